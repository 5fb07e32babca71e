//! Assignment of tasks to nodes by longest processing time first (paper, section "Load Balancing").
//!
//! Each task is given by its time on a node of speed 1; on a node of speed 2, the task takes half that time.
//! An assignment is made from *predicted* times and evaluated with *measured* times.

use anyhow::{Result, bail, ensure};

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
    /// If `times` does not have one time per task, if `speeds` does not have one speed per node, if a task is
    /// on a node that does not exist, and as [`assign_longest_first`].
    pub fn makespan(&self, times: &[f64], speeds: &[f64]) -> Result<f64> {
        check(times, speeds)?;
        ensure!(
            times.len() == self.node_of.len() && speeds.len() == self.nodes,
            "there are {} times and {} speeds, but the assignment has {} tasks and {} nodes; give one time per \
             task and one speed per node",
            times.len(),
            speeds.len(),
            self.node_of.len(),
            self.nodes
        );
        let mut loads = vec![0.0; self.nodes];
        for (&node, &time) in self.node_of.iter().zip(times) {
            ensure!(
                node < self.nodes,
                "the assignment names node {node}; its {} nodes are numbered from 0",
                self.nodes
            );
            loads[node] += time / speeds[node];
        }
        Ok(loads.into_iter().fold(0.0, f64::max))
    }
}

/// Indices of the tasks from longest to shortest; equal times in ascending order of index.
///
/// # Errors
/// For a time that is negative or not finite.
pub fn longest_first(times: &[f64]) -> Result<Vec<usize>> {
    check_times(times)?;
    let mut order: Vec<usize> = (0..times.len()).collect();
    order.sort_by(|&a, &b| times[b].total_cmp(&times[a]));
    Ok(order)
}

/// Assigns tasks by longest processing time first (Graham 1969): takes the tasks in descending order of time,
/// and assigns each to the node that would finish it first; of several such nodes, to one with the fewest
/// tasks. Tasks of equal time on nodes of equal speed are assigned round-robin.
///
/// # Errors
/// For no node or more than [`MAX_NODES`], for a speed that is not finite and positive, for a time that is
/// negative or not finite, and for times whose sum on the slowest node is not finite.
pub fn assign_longest_first(times: &[f64], speeds: &[f64]) -> Result<Assignment> {
    check(times, speeds)?;
    let mut loads = vec![0.0f64; speeds.len()];
    let mut counts = vec![0usize; speeds.len()];
    let mut node_of = vec![0; times.len()];
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

/// Checks times and speeds, and that the sum of the times is finite on the slowest node.
fn check(times: &[f64], speeds: &[f64]) -> Result<()> {
    check_speeds(speeds)?;
    check_times(times)?;
    let slowest = speeds.iter().copied().fold(f64::INFINITY, f64::min);
    ensure!(
        times.iter().map(|t| t / slowest).sum::<f64>().is_finite(),
        "on a node of speed {slowest}, the times add up to more than a 64-bit float can hold; check their unit"
    );
    Ok(())
}

/// Checks that there are 1 to [`MAX_NODES`] nodes, and that their speeds are finite and positive.
pub(super) fn check_speeds(speeds: &[f64]) -> Result<()> {
    match speeds.len() {
        0 => bail!("there are no nodes; at least one is needed"),
        1..=MAX_NODES => {}
        n => bail!("there are {n} nodes, but at most {MAX_NODES} are accepted; check the number of nodes"),
    }
    for (i, s) in speeds.iter().enumerate() {
        ensure!(s.is_finite() && *s > 0.0, "the speed of node {i} is {s}; it must be finite and positive");
    }
    Ok(())
}

/// Checks that times are finite and not negative.
pub(super) fn check_times(times: &[f64]) -> Result<()> {
    for (i, t) in times.iter().enumerate() {
        ensure!(
            t.is_finite() && *t >= 0.0,
            "the time of task {i} is {t}; it must be finite and not negative"
        );
    }
    Ok(())
}
