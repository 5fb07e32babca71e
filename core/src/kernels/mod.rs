//! Vector kernels behind a level token: the only module of this crate with `unsafe`.
//!
//! A [`Level`] can only be had by asking the CPU, so holding one proves that the instructions of its ISA may
//! be used. Networks keep the level they were built for and dispatch once per call, never once per layer.
#![allow(unsafe_code, reason = "SIMD intrinsics and packed storage; every block states why it is sound")]

mod activation;
pub(crate) mod conv;
mod dispatch;
mod executor;
pub(crate) mod helper;
mod level;
pub(crate) mod mlp;
mod plain;
pub(crate) mod resample;
mod scalar;
mod simd;
#[cfg(target_arch = "x86_64")]
mod x86_64;

pub use activation::{SELU_ALPHA, SELU_SCALE, selu};
pub use executor::Executor;
pub use helper::Helper;
pub use level::{Isa, Level};
pub use mlp::Storage;
pub use simd::{Kernel, Simd};
