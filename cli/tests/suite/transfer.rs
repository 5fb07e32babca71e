//! A model of one renderer is calibrated to a second renderer with a few frames of the second renderer.

use entire_cli::calibrate::calibrate_to_frames;
use entire_core::model::ModelFile;
use entire_io::dataset::{Clock, Table, Timed};
use entire_io::metrics::Metrics;
use entire_train::fit::{FitContext, Kind, Recipe, predict};
use entire_train::split::TimedFrames;
use std::path::Path;

/// Tables of data/timings, numbered in their order.
fn tables(names: &[&str]) -> Vec<Table> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().join("data/timings");
    let read = |(i, name)| Table::read(&folder.join(format!("{name}.csv.gz")), i).unwrap();
    names.iter().enumerate().map(read).collect()
}

/// Fits a model to the frames of the first table by `fit`. Returns its RMSE/SD on the second table, and the
/// model.
fn error(
    tables: &[Table],
    clock: Clock,
    fit: impl Fn(&FitContext<'_>, Timed<'_>) -> anyhow::Result<ModelFile>,
) -> (f64, ModelFile) {
    let [train, unseen] = [0, 1].map(|i: usize| TimedFrames::of(&tables[i].frames, clock));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let bar = indicatif::ProgressBar::hidden();
    let context = FitContext { tables, pool: &pool, bar: &bar, stop: &|| false };
    let file = fit(&context, train.timed()).unwrap();
    let predicted = predict(&file.to_model().unwrap(), &context, &unseen.frames).unwrap();
    (Metrics::new(&predicted, &unseen.seconds).unwrap().rmse_over_sd, file)
}

fn unit_costs(context: &FitContext<'_>, frames: Timed<'_>) -> anyhow::Result<ModelFile> {
    let recipe = Recipe { kind: Kind::Analytic, ..Recipe::default() };
    Ok(recipe.make(context, frames, Timed { frames: &[], seconds: &[] })?.file)
}

#[test]
fn a_model_of_the_raycaster_learns_vtk_from_a_few_frames() {
    let (before, base) = error(&tables(&["none-others", "vtk-gpu-test"]), Clock::Cpu, unit_costs);
    let (after, _) = error(&tables(&["vtk-gpu-train", "vtk-gpu-test"]), Clock::Cpu, |context, all| {
        let frames: Vec<_> = all.frames.iter().copied().step_by(20).collect();
        let seconds: Vec<f64> = all.seconds.iter().copied().step_by(20).collect();
        let few = Timed { frames: &frames, seconds: &seconds };
        calibrate_to_frames(std::slice::from_ref(&base), context, few)
    });
    assert!(after < 0.25 && after < 0.5 * before, "{before} as it is, {after} calibrated");
}

/// The same tables, as if a renderer with this backend on this device had drawn them.
fn drawn_by(tables: &[Table], backend: &str, device: &str) -> Vec<Table> {
    let mut out = tables.to_vec();
    for manifest in out.iter_mut().filter_map(|t| t.manifest.as_mut()) {
        (manifest.renderer, manifest.device) = (backend.into(), device.into());
    }
    out
}

#[test]
fn what_converting_stored_values_costs_is_told_from_the_volume() {
    let tables = tables(&["vtk-fixed-train", "vtk-fixed-test"]);
    let (converting, _) = error(&tables, Clock::Cpu, unit_costs);
    let (plain, _) = error(&drawn_by(&tables, "cpu", "CPU"), Clock::Cpu, unit_costs);
    assert!(converting < 0.2 && converting < 0.75 * plain, "{converting}, {plain} without");
}

#[test]
fn the_longest_ray_decides_how_long_a_gpu_takes() {
    let tables = tables(&["none-h100-train", "none-h100-members"]);
    let fit = |context: &FitContext<'_>, frames: Timed<'_>| calibrate_to_frames(&[], context, frames);
    let (gpu, _) = error(&tables, Clock::Device, fit);
    // A software renderer has no cost of the longest ray.
    let (software, _) = error(&drawn_by(&tables, "vulkan", "llvmpipe"), Clock::Device, fit);
    assert!(gpu < 0.35 && gpu < 0.6 * software, "{gpu}, {software} as if in software");
}
