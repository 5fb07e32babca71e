//! Numbers about the scene: names, order and units, once per volume, once per transfer function and once per
//! frame.
//!
//! * [`VolumeSummary`]: a grid of cells with value bounds and quantiles, made once per volume, or kept up to
//!   date from one time step to the next by a [`SummarySeries`].
//! * [`TransferSummary`]: emptiness and extinction of each cell under a transfer function, remade in place at
//!   each edit.
//! * [`FrameFeatures`]: what a camera sees of it: footprint, ray lengths and the coarse ray probe, measured
//!   once per frame and then evaluated for any ray step and image size.
//! * [`SceneFeature`]: the names under which a model file asks for these numbers.

mod classify;
mod cost;
mod footprint;
mod frame;
mod interior;
mod probe;
mod schema;
#[cfg(test)]
mod tests;
mod transfer;
mod volume;

pub(crate) use cost::COMMON_COSTS;
pub use cost::{COST_QUANTITIES, COSTS, UnitCosts};
pub(crate) use footprint::Footprint;
pub use frame::{Changes, FrameFeatures, Setting, Work};
pub use probe::{MAX_PROBE_SIDE, PROBE_SIDE};
pub(crate) use probe::{Probe, SHADOW_STEP};
pub use schema::{SceneFeature, SceneQuantity};
pub use transfer::TransferSummary;
pub(crate) use volume::QUANTILES;
pub use volume::{SummaryBuilder, SummaryOptions, SummarySeries, VolumeSummary};
