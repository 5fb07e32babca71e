//! `entire collect`: render many random frames of volumes and write down how long each took.

use anyhow::Result;

/// Render many random frames of volumes and write down how long each took.
#[derive(Debug, clap::Args)]
pub struct Options {}

/// Runs the command.
pub fn run(_options: &Options) -> Result<()> {
    anyhow::bail!("`entire collect` is not there yet")
}
