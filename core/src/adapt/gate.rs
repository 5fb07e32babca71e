//! Which timings are believed.

pub use crate::predict::LONGEST_FRAME;

/// What became of an observation. Stable numbers: they are part of the C ABI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[repr(u32)]
pub enum Verdict {
    /// Learned from.
    Learned = 0,
    /// Far from what was expected: its pull was clipped.
    Clipped = 1,
    /// Taken note of, not learned from: the caller flagged it, or it was the first frame after a pipeline was built.
    Ignored = 2,
    /// Refused: NaN or infinite.
    NotFinite = 3,
    /// Refused: zero or negative.
    NotPositive = 4,
    /// Refused: over [`LONGEST_FRAME`].
    TooLong = 5,
    /// Refused: no plan has this id, or it is so old that it was forgotten.
    UnknownPlan = 6,
    /// Refused: this plan was observed before.
    Duplicate = 7,
}

impl Verdict {
    /// Whether the observation was refused and left no trace.
    pub const fn is_refused(self) -> bool {
        (self as u32) >= (Self::NotFinite as u32)
    }

    /// A short name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Learned => "learned",
            Self::Clipped => "clipped",
            Self::Ignored => "ignored",
            Self::NotFinite => "not finite",
            Self::NotPositive => "not positive",
            Self::TooLong => "too long",
            Self::UnknownPlan => "unknown plan",
            Self::Duplicate => "duplicate",
        }
    }
}

/// What the caller knows about an observation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct ObserveFlags {
    /// The time holds work that is not the frame's (a compile, an upload, a stall): note it, do not learn from it.
    pub unusual: bool,
    /// The frame was abandoned before it was complete; its time says only that it takes at least that long.
    pub cancelled: bool,
}

/// Whether a time can be a frame's.
pub fn check_seconds(seconds: f32) -> Option<Verdict> {
    if !seconds.is_finite() {
        Some(Verdict::NotFinite)
    } else if seconds <= 0.0 {
        Some(Verdict::NotPositive)
    } else if seconds > LONGEST_FRAME {
        Some(Verdict::TooLong)
    } else {
        None
    }
}
