//! Results of the study, in one small file for every part of it, data set and mode.

use super::description::Panel;
use anyhow::{Context, Result};
use entire_io::files::{make_folder, read_text, write_json};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Errors of a predictor on some frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// The predictor.
    pub name: String,
    /// The split, or the experiment.
    pub split: String,
    /// Number of test frames.
    pub frames: usize,
    /// Number of training runs.
    pub runs: usize,
    /// Mean over the runs, seconds.
    pub rmse: f64,
    /// Standard deviation over the runs, seconds.
    pub rmse_sd: f64,
    /// Median over the runs, seconds.
    pub rmse_median: f64,
    /// Standard deviation of the measured seconds.
    pub sd: f64,
    /// Mean of the measured seconds.
    pub mean: f64,
    /// RMSE over that of the mean of 15 % of the frames.
    pub over_constant: Option<f64>,
    /// RMSE over that of the low-resolution proxy.
    pub over_lvrp: Option<f64>,
    /// Median of |predicted − measured| / measured, mean over the runs.
    pub mdape: f64,
    /// Seconds of one prediction, if it was measured.
    pub latency: Option<f64>,
    /// Squared errors of all runs: 5th, 25th, 50th, 75th, 95th percentile.
    pub squared_errors: [f64; 5],
    /// Other numbers.
    #[serde(default)]
    pub more: BTreeMap<String, f64>,
}

/// A line of a chart.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// The chart that it belongs to.
    pub chart: String,
    /// Name of the curve.
    pub name: String,
    /// Quantity along x.
    pub x: String,
    /// (x, y).
    pub points: Vec<(f64, f64)>,
}

/// The chart of the orbit's times; its curve of measured times is [`MEASURED`].
pub(super) const ORBIT_CHART: &str = "orbit";
/// The chart of the orbit with drawn transfer functions: a curve per volume.
pub(super) const DRAWN_CHART: &str = "orbit, drawn transfer functions";
/// The curve of measured times.
pub(super) const MEASURED: &str = "measured";
/// Quantity along x where a curve has a point per frame.
pub(super) const SORTED: &str = "frames, by their measured time";

/// Named numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Fact {
    /// Name of the group of numbers.
    pub name: String,
    /// By name.
    pub values: BTreeMap<String, f64>,
}

/// Results of one part of the study for one data set and mode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Results {
    /// Hash of the inputs.
    pub identity: String,
    /// The part of the study.
    pub panel: Panel,
    /// The data set.
    pub set: String,
    /// The mode.
    pub mode: String,
    /// Training, validation and test frames, by split.
    pub frames: BTreeMap<String, [usize; 3]>,
    /// The network's encoder.
    pub encoder: String,
    /// Device that the frames were measured on.
    pub device: String,
    /// Its machine.
    pub machine: String,
    /// Errors.
    pub rows: Vec<Row>,
    /// Lines.
    pub curves: Vec<Curve>,
    /// Other numbers.
    pub facts: Vec<Fact>,
    /// Pictures' files beside this one, with captions.
    #[serde(default)]
    pub pictures: Vec<(String, String)>,
    /// Date.
    pub made: String,
    /// Version of the program.
    pub program: String,
    /// Seconds of the computation.
    pub seconds: f64,
}

impl Results {
    /// Nothing yet.
    pub fn new(panel: Panel, set: &str, mode: &str, identity: String) -> Self {
        Self {
            identity,
            panel,
            set: set.to_owned(),
            mode: mode.to_owned(),
            frames: BTreeMap::new(),
            encoder: String::new(),
            device: String::new(),
            machine: String::new(),
            rows: Vec::new(),
            curves: Vec::new(),
            facts: Vec::new(),
            pictures: Vec::new(),
            made: entire_io::machine::now(),
            program: entire_io::machine::version(),
            seconds: 0.0,
        }
    }

    /// A row.
    pub fn row(&self, split: &str, name: &str) -> Option<&Row> {
        self.rows.iter().find(|r| r.split == split && r.name == name)
    }
}

/// Path of the results of a part.
pub(super) fn path(out: &Path, panel: Panel, set: &str, mode: &str) -> PathBuf {
    out.join("results").join(format!("{}-{set}-{mode}.json", panel.name()))
}

/// Writes results.
///
/// # Errors
/// When the file cannot be written.
pub(super) fn write(out: &Path, results: &Results) -> Result<()> {
    make_folder(&out.join("results"))?;
    write_json(&path(out, results.panel, &results.set, &results.mode), results)
}

/// The stored results with this identity.
///
/// # Errors
/// When the file cannot be read.
pub(super) fn kept(
    out: &Path,
    panel: Panel,
    set: &str,
    mode: &str,
    identity: &str,
) -> Result<Option<Results>> {
    let path = path(out, panel, set, mode);
    if !path.exists() {
        return Ok(None);
    }
    let found: Results = one(&read_text(&path, 256 << 20)?, &path)?;
    Ok((found.identity == identity).then_some(found))
}

fn one(text: &str, path: &Path) -> Result<Results> {
    serde_json::from_str(text).with_context(|| format!("{} holds no results of this version", path.display()))
}

/// All results of a folder, and kept ones of parts that the folder lacks.
///
/// # Errors
/// When a file cannot be read.
pub(super) fn read_all(out: &Path, kept: Vec<Results>) -> Result<Vec<Results>> {
    let key = |r: &Results| (r.panel, r.set.clone(), r.mode.clone());
    let mut all: BTreeMap<_, Results> = kept.into_iter().map(|r| (key(&r), r)).collect();
    let folder = out.join("results");
    if folder.is_dir() {
        for entry in
            std::fs::read_dir(&folder).with_context(|| format!("cannot read {}", folder.display()))?
        {
            let path = entry?.path();
            if path.extension().is_some_and(|e| e == "json") {
                let found = one(&read_text(&path, 256 << 20)?, &path)?;
                all.insert(key(&found), found);
            }
        }
    }
    Ok(all.into_values().collect())
}
