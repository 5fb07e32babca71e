//! Scene of a frame; modes and transfer functions as text.

use anyhow::{Result, anyhow, bail, ensure};
use entire_core::scene::{
    Arcball, Camera, Frame, GaussianLobe, Shading, Skipping, TransferFunction, TransferTable,
};
use std::fmt::Write as _;

/// Scene of a frame: all that is known before it is drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Path of the volume file, as it was given to the program that measured.
    pub volume: String,
    /// The ensemble member (or any other name of a group of related volumes). Empty when there is none.
    pub member: String,
    /// The time step within the member, if there is one.
    pub time_step: Option<u32>,
    /// Voxels along x, y, z.
    pub dims: [u32; 3],
    /// Camera angles in degrees and distance in bounding-sphere radii.
    pub camera: Arcball,
    /// Vertical field of view, degrees.
    pub fov_y_degrees: f32,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Ray step in reference steps.
    pub step: f32,
    /// Shading of each sample.
    pub shading: Shading,
    /// Skipping of empty space.
    pub skipping: Skipping,
    /// Accumulated opacity at which a ray stops.
    pub termination: f32,
    /// The transfer function's lobes.
    pub lobes: Vec<GaussianLobe>,
}

impl Scene {
    /// Returns the frame that a renderer draws.
    ///
    /// # Errors
    /// When the core refuses a value; the message is the core's.
    pub fn to_frame(&self) -> Result<Frame> {
        let camera = Camera::from_arcball(self.camera)?.with_fov_y_degrees(self.fov_y_degrees)?;
        Ok(Frame {
            step: self.step,
            termination: self.termination,
            shading: self.shading,
            skipping: self.skipping,
            ..Frame::new(camera, self.width, self.height)?
        }
        .checked()?)
    }

    /// Returns the number of pixels of the image.
    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    /// The transfer function.
    pub fn transfer_function(&self) -> TransferFunction {
        TransferFunction::Gaussian(self.lobes.clone())
    }

    /// The transfer function's table.
    ///
    /// # Errors
    /// When a lobe is refused by the core.
    pub fn to_table(&self) -> Result<TransferTable> {
        Ok(self.transfer_function().to_table()?)
    }

    pub(super) fn check(&self) -> Result<()> {
        for (name, text) in [("volume", &self.volume), ("member", &self.member)] {
            ensure!(
                !text.chars().any(char::is_control),
                "{name} {text:?} holds a line break or another control character; rename it"
            );
        }
        ensure!(!self.volume.trim().is_empty(), "the volume's name is empty; give the file's path");
        ensure!(self.dims.iter().all(|&n| n > 0), "volume size {:?} holds a 0", self.dims);
        self.to_frame()?;
        self.to_table()?;
        Ok(())
    }
}

/// Reads Gaussian lobes from `c w h;c w h;…`. An empty text gives no lobes.
///
/// # Errors
/// When a lobe does not have three parts, or a part is no number.
pub fn parse_lobes(text: &str) -> Result<Vec<GaussianLobe>> {
    text.split(';')
        .map(str::trim)
        .filter(|lobe| !lobe.is_empty())
        .enumerate()
        .map(|(i, lobe)| {
            let parts: Vec<f32> = lobe
                .split_whitespace()
                .map(|p| p.parse().map_err(|_| anyhow!("lobe {i}: {p:?} is no number")))
                .collect::<Result<_>>()?;
            let [center, width, height] = parts[..] else {
                bail!("lobe {i} is {lobe:?}; three numbers are expected: center, width, height");
            };
            Ok(GaussianLobe { center, width, height })
        })
        .collect()
}

/// Returns Gaussian lobes as a text from which [`parse_lobes`] reads the same bits.
pub(crate) fn format_lobes(lobes: &[GaussianLobe]) -> String {
    let mut text = String::new();
    for (i, l) in lobes.iter().enumerate() {
        let separator = if i == 0 { "" } else { ";" };
        let _ = write!(text, "{separator}{} {} {}", l.center, l.width, l.height);
    }
    text
}
