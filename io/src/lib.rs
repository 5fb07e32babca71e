//! What the `entire` command reads and writes: volume files, timing tables, paths of cameras and transfer functions,
//! and files that are whole or not there. Options, clocks and progress bars that its programs share stand here too.

pub mod clock;
pub mod dataset;
pub mod device;
pub mod enlarge;
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
