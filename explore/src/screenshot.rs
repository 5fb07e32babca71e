//! Screenshots: pictures at full quality in files, drawn in slices.

use crate::host::Host;
use crate::refine::Cursor;
use anyhow::Result;
use entire_core::scene::Frame;
use entire_vk_raycaster::{Image, VulkanRaycaster};
use std::path::PathBuf;

/// A screenshot that is being drawn.
pub(crate) struct Screenshot {
    pub(crate) file: PathBuf,
    frame: Frame,
    /// Expected seconds of the whole frame.
    expected: f64,
    cursor: Cursor,
    picture: Image,
}

impl Screenshot {
    /// A screenshot that has not begun to draw. `expected`: seconds of the whole frame.
    pub(crate) fn new(file: PathBuf, frame: Frame, expected: f64) -> Self {
        let Frame { width, height, .. } = frame;
        let picture = Image { width, height, rgba: vec![0; width as usize * height as usize * 4] };
        Self { file, frame, expected, cursor: Cursor::new(width, height, expected), picture }
    }

    /// Begins anew, after a change of the transfer function: a picture shows one transfer function.
    pub(crate) fn restart(&mut self) {
        self.cursor = Cursor::new(self.frame.width, self.frame.height, self.expected);
    }

    pub(crate) fn share(&self) -> f64 {
        self.cursor.share()
    }

    /// Continues to draw for about `budget` seconds. Returns true once the file is written.
    pub(crate) fn slice(
        &mut self,
        raycaster: &mut VulkanRaycaster,
        budget: f64,
        host: &dyn Host,
    ) -> Result<bool> {
        let (frame, rgba) = (&self.frame, &mut self.picture.rgba);
        let line = 4 * frame.width as usize;
        self.cursor.slice(budget, |region| {
            let rendered = raycaster.render_region(frame, region)?;
            let part = 4 * region.width as usize;
            for (row, pixels) in rendered.image.rgba.chunks_exact(part).enumerate() {
                let start = (region.y as usize + row) * line + 4 * region.x as usize;
                rgba[start..start + part].copy_from_slice(pixels);
            }
            Ok(rendered.time.wall)
        })?;
        if self.cursor.is_done() {
            host.write_picture(&self.file, &self.picture)?;
        }
        Ok(self.cursor.is_done())
    }
}
