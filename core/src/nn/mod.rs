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

/// Pseudo-random numbers of 53 bits, for tests.
#[cfg(test)]
fn random(seed: u64) -> impl FnMut() -> u64 {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state >> 11
    }
}
