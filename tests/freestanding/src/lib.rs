//! Computation and output of the freestanding program, shared with the test that compares it with a hosted
//! build.
#![no_std]

extern crate alloc;

use alloc::string::{String, ToString};
use alloc::vec;
use alloc::vec::Vec;
use core::fmt::Write;
use entire_core::kernels::Level;
use entire_core::kernels::{Executor, Storage};
use entire_core::model::Model;
use entire_core::nn::{PredNet, VolumeNet};
use entire_core::scene::{Scalars, VolumeView};

/// Loads a model and prints the bits of its results: one line per level and storage format for the
/// prediction network, and one line per level and volume for the volume network.
///
/// # Errors
/// The core's message, "the model has no …", or "cannot write".
pub fn report(model: &[u8], out: &mut dyn Write) -> Result<(), String> {
    let text = |e: entire_core::Error| e.to_string();
    let failed = |_| String::from("cannot write");
    let model = Model::from_bytes(model).map_err(text)?;
    let prednet = model.prednet.as_ref().ok_or("the model has no PredNet")?;
    let volumenet = model.volumenet.as_ref().ok_or("the model has no VolumeNet")?;
    for level in Level::available() {
        for storage in [Storage::F32, Storage::F16, Storage::Bf16] {
            let net = PredNet::with(prednet, level, storage).map_err(text)?;
            let mut scratch = net.scratch(1).map_err(text)?;
            let mut inputs = vec![0.0f32; net.inputs() * 3];
            for (i, x) in inputs.iter_mut().enumerate() {
                *x = (i * 37 % 101) as f32 / 50.0 - 1.0;
            }
            write!(out, "prednet {} {storage:?}", level.isa()).map_err(failed)?;
            for row in inputs.chunks_exact(net.inputs()) {
                write!(out, " {:08x}", net.predict(row, &mut scratch).to_bits()).map_err(failed)?;
            }
            let mut seconds = [0.0f32; 3];
            net.predict_batch(Executor::Serial, &inputs, &mut seconds, core::slice::from_mut(&mut scratch))
                .map_err(text)?;
            for s in seconds {
                write!(out, " {:08x}", s.to_bits()).map_err(failed)?;
            }
            writeln!(out).map_err(failed)?;
        }
        let net = VolumeNet::with(volumenet, level).map_err(text)?;
        let mut scratch = net.scratch();
        let mut features = vec![0.0f32; net.feature_len()];
        let n = volumenet.input;
        // Resampling from the same size, from larger ones by whole and by fractional factors, and from a
        // smaller one.
        for dims in [[n; 3], [2 * n; 3], [n + 3, 2 * n - 1, n + 1], [1, n / 2, 3]] {
            let voxels = dims.iter().product();
            let bytes: Vec<u8> = (0..voxels).map(|i| (i * 193 % 251) as u8).collect();
            let floats: Vec<f32> = bytes.iter().map(|&b| f32::from(b) * 0.37 - 11.0).collect();
            for scalars in [Scalars::U8(&bytes), Scalars::F32(&floats)] {
                let view = VolumeView::new(scalars, dims).map_err(text)?;
                net.encode(&view, &mut scratch, Executor::Serial, &mut features).map_err(text)?;
                write!(out, "volumenet {} {:?} {dims:?}", level.isa(), view.scalars().scalar_type())
                    .map_err(failed)?;
                for f in &features {
                    write!(out, " {:08x}", f.to_bits()).map_err(failed)?;
                }
                writeln!(out).map_err(failed)?;
            }
        }
    }
    Ok(())
}
