//! Device objects that are freed when they are dropped.

use super::gpu::{Gpu, NamedCall};
use crate::error::{Error, Result};
use ash::vk;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use std::sync::{Arc, PoisonError};

/// A handle that is destroyed when this value drops. The owner ensures that the device then does not use the
/// handle. On an abandoned device, the handle is leaked.
pub(crate) struct Owned<T: Copy> {
    gpu: Arc<Gpu>,
    handle: T,
    destroy: fn(&ash::Device, T),
}

impl<T: Copy> Owned<T> {
    pub(crate) fn new(gpu: &Arc<Gpu>, handle: T, destroy: fn(&ash::Device, T)) -> Self {
        Self { gpu: Arc::clone(gpu), handle, destroy }
    }

    pub(crate) fn get(&self) -> T {
        self.handle
    }
}

impl<T: Copy> Drop for Owned<T> {
    fn drop(&mut self) {
        if !self.gpu.is_abandoned() {
            (self.destroy)(&self.gpu.device, self.handle);
        }
    }
}

/// Makes a device object that is destroyed when its [`Owned`] drops.
macro_rules! owned {
    ($gpu:expr, $create:ident($info:expr), $destroy:ident, $call:literal) => {{
        let gpu: &Arc<Gpu> = $gpu;
        // SAFETY: the device is alive, pointers in the create info live until the call returns, and an
        // `Owned` destroys the handle once.
        let made = unsafe { gpu.device.$create($info, None) }.on(gpu, $call);
        made.map(|handle| {
            Owned::new(gpu, handle, |d, h| {
                // SAFETY: `Owned` calls this once, when the device no longer uses the handle.
                unsafe { d.$destroy(h, None) }
            })
        })
    }};
}
pub(crate) use owned;

/// Memory of a buffer or image, which is freed when this value drops; on an abandoned device, it is leaked.
struct Memory {
    gpu: Arc<Gpu>,
    allocation: Allocation,
}

impl Drop for Memory {
    fn drop(&mut self) {
        let allocation = std::mem::take(&mut self.allocation);
        if self.gpu.is_abandoned() {
            std::mem::forget(allocation);
        } else {
            // This fails only for an allocation of another allocator, which cannot happen here.
            let _ = self.gpu.allocator.lock().unwrap_or_else(PoisonError::into_inner).free(allocation);
        }
    }
}

fn allocate(
    gpu: &Arc<Gpu>,
    name: &str,
    requirements: vk::MemoryRequirements,
    location: MemoryLocation,
    linear: bool,
) -> Result<Memory> {
    if requirements.size > gpu.max_allocation {
        return Err(Error::new(format!(
            "the {name} needs {} bytes, but {} allocates at most {} at once; use a smaller volume or image",
            requirements.size, gpu.name, gpu.max_allocation
        )));
    }
    gpu.allocator
        .lock()
        .unwrap_or_else(PoisonError::into_inner)
        .allocate(&AllocationCreateDesc {
            name,
            requirements,
            location,
            linear,
            allocation_scheme: AllocationScheme::GpuAllocatorManaged,
        })
        .map(|allocation| Memory { gpu: Arc::clone(gpu), allocation })
        .map_err(|e| {
            Error::new(format!(
                "no memory for the {name}, {} bytes, on {}: {e}; use a smaller volume or image, or close \
                 other programs that use the device",
                requirements.size, gpu.name
            ))
        })
}

pub(crate) struct Buffer {
    buffer: Owned<vk::Buffer>,
    memory: Memory,
    size: u64,
}

impl Buffer {
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        name: &str,
        size: u64,
        usage: vk::BufferUsageFlags,
        location: MemoryLocation,
    ) -> Result<Self> {
        let info =
            vk::BufferCreateInfo::default().size(size).usage(usage).sharing_mode(vk::SharingMode::EXCLUSIVE);
        // Callers pass a size that is not 0.
        let buffer = owned!(gpu, create_buffer(&info), destroy_buffer, "vkCreateBuffer")?;
        // SAFETY: the buffer was made from this device.
        let requirements = unsafe { gpu.device.get_buffer_memory_requirements(buffer.get()) };
        let memory = allocate(gpu, name, requirements, location, true)?;
        let at = &memory.allocation;
        // SAFETY: the allocation was made for this buffer's requirements and is bound once.
        unsafe { gpu.device.bind_buffer_memory(buffer.get(), at.memory(), at.offset()) }
            .on(gpu, "vkBindBufferMemory")?;
        Ok(Self { buffer, memory, size })
    }

    pub(crate) fn get(&self) -> vk::Buffer {
        self.buffer.get()
    }

    pub(crate) fn size(&self) -> u64 {
        self.size
    }

    /// Returns the bytes, if the host can access them.
    pub(crate) fn bytes(&self) -> Result<&[u8]> {
        self.memory
            .allocation
            .mapped_slice()
            .map(|s| &s[..self.size as usize])
            .ok_or_else(|| Error::new("a buffer that the host reads is not mapped; this is a driver fault"))
    }

    /// Returns the bytes for writing, if the host can access them.
    pub(crate) fn bytes_mut(&mut self) -> Result<&mut [u8]> {
        let size = self.size as usize;
        self.memory
            .allocation
            .mapped_slice_mut()
            .map(|s| &mut s[..size])
            .ok_or_else(|| Error::new("a buffer that the host writes is not mapped; this is a driver fault"))
    }
}

/// Size and use of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Shape {
    /// Texels along each axis; a depth of 0 makes the image 2-D.
    pub(crate) extent: [u32; 3],
    pub(crate) format: vk::Format,
    /// True if shaders read the image as a storage image; false if shaders sample the image.
    pub(crate) storage: bool,
}

impl Shape {
    /// True if the image is 2-D.
    pub(crate) fn is_flat(&self) -> bool {
        self.extent[2] == 0
    }

    /// Returns the number of copy units (slices of a 3-D image, rows of a 2-D image), and the number of
    /// texels in each.
    pub(crate) fn slices(&self) -> (u32, u64) {
        let [x, y, z] = self.extent;
        if self.is_flat() { (y, u64::from(x)) } else { (z, u64::from(x) * u64::from(y)) }
    }
}

/// An image that shaders read, with its memory and a view of all of it.
pub(crate) struct Image {
    view: Owned<vk::ImageView>,
    image: Owned<vk::Image>,
    _memory: Memory,
    pub(crate) shape: Shape,
}

impl Image {
    /// Makes a 2-D or 3-D image that copies write and shaders read.
    pub(crate) fn new(gpu: &Arc<Gpu>, name: &str, shape: Shape) -> Result<Self> {
        let Shape { extent, format, storage } = shape;
        let (kind, view_kind) = if shape.is_flat() {
            (vk::ImageType::TYPE_2D, vk::ImageViewType::TYPE_2D)
        } else {
            (vk::ImageType::TYPE_3D, vk::ImageViewType::TYPE_3D)
        };
        let read = if storage { vk::ImageUsageFlags::STORAGE } else { vk::ImageUsageFlags::SAMPLED };
        let info = vk::ImageCreateInfo::default()
            .image_type(kind)
            .format(format)
            .extent(vk::Extent3D { width: extent[0], height: extent[1], depth: extent[2].max(1) })
            .mip_levels(1)
            .array_layers(1)
            .samples(vk::SampleCountFlags::TYPE_1)
            .tiling(vk::ImageTiling::OPTIMAL)
            .usage(read | vk::ImageUsageFlags::TRANSFER_DST)
            .sharing_mode(vk::SharingMode::EXCLUSIVE)
            .initial_layout(vk::ImageLayout::UNDEFINED);
        // The caller has checked that the device supports this extent and format.
        let image = owned!(gpu, create_image(&info), destroy_image, "vkCreateImage")?;
        // SAFETY: the image was made from this device.
        let requirements = unsafe { gpu.device.get_image_memory_requirements(image.get()) };
        let memory = allocate(gpu, name, requirements, MemoryLocation::GpuOnly, false)?;
        let at = &memory.allocation;
        // SAFETY: the allocation was made for this image's requirements and is bound once.
        unsafe { gpu.device.bind_image_memory(image.get(), at.memory(), at.offset()) }
            .on(gpu, "vkBindImageMemory")?;
        // The image is bound to memory, and the view has the image's format and kind.
        let info = vk::ImageViewCreateInfo::default()
            .image(image.get())
            .view_type(view_kind)
            .format(format)
            .subresource_range(COLOR_RANGE);
        let view = owned!(gpu, create_image_view(&info), destroy_image_view, "vkCreateImageView")?;
        Ok(Self { view, image, _memory: memory, shape })
    }

    pub(crate) fn get(&self) -> vk::Image {
        self.image.get()
    }

    /// The layout in which shaders read the image.
    pub(crate) fn layout(&self) -> vk::ImageLayout {
        if self.shape.storage { vk::ImageLayout::GENERAL } else { vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL }
    }

    pub(crate) fn view(&self) -> vk::ImageView {
        self.view.get()
    }
}

/// The one mip level and layer that every image here has.
pub(crate) const COLOR_RANGE: vk::ImageSubresourceRange = vk::ImageSubresourceRange {
    aspect_mask: vk::ImageAspectFlags::COLOR,
    base_mip_level: 0,
    level_count: 1,
    base_array_layer: 0,
    layer_count: 1,
};
