//! Fitting of predictors to measured frames.
//!
//! * `analytic`: unit costs of estimated work, by robust regression of ln(seconds) with a prior for each
//!   cost. Stored as one dense layer on counts that gives seconds.
//! * `prednet`: PredNet by gradient descent.
//! * `residual`: analytic × exp(network). Unit costs first, then a network on ln(measured / analytic). Stored
//!   as dense layers that add the input `log_estimated_seconds` to the network's output.

mod analytic;
mod compose;
mod recipe;
#[cfg(test)]
mod tests;
mod training;

pub use analytic::{counts, expected_costs, typical_costs, typical_costs_of};
pub use recipe::{DtypeChoice, Kind, Recipe, TargetChoice};

use crate::gradient::EpochRecord;
use crate::inputs::{Layout, prednet_of};
use anyhow::Result;
use entire_core::kernels::{Level, Storage};
use entire_core::model::{Model, ModelFile};
use entire_core::nn::PredNet;
use entire_io::dataset::{Table, TimedFrame};
use entire_steer::predict::check_predictions;
use indicatif::ProgressBar;
use rayon::ThreadPool;

/// Context of fitting and prediction: the data and the machine.
pub struct FitContext<'a> {
    /// The tables that hold the frames.
    pub tables: &'a [Table],
    /// Threads that compute inputs and train networks.
    pub pool: &'a ThreadPool,
    /// Progress bar, whose message and position the training sets.
    pub bar: &'a ProgressBar,
    /// Called before the training of each network, after every training step, and after an analytic fit; the
    /// fit stops when `stop` returns true.
    pub stop: &'a dyn Fn() -> bool,
}

/// A fitted predictor.
#[derive(Clone, Debug)]
pub struct FittedModel {
    /// The model file.
    pub file: ModelFile,
    /// Description of the model, in one line.
    pub what: String,
    /// Settings of the fit.
    pub settings: serde_json::Value,
    /// Epochs of the network, or of the first network of an ensemble; empty if no network was trained.
    pub history: Vec<EpochRecord>,
    /// Result of the fit, in one line.
    pub outcome: String,
}

/// Returns the seconds that the model's network predicts for rows of the model's layout, computed as in a
/// session: rows are clamped to the training range, if the model states it. The seconds are finite and
/// positive. `storage` is the storage format of the network's weights; `None`: that of a session.
///
/// # Errors
/// When the model holds no PredNet, or its output for a row is not finite.
pub fn predict_rows(
    model: &Model,
    layout: &Layout,
    rows: &[f32],
    storage: Option<Storage>,
) -> Result<Vec<f64>> {
    let parts = prednet_of(model)?;
    let net = match storage {
        Some(storage) => PredNet::with(parts, Level::detect(), storage)?,
        None => PredNet::new(parts)?,
    };
    let mut scratch = net.scratch(1)?;
    let (width, mut rows) = (layout.width(), rows.to_vec());
    rows.chunks_exact_mut(width).for_each(|row| layout.hold(row));
    let mut seconds: Vec<f32> = rows.chunks_exact(width).map(|row| net.predict(row, &mut scratch)).collect();
    check_predictions(&mut seconds)?;
    Ok(seconds.into_iter().map(f64::from).collect())
}

/// Returns the seconds that a model file predicts for frames.
///
/// # Errors
/// When the model's inputs cannot be computed, or the model contains no network.
pub fn predict(model: &Model, context: &FitContext<'_>, frames: &[&TimedFrame]) -> Result<Vec<f64>> {
    let layout = Layout::of_model(model)?;
    let rows = layout.rows(context.tables, frames, context.pool, &ProgressBar::hidden())?;
    predict_rows(model, &layout, &rows, None)
}
