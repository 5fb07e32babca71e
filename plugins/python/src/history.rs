//! The last frames of a session.

use std::collections::VecDeque;

/// Number of frames that are kept.
pub(crate) const KEPT: usize = 4096;

/// One observed frame.
#[derive(Clone, Copy)]
pub(crate) struct Entry {
    pub(crate) plan: u64,
    pub(crate) target: f32,
    pub(crate) predicted: f32,
    pub(crate) upper: f32,
    pub(crate) measured: f32,
    pub(crate) step: f32,
    pub(crate) image_sample_distance: f32,
    pub(crate) reason: &'static str,
    pub(crate) verdict: &'static str,
}

/// The last [`KEPT`] observed frames, oldest first.
#[derive(Default)]
pub(crate) struct History(VecDeque<Entry>);

impl History {
    pub(crate) fn push(&mut self, entry: Entry) {
        if self.0.len() == KEPT {
            self.0.pop_front();
        }
        self.0.push_back(entry);
    }

    pub(crate) fn clear(&mut self) {
        self.0.clear();
    }

    pub(crate) fn entries(&self) -> impl Iterator<Item = &Entry> {
        self.0.iter()
    }
}
