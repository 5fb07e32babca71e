//! The model that steering predicts with: its choice, and its errors on the played volume.

use crate::calibrate::place::{calibrated_on, shading_of};
use crate::shipped::shipped_model;
use anyhow::{Context, Result};
use entire_core::model::{Model, ModelFile};
use entire_core::scene::{Arcball, GaussianLobe, Shading, VolumeView};
use entire_io::files::note;
use entire_io::metrics::median;
use entire_steer::features::{Changes, FrameFeatures, Setting};
use entire_steer::predict::{Inputs, Predictor, load};
use entire_train::inputs::volume_features;
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;

/// One rendering of a random scene.
#[derive(Clone, Debug)]
pub struct Sample {
    /// The scene's number.
    pub scene: usize,
    /// Scene features of the frame.
    pub features: FrameFeatures,
    /// Step, size and modes.
    pub setting: Setting,
    /// Camera.
    pub camera: Arcball,
    /// The transfer function's lobes.
    pub lobes: Vec<GaussianLobe>,
    /// Seconds by the chosen clock.
    pub seconds: f64,
}

/// Errors of predictions on samples.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Quality {
    /// Number of evaluated frames.
    pub frames: usize,
    /// Median of |predicted / measured − 1|.
    pub median_error: f64,
    /// 95th percentile of |predicted / measured − 1| (nearest rank).
    pub p95_error: f64,
    /// Root mean square of ln(measured / predicted), without the tenth of the values that has the largest
    /// magnitudes.
    pub log_sd: f64,
}

impl Quality {
    /// Returns the errors of (predicted, measured) pairs of seconds; `None` if no pair has a finite error.
    pub fn of(pairs: &[(f64, f64)]) -> Option<Self> {
        let mut logs: Vec<f64> =
            pairs.iter().map(|(p, m)| (m / p).ln().abs()).filter(|l| l.is_finite()).collect();
        let mut errors: Vec<f64> =
            pairs.iter().map(|(p, m)| (p / m - 1.0).abs()).filter(|e| e.is_finite()).collect();
        if errors.is_empty() || logs.is_empty() {
            return None;
        }
        errors.sort_by(f64::total_cmp);
        logs.sort_by(f64::total_cmp);
        logs.truncate((logs.len() * 9).div_ceil(10));
        let rank = ((0.95 * errors.len() as f64).ceil() as usize).clamp(1, errors.len());
        Some(Self {
            frames: errors.len(),
            median_error: median(&mut errors.clone())?,
            p95_error: errors[rank - 1],
            log_sd: (logs.iter().map(|l| l * l).sum::<f64>() / logs.len() as f64).sqrt(),
        })
    }
}

/// A model from which any number of contenders can get a predictor.
#[derive(Clone, Debug)]
pub struct SteeringModel {
    title: String,
    model: Arc<Model>,
    volume_features: Option<Vec<f32>>,
    /// Error of the predictor, if it is known, for controllers that correct the predictor.
    pub(crate) log_sd: Option<f32>,
}

impl SteeringModel {
    /// Prepares a model for steering. If its inputs need features of the volume, its VolumeNet encodes
    /// `volume` now.
    ///
    /// # Errors
    /// When the model holds no predictor, or the volume cannot be encoded.
    pub fn new(title: String, model: Model, volume: &VolumeView<'_>) -> Result<Self> {
        load(&model)?;
        let volume_features = volume_features(&model, volume)?;
        Ok(Self { title, model: Arc::new(model), volume_features, log_sd: None })
    }

    /// Returns VolumeNet's output for a volume, if the model uses it.
    ///
    /// # Errors
    /// When the volume cannot be encoded.
    pub fn encode(&self, volume: &VolumeView<'_>) -> Result<Option<Vec<f32>>> {
        volume_features(&self.model, volume)
    }

    /// A new predictor.
    ///
    /// # Errors
    /// When the model holds no predictor.
    pub fn predictor(&self) -> Result<Box<dyn Predictor + Send>> {
        Ok(load(&self.model)?)
    }

    /// True if the model was calibrated on the volume; `None` if its file lacks the hashes of its volumes.
    pub(crate) fn calibrated_on(&self, volume: &Path) -> Result<Option<bool>> {
        calibrated_on(&self.model.metadata, volume)
    }

    /// Name of the model in printed output.
    pub fn title(&self) -> &str {
        &self.title
    }

    /// VolumeNet's output for the volume, if the model uses it.
    pub fn volume_features(&self) -> Option<&[f32]> {
        self.volume_features.as_deref()
    }

    /// The model's errors on samples. Models without the ray step as input are evaluated at the reference
    /// step only.
    ///
    /// # Errors
    /// When there are no samples, or the model needs an input that they lack.
    pub fn quality<'a>(&self, samples: impl IntoIterator<Item = &'a Sample>) -> Result<Quality> {
        self.quality_with(samples.into_iter().map(|s| (s, self.volume_features())))
    }

    /// As [`SteeringModel::quality`], for samples of several volumes, each with VolumeNet's output for its
    /// volume.
    ///
    /// # Errors
    /// As [`SteeringModel::quality`].
    pub fn quality_with<'a>(
        &self,
        samples: impl IntoIterator<Item = (&'a Sample, Option<&'a [f32]>)>,
    ) -> Result<Quality> {
        let mut predictor = self.predictor()?;
        let every_step = predictor.knows_step();
        let mut pairs = Vec::new();
        for (s, volume_features) in samples.into_iter().filter(|(s, _)| every_step || s.setting.step == 1.0) {
            let inputs = Inputs {
                features: &s.features,
                setting: s.setting,
                changes: Changes::default(),
                camera: s.camera,
                volume_features,
                lobes: Some(&s.lobes),
            };
            pairs.push((f64::from(predictor.predict(&inputs)?.seconds), s.seconds));
        }
        Quality::of(&pairs).context("there is no frame to evaluate the model on")
    }
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct Steers {
    pub(crate) title: String,
    /// Errors of the predictor on random frames of the played volume.
    pub(crate) on_this_volume: Quality,
    /// True if the model was calibrated on the played volume; `None` if its file lacks the hashes of its
    /// volumes.
    pub(crate) calibrated_on_this_volume: Option<bool>,
}

impl Steers {
    pub(crate) fn sentence(&self) -> String {
        let Quality { frames, median_error, p95_error, .. } = self.on_this_volume;
        let seen = match self.calibrated_on_this_volume {
            Some(true) => ", on which the model was calibrated: the error on other volumes may be larger",
            Some(false) => ", to which the model was not fitted",
            None => "; it is unknown if the model was fitted to this volume",
        };
        format!(
            "{}: median error {:.1} %, 95 % of errors below {:.1} %, on {frames} random frames of this \
             volume{seen}",
            self.title,
            100.0 * median_error,
            100.0 * p95_error
        )
    }
}

/// Returns name and model of the predictor: the given model, else the machine's, else the shipped one. The
/// flag is true unless the model is the shipped one.
pub(crate) fn chosen_model(
    given: Option<(String, Model)>,
    machine: Option<(String, ModelFile)>,
    shading: Shading,
) -> Result<(String, Model, bool)> {
    if let Some((title, model)) = given {
        return Ok((title, model, true));
    }
    let known = machine.is_some();
    let (title, file) = machine.map_or_else(|| shipped_model(shading), Ok)?;
    Ok((title, file.to_model()?, known))
}

/// Returns the [chosen](chosen_model) model. Sessions scale the shipped model, whose error here is unknown,
/// to this machine frame by frame.
pub(crate) fn steering_model(
    given: Option<(String, Model)>,
    machine: Option<(String, ModelFile)>,
    shading: Shading,
    volume: &VolumeView<'_>,
) -> Result<SteeringModel> {
    if let Some((name, model)) = &given
        && let Some(fitted) = shading_of(model).filter(|fitted| *fitted != shading)
    {
        note(&format!(
            "{name} was fitted to frames with --shade {fitted}; this path is drawn with --shade {shading}"
        ));
    }
    let (title, model, known) = chosen_model(given, machine, shading)?;
    let corrected = if known { "" } else { ", corrected by the measured time of every frame" };
    let mut model = SteeringModel::new(title + corrected, model, volume)?;
    model.log_sd = model.predictor()?.log_sd().filter(|_| known);
    Ok(model)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quality_is_relative_to_the_measured_time() {
        let pairs: Vec<(f64, f64)> = (0..20).map(|i| (1.1, if i == 0 { 0.1 } else { 1.0 })).collect();
        let q = Quality::of(&pairs).unwrap();
        assert!((q.median_error - 0.1).abs() < 1e-12 && (q.p95_error - 0.1).abs() < 1e-9);
        // The outlier is in the excluded tenth.
        assert!((q.log_sd - 1.1f64.ln()).abs() < 1e-12);
        assert_eq!(Quality::of(&[]), None);
        assert_eq!(Quality::of(&[(f64::NAN, 1.0)]), None);
    }
}
