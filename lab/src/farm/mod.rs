//! Render farms in studies: tasks of recorded paths, and methods of load balancing.

pub mod bars;
mod compare;
mod factor;
mod search;
pub mod sort_last;
pub mod stand_in;
mod tables;
mod tasks;

pub use compare::{Comparison, compare, second_measurement};
pub use factor::Factor;
pub use tasks::{Fitting, tasks_of_trace};
