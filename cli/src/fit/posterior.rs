//! A model of another machine taken to this one: unit costs and the factor's last layer, each drawn towards
//! what they were by as much as cross-validation says.
//!
//! ln t = ln Σ m_i e^θ_i c_i + ψ·w + b, with c the counts of estimated work, m the unit costs of the prior
//! model, ψ the activations before its last layer and w that layer's weights. θ_i ~ N(0, τ²), w ~ N(r·w₀,
//! (α s)²) with s the root mean square of w₀, b free. With τ = 0 and r = 1 this would be [`super::calibrate`];
//! with a large τ and r = 1/4 it is [`super::transfer`]; τ, α and r in between are what few frames call for.

use super::adapt::hidden_activations;
use super::least_squares::{solve, standardized};
use crate::metrics::{Metrics, median};
use crate::train::Standardization;
use anyhow::{Context, Result, ensure};
use entire_core::features::{SceneFeature, SceneQuantity};
use entire_core::model::ModelFile;
use entire_core::nn::{PredNetParts, Target};
use entire_core::predict::{COSTS, InputLayout, UnitCosts};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;

/// How strongly the prior model is believed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Belief {
    /// Standard deviation of the logarithm of each unit cost.
    pub costs: f64,
    /// Share of the factor's weights that is expected.
    pub share: f64,
    /// Standard deviation of the factor's weights, over their root mean square.
    pub weights: f64,
}

impl Belief {
    /// How freely observations move the model.
    fn freedom(&self) -> f64 {
        self.costs + self.weights
    }
}

/// What cross-validation chooses among. Ratios of unit costs are of one machine: that they hold on the next is
/// never believed.
const COSTS_SD: [f64; 3] = [0.15, 0.5, 1.5];
const WEIGHTS_SD: [(f64, f64); 7] =
    [(1.0, 0.0), (1.0, 0.2), (1.0, 0.7), (0.5, 0.0), (0.5, 0.2), (0.5, 0.7), (0.25, 2.0)];

/// Standard deviation of ln t about the model, before it is known.
const NOISE: f64 = 0.06;

/// Exponent of the expected time in a frame's importance: long frames decide the RMSE.
const IMPORTANCE: f64 = 0.25;

/// Rounds of Gauss and Newton.
const ROUNDS: usize = 6;

/// Parts for cross-validation at most.
const FOLDS: usize = 7;

/// Least cost that is thought possible of work whose cost the prior model does not know, as a share of what a
/// renderer of the kind would pay at the prior's speed.
const UNKNOWN_SHARE: f64 = 0.1;

/// Standard deviation of the logarithm of such a cost, at least.
const UNKNOWN_SD: f64 = 1.5;

/// A model file split into what is fitted and what stays.
pub struct Split {
    file: ModelFile,
    parts: PredNetParts,
    scale: Standardization,
    costs: [f64; COSTS],
    weights: Vec<f64>,
    /// What ln t has besides the estimate and the factor.
    constant: f64,
    root_mean_square: f64,
    inputs: usize,
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
    /// What is left out together in cross-validation: the volume.
    pub group: String,
}

/// What was fitted.
#[derive(Clone, Debug)]
pub struct Posterior {
    costs: [f64; COSTS],
    weights: Vec<f64>,
    bias: f64,
}

/// A fitted model and what is known of it.
pub struct Chosen {
    /// The model file.
    pub file: ModelFile,
    /// How strongly the prior was believed.
    pub belief: Belief,
    /// Seconds that each frame was predicted to take without its volume; as fitted where there are fewer than
    /// three volumes.
    pub crossed: Vec<f64>,
    /// Groups that were left out in turn; 0 where nothing was.
    pub folds: usize,
}

impl Split {
    /// Takes a model apart.
    ///
    /// # Errors
    /// For a model that is no analytic one times a learned factor.
    pub fn new(file: &ModelFile) -> Result<Self> {
        let model = file.to_model()?;
        let layout = InputLayout::of_model(&model)?;
        let carried = layout.scene_features.last()
            == Some(&SceneFeature { quantity: SceneQuantity::EstimatedSeconds, log: true });
        let parts = model.prednet().context("the model file holds no PredNet")?.clone();
        let (Some(UnitCosts(costs)), true) =
            (layout.unit_costs, carried && parts.target == Target::LogSeconds)
        else {
            anyhow::bail!(
                "only an analytic model times a learned factor (--model-kind residual) can be the prior of a \
                 calibration; give another, or leave it away"
            )
        };
        let scale = Standardization::of(&parts);
        let last = parts.layers.last().context("the PredNet has no layer")?;
        let width = last.inputs - 1;
        let weights: Vec<f64> = last.weight[..width].iter().map(|&w| f64::from(w)).collect();
        let square = weights.iter().map(|w| w * w).sum::<f64>() / width.max(1) as f64;
        let inputs = scale.input_mean.len();
        let mut out = Self {
            file: file.clone(),
            parts,
            scale,
            costs,
            weights,
            constant: 0.0,
            root_mean_square: square.sqrt(),
            inputs,
        };
        if out.root_mean_square < 1e-6 {
            out.root_mean_square = 0.05;
        }
        // At the inputs' means every standardized input is 0, the estimate's too.
        let mean: Vec<f32> = out.scale.input_mean.clone();
        let psi = out.activations(&mean);
        let total = f64::from(
            entire_core::nn::PredNet::new(&out.parts)?
                .predict(&mean, &mut entire_core::nn::PredNet::new(&out.parts)?.scratch(1)?),
        )
        .ln();
        out.constant = total - f64::from(mean[inputs - 1]) - dot(&psi, &out.weights);
        Ok(out)
    }

    /// The prior's unit costs.
    pub fn costs(&self) -> &[f64; COSTS] {
        &self.costs
    }

    /// ψ of rows, each as long as the factor is wide.
    fn activations(&self, rows: &[f32]) -> Vec<f64> {
        let hidden = hidden_activations(&self.parts, &standardized(rows, &self.scale));
        let (whole, width) = (self.weights.len() + 1, self.weights.len());
        let deviation = f64::from(self.scale.output_std);
        hidden.chunks_exact(whole).flat_map(|h| h[..width].iter().map(|v| v * deviation)).collect()
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
    ///
    /// # Errors
    /// When a number does not fit the file.
    pub fn with(&self, fitted: &Posterior) -> Result<ModelFile> {
        let mut file = self.file.clone();
        let mut parts = self.parts.clone();
        let deviation = f64::from(self.scale.output_std);
        if let Some(layer) = parts.layers.last_mut() {
            for (slot, &w) in layer.weight.iter_mut().zip(&fitted.weights) {
                *slot = w as f32;
            }
            layer.bias[0] = (f64::from(layer.bias[0]) + (fitted.bias - self.constant) / deviation) as f32;
        }
        let layout = InputLayout {
            unit_costs: Some(UnitCosts(fitted.costs)),
            ..InputLayout::of_model(&self.file.to_model()?)?
        };
        layout.store(&parts, &mut file)?;
        Ok(file)
    }

    /// Fits the frames, believing the prior as strongly as said.
    fn fit(&self, prior: &[f64; COSTS], frames: &[&Prepared], belief: Belief) -> Posterior {
        let active: Vec<usize> =
            (0..COSTS).filter(|&i| prior[i] > 0.0 && frames.iter().any(|f| f.work[i] > 0.0)).collect();
        let (k, width) = (active.len(), if belief.weights > 0.0 { self.weights.len() } else { 0 });
        let m = k + width + 1;
        let expected: Vec<f64> = self.weights.iter().map(|w| belief.share * w).collect();
        let mut fitted = Posterior { costs: *prior, weights: expected.clone(), bias: 0.0 };
        let mut rest: Vec<f64> = frames
            .iter()
            .map(|f| f.log - dot(&fitted.costs, &f.work).ln() - dot(&f.psi, &expected))
            .collect();
        fitted.bias = median(&mut rest).unwrap_or(self.constant);
        let mut mean = 0.0;
        let importance: Vec<f64> = frames
            .iter()
            .map(|f| {
                let w = (IMPORTANCE * f.log).exp();
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
                fitted.costs[i] = prior[i] * t.exp();
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

    /// Fits frames of this machine, believing the prior as much as cross-validation by group calls for.
    /// `renderer` holds costs of a renderer of the kind, for work whose cost the prior does not know;
    /// `judged` says by which frames the choice is made.
    ///
    /// # Errors
    /// Without frames, or when rows are not the model's.
    pub fn choose(
        &self,
        frames: &[Observed],
        renderer: &UnitCosts,
        judged: impl Fn(usize) -> bool,
    ) -> Result<Chosen> {
        ensure!(!frames.is_empty(), "there are no frames to calibrate to");
        ensure!(
            frames.iter().all(|f| f.row.len() == self.inputs),
            "a frame does not have the {} inputs that the model takes",
            self.inputs
        );
        let prior = self.prior_costs(frames, renderer);
        let prepared: Vec<Prepared> = frames
            .iter()
            .map(|f| Prepared { psi: self.activations(&f.row), work: f.work, log: f.seconds.ln() })
            .collect();
        let all: Vec<&Prepared> = prepared.iter().collect();
        let folds = folds(frames);
        let beliefs: Vec<Belief> = COSTS_SD
            .iter()
            .flat_map(|&costs| {
                WEIGHTS_SD.iter().map(move |&(share, weights)| Belief { costs, share, weights })
            })
            .collect();
        let count = folds.iter().max().map_or(0, |m| m + 1);
        let measured: Vec<f64> = frames.iter().map(|f| f.seconds).collect();
        if count < 3 {
            // Too little to choose by: the prior's shape, and the speed of this machine.
            let belief = Belief { costs: 0.15, share: 1.0, weights: 0.0 };
            let fitted = self.fit(&prior, &all, belief);
            let crossed = prepared.iter().map(|f| fitted.log_seconds(f).exp()).collect();
            return Ok(Chosen { file: self.with(&fitted)?, belief, crossed, folds: 0 });
        }
        let tried: Vec<(Belief, Vec<f64>)> = beliefs
            .par_iter()
            .map(|&belief| {
                let mut crossed = vec![0.0; frames.len()];
                for fold in 0..count {
                    let rest: Vec<&Prepared> =
                        prepared.iter().zip(&folds).filter(|(_, f)| **f != fold).map(|(p, _)| p).collect();
                    let fitted = self.fit(&prior, &rest, belief);
                    for ((slot, p), _) in
                        crossed.iter_mut().zip(&prepared).zip(&folds).filter(|(_, f)| **f == fold)
                    {
                        *slot = fitted.log_seconds(p).exp();
                    }
                }
                (belief, crossed)
            })
            .collect();
        let score = |crossed: &[f64]| {
            let pick = |values: &[f64]| -> Vec<f64> {
                values.iter().enumerate().filter(|(i, _)| judged(*i)).map(|(_, v)| *v).collect()
            };
            score(&pick(crossed), &pick(&measured))
        };
        // The strongest belief that is as good as the best, as far as so few frames can tell (the rule of one
        // standard error).
        let scores: Vec<f64> = tried.iter().map(|t| score(&t.1)).collect();
        let best = scores.iter().copied().fold(f64::INFINITY, f64::min);
        let frames_judged = (0..frames.len()).filter(|i| judged(*i)).count();
        let enough = best + 1.0 / (frames_judged.max(1) as f64).sqrt();
        let (belief, crossed) = tried
            .into_iter()
            .zip(scores)
            .filter(|(_, score)| *score <= enough)
            .min_by(|a, b| a.0.0.freedom().total_cmp(&b.0.0.freedom()).then(a.1.total_cmp(&b.1)))
            .map(|(tried, _)| tried)
            .context("nothing was cross-validated")?;
        let fitted = self.fit(&prior, &all, belief);
        Ok(Chosen { file: self.with(&fitted)?, belief, crossed, folds: count })
    }
}

/// What the fit needs of a frame.
struct Prepared {
    psi: Vec<f64>,
    work: [f64; COSTS],
    log: f64,
}

impl Posterior {
    fn log_seconds(&self, frame: &Prepared) -> f64 {
        dot(&self.costs, &frame.work).max(1e-12).ln() + dot(&self.weights, &frame.psi) + self.bias
    }
}

/// What choices go by: the geometric mean of a robust relative error and of RMSE over SD.
fn score(predicted: &[f64], measured: &[f64]) -> f64 {
    let Some(m) = Metrics::new(predicted, measured) else { return f64::INFINITY };
    let mut sizes: Vec<f64> = predicted.iter().zip(measured).map(|(p, t)| (p / t).ln().abs()).collect();
    sizes.sort_by(f64::total_cmp);
    sizes.truncate((sizes.len() * 9).div_ceil(10));
    let spread = (sizes.iter().map(|s| s * s).sum::<f64>() / sizes.len() as f64).sqrt();
    spread.max(1e-6).ln() + m.rmse_over_sd.max(1e-6).ln()
}

/// The part of cross-validation that each frame is left out with: whole groups, spread so that parts have
/// about as many frames.
fn folds(frames: &[Observed]) -> Vec<usize> {
    let mut sizes: BTreeMap<&str, usize> = BTreeMap::new();
    for f in frames {
        *sizes.entry(&f.group).or_default() += 1;
    }
    let mut groups: Vec<(&str, usize)> = sizes.into_iter().collect();
    groups.sort_by(|a, b| b.1.cmp(&a.1).then(a.0.cmp(b.0)));
    let mut loads = vec![0usize; FOLDS.min(groups.len())];
    let mut fold_of = BTreeMap::new();
    for (group, size) in groups {
        let least = (0..loads.len()).min_by_key(|&i| loads[i]).unwrap_or(0);
        loads[least] += size;
        fold_of.insert(group, least);
    }
    frames.iter().map(|f| fold_of[f.group.as_str()]).collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}
