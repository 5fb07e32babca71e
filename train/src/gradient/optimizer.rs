//! One step of training: gradients over the batch in parallel, clipping, Adam, the cosine learning rate.

use super::matmul::vectorized;
use super::network::{Network, Pass};
use super::{Loss, Real};
use anyhow::{Result, bail, ensure};
use rayon::ThreadPool;
use rayon::prelude::*;

/// Adam's decay of the first moment (paper, supplement "Implementation").
const ADAM_BETA1: f64 = 0.9;
/// Adam's decay of the second moment (paper, supplement "Implementation").
const ADAM_BETA2: f64 = 0.999;
/// Number that is added to the root of Adam's second moment.
const ADAM_EPSILON: f64 = 1e-8;

/// Smallest number of rows of a task, if the batch has as many. Tasks do not depend on the number of threads,
/// so results do not depend on it either.
const ROWS_PER_TASK: usize = 64;
/// Maximum number of tasks into which a batch is divided.
const MAX_TASKS: usize = 16;
/// Number of parameters that one task sums or updates.
const PARAMETERS_PER_TASK: usize = 8192;

/// Returns the learning rate after `step` of `steps` steps: a half cosine from `first` to `last`.
pub fn cosine_learning_rate(first: f64, last: f64, step: u64, steps: u64) -> f64 {
    let t = if steps == 0 { 1.0 } else { (step as f64 / steps as f64).min(1.0) };
    last + 0.5 * (first - last) * (1.0 + libm::cos(std::f64::consts::PI * t))
}

/// Result of one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Mean loss over the batch, before the step.
    pub loss: f64,
    /// Norm of the whole gradient, before clipping.
    pub gradient_norm: f64,
}

/// A network in training.
#[derive(Debug)]
pub struct Trainer<T> {
    network: Network<T>,
    loss: Loss,
    clip_norm: f64,
    first_moment: Vec<T>,
    second_moment: Vec<T>,
    steps: i32,
    tasks: Vec<Pass<T>>,
    gradient: Vec<T>,
}

impl<T: Real> Trainer<T> {
    /// Starts training a network. `clip_norm` is the largest norm of the whole gradient; infinity for no
    /// clipping.
    ///
    /// # Errors
    /// When the network has more than one output, or a setting is out of range.
    pub fn new(network: Network<T>, loss: Loss, clip_norm: f64) -> Result<Self> {
        loss.check()?;
        if network.widths().last() != Some(&1) {
            bail!("the network's layer widths are {:?}; the last must be 1 (seconds)", network.widths());
        }
        if clip_norm.is_nan() || clip_norm <= 0.0 {
            bail!(
                "gradient clipping norm is {clip_norm}; it must be positive. Infinity stands for no clipping"
            );
        }
        let n = network.parameters().len();
        Ok(Self {
            network,
            loss,
            clip_norm,
            first_moment: vec![T::zero(); n],
            second_moment: vec![T::zero(); n],
            steps: 0,
            tasks: Vec::new(),
            gradient: vec![T::zero(); n],
        })
    }

    /// The current network.
    pub fn network(&self) -> &Network<T> {
        &self.network
    }

    /// Gradient of the last step's mean loss, before clipping.
    pub fn gradient(&self) -> &[T] {
        &self.gradient
    }

    /// Computes loss and gradient over a batch, without a step. `inputs`: [rows, width] by rows, with one
    /// target per row. The result has the same bits for any number of threads.
    ///
    /// # Errors
    /// When the numbers of inputs and targets do not fit together, or are 0.
    pub fn evaluate(&mut self, pool: &ThreadPool, inputs: &[T], targets: &[T]) -> Result<Step> {
        let (width, rows) = (self.network.widths()[0], targets.len());
        ensure!(
            rows > 0 && inputs.len() == rows * width,
            "batch of {} inputs and {rows} targets; {width} inputs and 1 target per row are needed",
            inputs.len()
        );
        let count = (rows / ROWS_PER_TASK).clamp(1, MAX_TASKS);
        let bounds = |task: usize| task * rows / count..(task + 1) * rows / count;
        let same = self.tasks.len() == count && (0..count).all(|t| self.tasks[t].rows == bounds(t).len());
        if !same {
            self.tasks = (0..count).map(|t| Pass::new(&self.network, bounds(t).len(), true)).collect();
        }
        let (network, loss) = (&self.network, self.loss);
        let share = T::one() / T::of(rows as f64);
        let tasks = &mut self.tasks;
        let gradient = &mut self.gradient;
        pool.install(|| {
            let losses: Vec<f64> = tasks
                .par_iter_mut()
                .enumerate()
                .map(|(t, pass)| {
                    let range = bounds(t);
                    let x = &inputs[range.start * width..range.end * width];
                    pass.forward(network, x);
                    let mut total = 0.0;
                    let delta: Vec<T> = pass
                        .output()
                        .iter()
                        .zip(&targets[range])
                        .map(|(&y, &t)| {
                            let (value, slope) = loss.value_and_slope(y, t);
                            total += value.wide();
                            slope * share
                        })
                        .collect();
                    pass.backward(network, x, &delta);
                    total
                })
                .collect();
            let squares: Vec<f64> = gradient
                .par_chunks_mut(PARAMETERS_PER_TASK)
                .enumerate()
                .map(|(block, out)| {
                    let start = block * PARAMETERS_PER_TASK;
                    let end = start + out.len();
                    out.copy_from_slice(&tasks[0].gradient[start..end]);
                    vectorized(|| {
                        for pass in &tasks[1..] {
                            for (sum, g) in out.iter_mut().zip(&pass.gradient[start..end]) {
                                *sum += *g;
                            }
                        }
                        sum_of_squares(out)
                    })
                })
                .collect();
            Ok(Step {
                loss: losses.iter().sum::<f64>() / rows as f64,
                gradient_norm: libm::sqrt(squares.iter().sum()),
            })
        })
    }

    /// Does one step on a batch: gradient, clipping by its global norm, Adam with the given learning rate. If
    /// the gradient is not finite, the batch changes nothing, and the norm in the returned [`Step`] is not
    /// finite.
    ///
    /// # Errors
    /// When the numbers of inputs and targets do not fit together, or are 0.
    pub fn step(
        &mut self,
        pool: &ThreadPool,
        inputs: &[T],
        targets: &[T],
        learning_rate: f64,
    ) -> Result<Step> {
        let step = self.evaluate(pool, inputs, targets)?;
        if !step.gradient_norm.is_finite() {
            return Ok(step);
        }
        self.steps = self.steps.saturating_add(1);
        let clip = T::of((self.clip_norm / (step.gradient_norm + 1e-6)).min(1.0));
        let correction1 = 1.0 - libm::pow(ADAM_BETA1, self.steps.into());
        let correction2 = T::of(libm::sqrt(1.0 - libm::pow(ADAM_BETA2, self.steps.into())));
        let rate = T::of(learning_rate / correction1);
        let (b1, b2, epsilon) = (T::of(ADAM_BETA1), T::of(ADAM_BETA2), T::of(ADAM_EPSILON));
        let (c1, c2) = (T::of(1.0 - ADAM_BETA1), T::of(1.0 - ADAM_BETA2));
        let gradient = &self.gradient;
        pool.install(|| {
            self.network
                .parameters
                .par_chunks_mut(PARAMETERS_PER_TASK)
                .zip(self.first_moment.par_chunks_mut(PARAMETERS_PER_TASK))
                .zip(self.second_moment.par_chunks_mut(PARAMETERS_PER_TASK))
                .zip(gradient.par_chunks(PARAMETERS_PER_TASK))
                .for_each(|(((p, m), v), g)| {
                    vectorized(|| {
                        for (((p, m), v), g) in p.iter_mut().zip(m).zip(v).zip(g) {
                            let g = *g * clip;
                            *m = b1 * *m + c1 * g;
                            *v = b2 * *v + c2 * g * g;
                            *p -= rate * *m / (v.sqrt() / correction2 + epsilon);
                        }
                    });
                });
        });
        Ok(step)
    }

    /// Returns the mean loss over rows, without gradients; `None` without rows.
    pub(crate) fn validate(&self, pool: &ThreadPool, inputs: &[T], targets: &[T]) -> Option<f64> {
        let outputs = predict(pool, &self.network, inputs);
        let losses = outputs.iter().zip(targets).map(|(&y, &t)| self.loss.value_and_slope(y, t).0.wide());
        (!targets.is_empty()).then(|| losses.sum::<f64>() / targets.len() as f64)
    }
}

/// Returns the outputs of a network with one output for rows of inputs, computed in parallel.
pub(crate) fn predict<T: Real>(pool: &ThreadPool, network: &Network<T>, inputs: &[T]) -> Vec<T> {
    const ROWS: usize = 256;
    let width = network.widths()[0];
    pool.install(|| {
        inputs
            .par_chunks(ROWS * width)
            .flat_map_iter(|x| {
                let mut pass = Pass::new(network, x.len() / width, false);
                pass.forward(network, x);
                pass.output().to_vec()
            })
            .collect()
    })
}

/// Returns Σ x², computed in eight running sums, so that the compiler vectorizes the loop.
#[inline(always)]
fn sum_of_squares<T: Real>(values: &[T]) -> f64 {
    let mut sums = [0.0f64; 8];
    let chunks = values.chunks_exact(8);
    let rest: f64 = chunks.remainder().iter().map(|v| v.wide() * v.wide()).sum();
    for chunk in chunks {
        for (s, v) in sums.iter_mut().zip(chunk) {
            *s += v.wide() * v.wide();
        }
    }
    sums.iter().sum::<f64>() + rest
}
