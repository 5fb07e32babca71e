//! Dynamic queues: a free node takes the next task.

use super::assignment::{check_speeds, check_times};
use anyhow::{Result, bail};

/// Time span and node of a task.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Span {
    /// The task.
    pub task: usize,
    /// The node.
    pub node: usize,
    /// Start, seconds from the beginning.
    pub start: f64,
    /// End, seconds from the beginning.
    pub end: f64,
}

/// Result of a schedule.
#[derive(Clone, Debug, PartialEq)]
pub struct Timeline {
    /// Every task, in the order of the schedule.
    pub spans: Vec<Span>,
    /// End of the last task.
    pub makespan: f64,
}

/// Simulates a queue: tasks leave it in `order`, each to the first free node (of several, the fastest).
/// `times` are the true times on a node of speed 1, without loading; predictions determine only the order.
/// Arrival order is `0..n`; [`super::longest_first`] returns the order of predicted times, longest first.
/// `loads` has the volume of each task, and the seconds to load it on a node that had no task or whose
/// previous task was on another volume; these seconds do not depend on the node's speed. `loads` is empty if
/// no task loads a volume.
///
/// # Errors
/// For unusable times or speeds, or an order that is not a permutation of the tasks.
pub fn simulate_queue(
    order: &[usize],
    times: &[f64],
    loads: &[(usize, f64)],
    speeds: &[f64],
) -> Result<Timeline> {
    check_speeds(speeds)?;
    check_times(times)?;
    let loading: Vec<f64> = loads.iter().map(|l| l.1).collect();
    check_times(&loading)?;
    check_order(order, times.len())?;
    Ok(run(order, times, loads, speeds, |free, _| {
        let earlier =
            |&a: &usize, &b: &usize| free[a].total_cmp(&free[b]).then(speeds[b].total_cmp(&speeds[a]));
        (0..free.len()).min_by(earlier).unwrap_or(0)
    }))
}

/// Returns the timeline of tasks that start in `order`. `node_of` returns the node of a task from the times,
/// in seconds, at which the nodes are free. The other arguments are those of [`simulate_queue`].
pub(super) fn run(
    order: &[usize],
    times: &[f64],
    loads: &[(usize, f64)],
    speeds: &[f64],
    node_of: impl Fn(&[f64], usize) -> usize,
) -> Timeline {
    let mut free = vec![0.0f64; speeds.len()];
    let mut holds: Vec<Option<usize>> = vec![None; speeds.len()];
    let mut spans = Vec::with_capacity(order.len());
    for &task in order {
        let node = node_of(&free, task);
        let missing = loads.get(task).filter(|&&(volume, _)| holds[node].replace(volume) != Some(volume));
        let loading = missing.map_or(0.0, |&(_, seconds)| seconds);
        let start = free[node];
        let end = start + loading + times[task] / speeds[node];
        free[node] = end;
        spans.push(Span { task, node, start, end });
    }
    let makespan = free.into_iter().fold(0.0, f64::max);
    Timeline { spans, makespan }
}

fn check_order(order: &[usize], tasks: usize) -> Result<()> {
    let mut seen = vec![false; tasks];
    for &task in order {
        match seen.get_mut(task) {
            Some(slot) if !*slot => *slot = true,
            Some(_) => bail!("the order holds task {task} twice"),
            None => bail!("the order holds task {task}; the {tasks} tasks are numbered from 0"),
        }
    }
    if order.len() != tasks {
        bail!("the order holds {} of {tasks} tasks; it must hold each task once", order.len());
    }
    Ok(())
}
