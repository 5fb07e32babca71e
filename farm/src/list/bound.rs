//! Lower bounds on the end of any schedule.

use anyhow::Result;
use entire_steer::schedule::{assign_longest_first, longest_first};

/// Lower bound on the makespan of any schedule without preemption, seconds: the maximum of (all work) / (sum
/// of all speeds) and, for every k, (work of the k longest tasks) / (sum of the speeds of the k fastest
/// nodes).
///
/// # Errors
/// When a time is negative or not finite, a speed is not finite and positive, or there is no node.
pub fn lower_bound(times: &[f64], speeds: &[f64]) -> Result<f64> {
    // This call only checks the speeds.
    assign_longest_first(&[], speeds)?;
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
