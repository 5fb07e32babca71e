//! The `entire` command as a library, so that tests and the laboratory reach it: calibration, collection, the race of
//! controllers, and one module per command.

pub mod calibrate;
pub mod collection;
mod command_line;
pub mod commands;
pub mod pictures;
pub mod program;
pub mod reference;
#[cfg(test)]
mod scripted;
pub mod steering;

pub use command_line::{command, main_with_args};
