//! Predicts how long a volume-rendered frame will take, before it is drawn, and picks the ray step that keeps
//! the frame inside its budget.
//!
//! # Units
//!
//! | quantity | unit |
//! |---|---|
//! | time | seconds (`f32`, or `f64` where they are accumulated) |
//! | ray step | multiples of the *reference step*, which is the volume's smallest voxel spacing |
//! | angles | degrees at the door (`Arcball`), radians inside |
//! | scene space | origin at the volume's center, unit length = radius of its bounding sphere |
//! | image sizes | pixels |
//!
//! # Contract
//!
//! The crate is `no_std` with `alloc`. It knows no files, no GPU and no threads that the caller did not give. Hot calls
//! (predict, plan, observe) never allocate, lock or call the system once set-up is done. A prediction is a pure
//! function: same model, same inputs, same SIMD level, same bits, with and without the feature `std`.
#![cfg_attr(not(feature = "std"), no_std)]
#![deny(unsafe_code)]

extern crate alloc;
#[cfg(all(test, not(feature = "std")))]
extern crate std;

pub mod adapt;
pub mod control;
mod error;
pub mod features;
pub mod kernels;
pub mod model;
pub mod nn;
pub mod predict;
pub mod scene;
pub mod schedule;
#[cfg(feature = "train")]
pub mod train;

pub use error::{Error, ErrorKind, Result};
