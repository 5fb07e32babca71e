//! Render farms in studies: tasks of recorded paths, and methods of load balancing.

pub(crate) mod bars;
mod compare;
mod search;
mod tasks;

pub(crate) use compare::compare;
pub(crate) use tasks::tasks_of_trace;
