//! Replacement for the recording of frames in builds without the feature `calibrate`, which record nothing.

use crate::features::VolumeSummary;
use crate::predict::Inputs;
use entire_core::scene::TransferTable;

/// Type without values: a session without the feature `calibrate` never holds a recording.
pub(super) enum Recording {}

/// Methods of a recording, which are never called.
macro_rules! methods {
    ($($name:ident($($kind:ty),*) $(-> $out:ty)?;)*) => {
        impl Recording {
            $(pub(super) fn $name(&self, $(_: $kind),*) $(-> $out)? {
                match *self {}
            })*
        }
    };
}

methods! {
    probe_side() -> usize;
    clear();
    set_volume(&VolumeSummary);
    set_transfer(&TransferTable);
    plan(u64, &Inputs<'_>);
    observe(u64, f32);
}
