//! Baselines: the mean of some frames of each volume, and a low-resolution proxy.

use super::data::OnSet;
use super::findings::judge;
use super::{CONSTANT, Findings, PROXY, Set};
use crate::latency::Latency;
use anyhow::{Result, bail, ensure};
use entire_io::dataset::{Clock, Scene, Table, TimedFrame};
use entire_io::metrics::median;
use entire_train::evaluation::probe_means;
use entire_train::split::TimedFrames;
use std::collections::BTreeMap;

/// Evaluates the constant baseline: the mean time of a share of each volume's frames predicts all of its
/// frames.
pub(super) fn constant(on: &OnSet<'_>, out: &mut Findings) {
    let set = on.set;
    for (split, part) in set.splits.iter().zip(&on.data.splits) {
        let constant = probe_means(&part.frames, &part.seconds, 1);
        out.results.extend(judge(&set.name, &split.name, CONSTANT, "baseline", part, &constant, None));
    }
}

/// A straight line fitted by least squares.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Line {
    middle: (f64, f64),
    slope: f64,
}

impl Line {
    pub(crate) fn through(points: impl Iterator<Item = (f64, f64)> + Clone) -> Self {
        let n = points.clone().count() as f64;
        let (mx, my) = points.clone().fold((0.0, 0.0), |(x, y), p| (x + p.0 / n, y + p.1 / n));
        let (mut xx, mut xy) = (0.0, 0.0);
        for (x, y) in points {
            xx += (x - mx) * (x - mx);
            xy += (x - mx) * (y - my);
        }
        Self { middle: (mx, my), slope: if xx > 0.0 { xy / xx } else { 0.0 } }
    }

    pub(crate) fn at(&self, x: f64) -> f64 {
        self.middle.1 + self.slope * (x - self.middle.0)
    }
}

/// Seconds of the frames as rendered by the low-resolution proxy, by table and frame number.
pub(crate) type Low = BTreeMap<(usize, u64), f64>;

/// The line by which the low-resolution proxy predicts: seconds as a linear function of the seconds at low
/// resolution, fitted to the training frames. `None` if too few training frames were rendered at low
/// resolution.
pub(crate) fn line_of(low: &Low, training: &TimedFrames<'_>) -> Option<Line> {
    let pairs: Vec<(f64, f64)> = training
        .frames
        .iter()
        .zip(&training.seconds)
        .filter_map(|(f, t)| Some((*low.get(&(f.table, f.number))?, *t)))
        .collect();
    (pairs.len() > 2).then(|| Line::through(pairs.iter().copied()))
}

/// Predictions of the low-resolution proxy; `None` for a frame that was not rendered at low resolution.
pub(crate) fn by_proxy(low: &Low, line: Option<Line>, frames: &[&TimedFrame]) -> Vec<Option<f64>> {
    frames.iter().map(|f| Some(line?.at(*low.get(&(f.table, f.number))?))).collect()
}

/// The frames for which the low-resolution proxy has a prediction.
pub(crate) fn with_twins<'a>(all: &TimedFrames<'a>, proxy: &[Option<f64>]) -> TimedFrames<'a> {
    let all = all.frames.iter().zip(&all.seconds).zip(proxy);
    let (frames, seconds) = all.filter(|(_, p)| p.is_some()).map(|((f, t), _)| (*f, *t)).unzip();
    TimedFrames { frames, seconds }
}

/// Evaluates the low-resolution proxy: seconds as a linear function of the seconds of the same frame on 64³
/// voxels.
pub(super) fn proxy(on: &OnSet<'_>, low: &Low, out: &mut Findings) -> Result<()> {
    let (set, training, splits) = (on.set, &on.data.one_step.all, &on.data.splits);
    if low.is_empty() {
        return Ok(());
    }
    let line = line_of(low, training);
    ensure!(
        line.is_some(),
        "set {}: low_resolution has fewer than 3 frames of the training tables",
        set.name
    );
    for (split, part) in set.splits.iter().zip(splits) {
        let proxy = by_proxy(low, line, &part.frames);
        let seconds: Vec<f64> = proxy.iter().copied().flatten().collect();
        let part = with_twins(part, &proxy);
        out.results.extend(judge(&set.name, &split.name, PROXY, "baseline", &part, &seconds, None));
    }
    let mut times: Vec<f64> = low.values().copied().collect();
    if let Some(t) = median(&mut times) {
        out.latencies.push((set.name.clone(), PROXY.into(), Latency { cold: t, warm: t, transfer: 0.0 }));
    }
    Ok(())
}

/// Seconds of the frames of `tables` when they are rendered with 64³ voxels, by table and frame number.
/// Frames of a table for which `set.low_resolution` names no file are left out.
pub(super) fn low_resolution(set: &Set, tables: &[Table], clock: Clock) -> Result<Low> {
    let mut low = Low::new();
    for (index, table) in tables.iter().enumerate() {
        let Some(path) = set.low_resolution.get(&file_name(table)) else { continue };
        twins((index, table), path, clock, &mut low)?;
    }
    Ok(low)
}

fn file_name(table: &Table) -> String {
    table.path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Reads the low-resolution table at `path` and adds the seconds of its frames to `low`. The key is the index
/// of the full-resolution table and the number of that table's frame of the same scene.
///
/// # Errors
/// When the table at `path` cannot be read, or shows a scene that the full-resolution table lacks.
pub(crate) fn twins(
    (index, table): (usize, &Table),
    path: &std::path::Path,
    clock: Clock,
    low: &mut Low,
) -> Result<()> {
    // The scenes must be equal except for the number of voxels.
    let key = |scene: &Scene| format!("{:?}", Scene { dims: [0; 3], ..scene.clone() });
    let numbers: BTreeMap<String, u64> = table.frames.iter().map(|f| (key(&f.scene), f.number)).collect();
    for twin in Table::read_without_features(path, 0)?.frames {
        let Some(number) = numbers.get(&key(&twin.scene)) else {
            bail!(
                "{}: frame {} shows a scene that {} lacks; collect it with the same seed, volumes and \
                 settings",
                path.display(),
                twin.number,
                file_name(table)
            );
        };
        low.extend(twin.seconds(clock).map(|t| ((index, *number), t)));
    }
    Ok(())
}
