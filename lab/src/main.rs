//! The `entire-lab` command: studies, their records and bars. Exit status as of `entire`.

use clap::{Parser, Subcommand};
use entire_cli::program;
use entire_lab::commands;
use std::process::ExitCode;

/// Judges predictors and controllers beside others, and measures the project's bars.
#[derive(Debug, Parser)]
#[command(name = "entire-lab", version, propagate_version = true)]
struct Lab {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make and judge every predictor of a study; accuracy against latency in one report.
    Study(commands::study::Options),
    /// Find the cheapest predictor that is good enough, and the inputs that it can do without.
    Select(commands::select::Options),
    /// Record what every frame of a path costs at a grid of ray steps.
    Record(commands::record::Options),
    /// Replay recorded cost curves under every controller and target, beside an oracle.
    Replay(commands::replay::Options),
    /// Play the scenes in which methods of holding a frame time break.
    Stress(commands::stress::Options),
    /// Compare every way to balance a render farm.
    Farm(commands::farm::Options),
}

fn main() -> ExitCode {
    program::run("entire-lab", || match &Lab::parse().command {
        Command::Study(options) => commands::study::run(options),
        Command::Select(options) => commands::select::run(options),
        Command::Record(options) => commands::record::run(options),
        Command::Replay(options) => commands::replay::run(options),
        Command::Stress(options) => commands::stress::run(options),
        Command::Farm(options) => commands::farm::run(options),
    })
}
