//! From inputs to seconds: the analytic cost model and PredNet behind one trait, with upper bound and
//! out-of-range score.
//!
//! [`load`] turns a model file into the predictor that fits it.

mod analytic;
#[allow(clippy::needless_range_loop, reason = "indices run over several small arrays at once")]
mod calibration;
mod inputs;
mod layout;
mod network;
#[allow(clippy::needless_range_loop, reason = "indices run over several small arrays at once")]
mod nnls;
mod seconds;

pub use crate::features::{COMMON_COSTS, COST_QUANTITIES, COSTS, UnitCosts};
pub use analytic::{AnalyticModel, FitReport, Measurement, TERMS, UNIT_COSTS_KEY};
pub use calibration::{Calibration, FeatureRange, UPPER_LEVEL};
pub use inputs::{CostTerms, GroupKind, Inputs, Prediction, Predictor, Source};
pub use layout::{InputLayout, InputValues, LOBE_ORDER_KEY, PROBE_SIDE_KEY};
pub use network::{CALIBRATION_KEY, ModelPredictor, load};
pub use seconds::{
    CLAMPED_SCORE, LONGEST_FRAME, LONGEST_PREDICTION, SHORTEST_PREDICTION, check_batch, checked_seconds,
};
