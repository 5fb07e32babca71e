//! Steering in commands: calibration scenes, a path under several controllers, its results, and the report.

pub mod calibrate;
pub mod contenders;
pub mod metrics;
pub mod model;
pub mod play;
pub mod race;
pub mod report;
pub mod rivals;
pub mod sizes;
