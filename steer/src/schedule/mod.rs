//! Scheduling by longest processing time first, for render farms (paper, section "Load Balancing").
//!
//! Each task is given by its time on a node of speed 1; on a node of speed 2, the task takes half that time.
//! An assignment is made from *predicted* times and evaluated with *measured* times: [`Assignment::makespan`]
//! accepts any times whose sum is finite on the slowest node.

use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::memory::{collected, filled};

/// Largest number of nodes of a schedule.
pub const MAX_NODES: usize = 1 << 20;

/// Assignment of tasks to nodes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Assignment {
    /// Node of each task.
    pub node_of: Vec<usize>,
    /// Number of nodes.
    pub nodes: usize,
}

impl Assignment {
    /// Time until the last node has finished, for given task times and node speeds; its unit is that of
    /// `times`.
    ///
    /// # Errors
    /// [`crate::ErrorKind::SizeMismatch`] if `times` does not have one time per task or `speeds` does not
    /// have one speed per node; [`crate::ErrorKind::InvalidArgument`] for a task on a node that does not
    /// exist; for other invalid values, as [`assign_longest_first`].
    pub fn makespan(&self, times: &[f64], speeds: &[f64]) -> Result<f64> {
        check(times, speeds)?;
        if times.len() != self.node_of.len() || speeds.len() != self.nodes {
            bail!(
                SizeMismatch,
                "there are {} times and {} speeds, but the assignment has {} tasks and {} nodes; give one \
                 time per task and one speed per node",
                times.len(),
                speeds.len(),
                self.node_of.len(),
                self.nodes
            );
        }
        let mut loads = filled(self.nodes, 0.0)?;
        for (&node, &time) in self.node_of.iter().zip(times) {
            let Some(load) = loads.get_mut(node) else {
                bail!(
                    InvalidArgument,
                    "the assignment names node {node}; its {} nodes are numbered from 0",
                    self.nodes
                );
            };
            *load += time / speeds[node];
        }
        Ok(loads.into_iter().fold(0.0, f64::max))
    }
}

/// Indices of the tasks from longest to shortest; equal times in ascending order of index.
///
/// # Errors
/// [`crate::ErrorKind::InvalidArgument`] for a time that is negative or not finite,
/// [`crate::ErrorKind::OutOfMemory`] if memory does not suffice for the indices.
pub fn longest_first(times: &[f64]) -> Result<Vec<usize>> {
    check_times(times)?;
    let mut order = collected(0..times.len())?;
    // The unstable sort allocates nothing; the comparison by index gives equal times a defined order.
    order.sort_unstable_by(|&a, &b| times[b].total_cmp(&times[a]).then(a.cmp(&b)));
    Ok(order)
}

/// Assigns tasks by longest processing time first (Graham 1969): takes the tasks in descending order of time,
/// and assigns each to the node that would finish it first; of several such nodes, to one with the fewest
/// tasks. Tasks of equal time on nodes of equal speed are assigned round-robin.
///
/// # Errors
/// [`crate::ErrorKind::InvalidArgument`] for no node or more than [`MAX_NODES`], for a speed that is not
/// finite and positive, for a time that is negative or not finite, and for times whose sum is not finite;
/// [`crate::ErrorKind::OutOfMemory`] if memory does not suffice for the assignment.
pub fn assign_longest_first(times: &[f64], speeds: &[f64]) -> Result<Assignment> {
    check(times, speeds)?;
    let mut loads = filled(speeds.len(), 0.0f64)?;
    let mut counts = filled(speeds.len(), 0usize)?;
    let mut node_of = filled(times.len(), 0)?;
    for task in longest_first(times)? {
        let done = |n: usize| loads[n] + times[task] / speeds[n];
        let order = |a: usize, b: usize| done(a).total_cmp(&done(b)).then(counts[a].cmp(&counts[b]));
        let node = (0..speeds.len()).min_by(|&a, &b| order(a, b)).unwrap_or(0);
        loads[node] = done(node);
        counts[node] += 1;
        node_of[task] = node;
    }
    Ok(Assignment { node_of, nodes: speeds.len() })
}

fn check(times: &[f64], speeds: &[f64]) -> Result<()> {
    match speeds.len() {
        0 => bail!(InvalidArgument, "there are no nodes; at least one is needed"),
        1..=MAX_NODES => {}
        n => bail!(
            InvalidArgument,
            "there are {n} nodes, but at most {MAX_NODES} are accepted; check the number of nodes"
        ),
    }
    for (i, &s) in speeds.iter().enumerate() {
        if !(s.is_finite() && s > 0.0) {
            bail!(InvalidArgument, "the speed of node {i} is {s}; it must be finite and positive");
        }
    }
    check_times(times)?;
    // This check makes every node's total time finite, for any assignment.
    let slowest = speeds.iter().copied().fold(f64::INFINITY, f64::min);
    if !times.iter().map(|t| t / slowest).sum::<f64>().is_finite() {
        bail!(
            InvalidArgument,
            "on a node of speed {slowest}, the times add up to more than a 64-bit float can hold; check \
             their unit"
        );
    }
    Ok(())
}

fn check_times(times: &[f64]) -> Result<()> {
    for (i, &t) in times.iter().enumerate() {
        if !(t.is_finite() && t >= 0.0) {
            bail!(InvalidArgument, "the time of task {i} is {t}; it must be finite and not negative");
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
