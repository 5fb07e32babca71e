//! Studies of `entire`: comparisons of its predictors and controllers with others, and the bars. This crate
//! is not published; the program for users is in `entire-cli`.

mod bars;
mod child;
pub mod command_line;
mod commands;
mod farm;
mod fitted;
mod gpu;
mod latency;
mod paper;
pub mod replay;
mod ship;
mod stress;
mod study;
pub mod trace;
mod trees;
