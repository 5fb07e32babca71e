//! Networks in plain meaning: dense layers, activation, PredNet, VolumeNet. Speed lives in `kernels`.
//!
//! [`PredNetParts`] and [`VolumeNetParts`] are checked weights without any layout: what a model file holds, what training
//! writes. [`PredNet`] is built from them for one [`Level`](crate::kernels::Level) and one [`Storage`].

#[cfg(test)]
mod conv3d;
mod executor;
mod parts;
mod prednet;
mod resample;
mod volumenet;

pub use executor::Executor;
pub use parts::{ConvBlockParts, DenseParts, Dtype, Normalization, PredNetParts, Target, VolumeNetParts};
pub use prednet::{PREDNET_F32_TOLERANCE, PredNet, PredScratch, Storage};
pub use resample::{RESAMPLE_MAX_RATIO, RESAMPLE_TOLERANCE, Resampler};
pub use volumenet::{EncodeScratch, VOLUMENET_TOLERANCE, VolumeNet};

/// SELU's scale λ (Klambauer et al. 2017, self-normalizing networks).
pub const SELU_SCALE: f64 = 1.050_700_987_355_480_5;
/// SELU's α: SELU(x) = λ·x for x > 0, λ·α·(eˣ − 1) otherwise.
pub const SELU_ALPHA: f64 = 1.673_263_242_354_377_2;

/// Largest relative error of the vector SELU against float64, wherever the result is a normal number; subnormal results
/// are within one unit in the last place. Holds for every finite f32.
pub const SELU_TOLERANCE: f64 = 2e-7;
