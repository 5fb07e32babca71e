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

#[derive(Debug, Subcommand)]
enum Command {
    /// Train and test every predictor of a study; report accuracy against latency.
    Study(commands::study::Options),
    /// Reproduce every table and figure of the paper, beside our results.
    Paper(commands::paper::Options),
    /// Measure the error of calibrations to few and many frames, on another type of machine.
    Frames(commands::frames::Options),
    /// Record the time of every frame of a path at a grid of ray steps.
    Record(commands::record::Options),
    /// Record the slowdown of frames while another program runs on the machine.
    Disturb(commands::disturb::Options),
    /// Replay recorded time curves under every controller and target, beside an oracle.
    Replay(commands::replay::Options),
    /// Search for better constants of the controller on recorded paths.
    Tune(commands::tune::Options),
    /// Play stress scenes, in which methods of holding a frame time fail.
    Stress(commands::stress::Options),
    /// Measure a device: pictures, rates, timing tables, models and steering, in one report.
    GpuStudy(commands::gpu_study::Options),
    /// Compare methods of load balancing on a render farm.
    Farm(commands::farm::Options),
    /// Measure those goals of render farms that can be measured without an engine.
    FarmBars(commands::farm_bars::BarsOptions),
    /// Simulate a farm on a task list.
    FarmSimulate(commands::farm_bars::SimulateOptions),
    /// Stand-in for a renderer in `entire farm`: sleeps for listed times.
    FarmStandIn(commands::farm_bars::StandInOptions),
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
            Command::FarmBars(options) => commands::farm_bars::run_bars(options),
            Command::FarmSimulate(options) => commands::farm_bars::run_simulate(options),
            Command::FarmStandIn(options) => commands::farm_bars::run_stand_in(options),
        }
    })
}
