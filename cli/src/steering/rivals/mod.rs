//! The controllers that the hybrid is compared with: a fixed step, the paper's Algorithm 1 with its
//! baselines, and the reactive rules of other renderers. They implement [`entire_steer::control::Controller`]
//! and are offered by `entire steer` and `entire explore`. The C library does not contain them.

mod algorithm1;
mod reactive;
mod response;
#[cfg(test)]
mod tests;

pub use algorithm1::PID_GAINS;
pub(crate) use algorithm1::{Algorithm1, Fixed, Olp, Pid, Recent};
pub(crate) use reactive::{Filament, Reactive, Rule, Unreal, VtkFixedPoint, VtkGpu, VtkJs};
pub(crate) use response::response_pairs;
pub use response::{StepResponse, response};
