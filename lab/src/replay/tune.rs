//! Search for better constants of a controller on recorded paths: of ours, and of PID, which it is compared
//! with.
//!
//! The cost of a path is the sum of the controller's errors on it over every useful target, each divided by
//! a limit: the mean of |time − target| / target (8 %), the share of frames over 1.1 targets (3 %), the loss
//! of quality (8 %), the share of frames that are coarser than full quality although full quality meets the
//! target (8 %), and the share of calm frames at which the step jumps (8 %). All errors except the share of
//! jumps are added once more for sessions without a model, over the frames after their first one.
//! Sessions without a model start anywhere on the path, as in a program that knows only its own frame times.
//! The renderer of such a program is not the recorded one, so these sessions are played on three renderers:
//! the recorded one, one whose time falls faster with the step, and one whose time falls more slowly
//! ([`LAWS`]).
//!
//! The search goes through the constants and tries a few multiples of each. A multiple qualifies if it lowers
//! the mean cost of the paths by more than two standard errors of this difference: dozens of values are
//! tried, so a smaller gain may be chance. The search takes the best multiple that qualifies. It ends after a
//! round in which no constant changed.

use super::trials::{hybrid, starts, without_model};
use super::{LIMITS, Replayable, Replayed, Tally, Three, Trial, replay, trials};
use crate::fitted::FittedPredictor;
use crate::trace::{Curve, TRACE_SCALES};
use anyhow::Result;
use entire_cli::steering::contenders::{ControllerKind, pid};
use entire_cli::steering::play::Contender;
use entire_cli::steering::rivals::PID_GAINS;
use entire_steer::control::{CorrectionConstants, HybridConstants, HybridOptions, Session};
use entire_steer::predict::AnalyticModel;
use rayon::prelude::*;
use serde::Serialize;

/// Number of standard errors by which a value must lower the cost.
const STANDARD_ERRORS: f64 = 2.0;

/// Factors on a constant that are tried.
const FACTORS: [f64; 6] = [0.35, 0.5, 0.71, 1.41, 2.0, 2.8];

/// Divisor of every error in the cost, except of the share of missed frames. The steering bars limit the mean
/// of |time − target| / target and the loss of quality to the same value.
const ERROR_GOAL: f64 = 0.08;
/// Divisor, in the cost, of the share of frames over 1.1 targets: the limit of the steering bars.
const PROMISED_MISSES: f64 = 0.03;

/// Number of frames that each session without a model plays.
const COLD_FRAMES: usize = 6;

/// Constants of a controller that the search varies.
pub(crate) trait Constants: Copy + Sync {
    /// Name of the controller in printed texts.
    const CONTROLLER: &'static str;

    /// Name of every constant, in the order of [`Constants::values`].
    fn names() -> Vec<&'static str>;

    /// Returns a mutable reference to every constant.
    fn values(&mut self) -> Vec<&mut f64>;

    /// Returns the controller with these constants before its first frame, with a fitted predictor; without
    /// `calibrated`, with the predictor of an unmeasured machine.
    fn contender(&self, calibrated: Option<&FittedPredictor>) -> Result<Contender>;

    fn changed(mut self, index: usize, value: f64) -> Self {
        if let Some(v) = self.values().into_iter().nth(index) {
            *v = value;
        }
        self
    }
}

/// Constants of our controller.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Ours {
    hybrid: HybridConstants,
    correction: CorrectionConstants,
}

impl Constants for Ours {
    const CONTROLLER: &'static str = ControllerKind::Hybrid.title();

    fn names() -> Vec<&'static str> {
        let Self { mut hybrid, mut correction } = Self::default();
        hybrid.values().into_iter().chain(correction.values()).map(|(name, _)| name).collect()
    }

    fn values(&mut self) -> Vec<&mut f64> {
        self.hybrid.values().into_iter().chain(self.correction.values()).map(|(_, value)| value).collect()
    }

    fn contender(&self, calibrated: Option<&FittedPredictor>) -> Result<Contender> {
        let Self { hybrid: constants, correction } = *self;
        let options = HybridOptions { constants, correction, ..HybridOptions::default() };
        Ok(match calibrated {
            Some(c) => hybrid(c.model.predictor()?, HybridOptions { log_sd: c.log_sd(), ..options }),
            None => without_model(options),
        })
    }
}

/// Gains of the PID controller, which entire is compared with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Gains([f64; 3]);

impl Default for Gains {
    fn default() -> Self {
        Self(PID_GAINS.map(f64::from))
    }
}

impl Constants for Gains {
    const CONTROLLER: &'static str = ControllerKind::Pid.title();

    fn names() -> Vec<&'static str> {
        vec!["pid_proportional", "pid_integral", "pid_differential"]
    }

    fn values(&mut self) -> Vec<&mut f64> {
        self.0.iter_mut().collect()
    }

    fn contender(&self, _: Option<&FittedPredictor>) -> Result<Contender> {
        let mut out = without_model(HybridOptions::default());
        out.name = Self::CONTROLLER.into();
        out.session =
            Session::with_controller(Box::new(AnalyticModel::default()), pid(self.0.map(|gain| gain as f32)));
        Ok(out)
    }
}

/// Name of a constant, and the value at which it has no effect, or the least effect in its valid range.
const VALUES_WITHOUT_EFFECT: [(&str, f64); 9] = [
    ("full", 0.0),
    ("damping", 10.0),
    ("slope_sd", 0.0),
    ("far", 1e-3),
    ("margin_start", 1.0),
    ("unit_cost_sd", 0.0),
    ("spread_start", 0.0),
    ("gain", 0.0),
    ("clip_below", 3.0),
];

#[derive(Clone, Debug, Serialize)]
pub(crate) struct Removed {
    pub(crate) name: &'static str,
    pub(crate) value: f64,
    /// The constant's value in [`VALUES_WITHOUT_EFFECT`].
    pub(crate) without: f64,
    /// Increase of the paths' mean cost if the constant has the value `without`.
    pub(crate) more: f64,
    /// Standard error of the increase, among paths.
    pub(crate) standard_error: f64,
}

/// Effect of each constant of [`VALUES_WITHOUT_EFFECT`]: the increase of the paths' mean cost over that of
/// `now` if this constant alone has its value in [`VALUES_WITHOUT_EFFECT`].
pub(crate) fn removed(
    courses: &[Course<'_>],
    paths: usize,
    mut constants: Ours,
    now: &[Cost],
) -> Result<Vec<Removed>> {
    let values: Vec<f64> = constants.values().into_iter().map(|v| *v).collect();
    Ours::names()
        .into_iter()
        .zip(values)
        .enumerate()
        .filter_map(|(i, (name, value))| {
            VALUES_WITHOUT_EFFECT
                .iter()
                .find(|(n, _)| *n == name)
                .map(|&(_, without)| (i, name, value, without))
        })
        .map(|(i, name, value, without)| {
            let costs = costs(courses, constants.changed(i, without))?;
            let (more, standard_error) = difference(paths, now, &costs);
            Ok(Removed { name, value, without, more, standard_error })
        })
        .collect()
}

/// Renderers of a replay: the recorded one (`None`), and two imitations. An imitation adds a multiple of the
/// frame's shortest recorded time to all times of the frame; the number is this multiple. With -0.9, the
/// remaining time is nearly proportional to 1/step; with 2, most of the time does not depend on the step.
pub(crate) const LAWS: [Option<f64>; 3] = [None, Some(-0.9), Some(2.0)];

/// Returns the recorded path with the frame times of one of [`LAWS`].
pub(crate) fn by_law(recorded: &Replayable, law: Option<f64>) -> Replayable {
    let mut out = recorded.clone();
    let Some(share) = law else { return out };
    for frame in &mut out.trace.frames {
        // Removes images with scales other than 1 and TRACE_SCALES: the replay does not use them, and they
        // may take less time than `coarsest`.
        frame.retain(|p| p.scale == 1.0 || TRACE_SCALES.contains(&p.scale));
        let coarsest = frame.iter().flat_map(|p| &p.seconds).copied().fold(f64::INFINITY, f64::min);
        for seconds in frame.iter_mut().flat_map(|p| &mut p.seconds) {
            *seconds += share * coarsest;
        }
    }
    out.curves = out.trace.frames.iter().map(|f| Curve::of(f)).collect();
    out.images = None;
    out
}

pub(crate) struct Course<'a> {
    /// The path with the frame times of each of [`LAWS`].
    recorded: &'a [Replayable; 3],
    /// Predictor fitted to other volumes than those of the path.
    calibrated: &'a FittedPredictor,
    /// Trials with the frame times of each of [`LAWS`].
    trials: [Vec<Trial>; 3],
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub(crate) struct Cost {
    /// Scores with a fitted predictor.
    pub(crate) fitted: Three,
    /// Share of the frames with a fitted predictor that were coarser than full quality although full quality
    /// met the target.
    pub(crate) fitted_coarse: f64,
    /// Share of the calm frames of a fitted predictor at which the step jumps.
    pub(crate) jumps: f64,
    /// Scores of sessions without a model, over the frames after the first.
    pub(crate) cold: Three,
    /// As `fitted_coarse`, for sessions without a model, over the frames after the first.
    pub(crate) cold_coarse: f64,
    /// Share of the second frames of sessions without a model that took no more than their upper bound.
    pub(crate) second_in_bound: f64,
}

impl Cost {
    /// Returns the cost that the search lowers: the sum of the errors, each divided by its limit.
    pub(crate) fn value(&self) -> f64 {
        let wrong = |t: &Three| (t.deviation + 1.0 - t.quality) / ERROR_GOAL + t.missed / PROMISED_MISSES;
        let others = self.jumps + self.fitted_coarse + self.cold_coarse;
        wrong(&self.fitted) + wrong(&self.cold) + others / ERROR_GOAL
    }
}

/// Number of frames that are coarser than full quality although full quality meets the target.
fn coarse(frames: &[Replayed]) -> f64 {
    let finest = f64::from(LIMITS.finest);
    frames.iter().filter(|f| f.oracle_step <= finest && f.step > finest).count() as f64
}

/// A change of a constant that the search has taken.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Taken {
    pub(crate) name: &'static str,
    pub(crate) from: f64,
    pub(crate) to: f64,
    /// Mean cost of the paths before and after.
    pub(crate) cost: [f64; 2],
    /// Standard error of the difference, among paths.
    pub(crate) standard_error: f64,
}

impl<'a> Course<'a> {
    /// Returns the path with its [`trials`] on each renderer.
    pub(crate) fn new(
        recorded: &'a [Replayable; 3],
        calibrated: &'a FittedPredictor,
        targets: &[(f64, &str)],
    ) -> Self {
        let trials = recorded.each_ref().map(|r| trials(std::slice::from_ref(r), targets));
        Self { recorded, calibrated, trials }
    }

    /// True if the path has no useful target ([`worth_playing`](super::worth_playing)), that is one that some
    /// allowed step meets in at least half of the frames.
    pub(crate) fn is_empty(&self) -> bool {
        self.trials[0].is_empty()
    }

    pub(crate) fn cost(&self, constants: &impl Constants) -> Result<Cost> {
        let (mut fitted, mut cold) = (Tally::default(), Tally::default());
        let (mut fitted_coarse, mut cold_coarse) = (0.0, 0.0);
        let (mut seconds, mut inside) = (0u32, 0u32);
        for trial in &self.trials[0] {
            for round in 1..=2 {
                let mut who = constants.contender(Some(self.calibrated))?;
                let all = 0..trial.targets.len();
                let played = replay(&self.recorded[0], &mut who, &[], &trial.targets, LIMITS, round, all)?;
                fitted.merge(&Tally::of(&played));
                fitted_coarse += coarse(&played);
            }
        }
        for (recorded, trial) in
            self.recorded.iter().zip(&self.trials).flat_map(|(r, t)| t.iter().map(move |t| (r, t)))
        {
            for frames in starts(trial.targets.len(), COLD_FRAMES) {
                let mut who = constants.contender(None)?;
                let played = replay(recorded, &mut who, &[], &trial.targets, LIMITS, 1, frames)?;
                cold.merge(&Tally::of(&played[1..]));
                cold_coarse += coarse(&played[1..]);
                seconds += 1;
                inside += u32::from(played[1].seconds <= played[1].upper);
            }
        }
        let second_in_bound = f64::from(inside) / f64::from(seconds.max(1));
        let (fitted, cold) = (fitted.score(), cold.score());
        Ok(Cost {
            fitted: fitted.all,
            fitted_coarse: fitted_coarse / fitted.frames.max(1) as f64,
            jumps: fitted.jumps,
            cold: cold.all,
            cold_coarse: cold_coarse / cold.frames.max(1) as f64,
            second_in_bound,
        })
    }
}

pub(crate) fn costs(courses: &[Course<'_>], constants: impl Constants) -> Result<Vec<Cost>> {
    courses.par_iter().map(|c| c.cost(&constants)).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

pub(crate) fn mean_cost(costs: &[Cost]) -> f64 {
    mean(&costs.iter().map(Cost::value).collect::<Vec<_>>())
}

/// The difference of two costs: its mean over the recorded paths and its standard error. The courses are the
/// paths, followed by the same paths with each disturbance. Courses of one path are not independent, so a
/// path's difference is the mean over its courses.
fn difference(paths: usize, before: &[Cost], after: &[Cost]) -> (f64, f64) {
    let mut d = vec![0.0; paths];
    for (i, (b, a)) in before.iter().zip(after).enumerate() {
        d[i % paths] += (a.value() - b.value()) * paths as f64 / before.len() as f64;
    }
    let m = mean(&d);
    let n = d.len() as f64;
    let variance = d.iter().map(|v| (v - m).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    (m, (variance / n).sqrt())
}

/// Searches from `constants`, with the costs `now`, for at most `rounds` rounds over the constants `tried`
/// (by index). Returns constants, costs and taken changes. `done` is called after every tried value.
pub(crate) fn search<C: Constants>(
    courses: &[Course<'_>],
    paths: usize,
    mut constants: C,
    mut now: Vec<Cost>,
    tried: &[usize],
    rounds: usize,
    done: &dyn Fn(),
) -> Result<(C, Vec<Cost>, Vec<Taken>)> {
    let mut taken = Vec::new();
    let names = C::names();
    for _ in 0..rounds {
        let before = taken.len();
        for &i in tried {
            let from = *constants.values()[i];
            let mut best: Option<(f64, f64, f64, Vec<Cost>)> = None;
            for to in FACTORS.map(|f| f * from) {
                let costs = costs(courses, constants.changed(i, to))?;
                let (gain, error) = difference(paths, &now, &costs);
                if gain < -STANDARD_ERRORS * error && best.as_ref().is_none_or(|b| gain < b.1) {
                    best = Some((to, gain, error, costs));
                }
                done();
            }
            if let Some((to, _, standard_error, costs)) = best {
                constants = constants.changed(i, to);
                let cost = [mean_cost(&now), mean_cost(&costs)];
                taken.push(Taken { name: names[i], from, to, cost, standard_error });
                now = costs;
            }
        }
        if taken.len() == before {
            break;
        }
    }
    Ok((constants, now, taken))
}

/// Number of values of a constant that a round of the search tries.
pub(crate) const TRIED_VALUES: usize = FACTORS.len();
