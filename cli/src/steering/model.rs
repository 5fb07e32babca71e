//! The model that steering predicts with: its choice, and its errors on the played volume.

use super::sampling::{Quality, Sample};
use crate::calibrate::place::{calibrated_on, shading_of};
use crate::shipped::shipped_model;
use anyhow::{Context, Result};
use entire_core::model::{Model, ModelFile};
use entire_core::scene::{Shading, VolumeView};
use entire_io::files::note;
use entire_steer::features::Changes;
use entire_steer::predict::{Inputs, Predictor, load};
use entire_train::inputs::volume_features;
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;

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

    /// The model's errors on samples. Models without the ray step as input are
    /// evaluated at the reference step only.
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

/// Returns the [chosen](chosen_model) model. Sessions scale the shipped model, whose error here is unknown, to
/// this machine frame by frame.
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
