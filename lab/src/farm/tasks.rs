//! Tasks of a recorded path or a timing table, predicted by a model that was fitted to other volumes.

use crate::trace::{Curve, Trace};
use anyhow::{Context, Result, ensure};
use entire_farm::Task;
use entire_io::dataset::{Clock, read_tables, timed};
use entire_io::files::open_model;
use entire_io::metrics::median;
use entire_io::options::thread_pool;
use entire_steer::features::{Changes, FrameFeatures, MAX_PROBE_SIDE, Setting, TransferSummary};
use entire_steer::predict::{AnalyticModel, COSTS, Inputs, Predictor, UnitCosts};
use entire_train::fit::{FitContext, predict};
use std::path::{Path, PathBuf};

/// Adds work and seconds for every frame of a trace and every recorded ray step at full image size.
fn add(measured: &mut Vec<([f64; COSTS], f64)>, trace: &Trace, probe_side: usize) -> Result<()> {
    let (path, summaries) = (trace.path.resolve()?, trace.summaries()?);
    for (index, at) in path.frames.iter().enumerate() {
        let summary = &summaries[trace.volume_at(index)];
        let table = at.transfer.function().to_table()?;
        let mut transfer = TransferSummary::new(summary, &table)?;
        let frame = trace.frame(&path, index)?;
        let features = FrameFeatures::of(summary, &mut transfer, &frame, probe_side)?;
        for p in trace.frames[index].iter().filter(|p| p.scale == 1.0) {
            let setting = Setting { step: p.step, ..Setting::from(&frame) };
            let seconds = median(&mut p.seconds.clone()).context("a point without a time")?;
            measured.push((features.cost_work(&setting), seconds));
        }
    }
    Ok(())
}

/// The analytic model fitted to recorded frames of other volumes, with a probe of `side` × `side` rays.
fn task_predictor(training: &[PathBuf], side: usize) -> Result<AnalyticModel> {
    ensure!(
        (1..=MAX_PROBE_SIDE).contains(&side),
        "--probe-side is {side}; it must lie in 1 to {MAX_PROBE_SIDE}"
    );
    ensure!(
        !training.is_empty(),
        "the frames of --trace cannot be predicted without --training (recorded frames of other volumes)"
    );
    let mut measured = Vec::new();
    for file in training {
        add(&mut measured, &Trace::open(file)?, side)?;
    }
    Ok(AnalyticModel::fit(&UnitCosts::SOFTWARE, &measured, side)?.0)
}

/// The frames of a recorded path at the reference step as tasks. Their predictor is fitted to `training`,
/// recordings of other volumes with the same transfer function, and has a probe of `probe_side` ×
/// `probe_side` rays.
pub(crate) fn tasks_of_trace(trace: &Trace, training: &[PathBuf], probe_side: usize) -> Result<Vec<Task>> {
    let mut predictor = task_predictor(training, probe_side)?;
    let (path, summaries) = (trace.path.resolve()?, trace.summaries()?);
    let mut tasks = Vec::with_capacity(trace.frames.len());
    let mut took = std::time::Duration::ZERO;
    for (index, at) in path.frames.iter().enumerate() {
        let volume = trace.volume_at(index);
        let table = at.transfer.function().to_table()?;
        let mut transfer = TransferSummary::new(&summaries[volume], &table)?;
        let frame = trace.frame(&path, index)?;
        let begin = std::time::Instant::now();
        let features = FrameFeatures::of(&summaries[volume], &mut transfer, &frame, probe_side)?;
        let lobes = at.transfer.lobes();
        let predicted = predictor.predict(&Inputs {
            features: &features,
            setting: Setting::from(&frame),
            changes: Changes::default(),
            camera: at.parallel_scale.map_or(at.camera, |_| frame.camera.to_arcball()),
            volume_features: None,
            lobes: lobes.as_deref(),
        })?;
        took += begin.elapsed();
        tasks.push(Task {
            task: format!("frame {index}"),
            predicted_s: Some(f64::from(predicted.seconds)),
            measured_s: Some(Curve::of(&trace.frames[index]).seconds(1.0)),
            volume: trace.volumes[volume].file.display().to_string(),
            load_s: 0.0,
        });
    }
    println!("prediction {:.3} ms per task", 1e3 * took.as_secs_f64() / tasks.len().max(1) as f64);
    Ok(tasks)
}

/// Tables of held-out volumes, each with the model that predicts it (as in `data/timings/study.json`).
pub(super) const HELD_OUT: [(&str, &str); 9] = [
    ("none-members", "unshaded-selected"),
    ("none-scans", "unshaded-selected"),
    ("none-others", "unshaded-selected"),
    ("none-timestep", "unshaded-selected"),
    ("local-members", "local-selected"),
    ("local-scans", "local-selected"),
    ("local-others", "local-selected"),
    ("scatter-members", "scatter-selected"),
    ("scatter-scans", "scatter-selected"),
];

/// Returns the frames of a table as tasks. A model predicts their times; the measured time of a frame is the
/// median processor time of its repeats.
pub(super) fn tasks_of_table(table: &str, model: &str) -> Result<Vec<Task>> {
    let tables = read_tables(&[format!("data/timings/{table}.csv.gz").into()])?;
    let model = open_model(Path::new(&format!("models/{model}.safetensors")))?;
    let pairs = timed(&tables, Clock::Cpu, None)?;
    let frames: Vec<_> = pairs.iter().map(|(f, _)| *f).collect();
    let pool = thread_pool(None)?;
    let (bar, stop) = (indicatif::ProgressBar::hidden(), || false);
    let context = FitContext { tables: &tables, pool: &pool, bar: &bar, stop: &stop };
    let predicted = predict(&model, &context, &frames).with_context(|| format!("table {table}"))?;
    let tasks: Vec<Task> = pairs
        .iter()
        .zip(predicted)
        .map(|((frame, seconds), predicted)| Task {
            task: format!("{table} {}", frame.number),
            predicted_s: Some(predicted.max(1e-6)),
            measured_s: Some(*seconds),
            volume: frame.scene.volume.clone(),
            load_s: 0.0,
        })
        .collect();
    ensure!(!tasks.is_empty(), "the table {table} holds no frame");
    Ok(tasks)
}
