//! `entire encode`: turn a volume into its feature vector.

use anyhow::Result;

/// Turn a volume into its feature vector.
#[derive(Debug, clap::Args)]
pub struct Options {}

/// Runs the command.
pub fn run(_options: &Options) -> Result<()> {
    anyhow::bail!("`entire encode` is not there yet")
}
