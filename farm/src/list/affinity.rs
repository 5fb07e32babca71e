//! A dynamic queue whose tasks need a volume that takes time to load.

use super::queue::{Span, Timeline, check, check_dispatch, check_order, first_free};
use anyhow::{Result, bail};

/// A task that needs a volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AffinityTask {
    /// The volume that the task needs.
    pub volume: usize,
    /// Seconds of the task on a node of speed 1, without loading.
    pub seconds: f64,
    /// Seconds to load the volume on a node that does not hold it. They do not depend on the node's speed.
    pub load: f64,
}

/// Simulates a queue in which a node keeps its last volume. The node takes the first task on this volume
/// among the next `window` tasks of the order, or the next task if there is none. With a window of 1, the
/// result is that of [`super::simulate_queue`] with loading times. Every dispatch costs `dispatch` seconds of
/// the node.
///
/// # Errors
/// For unusable times, speeds or dispatch cost, a window of 0, or an order that is not a permutation of the
/// tasks.
pub fn simulate_affinity(
    order: &[usize],
    tasks: &[AffinityTask],
    speeds: &[f64],
    window: usize,
    dispatch: f64,
) -> Result<Timeline> {
    let times: Vec<f64> = tasks.iter().map(|t| t.seconds).collect();
    check(&times, speeds)?;
    let loads: Vec<f64> = tasks.iter().map(|t| t.load).collect();
    check(&loads, speeds)?;
    check_order(order, tasks.len())?;
    check_dispatch(dispatch)?;
    if window == 0 {
        bail!("the window is 0 tasks; it must be at least 1");
    }
    let mut free = vec![0.0f64; speeds.len()];
    let mut holds: Vec<Option<usize>> = vec![None; speeds.len()];
    let mut waiting: Vec<usize> = order.to_vec();
    let mut spans = Vec::with_capacity(order.len());
    while !waiting.is_empty() {
        let node = first_free(&free, speeds);
        let near = &waiting[..window.min(waiting.len())];
        let pick = near.iter().position(|&t| holds[node] == Some(tasks[t].volume)).unwrap_or(0);
        let task = waiting.remove(pick);
        let AffinityTask { volume, seconds, load } = tasks[task];
        let loading = if holds[node] == Some(volume) { 0.0 } else { load };
        holds[node] = Some(volume);
        let start = free[node];
        let end = start + dispatch + loading + seconds / speeds[node];
        free[node] = end;
        spans.push(Span { task, node, start, end });
    }
    let makespan = free.into_iter().fold(0.0, f64::max);
    Ok(Timeline { spans, makespan })
}
