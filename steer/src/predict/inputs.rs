//! Inputs and outputs of predictors.

use super::{Clock, Quality, TERMS};
use crate::features::{Changes, FrameFeatures, PROBE_SIDE, Setting};
use entire_core::Result;
use entire_core::scene::{Arcball, GaussianLobe};

/// Origin of a prediction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u32)]
pub enum Source {
    /// Unit costs times the estimated work.
    Analytic = 1,
    /// A network from a model file.
    Network = 2,
}

/// A predicted frame time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prediction {
    /// Expected seconds; finite and positive.
    pub seconds: f32,
    /// Upper bound in seconds; NaN if the predictor is uncalibrated.
    pub upper: f32,
    /// Distance of the inputs from the training range: 0 inside, growing with the distance; NaN if the
    /// predictor has no range. A session trusts predictions up to
    /// [`crate::control::HybridOptions::trust_limit`].
    pub out_of_range: f32,
    /// Origin of the prediction.
    pub source: Source,
}

/// A predicted frame time as a sum of terms. The online correction scales each term separately.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CostTerms {
    /// Seconds of each term, none negative; their sum is the prediction.
    pub parts: [f32; TERMS],
    /// Out-of-range score, see [`Prediction::out_of_range`].
    pub out_of_range: f32,
    /// Origin of the prediction.
    pub source: Source,
}

impl CostTerms {
    /// Splits a prediction that has no terms: 2 % of the seconds become the frame's fixed cost, and 98 % one
    /// other term.
    pub fn whole(seconds: f32, out_of_range: f32, source: Source) -> Self {
        let mut parts = [0.0; TERMS];
        parts[0] = 0.02 * seconds;
        parts[1] = 0.98 * seconds;
        Self { parts, out_of_range, source }
    }

    /// Returns the predicted seconds: the sum of all cost terms.
    pub(crate) fn seconds(&self) -> f32 {
        self.parts.iter().sum()
    }
}

/// Inputs of a predictor for one frame. Groups that the caller does not have are `None`.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'a> {
    /// Scene features of the frame.
    pub features: &'a FrameFeatures,
    /// The setting to predict for.
    pub setting: Setting,
    /// Changes of the scene since the previous frame.
    pub changes: Changes,
    /// The camera as an arcball pose.
    pub camera: Arcball,
    /// VolumeNet's output for the volume.
    pub volume_features: Option<&'a [f32]>,
    /// The transfer function as Gaussian lobes.
    pub lobes: Option<&'a [GaussianLobe]>,
}

/// Predicts a frame's time. Implementations do not allocate on success.
pub trait Predictor {
    /// The prediction for one frame at one setting.
    ///
    /// # Errors
    /// [`crate::ErrorKind::MissingInput`] if an input group of the model was not supplied.
    fn predict(&mut self, inputs: &Inputs<'_>) -> Result<Prediction>;

    /// The prediction as a sum of terms. The default is [`CostTerms::whole`] of [`Predictor::predict`].
    ///
    /// # Errors
    /// As [`Predictor::predict`].
    fn terms(&mut self, inputs: &Inputs<'_>) -> Result<CostTerms> {
        let p = self.predict(inputs)?;
        Ok(CostTerms::whole(p.seconds, p.out_of_range, p.source))
    }

    /// Checks that every input of the model was supplied. The default makes a prediction; an implementation
    /// may check the inputs without a prediction.
    ///
    /// # Errors
    /// As [`Predictor::predict`].
    fn check(&mut self, inputs: &Inputs<'_>) -> Result<()> {
        self.predict(inputs).map(drop)
    }

    /// Standard deviation of ln(measured / predicted) on the machine where the model was measured; `None` for
    /// a model that was never measured.
    fn log_sd(&self) -> Option<f32> {
        None
    }

    /// The clock whose seconds are predicted; `None`, the default, if the clock is unknown.
    fn clock(&self) -> Option<Clock> {
        None
    }

    /// Picture quality law of the renderer with this name; `None` if no law was measured for it. An empty
    /// name means the predictor's own renderer. The default is `None`.
    fn quality(&self, _renderer: &str) -> Option<Quality> {
        None
    }

    /// Number of rays along each side of the probe with which the predictor was trained, see
    /// [`FrameFeatures::of`]; 0 if no input needs the probe.
    fn probe_side(&self) -> usize {
        PROBE_SIDE
    }

    /// True if a probe with any number of rays may be used. This holds for models that are linear in counts,
    /// because every probe estimates counts without bias.
    fn any_probe_side(&self) -> bool {
        false
    }

    /// Hash of the model. Corrections learned for one predictor are not valid for another with a different
    /// hash. The default is 0, for predictors without a hash.
    fn identity(&self) -> u32 {
        0
    }

    /// True if the prediction depends on the ray step. If false, callers predict at the reference step, and
    /// scale the prediction by the ratio of the analytic model's times at the frame's step and at the
    /// reference step.
    fn knows_step(&self) -> bool {
        true
    }
}
