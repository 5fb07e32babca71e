//! The model that a calibration starts from where there is none.

use crate::Result;
use crate::features::{PROBE_SIDE, SceneFeature, SceneQuantity, UnitCosts};
use crate::model::ModelFile;
use crate::nn::{DenseParts, Dtype, Normalization, PredNetParts, Target};
use crate::predict::{GroupKind, InputLayout};
use alloc::vec;
use alloc::vec::Vec;

/// Mean and standard deviation of what the factor takes, of the order that random scenes have; the fit only
/// needs numbers of like size. The last one is the estimate.
const INPUTS: [(SceneQuantity, bool, f32, f32); 13] = [
    (SceneQuantity::Pixels, true, 10.5, 1.6),
    (SceneQuantity::SamplesPerPixel, true, 3.0, 1.5),
    (SceneQuantity::SkipsPerPixel, true, 1.5, 1.0),
    (SceneQuantity::ShadedPerPixel, true, 1.0, 3.0),
    (SceneQuantity::ShadowPerPixel, true, 0.0, 4.0),
    (SceneQuantity::RunsPerRay, true, 0.5, 0.7),
    (SceneQuantity::RaySpacing, true, 0.0, 1.0),
    (SceneQuantity::TerminatedShare, false, 0.1, 0.2),
    (SceneQuantity::Divergence, true, -1.5, 1.0),
    (SceneQuantity::OccupiedShare, false, 0.5, 0.3),
    (SceneQuantity::MeanChord, true, 4.6, 0.6),
    (SceneQuantity::Voxels, true, 15.0, 1.3),
    (SceneQuantity::EstimatedSeconds, true, -3.5, 1.8),
];

/// Unit costs of a software renderer, times a factor of 1 that is linear in a few logarithms: what a
/// calibration starts from where there is no model. Its features are those of a probe with `side`² rays.
///
/// # Errors
/// [`crate::ErrorKind::OutOfMemory`].
pub fn blank_prior(side: usize) -> Result<ModelFile> {
    let width = INPUTS.len();
    let [.., (_, _, mean, deviation)] = INPUTS;
    // The estimate as it is: its logarithm, standardized, times its deviation and past its mean.
    let mut weight = vec![0.0; width];
    weight[width - 1] = deviation;
    let parts = PredNetParts {
        layers: vec![DenseParts { inputs: width, outputs: 1, weight, bias: vec![mean], dtype: Dtype::F32 }],
        input: Some(Normalization {
            mean: INPUTS.iter().map(|i| i.2).collect(),
            std: INPUTS.iter().map(|i| i.3).collect(),
        }),
        output: Some(Normalization { mean: vec![0.0], std: vec![1.0] }),
        target: Target::LogSeconds,
    };
    let features: Vec<SceneFeature> =
        INPUTS.iter().map(|&(quantity, log, ..)| SceneFeature { quantity, log }).collect();
    let mut layout = InputLayout::new(&[GroupKind::SceneFeatures], features, 0, 0)?;
    layout.unit_costs = Some(UnitCosts::SOFTWARE);
    layout.probe_side = if side == 0 { PROBE_SIDE } else { side };
    let mut file = ModelFile::default();
    layout.store(&parts, &mut file)?;
    Ok(file)
}
