//! Trains every predictor of a study on every set, tests it, and calibrates it to other data. A stored model
//! is used again if all inputs of its training are the same.

use super::bars::judged_in_eight_bits;
use super::baselines::{constant, low_resolution, proxy};
use super::data::{MEMBERS, OnSet, SetData, SetTables};
use super::description::main_panel;
use super::findings::{CalibratedResult, judge};
use super::rule::{by_rule, numbers};
use super::{CALIBRATION_FRAMES, Findings, Fit, Intervals, Named, Study};
use crate::latency::{Bench, Latency};
use crate::trees::Trees;
use anyhow::{Context, Result, ensure};
use entire_cli::calibrate::{calibrate_to_frames, can_be_prior};
use entire_core::kernels::Storage;
use entire_core::model::{Key, Model, ModelFile};
use entire_io::dataset::feature_table::FeatureTable;
use entire_io::dataset::{Clock, Table, TimedFrame, noise_floor};
use entire_io::files::{fnv1a_text, make_folder, read_bytes, read_model_file, write_whole};
use entire_io::metrics::Metrics;
use entire_io::volume::Volume;
use entire_steer::predict::UpperBound;
use entire_train::bound;
use entire_train::fit::{FitContext, Recipe, predict, predict_rows};
use entire_train::inputs::Layout;
use entire_train::split::TimedFrames;
use indicatif::ProgressBar;
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use serde_json::json;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Frames that determine an upper bound.
pub(crate) enum Bounds<'a> {
    /// The given frames; the validation frames if no frames are given.
    Frames(&'a TimedFrames<'a>),
    Crossed(&'a Crossed<'a>),
}

/// Results of a cross-validation: frames, each predicted by a model that was trained without the frame's
/// member or volume.
pub(crate) struct Crossed<'a> {
    pub(super) predicted: Vec<f64>,
    pub(super) measured: TimedFrames<'a>,
    pub(super) groups: Vec<String>,
    pub(super) folds: usize,
}

impl Crossed<'_> {
    fn upper(&self) -> UpperBound {
        bound::from_groups(&self.predicted, &self.measured.seconds, &self.groups)
    }
}

pub(super) struct KeptModel {
    model: Model,
    file: ModelFile,
    path: PathBuf,
}

pub(super) enum StudyPredictor {
    Model(Box<KeptModel>),
    /// Boosted trees, a reference without a model file.
    Trees(Box<Trees>),
}

impl StudyPredictor {
    pub(super) fn predict(&self, context: &FitContext<'_>, frames: &[&TimedFrame]) -> Result<Vec<f64>> {
        match self {
            Self::Model(kept) => predict(&kept.model, context, frames),
            Self::Trees(trees) => trees.predict(context, frames),
        }
    }

    /// Number of rays along each side of the predictor's probe; 0 if the predictor takes no scene features.
    fn probe_side(&self) -> usize {
        match self {
            Self::Model(kept) => Layout::of_model(&kept.model).map_or(0, |l| l.probe_side()),
            Self::Trees(trees) => trees.probe_side(),
        }
    }

    pub(super) fn latency(&self, bench: &mut Bench) -> Result<Latency> {
        match self {
            Self::Model(kept) => bench.latency(&kept.model),
            Self::Trees(t) => bench.latency_of(Some(t.probe_side()), 0, t.predictor()?),
        }
    }
}

/// Context of a study besides its description.
pub(crate) struct Runner<'a> {
    pub(crate) pool: &'a rayon::ThreadPool,
    pub(crate) models: PathBuf,
    pub(crate) bar: &'a ProgressBar,
    /// Called often; the study stops once it returns true.
    pub(crate) stop: &'a dyn Fn() -> bool,
}

impl Runner<'_> {
    /// Trains a predictor, or reads the model that is stored for the same data and recipe. Returns the model
    /// and its path.
    pub(crate) fn made(
        &self,
        key: &str,
        recipe: &Recipe,
        context: &FitContext<'_>,
        (training, validation): (&TimedFrames<'_>, &TimedFrames<'_>),
        bounds: &Bounds<'_>,
    ) -> Result<(ModelFile, PathBuf)> {
        let none = TimedFrames::default();
        let (judged, upper, residuals) = match bounds {
            Bounds::Frames(frames) => (*frames, None, Vec::new()),
            Bounds::Crossed(c) => {
                (&none, Some(c.upper()), bound::log_residuals(&c.predicted, &c.measured.seconds))
            }
        };
        let mark = identity(recipe, context.tables, [training, validation, judged], &residuals)?;
        let path = path_of(&self.models, key, &mark);
        if let Some(file) = kept(&path, &mark, upper)? {
            return Ok((file, path));
        }
        self.bar.set_message(key.to_owned());
        let fitted = recipe.make(context, training.timed(), validation.timed());
        ensure!(!(self.stop)(), "stopped; finished results are in {}", self.models.display());
        let fitted = fitted?;
        let mut file = fitted.file;
        let judged = if judged.frames.is_empty() { validation } else { judged };
        if let Some(upper) = upper {
            upper.store(&mut file)?;
        } else if !judged.frames.is_empty() {
            let predicted = predict(&file.to_model()?, context, &judged.frames)?;
            bound::from_predictions(&predicted, &judged.seconds).store(&mut file)?;
        }
        file.metadata.insert(STUDY_KEY.into(), mark);
        if recipe.file.is_none() || !file.metadata.contains_key(Key::Provenance.name()) {
            file.metadata.insert(
                Key::Provenance.into(),
                json!({ "what": fitted.what, "settings": fitted.settings, "outcome": fitted.outcome,
                    "training_frames": training.frames.len(), "program": entire_io::machine::version() })
                .to_string(),
            );
        }
        make_folder(&self.models)?;
        write_whole(&path, &file.to_bytes()?)?;
        Ok((file, path))
    }

    /// Trains a predictor as [`Runner::made`] does; if `trees` is true, grows boosted trees instead.
    pub(super) fn any(
        &self,
        key: &str,
        (recipe, trees): (&Recipe, bool),
        context: &FitContext<'_>,
        parts: (&TimedFrames<'_>, &TimedFrames<'_>),
        bounds: &Bounds<'_>,
    ) -> Result<StudyPredictor> {
        if trees {
            self.bar.set_message(key.to_owned());
            let trees = Trees::fit(recipe, context, parts.0.timed(), parts.1.timed())?;
            return Ok(StudyPredictor::Trees(Box::new(trees)));
        }
        let (file, path) = self.made(key, recipe, context, parts, bounds)?;
        Ok(StudyPredictor::Model(Box::new(KeptModel { model: file.to_model()?, file, path })))
    }

    /// Cross-validates a predictor: each fold of `judged` is predicted by a model that was trained on the
    /// frames of `all` in other folds. `None` if there are too few groups.
    pub(super) fn crossed<'f>(
        &self,
        key: &str,
        method: (&Recipe, bool),
        context: &FitContext<'_>,
        all: &TimedFrames<'_>,
        judged: &TimedFrames<'f>,
    ) -> Result<Option<Crossed<'f>>> {
        let (by, folds) = judged.folds();
        let (mut predicted, mut measured, mut groups) = (Vec::new(), TimedFrames::default(), Vec::new());
        for (k, fold) in folds.iter().enumerate() {
            let inside = |f: &TimedFrame| fold.contains(&by.group(&f.scene));
            let (held, rest) = (judged.parted(inside).0, all.parted(inside).1);
            let (validation, training) = rest.hold_out(rest.groups_at_least(MEMBERS), 1);
            let none = TimedFrames::default();
            let key = format!("{key}-without-{}", k + 1);
            let made = self.any(&key, method, context, (&training, &validation), &Bounds::Frames(&none))?;
            predicted.extend(made.predict(context, &held.frames)?);
            groups.extend(held.frames.iter().map(|f| by.group(&f.scene)));
            measured = measured.and(held);
        }
        let folds = folds.len();
        Ok((folds > 0).then_some(Crossed { predicted, measured, groups, folds }))
    }

    pub(crate) fn run(&self, study: &Study) -> Result<Findings> {
        let clock: Clock = study.clock.parse()?;
        let mut out = Findings::default();
        let (path, factor) = &study.latency_volume;
        let volume = Volume::open(path)?.enlarged(*factor)?;
        self.bar.set_length((study.sets.len() * study.predictors.len()) as u64);
        for set in &study.sets {
            let tables = SetTables::read(set)?;
            let data = SetData::new(set, &tables, clock)?;
            let hidden = ProgressBar::hidden();
            let context =
                FitContext { tables: &tables.tables, pool: self.pool, bar: &hidden, stop: self.stop };
            for (split, part) in set.splits.iter().zip(&data.splits) {
                if let Some(noise) =
                    noise_floor(part.frames.iter().copied(), clock, |f| tables.tables[f.table].passes())
                {
                    out.noise.push((set.name.clone(), split.name.clone(), noise, part.frames.len()));
                }
            }
            // The frames at low resolution are read before any training, so that a table with other scenes is
            // reported at once.
            let low = low_resolution(set, &tables.tables, clock)?;
            let mut bench = Bench::new(&volume, data.one_step.all.frames[0].scene.shading)?;
            let on = OnSet { study, set, data: &data, context: &context };
            for named in study.predictors.iter().filter(|p| p.is_of(&set.name)) {
                match self.on_set(&on, named) {
                    Ok((predictor, upper, fit)) => {
                        out.fits.extend(fit);
                        self.judge(&on, named, (&predictor, upper), &mut bench, &mut out)?;
                    }
                    Err(e) if (self.stop)() => return Err(e),
                    Err(e) => out.left_out.push((set.name.clone(), named.name.clone(), format!("{e:#}"))),
                }
                self.bar.inc(1);
            }
            constant(&on, &mut out);
            proxy(&on, &low, &mut out)?;
        }
        for set in &study.sets {
            if let Some(selected) = by_rule(study, &out, &set.name) {
                out.selected.insert(set.name.clone(), selected.name.clone());
            }
        }
        Ok(out)
    }

    /// Trains a predictor for a set, and cross-validates it if required. Returns it with its upper bound, and
    /// with its errors in training and cross-validation.
    fn on_set(
        &self,
        on: &OnSet<'_>,
        named: &Named,
    ) -> Result<(StudyPredictor, Option<UpperBound>, Option<Fit>)> {
        let OnSet { set, data, context, .. } = *on;
        let key = format!("{}-{}", set.name, named.name);
        let recipe = named.recipe_for(&set.name);
        let method = (recipe, named.trees);
        let learned = on.learned(recipe)?;
        let crossed = if named.cross_validated && named.panel == main_panel() {
            self.crossed(&key, method, context, &learned.all, &data.one_step.all)?
        } else {
            None
        };
        let from = crossed.as_ref().map_or(Bounds::Frames(&data.bounds), Bounds::Crossed);
        let made = self.any(&key, method, context, (&learned.training, &learned.validation), &from)?;
        // The training tables come first.
        let seen = learned.training.parted(|f| f.table < set.training.len()).0;
        let predicted = made.predict(context, &seen.frames)?;
        let shading = data.one_step.all.frames[0].scene.shading;
        let fit = Metrics::new(&predicted, &seen.seconds).map(|metrics| Fit {
            set: set.name.clone(),
            predictor: named.name.clone(),
            seen: metrics,
            seen_intervals: Intervals::of(&predicted, &seen),
            crossed: crossed.as_ref().and_then(|c| Metrics::new(&c.predicted, &c.measured.seconds)),
            crossed_intervals: crossed.as_ref().and_then(|c| Intervals::of(&c.predicted, &c.measured)),
            noise: data.noise,
            folds: crossed.as_ref().map_or(0, |c| c.folds),
            numbers: if let StudyPredictor::Model(m) = &made { numbers(&m.model, shading) } else { 0 },
            probe_side: made.probe_side(),
        });
        let upper = match (&made, &crossed) {
            (StudyPredictor::Model(kept), _) => bound::of(&kept.model),
            (StudyPredictor::Trees(_), crossed) => crossed.as_ref().map(Crossed::upper),
        };
        Ok((made, upper, fit))
    }

    /// Tests a predictor on every split, measures its latency, and calibrates it to other data.
    fn judge(
        &self,
        on: &OnSet<'_>,
        named: &Named,
        (made, upper): (&StudyPredictor, Option<UpperBound>),
        bench: &mut Bench,
        out: &mut Findings,
    ) -> Result<()> {
        let OnSet { study, set, data, context } = *on;
        if let StudyPredictor::Model(kept) = made {
            out.files.push((set.name.clone(), named.name.clone(), kept.path.clone()));
        }
        out.latencies.push((set.name.clone(), named.name.clone(), made.latency(bench)?));
        let crossed = out.crossed(&set.name, &named.name).is_some();
        for (split, part) in set.splits.iter().zip(&data.splits) {
            match made.predict(context, &part.frames) {
                Ok(predicted) => {
                    let (name, panel) = (&named.name, &named.panel);
                    // A bound is not tested on the frames that it was fitted to.
                    let upper = upper.as_ref().filter(|_| crossed || !set.bounds_are_of(split));
                    let result = judge(&set.name, &split.name, name, panel, part, &predicted, upper);
                    out.results.extend(result);
                }
                Err(e) => {
                    let what = format!("{} on {}", named.name, split.name);
                    out.left_out.push((set.name.clone(), what, format!("{e:#}")));
                }
            }
        }
        if let StudyPredictor::Model(kept) = made {
            if judged_in_eight_bits(study).any(|name| name == named.name) {
                eight_bit(on, &named.name, &kept.model, out)?;
            }
            calibrated(on, &named.name, &kept.file, out)?;
        }
        Ok(())
    }
}

/// Stores the RMSE with eight-bit weights divided by the RMSE with the weights as stored, on the main split.
fn eight_bit(on: &OnSet<'_>, name: &str, model: &Model, out: &mut Findings) -> Result<()> {
    let OnSet { set, data, context, .. } = *on;
    for (split, part) in set.splits.iter().zip(&data.splits).filter(|(split, _)| split.main) {
        let Some(stored) = out.of(&set.name, &split.name, name).map(|r| r.metrics.rmse) else { continue };
        let layout = Layout::of_model(model)?;
        let rows = layout.rows(context.tables, &part.frames, context.pool, &ProgressBar::hidden())?;
        let small = predict_rows(model, &layout, &rows, Some(Storage::Int8))?;
        if let Some(m) = Metrics::new(&small, &part.seconds) {
            out.eight_bit.push((set.name.clone(), name.to_owned(), m.rmse / stored));
        }
    }
    Ok(())
}

/// The metadata key under which a stored model holds the hash of the inputs of its training.
pub(crate) const STUDY_KEY: &str = "entire.study_key";

/// Version of the fits: raised whenever the same recipe gives another model for the same frames.
const MADE_AS: u32 = 5;

/// Identity of a model: a hash of everything on which the model depends. The hash covers the program's
/// version, [`MADE_AS`], the recipe, and the bytes of the model files that the recipe names. For each frame
/// of `parts`, it covers the frame's number and seconds and the hashes of its timing table and feature table.
/// It also covers `residuals`, from which the upper bound follows (empty without a cross-validation). It does
/// not cover the paths of files.
pub(super) fn identity(
    recipe: &Recipe,
    tables: &[Table],
    parts: [&TimedFrames<'_>; 3],
    residuals: &[f64],
) -> Result<String> {
    let from = |path: &Option<PathBuf>| -> Result<String> {
        let Some(path) = path else { return Ok("none".into()) };
        let bytes = read_bytes(path).with_context(|| format!("cannot read {}", path.display()))?;
        Ok(fnv1a_text(&bytes))
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
        text += &format!(" {}", fnv1a_text(&bytes));
    }
    if !residuals.is_empty() {
        let bytes: Vec<u8> = residuals.iter().flat_map(|r| r.to_le_bytes()).collect();
        text += &format!(" {}", fnv1a_text(&bytes));
    }
    Ok(fnv1a_text(text.as_bytes()))
}

/// Path of the model file of a predictor with this key and identity.
fn path_of(models: &Path, key: &str, identity: &str) -> PathBuf {
    let plain = |c: char| if c.is_ascii_alphanumeric() || c == '-' { c } else { '_' };
    let name: String = key.chars().map(plain).collect();
    models.join(format!("{name}-{}.safetensors", &identity[..8]))
}

/// Returns the stored model if it has this identity, with `upper`, if given, as its upper bound.
fn kept(path: &Path, identity: &str, upper: Option<UpperBound>) -> Result<Option<ModelFile>> {
    if !path.exists() {
        return Ok(None);
    }
    let (mut file, model) = read_model_file(path)?;
    if file.metadata.get(STUDY_KEY).is_none_or(|key| key != identity) {
        return Ok(None);
    }
    if let Some(upper) = upper.filter(|u| bound::of(&model) != Some(*u)) {
        upper.store(&mut file)?;
        write_whole(path, &file.to_bytes()?)?;
    }
    Ok(Some(file))
}

/// The seed of the split of volumes into calibration and test.
const HALVES_SEED: u64 = 11;
const FRAMES_SEED: u64 = 13;

/// Calibrates a predictor to [`CALIBRATION_FRAMES`] of one half of the set's calibration split, tests it on
/// the other half, and vice versa. Does nothing for sets without such a split and for models that cannot be a
/// prior.
fn calibrated(on: &OnSet<'_>, predictor: &str, file: &ModelFile, out: &mut Findings) -> Result<()> {
    let OnSet { set, data, context, .. } = *on;
    let Some(at) = set.splits.iter().position(|s| set.calibration_split.as_ref() == Some(&s.name)) else {
        return Ok(());
    };
    if !can_be_prior(file) {
        return Ok(());
    }
    let Some(halves) = halves(&data.splits[at]) else { return Ok(()) };
    let (mut predicted, mut measured) = (Vec::new(), Vec::new());
    for (half, judged) in halves.iter().zip(halves.iter().rev()) {
        let (few, _) = half.sample(CALIBRATION_FRAMES.min(half.frames.len()), FRAMES_SEED);
        let here = calibrate_to_frames(std::slice::from_ref(file), context, few.timed())?;
        predicted.extend(predict(&here.to_model()?, context, &judged.frames)?);
        measured.extend_from_slice(&judged.seconds);
    }
    out.calibrated.extend(Metrics::new(&predicted, &measured).map(|metrics| CalibratedResult {
        set: set.name.clone(),
        split: set.splits[at].name.clone(),
        predictor: predictor.to_owned(),
        metrics,
    }));
    Ok(())
}

/// Divides frames into two parts without a common ensemble member (without a common volume if there are fewer
/// than two members), so that no model is tested on data that it was adapted to. `None` with fewer than two
/// volumes.
fn halves<'a>(all: &TimedFrames<'a>) -> Option<[TimedFrames<'a>; 2]> {
    let by = all.groups_at_least(2);
    let groups: BTreeSet<String> = all.frames.iter().map(|f| by.group(&f.scene)).collect();
    let mut groups: Vec<String> = groups.into_iter().collect();
    groups.shuffle(&mut ChaCha8Rng::seed_from_u64(HALVES_SEED));
    groups.truncate(groups.len() / 2);
    let (first, second) = all.parted(|f| groups.contains(&by.group(&f.scene)));
    (!first.frames.is_empty()).then_some([first, second])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::study::tests::table;
    use entire_io::dataset::Clock;

    #[test]
    fn no_volume_is_adapted_to_and_judged_by() {
        let volumes = |part: &TimedFrames<'_>| -> BTreeSet<String> {
            part.frames.iter().map(|f| f.scene.volume.clone()).collect()
        };
        let scans: Vec<(String, String)> =
            (0..70).map(|i| (format!("scans/v{}.nrrd", i % 7), String::new())).collect();
        let t = table(&scans);
        let [first, second] = halves(&TimedFrames::of(&t.frames, Clock::Cpu)).unwrap();
        assert_eq!((first.frames.len(), second.frames.len()), (30, 40));
        assert!(volumes(&first).is_disjoint(&volumes(&second)));

        // All time steps of a member must be in the same half.
        let steps: Vec<(String, String)> =
            (0..40).map(|i| (format!("e/m{}/t{}.nrrd", i % 4, i / 4), format!("m{}", i % 4))).collect();
        let t = table(&steps);
        let [first, second] = halves(&TimedFrames::of(&t.frames, Clock::Cpu)).unwrap();
        let members = |part: &TimedFrames<'_>| -> BTreeSet<String> {
            part.frames.iter().map(|f| f.scene.member.clone()).collect()
        };
        assert_eq!((first.frames.len(), second.frames.len()), (20, 20));
        assert!(members(&first).is_disjoint(&members(&second)));

        let one = table(&[("a.nrrd", ""), ("a.nrrd", "")]);
        assert!(halves(&TimedFrames::of(&one.frames, Clock::Cpu)).is_none());
    }
}
