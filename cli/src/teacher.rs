//! A predictor in a renderer's place: frames cost nothing but their prediction, so that a model which needs very many can
//! be taught by one that needs few.

use entire_core::features::{
    Changes, FrameFeatures, Setting, SummaryOptions, TransferSummary, VolumeSummary,
};
use entire_core::model::Model;
use entire_core::predict::{Inputs, Predictor, load};
use entire_core::scene::{Arcball, Frame, Skipping, TransferTable, VolumeView};
use entire_vk_raycaster::{Error, FrameTime, Image, Preparation, Rendered, Renderer, Result};

/// Draws nothing, and takes as long as its model says: the time by every clock is the prediction.
pub struct Teacher {
    name: String,
    predictor: Box<dyn Predictor + Send>,
    features: FrameFeatures,
    summary: Option<VolumeSummary>,
    transfer: Option<TransferSummary>,
}

impl Teacher {
    /// A teacher by the name of `name` from a model on scene features alone.
    ///
    /// # Errors
    /// When the model holds no PredNet, or needs inputs that a renderer is not given (volume features, Gaussian lobes).
    pub fn new(name: &str, model: &Model) -> anyhow::Result<Self> {
        let predictor = load(model)?;
        if let Some(group) = model.inputs().iter().find(|g| g.name != "scene_features") {
            anyhow::bail!(
                "the model takes {}; a teacher must be a model on scene_features alone, such as models/unshaded-selected.safetensors",
                group.name
            );
        }
        let features = FrameFeatures::with_probe_side(predictor.probe_side());
        Ok(Self { name: name.into(), predictor, features, summary: None, transfer: None })
    }
}

impl Renderer for Teacher {
    fn device(&self) -> String {
        format!("the predictor {}", self.name)
    }

    fn backend(&self) -> &'static str {
        "teacher"
    }

    fn set_volume(&mut self, volume: &VolumeView<'_>) -> Result<Preparation> {
        let summary = VolumeSummary::new(volume, SummaryOptions::default());
        self.summary = Some(summary.map_err(|e| Error::new(e.to_string()))?);
        self.transfer = None;
        Ok(Preparation::default())
    }

    fn set_transfer(&mut self, table: &TransferTable) -> Result<Preparation> {
        let summary = self.summary.as_ref().ok_or_else(|| Error::new("no volume was set"))?;
        self.transfer = Some(TransferSummary::new(summary, table));
        Ok(Preparation::default())
    }

    fn render(&mut self, frame: &Frame) -> Result<Rendered> {
        let (Some(summary), Some(transfer)) = (&self.summary, &mut self.transfer) else {
            return Err(Error::new("volume and transfer function were not set"));
        };
        if frame.skipping() == Skipping::Distance {
            transfer.prepare_distance();
        }
        self.features.measure(summary, transfer, frame);
        let inputs = Inputs {
            features: &self.features,
            setting: Setting::of(frame),
            changes: Changes::NONE,
            // Scene features hold what counts of it.
            camera: Arcball { rx: 0.0, ry: 0.0, dz: 2.0 },
            volume_features: None,
            lobes: None,
        };
        let prediction = self.predictor.predict(&inputs).map_err(|e| Error::new(e.to_string()))?;
        let seconds = f64::from(prediction.seconds);
        Ok(Rendered {
            image: Image { width: 0, height: 0, rgba: Vec::new() },
            time: FrameTime { device: Some(seconds), wall: seconds, cpu: Some(seconds) },
            counts: None,
        })
    }
}
