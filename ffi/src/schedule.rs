//! Assignment of tasks to the nodes of a render farm.

use crate::abi::{check_pointer, slice, slice_mut, write};
use crate::guard::{entry, guard};
use crate::limits::{ENTIRE_MAX_NODES, ENTIRE_MAX_TASKS, ENTIRE_MAX_TASKS_TIMES_NODES, at_most};
use crate::reserve;
use crate::result::entire_result::{self, *};
use crate::result::{Failure, collected, refuse};
use entire_steer::schedule::assign_longest_first;

/// Assigns tasks to nodes in order of decreasing time, each to the node that would finish it earliest.
/// `seconds` holds each task's time on a node of speed 1 and `speeds` each node's speed (2: takes half the
/// time); `speeds` may be NULL for nodes of speed 1. `node_of_task` receives the node of each task, counted
/// from 0. `makespan`, which may be NULL, receives the seconds until the last node is done.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (no node, a time or speed that is out of range, times whose sum
/// overflows a double), ENTIRE_SIZE_MISMATCH (counts over ENTIRE_MAX_TASKS, ENTIRE_MAX_NODES or
/// ENTIRE_MAX_TASKS_TIMES_NODES), ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_schedule(
    seconds: *const f64,
    task_count: usize,
    speeds: *const f64,
    node_count: usize,
    node_of_task: *mut usize,
    makespan: *mut f64,
) -> entire_result {
    entry!(guard(|| {
        reserve::check()?;
        check_counts(task_count, node_count)?;
        let times = slice(seconds, task_count, "seconds")?;
        let equal;
        let speeds = if speeds.is_null() {
            equal = collected(std::iter::repeat_n(1.0, node_count))?;
            equal.as_slice()
        } else {
            slice(speeds, node_count, "speeds")?
        };
        let out = slice_mut(node_of_task, task_count, "node_of_task (output)")?;
        if !makespan.is_null() {
            check_pointer(makespan, "makespan (output)")?;
        }
        let assignment = assign_longest_first(times, speeds)?;
        let longest = assignment.makespan(times, speeds)?;
        out.copy_from_slice(&assignment.node_of);
        if !makespan.is_null() {
            write(makespan, longest, "makespan (output)")?;
        }
        Ok(())
    }))
}

fn check_counts(tasks: usize, nodes: usize) -> Result<(), Failure> {
    at_most("task_count", tasks, ENTIRE_MAX_TASKS, "ENTIRE_MAX_TASKS")?;
    at_most("node_count", nodes, ENTIRE_MAX_NODES, "ENTIRE_MAX_NODES")?;
    // Both counts are within their limits here, so their product does not overflow.
    if tasks as u64 * nodes as u64 > ENTIRE_MAX_TASKS_TIMES_NODES {
        refuse!(
            ENTIRE_SIZE_MISMATCH,
            "{tasks} tasks on {nodes} nodes are too many: the product of both numbers must be at most \
             {ENTIRE_MAX_TASKS_TIMES_NODES} (ENTIRE_MAX_TASKS_TIMES_NODES). Split the tasks or the nodes \
             into groups, and schedule each group alone"
        );
    }
    Ok(())
}
