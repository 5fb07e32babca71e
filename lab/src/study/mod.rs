//! Studies: a JSON file names data sets, splits and predictors. Every predictor is trained on the training tables of
//! every set and tested on every split. Trained models are stored, so that a stopped study can be continued.

mod bars;
#[cfg(test)]
mod bars_tests;
mod baselines;
mod cache;
mod calibrated;
mod data;
mod description;
mod findings;
pub mod report;
mod rule;
mod runner;
#[cfg(test)]
mod tests;

pub(crate) use baselines::{Line, twins};
pub(crate) use runner::Bounds;

pub use bars::bars;
pub(crate) use description::SELECTED;
pub use description::{Limits, Named, Set, Ship, SplitTables, Study, clock, read};
pub use findings::{CALIBRATION_FRAMES, CONSTANT, Findings, Fit, Intervals, LEVEL, PROXY, SplitResult};
pub(crate) use rule::SENTENCE;
pub use rule::{by_rule, shipped};
pub use runner::Runner;
