//! Trains every predictor of a study on every set and tests it.

use super::bars::judged_in_eight_bits;
use super::baselines::{constant, low_resolution, proxy};
use super::cache::{STUDY_KEY, identity, kept, path_of};
use super::calibrated::calibrated;
use super::data::{MEMBERS, OnSet, SetData, SetTables};
use super::description::main_panel;
use super::findings::judge;
use super::rule::{by_rule, numbers};
use super::{Findings, Fit, Intervals, Named, Study};
use crate::latency::{Bench, Latency};
use crate::trees::Trees;
use anyhow::{Result, ensure};
use entire_core::kernels::Storage;
use entire_core::model::{Key, Model, ModelFile};
use entire_io::dataset::{Clock, TimedFrame, noise_floor};
use entire_io::enlarge::enlarge;
use entire_io::files::{make_folder, write_whole};
use entire_io::metrics::Metrics;
use entire_io::volume::Volume;
use entire_steer::predict::UpperBound;
use entire_train::bound;
use entire_train::fit::{FitContext, Recipe, predict, predict_stored};
use entire_train::inputs::Layout;
use entire_train::split::TimedFrames;
use indicatif::ProgressBar;
use serde_json::json;
use std::path::PathBuf;

/// Frames that determine an upper bound.
pub(crate) enum Bounds<'a> {
    /// These frames; the validation frames if there are none.
    Frames(&'a TimedFrames<'a>),
    Crossed(&'a Crossed<'a>),
}

/// Results of a cross-validation: frames, each predicted by a model trained without its member or volume.
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

    /// Cross-validates a predictor: each fold of `judged` is predicted by a model that was trained on the frames of
    /// `all` in other folds. `None` if there are too few groups.
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
        let volume = enlarge(&Volume::open(path)?, *factor)?;
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
                let made = self.made_and_judged(&on, named, &mut bench, &mut out);
                self.bar.inc(1);
                made?;
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

    /// Trains a predictor and tests it on every split; notes the reason if it cannot be trained.
    pub(super) fn made_and_judged(
        &self,
        on: &OnSet<'_>,
        named: &Named,
        bench: &mut Bench,
        out: &mut Findings,
    ) -> Result<()> {
        match self.on_set(on, named) {
            Ok((predictor, upper, fit)) => {
                out.fits.extend(fit);
                self.judge(on, named, (&predictor, upper), bench, out)?;
            }
            Err(e) if (self.stop)() => return Err(e),
            Err(e) => out.left_out.push((on.set.name.clone(), named.name.clone(), format!("{e:#}"))),
        }
        Ok(())
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
        let small = predict_stored(model, Storage::Int8, context, &part.frames)?;
        if let Some(m) = Metrics::new(&small, &part.seconds) {
            out.eight_bit.push((set.name.clone(), name.to_owned(), m.rmse / stored));
        }
    }
    Ok(())
}
