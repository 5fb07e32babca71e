//! Screenshots: pictures at full quality in files, drawn in slices.

use crate::host::Host;
use crate::refine::Cursor;
use anyhow::Result;
use entire_core::scene::Frame;
use entire_vk_raycaster::VulkanRaycaster;
use std::path::PathBuf;

/// A screenshot that is being drawn.
pub(crate) struct Screenshot {
    pub(crate) file: PathBuf,
    frame: Frame,
    /// Expected seconds of the whole frame.
    expected: f64,
    cursor: Cursor,
    rgb: Vec<u8>,
}

impl Screenshot {
    /// A screenshot that has not begun to draw. `expected`: seconds of the whole frame.
    pub(crate) fn new(file: PathBuf, frame: Frame, expected: f64) -> Self {
        let rgb = vec![0; frame.width as usize * frame.height as usize * 3];
        Self { file, frame, expected, cursor: Cursor::new(frame.width, frame.height, expected), rgb }
    }

    /// Begins anew, after a change of the transfer function: a picture shows one transfer function.
    pub(crate) fn restart(&mut self) {
        self.cursor = Cursor::new(self.frame.width, self.frame.height, self.expected);
    }

    pub(crate) fn share(&self) -> f64 {
        self.cursor.share()
    }

    /// Continues to draw for about `budget` seconds. Returns true once the file is written.
    ///
    /// # Errors
    /// When the raycaster fails or the file cannot be written.
    pub(crate) fn slice(
        &mut self,
        raycaster: &mut VulkanRaycaster,
        budget: f64,
        host: &dyn Host,
    ) -> Result<bool> {
        let (frame, rgb) = (&self.frame, &mut self.rgb);
        let width = frame.width as usize;
        self.cursor.slice(budget, |region| {
            let rendered = raycaster.render_region(frame, region)?;
            let found = rendered.image.rgba.as_chunks::<4>().0.chunks_exact(region.width as usize);
            for (row, pixels) in found.enumerate() {
                let start = ((region.y as usize + row) * width + region.x as usize) * 3;
                let out = &mut rgb[start..start + 3 * region.width as usize];
                for (out, pixel) in out.as_chunks_mut::<3>().0.iter_mut().zip(pixels) {
                    // Colors are premultiplied: without alpha they are already blended over black.
                    out.copy_from_slice(&pixel[..3]);
                }
            }
            Ok(rendered.time.wall)
        })?;
        if self.cursor.is_done() {
            host.write_whole(&self.file, &png(frame.width, frame.height, rgb)?)?;
        }
        Ok(self.cursor.is_done())
    }
}

/// A PNG file of 8-bit RGB.
fn png(width: u32, height: u32, rgb: &[u8]) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(rgb)?;
    writer.finish()?;
    Ok(bytes)
}
