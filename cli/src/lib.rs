//! The `entire` command as a library, for tests and for `entire-lab`: calibration, collection, the comparison
//! of controllers, and one module per command.

pub mod calibrate;
pub mod collection;
mod command_line;
pub mod commands;
pub mod pictures;
pub mod program;
pub mod reference;
#[cfg(test)]
mod scripted;
mod shipped;
pub mod steering;

pub use command_line::{command, main_with_args};
