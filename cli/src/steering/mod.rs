//! Steering as commands play it: calibration, a path under several controllers, what came of it, and the
//! report.

pub mod calibrate;
pub mod contenders;
pub mod metrics;
pub mod model;
pub mod play;
pub mod race;
pub mod report;
pub mod rivals;
pub mod sizes;
