//! Trains a PredNet on synthetic frames and prints the seconds of the training, for comparison with PyTorch
//! (`lab/scripts/bars_train.py`).
//!
//! `train_speed FOLDER PRESET FRAMES BATCH EPOCHS THREADS` writes the frames and the initial weights to
//! FOLDER, trains, and prints one JSON object. All numbers are little-endian f32. `inputs.bin` and
//! `seconds.bin` contain standardized values, `weights.bin` contains the weights in the order of the layers.

use entire_train::gradient::{Network, Samples, Settings, train};
use std::io::Write;
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

const INPUTS: usize = 16;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, preset, frames, batch, epochs, threads] = &arguments[..] else {
        return Err("FOLDER PRESET FRAMES BATCH EPOCHS THREADS are expected".into());
    };
    let frames: usize = frames.parse()?;
    let settings = Settings { batch: batch.parse()?, epochs: epochs.parse()?, ..Settings::default() };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.parse()?).build()?;

    let mut state = 1u64;
    let mut noise = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 40) as f32 / (1u64 << 23) as f32 - 1.0) * 3f32.sqrt()
    };
    let inputs: Vec<f32> = (0..frames * INPUTS).map(|_| noise()).collect();
    let seconds: Vec<f64> = inputs
        .chunks(INPUTS)
        .map(|x| {
            let log = 0.6 * x[0] + 0.4 * x[1] * x[2] + 0.3 * (2.0 * x[3]).sin() - 0.2 * x[4].abs() - 4.0;
            f64::from(log).exp()
        })
        .collect();

    let widths = entire_train::gradient::preset_widths(preset, INPUTS)?;
    let network = Network::<f32>::random(&widths, 1)?;
    let write = |name: &str, values: &[f32]| -> std::io::Result<()> {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        std::fs::File::create(Path::new(folder).join(name))?.write_all(&bytes)
    };
    let standardized = entire_train::gradient::Standardization::fit(
        Samples { inputs: &inputs, seconds: &seconds },
        INPUTS,
        settings.target,
    );
    let (mean, std) = (standardized.output.mean[0], standardized.output.std[0]);
    let targets: Vec<f32> = seconds.iter().map(|t| (*t as f32 - mean) / std).collect();
    write("inputs.bin", &standardized.inputs(&inputs))?;
    write("seconds.bin", &targets)?;
    write("weights.bin", network.parameters())?;

    let started = Instant::now();
    let none = Samples { inputs: &[], seconds: &[] };
    let trained =
        train(&pool, network, None, Samples { inputs: &inputs, seconds: &seconds }, none, &settings, |_| {
            ControlFlow::Continue(())
        })?;
    let taken = started.elapsed().as_secs_f64();
    let losses: Vec<f64> = trained.history.iter().map(|h| h.training_loss).collect();
    println!("{}", serde_json::json!({ "seconds": taken, "losses": losses, "widths": widths }));
    Ok(())
}
