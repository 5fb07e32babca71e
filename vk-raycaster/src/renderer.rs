//! Interface of all renderers of this crate.

use crate::error::Result;
use entire_core::scene::{Frame, TransferTable, VolumeView};

/// An 8-bit RGBA image, rows from top to bottom, colors premultiplied by opacity over black.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `width * height * 4` bytes.
    pub rgba: Vec<u8>,
}

/// Time of a frame by each clock. A clock that does not exist is `None`, never zero.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrameTime {
    /// Time between the device timestamps around the ray-casting pass, in seconds.
    pub device: Option<f64>,
    /// Time from submission to completion on the host's clock, in seconds.
    pub wall: f64,
    /// CPU time of all threads of this process during the frame, in seconds.
    pub cpu: Option<f64>,
}

impl FrameTime {
    /// The frame's time in seconds: device time if the device has timestamps, else wall time.
    pub fn seconds(&self) -> f64 {
        self.device.unwrap_or(self.wall)
    }

    /// The name of the clock behind [`FrameTime::seconds`]: `device` or `wall`.
    pub fn source(&self) -> &'static str {
        if self.device.is_some() { "device" } else { "wall" }
    }
}

/// Counts of a frame's work, over the whole image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WorkCounts {
    /// Rays that hit the volume's box.
    pub rays: u64,
    /// Samples taken, those of shadow rays included; the fetches of a gradient are not counted.
    pub samples: u64,
    /// Skips of empty blocks, those of shadow rays included.
    pub skips: u64,
    /// Visible samples, if the frame has shading; else 0.
    pub shaded: u64,
}

/// A finished frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Rendered {
    /// The picture.
    pub image: Image,
    /// Time of the frame.
    pub time: FrameTime,
    /// Work of the frame; `None` if it was not counted.
    pub counts: Option<WorkCounts>,
}

/// Time of a preparation (a change of volume or transfer function), in wall seconds: the total and its parts.
/// The time of a frame does not include preparations. A part that the change did not need is `None`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Preparation {
    /// Total time.
    pub wall: f64,
    /// Conversion of the voxels and their upload to the device.
    pub upload: Option<f64>,
    /// Computation of the smallest and largest value of each block.
    pub block_map: Option<f64>,
    /// Search for the blocks that are empty under the transfer function.
    pub occupancy: Option<f64>,
    /// Computation of the distances between empty and occupied blocks.
    pub distance_map: Option<f64>,
}

/// A Vulkan device and its limits, as its driver reports them.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceLimits {
    /// The device's name.
    pub name: String,
    /// Driver name and version.
    pub driver: String,
    /// Vulkan version, `major.minor.patch`.
    pub api_version: String,
    /// True if the device is a software implementation.
    pub is_software: bool,
    /// Maximum number of texels along an axis of a 3-D texture.
    pub max_image_3d: u32,
    /// Maximum number of bytes of a storage buffer.
    pub max_storage_buffer: u64,
    /// Maximum number of bytes of one allocation.
    pub max_allocation: u64,
    /// Bytes of the largest memory heap on the device.
    pub memory: u64,
    /// Number of invocations in a subgroup.
    pub subgroup_size: u32,
    /// Valid bits and nanoseconds per tick of device timestamps; `None` if there are none.
    pub timestamps: Option<(u32, f64)>,
}

/// A volume renderer. Set a volume and a transfer function, then render frames.
pub trait Renderer {
    /// Device name and driver, for manifests.
    fn device(&self) -> String;

    /// Kind of the renderer: `vulkan` or `cpu` for the raycasters of this crate.
    fn backend(&self) -> &'static str;

    /// Kind and limits of the Vulkan device, which may be software; `None` if the renderer uses no Vulkan
    /// device.
    fn limits(&self) -> Option<DeviceLimits> {
        None
    }

    /// Sets the volume; the view is only borrowed for the call.
    ///
    /// # Errors
    /// When the device cannot hold the volume; the error names the size and the limit.
    fn set_volume(&mut self, volume: &VolumeView<'_>) -> Result<Preparation>;

    /// Sets the transfer function.
    ///
    /// # Errors
    /// When the device fails.
    fn set_transfer(&mut self, table: &TransferTable) -> Result<Preparation>;

    /// Renders a frame and reads it back.
    ///
    /// # Errors
    /// When volume or transfer function were not set, when the frame is invalid, or when the device fails.
    /// The renderer stays usable unless the device was lost.
    fn render(&mut self, frame: &Frame) -> Result<Rendered>;

    /// Switches [`Rendered::counts`] on or off for later frames. Frames with counts may take a little longer.
    /// Renderers that always count, or cannot count, ignore this call.
    fn count_work(&mut self, on: bool) {
        let _ = on;
    }
}
