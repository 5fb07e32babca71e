//! Casting the rays of a frame or of a part of it: tile by tile, window by window, brick by brick. A window
//! is the range of successive samples of a ray that one dispatch may take.

use super::engine::Cast;
use super::picture::{Picture, Region};
use super::recording::{IMAGE_BYTES, Output, record_tile, tiles};
use super::{Brick, LONG_DISPATCH_SECONDS, SMALLEST_TILE, VulkanRaycaster, add_counts, brick_order};
use crate::clock::Stopwatch;
use crate::error::{Error, Result};
use crate::renderer::{FrameTime, Image, Rendered, WorkCounts};
use crate::setup::NO_SAMPLE;
use entire_core::scene::Frame;

/// Destination of the pixels.
enum Sink<'a> {
    /// Memory of the host for the rows of the region.
    Host(&'a mut [u8]),
    /// A picture on the device; the pixels go to the region's place in it.
    Picture(&'a mut Picture),
}

impl Sink<'_> {
    /// Destination of a dispatch's pixels: only the last dispatch of a tile (`done`) has the finished pixels.
    fn output(&self, done: bool) -> Output {
        match self {
            _ if !done => Output::Device,
            Sink::Host(_) => Output::Host,
            Sink::Picture(p) => Output::Picture { image: p.image(), fresh: p.fresh },
        }
    }
}

impl VulkanRaycaster {
    /// Renders a part of a frame and reads it back. The pixels equal those of the whole frame.
    ///
    /// # Errors
    /// For a region beyond the frame; else as [`crate::Renderer::render`].
    pub fn render_region(&mut self, frame: &Frame, region: Region) -> Result<Rendered> {
        region.check(frame)?;
        let mut rgba = vec![0; region.width as usize * region.height as usize * IMAGE_BYTES as usize];
        let (time, counts) = self.cast(frame, region, Sink::Host(&mut rgba))?;
        let image = Image { width: region.width, height: region.height, rgba };
        Ok(Rendered { image, time, counts: self.options.count_work.then_some(counts) })
    }

    /// Renders a part of a frame into a picture on the device, at the region's place in the frame; the other
    /// pixels of the picture are unchanged. Returns once the device has finished.
    ///
    /// # Errors
    /// For a region beyond the frame or the picture, and for a picture on another device; else as
    /// [`crate::Renderer::render`].
    pub fn render_to(&mut self, frame: &Frame, region: Region, picture: &mut Picture) -> Result<FrameTime> {
        region.check(frame)?;
        let (Region { x, y, width, height }, across, down) = (region, picture.width(), picture.height());
        if x + width > across || y + height > down {
            return Err(Error::new(format!(
                "the region of {width} x {height} pixels at {x}, {y} reaches beyond the picture of \
                 {across} x {down}"
            )));
        }
        if !picture.is_of(&self.shared_device()) {
            return Err(Error::new("the picture is on another device; make one on this raycaster's device"));
        }
        Ok(self.cast(frame, region, Sink::Picture(picture))?.0)
    }

    fn cast(&mut self, frame: &Frame, region: Region, mut sink: Sink<'_>) -> Result<(FrameTime, WorkCounts)> {
        let watch = Stopwatch::start();
        let mut plan = self.plan(frame)?;
        let order = self.volume.as_ref().map(|v| brick_order(v, &plan.setup)).unwrap_or_default();
        let bricks = self.volume.as_ref().map(|v| v.bricks.clone()).unwrap_or_default();
        self.table_step = None;
        let mut counts = WorkCounts::default();
        let mut device = self.has_timestamps().then_some(0.0);
        let timestamps = device.is_some();
        let is_fixed = self.is_software() && self.options.tile.is_none();
        let longest = if is_fixed { f64::INFINITY } else { LONG_DISPATCH_SECONDS };
        let class = plan.key.shading as usize;
        let windowed = plan.last_window > 0.0 || bricks.len() > 1;
        let edge = self.tile[class];
        let cut = tiles(region.width, region.height, edge);
        for (i, &place) in cut.iter().enumerate() {
            let tile = Region { x: region.x + place.x, y: region.y + place.y, ..place };
            let pass = format!("ray casting, tile {} of {}", i + 1, cut.len());
            let mut begin = 0.0;
            loop {
                let last = begin >= plan.last_window;
                for (visit, &brick) in order.iter().enumerate() {
                    let mut setup = plan.setup;
                    setup.resume = u32::from(begin > 0.0 || visit > 0);
                    setup.window_end = if last { NO_SAMPLE } else { begin + plan.window };
                    let Brick { low, high, origin, dims } = bricks[brick];
                    [setup.brick_low, setup.brick_high, setup.brick_origin, setup.brick_dims] =
                        [low, high, origin, dims].map(|corner| corner.map(|n| n as f32));
                    let done = last && visit + 1 == order.len();
                    let table = plan.table.take();
                    let counting = self.options.count_work;
                    let commands = record_tile(&setup, tile, table, timestamps, counting, sink.output(done));
                    let cast = Cast { pass: &pass, key: plan.key, tile, windowed, brick };
                    // Drivers may compile a shader until the end of its first dispatch, so the time of this
                    // dispatch does not shrink the tiles.
                    let compiled = self.engine.has_pipeline(plan.key);
                    let tile_watch = Stopwatch::start();
                    let found = self.engine.cast(&cast, &commands)?;
                    device = device.zip(found.seconds).map(|(sum, s)| sum + s);
                    let seconds = found.seconds.unwrap_or_else(|| tile_watch.wall());
                    if compiled && seconds > longest {
                        self.tile[class] = (edge / 2).max(SMALLEST_TILE.min(edge));
                    }
                    if done {
                        match &mut sink {
                            Sink::Host(rgba) => join(rgba, region.width, place, found.image),
                            Sink::Picture(picture) => picture.fresh = false,
                        }
                        add_counts(&mut counts, found.work);
                    }
                }
                if last {
                    break;
                }
                begin += plan.window;
            }
        }
        self.table_step = Some(frame.step);
        Ok((FrameTime { device, wall: watch.wall(), cpu: watch.cpu() }, counts))
    }
}

/// Copies a finished tile into the image.
fn join(rgba: &mut [u8], width: u32, tile: Region, found: &[u8]) {
    let row_bytes = tile.width as usize * 4;
    for (y, row) in found.chunks_exact(row_bytes).enumerate() {
        let start = ((tile.y as usize + y) * width as usize + tile.x as usize) * 4;
        rgba[start..start + row_bytes].copy_from_slice(row);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_last_dispatch_of_a_tile_is_read_back() {
        let sink = Sink::Host(&mut []);
        assert_eq!([false, true].map(|done| sink.output(done)), [Output::Device, Output::Host]);
    }
}
