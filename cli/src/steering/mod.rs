//! Steering as a command plays it: calibration, a path under several controllers, what came of it, and the report.

pub mod calibrate;
pub mod contenders;
pub mod metrics;
pub mod play;
