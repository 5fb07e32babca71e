//! One module per subcommand: its options and its execution.

pub mod disturb;
pub mod farm;
pub mod farm_bars;
pub mod farm_sort_last;
pub mod frames;
pub mod gpu_study;
pub mod paper;
pub mod record;
pub mod replay;
pub mod stress;
pub mod study;
pub mod tune;
