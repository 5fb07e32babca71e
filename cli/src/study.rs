//! A study: data sets, splits and predictors by name in one JSON file; every predictor made on every set's training
//! tables and judged on every split. What is made is kept, so that a study that was stopped goes on where it was.

use crate::bound;
use crate::dataset::{Clock, NoiseFloor, Scene, Table, TimedFrame, fnv1a, noise_floor, read_tables};
use crate::feature_table::FeatureTable;
use crate::inputs::Layout;
use crate::latency::{Bench, Latency};
use crate::metrics::{BoundMetrics, Metrics, bootstrap_by_group};
use crate::recipe::{Kind, Kitchen, Recipe, Timed, calibrate, transfer};
use crate::split::GroupBy;
use crate::trees::Trees;
use anyhow::{Context, Result, bail, ensure};
use entire_core::model::{Model, ModelFile, keys};
use entire_core::predict::Calibration;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The description, as its file holds it. Paths are relative to the file's folder.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Study {
    /// Title of the report.
    pub title: String,
    /// Whose seconds count.
    #[serde(default = "cpu")]
    pub clock: String,
    /// Data sets: a shading mode, or a renderer.
    pub sets: Vec<Set>,
    /// Predictors, each made for every set.
    pub predictors: Vec<Named>,
    /// Numbers of training frames to make predictors with again.
    #[serde(default)]
    pub sample_sizes: Vec<usize>,
    /// Shares of the calibration split's frames, for fine-tuning curves.
    #[serde(default)]
    pub shares: Vec<f64>,
    /// Names of the predictors that sample and fine-tuning curves are drawn for.
    #[serde(default)]
    pub curves: Vec<String>,
    /// What `entire chart --ship` writes for every set.
    #[serde(default)]
    pub ship: Vec<Ship>,
    /// Volume on which latencies are measured, and its enlargement.
    pub latency_volume: (PathBuf, usize),
}

fn cpu() -> String {
    Clock::Cpu.name().into()
}

/// A predictor to ship.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ship {
    /// Its name.
    pub predictor: String,
    /// How its weights are stored.
    #[serde(default)]
    pub dtype: crate::recipe::DtypeChoice,
}

/// A data set.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Set {
    /// Its name.
    pub name: String,
    /// Tables to learn from; a tenth of their ensemble members decides when training stops (of their volumes, where there are
    /// fewer than ten members).
    pub training: Vec<PathBuf>,
    /// Tables of frames at other ray steps, for predictors that take the step into account.
    #[serde(default)]
    pub other_steps: Vec<PathBuf>,
    /// Tables whose frames set the upper bounds and are used for nothing else, of predictors that are not cross-validated;
    /// the validation frames where there are none.
    #[serde(default)]
    pub bounds: Vec<PathBuf>,
    /// Tables to test on, by split.
    pub splits: Vec<SplitTables>,
    /// The same frames on volumes of 64³ voxels, by table: `{"none-train.csv.gz": "none-train-64.csv.gz"}`.
    #[serde(default)]
    pub low_resolution: BTreeMap<String, PathBuf>,
    /// The split that fine-tuning curves and the calibration bar are about.
    #[serde(default)]
    pub calibration_split: Option<String>,
    /// Further splits that fine-tuning curves are drawn for.
    #[serde(default)]
    pub more_calibration_splits: Vec<String>,
    /// Whether the split that calibration curves are about is of another renderer: a curve is drawn for models that are
    /// transferred to it, too.
    #[serde(default)]
    pub transfer: bool,
    /// Limits of the bars; there are no bars for limits that are left away.
    #[serde(default)]
    pub limits: Limits,
}

/// Tables of a split.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplitTables {
    /// Its name: `member`, `time step`, `modality`.
    pub name: String,
    /// Its tables.
    pub tables: Vec<PathBuf>,
    /// Whether the main bars are about it.
    #[serde(default)]
    pub main: bool,
}

/// What the bars ask for.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Largest RMSE/SD of the best predictor on the main split.
    pub rmse_over_sd: Option<f64>,
    /// Least ratio of the constant baseline's RMSE to that of the predictor `paper`.
    pub constant_over_paper: Option<f64>,
    /// Least ratio of the low-resolution proxy's RMSE to that of the predictor `paper`.
    pub proxy_over_paper: Option<f64>,
    /// Whether the bars of the calibration split apply.
    pub modality: bool,
    /// Whether the bars on latency apply.
    pub latency: bool,
    /// Largest share of the cold latency of the predictor `paper` that the selected one may take; any unless given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cold_over_paper: Option<f64>,
}

/// A predictor.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Named {
    /// Its name in every table; `paper` and `selected` have bars of their own.
    pub name: String,
    /// How it is made.
    #[serde(default)]
    pub recipe: Recipe,
    /// Another recipe in the sets of these names: what suits one shading mode is not what suits another.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub in_set: BTreeMap<String, Recipe>,
    /// Which table it belongs to: `main`, `ablation`, `architecture`.
    #[serde(default = "main_panel")]
    pub panel: String,
    /// Whether it is made again without one ensemble member after another, to be judged on that member: which predictor is
    /// selected and what its upper bound is follow from these errors. For the table `main` alone.
    #[serde(default = "yes")]
    pub cross_validated: bool,
}

impl Named {
    /// How it is made for a set.
    pub fn recipe_for(&self, set: &str) -> &Recipe {
        self.in_set.get(set).unwrap_or(&self.recipe)
    }
}

fn main_panel() -> String {
    "main".into()
}

fn yes() -> bool {
    true
}

/// How a predictor did on the frames that it was made of, and on those of the training tables when it was made without
/// their ensemble member.
#[derive(Clone, Debug, Serialize)]
pub struct Fit {
    /// Set and predictor.
    pub set: String,
    /// See `set`.
    pub predictor: String,
    /// On the frames that it was made of.
    pub seen: Metrics,
    /// On frames of members that it was made without.
    pub crossed: Option<Metrics>,
    /// How often.
    pub folds: usize,
}

/// How a predictor did on a split.
#[derive(Clone, Debug, Serialize)]
pub struct Result1 {
    /// Set, split and predictor.
    pub set: String,
    /// See `set`.
    pub split: String,
    /// See `set`.
    pub predictor: String,
    /// See [`Named::panel`]; `baseline` for those that have no model file.
    pub panel: String,
    /// Errors.
    pub metrics: Metrics,
    /// 95 % interval of RMSE/SD over ensemble members drawn anew.
    pub rmse_interval: Option<(f64, f64)>,
    /// 95 % interval of MdAPE over ensemble members drawn anew.
    pub mdape_interval: Option<(f64, f64)>,
    /// The upper bound, where there is one.
    pub bound: Option<BoundMetrics>,
    /// By what a frame is like: image size, camera inside.
    pub parts: Vec<(String, Metrics)>,
    /// ln(predicted / measured) at the 1st, 5th, 25th, 50th, 75th, 95th and 99th percentile.
    pub log_errors: [f64; 7],
}

/// A curve's point.
#[derive(Clone, Debug, Serialize)]
pub struct Point {
    /// Set and split that it was judged on.
    pub set: String,
    /// See `set`.
    pub split: String,
    /// Which curve.
    pub curve: String,
    /// Frames learned from.
    pub frames: usize,
    /// Errors on the frames not learned from.
    pub metrics: Metrics,
}

/// All that a study found.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Findings {
    /// One per set, split and predictor.
    pub results: Vec<Result1>,
    /// Errors on the training tables.
    pub fits: Vec<Fit>,
    /// By set and predictor.
    pub latencies: Vec<(String, String, Latency)>,
    /// Noise floor by set and split.
    pub noise: Vec<(String, String, NoiseFloor, usize)>,
    /// Training-sample and fine-tuning curves.
    pub samples: Vec<Point>,
    /// See `samples`.
    pub tuning: Vec<Point>,
    /// Predictors that could not be made, and why.
    pub left_out: Vec<(String, String, String)>,
    /// Model file by set and predictor.
    #[serde(skip)]
    pub files: Vec<(String, String, PathBuf)>,
}

impl Findings {
    /// A result.
    pub fn of(&self, set: &str, split: &str, predictor: &str) -> Option<&Result1> {
        self.results.iter().find(|r| r.set == set && r.split == split && r.predictor == predictor)
    }

    /// Errors on the training tables.
    pub fn fit(&self, set: &str, predictor: &str) -> Option<&Fit> {
        self.fits.iter().find(|f| f.set == set && f.predictor == predictor)
    }

    /// A latency.
    pub fn latency(&self, set: &str, predictor: &str) -> Option<Latency> {
        self.latencies.iter().find(|l| l.0 == set && l.1 == predictor).map(|l| l.2)
    }

    /// What repeats leave as median absolute relative error of a predictor that knows the truth: 0.6745 standard
    /// deviations of a frame's median.
    pub fn noise_mdape(&self, set: &str, split: &str) -> f64 {
        self.noise.iter().find(|n| n.0 == set && n.1 == split).map_or(0.0, |n| 0.6745 * n.2.log_sd_of_median)
    }
}

/// Frames after which the bars on calibration are taken.
pub const CALIBRATION_FRAMES: usize = 100;

/// The name of the baseline of probes.
pub const CONSTANT: &str = "constant (mean of 15 % probes)";
/// The name of the low-resolution proxy.
pub const PROXY: &str = "LVRP (64³ render, linear fit)";

/// Reads a study.
///
/// # Errors
/// When the file cannot be read or says something that it may not.
pub fn read(path: &Path) -> Result<Study> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let mut study: Study =
        serde_json::from_str(&text).with_context(|| format!("{} is no study", path.display()))?;
    let folder = path.parent().unwrap_or(Path::new("")).to_owned();
    let place = |p: &mut PathBuf| *p = folder.join(&*p);
    place(&mut study.latency_volume.0);
    for set in &mut study.sets {
        set.training.iter_mut().chain(&mut set.bounds).chain(&mut set.other_steps).for_each(place);
        set.splits.iter_mut().flat_map(|s| &mut s.tables).for_each(place);
        set.low_resolution.values_mut().for_each(place);
    }
    for p in &mut study.predictors {
        for recipe in p.in_set.values_mut().chain(std::iter::once(&mut p.recipe)) {
            recipe.volumenet.iter_mut().chain(&mut recipe.fine_tune).chain(&mut recipe.file).for_each(place);
        }
        if let Some(other) = p.in_set.keys().find(|n| study.sets.iter().all(|s| s.name != **n)) {
            bail!("{}: {} names the set {other:?}, which is none", path.display(), p.name);
        }
    }
    let mut names: Vec<&str> = study.predictors.iter().map(|p| p.name.as_str()).collect();
    names.sort_unstable();
    if let Some(twice) = names.windows(2).find(|w| w[0] == w[1]) {
        bail!("{}: the predictor {:?} stands there twice", path.display(), twice[0]);
    }
    for (list, name) in
        study.curves.iter().map(|n| ("curves", n)).chain(study.ship.iter().map(|s| ("ship", &s.predictor)))
    {
        ensure!(
            names.contains(&name.as_str()),
            "{}: {list} names {name:?}, which is no predictor",
            path.display()
        );
    }
    Ok(study)
}

/// The clock by its name.
///
/// # Errors
/// For a name that is none.
pub fn clock(name: &str) -> Result<Clock> {
    [Clock::Auto, Clock::Device, Clock::Wall, Clock::Cpu]
        .into_iter()
        .find(|c| c.name() == name)
        .with_context(|| format!("clock {name:?}; auto, device, wall or cpu is expected"))
}

/// Frames with their seconds, owned.
pub struct Part<'a> {
    /// The frames.
    pub frames: Vec<&'a TimedFrame>,
    /// Seconds of each.
    pub seconds: Vec<f64>,
}

impl<'a> Part<'a> {
    /// Frames that have seconds by the clock.
    pub fn of(frames: impl IntoIterator<Item = &'a TimedFrame>, clock: Clock) -> Self {
        let (frames, seconds) = frames.into_iter().filter_map(|f| Some((f, f.seconds(clock)?))).unzip();
        Self { frames, seconds }
    }

    /// Borrowed.
    pub fn timed(&self) -> Timed<'_> {
        Timed { frames: &self.frames, seconds: &self.seconds }
    }

    /// These frames and others.
    fn and(&self, other: Self) -> Self {
        let frames = self.frames.iter().copied().chain(other.frames).collect();
        let seconds = self.seconds.iter().copied().chain(other.seconds).collect();
        Self { frames, seconds }
    }

    /// The frames that are asked for, and the rest.
    fn parted(&self, wanted: impl Fn(&TimedFrame) -> bool) -> (Self, Self) {
        self.divided(|i| wanted(self.frames[i]))
    }

    /// Groups for cross-validation, at most [`FOLDS`] times some that are held out together: ensemble members, volumes
    /// where there are fewer than three members; none where there are fewer than three volumes too.
    pub fn folds(&self) -> (GroupBy, Vec<BTreeSet<String>>) {
        let by = self.groups_at_least(3);
        let groups: BTreeSet<String> = self.frames.iter().map(|f| by.group(&f.scene)).collect();
        if groups.len() < 3 {
            return (by, Vec::new());
        }
        let mut groups: Vec<String> = groups.into_iter().collect();
        groups.shuffle(&mut ChaCha8Rng::seed_from_u64(3));
        let mut folds = vec![BTreeSet::new(); FOLDS.min(groups.len())];
        let count = folds.len();
        for (i, group) in groups.into_iter().enumerate() {
            folds[i % count].insert(group);
        }
        (by, folds)
    }

    fn divided(&self, first: impl Fn(usize) -> bool) -> (Self, Self) {
        let pick = |want: bool| Self {
            frames: self
                .frames
                .iter()
                .enumerate()
                .filter(|(i, _)| first(*i) == want)
                .map(|(_, f)| *f)
                .collect(),
            seconds: self
                .seconds
                .iter()
                .enumerate()
                .filter(|(i, _)| first(*i) == want)
                .map(|(_, t)| *t)
                .collect(),
        };
        (pick(true), pick(false))
    }

    /// What may not be torn apart: ensemble members, or volumes where there are fewer members than needed.
    pub fn groups_at_least(&self, needed: usize) -> GroupBy {
        let members: BTreeSet<String> = self.frames.iter().map(|f| GroupBy::Member.group(&f.scene)).collect();
        if members.len() < needed { GroupBy::Volume } else { GroupBy::Member }
    }

    /// A tenth of the groups (at least one where there are three) and the rest: validation and training.
    pub fn hold_out(&self, by: GroupBy, seed: u64) -> (Self, Self) {
        let of_frame: Vec<String> = self.frames.iter().map(|f| by.group(&f.scene)).collect();
        let mut groups: Vec<&String> = of_frame.iter().collect();
        groups.sort_unstable();
        groups.dedup();
        if groups.len() < 3 {
            return (Self { frames: vec![], seconds: vec![] }, self.divided(|_| true).0);
        }
        groups.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        groups.truncate((groups.len() as f64 / 10.0).round().max(1.0) as usize);
        self.divided(|i| groups.contains(&&of_frame[i]))
    }

    /// So many frames, chosen by the seed, and the rest.
    pub fn sample(&self, count: usize, seed: u64) -> (Self, Self) {
        let mut order: Vec<usize> = (0..self.frames.len()).collect();
        order.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        let mut chosen = vec![false; order.len()];
        order.iter().take(count).for_each(|&i| chosen[i] = true);
        self.divided(|i| chosen[i])
    }
}

/// Seconds that a model file predicts for frames.
///
/// # Errors
/// When its inputs cannot be computed.
pub fn predict(model: &Model, kitchen: &Kitchen<'_>, frames: &[&TimedFrame]) -> Result<Vec<f64>> {
    let layout = Layout::of_model(model)?;
    let rows = layout.rows(kitchen.tables, frames, kitchen.pool, &indicatif::ProgressBar::hidden())?;
    crate::commands::train::predict_rows(model, &rows, layout.width())
}

/// Members from which on a tenth of them is held out rather than a tenth of the volumes. Of fewer, one alone would be far
/// more than a tenth of the frames to learn from, and what training loses by that is more than what a better moment to
/// stop gains: the frames that a study is judged on are of other members in any case.
const MEMBERS: usize = 10;

/// Parts of a cross-validation at most.
pub const FOLDS: usize = 5;

/// What an upper bound follows from.
enum Bounds<'a> {
    /// Frames; the validation frames where there are none.
    Frames(&'a Part<'a>),
    /// Frames that were predicted without their group.
    Crossed(&'a Crossed),
}

/// Training frames, each predicted without its ensemble member.
struct Crossed {
    predicted: Vec<f64>,
    measured: Vec<f64>,
    /// The member of each.
    groups: Vec<String>,
    folds: usize,
}

impl Crossed {
    fn upper(&self) -> Calibration {
        bound::from_groups(&self.predicted, &self.measured, &self.groups)
    }
}

/// A predictor of a study.
enum Made {
    /// One with a model file.
    Model(Box<(Model, ModelFile, PathBuf)>),
    /// The yardstick.
    Trees(Box<Trees>),
}

impl Made {
    fn predict(&self, kitchen: &Kitchen<'_>, frames: &[&TimedFrame]) -> Result<Vec<f64>> {
        match self {
            Self::Model(made) => predict(&made.0, kitchen, frames),
            Self::Trees(trees) => trees.predict(kitchen, frames),
        }
    }

    fn latency(&self, bench: &mut Bench) -> Result<Latency> {
        match self {
            Self::Model(made) => bench.latency(&made.0),
            Self::Trees(t) => bench.latency_of(Some(t.probe_side()), 0, |inputs| t.predict_one(inputs)),
        }
    }
}

/// Counts up whenever the same recipe makes something else of the same frames.
const MADE_AS: u32 = 1;

/// Tells apart what was made: a hash of the program's version, the recipe, the bytes of the model files that it starts
/// from, and the frames of each part with their seconds (which tell the clock) and the bytes of their tables and kept
/// features. Where files lie does not count.
fn identity(recipe: &Recipe, tables: &[Table], parts: [&Part<'_>; 3], residuals: &[f64]) -> Result<String> {
    let from = |path: &Option<PathBuf>| -> Result<String> {
        let Some(path) = path else { return Ok("none".into()) };
        let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        Ok(format!("{:016x}", fnv1a(&bytes)))
    };
    let bare = Recipe { volumenet: None, fine_tune: None, file: None, ..recipe.clone() };
    let mut text = format!(
        "{} {MADE_AS} {} {} {}",
        env!("CARGO_PKG_VERSION"),
        serde_json::to_string(&bare)?,
        from(&recipe.volumenet)?,
        from(&recipe.fine_tune)?
    );
    if recipe.file.is_some() {
        text += &format!(" {}", from(&recipe.file)?);
    }
    for part in parts {
        let mut bytes = Vec::with_capacity(32 * part.frames.len());
        for (f, seconds) in part.frames.iter().zip(&part.seconds) {
            let table = tables.get(f.table).context("a frame of no table")?;
            let features = table.features.as_ref().map_or(0, FeatureTable::hash);
            for v in [table.hash, features, f.number, seconds.to_bits()] {
                bytes.extend(v.to_le_bytes());
            }
        }
        text += &format!(" {:016x}", fnv1a(&bytes));
    }
    if !residuals.is_empty() {
        let bytes: Vec<u8> = residuals.iter().flat_map(|r| r.to_le_bytes()).collect();
        text += &format!(" {:016x}", fnv1a(&bytes));
    }
    Ok(format!("{:016x}", fnv1a(text.as_bytes())))
}

/// Writes a model file, whole or not at all.
fn keep(file: &ModelFile, path: &Path) -> Result<()> {
    let part = path.with_extension("part");
    std::fs::write(&part, file.to_bytes()?)
        .and_then(|()| std::fs::rename(&part, path))
        .with_context(|| format!("cannot write {}", path.display()))
}

/// What a study works with besides its description.
pub struct Runner<'a> {
    /// Threads.
    pub pool: &'a rayon::ThreadPool,
    /// Where models are kept.
    pub models: PathBuf,
    /// Progress over all trainings.
    pub bar: &'a indicatif::ProgressBar,
    /// Asked all the time.
    pub stop: &'a dyn Fn() -> bool,
}

impl Runner<'_> {
    /// Makes a predictor, or takes the one that was made of the same data and recipe before.
    fn made(
        &self,
        key: &str,
        recipe: &Recipe,
        kitchen: &Kitchen<'_>,
        (training, validation): (&Part<'_>, &Part<'_>),
        bounds: &Bounds<'_>,
    ) -> Result<(ModelFile, PathBuf)> {
        let none = Part { frames: vec![], seconds: vec![] };
        let (judged, upper) = match bounds {
            Bounds::Frames(frames) => (*frames, None),
            Bounds::Crossed(crossed) => (&none, Some(crossed.upper())),
        };
        let residuals = match bounds {
            Bounds::Frames(_) => Vec::new(),
            Bounds::Crossed(c) => bound::log_residuals(&c.predicted, &c.measured),
        };
        let mark = identity(recipe, kitchen.tables, [training, validation, judged], &residuals)?;
        let name: String =
            key.chars().map(|c| if c.is_ascii_alphanumeric() || c == '-' { c } else { '_' }).collect();
        let path = self.models.join(format!("{name}-{}.safetensors", &mark[..8]));
        if path.exists() {
            let (mut file, model) = crate::recipe::read_model_file(&path)?;
            if file.metadata().get("entire.study_key") == Some(&mark) {
                if let Some(upper) = upper.filter(|u| bound::of(&model) != Some(*u)) {
                    bound::set(&mut file, &upper)?;
                    keep(&file, &path)?;
                }
                return Ok((file, path));
            }
        }
        self.bar.set_message(key.to_owned());
        let fitted = recipe.make(kitchen, training.timed(), validation.timed())?;
        ensure!(!(self.stop)(), "stopped; what was made is kept in {}", self.models.display());
        let mut file = fitted.file;
        let judged = if judged.frames.is_empty() { validation } else { judged };
        if let Some(upper) = upper {
            bound::set(&mut file, &upper)?;
        } else if !judged.frames.is_empty() {
            let predicted = predict(&file.to_model()?, kitchen, &judged.frames)?;
            bound::set(&mut file, &bound::from_predictions(&predicted, &judged.seconds))?;
        }
        file.set_metadata("entire.study_key", mark);
        if recipe.file.is_none() || !file.metadata().contains_key(keys::PROVENANCE) {
            file.set_metadata(
                keys::PROVENANCE,
                json!({ "what": fitted.what, "settings": fitted.settings, "outcome": fitted.outcome,
                    "training_frames": training.frames.len(), "program": crate::machine::version() })
                .to_string(),
            );
        }
        std::fs::create_dir_all(&self.models)?;
        keep(&file, &path)?;
        Ok((file, path))
    }

    /// As [`Runner::made`], of any kind.
    fn any(
        &self,
        key: &str,
        recipe: &Recipe,
        kitchen: &Kitchen<'_>,
        parts: (&Part<'_>, &Part<'_>),
        bounds: &Bounds<'_>,
    ) -> Result<Made> {
        if recipe.kind == Kind::Trees {
            self.bar.set_message(key.to_owned());
            return Ok(Made::Trees(Box::new(recipe.trees(kitchen, parts.0.timed(), parts.1.timed())?)));
        }
        let (file, path) = self.made(key, recipe, kitchen, parts, bounds)?;
        Ok(Made::Model(Box::new((file.to_model()?, file, path))))
    }

    /// Predicts every frame of `judged` with a predictor that was made of those frames of `all` that are of other groups.
    /// `None` where there are too few groups.
    fn crossed(
        &self,
        key: &str,
        recipe: &Recipe,
        kitchen: &Kitchen<'_>,
        all: &Part<'_>,
        judged: &Part<'_>,
    ) -> Result<Option<Crossed>> {
        let (by, folds) = judged.folds();
        let (mut predicted, mut measured, mut groups) = (Vec::new(), Vec::new(), Vec::new());
        for (k, fold) in folds.iter().enumerate() {
            let of_fold = |f: &TimedFrame| fold.contains(&by.group(&f.scene));
            let (held, _) = judged.parted(of_fold);
            let (_, rest) = all.parted(of_fold);
            let (validation, training) = rest.hold_out(rest.groups_at_least(MEMBERS), 1);
            let none = Part { frames: vec![], seconds: vec![] };
            let key = format!("{key}-without-{}", k + 1);
            let made = self.any(&key, recipe, kitchen, (&training, &validation), &Bounds::Frames(&none))?;
            predicted.extend(made.predict(kitchen, &held.frames)?);
            groups.extend(held.frames.iter().map(|f| by.group(&f.scene)));
            measured.extend(held.seconds);
        }
        Ok((!folds.is_empty()).then_some(Crossed { predicted, measured, groups, folds: folds.len() }))
    }

    /// Runs a whole study.
    ///
    /// # Errors
    /// When tables cannot be read, a baseline's tables do not fit, or it was stopped.
    pub fn run(&self, study: &Study) -> Result<Findings> {
        let clock = clock(&study.clock)?;
        let mut out = Findings::default();
        let volume = crate::volume::Volume::open(&study.latency_volume.0)?;
        let volume = crate::enlarge::enlarge(&volume, study.latency_volume.1)?;
        self.bar.set_length((study.sets.len() * study.predictors.len()) as u64);
        for set in &study.sets {
            let mut paths = set.training.clone();
            paths.extend(set.bounds.iter().cloned());
            paths.extend(set.other_steps.iter().cloned());
            let bounds_at = set.training.len();
            let steps_at = bounds_at + set.bounds.len();
            let mut split_at = Vec::new();
            for split in &set.splits {
                split_at.push(paths.len()..paths.len() + split.tables.len());
                paths.extend(split.tables.iter().cloned());
            }
            let tables = read_tables(&paths)?;
            let kitchen = Kitchen {
                tables: &tables,
                pool: self.pool,
                bar: &indicatif::ProgressBar::hidden(),
                stop: self.stop,
            };
            let of =
                |range: std::ops::Range<usize>| Part::of(tables[range].iter().flat_map(|t| &t.frames), clock);
            let all = of(0..bounds_at);
            ensure!(
                !all.frames.is_empty(),
                "set {}: no training frame has a time by the clock {:?}",
                set.name,
                clock.name()
            );
            let bounds = of(bounds_at..steps_at);
            // The paper's inputs say nothing of the step.
            let by = all.groups_at_least(MEMBERS);
            let every = all.and(of(steps_at..steps_at + set.other_steps.len()));
            let one_step = all.hold_out(by, 1);
            let every_step = every.hold_out(by, 1);
            let splits: Vec<Part<'_>> = split_at.iter().map(|r| of(r.clone())).collect();
            for (split, part) in set.splits.iter().zip(&splits) {
                if let Some(noise) = noise_floor(part.frames.iter().copied(), clock) {
                    out.noise.push((set.name.clone(), split.name.clone(), noise, part.frames.len()));
                }
            }
            let low = low_resolution(set, &tables, clock)?;
            let shading = all.frames[0].scene.shading;
            let mut bench = Bench::new(&volume, shading)?;
            for named in &study.predictors {
                let key = format!("{}-{}", set.name, named.name);
                let recipe = named.recipe_for(&set.name);
                let (whole, (validation, training)) =
                    if recipe.knows_step()? { (&every, &every_step) } else { (&all, &one_step) };
                let made = || -> Result<_> {
                    let crossed = if named.cross_validated && named.panel == main_panel() {
                        self.crossed(&key, recipe, &kitchen, whole, &all)?
                    } else {
                        None
                    };
                    let from = crossed.as_ref().map_or(Bounds::Frames(&bounds), Bounds::Crossed);
                    let made = self.any(&key, recipe, &kitchen, (training, validation), &from)?;
                    let (seen, _) = training.parted(|f| f.table < bounds_at);
                    let predicted = made.predict(&kitchen, &seen.frames)?;
                    let fit = Metrics::new(&predicted, &seen.seconds).map(|seen| Fit {
                        set: set.name.clone(),
                        predictor: named.name.clone(),
                        seen,
                        crossed: crossed.as_ref().and_then(|c| Metrics::new(&c.predicted, &c.measured)),
                        folds: crossed.as_ref().map_or(0, |c| c.folds),
                    });
                    let upper = match (&made, &crossed) {
                        (Made::Model(made), _) => bound::of(&made.0),
                        (Made::Trees(_), crossed) => crossed.as_ref().map(Crossed::upper),
                    };
                    Ok((made, fit, upper))
                };
                let made = made();
                self.bar.inc(1);
                let (made, upper) = match made {
                    Ok((made, fit, upper)) => {
                        if let Made::Model(m) = &made {
                            out.files.push((set.name.clone(), named.name.clone(), m.2.clone()));
                        }
                        out.fits.extend(fit);
                        (made, upper)
                    }
                    Err(e) if (self.stop)() => return Err(e),
                    Err(e) => {
                        out.left_out.push((set.name.clone(), named.name.clone(), format!("{e:#}")));
                        continue;
                    }
                };
                out.latencies.push((set.name.clone(), named.name.clone(), made.latency(&mut bench)?));
                for (split, part) in set.splits.iter().zip(&splits) {
                    let predicted = match made.predict(&kitchen, &part.frames) {
                        Ok(p) => p,
                        Err(e) => {
                            out.left_out.push((
                                set.name.clone(),
                                format!("{} on {}", named.name, split.name),
                                format!("{e:#}"),
                            ));
                            continue;
                        }
                    };
                    out.results.extend(judge(
                        &set.name,
                        &split.name,
                        &named.name,
                        &named.panel,
                        part,
                        &predicted,
                        upper.as_ref(),
                    ));
                }
                if let Made::Model(made) = &made
                    && study.curves.contains(&named.name)
                {
                    self.curves(
                        study,
                        set,
                        named,
                        &kitchen,
                        (training, validation),
                        &splits,
                        &made.1,
                        &mut out,
                    )?;
                }
            }
            for (split, part) in set.splits.iter().zip(&splits) {
                let constant = crate::commands::evaluate::probe_means(&part.frames, &part.seconds, 1);
                out.results.extend(judge(
                    &set.name,
                    &split.name,
                    CONSTANT,
                    "baseline",
                    part,
                    &constant,
                    None,
                ));
            }
            self.proxy(set, &low, &all, &splits, &mut out)?;
        }
        Ok(out)
    }

    /// The low-resolution proxy: seconds as a linear function of those of the same frame on 64³ voxels.
    fn proxy(
        &self,
        set: &Set,
        low: &BTreeMap<(usize, u64), f64>,
        training: &Part<'_>,
        splits: &[Part<'_>],
        out: &mut Findings,
    ) -> Result<()> {
        if low.is_empty() {
            return Ok(());
        }
        let paired = |part: &Part<'_>| -> Vec<(usize, f64)> {
            part.frames
                .iter()
                .enumerate()
                .filter_map(|(i, f)| Some((i, *low.get(&(f.table, f.number))?)))
                .collect()
        };
        let pairs = paired(training);
        ensure!(pairs.len() > 2, "set {}: low_resolution holds no frames of the training tables", set.name);
        let n = pairs.len() as f64;
        let (mx, my) =
            pairs.iter().fold((0.0, 0.0), |(x, y), (i, l)| (x + l / n, y + training.seconds[*i] / n));
        let (mut xx, mut xy) = (0.0, 0.0);
        for (i, l) in &pairs {
            xx += (l - mx) * (l - mx);
            xy += (l - mx) * (training.seconds[*i] - my);
        }
        let slope = if xx > 0.0 { xy / xx } else { 0.0 };
        for (split, part) in set.splits.iter().zip(splits) {
            let pairs = paired(part);
            if pairs.is_empty() {
                continue;
            }
            let sub = Part {
                frames: pairs.iter().map(|(i, _)| part.frames[*i]).collect(),
                seconds: pairs.iter().map(|(i, _)| part.seconds[*i]).collect(),
            };
            let predicted: Vec<f64> = pairs.iter().map(|(_, l)| my + slope * (l - mx)).collect();
            out.results.extend(judge(&set.name, &split.name, PROXY, "baseline", &sub, &predicted, None));
        }
        let mut times: Vec<f64> = low.values().copied().collect();
        if let Some(t) = crate::dataset::median(&mut times) {
            out.latencies.push((set.name.clone(), PROXY.into(), Latency { cold: t, warm: t, transfer: 0.0 }));
        }
        Ok(())
    }

    #[allow(clippy::too_many_arguments, reason = "one call site")]
    fn curves(
        &self,
        study: &Study,
        set: &Set,
        named: &Named,
        kitchen: &Kitchen<'_>,
        (training, validation): (&Part<'_>, &Part<'_>),
        splits: &[Part<'_>],
        file: &ModelFile,
        out: &mut Findings,
    ) -> Result<()> {
        let none = Part { frames: vec![], seconds: vec![] };
        if let Some(at) = set.splits.iter().position(|s| s.main) {
            for &size in study.sample_sizes.iter().filter(|n| **n < training.frames.len()) {
                let (part, _) = training.sample(size, 7);
                let key = format!("{}-{}-{size}", set.name, named.name);
                let (made, _) = self.made(
                    &key,
                    named.recipe_for(&set.name),
                    kitchen,
                    (&part, validation),
                    &Bounds::Frames(&none),
                )?;
                let model = made.to_model()?;
                let predicted = predict(&model, kitchen, &splits[at].frames)?;
                push_point(
                    &mut out.samples,
                    set,
                    &set.splits[at].name,
                    &named.name,
                    size,
                    &predicted,
                    &splits[at].seconds,
                );
            }
            let predicted = predict(&file.to_model()?, kitchen, &splits[at].frames)?;
            push_point(
                &mut out.samples,
                set,
                &set.splits[at].name,
                &named.name,
                training.frames.len(),
                &predicted,
                &splits[at].seconds,
            );
        }
        let main = set.calibration_split.iter().map(|n| (n, String::new()));
        let more = set.more_calibration_splits.iter().map(|n| (n, format!(" ({n})")));
        for (name, on) in main.chain(more) {
            let Some(at) = set.splits.iter().position(|s| s.name == *name) else { continue };
            let (split, all) = (&set.splits[at].name, &splits[at]);
            // The last half is judged on, whatever the share learned from.
            let (pool, judged) = all.sample(all.frames.len() / 2, 11);
            let before = predict(&file.to_model()?, kitchen, &judged.frames)?;
            push_point(
                &mut out.tuning,
                set,
                split,
                &format!("{}, calibrated{on}", named.name),
                0,
                &before,
                &judged.seconds,
            );
            let mut counts: Vec<usize> = study
                .shares
                .iter()
                .map(|s| ((s * all.frames.len() as f64).round() as usize).max(2))
                .collect();
            counts.push(CALIBRATION_FRAMES);
            counts.sort_unstable();
            counts.dedup();
            for count in counts.into_iter().filter(|n| *n <= pool.frames.len()) {
                let (part, _) = pool.sample(count, 13);
                let mut tuned = vec![("calibrated", calibrate(file, kitchen, part.timed())?)];
                if set.transfer {
                    tuned.push(("transferred", transfer(file, kitchen, part.timed())?));
                }
                for (how, tuned) in tuned {
                    let predicted = predict(&tuned.to_model()?, kitchen, &judged.frames)?;
                    push_point(
                        &mut out.tuning,
                        set,
                        split,
                        &format!("{}, {how}{on}", named.name),
                        count,
                        &predicted,
                        &judged.seconds,
                    );
                }
                if count >= 10 {
                    let key = format!("{}-{}-{split}-alone-{count}", set.name, named.name);
                    match self.made(
                        &key,
                        named.recipe_for(&set.name),
                        kitchen,
                        (&part, &none),
                        &Bounds::Frames(&none),
                    ) {
                        Ok((alone, _)) => {
                            let predicted = predict(&alone.to_model()?, kitchen, &judged.frames)?;
                            push_point(
                                &mut out.tuning,
                                set,
                                split,
                                &format!("{}, from nothing{on}", named.name),
                                count,
                                &predicted,
                                &judged.seconds,
                            );
                        }
                        Err(e) if (self.stop)() => return Err(e),
                        Err(e) => out.left_out.push((set.name.clone(), key, format!("{e:#}"))),
                    }
                }
            }
        }
        Ok(())
    }
}

/// Seconds of the frames' twins on 64³ voxels, by table and frame number; empty where the set names none.
///
/// # Errors
/// When a table cannot be read, or one of its frames shows another scene than the frame of its number.
fn low_resolution(set: &Set, tables: &[Table], clock: Clock) -> Result<BTreeMap<(usize, u64), f64>> {
    let mut low = BTreeMap::new();
    for (index, table) in tables.iter().enumerate() {
        let name = table.path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let Some(path) = set.low_resolution.get(&name) else { continue };
        let other = Table::read_without_features(path, 0)?;
        let by_number: BTreeMap<u64, &TimedFrame> = other.frames.iter().map(|f| (f.number, f)).collect();
        for f in &table.frames {
            let Some(twin) = by_number.get(&f.number) else { continue };
            // All but the number of voxels.
            let as_large = Scene { dims: f.scene.dims, ..twin.scene.clone() };
            ensure!(
                as_large == f.scene,
                "{}: frame {} shows another scene than in {name}; collect it with the same seed, volumes and settings",
                path.display(),
                f.number
            );
            if let Some(t) = twin.seconds(clock) {
                low.insert((index, f.number), t);
            }
        }
    }
    Ok(low)
}

fn push_point(
    points: &mut Vec<Point>,
    set: &Set,
    split: &str,
    curve: &str,
    frames: usize,
    predicted: &[f64],
    measured: &[f64],
) {
    if let Some(metrics) = Metrics::new(predicted, measured) {
        points.push(Point {
            set: set.name.clone(),
            split: split.to_owned(),
            curve: curve.to_owned(),
            frames,
            metrics,
        });
    }
}

fn judge(
    set: &str,
    split: &str,
    predictor: &str,
    panel: &str,
    part: &Part<'_>,
    predicted: &[f64],
    upper: Option<&Calibration>,
) -> Option<Result1> {
    let metrics = Metrics::new(predicted, &part.seconds)?;
    let groups: Vec<String> = part.frames.iter().map(|f| GroupBy::Member.group(&f.scene)).collect();
    let bound = upper.and_then(|u| bound::judge(u, predicted, &part.seconds));
    let parts = crate::commands::evaluate::by_kind(&part.frames, predicted, &part.seconds)
        .into_iter()
        .map(|(name, m)| (name.to_owned(), m))
        .collect();
    let mut errors: Vec<f64> = bound::log_residuals(predicted, &part.seconds).iter().map(|e| -e).collect();
    errors.sort_by(f64::total_cmp);
    let log_errors =
        [0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99].map(|q| crate::metrics::percentile(&errors, q));
    Some(Result1 {
        set: set.to_owned(),
        split: split.to_owned(),
        predictor: predictor.to_owned(),
        panel: panel.to_owned(),
        rmse_interval: bootstrap_by_group(predicted, &part.seconds, &groups, 200, |m| m.rmse_over_sd),
        mdape_interval: bootstrap_by_group(predicted, &part.seconds, &groups, 200, |m| m.mdape),
        metrics,
        bound,
        parts,
        log_errors,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::Measurement;
    use entire_core::scene::{Shading, Skipping};

    fn table(volumes: &[(&str, &str)]) -> Table {
        let frame = |number: usize, volume: &str, member: &str| TimedFrame {
            number: number as u64,
            repeats: vec![Measurement { wall: Some(0.5), cpu: Some(0.25), ..Measurement::default() }],
            ..TimedFrame::of_no_volume(volume, member)
        };
        let frames = volumes.iter().enumerate().map(|(i, (v, m))| frame(i, v, m)).collect();
        Table { path: "t.csv".into(), manifest: None, frames, hash: 7, features: None, root: None }
    }

    #[test]
    fn whole_members_are_held_out_and_volumes_where_there_are_too_few_of_them() {
        let many: Vec<(String, String)> =
            (0..40).map(|i| (format!("e/m{}/t{}.nrrd", i % 4, i / 4), format!("m{}", i % 4))).collect();
        let many: Vec<(&str, &str)> = many.iter().map(|(v, m)| (v.as_str(), m.as_str())).collect();
        let t = table(&many);
        let part = Part::of(&t.frames, Clock::Cpu);
        let by = part.groups_at_least(4);
        assert_eq!(by, GroupBy::Member);
        let (held, rest) = part.hold_out(by, 1);
        assert_eq!((held.frames.len(), rest.frames.len()), (10, 30));
        let member = &held.frames[0].scene.member;
        assert!(held.frames.iter().all(|f| f.scene.member == *member));
        assert!(rest.frames.iter().all(|f| f.scene.member != *member));
        assert_eq!(part.groups_at_least(5), GroupBy::Volume);
        let (held, rest) = part.hold_out(GroupBy::Volume, 1);
        assert_eq!((held.frames.len(), rest.frames.len()), (4, 36));

        let alone = table(&[("a.nrrd", ""), ("b.nrrd", "")]);
        let part = Part::of(&alone.frames, Clock::Cpu);
        let (held, rest) = part.hold_out(part.groups_at_least(3), 1);
        assert_eq!((held.frames.len(), rest.frames.len()), (0, 2));
    }

    #[test]
    fn folds_share_no_member_and_leave_none_out() {
        let frames: Vec<(String, String)> =
            (0..60).map(|i| (format!("e/m{}/t{}.nrrd", i % 7, i / 7), format!("m{}", i % 7))).collect();
        let frames: Vec<(&str, &str)> = frames.iter().map(|(v, m)| (v.as_str(), m.as_str())).collect();
        let t = table(&frames);
        let part = Part::of(&t.frames, Clock::Cpu);
        let (by, folds) = part.folds();
        assert_eq!((by, folds.len()), (GroupBy::Member, FOLDS));
        let all: Vec<&String> = folds.iter().flatten().collect();
        assert_eq!((all.len(), all.iter().collect::<BTreeSet<_>>().len()), (7, 7));
        let held: usize =
            folds.iter().map(|f| part.parted(|x| f.contains(&by.group(&x.scene))).0.frames.len()).sum();
        assert_eq!(held, part.frames.len());
        // Of two members, volumes are held out; of two volumes, nothing is.
        let few = table(&[("e/a/t0.nrrd", "a"), ("e/a/t1.nrrd", "a"), ("e/b/t0.nrrd", "b")]);
        let (by, folds) = Part::of(&few.frames, Clock::Cpu).folds();
        assert_eq!((by, folds.len()), (GroupBy::Volume, 3));
        let pair = table(&[("a.nrrd", ""), ("b.nrrd", "")]);
        assert!(Part::of(&pair.frames, Clock::Cpu).folds().1.is_empty());
    }

    #[test]
    fn what_is_cross_validated_was_not_learned_from() {
        // Seconds are the member's own, nothing that another member tells: a predictor that had seen them would know.
        let frames: Vec<(String, String)> =
            (0..40).map(|i| (format!("e/m{}/t{}.nrrd", i % 4, i / 4), format!("m{}", i % 4))).collect();
        let named: Vec<(&str, &str)> = frames.iter().map(|(v, m)| (v.as_str(), m.as_str())).collect();
        let mut t = table(&named);
        for (i, f) in t.frames.iter_mut().enumerate() {
            let seconds = [1.0, 1000.0, 2.0, 500.0][i % 4];
            f.scene.camera.rx = (i % 4) as f32 * 20.0;
            f.repeats =
                vec![Measurement { cpu: Some(seconds), wall: Some(seconds), ..Measurement::default() }];
        }
        let part = Part::of(&t.frames, Clock::Cpu);
        let folder = tempfile::tempdir().unwrap();
        let pool = crate::commands::train::thread_pool(Some(1)).unwrap();
        let hidden = indicatif::ProgressBar::hidden();
        let runner = Runner { pool: &pool, models: folder.path().to_owned(), bar: &hidden, stop: &|| false };
        let tables = [t.clone()];
        let kitchen = Kitchen { tables: &tables, pool: &pool, bar: &hidden, stop: &|| false };
        let inputs = vec!["camera".to_owned()];
        for recipe in [
            Recipe {
                inputs: inputs.clone(),
                layers: vec![8],
                epochs: 300,
                patience: 300,
                batch: 8,
                learning_rate: Some(1e-2),
                ..Recipe::default()
            },
            Recipe { inputs, kind: Kind::Trees, ..Recipe::default() },
        ] {
            let Crossed { predicted, measured, folds, groups } =
                runner.crossed("key", &recipe, &kitchen, &part, &part).unwrap().unwrap();
            assert_eq!((folds, predicted.len(), groups.len()), (4, 40, 40));
            let worst = bound::log_residuals(&predicted, &measured).into_iter().map(f64::abs);
            assert!(worst.clone().all(|r| r > 0.3), "{:?}", worst.collect::<Vec<_>>());
            let none = Part { frames: vec![], seconds: vec![] };
            let seen = runner.any("all", &recipe, &kitchen, (&part, &none), &Bounds::Frames(&none)).unwrap();
            let metrics =
                Metrics::new(&seen.predict(&kitchen, &part.frames).unwrap(), &part.seconds).unwrap();
            let crossed = Metrics::new(&predicted, &measured).unwrap();
            assert!(metrics.mdape < 0.5 * crossed.mdape, "{} {}", metrics.mdape, crossed.mdape);
        }
    }

    #[test]
    fn what_was_made_is_told_apart_by_all_that_it_was_made_of() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("start.safetensors");
        std::fs::write(&file, "one").unwrap();
        let recipe = Recipe { fine_tune: Some(file.clone()), ..Recipe::default() };
        let t = table(&[("a.nrrd", ""), ("b.nrrd", "")]);
        let key = |recipe: &Recipe, t: &Table, clock: Clock| {
            let part = Part::of(&t.frames, clock);
            identity(recipe, std::slice::from_ref(t), [&part, &part, &part], &[]).unwrap()
        };
        let first = key(&recipe, &t, Clock::Cpu);
        assert_eq!(first, key(&recipe, &t, Clock::Cpu));
        let moved = folder.path().join("moved.safetensors");
        std::fs::copy(&file, &moved).unwrap();
        assert_eq!(first, key(&Recipe { fine_tune: Some(moved), ..recipe.clone() }, &t, Clock::Cpu));

        let part = Part::of(&t.frames, Clock::Cpu);
        let of = |r: &[f64]| identity(&recipe, std::slice::from_ref(&t), [&part, &part, &part], r).unwrap();
        let mut keys = vec![first, key(&recipe, &t, Clock::Wall), of(&[0.1]), of(&[0.2])];
        keys.push(key(&Recipe { epochs: 7, ..recipe.clone() }, &t, Clock::Cpu));
        keys.push(key(&recipe, &Table { hash: 8, ..t.clone() }, Clock::Cpu));
        for value in [1.0, 2.0] {
            let features = FeatureTable::new(vec!["x".into()], &[0, 1], vec![value, 0.0], 7).unwrap();
            keys.push(key(&recipe, &Table { features: Some(features), ..t.clone() }, Clock::Cpu));
        }
        std::fs::write(&file, "two").unwrap();
        keys.push(key(&recipe, &t, Clock::Cpu));
        let all = keys.len();
        keys.sort();
        keys.dedup();
        assert_eq!(keys.len(), all);
        std::fs::remove_file(&file).unwrap();
        let part = Part::of(&t.frames, Clock::Cpu);
        let gone = identity(&recipe, std::slice::from_ref(&t), [&part, &part, &part], &[]);
        assert!(gone.unwrap_err().to_string().contains("start.safetensors"));
    }

    #[test]
    fn a_twin_shows_the_same_scene_but_for_its_voxels() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("low.csv");
        let t = table(&[("a.nrrd", "")]);
        let set: Set = serde_json::from_value(json!({
            "name": "s", "training": [], "splits": [], "low_resolution": { "t.csv": path }
        }))
        .unwrap();
        let low = |change: &dyn Fn(&mut Scene)| {
            let mut scene = Scene { dims: [64; 3], ..t.frames[0].scene.clone() };
            change(&mut scene);
            let mut writer = crate::dataset::Writer::create(&path).unwrap();
            writer.append(0, &scene, &t.frames[0].repeats).unwrap();
            drop(writer);
            let found = low_resolution(&set, std::slice::from_ref(&t), Clock::Cpu);
            std::fs::remove_file(&path).unwrap();
            found.map_err(|e| e.to_string())
        };
        assert_eq!(low(&|_| ()).unwrap().get(&(0, 0)), Some(&0.25));
        let changes: [&dyn Fn(&mut Scene); 6] = [
            &|s| s.height = 11,
            &|s| s.step = 2.0,
            &|s| s.shading = Shading::Local,
            &|s| s.skipping = Skipping::None,
            &|s| s.volume = "b.nrrd".into(),
            &|s| s.camera.dz = 2.0,
        ];
        for change in changes {
            assert!(low(change).unwrap_err().contains("frame 0 shows another scene than in t.csv"));
        }
    }
}
