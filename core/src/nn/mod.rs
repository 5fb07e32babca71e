//! Networks: dense layers, activation, PredNet, VolumeNet. The fast loops are in `kernels`.
//!
//! [`PredNetParts`] and [`VolumeNetParts`] are checked weights without a memory layout, as a model file holds
//! them and training writes them. [`PredNet`] is built from them for one
//! [`Level`](crate::kernels::Level) and one [`Storage`](crate::kernels::Storage).

#[cfg(test)]
mod conv3d;
mod parts;
mod prednet;
mod resample;
mod volumenet;

pub use parts::{ConvBlockParts, DenseParts, Dtype, Normalization, PredNetParts, Target, VolumeNetParts};
pub use prednet::{PredNet, PredScratch};
pub use resample::Resampler;
pub(crate) use volumenet::check as check_volumenet;
pub use volumenet::{EncodeScratch, VOLUMENET_TOLERANCE, VolumeNet};
