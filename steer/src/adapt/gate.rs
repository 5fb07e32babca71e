//! Which timings are believed.

use entire_core::names;
use entire_core::{Error, ErrorKind, Result};

use crate::predict::LONGEST_FRAME;

/// What became of an observation. Stable numbers: they are part of the C ABI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[repr(u32)]
pub enum Verdict {
    /// Learned from.
    Learned = 0,
    /// Far from what was expected: its pull was clipped.
    Clipped = 1,
    /// Taken note of, not learned from: the caller said that it is unusual, or cancelled it no later than it
    /// was expected to end.
    Ignored = 2,
}

names! { Verdict:
    Learned "learned",
    Clipped "clipped",
    Ignored "ignored",
}

/// What the caller knows about an observation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct ObserveFlags {
    /// The time holds work that is not the frame's (a compile, an upload, a stall): note it, do not learn
    /// from it.
    pub unusual: bool,
    /// The frame was abandoned before it was complete; its time says only that it takes at least that long.
    pub cancelled: bool,
}

/// Checks that a time can be a frame's.
///
/// # Errors
/// [`crate::ErrorKind::RejectedObservation`] unless it is finite, positive and at most [`LONGEST_FRAME`].
pub(crate) fn check_seconds(seconds: f32) -> Result<()> {
    let text = if !seconds.is_finite() {
        "the frame time is not finite; report the seconds that the frame took"
    } else if seconds <= 0.0 {
        "the frame time is not positive; report the seconds that the frame took"
    } else if seconds > LONGEST_FRAME {
        "the frame time is over 10000 s; report the seconds that the frame took, not milliseconds"
    } else {
        return Ok(());
    };
    Err(Error::new(ErrorKind::RejectedObservation, text))
}
