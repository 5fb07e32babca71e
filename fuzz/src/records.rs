//! Invariants of tables, manifests, paths, task lists and farm jobs.

use crate::dataset::{Clock, Manifest, feature_table::FeatureTable, noise_floor, parse_table};
use crate::farm::job::{CamerasEntry, Job, JobFile, Renderer};
use crate::farm::{By, Method, parse_tasks, plan, play, times};
use crate::path::{MAX_FRAMES, PathFile};
use std::collections::HashSet;
use std::fmt::Display;
use std::path::Path;

/// Number of frames above which a path is not resolved into frames: a million frames would take a second.
const MOST_PATH_FRAMES: u32 = 4096;

/// Returns an accepted value; checks that an error has a message.
pub(crate) fn accepted<T, E: Display>(read: Result<T, E>) -> Option<T> {
    read.inspect_err(|error| assert!(!format!("{error:#}").is_empty())).ok()
}

/// Checks that every frame of an accepted table can be drawn and that its seconds are finite and positive.
pub fn check_table(input: &[u8]) {
    let Some(frames) = accepted(parse_table(input, 3)) else { return };
    for frame in &frames {
        assert!(frame.table == 3 && !frame.repeats.is_empty());
        frame.scene.to_frame().expect("a checked scene can be drawn");
        frame.scene.to_table().expect("a checked transfer function has a table");
        for clock in Clock::ALL {
            assert!(frame.seconds(clock).is_none_or(|s| s.is_finite() && s > 0.0));
        }
    }
    for clock in Clock::ALL {
        let _ = noise_floor(&frames, clock, |_| 1);
    }
}

/// Checks that every column of an accepted feature table is found by its name, and that the row of frame 1,
/// if there is one, has a finite value in every column.
pub fn check_features(input: &[u8]) {
    let Some(table) = accepted(FeatureTable::parse(input)) else { return };
    for (i, name) in table.columns().iter().enumerate() {
        assert!(table.column(name).is_some_and(|at| at <= i));
    }
    if let Some(row) = table.row(1) {
        assert!(row.len() == table.columns().len() && row.iter().all(|v| v.is_finite()));
    }
}

/// Checks that an accepted manifest can be written and read again.
pub fn check_manifest(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else { return };
    let Some(manifest) = accepted(Manifest::parse(text)) else { return };
    let written = serde_json::to_string(&manifest).expect("a manifest can be written");
    Manifest::parse(&written).expect("a written manifest can be read");
}

/// Checks that at least 16 frames (all frames of a shorter path) have a camera and a transfer table, in an
/// accepted path of at most `MOST_PATH_FRAMES` frames. Paths of more frames, up to `MAX_FRAMES`, are only
/// parsed.
pub fn check_path(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else { return };
    let Some(file) = accepted(PathFile::parse(text)) else { return };
    if file.frames > MOST_PATH_FRAMES && file.frames <= MAX_FRAMES {
        return;
    }
    let Some(path) = accepted(file.resolve()) else { return };
    assert_eq!(path.frames.len(), file.frames as usize);
    for (i, frame) in path.frames.iter().enumerate().step_by((path.frames.len() / 16).max(1)) {
        path.camera(i).expect("an interpolated camera");
        frame.transfer.function().to_table().expect("an interpolated transfer function");
    }
}

/// Checks that every plan for the tasks of an accepted list, by any method, contains each task once.
pub fn check_tasks(input: &[u8]) {
    let (json, input) = match input.split_first() {
        Some((b'j', rest)) => (true, rest),
        Some((b'c', rest)) => (false, rest),
        _ => return,
    };
    let Some(tasks) = accepted(parse_tasks(input, json)) else { return };
    if tasks.len() > 64 {
        return;
    }
    let speeds = [1.0, 2.0, 0.5];
    for by in [By::Predicted, By::Measured, By::Uniform] {
        let Ok(seconds) = times(&tasks, by) else { continue };
        for method in [Method::Static, Method::Longest, Method::Queue, Method::Arrival] {
            let timeline =
                plan(method, &seconds, &speeds).and_then(|plan| play(&plan, &seconds, &tasks, &speeds));
            let Some(timeline) = accepted(timeline) else { continue };
            let mut done: Vec<usize> = timeline.spans.iter().map(|s| s.task).collect();
            done.sort_unstable();
            assert_eq!(done, (0..tasks.len()).collect::<Vec<_>>());
            assert!(timeline.makespan >= 0.0);
        }
    }
}

/// Number of views of an entry above which a job is only parsed. A job may have twenty million views, which
/// take a second and a gigabyte.
const MOST_VIEWS: u32 = 100;

/// Checks that the tasks of an accepted job have different ids and lie within the job's dimensions. A job
/// that could name a file outside of its folder is only parsed.
pub fn check_job(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else { return };
    let Some(file) = accepted(JobFile::parse(text)) else { return };
    let outside = |path: &str| path.contains(['/', '\\', '*', '?', '[']);
    let many = |entry: &CamerasEntry| match entry {
        CamerasEntry::Orbit { views, .. } | CamerasEntry::SemiSphere { views, .. } => *views > MOST_VIEWS,
        CamerasEntry::List { .. } => false,
    };
    if file.volumes.iter().flat_map(|entry| &entry.files).any(|path| outside(path))
        || file.cameras.iter().any(many)
        || matches!(file.renderer, Renderer::Pvbatch { .. })
    {
        return;
    }
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus/raw");
    let Some(job) = accepted(Job::new(file, &folder)) else { return };
    let lengths =
        [job.volumes.len(), job.cameras.len(), job.transfers.len(), job.sizes.len(), job.steps.len()];
    assert_eq!(job.len(), lengths.iter().product::<usize>());
    let mut ids = HashSet::new();
    for task in 0..job.len().min(1000) {
        let at = job.place(task);
        let indices = [at.volume, at.camera, at.transfer, at.size, at.step];
        assert!(indices.iter().zip(lengths).all(|(&index, length)| index < length));
        assert!(ids.insert(job.id(task)), "two tasks have the same id");
    }
}
