//! `entire-lab farm`: comparison of methods of load balancing; `farm-bars`, `farm-simulate` and
//! `farm-stand-in`: the parts of `make bars-farm`.

use crate::bars;
use crate::farm::{bars as studies, compare, tasks_of_trace};
use crate::trace::Trace;
use anyhow::{Context, Result, bail, ensure};
use entire_farm::dispatch::Order;
use entire_farm::list::lower_bound;
use entire_farm::load::Loads;
use entire_farm::planner::Setting;
use entire_farm::simulate::{World, simulate};
use entire_farm::{By, read_tasks, times, volume_numbers};
use entire_io::files::write_whole;
use entire_report::encode_png;
use entire_steer::features::PROBE_SIDE;
use entire_vk_raycaster::Image;
use serde::Deserialize;
use std::collections::HashMap;
use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Compare methods of load balancing on a render farm of 2 to 64 nodes, by measured times.
///
/// The tasks come from a list (see `entire schedule`) with predicted and measured times, or are the frames of
/// a recorded path, whose times are predicted by a model that was fitted to other volumes.
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
    /// Recorded frames of other volumes with the same transfer function, such as frames that the farm
    /// rendered before. The analytic model is fitted to them and predicts --trace.
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
    let found = compare(&tasks, source.unwrap_or_default(), &options.report)?;
    if options.bars {
        bars::print(&found)?;
    }
    Ok(())
}

/// Measure and print those goals (bars) of render farms that can be measured without an engine; fail when one
/// is missed.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  entire-lab farm-bars
  entire-lab farm-bars --out out/farm")]
pub(crate) struct BarsOptions {
    /// Folder for the job of a million tasks.
    #[arg(long, default_value = "out/farm-bars", value_name = "DIR")]
    pub(crate) out: PathBuf,
}

pub(crate) fn run_bars(options: &BarsOptions) -> Result<()> {
    bars::print(&studies::all(&options.out)?)
}

/// Simulate a farm on a task list with predicted and measured times, and print the result as JSON.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  entire-lab farm-simulate tasks.csv --slots 16
  entire-lab farm-simulate tasks.csv --slots 16 --latency 0.02 --arrival")]
pub(crate) struct SimulateOptions {
    /// The task list.
    #[arg(value_name = "TASKS.csv")]
    pub(crate) tasks: PathBuf,
    /// Number of bundles (groups of tasks) that run at once.
    #[arg(long, value_name = "N")]
    pub(crate) slots: usize,
    /// Time that each bundle takes in addition to its tasks, seconds.
    #[arg(long, default_value_t = 0.0, value_name = "SECONDS")]
    pub(crate) latency: f64,
    /// Overhead per bundle that the planner assumes, seconds; default: --latency.
    #[arg(long, value_name = "SECONDS")]
    pub(crate) overhead: Option<f64>,
    /// Send tasks in the order of the list.
    #[arg(long)]
    pub(crate) arrival: bool,
    /// Plan as if all tasks took equally long.
    #[arg(long)]
    pub(crate) uniform: bool,
}

pub(crate) fn run_simulate(options: &SimulateOptions) -> Result<()> {
    ensure!(options.slots > 0, "--slots is 0; at least one is needed");
    let overhead = options.overhead.unwrap_or(options.latency);
    check("latency", options.latency)?;
    check("overhead", overhead)?;
    let tasks = read_tasks(&options.tasks)?;
    let base = times(&tasks, if options.uniform { By::Uniform } else { By::Predicted })?;
    let truth = times(&tasks, By::Measured)?;
    let volume = volume_numbers(&tasks);
    let volumes = volume.iter().max().map_or(1, |v| v + 1);
    let mut load = vec![0.0; volumes];
    for (task, v) in tasks.iter().zip(&volume) {
        load[*v] = task.load_s;
    }
    let plain = options.arrival || options.uniform;
    let setting = Setting {
        slots: options.slots,
        bound: false,
        overhead,
        limit: None,
        order: if plain { Order::Arrival } else { Order::Longest },
        learn: !options.uniform,
    };
    let mut planner = studies::plan(&base, &volume, Loads::known(load.clone()), setting);
    let world =
        World { latency: options.latency, ..studies::world(truth.clone(), volume, load, options.slots) };
    let out = simulate(&mut planner, &world, &[]);
    let bound = lower_bound(&truth, &world.speeds)?;
    let json = serde_json::json!({
        "makespan_s": out.makespan, "lower_bound_s": bound, "bundles": out.bundles, "loads": out.loads,
    });
    println!("{json}");
    Ok(())
}

/// Stand-in for a renderer in `entire farm`: each task sleeps for its time in a list.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Example, as the renderer of a job file:
  entire-lab farm-stand-in tasks.csv --scale 0.1")]
pub(crate) struct StandInOptions {
    /// The task list; it names tasks by their ids in the job.
    #[arg(value_name = "TASKS.csv")]
    pub(crate) tasks: PathBuf,
    /// Factor by which the seconds of the list are multiplied.
    #[arg(long, default_value_t = 1.0, value_name = "X")]
    pub(crate) scale: f64,
}

pub(crate) fn run_stand_in(options: &StandInOptions) -> Result<()> {
    check("scale", options.scale)?;
    serve(&options.tasks, options.scale)
}

fn check(option: &str, value: f64) -> Result<()> {
    ensure!(value.is_finite() && value >= 0.0, "--{option} is {value}; it must be finite and not negative");
    Ok(())
}

/// A request of the session protocol of `entire farm`.
#[derive(Deserialize)]
struct Asked {
    #[serde(flatten)]
    order: entire_farm::record::Order,
    out: PathBuf,
}

/// Serves tasks from standard input. A task takes `scale` times the `measured_s` (else `predicted_s`) of its
/// entry in the list, plus `scale` times `load_s` if its volume differs from that of the task before.
fn serve(list: &Path, scale: f64) -> Result<()> {
    let tasks = read_tasks(list)?;
    let times: HashMap<&str, (f64, f64)> = tasks
        .iter()
        .map(|t| (t.task.as_str(), (t.measured_s.or(t.predicted_s).unwrap_or(0.0), t.load_s)))
        .collect();
    let mut held = None;
    for line in std::io::stdin().lock().lines() {
        let clock = Instant::now();
        let asked: Asked = serde_json::from_str(&line?).context("standard input")?;
        let (seconds, load) = *times
            .get(asked.order.task.as_str())
            .with_context(|| format!("{} is not in {}", asked.order.task, list.display()))?;
        let fresh = held.as_ref() != Some(&asked.order.volume);
        let load = if fresh { load * scale } else { 0.0 };
        held = Some(asked.order.volume.clone());
        let [width, height] = asked.order.size;
        let image = Image { width, height, rgba: vec![0; 4 * (width * height) as usize] };
        std::fs::write(&asked.out, encode_png(&image)?)
            .with_context(|| format!("cannot write {}", asked.out.display()))?;
        let rest = Duration::from_secs_f64(seconds * scale + load);
        std::thread::sleep(rest.saturating_sub(clock.elapsed()));
        let answer = serde_json::json!({
            "task": asked.order.task, "seconds": seconds * scale, "load_s": load,
        });
        let mut out = std::io::stdout().lock();
        writeln!(out, "{answer}")?;
        out.flush()?;
    }
    Ok(())
}
