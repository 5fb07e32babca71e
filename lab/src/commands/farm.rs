//! `entire-lab farm`: comparison of methods of load balancing.

use crate::bars;
use crate::farm::{compare, second_measurement, tasks_of_trace};
use crate::trace::Trace;
use anyhow::{Result, bail};
use entire_farm::read_tasks;
use entire_io::files::write_whole;
use entire_steer::features::PROBE_SIDE;
use std::path::PathBuf;

/// Compare methods of load balancing on a render farm of 2 to 64 nodes, by measured times.
///
/// The tasks come from a list (see `entire schedule`) with predicted and measured times, or are the frames of a
/// recorded path, predicted by a model fitted to other volumes.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire-lab farm tasks.csv --report out/farm
  entire-lab farm --trace farm.json --training before.json --probe-side 24 \\
      --report out/farm --bars")]
pub(crate) struct Options {
    /// The task list.
    #[arg(value_name = "TASKS", required_unless_present = "trace")]
    pub(crate) tasks: Option<PathBuf>,
    /// Take the frames of a recorded path at the reference step as tasks.
    #[arg(long, value_name = "TRACE.json", conflicts_with = "tasks")]
    pub(crate) trace: Option<PathBuf>,
    /// Recorded frames of other volumes with the same transfer function, such as frames that the farm rendered
    /// before. The analytic model is fitted to them and predicts --trace.
    #[arg(long, value_delimiter = ',', value_name = "TRACE.json", requires = "trace")]
    pub(crate) training: Vec<PathBuf>,
    /// Rays along each side of the probe that predicts the tasks of --trace, 1 to 24. Steering uses
    /// 11 in every frame; a schedule is computed once, so more rays are affordable.
    #[arg(long, default_value_t = PROBE_SIDE, value_name = "N")]
    pub(crate) probe_side: usize,
    /// Write the tasks of --trace as a task list (CSV).
    #[arg(long, value_name = "TASKS.csv", requires = "trace")]
    pub(crate) save_tasks: Option<PathBuf>,
    /// Folder for the report.
    #[arg(long, value_name = "DIR")]
    pub(crate) report: PathBuf,
    /// Print the goals (bars) of the comparison, and fail when one is missed.
    #[arg(long)]
    pub(crate) bars: bool,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let trace = options.trace.as_ref().map(|file| Trace::open(file)).transpose()?;
    let tasks = match (&options.tasks, &trace) {
        (Some(file), _) => read_tasks(file)?,
        (None, Some(trace)) => tasks_of_trace(trace, &options.training, options.probe_side)?,
        (None, None) => bail!("give a task list or --trace"),
    };
    if let Some(file) = &options.save_tasks {
        let mut out = csv::Writer::from_writer(Vec::new());
        tasks.iter().try_for_each(|t| out.serialize(t))?;
        write_whole(file, &out.into_inner()?)?;
    }
    let source = options.trace.as_ref().or(options.tasks.as_ref()).map(|p| p.display().to_string());
    let noise = trace.as_ref().map(second_measurement).transpose()?.flatten();
    let found = compare(&tasks, source.unwrap_or_default(), noise, &options.report)?;
    if options.bars {
        bars::print(&found)?;
    }
    Ok(())
}
