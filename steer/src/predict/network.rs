//! Predictor that runs a network from a model file.

use super::quality::KnownQuality;
use super::{
    AnalyticModel, CLAMPED_SCORE, Clock, GroupKind, InputLayout, Inputs, Prediction, Predictor, Quality,
    Source, UpperBound, checked_seconds,
};
use crate::memory::chunks_mut;
use alloc::boxed::Box;
use alloc::string::String;
use alloc::sync::Arc;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::memory::try_vec;
use entire_core::model::{Key, Model};
use entire_core::nn::{PredNet, PredScratch};
use serde::{Deserialize, Serialize};

/// Distance of an input from its training mean up to which it counts as inside the range, in standard
/// deviations.
const RANGE_DEVIATIONS: f32 = 2.5;

/// Content of [`Key::Calibration`].
#[derive(Serialize, Deserialize)]
pub(super) struct Stored {
    pub(super) level: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) log_factor: Option<f32>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) low: Option<Vec<f32>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) high: Option<Vec<f32>>,
    /// Lower ends of [`InputRange`](super::InputRange); the upper ends are `input_high`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) input_low: Option<Vec<f32>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) input_high: Option<Vec<f32>>,
}

impl Stored {
    pub(super) fn to_json(&self) -> Result<String> {
        match serde_json::to_string(self) {
            Ok(text) => Ok(text),
            Err(e) => bail!(InvalidArgument, "the calibration cannot be written as JSON: {e}"),
        }
    }

    pub(super) fn of(model: &Model) -> Result<Option<Self>> {
        let Some(text) = model.metadata.get(Key::Calibration.name()) else { return Ok(None) };
        match serde_json::from_str::<Self>(text) {
            Ok(stored) => Ok(Some(stored)),
            Err(e) => bail!(InvalidModel, "{} is not a calibration object: {e}", Key::Calibration),
        }
    }
}

/// Returns the predictor of a model file: an analytic model if the file holds one, otherwise its PredNet.
///
/// # Errors
/// As [`InputLayout::of_model`]; [`crate::ErrorKind::InvalidModel`] also for a file without PredNet, or with
/// a damaged calibration or picture quality law; [`crate::ErrorKind::OutOfMemory`].
pub fn load(model: &Model) -> Result<Box<dyn Predictor + Send>> {
    Ok(match AnalyticModel::from_model(model)? {
        Some(analytic) => Box::new(analytic),
        None => Box::new(ModelPredictor::new(model)?),
    })
}

/// Returns the predictor of a model file as [`load`] does, with a network that was already built from the
/// same model, so that several predictors share its weights. An analytic model does not use the network.
///
/// # Errors
/// As [`load`], and [`crate::ErrorKind::SizeMismatch`] if the network's number of inputs is not the
/// model's.
pub fn load_with(net: &Arc<PredNet>, model: &Model) -> Result<Box<dyn Predictor + Send>> {
    Ok(match AnalyticModel::from_model(model)? {
        Some(analytic) => Box::new(analytic),
        None => Box::new(ModelPredictor::with_net(net.clone(), model)?),
    })
}

/// Predictor that runs a model file's PredNet on inputs assembled from named groups in the file's order.
///
/// The out-of-range score uses the inputs' distances from their training means, if the file has these means.
/// VolumeNet's outputs do not count, since they are in a similar range for every volume.
#[derive(Clone, Debug)]
pub(super) struct ModelPredictor {
    net: Arc<PredNet>,
    layout: InputLayout,
    /// Mean and standard deviation of each input; the mean is NaN if the input is ignored by the out-of-range
    /// score.
    spread: Vec<(f32, f32)>,
    scratch: PredScratch,
    row: Vec<f32>,
    knows_step: bool,
    calibration: UpperBound,
    clock: Option<Clock>,
    quality: Option<KnownQuality>,
    identity: u32,
}

impl ModelPredictor {
    /// Returns a predictor for a checked model. It uses the fastest instruction set of this CPU.
    ///
    /// # Errors
    /// As [`load`].
    pub(super) fn new(model: &Model) -> Result<Self> {
        let Some(parts) = model.prednet.as_ref() else {
            bail!(
                InvalidModel,
                "the file holds no PredNet (prednet.0.weight); a VolumeNet alone cannot predict times"
            );
        };
        Self::with_net(Arc::new(PredNet::new(parts)?), model)
    }

    /// Returns a predictor as [`ModelPredictor::new`] does, with a network already built from the same model.
    fn with_net(net: Arc<PredNet>, model: &Model) -> Result<Self> {
        let layout = InputLayout::of_model(model)?;
        let width = layout.width();
        if width != net.inputs() {
            bail!(
                SizeMismatch,
                "the network takes {} inputs, but the model's groups hold {width}; build the network from \
                 the same model",
                net.inputs()
            );
        }
        let mut spread = try_vec(width, (f32::NAN, 1.0))?;
        if let Some(norm) = model.prednet.as_ref().and_then(|p| p.input.as_ref()) {
            let mut left = spread.iter_mut().zip(norm.mean.iter().zip(&norm.std));
            for &(kind, size) in &layout.groups {
                for (slot, (&mean, &std)) in left.by_ref().take(size) {
                    if kind != GroupKind::VolumeFeatures {
                        *slot = (mean, std);
                    }
                }
            }
        }
        let calibration = Stored::of(model)?
            .and_then(|s| s.log_factor)
            .map_or(UpperBound::default(), |log_factor| UpperBound { log_factor });
        let scratch = net.scratch(1)?;
        Ok(Self {
            knows_step: layout.knows_step(),
            layout,
            net,
            spread,
            scratch,
            row: try_vec(width, 0.0)?,
            calibration,
            clock: Clock::of(model),
            quality: KnownQuality::of(model)?,
            identity: identity_of(model),
        })
    }

    /// Returns the input row of a frame, in the model's order, before it is clamped to the training range.
    ///
    /// # Errors
    /// [`crate::ErrorKind::MissingInput`] for a group that was not supplied.
    fn row(&mut self, inputs: &Inputs<'_>) -> Result<&[f32]> {
        self.layout.write(inputs, &mut self.row)?;
        Ok(&self.row)
    }

    /// The out-of-range score of an input row in the model's order; see [`Prediction::out_of_range`].
    fn out_of_range(&self, row: &[f32]) -> f32 {
        let (mut worst, mut known) = (0.0f32, false);
        for (x, &(mean, std)) in row.iter().zip(&self.spread) {
            if mean.is_nan() {
                continue;
            }
            known = true;
            let z = (x - mean).abs() / std;
            worst = worst.max(if z.is_nan() { f32::INFINITY } else { z });
        }
        if known { (worst / RANGE_DEVIATIONS - 1.0).max(0.0) } else { f32::NAN }
    }
}

/// Returns the out-of-range score ([`Prediction::out_of_range`]) of each row of inputs of a model's network.
///
/// # Errors
/// As [`load`].
pub fn out_of_range(model: &Model, rows: &[f32]) -> Result<Vec<f32>> {
    let predictor = ModelPredictor::new(model)?;
    let rows = rows.chunks_exact(predictor.layout.width().max(1));
    Ok(rows.map(|row| predictor.out_of_range(row)).collect())
}

/// Returns a checksum of everything that determines a model's predictions: weights, input layout and
/// metadata. The metadata names renderer, device and clock, if they are known.
fn identity_of(model: &Model) -> u32 {
    // Bytes are little-endian on every machine, so that a model has the same checksum on all of them.
    let numbers = |hash: &mut crc32fast::Hasher, values: &[f32]| {
        let mut bytes = [0; 256];
        for chunk in values.chunks(64) {
            let bytes = &mut bytes[..4 * chunk.len()];
            chunks_mut::<4, _>(bytes).0.iter_mut().zip(chunk).for_each(|(b, v)| *b = v.to_le_bytes());
            hash.update(bytes);
        }
    };
    let mut hash = crc32fast::Hasher::new();
    for (key, value) in &model.metadata {
        for text in [key, value] {
            hash.update(&(text.len() as u64).to_le_bytes());
            hash.update(text.as_bytes());
        }
    }
    if let Some(net) = model.prednet.as_ref() {
        for layer in &net.layers {
            hash.update(&(layer.inputs as u64).to_le_bytes());
            numbers(&mut hash, &layer.weight);
            numbers(&mut hash, &layer.bias);
        }
        for norm in [&net.input, &net.output].into_iter().flatten() {
            numbers(&mut hash, &norm.mean);
            numbers(&mut hash, &norm.std);
        }
    }
    if let Some(net) = model.volumenet.as_ref() {
        for block in &net.blocks {
            numbers(&mut hash, &block.weight);
            numbers(&mut hash, &block.bias);
        }
        numbers(&mut hash, &net.fc.weight);
        numbers(&mut hash, &net.fc.bias);
    }
    hash.finalize()
}

impl Predictor for ModelPredictor {
    fn predict(&mut self, inputs: &Inputs<'_>) -> Result<Prediction> {
        self.row(inputs)?;
        let out_of_range = self.out_of_range(&self.row);
        self.layout.hold(&mut self.row);
        let seconds = self.net.predict(&self.row, &mut self.scratch);
        let (seconds, clamped) = checked_seconds(seconds)?;
        // Without a known range the score is NaN; `max` replaces NaN by `CLAMPED_SCORE`.
        let out_of_range = if clamped { out_of_range.max(CLAMPED_SCORE) } else { out_of_range };
        Ok(Prediction {
            seconds,
            upper: self.calibration.upper(seconds),
            out_of_range,
            source: Source::Network,
        })
    }

    fn check(&mut self, inputs: &Inputs<'_>) -> Result<()> {
        self.row(inputs).map(drop)
    }

    fn log_sd(&self) -> Option<f32> {
        // Even without calibration, a network was trained on times of a machine. Its errors are assumed to
        // have a standard deviation of 0.5 in ln(time).
        Some(self.calibration.log_sd().unwrap_or(0.5))
    }

    fn clock(&self) -> Option<Clock> {
        self.clock
    }

    fn quality(&self, renderer: &str) -> Option<Quality> {
        KnownQuality::holds_for(self.quality.as_ref(), renderer)
    }

    fn identity(&self) -> u32 {
        self.identity
    }

    fn knows_step(&self) -> bool {
        self.knows_step
    }

    fn probe_side(&self) -> usize {
        self.layout.probe_side
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::tests::{cube, lobe_at, measured};
    use crate::features::{Changes, FrameFeatures, PROBE_SIDE, Setting, UnitCosts};
    use alloc::vec;
    use entire_core::ErrorKind;
    use entire_core::model::{InputGroup, ModelFile};
    use entire_core::nn::{DenseParts, Dtype, Normalization, PredNetParts, Target};
    use entire_core::scene::{Arcball, Camera, Frame, GaussianLobe};

    fn model(
        groups: &[(&str, usize)],
        features: &[&str],
        target: Target,
        norm: Option<Normalization>,
    ) -> Model {
        model_file(groups, features, target, norm).to_model().unwrap()
    }

    fn model_file(
        groups: &[(&str, usize)],
        features: &[&str],
        target: Target,
        norm: Option<Normalization>,
    ) -> ModelFile {
        let n: usize = groups.iter().map(|g| g.1).sum();
        let weight = (0..n).map(|i| 0.001 * (i + 1) as f32).collect();
        file_of(groups, features, &PredNetParts { input: norm, ..linear(weight, 0.5, target) })
    }

    /// A network of one layer.
    fn linear(weight: Vec<f32>, bias: f32, target: Target) -> PredNetParts {
        let inputs = weight.len();
        let layer = DenseParts { inputs, outputs: 1, weight, bias: vec![bias], dtype: Dtype::F32 };
        PredNetParts { layers: vec![layer], input: None, output: None, target }
    }

    fn file_of(groups: &[(&str, usize)], features: &[&str], parts: &PredNetParts) -> ModelFile {
        let mut file = ModelFile::default();
        let inputs: Vec<InputGroup> =
            groups.iter().map(|&(name, size)| InputGroup { name: name.into(), size }).collect();
        file.set_prednet(parts, &inputs).unwrap();
        if !features.is_empty() {
            file.metadata
                .insert(Key::SceneFeatures.into(), serde_json::Value::from(features.to_vec()).to_string());
        }
        file
    }

    fn frame() -> Frame {
        Frame::new(Camera::from_arcball(Arcball { rx: 10.0, ry: 20.0, dz: 2.0 }).unwrap(), 64, 32).unwrap()
    }

    fn inputs<'a>(features: &'a FrameFeatures, x: &'a [f32], lobes: &'a [GaussianLobe]) -> Inputs<'a> {
        Inputs {
            features,
            setting: Setting { step: 3.0, ..Setting::from(&frame()) },
            changes: Changes::default(),
            camera: Arcball { rx: 10.0, ry: 20.0, dz: 2.0 },
            volume_features: Some(x),
            lobes: Some(lobes),
        }
    }

    #[test]
    fn a_models_identity_is_the_same_on_every_machine() {
        let norm = Normalization { mean: vec![1.0, 2.0, 3.0], std: vec![4.0, 5.0, 6.0] };
        let identity = |norm| identity_of(&model(&[("camera", 3)], &[], Target::LogSeconds, norm));
        // Checksums of the little-endian bytes, computed by zlib.
        assert_eq!([identity(None), identity(Some(norm))], [3_801_741_576, 2_685_955_157]);
    }

    #[test]
    fn encoders_are_part_of_a_models_identity() {
        let identity = |weight: f32, bias: f32| {
            let mut file = model_file(&[("volume_features", 1)], &[], Target::LogSeconds, None);
            for (name, shape, value) in [
                ("volumenet.encoder.0.conv.weight", vec![2, 1, 3, 3, 3], weight),
                ("volumenet.encoder.0.bn.weight", vec![2], 1.0),
                ("volumenet.encoder.0.bn.bias", vec![2], 1.0),
                ("volumenet.encoder.0.bn.running_mean", vec![2], 1.0),
                ("volumenet.encoder.0.bn.running_var", vec![2], 1.0),
                ("volumenet.fc.weight", vec![1, 128], 1.0),
                ("volumenet.fc.bias", vec![1], bias),
            ] {
                let n = shape.iter().product();
                file.set_tensor(name, Dtype::F32, &shape, &vec![value; n]).unwrap();
            }
            let layout = r#"{"input":8,"blocks":[{"stride":2,"padding":1}]}"#;
            file.metadata.insert(Key::VolumeNet.into(), layout.into());
            identity_of(&file.to_model().unwrap())
        };
        assert_eq!(identity(0.5, 0.5), identity(0.5, 0.5));
        assert_ne!(identity(0.5, 0.5), identity(0.6, 0.5));
        assert_ne!(identity(0.5, 0.5), identity(0.5, 0.6));
    }

    #[test]
    fn groups_are_assembled_in_the_files_order() {
        let m = model(
            &[
                ("step_size", 1),
                ("transfer_function", 3),
                ("resolution", 2),
                ("volume_features", 2),
                ("camera", 3),
                ("scene_features", 2),
            ],
            &["step", "log_pixels"],
            Target::LogSeconds,
            None,
        );
        let mut p = ModelPredictor::new(&m).unwrap();
        let features = FrameFeatures::default();
        let lobes = [GaussianLobe { center: 0.1, width: 0.2, height: 0.3 }];
        let x = [7.0, 8.0];
        let inputs = inputs(&features, &x, &lobes);
        let log_pixels = libm::log(64.0 * 32.0 + 1.0) as f32;
        let expected = [3.0, 0.1, 0.2, 0.3, 64.0, 32.0, 7.0, 8.0, 10.0, 20.0, 2.0, 3.0, log_pixels];
        assert_eq!(p.row(&inputs).unwrap(), expected);
        let y: f64 = 0.5
            + expected.iter().enumerate().map(|(i, &v)| 0.001 * (i + 1) as f64 * f64::from(v)).sum::<f64>();
        let seconds = p.predict(&inputs).unwrap();
        assert!((f64::from(seconds.seconds) / y.exp() - 1.0).abs() < 1e-5);
        assert!(seconds.upper.is_nan() && seconds.out_of_range.is_nan() && p.knows_step());
    }

    #[test]
    fn lobes_go_in_by_center_where_the_file_says_so() {
        let of = |order: Option<&str>| {
            let mut file = model_file(&[("transfer_function", 6)], &[], Target::Seconds, None);
            if let Some(order) = order {
                file.metadata.insert(Key::LobeOrder.into(), order.into());
            }
            ModelPredictor::new(&file.to_model().unwrap())
        };
        let features = FrameFeatures::default();
        let late = GaussianLobe { center: 0.9, width: 0.2, height: 0.3 };
        let early = GaussianLobe { center: 0.1, width: 0.4, height: 0.5 };
        let (given, swapped) = ([late, early], [early, late]);
        let mut plain = of(None).unwrap();
        assert_eq!(plain.row(&inputs(&features, &[], &given)).unwrap(), [0.9, 0.2, 0.3, 0.1, 0.4, 0.5]);
        let mut sorted = of(Some("center")).unwrap();
        assert_eq!(sorted.row(&inputs(&features, &[], &given)).unwrap(), [0.1, 0.4, 0.5, 0.9, 0.2, 0.3]);
        let times = [given, swapped].map(|lobes| sorted.predict(&inputs(&features, &[], &lobes)).unwrap());
        assert_eq!(times[0].seconds.to_bits(), times[1].seconds.to_bits());
        assert_eq!(of(Some("height")).unwrap_err().kind(), ErrorKind::Unsupported);
    }

    #[test]
    fn the_tallest_of_too_few_lobes_is_shared_out() {
        let features = FrameFeatures::default();
        let lobe = |center: f32, height: f32| GaussianLobe { center, width: 0.01, height };
        let row = |lobes: &[GaussianLobe]| {
            let mut p = ModelPredictor::new(&model(&[("transfer_function", 9)], &[], Target::Seconds, None));
            let p = p.as_mut().unwrap();
            p.row(&inputs(&features, &[], lobes)).unwrap().to_vec()
        };
        assert_eq!(row(&[lobe(0.4, 0.6)]), [0.4, 0.01, 0.6 / 3.0].repeat(3));
        assert_eq!(row(&[lobe(0.2, 0.1), lobe(0.4, 0.6)]), [0.2, 0.01, 0.1, 0.4, 0.01, 0.3, 0.4, 0.01, 0.3]);
        // The row with three lobes describes the transfer function with two lobes: at every scalar value, the
        // sums of the lobes (Eq. 4 of the paper) are equal.
        let of = |row: &[f32], s: f32| -> f32 {
            row.chunks(3).map(|l| l[2] * libm::expf(-(s - l[0]).powi(2) / l[1])).sum()
        };
        let full = row(&[lobe(0.2, 0.1), lobe(0.4, 0.6)]);
        for i in 0..=20 {
            let s = 0.05 * i as f32;
            let expected = of(&[0.2, 0.01, 0.1, 0.4, 0.01, 0.6], s);
            assert!((of(&full, s) - expected).abs() < 1e-6, "{s}");
        }
    }

    #[test]
    fn a_group_that_was_not_supplied_is_an_error_and_never_zero() {
        let features = FrameFeatures::default();
        let lobes = [GaussianLobe { center: 0.1, width: 0.2, height: 0.3 }; 2];
        let x = [1.0];
        let full = inputs(&features, &x, &lobes);
        let check = |group: (&str, usize), inputs: &Inputs<'_>, text: &str| {
            let mut p = ModelPredictor::new(&model(&[group], &[], Target::Seconds, None)).unwrap();
            let e = p.predict(inputs).unwrap_err();
            assert_eq!(e.kind(), ErrorKind::MissingInput);
            assert!(e.to_string().contains(text), "{e}");
        };
        check(("volume_features", 2), &Inputs { volume_features: None, ..full }, "none were supplied");
        check(("volume_features", 2), &full, "but 1 values were given; encode the volume");
        check(("transfer_function", 6), &Inputs { lobes: None, ..full }, "2 lobes");
        check(("transfer_function", 3), &full, "takes 1 Gaussian lobes, the transfer function has 2");
        check(("transfer_function", 6), &Inputs { lobes: Some(&[]), ..full }, "the transfer function has 0");
        let unknown = model(&[("phase_of_the_moon", 1)], &[], Target::Seconds, None);
        assert_eq!(ModelPredictor::new(&unknown).unwrap_err().kind(), ErrorKind::MissingInput);
        let unknown = model(&[("scene_features", 1)], &["mood"], Target::Seconds, None);
        assert_eq!(ModelPredictor::new(&unknown).unwrap_err().kind(), ErrorKind::Unsupported);
    }

    #[test]
    fn a_model_says_how_fine_a_probe_it_needs() {
        let of = |features: &[&str], side: Option<&str>| {
            let mut file = model_file(&[("scene_features", features.len())], features, Target::Seconds, None);
            if let Some(side) = side {
                file.metadata.insert(Key::ProbeSide.into(), side.into());
            }
            ModelPredictor::new(&file.to_model().unwrap()).map(|p| p.probe_side())
        };
        assert_eq!(of(&["step", "log_samples"], None).unwrap(), PROBE_SIDE);
        assert_eq!(of(&["step", "log_samples"], Some("7")).unwrap(), 7);
        assert_eq!(of(&["step", "log_pixels"], Some("7")).unwrap(), 0);
        for bad in ["0", "25", "-1", "seven", ""] {
            let e = of(&["samples"], Some(bad)).unwrap_err();
            assert_eq!(e.kind(), ErrorKind::InvalidModel);
            assert!(e.to_string().contains("entire.probe_side") && e.to_string().contains("1 to 24"), "{e}");
        }
    }

    #[test]
    fn seconds_are_positive_and_far_inputs_are_told() {
        let norm = Normalization { mean: vec![64.0, 32.0], std: vec![10.0, 10.0] };
        let m = model(&[("resolution", 2)], &[], Target::Seconds, Some(norm));
        let mut p = ModelPredictor::new(&m).unwrap();
        assert!(!p.knows_step());
        let features = FrameFeatures::default();
        let mut i = inputs(&features, &[], &[]);
        assert_eq!(p.predict(&i).unwrap().out_of_range, 0.0);
        i.setting.width = 164;
        assert!((p.predict(&i).unwrap().out_of_range - 3.0).abs() < 1e-6);
        let negative = file_of(&[("resolution", 2)], &[], &linear(vec![-1.0; 2], 0.0, Target::Seconds));
        let seconds =
            ModelPredictor::new(&negative.to_model().unwrap()).unwrap().predict(&i).unwrap().seconds;
        assert!(seconds > 0.0 && seconds.is_finite());
    }

    #[test]
    fn analytic_models_survive_their_file() {
        let mut analytic = AnalyticModel::from_costs(UnitCosts::new([
            1e-3, 2e-9, 0.0, 4e-9, 5e-8, 0.0, 7e-8, 0.0, 9e-8, 1e-8, 0.0, 2e-8, 3e-9, 1e-5, 4e-8, 5e-8, 6e-9,
            0.0, 3e-9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        ]))
        .unwrap();
        analytic.calibration = UpperBound { log_factor: 0.25 };
        let model = analytic.to_model_file().unwrap().to_model().unwrap();
        let back = AnalyticModel::from_model(&model).unwrap().unwrap();
        for (a, b) in analytic.costs().seconds.iter().zip(&back.costs().seconds) {
            assert!((a - b).abs() <= 1e-7 * a);
        }
        assert_eq!(back.calibration.log_factor, 0.25);
        // The same file loaded as a network predicts the same seconds.
        let features = measured(&cube(24), &lobe_at(0.4), &frame());
        let inputs = inputs(&features, &[], &[]);
        let mut net = ModelPredictor::new(&model).unwrap();
        let (a, b) = (load(&model).unwrap().predict(&inputs).unwrap(), net.predict(&inputs).unwrap());
        assert!((a.seconds / b.seconds - 1.0).abs() < 1e-5);
        assert_eq!((a.source, b.source), (Source::Analytic, Source::Network));
        // Both predictors use the file's number of cached voxels: with fewer cached voxels, more reads wait.
        let mut file = analytic.to_model_file().unwrap();
        file.metadata.insert(Key::CachedVoxels.into(), "1e4".into());
        let model = file.to_model().unwrap();
        let mut net = ModelPredictor::new(&model).unwrap();
        let (c, d) = (load(&model).unwrap().predict(&inputs).unwrap(), net.predict(&inputs).unwrap());
        assert!(
            c.seconds > 1.05 * a.seconds && (c.seconds / d.seconds - 1.0).abs() < 1e-5,
            "{a:?} {c:?} {d:?}"
        );
    }
}
