//! Studies around `entire`: comparisons of predictors and controllers, their references, and the bars.
//! Nothing here is published; the product is `entire-cli`.

mod bars;
pub mod calibration;
mod child;
pub mod command_line;
mod commands;
mod farm;
pub mod fitted;
mod gpu;
mod latency;
mod paper;
pub mod replay;
mod ship;
mod stress;
mod study;
pub mod trace;
mod trees;
