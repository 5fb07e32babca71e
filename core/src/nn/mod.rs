//! Networks in plain meaning: dense layers, activation, PredNet, VolumeNet. Speed lives in `kernels`.
//!
//! [`PredNetParts`] and [`VolumeNetParts`] are checked weights without any layout: what a model file holds,
//! what training writes. [`PredNet`] is built from them for one [`Level`](crate::kernels::Level) and one
//! [`Storage`].

#[cfg(test)]
mod conv3d;
mod parts;
mod prednet;
mod resample;
mod volumenet;

pub use crate::kernels::Executor;
pub use parts::{ConvBlockParts, DenseParts, Dtype, Normalization, PredNetParts, Target, VolumeNetParts};
pub use prednet::{
    PREDNET_BF16_TOLERANCE, PREDNET_F16_TOLERANCE, PREDNET_F32_TOLERANCE, PREDNET_INT8_TOLERANCE, PredNet,
    PredScratch,
};
pub use resample::{RESAMPLE_MAX_RATIO, RESAMPLE_TOLERANCE, Resampler};
pub(crate) use volumenet::check as check_volumenet;
pub use volumenet::{EncodeScratch, MAX_ENCODER_MEMORY, VOLUMENET_TOLERANCE, VolumeNet};

pub use crate::kernels::{Helper, SELU_ALPHA, SELU_SCALE, SELU_TOLERANCE, Storage};
