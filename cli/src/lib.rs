//! Files, progress bars and plots around `entire-core`: everything behind the `entire` command, as a library so that
//! tests and fuzz targets reach it.

pub mod bound;
pub mod commands;
pub mod dataset;
pub mod device;
pub mod enlarge;
pub mod feature_table;
pub mod files;
pub mod inputs;
pub mod interrupt;
pub mod latency;
pub mod machine;
pub mod metrics;
pub mod path;
pub mod recipe;
pub mod report;
pub mod scenes;
#[cfg(test)]
mod scripted;
pub mod ship;
pub mod split;
pub mod steering;
pub mod stress;
pub mod study;
pub mod teacher;
pub mod trees;
pub mod volume;
