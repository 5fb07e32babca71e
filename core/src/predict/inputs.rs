//! What a predictor takes and gives.

use super::TERMS;
use crate::Result;
use crate::error::bail;
use crate::features::{Changes, FrameFeatures, PROBE_SIDE, SceneFeature, Setting};
use crate::model::Model;
use crate::scene::{Arcball, GaussianLobe};

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
    /// How far outside its training range the inputs lie: 0 inside, 1 at the edge of trust, growing beyond; NaN
    /// where the predictor knows no range.
    pub out_of_range: f32,
    /// Where it came from.
    pub source: Source,
}

/// A prediction as a sum of parts that can be corrected apart from each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CostTerms {
    /// Seconds of each part, none negative; [`CostTerms::seconds`] is their sum.
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
    pub fn seconds(&self) -> f32 {
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

    /// Standard deviation of ln(measured / predicted) on the machine that the model was measured on; `None` for a
    /// model that was never measured.
    fn log_sd(&self) -> Option<f32> {
        None
    }

    /// Rays along each side of the probe that the predictor was made with: what [`FrameFeatures::with_probe_side`]
    /// takes. 0 where no input needs the probe.
    fn probe_side(&self) -> usize {
        PROBE_SIDE
    }

    /// Whether a probe of another side than [`Predictor::probe_side`] serves as well: what is linear in counts that every
    /// probe estimates was not trained with one.
    fn any_probe_side(&self) -> bool {
        false
    }

    /// A number that tells predictors apart whose corrections must not be mixed up: what was learned of one says nothing
    /// about another. 0, the default, for predictors that do not tell.
    fn identity(&self) -> u32 {
        0
    }

    /// Whether the ray step enters the prediction. Where it does not, callers scale by the analytic model.
    fn knows_step(&self) -> bool {
        true
    }
}

/// The input groups of the model file contract.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum GroupKind {
    /// `volume_features`.
    VolumeFeatures,
    /// `camera`.
    Camera,
    /// `resolution`.
    Resolution,
    /// `transfer_function`.
    TransferFunction,
    /// `step_size`.
    StepSize,
    /// `scene_features`.
    SceneFeatures,
}

impl GroupKind {
    /// Every group.
    pub const ALL: [Self; 6] = [
        Self::VolumeFeatures,
        Self::Camera,
        Self::Resolution,
        Self::TransferFunction,
        Self::StepSize,
        Self::SceneFeatures,
    ];

    /// The name used in model files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::VolumeFeatures => "volume_features",
            Self::Camera => "camera",
            Self::Resolution => "resolution",
            Self::TransferFunction => "transfer_function",
            Self::StepSize => "step_size",
            Self::SceneFeatures => "scene_features",
        }
    }

    /// Reads a name.
    ///
    /// # Errors
    /// [`crate::ErrorKind::MissingInput`] for a group that this version cannot supply.
    pub fn from_name(name: &str) -> Result<Self> {
        match Self::ALL.into_iter().find(|g| g.name() == name) {
            Some(group) => Ok(group),
            None => bail!(
                MissingInput,
                "the model takes an input group {name:?} that this version does not supply; known are volume_features, camera, resolution, transfer_function, step_size, scene_features"
            ),
        }
    }
}

/// Metadata key under which a model file names the order in which it takes Gaussian lobes: `center` for ascending centers.
/// Without it, lobes go in as they are given. A sum of lobes does not depend on their order; a network that always sees the
/// same order need not learn so.
pub const LOBE_ORDER_KEY: &str = "entire.lobe_order";

/// Whether a model takes its Gaussian lobes by ascending center.
///
/// # Errors
/// [`crate::ErrorKind::Unsupported`] for an order that this version does not know.
pub fn takes_sorted_lobes(model: &Model) -> Result<bool> {
    match model.metadata().get(LOBE_ORDER_KEY).map(|s| s.as_str()) {
        None => Ok(false),
        Some("center") => Ok(true),
        Some(other) => {
            bail!(
                Unsupported,
                "{LOBE_ORDER_KEY} is {other:?}; this version knows center, and none for lobes as given"
            )
        }
    }
}

/// Puts the lobes of a `transfer_function` group, (c, w, h) each, in the order of their centers; equal centers keep theirs.
pub fn sort_lobes(group: &mut [f32]) {
    let count = group.len() / 3;
    for end in 1..count {
        let mut at = end;
        while at > 0 && group[3 * at] < group[3 * (at - 1)] {
            for k in 0..3 {
                group.swap(3 * at + k, 3 * (at - 1) + k);
            }
            at -= 1;
        }
    }
}

/// Writes one input group into its place in a model's input vector.
///
/// # Errors
/// [`crate::ErrorKind::MissingInput`] when the caller did not supply the group, or supplied another size.
pub fn write_group(
    group: GroupKind,
    scene_features: &[SceneFeature],
    inputs: &Inputs<'_>,
    out: &mut [f32],
) -> Result<()> {
    let size = out.len();
    let fixed = |out: &mut [f32], values: &[f32]| {
        if out.len() != values.len() {
            bail!(
                MissingInput,
                "the model's input group {} has size {}, this version supplies {}",
                group.name(),
                out.len(),
                values.len()
            );
        }
        out.copy_from_slice(values);
        Ok(())
    };
    match group {
        GroupKind::VolumeFeatures => match inputs.volume_features {
            Some(x) => fixed(out, x),
            None => bail!(
                MissingInput,
                "the model takes {size} volume features and none were supplied; encode the volume first"
            ),
        },
        GroupKind::Camera => fixed(out, &[inputs.camera.rx, inputs.camera.ry, inputs.camera.dz]),
        GroupKind::Resolution => fixed(out, &[inputs.setting.width as f32, inputs.setting.height as f32]),
        GroupKind::TransferFunction => {
            let Some(lobes) = inputs.lobes else {
                bail!(
                    MissingInput,
                    "the model takes Gaussian transfer-function parameters and none were supplied; describe the transfer function by {} lobes, or use a model on scene features, which takes any transfer function",
                    size / 3
                );
            };
            if lobes.len() * 3 != size {
                bail!(
                    MissingInput,
                    "the model takes {} Gaussian lobes, the transfer function has {}; supply as many as the model was trained with",
                    size / 3,
                    lobes.len()
                );
            }
            for (slot, lobe) in out.chunks_exact_mut(3).zip(lobes) {
                slot.copy_from_slice(&[lobe.center, lobe.width, lobe.height]);
            }
            Ok(())
        }
        GroupKind::StepSize => fixed(out, &[inputs.setting.step]),
        GroupKind::SceneFeatures => {
            if scene_features.len() != size {
                bail!(
                    MissingInput,
                    "the model takes {size} scene features and names {}; its file must name each",
                    scene_features.len()
                );
            }
            inputs.features.write(scene_features, &inputs.setting, inputs.changes, out);
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lobes_are_sorted_by_center_whole_and_stably() {
        let mut group = [0.7, 1.0, 2.0, 0.1, 3.0, 4.0, 0.7, 5.0, 6.0, -0.2, 7.0, 8.0];
        sort_lobes(&mut group);
        assert_eq!(group, [-0.2, 7.0, 8.0, 0.1, 3.0, 4.0, 0.7, 1.0, 2.0, 0.7, 5.0, 6.0]);
        sort_lobes(&mut []);
        let mut one = [0.5, 0.1, 0.2];
        sort_lobes(&mut one);
        assert_eq!(one, [0.5, 0.1, 0.2]);
    }
}
