//! One module per subcommand: its options and its execution.

pub mod calibrate;
pub mod collect;
pub mod demo;
pub mod doctor;
pub mod encode;
pub mod evaluate;
pub mod explore;
pub mod farm;
pub mod features;
pub mod predict;
pub mod probe;
pub mod render;
pub mod schedule;
pub mod steer;
pub mod train;
