//! Description of the paper's study: its JSON file.

use anyhow::{Context, Result, bail, ensure};
use entire_io::files::read_text;
use entire_io::scenes::SceneDistribution;
use entire_train::fit::{Recipe, TargetChoice};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Random volumes, a tenth each for validation and test: the paper's rule for MAESTROeX.
pub(super) const BY_VOLUMES: &str = "volumes";
/// Whole ensemble members: the paper's rule for Nyx and Castro.
pub(super) const BY_MEMBERS: &str = "members";
/// Volumes of another kind.
pub(super) const BY_MODALITY: &str = "modality";

/// Contents of a description file. Paths are relative to the file's folder.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Paper {
    /// Title of the report.
    pub title: String,
    /// Clock of the frame times.
    pub clock: String,
    /// Seed of the scenes.
    pub seed: u64,
    /// Frames per volume.
    pub frames: FrameCounts,
    /// Renderings of each frame.
    pub repeats: u32,
    /// Renderings discarded after each volume is loaded.
    pub warm_up: u32,
    /// Enlargement of the volumes at load.
    pub enlarge: usize,
    /// Voxels per side of the volumes of the low-resolution proxy (LVRP).
    pub proxy: usize,
    /// Distribution of the scenes.
    pub scenes: SceneDistribution,
    /// Differences of a mode whose frames take far longer.
    #[serde(default)]
    pub in_mode: BTreeMap<String, InMode>,
    /// Data sets.
    pub data_sets: Vec<DataSet>,
    /// Collection of yt's frames.
    pub yt: YtFrames,
    /// VolumeNets.
    pub encoders: Encoders,
    /// Training runs of one network with different seeds, for deviations.
    pub runs: usize,
    /// The paper's network.
    pub network: Recipe,
    /// Our predictor, by mode.
    pub ours: BTreeMap<String, Recipe>,
    /// Shares of the training frames, in the study of their number.
    pub shares: Vec<f64>,
    /// Layers of PredNet to compare.
    pub depths: Vec<String>,
    /// Layers of PredNet on which encoders are compared.
    pub encoder_depth: String,
    /// The two architectures of the final selection: encoder's input side, features, layers.
    pub finalists: Vec<(usize, usize, String)>,
    /// Fine-tuning.
    pub tuning: Tuning,
    /// Load balancing.
    pub orbit: Orbit,
    /// Experiments on the causes of the network's error.
    pub trials: Trials,
    /// For each part of the study, the data sets and modes that it is made of; `overall` is made of all.
    pub panels: BTreeMap<Panel, Vec<(String, String)>>,
    /// The paper's tables and figures.
    pub labels: Vec<Label>,
    /// Limits of the bars.
    pub limits: Limits,
}

/// Differences of a mode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InMode {
    /// Renderings of each frame.
    pub repeats: Option<u32>,
    /// Longest image side, pixels.
    pub max_size: Option<u32>,
}

/// Frames per volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameCounts {
    /// Frames of a training volume.
    pub training: u32,
    /// Frames of a validation or test volume; and, for every volume, frames at low resolution, to which the
    /// proxy's line is fitted.
    pub held_out: u32,
    /// Frames of an experiment with one varied parameter.
    pub varied: u32,
}

/// A data set.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataSet {
    /// Name of its folder, in the data folder or in `ensembles` there.
    pub name: String,
    /// The name in reports.
    pub title: String,
    /// Name of the data set in the paper, if it is there.
    #[serde(default)]
    pub paper: Option<String>,
    /// Modes to collect: `none`, `local`, `scatter`, `yt`.
    pub modes: Vec<String>,
    /// True if it only tests models of the others: volumes of another kind.
    #[serde(default)]
    pub only_tests: bool,
    /// The paper's split of this data set.
    #[serde(default)]
    pub rule: Rule,
    /// The members of the split by member.
    #[serde(default)]
    pub members: Option<MemberSplit>,
}

/// The split by which the paper tests on a data set. Its headline numbers are of that split.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rule {
    /// Random volumes, as of MAESTROeX.
    #[default]
    Volumes,
    /// A whole ensemble member, as of Nyx and Castro.
    Members,
}

impl Rule {
    /// The split's name in results.
    pub const fn split(self) -> &'static str {
        match self {
            Self::Volumes => BY_VOLUMES,
            Self::Members => BY_MEMBERS,
        }
    }

    /// The split that the paper does not judge on.
    pub const fn other(self) -> Self {
        match self {
            Self::Volumes => Self::Members,
            Self::Members => Self::Volumes,
        }
    }
}

/// Roles of ensemble members in the split by member; all others are for training.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MemberSplit {
    /// Decides when training stops; a tenth of the other volumes if empty.
    #[serde(default)]
    pub validation: BTreeSet<String>,
    /// Tested on.
    pub test: BTreeSet<String>,
}

/// Collection of yt's frames.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct YtFrames {
    /// The collector.
    pub script: PathBuf,
    /// Renderings of each frame.
    pub repeats: u32,
    /// Shortest image side, pixels.
    pub min_size: u32,
    /// Longest image side, pixels.
    pub max_size: u32,
}

/// The VolumeNets to train, and their training.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Encoders {
    /// The training script.
    pub script: PathBuf,
    /// Input sides.
    pub sizes: Vec<usize>,
    /// Lengths of the feature vector.
    pub features: Vec<usize>,
    /// Epochs.
    pub epochs: usize,
    /// Epochs without a better validation loss after which training stops.
    pub patience: usize,
    /// Input side and features of the encoder in all parts that compare none.
    pub main: (usize, usize),
    /// Shipped encoders, for splits without encoders of their own: first of the main one's size, then others.
    pub shipped: Vec<PathBuf>,
    /// Widths of the blocks in the capacity sweep, and its data set and input side.
    pub capacity: Capacity,
}

/// The capacity sweep: reconstruction by the widths of the encoder's blocks.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Capacity {
    /// Data sets.
    pub data_sets: Vec<String>,
    /// Input side.
    pub size: usize,
    /// Features.
    pub features: usize,
    /// Output channels of the blocks, one entry per VolumeNet.
    pub channels: Vec<Vec<usize>>,
}

/// Fine-tuning of a pre-trained network.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tuning {
    /// Mode of the data sets for pre-training, which is on all of them together.
    pub mode: String,
    /// Numbers of frames for fine-tuning.
    pub frames: Vec<usize>,
    /// Epochs of fine-tuning.
    pub epochs: usize,
    /// Tables of other renderers: name, training table, test table. If both are the same: random halves of
    /// its frames.
    pub renderers: Vec<(String, PathBuf, PathBuf)>,
    /// Tables of the same renderer on other machines, likewise.
    #[serde(default)]
    pub machines: Vec<(String, PathBuf, PathBuf)>,
}

/// Load balancing: images of a few time steps from many poses of an orbit.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Orbit {
    /// Time steps.
    pub volumes: usize,
    /// Poses of each.
    pub poses: usize,
    /// Sides of the images, pixels.
    pub size: u32,
}

/// Experiments on the causes of the network's error, on frames of the repository.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trials {
    /// Measured frames, by mode; the changes are tried in the first.
    pub tables: Vec<TrialTables>,
    /// A teacher's labels of frames of the first mode's training volumes.
    pub labels: PathBuf,
    /// Frames of each volume that are learned from by labels, and passes over them.
    pub frames: Vec<(usize, usize)>,
    /// Trainings on labels, of each number of frames.
    pub label_runs: usize,
    /// Trainings of each change.
    pub runs: usize,
    /// Passes over the measured frames.
    pub epochs: usize,
    /// Changes of the recipe, tried one at a time.
    pub changes: Vec<Change>,
}

/// Measured frames of one mode.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrialTables {
    /// The mode.
    pub mode: String,
    /// Learned from, and validated on.
    pub training: PathBuf,
    /// The same on few voxels.
    pub training_low: PathBuf,
    /// Tested on: ensemble members that nothing was learned from.
    pub test: PathBuf,
    /// The same on few voxels.
    pub test_low: PathBuf,
}

/// A change of the paper's recipe.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Change {
    /// In tables.
    pub name: String,
    /// Gaussian lobes by ascending center.
    pub sorted_lobes: bool,
    /// Every frame with its Gaussian lobes in each order, and as many steps in all.
    pub every_order: bool,
    /// Logarithms of image sides, and of widths and heights of lobes.
    pub log_inputs: bool,
    /// One number for the image's size, the geometric mean of its sides.
    pub one_resolution: bool,
    /// Output of the network.
    pub target: Option<TargetChoice>,
    /// Frames per step.
    pub batch: Option<usize>,
    /// Gradients as they are.
    pub no_clipping: bool,
    /// Frames by whose error the epoch of the weights is chosen.
    pub validation: Validation,
}

/// Frames by whose error the epoch of the weights is chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Validation {
    /// As many frames of each validation volume as the description says.
    #[default]
    Few,
    /// All frames of the validation volumes.
    All,
    /// The training loss, which is lowest at the end.
    Training,
}

/// A part of the study; each is made and kept by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum Panel {
    /// Every data set and mode: the network, ours, the mean of 15 %, LVRP; by volumes, members, modality.
    Overall,
    /// The network, each time without one input.
    Ablation,
    /// One parameter varied at a time.
    Varied,
    /// The number of training frames.
    Samples,
    /// The number of PredNet's layers.
    Depth,
    /// Encoders of other sizes and lengths.
    Encoders,
    /// The two best architectures over renderers.
    Final,
    /// Fine-tuning to other renderers, machines and data sets.
    Tuning,
    /// Use case 1: holding a frame time.
    Steering,
    /// Use case 2: load balancing.
    Balancing,
    /// Renderings.
    Pictures,
    /// The paper's recipe on the repository's frames, one change at a time; only where it is named.
    Procedure,
    /// The paper's recipe on a teacher's labels, by their number; only where it is named.
    Frames,
}

impl Panel {
    /// The name in files and commands.
    pub fn name(self) -> String {
        serde_json::to_value(self).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default()
    }
}

/// A table or figure of the paper.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Label {
    /// The paper's label.
    pub label: String,
    /// Title of the table or figure.
    pub title: String,
    /// The part with its counterpart.
    pub panel: Panel,
    /// The command that makes it.
    pub command: String,
    /// The paper's numbers.
    #[serde(default)]
    pub paper: Option<Numbers>,
    /// A picture of ours from elsewhere.
    #[serde(default)]
    pub picture: Option<PathBuf>,
    /// Inherent difference from the paper.
    #[serde(default)]
    pub note: String,
}

/// A table of the paper's numbers.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Numbers {
    /// Headings; the first is that of the rows' names.
    pub columns: Vec<String>,
    /// Rows: a name, then numbers; `null` for missing ones.
    pub rows: Vec<(String, Vec<Option<f64>>)>,
}

/// Limits of the bars.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// RMSE of the network over that of the mean of 15 %, by data set: in the paper's base mode, by its rule.
    pub over_constant: BTreeMap<String, f64>,
    /// The same of frames that yt drew, of each of them.
    pub yt_over_constant: f64,
    /// RMSE of the network over LVRP's, at the paper's ratio of voxels.
    pub over_lvrp: f64,
    /// Voxels of the paper's volumes over those that its LVRP renders.
    pub lvrp_voxels: f64,
    /// RMSE of ours over the network's.
    pub ours_over_network: f64,
    /// Error without the feature vector over that with it, where volumes differ in sparsity: in the ablation, and
    /// where the volume alone varies.
    pub feature_vector: (f64, f64),
    /// Reconstruction of held-out volumes, dB.
    pub psnr: f64,
    /// Data sets for which that must hold.
    pub data_sets: usize,
    /// Mean distance from the target of Algorithm 1 with the network over that of OLP: in the first frame after a
    /// change, and over all frames.
    pub algorithm1_over_olp: (f64, f64),
    /// The slowest node by the network's times over that by measured times.
    pub slowest_node: f64,
    /// Seconds that the report may take.
    pub report_seconds: f64,
}

/// Modes of our raycaster.
pub const RAYCASTER_MODES: [&str; 3] = ["none", "local", "scatter"];
/// The paper's raycaster shades by local lighting; single scattering comes on top.
pub const BASE_MODE: &str = "local";
/// The mode of frames that yt drew.
pub const YT: &str = "yt";

impl Paper {
    /// A data set by its name.
    pub fn data_set(&self, name: &str) -> Option<&DataSet> {
        self.data_sets.iter().find(|d| d.name == name)
    }

    /// The paper's split of a data set.
    pub fn rule(&self, set: &str) -> Rule {
        self.data_set(set).map_or_else(Rule::default, |d| d.rule)
    }

    /// Ours for a mode.
    ///
    /// # Errors
    /// If the description has none.
    pub fn ours_for(&self, mode: &str) -> Result<&Recipe> {
        self.ours.get(mode).with_context(|| format!("the description has no recipe `ours` for mode {mode:?}"))
    }
}

/// Reads a description.
///
/// # Errors
/// When the file cannot be read or holds an invalid value.
pub fn read(path: &Path) -> Result<Paper> {
    let text = read_text(path, 16 << 20).with_context(|| format!("cannot read {}", path.display()))?;
    let mut paper: Paper = serde_json::from_str(&text)
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
    for tables in &mut paper.trials.tables {
        let all = [&mut tables.training, &mut tables.training_low, &mut tables.test, &mut tables.test_low];
        all.into_iter().for_each(place);
    }
    paper.labels.iter_mut().filter_map(|l| l.picture.as_mut()).for_each(place);
    check(&paper).with_context(|| format!("{}", path.display()))?;
    Ok(paper)
}

fn check(paper: &Paper) -> Result<()> {
    ensure!(
        paper.frames.held_out > 0 && paper.frames.held_out <= paper.frames.training,
        "frames: {} of held-out volumes and {} of training ones; at least 1 and no more than those of training",
        paper.frames.held_out,
        paper.frames.training
    );
    ensure!(paper.in_mode.values().all(|m| m.repeats != Some(0)), "in_mode: repeats is 0; it is at least 1");
    ensure!(paper.repeats > 0 && paper.yt.repeats > 0 && paper.runs > 0, "repeats and runs are at least 1");
    let trials = &paper.trials;
    ensure!(
        !trials.tables.is_empty() && trials.runs.min(trials.label_runs) > 0,
        "trials need tables and runs"
    );
    ensure!(!paper.encoders.shipped.is_empty(), "encoders: shipped names none");
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
