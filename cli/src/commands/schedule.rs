//! `entire schedule`: assignment of tasks to nodes, in order, and the predicted end.

use anyhow::{Context, Result, bail, ensure};
use entire_farm::list::lower_bound;
use entire_farm::{By, Farm, Method, Task, eta, plan, play, read_tasks, times};
use entire_io::files::{ensure_not_input, make_folder_of, write_json, write_whole};
use entire_steer::schedule::MAX_NODES;
use serde_json::json;
use std::path::PathBuf;

/// Assign the tasks of a render farm to its nodes and predict when the last task ends.
///
/// Reads tasks (CSV with a header line, or a JSON array of objects): `predicted_s` or `measured_s` (either
/// may be missing, not both), and optionally `task` (a name), `volume` (the data it needs) and `load_s`
/// (seconds to load that data). All seconds are wall time on a node of speed 1; `entire predict` names the
/// clock of its seconds; seconds of another clock are wrong by a factor. Writes the assignment or the order
/// as CSV or JSON, by the file's ending.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire schedule tasks.csv --nodes 16 --out assignment.csv
  entire schedule tasks.json --speeds 1,1,2,0.5 --method queue --out order.json
  entire schedule tasks.csv --nodes 8 --method affinity --window 32 --out order.csv")]
pub(crate) struct Options {
    /// The task list: CSV with a header line, or a JSON array of objects (.json). Columns: `predicted_s` or
    /// `measured_s`, in seconds on a node of speed 1; optionally `task` (a name), `volume`, and `load_s`, the
    /// seconds to load the volume.
    #[arg(value_name = "TASKS")]
    pub(crate) tasks: PathBuf,
    /// Number of nodes, all of equal speed.
    #[arg(long, value_name = "N", conflicts_with = "speeds")]
    pub(crate) nodes: Option<usize>,
    /// Speed of each node; a node of speed 2 needs half of a task's seconds.
    #[arg(long, value_delimiter = ',', value_name = "SPEED,…")]
    pub(crate) speeds: Vec<f64>,
    /// Assignment method.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) method: Method,
    /// Task times that the schedule uses.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) by: By,
    /// Seconds that a node spends on each dispatch from a queue [default: 0].
    #[arg(long, value_name = "SECONDS")]
    pub(crate) dispatch: Option<f64>,
    /// Queue entries that a node searches for a task on its loaded volume (--method affinity) [default: 64].
    #[arg(long, value_name = "TASKS")]
    pub(crate) window: Option<usize>,
    /// File for the assignment or order (.csv or .json).
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
}

/// Runs the command.
///
/// # Errors
/// Bad options or tasks, a file that cannot be written.
pub(crate) fn run(options: &Options) -> Result<()> {
    let tasks = read_tasks(&options.tasks)?;
    let speeds = match (options.nodes, options.speeds.is_empty()) {
        (Some(0), _) => bail!("--nodes is 0; at least one is needed"),
        (Some(n), _) => {
            ensure!(n <= MAX_NODES, "--nodes is {n}; at most {MAX_NODES} are accepted");
            vec![1.0; n]
        }
        (None, false) => options.speeds.clone(),
        (None, true) => bail!("say how many nodes there are (--nodes N, or --speeds S,…)"),
    };
    let name = options.method.name();
    ensure!(
        options.dispatch.is_none() || !matches!(options.method, Method::Static | Method::Longest),
        "--dispatch is the cost of a queue; --method {name} has no queue: leave --dispatch out, or choose \
         queue, arrival or affinity"
    );
    ensure!(
        options.window.is_none() || options.method == Method::Affinity,
        "--window is for --method affinity; --method {name} searches no queue: leave --window out, or \
         choose affinity"
    );
    let farm =
        Farm { speeds, dispatch: options.dispatch.unwrap_or(0.0), window: options.window.unwrap_or(64) };
    write(&tasks, &farm, options)
}

fn write(tasks: &[Task], farm: &Farm, options: &Options) -> Result<()> {
    let (speeds, out) = (&farm.speeds, &options.out);
    ensure_not_input(out, [options.tasks.as_path()]).context("--out")?;
    make_folder_of(out)?;
    let deciding = times(tasks, options.by)?;
    let plan = plan(options.method, &deciding, speeds)?;
    // Expected seconds: the prediction of each task, or its measured time if it has no prediction.
    let expected: Vec<f64> = tasks.iter().filter_map(|t| t.predicted_s.or(t.measured_s)).collect();
    let line = play(&plan, &expected, tasks, farm)?;
    let ([low, middle, high], bound) = eta(&plan, &expected, tasks, farm)?;
    ensure!(
        line.makespan.is_finite() && high.is_finite(),
        "the schedule takes more seconds than a number can hold; check --dispatch and the unit of load_s"
    );
    if out.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
        let spans: Vec<serde_json::Value> = line
            .spans
            .iter()
            .enumerate()
            .map(|(i, s)| {
                let task = &tasks[s.task].task;
                json!({ "order": i, "task": task, "node": s.node, "start_s": s.start, "end_s": s.end })
            })
            .collect();
        let all = json!({
            "method": options.method.name(), "nodes": speeds, "makespan_s": line.makespan,
            "lower_bound_s": lower_bound(&expected, speeds)?,
            "eta_s": { "p5": low, "p50": middle, "p95": high }, "tasks": spans,
        });
        write_json(out, &all)?;
    } else {
        let mut csv = csv::Writer::from_writer(Vec::new());
        csv.write_record(["order", "task", "node", "start_s", "end_s"])?;
        for (i, s) in line.spans.iter().enumerate() {
            csv.write_record([
                i.to_string(),
                tasks[s.task].task.clone(),
                s.node.to_string(),
                s.start.to_string(),
                s.end.to_string(),
            ])?;
        }
        write_whole(out, &csv.into_inner()?)?;
    }
    println!(
        "{} tasks on {} nodes: expected end after {:.3} s, 90 % interval {low:.3} to {high:.3} s; no \
         schedule is expected to end before {bound:.3} s",
        tasks.len(),
        speeds.len(),
        middle
    );
    println!("{}", out.display());
    Ok(())
}
