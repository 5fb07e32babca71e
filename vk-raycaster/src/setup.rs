//! Parameters of a frame for its rays: the shader reads them from a storage buffer, the CPU version from the
//! struct.

use crate::error::{Error, Result};
use crate::voxels::{BLOCK_EDGE, Geometry};
use entire_core::scene::Frame;

/// Direction towards the light of single scattering, in scene space, not normalized.
pub const LIGHT_DIRECTION: [f32; 3] = [0.4, 0.8, 0.45];

/// Distance between the samples of a shadow ray, in steps of the frame.
pub const SHADOW_STEP: u32 = 2;

/// Transmittance below which a shadow ray stops.
pub(crate) const SHADOW_TERMINATION: f32 = 0.25;

/// Smallest advance per step along an axis, in voxels; keeps its inverse finite.
pub(crate) const SMALLEST_ADVANCE: f32 = 1e-9;

/// Largest number of samples of a ray.
const MOST_SAMPLES: f64 = 16_777_216.0;

/// Sample number beyond the last sample of every ray.
pub(crate) const NO_SAMPLE: f32 = 3.0e38;

/// A frame's parameters for its rays. Laid out as the shader's struct: seventeen rows of 16 bytes.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct FrameSetup {
    /// Origin of the ray through the image's middle in voxel coordinates (see `Camera::ray_basis`).
    pub(crate) eye: [f32; 3],
    /// Width of a pixel where the image spans −1 to 1: 2 / image width.
    pub(crate) pixel_width: f32,
    /// `forward`, `right` and `up`: ray directions in scene space (see `Camera::ray_basis`).
    pub(crate) forward: [f32; 3],
    /// Height of a pixel where the image spans −1 to 1: 2 / image height.
    pub(crate) pixel_height: f32,
    pub(crate) right: [f32; 3],
    /// Opacity at which a ray stops; with a value over 1, no ray stops.
    pub(crate) termination: f32,
    pub(crate) up: [f32; 3],
    /// 1 with jitter, else 0.
    pub(crate) jitter: u32,
    /// Voxels per step for a unit direction in scene space.
    pub(crate) advance: [f32; 3],
    /// Increase of the table position per unit of voxel value.
    pub(crate) scale: f32,
    /// Number of voxels along each axis.
    pub(crate) dims: [f32; 3],
    /// Table position of voxel value 0.
    pub(crate) bias: f32,
    /// Smallest spacing / spacing along each axis.
    pub(crate) gradient_scale: [f32; 3],
    /// First pixel row of the dispatch.
    pub(crate) tile_y: u32,
    /// Advance of a shadow ray per shadow step, in voxels.
    pub(crate) light: [f32; 3],
    /// First pixel column of the dispatch.
    pub(crate) tile_x: u32,
    /// Reciprocals of the components of `light`.
    pub(crate) light_inverse: [f32; 3],
    /// Pixels per row of the dispatch's output.
    pub(crate) tile_width: u32,
    /// Number of pixel rows of the dispatch's output.
    pub(crate) tile_height: u32,
    /// 0 starts the rays; 1 continues them where the previous dispatch stopped.
    pub(crate) resume: u32,
    /// Number of the sample at which the dispatch stops; with [`NO_SAMPLE`], the dispatch takes all remaining
    /// samples.
    pub(crate) window_end: f32,
    /// Number of cells along a block's edge.
    pub(crate) block_edge: f32,
    /// Number of blocks along each axis.
    pub(crate) blocks: [u32; 3],
    /// log₂ of `block_edge`.
    pub(crate) block_shift: u32,
    /// `brick_low` and `brick_high`: first and last cell of the brick whose samples the dispatch takes.
    pub(crate) brick_low: [f32; 3],
    /// Number of runs of successive workgroups, one per thread of a software device (`dealt` in the shader);
    /// 1 on a GPU.
    pub(crate) parts: u32,
    pub(crate) brick_high: [f32; 3],
    pub(crate) pad_high: f32,
    /// `brick_origin` and `brick_dims`: first voxel of the brick's texture, and number of voxels along each
    /// axis of the texture.
    pub(crate) brick_origin: [f32; 3],
    pub(crate) pad_origin: f32,
    pub(crate) brick_dims: [f32; 3],
    pub(crate) pad_dims: f32,
    /// Offset in voxels from the ray origin at the image's middle to the ray origin half an image to the
    /// right (`origin_right`) or up (`origin_up`); 0 except with parallel rays.
    pub(crate) origin_right: [f32; 3],
    pub(crate) pad_right: f32,
    pub(crate) origin_up: [f32; 3],
    pub(crate) pad_up: f32,
}

impl FrameSetup {
    pub(crate) fn new(volume: &Geometry, frame: &Frame) -> Self {
        let (origin, [forward, right, up]) = frame.camera.ray_basis(frame.width, frame.height);
        let dims = volume.dims.map(|n| n as f64);
        let [eye, origin_right, origin_up] = origin.map(|o| o.to_array().map(f64::from));
        let step = f64::from(frame.step) * volume.reference_step();
        // Voxels per unit of scene space along each axis.
        let density = [0, 1, 2].map(|a| dims[a] / (2.0 * volume.half_extent[a]));
        let light = LIGHT_DIRECTION.map(f64::from);
        let length = light.iter().map(|l| l * l).sum::<f64>().sqrt();
        let light = [0, 1, 2].map(|a| light[a] / length * step * f64::from(SHADOW_STEP) * density[a]);
        Self {
            eye: [0, 1, 2].map(|a| ((eye[a] + volume.half_extent[a]) * density[a]) as f32),
            pixel_width: (2.0 / f64::from(frame.width)) as f32,
            forward: forward.to_array(),
            pixel_height: (2.0 / f64::from(frame.height)) as f32,
            right: right.to_array(),
            termination: if frame.termination < 1.0 { frame.termination } else { 2.0 },
            up: up.to_array(),
            jitter: u32::from(frame.jitter),
            advance: density.map(|d| (d * step) as f32),
            scale: volume.scale,
            dims: dims.map(|n| n as f32),
            bias: volume.bias,
            gradient_scale: volume.relative_spacing.map(|s| (1.0 / s) as f32),
            light: light.map(|l| l as f32),
            light_inverse: light.map(|l| 1.0 / (l as f32)),
            tile_width: frame.width,
            tile_height: frame.height,
            window_end: NO_SAMPLE,
            block_edge: BLOCK_EDGE as f32,
            blocks: volume.blocks().map(|n| n as u32),
            block_shift: BLOCK_EDGE.trailing_zeros(),
            parts: 1,
            brick_high: dims.map(|n| n as f32 - 1.0),
            brick_dims: dims.map(|n| n as f32),
            origin_right: [0, 1, 2].map(|a| (origin_right[a] * density[a]) as f32),
            origin_up: [0, 1, 2].map(|a| (origin_up[a] * density[a]) as f32),
            ..bytemuck::Zeroable::zeroed()
        }
    }
}

/// Refuses a frame that cannot be drawn.
pub(crate) fn check(frame: &Frame, volume: &Geometry) -> Result<()> {
    frame.checked().map_err(|e| Error::new(e.to_string()))?;
    // No ray is longer than the bounding sphere's diameter, which is 2. Single precision represents whole
    // numbers exactly up to 2²⁴.
    let samples = 2.0 / (f64::from(frame.step) * volume.reference_step());
    if samples > MOST_SAMPLES {
        return Err(Error::new(format!(
            "a ray may take {samples:.1e} samples at step {}, more than the {MOST_SAMPLES:.1e} that are counted exactly; \
             use a larger step, or correct the volume's spacing",
            frame.step
        )));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::voxels::PreparedVolume;
    use entire_core::scene::{Arcball, Camera, Scalars, VolumeOptions, VolumeView};

    #[test]
    fn the_uniform_block_has_the_layout_of_the_shader() {
        assert_eq!(size_of::<FrameSetup>(), 17 * 16);
        assert_eq!(core::mem::offset_of!(FrameSetup, advance), 64);
        assert_eq!(core::mem::offset_of!(FrameSetup, light), 112);
        assert_eq!(core::mem::offset_of!(FrameSetup, tile_height), 144);
        assert_eq!(core::mem::offset_of!(FrameSetup, blocks), 160);
        assert_eq!(core::mem::offset_of!(FrameSetup, brick_dims), 224);
        assert_eq!(core::mem::offset_of!(FrameSetup, origin_up), 256);
    }

    #[test]
    fn rays_of_too_many_samples_are_refused() {
        let data = vec![0u8; 2 * 2 * 20];
        let spacing = [1.0, 1.0, 1e6];
        let options = VolumeOptions { spacing, ..VolumeOptions::default() };
        let view = VolumeView::with(Scalars::U8(&data), [2, 2, 20], options).unwrap();
        let volume = PreparedVolume::new(&view).geometry;
        let camera = Camera::from_arcball(Arcball { rx: 0.0, ry: 0.0, dz: 3.0 }).unwrap();
        let frame = Frame::new(camera, 8, 8).unwrap();
        let said = check(&frame, &volume).unwrap_err().to_string();
        assert!(said.contains("larger step"), "{said}");
        assert!(check(&Frame { step: 4.0, ..frame }, &volume).is_ok());
    }

    #[test]
    fn eye_and_advance_are_in_voxels() {
        let data = vec![0u8; 8 * 4 * 2];
        let options = VolumeOptions { spacing: [1.0, 2.0, 4.0], ..VolumeOptions::default() };
        let view = VolumeView::with(Scalars::U8(&data), [8, 4, 2], options).unwrap();
        let volume = PreparedVolume::new(&view).geometry;
        let camera = Camera::from_arcball(Arcball { rx: 0.0, ry: 0.0, dz: 2.0 }).unwrap();
        let frame = Frame { step: 0.5, ..Frame::new(camera, 4, 4).unwrap() };
        let setup = FrameSetup::new(&volume, &frame);
        // The box is a cube of edge 8: half its diagonal is 4√3; the eye is twice that far from the center.
        assert!((setup.eye[0] - 4.0).abs() < 1e-5 && (setup.eye[1] - 2.0).abs() < 1e-5);
        assert!((setup.eye[2] - (1.0 + 8.0 * 3f32.sqrt() / 4.0)).abs() < 1e-4);
        for (a, want) in setup.advance.iter().zip([0.5, 0.25, 0.125]) {
            assert!((a - want).abs() < 1e-6);
        }
        assert_eq!(setup.termination, 0.99);
        let off = FrameSetup::new(&volume, &Frame { termination: 1.0, ..frame });
        assert!(off.termination > 1.0);
    }
}
