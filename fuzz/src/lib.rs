//! The readers under test and what must hold for whatever they give back.

/// The command's volume readers, compiled from where they are: the rest of the command (with dependencies that
/// no reader needs) would take minutes to build with a sanitizer.
#[path = "../../cli/src/volume/mod.rs"]
pub mod volume;

pub mod checks;
