//! Fits unit costs to timed frames.
//!
//! The model of a frame's seconds t is ln t = ln Σ c_i exp(θ_i) w_i + b:
//!
//! * w_i is the estimated work of kind i, c_i its prior unit cost, and θ_i the fitted logarithm of a factor
//!   on c_i, with a normal prior of mean 0 and a standard deviation for each cost.
//! * b is ln of a factor common to all frames. It has no prior.
//!
//! Errors of ln t are assumed to be normally distributed, with the standard deviation [`NOISE`]. For errors
//! beyond twice their robust standard deviation, the loss is linear (Huber). With this regularization, three
//! frames determine the speed, ten frames the kinds of work that differ most, and hundreds of frames every
//! cost. Costs stay positive. So no prediction falls with a finer step.

use super::COSTS;
use crate::numeric::{dot, median, solve};
use alloc::vec;
use alloc::vec::Vec;

/// Prior standard deviation of the logarithm of a unit cost, apart from the common speed.
pub(crate) const COST_SD: f64 = 0.4;

/// Assumed standard deviation of ln(measured seconds) about the model.
const NOISE: f64 = 0.06;

/// Exponent of a frame's time in the weight of the frame: long frames get a larger weight, since they
/// dominate the root mean square error.
const IMPORTANCE: f64 = 0.25;

/// Largest number of Gauss-Newton iterations.
const ROUNDS: usize = 20;

/// Share of a Gauss-Newton step below which the step is not halved again.
const LEAST_SHARE: f64 = 0.02;

/// A timed frame.
pub(crate) struct FitRow {
    /// Estimated work: 1, then the counts of `COST_QUANTITIES`.
    pub(crate) work: [f64; COSTS],
    /// Natural logarithm of the measured seconds.
    pub(crate) log: f64,
}

/// Fitted parameters: the unit costs c_i exp(θ_i) in seconds, and b.
pub(crate) struct CostFit {
    pub(crate) costs: [f64; COSTS],
    pub(crate) bias: f64,
}

impl CostFit {
    /// Returns the parameters fitted to the rows. `prior` holds the unit costs of the prior in seconds (costs
    /// of 0 stay 0), `cost_sd` the standard deviations of their logarithms.
    pub(crate) fn new(prior: &[f64; COSTS], cost_sd: &[f64; COSTS], rows: &[&FitRow]) -> Self {
        let active: Vec<usize> =
            (0..COSTS).filter(|&i| prior[i] > 0.0 && rows.iter().any(|f| f.work[i] > 0.0)).collect();
        let k = active.len();
        let m = k + 1;
        let mut fitted = Self { costs: *prior, bias: 0.0 };
        let mut rest: Vec<f64> = rows.iter().map(|f| f.log - fitted.log_seconds(f)).collect();
        fitted.bias = median(&mut rest).unwrap_or(0.0);
        let importance: Vec<f64> = rows.iter().map(|f| libm::exp(IMPORTANCE * f.log)).collect();
        let mean = importance.iter().sum::<f64>() / rows.len() as f64;
        let mut theta = vec![0.0; k];
        let mut jacobian = vec![0.0; m];
        for round in 0..ROUNDS {
            let residuals: Vec<f64> = rows.iter().map(|f| f.log - fitted.log_seconds(f)).collect();
            let mut sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
            let limit = (2.0 * 1.4826 * median(&mut sizes).unwrap_or(0.0)).max(0.5 * NOISE);
            let (mut gram, mut rhs) = (vec![0.0; m * m], vec![0.0; m]);
            for ((f, r), w) in rows.iter().zip(&residuals).zip(&importance) {
                let estimate = dot(&fitted.costs, &f.work);
                for (slot, &i) in jacobian.iter_mut().zip(&active) {
                    *slot = fitted.costs[i] * f.work[i] / estimate;
                }
                jacobian[k] = 1.0;
                let robust = if r.abs() <= limit { 1.0 } else { limit / r.abs() };
                let weight = robust * w / mean / (NOISE * NOISE);
                for i in 0..m {
                    let scaled = weight * jacobian[i];
                    rhs[i] += scaled * r;
                    for (g, j) in gram[i * m..i * m + i + 1].iter_mut().zip(&jacobian) {
                        *g += scaled * j;
                    }
                }
            }
            for (i, t) in theta.iter().enumerate() {
                let precision = 1.0 / (cost_sd[active[i]] * cost_sd[active[i]]);
                gram[i * m + i] += precision;
                rhs[i] -= precision * t;
            }
            gram[m * m - 1] += 1e-6;
            let Some(step) = solve(&mut gram, rhs) else { break };
            // The step is shortened so that it changes no cost by more than a factor of e. It is then halved
            // while it makes the fit worse.
            let loss = |fit: &Self, theta: &[f64]| -> f64 {
                let of_rows: f64 = rows
                    .iter()
                    .zip(&importance)
                    .map(|(f, w)| {
                        let size = (f.log - fit.log_seconds(f)).abs();
                        let huber = if size <= limit { size * size } else { limit * (2.0 * size - limit) };
                        huber * w / mean / (NOISE * NOISE)
                    })
                    .sum();
                let of_costs = theta.iter().zip(&active).map(|(t, &i)| (t / cost_sd[i]) * (t / cost_sd[i]));
                of_rows + of_costs.sum::<f64>()
            };
            let before = loss(&fitted, &theta);
            let largest = step.iter().fold(0.0, |a: f64, s| a.max(s.abs()));
            let mut share = (1.0 / largest).min(1.0);
            loop {
                let mut next = Self { costs: fitted.costs, bias: fitted.bias };
                let mut moved = theta.clone();
                for ((t, s), &i) in moved.iter_mut().zip(&step).zip(&active) {
                    *t = (*t + share * s).clamp(-6.0, 6.0);
                    next.costs[i] = prior[i] * libm::exp(*t);
                }
                next.bias += share * step[k];
                if loss(&next, &moved) <= before {
                    (fitted, theta) = (next, moved);
                    break;
                }
                if share < LEAST_SHARE {
                    return fitted;
                }
                share *= 0.5;
            }
            if round > 1 && share * largest < 1e-4 {
                break;
            }
        }
        fitted
    }

    /// Returns ln(predicted seconds) of a frame.
    pub(crate) fn log_seconds(&self, row: &FitRow) -> f64 {
        libm::log(dot(&self.costs, &row.work).max(1e-12)) + self.bias
    }

    /// Returns the fitted unit costs in seconds, multiplied by the factor common to all frames.
    pub(crate) fn unit_costs(&self) -> [f64; COSTS] {
        self.costs.map(|c| c * libm::exp(self.bias))
    }
}
