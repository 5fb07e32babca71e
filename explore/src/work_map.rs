//! Map of the mean number of samples per ray in each cell of the image, counted by the raycaster.

use anyhow::Result;
use entire_core::scene::Frame;
use entire_vk_raycaster::{Region, Renderer, VulkanRaycaster};

/// Number of cells along x and y.
pub(crate) const CELLS: [u32; 2] = [24, 18];

/// Mean number of pixels along the edge of a cell.
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
    /// Returns an empty map for the camera, aspect ratio and modes of a frame, at the reference step.
    pub(crate) fn new(frame: &Frame) -> Result<Self> {
        let sides = [frame.width, frame.height].map(f64::from);
        let pixels = f64::from(CELLS[0] * CELLS[1] * CELL_PIXELS * CELL_PIXELS);
        let scale = (pixels / (sides[0] * sides[1])).sqrt();
        let side = |a: usize| ((sides[a] * scale).round() as u32).max(CELLS[a]);
        let coarse =
            Frame { width: side(0), height: side(1), step: 1.0, jitter: false, ..*frame }.checked()?;
        Ok(Self { samples: vec![0.0; (CELLS[0] * CELLS[1]) as usize], next: 0, frame: coarse })
    }

    pub(crate) fn is_done(&self) -> bool {
        self.next == CELLS[0] * CELLS[1]
    }

    /// The pixels of a cell.
    fn region(&self, cell: u32) -> Region {
        let part = |index: u32, cells: u32, side: u32| {
            let first = index * side / cells;
            (first, (index + 1) * side / cells - first)
        };
        let (x, width) = part(cell % CELLS[0], CELLS[0], self.frame.width);
        let (y, height) = part(cell / CELLS[0], CELLS[1], self.frame.height);
        Region { x, y, width, height }
    }

    /// Counts the samples of at least one cell, and of further cells for about `budget` seconds.
    pub(crate) fn slice(&mut self, raycaster: &mut VulkanRaycaster, budget: f64) -> Result<()> {
        let begin = std::time::Instant::now();
        raycaster.count_work(true);
        let counted = self.count(raycaster, || begin.elapsed().as_secs_f64() < budget);
        raycaster.count_work(false);
        counted
    }

    fn count(&mut self, raycaster: &mut VulkanRaycaster, go_on: impl Fn() -> bool) -> Result<()> {
        while !self.is_done() {
            let region = self.region(self.next);
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

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::scene::{Arcball, Camera};

    #[test]
    fn cells_divide_a_view_of_any_aspect_ratio() {
        let camera = Camera::from_arcball(Arcball { rx: 20.0, ry: 30.0, dz: 2.5 }).unwrap();
        for [width, height] in [[800, 600], [1021, 317], [250, 900]] {
            let map = WorkMap::new(&Frame::new(camera, width, height).unwrap()).unwrap();
            let aspect = |width: u32, height: u32| f64::from(width) / f64::from(height);
            let ratio = aspect(map.frame.width, map.frame.height) / aspect(width, height);
            assert!((ratio - 1.0).abs() < 0.01, "{width} x {height}: {ratio}");
            let cells = (0..CELLS[0] * CELLS[1]).map(|cell| map.region(cell));
            let pixels: u64 = cells.map(|r| r.pixels()).sum();
            assert_eq!(pixels, u64::from(map.frame.width) * u64::from(map.frame.height));
            let last = map.region(CELLS[0] * CELLS[1] - 1);
            assert_eq!([last.x + last.width, last.y + last.height], [map.frame.width, map.frame.height]);
        }
    }
}
