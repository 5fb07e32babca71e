//! `entire_frame`: the next frame to draw, and the settings that a caller can choose from.

use crate::abi::{by_value, init_struct};
use crate::guard::{entry, guard};
use crate::result::entire_result::{self, *};
use crate::result::{Failure, refuse};
use entire_core::scene::{Arcball, Camera, DEFAULT_FOV_Y_DEGREES, Frame, Shading, Skipping};
use entire_steer::features::Setting;
use glam::{Mat4, Vec3};

/// Kind of a frame's camera: one of the two `ENTIRE_CAMERA_*` numbers.
pub type entire_camera = u32;
/// Camera given by entire_frame.arcball.
pub const ENTIRE_CAMERA_ARCBALL: entire_camera = 1;
/// Camera given by entire_frame.view, volume_center and volume_radius.
pub const ENTIRE_CAMERA_VIEW: entire_camera = 2;

/// Projection of a camera: one of the two `ENTIRE_PROJECTION_*` numbers.
pub type entire_projection = u32;
/// Perspective, with the field of view entire_frame.fov_y; rays start at the eye.
pub const ENTIRE_PROJECTION_PERSPECTIVE: entire_projection = 1;
/// Orthographic; entire_frame.parallel_scale is half of the visible height. Rays start in the plane through
/// the eye and run along the view direction.
pub const ENTIRE_PROJECTION_PARALLEL: entire_projection = 2;

/// Shading of each sample: one of the `ENTIRE_SHADING_*` numbers.
pub type entire_shading = u32;
/// Color and opacity of the transfer function only.
pub const ENTIRE_SHADING_NONE: entire_shading = 1;
/// Local lighting with gradients.
pub const ENTIRE_SHADING_LOCAL: entire_shading = 2;
/// Single scattering: a shadow ray per visible sample.
pub const ENTIRE_SHADING_SCATTER: entire_shading = 3;
/// Local lighting with gradients, and single scattering.
pub const ENTIRE_SHADING_LOCAL_SCATTER: entire_shading = 4;

/// Skipping of empty space: one of the `ENTIRE_SKIPPING_*` numbers.
pub type entire_skipping = u32;
/// Every sample is taken.
pub const ENTIRE_SKIPPING_NONE: entire_skipping = 1;
/// Transparent blocks are skipped.
pub const ENTIRE_SKIPPING_BLOCKS: entire_skipping = 2;
/// Transparent blocks are skipped with a distance map: one skip crosses all blocks that the map shows to be
/// empty.
pub const ENTIRE_SKIPPING_DISTANCE: entire_skipping = 3;

/// A frame to draw. Fill with entire_frame_init, then set what differs.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_frame {
    /// sizeof(entire_frame).
    pub struct_size: usize,
    /// Image width in pixels, 1 to 16384. No default.
    pub width: u32,
    /// Image height in pixels, 1 to 16384. No default.
    pub height: u32,
    /// ENTIRE_CAMERA_ARCBALL (default) or ENTIRE_CAMERA_VIEW.
    pub camera: entire_camera,
    /// Vertical field of view in degrees, over 0 and up to 179; default 45. Not read with
    /// ENTIRE_PROJECTION_PARALLEL.
    pub fov_y: f32,
    /// Rotation about x and y in degrees (a positive first number raises the eye, a positive second number
    /// moves it to the right), and the eye's distance from the volume's center in multiples of its
    /// bounding-sphere radius. Default 0, 0, 3.
    pub arcball: [f32; 3],
    /// World-to-eye matrix as in OpenGL: column-major, rotation and translation only, the eye looks along -z.
    /// Default identity.
    pub view: [f32; 16],
    /// World position of the volume's center, for ENTIRE_CAMERA_VIEW; default 0, 0, 0.
    pub volume_center: [f32; 3],
    /// World radius of the volume's bounding sphere, for ENTIRE_CAMERA_VIEW. Default NaN: the radius of the
    /// session's volume (entire_volume_info.bounding_radius), which is correct if world units are those of
    /// the volume's spacing.
    pub volume_radius: f32,
    /// Ray step in multiples of the reference step, from 1/64 to 4096; default 1. entire_session_predict
    /// predicts the time at this step. entire_session_plan returns this step if steering is off, else ignores
    /// it.
    pub step: f32,
    /// Accumulated opacity at which a ray stops, over 0 and up to 1; 1 disables early termination. Default
    /// 0.99.
    pub termination: f32,
    /// One of ENTIRE_SHADING_*; default ENTIRE_SHADING_NONE.
    pub shading: entire_shading,
    /// One of ENTIRE_SKIPPING_*; default ENTIRE_SKIPPING_BLOCKS.
    pub skipping: entire_skipping,
    /// Not 0 if ray starts are jittered; default 0.
    pub jitter: u32,
    /// ENTIRE_PROJECTION_PERSPECTIVE (default) or ENTIRE_PROJECTION_PARALLEL.
    pub projection: entire_projection,
    /// Half of the height that a parallel projection shows: world units with ENTIRE_CAMERA_VIEW (VTK's
    /// ParallelScale), bounding-sphere radii with ENTIRE_CAMERA_ARCBALL. From 1e-6 to 1e6 radii; default NaN.
    /// Must be set with ENTIRE_PROJECTION_PARALLEL.
    pub parallel_scale: f32,
}

by_value!(entire_frame {
    width: 0,
    height: 0,
    camera: ENTIRE_CAMERA_ARCBALL,
    fov_y: DEFAULT_FOV_Y_DEGREES,
    arcball: [0.0, 0.0, 3.0],
    view: Mat4::IDENTITY.to_cols_array(),
    volume_center: [0.0; 3],
    volume_radius: f32::NAN,
    step: 1.0,
    termination: 0.99,
    shading: ENTIRE_SHADING_NONE,
    skipping: ENTIRE_SKIPPING_BLOCKS,
    jitter: 0,
    projection: ENTIRE_PROJECTION_PERSPECTIVE,
    parallel_scale: f32::NAN,
});

/// One of the settings that entire_session_choose may pick.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_setting {
    /// Ray step in multiples of the reference step.
    pub step: f32,
    /// Image width in pixels; the ratio of width to height should be that of the frame.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// One of ENTIRE_SHADING_*.
    pub shading: entire_shading,
    /// One of ENTIRE_SKIPPING_*.
    pub skipping: entire_skipping,
}

// Callers pass arrays of entire_setting, so its size never changes.
const _: () = assert!(size_of::<entire_setting>() == 20);

/// Fills a frame with its defaults; `struct_size` is sizeof(entire_frame).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_frame_init(frame: *mut entire_frame, struct_size: usize) -> entire_result {
    entry!(guard(|| init_struct(frame, struct_size)))
}

pub(crate) fn shading(number: u32) -> Result<Shading, Failure> {
    match number {
        ENTIRE_SHADING_NONE => Ok(Shading::None),
        ENTIRE_SHADING_LOCAL => Ok(Shading::Local),
        ENTIRE_SHADING_SCATTER => Ok(Shading::Scatter),
        ENTIRE_SHADING_LOCAL_SCATTER => Ok(Shading::LocalScatter),
        other => refuse!(
            ENTIRE_INVALID_ARGUMENT,
            "shading is {other}; it must be one of ENTIRE_SHADING_NONE (1) to ENTIRE_SHADING_LOCAL_SCATTER (4)"
        ),
    }
}

fn skipping(number: u32) -> Result<Skipping, Failure> {
    match number {
        ENTIRE_SKIPPING_NONE => Ok(Skipping::None),
        ENTIRE_SKIPPING_BLOCKS => Ok(Skipping::Blocks),
        ENTIRE_SKIPPING_DISTANCE => Ok(Skipping::Distance),
        other => refuse!(
            ENTIRE_INVALID_ARGUMENT,
            "skipping is {other}; it must be one of ENTIRE_SKIPPING_NONE (1) \
             to ENTIRE_SKIPPING_DISTANCE (3)"
        ),
    }
}

impl entire_frame {
    /// The core's frame. `radius`: the bounding-sphere radius if the volume is known.
    pub(crate) fn checked(&self, radius: Option<f32>) -> Result<Frame, Failure> {
        let (camera, unit) = match self.camera {
            ENTIRE_CAMERA_ARCBALL => {
                let [rx, ry, dz] = self.arcball;
                (Camera::from_arcball(Arcball { rx, ry, dz })?, 1.0)
            }
            ENTIRE_CAMERA_VIEW => {
                let radius = if self.volume_radius.is_nan() { radius } else { Some(self.volume_radius) };
                let radius = radius.ok_or_else(|| {
                    Failure::new(
                        ENTIRE_NOT_READY,
                        "volume_radius is NaN and no volume is set to take it from; set the volume first",
                    )
                })?;
                let view = Mat4::from_cols_array(&self.view);
                (Camera::from_world_view(view, Vec3::from_array(self.volume_center), radius)?, radius)
            }
            other => refuse!(
                ENTIRE_INVALID_ARGUMENT,
                "camera is {other}; it must be ENTIRE_CAMERA_ARCBALL (1) or ENTIRE_CAMERA_VIEW (2)"
            ),
        };
        let camera = match self.projection {
            ENTIRE_PROJECTION_PERSPECTIVE => camera.with_fov_y_degrees(self.fov_y)?,
            ENTIRE_PROJECTION_PARALLEL => camera.with_parallel_scale(self.parallel_scale / unit)?,
            other => refuse!(
                ENTIRE_INVALID_ARGUMENT,
                "projection is {other}; it must be ENTIRE_PROJECTION_PERSPECTIVE (1) or \
                 ENTIRE_PROJECTION_PARALLEL (2)"
            ),
        };
        Ok(Frame {
            step: self.step,
            termination: self.termination,
            shading: shading(self.shading)?,
            skipping: skipping(self.skipping)?,
            jitter: self.jitter != 0,
            ..Frame::new(camera, self.width, self.height)?
        }
        .checked()?)
    }
}

impl entire_setting {
    pub(crate) fn checked(self) -> Result<Setting, Failure> {
        Ok(Setting {
            step: self.step,
            width: self.width,
            height: self.height,
            shading: shading(self.shading)?,
            skipping: skipping(self.skipping)?,
        })
    }
}
