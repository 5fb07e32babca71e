//! The window of `entire`: a volume explorer whose frame time stays where it is put.
//!
//! One window on the project's Vulkan raycaster. Every frame is planned by an [`entire_steer::Session`] and
//! told to it afterwards; a graph shows the prediction with its bound beside what the frame took. The picture
//! never leaves the device: the compute shader writes it, the interface samples it.
//!
//! What surrounds the window (readers of volume files, predictors, controllers, path files) comes from the
//! program that opens it, through [`Host`].
#![deny(unsafe_code)]

mod app;
mod camera;
mod exchange;
mod histogram;
mod host;
mod loading;
mod log;
#[allow(unsafe_code, reason = "calls into Vulkan")]
mod present;
mod recent;
mod recording;
mod refine;
mod scene;
mod screenshot;
mod script;
mod state;
mod steering;
mod transfer;
mod ui;
mod work_map;

pub use app::run;
pub use host::{Host, Options, Progress, Steering, VolumeSource};
pub use recording::{RecordedFrame, Recording};
pub use transfer::RecordedTransfer;
