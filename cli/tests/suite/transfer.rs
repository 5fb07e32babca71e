//! A model of one renderer is calibrated to another with a few frames.

use entire_cli::calibrate::{calibrate_from, calibrate_to_frames};
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

#[test]
fn a_model_of_the_raycaster_learns_vtk_from_a_few_frames() {
    let tables = tables(&["none-others", "vtk-gpu-train", "vtk-gpu-test"]);
    let [here, there, unseen] = [0, 1, 2].map(|i: usize| TimedFrames::of(&tables[i].frames, Clock::Cpu));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let bar = indicatif::ProgressBar::hidden();
    let context = FitContext { tables: &tables, pool: &pool, bar: &bar, stop: &|| false };
    let recipe = |kind| Recipe { kind, ..Recipe::default() };
    let nothing = Timed { frames: &[], seconds: &[] };
    let base = recipe(Kind::Analytic).make(&context, here.timed(), nothing).unwrap().file;
    let few: Vec<usize> = (0..there.frames.len()).step_by(20).collect();
    let frames: Vec<_> = few.iter().map(|&i| there.frames[i]).collect();
    let seconds: Vec<f64> = few.iter().map(|&i| there.seconds[i]).collect();
    let few = Timed { frames: &frames, seconds: &seconds };
    let tuned = calibrate_to_frames(&base, &context, few).unwrap();
    let error = |file: &entire_core::model::ModelFile| {
        let predicted = predict(&file.to_model().unwrap(), &context, &unseen.frames).unwrap();
        Metrics::new(&predicted, &unseen.seconds).unwrap().rmse_over_sd
    };
    let (before, after) = (error(&base), error(&tuned));
    assert!(after < 0.25 && after < 0.5 * before, "{before} as it is, {after} calibrated");
}

#[test]
fn what_converting_stored_values_costs_is_told_from_the_volume() {
    let tables = tables(&["vtk-fixed-train", "vtk-fixed-test"]);
    let [train, unseen] = [0, 1].map(|i: usize| TimedFrames::of(&tables[i].frames, Clock::Cpu));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let bar = indicatif::ProgressBar::hidden();
    let context = FitContext { tables: &tables, pool: &pool, bar: &bar, stop: &|| false };
    let nothing = Timed { frames: &[], seconds: &[] };
    let recipe = Recipe { kind: Kind::Analytic, ..Recipe::default() };
    let error = |context: &FitContext<'_>| {
        let file = recipe.make(context, train.timed(), nothing).unwrap().file;
        let predicted = predict(&file.to_model().unwrap(), context, &unseen.frames).unwrap();
        Metrics::new(&predicted, &unseen.seconds).unwrap().rmse_over_sd
    };
    let converting = error(&context);
    // The same frames, as if the CPU version of the raycaster had drawn them.
    let mut as_ours = tables.clone();
    for t in &mut as_ours {
        t.manifest.as_mut().unwrap().renderer = "cpu".into();
    }
    let plain = error(&FitContext { tables: &as_ours, ..context });
    assert!(converting < 0.2 && converting < 0.75 * plain, "{converting}, {plain} without");
}

#[test]
fn the_longest_ray_decides_how_long_a_gpu_takes() {
    let tables = tables(&["none-h100-train", "none-h100-members"]);
    let [train, unseen] = [0, 1].map(|i: usize| TimedFrames::of(&tables[i].frames, Clock::Device));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let bar = indicatif::ProgressBar::hidden();
    let context = FitContext { tables: &tables, pool: &pool, bar: &bar, stop: &|| false };
    let error = |context: &FitContext<'_>| {
        let file = calibrate_from(&[], context, train.timed()).unwrap();
        let predicted = predict(&file.to_model().unwrap(), context, &unseen.frames).unwrap();
        Metrics::new(&predicted, &unseen.seconds).unwrap().rmse_over_sd
    };
    let gpu = error(&context);
    // The same frames, as if a software driver had drawn them: no cost is that of a single ray.
    let mut as_software = tables.clone();
    for t in &mut as_software {
        t.manifest.as_mut().unwrap().device = "llvmpipe".into();
    }
    let software = error(&FitContext { tables: &as_software, ..context });
    assert!(gpu < 0.35 && gpu < 0.6 * software, "{gpu}, {software} as if in software");
}
