//! Prediction of seconds: the analytic cost model and PredNet behind one trait, with upper bound and
//! out-of-range score.
//!
//! [`load`] makes the predictor of a model file.

mod analytic;
mod bounds;
mod clock;
mod cost_fit;
mod inputs;
mod layout;
mod network;
mod quality;
mod range;
mod seconds;

pub use crate::features::{COST_QUANTITIES, COSTS, UnitCosts};
pub use analytic::AnalyticModel;
pub(crate) use analytic::TERMS;
pub use bounds::{UPPER_LEVEL, UpperBound};
pub use clock::Clock;
#[cfg(feature = "calibrate")]
pub(crate) use cost_fit::{COST_SD, CostFit, FitRow};
pub use entire_core::model::GroupKind;
pub use inputs::{CostTerms, Inputs, Prediction, Predictor, Source};
pub use layout::InputLayout;
#[cfg(feature = "calibrate")]
pub(crate) use layout::store_probe_side;
pub use network::{load, load_with, out_of_range};
pub(crate) use quality::DISTANCE_RATIO;
pub use quality::Quality;
pub use range::InputRange;
pub(crate) use seconds::CLAMPED_SCORE;
pub(crate) use seconds::checked_seconds;
pub use seconds::{LONGEST_FRAME, PREDICTED_SECONDS, check_predictions};
