//! Networks in plain meaning: dense layers, activation, PredNet, VolumeNet. Speed lives in `kernels`.
//!
//! [`PredNetParts`] and [`VolumeNetParts`] are checked weights without any layout: what a model file holds,
//! what training writes. [`PredNet`] is built from them for one [`Level`] and one
//! [`Storage`].

#[cfg(test)]
mod conv3d;
mod parts;
mod prednet;
mod resample;
mod volumenet;

pub use crate::kernels::{Executor, Helper, Isa, Level, SELU_ALPHA, SELU_SCALE, Storage, selu};
pub use parts::{ConvBlockParts, DenseParts, Dtype, Normalization, PredNetParts, Target, VolumeNetParts};
pub use prednet::{PredNet, PredScratch};
pub use resample::Resampler;
pub(crate) use volumenet::check as check_volumenet;
pub use volumenet::{EncodeScratch, VOLUMENET_TOLERANCE, VolumeNet};
