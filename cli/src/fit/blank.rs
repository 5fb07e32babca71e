//! The model that a calibration starts from where none is shipped.

use super::compose::carry_past;
use super::recipe::Recipe;
use crate::inputs::Layout;
use anyhow::Result;
use entire_core::features::{SceneFeature, SceneQuantity};
use entire_core::model::ModelFile;
use entire_core::nn::{DenseParts, Dtype, Normalization, PredNetParts, Target};
use entire_core::predict::{GroupKind, UNIT_COSTS_KEY, UnitCosts};

/// Mean and standard deviation of what the factor takes, of the order that random scenes have; the fit only
/// needs numbers of like size.
const INPUTS: [(SceneFeature, f32, f32); 12] = [
    (SceneFeature::log(SceneQuantity::Pixels), 10.5, 1.6),
    (SceneFeature::log(SceneQuantity::SamplesPerPixel), 3.0, 1.5),
    (SceneFeature::log(SceneQuantity::SkipsPerPixel), 1.5, 1.0),
    (SceneFeature::log(SceneQuantity::ShadedPerPixel), 1.0, 3.0),
    (SceneFeature::log(SceneQuantity::ShadowPerPixel), 0.0, 4.0),
    (SceneFeature::log(SceneQuantity::RunsPerRay), 0.5, 0.7),
    (SceneFeature::log(SceneQuantity::RaySpacing), 0.0, 1.0),
    (SceneFeature::linear(SceneQuantity::TerminatedShare), 0.1, 0.2),
    (SceneFeature::log(SceneQuantity::Divergence), -1.5, 1.0),
    (SceneFeature::linear(SceneQuantity::OccupiedShare), 0.5, 0.3),
    (SceneFeature::log(SceneQuantity::MeanChord), 4.6, 0.6),
    (SceneFeature::log(SceneQuantity::Voxels), 15.0, 1.3),
];

/// Unit costs of a software renderer, times a factor of 1 that is linear in a few logarithms.
///
/// # Errors
/// Never for the features of this version.
pub fn blank_prior() -> Result<ModelFile> {
    let width = INPUTS.len();
    let layer = DenseParts {
        inputs: width,
        outputs: 1,
        weight: vec![0.0; width],
        bias: vec![0.0],
        dtype: Dtype::F32,
    };
    let factor = PredNetParts {
        layers: vec![layer],
        input: Some(Normalization {
            mean: INPUTS.iter().map(|i| i.1).collect(),
            std: INPUTS.iter().map(|i| i.2).collect(),
        }),
        output: None,
        target: Target::LogSeconds,
    };
    let mut features: Vec<SceneFeature> = INPUTS.iter().map(|i| i.0).collect();
    features.push(SceneFeature::log(SceneQuantity::EstimatedSeconds));
    let layout = Layout::new(&[GroupKind::SceneFeatures], features, 0, None)?;
    let mut file = ModelFile::new();
    file.set_metadata(UNIT_COSTS_KEY, UnitCosts::SOFTWARE.to_json()?);
    Recipe::default().store(&mut file, carry_past(factor, -3.5, 1.8), &layout)?;
    Ok(file)
}
