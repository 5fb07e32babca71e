//! What a predictor takes and gives.

use super::{Clock, Quality, TERMS};
use crate::features::{Changes, FrameFeatures, PROBE_SIDE, Setting};
use entire_core::Result;
use entire_core::scene::{Arcball, GaussianLobe};

/// Where a prediction came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[repr(u32)]
pub enum Source {
    /// The linear cost model on estimated work.
    Analytic = 1,
    /// A network from a model file.
    Network = 2,
    /// Recent frames, scaled to the setting asked for.
    History = 3,
}

/// A predicted frame time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prediction {
    /// Expected seconds; finite and positive.
    pub seconds: f32,
    /// Upper bound of the calibrated level, seconds; NaN where the predictor was never calibrated.
    pub upper: f32,
    /// How far outside its training range the inputs lie: 0 inside, 1 at the edge of trust, growing beyond;
    /// NaN where the predictor knows no range.
    pub out_of_range: f32,
    /// Where it came from.
    pub source: Source,
}

/// A prediction as a sum of parts that can be corrected apart from each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CostTerms {
    /// Seconds of each part, none negative; their sum is the prediction.
    pub parts: [f32; TERMS],
    /// As [`Prediction::out_of_range`].
    pub out_of_range: f32,
    /// As [`Prediction::source`].
    pub source: Source,
}

impl CostTerms {
    /// A prediction in one piece, beside a fixed cost of its own.
    pub fn whole(seconds: f32, out_of_range: f32, source: Source) -> Self {
        let mut parts = [0.0; TERMS];
        parts[0] = 0.02 * seconds;
        parts[1] = 0.98 * seconds;
        Self { parts, out_of_range, source }
    }

    /// The sum of the parts.
    pub(crate) fn seconds(&self) -> f32 {
        self.parts.iter().sum()
    }
}

/// Everything that a predictor may ask for about a frame. Groups that the caller does not have are `None`.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'a> {
    /// The measured frame.
    pub features: &'a FrameFeatures,
    /// The setting to predict for.
    pub setting: Setting,
    /// What changed since the frame before.
    pub changes: Changes,
    /// The camera as arcball pose.
    pub camera: Arcball,
    /// VolumeNet's output for the volume.
    pub volume_features: Option<&'a [f32]>,
    /// The transfer function as Gaussian lobes.
    pub lobes: Option<&'a [GaussianLobe]>,
}

/// Predicts a frame's time. Implementations never allocate on success.
pub trait Predictor {
    /// The prediction for one frame at one setting.
    ///
    /// # Errors
    /// [`crate::ErrorKind::MissingInput`] when an input group that the model names was not supplied.
    fn predict(&mut self, inputs: &Inputs<'_>) -> Result<Prediction>;

    /// The prediction in parts. The default is [`CostTerms::whole`].
    ///
    /// # Errors
    /// As [`Predictor::predict`].
    fn terms(&mut self, inputs: &Inputs<'_>) -> Result<CostTerms> {
        let p = self.predict(inputs)?;
        Ok(CostTerms::whole(p.seconds, p.out_of_range, p.source))
    }

    /// Whether every input that the model needs was supplied; cheaper than a prediction.
    ///
    /// # Errors
    /// As [`Predictor::predict`].
    fn check(&mut self, inputs: &Inputs<'_>) -> Result<()> {
        self.predict(inputs).map(drop)
    }

    /// Standard deviation of ln(measured / predicted) on the machine that the model was measured on; `None`
    /// for a model that was never measured.
    fn log_sd(&self) -> Option<f32> {
        None
    }

    /// The clock whose seconds are predicted; `None`, the default, where that is not known.
    fn clock(&self) -> Option<Clock> {
        None
    }

    /// What coarser steps and smaller images cost the pictures of the renderer of this name, where that was
    /// measured; an empty name stands for the renderer that the predictor is of. `None` is the default.
    fn quality(&self, _renderer: &str) -> Option<Quality> {
        None
    }

    /// Rays along each side of the probe that the predictor was made with: what
    /// [`FrameFeatures::with_probe_side`] takes. 0 where no input needs the probe.
    fn probe_side(&self) -> usize {
        PROBE_SIDE
    }

    /// Whether a probe of another side than [`Predictor::probe_side`] serves as well: what is linear in
    /// counts that every probe estimates was not trained with one.
    fn any_probe_side(&self) -> bool {
        false
    }

    /// A number that tells predictors apart whose corrections must not be mixed up: what was learned of one
    /// says nothing about another. 0, the default, for predictors that do not tell.
    fn identity(&self) -> u32 {
        0
    }

    /// Whether the ray step enters the prediction. Where it does not, callers scale by the analytic model.
    fn knows_step(&self) -> bool {
        true
    }
}
