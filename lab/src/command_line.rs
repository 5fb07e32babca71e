//! The command line of `entire-lab`: studies, their records and bars. Exit status as of `entire`.

use crate::commands;
use clap::{CommandFactory, Parser, Subcommand};
use entire_cli::program;
use entire_io::quiet;
use std::process::ExitCode;

/// Judges predictors and controllers beside others, and measures the project's bars.
#[derive(Debug, Parser)]
#[command(name = "entire-lab", version, propagate_version = true)]
struct Lab {
    /// No progress bar and no notes: results and errors alone.
    #[arg(long, global = true)]
    quiet: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make and judge every predictor of a study; accuracy against latency in one report.
    Study(commands::study::Options),
    /// Hold every table and figure of the paper against ours.
    Paper(commands::paper::Options),
    /// Find how many frames of another make of machine a calibration needs.
    Frames(commands::frames::Options),
    /// Record what every frame of a path costs at a grid of ray steps.
    Record(commands::record::Options),
    /// Record how much somebody else on the machine slows frames down.
    Disturb(commands::disturb::Options),
    /// Replay recorded cost curves under every controller and target, beside an oracle.
    Replay(commands::replay::Options),
    /// Choose the controller's constants on recorded paths.
    Tune(commands::tune::Options),
    /// Play the scenes in which methods of holding a frame time break.
    Stress(commands::stress::Options),
    /// Study a device: pictures, costs, tables, models, frames held; one report.
    GpuStudy(commands::gpu_study::Options),
    /// Compare every way to balance a render farm.
    Farm(commands::farm::Options),
    /// Measure the bars of render farms that need no engine.
    FarmBars(commands::farm_bars::BarsOptions),
    /// Simulate a farm on a task list.
    FarmSimulate(commands::farm_bars::SimulateOptions),
    /// Simulate a farm on a volume that is too large for a node.
    FarmSortLast(commands::farm_sort_last::Options),
    /// Stand in for a renderer in `entire farm`.
    FarmStandIn(commands::farm_bars::StandInOptions),
}

/// The commands with their options, as `--help` tells of them.
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
            Command::FarmBars(options) => commands::farm_bars::run_bars(options),
            Command::FarmSimulate(options) => commands::farm_bars::run_simulate(options),
            Command::FarmSortLast(options) => commands::farm_sort_last::run(options),
            Command::FarmStandIn(options) => commands::farm_bars::run_stand_in(options),
        }
    })
}
