//! Fits a model to frames of this machine, with a model of other machines as prior: unit costs and, if the
//! prior has a learned factor, the last layer of this factor. Both are regularized towards the prior. One of
//! [`CACHED_VOXELS`] replaces the prior's number of cached voxels if it clearly reduces the error in
//! cross-validation.
//!
//! [`CostFit`] does the fit. The prior standard deviation of the last layer's weights is [`FACTOR_SD`] times
//! their root mean square.

use crate::features::{SceneFeature, SceneQuantity};
use crate::memory::each;
use crate::numeric::{dot, median, rmse_over_sd};
use crate::predict::{
    AnalyticModel, COST_SD, COSTS, CostFit, Expected, FitRow, InputLayout, InputRange, Inputs, UnitCosts,
};
use alloc::collections::BTreeMap;
use alloc::vec;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::kernels::Executor;
use entire_core::kernels::{SELU_ALPHA, SELU_SCALE};
use entire_core::model::ModelFile;
use entire_core::nn::{Normalization, PredNet, PredNetParts, Target};

const NOT_A_PRIOR: &str = "a calibration starts from analytic models, or from one analytic model times a learned factor \
     (entire train --model-kind analytic and residual make them); give another model, or none";

/// Prior standard deviation of the logarithm of a unit cost that the prior model lacks.
const UNKNOWN_SD: f64 = 1.5;

/// Prior standard deviation of a weight of the factor's last layer, as a share of the root mean square of
/// this layer's weights.
const FACTOR_SD: f64 = 0.2;

/// Prior of a cost that is 0 in a machine's model, as a share of the cost in an equally fast typical
/// renderer. The cost is 0 because frames of that machine could not separate two kinds of work; frames of
/// this machine may separate them.
const ZERO_SHARE: f64 = 0.1;

/// Numbers of cached voxels that a fit compares ([`UnitCosts::cached_voxels`]): 8 to 64 MB in a renderer that packs a
/// voxel into four bytes.
const CACHED_VOXELS: [f64; 4] = [2.0e6, 4.0e6, 8.0e6, 16.0e6];

/// Share of the smallest error so far. A fit with another kind of renderer, or with another number of cached
/// voxels, replaces the best fit if its error is below this share.
const LESS_ERROR: f64 = 0.95;

/// Largest number of folds in cross-validation.
const FOLDS: usize = 7;

/// Smallest number of groups of frames for cross-validation.
pub(super) const FEWEST_GROUPS: usize = 3;

/// Prior of a calibration: unit costs, and at most one learned factor.
#[derive(Clone, Debug)]
pub struct PriorModel {
    costs: UnitCosts,
    /// True for costs that the prior's models have; the others are guesses.
    known: [bool; COSTS],
    factor: Option<Factor>,
}

/// A learned factor, split into its last layer and the layers before it.
#[derive(Clone, Debug)]
struct Factor {
    file: ModelFile,
    parts: PredNetParts,
    layout: InputLayout,
    /// Mean and standard deviation of each input.
    inputs: Vec<(f64, f64)>,
    /// Standard deviation of the factor's output.
    deviation: f64,
    /// Weights of the last layer, without the weight of the estimated seconds.
    weights: Vec<f64>,
    /// Constant term of ln(predicted seconds), added to ln(estimated seconds) and the weighted activations.
    constant: f64,
    root_mean_square: f64,
    /// Range to which the factor's inputs are clamped.
    range: Option<InputRange>,
}

/// One frame of the fit.
#[derive(Clone, Debug)]
pub struct Observed {
    /// Inputs of the prior's factor, in the factor's order; empty if the prior has no factor.
    pub row: Vec<f32>,
    /// Estimated work: 1, then the counts of `COST_QUANTITIES`.
    pub work: [f64; COSTS],
    /// Measured seconds.
    pub seconds: f64,
    /// Group for cross-validation: the frames of a group are held out together.
    pub group: u64,
}

/// A fitted model and its errors.
#[derive(Clone, Debug)]
pub struct Chosen {
    /// The model file.
    pub file: ModelFile,
    /// Cross-validated prediction of each frame in seconds, from the fit without its fold; with fewer than
    /// three groups, from the fit to all frames.
    pub crossed: Vec<f64>,
    /// Number of folds; 0 without cross-validation.
    pub folds: usize,
}

impl Factor {
    fn new(file: &ModelFile) -> Result<(Self, UnitCosts)> {
        let model = file.to_model()?;
        let layout = InputLayout::of_model(&model)?;
        let carried = layout.scene_features.last()
            == Some(&SceneFeature { quantity: SceneQuantity::EstimatedSeconds, log: true });
        let (Some(parts), Some(costs), true) = (model.prednet.as_ref(), layout.unit_costs, carried) else {
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
        // If each input has its mean, all standardized inputs are 0, also that of the estimated seconds.
        let mean: Vec<f32> = inputs.iter().map(|i| i.0 as f32).collect();
        let net = PredNet::new(parts)?;
        let total = libm::log(f64::from(net.predict(&mean, &mut net.scratch(1)?)));
        let mut out = Self {
            file: file.clone(),
            parts: parts.clone(),
            inputs,
            deviation,
            weights,
            constant: 0.0,
            root_mean_square: libm::sqrt(square).max(1e-3),
            range: InputRange::of(&model, layout.width())?,
            layout,
        };
        let psi = out.activations(&mean);
        out.constant = total - mean.last().map_or(0.0, |&m| f64::from(m)) - dot(&psi, &out.weights);
        Ok((out, costs))
    }

    /// Returns the inputs of the last layer, without the estimated seconds, multiplied by the standard
    /// deviation of the network's output.
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

    /// Returns the model file with the fitted costs and the fitted last layer.
    fn with(&self, fitted: &CostFit, cached_voxels: f64) -> Result<ModelFile> {
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
        layout.unit_costs = Some(UnitCosts { seconds: fitted.costs, cached_voxels });
        layout.cached_voxels = cached_voxels;
        layout.store(&parts, &mut file)?;
        Ok(file)
    }
}

impl Default for PriorModel {
    /// The unit costs of a software renderer.
    fn default() -> Self {
        Self::typical(&UnitCosts::SOFTWARE)
    }
}

impl PriorModel {
    /// Returns the prior made from `files`. For analytic models of different machines, it is the geometric
    /// mean of their unit costs and of their numbers of cached voxels. An analytic model times a learned factor
    /// must be the only file, and is the prior itself. Without files, the prior is `typical`, the typical costs
    /// of this kind of renderer.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Unsupported`] for other models.
    pub fn new(files: &[ModelFile], typical: &UnitCosts) -> Result<Self> {
        if files.is_empty() {
            return Ok(Self::typical(typical));
        }
        let (mut logs, mut cached, mut known) = ([0.0; COSTS], 0.0, [true; COSTS]);
        for file in files {
            let Some(model) = AnalyticModel::from_model(&file.to_model()?)? else {
                if files.len() > 1 {
                    bail!(Unsupported, "{NOT_A_PRIOR}");
                }
                let (factor, costs) = Factor::new(file)?;
                return Ok(Self { known: costs.seconds.map(|c| c > 0.0), costs, factor: Some(factor) });
            };
            let own = model.costs();
            let costs = with_unknown(&own, typical);
            for i in 0..COSTS {
                logs[i] += libm::log(costs.seconds[i]) / files.len() as f64;
                known[i] &= own.seconds[i] > 0.0;
            }
            cached += libm::log(costs.cached_voxels) / files.len() as f64;
        }
        let costs = UnitCosts { seconds: logs.map(libm::exp), cached_voxels: libm::round(libm::exp(cached)) };
        Ok(Self { costs, known, factor: None })
    }

    /// The typical costs of a kind of renderer as a prior.
    fn typical(costs: &UnitCosts) -> Self {
        Self { costs: *costs, known: costs.seconds.map(|c| c > 0.0), factor: None }
    }

    /// Unit costs of the prior; 0 for work whose cost the prior lacks.
    pub fn costs(&self) -> &UnitCosts {
        &self.costs
    }

    /// Input layout of the prior's factor; `None` for a prior without a factor, which uses only a frame's
    /// work.
    pub fn layout(&self) -> Option<&InputLayout> {
        self.factor.as_ref().map(|f| &f.layout)
    }

    /// Number of values in a row of the factor's inputs.
    pub(crate) fn width(&self) -> usize {
        self.factor.as_ref().map_or(0, |f| f.inputs.len())
    }

    /// Number of rays along each side of the probe with which the factor was fitted; 0 if any number may be
    /// used.
    pub(crate) fn probe_side(&self) -> usize {
        self.factor.as_ref().map_or(0, |f| f.layout.probe_side)
    }

    /// Writes a row of the factor's inputs.
    ///
    /// # Errors
    /// [`crate::ErrorKind::MissingInput`] where an input was not supplied.
    pub(crate) fn write(&self, inputs: &Inputs<'_>, row: &mut [f32]) -> Result<()> {
        match &self.factor {
            Some(factor) => factor.layout.write(inputs, row),
            None => Ok(()),
        }
    }

    /// Fits unit costs, the weights of the learned factor and the common speed to `frames`. `prior` holds the
    /// prior unit costs. The work of `frames` must be computed for the number of cached voxels in `prior`.
    fn fit(&self, prior: &UnitCosts, frames: &[&FitRow]) -> CostFit {
        let (weights, weight_sd): (&[f64], f64) = match &self.factor {
            Some(f) => (&f.weights, FACTOR_SD * f.root_mean_square),
            None => (&[], 1.0),
        };
        let cost_sd = self.known.map(|known| if known { COST_SD } else { UNKNOWN_SD });
        CostFit::new(&Expected { costs: &prior.seconds, cost_sd, weights, weight_sd }, frames)
    }

    /// Fits a model to frames of this machine. `renderers` holds the typical costs of each kind of renderer
    /// that may have drawn the frames. The model is that of the first kind, unless another kind has a clearly
    /// smaller error in cross-validation. For work whose cost the prior model lacks, the prior is a tenth of
    /// the typical cost, scaled to the speed of the prior model. Costs that are 0 in the prior model and in
    /// the typical costs stay 0. Then other numbers of cached voxels are compared, each by its error in
    /// cross-validation; without cross-validation, the prior's number stays.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] without frames or typical costs, for a time that is not positive, if
    /// rows do not fit the prior's factor, or if the fit predicts a time that is not finite.
    pub fn choose(
        &self,
        frames: &[Observed],
        renderers: &[UnitCosts],
        executor: Executor<'_>,
    ) -> Result<Chosen> {
        let inputs = self.width();
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
        let mut prepared: Vec<FitRow> = frames
            .iter()
            .map(|f| FitRow {
                psi: self.factor.as_ref().map_or(Vec::new(), |factor| factor.activations(&f.row)),
                work: f.work,
                log: libm::log(f.seconds),
            })
            .collect();
        let folds = folds(frames);
        let mut count = folds.iter().max().map_or(0, |m| m + 1);
        if count < FEWEST_GROUPS {
            count = 0;
        }
        let Some((first, others)) = renderers.split_first() else {
            bail!(InvalidArgument, "no typical costs of a renderer were given; give at least one set")
        };
        let mut fit = |prior: UnitCosts| -> Result<(f64, UnitCosts, Chosen)> {
            let chosen = self.fit_from(&prior, frames, &mut prepared, (&folds, count), executor)?;
            // Both errors count equally: their geometric mean decides.
            let (median, rmse_over_sd) = chosen.errors(frames);
            Ok((libm::sqrt(median * rmse_over_sd), prior, chosen))
        };
        let mut best = fit(with_unknown(&self.costs, first))?;
        if count > 0 {
            for renderer in others {
                take_better(&mut best, fit(with_unknown(&self.costs, renderer)));
            }
            // If inputs of the factor were computed with a number of cached voxels, this number is kept.
            let far = |factor: &Factor| factor.layout.scene_features.iter().any(|f| f.quantity.is_far());
            let compared = if self.factor.as_ref().is_some_and(far) { &[][..] } else { &CACHED_VOXELS };
            for &cached_voxels in compared {
                let prior = UnitCosts { cached_voxels, ..best.1 };
                if prior != best.1 {
                    take_better(&mut best, fit(prior));
                }
            }
        }
        Ok(best.2)
    }

    /// Fits a model with `prior` as the unit costs of the prior.
    fn fit_from(
        &self,
        prior: &UnitCosts,
        frames: &[Observed],
        prepared: &mut [FitRow],
        (folds, count): (&[usize], usize),
        executor: Executor<'_>,
    ) -> Result<Chosen> {
        for (row, frame) in prepared.iter_mut().zip(frames) {
            row.work = prior.work(&frame.work);
        }
        let prepared = &*prepared;
        // The fit to all frames, then the fits without each fold.
        let mut fits: Vec<(usize, Option<CostFit>)> = (0..=count).map(|part| (part, None)).collect();
        each(executor, &mut fits, &|(part, fit): &mut (usize, Option<CostFit>)| {
            let kept = prepared.iter().zip(folds).filter(|(_, f)| *part == 0 || **f + 1 != *part);
            *fit = Some(self.fit(prior, &kept.map(|(p, _)| p).collect::<Vec<_>>()));
        });
        let fits: Vec<CostFit> = fits.into_iter().filter_map(|(_, fit)| fit).collect();
        let without = |fold: usize| &fits[if count == 0 { 0 } else { fold + 1 }];
        let crossed: Vec<f64> =
            prepared.iter().zip(folds).map(|(p, &f)| libm::exp(without(f).log_seconds(p))).collect();
        if !crossed.iter().all(|p| p.is_finite()) {
            bail!(
                InvalidArgument,
                "a fit to these frames predicts a time that is not finite; check the measured times"
            );
        }
        let file = match &self.factor {
            Some(factor) => factor.with(&fits[0], prior.cached_voxels)?,
            None => {
                let works = frames.iter().map(|f| &f.work);
                let costs = UnitCosts { seconds: fits[0].unit_costs(), cached_voxels: prior.cached_voxels };
                AnalyticModel::from_costs(costs)?.ranging_over(works).to_model_file()?
            }
        };
        Ok(Chosen { file, crossed, folds: count })
    }
}

impl Chosen {
    /// Cross-validated errors on the frames of the fit: the median of |predicted / measured − 1|, and RMSE/SD.
    pub(super) fn errors(&self, frames: &[Observed]) -> (f64, f64) {
        let pairs: Vec<(f64, f64)> = self.crossed.iter().zip(frames).map(|(&p, f)| (p, f.seconds)).collect();
        let mut relative: Vec<f64> = pairs.iter().map(|(p, t)| (p / t - 1.0).abs()).collect();
        (median(&mut relative).unwrap_or(f64::NAN), rmse_over_sd(&pairs).unwrap_or(f64::NAN))
    }
}

/// Replaces the best fit so far, with its error, by one whose error is clearly smaller.
fn take_better(best: &mut (f64, UnitCosts, Chosen), other: Result<(f64, UnitCosts, Chosen)>) {
    match other {
        Ok(other) if other.0 < LESS_ERROR * best.0 => *best = other,
        _ => {}
    }
}

/// Returns unit costs in which each 0 of `costs` is replaced by [`ZERO_SHARE`] times the cost in `renderer`,
/// scaled to the speed of `costs`.
fn with_unknown(costs: &UnitCosts, renderer: &UnitCosts) -> UnitCosts {
    let known = costs.seconds.iter().zip(&renderer.seconds).filter(|(c, r)| **c > 0.0 && **r > 0.0);
    let mut ratios: Vec<f64> = known.map(|(c, r)| c / r).collect();
    let speed = median(&mut ratios).unwrap_or(1.0);
    let mut out = *costs;
    for (cost, typical) in out.seconds.iter_mut().zip(&renderer.seconds) {
        if *cost == 0.0 {
            *cost = ZERO_SHARE * speed * typical;
        }
    }
    out
}

/// Returns the inputs of a network's last layer for standardized inputs of the network.
fn hidden_activations(parts: &PredNetParts, mut values: Vec<f64>) -> Vec<f64> {
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

/// Returns the fold of each frame in cross-validation. All frames of a group are in the same fold, and folds
/// have similar numbers of frames.
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
