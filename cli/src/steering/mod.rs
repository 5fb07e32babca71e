//! Comparison of controllers: random scenes of a volume, a path under several controllers, metrics and
//! report.

pub mod contenders;
pub(crate) mod metrics;
pub mod model;
pub mod play;
pub mod race;
pub mod report;
pub mod rivals;
