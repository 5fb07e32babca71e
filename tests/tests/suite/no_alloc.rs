//! Checks that predictions of networks allocate nothing after set-up, on every level (instruction set) and
//! with every storage format. If a call allocates, the test's allocator aborts the process.

use assert_no_alloc::{AllocDisabler, assert_no_alloc};
use entire_core::kernels::{Executor, Level, Storage};
use entire_core::nn::{DenseParts, Dtype, Normalization, PredNet, PredNetParts, Target};

#[global_allocator]
static ALLOCATOR: AllocDisabler = AllocDisabler;

fn network() -> PredNetParts {
    let sizes = [16, 256, 256, 128, 40, 1];
    let number = |i: usize| ((i * 2_654_435_761) % 1000) as f32 / 5000.0 - 0.1;
    let layers = sizes.windows(2).map(|size| DenseParts {
        inputs: size[0],
        outputs: size[1],
        weight: (0..size[0] * size[1]).map(number).collect(),
        bias: (0..size[1]).map(number).collect(),
        dtype: Dtype::F32,
    });
    PredNetParts {
        layers: layers.collect(),
        input: Some(Normalization { mean: vec![0.5; 16], std: vec![2.0; 16] }),
        output: Some(Normalization { mean: vec![-4.0], std: vec![0.5] }),
        target: Target::LogSeconds,
    }
}

/// Starts a copy of this test with `ENTIRE_TEST_ALLOCATES` set. The copy allocates, and must be aborted.
#[test]
fn an_allocation_aborts_the_process() {
    const ALLOCATES: &str = "ENTIRE_TEST_ALLOCATES";
    if std::env::var_os(ALLOCATES).is_some() {
        assert_no_alloc(|| drop(std::hint::black_box(vec![0u8; 64])));
        return;
    }
    let copy = std::process::Command::new(std::env::current_exe().expect("the path of this test"))
        .args(["--exact", "no_alloc::an_allocation_aborts_the_process"])
        .env(ALLOCATES, "1")
        .output()
        .expect("a copy of this test");
    assert!(!copy.status.success());
}

#[test]
fn an_encoder_that_never_runs_has_no_working_memory() {
    use entire_core::nn::{ConvBlockParts, VolumeNet, VolumeNetParts};
    let block = ConvBlockParts {
        inputs: 1,
        outputs: 1,
        kernel: 1,
        stride: 128,
        padding: 0,
        weight: vec![1.0],
        bias: vec![0.0],
        input_edge: 128,
        output_edge: 1,
        dtype: Dtype::F32,
    };
    let fc = DenseParts { inputs: 1, outputs: 1, weight: vec![1.0], bias: vec![0.0], dtype: Dtype::F32 };
    let net = VolumeNet::new(&VolumeNetParts { input: 128, blocks: vec![block], fc }).expect("an encoder");
    assert_no_alloc(|| drop(std::hint::black_box(net.scratch())));
}

#[test]
fn predictions_allocate_nothing() {
    for level in Level::available() {
        for storage in Storage::ALL {
            let net = PredNet::with(&network(), level, storage).expect("a network");
            let inputs: Vec<f32> = (0..16 * 100).map(|i| (i % 37) as f32 * 0.1).collect();
            let mut scratch = net.scratch(1).expect("memory");
            let mut seconds = vec![0.0; 100];
            let mut scratches = [(); 2].map(|()| net.scratch(30).expect("memory"));
            assert_no_alloc(|| {
                let mut sum = 0.0;
                for row in inputs.chunks_exact(16) {
                    sum += net.predict(row, &mut scratch);
                }
                net.predict_batch(Executor::Serial, &inputs, &mut seconds, &mut scratches[..1])
                    .expect("a batch");
                sum += seconds[99];
                net.predict_batch(Executor::Serial, &inputs, &mut seconds, &mut scratches)
                    .expect("a batch in two parts");
                assert!((sum + seconds[0]).is_finite());
            });
        }
    }
}
