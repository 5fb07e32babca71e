//! Numbers about the scene: names, order and units, once per volume, once per transfer function and once per
//! frame.
//!
//! * [`VolumeSummary`]: a grid of cells with value bounds and quantiles, made once per volume.
//! * [`TransferSummary`]: emptiness and extinction of each cell under a transfer function, remade in place at
//!   each edit.
//! * [`FrameFeatures`]: what a camera sees of it: footprint, ray lengths and the coarse ray probe, measured
//!   once per frame and then evaluated for any ray step and image size.
//! * [`SceneFeature`]: the names under which a model file asks for these numbers.

mod cost;
mod footprint;
mod frame;
mod probe;
mod schema;
#[cfg(test)]
mod tests;
mod transfer;
mod volume;

pub use cost::{COMMON_COSTS, COST_QUANTITIES, COSTS, UnitCosts};
pub use footprint::Footprint;
pub use frame::{CACHED_VOXELS, Changes, FrameFeatures, Setting, UNSHARED_SPACING, Work};
pub use probe::{MAX_PROBE_SIDE, PROBE_SIDE, Probe, SHADOW_DIRECTION, SHADOW_OPACITY, SHADOW_STEP};
pub use schema::{SceneFeature, SceneQuantity};
pub use transfer::{CORRELATION_LENGTH, TransferSummary};
pub use volume::{
    BLOCK_EDGE, DEFAULT_CELLS_PER_AXIS, Geometry, LARGEST_INDEX, QUANTILES, SummaryBuilder, SummaryOptions,
    VolumeSummary,
};
