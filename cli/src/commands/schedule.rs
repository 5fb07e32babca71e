//! `entire schedule`: assigns tasks to nodes, or orders them for a queue, and predicts the end.

use anyhow::{Context, Result, bail, ensure};
use entire_farm::list::{MAX_NODES, lower_bound};
use entire_farm::{By, Method, plan, play, read_tasks, times};
use entire_io::files::{ensure_not_input, make_folder_of, write_json, write_whole};
use serde_json::json;
use std::path::PathBuf;

/// Assign the tasks of a render farm to its nodes and predict when the last task ends.
///
/// All seconds in the task list must be wall time: task times on a node of speed 1, and load times, which do
/// not depend on the node. `entire predict` names the clock of its seconds; seconds by another clock than
/// wall time make the predicted end wrong. Writes the assignment or, for a queue, the order of the tasks, as
/// CSV or JSON by the ending of the file's name.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire schedule tasks.csv --nodes 16 --out assignment.csv
  entire schedule tasks.json --speeds 1,1,2,0.5 --method queue --out q.json")]
pub(crate) struct Options {
    /// The task list: CSV with a header line, or a JSON array of objects (.json). Columns: `predicted_s`,
    /// `measured_s` or both, in seconds on a node of speed 1; optionally `task` (a name), `volume`, and
    /// `load_s`, the seconds to load the volume.
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
    /// File for the assignment or order (.csv or .json).
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
}

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
    let out = &options.out;
    ensure_not_input(out, [options.tasks.as_path()]).context("--out")?;
    make_folder_of(out)?;
    let deciding = times(&tasks, options.by)?;
    let plan = plan(options.method, &deciding, &speeds)?;
    // Expected seconds: the prediction of each task, or its measured time if it has no prediction.
    let expected: Vec<f64> = tasks.iter().filter_map(|t| t.predicted_s.or(t.measured_s)).collect();
    let line = play(&plan, &expected, &tasks, &speeds)?;
    // The bound adds the times in another order than the schedule does, so rounding may make it exceed the
    // makespan.
    let bound = lower_bound(&expected, &speeds)?.min(line.makespan);
    ensure!(
        line.makespan.is_finite() && bound.is_finite(),
        "the schedule takes more seconds than a number can hold; check the unit of load_s"
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
            "lower_bound_s": bound, "tasks": spans,
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
        "{} tasks on {} nodes: expected end after {:.3} s; no schedule is expected to end before \
         {bound:.3} s",
        tasks.len(),
        speeds.len(),
        line.makespan
    );
    println!("{}", out.display());
    Ok(())
}
