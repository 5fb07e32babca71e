//! `entire render`: render one frame and time it.

use anyhow::Result;

/// Render one frame and time it.
#[derive(Debug, clap::Args)]
pub struct Options {}

/// Runs the command.
pub fn run(_options: &Options) -> Result<()> {
    anyhow::bail!("`entire render` is not there yet")
}
