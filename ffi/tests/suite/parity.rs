//! C and Rust give the same bits: the C program `tests/c/parity.c` and this test evaluate the same model on
//! the same inputs.
//!
//! Run by `make test-ffi`, which builds the program against the installed library and names it in
//! `ENTIRE_C_PARITY`.

use entire_core::kernels::Executor;
use entire_core::model::Model;
use entire_core::nn::{PredNet, VolumeNet};
use entire_core::scene::{
    Arcball, Camera, Frame, GaussianLobe, Scalars, TransferFunction, VolumeOptions, VolumeView,
};
use entire_steer::control::{HybridOptions, Session};
use entire_steer::features::VolumeSummary;
use entire_steer::predict;
use std::io::Write;
use std::process::{Command, Stdio};

const TOY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden/toy_model/toy.safetensors");

fn model() -> Model {
    Model::from_bytes(&std::fs::read(TOY).unwrap()).unwrap()
}

/// Inputs of many magnitudes, the same on every run.
fn rows(columns: usize) -> Vec<f32> {
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    let mut rows = Vec::new();
    for row in 0..500 {
        for column in 0..columns {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let unit = (state >> 40) as f32 / (1u64 << 24) as f32;
            let scale = [1.0, 1.0, 90.0, 180.0, 5.0, 1024.0, 1024.0, 1.0, 0.05, 1.0, 8.0][column % 11];
            rows.push(scale * (unit - 0.3 * (row % 3) as f32));
        }
    }
    rows
}

#[test]
#[ignore = "needs the C program that `make test-ffi` builds, named in ENTIRE_C_PARITY"]
fn predictions_features_and_plans_are_the_same_bits_in_rust_and_c() {
    let program = std::env::var_os("ENTIRE_C_PARITY").expect("ENTIRE_C_PARITY names the parity program");
    let model = model();
    let net = PredNet::new(model.prednet.as_ref().unwrap()).unwrap();
    let inputs = rows(net.inputs());

    let mut child = Command::new(&program)
        .args([TOY, &net.inputs().to_string()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap_or_else(|e| panic!("{program:?}: {e}"));
    let mut stdin = child.stdin.take().unwrap();
    let bytes: Vec<u8> = inputs.iter().flat_map(|v| v.to_ne_bytes()).collect();
    let writer = std::thread::spawn(move || stdin.write_all(&bytes).unwrap());
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    assert!(output.status.success(), "the C program failed");
    let found: Vec<f32> =
        output.stdout.chunks_exact(4).map(|b| f32::from_ne_bytes([b[0], b[1], b[2], b[3]])).collect();

    let mut wanted = Vec::new();
    let mut scratch = net.scratch(1).unwrap();
    for row in inputs.chunks_exact(net.inputs()) {
        let mut seconds = [net.predict(row, &mut scratch)];
        predict::check_predictions(&mut seconds).unwrap();
        wanted.extend(seconds);
    }

    let voxels: Vec<u8> = (0..5 * 7 * 11).map(|i| (i * 37 % 256) as u8).collect();
    let options = VolumeOptions { spacing: [1.0, 2.0, 7.0], ..VolumeOptions::default() };
    let view = VolumeView::with(Scalars::U8(&voxels), [5, 7, 11], options).unwrap();
    let encoder = VolumeNet::new(model.volumenet.as_ref().unwrap()).unwrap();
    let mut features = vec![0.0; encoder.feature_len()];
    encoder.encode(&view, &mut encoder.scratch(), Executor::Serial, &mut features).unwrap();
    wanted.extend_from_slice(&features);

    let lobes = [GaussianLobe { center: 0.5, width: 0.05, height: 0.3 }];
    let table = TransferFunction::Gaussian(lobes.to_vec()).to_table().unwrap();
    let mut session = Session::new(predict::load(&model).unwrap(), HybridOptions::default()).unwrap();
    session.set_volume(VolumeSummary::new(&view).unwrap(), Some(features.clone()));
    session.set_transfer(&table, Some(&lobes)).unwrap();
    for i in 0..50u8 {
        let pose = Arcball { rx: f32::from(i), ry: 7.0 * f32::from(i), dz: 3.0 };
        let frame = Frame::new(Camera::from_arcball(pose).unwrap(), 96, 64).unwrap();
        let plan = session.plan(&frame, 0.004).unwrap();
        wanted.extend([plan.seconds, plan.step]);
        session.observe(plan.id, 0.001 + 0.01 / plan.step, Default::default()).unwrap();
    }

    assert_eq!(found.len(), wanted.len());
    for (i, (c, rust)) in found.iter().zip(&wanted).enumerate() {
        assert_eq!(c.to_bits(), rust.to_bits(), "number {i}: C has {c}, Rust {rust}");
    }
    assert!(wanted.iter().filter(|v| v.is_finite()).count() > 500);
}
