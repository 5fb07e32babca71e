//! Corrects each term of the cost from observed frame times.

use super::busy::Busy;
use super::constants::{CLIP, CorrectionConstants, ESTABLISHED_FRAMES, PACE};
use super::state::{Reader, Writer};
use crate::numeric::cholesky;
use crate::predict::{CostTerms, TERMS};
use entire_core::Result;
use entire_core::bail;

/// Prior knowledge of the prediction's errors, before the first observation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Prior {
    /// The machine was never measured: even the order of magnitude is unknown.
    Unknown,
    /// The model was fitted to times of another clock: predicted ratios of the times of two scenes are about
    /// right, but the factor between the clocks is unknown.
    Converted {
        /// Standard deviation of ln(measured / predicted), apart from the common factor.
        log_sd: f32,
    },
    /// The model was fitted to times of this machine and clock.
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

#[derive(Clone, Copy, Debug)]
pub(crate) struct Corrected {
    /// Expected seconds.
    pub(crate) seconds: f64,
    /// Standard deviation of ln(time) over all frames.
    pub(crate) sd: f64,
    /// Standard deviation of ln(time) over frames that no other program disturbs.
    pub(crate) calm_sd: f64,
}

fn standard_deviation(variance: f64) -> f64 {
    libm::sqrt(variance.clamp(1.0e-8, 4.0 * MAX_VARIANCE))
}

/// Predicts a frame's time as t = exp(b) · Σ exp(θ_i) · part_i, where part_i is the i-th term of the
/// uncorrected prediction. An extended Kalman filter on ln t estimates θ and b together from observed times.
///
/// θ belongs to the machine: it drifts slowly and persists across scenes. b belongs to the present scene: it
/// is the logarithm of a factor for this scene alone, and is learned from the last few frames. At the first
/// frame of a new scene, b is multiplied by 1 − novelty. If the novelty is 1, b is thus 0, and its variance
/// is that observed among scenes. So errors learned on an expensive scene do not bias an unrelated cheap
/// scene after it.
///
/// Costs stay positive because only their logarithms change.
///
/// Times have a heavy tail on the slow side: other programs slow frames down, mostly several in a row, and
/// such times carry no information about the scene. A single frame that is too slow by more than three
/// standard deviations is a stall, and its error is clipped to three standard deviations. If the time of the
/// next frame is closer to the expected time without the stall, the stall's increase of b is taken back. The
/// error of a frame that is too fast is clipped at `clip_below`. Two successive frames that are both too
/// slow, or both too fast, by more than three standard deviations begin a *load*: a factor on the times of
/// all scenes; a stall's increase of b is then taken back, too. A single stall begins a load if its processor
/// time is unusually low ([`Busy`]). The load ends with the first frame whose time is more likely without the
/// load than with it, and whose processor time is not unusually low. During a load, later frames of the
/// present scene do not update θ and b; its first frame does. If a load lasts longer than
/// [`ESTABLISHED_FRAMES`] frames, it is added to θ: from then on, the changed speed counts as the machine's
/// normal speed. A scene of at most [`ESTABLISHED_FRAMES`] frames may have begun under an undetected load: if
/// its frames become faster, b is changed instead of the load. All state is bounded.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Correction {
    /// Estimates of the filter: the logarithm θ_i of each term's factor, then the logarithm b of the scene's
    /// own factor.
    state: [f64; STATES],
    covariance: [[f64; STATES]; STATES],
    /// Variance of ln(measured / expected seconds) over calm frames. Stalls and frames under a load are left
    /// out.
    spread: f64,
    /// Variance of ln(measured / expected seconds), including stalls and frames under a load.
    spread_of_all: f64,
    /// Variance, from scene to scene, of the logarithm of a scene's own factor.
    change: f64,
    /// ln of the load, which is a factor on the times of all scenes; 0 without a load.
    load: f64,
    /// Number of frames under the present load.
    loaded: u64,
    /// Number of the last consecutive frames whose errors exceed [`CLIP`]: positive if they were too slow,
    /// negative if they were too fast.
    off: i64,
    /// Increase of b by the last observation if that was a stall, else 0. The next observation may take this
    /// increase back.
    stall: f64,
    /// Usual processor time per wall time.
    busy: Busy,
    /// True if the last observation began or ended a load, or was so fast that its error was applied without
    /// clipping. Earlier frames then do not predict the next one.
    pub(crate) jumped: bool,
    observations: u64,
    /// Number of frames of the scene so far, including the present frame.
    age: u64,
    prior: Prior,
    constants: CorrectionConstants,
}

/// Number of states of the filter: the logarithm of each term's factor, and that of the scene's own factor.
const STATES: usize = TERMS + 1;
/// Index, among the states, of the logarithm of the scene's own factor.
const LOCAL: usize = TERMS;
/// Largest absolute value of a state and of the field `load`. Both are logarithms of factors, and e¹⁰
/// exceeds the speed ratio of any two machines.
const STATE_LIMIT: f64 = 10.0;
/// Range of the variance of calm frames' errors in ln(time), for standard deviations from 0.3 % (below any
/// clock's noise) to 50 %.
const SPREAD_RANGE: (f64, f64) = (1.0e-5, 0.25);
/// Range of `gain`. At 0 the scene's factor would never change; at 1 every error, noise included, would be
/// added to it completely.
const GAIN: (f64, f64) = (0.1, 0.8);
/// Prior variance of ln of each unit cost of a fitted model, and of their common factor, as a share of the
/// variance of the model's errors. At 0, the loss on the training paths is the same.
const FITTED_SHARE: f64 = 0.1;
/// Limits of the variance, over scenes, of ln of a scene's own factor; they correspond to standard deviations
/// of 3 % and 70 %.
const CHANGE: (f64, f64) = (1.0e-3, 0.5);
/// Prior variance of ln of the unit costs' common factor if this factor is unknown. The value is a choice:
/// its standard deviation of 3 is a factor of 20, so that the first observed time determines the common
/// factor, whatever its order of magnitude.
const UNKNOWN_VARIANCE: f64 = 9.0;
/// Upper bound of every variance in the filter, slightly above the prior variance of an unknown machine
/// ([`UNKNOWN_VARIANCE`] plus that of a unit cost).
const MAX_VARIANCE: f64 = 12.0;
/// Assumed standard deviation of ln(measured / predicted) among scenes, on an unmeasured machine and if
/// [`Prior`] states a value that is not finite.
const ASSUMED_SD: f64 = 0.3;
/// Range to which the standard deviation stated by [`Prior`] is clamped, from 1 % to a factor of e.
const FITTED_SD_RANGE: (f64, f64) = (0.01, 1.0);
/// Number of frames after which a scene's own factor is settled: at the default `gain`, a fifth of the first
/// error is left.
const SETTLED_FRAMES: u64 = 3;
/// Number of consecutive frames with errors beyond [`CLIP`] on the same side that begin a load. Normally
/// distributed errors exceed [`CLIP`] twice in a row on the same side only once in a quarter of a million
/// frames; a single slow frame is a stall.
const LOAD_START_FRAMES: i64 = 2;
/// Variance that each frame adds to ln of the unit costs' common factor, for a machine whose speed drifts: a
/// standard deviation of 10 % after 1000 frames. At 0, the loss on the training paths is the same.
const DRIFT: f64 = 1.0e-5;
/// Largest number of frames over which the load is averaged; more frames would hide a change of the load.
const LOAD_FRAMES: f64 = 8.0;
/// Variance added to ln of the unit costs' common factor when an established load becomes a part of that
/// factor, as a share of the variance of the scenes' own factors ([`Correction::change`]). The share is a
/// guess, since few scenes were observed under the load.
const LEARNED_SHARE: f64 = 0.25;
/// Clipping limit of the ratio of a squared error to its expected value; 1.4 % of normal errors exceed it.
const SQUARE_LIMIT: f64 = 6.0;
/// Largest learning rate of the variance of calm frames' errors, so that no single early error dominates the
/// variance.
const FASTEST_PACE: f64 = 0.25;
/// Lower clamp of the trust in an observation; full trust is 1.
const LEAST_TRUST: f64 = 1.0e-3;
/// Novelty at or above which a frame begins a scene, on a scale from 0 (same scene) to 1 (unrelated): one
/// half by definition.
pub(crate) const NOVELTY_LIMIT: f64 = 0.5;

impl Correction {
    /// Returns a correction without observations.
    pub(crate) fn new(prior: Prior, constants: CorrectionConstants) -> Self {
        let c = constants;
        let (common, single, change) = match prior {
            Prior::Unknown => (UNKNOWN_VARIANCE, c.unit_cost_sd * c.unit_cost_sd, ASSUMED_SD * ASSUMED_SD),
            Prior::Converted { log_sd } | Prior::Fitted { log_sd } => {
                let sd = if log_sd.is_finite() {
                    f64::from(log_sd).clamp(FITTED_SD_RANGE.0, FITTED_SD_RANGE.1)
                } else {
                    ASSUMED_SD
                };
                // A model fitted on this machine has the right speed; its errors are those of single scenes.
                let single = FITTED_SHARE * sd * sd;
                let common = if matches!(prior, Prior::Converted { .. }) { UNKNOWN_VARIANCE } else { single };
                (common, single, sd * sd)
            }
        };
        let spread = (c.spread_start * c.spread_start).clamp(SPREAD_RANGE.0, SPREAD_RANGE.1);
        let mut out = Self {
            state: [0.0; STATES],
            covariance: [[0.0; STATES]; STATES],
            spread,
            spread_of_all: spread,
            change: change.clamp(CHANGE.0, CHANGE.1),
            load: 0.0,
            loaded: 0,
            off: 0,
            stall: 0.0,
            busy: Busy::UNKNOWN,
            jumped: false,
            observations: 0,
            age: 0,
            prior,
            constants,
        };
        out.widen(common, single);
        out.covariance[LOCAL][LOCAL] = out.change;
        out
    }

    /// Forgets all observations.
    pub(crate) fn reset(&mut self) {
        *self = Self::new(self.prior, self.constants);
    }

    /// Correction factor of each term, common to all scenes.
    #[cfg(test)]
    pub(crate) fn factors(&self) -> [f64; TERMS] {
        core::array::from_fn(|i| libm::exp(self.state[i]))
    }

    /// True from the fifth frame of a scene on, when [`SETTLED_FRAMES`] frames lie between the first frame
    /// and the present one.
    pub(crate) fn settled(&self) -> bool {
        self.age > SETTLED_FRAMES + 1
    }

    /// True under a load.
    pub(crate) fn loaded(&self) -> bool {
        self.load != 0.0
    }

    /// Returns the load: a factor on the times of all scenes; 1 without a load.
    pub(crate) fn load_factor(&self) -> f64 {
        libm::exp(self.load)
    }

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

    /// Begins the next frame. `novelty` is 0 if the frame continues the previous frame, 1 if the two frames
    /// are unrelated.
    pub(crate) fn advance(&mut self, novelty: f64) {
        let novelty = if novelty.is_finite() { novelty.clamp(0.0, 1.0) } else { 1.0 };
        let keep = 1.0 - novelty;
        self.state[LOCAL] *= keep;
        self.stall *= keep;
        for i in 0..STATES {
            self.covariance[i][LOCAL] *= keep;
            self.covariance[LOCAL][i] *= keep;
        }
        // The logarithm of the scene's own factor is a random walk. Under a load, later frames of a scene do
        // not update this factor, so the random walk pauses.
        let wander = if self.loaded() { 0.0 } else { keep * self.spread * self.gain() * self.gain() };
        self.covariance[LOCAL][LOCAL] += (1.0 - keep * keep) * self.change + wander;
        self.widen(DRIFT, 0.0);
        self.tidy();
        if novelty >= NOVELTY_LIMIT {
            self.age = 0;
        }
        self.age = self.age.saturating_add(1);
        self.recover();
    }

    /// Returns the corrected prediction of the present frame.
    pub(crate) fn apply(&self, terms: &CostTerms) -> Corrected {
        let (seconds, shares) = self.shares(terms, true);
        let model = self.model_variance(&shares);
        Corrected {
            seconds: seconds * self.load_factor(),
            sd: standard_deviation(model + self.noise_of_all()),
            calm_sd: standard_deviation(model + self.noise()),
        }
    }

    /// Updates the filter by the observed time (finite and positive) of a frame for which
    /// [`Correction::advance`] was called. A `trust` below 1 weakens an observation that may include work
    /// that most frames do not include. `ratio` is ln(processor time / wall time), NaN if the processor time
    /// is unknown. Returns the error before the update, ln(observed / corrected
    /// prediction), in standard deviations; NaN if the time or the prediction is invalid.
    pub(crate) fn observe(
        &mut self,
        terms: &CostTerms,
        seconds: f64,
        standing: Standing,
        trust: f64,
        ratio: f64,
    ) -> f64 {
        let c = self.constants;
        let this_scene = standing != Standing::Past;
        let (predicted, shares) = self.shares(terms, this_scene);
        if !(seconds.is_finite() && seconds > 0.0 && predicted.is_finite() && predicted > 0.0) {
            return f64::NAN;
        }
        let mut free = libm::log(seconds / predicted);
        let others = if this_scene { 0.0 } else { self.change };
        let weakened = |noise: f64| noise / trust.clamp(LEAST_TRUST, 1.0) + others;
        let noise = weakened(self.noise());
        let mut model = self.model_variance(&shares);
        let sd = libm::sqrt(model + noise);
        let surprise = free - self.load;
        let normalized = surprise / libm::sqrt(model + weakened(self.noise_of_all()));
        let calm = standing == Standing::Same && trust >= 1.0 && self.age > SETTLED_FRAMES;
        if calm {
            self.spread_of_all = self.follow(self.spread_of_all, surprise * surprise);
        }
        let loaded = self.loaded();
        self.jumped = false;
        let disturbed = trust >= 1.0 && self.busy.observe(ratio);
        let judged = this_scene && trust >= 1.0;
        let mut whole = false;
        if judged {
            if libm::fabs(free + self.stall) < libm::fabs(free) {
                free = self.take_back(free);
            }
            whole = self.judge(&mut free, sd, disturbed);
            self.stall = 0.0;
        }
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
        // The distribution of errors is skewed, so the clipping limit is smaller for frames that are faster
        // than expected than for slower frames.
        let taken = if whole { error } else { error.clamp(-c.clip_below * sd, CLIP * sd) };
        // In a scene's first frame, the squared error, less the variances of the terms' factors and of the
        // noise, updates the variance of the scenes' own factors. In a calm frame, the squared error updates
        // the variance of calm frames' errors.
        let squared = (error * error).min(CLIP * CLIP * sd * sd);
        if standing == Standing::First {
            if self.observations > 0 {
                let local = self.covariance[LOCAL][LOCAL].min(model);
                let others = (model - local).max(0.0) + noise;
                let seen = (squared - others).clamp(0.0, SQUARE_LIMIT * self.change);
                self.change = (self.change + PACE * (seen - self.change)).clamp(CHANGE.0, CHANGE.1);
            }
        } else if calm && self.off == 0 && !self.jumped {
            self.spread = self.follow(self.spread, squared);
        }
        // Kalman update.
        let local = self.state[LOCAL];
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
        if judged && self.off > 0 {
            self.stall = (self.state[LOCAL] - local).max(0.0);
        }
        self.tidy();
        self.observations = self.observations.saturating_add(1);
        self.recover();
        normalized
    }

    /// Returns the mean squared error `spread`, updated by the squared error `squared`.
    fn follow(&self, spread: f64, squared: f64) -> f64 {
        let pace = (1.0 / (self.observations as f64 - 1.0).max(1.0)).clamp(PACE, FASTEST_PACE);
        (spread + pace * (squared.min(SQUARE_LIMIT * spread) - spread)).clamp(SPREAD_RANGE.0, SPREAD_RANGE.1)
    }

    /// Begins, changes or ends the load. `free` is ln(observed / expected without a load), `sd` its standard
    /// deviation. If a load begins, the stall before it was its first frame, so the stall's increase of b is
    /// taken back, and `free` is computed anew. In a `disturbed` frame, other programs took processors away;
    /// a single such frame begins a load if it is too slow, and it ends no load. Returns true if the scene's
    /// own factor must be changed instead of the load: the frames of a new scene have become faster.
    fn judge(&mut self, free: &mut f64, sd: f64, disturbed: bool) -> bool {
        let with = *free - self.load;
        // After n frames of a load, the odds that it continues are n to 1 (Laplace's rule of succession).
        if self.loaded()
            && !disturbed
            && with * with - *free * *free > 2.0 * sd * sd * libm::log(self.loaded as f64)
        {
            self.pace(0.0);
            return false;
        }
        if libm::fabs(with) > CLIP * sd {
            let side = if with > 0.0 { 1 } else { -1 };
            self.off = if self.off.signum() == side { self.off + side } else { side };
            if self.off.abs() < LOAD_START_FRAMES && !(disturbed && side > 0) {
                return false;
            }
            if side < 0 && !self.loaded() && self.age <= ESTABLISHED_FRAMES {
                (self.off, self.jumped) = (0, true);
                return true;
            }
            *free = self.take_back(*free);
            self.pace(free.clamp(-STATE_LIMIT, STATE_LIMIT));
            return false;
        }
        self.off = 0;
        if self.loaded() {
            self.loaded = self.loaded.saturating_add(1);
            let mean = self.load + with / (self.loaded as f64).min(LOAD_FRAMES);
            self.load = mean.clamp(-STATE_LIMIT, STATE_LIMIT);
            // A load that has lasted for more than `ESTABLISHED_FRAMES` frames is added to the logarithms of
            // the terms' factors. It is not added in the first frame of a scene, because the error of that
            // frame updates these logarithms too.
            if self.loaded > ESTABLISHED_FRAMES && self.age > 1 {
                for i in 0..TERMS {
                    self.state[i] = (self.state[i] + self.load).clamp(-STATE_LIMIT, STATE_LIMIT);
                }
                self.widen(LEARNED_SHARE * self.change, 0.0);
                (self.load, self.loaded) = (0.0, 0);
            }
        }
        false
    }

    /// Takes back the stall's increase of b. Returns ln(observed / expected without a load), which was `free`
    /// before.
    fn take_back(&mut self, free: f64) -> f64 {
        self.state[LOCAL] -= self.stall;
        free + core::mem::take(&mut self.stall)
    }

    /// Begins a load whose first frame is the last observed frame; a `load` of 0 ends the present load.
    fn pace(&mut self, load: f64) {
        self.load = load;
        self.loaded = u64::from(load != 0.0);
        (self.off, self.jumped) = (0, true);
    }

    /// Returns the corrected time t in seconds, without the load, and the derivatives of ln t with respect to
    /// the states. Without `this_scene`, the scene's own factor is left out.
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

    /// Adds `common` to all covariances of the logarithms of the terms' factors, and then `single` to their
    /// variances.
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
                // Set without rounding error, so that another call leaves this variance unchanged.
                self.covariance[i][i] = MAX_VARIANCE;
            } else if d < 1.0e-9 {
                self.covariance[i][i] = 1.0e-9;
            }
        }
    }

    /// Forgets all observations if a value is not finite: no observation would repair such a filter.
    fn recover(&mut self) {
        let rest = [self.spread, self.spread_of_all, self.change, self.load, self.stall];
        let mut numbers = self.state.iter().chain(self.covariance.iter().flatten()).chain(&rest);
        if !numbers.all(|v| v.is_finite()) {
            self.reset();
        }
    }

    /// True if the covariance, with its diagonal increased by a millionth, is positive definite.
    fn is_definite(&self) -> bool {
        const TOLERANCE: f64 = 1.0e-6;
        let mut matrix = self.covariance;
        for i in 0..STATES {
            matrix[i][i] *= 1.0 + TOLERANCE;
        }
        cholesky(matrix.as_flattened_mut(), STATES)
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
        self.spread = r.f64(SPREAD_RANGE.0, SPREAD_RANGE.1)?;
        self.spread_of_all = r.f64(SPREAD_RANGE.0, SPREAD_RANGE.1)?;
        self.change = r.f64(CHANGE.0, CHANGE.1)?;
        // The saved load is read but not used, because later frames may have another load.
        r.f64(-STATE_LIMIT, STATE_LIMIT)?;
        r.u64()?;
        r.f64(-LOAD_START_FRAMES as f64, LOAD_START_FRAMES as f64)?;
        (self.load, self.loaded, self.off, self.stall) = (0.0, 0, 0, 0.0);
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
                        correction.observe(&terms(frame), 0.02, Standing::Same, 1.0, f64::NAN);
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
                // The terms stay the same for 1000 frames, so that the filter becomes certain of only one
                // combination of its states.
                correction.observe(&terms(frame / 1000), seconds, standing, 1.0, f64::NAN);
                let bytes = saved(&correction);
                let mut other = Correction::new(prior, CorrectionConstants::default());
                other.load(&mut Reader(&bytes)).unwrap();
                assert_eq!(other.observations, correction.observations, "frame {frame}");
            }
            // All variances are unchanged, but two states get a correlation of -1.01 or 1.01.
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
