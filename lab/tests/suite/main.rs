//! The tests of the studies that need no harness of their own, as one program.

mod commands;
mod constants;
mod farm;
mod image_resolution;
mod online_learning;
mod paper;
mod reference;
mod study;

#[path = "../../../cli/tests/support/reference.rs"]
mod page;
