//! Observations and what they teach: correction of each part of the cost, margin, drift, and the refusal of
//! broken timings.

#[allow(clippy::needless_range_loop, reason = "indices run over several small arrays at once")]
mod correction;
mod gate;
mod margin;
pub(crate) mod state;
#[cfg(test)]
mod tests;

pub use correction::Prior;
pub(crate) use correction::{Correction, Standing};
pub use gate::{LONGEST_FRAME, ObserveFlags, Verdict, check_seconds};
pub(crate) use margin::Margin;
