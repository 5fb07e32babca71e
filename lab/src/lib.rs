//! Studies around `entire`: comparisons of predictors and controllers, their references, and the bars.
//! Nothing here is published; the product is `entire-cli`.

pub mod bars;
pub mod calibration;
pub mod child;
pub mod command_line;
pub mod commands;
pub mod farm;
pub mod fitted;
pub mod gpu;
pub mod latency;
pub mod paper;
pub mod replay;
pub mod ship;
pub mod stress;
pub mod study;
pub mod trace;
pub mod trees;
