//! Nested cross-validation: what the whole procedure of choosing, fitting and bounding is worth on an
//! ensemble member that none of it saw.
//!
//! One part of the training frames after another (the *outer* one) is left out. On the others every candidate
//! is cross-validated, the rule chooses, the chosen recipe is fitted, and its upper bound follows from the
//! same cross-validation; then it predicts the outer part. A model that leaves out two parts serves both as
//! outer ones, so each pair is fitted once.

use super::data::{Folds, Learned};
use super::rule::{self, Choice, Contender, GRID, LISTED, choose, same, shape};
use super::runner::{Bounds, OnSet, Runner};
use super::{Findings, Intervals, Named};
use crate::latency::Bench;
use anyhow::{Context, Result, ensure};
use entire_cli::bound;
use entire_cli::dataset::Table;
use entire_cli::fit::{FitContext, Recipe};
use entire_cli::metrics::{BoundMetrics, Metrics};
use entire_cli::options::thread_pool;
use entire_cli::split::{GroupBy, TimedFrames};
use entire_core::predict::UPPER_LEVEL;
use indicatif::ProgressBar;
use rayon::ThreadPool;
use serde::Serialize;
use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

/// Fewest parts: one is left out, and the rest is cross-validated.
const FEWEST: usize = 3;

/// How often the workers' master looks whether it is to stop.
const LOOK: Duration = Duration::from_millis(30);

/// The errors of a procedure on members that it did not see.
#[derive(Clone, Debug, Serialize)]
pub struct Nested {
    /// The set.
    pub set: String,
    /// What is judged: the rule and among which candidates it chooses, or a predictor without a choice.
    pub what: String,
    /// Candidates.
    pub candidates: usize,
    /// Longest latency that the rule accepts, seconds; any unless given.
    pub longest: Option<f64>,
    /// Errors over all outer parts.
    pub metrics: Metrics,
    /// Intervals of these.
    pub intervals: Option<Intervals>,
    /// How often the upper bound held. It follows from errors on the inner parts, every member counting alike.
    pub bound: BoundMetrics,
    /// How often one would have held that counts every frame alike.
    pub bound_by_frame: BoundMetrics,
    /// By outer part.
    pub folds: Vec<OuterFold>,
}

/// An outer part.
#[derive(Clone, Debug, Serialize)]
pub struct OuterFold {
    /// Ensemble members (volumes, where those are left out) that nothing saw.
    pub without: Vec<String>,
    /// The predictor that was chosen without them.
    pub chosen: String,
    /// Its errors in the cross-validation by which it was chosen.
    pub inner: Metrics,
    /// Its errors on the outer part.
    pub metrics: Metrics,
    /// How often its upper bound held there.
    pub bound: BoundMetrics,
}

/// A part's frames, as far as errors need them.
#[derive(Clone, Debug)]
pub(super) struct Part {
    /// Measured seconds.
    pub(super) measured: Vec<f64>,
    /// What each is left out with.
    pub(super) groups: Vec<String>,
    /// The volume of each.
    pub(super) volumes: Vec<String>,
}

/// What a candidate predicts where it did not see.
#[derive(Clone, Debug)]
pub(super) struct Candidate<'a> {
    /// Its name.
    pub(super) name: &'a str,
    /// Seconds of one prediction with cold caches.
    pub(super) cold: f64,
    /// `[outer][inner]`: the frames of `inner`, by a model that saw neither part.
    pub(super) predicted: &'a [Vec<Vec<f64>>],
}

impl Candidate<'_> {
    /// Predictions and measured seconds of the given parts by models without `outer`.
    fn pooled(&self, outer: Option<usize>, inner: &[usize], parts: &[Part]) -> (Vec<f64>, Vec<f64>) {
        let predicted =
            inner.iter().flat_map(|&k| self.predicted[outer.unwrap_or(k)][k].iter().copied()).collect();
        (predicted, inner.iter().flat_map(|&k| parts[k].measured.iter().copied()).collect())
    }

    fn contender(&self, outer: Option<usize>, inner: &[usize], parts: &[Part]) -> Contender {
        let (predicted, measured) = self.pooled(outer, inner, parts);
        let error = Metrics::new(&predicted, &measured).map_or(f64::NAN, |m| m.rmse);
        Contender { error, cold: self.cold }
    }
}

/// Plays the procedure with every part as the outer one; `None` where the rule finds nothing to choose.
pub(super) fn evaluate(
    (set, what): (&str, &str),
    parts: &[Part],
    candidates: &[Candidate<'_>],
    longest: Option<f64>,
) -> Option<Nested> {
    let mut folds = Vec::with_capacity(parts.len());
    let (mut predicted, mut measured) = (Vec::new(), Vec::new());
    let (mut bounds, mut by_frame, mut volumes) = (Vec::new(), Vec::new(), Vec::new());
    for (outer, part) in parts.iter().enumerate() {
        let inner: Vec<usize> = (0..parts.len()).filter(|k| *k != outer).collect();
        let contenders: Vec<Contender> =
            candidates.iter().map(|c| c.contender(Some(outer), &inner, parts)).collect();
        let chosen = &candidates[choose(&contenders, longest)?];
        let (p, t) = chosen.pooled(Some(outer), &inner, parts);
        let groups: Vec<String> = inner.iter().flat_map(|&k| parts[k].groups.iter().cloned()).collect();
        let upper = bound::from_groups(&p, &t, &groups);
        let ours = &chosen.predicted[outer][outer];
        let mut without = part.groups.clone();
        without.sort_unstable();
        without.dedup();
        folds.push(OuterFold {
            without,
            chosen: chosen.name.to_owned(),
            inner: Metrics::new(&p, &t)?,
            metrics: Metrics::new(ours, &part.measured)?,
            bound: bound::judge(&upper, ours, &part.measured)?,
        });
        bounds.extend(bound::of_predictions(&upper, ours));
        by_frame.extend(bound::of_predictions(&bound::from_predictions(&p, &t), ours));
        predicted.extend_from_slice(ours);
        measured.extend_from_slice(&part.measured);
        volumes.extend_from_slice(&part.volumes);
    }
    Some(Nested {
        set: set.to_owned(),
        what: what.to_owned(),
        candidates: candidates.len(),
        longest,
        metrics: Metrics::new(&predicted, &measured)?,
        intervals: Intervals::by(&predicted, &measured, &volumes),
        bound: BoundMetrics::new(&bounds, &measured, UPPER_LEVEL)?,
        bound_by_frame: BoundMetrics::new(&by_frame, &measured, UPPER_LEVEL)?,
        folds,
    })
}

/// What is made without one and without two parts.
pub(super) struct Method<'a> {
    /// What its models are kept as.
    pub(super) key: String,
    /// How it is made.
    pub(super) recipe: &'a Recipe,
    /// From what.
    pub(super) learned: &'a Learned<'a>,
}

/// A candidate's predictions `[outer][inner]`, see [`Candidate::predicted`].
type Crossings = Vec<Vec<Vec<f64>>>;

/// What every worker reads.
struct Work<'a> {
    methods: &'a [Method<'a>],
    folds: &'a Folds,
    parts: &'a [TimedFrames<'a>],
    tables: &'a [Table],
    models: &'a Path,
    bar: &'a ProgressBar,
    halt: &'a AtomicBool,
}

impl Work<'_> {
    /// Makes a method without some parts and predicts those. `pool` is one of a single thread, in which this
    /// runs: no step of a training then waits for another thread.
    fn job(&self, pool: &ThreadPool, method: usize, held: &[usize]) -> Result<Vec<Vec<f64>>> {
        let Method { key, recipe, learned } = &self.methods[method];
        let hidden = ProgressBar::hidden();
        let stop = || self.halt.load(Ordering::Relaxed);
        let runner = Runner { pool, models: self.models.to_owned(), bar: self.bar, stop: &stop };
        let context = FitContext { tables: self.tables, pool, bar: &hidden, stop: &stop };
        let (training, validation) = self.folds.without(held, &learned.all);
        let made = runner.any(
            &Folds::key(key, held),
            (recipe, false),
            &context,
            (&training, &validation),
            &Bounds::Frames(&TimedFrames::default()),
        )?;
        held.iter().map(|&k| made.predict(&context, &self.parts[k].frames)).collect()
    }
}

impl Runner<'_> {
    /// Makes every method without each part and each pair of parts, on as many threads as the pool has, and
    /// predicts what it did not see. A method that cannot be made says why.
    ///
    /// # Errors
    /// When it was stopped; what was made is kept.
    pub(super) fn leave_out(
        &self,
        tables: &[Table],
        folds: &Folds,
        parts: &[TimedFrames<'_>],
        methods: &[Method<'_>],
    ) -> Result<Vec<Result<Crossings>>> {
        let count = parts.len();
        let mut jobs: Vec<(usize, Vec<usize>)> = Vec::new();
        for method in 0..methods.len() {
            for a in 0..count {
                jobs.push((method, vec![a]));
                jobs.extend((a + 1..count).map(|b| (method, vec![a, b])));
            }
        }
        let done: Vec<OnceLock<Result<Vec<Vec<f64>>>>> = jobs.iter().map(|_| OnceLock::new()).collect();
        let (next, halt) = (AtomicUsize::new(0), AtomicBool::new(false));
        let work = Work { methods, folds, parts, tables, models: &self.models, bar: self.bar, halt: &halt };
        self.bar.inc_length(jobs.len() as u64);
        std::thread::scope(|scope| {
            let run = || {
                while !work.halt.load(Ordering::Relaxed) {
                    let at = next.fetch_add(1, Ordering::Relaxed);
                    let Some((method, held)) = jobs.get(at) else { break };
                    let job = thread_pool(Some(1)).and_then(|p| p.install(|| work.job(&p, *method, held)));
                    let _ = done[at].set(job);
                    work.bar.inc(1);
                }
            };
            let workers: Vec<_> = (0..self.pool.current_num_threads()).map(|_| scope.spawn(run)).collect();
            while workers.iter().any(|w| !w.is_finished()) {
                halt.fetch_or((self.stop)(), Ordering::Relaxed);
                std::thread::sleep(LOOK);
            }
        });
        ensure!(!(self.stop)(), "stopped; what was made is kept in {}", self.models.display());
        let mut all: Vec<Result<Crossings>> =
            methods.iter().map(|_| Ok(vec![vec![Vec::new(); count]; count])).collect();
        for ((method, held), cell) in jobs.into_iter().zip(done) {
            let Ok(crossings) = &mut all[method] else { continue };
            match cell.into_inner().context("a part was not made")? {
                Ok(mut predicted) => {
                    // Of a pair, each part is the outer one of the other's frames.
                    for (i, &inner) in held.iter().enumerate() {
                        let outer = held[held.len() - 1 - i];
                        crossings[outer][inner] = std::mem::take(&mut predicted[i]);
                    }
                }
                Err(e) => all[method] = Err(e),
            }
        }
        Ok(all)
    }

    /// Judges the choice among the study's predictors, and that among the candidates of its grid, by nested
    /// cross-validation on a set's training frames. What the rule chooses of the grid from all of them is
    /// then made and judged on the splits, as the one candidate of the grid.
    ///
    /// # Errors
    /// When it was stopped, or a latency cannot be measured.
    pub(super) fn nested(&self, on: &OnSet<'_>, bench: &mut Bench, out: &mut Findings) -> Result<()> {
        let OnSet { study, set, data, context } = *on;
        let name = set.name.as_str();
        let judged = &data.one_step.all;
        let folds = Folds::of(judged);
        if folds.groups.len() < FEWEST {
            let why = format!("there are fewer than {FEWEST} ensemble members and volumes to learn from");
            out.left_out.push((name.to_owned(), "nested cross-validation".into(), why));
            return Ok(());
        }
        let grid = study.grid_predictors()?;
        let listed = rule::listed(study, name);
        // Recipes that are there twice are made once.
        let mut own: Vec<&Named> = Vec::new();
        let mut methods: Vec<Method<'_>> = Vec::new();
        let mut places: Vec<(&Named, &str, usize)> = Vec::new();
        for (named, among) in listed.into_iter().map(|p| (p, LISTED)).chain(grid.iter().map(|p| (p, GRID))) {
            let recipe = named.recipe_for(name);
            // What cannot be made at all was said before.
            let Ok(learned) = on.learned(recipe) else { continue };
            let place = own.iter().position(|p| same(p.recipe_for(name), recipe)).unwrap_or_else(|| {
                own.push(named);
                methods.push(Method { key: format!("{name}-{}", named.name), recipe, learned });
                own.len() - 1
            });
            places.push((named, among, place));
        }
        let frames: Vec<TimedFrames<'_>> = (0..folds.groups.len()).map(|k| folds.part(k, judged)).collect();
        let made = self.leave_out(context.tables, &folds, &frames, &methods)?;
        let parts: Vec<Part> = frames.into_iter().map(|f| Part::of(f, folds.by)).collect();
        let mut candidates: Vec<(&Named, &str, Candidate<'_>)> = Vec::new();
        let mut known: Vec<(Recipe, f64)> = Vec::new();
        for (named, among, place) in places {
            let predicted = match &made[place] {
                Ok(predicted) => predicted,
                Err(e) => {
                    let what = format!("{}, nested", named.name);
                    out.left_out.push((name.to_owned(), what, format!("{e:#}")));
                    continue;
                }
            };
            let shape = shape(named.recipe_for(name));
            let measured = (among == LISTED).then(|| out.latency(name, &named.name)).flatten();
            let cold = match (measured, known.iter().find(|k| k.0 == shape)) {
                (Some(latency), _) => latency.cold,
                (None, Some((_, cold))) => *cold,
                (None, None) => {
                    let Method { key, recipe, learned } = &methods[place];
                    let (training, validation) = folds.without(&[0], &learned.all);
                    let none = TimedFrames::default();
                    let bounds = Bounds::Frames(&none);
                    let key = Folds::key(key, &[0]);
                    let any = self.any(&key, (recipe, false), context, (&training, &validation), &bounds)?;
                    any.latency(bench)?.cold
                }
            };
            known.push((shape, cold));
            candidates.push((named, among, Candidate { name: &named.name, cold, predicted }));
        }
        let longest = rule::longest(study, out, name);
        let all: Vec<usize> = (0..parts.len()).collect();
        for among in [LISTED, GRID] {
            let (named, of): (Vec<&Named>, Vec<Candidate<'_>>) =
                candidates.iter().filter(|c| c.1 == among).map(|c| (c.0, c.2.clone())).unzip();
            if of.is_empty() {
                continue;
            }
            let what = format!("the rule, {among} candidates");
            match evaluate((name, &what), &parts, &of, longest) {
                Some(found) => out.nested.push(found),
                None => out.left_out.push((name.to_owned(), what, "no candidate is quick enough".into())),
            }
            if longest.is_some() {
                let what = format!("the rule without a limit on latency, {among} candidates");
                out.nested.extend(evaluate((name, &what), &parts, &of, None));
            }
            if among == GRID {
                let contenders: Vec<Contender> = of.iter().map(|c| c.contender(None, &all, &parts)).collect();
                let Some(place) = choose(&contenders, longest) else { continue };
                let taken = named[place];
                let (predicted, measured) = of[place].pooled(None, &all, &parts);
                let volumes: Vec<String> = parts.iter().flat_map(|p| p.volumes.iter().cloned()).collect();
                let errors =
                    (Metrics::new(&predicted, &measured), Intervals::by(&predicted, &measured, &volumes));
                let choice = Choice::new((study, &*out), name, (GRID, of.len()), taken, errors);
                out.choices.push(choice);
                // One that the study names too is judged as such.
                if !study.predictors.iter().any(|p| same(p.recipe_for(name), &taken.recipe)) {
                    self.made_and_judged(on, taken, bench, out)?;
                }
            }
        }
        let ships = out.choices.iter().find(|c| c.set == name).and_then(|c| c.ships.clone());
        if let Some((named, _, alone)) =
            candidates.iter().find(|c| c.1 == LISTED && Some(&c.0.name) == ships.as_ref())
        {
            let what = format!("`{}` without a choice", named.name);
            out.nested.extend(evaluate((name, &what), &parts, std::slice::from_ref(alone), None));
        }
        Ok(())
    }
}

impl Part {
    fn of(frames: TimedFrames<'_>, by: GroupBy) -> Self {
        Self {
            groups: frames.frames.iter().map(|f| by.group(&f.scene)).collect(),
            volumes: frames.frames.iter().map(|f| GroupBy::Volume.group(&f.scene)).collect(),
            measured: frames.seconds,
        }
    }
}
