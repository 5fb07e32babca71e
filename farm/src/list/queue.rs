//! Dynamic queues: a free node takes the next task, or one that needs its loaded volume.

use anyhow::{Result, bail, ensure};
use entire_steer::schedule::{assign_longest_first, longest_first};
use std::collections::VecDeque;

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

/// Result of a queue.
#[derive(Clone, Debug, PartialEq)]
pub struct Timeline {
    /// Every task in the order of dispatch.
    pub spans: Vec<Span>,
    /// End of the last task.
    pub makespan: f64,
}

/// Simulates a queue: tasks leave it in `order`, each to the first free node (of several, the fastest).
/// `times` are the true times; predictions determine only the order. Arrival order is `0..n`;
/// [`longest_first`] returns the order of predicted times, longest first. Every dispatch costs `dispatch`
/// seconds of the node.
///
/// # Errors
/// For unusable times, speeds or dispatch cost, or an order that is not a permutation of the tasks.
pub fn simulate_queue(order: &[usize], times: &[f64], speeds: &[f64], dispatch: f64) -> Result<Timeline> {
    let n = times.len();
    simulate_affinity(order, (times, &vec![0; n], &vec![0.0; n]), speeds, 1, dispatch)
}

/// Simulates a queue in which a node keeps its last volume. The node takes the first task on this volume
/// among the next `window` tasks of the order, or the next task if there is none. Every dispatch costs
/// `dispatch` seconds of the node. The tasks are given by their seconds on a node of speed 1 without loading,
/// their volumes, and the seconds to load each task's volume on a node that does not hold it, which do not
/// depend on the node's speed.
///
/// # Errors
/// For unusable times, speeds or dispatch cost, a window of 0, or an order that is not a permutation of the
/// tasks.
pub(super) fn simulate_affinity(
    order: &[usize],
    (times, volumes, loads): (&[f64], &[usize], &[f64]),
    speeds: &[f64],
    window: usize,
    dispatch: f64,
) -> Result<Timeline> {
    check(times, speeds)?;
    check(loads, speeds)?;
    check_order(order, times.len())?;
    ensure!(
        dispatch.is_finite() && dispatch >= 0.0,
        "the dispatch cost is {dispatch} seconds; it must be finite and not negative"
    );
    ensure!(window > 0, "the window is 0 tasks; it must be at least 1");
    let mut free = vec![0.0f64; speeds.len()];
    let mut holds: Vec<Option<usize>> = vec![None; speeds.len()];
    let mut waiting: VecDeque<usize> = order.iter().copied().collect();
    let mut spans = Vec::with_capacity(order.len());
    while !waiting.is_empty() {
        let node = first_free(&free, speeds);
        let near = waiting.iter().take(window).position(|&t| holds[node] == Some(volumes[t]));
        let Some(task) = waiting.remove(near.unwrap_or(0)) else { break };
        let holding = holds[node].replace(volumes[task]) == Some(volumes[task]);
        let loading = if holding { 0.0 } else { loads[task] };
        let start = free[node];
        let end = start + dispatch + loading + times[task] / speeds[node];
        free[node] = end;
        spans.push(Span { task, node, start, end });
    }
    let makespan = free.into_iter().fold(0.0, f64::max);
    Ok(Timeline { spans, makespan })
}

/// Checks that times are finite and not negative, and speeds finite and positive.
fn check(times: &[f64], speeds: &[f64]) -> Result<()> {
    // The results are not used.
    assign_longest_first(&[], speeds)?;
    longest_first(times)?;
    Ok(())
}

fn first_free(free: &[f64], speeds: &[f64]) -> usize {
    let earlier = |&a: &usize, &b: &usize| free[a].total_cmp(&free[b]).then(speeds[b].total_cmp(&speeds[a]));
    (0..free.len()).min_by(earlier).unwrap_or(0)
}

fn check_order(order: &[usize], tasks: usize) -> Result<()> {
    let mut seen = vec![false; tasks];
    for &task in order {
        match seen.get_mut(task) {
            Some(slot) if !*slot => *slot = true,
            Some(_) => bail!("the order holds task {task} twice"),
            None => bail!("the order holds task {task}, but there are only {tasks} tasks"),
        }
    }
    if order.len() != tasks {
        bail!("the order holds {} of {tasks} tasks; it must hold each once", order.len());
    }
    Ok(())
}
