//! The paper's evaluation, row by row: frames collected as the paper collects them, its networks trained as it
//! trains them, and one report that holds every table and figure of the paper beside ours.
//!
//! Every step keeps what it made in one folder and makes nothing twice, so that it can be stopped and gone on
//! with: tables of frames, encoders, models, and one file of results for every part of the study.

mod bars;
pub mod book;
pub mod cases;
pub mod collect;
pub mod control;
pub mod description;
pub mod encode;
mod frames;
mod interval;
mod judge;
pub mod material;
mod overall;
pub mod pictures;
pub mod report;
mod results;
mod sections;
pub mod train;
pub mod trials;
mod tuning;
mod volumes;
pub mod yt;

pub use bars::bars;
pub use description::{Paper, read};
pub use results::Results;
pub use volumes::{Place, Selection, places};

use std::time::Instant;

/// What every step of the study works with.
pub struct Work<'a> {
    /// What is asked for.
    pub paper: &'a Paper,
    /// Which part of it.
    pub selection: &'a Selection,
    /// The folder of the volumes.
    pub data: &'a std::path::Path,
    /// The folder that everything made goes to.
    pub out: &'a std::path::Path,
    /// The Python that trains VolumeNet and draws by yt.
    pub python: &'a std::path::Path,
    /// Threads.
    pub pool: &'a rayon::ThreadPool,
    /// When to stop, where that was asked for.
    pub deadline: Option<Instant>,
    /// Whether the user asked to stop.
    pub interrupted: &'a dyn Fn() -> bool,
}

impl Work<'_> {
    /// Whether to stop: the user asked, or the time is over.
    pub fn stop(&self) -> bool {
        (self.interrupted)() || self.deadline.is_some_and(|d| Instant::now() >= d)
    }

    /// Why it stopped and how to go on.
    pub fn stopped(&self) -> &'static str {
        if (self.interrupted)() {
            "interrupted; what is done is kept, the same command goes on"
        } else {
            "the time of --budget is over; what is done is kept, the same command goes on"
        }
    }
}
