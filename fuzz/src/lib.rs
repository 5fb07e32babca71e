//! The readers under test, invariants of their results, and mutations that know their formats.

#![allow(dead_code, unused_imports, reason = "parts of modules that no target calls")]

pub use entire_io::{dataset, path, volume};

// Only the task lists of entire-farm: the whole crate would bring in charts.
#[path = "../../farm/src/list/mod.rs"]
pub mod farm;

#[path = "../../lab/src/trace/format.rs"]
pub mod trace;

#[path = "../../tests/src/mutants.rs"]
pub mod mutants;

pub mod checks;
pub mod mutate;
pub mod records;
pub mod state;
pub mod traces;
