//! The command line of `entire`.

use crate::commands;
use crate::program;
use clap::{CommandFactory, Parser, Subcommand};
use entire_io::quiet;
use std::ffi::OsString;
use std::process::ExitCode;

/// Predicts the render time of a volume-rendered frame before it is drawn, and picks the ray step that keeps
/// the frame within its time budget.
#[derive(Debug, Parser)]
#[command(name = "entire", version, propagate_version = true)]
struct Cli {
    /// Print only results and errors: no progress bar, no notes.
    #[arg(long, global = true)]
    quiet: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Render many random frames of volumes and write their render times to a table.
    Collect(commands::collect::Options),
    /// Fit a model to this machine in a minute and a half.
    Calibrate(commands::calibrate::Options),
    /// Compute the scene features of collected frames and keep them beside the tables.
    Features(commands::features::Options),
    /// Train or fine-tune a predictor on collected frames.
    Train(commands::train::Options),
    /// Measure the errors of predictors on collected frames.
    Evaluate(commands::evaluate::Options),
    /// Predict seconds for rows of model inputs.
    Predict(commands::predict::Options),
    /// Turn a volume into its feature vector.
    Encode(commands::encode::Options),
    /// Render one frame and time it.
    Render(commands::render::Options),
    /// Measure this machine's rates for rays, samples and skips.
    Probe(commands::probe::Options),
    /// Play a path against a target frame time under several controllers.
    Steer(commands::steer::Options),
    /// View a volume in an interactive window that holds a target frame time.
    Explore(commands::explore::Options),
    /// Assign the tasks of a render farm to its nodes and predict when the last task ends.
    Schedule(commands::schedule::Options),
    /// Render an image database on a farm and predict when it is complete.
    Farm(commands::farm::Options),
    /// A worker of `entire farm`; engines start it.
    #[command(hide = true)]
    FarmWorker(commands::farm::WorkerOptions),
    /// Calibrate, play a path under several controllers, and report.
    Demo(commands::demo::Options),
    /// Report what is installed here and what works with it.
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
