//! Predicts how long a volume-rendered frame takes, before it is drawn, and picks the ray step that keeps the
//! frame inside its budget.
//!
//! # Units
//!
//! | quantity | unit |
//! |---|---|
//! | time | seconds (`f32`; `f64` for sums of times) |
//! | ray step | multiples of the *reference step*, the volume's smallest voxel spacing |
//! | angles | degrees in the interface (`Arcball`), radians inside |
//! | scene space | origin at the volume's center, unit length = radius of its bounding sphere |
//! | image sizes | pixels |
//!
//! # Steering a render loop
//!
//! A [`Session`] holds the volume and the transfer function. Before each frame, the session plans the ray
//! step; after the frame, the caller reports the seconds that the frame took:
//!
//! ```
//! use entire_core::scene::{Arcball, Camera, Scalars, TransferFunction};
//! use entire_core::{Frame, GaussianLobe, VolumeView};
//! use entire_steer::control::ObserveFlags;
//! use entire_steer::{Session, VolumeSummary};
//!
//! let voxels = vec![100u8; 32 * 32 * 32];
//! let view = VolumeView::new(Scalars::U8(&voxels), [32, 32, 32])?;
//! let lobe = GaussianLobe { center: 0.4, width: 0.1, height: 0.8 };
//! let table = TransferFunction::Gaussian(vec![lobe]).to_table()?;
//!
//! let mut session = Session::default();
//! session.set_volume(VolumeSummary::new(&view)?, None);
//! session.set_transfer(&table, None)?;
//!
//! let camera = Camera::from_arcball(Arcball { rx: 20.0, ry: 30.0, dz: 2.0 })?;
//! let frame = Frame::new(camera, 640, 480)?;
//! let plan = session.plan(&frame, 0.016)?;
//! // … draw with plan.step and measure the seconds it took …
//! let seconds = 0.012;
//! session.observe(plan.id, seconds, ObserveFlags::default())?;
//!
//! // Predicted time of a frame, corrected by the observations:
//! let expected = session.predict(&frame)?;
//! assert!(expected.seconds > 0.0 && expected.upper >= expected.seconds);
//! # Ok::<(), entire_core::Error>(())
//! ```
//!
//! # Loading a model
//!
//! [`predict::load`] makes a predictor from a model file; [`Session::new`] makes a session that uses the
//! predictor:
//!
//! ```
//! use entire_core::Model;
//! use entire_steer::control::HybridOptions;
//! use entire_steer::predict::{AnalyticModel, load};
//! use entire_steer::Session;
//!
//! // Bytes of a model file; here of an analytic model.
//! let bytes = AnalyticModel::default().to_model_file()?.to_bytes()?;
//! let model = Model::from_bytes(&bytes)?;
//! let session = Session::new(load(&model)?, HybridOptions::default())?;
//! # let _ = session;
//! # Ok::<(), entire_core::Error>(())
//! ```
//!
//! # Contract
//!
//! The crate is `no_std` with `alloc`. It uses no files, no GPU and no threads except those of the caller.
//! Hot calls (predict, plan, observe) never allocate, lock or make a system call once set-up is done. A
//! prediction is a pure function: the same model, inputs and SIMD level give the same bits, with and without
//! the feature `std`.
#![cfg_attr(not(any(feature = "std", test)), no_std)]
#![forbid(unsafe_code)]

extern crate alloc;

mod adapt;
#[cfg(feature = "calibrate")]
pub mod calibrate;
pub mod control;
pub mod features;
mod memory;
pub mod numeric;
pub mod predict;

pub use control::{Plan, Session};
pub use entire_core::{Error, ErrorKind, Result};
pub use features::VolumeSummary;
pub use predict::{Prediction, Predictor};
