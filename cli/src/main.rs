//! The `entire` command. Exit status: 0, 1 for bad input (one line on standard error that says why and what to do),
//! 2 for wrong usage.

use clap::{Parser, Subcommand};
use entire_cli::commands;
use std::io::Write;
use std::process::ExitCode;
use std::sync::{Arc, Mutex};

/// Tells how long a volume-rendered frame will take before it is drawn, and picks the ray step that keeps it inside its
/// budget.
#[derive(Debug, Parser)]
#[command(name = "entire", version, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Render many random frames of volumes and write down how long each took.
    Collect(commands::collect::Options),
    /// Compute the scene features of collected frames and keep them beside the tables.
    Features(commands::features::Options),
    /// Train or fine-tune a predictor on collected frames.
    Train(commands::train::Options),
    /// Measure how well predictors do on collected frames.
    Evaluate(commands::evaluate::Options),
    /// Make and judge every predictor of a study; accuracy against latency in one report.
    Chart(commands::chart::Options),
    /// Find the cheapest predictor that is good enough, and the inputs that it can do without.
    Select(commands::select::Options),
    /// Predict seconds for rows of model inputs.
    Predict(commands::predict::Options),
    /// Turn a volume into its feature vector.
    Encode(commands::encode::Options),
    /// Render one frame and time it.
    Render(commands::render::Options),
    /// Measure what this machine needs for each part of a frame.
    Probe(commands::probe::Options),
    /// Play a path against a target frame time under several controllers.
    Steer(commands::steer::Options),
    /// Record what every frame of a path costs at a grid of ray steps.
    Record(commands::record::Options),
    /// Replay recorded cost curves under every controller and target, beside an oracle.
    Replay(commands::replay::Options),
    /// Decide which node of a farm renders what, in which order.
    Schedule(commands::schedule::Options),
    /// Play the scenes in which methods of holding a frame time break.
    Stress(commands::stress::Options),
    /// Calibrate, explore and report: the main job, end to end.
    Demo(commands::demo::Options),
}

fn main() -> ExitCode {
    // What went wrong is told once, below, in one line: the hook only remembers where.
    let location = Arc::new(Mutex::new(None));
    let noted = location.clone();
    std::panic::set_hook(Box::new(move |info| {
        if let (Some(at), Ok(mut noted)) = (info.location(), noted.lock()) {
            *noted = Some(format!("{}:{}", at.file(), at.line()));
        }
    }));
    let result = std::panic::catch_unwind(|| Cli::parse().run());
    let line = match result {
        Ok(Ok(())) => return ExitCode::SUCCESS,
        // Whoever read our output has seen enough.
        Ok(Err(error)) if error.chain().any(is_broken_pipe) => return ExitCode::SUCCESS,
        Ok(Err(error)) => format!("{error:#}"),
        Err(panic) => {
            let text = panic
                .downcast_ref::<String>()
                .map(String::as_str)
                .or_else(|| panic.downcast_ref::<&str>().copied())
                .unwrap_or("unknown");
            if text.starts_with("failed printing to std") {
                return ExitCode::SUCCESS;
            }
            let at = location.lock().ok().and_then(|at| at.clone()).unwrap_or_default();
            format!("internal error ({text}, {at}); please report it with the command that you ran")
        }
    };
    let line: String = line.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let _ = writeln!(std::io::stderr().lock(), "entire: {line}");
    ExitCode::from(1)
}

impl Cli {
    fn run(&self) -> anyhow::Result<()> {
        match &self.command {
            Command::Collect(options) => commands::collect::run(options),
            Command::Features(options) => commands::features::run(options),
            Command::Train(options) => commands::train::run(options),
            Command::Evaluate(options) => commands::evaluate::run(options),
            Command::Chart(options) => commands::chart::run(options),
            Command::Select(options) => commands::select::run(options),
            Command::Predict(options) => commands::predict::run(options),
            Command::Encode(options) => commands::encode::run(options),
            Command::Render(options) => commands::render::run(options),
            Command::Probe(options) => commands::probe::run(options),
            Command::Steer(options) => commands::steer::run(options),
            Command::Record(options) => commands::record::run(options),
            Command::Replay(options) => commands::replay::run(options),
            Command::Schedule(options) => commands::schedule::run(options),
            Command::Stress(options) => commands::stress::run(options),
            Command::Demo(options) => commands::demo::run(options),
        }
    }
}

fn is_broken_pipe(error: &(dyn std::error::Error + 'static)) -> bool {
    error.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe)
}
