//! Studies: a JSON file names data sets, splits and predictors. Every predictor is trained on the training
//! tables of every set and tested on every split. Trained models are stored, so that a stopped study can be
//! continued.

mod bars;
#[cfg(test)]
mod bars_tests;
mod baselines;
mod data;
mod description;
mod findings;
pub(crate) mod report;
mod rule;
mod runner;
#[cfg(test)]
mod tests;

pub(crate) use bars::bars;
pub(crate) use baselines::{Line, Low, by_proxy, line_of, twins, with_twins};
pub(crate) use data::SetTables;
pub(crate) use description::{Named, SELECTED, Set, Ship, Study, read};
pub(crate) use findings::{
    CALIBRATION_FRAMES, CONSTANT, Findings, Fit, Intervals, LEVEL, PROXY, SplitResult, judge,
};
pub(crate) use rule::{SENTENCE, by_rule, shipped};
pub(crate) use runner::{Bounds, Runner, STUDY_KEY};
