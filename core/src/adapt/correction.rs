//! Learning each part of the cost from observed frame times.

use super::state::{Reader, Writer};
use crate::Result;
use crate::predict::{CostTerms, TERMS};

/// How well the prediction is known before the first observation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Prior {
    /// The machine was never measured: even the order of magnitude is open.
    Unknown,
    /// The model was fitted on this machine; its errors have about this standard deviation in ln(time).
    Fitted {
        /// Standard deviation of ln(measured / predicted).
        log_sd: f32,
    },
}

/// t = Σ exp(θ_i) · part_i, with θ learned from observed times by a Kalman filter on ln t.
///
/// Costs stay positive because only their logarithms move. A drift common to all parts (clock, load, throttling) is
/// expected from frame to frame, a drift of single parts less so; a known change of scene widens what is expected.
/// Errors beyond three standard deviations are clipped; two in a row on the same side mean that the machine has
/// changed, and the filter opens up. The state is bounded for ever.
#[derive(Clone, Debug, PartialEq)]
pub struct Correction {
    theta: [f64; TERMS],
    covariance: [[f64; TERMS]; TERMS],
    /// Variance of ln t between equal frames.
    noise: f64,
    /// Variance that a known change of scene adds.
    change: f64,
    run: i32,
    observations: u64,
    prior: Prior,
}

/// θ stays within these bounds: factors of e⁻¹⁰…e¹⁰.
const THETA_LIMIT: f64 = 10.0;
const NOISE: (f64, f64) = (2.0e-5, 0.1);
const CHANGE: (f64, f64) = (1.0e-3, 0.5);
const MAX_VARIANCE: f64 = 12.0;
const COMMON_DRIFT: f64 = 1.0e-4;
const SINGLE_DRIFT: f64 = 2.0e-5;
const CLIP: f64 = 3.0;

impl Correction {
    /// A correction that has seen nothing.
    pub fn new(prior: Prior) -> Self {
        let mut out = Self {
            theta: [0.0; TERMS],
            covariance: [[0.0; TERMS]; TERMS],
            noise: 2.5e-3,
            change: 0.02,
            run: 0,
            observations: 0,
            prior,
        };
        out.reset();
        out
    }

    /// Forgets everything.
    pub fn reset(&mut self) {
        let (common, single) = match self.prior {
            Prior::Unknown => (9.0, 1.0),
            Prior::Fitted { log_sd } => {
                let sd = if log_sd.is_finite() { f64::from(log_sd).clamp(0.01, 1.0) } else { 0.3 };
                (sd * sd, 0.25 * sd * sd)
            }
        };
        self.theta = [0.0; TERMS];
        for i in 0..TERMS {
            for j in 0..TERMS {
                self.covariance[i][j] = common + if i == j { single } else { 0.0 };
            }
        }
        self.noise = 2.5e-3;
        self.change = 0.02;
        self.run = 0;
        self.observations = 0;
    }

    /// Observations learned from since the last reset.
    pub fn observations(&self) -> u64 {
        self.observations
    }

    /// The factor that each part is corrected by.
    pub fn factors(&self) -> [f64; TERMS] {
        self.theta.map(libm::exp)
    }

    /// The corrected time of a prediction in parts: seconds, and the standard deviation of ln(time). `changed` says
    /// that frames before this one are a bad guide.
    pub fn apply(&self, terms: &CostTerms, changed: bool) -> (f64, f64) {
        let (seconds, shares) = self.shares(terms);
        let variance = self.model_variance(&shares) + self.noise + if changed { self.change } else { 0.0 };
        (seconds, libm::sqrt(variance.clamp(1.0e-8, 4.0 * MAX_VARIANCE)))
    }

    /// Learns from an observed time (finite and positive). `trust` in (0, 1] weakens an observation that may hold
    /// other work. Returns the error ln(observed / corrected prediction) in standard deviations, before learning.
    pub fn observe(&mut self, terms: &CostTerms, seconds: f64, changed: bool, trust: f64) -> f64 {
        let (predicted, shares) = self.shares(terms);
        if !(seconds.is_finite() && seconds > 0.0 && predicted.is_finite() && predicted > 0.0) {
            return f64::NAN;
        }
        let error = libm::log(seconds / predicted);
        if changed {
            self.widen(self.change, self.change);
        }
        let model = self.model_variance(&shares);
        let noise = self.noise / trust.clamp(1.0e-3, 1.0);
        let variance = model + noise;
        let sd = libm::sqrt(variance);
        let normalized = error / sd;
        let clipped = error.clamp(-CLIP * sd, CLIP * sd);
        if libm::fabs(normalized) > CLIP {
            self.run = if (normalized > 0.0) == (self.run > 0) { self.run } else { 0 };
            self.run += if normalized > 0.0 { 1 } else { -1 };
        } else {
            self.run = 0;
        }
        // Kalman step on θ.
        let mut ps = [0.0f64; TERMS];
        for i in 0..TERMS {
            ps[i] = (0..TERMS).map(|j| self.covariance[i][j] * shares[j]).sum();
        }
        for i in 0..TERMS {
            let gain = ps[i] / variance;
            self.theta[i] = (self.theta[i] + gain * clipped).clamp(-THETA_LIMIT, THETA_LIMIT);
            for j in 0..TERMS {
                self.covariance[i][j] -= gain * ps[j];
            }
        }
        self.widen(COMMON_DRIFT, SINGLE_DRIFT);
        if self.run.abs() >= 2 {
            // Not an outlier but another machine: be ready to move by what was just seen.
            let jump = (error * error).min(4.0);
            self.widen(jump, 0.1 * jump);
            self.run = 0;
        }
        self.tidy();
        // What is left after the model's own uncertainty is noise (calm) or the effect of a change.
        let squared = (clipped * clipped - if changed { self.noise } else { model }).max(0.0);
        if changed {
            self.change = (self.change + 0.15 * (squared - self.change)).clamp(CHANGE.0, CHANGE.1);
        } else if trust >= 1.0 && self.observations > 2 {
            let pace = (1.0 / (self.observations as f64 - 1.0)).max(0.03);
            let bounded = squared.min(6.0 * self.noise);
            self.noise = (self.noise + pace * (bounded - self.noise)).clamp(NOISE.0, NOISE.1);
        }
        self.observations = self.observations.saturating_add(1);
        normalized
    }

    fn shares(&self, terms: &CostTerms) -> (f64, [f64; TERMS]) {
        let mut parts = [0.0f64; TERMS];
        let mut sum = 0.0;
        for i in 0..TERMS {
            let p = f64::from(terms.parts[i]);
            if p > 0.0 {
                parts[i] = p * libm::exp(self.theta[i]);
                sum += parts[i];
            } else if p.is_nan() {
                return (f64::NAN, parts);
            }
        }
        let inv = if sum > 0.0 { 1.0 / sum } else { 0.0 };
        (sum, parts.map(|p| p * inv))
    }

    fn model_variance(&self, shares: &[f64; TERMS]) -> f64 {
        let mut v = 0.0;
        for i in 0..TERMS {
            if shares[i] > 0.0 {
                for j in 0..TERMS {
                    v += shares[i] * self.covariance[i][j] * shares[j];
                }
            }
        }
        v.max(0.0)
    }

    fn widen(&mut self, common: f64, single: f64) {
        for i in 0..TERMS {
            for j in 0..TERMS {
                self.covariance[i][j] += common + if i == j { single } else { 0.0 };
            }
        }
    }

    /// Keeps the covariance symmetric, positive on its diagonal, and bounded.
    fn tidy(&mut self) {
        for i in 0..TERMS {
            for j in 0..i {
                let mean = 0.5 * (self.covariance[i][j] + self.covariance[j][i]);
                self.covariance[i][j] = mean;
                self.covariance[j][i] = mean;
            }
        }
        for i in 0..TERMS {
            let d = self.covariance[i][i];
            if d > MAX_VARIANCE {
                // Scaling row and column keeps correlations as they are.
                let s = libm::sqrt(MAX_VARIANCE / d);
                for j in 0..TERMS {
                    self.covariance[i][j] *= s;
                    self.covariance[j][i] *= s;
                }
            } else if d < 1.0e-9 {
                self.covariance[i][i] = 1.0e-9;
            }
        }
    }

    pub(crate) fn save(&self, w: &mut Writer<'_>) {
        w.f64s(&self.theta);
        for row in &self.covariance {
            w.f64s(row);
        }
        w.f64(self.noise);
        w.f64(self.change);
        w.u64(self.observations);
    }

    pub(crate) fn load(&mut self, r: &mut Reader<'_>) -> Result<()> {
        r.f64s(&mut self.theta, -THETA_LIMIT, THETA_LIMIT)?;
        for row in &mut self.covariance {
            r.f64s(row, -2.0 * MAX_VARIANCE, 2.0 * MAX_VARIANCE)?;
        }
        self.noise = r.f64(NOISE.0, NOISE.1)?;
        self.change = r.f64(CHANGE.0, CHANGE.1)?;
        self.observations = r.u64()?;
        self.run = 0;
        self.tidy();
        Ok(())
    }
}
