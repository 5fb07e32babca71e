//! Description of the paper's study: its JSON file.

use anyhow::{Context, Result, bail, ensure};
use entire_io::files::read_text;
use entire_io::scenes::SceneDistribution;
use entire_train::fit::{Recipe, TargetChoice};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Name of the split by random volumes, a tenth each for validation and test: the paper's rule for MAESTROeX.
pub(super) const BY_VOLUMES: &str = "volumes";
/// Name of the split by whole ensemble members: the paper's rule for Nyx and Castro.
pub(super) const BY_MEMBERS: &str = "members";
/// Name of the test on volumes of another kind than the training volumes, such as scans.
pub(super) const BY_MODALITY: &str = "modality";

/// Contents of a description file. Paths are relative to the file's folder. The key `base` names a
/// description in the same folder, whose values are used for all other keys that the file lacks.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Paper {
    pub(crate) title: String,
    /// True if goals that this study does not measure are left out, since another study measures them.
    #[serde(default)]
    pub(crate) partial: bool,
    pub(crate) clock: String,
    /// Model file whose predicted times are the frames' times, in place of a renderer. No proxy is then
    /// rendered.
    #[serde(default)]
    pub(crate) teacher: Option<PathBuf>,
    /// Seed of the scenes.
    pub(crate) seed: u64,
    pub(crate) frames: FrameCounts,
    /// Number of renderings of each frame.
    pub(crate) repeats: u32,
    /// Renderings discarded after each volume is loaded.
    pub(crate) warm_up: u32,
    /// Factor by which each side of a volume is enlarged when the volume is loaded.
    pub(crate) enlarge: usize,
    /// Voxels per side of the volumes of the low-resolution proxy (LVRP).
    pub(crate) proxy: usize,
    pub(crate) scenes: SceneDistribution,
    /// Settings of modes whose frames take far longer than those of the other modes.
    #[serde(default)]
    pub(crate) in_mode: BTreeMap<String, InMode>,
    pub(crate) data_sets: Vec<DataSet>,
    pub(crate) yt: YtFrames,
    pub(crate) encoders: Encoders,
    /// Number of training runs of each network, with different seeds.
    pub(crate) runs: usize,
    pub(crate) network: Recipe,
    pub(crate) ours: BTreeMap<String, Recipe>,
    /// Fractions of the training frames, for the study of the number of training frames.
    pub(crate) shares: Vec<f64>,
    /// Names of the PredNet presets to compare, which differ in the number of layers.
    pub(crate) depths: Vec<String>,
    /// Name of the PredNet preset with which encoders are compared.
    pub(crate) encoder_depth: String,
    /// The two architectures of the final selection: the encoder's input side and features, PredNet's preset.
    pub(crate) finalists: Vec<(usize, usize, String)>,
    pub(crate) tuning: Tuning,
    pub(crate) orbit: Orbit,
    pub(crate) trials: Trials,
    /// Data sets and modes of each part of the study, except `overall`, which uses all.
    pub(crate) panels: BTreeMap<Panel, Vec<(String, String)>>,
    pub(crate) labels: Vec<Label>,
    pub(crate) limits: Limits,
    /// Further studies, whose kept results are also on the book's page.
    #[serde(default)]
    pub(crate) also: Vec<Also>,
    #[serde(default)]
    pub(crate) contradicted: Contradicted,
}

/// A further study: a description with kept results.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Also {
    pub(crate) description: PathBuf,
    pub(crate) kept: PathBuf,
    /// Command that makes the results.
    pub(crate) command: String,
}

/// Claims about the paper or the results that the results contradict. A person found them; a program counts
/// those that pages still make.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Contradicted {
    pub(crate) pages: Vec<PathBuf>,
    /// Wordings of the claims. A wording is on a page even if the page breaks its lines elsewhere.
    pub(crate) wordings: Vec<String>,
}

/// Settings of one mode; a setting that is `None` is that of all modes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct InMode {
    /// Number of renderings of each frame.
    pub(crate) repeats: Option<u32>,
    /// Longest image side, pixels.
    pub(crate) max_size: Option<u32>,
}

/// Frames per volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FrameCounts {
    /// Frames of a training volume.
    pub(crate) training: u32,
    /// Frames of a validation or test volume. As many frames of every volume are also drawn at low
    /// resolution; the line by which the proxy predicts is fitted to these frames.
    pub(crate) held_out: u32,
    /// Frames of an experiment with one varied parameter.
    pub(crate) varied: u32,
}

impl FrameCounts {
    /// True if this frame is among the first `held_out` frames of its volume.
    pub(super) fn is_of_few(self, number: u64) -> bool {
        number % u64::from(self.training) < u64::from(self.held_out)
    }
}

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct DataSet {
    /// Name of the data set's folder, which is in the data folder or in its subfolder `ensembles`.
    pub(crate) name: String,
    /// The name in reports.
    pub(crate) title: String,
    /// Modes to collect: `none`, `local`, `scatter`, `yt`.
    pub(crate) modes: Vec<String>,
    /// True if the volumes are of another kind than those of the other data sets. They then have no splits:
    /// models of the other data sets are tested on them, or adapted to a few of their frames.
    #[serde(default)]
    pub(crate) only_tests: bool,
    #[serde(default)]
    pub(crate) rule: Rule,
    #[serde(default)]
    pub(crate) members: Option<MemberSplit>,
    /// True if every volume has variants of different sparsity.
    #[serde(default)]
    pub(crate) variants: bool,
    /// True to train and test by the paper's split alone.
    #[serde(default)]
    pub(crate) only_rule: bool,
}

/// The split by which the paper tests on a data set; the paper's main numbers are those of this split.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Rule {
    /// Random volumes, as for MAESTROeX.
    #[default]
    Volumes,
    /// A whole ensemble member, as for Nyx and Castro.
    Members,
}

impl Rule {
    pub(crate) const fn split(self) -> &'static str {
        match self {
            Self::Volumes => BY_VOLUMES,
            Self::Members => BY_MEMBERS,
        }
    }

    /// The rule of the split on which the paper does not test.
    pub(crate) const fn other(self) -> Self {
        match self {
            Self::Volumes => Self::Members,
            Self::Members => Self::Volumes,
        }
    }
}

/// Roles of ensemble members in the split by member; all others are for training.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct MemberSplit {
    /// Members that decide when training stops; if empty, a tenth of the volumes that are not for testing.
    #[serde(default)]
    pub(crate) validation: BTreeSet<String>,
    pub(crate) test: BTreeSet<String>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct YtFrames {
    /// The Python program that collects frames drawn by yt.
    pub(crate) script: PathBuf,
    /// Number of renderings of each frame.
    pub(crate) repeats: u32,
    /// Shortest image side, pixels.
    pub(crate) min_size: u32,
    /// Longest image side, pixels.
    pub(crate) max_size: u32,
}

/// The VolumeNets to train, and their training.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Encoders {
    pub(crate) script: PathBuf,
    /// Sides of the input, voxels.
    pub(crate) sizes: Vec<usize>,
    /// Lengths of the feature vector.
    pub(crate) features: Vec<usize>,
    /// Maximum number of epochs.
    pub(crate) epochs: usize,
    /// Epochs without a better validation loss after which training stops.
    pub(crate) patience: usize,
    /// The main encoder: side of its input in voxels, and number of its features. All parts of the study that
    /// do not compare encoders use this encoder.
    pub(crate) main: (usize, usize),
    /// Files of shipped encoders, for splits without trained encoders. The first has the size of the main
    /// encoder.
    pub(crate) shipped: Vec<PathBuf>,
    pub(crate) capacity: Capacity,
}

/// The capacity sweep: quality of the reconstruction by the number of channels of the encoder's blocks.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Capacity {
    pub(crate) data_sets: Vec<String>,
    /// Side of the input, voxels.
    pub(crate) size: usize,
    pub(crate) features: usize,
    /// Output channels of the blocks of each VolumeNet to train.
    pub(crate) channels: Vec<Vec<usize>>,
}

/// Fine-tuning of a pre-trained network.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Tuning {
    /// Mode of the frames for pre-training, which uses all data sets together.
    pub(crate) mode: String,
    /// Numbers of frames for fine-tuning.
    pub(crate) frames: Vec<usize>,
    pub(crate) epochs: usize,
    /// Tables of other renderers: name, training table, test table. If both are the same table, random halves
    /// of its frames are used for training and for testing.
    pub(crate) renderers: Vec<(String, PathBuf, PathBuf)>,
    /// Tables of our raycaster on other machines: name, training table, test table.
    #[serde(default)]
    pub(crate) machines: Vec<(String, PathBuf, PathBuf)>,
}

/// Load balancing: images of a few time steps from many poses of an orbit.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Orbit {
    /// Number of time steps.
    pub(crate) volumes: usize,
    pub(crate) poses: usize,
    /// Sides of the images, pixels.
    pub(crate) size: u32,
}

/// Experiments on the causes of the network's error, on frames of the repository.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Trials {
    /// Tables of measured frames, one entry per mode; the changes are tried in the first mode.
    pub(crate) tables: Vec<TrialTables>,
    /// Table of frames of the first mode's training volumes, whose times (labels) a teacher model predicted.
    pub(crate) labels: PathBuf,
    /// Trainings on labels: number of labels of each volume, and number of epochs.
    pub(crate) frames: Vec<(usize, usize)>,
    pub(crate) label_runs: usize,
    pub(crate) runs: usize,
    /// Number of epochs on the measured frames.
    pub(crate) epochs: usize,
    /// Changes of the recipe, each tried alone. The last one combines those that clearly lower the error.
    pub(crate) changes: Vec<Change>,
}

/// Tables of measured frames of one mode.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TrialTables {
    pub(crate) mode: String,
    /// Training and validation frames.
    pub(crate) training: PathBuf,
    /// Test frames, of ensemble members that are not in the training table.
    pub(crate) test: PathBuf,
    /// The frames as rendered by the low-resolution proxy.
    pub(crate) low: LowTables,
    /// The frames as rendered by a proxy with at most the paper's share of the voxels.
    pub(crate) lower: LowTables,
    /// File of the paper's network that was trained on many labels of a teacher model.
    pub(crate) distilled: PathBuf,
    /// File of the teacher model.
    pub(crate) teacher: PathBuf,
}

/// Tables of a low-resolution proxy. Their frames are found in the full-resolution tables by their scenes.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct LowTables {
    pub(crate) training: Vec<PathBuf>,
    pub(crate) test: Vec<PathBuf>,
}

/// A change of the paper's recipe.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Change {
    /// Name in tables.
    pub(crate) name: String,
    /// True to sort the Gaussian lobes by ascending center.
    pub(crate) sorted_lobes: bool,
    /// True to train on every frame once for each permutation of its Gaussian lobes. The number of epochs
    /// decreases accordingly, so that the number of optimizer steps stays the same.
    pub(crate) every_order: bool,
    /// True to take logarithms of image sides, and of widths and heights of lobes.
    pub(crate) log_inputs: bool,
    /// True to state the image's size as one number, the geometric mean of its sides.
    pub(crate) one_resolution: bool,
    /// Output of the network; `None` for the recipe's output.
    pub(crate) target: Option<TargetChoice>,
    /// Frames per optimizer step; `None` for the recipe's number.
    pub(crate) batch: Option<usize>,
    pub(crate) no_clipping: bool,
    /// Frames whose error decides from which epoch the weights are taken.
    pub(crate) validation: Validation,
}

/// Frames whose error decides from which epoch the weights are taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Validation {
    /// The description's number of frames of each validation volume.
    #[default]
    Few,
    /// All frames of the validation volumes.
    All,
    /// No frames: the epoch with the lowest training loss is taken, which is one of the last.
    Training,
}

/// A part of the study, with results in a file of its own.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub(crate) enum Panel {
    /// The network, our predictor and both baselines on every data set and mode, tested on random volumes,
    /// left-out members and scans.
    #[default]
    Overall,
    /// The network without one of its inputs, each input in turn.
    Ablation,
    /// One parameter varied at a time.
    Varied,
    /// The number of training frames.
    Samples,
    /// The number of PredNet's layers.
    Depth,
    /// Encoders with other input sizes and lengths of the feature vector.
    Encoders,
    /// The two best architectures on several renderers.
    Final,
    /// Fine-tuning to other renderers, machines and data sets.
    Tuning,
    /// Use case 1: holding a frame time.
    Steering,
    /// Use case 2: load balancing.
    Balancing,
    /// Pictures of the data sets over time and from several poses, and reconstructions.
    Pictures,
    /// Renderings of the data sets in the base mode.
    Renderings,
    /// The paper's recipe on the repository's frames, one change at a time; runs only if --only names it.
    Procedure,
    /// The paper's recipe on different numbers of frame times that a teacher predicted; runs only if --only
    /// names it.
    Frames,
    /// The paper's network on each data set: by the paper's recipe, with the changes of the recipe that
    /// clearly lower the error, and distilled; runs only if --only names it.
    Improved,
}

impl Panel {
    pub(crate) fn name(self) -> String {
        serde_json::to_value(self).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default()
    }
}

/// A table or figure of the paper.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Label {
    pub(crate) label: String,
    pub(crate) title: String,
    /// Part of the study that contains our counterpart of the table or figure.
    pub(crate) panel: Panel,
    /// Command that makes this project's counterpart of the table or figure.
    pub(crate) command: String,
    #[serde(default)]
    pub(crate) paper: Option<Numbers>,
    /// Our picture, if it is in the repository.
    #[serde(default)]
    pub(crate) picture: Option<PathBuf>,
    /// Note on a difference from the paper that cannot be avoided.
    #[serde(default)]
    pub(crate) note: String,
}

/// A table of the paper's numbers.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Numbers {
    /// Headings of the columns; the first column holds the names of the rows.
    pub(crate) columns: Vec<String>,
    /// Rows: a name, then numbers; `None` for missing ones.
    pub(crate) rows: Vec<(String, Vec<Option<f64>>)>,
}

/// Goals that `make bars-paper` checks.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Limits {
    /// RMSE of the network divided by the RMSE of a constant prediction, the mean time of 15 % of the frames;
    /// by data set, in the base mode, on the paper's split.
    pub(crate) over_constant: BTreeMap<String, f64>,
    /// The ratio of `over_constant` on frames that yt drew, for each data set in `over_constant`.
    pub(crate) yt_over_constant: f64,
    /// RMSE of the network divided by that of LVRP; checked only if LVRP renders at most 1 / `lvrp_voxels` of
    /// the voxels.
    pub(crate) over_lvrp: f64,
    /// Voxels of the paper's volumes divided by the voxels that its LVRP renders.
    pub(crate) lvrp_voxels: f64,
    /// RMSE of our predictor divided by the network's.
    pub(crate) ours_over_network: f64,
    /// Error without the feature vector divided by the error with it, on volumes that differ in sparsity: in
    /// the ablation, and in the experiment that varies the volume alone.
    pub(crate) feature_vector: (f64, f64),
    /// Peak signal-to-noise ratio of reconstructed held-out volumes, dB.
    pub(crate) psnr: f64,
    /// Number of data sets whose volumes must reach the signal-to-noise ratio `psnr`.
    pub(crate) data_sets: usize,
    /// Mean distance from the target under Algorithm 1, divided by that under OLP: in first frames after a
    /// change, and in all frames.
    pub(crate) algorithm1_over_olp: (f64, f64),
    /// Total time of the slowest node if tasks are assigned by the network's times, divided by that if they
    /// are assigned by measured times.
    pub(crate) slowest_node: f64,
    /// Seconds within which the report must be written.
    pub(crate) report_seconds: f64,
}

pub(crate) const RAYCASTER_MODES: [&str; 3] = ["none", "local", "scatter"];
/// The base mode: the paper's raycaster shades by local lighting.
pub(crate) const BASE_MODE: &str = "local";
/// The mode of frames that yt drew.
pub(crate) const YT: &str = "yt";

impl Paper {
    pub(crate) fn data_set(&self, name: &str) -> Option<&DataSet> {
        self.data_sets.iter().find(|d| d.name == name)
    }

    pub(crate) fn rule(&self, set: &str) -> Rule {
        self.data_set(set).map_or_else(Rule::default, |d| d.rule)
    }

    pub(crate) fn ours_for(&self, mode: &str) -> Result<&Recipe> {
        self.ours.get(mode).with_context(|| format!("the description has no recipe `ours` for mode {mode:?}"))
    }
}

/// Reads the values of a description. If the file has the key `base` (the name of another description in the
/// same folder), the values that the file lacks are taken from that description.
fn values(path: &Path) -> Result<serde_json::Map<String, serde_json::Value>> {
    let text = read_text(path, 16 << 20).with_context(|| format!("cannot read {}", path.display()))?;
    let mut own: serde_json::Map<_, _> = serde_json::from_str(&text)
        .with_context(|| format!("{} is no description of the paper's study", path.display()))?;
    let Some(base) = own.remove("base") else { return Ok(own) };
    let base = base.as_str().with_context(|| format!("{}: base is not a file's name", path.display()))?;
    ensure!(
        path.file_name().is_some_and(|name| name != base),
        "{}: base names the file itself; name another description",
        path.display()
    );
    let mut all = values(&path.with_file_name(base))?;
    all.extend(own);
    Ok(all)
}

pub(crate) fn read(path: &Path) -> Result<Paper> {
    let mut paper: Paper = serde_json::from_value(values(path)?.into())
        .with_context(|| format!("{} is no description of the paper's study", path.display()))?;
    let folder = path.parent().unwrap_or(Path::new("")).to_owned();
    let place = |p: &mut PathBuf| *p = folder.join(&*p);
    place(&mut paper.yt.script);
    place(&mut paper.encoders.script);
    paper.encoders.shipped.iter_mut().for_each(place);
    paper.tuning.renderers.iter_mut().chain(&mut paper.tuning.machines).for_each(|(_, a, b)| {
        place(a);
        place(b);
    });
    place(&mut paper.trials.labels);
    paper.teacher.iter_mut().for_each(place);
    paper.also.iter_mut().flat_map(|a| [&mut a.description, &mut a.kept]).for_each(place);
    paper.contradicted.pages.iter_mut().for_each(place);
    for tables in &mut paper.trials.tables {
        let TrialTables { training, test, low, lower, distilled, teacher, .. } = tables;
        [training, test, distilled, teacher].into_iter().for_each(place);
        [low, lower].into_iter().flat_map(|l| l.training.iter_mut().chain(&mut l.test)).for_each(place);
    }
    paper.labels.iter_mut().filter_map(|l| l.picture.as_mut()).for_each(place);
    check(&paper).with_context(|| format!("{}", path.display()))?;
    Ok(paper)
}

fn check(paper: &Paper) -> Result<()> {
    ensure!(
        paper.frames.held_out > 0 && paper.frames.held_out <= paper.frames.training,
        "frames: held_out is {}, training is {}; held_out must be at least 1 and no more than training",
        paper.frames.held_out,
        paper.frames.training
    );
    ensure!(paper.in_mode.values().all(|m| m.repeats != Some(0)), "in_mode: repeats must be at least 1");
    ensure!(
        paper.repeats > 0 && paper.yt.repeats > 0 && paper.runs > 0,
        "repeats and runs must be at least 1"
    );
    let trials = &paper.trials;
    ensure!(
        !trials.tables.is_empty() && !trials.changes.is_empty() && trials.runs.min(trials.label_runs) > 0,
        "trials: tables or changes is empty, or a number of runs is 0"
    );
    ensure!(!paper.encoders.shipped.is_empty(), "encoders: shipped is empty; name at least one file");
    paper.scenes.check()?;
    let mut names = BTreeSet::new();
    for d in &paper.data_sets {
        ensure!(names.insert(d.name.as_str()), "the data set {:?} appears twice", d.name);
        if let Some(mode) = d.modes.iter().find(|m| !RAYCASTER_MODES.contains(&m.as_str()) && *m != YT) {
            bail!("{}: mode {mode:?}; none, local, scatter or yt is accepted", d.name);
        }
        d.modes.iter().try_for_each(|m| paper.ours_for(m).map(|_| ()))?;
    }
    for (panel, sets) in &paper.panels {
        for (set, mode) in sets {
            let known = paper.data_set(set).is_some_and(|d| d.modes.contains(mode));
            ensure!(known, "panels: {} names {set} in mode {mode}, which is not collected", panel.name());
        }
    }
    let mut labels = BTreeSet::new();
    for label in &paper.labels {
        ensure!(labels.insert(label.label.as_str()), "the label {:?} appears twice", label.label);
        for (name, row) in label.paper.iter().flat_map(|p| p.rows.iter()) {
            let columns = label.paper.as_ref().map_or(0, |p| p.columns.len());
            ensure!(
                row.len() + 1 == columns,
                "{}: row {name:?} has {} numbers under {columns} headings",
                label.label,
                row.len()
            );
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_description_takes_what_it_lacks_from_its_base() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/timings");
        let base = read(&folder.join("paper.json")).unwrap();
        let gpu = read(&folder.join("paper-gpu.json")).unwrap();
        assert_eq!((base.clock.as_str(), gpu.clock.as_str()), ("cpu", "device"));
        assert!(gpu.labels.len() == base.labels.len() && !gpu.panels.contains_key(&Panel::Depth));
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("own.json");
        std::fs::write(&path, r#"{"base": "own.json"}"#).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("another description"));
    }
}
