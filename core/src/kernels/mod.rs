//! SIMD kernels. Every call takes a [`Level`]. This is the only module of the crate with `unsafe`.
//!
//! Only detection on the CPU creates a [`Level`], so a value of this type proves that the CPU has the level's
//! instructions. A network keeps the level for which it was built. PredNet dispatches once per row or block
//! of rows; VolumeNet dispatches several times per layer.
#![allow(unsafe_code, reason = "SIMD intrinsics and packed storage; every block states why it is sound")]

mod activation;
pub(crate) mod conv;
mod dispatch;
mod executor;
mod level;
pub(crate) mod mlp;
pub(crate) mod resample;
mod scalar;
mod simd;
#[cfg(target_arch = "x86_64")]
mod x86_64;

pub use activation::selu;
pub use executor::Executor;
pub use level::Level;
pub use mlp::Storage;
pub use simd::{Kernel, SELU_ALPHA, SELU_SCALE, Simd};
