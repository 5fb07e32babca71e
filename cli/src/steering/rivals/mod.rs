//! The controllers that the hybrid is compared with: the paper's Algorithm 1 with its baselines, and the
//! reactive rules of renderers in use. They implement [`entire_core::control::Controller`]; no product steers
//! by them. All stand here because `entire steer --controllers` offers all of them.

mod algorithm1;
mod reactive;
mod response;
#[cfg(test)]
mod tests;

pub use algorithm1::{Algorithm1, Olp, Pid};
pub use reactive::{Filament, Unreal, VtkFixedPoint, VtkGpu, VtkJs};
pub use response::StepResponse;
