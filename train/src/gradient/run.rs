//! A whole training run: standardization, shuffled mini-batches, validation, early stopping, the best
//! weights.

use super::optimizer::{cosine_learning_rate, predict};
use super::{Loss, Network, Trainer};
use anyhow::{Result, bail, ensure};
use entire_core::nn::{DenseParts, Dtype, Normalization, PredNetParts, Target};
use entire_steer::predict::LONGEST_FRAME;
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use rayon::ThreadPool;
use std::ops::ControlFlow;

/// Returns the training target for the seconds of a frame.
fn target_of(target: Target, seconds: f64) -> f64 {
    match target {
        Target::Seconds => seconds,
        Target::LogSeconds => libm::log(seconds),
    }
}

/// Returns the seconds for a training target: the inverse of [`target_of`].
fn seconds_of(target: Target, value: f64) -> f64 {
    match target {
        Target::Seconds => value,
        Target::LogSeconds => libm::exp(value),
    }
}

/// Frames for training or validation.
#[derive(Clone, Copy, Debug)]
pub struct Samples<'a> {
    /// One row per frame, [frames, width] by rows. The columns have the order of the model's input groups;
    /// the values are not standardized.
    pub inputs: &'a [f32],
    /// Seconds of each frame, finite and positive.
    pub seconds: &'a [f64],
}

impl Samples<'_> {
    fn check(&self, what: &str, width: usize) -> Result<()> {
        ensure!(
            self.inputs.len() == self.seconds.len() * width,
            "{what}: {} inputs for {} frames; {width} per frame are needed",
            self.inputs.len(),
            self.seconds.len()
        );
        if let Some(i) = self.inputs.iter().position(|v| !v.is_finite()) {
            bail!(
                "{what}: input {} of frame {} is {}; inputs must be finite",
                i % width,
                i / width,
                self.inputs[i]
            );
        }
        let longest = f64::from(LONGEST_FRAME);
        if let Some(i) = self.seconds.iter().position(|t| !(*t > 0.0 && *t <= longest)) {
            bail!(
                "{what}: frame {i} took {} seconds; times must be positive and at most {longest}: check \
                 their unit, or leave the frame out",
                self.seconds[i]
            );
        }
        Ok(())
    }
}

/// Settings of a run. The defaults are those of the paper, except the batch size 256 and the patience 50,
/// which the paper does not state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Maximum number of passes over the training frames.
    pub epochs: usize,
    /// Number of frames per training step.
    pub batch: usize,
    /// Learning rate at the start.
    pub learning_rate: f64,
    /// Learning rate at the end of the last epoch. From step to step, the rate falls along half a cosine.
    pub final_learning_rate: f64,
    /// Largest norm of the whole gradient.
    pub clip_norm: f64,
    /// Number of successive epochs without a lower validation loss after which training stops.
    pub patience: usize,
    /// Loss function.
    pub loss: Loss,
    /// Output quantity of the network.
    pub target: Target,
    /// Seed of the order of the frames.
    pub seed: u64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            epochs: 200,
            batch: 256,
            learning_rate: 1e-4,
            final_learning_rate: 1e-6,
            clip_norm: 1.0,
            patience: 50,
            loss: Loss::SquaredError,
            target: Target::Seconds,
            seed: 1,
        }
    }
}

impl Settings {
    pub(crate) fn check(&self) -> Result<()> {
        for (name, value) in [("epochs", self.epochs), ("batch", self.batch), ("patience", self.patience)] {
            ensure!(value > 0, "{name} is 0; it must be at least 1");
        }
        let (first, last) = (self.learning_rate, self.final_learning_rate);
        ensure!(
            first.is_finite() && first > 0.0 && last.is_finite() && last >= 0.0,
            "learning rate goes from {first} to {last}; both must be finite, the first positive, the \
                 last not negative"
        );
        self.loss.check()
    }
}

/// Standardization x ← (x − mean) / std of the inputs and of the target, as in the model file. Means and
/// standard deviations are those of the training frames; the deviation of a value that never changes is 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Standardization {
    /// Standardization of each input.
    pub input: Normalization,
    /// Standardization of the target: one mean and one standard deviation.
    pub output: Normalization,
}

impl Standardization {
    /// Returns the standardization fitted to the training frames.
    pub fn fit(samples: Samples<'_>, width: usize, target: Target) -> Self {
        let n = samples.seconds.len().max(1) as f64;
        let mut mean = vec![0.0f64; width];
        for row in samples.inputs.chunks_exact(width) {
            for (m, x) in mean.iter_mut().zip(row) {
                *m += f64::from(*x) / n;
            }
        }
        let mut variance = vec![0.0f64; width];
        for row in samples.inputs.chunks_exact(width) {
            for ((v, x), m) in variance.iter_mut().zip(row).zip(&mean) {
                *v += (f64::from(*x) - m) * (f64::from(*x) - m) / n;
            }
        }
        let targets = samples.seconds.iter().map(|&t| target_of(target, t));
        let output_mean = targets.clone().sum::<f64>() / n;
        let output_variance = targets.map(|y| (y - output_mean) * (y - output_mean)).sum::<f64>() / n;
        let std = variance.iter().zip(&mean).map(|(v, m)| deviation(*v, *m)).collect();
        let input = Normalization { mean: mean.iter().map(|m| *m as f32).collect(), std };
        let std = vec![deviation(output_variance, output_mean)];
        Self { input, output: Normalization { mean: vec![output_mean as f32], std } }
    }

    /// Returns the standardization of a model; the identity if the model has none.
    pub fn of(parts: &PredNetParts) -> Self {
        let identity = |width: usize| Normalization { mean: vec![0.0; width], std: vec![1.0; width] };
        let width = parts.layers.first().map_or(0, |layer| layer.inputs);
        Self {
            input: parts.input.clone().unwrap_or_else(|| identity(width)),
            output: parts.output.clone().unwrap_or_else(|| identity(1)),
        }
    }

    /// Returns rows of inputs, standardized.
    pub fn inputs(&self, inputs: &[f32]) -> Vec<f32> {
        let Normalization { mean, std } = &self.input;
        inputs
            .chunks_exact(mean.len())
            .flat_map(|row| row.iter().zip(mean).zip(std))
            .map(|((x, m), s)| ((f64::from(*x) - f64::from(*m)) / f64::from(*s)) as f32)
            .collect()
    }

    /// Returns mean and standard deviation of the target.
    fn target(&self) -> (f64, f64) {
        (f64::from(self.output.mean[0]), f64::from(self.output.std[0]))
    }

    fn check(&self, width: usize) -> Result<()> {
        for (part, count, of) in [(&self.input, width, "inputs"), (&self.output, 1, "target")] {
            let [means, deviations] = [part.mean.len(), part.std.len()];
            ensure!(
                means == count && deviations == count,
                "standardization has {means} means and {deviations} deviations; {count} of each are needed \
                 ({of})"
            );
            let finite = part.mean.iter().chain(&part.std).all(|v| v.is_finite());
            ensure!(
                finite && part.std.iter().all(|s| *s > 0.0),
                "standardization holds a mean that is not finite or a deviation that is not positive"
            );
        }
        Ok(())
    }
}

/// Returns the square root of a variance, or 1 if the variance is only rounding noise.
fn deviation(variance: f64, mean: f64) -> f32 {
    let deviation = libm::sqrt(variance);
    if deviation > 1e-7 * mean.abs() && deviation > 1e-30 { deviation as f32 } else { 1.0 }
}

/// Returns the layer widths of a paper preset such as `12C256`: inputs → 256, 12 × (256 → 256), then halved
/// down to 16, then 1 (paper, section "Architecture"). Up to 1000 layers are accepted, and as width any power
/// of two from 32 to 65 536.
///
/// # Errors
/// For any other text.
pub fn preset_widths(preset: &str, inputs: usize) -> Result<Vec<usize>> {
    let parts = preset.split_once(['C', 'c']).and_then(|(n, w)| Some((n.parse().ok()?, w.parse().ok()?)));
    let Some((layers, width)): Option<(usize, usize)> = parts
        .filter(|&(n, w): &(usize, usize)| n <= 1000 && (32..=65_536).contains(&w) && w.is_power_of_two())
    else {
        bail!(
            "preset {preset:?}; <layers>C<width> is expected, as in 12C256: at most 1000 layers, width a \
             power of two from 32 to 65536"
        );
    };
    let mut widths = vec![inputs];
    widths.extend(std::iter::repeat_n(width, layers + 1));
    widths.extend(std::iter::successors(Some(width / 2), |w| Some(w / 2)).take_while(|w| *w >= 16));
    widths.push(1);
    Ok(widths)
}

/// Losses of one epoch, in squared standard deviations of the target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EpochRecord {
    /// Number of the epoch, from 1.
    pub epoch: usize,
    /// Mean loss over the epoch's batches, each evaluated before its step.
    pub training_loss: f64,
    /// Loss of the validation frames after the epoch; the training loss if there are no such frames.
    pub validation_loss: f64,
}

/// State of the training, given to the callback after every step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Maximum number of epochs.
    pub epochs: usize,
    /// Number of training steps done in all epochs.
    pub steps: u64,
    /// Maximum number of steps, over all epochs.
    pub total_steps: u64,
    /// Record of the epoch that ended with this step; `None` if it was not the last step of an epoch.
    pub ended: Option<EpochRecord>,
    /// Best validation loss so far; infinity before the first epoch's end.
    pub best: f64,
}

/// Reason for the end of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Stop {
    /// All epochs were finished.
    Finished,
    /// The validation loss stopped falling.
    Early,
    /// The callback stopped the run.
    Interrupted,
    /// A loss or a gradient was not finite: the learning rate is too high.
    Diverged,
}

/// Result of a run.
#[derive(Clone, Debug)]
pub struct Trained {
    /// The weights with the lowest validation loss; with the lowest training loss if there are no validation
    /// frames.
    pub network: Network<f32>,
    /// Standardization, stored with the weights.
    pub standardization: Standardization,
    /// Output quantity of the network.
    pub target: Target,
    /// Records of the epochs that ended.
    pub history: Vec<EpochRecord>,
    /// Epoch in which training reached the weights of `network`; 0 for the initial weights.
    pub best_epoch: usize,
    /// Validation loss of `network`; its training loss if there are no validation frames.
    pub best_loss: f64,
    /// Reason for the end of the run.
    pub stop: Stop,
}

impl Trained {
    /// Returns the contents of a model file, with weights as F32.
    pub fn to_parts(&self) -> PredNetParts {
        PredNetParts {
            layers: (0..self.network.layers())
                .map(|i| {
                    let (weight, bias) = self.network.layer(i);
                    let [inputs, outputs] = [self.network.widths()[i], self.network.widths()[i + 1]];
                    let [weight, bias] = [weight, bias].map(<[f32]>::to_vec);
                    DenseParts { inputs, outputs, weight, bias, dtype: Dtype::F32 }
                })
                .collect(),
            input: Some(self.standardization.input.clone()),
            output: Some(self.standardization.output.clone()),
            target: self.target,
        }
    }

    /// Returns the predicted seconds of each row of inputs (not standardized), computed in parallel.
    ///
    /// # Errors
    /// When the number of inputs is not a multiple of the row length.
    pub fn predict(&self, pool: &ThreadPool, inputs: &[f32]) -> Result<Vec<f64>> {
        let width = self.network.widths()[0];
        if !inputs.len().is_multiple_of(width) {
            bail!("the number of inputs, {}, is not a multiple of the row length {width}", inputs.len());
        }
        let (mean, std) = self.standardization.target();
        let outputs = predict(pool, &self.network, &self.standardization.inputs(inputs));
        Ok(outputs.into_iter().map(|y| seconds_of(self.target, f64::from(y) * std + mean)).collect())
    }
}

struct Prepared {
    inputs: Vec<f32>,
    targets: Vec<f32>,
}

fn prepare(samples: Samples<'_>, s: &Standardization, settings: &Settings) -> Prepared {
    let (mean, std) = s.target();
    let target = |&t: &f64| ((target_of(settings.target, t) - mean) / std) as f32;
    Prepared { inputs: s.inputs(samples.inputs), targets: samples.seconds.iter().map(target).collect() }
}

/// Trains a network (random, or given to be fine-tuned) and returns the weights with the lowest validation
/// loss.
///
/// `standardization` is fitted to the training frames if it is `None`; a fine-tuned model has its own.
/// Without validation frames, the lowest training loss decides. `progress` is called after every step and
/// stops the run by [`ControlFlow::Break`]; the weights at this moment are then also candidates for the best.
///
/// # Errors
/// When a setting is out of range, an input or a time is invalid, there are no training frames, or
/// sizes do not fit.
pub fn train(
    pool: &ThreadPool,
    network: Network<f32>,
    standardization: Option<Standardization>,
    training: Samples<'_>,
    validation: Samples<'_>,
    settings: &Settings,
    mut progress: impl FnMut(&Progress) -> ControlFlow<()>,
) -> Result<Trained> {
    settings.check()?;
    let width = network.widths()[0];
    training.check("training frames", width)?;
    validation.check("validation frames", width)?;
    let frames = training.seconds.len();
    ensure!(frames > 0, "there are no training frames");
    let standardization = match standardization {
        Some(given) => {
            given.check(width)?;
            given
        }
        None => Standardization::fit(training, width, settings.target),
    };
    let data = prepare(training, &standardization, settings);
    let judged = prepare(validation, &standardization, settings);
    let mut trainer = Trainer::new(network, settings.loss, settings.clip_norm)?;

    let batch = settings.batch.min(frames);
    let steps_per_epoch = frames.div_ceil(batch);
    let total_steps = (settings.epochs as u64).saturating_mul(steps_per_epoch as u64);
    let mut order: Vec<usize> = (0..frames).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(settings.seed ^ 0x5348_5546_464c_4521);
    let mut inputs: Vec<f32> = Vec::with_capacity(batch * width);
    let mut targets: Vec<f32> = Vec::with_capacity(batch);

    let mut best = trainer.network().clone();
    let (mut best_loss, mut best_epoch) = (f64::INFINITY, 0);
    let mut history = Vec::new();
    let mut steps = 0u64;
    let mut stop = Stop::Finished;
    'epochs: for epoch in 1..=settings.epochs {
        shuffle(&mut order, &mut rng);
        let mut total = 0.0;
        for (at, chosen) in order.chunks(batch).enumerate() {
            inputs.clear();
            targets.clear();
            for &i in chosen {
                inputs.extend_from_slice(&data.inputs[i * width..(i + 1) * width]);
                targets.push(data.targets[i]);
            }
            let (first, last) = (settings.learning_rate, settings.final_learning_rate);
            let rate = cosine_learning_rate(first, last, steps, total_steps);
            let step = trainer.step(pool, &inputs, &targets, rate)?;
            steps += 1;
            total += step.loss * chosen.len() as f64;
            if !(step.loss.is_finite() && step.gradient_norm.is_finite()) {
                stop = Stop::Diverged;
                break 'epochs;
            }
            let last = at + 1 == steps_per_epoch;
            let mut told =
                Progress { epochs: settings.epochs, steps, total_steps, ended: None, best: best_loss };
            if !last {
                if progress(&told).is_break() {
                    stop = Stop::Interrupted;
                    let validation = trainer.validate(pool, &judged.inputs, &judged.targets);
                    let loss = validation.unwrap_or(total / ((at + 1) * batch) as f64);
                    if loss < best_loss {
                        (best_loss, best_epoch) = (loss, epoch);
                        best = trainer.network().clone();
                    }
                    break 'epochs;
                }
                continue;
            }
            let training_loss = total / frames as f64;
            let validation = trainer.validate(pool, &judged.inputs, &judged.targets);
            let validation_loss = validation.unwrap_or(training_loss);
            let record = EpochRecord { epoch, training_loss, validation_loss };
            history.push(record);
            // The training loss does not cover the weights after the epoch's last step, so these weights are
            // checked separately.
            let finite = trainer.network().parameters().iter().all(|p| p.is_finite());
            if !(validation_loss.is_finite() && finite) {
                stop = Stop::Diverged;
                break 'epochs;
            }
            if validation_loss < best_loss {
                (best_loss, best_epoch) = (validation_loss, epoch);
                best = trainer.network().clone();
            }
            told.ended = Some(record);
            told.best = best_loss;
            if progress(&told).is_break() {
                stop = Stop::Interrupted;
                break 'epochs;
            }
            if epoch - best_epoch >= settings.patience && epoch < settings.epochs {
                stop = Stop::Early;
                break 'epochs;
            }
        }
    }
    let target = settings.target;
    Ok(Trained { network: best, standardization, target, history, best_epoch, best_loss, stop })
}

fn shuffle(order: &mut [usize], rng: &mut ChaCha8Rng) {
    for i in (1..order.len()).rev() {
        // The bias of the remainder is below 2^-32 for any number of frames that fits in memory.
        let j = (rng.next_u64() % (i as u64 + 1)) as usize;
        order.swap(i, j);
    }
}
