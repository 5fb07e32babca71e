//! Features of a scene, with their names, order and units. Each is computed once per volume, once per
//! transfer function or once per frame.
//!
//! * [`VolumeSummary`]: a grid of cells with value bounds and quantiles, made once per volume, or updated
//!   from one time step to the next by a [`SummarySeries`].
//! * [`TransferSummary`]: emptiness and extinction of each cell under a transfer function, recomputed in
//!   place at each edit.
//! * [`FrameFeatures`]: footprint, ray lengths and the coarse ray probe for a camera, measured once per frame
//!   and then evaluated for any ray step and image size.
//! * [`SceneFeature`]: names under which a model file requests these features.

mod classify;
mod cost;
mod footprint;
mod frame;
mod interior;
mod probe;
mod schema;
#[cfg(test)]
pub(crate) mod tests;
mod transfer;
mod volume;

pub(crate) use cost::{COMMON_COSTS, far_ratio};
pub use cost::{COST_QUANTITIES, COSTS, UnitCosts};
pub(crate) use footprint::Footprint;
pub use frame::{Changes, FrameFeatures, Setting};
pub use probe::{MAX_PROBE_SIDE, PROBE_SIDE};
pub(crate) use probe::{Probe, SHADOW_DIRECTION, SHADOW_STEP};
pub use schema::{SceneFeature, SceneQuantity};
pub use transfer::TransferSummary;
pub(crate) use volume::QUANTILES;
pub use volume::{SummarySeries, VolumeSummary};
