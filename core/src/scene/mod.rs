//! Description of a scene: volume, camera, transfer function and frame. Everything is validated here, so that
//! the rest of the library never meets a zero size, a NaN or a product that overflows.

mod camera;
mod frame;
mod nodes;
mod range;
mod transfer;
mod volume;

pub use camera::{Arcball, Camera, DEFAULT_FOV_Y_DEGREES};
pub use frame::{Frame, MAX_IMAGE_SIDE, Shading, Skipping};
pub use nodes::{Node, Nodes};
pub use transfer::{COLOR_RAMP, ControlPoint, GaussianLobe, TABLE_LEN, TransferFunction, TransferTable};
pub use volume::{
    MAX_REPEATED_VOXELS, MAX_VOLUME_EDGE, ScalarType, Scalars, Shape, VolumeOptions, VolumeView, normalize,
};
