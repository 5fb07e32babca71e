//! The command line of `entire-lab`: studies, recordings and bars. Its exit statuses are those of `entire`.

use crate::commands;
use clap::{CommandFactory, Parser, Subcommand};
use entire_cli::program;
use entire_io::quiet;
use std::process::ExitCode;

/// Compares predictors and controllers with others, and measures the project's goals (bars).
#[derive(Debug, Parser)]
#[command(name = "entire-lab", version, propagate_version = true)]
struct Lab {
    /// Print only results and errors: no progress bar, no notes.
    #[arg(long, global = true)]
    quiet: bool,
    #[command(subcommand)]
    command: Command,
}

/// The commands. The help text of a command is the doc comment of its `Options` type.
#[derive(Debug, Subcommand)]
enum Command {
    Study(commands::study::Options),
    Paper(commands::paper::Options),
    Frames(commands::frames::Options),
    Record(commands::record::Options),
    Disturb(commands::disturb::Options),
    Replay(commands::replay::Options),
    Tune(commands::tune::Options),
    Stress(commands::stress::Options),
    GpuStudy(commands::gpu_study::Options),
    Farm(commands::farm::Options),
    FarmBars(commands::farm::BarsOptions),
    FarmSimulate(commands::farm::SimulateOptions),
    FarmStandIn(commands::farm::StandInOptions),
}

/// The commands with their options, as in `--help`.
pub fn command() -> clap::Command {
    Lab::command()
}

/// Runs the command line of this process. Ends the process with status 2 for wrong usage.
pub fn main() -> ExitCode {
    program::run("entire-lab", || {
        let lab = Lab::parse();
        quiet::keep_quiet(lab.quiet);
        match &lab.command {
            Command::Study(options) => commands::study::run(options),
            Command::Paper(options) => commands::paper::run(options),
            Command::Frames(options) => commands::frames::run(options),
            Command::Record(options) => commands::record::run(options),
            Command::Disturb(options) => commands::disturb::run(options),
            Command::Replay(options) => commands::replay::run(options),
            Command::Tune(options) => commands::tune::run(options),
            Command::Stress(options) => commands::stress::run(options),
            Command::GpuStudy(options) => commands::gpu_study::run(options),
            Command::Farm(options) => commands::farm::run(options),
            Command::FarmBars(options) => commands::farm::run_bars(options),
            Command::FarmSimulate(options) => commands::farm::run_simulate(options),
            Command::FarmStandIn(options) => commands::farm::run_stand_in(options),
        }
    })
}
