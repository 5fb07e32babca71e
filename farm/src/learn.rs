//! Expected times of tasks, corrected by measured ones.
//!
//! ln(seconds / base) of a task is modeled as x·β + u + ε: x are features of the task (logarithms of base,
//! pixels, step and distance, the view direction, its transfer function), β are their coefficients, u is an
//! effect of the task's volume, ε an error of the task. β and u have normal priors. The variances of u and ε
//! are estimated from the data by updates similar to REML. This is a mixed-effects model (Laird and Ware
//! 1982). The posterior is exact for given variances. Volumes are eliminated by a Schur complement, so a job
//! may have any number of them. The speed of a node is estimated from the mean residual of its tasks, which
//! is shrunk towards 0.

#![allow(clippy::needless_range_loop, reason = "loops over the terms read several arrays at once")]

use super::job::Job;
use entire_core::scene::Camera;
use entire_steer::numeric::{back, forward, solve};
use entire_steer::predict::PREDICTED_SECONDS;
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use rayon::prelude::*;

/// Number of features of a task without its transfer function: a constant, ln base, ln pixels, ln step, ln
/// distance, absolute x and y components of the view direction, and the squares of both.
const BASE_FEATURES: usize = 9;
/// Prior standard deviations of the coefficients of the [`BASE_FEATURES`] features.
const PRIOR: [f64; BASE_FEATURES] = [CONSTANT_SD_WITHOUT_MODEL, 0.1, 0.2, 0.2, 0.3, 0.2, 0.2, 0.2, 0.2];
/// Prior standard deviation of the constant (ln of a common factor) if no model file or list gives base
/// times.
const CONSTANT_SD_WITHOUT_MODEL: f64 = 4.0;
/// Prior standard deviation of the constant if a model file or list, perhaps of another machine, gives base
/// times.
pub const CONSTANT_SD_WITH_MODEL: f64 = 0.5;
/// Prior standard deviation of the coefficient of each transfer function.
const PRIOR_TRANSFER: f64 = 0.3;
/// Maximum number of transfer functions; with more of them, none has a coefficient.
const MAX_TRANSFERS: usize = 64;
/// Prior standard deviation of the residuals and of the volume effects, ln seconds; weight of this prior, as
/// a number of observations.
const PRIOR_SDS: (f64, f64) = (0.15, 4.0);
/// Prior standard deviation of the volume effects when a model or a list is given: nearly twice the largest
/// value of a shipped model on held-out volumes. The values are 0.00 to 0.04 on the tables local-timestep,
/// scatter-timestep, none-inside, none-earlier and none-steps-members of `data/timings` (predictions.csv of
/// `entire evaluate`).
const VOLUME_SD_WITH_MODEL: f64 = 0.07;
/// Prior standard deviation of the coefficient of ln(base) when a model or a list is given: the root mean
/// square of the slopes of ln(measured / base) over ln(base) on the tables of [`VOLUME_SD_WITH_MODEL`]. The
/// slope of none-earlier, frames of an earlier version of the renderer, is 0.08; the others are −0.004 to
/// 0.012.
const SLOPE_SD_WITH_MODEL: f64 = 0.04;
/// Decrease of ln of the residual's standard deviation per unit of ln base, with a model or list: long tasks
/// scatter less than short ones (0 on none-earlier, 0.11 to 0.26 on the other tables of
/// [`VOLUME_SD_WITH_MODEL`]). The second number is the distance of ln base from its mean up to which the
/// decrease applies.
const SCATTER_SLOPE_WITH_MODEL: (f64, f64) = (0.2, 4.0);
/// Number of standard deviations at which residuals are clipped: one hung task must not affect the others.
const HUBER: f64 = 4.0;
/// Maximum number of residuals that are kept for random draws.
const MAX_DRAWN_RESIDUALS: usize = 1024;

/// Returns the upper limit of a task's expected time, in seconds, which is the upper limit of any prediction.
/// Without this limit, a task list whose times have a wrong unit could give infinite expected times, which
/// JSON cannot hold.
fn longest() -> f64 {
    f64::from(*PREDICTED_SECONDS.end())
}

/// Returns a random number from the standard normal distribution (Box and Muller 1958).
pub(crate) fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let mut unit = || ((rng.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
    (-2.0 * unit().ln()).sqrt() * (std::f64::consts::TAU * unit()).cos()
}

/// Returns the probability that a standard normal number is below `x`.
fn normal_below(x: f64) -> f64 {
    0.5 * libm::erfc(-x * std::f64::consts::FRAC_1_SQRT_2)
}

/// Features of a job's tasks.
#[derive(Clone, Debug)]
pub struct Shape {
    /// ln of the base seconds, by task.
    base: Vec<f32>,
    volume: Vec<u32>,
    /// Index of each task's row in `terms`, which leaves out the base and the transfer function.
    row: Vec<u32>,
    transfer: Vec<u16>,
    terms: Vec<[f32; BASE_FEATURES]>,
    volumes: usize,
    transfers: usize,
    constant: f64,
}

impl Shape {
    /// Sets the prior standard deviation of the constant, which is ln of a common factor of the base seconds.
    pub fn with_constant(self, sd: f64) -> Self {
        Self { constant: sd, ..self }
    }

    /// True if the base seconds come from a model file or list, not from the analytic model or pixels / step.
    pub(crate) fn has_model(&self) -> bool {
        self.constant < CONSTANT_SD_WITHOUT_MODEL
    }

    /// Returns the features of a job's tasks. `base`: ln of the base seconds of every task.
    pub(crate) fn of_job(job: &Job, base: Vec<f32>) -> Self {
        let (sizes, steps) = (job.sizes.len(), job.steps.len());
        let mean = |values: &mut dyn Iterator<Item = f64>, n: usize| values.sum::<f64>() / n as f64;
        let pixels = |s: &[u32; 2]| (f64::from(s[0]) * f64::from(s[1])).ln();
        let mean_pixels = mean(&mut job.sizes.iter().map(pixels), sizes);
        let mean_step = mean(&mut job.steps.iter().map(|s| f64::from(*s).ln()), steps);
        let mean_dz = mean(&mut job.cameras.iter().map(|c| f64::from(c.dz).ln()), job.cameras.len());
        let mut terms = Vec::with_capacity(job.cameras.len() * sizes * steps);
        for camera in &job.cameras {
            let direction = Camera::from_arcball(*camera)
                .map(|c| c.ray_basis(2, 2).1[0].to_array().map(|v| f64::from(v.abs())))
                .unwrap_or([0.0; 3]);
            for size in &job.sizes {
                for step in &job.steps {
                    let [x, y, _] = direction;
                    terms.push(
                        [
                            1.0,
                            0.0,
                            pixels(size) - mean_pixels,
                            f64::from(*step).ln() - mean_step,
                            f64::from(camera.dz).ln() - mean_dz,
                            x - 0.5,
                            y - 0.5,
                            x * x - 0.4,
                            y * y - 0.4,
                        ]
                        .map(|v| v as f32),
                    );
                }
            }
        }
        let n = job.len();
        let (mut volume, mut row, mut transfer) =
            (Vec::with_capacity(n), Vec::with_capacity(n), Vec::with_capacity(n));
        // Tasks are in the order of `Job::place`.
        let per_camera = sizes * steps;
        for v in 0..job.volumes.len() {
            volume.resize(volume.len() + n / job.volumes.len(), v as u32);
            for camera in 0..job.cameras.len() {
                for t in 0..job.transfers.len() {
                    row.extend((camera * per_camera) as u32..((camera + 1) * per_camera) as u32);
                    transfer.resize(row.len(), t.min(u16::MAX as usize) as u16);
                }
            }
        }
        let transfers = job.transfers.len();
        let transfers = if (2..=MAX_TRANSFERS).contains(&transfers) { transfers } else { 0 };
        let (volumes, constant) = (job.volumes.len(), CONSTANT_SD_WITHOUT_MODEL);
        Self { base, volume, row, transfer, terms, volumes, transfers, constant }
    }

    /// Returns the features of tasks of which only base seconds and volume are known.
    pub fn of_volumes(base_seconds: &[f64], volume: &[usize]) -> Self {
        let base = base_seconds.iter().map(|s| s.max(1e-9).ln() as f32).collect();
        let volumes = volume.iter().max().map_or(1, |v| v + 1);
        let n = base_seconds.len();
        let mut terms = [0.0; BASE_FEATURES];
        terms[0] = 1.0;
        Self {
            base,
            volume: volume.iter().map(|v| *v as u32).collect(),
            row: vec![0; n],
            transfer: vec![0; n],
            terms: vec![terms],
            volumes,
            transfers: 0,
            constant: CONSTANT_SD_WITHOUT_MODEL,
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.base.len()
    }

    /// The volume of a task.
    pub fn volume(&self, task: usize) -> usize {
        self.volume[task] as usize
    }

    pub(crate) fn volumes(&self) -> usize {
        self.volumes
    }
}

#[derive(Clone, Copy, Debug)]
struct Seen {
    task: u32,
    node: u32,
    /// Natural logarithm of measured seconds / base seconds.
    y: f64,
}

/// The model of a job's times.
#[derive(Clone, Debug)]
pub struct Learner {
    shape: Shape,
    mean_base: f64,
    seen: Vec<Seen>,
    refit_at: usize,
    /// Number of observations in the fit.
    fitted: usize,
    beta: Vec<f64>,
    /// Lower triangular factor L of the precision of β, which is L·Lᵀ.
    factor: Vec<f64>,
    effects: Vec<f64>,
    /// Effective degrees of freedom of the nodes' speeds.
    used_nodes: f64,
    /// Precision of each volume's effect for a given β.
    precisions: Vec<f64>,
    /// Weighted sum of the features x over each volume's observations.
    sums: Vec<Vec<f64>>,
    /// Variance of ln(measured / expected) of a task.
    sigma2: f64,
    tau2: f64,
    drift: f64,
    nodes: Vec<f64>,
    residuals: Vec<f32>,
}

/// One random draw of all uncertain quantities except the tasks' own errors.
#[derive(Clone, Debug)]
pub(crate) struct Draw {
    beta: Vec<f64>,
    effects: Vec<f64>,
    drift: f64,
}

impl Learner {
    pub(crate) fn new(shape: Shape) -> Self {
        let d = BASE_FEATURES + shape.transfers;
        let mean_base = shape.base.iter().map(|b| f64::from(*b)).sum::<f64>() / shape.len().max(1) as f64;
        let volumes = shape.volumes;
        let before = if shape.has_model() { VOLUME_SD_WITH_MODEL } else { PRIOR_SDS.0 };
        let mut new = Self {
            shape,
            mean_base,
            seen: Vec::new(),
            refit_at: 1,
            used_nodes: 0.0,
            fitted: 0,
            beta: vec![0.0; d],
            factor: Vec::new(),
            effects: vec![0.0; volumes],
            precisions: Vec::new(),
            sums: Vec::new(),
            sigma2: PRIOR_SDS.0.powi(2),
            tau2: before.powi(2),
            drift: 0.0,
            nodes: Vec::new(),
            residuals: Vec::new(),
        };
        new.refit();
        new
    }

    /// Features of the tasks.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    pub(crate) fn observed(&self) -> usize {
        self.seen.len()
    }

    /// Speed of a node; 1 if it is unknown.
    pub(crate) fn speed(&self, node: usize) -> f64 {
        self.nodes.get(node).map_or(1.0, |o| (-o).exp())
    }

    /// Divisor of the standard deviation of a task's residual: above 1 for tasks longer than the mean, below
    /// 1 for shorter ones; 1 for all tasks without a model file or list.
    fn calm(&self, task: usize) -> f64 {
        if !self.shape.has_model() {
            return 1.0;
        }
        let (slope, most) = SCATTER_SLOPE_WITH_MODEL;
        (slope * (f64::from(self.shape.base[task]) - self.mean_base).clamp(-most, most)).exp()
    }

    fn x(&self, task: usize, out: &mut [f64]) {
        out.fill(0.0);
        let row = &self.shape.terms[self.shape.row[task] as usize];
        for k in 0..BASE_FEATURES {
            out[k] = f64::from(row[k]);
        }
        out[1] = f64::from(self.shape.base[task]) - self.mean_base;
        if self.shape.transfers > 0 {
            out[BASE_FEATURES + self.shape.transfer[task] as usize] = 1.0;
        }
    }

    fn log_of(&self, beta: &[f64], effects: &[f64], task: usize) -> f64 {
        let row = &self.shape.terms[self.shape.row[task] as usize];
        let mut sum = (f64::from(self.shape.base[task]) - self.mean_base) * beta[1];
        for k in 0..BASE_FEATURES {
            sum += f64::from(row[k]) * beta[k];
        }
        if self.shape.transfers > 0 {
            sum += beta[BASE_FEATURES + self.shape.transfer[task] as usize];
        }
        sum + effects[self.shape.volume(task)]
    }

    /// Expected seconds on a node of speed 1.
    pub fn seconds(&self, task: usize) -> f64 {
        let log = f64::from(self.shape.base[task]) + self.log_of(&self.beta, &self.effects, task);
        (log + 0.5 * self.sigma2 / self.calm(task).powi(2)).exp().min(longest())
    }

    pub(crate) fn all_seconds(&self) -> Vec<f32> {
        (0..self.shape.len()).into_par_iter().with_min_len(4096).map(|t| self.seconds(t) as f32).collect()
    }

    /// Adds an observed time. Returns true if the model was refitted, which changes the expected seconds.
    pub(crate) fn observe(&mut self, task: usize, node: usize, seconds: f64) -> bool {
        if !(seconds.is_finite() && seconds > 0.0) {
            return false;
        }
        let y = seconds.ln() - f64::from(self.shape.base[task]);
        self.seen.push(Seen { task: task as u32, node: node as u32, y });
        let due = self.seen.len() >= self.refit_at;
        if due {
            self.refit();
            self.refit_at = self.seen.len() + (self.seen.len() / 4).max(1);
        }
        due
    }

    /// True if the fit includes all observations.
    pub(crate) fn is_fresh(&self) -> bool {
        self.fitted == self.seen.len()
    }

    pub(crate) fn refit(&mut self) {
        let d = self.beta.len();
        let nodes = self.seen.iter().map(|s| s.node as usize + 1).max().unwrap_or(0);
        self.nodes.resize(nodes, 0.0);
        let mut x = vec![0.0; d];
        // Three rounds: the fit depends on the nodes' speeds and on the clipping, and both depend on the fit.
        for round in 0..if self.seen.is_empty() { 1 } else { 3 } {
            let clip = HUBER * self.sigma2.sqrt();
            let (mut xtx, mut xty, mut yy) = (vec![0.0; d * d], vec![0.0; d], 0.0);
            let mut counts = vec![0.0; self.shape.volumes];
            let mut sums = vec![vec![0.0; d]; self.shape.volumes];
            let mut sums_y = vec![0.0; self.shape.volumes];
            for s in &self.seen {
                let task = s.task as usize;
                let calm = self.calm(task);
                let weight = calm * calm;
                let mut y = s.y - self.nodes[s.node as usize];
                if round > 0 && self.seen.len() >= 30 {
                    let middle = self.log_of(&self.beta, &self.effects, task);
                    y = y.clamp(middle - clip / calm, middle + clip / calm);
                }
                self.x(task, &mut x);
                let used: Vec<usize> = (0..d).filter(|k| x[*k] != 0.0).collect();
                let v = self.shape.volume(task);
                for &i in &used {
                    xty[i] += weight * x[i] * y;
                    sums[v][i] += weight * x[i];
                    for &j in &used {
                        xtx[i * d + j] += weight * x[i] * x[j];
                    }
                }
                counts[v] += weight;
                sums_y[v] += weight * y;
                yy += weight * y * y;
            }
            self.solve(&xtx, &xty, yy, &counts, sums, &sums_y);
            self.fit_nodes();
        }
        self.keep_residuals();
        self.fitted = self.seen.len();
    }

    fn solve(
        &mut self,
        xtx: &[f64],
        xty: &[f64],
        yy: f64,
        counts: &[f64],
        sums: Vec<Vec<f64>>,
        sums_y: &[f64],
    ) {
        let d = self.beta.len();
        let n = self.seen.len() as f64;
        let constant = self.shape.constant;
        let has_model = self.shape.has_model();
        let sd = |k: usize| match k {
            0 => constant,
            1 if has_model => SLOPE_SD_WITH_MODEL,
            _ => PRIOR.get(k).copied().unwrap_or(PRIOR_TRANSFER),
        };
        let prior = |k: usize| sd(k).powi(2).recip();
        for _ in 0..if n > 0.0 { 12 } else { 1 } {
            let (s2, t2) = (self.sigma2, self.tau2);
            let precisions: Vec<f64> = counts.iter().map(|c| c / s2 + 1.0 / t2).collect();
            let mut a: Vec<f64> = xtx.iter().map(|v| v / s2).collect();
            let mut b: Vec<f64> = xty.iter().map(|v| v / s2).collect();
            for k in 0..d {
                a[k * d + k] += prior(k);
            }
            for v in (0..counts.len()).filter(|v| counts[*v] > 0.0) {
                let w = 1.0 / (s2 * s2 * precisions[v]);
                for i in (0..d).filter(|i| sums[v][*i] != 0.0) {
                    b[i] -= w * sums[v][i] * sums_y[v];
                    for j in 0..d {
                        a[i * d + j] -= w * sums[v][i] * sums[v][j];
                    }
                }
            }
            let Some(beta) = solve(&mut a, b) else { return };
            (self.beta, self.factor) = (beta, a);
            let dot = |x: &[f64]| x.iter().zip(&self.beta).map(|(a, b)| a * b).sum::<f64>();
            for v in 0..counts.len() {
                self.effects[v] = (sums_y[v] - dot(&sums[v])) / s2 / precisions[v];
            }
            if n > 0.0 {
                // Effective number of parameters: for β the trace of (precision⁻¹ · precision of the data),
                // for each volume its shrinkage factor.
                let mut used = 0.0;
                for k in 0..d {
                    let mut unit = vec![0.0; d];
                    unit[k] = 1.0;
                    let column = back(&self.factor, forward(&self.factor, unit));
                    used += 1.0 - (prior(k) * column[k]).min(1.0);
                }
                let mut used_volumes = 0.0;
                let (mut square, mut fit) = (yy - 2.0 * dot(xty), 0.0);
                for i in 0..d {
                    square += self.beta[i] * dot(&xtx[i * d..(i + 1) * d]);
                }
                for v in (0..counts.len()).filter(|v| counts[*v] > 0.0) {
                    let u = self.effects[v];
                    used_volumes += counts[v] / s2 / precisions[v];
                    square += u * (counts[v] * u - 2.0 * (sums_y[v] - dot(&sums[v])));
                    fit += u * u;
                }
                let (before, worth) = PRIOR_SDS;
                let free = (n - used - used_volumes - self.used_nodes).max(0.0);
                self.sigma2 = ((square.max(0.0) + worth * before * before) / (free + worth)).max(1e-8);
                let before = if has_model { VOLUME_SD_WITH_MODEL } else { before };
                self.tau2 = ((fit + worth * before * before) / (used_volumes + worth)).max(1e-8);
            }
            self.precisions = precisions;
        }
        self.sums = sums;
    }

    fn fit_nodes(&mut self) {
        let mut sums = vec![(0.0, 0.0); self.nodes.len()];
        let clip = HUBER * self.sigma2.sqrt();
        for s in &self.seen {
            let error = s.y - self.log_of(&self.beta, &self.effects, s.task as usize);
            let (node, calm) = (s.node as usize, self.calm(s.task as usize));
            let weight = calm * calm;
            let (low, high) = (self.nodes[node] - clip / calm, self.nodes[node] + clip / calm);
            sums[node].0 += weight * error.clamp(low, high);
            sums[node].1 += weight;
        }
        self.used_nodes = 0.0;
        if self.nodes.len() < 2 {
            return;
        }
        // Variance of the nodes' mean residuals that the errors of their tasks do not explain.
        let of_nodes: f64 =
            sums.iter().filter(|s| s.1 > 0.0).map(|(sum, n)| sum * sum / n - self.sigma2).sum();
        let variance = of_nodes / sums.iter().map(|s| s.1).sum::<f64>().max(1.0);
        let shrink = if variance > 0.0 { self.sigma2 / variance } else { f64::INFINITY };
        for (node, (sum, n)) in self.nodes.iter_mut().zip(&sums) {
            *node = sum / (n + shrink);
            self.used_nodes += n / (n + shrink);
        }
        // Speeds are relative: their mean is part of the constant.
        let known = sums.iter().filter(|s| s.1 > 0.0).count().max(1) as f64;
        let mean = self.nodes.iter().sum::<f64>() / known;
        for (node, (_, n)) in self.nodes.iter_mut().zip(&sums) {
            if *n > 0.0 {
                *node -= mean;
            }
        }
    }

    fn keep_residuals(&mut self) {
        let n = self.seen.len();
        let errors: Vec<f64> = self
            .seen
            .iter()
            .map(|s| {
                let middle = self.log_of(&self.beta, &self.effects, s.task as usize);
                (s.y - middle - self.nodes[s.node as usize]) * self.calm(s.task as usize)
            })
            .collect();
        let stride = n.div_ceil(MAX_DRAWN_RESIDUALS).max(1);
        self.residuals = errors.iter().step_by(stride).map(|e| *e as f32).collect();
        // Drift of the machine: the standard deviation of the mean residuals of consecutive eighths of the
        // tasks, after subtraction of the variance that the errors of the tasks explain.
        const PARTS: usize = 8;
        self.drift = 0.0;
        if n >= 4 * PARTS {
            let size = n / PARTS;
            let clip = HUBER * self.sigma2.sqrt();
            let means: Vec<f64> = errors
                .chunks_exact(size)
                .take(PARTS)
                .map(|part| part.iter().map(|e| e.clamp(-clip, clip)).sum::<f64>() / size as f64)
                .collect();
            let variance = means.iter().map(|m| m * m).sum::<f64>() / (PARTS - 1) as f64;
            let expected = self.sigma2 / size as f64;
            // If tasks are independent, the sum of the squared means divided by their variance has a χ²
            // distribution with 7 degrees of freedom. Drift is assumed only above its 0.95 quantile, 14.07.
            const DRIFT_LIMIT: f64 = 14.07 / (PARTS - 1) as f64;
            if variance > DRIFT_LIMIT * expected {
                self.drift = (variance - expected).sqrt();
            }
        }
    }

    /// Draws β; returns it and its difference from the mean.
    fn draw_beta(&self, rng: &mut ChaCha8Rng) -> (Vec<f64>, Vec<f64>) {
        let noise: Vec<f64> = (0..self.beta.len()).map(|_| normal(rng)).collect();
        let shift = back(&self.factor, noise);
        (self.beta.iter().zip(&shift).map(|(a, b)| a + b).collect(), shift)
    }

    pub(crate) fn draw(&self, rng: &mut ChaCha8Rng) -> Draw {
        let (beta, shift) = self.draw_beta(rng);
        let effects = (0..self.shape.volumes)
            .map(|v| {
                let along: f64 = self.sums[v].iter().zip(&shift).map(|(a, b)| a * b).sum();
                let mean = self.effects[v] - along / self.sigma2 / self.precisions[v];
                mean + normal(rng) / self.precisions[v].sqrt()
            })
            .collect();
        Draw { beta, effects, drift: self.drift * normal(rng) }
    }

    /// Seconds of a task in a draw, with a random error of the task.
    pub(crate) fn drawn_seconds(&self, draw: &Draw, task: usize, rng: &mut ChaCha8Rng) -> f64 {
        let calm = self.calm(task);
        let error = if self.residuals.len() >= 50 {
            let r = self.residuals[(rng.next_u64() % self.residuals.len() as u64) as usize];
            f64::from(r)
        } else {
            self.sigma2.sqrt() * normal(rng)
        };
        let log = self.log_of(&draw.beta, &draw.effects, task);
        (f64::from(self.shape.base[task]) + log + draw.drift + error / calm).exp().min(longest())
    }

    /// As [`Learner::drawn_seconds`], for a task that has run for `seconds` and is not finished. Returns a
    /// longer time, and the probability in this draw that the task takes longer than `seconds`.
    pub(crate) fn drawn_beyond(
        &self,
        draw: &Draw,
        task: usize,
        seconds: f64,
        rng: &mut ChaCha8Rng,
    ) -> (f64, f64) {
        let log =
            f64::from(self.shape.base[task]) + self.log_of(&draw.beta, &draw.effects, task) + draw.drift;
        let calm = self.calm(task);
        let least = (seconds.ln() - log) * calm;
        // Lower bound on the returned probability, since a task may hang for reasons outside the model.
        const MIN_PROBABILITY: f64 = 1e-3;
        let probable = if self.residuals.len() >= 50 {
            let beyond = self.residuals.iter().filter(|r| f64::from(**r) > least).count();
            beyond as f64 / self.residuals.len() as f64
        } else {
            1.0 - normal_below(least / self.sigma2.sqrt())
        };
        for _ in 0..64 {
            let drawn = self.drawn_seconds(draw, task, rng);
            if drawn > seconds {
                return (drawn, probable.max(MIN_PROBABILITY));
            }
        }
        // No draw was longer than `seconds`. The returned time exceeds `seconds` by a relative amount: half
        // of the standard deviation of ln(the task's time).
        (seconds * (1.0 + 0.5 * self.sigma2.sqrt() / calm), probable.max(MIN_PROBABILITY))
    }

    /// Upper bound at `level`, by random draws, on the total seconds of some tasks on a node of speed 1.
    pub fn upper(&self, tasks: &[u32], level: f64) -> f64 {
        const DRAWS: usize = 200;
        let mut rng = ChaCha8Rng::seed_from_u64(u64::from(tasks.first().copied().unwrap_or(0)));
        let stride = tasks.len().div_ceil(256).max(1);
        let share = tasks.len() as f64 / tasks.len().div_ceil(stride).max(1) as f64;
        let mut sums: Vec<f64> = (0..DRAWS)
            .map(|_| {
                let draw = self.draw_few(&mut rng, tasks, stride);
                let drawn = tasks.iter().step_by(stride);
                share * drawn.map(|t| self.drawn_seconds(&draw, *t as usize, &mut rng)).sum::<f64>()
            })
            .collect();
        sums.sort_by(f64::total_cmp);
        sums[((level * DRAWS as f64) as usize).min(DRAWS - 1)]
    }

    /// As [`Learner::draw`], but draws effects only for the volumes of every `stride`-th task in `tasks`.
    fn draw_few(&self, rng: &mut ChaCha8Rng, tasks: &[u32], stride: usize) -> Draw {
        let (beta, shift) = self.draw_beta(rng);
        let mut effects = self.effects.clone();
        let mut volumes: Vec<usize> =
            tasks.iter().step_by(stride).map(|t| self.shape.volume(*t as usize)).collect();
        volumes.sort_unstable();
        volumes.dedup();
        for v in volumes {
            let along: f64 = self.sums[v].iter().zip(&shift).map(|(a, b)| a * b).sum();
            effects[v] += normal(rng) / self.precisions[v].sqrt() - along / self.sigma2 / self.precisions[v];
        }
        Draw { beta, effects, drift: self.drift * normal(rng) }
    }
}

#[cfg(test)]
#[path = "learn_tests.rs"]
mod tests;
