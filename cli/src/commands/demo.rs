//! `entire demo`: calibrate, explore and report: the main job, end to end.

use anyhow::Result;

/// Calibrate, explore and report: the main job, end to end.
#[derive(Debug, clap::Args)]
pub struct Options {}

/// Runs the command.
pub fn run(_options: &Options) -> Result<()> {
    anyhow::bail!("`entire demo` is not there yet")
}
