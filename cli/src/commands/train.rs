//! `entire train`: train or fine-tune a predictor on collected frames.

use anyhow::Result;

/// Train or fine-tune a predictor on collected frames.
#[derive(Debug, clap::Args)]
pub struct Options {}

/// Runs the command.
pub fn run(_options: &Options) -> Result<()> {
    anyhow::bail!("`entire train` is not there yet")
}
