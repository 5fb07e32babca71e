//! Improvement of an assignment by moves and exchanges.

use super::Assignment;
use anyhow::Result;

const ROUNDS_PER_NODE: usize = 40;
/// Smallest gain of a round, as a share of the makespan.
const LEAST_GAIN: f64 = 1.0e-6;
/// Upper bound of the rounding errors of two nodes' ends, as a share of the makespan.
const ROUNDING: f64 = 1.0e-12;

/// A round's change: the node that ends last gives the task `give` to the node `to` and takes `take`, if any.
struct Change {
    give: usize,
    to: usize,
    take: Option<usize>,
    longest: f64,
}

/// In each round, makes one change: the node that ends last gives a task to another node, and may take a task
/// of that node in exchange. Of all such changes, chooses the one after which the later of the two nodes'
/// ends is earliest. Stops when no change helps, or after 40 rounds per node. The makespan for `times` never
/// grows. A round takes O(tasks of the node that ends last · nodes · log tasks).
///
/// After assignment by longest processing time first, the ends of the nodes differ by about the time of one
/// short task. With few tasks per node, that is several percent; exchanges remove this difference. Errors of
/// predicted times are not reduced.
///
/// # Errors
/// When the numbers of tasks or nodes differ from those of the assignment, or a time or speed is invalid.
pub(super) fn exchange(assignment: &mut Assignment, times: &[f64], speeds: &[f64]) -> Result<()> {
    // Checks times and speeds.
    assignment.makespan(times, speeds)?;
    let mut loads = vec![0.0; speeds.len()];
    for (&node, &time) in assignment.node_of.iter().zip(times) {
        loads[node] += time / speeds[node];
    }
    // Each node's tasks in ascending time.
    let mut held: Vec<Vec<usize>> = vec![Vec::new(); speeds.len()];
    for (task, &node) in assignment.node_of.iter().enumerate() {
        held[node].push(task);
    }
    let by_time = |a: &usize, b: &usize| times[*a].total_cmp(&times[*b]).then(a.cmp(b));
    held.iter_mut().for_each(|tasks| tasks.sort_unstable_by(by_time));
    for _ in 0..ROUNDS_PER_NODE * speeds.len() {
        let last = (0..loads.len()).fold(0, |m, n| if loads[n] > loads[m] { n } else { m });
        let Some(change) = best_change(last, times, speeds, &loads, &held) else { break };
        if !(change.longest < loads[last] * (1.0 - LEAST_GAIN)) {
            break;
        }
        let mut carry = |task: usize, from: usize, to: usize| {
            held[from].retain(|&t| t != task);
            let place = held[to].binary_search_by(|t| by_time(t, &task)).unwrap_or_else(|p| p);
            held[to].insert(place, task);
            loads[from] -= times[task] / speeds[from];
            loads[to] += times[task] / speeds[to];
            assignment.node_of[task] = to;
        };
        carry(change.give, last, change.to);
        if let Some(task) = change.take {
            carry(task, change.to, last);
        }
    }
    Ok(())
}

/// Returns the change between `last` and another node after which the later of the two nodes' ends is
/// earliest.
fn best_change(
    last: usize,
    times: &[f64],
    speeds: &[f64],
    loads: &[f64],
    held: &[Vec<usize>],
) -> Option<Change> {
    let mut best: Option<Change> = None;
    for &give in &held[last] {
        for to in (0..loads.len()).filter(|&n| n != last) {
            let (own, other) = (1.0 / speeds[last], 1.0 / speeds[to]);
            // The time at which both nodes would end if tasks could be divided: no change of these two nodes
            // ends earlier.
            let ideal = loads[to] + (loads[last] - loads[to]) * (other / (own + other));
            if best.as_ref().is_some_and(|b| ideal - ROUNDING * loads[last] >= b.longest) {
                continue;
            }
            // Seconds of an ideal task to take: if `last` took this task in exchange for `give`, both nodes
            // would end at the same time.
            let even = times[give] - (loads[last] - loads[to]) / (own + other);
            let above = held[to].partition_point(|&t| times[t] < even);
            let around = [above.checked_sub(1), Some(above)];
            let candidates = around.into_iter().flatten().filter_map(|i| held[to].get(i).copied());
            for take in core::iter::once(None).chain(candidates.map(Some)) {
                let moved = times[give] - take.map_or(0.0, |t| times[t]);
                let longest = f64::max(loads[last] - moved * own, loads[to] + moved * other);
                if best.as_ref().is_none_or(|b| longest < b.longest) {
                    best = Some(Change { give, to, take, longest });
                }
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Compares the best change with that of all pairs of tasks.
        #[test]
        fn no_change_is_better_than_the_best(
            times in prop::collection::vec(0.01f64..10.0, 1..24),
            nodes in prop::collection::vec(0usize..4, 24),
            speeds in prop::collection::vec(0.2f64..4.0, 4),
        ) {
            let (mut held, mut loads) = (vec![Vec::new(); 4], [0.0; 4]);
            for (task, (&time, &node)) in times.iter().zip(&nodes).enumerate() {
                held[node].push(task);
                loads[node] += time / speeds[node];
            }
            held.iter_mut().for_each(|tasks| tasks.sort_by(|&a, &b| times[a].total_cmp(&times[b])));
            let last = (0..4).fold(0, |m, n| if loads[n] > loads[m] { n } else { m });
            let mut expected = f64::INFINITY;
            for to in (0..4).filter(|&n| n != last) {
                for &give in &held[last] {
                    for taken in held[to].iter().map(|&t| times[t]).chain([0.0]) {
                        let moved = times[give] - taken;
                        let ends = [loads[last] - moved / speeds[last], loads[to] + moved / speeds[to]];
                        expected = expected.min(ends[0].max(ends[1]));
                    }
                }
            }
            let found = best_change(last, &times, &speeds, &loads, &held).unwrap();
            prop_assert!((found.longest - expected).abs() < 1e-9, "{} {expected}", found.longest);
        }
    }
}
