//! Pictures that stay on the device, and parts of frames.

use super::resources::{Image, Shape};
use super::shared::SharedDevice;
use crate::error::{Error, Result};
use ash::vk;
use entire_core::scene::Frame;
use std::mem::ManuallyDrop;

/// A rectangle of a frame, in pixels from its upper left corner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Region {
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Region {
    /// The whole frame.
    pub fn whole(frame: &Frame) -> Self {
        Self { x: 0, y: 0, width: frame.width, height: frame.height }
    }

    /// Refuses an invalid frame, and a region that is empty or reaches beyond the frame.
    pub(crate) fn check(&self, frame: &Frame) -> Result<()> {
        frame.checked().map_err(|e| Error::new(e.to_string()))?;
        let fits = |first: u32, count: u32, all: u32| {
            count > 0 && first.checked_add(count).is_some_and(|end| end <= all)
        };
        if fits(self.x, self.width, frame.width) && fits(self.y, self.height, frame.height) {
            return Ok(());
        }
        Err(Error::new(format!(
            "the region of {} x {} pixels at {}, {} is empty or reaches beyond the frame of {} x {}",
            self.width, self.height, self.x, self.y, frame.width, frame.height
        )))
    }

    /// Number of pixels.
    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }
}

/// A picture on the device, 8-bit RGBA in `R8G8B8A8_SRGB`: a viewer that samples the picture gets linear
/// colors. Between the calls that draw into it, the picture has the layout `SHADER_READ_ONLY_OPTIMAL`.
pub struct Picture {
    device: SharedDevice,
    image: ManuallyDrop<Image>,
    /// True if nothing was drawn into the picture.
    pub(super) fresh: bool,
}

impl Picture {
    /// Makes a picture with undefined contents.
    ///
    /// # Errors
    /// For a size of 0 or over [`SharedDevice::max_image_side`], and when the memory is full.
    pub fn new(device: &SharedDevice, width: u32, height: u32) -> Result<Self> {
        let longest = device.max_image_side();
        if width == 0 || height == 0 || width > longest || height > longest {
            return Err(Error::new(format!(
                "a picture of {width} x {height} pixels cannot be made; on {}, each side must have 1 to {longest} pixels",
                device.name()
            )));
        }
        let shape = Shape { extent: [width, height, 0], format: vk::Format::R8G8B8A8_SRGB, storage: false };
        let image = Image::new(device.gpu(), "picture", shape)?;
        Ok(Self { device: device.clone(), image: ManuallyDrop::new(image), fresh: true })
    }

    /// Width in pixels.
    pub fn width(&self) -> u32 {
        self.image.shape.extent[0]
    }

    /// Height in pixels.
    pub fn height(&self) -> u32 {
        self.image.shape.extent[1]
    }

    /// A view of the image, for sampling it.
    pub fn view(&self) -> vk::ImageView {
        self.image.view()
    }

    /// True if nothing was drawn into the picture. Such a picture must not be shown.
    pub fn is_fresh(&self) -> bool {
        self.fresh
    }

    pub(super) fn is_of(&self, device: &SharedDevice) -> bool {
        std::sync::Arc::ptr_eq(self.device.gpu(), device.gpu())
    }

    pub(super) fn image(&self) -> vk::Image {
        self.image.get()
    }
}

impl Drop for Picture {
    fn drop(&mut self) {
        let gpu = self.device.gpu();
        // A hanging device may still use the image, which is therefore leaked.
        if gpu.is_hanging() {
            return;
        }
        if !gpu.is_lost() && !gpu.is_abandoned() {
            let queue = gpu.queue();
            // A viewer may still be reading the picture. `drop` cannot report that the wait failed; a lost
            // device reads nothing.
            // SAFETY: the queue belongs to this device, and the lock keeps other threads from it.
            let _ = unsafe { gpu.device.queue_wait_idle(*queue) };
        }
        // SAFETY: the image is dropped once, here.
        unsafe { ManuallyDrop::drop(&mut self.image) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::scene::{Arcball, Camera};

    #[test]
    fn a_region_of_an_invalid_frame_is_refused() {
        let camera = Camera::from_arcball(Arcball { rx: 0.0, ry: 0.0, dz: 3.0 }).unwrap();
        let frame = Frame::new(camera, 8, 8).unwrap();
        assert!(Region::whole(&frame).check(&frame).is_ok());
        let huge = Frame { width: u32::MAX, height: u32::MAX, ..frame };
        let said = Region::whole(&huge).check(&huge).unwrap_err().to_string();
        assert!(said.contains("image size"), "{said}");
        assert!(Region { x: 8, ..Region::whole(&frame) }.check(&frame).is_err());
    }
}
