//! One module per subcommand: its options and its execution.

pub(crate) mod calibrate;
pub(crate) mod collect;
pub(crate) mod demo;
pub(crate) mod doctor;
pub(crate) mod encode;
pub(crate) mod evaluate;
pub(crate) mod explore;
pub(crate) mod farm;
pub mod features;
pub(crate) mod predict;
pub(crate) mod probe;
pub(crate) mod render;
pub(crate) mod schedule;
pub(crate) mod steer;
pub(crate) mod train;
