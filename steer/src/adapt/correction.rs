//! Corrects each term of the cost from observed frame times.

use super::constants::CorrectionConstants;
use super::state::{Reader, Writer};
use crate::predict::{CostTerms, TERMS};
use entire_core::Result;
use entire_core::bail;

/// Prior knowledge of the prediction's errors, before the first observation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Prior {
    /// The machine was never measured: even the order of magnitude is unknown.
    Unknown,
    /// The model was fitted to times of another clock: ratios between scenes have errors of about this
    /// standard deviation in ln(time), but the factor between the clocks is unknown.
    Converted {
        /// Standard deviation of ln(measured / predicted), apart from the common factor.
        log_sd: f32,
    },
    /// The model was fitted on this machine; its errors have about this standard deviation in ln(time).
    Fitted {
        /// Standard deviation of ln(measured / predicted).
        log_sd: f32,
    },
}

/// Relation of an observed frame to the present scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Standing {
    /// The first frame of this scene.
    First,
    /// A later frame of this scene.
    Same,
    /// A late observation of an earlier scene, which carries no information about this one.
    Past,
}

/// A corrected prediction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Corrected {
    /// Seconds.
    pub(crate) seconds: f64,
    /// Standard deviation of ln(time).
    pub(crate) sd: f64,
    /// Standard deviation of ln(time) among undisturbed frames.
    pub(crate) calm_sd: f64,
}

fn standard_deviation(variance: f64) -> f64 {
    libm::sqrt(variance.clamp(1.0e-8, 4.0 * MAX_VARIANCE))
}

/// t = exp(b) · Σ exp(θ_i) · part_i, with θ and b estimated together from observed times by an extended
/// Kalman filter on ln t.
///
/// θ belongs to the machine: it drifts slowly and persists across scenes. b belongs to the present scene: the
/// prediction's error for this scene alone. It follows the last few frames as closely as their noise allows;
/// a new scene begins with b = 0 and the variance observed among scenes. So errors learned on an expensive
/// scene do not bias the cheap one after it.
///
/// Costs stay positive because only their logarithms change.
///
/// Times have a heavy tail on the slow side: other programs slow frames down, mostly several in a row, and
/// such times carry no information about the scene. A single frame that is too slow by more than three
/// standard deviations is a stall, and its error is clipped to three standard deviations; errors of frames
/// that are too fast are clipped at `clip_below`. Two frames in a row with errors of more than three standard
/// deviations on the same side are a change of the machine's pace: its *load*, a common factor on every
/// scene. The load ends with the first frame that is better explained without it. While it lasts, only the
/// first of the present scene's frames updates θ and b. A load that persists becomes the machine's own pace
/// and is added to θ. A scene of at most [`ESTABLISHED`] frames may have begun under an undetected load: if
/// its frames become faster, b absorbs the change. All state is bounded.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Correction {
    /// θ, then b.
    state: [f64; STATES],
    covariance: [[f64; STATES]; STATES],
    /// Variance of the errors of calm frames, in ln t, without stalls.
    spread: f64,
    /// As `spread`, including stalls and frames under a load.
    spread_of_all: f64,
    /// Variance of b among scenes.
    change: f64,
    /// ln of the present common factor on all times; 0 where the machine runs at its own pace.
    load: f64,
    /// Number of frames under the present load.
    loaded: u64,
    /// Number of consecutive frames whose error exceeds [`CLIP`]: positive for too slow, negative for too
    /// fast.
    off: i64,
    /// True where the last observation began or ended a load, or was applied without clipping.
    jumped: bool,
    observations: u64,
    /// Number of frames since the scene began.
    age: u64,
    prior: Prior,
    constants: CorrectionConstants,
}

/// Number of states: θ and b.
const STATES: usize = TERMS + 1;
/// Index of b among the states.
const LOCAL: usize = TERMS;
/// Guard: largest magnitude of θ and b, logarithms of factors: e¹⁰ exceeds the speed ratio of any two machines.
const STATE_LIMIT: f64 = 10.0;
/// Guard: range of the variance of calm frames' errors, for standard deviations of 0.3 % (below any clock's
/// noise) to 50 %.
const SPREAD: (f64, f64) = (1.0e-5, 0.25);
/// Guard: range of `gain`. At 0 the scene's factor would never change; at 1 it would absorb every error
/// completely, noise included.
const GAIN: (f64, f64) = (0.1, 0.8);
/// Smallest learning rate of the variance of calm frames' errors: an average over about ten frames. At half
/// the rate, the loss on the training paths is the same.
const SPREAD_PACE: f64 = 0.1;
/// Learning rate of the variance of b among scenes: an average over about ten scenes. At half the rate, the
/// loss on the training paths is the same.
const SCENE_PACE: f64 = 0.1;
/// Prior variance of ln of each unit cost of a fitted model, and of their common factor, as a share of the
/// variance of the model's errors. At 0, the loss on the training paths is the same.
const FITTED_SHARE: f64 = 0.1;
/// Guard: range of the variance of b among scenes, for standard deviations of 3 % to 70 %.
const CHANGE: (f64, f64) = (1.0e-3, 0.5);
/// Prior variance of ln of an unknown common factor, by definition: a standard deviation of 3, a factor of
/// 20, so that the first observed time determines the factor, whatever its order of magnitude.
const OPEN: f64 = 9.0;
/// Guard: upper bound of every variance, slightly above the prior variance of an unknown machine ([`OPEN`]
/// plus that of a unit cost).
const MAX_VARIANCE: f64 = 12.0;
/// Guard: standard deviation of ln(time) of a fitted model that states none.
const FITTED_SD: f64 = 0.3;
/// Guard: range of stated standard deviations of ln(time), from 1 % to a factor of e.
const FITTED_SD_RANGE: (f64, f64) = (0.01, 1.0);
/// Number of frames after which a scene's own factor is settled: at the default `gain`, a fifth of the first
/// error is left.
const SETTLED: u64 = 3;
/// Number of consecutive frames beyond [`CLIP`] on one side that count as a change of pace. Normal errors
/// exceed [`CLIP`] twice in a row on one side only once in a quarter of a million frames; a single slow frame
/// is a stall.
const SURE: i64 = 2;
/// Variance that each frame adds to ln of the unit costs' common factor, for a machine whose speed drifts: a
/// standard deviation of 10 % after 1000 frames. At 0, the loss on the training paths is the same.
const DRIFT: f64 = 1.0e-5;
/// As [`DRIFT`], for ln of each unit cost: a standard deviation of 4.5 % after 1000 frames.
const DRIFT_SINGLE: f64 = 2.0e-6;
/// Guard: largest number of frames over which the load is averaged, so that it can change.
const LOAD_FRAMES: f64 = 8.0;
/// Number of frames after which a scene or a load is established: half a second at 60 frames per second, the
/// longest burst in the recordings.
const ESTABLISHED: u64 = 32;
/// Variance added to ln of the common factor when a persistent load becomes the machine's own pace, as a
/// share of the variance of b among scenes: a guess, since few scenes were observed under the load.
const LEARNED_SHARE: f64 = 0.25;
/// Guard: largest ratio of a squared error to its expectation; 1.4 % of normal errors exceed it.
const SQUARE_LIMIT: f64 = 6.0;
/// Guard: largest learning rate of the variance during the first frames, so that no single error dominates.
const FASTEST_PACE: f64 = 0.25;
/// Guard: smallest trust in an observation, on a scale up to 1.
const LEAST_TRUST: f64 = 1.0e-3;
/// Smallest novelty of a scene's first frame, on a scale from 0 (same scene) to 1 (unrelated); by definition,
/// one half.
pub(crate) const NOVEL: f64 = 0.5;
/// Clipping limit of errors, in standard deviations: only 0.3 % of normal errors are larger, so a larger
/// error is an outlier (a stall, a load, or another machine).
pub(crate) const CLIP: f64 = 3.0;

impl Correction {
    /// A correction without observations.
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

    /// Forgets all observations.
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
                // A model fitted on this machine has the right speed; its errors are those of single scenes.
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

    /// Correction factor of each term, common to all scenes.
    #[cfg(test)]
    pub(crate) fn factors(&self) -> [f64; TERMS] {
        core::array::from_fn(|i| libm::exp(self.state[i]))
    }

    /// True where the present scene has lasted longer than [`SETTLED`] frames, not counting its first.
    pub(crate) fn settled(&self) -> bool {
        self.age > SETTLED + 1
    }

    /// True where the last observation began or ended a load, or was so fast that it was applied without
    /// clipping. Earlier frames then do not predict the next one.
    pub(crate) fn jumped(&self) -> bool {
        self.jumped
    }

    /// True during a load.
    fn loaded(&self) -> bool {
        self.load != 0.0
    }

    /// Share of a calm frame's error that is added to the scene's own factor.
    fn gain(&self) -> f64 {
        self.constants.gain.clamp(GAIN.0, GAIN.1)
    }

    /// Variance of ln t among equal frames, without stalls.
    fn noise(&self) -> f64 {
        self.spread * (1.0 - self.gain())
    }

    /// Variance of ln t among equal frames, including stalls.
    fn noise_of_all(&self) -> f64 {
        self.spread_of_all * (1.0 - self.gain())
    }

    /// Advances by one frame. `novelty` is 0 where the frame continues the one before, 1 where it is
    /// unrelated to it.
    pub(crate) fn advance(&mut self, novelty: f64) {
        let novelty = if novelty.is_finite() { novelty.clamp(0.0, 1.0) } else { 1.0 };
        let keep = 1.0 - novelty;
        self.state[LOCAL] *= keep;
        for i in 0..STATES {
            self.covariance[i][LOCAL] *= keep;
            self.covariance[LOCAL][i] *= keep;
        }
        // b is a random walk, except during a load, when it is not updated.
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

    /// Corrects a prediction.
    pub(crate) fn apply(&self, terms: &CostTerms) -> Corrected {
        let (seconds, shares) = self.shares(terms, true);
        let model = self.model_variance(&shares);
        Corrected {
            seconds: seconds * libm::exp(self.load),
            sd: standard_deviation(model + self.noise_of_all()),
            calm_sd: standard_deviation(model + self.noise()),
        }
    }

    /// Updates the filter by the observed time (finite and positive) of a frame for which
    /// [`Correction::advance`] was called. `trust` in (0, 1] weakens an observation that may include other
    /// work. Returns the error ln(observed / corrected prediction) before the update, in standard deviations.
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
        // The distribution of errors is skewed: frames faster than expected are clipped earlier than slower
        // ones.
        let taken = if whole { error } else { error.clamp(-c.clip_below * sd, CLIP * sd) };
        // The part of the squared error beyond the model's variance is attributed to the variance among
        // scenes in a scene's first frame, and to noise in calm frames.
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
        // Kalman update.
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

    /// Updates a mean squared error by one more squared error.
    fn follow(&self, spread: f64, squared: f64) -> f64 {
        let pace = (1.0 / (self.observations as f64 - 1.0).max(1.0)).clamp(SPREAD_PACE, FASTEST_PACE);
        (spread + pace * (squared.min(SQUARE_LIMIT * spread) - spread)).clamp(SPREAD.0, SPREAD.1)
    }

    /// Begins, moves or ends the load. `free` is ln(observed / expected without load), `sd` the expectation's
    /// standard deviation. Returns true where the scene alone has become faster.
    fn judge(&mut self, free: f64, sd: f64) -> bool {
        let with = free - self.load;
        // After n frames of a load, the odds that it continues are n to 1 (Laplace's rule of succession).
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
            // An established load becomes the machine's own pace, but not at the first frame of a scene,
            // whose error updates θ and b as well.
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

    /// Begins a load whose first frame is the last observed one; a `load` of 0 ends it.
    fn pace(&mut self, load: f64) {
        self.load = load;
        self.loaded = u64::from(load != 0.0);
        (self.off, self.jumped) = (0, true);
    }

    /// The corrected time in seconds, without the load, and the derivatives of ln t with respect to the
    /// states.
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

    /// Increases the variance of θ.
    fn widen(&mut self, common: f64, single: f64) {
        for i in 0..TERMS {
            for j in 0..TERMS {
                self.covariance[i][j] += common + if i == j { single } else { 0.0 };
            }
        }
    }

    /// Keeps the covariance symmetric, bounded, and positive on its diagonal.
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
                // Scaling row and column keeps the correlations.
                let s = libm::sqrt(MAX_VARIANCE / d);
                for j in 0..STATES {
                    self.covariance[i][j] *= s;
                    self.covariance[j][i] *= s;
                }
                // Set exactly, without rounding error, so that a bounded variance stays unchanged afterwards.
                self.covariance[i][i] = MAX_VARIANCE;
            } else if d < 1.0e-9 {
                self.covariance[i][i] = 1.0e-9;
            }
        }
    }

    /// Forgets all observations where a value is not finite: no observation would repair such a filter.
    fn recover(&mut self) {
        let rest = [self.spread, self.spread_of_all, self.change, self.load];
        let mut numbers = self.state.iter().chain(self.covariance.iter().flatten()).chain(&rest);
        if !numbers.all(|v| v.is_finite()) {
            self.reset();
        }
    }

    /// True where the covariance is positive definite, to a millionth of its diagonal (Cholesky).
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
                // The terms stay the same for 1000 frames, so that the filter becomes certain in one
                // direction only.
                correction.observe(&terms(frame / 1000), seconds, standing, 1.0);
                let bytes = saved(&correction);
                let mut other = Correction::new(prior, CorrectionConstants::default());
                other.load(&mut Reader(&bytes)).unwrap();
                assert_eq!(other.observations, correction.observations, "frame {frame}");
            }
            // All variances are unchanged, but two states get a correlation above 1.
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
