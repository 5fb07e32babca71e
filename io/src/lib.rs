//! Input and output of the programs: volume files, timing tables, paths of cameras and transfer functions,
//! and files that are written completely or not at all; also the options, clocks and progress bars that the
//! programs share.

pub mod child;
pub mod clock;
pub mod dataset;
pub mod files;
pub mod identity;
pub mod interrupt;
pub mod machine;
pub mod metrics;
pub mod options;
pub mod path;
pub mod progress;
pub mod quiet;
pub mod scenes;
pub mod volume;
