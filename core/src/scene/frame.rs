//! One frame: from where, how large, how fine, and which work each sample costs.

use super::Camera;
use crate::Result;
use crate::error::bail;

/// Largest image width or height that a frame may have.
pub const MAX_IMAGE_SIDE: u32 = 16384;

/// What is computed at each sample: a cost class of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Shading {
    /// Color and opacity of the transfer function alone.
    None,
    /// Local lighting with gradients by central differences (six more fetches where the sample is visible).
    Local,
    /// Single scattering: a shadow ray towards the light per visible sample.
    Scatter,
}

impl Shading {
    /// The name used in files and options.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Local => "local",
            Self::Scatter => "scatter",
        }
    }
}

/// How empty space is skipped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Skipping {
    /// Every sample is taken.
    None,
    /// Blocks whose min–max range is transparent under the transfer function are jumped over.
    Blocks,
    /// As blocks, with a Chebyshev distance map so that runs of empty blocks cost one jump.
    Distance,
}

impl Skipping {
    /// The name used in files and options.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Blocks => "blocks",
            Self::Distance => "distance",
        }
    }
}

/// A frame to draw, beside its volume and transfer function.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    camera: Camera,
    width: u32,
    height: u32,
    step: f32,
    shading: Shading,
    skipping: Skipping,
    termination: f32,
    jitter: bool,
}

impl Frame {
    /// A frame with the reference step, no shading, block skipping, early ray termination at opacity 0.99, no
    /// jitter.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a size of 0 or over [`MAX_IMAGE_SIDE`].
    pub fn new(camera: Camera, width: u32, height: u32) -> Result<Self> {
        if width == 0 || height == 0 || width > MAX_IMAGE_SIDE || height > MAX_IMAGE_SIDE {
            bail!(
                InvalidArgument,
                "image size is {width} x {height}; both sides must lie in 1…{MAX_IMAGE_SIDE} pixels"
            );
        }
        Ok(Self {
            camera,
            width,
            height,
            step: 1.0,
            shading: Shading::None,
            skipping: Skipping::Blocks,
            termination: 0.99,
            jitter: false,
        })
    }

    /// Sets the ray step in multiples of the reference step.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless it lies in [1/64, 4096].
    pub fn with_step(mut self, step: f32) -> Result<Self> {
        if !(1.0 / 64.0..=4096.0).contains(&step) {
            bail!(InvalidArgument, "ray step is {step} reference steps; it must lie in [0.015625, 4096]");
        }
        self.step = step;
        Ok(self)
    }

    /// Sets the accumulated opacity at which a ray stops; 1 switches early termination off.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless it lies in (0, 1].
    pub fn with_termination(mut self, opacity: f32) -> Result<Self> {
        if !(opacity > 0.0 && opacity <= 1.0) {
            bail!(InvalidArgument, "termination opacity is {opacity}; it must lie in (0, 1], 1 for none");
        }
        self.termination = opacity;
        Ok(self)
    }

    /// Sets the shading mode.
    pub fn with_shading(mut self, shading: Shading) -> Self {
        self.shading = shading;
        self
    }

    /// Sets the skipping mode.
    pub fn with_skipping(mut self, skipping: Skipping) -> Self {
        self.skipping = skipping;
        self
    }

    /// Switches jittered ray starts on or off.
    pub fn with_jitter(mut self, jitter: bool) -> Self {
        self.jitter = jitter;
        self
    }

    /// The camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Image width in pixels.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Image height in pixels.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Number of pixels.
    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    /// Ray step in multiples of the reference step.
    pub fn step(&self) -> f32 {
        self.step
    }

    /// Shading mode.
    pub fn shading(&self) -> Shading {
        self.shading
    }

    /// Skipping mode.
    pub fn skipping(&self) -> Skipping {
        self.skipping
    }

    /// Accumulated opacity at which a ray stops.
    pub fn termination(&self) -> f32 {
        self.termination
    }

    /// Whether ray starts are jittered.
    pub fn jitter(&self) -> bool {
        self.jitter
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
        for bad in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e9] {
            assert!(frame.with_step(bad).is_err());
        }
        for bad in [0.0, 1.1, f32::NAN] {
            assert!(frame.with_termination(bad).is_err());
        }
        assert_eq!(frame.with_step(2.0).unwrap().step(), 2.0);
    }
}
