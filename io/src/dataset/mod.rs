//! Timing tables on disk: one CSV row per repeat of a frame, a JSON manifest beside it, and repeats grouped
//! into frames in memory.
//!
//! Columns, in this order (see [`COLUMNS`]): the frame and repeat numbers; the volume's path, its ensemble
//! member, time step and size; the camera (arcball degrees, distance in bounding-sphere radii, vertical field
//! of view in degrees); the image size in pixels; the ray step in reference steps; the shading and skipping
//! modes, the opacity at which rays stop; the transfer function's Gaussian lobes as `c w h` joined by `;`;
//! seconds by each clock; and work counts. An empty field means that there is no value.

mod compared;
pub mod feature_table;
mod groups;
mod manifest;
mod scene;
mod table;
#[cfg(test)]
mod tests;
mod timing;
mod writer;

pub use compared::read_pictures;
pub use entire_steer::predict::Clock;
pub use groups::Groups;
pub use manifest::{MANIFEST_FORMAT, Manifest, STEP_REFERENCE};
pub(crate) use scene::format_lobes;
pub use scene::{Scene, parse_lobes};
pub use table::{COLUMNS, Table, open_tables, parse as parse_table, read_tables};
pub use timing::{
    NoiseFloor, Timed, TimedFrame, Timing, left_out, manifests_of, mixed, noise_floor, shaded, timed,
};
pub use writer::{Writer, ensure_no_table};
