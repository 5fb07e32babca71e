//! `entire evaluate`: measure how well predictors do on collected frames.

use anyhow::Result;

/// Measure how well predictors do on collected frames.
#[derive(Debug, clap::Args)]
pub struct Options {}

/// Runs the command.
pub fn run(_options: &Options) -> Result<()> {
    anyhow::bail!("`entire evaluate` is not there yet")
}
