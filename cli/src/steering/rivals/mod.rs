//! The controllers that the hybrid is compared with: one step for every frame, the paper's Algorithm 1 with
//! its baselines, and the reactive rules of renderers in use. They implement
//! [`entire_steer::control::Controller`]; no product steers by them. All stand here because `entire steer
//! --controllers` offers all of them.

mod algorithm1;
mod fixed;
mod reactive;
mod response;
#[cfg(test)]
mod tests;

pub use algorithm1::{Algorithm1, Olp, Pid};
pub use fixed::Fixed;
pub use reactive::{Filament, Unreal, VtkFixedPoint, VtkGpu, VtkJs};
pub use response::StepResponse;
