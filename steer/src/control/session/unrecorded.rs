//! Replacement for the recording of frames in builds without the feature `calibrate`, which record nothing.

use crate::features::VolumeSummary;
use crate::predict::Inputs;
use entire_core::scene::TransferTable;

/// Type without values: a session without the feature `calibrate` never holds a recording.
pub(super) enum Recording {}

impl Recording {
    pub(super) fn probe_side(&self) -> usize {
        match *self {}
    }

    pub(super) fn clear(&mut self) {
        match *self {}
    }

    pub(super) fn set_volume(&mut self, _: &VolumeSummary) {
        match *self {}
    }

    pub(super) fn set_transfer(&mut self, _: &TransferTable) {
        match *self {}
    }

    pub(super) fn plan(&mut self, _: u64, _: &Inputs<'_>) {
        match *self {}
    }

    pub(super) fn observe(&mut self, _: u64, _: f32) {
        match *self {}
    }
}
