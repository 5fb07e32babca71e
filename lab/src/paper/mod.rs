//! The paper's evaluation, row by row: frames and networks as the paper describes them, and one report with
//! every table and figure of the paper beside ours.
//!
//! Every step stores its results in one folder and computes nothing twice, so that it can be stopped and
//! continued: tables of frames, encoders, models, and one file of results for every part of the study.

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
mod section;
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

/// Context of every step of the study.
pub struct Work<'a> {
    /// Description of the study.
    pub paper: &'a Paper,
    /// Selected data sets and modes.
    pub selection: &'a Selection,
    /// The folder of the volumes.
    pub data: &'a std::path::Path,
    /// The folder of all results.
    pub out: &'a std::path::Path,
    /// The Python interpreter for VolumeNet and yt.
    pub python: &'a std::path::Path,
    /// Threads for training and prediction.
    pub pool: &'a rayon::ThreadPool,
    /// Deadline, if there is one.
    pub deadline: Option<Instant>,
    /// Returns true if the user asked to stop.
    pub interrupted: &'a dyn Fn() -> bool,
}

impl Work<'_> {
    /// True if the study must stop: the user asked, or the time is over.
    pub fn stop(&self) -> bool {
        (self.interrupted)() || self.deadline.is_some_and(|d| Instant::now() >= d)
    }

    /// Reason for the stop, and the way to continue.
    pub fn stopped(&self) -> &'static str {
        if (self.interrupted)() {
            "interrupted; finished results are kept, the same command goes on from there"
        } else {
            "the time of --budget is over; finished results are kept, the same command goes on from there"
        }
    }
}
