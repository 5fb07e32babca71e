//! One module per subcommand: its options and what it does.

pub mod chart;
pub mod collect;
pub mod demo;
pub mod encode;
pub mod evaluate;
pub mod features;
pub mod predict;
pub mod probe;
pub mod record;
pub mod render;
pub mod replay;
pub mod schedule;
pub mod select;
pub mod steer;
pub mod stress;
pub mod train;
