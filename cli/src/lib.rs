//! Files, progress bars and plots around `entire-core`: everything behind the `entire` command, as a library
//! so that tests and fuzz targets reach it.

pub mod bound;
pub mod calibrate;
pub mod clock;
pub mod collection;
mod command_line;
pub mod commands;
pub mod dataset;
pub mod device;
pub mod enlarge;
pub mod evaluation;
pub mod farm;
pub mod files;
pub mod fit;
pub mod identity;
pub mod inputs;
pub mod interrupt;
pub mod machine;
pub mod metrics;
pub mod options;
pub mod path;
pub mod pictures;
pub mod program;
pub mod progress;
pub mod quiet;
pub mod reference;
pub mod report;
pub mod scenes;
#[cfg(test)]
mod scripted;
pub mod split;
pub mod steering;
pub mod teacher;
pub mod train;
pub mod volume;

pub use command_line::{command, main_with_args};
