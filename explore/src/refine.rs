//! Drawing in slices: a picture is drawn region by region, each slice within a time budget.

use anyhow::Result;
use entire_core::scene::Frame;
use entire_vk_raycaster::{Picture, Region, VulkanRaycaster};
use std::time::Instant;

/// Height of a band, pixels.
const BAND: u32 = 32;

/// Width of a piece of a band, pixels. A piece is the smallest unit of work.
const PIECE: u32 = 16;

/// Safety factor on the expected time of the next pieces.
const CAUTION: f64 = 1.3;

/// Progress of a picture: bands from top to bottom, each from left to right.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Cursor {
    width: u32,
    height: u32,
    x: u32,
    y: u32,
    /// Expected seconds of the next piece: the seconds per piece of the last region.
    piece: f64,
    /// Seconds spent on the finished part of the picture.
    spent: f64,
}

impl Cursor {
    /// Returns a cursor at the beginning. `expected`: seconds of the whole picture.
    pub(crate) fn new(width: u32, height: u32, expected: f64) -> Self {
        let pieces = f64::from(width.div_ceil(PIECE)) * f64::from(height.div_ceil(BAND));
        let piece = if expected.is_finite() && expected > 0.0 { expected / pieces } else { 1e-3 };
        Self { width, height, x: 0, y: 0, piece, spent: 0.0 }
    }

    pub(crate) fn is_done(&self) -> bool {
        self.y >= self.height
    }

    /// The finished regions: all complete bands, and the left part of the current band.
    pub(crate) fn covered(&self) -> [Option<Region>; 2] {
        let part = |x, y, width, height| (width > 0 && height > 0).then_some(Region { x, y, width, height });
        [
            part(0, 0, self.width, self.y.min(self.height)),
            part(0, self.y, self.x, BAND.min(self.height.saturating_sub(self.y))),
        ]
    }

    /// Returns the finished share of the picture, from 0 to 1.
    pub(crate) fn share(&self) -> f64 {
        let done: u64 = self.covered().iter().flatten().map(Region::pixels).sum();
        done as f64 / (f64::from(self.width) * f64::from(self.height))
    }

    /// Returns the expected seconds of the picture's unfinished part.
    pub(crate) fn remaining(&self) -> f64 {
        let pieces = f64::from(self.width.div_ceil(PIECE)) * f64::from(self.height.div_ceil(BAND));
        let share = self.share();
        // Two estimates of the whole picture's time are averaged. The estimate from the finished part has the
        // finished share as weight, the estimate from the last region has the unfinished share.
        let whole = share * (self.spent / share.max(1e-6)) + (1.0 - share) * self.piece * pieces;
        (1.0 - share) * whole
    }

    /// Calls `work` with region after region for about `budget` seconds, and at least once. `work` draws a
    /// region and returns the seconds it took.
    pub(crate) fn slice(&mut self, budget: f64, mut work: impl FnMut(Region) -> Result<f64>) -> Result<()> {
        let begin = Instant::now();
        let mut spent = 0.0;
        while !self.is_done() {
            let left = budget - spent;
            let pieces = (left / (CAUTION * self.piece)).floor();
            if pieces < 1.0 && spent > 0.0 {
                break;
            }
            let columns = (pieces.clamp(1.0, 1e6) as u32).saturating_mul(PIECE).min(self.width - self.x);
            let region =
                Region { x: self.x, y: self.y, width: columns, height: BAND.min(self.height - self.y) };
            let seconds = work(region)?;
            let whole = f64::from(PIECE) * f64::from(BAND);
            self.piece = (seconds / region.pixels() as f64 * whole).max(1e-7);
            self.spent += seconds;
            self.x += columns;
            if self.x >= self.width {
                (self.x, self.y) = (0, self.y + BAND);
            }
            spent = (spent + seconds).max(begin.elapsed().as_secs_f64());
        }
        Ok(())
    }
}

/// A picture at full quality that is being drawn on the device.
pub(crate) struct Refinement {
    pub(crate) frame: Frame,
    pub(crate) cursor: Cursor,
    /// Time at which the refinement began.
    pub(crate) begin: Instant,
    /// The longest slice so far, seconds.
    pub(crate) longest: f64,
    /// Seconds of ray casting so far.
    pub(crate) cast: f64,
}

impl Refinement {
    /// A refinement that has not begun to draw. `expected`: seconds of the whole frame.
    pub(crate) fn new(frame: Frame, expected: f64) -> Self {
        let cursor = Cursor::new(frame.width, frame.height, expected);
        Self { frame, cursor, begin: Instant::now(), longest: 0.0, cast: 0.0 }
    }

    /// Continues to draw for about `budget` seconds.
    pub(crate) fn slice(
        &mut self,
        raycaster: &mut VulkanRaycaster,
        picture: &mut Picture,
        budget: f64,
    ) -> Result<()> {
        let begin = Instant::now();
        let (frame, cast) = (&self.frame, &mut self.cast);
        self.cursor.slice(budget, |region| {
            let seconds = raycaster.render_to(frame, region, picture)?.wall;
            *cast += seconds;
            Ok(seconds)
        })?;
        self.longest = self.longest.max(begin.elapsed().as_secs_f64());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slices_cover_every_pixel_once_and_keep_to_the_budget() {
        let (width, height) = (203, 131);
        // The lower half costs ten times the upper one.
        let cost = |r: Region| {
            let rows = f64::from(r.width) * f64::from(r.height);
            rows * if r.y < 64 { 1e-6 } else { 1e-5 }
        };
        let mut cursor = Cursor::new(width, height, 0.1);
        let mut seen = vec![0u8; (width * height) as usize];
        let mut slices = 0;
        while !cursor.is_done() {
            let (mut total, mut largest) = (0.0, 0.0f64);
            cursor
                .slice(0.02, |r| {
                    for y in r.y..r.y + r.height {
                        for x in r.x..r.x + r.width {
                            seen[(y * width + x) as usize] += 1;
                        }
                    }
                    total += cost(r);
                    largest = largest.max(cost(r));
                    Ok(cost(r))
                })
                .unwrap();
            // A tenfold jump of the cost may let one region exceed the budget.
            assert!(total <= 0.02 + 1e-9 || largest > 0.02, "{total}");
            slices += 1;
            let done: u64 = cursor.covered().iter().flatten().map(Region::pixels).sum();
            assert_eq!(done, seen.iter().filter(|&&n| n == 1).count() as u64);
        }
        assert!(seen.iter().all(|&n| n == 1) && slices > 4, "{slices}");
        assert!(cursor.share() == 1.0 && cursor.remaining() == 0.0);
    }

    #[test]
    fn the_rest_is_foretold() {
        let mut cursor = Cursor::new(320, 320, 1.0);
        assert!((cursor.remaining() - 1.0).abs() < 1e-9);
        cursor.slice(1.0, |r| Ok(r.pixels() as f64 * 2.0 / 102_400.0)).unwrap();
        let left = 2.0 * (1.0 - cursor.share());
        assert!((cursor.remaining() / left - 1.0).abs() < 0.3, "{} {left}", cursor.remaining());
    }
}
