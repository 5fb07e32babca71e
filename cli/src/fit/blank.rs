//! The model that a calibration starts from where none is shipped.

use super::compose::carry_past;
use super::recipe::Recipe;
use crate::inputs::Layout;
use anyhow::Result;
use entire_core::features::{SceneFeature, SceneQuantity};
use entire_core::model::ModelFile;
use entire_core::nn::{DenseParts, Dtype, Normalization, PredNetParts, Target};
use entire_core::predict::{GroupKind, UnitCosts};

/// Mean and standard deviation of what the factor takes, of the order that random scenes have; the fit only
/// needs numbers of like size.
const INPUTS: [(SceneFeature, f32, f32); 12] = [
    (SceneFeature { quantity: SceneQuantity::Pixels, log: true }, 10.5, 1.6),
    (SceneFeature { quantity: SceneQuantity::SamplesPerPixel, log: true }, 3.0, 1.5),
    (SceneFeature { quantity: SceneQuantity::SkipsPerPixel, log: true }, 1.5, 1.0),
    (SceneFeature { quantity: SceneQuantity::ShadedPerPixel, log: true }, 1.0, 3.0),
    (SceneFeature { quantity: SceneQuantity::ShadowPerPixel, log: true }, 0.0, 4.0),
    (SceneFeature { quantity: SceneQuantity::RunsPerRay, log: true }, 0.5, 0.7),
    (SceneFeature { quantity: SceneQuantity::RaySpacing, log: true }, 0.0, 1.0),
    (SceneFeature { quantity: SceneQuantity::TerminatedShare, log: false }, 0.1, 0.2),
    (SceneFeature { quantity: SceneQuantity::Divergence, log: true }, -1.5, 1.0),
    (SceneFeature { quantity: SceneQuantity::OccupiedShare, log: false }, 0.5, 0.3),
    (SceneFeature { quantity: SceneQuantity::MeanChord, log: true }, 4.6, 0.6),
    (SceneFeature { quantity: SceneQuantity::Voxels, log: true }, 15.0, 1.3),
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
    features.push(SceneFeature { quantity: SceneQuantity::EstimatedSeconds, log: true });
    let layout =
        Layout::new(&[GroupKind::SceneFeatures], features, 0, None)?.with_unit_costs(UnitCosts::SOFTWARE);
    let mut file = ModelFile::default();
    Recipe::default().store(&mut file, carry_past(factor, -3.5, 1.8), &layout)?;
    Ok(file)
}
