//! One frame: camera, image size, ray step and shading.

use super::Camera;
use crate::error::bail;
use crate::names::names;
use crate::{Error, Result};
use core::str::FromStr;

/// Largest image width or height of a frame, in pixels.
pub const MAX_IMAGE_SIDE: u32 = 16384;

/// Shading, computed at each sample. Each variant has its own cost models.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Shading {
    /// Color and opacity of the transfer function only.
    #[default]
    None,
    /// Local lighting, with gradients by central differences (six more fetches per visible sample).
    Local,
    /// Single scattering: one shadow ray towards the light per visible sample.
    Scatter,
    /// Local lighting and single scattering: the shadow ray attenuates the lit color.
    LocalScatter,
}

names! { Shading:
    None "none",
    Local "local",
    Scatter "scatter",
    LocalScatter "local-scatter",
}

impl Shading {
    /// True with local lighting.
    pub const fn is_lit(self) -> bool {
        matches!(self, Self::Local | Self::LocalScatter)
    }

    /// True with shadow rays.
    pub const fn scatters(self) -> bool {
        matches!(self, Self::Scatter | Self::LocalScatter)
    }
}

impl FromStr for Shading {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match Self::ALL.into_iter().find(|s| s.name() == name) {
            Some(found) => Ok(found),
            None => bail!(
                InvalidArgument,
                "shading is {name:?}; none, local, scatter or local-scatter is expected"
            ),
        }
    }
}

/// Method of skipping empty space.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Skipping {
    /// Every sample is taken.
    None,
    /// Blocks whose min–max range is transparent under the transfer function are skipped.
    #[default]
    Blocks,
    /// Transparent blocks are skipped with a Chebyshev distance map: one skip crosses all blocks that the map
    /// shows to be empty.
    Distance,
}

names! { Skipping:
    None "none",
    Blocks "blocks",
    Distance "distance",
}

impl FromStr for Skipping {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match Self::ALL.into_iter().find(|s| s.name() == name) {
            Some(found) => Ok(found),
            None => bail!(InvalidArgument, "skipping is {name:?}; none, blocks or distance is expected"),
        }
    }
}

/// Settings of a frame, apart from its volume and transfer function. [`Frame::new`] sets the usual modes;
/// other fields are set by name:
///
/// ```
/// # use entire_core::scene::{Arcball, Camera, Frame, Shading};
/// # let camera = Camera::from_arcball(Arcball { rx: 20.0, ry: 30.0, dz: 2.0 })?;
/// let frame = Frame { step: 2.0, shading: Shading::Local, ..Frame::new(camera, 640, 480)? }.checked()?;
/// # let _ = frame;
/// # Ok::<(), entire_core::Error>(())
/// ```
///
/// Every function that takes a frame refuses one that [`Frame::checked`] refuses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Camera.
    pub camera: Camera,
    /// Image width in pixels, 1 to [`MAX_IMAGE_SIDE`].
    pub width: u32,
    /// Image height in pixels, 1 to [`MAX_IMAGE_SIDE`].
    pub height: u32,
    /// Ray step in multiples of the reference step, 1/64 to 4096.
    pub step: f32,
    /// Shading at each sample.
    pub shading: Shading,
    /// Method of skipping empty space.
    pub skipping: Skipping,
    /// Accumulated opacity at which a ray stops, in (0, 1]; 1 disables early termination.
    pub termination: f32,
    /// True if ray starts are jittered.
    pub jitter: bool,
}

impl Frame {
    /// A frame with the reference step, no shading, block skipping, early ray termination at opacity 0.99 and
    /// no jitter.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a size of 0 or over [`MAX_IMAGE_SIDE`].
    pub fn new(camera: Camera, width: u32, height: u32) -> Result<Self> {
        Self {
            camera,
            width,
            height,
            step: 1.0,
            shading: Shading::None,
            skipping: Skipping::Blocks,
            termination: 0.99,
            jitter: false,
        }
        .checked()
    }

    /// Returns the frame if it is valid.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a size of 0 or over [`MAX_IMAGE_SIDE`], a step outside of
    /// [1/64, 4096] or a termination outside of (0, 1].
    #[inline]
    pub fn checked(self) -> Result<Self> {
        let Self { width, height, step, termination, .. } = self;
        if width == 0 || height == 0 || width > MAX_IMAGE_SIDE || height > MAX_IMAGE_SIDE {
            bail!(
                InvalidArgument,
                "image size is {width} x {height}; both sides must lie in 1…{MAX_IMAGE_SIDE} pixels"
            );
        }
        if !(1.0 / 64.0..=4096.0).contains(&step) {
            bail!(InvalidArgument, "ray step is {step} reference steps; it must lie in [0.015625, 4096]");
        }
        if !(termination > 0.0 && termination <= 1.0) {
            bail!(InvalidArgument, "termination opacity is {termination}; it must lie in (0, 1]");
        }
        Ok(self)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Arcball;
    use super::*;

    #[test]
    fn sizes_steps_and_thresholds_are_checked() {
        let camera = Camera::from_arcball(Arcball { rx: 0.0, ry: 0.0, dz: 2.0 }).unwrap();
        assert!(Frame::new(camera, 0, 5).is_err() && Frame::new(camera, 5, MAX_IMAGE_SIDE + 1).is_err());
        let frame = Frame::new(camera, 1, 1).unwrap();
        assert_eq!(frame.checked(), Ok(frame));
        for step in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e9] {
            assert!(Frame { step, ..frame }.checked().is_err(), "{step}");
        }
        for termination in [0.0, 1.1, f32::NAN] {
            assert!(Frame { termination, ..frame }.checked().is_err(), "{termination}");
        }
        assert!(Frame { step: 2.0, termination: 1.0, ..frame }.checked().is_ok());
        assert!(
            Frame { width: 0, ..frame }.checked().is_err()
                && Frame { height: 1 << 20, ..frame }.checked().is_err()
        );
    }
}
