//! A model of another machine taken to this one: unit costs and the factor's last layer, each drawn towards
//! what they were by as much as cross-validation says.
//!
//! ln t = ln Σ m_i e^θ_i c_i + ψ·w + b, with c the counts of estimated work, m the unit costs of the prior
//! model, ψ the activations before its last layer and w that layer's weights. θ_i ~ N(0, τ²), w ~ N(r·w₀,
//! (α s)²) with s the root mean square of w₀, b free. What is fitted is the mean over several τ, α and r, each
//! weighted by how well it predicts groups of frames that it was not fitted to (Bayesian model averaging).

use super::linear::{dot, median, solve};
use crate::Result;
use crate::error::bail;
use crate::features::{SceneFeature, SceneQuantity};
use crate::kernels::Executor;
use crate::model::ModelFile;
use crate::nn::{Normalization, PredNet, PredNetParts, SELU_ALPHA, SELU_SCALE, Target};
use crate::predict::{COSTS, InputLayout, InputRange, UnitCosts};
use alloc::collections::BTreeMap;
use alloc::vec;
use alloc::vec::Vec;

const NOT_A_PRIOR: &str = "only an analytic model times a learned factor can be the prior of a calibration (entire train \
     --model-kind residual makes one); give another, or none";

/// How strongly the prior model is believed.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Belief {
    /// Standard deviation of the logarithm of each unit cost.
    pub costs: f64,
    /// Share of the factor's weights that is expected.
    pub share: f64,
    /// Standard deviation of the factor's weights, over their root mean square.
    pub weights: f64,
}

/// The beliefs that are averaged, beside [`SPEED_ALONE`].
const COSTS_SD: [f64; 3] = [0.15, 0.5, 1.5];
const WEIGHTS_SD: [(f64, f64); 7] =
    [(1.0, 0.0), (1.0, 0.2), (1.0, 0.7), (0.5, 0.0), (0.5, 0.2), (0.5, 0.7), (0.25, 2.0)];

/// The prior model is of a machine like this one: all that it does not know is how fast this one runs today.
const SPEED_ALONE: Belief = Belief { costs: 0.0, share: 1.0, weights: 0.0 };

/// Exponent of a belief's root mean square error in its weight, per frame: that of n independent Gaussian errors
/// would be −n; frames of one volume err alike, and count as a quarter of them.
const LIKELIHOOD: f64 = 0.25;

/// Standard deviation of ln t about the model, before it is known.
const NOISE: f64 = 0.06;

/// Exponent of the expected time in a frame's importance: long frames decide the RMSE.
const IMPORTANCE: f64 = 0.25;

/// Rounds of Gauss and Newton.
const ROUNDS: usize = 6;

/// Parts for cross-validation at most, and groups of frames that it needs.
const FOLDS: usize = 7;
pub(super) const FEWEST_GROUPS: usize = 3;

/// Least cost that is thought possible of work whose cost the prior model does not know, as a share of what a
/// renderer of the kind would pay at the prior's speed.
const UNKNOWN_SHARE: f64 = 0.1;

/// Standard deviation of the logarithm of such a cost, at least.
const UNKNOWN_SD: f64 = 1.5;

/// A model file split into what a calibration fits and what stays.
#[derive(Clone, Debug)]
pub struct PriorModel {
    file: ModelFile,
    parts: PredNetParts,
    layout: InputLayout,
    /// Mean and deviation of each input, and the deviation of the output.
    inputs: Vec<(f64, f64)>,
    deviation: f64,
    costs: [f64; COSTS],
    weights: Vec<f64>,
    /// What ln t has besides the estimate and the factor.
    constant: f64,
    root_mean_square: f64,
    /// What the factor's inputs are held within.
    range: Option<InputRange>,
}

/// One frame, as the fit sees it.
#[derive(Clone, Debug)]
pub struct Observed {
    /// Inputs of the prior model, in its order.
    pub row: Vec<f32>,
    /// Estimated work: 1, then the counts of `COST_QUANTITIES`.
    pub work: [f64; COSTS],
    /// Measured seconds.
    pub seconds: f64,
    /// What is left out together in cross-validation: frames of one volume have one number.
    pub group: u64,
}

/// What was fitted.
struct Posterior {
    costs: [f64; COSTS],
    weights: Vec<f64>,
    bias: f64,
}

/// A fitted model and what is known of it.
#[derive(Clone, Debug)]
pub struct Chosen {
    /// The model file.
    pub file: ModelFile,
    /// How strongly the prior was believed: the weighted mean of the beliefs that were averaged.
    pub belief: Belief,
    /// Seconds that each frame was predicted to take without its volume, by beliefs that the other volumes
    /// weight; as fitted where there are fewer than three volumes.
    pub crossed: Vec<f64>,
    /// Groups that were left out in turn; 0 where nothing was.
    pub folds: usize,
    /// Of the belief that does best: ln of a robust relative error plus ln of RMSE over SD, of the judged frames
    /// without their volume. Fits of several priors to the same frames compare by it; less is better.
    pub score: f64,
}

impl PriorModel {
    /// Takes a model apart.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Unsupported`] for a model that is no analytic one times a learned factor.
    pub fn new(file: &ModelFile) -> Result<Self> {
        let model = file.to_model()?;
        let layout = InputLayout::of_model(&model)?;
        let carried = layout.scene_features.last()
            == Some(&SceneFeature { quantity: SceneQuantity::EstimatedSeconds, log: true });
        let (Some(parts), Some(UnitCosts(costs)), true) = (model.prednet(), layout.unit_costs, carried)
        else {
            bail!(Unsupported, "{NOT_A_PRIOR}");
        };
        let Some(last) = parts.layers.last().filter(|_| parts.target == Target::LogSeconds) else {
            bail!(Unsupported, "{NOT_A_PRIOR}");
        };
        let width = last.inputs - 1;
        let weights: Vec<f64> = last.weight[..width].iter().map(|&w| f64::from(w)).collect();
        let square = dot(&weights, &weights) / width.max(1) as f64;
        let inputs: Vec<(f64, f64)> = match &parts.input {
            Some(Normalization { mean, std }) => {
                mean.iter().zip(std).map(|(&m, &s)| (f64::from(m), f64::from(s))).collect()
            }
            None => vec![(0.0, 1.0); layout.width()],
        };
        let deviation = parts.output.as_ref().and_then(|n| n.std.first()).map_or(1.0, |&s| f64::from(s));
        // At the inputs' means every standardized input is 0, the estimate's too.
        let mean: Vec<f32> = inputs.iter().map(|i| i.0 as f32).collect();
        let net = PredNet::new(parts)?;
        let total = libm::log(f64::from(net.predict(&mean, &mut net.scratch(1)?)));
        let mut out = Self {
            file: file.clone(),
            parts: parts.clone(),
            inputs,
            deviation,
            costs,
            weights,
            constant: 0.0,
            root_mean_square: libm::sqrt(square),
            range: InputRange::of(&model, layout.width())?,
            layout,
        };
        if out.root_mean_square < 1e-6 {
            out.root_mean_square = 0.05;
        }
        let psi = out.activations(&mean);
        out.constant = total - mean.last().map_or(0.0, |&m| f64::from(m)) - dot(&psi, &out.weights);
        Ok(out)
    }

    /// The prior's unit costs.
    pub fn costs(&self) -> &[f64; COSTS] {
        &self.costs
    }

    /// What the model takes.
    pub fn layout(&self) -> &InputLayout {
        &self.layout
    }

    /// ψ of a row: what enters the last layer, in units of the output.
    fn activations(&self, row: &[f32]) -> Vec<f64> {
        let mut held = row.to_vec();
        if let Some(range) = &self.range {
            range.hold(&mut held);
        }
        let standardized =
            held.iter().zip(&self.inputs).map(|(&x, (mean, std))| (f64::from(x) - mean) / std).collect();
        let mut values = hidden_activations(&self.parts, standardized);
        values.truncate(self.weights.len());
        values.iter_mut().for_each(|v| *v *= self.deviation);
        values
    }

    /// Unit costs that observations may move: those of the prior model, and a little of what it does not know
    /// and a software renderer pays for.
    fn prior_costs(&self, frames: &[Observed], renderer: &UnitCosts) -> [f64; COSTS] {
        let mut ratios: Vec<f64> = frames
            .iter()
            .map(|f| dot(&self.costs, &f.work) / dot(&renderer.0, &f.work))
            .filter(|r| r.is_finite() && *r > 0.0)
            .collect();
        let speed = median(&mut ratios).unwrap_or(1.0);
        let mut out = self.costs;
        for (cost, known) in out.iter_mut().zip(&renderer.0) {
            if *cost == 0.0 {
                *cost = UNKNOWN_SHARE * speed * known;
            }
        }
        out
    }

    /// The model with what was fitted.
    fn with(&self, fitted: &Posterior) -> Result<ModelFile> {
        let mut file = self.file.clone();
        let mut parts = self.parts.clone();
        if let Some(layer) = parts.layers.last_mut() {
            for (slot, &w) in layer.weight.iter_mut().zip(&fitted.weights) {
                *slot = w as f32;
            }
            layer.bias[0] =
                (f64::from(layer.bias[0]) + (fitted.bias - self.constant) / self.deviation) as f32;
        }
        let mut layout = self.layout.clone();
        layout.unit_costs = Some(UnitCosts(fitted.costs));
        layout.store(&parts, &mut file)?;
        Ok(file)
    }

    /// Fits the frames, believing the prior as strongly as said.
    fn fit(&self, prior: &[f64; COSTS], frames: &[&Prepared], belief: Belief) -> Posterior {
        // Where no cost may move, work that costs nothing in the prior model costs nothing here.
        let moves = belief.costs > 0.0;
        let prior = if moves { prior } else { &self.costs };
        let paid = |i: usize| prior[i] > 0.0 && frames.iter().any(|f| f.work[i] > 0.0);
        let active: Vec<usize> = (0..COSTS).filter(|&i| moves && paid(i)).collect();
        let (k, width) = (active.len(), if belief.weights > 0.0 { self.weights.len() } else { 0 });
        let m = k + width + 1;
        let expected: Vec<f64> = self.weights.iter().map(|w| belief.share * w).collect();
        let mut fitted = Posterior { costs: *prior, weights: expected.clone(), bias: 0.0 };
        let mut rest: Vec<f64> = frames
            .iter()
            .map(|f| f.log - libm::log(dot(&fitted.costs, &f.work)) - dot(&f.psi, &expected))
            .collect();
        fitted.bias = median(&mut rest).unwrap_or(self.constant);
        let mut mean = 0.0;
        let importance: Vec<f64> = frames
            .iter()
            .map(|f| {
                let w = libm::exp(IMPORTANCE * f.log);
                mean += w / frames.len() as f64;
                w
            })
            .collect();
        let mut theta = vec![0.0; k];
        let mut jacobian = vec![0.0; m];
        for round in 0..ROUNDS {
            let residuals: Vec<f64> = frames.iter().map(|f| f.log - fitted.log_seconds(f)).collect();
            let mut sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
            let limit = (2.0 * 1.4826 * median(&mut sizes).unwrap_or(0.0)).max(0.5 * NOISE);
            let (mut gram, mut rhs) = (vec![0.0; m * m], vec![0.0; m]);
            for ((f, r), w) in frames.iter().zip(&residuals).zip(&importance) {
                let estimate = dot(&fitted.costs, &f.work);
                for (slot, &i) in jacobian.iter_mut().zip(&active) {
                    *slot = fitted.costs[i] * f.work[i] / estimate;
                }
                jacobian[k..k + width].copy_from_slice(&f.psi[..width]);
                jacobian[m - 1] = 1.0;
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
                let known = self.costs[active[i]] > 0.0;
                let deviation = if known { belief.costs } else { belief.costs.max(UNKNOWN_SD) };
                let precision = 1.0 / (deviation * deviation);
                gram[i * m + i] += precision;
                rhs[i] -= precision * t;
            }
            let deviation = belief.weights * self.root_mean_square;
            for (i, (w, mean)) in fitted.weights.iter().zip(&expected).enumerate().take(width) {
                let precision = 1.0 / (deviation * deviation);
                gram[(k + i) * m + k + i] += precision;
                rhs[k + i] -= precision * (w - mean);
            }
            gram[m * m - 1] += 1e-6;
            let Some(step) = solve(&mut gram, rhs) else { break };
            for ((t, s), &i) in theta.iter_mut().zip(&step).zip(&active) {
                *t = (*t + s.clamp(-1.0, 1.0)).clamp(-6.0, 6.0);
                fitted.costs[i] = prior[i] * libm::exp(*t);
            }
            for (w, s) in fitted.weights.iter_mut().zip(&step[k..k + width]) {
                *w += s;
            }
            fitted.bias += step[m - 1];
            if round > 1 && step.iter().all(|s| s.abs() < 1e-4) {
                break;
            }
        }
        fitted
    }

    /// Fits frames of this machine, believing the prior as much as cross-validation by group calls for: where the
    /// speed alone explains them as well as anything, as far as so few frames can tell, the speed is what is fitted;
    /// otherwise the fits of all beliefs are averaged, which so few frames mislead less than a choice among them.
    /// `renderer` holds costs of a renderer of the kind, for work whose cost the prior does not know;
    /// `judged` says by which frames, by their index, the choice is made.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] without frames, for a time that is not positive, or when rows
    /// are not the model's.
    pub fn choose(
        &self,
        frames: &[Observed],
        renderer: &UnitCosts,
        judged: impl Fn(usize) -> bool,
        executor: Executor<'_>,
    ) -> Result<Chosen> {
        let inputs = self.inputs.len();
        if frames.is_empty() {
            bail!(InvalidArgument, "there are no frames to calibrate to; observe some first");
        }
        for (i, f) in frames.iter().enumerate() {
            if f.row.len() != inputs || !(f.seconds.is_finite() && f.seconds > 0.0) {
                bail!(
                    InvalidArgument,
                    "frame {i} has {} inputs and took {} seconds; the model takes {inputs} inputs, and times are finite \
                     and positive",
                    f.row.len(),
                    f.seconds
                );
            }
        }
        let prior = self.prior_costs(frames, renderer);
        let prepared: Vec<Prepared> = frames
            .iter()
            .map(|f| Prepared { psi: self.activations(&f.row), work: f.work, log: libm::log(f.seconds) })
            .collect();
        let all: Vec<&Prepared> = prepared.iter().collect();
        let pairs = |crossed: &[f64]| -> Vec<(f64, f64)> {
            let pairs = crossed.iter().zip(frames).enumerate();
            pairs.filter(|(i, _)| judged(*i)).map(|(_, (&p, f))| (p, f.seconds)).collect()
        };
        let folds = folds(frames);
        let count = folds.iter().max().map_or(0, |m| m + 1);
        if count < FEWEST_GROUPS {
            // Too little to choose by: the prior's factor, costs near the prior's, and the speed of this machine.
            let belief = Belief { costs: COSTS_SD[0], share: 1.0, weights: 0.0 };
            let fitted = self.fit(&prior, &all, belief);
            let crossed: Vec<f64> = prepared.iter().map(|f| libm::exp(fitted.log_seconds(f))).collect();
            let score = score(&pairs(&crossed));
            return Ok(Chosen { file: self.with(&fitted)?, belief, crossed, folds: 0, score });
        }
        let with = |costs| WEIGHTS_SD.iter().map(move |&(share, weights)| Belief { costs, share, weights });
        let mut tried: Vec<Tried> = core::iter::once(SPEED_ALONE)
            .chain(COSTS_SD.into_iter().flat_map(with))
            .map(|belief| Tried { belief, without: Vec::new(), all: None, crossed: Vec::new() })
            .collect();
        each(executor, &mut tried, &|tried: &mut Tried| {
            tried.without = (0..count)
                .map(|fold| {
                    let rest = prepared.iter().zip(&folds).filter(|(_, f)| **f != fold);
                    self.fit(&prior, &rest.map(|(p, _)| p).collect::<Vec<_>>(), tried.belief)
                })
                .collect();
            tried.crossed = prepared
                .iter()
                .zip(&folds)
                .map(|(p, &f)| libm::exp(tried.without[f].log_seconds(p)))
                .collect();
            tried.all = Some(self.fit(&prior, &all, tried.belief));
        });
        // How much each belief counts, by the frames of all parts but one, if any.
        let weigh = |without: Option<usize>| -> Vec<f64> {
            let counts = |i: usize| judged(i) && without != Some(folds[i]);
            let pairs: Vec<Vec<(f64, f64)>> = tried
                .iter()
                .map(|t| {
                    let pairs = t.crossed.iter().zip(frames).enumerate();
                    pairs.filter(|(i, _)| counts(*i)).map(|(_, (&p, f))| (p, f.seconds)).collect()
                })
                .collect();
            weights(&pairs)
        };
        let weights = weigh(None);
        // What a part's frames were predicted by weights that the others give: an error that they did not see.
        let without: Vec<Posterior> = (0..count)
            .map(|fold| Posterior::mean(&weigh(Some(fold)), tried.iter().map(|t| &t.without[fold])))
            .collect();
        let crossed: Vec<f64> =
            prepared.iter().zip(&folds).map(|(p, &f)| libm::exp(without[f].log_seconds(p))).collect();
        if !crossed.iter().all(|p| p.is_finite()) {
            bail!(InvalidArgument, "no fit to these frames predicts a finite time; are their times right?");
        }
        let score = tried.iter().map(|t| score(&pairs(&t.crossed))).fold(f64::INFINITY, f64::min);
        let fitted = Posterior::mean(&weights, tried.iter().filter_map(|t| t.all.as_ref()));
        let mean = |of: fn(&Belief) -> f64| weights.iter().zip(&tried).map(|(w, t)| w * of(&t.belief)).sum();
        Ok(Chosen {
            file: self.with(&fitted)?,
            belief: Belief {
                costs: mean(|b| b.costs),
                share: mean(|b| b.share),
                weights: mean(|b| b.weights),
            },
            crossed,
            folds: count,
            score,
        })
    }
}

/// What a belief makes of the frames.
struct Tried {
    belief: Belief,
    /// Fitted to all frames but those of each part of cross-validation.
    without: Vec<Posterior>,
    /// Fitted to all frames.
    all: Option<Posterior>,
    /// Seconds of each frame by the fit that did not see its part.
    crossed: Vec<f64>,
}

/// How much each belief counts, of its predicted and the measured seconds; the first is [`SPEED_ALONE`].
fn weights(pairs: &[Vec<(f64, f64)>]) -> Vec<f64> {
    let n = pairs.first().map_or(0, Vec::len).max(1) as f64;
    let scores: Vec<f64> = pairs.iter().map(|p| score(p)).collect();
    let best = scores.iter().copied().fold(f64::INFINITY, f64::min);
    // The rule of one standard error.
    if scores.first().is_some_and(|s| *s <= best + 1.0 / libm::sqrt(n)) {
        let mut alone = vec![0.0; pairs.len()];
        alone[0] = 1.0;
        return alone;
    }
    let error = |pairs: &Vec<(f64, f64)>| {
        let squares: f64 = pairs.iter().map(|(p, t)| libm::pow(libm::log(p / t), 2.0)).sum();
        if squares.is_finite() { 0.5 * libm::log((squares / n).max(1e-12)) } else { f64::INFINITY }
    };
    let errors: Vec<f64> = pairs.iter().map(error).collect();
    let least = errors.iter().copied().fold(f64::INFINITY, f64::min);
    // A belief whose fit predicts nothing has no say: its error is infinite, that of the best is not.
    let mut weights: Vec<f64> = errors.iter().map(|e| libm::exp(-LIKELIHOOD * n * (e - least))).collect();
    let sum: f64 = weights.iter().sum();
    weights.iter_mut().for_each(|w| *w /= sum);
    weights
}

/// What enters a network's last layer, of standardized inputs.
pub fn hidden_activations(parts: &PredNetParts, mut values: Vec<f64>) -> Vec<f64> {
    let hidden = parts.layers.split_last().map_or(&[][..], |(_, hidden)| hidden);
    for layer in hidden {
        values = layer
            .weight
            .chunks_exact(layer.inputs)
            .zip(&layer.bias)
            .map(|(weights, &bias)| {
                let sum: f64 = weights.iter().zip(&values).map(|(&w, x)| f64::from(w) * x).sum();
                let sum = sum + f64::from(bias);
                SELU_SCALE * if sum > 0.0 { sum } else { SELU_ALPHA * libm::expm1(sum) }
            })
            .collect();
    }
    values
}

/// Calls `f` with each item, on as many threads as the executor has.
fn each<T: Send>(executor: Executor<'_>, items: &mut [T], f: &(impl Fn(&mut T) + Sync)) {
    match items {
        [] => {}
        [one] => f(one),
        _ => {
            let (a, b) = items.split_at_mut(items.len() / 2);
            executor.join(|| each(executor, a, f), || each(executor, b, f));
        }
    }
}

/// What the fit needs of a frame.
struct Prepared {
    psi: Vec<f64>,
    work: [f64; COSTS],
    log: f64,
}

impl Posterior {
    /// The mean of fits whose weights add up to 1: of their estimates in seconds, and of what their factors say
    /// in logarithms.
    fn mean<'a>(weights: &[f64], fits: impl Iterator<Item = &'a Self> + Clone) -> Self {
        let counted = || weights.iter().zip(fits.clone()).filter(|(w, _)| **w > 0.0);
        let bias: f64 = counted().map(|(w, fit)| w * fit.bias).sum();
        let mut out = Self { costs: [0.0; COSTS], weights: Vec::new(), bias };
        for (w, fit) in counted() {
            out.weights.resize(fit.weights.len(), 0.0);
            // Each fit's own speed goes with its costs.
            let scale = w * libm::exp(fit.bias - bias);
            out.costs.iter_mut().zip(&fit.costs).for_each(|(slot, cost)| *slot += scale * cost);
            out.weights.iter_mut().zip(&fit.weights).for_each(|(slot, weight)| *slot += w * weight);
        }
        out
    }

    fn log_seconds(&self, frame: &Prepared) -> f64 {
        libm::log(dot(&self.costs, &frame.work).max(1e-12)) + dot(&self.weights, &frame.psi) + self.bias
    }
}

/// What choices go by: the geometric mean of a robust relative error and of RMSE over SD. Pairs of predicted
/// and measured seconds.
fn score(pairs: &[(f64, f64)]) -> f64 {
    let Some(whole) = rmse_over_sd(pairs) else { return f64::INFINITY };
    let mut sizes: Vec<f64> = pairs.iter().map(|(p, t)| libm::log(p / t).abs()).collect();
    sizes.sort_unstable_by(f64::total_cmp);
    sizes.truncate((sizes.len() * 9).div_ceil(10));
    let spread = libm::sqrt(dot(&sizes, &sizes) / sizes.len() as f64);
    let score = libm::log(spread.max(1e-6)) + libm::log(whole.max(1e-6));
    if score.is_nan() { f64::INFINITY } else { score }
}

/// Root of the mean squared error over the standard deviation of the measured seconds; `None` without pairs.
pub(super) fn rmse_over_sd(pairs: &[(f64, f64)]) -> Option<f64> {
    if pairs.is_empty() {
        return None;
    }
    let n = pairs.len() as f64;
    let mean = pairs.iter().map(|p| p.1).sum::<f64>() / n;
    let variance = pairs.iter().map(|(_, t)| (t - mean) * (t - mean)).sum::<f64>() / n;
    let square = pairs.iter().map(|(p, t)| (p - t) * (p - t)).sum::<f64>() / n;
    Some(libm::sqrt(square / variance))
}

/// The part of cross-validation that each frame is left out with: whole groups, spread so that parts have
/// about as many frames.
fn folds(frames: &[Observed]) -> Vec<usize> {
    let mut sizes: BTreeMap<u64, usize> = BTreeMap::new();
    for f in frames {
        *sizes.entry(f.group).or_default() += 1;
    }
    let mut groups: Vec<(u64, usize)> = sizes.into_iter().collect();
    groups.sort_by(|a, b| b.1.cmp(&a.1).then(a.0.cmp(&b.0)));
    let mut loads = vec![0usize; FOLDS.min(groups.len())];
    let mut fold_of = BTreeMap::new();
    for (group, size) in groups {
        let least = (0..loads.len()).min_by_key(|&i| loads[i]).unwrap_or(0);
        loads[least] += size;
        fold_of.insert(group, least);
    }
    frames.iter().map(|f| fold_of[&f.group]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Measured seconds, and predictions that are off by ± `error` in logarithms.
    fn off(error: f64) -> Vec<(f64, f64)> {
        (0..32)
            .map(|i| {
                let measured = 0.01 * f64::from(1 + i % 7);
                (measured * libm::exp(if i % 2 == 0 { error } else { -error }), measured)
            })
            .collect()
    }

    #[test]
    fn beliefs_count_by_their_errors_and_speed_alone_wins_where_nothing_is_better() {
        // Weights are errors to the power −n/4: with n = 32, of twice the error 2^−8 as much.
        let found = weights(&[off(0.5), off(0.1), off(0.2)]);
        assert!((found.iter().sum::<f64>() - 1.0).abs() < 1e-12, "{found:?}");
        assert!((found[2] / found[1] - libm::pow(2.0, -8.0)).abs() < 1e-6, "{found:?}");
        assert!((found[0] / found[1] - libm::pow(5.0, -8.0)).abs() < 1e-7, "{found:?}");
        // Within a standard error of the best, speed alone is all.
        assert_eq!(weights(&[off(0.105), off(0.1), off(0.2)]), [1.0, 0.0, 0.0]);
        // A fit that predicts nothing has no say.
        let mut broken = off(0.1);
        broken[3].0 = f64::NAN;
        let found = weights(&[off(0.5), off(0.1), broken]);
        assert!(found[2] == 0.0 && found[1] > 0.99, "{found:?}");
    }

    #[test]
    fn the_mean_of_fits_adds_up_their_estimates() {
        let fit = |cost: f64, weight: f64, bias: f64| Posterior {
            costs: core::array::from_fn(|i| if i == 3 { cost } else { 0.0 }),
            weights: vec![weight, 0.0],
            bias,
        };
        let fits = [fit(2e-6, 0.5, 0.3), fit(5e-6, 0.5, -0.4), fit(f64::NAN, f64::NAN, f64::NAN)];
        let mut work = [0.0; COSTS];
        work[3] = 1e4;
        let frame = Prepared { psi: vec![0.7, 1.0], work, log: 0.0 };
        let mean = Posterior::mean(&[0.25, 0.75, 0.0], fits.iter());
        let expected = libm::log(0.25 * 2e-2 * libm::exp(0.3) + 0.75 * 5e-2 * libm::exp(-0.4)) + 0.5 * 0.7;
        assert!((mean.log_seconds(&frame) - expected).abs() < 1e-12);
        // One fit is its own mean.
        let one = Posterior::mean(&[0.0, 1.0, 0.0], fits.iter());
        assert!((one.log_seconds(&frame) - fits[1].log_seconds(&frame)).abs() < 1e-12);
        assert_eq!((one.costs, one.bias), (fits[1].costs, fits[1].bias));
    }
}
