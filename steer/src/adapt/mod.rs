//! Learning from observed frame times: correction of each term of the cost, margin of the upper bound, and
//! rejection of invalid times.

mod busy;
mod constants;
#[allow(clippy::needless_range_loop, reason = "indices run over several small arrays at once")]
mod correction;
mod gate;
mod margin;
pub(crate) mod state;
#[cfg(test)]
mod tests;

pub use constants::CorrectionConstants;
pub(crate) use constants::{CLIP, PACE, constants};
pub(crate) use correction::{Correction, NOVELTY_LIMIT, Prior, Standing};
pub(crate) use gate::check_seconds;
pub use gate::{ObserveFlags, Verdict};
pub(crate) use margin::{Margin, exceeded, normal_quantile};
