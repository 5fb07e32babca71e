//! Map of the samples per ray by cell of the image, counted by the raycaster.

use anyhow::Result;
use entire_core::scene::Frame;
use entire_vk_raycaster::{Region, Renderer, VulkanRaycaster};

/// Cells along x and y.
pub(crate) const CELLS: [u32; 2] = [24, 18];

/// Pixels along the edge of a cell.
const CELL_PIXELS: u32 = 8;

/// A map that is filled cell by cell.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct WorkMap {
    /// Samples per ray in each cell, row by row; 0 if not counted yet.
    pub(crate) samples: Vec<f32>,
    next: u32,
    frame: Frame,
}

impl WorkMap {
    /// An empty map for the camera and modes of a frame, at the reference step.
    ///
    /// # Errors
    /// When the frame is invalid.
    pub(crate) fn new(frame: &Frame) -> Result<Self> {
        let coarse = Frame {
            termination: frame.termination,
            shading: frame.shading,
            skipping: frame.skipping,
            step: 1.0,
            ..Frame::new(frame.camera, CELLS[0] * CELL_PIXELS, CELLS[1] * CELL_PIXELS)?
        }
        .checked()?;
        Ok(Self { samples: vec![0.0; (CELLS[0] * CELLS[1]) as usize], next: 0, frame: coarse })
    }

    pub(crate) fn is_done(&self) -> bool {
        self.next == CELLS[0] * CELLS[1]
    }

    /// Counts the samples of cells for about `budget` seconds, of at least one cell.
    ///
    /// # Errors
    /// Those of the raycaster.
    pub(crate) fn slice(&mut self, raycaster: &mut VulkanRaycaster, budget: f64) -> Result<()> {
        let begin = std::time::Instant::now();
        raycaster.count_work(true);
        let counted = self.count(raycaster, || begin.elapsed().as_secs_f64() < budget);
        raycaster.count_work(false);
        counted
    }

    fn count(&mut self, raycaster: &mut VulkanRaycaster, go_on: impl Fn() -> bool) -> Result<()> {
        while !self.is_done() {
            let (x, y) = (self.next % CELLS[0] * CELL_PIXELS, self.next / CELLS[0] * CELL_PIXELS);
            let region = Region { x, y, width: CELL_PIXELS, height: CELL_PIXELS };
            let counts = raycaster.render_region(&self.frame, region)?.counts.unwrap_or_default();
            self.samples[self.next as usize] = counts.samples as f32 / region.pixels() as f32;
            self.next += 1;
            if !go_on() {
                break;
            }
        }
        Ok(())
    }
}
