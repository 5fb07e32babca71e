//! The readers under test, invariants of their results, and mutations that know their formats.
//!
//! The command's readers are compiled from their files: the rest of the command (with dependencies that no
//! reader needs) would take minutes to build with a sanitizer.

#![allow(dead_code, unused_imports, reason = "parts of modules that no target calls")]

// The trace's reader refers to the command's library, whose modules these are.
extern crate self as entire_cli;

#[path = "../../cli/src/dataset/mod.rs"]
pub mod dataset;
#[path = "../../cli/src/device.rs"]
pub mod device;
#[path = "../../cli/src/farm/list/mod.rs"]
pub mod farm;
#[path = "../../cli/src/files.rs"]
pub mod files;
#[path = "../../cli/src/identity.rs"]
pub mod identity;
#[path = "../../cli/src/machine.rs"]
pub mod machine;
#[path = "../../cli/src/metrics.rs"]
pub mod metrics;
#[path = "../../cli/src/options.rs"]
pub mod options;
#[path = "../../cli/src/path/mod.rs"]
pub mod path;
#[path = "../../cli/src/quiet.rs"]
pub mod quiet;
#[path = "../../cli/src/volume/mod.rs"]
pub mod volume;

#[path = "../../lab/src/trace/format.rs"]
pub mod trace;

#[path = "../../tests/src/mutants.rs"]
pub mod mutants;

pub mod checks;
pub mod mutate;
pub mod records;
pub mod state;
pub mod traces;
