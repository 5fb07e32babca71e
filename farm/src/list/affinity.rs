//! A dynamic queue whose tasks need a volume that takes time to load.

use super::queue::{Span, Timeline, check, check_dispatch, check_order, first_free};
use anyhow::{Result, bail};

/// A task that needs a volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AffinityTask {
    /// Its volume.
    pub volume: usize,
    /// Its seconds on a node of speed 1, without loading.
    pub seconds: f64,
    /// Seconds to load its volume on a node with another one, whatever the node's speed.
    pub load: f64,
}

/// Simulates a queue in which a node keeps its last volume: it takes the first task on that volume among the
/// next `window` tasks of the order, or the next task if there is none. A window of 1 is
/// [`super::simulate_queue`] with loading times. Every dispatch costs `dispatch` seconds of the node.
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
        bail!("a window of 0 tasks was given; at least the next task must be looked at");
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
