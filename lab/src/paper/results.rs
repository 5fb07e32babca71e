//! Results of the study, in one small file for each part of the study, data set and mode. One further file
//! holds all inputs of the report.

use super::description::{Panel, Paper};
use super::encode::{ALL, Encoder, Provenance, Record, SHIPPED};
use super::interval::{self, ByVolume};
use anyhow::{Context, Result};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use entire_core::model::Key;
use entire_io::dataset::Table;
use entire_io::files::{
    gzip, make_folder, make_folder_of, read_bytes, read_decompressed, read_model_file, read_text, write_json,
    write_whole,
};
use entire_io::metrics::percentile;
use entire_train::inputs::volumenet_of;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Name of the constant baseline: the mean of 15 % of the frames.
pub(super) const CONSTANT: &str = "mean of 15 % (Bruder et al.)";
/// Name of the low-resolution proxy.
pub(super) const LVRP: &str = "LVRP";
/// Name of a low-resolution proxy with at most the paper's share of the voxels.
pub(super) const LVRP_AS_PAPER: &str = "LVRP with a 512th of the voxels";

/// Errors of a predictor on some frames.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Row {
    pub(crate) name: String,
    /// The split, or the experiment.
    pub(crate) split: String,
    pub(crate) frames: usize,
    pub(crate) runs: usize,
    /// Mean RMSE over the runs, seconds.
    pub(crate) rmse: f64,
    /// Standard deviation of the RMSE over the runs, seconds.
    pub(crate) rmse_sd: f64,
    /// Standard deviation of the measured seconds.
    pub(crate) sd: f64,
    /// RMSE divided by the RMSE of the constant baseline, [`CONSTANT`].
    pub(crate) over_constant: Option<f64>,
    /// RMSE divided by that of the low-resolution proxy, on the frames that were rendered at low resolution.
    pub(crate) over_lvrp: Option<f64>,
    /// Median of |predicted − measured| / measured, mean over the runs.
    pub(crate) mdape: f64,
    /// Seconds of one prediction, if it was measured.
    pub(crate) latency: Option<f64>,
    /// Percentiles of the squared errors of all runs: 5th, 25th, 50th, 75th, 95th.
    pub(crate) squared_errors: [f64; 5],
    /// Squared errors by volume, from which intervals are computed.
    #[serde(default, skip_serializing_if = "ByVolume::is_empty")]
    pub(crate) by_volume: ByVolume,
    /// Squared errors by volume, on the frames that were also rendered at low resolution.
    #[serde(default, skip_serializing_if = "ByVolume::is_empty")]
    pub(crate) of_twins: ByVolume,
    #[serde(default)]
    pub(crate) more: BTreeMap<String, f64>,
}

impl Row {
    /// Standard deviation of the RMSE over the runs, seconds; `None` for a single run.
    pub(super) fn spread(&self) -> Option<f64> {
        (self.runs > 1).then_some(self.rmse_sd)
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Curve {
    pub(crate) chart: String,
    pub(crate) name: String,
    pub(crate) x: String,
    pub(crate) points: Vec<(f64, f64)>,
}

impl Curve {
    pub(super) fn new(chart: &str, name: &str, x: &str, points: Vec<(f64, f64)>) -> Self {
        Self { chart: chart.into(), name: name.into(), x: x.into(), points }
    }

    /// A curve of some values; the position along x is the value's index.
    pub(super) fn by_index(chart: &str, name: &str, x: &str, values: &[f64]) -> Self {
        Self::new(chart, name, x, values.iter().enumerate().map(|(k, v)| (k as f64, *v)).collect())
    }
}

/// Name of the chart of the orbit's times; its curve of measured times is [`MEASURED`].
pub(super) const ORBIT_CHART: &str = "orbit";
/// Name of the chart of the orbit with random transfer functions, with a curve per volume.
pub(super) const DRAWN_CHART: &str = "orbit, drawn transfer functions";
pub(super) const MEASURED: &str = "measured";
/// Label of the x axis of charts that draw one point per frame.
pub(super) const SORTED: &str = "frames, by their measured time";

/// The percentiles of a box in a chart, by name.
pub(super) const BOX: [(&str, f64); 5] =
    [("p5", 0.05), ("p25", 0.25), ("p50", 0.5), ("p75", 0.75), ("p95", 0.95)];

/// The percentiles of [`BOX`] of some ascending numbers.
pub(super) fn percentiles(ascending: &[f64]) -> [(String, f64); 5] {
    BOX.map(|(name, share)| (name.to_owned(), percentile(ascending, share)))
}

/// The percentiles of [`BOX`] among named numbers; NaN for missing ones.
pub(super) fn box_of(values: &BTreeMap<String, f64>) -> [f64; 5] {
    BOX.map(|(name, _)| values.get(name).copied().unwrap_or(f64::NAN))
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Fact {
    pub(crate) name: String,
    pub(crate) values: BTreeMap<String, f64>,
}

/// Results of one part of the study for one data set and mode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Results {
    pub(crate) identity: String,
    pub(crate) panel: Panel,
    pub(crate) set: String,
    pub(crate) mode: String,
    /// Numbers of training, validation and test frames, by split.
    pub(crate) frames: BTreeMap<String, [usize; 3]>,
    pub(crate) encoder: String,
    pub(crate) device: String,
    pub(crate) machine: String,
    pub(crate) rows: Vec<Row>,
    pub(crate) curves: Vec<Curve>,
    pub(crate) facts: Vec<Fact>,
    /// Names of the pictures' files, with captions.
    #[serde(default)]
    pub(crate) pictures: Vec<(String, String)>,
}

impl Results {
    pub(crate) fn new(panel: Panel, set: &str, mode: &str, identity: String) -> Self {
        Self { identity, panel, set: set.to_owned(), mode: mode.to_owned(), ..Self::default() }
    }

    /// Takes device and machine from the manifest of a table.
    pub(super) fn measured_as(&mut self, table: &Table) {
        if let Some(m) = &table.manifest {
            (self.device, self.machine) = (m.device.clone(), m.machine.clone());
        }
    }

    pub(super) fn fact(&self, name: &str) -> Option<&BTreeMap<String, f64>> {
        self.facts.iter().find(|f| f.name == name).map(|f| &f.values)
    }

    /// Returns the interval of a row's RMSE divided by the RMSE of the constant baseline, [`CONSTANT`].
    pub(crate) fn over_constant_interval(&self, row: &Row) -> Option<(f64, f64)> {
        let constant = self.row(&row.split, CONSTANT)?;
        // The row of the low-resolution proxy has fewer frames than the constant's row; the two are compared
        // on these frames.
        let under = if row.frames == constant.frames { &constant.by_volume } else { &constant.of_twins };
        interval::of_ratio(&row.by_volume, under)
    }

    /// Returns the interval of a row's RMSE divided by the RMSE of [`LVRP`].
    pub(crate) fn over_lvrp_interval(&self, row: &Row) -> Option<(f64, f64)> {
        interval::of_ratio(&row.of_twins, &self.row(&row.split, LVRP)?.of_twins)
    }

    pub(crate) fn row(&self, split: &str, name: &str) -> Option<&Row> {
        self.rows.iter().find(|r| r.split == split && r.name == name)
    }
}

pub(super) fn path(out: &Path, panel: Panel, set: &str, mode: &str) -> PathBuf {
    out.join("results").join(format!("{}-{set}-{mode}.json", panel.name()))
}

pub(super) fn write(out: &Path, results: &Results) -> Result<()> {
    make_folder(&out.join("results"))?;
    write_json(&path(out, results.panel, &results.set, &results.mode), results)
}

/// True if the results of a part are stored and have this identity.
pub(super) fn kept(out: &Path, panel: Panel, set: &str, mode: &str, identity: &str) -> Result<bool> {
    let path = path(out, panel, set, mode);
    Ok(path.exists() && one(&path)?.identity == identity)
}

fn one(path: &Path) -> Result<Results> {
    serde_json::from_str(&read_text(path, 256 << 20)?)
        .with_context(|| format!("{} holds no results of this version", path.display()))
}

/// Reads all results of a folder, and adds results from `kept` that the folder lacks.
pub(super) fn read_all(out: &Path, kept: Vec<Results>) -> Result<Vec<Results>> {
    let key = |r: &Results| (r.panel, r.set.clone(), r.mode.clone());
    let mut all: BTreeMap<_, Results> = kept.into_iter().map(|r| (key(&r), r)).collect();
    let folder = out.join("results");
    if folder.is_dir() {
        let fail = || format!("cannot read {}", folder.display());
        for entry in std::fs::read_dir(&folder).with_context(fail)? {
            let path = entry?.path();
            if path.extension().is_some_and(|e| e == "json") {
                let found = one(&path)?;
                all.insert(key(&found), found);
            }
        }
    }
    Ok(all.into_values().collect())
}

/// An encoder, with its quality of reconstruction.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Reconstruction {
    pub(crate) encoder: Encoder,
    pub(crate) record: Record,
}

impl Reconstruction {
    /// Mean peak signal-to-noise ratio over the test volumes of the encoder's data set, dB.
    pub(crate) fn psnr(&self) -> Option<f64> {
        self.record.psnr("test", &self.encoder.set)
    }
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Material {
    pub(crate) all: Vec<Results>,
    pub(crate) reconstructions: Vec<Reconstruction>,
    /// PNG files by name, as base64 text.
    pub(crate) pictures: BTreeMap<String, String>,
}

/// Reads the results of all parts of the study from a folder. Results that are missing in the folder are read
/// from a file written by [`keep_material`].
pub(crate) fn material(paper: &Paper, out: &Path, kept: Option<&Path>) -> Result<Material> {
    let kept = kept.map(read_material).transpose()?.unwrap_or_default();
    let all = read_all(out, kept.all)?;
    let asked = &paper.encoders;
    let mut reconstructions = Vec::new();
    let names = paper.data_sets.iter().map(|d| d.name.as_str()).chain([ALL]);
    for set in names {
        for encoder in Encoder::of_set(asked, set) {
            let before = || kept.reconstructions.iter().find(|r| r.encoder == encoder);
            match encoder.record(out)?.filter(Record::complete) {
                Some(record) => reconstructions.push(Reconstruction { encoder, record }),
                None => reconstructions.extend(before().cloned()),
            }
        }
    }
    for path in &asked.shipped {
        reconstructions.extend(shipped(path)?);
    }
    let mut pictures = kept.pictures;
    for name in all.iter().flat_map(|r| &r.pictures).map(|(name, _)| name) {
        let path = out.join("pictures").join(name);
        if path.exists() {
            pictures.insert(name.clone(), STANDARD.encode(read_bytes(&path)?));
        }
    }
    Ok(Material { all, reconstructions, pictures })
}

/// Reads the training record in the file of a shipped encoder; `None` if there is none.
fn shipped(path: &Path) -> Result<Option<Reconstruction>> {
    let (file, model) = read_model_file(path)?;
    let net = volumenet_of(&model, path)?;
    let Some(text) = file.metadata.get(Key::Provenance.name()) else { return Ok(None) };
    let provenance: Provenance = serde_json::from_str(text)
        .with_context(|| format!("{}: the training record in the metadata cannot be read", path.display()))?;
    let (size, features) = (net.input, net.fc.outputs);
    let encoder = Encoder { set: SHIPPED.into(), size, features, channels: Vec::new() };
    // The duration of the training is not in the file.
    Ok(Some(Reconstruction { encoder, record: Record { provenance, seconds: 0.0 } }))
}

pub(super) fn read_material(path: &Path) -> Result<Material> {
    let bytes = read_decompressed(path).with_context(|| format!("cannot read {}", path.display()))?;
    serde_json::from_slice(&bytes)
        .with_context(|| format!("{} holds no results of this version", path.display()))
}

/// Writes all inputs of the report into one compressed file, which [`material`] can read.
pub(crate) fn keep_material(material: &Material, path: &Path) -> Result<()> {
    make_folder_of(path)?;
    write_whole(path, &gzip(&serde_json::to_vec(material)?)?)
}
