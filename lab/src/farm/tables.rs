//! Tasks from timing tables: measured frames, predicted by a model that was trained on other volumes.

use anyhow::{Context, Result, ensure};
use entire_farm::Task;
use entire_io::dataset::{Clock, read_tables, timed};
use entire_io::files::open_model;
use entire_io::options::thread_pool;
use entire_train::fit::{FitContext, predict};
use std::path::Path;

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
pub(super) fn tasks(table: &str, model: &str) -> Result<Vec<Task>> {
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
