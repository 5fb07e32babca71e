//! The tests of the lab that run under cargo's harness, as one program.

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
