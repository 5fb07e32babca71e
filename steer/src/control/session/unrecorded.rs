//! Replacement for the recording of frames in builds without the feature `calibrate`, which record nothing.

use crate::features::{Changes, TransferSummary, VolumeSummary};
use crate::predict::COSTS;

/// Type without values: a session without the feature `calibrate` never holds a recording.
pub(super) enum Recording {}

/// Methods of a recording, which are never called.
macro_rules! methods {
    ($($name:ident($($kind:ty),*);)*) => {
        impl Recording {
            $(pub(super) fn $name(&self, $(_: $kind),*) {
                match *self {}
            })*
        }
    };
}

methods! {
    clear();
    set_volume(&VolumeSummary);
    set_transfer(&TransferSummary);
    plan(u64, &[f64; COSTS], Changes);
    observe(u64, f32);
}
