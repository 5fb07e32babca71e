//! Reproduction of the paper's evaluation: frames and networks as the paper describes them, and one report
//! with every table and figure of the paper beside ours.
//!
//! Every step stores its results in one folder and computes nothing twice, so that it can be stopped and
//! continued: tables of frames, encoders, models, and one file of results for every part of the study.

mod bars;
pub(crate) mod cases;
pub(crate) mod collect;
pub(crate) mod control;
pub(crate) mod description;
pub(crate) mod encode;
mod frames;
pub(crate) mod improved;
mod interval;
mod judge;
pub(crate) mod pictures;
pub(crate) mod report;
pub(crate) mod results;
mod section;
mod sections;
pub(crate) mod train;
mod trial_sections;
pub(crate) mod trials;
mod tuning;
mod volumes;
pub(crate) mod yt;

pub(crate) use description::Paper;
pub(crate) use volumes::{Place, Selection, places};

use anyhow::{Result, ensure};
use std::time::Instant;

/// Context of every step of the study.
pub(crate) struct Work<'a> {
    pub(crate) paper: &'a Paper,
    pub(crate) selection: &'a Selection,
    pub(crate) data: &'a std::path::Path,
    pub(crate) out: &'a std::path::Path,
    /// The Python interpreter for VolumeNet and yt.
    pub(crate) python: &'a std::path::Path,
    pub(crate) pool: &'a rayon::ThreadPool,
    pub(crate) deadline: Option<Instant>,
    pub(crate) interrupted: &'a (dyn Fn() -> bool + Sync),
}

impl Work<'_> {
    /// True if the study must stop: the user asked, or the time is over.
    pub(crate) fn stop(&self) -> bool {
        (self.interrupted)() || self.deadline.is_some_and(|d| Instant::now() >= d)
    }

    pub(crate) fn go_on(&self) -> Result<()> {
        ensure!(!self.stop(), "{}", self.stopped());
        Ok(())
    }

    /// Reason for the stop, and the way to continue.
    pub(crate) fn stopped(&self) -> &'static str {
        if (self.interrupted)() {
            "interrupted; finished results are kept, the same command goes on from there"
        } else {
            "the time of --budget is over; finished results are kept, the same command goes on from there"
        }
    }
}
