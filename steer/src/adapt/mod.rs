//! Observations and what they teach: correction of each part of the cost, margin, drift, and the refusal of
//! broken timings.

mod constants;
#[allow(clippy::needless_range_loop, reason = "indices run over several small arrays at once")]
mod correction;
mod gate;
mod margin;
pub(crate) mod state;
#[cfg(test)]
mod tests;

pub use constants::CorrectionConstants;
pub(crate) use constants::constants;
pub use correction::Prior;
pub(crate) use correction::{CLIP, Correction, NOVEL, Standing};
pub(crate) use gate::check_seconds;
pub use gate::{ObserveFlags, Verdict};
pub(crate) use margin::Margin;
