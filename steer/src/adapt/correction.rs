//! Learning each part of the cost from observed frame times.

use super::constants::CorrectionConstants;
use super::state::{Reader, Writer};
use crate::predict::{CostTerms, TERMS};
use entire_core::Result;
use entire_core::bail;

/// How well the prediction is known before the first observation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Prior {
    /// The machine was never measured: even the order of magnitude is open.
    Unknown,
    /// The model was fitted by another clock: what it says of scenes against each other has errors of about
    /// this standard deviation in ln(time), but the factor between the clocks is open.
    Converted {
        /// Standard deviation of ln(measured / predicted), the common factor apart.
        log_sd: f32,
    },
    /// The model was fitted on this machine; its errors have about this standard deviation in ln(time).
    Fitted {
        /// Standard deviation of ln(measured / predicted).
        log_sd: f32,
    },
}

/// How an observed frame stands to the scene at hand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Standing {
    /// The first frame of this scene.
    First,
    /// A later frame of this scene.
    Same,
    /// A frame of an earlier scene, heard of late: it teaches nothing about this one.
    Past,
}

/// A prediction as it was corrected.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Corrected {
    /// Seconds.
    pub(crate) seconds: f64,
    /// Standard deviation of ln(time).
    pub(crate) sd: f64,
    /// The same among frames that nobody disturbs.
    pub(crate) calm_sd: f64,
}

fn standard_deviation(variance: f64) -> f64 {
    libm::sqrt(variance.clamp(1.0e-8, 4.0 * MAX_VARIANCE))
}

/// t = exp(b) · Σ exp(θ_i) · part_i, with θ and b learned together from observed times by a Kalman filter on
/// ln t.
///
/// θ belongs to the machine: it drifts slowly and outlives a change of scene. b belongs to the scene at hand:
/// what the prediction gets wrong about just this one. It follows the last few frames as closely as their
/// noise allows, and a new scene begins with b = 0 and the spread that scenes have been found to have among
/// each other. So what an expensive scene taught does not weigh on the cheap one after it.
///
/// Costs stay positive because only their logarithms move.
///
/// Times have a heavy tail on the slow side: whoever else runs on the machine slows frames down, mostly several in a
/// row, and says nothing about the scene. One frame that is off by over three standard deviations is a stall and
/// counts as three. Two in a row on one side are a change of the machine's pace: its *load*, a factor of its own on
/// every scene. It ends with the first frame that is better explained without it, and while it lasts nothing is
/// learned of the scene beyond its first frame. One that stays is the machine's own pace, and θ takes it over.
/// A scene that was seen for a few frames alone may have begun under a load that nobody knew: where its frames become
/// faster, b takes that. The state is bounded for ever.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Correction {
    /// θ, then b.
    state: [f64; STATES],
    covariance: [[f64; STATES]; STATES],
    /// Variance of the errors in calm frames, in ln t, stalls left out.
    spread: f64,
    /// The same with stalls and loads.
    spread_of_all: f64,
    /// Variance of b among scenes.
    change: f64,
    /// ln of the factor on the times of all scenes at present; 0 where the machine runs at its own pace.
    load: f64,
    /// Frames of this load.
    loaded: u64,
    /// Frames in a row that were off by more than [`CLIP`]: too slow where positive, too fast where negative.
    off: i64,
    /// The observation before began or ended a load, or was taken whole.
    jumped: bool,
    observations: u64,
    /// Frames since the scene was new.
    age: u64,
    prior: Prior,
    constants: CorrectionConstants,
}

const STATES: usize = TERMS + 1;
const LOCAL: usize = TERMS;
/// A guard: θ and b stay within factors of e⁻¹⁰…e¹⁰, more than any two machines are apart.
const STATE_LIMIT: f64 = 10.0;
/// Guards: errors in calm frames of 0.3 % (below any clock's noise) to 50 %.
const SPREAD: (f64, f64) = (1.0e-5, 0.25);
/// Guards: at 0 nothing is followed, and 1 leaves no noise to be sure of.
const GAIN: (f64, f64) = (0.1, 0.8);
/// Slowest paces at which the spread of calm errors and of scenes' errors are followed: over some ten of them. Half as fast,
/// the training paths cost the same.
const SPREAD_PACE: f64 = 0.1;
const SCENE_PACE: f64 = 0.1;
/// Variance of a fitted model's single unit costs, as a share of the variance of its errors: the rest is of scenes. With
/// none, the training paths cost the same.
const FITTED_SHARE: f64 = 0.1;
/// Guards: errors among scenes of 3 % to 70 %.
const CHANGE: (f64, f64) = (1.0e-3, 0.5);
/// Variance of an unknown common factor, by definition: a standard deviation of 3, a factor of 20, so the first observed time
/// decides it, whatever its order of magnitude.
const OPEN: f64 = 9.0;
/// A guard: no variance exceeds that of a machine of which nothing is known ([`OPEN`] and a unit cost's own) by much.
const MAX_VARIANCE: f64 = 12.0;
/// Without a stated error a fitted model is taken for one that is wrong by 30 %; a stated one lies within 1 % and a factor
/// of e: guards.
const FITTED_SD: f64 = 0.3;
const FITTED_SD_RANGE: (f64, f64) = (0.01, 1.0);
/// Frames in which a scene's own factor takes up `gain` of the first error three times: a fifth of it is left.
const SETTLED: u64 = 3;
/// Frames in a row beyond [`CLIP`], on one side, that are no accident: of normal errors two come once in a quarter of a
/// million frames, and one slow frame is a stall.
const SURE: i64 = 2;
/// Variance that the unit costs' common factor gains per frame, in ln, and that each of them gains beside it: a machine
/// that drifts by a tenth in an hour is followed. Without them the training paths cost the same.
const DRIFT: f64 = 1.0e-5;
const DRIFT_SINGLE: f64 = 2.0e-6;
/// Frames of a load whose mean it is, at most: a guard, so that a load may change.
const LOAD_FRAMES: f64 = 8.0;
/// Frames after which a scene or a load is established: half a second at 60 frames per second, the longest burst that the
/// recordings hold.
const ESTABLISHED: u64 = 32;
/// Share of the variance among scenes that the machine's own pace is uncertain by when it was just learned from one of
/// them: a guess; the next scenes decide.
const LEARNED_SHARE: f64 = 0.25;
/// A guard: a squared error counts six times what was expected at most, which of normal ones 1.4 % exceed.
const SQUARE_LIMIT: f64 = 6.0;
/// A guard: one of the first errors weighs a quarter at most, so that none decides.
const FASTEST_PACE: f64 = 0.25;
/// A guard: an observation weakens to a thousandth at most.
const LEAST_TRUST: f64 = 1.0e-3;
/// Novelty from which a frame is the first of a scene: by definition, it has more of a new scene than of the one before.
pub(crate) const NOVEL: f64 = 0.5;
/// Three standard deviations: of normal errors 0.3 % lie beyond, so what does is another work or another machine.
pub(crate) const CLIP: f64 = 3.0;

impl Correction {
    /// A correction that has seen nothing.
    pub(crate) fn new(prior: Prior, constants: CorrectionConstants) -> Self {
        let mut out = Self {
            state: [0.0; STATES],
            covariance: [[0.0; STATES]; STATES],
            spread: 0.0,
            spread_of_all: 0.0,
            change: 0.0,
            load: 0.0,
            loaded: 0,
            off: 0,
            jumped: false,
            observations: 0,
            age: 0,
            prior,
            constants,
        };
        out.reset();
        out
    }

    /// Forgets everything.
    pub(crate) fn reset(&mut self) {
        let c = self.constants;
        let (common, single, change) = match self.prior {
            Prior::Unknown => (OPEN, c.unit_cost_sd * c.unit_cost_sd, c.scene_sd * c.scene_sd),
            Prior::Converted { log_sd } | Prior::Fitted { log_sd } => {
                let sd = if log_sd.is_finite() {
                    f64::from(log_sd).clamp(FITTED_SD_RANGE.0, FITTED_SD_RANGE.1)
                } else {
                    FITTED_SD
                };
                // A model that was fitted here is right on the whole; it is wrong about single scenes.
                let single = FITTED_SHARE * sd * sd;
                let common = if matches!(self.prior, Prior::Converted { .. }) { OPEN } else { single };
                (common, single, sd * sd)
            }
        };
        self.state = [0.0; STATES];
        self.covariance = [[0.0; STATES]; STATES];
        for i in 0..TERMS {
            for j in 0..TERMS {
                self.covariance[i][j] = common + if i == j { single } else { 0.0 };
            }
        }
        self.spread = (c.spread_start * c.spread_start).clamp(SPREAD.0, SPREAD.1);
        self.spread_of_all = self.spread;
        self.change = change.clamp(CHANGE.0, CHANGE.1);
        self.covariance[LOCAL][LOCAL] = self.change;
        self.load = 0.0;
        self.loaded = 0;
        self.off = 0;
        self.jumped = false;
        self.observations = 0;
        self.age = 0;
    }

    /// The factor that each part is corrected by in every scene.
    #[cfg(test)]
    pub(crate) fn factors(&self) -> [f64; TERMS] {
        core::array::from_fn(|i| libm::exp(self.state[i]))
    }

    /// Whether the scene at hand has been seen for some frames.
    pub(crate) fn settled(&self) -> bool {
        self.age > SETTLED + 1
    }

    /// True if the observation before began or ended a load, or was so fast that it was taken whole. Then frames
    /// before it say nothing of the next one.
    pub(crate) fn jumped(&self) -> bool {
        self.jumped
    }

    /// True while other programs change the machine's pace, as far as times tell.
    fn loaded(&self) -> bool {
        self.load != 0.0
    }

    /// Share of a calm frame's error that the scene's own factor takes up.
    fn gain(&self) -> f64 {
        self.constants.gain.clamp(GAIN.0, GAIN.1)
    }

    /// Variance of ln t between equal frames, stalls left out.
    fn noise(&self) -> f64 {
        self.spread * (1.0 - self.gain())
    }

    /// Variance of ln t between equal frames, stalls included.
    fn noise_of_all(&self) -> f64 {
        self.spread_of_all * (1.0 - self.gain())
    }

    /// Moves on by a frame. `novelty` is 0 where the frame continues the one before, 1 where that says
    /// nothing about it.
    pub(crate) fn advance(&mut self, novelty: f64) {
        let novelty = if novelty.is_finite() { novelty.clamp(0.0, 1.0) } else { 1.0 };
        let keep = 1.0 - novelty;
        self.state[LOCAL] *= keep;
        for i in 0..STATES {
            self.covariance[i][LOCAL] *= keep;
            self.covariance[LOCAL][i] *= keep;
        }
        // b wanders only while it is followed.
        let wander = if self.loaded() { 0.0 } else { keep * self.spread * self.gain() * self.gain() };
        self.covariance[LOCAL][LOCAL] += (1.0 - keep * keep) * self.change + wander;
        self.widen(DRIFT, DRIFT_SINGLE);
        self.tidy();
        if novelty >= NOVEL {
            self.age = 0;
        }
        self.age = self.age.saturating_add(1);
        self.recover();
    }

    /// The corrected time of a prediction in parts.
    pub(crate) fn apply(&self, terms: &CostTerms) -> Corrected {
        let (seconds, shares) = self.shares(terms, true);
        let model = self.model_variance(&shares);
        Corrected {
            seconds: seconds * libm::exp(self.load),
            sd: standard_deviation(model + self.noise_of_all()),
            calm_sd: standard_deviation(model + self.noise()),
        }
    }

    /// Learns from an observed time (finite and positive) of a frame that [`Correction::advance`] was called
    /// for. `trust` in (0, 1] weakens an observation that may hold other work. Returns the error
    /// ln(observed / corrected prediction) in standard deviations, before learning.
    pub(crate) fn observe(&mut self, terms: &CostTerms, seconds: f64, standing: Standing, trust: f64) -> f64 {
        let c = self.constants;
        let this_scene = standing != Standing::Past;
        let (predicted, shares) = self.shares(terms, this_scene);
        if !(seconds.is_finite() && seconds > 0.0 && predicted.is_finite() && predicted > 0.0) {
            return f64::NAN;
        }
        let free = libm::log(seconds / predicted);
        let others = if this_scene { 0.0 } else { self.change };
        let weakened = |noise: f64| noise / trust.clamp(LEAST_TRUST, 1.0) + others;
        let noise = weakened(self.noise());
        let mut model = self.model_variance(&shares);
        let sd = libm::sqrt(model + noise);
        let surprise = free - self.load;
        let normalized = surprise / libm::sqrt(model + weakened(self.noise_of_all()));
        let calm = standing == Standing::Same && trust >= 1.0 && self.age > SETTLED;
        if calm {
            self.spread_of_all = self.follow(self.spread_of_all, surprise * surprise);
        }
        let loaded = self.loaded();
        self.jumped = false;
        let whole = this_scene && trust >= 1.0 && self.judge(free, sd);
        if whole {
            self.covariance[LOCAL][LOCAL] += free * free;
            self.tidy();
            model = self.model_variance(&shares);
        }
        if (loaded || self.loaded()) && standing == Standing::Same {
            self.observations = self.observations.saturating_add(1);
            return normalized;
        }
        let error = free - self.load;
        // A frame that was faster than expected is more often luck than one that was slower is misfortune.
        let taken = if whole { error } else { error.clamp(-c.clip_below * sd, CLIP * sd) };
        // What is left after the model's own uncertainty is noise (calm) or the effect of a change.
        let squared = (error * error).min(CLIP * CLIP * sd * sd);
        if standing == Standing::First {
            if self.observations > 0 {
                let local = self.covariance[LOCAL][LOCAL].min(model);
                let others = (model - local).max(0.0) + noise;
                let seen = (squared - others).clamp(0.0, SQUARE_LIMIT * self.change);
                self.change = (self.change + SCENE_PACE * (seen - self.change)).clamp(CHANGE.0, CHANGE.1);
            }
        } else if calm && self.off == 0 && !self.jumped {
            self.spread = self.follow(self.spread, squared);
        }
        // Kalman step.
        let variance = model + noise;
        let mut ps = [0.0f64; STATES];
        for i in 0..STATES {
            ps[i] = (0..STATES).map(|j| self.covariance[i][j] * shares[j]).sum();
        }
        for i in 0..STATES {
            let gain = ps[i] / variance;
            self.state[i] = (self.state[i] + gain * taken).clamp(-STATE_LIMIT, STATE_LIMIT);
            for j in 0..STATES {
                self.covariance[i][j] -= gain * ps[j];
            }
        }
        self.tidy();
        self.observations = self.observations.saturating_add(1);
        self.recover();
        normalized
    }

    /// A mean square error that has seen one more.
    fn follow(&self, spread: f64, squared: f64) -> f64 {
        let pace = (1.0 / (self.observations as f64 - 1.0).max(1.0)).clamp(SPREAD_PACE, FASTEST_PACE);
        (spread + pace * (squared.min(SQUARE_LIMIT * spread) - spread)).clamp(SPREAD.0, SPREAD.1)
    }

    /// Begins, moves or ends the load by ln(observed / expected without one) and that expectation's standard
    /// deviation. Whether the scene alone has become faster.
    fn judge(&mut self, free: f64, sd: f64) -> bool {
        let with = free - self.load;
        // Of a load that has lasted n frames, the odds that it goes on are n to 1 (Laplace's rule of succession).
        if self.loaded() && with * with - free * free > 2.0 * sd * sd * libm::log(self.loaded as f64) {
            self.pace(0.0);
            return false;
        }
        if libm::fabs(with) > CLIP * sd {
            let side = if with > 0.0 { 1 } else { -1 };
            self.off = if self.off.signum() == side { self.off + side } else { side };
            if self.off.abs() < SURE {
                return false;
            }
            if side < 0 && !self.loaded() && self.age <= ESTABLISHED {
                (self.off, self.jumped) = (0, true);
                return true;
            }
            self.pace(free.clamp(-STATE_LIMIT, STATE_LIMIT));
            return false;
        }
        self.off = 0;
        if self.loaded() {
            self.loaded = self.loaded.saturating_add(1);
            let mean = self.load + with / (self.loaded as f64).min(LOAD_FRAMES);
            self.load = mean.clamp(-STATE_LIMIT, STATE_LIMIT);
            // Not at the first frame of a scene, from which that scene learns as well.
            if self.loaded > ESTABLISHED && self.age > 1 {
                for i in 0..TERMS {
                    self.state[i] = (self.state[i] + self.load).clamp(-STATE_LIMIT, STATE_LIMIT);
                }
                self.widen(LEARNED_SHARE * self.change, 0.0);
                (self.load, self.loaded) = (0.0, 0);
            }
        }
        false
    }

    /// Another load, from the frame observed last on.
    fn pace(&mut self, load: f64) {
        self.load = load;
        self.loaded = u64::from(load != 0.0);
        (self.off, self.jumped) = (0, true);
    }

    /// The corrected time, and its derivative in ln t by each state.
    fn shares(&self, terms: &CostTerms, this_scene: bool) -> (f64, [f64; STATES]) {
        let mut parts = [0.0f64; STATES];
        let mut sum = 0.0;
        for i in 0..TERMS {
            let p = f64::from(terms.parts[i]);
            if p > 0.0 {
                parts[i] = p * libm::exp(self.state[i]);
                sum += parts[i];
            } else if p.is_nan() {
                return (f64::NAN, parts);
            }
        }
        let inv = if sum > 0.0 { 1.0 / sum } else { 0.0 };
        let mut shares = parts.map(|p| p * inv);
        shares[LOCAL] = if this_scene { 1.0 } else { 0.0 };
        (sum * libm::exp(shares[LOCAL] * self.state[LOCAL]), shares)
    }

    fn model_variance(&self, shares: &[f64; STATES]) -> f64 {
        let mut v = 0.0;
        for i in 0..STATES {
            if shares[i] > 0.0 {
                for j in 0..STATES {
                    v += shares[i] * self.covariance[i][j] * shares[j];
                }
            }
        }
        v.max(0.0)
    }

    /// Less certainty about θ.
    fn widen(&mut self, common: f64, single: f64) {
        for i in 0..TERMS {
            for j in 0..TERMS {
                self.covariance[i][j] += common + if i == j { single } else { 0.0 };
            }
        }
    }

    /// Keeps the covariance symmetric, positive on its diagonal, and bounded.
    fn tidy(&mut self) {
        for i in 0..STATES {
            for j in 0..i {
                let mean = 0.5 * (self.covariance[i][j] + self.covariance[j][i]);
                self.covariance[i][j] = mean;
                self.covariance[j][i] = mean;
            }
        }
        for i in 0..STATES {
            let d = self.covariance[i][i];
            if d > MAX_VARIANCE {
                // Scaling row and column keeps correlations as they are.
                let s = libm::sqrt(MAX_VARIANCE / d);
                for j in 0..STATES {
                    self.covariance[i][j] *= s;
                    self.covariance[j][i] *= s;
                }
                // Not a rounding error more, so that what was bounded once stays as it is.
                self.covariance[i][i] = MAX_VARIANCE;
            } else if d < 1.0e-9 {
                self.covariance[i][i] = 1.0e-9;
            }
        }
    }

    /// Forgets everything where a number is not finite: no observation brings such a filter back.
    fn recover(&mut self) {
        let rest = [self.spread, self.spread_of_all, self.change, self.load];
        let mut numbers = self.state.iter().chain(self.covariance.iter().flatten()).chain(&rest);
        if !numbers.all(|v| v.is_finite()) {
            self.reset();
        }
    }

    /// Whether the covariance is one: positive definite, to a millionth of its diagonal (Cholesky).
    fn is_definite(&self) -> bool {
        const TOLERANCE: f64 = 1.0e-6;
        let mut low = self.covariance;
        for j in 0..STATES {
            let own: f64 = (0..j).map(|k| low[j][k] * low[j][k]).sum();
            let pivot = low[j][j] * (1.0 + TOLERANCE) - own;
            if !(pivot > 0.0) {
                return false;
            }
            low[j][j] = libm::sqrt(pivot);
            for i in j + 1..STATES {
                let shared: f64 = (0..j).map(|k| low[i][k] * low[j][k]).sum();
                low[i][j] = (low[i][j] - shared) / low[j][j];
            }
        }
        true
    }

    pub(crate) fn save(&self, w: &mut Writer<'_>) {
        w.f64s(&self.state);
        for row in &self.covariance {
            w.f64s(row);
        }
        w.f64(self.spread);
        w.f64(self.spread_of_all);
        w.f64(self.change);
        w.f64(self.load);
        w.u64(self.loaded);
        w.f64(self.off as f64);
        w.u64(self.observations);
        w.u64(self.age);
    }

    pub(crate) fn load(&mut self, r: &mut Reader<'_>) -> Result<()> {
        r.f64s(&mut self.state, -STATE_LIMIT, STATE_LIMIT)?;
        for row in &mut self.covariance {
            r.f64s(row, -2.0 * MAX_VARIANCE, 2.0 * MAX_VARIANCE)?;
        }
        self.spread = r.f64(SPREAD.0, SPREAD.1)?;
        self.spread_of_all = r.f64(SPREAD.0, SPREAD.1)?;
        self.change = r.f64(CHANGE.0, CHANGE.1)?;
        self.load = r.f64(-STATE_LIMIT, STATE_LIMIT)?;
        self.loaded = r.u64()?;
        self.off = r.f64(-SURE as f64, SURE as f64)? as i64;
        self.observations = r.u64()?;
        self.age = r.u64()?;
        self.tidy();
        if !self.is_definite() {
            bail!(
                InvalidArgument,
                "the saved state's covariance is not positive definite; it is damaged, start without it"
            );
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::predict::Source;
    use alloc::vec::Vec;
    use entire_core::ErrorKind;

    fn saved(correction: &Correction) -> Vec<u8> {
        let mut bytes = Vec::new();
        correction.save(&mut Writer(&mut bytes));
        bytes
    }

    fn terms(seed: u64) -> CostTerms {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let parts = core::array::from_fn(|_| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            1.0e-4 * (1 + state % 1000) as f32
        });
        CostTerms { parts, out_of_range: 0.0, source: Source::Analytic }
    }

    #[test]
    fn a_variance_that_was_bounded_is_loaded_as_it_is() {
        for k in 1..400 {
            let mut correction = Correction::new(Prior::Unknown, CorrectionConstants::default());
            correction.covariance[3][3] = MAX_VARIANCE * (1.0 + f64::from(k) / 401.0);
            let mut once = correction.clone();
            once.load(&mut Reader(&saved(&correction))).unwrap();
            let mut twice = once.clone();
            twice.load(&mut Reader(&saved(&once))).unwrap();
            assert_eq!(saved(&once), saved(&twice), "{k}");
        }
    }

    #[test]
    fn a_filter_that_is_not_finite_starts_anew_by_itself() {
        for prior in [Prior::Unknown, Prior::Fitted { log_sd: 0.1 }] {
            let poisons: [fn(&mut Correction, f64); 6] = [
                |c, v| c.state[2] = v,
                |c, v| c.state[LOCAL] = v,
                |c, v| (c.covariance[1][3], c.covariance[3][1]) = (v, v),
                |c, v| c.covariance[LOCAL][LOCAL] = v,
                |c, v| c.spread = v,
                |c, v| c.load = v,
            ];
            for (i, poison) in poisons.into_iter().enumerate() {
                for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                    let mut correction = Correction::new(prior, CorrectionConstants::default());
                    poison(&mut correction, value);
                    for frame in 0..60 {
                        correction.advance(0.0);
                        correction.observe(&terms(frame), 0.02, Standing::Same, 1.0);
                    }
                    let Corrected { seconds, sd, .. } = correction.apply(&terms(7));
                    assert!(seconds > 0.0 && seconds.is_finite() && sd.is_finite(), "{prior:?} {i} {value}");
                    assert!(correction.observations > 50, "{prior:?} {i} {value}: it learns again");
                }
            }
        }
    }

    #[test]
    fn every_state_that_is_reached_is_loaded_and_indefinite_ones_are_not() {
        for prior in [Prior::Unknown, Prior::Fitted { log_sd: 0.01 }, Prior::Fitted { log_sd: 1.0 }] {
            let mut correction = Correction::new(prior, CorrectionConstants::default());
            for frame in 0..3000u64 {
                correction.advance([0.0, 0.0, 0.0, 0.3, 1.0][frame as usize % 5]);
                let seconds = if frame / 400 % 2 == 0 { 0.01 } else { 3.0 } * (1.0 + (frame % 7) as f64);
                let standing = if frame % 5 == 4 { Standing::First } else { Standing::Same };
                // The same make-up for long: the filter becomes sure of one direction alone.
                correction.observe(&terms(frame / 1000), seconds, standing, 1.0);
                let bytes = saved(&correction);
                let mut other = Correction::new(prior, CorrectionConstants::default());
                other.load(&mut Reader(&bytes)).unwrap();
                assert_eq!(other.observations, correction.observations, "frame {frame}");
            }
            // Every variance stays as it is; two states are more than fully correlated.
            for sign in [-1.0, 1.0] {
                let mut broken = correction.clone();
                let bound = libm::sqrt(broken.covariance[0][0] * broken.covariance[4][4]);
                broken.covariance[0][4] = sign * 1.01 * bound;
                broken.covariance[4][0] = sign * 1.01 * bound;
                let error = Correction::new(prior, CorrectionConstants::default())
                    .load(&mut Reader(&saved(&broken)))
                    .unwrap_err();
                assert_eq!(error.kind(), ErrorKind::InvalidArgument);
                assert!(error.to_string().contains("positive definite"), "{error}");
            }
        }
    }
}
