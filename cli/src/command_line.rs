//! The command line of `entire`.

use crate::{commands, program};
use clap::{CommandFactory, Parser, Subcommand};
use entire_io::quiet;
use std::ffi::OsString;
use std::process::ExitCode;

/// Predicts the render time of a volume-rendered frame before it is drawn, and picks the ray step and image
/// size with which the frame meets its target time.
#[derive(Debug, Parser)]
#[command(name = "entire", version, propagate_version = true)]
struct Cli {
    /// Print only results and errors: no progress bar, no notes.
    #[arg(long, global = true)]
    quiet: bool,
    #[command(subcommand)]
    command: Command,
}

/// The commands. The doc comment of each `Options` type is the help text of its command.
#[derive(Debug, Subcommand)]
enum Command {
    Collect(commands::collect::Options),
    Calibrate(commands::calibrate::Options),
    Features(commands::features::Options),
    Train(commands::train::Options),
    Evaluate(commands::evaluate::Options),
    Predict(commands::predict::Options),
    Encode(commands::encode::Options),
    Render(commands::render::Options),
    Probe(commands::probe::Options),
    Steer(commands::steer::Options),
    Explore(commands::explore::Options),
    Schedule(commands::schedule::Options),
    Farm(commands::farm::Options),
    #[command(hide = true)]
    FarmWorker(commands::farm::WorkerOptions),
    Demo(commands::demo::Options),
    Doctor(commands::doctor::Options),
}

/// Runs the command line `args`: the program's name, then its arguments. `program` is the command line that
/// starts this program, an executable file and its first arguments; workers of a farm are started with it.
/// Ends the process with status 2 for wrong usage.
pub fn main_with_args(args: impl IntoIterator<Item = OsString>, program: Vec<OsString>) -> ExitCode {
    let args: Vec<OsString> = args.into_iter().collect();
    program::run("entire", move || {
        let cli = Cli::parse_from(args);
        entire_core::kernels::Level::check_override()?;
        cli.run(&program)
    })
}

/// The commands with their options, as in `--help`.
pub fn command() -> clap::Command {
    Cli::command()
}

impl Cli {
    fn run(&self, program: &[OsString]) -> anyhow::Result<()> {
        quiet::keep_quiet(self.quiet);
        match &self.command {
            Command::Collect(options) => commands::collect::run(options),
            Command::Calibrate(options) => commands::calibrate::run(options),
            Command::Features(options) => commands::features::run(options),
            Command::Train(options) => commands::train::run(options),
            Command::Evaluate(options) => commands::evaluate::run(options),
            Command::Predict(options) => commands::predict::run(options),
            Command::Encode(options) => commands::encode::run(options),
            Command::Render(options) => commands::render::run(options),
            Command::Probe(options) => commands::probe::run(options),
            Command::Steer(options) => commands::steer::run(options),
            Command::Explore(options) => commands::explore::run(options),
            Command::Schedule(options) => commands::schedule::run(options),
            Command::Farm(options) => commands::farm::run(options, program),
            Command::FarmWorker(options) => commands::farm::work(options),
            Command::Demo(options) => commands::demo::run(options),
            Command::Doctor(options) => commands::doctor::run(options),
        }
    }
}
