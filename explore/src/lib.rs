//! The window of `entire`: a volume explorer that holds a target frame time.
//!
//! The window shows pictures of the project's Vulkan raycaster. An [`entire_steer::Session`] plans every
//! frame and then observes the frame's time; a graph shows the prediction with its bound beside the measured
//! time. The picture never leaves the device: the compute shader writes it, the interface samples it.
//!
//! Options of reading volume files, predictors and controllers come from the program that opens the window,
//! through [`Host`].
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
pub use host::{Host, Options, Progress, Steering};
