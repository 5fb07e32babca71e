//! A device that is shared with others: a window that shows the raycaster's pictures, and further raycasters.

use super::gpu::Gpu;
use super::{VulkanOptions, VulkanRaycaster};
use crate::error::{Error, Result};
use ash::vk;
use std::sync::Arc;

/// The device of a [`VulkanRaycaster`]. It stays open as long as any `SharedDevice`, raycaster or
/// [`Picture`](super::Picture) of it exists.
///
/// Code that makes Vulkan objects from [`SharedDevice::device`] must keep a clone of the `SharedDevice`, and
/// destroy the objects before it drops the clone.
#[derive(Clone)]
pub struct SharedDevice {
    gpu: Arc<Gpu>,
}

impl SharedDevice {
    pub(crate) fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// The loader.
    pub fn entry(&self) -> &ash::Entry {
        &self.gpu.instance.entry
    }

    /// The instance, made with [`VulkanOptions::surface_extensions`].
    pub fn instance(&self) -> &ash::Instance {
        &self.gpu.instance.functions
    }

    /// The physical device.
    pub fn physical_device(&self) -> vk::PhysicalDevice {
        self.gpu.physical
    }

    /// The device.
    pub fn device(&self) -> &ash::Device {
        &self.gpu.device
    }

    /// The family of the only queue.
    pub fn queue_family(&self) -> u32 {
        self.gpu.family
    }

    /// Calls `use_queue` with the locked queue. `use_queue` must not call a raycaster of this device.
    pub fn with_queue<T>(&self, use_queue: impl FnOnce(vk::Queue) -> T) -> T {
        let queue = self.gpu.queue();
        use_queue(*queue)
    }

    /// The device's name.
    pub fn name(&self) -> &str {
        &self.gpu.name
    }

    /// Maximum number of pixels along a side of an image.
    pub fn max_image_side(&self) -> u32 {
        self.gpu.limits.max_image_dimension2_d
    }

    /// True if a call has returned `VK_ERROR_DEVICE_LOST`: nothing runs on the device.
    pub fn is_lost(&self) -> bool {
        self.gpu.is_lost()
    }

    /// True if a raycaster was dropped while one of its submissions exceeded [`VulkanOptions::longest_wait`].
    /// The submission may still use objects that were made from the device, so none of these objects may be
    /// waited for or destroyed.
    pub fn is_abandoned(&self) -> bool {
        self.gpu.is_abandoned()
    }

    /// True if a submission of a raycaster has exceeded [`VulkanOptions::longest_wait`] and was not seen to
    /// end. The submission may still use objects that were made from the device, and a wait for the queue
    /// might never return. False for a lost device.
    pub fn is_hanging(&self) -> bool {
        self.gpu.is_hanging()
    }

    /// Returns the error of a Vulkan call on this device, with the remedy. The device is marked lost if
    /// `result` is `VK_ERROR_DEVICE_LOST`.
    pub fn error(&self, call: &str, result: vk::Result) -> Error {
        self.gpu.error(call, result)
    }

    /// Messages of the validation layer so far; empty without validation.
    pub fn validation_messages(&self) -> Vec<String> {
        self.gpu.messages()
    }
}

impl VulkanRaycaster {
    /// Makes a further raycaster on an open device, with its own volume and transfer function. Raycasters
    /// that share a device may run at the same time, each on its own thread.
    ///
    /// # Errors
    /// When the device is lost or its memory is full.
    pub fn on_device(device: &SharedDevice, options: VulkanOptions) -> Result<Self> {
        device.gpu.check()?;
        Self::on(Arc::clone(&device.gpu), options)
    }

    /// The device, for code that shows pictures and for further raycasters.
    pub fn shared_device(&self) -> SharedDevice {
        SharedDevice { gpu: Arc::clone(self.engine.gpu()) }
    }
}
