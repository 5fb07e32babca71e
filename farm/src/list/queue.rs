//! A dynamic queue: a free node takes the next task.

use anyhow::{Result, bail, ensure};
use entire_steer::schedule::longest_first;

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
    check(times, speeds)?;
    check_order(order, times.len())?;
    check_dispatch(dispatch)?;
    let mut free = vec![0.0f64; speeds.len()];
    let mut spans = Vec::with_capacity(order.len());
    for &task in order {
        let node = first_free(&free, speeds);
        let start = free[node];
        let end = start + dispatch + times[task] / speeds[node];
        free[node] = end;
        spans.push(Span { task, node, start, end });
    }
    let makespan = free.into_iter().fold(0.0, f64::max);
    Ok(Timeline { spans, makespan })
}

/// Checks that times are finite and not negative, and speeds finite and positive.
pub(super) fn check(times: &[f64], speeds: &[f64]) -> Result<()> {
    ensure!(!speeds.is_empty(), "there are no nodes; at least one is needed");
    if let Some((node, speed)) = speeds.iter().enumerate().find(|(_, s)| !(s.is_finite() && **s > 0.0)) {
        bail!("the speed of node {node} is {speed}; it must be finite and positive");
    }
    // Checks the times; the order is not used.
    longest_first(times)?;
    Ok(())
}

/// Checks that a dispatch cost is finite and not negative.
pub(super) fn check_dispatch(seconds: f64) -> Result<()> {
    ensure!(
        seconds.is_finite() && seconds >= 0.0,
        "the dispatch cost is {seconds} seconds; it must be finite and not negative"
    );
    Ok(())
}

pub(super) fn first_free(free: &[f64], speeds: &[f64]) -> usize {
    let earlier = |&a: &usize, &b: &usize| free[a].total_cmp(&free[b]).then(speeds[b].total_cmp(&speeds[a]));
    (0..free.len()).min_by(earlier).unwrap_or(0)
}

pub(super) fn check_order(order: &[usize], tasks: usize) -> Result<()> {
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
