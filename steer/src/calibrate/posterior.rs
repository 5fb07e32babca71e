//! Fits unit costs to frames of this machine, with unit costs of other machines as prior. One of
//! [`CACHED_VOXELS`] replaces the prior's number of cached voxels if it clearly reduces the error in
//! cross-validation. [`CostFit`] does the fit.

use crate::features::PROBE_SIDE;
use crate::numeric::{median, rmse_over_sd};
use crate::predict::{AnalyticModel, COST_SD, COSTS, CostFit, FitRow, Predictor, UnitCosts};
use alloc::collections::BTreeMap;
use alloc::vec;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::model::ModelFile;

/// Prior standard deviation of the logarithm of a unit cost that the prior model lacks.
const UNKNOWN_SD: f64 = 1.5;

/// Prior of a cost that is 0 in a machine's model, as a share of the cost in an equally fast typical
/// renderer. The cost is 0 because frames of that machine could not separate two kinds of work; frames of
/// this machine may separate them.
const ZERO_SHARE: f64 = 0.1;

/// Numbers of cached voxels that a fit compares ([`UnitCosts::cached_voxels`]): 8 to 64 MB in a renderer that
/// packs a voxel into four bytes.
const CACHED_VOXELS: [f64; 4] = [2.0e6, 4.0e6, 8.0e6, 16.0e6];

/// Share of the smallest error so far. A fit with another kind of renderer, or with another number of cached
/// voxels, replaces the best fit if its error is below this share.
const LESS_ERROR: f64 = 0.95;

/// Largest number of folds in cross-validation.
const FOLDS: usize = 7;

/// Smallest number of groups of frames for cross-validation.
pub(super) const FEWEST_GROUPS: usize = 3;

/// Returns the prior unit costs of a fit, made from `files`, analytic models of different machines: the
/// geometric mean of their unit costs and of their numbers of cached voxels. For work whose cost a file
/// lacks, the mean has a tenth of the cost in `typical`, scaled to the file's speed. Without files, the prior
/// is `typical`, the typical costs of this kind of renderer. Also returns the number of rays along each side
/// of the probe with which the work of frames must be computed: the largest number of a file, or
/// [`PROBE_SIDE`] without files.
///
/// # Errors
/// [`crate::ErrorKind::Unsupported`] for a model that is not analytic, and as [`ModelFile::to_model`] and
/// [`AnalyticModel::from_model`].
pub fn prior_costs(files: &[ModelFile], typical: &UnitCosts) -> Result<(UnitCosts, usize)> {
    PriorModel::new(files, typical).map(|prior| (prior.costs, prior.probe_side))
}

/// Fits a model to frames of this machine, from the prior models `files`. `renderers` holds the typical costs
/// of each kind of renderer that may have drawn the frames; those of the first kind are the prior if there
/// are no files ([`prior_costs`]). The model is that of the first kind, unless another kind has a clearly
/// smaller error in cross-validation. Costs that are 0 in the prior and in the typical costs stay 0. Then
/// numbers of cached voxels that differ from the prior's are tried, each by its error in cross-validation;
/// without cross-validation, the prior's number stays. The model states the probe of [`prior_costs`].
///
/// # Errors
/// As [`prior_costs`]; [`crate::ErrorKind::InvalidArgument`] without frames or typical costs, for a time that
/// is not positive, or if the fit predicts a time that is not finite.
pub fn fit_frames(files: &[ModelFile], renderers: &[UnitCosts], frames: &[Observed]) -> Result<Chosen> {
    PriorModel::new(files, renderers.first().unwrap_or(&UnitCosts::SOFTWARE))?.choose(frames, renderers)
}

/// Prior of a calibration: unit costs.
#[derive(Clone, Debug)]
pub(super) struct PriorModel {
    /// Unit costs; 0 for work whose typical cost is 0 and whose cost is missing in at least one of the
    /// prior's models.
    pub(super) costs: UnitCosts,
    /// True for costs that the prior's models have, false for guesses.
    known: [bool; COSTS],
    /// Rays along each side of the probe of the fitted models.
    pub(super) probe_side: usize,
}

/// One frame to which a model is fitted.
#[derive(Clone, Debug)]
pub struct Observed {
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

impl Default for PriorModel {
    /// The unit costs of a software renderer.
    fn default() -> Self {
        Self::typical(&UnitCosts::SOFTWARE)
    }
}

impl PriorModel {
    /// Returns the prior of [`prior_costs`].
    pub(super) fn new(files: &[ModelFile], typical: &UnitCosts) -> Result<Self> {
        if files.is_empty() {
            return Ok(Self::typical(typical));
        }
        let (mut logs, mut cached, mut known, mut probe_side) = ([0.0; COSTS], 0.0, [true; COSTS], 0);
        for file in files {
            let Some(model) = AnalyticModel::from_model(&file.to_model()?)? else {
                bail!(
                    Unsupported,
                    "a calibration starts from the unit costs of an analytic model; this model is of \
                     another kind. Give a model that `entire calibrate` made, or none"
                );
            };
            let own = model.costs();
            let costs = with_unknown(&own, typical);
            for i in 0..COSTS {
                logs[i] += libm::log(costs.seconds[i]) / files.len() as f64;
                known[i] &= own.seconds[i] > 0.0;
            }
            cached += libm::log(costs.cached_voxels) / files.len() as f64;
            probe_side = probe_side.max(model.probe_side());
        }
        let costs = UnitCosts { seconds: logs.map(libm::exp), cached_voxels: libm::round(libm::exp(cached)) };
        Ok(Self { costs, known, probe_side })
    }

    /// The typical costs of a kind of renderer as a prior.
    fn typical(costs: &UnitCosts) -> Self {
        Self { costs: *costs, known: costs.seconds.map(|c| c > 0.0), probe_side: PROBE_SIDE }
    }

    /// Fits unit costs to `frames`. `prior` holds the prior unit costs. The work of `frames` must be computed
    /// for the number of cached voxels in `prior`.
    fn fit(&self, prior: &UnitCosts, frames: &[&FitRow]) -> CostFit {
        let cost_sd = self.known.map(|known| if known { COST_SD } else { UNKNOWN_SD });
        CostFit::new(&prior.seconds, &cost_sd, frames)
    }

    /// Fits a model as [`fit_frames`] does.
    pub(super) fn choose(&self, frames: &[Observed], renderers: &[UnitCosts]) -> Result<Chosen> {
        if frames.is_empty() {
            bail!(InvalidArgument, "there are no frames to calibrate to; observe some first");
        }
        for (i, f) in frames.iter().enumerate() {
            if !(f.seconds.is_finite() && f.seconds > 0.0) {
                bail!(
                    InvalidArgument,
                    "frame {i} took {} seconds; times must be finite and positive",
                    f.seconds
                );
            }
        }
        let mut prepared: Vec<FitRow> =
            frames.iter().map(|f| FitRow { work: f.work, log: libm::log(f.seconds) }).collect();
        let folds = folds(frames);
        let mut count = folds.iter().max().map_or(0, |m| m + 1);
        if count < FEWEST_GROUPS {
            count = 0;
        }
        let Some((first, others)) = renderers.split_first() else {
            bail!(InvalidArgument, "no typical costs of a renderer were given; give at least one set")
        };
        let mut fit = |prior: UnitCosts| -> Result<(f64, UnitCosts, Chosen)> {
            let chosen = self.fit_from(&prior, frames, &mut prepared, (&folds, count))?;
            // The median error and RMSE/SD count equally: their geometric mean decides.
            let (median, rmse_over_sd) = chosen.errors(frames);
            // If all times are equal, RMSE/SD is not finite, and the median error decides.
            let other = if rmse_over_sd.is_finite() { rmse_over_sd } else { median };
            Ok((libm::sqrt(median * other), prior, chosen))
        };
        let mut best = fit(with_unknown(&self.costs, first))?;
        if count > 0 {
            for renderer in others {
                take_better(&mut best, fit(with_unknown(&self.costs, renderer)));
            }
            for cached_voxels in CACHED_VOXELS {
                let prior = UnitCosts { cached_voxels, ..best.1 };
                if prior != best.1 {
                    take_better(&mut best, fit(prior));
                }
            }
        }
        Ok(best.2)
    }

    /// Fits a model to all frames and, for cross-validation, one model per fold to the frames outside the
    /// fold. `prior` holds the prior unit costs.
    fn fit_from(
        &self,
        prior: &UnitCosts,
        frames: &[Observed],
        prepared: &mut [FitRow],
        (folds, count): (&[usize], usize),
    ) -> Result<Chosen> {
        for (row, frame) in prepared.iter_mut().zip(frames) {
            row.work = prior.work(&frame.work);
        }
        let prepared = &*prepared;
        // The fit to all frames, then the fits without each fold.
        let fit = |part: usize| {
            let kept = prepared.iter().zip(folds).filter(|(_, f)| part == 0 || **f + 1 != part);
            self.fit(prior, &kept.map(|(p, _)| p).collect::<Vec<_>>())
        };
        let fits: Vec<CostFit> = (0..=count).map(fit).collect();
        let without = |fold: usize| &fits[if count == 0 { 0 } else { fold + 1 }];
        let crossed: Vec<f64> =
            prepared.iter().zip(folds).map(|(p, &f)| libm::exp(without(f).log_seconds(p))).collect();
        if !crossed.iter().all(|p| p.is_finite()) {
            bail!(
                InvalidArgument,
                "a fit to these frames predicts a time that is not finite; check the measured times"
            );
        }
        let works = frames.iter().map(|f| &f.work);
        let costs = UnitCosts { seconds: fits[0].unit_costs(), cached_voxels: prior.cached_voxels };
        let model = AnalyticModel::from_costs(costs)?.with_probe_side(self.probe_side);
        let file = model.ranging_over(works).to_model_file()?;
        Ok(Chosen { file, crossed, folds: count })
    }
}

impl Chosen {
    /// Cross-validated errors on the frames of the fit: the median of |predicted / measured − 1|, and
    /// RMSE/SD.
    pub(super) fn errors(&self, frames: &[Observed]) -> (f64, f64) {
        let pairs: Vec<(f64, f64)> = self.crossed.iter().zip(frames).map(|(&p, f)| (p, f.seconds)).collect();
        let mut relative: Vec<f64> = pairs.iter().map(|(p, t)| (p / t - 1.0).abs()).collect();
        (median(&mut relative).unwrap_or(f64::NAN), rmse_over_sd(&pairs).unwrap_or(f64::NAN))
    }
}

/// Replaces `best`, the best fit so far with its error, by `other` if the latter's error is clearly smaller.
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
