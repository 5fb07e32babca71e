//! `entire steer`: play a path against a target frame time under several controllers.

use anyhow::Result;

/// Play a path against a target frame time under several controllers.
#[derive(Debug, clap::Args)]
pub struct Options {}

/// Runs the command.
pub fn run(_options: &Options) -> Result<()> {
    anyhow::bail!("`entire steer` is not there yet")
}
