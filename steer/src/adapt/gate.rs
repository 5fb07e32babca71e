//! Validation of observed times.

use entire_core::names;
use entire_core::{Error, ErrorKind, Result};

use crate::predict::LONGEST_FRAME;

/// Result of an observation. The numbers are stable: they are part of the C ABI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[repr(u32)]
pub enum Verdict {
    /// The correction was updated.
    Learned = 0,
    /// The time was more than three standard deviations from the expected time. In most cases, the error was
    /// clipped before the update. If the frame began or ended a load, the load was changed instead. If a new
    /// scene was much faster than expected, the error was not clipped. An outlier during a load may be
    /// ignored.
    Clipped = 1,
    /// The time was accepted without an update: the caller marked it as unusual, or cancelled the frame
    /// before its expected time had passed, or there was no prediction.
    Ignored = 2,
}

names! { Verdict:
    Learned "learned",
    Clipped "clipped",
    Ignored "ignored",
}

/// Flags of an observation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct ObserveFlags {
    /// True if the time includes work that most frames do not include (a compilation, an upload, a stall);
    /// nothing is then learned from it.
    pub unusual: bool,
    /// True if the frame was abandoned before it was complete; its time is then a lower bound.
    pub cancelled: bool,
}

/// Checks that a time is a valid frame time.
///
/// # Errors
/// [`crate::ErrorKind::RejectedObservation`] unless the time is finite, positive and at most
/// [`LONGEST_FRAME`].
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
