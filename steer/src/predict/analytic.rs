//! The analytic cost model: unit costs times estimated work.

use super::cost_fit::{COST_SD, CostFit, FitRow};
use super::layout::stored_cached_voxels;
use super::network::Stored;
use super::quality::KnownQuality;
use super::{
    Clock, CostTerms, GroupKind, InputLayout, InputRange, Inputs, LONGEST_FRAME, Prediction, Predictor,
    Quality, Source, UPPER_LEVEL, UpperBound,
};
use crate::features::{
    COMMON_COSTS, COST_QUANTITIES, COSTS, FrameFeatures, MAX_PROBE_SIDE, PROBE_SIDE, SceneFeature, Setting,
    UnitCosts,
};
use crate::numeric::dot;
use alloc::collections::BTreeMap;
use alloc::string::String;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::model::{Key, Model, ModelFile};
use entire_core::nn::{DenseParts, Dtype, PredNetParts, Target};

/// Number of separately corrected terms of a cost; each term holds one or more unit costs.
pub(crate) const TERMS: usize = 9;

/// Term of each unit cost; costs that scale together on every machine share a term.
const PART_OF: [usize; COSTS] =
    [0, 1, 2, 3, 4, 5, 3, 3, 6, 7, 8, 8, 3, 5, 5, 3, 6, 8, 5, 5, 5, 4, 4, 3, 8, 4, 3, 8];

impl UnitCosts {
    /// Returns the first cost that is negative or not finite, with its name.
    fn invalid(&self) -> Option<(&'static str, f64)> {
        self.named().find(|(_, cost)| !(cost.is_finite() && *cost >= 0.0))
    }

    /// Returns the costs as JSON, for [`Key::UnitCosts`] of a model file.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for costs that JSON cannot represent.
    pub(crate) fn to_json(self) -> Result<String> {
        let costs: BTreeMap<&str, f64> = self.named().collect();
        match serde_json::to_string(&costs) {
            Ok(text) => Ok(text),
            Err(e) => bail!(InvalidArgument, "the unit costs cannot be written as JSON: {e}"),
        }
    }

    /// Returns the unit costs in a model file; `None` if the file has none.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidModel`] for an entry that is not a JSON object of numbers, an unknown
    /// name, a cost that is negative or not finite, costs that are all zero, and a number of cached voxels
    /// that is not finite and positive.
    pub(crate) fn of(model: &Model) -> Result<Option<Self>> {
        let Some(text) = model.metadata.get(Key::UnitCosts.name()) else { return Ok(None) };
        let named: BTreeMap<String, f64> = match serde_json::from_str(text) {
            Ok(named) => named,
            Err(e) => bail!(InvalidModel, "{} is no JSON object of names and seconds: {e}", Key::UnitCosts),
        };
        let mut out = Self { seconds: [0.0; COSTS], cached_voxels: stored_cached_voxels(model)? };
        for (name, &cost) in &named {
            let Some(at) = out.named().position(|(n, _)| n == name) else {
                bail!(InvalidModel, "{} names {name:?}, which is not a known unit cost", Key::UnitCosts);
            };
            out.seconds[at] = cost;
        }
        if let Some((name, cost)) = out.invalid() {
            bail!(InvalidModel, "{}: {name} is {cost}; it must be finite and not negative", Key::UnitCosts);
        }
        if out.seconds.iter().all(|&c| c == 0.0) {
            bail!(InvalidModel, "{} holds no positive cost", Key::UnitCosts);
        }
        Ok(Some(out))
    }
}

/// Smallest number of scene features in a file of unit costs; a file of one layer with fewer scene features
/// is loaded as a network.
const FEWEST_NAMES: usize = 11;

/// Lower clamp of predicted times, in seconds.
const MIN_SECONDS: f32 = 1.0e-9;

/// Upper clamp of predicted times, in seconds.
const MAX_SECONDS: f32 = 1.0e9;

/// Linear cost model: seconds = cost per frame + Σ unit cost · work, over all kinds of work. No cost is
/// negative, so no prediction is negative, and none falls with a finer step. With more pixels, only the part
/// that waits for memory may fall ([`FrameFeatures::quantities`]).
#[derive(Clone, Debug, PartialEq)]
pub struct AnalyticModel {
    costs: UnitCosts,
    fitted: bool,
    /// Number of rays along each side of the probe; the costs were fitted to counts by this probe.
    probe_side: usize,
    /// Calibration of [`Prediction::upper`].
    pub(super) calibration: UpperBound,
    /// Range of the training frames' [`range_point`]s; `None` if the range is unknown.
    range: Option<InputRange>,
    /// Clock of the file that the costs come from.
    clock: Option<Clock>,
    /// Picture quality law in the file, with its renderer.
    quality: Option<KnownQuality>,
}

impl Default for AnalyticModel {
    /// The model of an unmeasured machine: unit costs of a software renderer on two processors.
    fn default() -> Self {
        Self {
            costs: UnitCosts::SOFTWARE,
            fitted: false,
            probe_side: PROBE_SIDE,
            calibration: UpperBound::default(),
            range: None,
            clock: None,
            quality: None,
        }
    }
}

impl AnalyticModel {
    /// Returns a model with the given unit costs.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a cost that is negative or not finite, or if all costs are
    /// zero.
    pub(crate) fn from_costs(costs: UnitCosts) -> Result<Self> {
        if let Some((name, cost)) = costs.invalid() {
            bail!(InvalidArgument, "the unit cost {name} is {cost}; it must be finite and not negative");
        }
        if costs.seconds.iter().all(|&c| c == 0.0) {
            bail!(InvalidArgument, "all unit costs are zero; at least one must be positive");
        }
        Ok(Self { costs, fitted: true, ..Self::default() })
    }

    /// Sets the training range to that of frames with the given work.
    #[cfg(feature = "calibrate")]
    pub(crate) fn ranging_over<'a>(mut self, works: impl Iterator<Item = &'a [f64; COSTS]>) -> Self {
        self.range = Some(range_of(works));
        self
    }

    /// States the number of rays along each side of the probe with which work must be counted.
    #[cfg(feature = "calibrate")]
    pub(crate) fn with_probe_side(self, probe_side: usize) -> Self {
        Self { probe_side, ..self }
    }

    /// Fits a model to measured frames, given as pairs of work ([`FrameFeatures::cost_work`]) and seconds.
    /// The prior is `default`, scaled to the speed of the measured frames. The upper bound is calibrated on
    /// the same frames. Costs of work that no measurement has keep their prior values; costs that are 0 in
    /// `default` stay 0. `probe_side` is the number of rays along each side of the probe with which the
    /// caller counted the work; the model stores this number, clamped to the range 1 to [`MAX_PROBE_SIDE`].
    /// The fit ignores frames with a time that is not positive or over
    /// [`LONGEST_FRAME`](super::LONGEST_FRAME), with work that is negative or not finite, or without work.
    /// Also returns |predicted / measured − 1| of the frames that are not ignored.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] if no measurement is usable, or if a fitted cost is not
    /// finite or none is positive.
    pub fn fit(
        default: &UnitCosts,
        measurements: &[([f64; COSTS], f64)],
        probe_side: usize,
    ) -> Result<(Self, Vec<f64>)> {
        let usable: Vec<&([f64; COSTS], f64)> = measurements
            .iter()
            .filter(|(work, seconds)| {
                *seconds > 0.0
                    && *seconds <= f64::from(LONGEST_FRAME)
                    && work.iter().all(|w| w.is_finite() && *w >= 0.0)
                    && work.iter().any(|w| *w > 0.0)
            })
            .collect();
        if usable.is_empty() {
            bail!(
                InvalidArgument,
                "none of {} measurements has a positive time of at most {LONGEST_FRAME} seconds and finite work; measure \
                 some frames first",
                measurements.len()
            );
        }
        let rows: Vec<FitRow> = usable
            .iter()
            .map(|(work, seconds)| FitRow { work: default.work(work), log: libm::log(*seconds) })
            .collect();
        let fitted = CostFit::new(&default.seconds, &[COST_SD; COSTS], &rows.iter().collect::<Vec<_>>());
        let costs = fitted.unit_costs();
        if !costs.iter().all(|c| c.is_finite()) || costs.iter().all(|&c| c <= 0.0) {
            bail!(InvalidArgument, "the measurements give no positive cost; check that times are in seconds");
        }
        let predicted = rows.iter().map(|row| dot(&costs, &row.work).max(1.0e-30));
        let logs = usable.iter().zip(predicted).map(|((_, seconds), p)| libm::log(seconds / p));
        let model = Self {
            costs: UnitCosts { seconds: costs, cached_voxels: default.cached_voxels },
            fitted: true,
            probe_side: probe_side.clamp(1, MAX_PROBE_SIDE),
            calibration: UpperBound::from_groups(logs.map(|log| (log, ()))),
            range: Some(range_of(usable.iter().map(|(work, _)| work))),
            ..Self::default()
        };
        let error =
            |(work, seconds): &&([f64; COSTS], f64)| libm::fabs(model.costs.time(work) / seconds - 1.0);
        let errors = usable.iter().map(error).collect();
        Ok((model, errors))
    }

    /// Number of unit costs up to the last one that is not 0, but at least `least`.
    fn used(&self, least: usize) -> usize {
        self.costs.seconds.iter().rposition(|&c| c != 0.0).map_or(least, |last| least.max(last + 1))
    }

    /// Returns the model as a file with one dense layer that predicts seconds. Its scene features are
    /// [`COST_QUANTITIES`], without those at the end that only some renderers need and whose costs are 0.
    /// Calibration and range are stored under [`Key::Calibration`].
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidTensor`] if a cost overflows single precision.
    pub fn to_model_file(&self) -> Result<ModelFile> {
        let mut file = ModelFile::default();
        let used = self.used(COMMON_COSTS);
        let parts = PredNetParts {
            layers: alloc::vec![DenseParts {
                inputs: used - 1,
                outputs: 1,
                weight: self.costs.seconds[1..used].iter().map(|&c| c as f32).collect(),
                bias: alloc::vec![self.costs.seconds[0] as f32],
                dtype: Dtype::F32,
            }],
            input: None,
            output: None,
            target: Target::Seconds,
        };
        let features = COST_QUANTITIES[..used - 1]
            .iter()
            .map(|&quantity| SceneFeature { quantity, log: false })
            .collect();
        let mut layout = InputLayout::new(&[GroupKind::SceneFeatures], features, 0, 0)?;
        layout.probe_side = self.probe_side;
        layout.cached_voxels = self.costs.cached_voxels;
        layout.store(&parts, &mut file)?;
        let (low, high) = self.range.as_ref().map(InputRange::ends).unzip();
        let stored = Stored {
            level: UPPER_LEVEL,
            log_factor: Some(self.calibration.log_factor).filter(|f| f.is_finite()),
            low,
            high,
            input_low: None,
            input_high: None,
        };
        file.metadata.insert(Key::Calibration.into(), stored.to_json()?);
        Ok(file)
    }

    /// Reads a file of [`AnalyticModel::to_model_file`]; `None` for any other model.
    ///
    /// # Errors
    /// As [`InputLayout::of_model`]; [`crate::ErrorKind::InvalidModel`] for an invalid calibration or
    /// quality law in the file.
    pub fn from_model(model: &Model) -> Result<Option<Self>> {
        let names = &model.scene_features;
        let Some(net) = model.prednet.as_ref() else { return Ok(None) };
        let [layer] = &net.layers[..] else { return Ok(None) };
        // Names must be in ascending order without repetition; costs that the file does not name are zero.
        let mut places = Vec::with_capacity(names.len());
        for name in names {
            match COST_QUANTITIES.iter().position(|q| name == q.name()) {
                Some(at) if places.last().is_none_or(|last| *last < at) => places.push(at),
                _ => return Ok(None),
            }
        }
        let fits = model.inputs.len() == 1
            && names.len() >= FEWEST_NAMES
            && net.input.is_none()
            && net.output.is_none()
            && net.target == Target::Seconds
            && layer.weight.iter().chain(&layer.bias).all(|&w| w >= 0.0);
        if !fits {
            return Ok(None);
        }
        let mut costs = [0.0; COSTS];
        costs[0] = f64::from(layer.bias[0]);
        for (at, &w) in places.into_iter().zip(&layer.weight) {
            costs[at + 1] = f64::from(w);
        }
        if costs.iter().all(|&c| c == 0.0) {
            return Ok(None);
        }
        let layout = InputLayout::of_model(model)?;
        let costs = UnitCosts { seconds: costs, cached_voxels: layout.cached_voxels };
        let mut out = Self::from_costs(costs)?;
        out.probe_side = layout.probe_side.clamp(1, MAX_PROBE_SIDE);
        out.clock = Clock::of(model);
        out.quality = KnownQuality::of(model)?;
        if let Some(stored) = Stored::of(model)? {
            out.calibration = UpperBound { log_factor: stored.log_factor.unwrap_or(f32::NAN) };
            out.range = InputRange::of_ends(stored.low, stored.high, RANGE_TERMS)?;
        }
        Ok(Some(out))
    }

    /// The unit costs.
    pub fn costs(&self) -> UnitCosts {
        self.costs
    }

    /// Returns the out-of-range score of a frame with this work; NaN for an unknown range.
    fn score(&self, work: &[f64; COSTS]) -> f32 {
        self.range.as_ref().map_or(f32::NAN, |range| range.score(&range_point(work)))
    }

    /// Returns the predicted terms of a frame's time at a setting.
    pub(crate) fn parts(&self, features: &FrameFeatures, setting: &Setting) -> CostTerms {
        let work = self.costs.work(&features.cost_work(setting));
        let mut sums = [0.0f64; TERMS];
        for ((cost, amount), part) in self.costs.seconds.iter().zip(&work).zip(PART_OF) {
            sums[part] += cost * amount;
        }
        let mut parts: [f32; TERMS] = sums.map(finite);
        let sum: f32 = parts.iter().sum();
        parts[0] += (MIN_SECONDS - sum).max(0.0);
        CostTerms { parts, out_of_range: self.score(&work), source: Source::Analytic }
    }
}

impl Predictor for AnalyticModel {
    fn probe_side(&self) -> usize {
        self.probe_side
    }

    fn any_probe_side(&self) -> bool {
        true
    }

    fn predict(&mut self, inputs: &Inputs<'_>) -> Result<Prediction> {
        let terms = self.parts(inputs.features, &inputs.setting);
        let seconds = terms.seconds().clamp(MIN_SECONDS, MAX_SECONDS);
        Ok(Prediction {
            seconds,
            upper: self.calibration.upper(seconds),
            out_of_range: terms.out_of_range,
            source: Source::Analytic,
        })
    }

    fn terms(&mut self, inputs: &Inputs<'_>) -> Result<CostTerms> {
        Ok(self.parts(inputs.features, &inputs.setting))
    }

    fn check(&mut self, _: &Inputs<'_>) -> Result<()> {
        Ok(())
    }

    fn identity(&self) -> u32 {
        // Bytes are little-endian on every machine, so that a saved state can be loaded on all of them.
        // Trailing zero costs of the longest ray are left out, so that states saved without these costs stay
        // valid.
        let bytes = self.costs.seconds.map(f64::to_le_bytes);
        let mut hash = crc32fast::Hasher::new();
        hash.update(bytes[..self.used(COMMON_COSTS + 1)].as_flattened());
        if self.costs.cached_voxels != UnitCosts::CACHED_VOXELS {
            hash.update(&self.costs.cached_voxels.to_le_bytes());
        }
        hash.finalize()
    }

    fn clock(&self) -> Option<Clock> {
        self.clock
    }

    fn quality(&self, renderer: &str) -> Option<Quality> {
        KnownQuality::holds_for(self.quality.as_ref(), renderer)
    }

    fn log_sd(&self) -> Option<f32> {
        // Costs without a calibrated bound are assumed to have errors with a standard deviation of 0.3 in
        // ln(seconds).
        self.fitted.then(|| self.calibration.log_sd().unwrap_or(0.3))
    }
}

/// Number of quantities of a frame that are compared with the model's range.
const RANGE_TERMS: usize = 5;

fn range_of<'a>(works: impl Iterator<Item = &'a [f64; COSTS]>) -> InputRange {
    let rows: Vec<_> = works.map(range_point).collect();
    InputRange::of_rows(rows.as_flattened(), RANGE_TERMS, 0)
}

/// Returns the quantities of a frame that are compared with the model's range: logarithm of its pixels, and
/// logarithms of its rays, skips, samples and lane samples, each per pixel.
fn range_point(work: &[f64; COSTS]) -> [f32; RANGE_TERMS] {
    let log = |v: f64| libm::log(v + 1.0) as f32;
    let per_pixel = |v: f64| libm::log(v / work[1].max(1.0) + 0.01) as f32;
    [log(work[1]), per_pixel(work[2]), per_pixel(work[3]), per_pixel(work[4]), per_pixel(work[5])]
}

fn finite(v: f64) -> f32 {
    if v.is_finite() { (v as f32).clamp(0.0, MAX_SECONDS) } else { MAX_SECONDS }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::{Noise, median};

    const TRUTH: [f64; COSTS] = [
        2e-4, 6e-8, 2e-8, 9e-9, 4e-9, 2e-9, 4e-8, 3e-8, 9e-10, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
    ];

    /// Returns a prior that differs from [`TRUTH`]. In ln(cost), its costs are alternately above and below
    /// those of [`TRUTH`] by one standard deviation ([`COST_SD`]). Costs that are 0 in [`TRUTH`] are 1 ns if
    /// their index is below [`COMMON_COSTS`], otherwise 0.
    fn prior() -> UnitCosts {
        let mut costs = [1e-9; COSTS];
        costs[COMMON_COSTS..].fill(0.0);
        for (i, (cost, truth)) in costs.iter_mut().zip(&TRUTH).enumerate().take(9) {
            *cost = truth * libm::exp(if i % 2 == 0 { COST_SD } else { -COST_SD });
        }
        UnitCosts::new(costs)
    }

    /// Simulated measurements: counts span several decades, and no frame has single scattering.
    fn measurements(n: usize, noise: f64, outliers: bool) -> Vec<([f64; COSTS], f64)> {
        let mut noise_of = Noise(9);
        let mut uniform = || noise_of.uniform();
        (0..n)
            .map(|i| {
                let pixels = libm::exp(7.0 + 7.0 * uniform());
                let rays = pixels * (0.1 + 0.9 * uniform());
                let samples = rays * libm::exp(4.0 * uniform());
                let local = if i % 2 == 0 { samples * uniform() } else { 0.0 };
                let mut work = [0.0; COSTS];
                work[..9].copy_from_slice(&[
                    1.0,
                    pixels,
                    rays,
                    rays * 20.0 * uniform(),
                    samples,
                    samples * (1.0 + uniform()),
                    rays * 3.0 * uniform(),
                    rays * 6.0 * uniform(),
                    local,
                ]);
                work[COMMON_COSTS] = if i % 3 == 0 { samples } else { 0.0 };
                let mut seconds = dot(&TRUTH, &work) * libm::exp(noise * (uniform() + uniform() - 1.0));
                if outliers && i % 20 == 0 {
                    seconds *= 10.0;
                }
                (work, seconds)
            })
            .collect()
    }

    /// Median and 95th percentile of the errors of a fit.
    fn quantiles(mut errors: Vec<f64>) -> [f64; 2] {
        let middle = median(&mut errors).unwrap();
        [middle, errors[errors.len() * 95 / 100]]
    }

    #[test]
    fn exact_times_give_back_their_costs() {
        let rows = measurements(200, 0.0, false);
        let (model, errors) = AnalyticModel::fit(&prior(), &rows, PROBE_SIDE).unwrap();
        let [middle, p95] = quantiles(errors);
        assert!(middle < 4e-3 && p95 < 2e-2, "{middle} {p95}");
        for (i, (&c, &t)) in model.costs().seconds.iter().zip(&TRUTH).enumerate().take(9) {
            assert!((c / t - 1.0).abs() < 0.25, "{i}: {c} {t}");
        }
        // Costs that were never observed keep their default ratio to the other costs and are not zero.
        assert!(model.costs().seconds[9] > 0.0 && model.costs().seconds[10] > 0.0);
    }

    #[test]
    fn a_fit_keeps_the_number_of_cached_voxels_of_its_prior() {
        let index = |name: &str| 1 + COST_QUANTITIES.iter().position(|q| q.name() == name).unwrap();
        let machine = UnitCosts { cached_voxels: 2e6, ..UnitCosts::SOFTWARE };
        let frame = |i: usize| {
            let mut work = [0.0; COSTS];
            (work[0], work[index("samples")]) = (1.0, 1e6 * (1 + i % 7) as f64);
            work[index("far_samples")] = 5e5 * (i % 5) as f64;
            work[index("touched_voxels")] = 1e5 * libm::exp((i % 11) as f64 / 2.0);
            (work, machine.time(&work))
        };
        let rows: Vec<_> = (0..150).map(frame).collect();
        let (model, errors) = AnalyticModel::fit(&machine, &rows, PROBE_SIDE).unwrap();
        assert_eq!(model.costs().cached_voxels, 2e6);
        assert!(errors.iter().all(|e| *e < 1e-3), "{errors:?}");
    }

    #[test]
    fn what_costs_nothing_by_default_is_solved_for_where_it_is_asked_for() {
        let mut truth = TRUTH;
        truth[COMMON_COSTS] = 7e-9;
        let mut rows = measurements(200, 0.0, false);
        for (work, seconds) in &mut rows {
            *seconds = dot(&truth, work);
        }
        let fit = |costs| AnalyticModel::fit(costs, &rows, PROBE_SIDE).unwrap();
        let plain = prior();
        let mut with_conversion = plain;
        with_conversion.seconds[COMMON_COSTS] = UnitCosts::CONVERSION.seconds[COMMON_COSTS];
        let (plain, errors) = fit(&plain);
        let [middle, _] = quantiles(errors);
        assert!(plain.costs().seconds[COMMON_COSTS..].iter().all(|&c| c == 0.0) && middle > 0.02);
        let (asked, errors) = fit(&with_conversion);
        assert!(quantiles(errors)[0] < 5e-3);
        assert!((asked.costs().seconds[COMMON_COSTS] / 7e-9 - 1.0).abs() < 0.1, "{:?}", asked.costs());
        // The file names the quantities with nonzero costs, and gives the same unit costs, in single
        // precision, when it is read.
        for (model, names) in [(&plain, COMMON_COSTS - 1), (&asked, COMMON_COSTS)] {
            let file = model.to_model_file().unwrap().to_model().unwrap();
            assert_eq!(file.scene_features.len(), names);
            let back = AnalyticModel::from_model(&file).unwrap().unwrap();
            for (a, b) in back.costs().seconds.iter().zip(&model.costs().seconds) {
                assert_eq!(*a, f64::from(*b as f32));
            }
        }
    }

    #[test]
    fn noise_and_outliers_do_not_carry_it_away() {
        let noisy = measurements(200, 0.1, true);
        let (model, errors) = AnalyticModel::fit(&UnitCosts::SOFTWARE, &noisy, PROBE_SIDE).unwrap();
        let [middle, _] = quantiles(errors);
        assert!(middle < 0.06, "{middle}");
        let clean = measurements(50, 0.0, false);
        for (work, seconds) in &clean {
            let error = model.costs.time(work) / seconds - 1.0;
            assert!(error.abs() < 0.15, "{error}");
        }
        assert!(model.calibration.factor() > 1.0);
    }

    #[test]
    fn a_handful_of_equal_frames_is_enough_to_set_the_scale() {
        let (work, seconds) = measurements(1, 0.0, false)[0];
        let (model, _) = AnalyticModel::fit(&UnitCosts::SOFTWARE, &[(work, seconds); 3], PROBE_SIDE).unwrap();
        assert!((model.costs.time(&work) / seconds - 1.0).abs() < 0.02);
        let mut double = work;
        double.iter_mut().skip(1).for_each(|w| *w *= 2.0);
        let ratio = model.costs.time(&double) / seconds;
        assert!(ratio > 1.1 && ratio < 2.05, "{ratio}");
    }

    #[test]
    fn broken_measurements_are_left_out_and_all_broken_is_an_error() {
        let mut rows = measurements(20, 0.0, false);
        let work = rows[0].0;
        for seconds in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            rows.push((work, seconds));
        }
        rows.push(([f64::NAN; COSTS], 1.0));
        let fit = |rows: &[_]| AnalyticModel::fit(&UnitCosts::SOFTWARE, rows, PROBE_SIDE);
        let fitted = |rows: &[_]| fit(rows).map(|(model, errors)| (model, errors.len())).unwrap();
        assert_eq!(fitted(&rows), (fitted(&rows[..20]).0, 20));
        // A time over `LONGEST_FRAME` is left out; a time of exactly `LONGEST_FRAME` is used.
        let longest = f64::from(LONGEST_FRAME);
        assert_eq!(fitted(&[rows[0], (rows[1].0, longest)]).1, 2);
        assert_eq!(fitted(&[rows[0], (rows[1].0, longest * 1.001)]), fitted(&rows[..1]));
        assert!(fit(&rows[20..]).is_err() && fit(&[]).is_err());
        assert!(AnalyticModel::from_costs(UnitCosts::new([0.0; COSTS])).is_err());
        assert!(
            AnalyticModel::from_costs(UnitCosts::new([-1.0; COSTS]))
                .unwrap_err()
                .to_string()
                .contains("frame")
        );
    }

    #[test]
    fn the_number_of_cached_voxels_survives_a_file_and_must_be_positive() {
        let costs = UnitCosts { cached_voxels: 2.5e6, ..UnitCosts::SOFTWARE };
        let model = AnalyticModel::from_costs(costs).unwrap();
        let mut file = model.to_model_file().unwrap();
        let read = |file: &ModelFile| AnalyticModel::from_model(&file.to_model().unwrap());
        let back = read(&file).unwrap().unwrap();
        assert_eq!(back.costs().cached_voxels, 2.5e6);
        assert_ne!(back.identity(), AnalyticModel::from_costs(UnitCosts::SOFTWARE).unwrap().identity());
        for damaged in ["0", "-1", "NaN", "inf", "8 million", ""] {
            file.metadata.insert(Key::CachedVoxels.into(), damaged.into());
            let error = read(&file).unwrap_err();
            assert_eq!(error.kind(), entire_core::ErrorKind::InvalidModel);
            assert!(error.to_string().contains("entire.cached_voxels"), "{error}");
        }
        file.metadata.remove(Key::CachedVoxels.name());
        assert_eq!(read(&file).unwrap().unwrap().costs().cached_voxels, UnitCosts::CACHED_VOXELS);
    }

    #[test]
    fn the_shortest_time_is_a_limit_and_is_not_added() {
        use entire_core::scene::{Shading, Skipping};
        let mut seconds = [0.0; COSTS];
        seconds[1] = 1.0e-13;
        let model = AnalyticModel::from_costs(UnitCosts::new(seconds)).unwrap();
        for side in [1, 50, 99, 101] {
            let modes = (Shading::None, Skipping::None);
            let setting =
                Setting { step: 1.0, width: side, height: side, shading: modes.0, skipping: modes.1 };
            let expected = (1.0e-13 * (side * side) as f32).max(MIN_SECONDS);
            let found = model.parts(&FrameFeatures::default(), &setting).seconds();
            assert!((found / expected - 1.0).abs() < 1e-5, "{side}: {found} {expected}");
        }
    }

    #[test]
    fn a_probe_side_beyond_the_limits_is_clamped_and_survives_a_file() {
        let rows = measurements(1, 0.0, false);
        for (asked, side) in [(0, 1), (7, 7), (1000, MAX_PROBE_SIDE)] {
            let (model, _) = AnalyticModel::fit(&UnitCosts::SOFTWARE, &rows, asked).unwrap();
            let file = model.to_model_file().unwrap();
            let back = AnalyticModel::from_model(&file.to_model().unwrap()).unwrap().unwrap();
            assert_eq!(back.probe_side(), side);
        }
    }

    #[test]
    fn a_damaged_range_is_refused() {
        let mut file = AnalyticModel::default().to_model_file().unwrap();
        for (damaged, says) in [
            (r#""low":[0,0,0,0,0]"#, "5 inputs and upper limits for 0"),
            (r#""low":[0,0,0],"high":[1,1,1,1,1]"#, "3 inputs and upper limits for 5"),
            (r#""low":[0,2,0,0,0],"high":[1,1,1,1,1]"#, "input 1 has the limits 2 and 1"),
        ] {
            file.metadata.insert(Key::Calibration.into(), alloc::format!("{{\"level\":0.95,{damaged}}}"));
            let error = AnalyticModel::from_model(&file.to_model().unwrap()).unwrap_err();
            assert_eq!(error.kind(), entire_core::ErrorKind::InvalidModel);
            assert!(error.to_string().contains(says), "{error}");
        }
    }

    #[test]
    fn range_scores_rise_outside_what_was_seen() {
        let rows = measurements(100, 0.0, false);
        let mut far = rows[0].0;
        assert!(AnalyticModel::default().score(&far).is_nan());
        let (model, _) = AnalyticModel::fit(&UnitCosts::SOFTWARE, &rows, PROBE_SIDE).unwrap();
        assert_eq!(model.score(&far), 0.0);
        far[4] *= 1e5;
        assert!(model.score(&far) > 1.0);
    }
}
