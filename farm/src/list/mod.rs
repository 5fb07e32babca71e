//! Task lists, and their assignment to nodes.

mod assignment;
mod exchange;
mod queue;
#[cfg(test)]
mod tests;

pub use assignment::{Assignment, MAX_NODES, assign_longest_first, longest_first};
pub use queue::{Span, Timeline, simulate_queue};

use anyhow::{Context, Result, ensure};
use assignment::check_speeds;
use entire_io::dataset::Groups;
use entire_io::files::{decode_text, read_bytes};
use exchange::exchange;
use queue::run;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Method of assigning tasks to nodes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Method {
    /// Assigned before the run: longest task first, each to the node that would finish it earliest; then
    /// nodes exchange tasks as long as an exchange makes the end earlier.
    #[default]
    Static,
    /// Assigned before the run: longest task first, without exchanges.
    Longest,
    /// A queue, longest first: a free node takes the next task.
    Queue,
    /// A queue in the order of the list.
    Arrival,
}

entire_core::names! { Method:
    Static "static",
    Longest "longest",
    Queue "queue",
    Arrival "arrival",
}

/// Task times that a schedule uses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum By {
    /// The values of `predicted_s` in the task list.
    #[default]
    Predicted,
    /// The values of `measured_s` in the task list.
    Measured,
    /// All tasks take equally long.
    Uniform,
}

/// A task of a list.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Task {
    /// Name of the task; default: its number in the list.
    pub task: String,
    /// Predicted seconds on a node of speed 1.
    pub predicted_s: Option<f64>,
    /// Measured seconds on a node of speed 1.
    pub measured_s: Option<f64>,
    /// Name of the data that the task needs.
    pub volume: String,
    /// Seconds to load these data.
    pub load_s: f64,
}

/// Reads a task list: JSON if the file's name ends in `.json`, else CSV. Fields are separated by commas,
/// semicolons or tabs. With semicolons or tabs, numbers may have decimal commas. The text is UTF-8, or UTF-16
/// with a byte order mark.
///
/// # Errors
/// When the list cannot be read or a task is invalid. The message names the file, the task and the error.
pub fn read_tasks(path: &Path) -> Result<Vec<Task>> {
    let bytes = read_bytes(path).with_context(|| format!("cannot read the task list {}", path.display()))?;
    let json = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    parse_tasks(&bytes, json).with_context(|| format!("task list {}", path.display()))
}

/// Parses a task list, JSON or CSV.
///
/// # Errors
/// When the list or a task is invalid. The message names the task and the error.
pub fn parse_tasks(bytes: &[u8], json: bool) -> Result<Vec<Task>> {
    let text = decode_text(bytes)?;
    let mut tasks: Vec<Task> = if json { serde_json::from_str(&text)? } else { parse_csv(&text)? };
    ensure!(!tasks.is_empty(), "it holds no task");
    for (i, t) in tasks.iter_mut().enumerate() {
        if t.task.is_empty() {
            t.task = i.to_string();
        }
        ensure!(
            t.predicted_s.is_some() || t.measured_s.is_some(),
            "task {i} ({}) has neither predicted_s nor measured_s; one of them is needed",
            t.task
        );
        for (name, value) in [
            ("predicted_s", t.predicted_s.unwrap_or(0.0)),
            ("measured_s", t.measured_s.unwrap_or(0.0)),
            ("load_s", t.load_s),
        ] {
            ensure!(
                value.is_finite() && value >= 0.0,
                "task {i} ({}): {name} is {value}; it must be finite and not negative",
                t.task
            );
        }
    }
    Ok(tasks)
}

/// Parses CSV. If the first line has semicolons or tabs but no comma, numbers may have decimal commas.
fn parse_csv(text: &str) -> Result<Vec<Task>> {
    let first = text.lines().next().unwrap_or("");
    let delimiter = [b',', b';', b'\t'].into_iter().find(|&d| first.as_bytes().contains(&d)).unwrap_or(b',');
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).delimiter(delimiter).from_reader(text.as_bytes());
    if delimiter == b',' {
        return Ok(reader.deserialize().collect::<std::result::Result<_, _>>()?);
    }
    let headers = reader.headers()?.clone();
    let mut tasks = Vec::new();
    for record in reader.records() {
        let record = record?;
        let mut pointed: csv::StringRecord = record
            .iter()
            .zip(&headers)
            .map(|(field, column)| match column {
                "predicted_s" | "measured_s" | "load_s" => field.replacen(',', ".", 1),
                _ => field.to_owned(),
            })
            .collect();
        pointed.set_position(record.position().cloned());
        tasks.push(pointed.deserialize(Some(&headers))?);
    }
    Ok(tasks)
}

/// Returns the task times that a schedule uses.
///
/// # Errors
/// When a task lacks its time. The message names the first such task.
pub fn times(tasks: &[Task], by: By) -> Result<Vec<f64>> {
    tasks
        .iter()
        .map(|t| match by {
            By::Predicted => t.predicted_s.with_context(|| format!("task {} has no predicted_s", t.task)),
            By::Measured => t.measured_s.with_context(|| format!("task {} has no measured_s", t.task)),
            By::Uniform => Ok(1.0),
        })
        .collect()
}

/// Returns the number of each task's volume. Volumes are numbered in order of first appearance.
pub fn volume_numbers(tasks: &[Task]) -> Vec<usize> {
    let mut numbers = Groups::default();
    tasks.iter().map(|t| numbers.number(&t.volume) as usize).collect()
}

/// Lower bound on the makespan of any schedule without preemption, seconds: the maximum of (all work) / (sum
/// of all speeds) and, for every k, (work of the k longest tasks) / (sum of the speeds of the k fastest
/// nodes).
///
/// # Errors
/// When a time is negative or not finite, a speed is not finite and positive, or there is no node or more
/// than [`MAX_NODES`].
pub fn lower_bound(times: &[f64], speeds: &[f64]) -> Result<f64> {
    check_speeds(speeds)?;
    let order = longest_first(times)?;
    let mut fastest = speeds.to_vec();
    fastest.sort_by(|a, b| b.total_cmp(a));
    let mut bound = times.iter().sum::<f64>() / speeds.iter().sum::<f64>();
    let (mut work, mut speed) = (0.0, 0.0);
    for (&task, &s) in order.iter().zip(&fastest) {
        work += times[task];
        speed += s;
        bound = bound.max(work / speed);
    }
    Ok(bound)
}

/// Simulates a plan with the true times `seconds` on nodes of the given speeds; a node also spends a task's
/// loading time if its previous task was on another volume. Returns node, start and end of every task.
///
/// # Errors
/// For a queue, as [`simulate_queue`]; none for an assignment, whose times and speeds are not checked here.
pub fn play(plan: &Schedule, seconds: &[f64], tasks: &[Task], speeds: &[f64]) -> Result<Timeline> {
    let loads: Vec<(usize, f64)> =
        volume_numbers(tasks).into_iter().zip(tasks.iter().map(|t| t.load_s)).collect();
    match plan {
        Schedule::Assigned(assignment, order) => {
            Ok(run(order, seconds, &loads, speeds, |_, task| assignment.node_of[task]))
        }
        Schedule::Queued(order) => simulate_queue(order, seconds, &loads, speeds),
    }
}

/// A schedule that is computed before the run.
#[derive(Clone, Debug)]
pub enum Schedule {
    /// The node of every task, and the order in which nodes run their tasks.
    Assigned(Assignment, Vec<usize>),
    /// An order from which a free node takes the next task.
    Queued(Vec<usize>),
}

/// Schedules tasks by the expected seconds `deciding`.
///
/// # Errors
/// When a time is negative or not finite; for an assignment, also as [`assign_longest_first`]. The speeds of
/// a queue are not checked here.
pub fn plan(method: Method, deciding: &[f64], speeds: &[f64]) -> Result<Schedule> {
    let order = longest_first(deciding)?;
    Ok(match method {
        Method::Longest => Schedule::Assigned(assign_longest_first(deciding, speeds)?, order),
        Method::Static => {
            let mut assignment = assign_longest_first(deciding, speeds)?;
            exchange(&mut assignment, deciding, speeds)?;
            Schedule::Assigned(assignment, order)
        }
        Method::Queue => Schedule::Queued(order),
        Method::Arrival => Schedule::Queued((0..deciding.len()).collect()),
    })
}
