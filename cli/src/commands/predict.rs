//! `entire predict`: predict seconds for rows of model inputs.

use anyhow::Result;

/// Predict seconds for rows of model inputs.
#[derive(Debug, clap::Args)]
pub struct Options {}

/// Runs the command.
pub fn run(_options: &Options) -> Result<()> {
    anyhow::bail!("`entire predict` is not there yet")
}
