//! The swapchain.

use anyhow::Result;
use ash::vk;
use entire_vk_raycaster::SharedDevice;

/// Resources of one swapchain image.
#[derive(Default)]
struct Frame {
    view: vk::ImageView,
    framebuffer: vk::Framebuffer,
    /// Signaled once the image is drawn.
    drawn: vk::Semaphore,
}

/// A swapchain with a render pass that clears and draws into it.
pub(super) struct Swapchain {
    functions: ash::khr::swapchain::Device,
    handle: vk::SwapchainKHR,
    pub(super) render_pass: vk::RenderPass,
    frames: Vec<Frame>,
    /// Signaled once the acquired image may be written.
    pub(super) acquired: vk::Semaphore,
    pub(super) extent: vk::Extent2D,
    /// The requested size in pixels; `extent` is this size within the surface's limits.
    pub(super) asked: [u32; 2],
    pub(super) format: vk::SurfaceFormatKHR,
    /// True if presentation waits for the display's refresh.
    pub(super) waits: bool,
    /// True if the surface has changed since the swapchain was made.
    pub(super) stale: bool,
    /// The replaced swapchain, if the device was hanging: the device may still use it.
    _replaced: Option<Box<Self>>,
    device: SharedDevice,
}

impl Swapchain {
    /// Returns a swapchain in place of an old one, which the device must not be using; `None` if the surface
    /// has no area (a minimized window).
    pub(super) fn new(
        device: &SharedDevice,
        surface_functions: &ash::khr::surface::Instance,
        surface: vk::SurfaceKHR,
        asked: [u32; 2],
        old: Option<Self>,
    ) -> Result<Option<Self>> {
        let failed = |call: &'static str| move |r| device.error(call, r);
        let physical = device.physical_device();
        // SAFETY: surface and physical device belong to the same instance.
        let (capabilities, formats, modes) = unsafe {
            (
                surface_functions
                    .get_physical_device_surface_capabilities(physical, surface)
                    .map_err(failed("vkGetPhysicalDeviceSurfaceCapabilitiesKHR"))?,
                surface_functions
                    .get_physical_device_surface_formats(physical, surface)
                    .map_err(failed("vkGetPhysicalDeviceSurfaceFormatsKHR"))?,
                surface_functions
                    .get_physical_device_surface_present_modes(physical, surface)
                    .map_err(failed("vkGetPhysicalDeviceSurfacePresentModesKHR"))?,
            )
        };
        let (least, most) = (capabilities.min_image_extent, capabilities.max_image_extent);
        let extent = if capabilities.current_extent.width == u32::MAX {
            vk::Extent2D {
                width: asked[0].clamp(least.width, most.width.max(least.width)),
                height: asked[1].clamp(least.height, most.height.max(least.height)),
            }
        } else {
            capabilities.current_extent
        };
        if extent.width == 0 || extent.height == 0 {
            return Ok(None);
        }
        let format = choose_format(&formats);
        let mode = choose_mode(&modes);
        let most_images =
            if capabilities.max_image_count == 0 { u32::MAX } else { capabilities.max_image_count };
        let images = (capabilities.min_image_count + 1).min(most_images);
        let alpha = [vk::CompositeAlphaFlagsKHR::OPAQUE, vk::CompositeAlphaFlagsKHR::INHERIT]
            .into_iter()
            .find(|a| capabilities.supported_composite_alpha.contains(*a))
            .unwrap_or(vk::CompositeAlphaFlagsKHR::OPAQUE);
        let functions = ash::khr::swapchain::Device::new(device.instance(), device.device());
        let info = vk::SwapchainCreateInfoKHR::default()
            .surface(surface)
            .min_image_count(images)
            .image_format(format.format)
            .image_color_space(format.color_space)
            .image_extent(extent)
            .image_array_layers(1)
            .image_usage(vk::ImageUsageFlags::COLOR_ATTACHMENT)
            .image_sharing_mode(vk::SharingMode::EXCLUSIVE)
            .pre_transform(capabilities.current_transform)
            .composite_alpha(alpha)
            .present_mode(mode)
            .clipped(true)
            .old_swapchain(old.as_ref().map_or(vk::SwapchainKHR::null(), |s| s.handle));
        // SAFETY: the surface was queried for every value of the create info and supports it.
        let handle =
            unsafe { functions.create_swapchain(&info, None) }.map_err(failed("vkCreateSwapchainKHR"))?;
        let mut this = Self {
            functions,
            handle,
            render_pass: vk::RenderPass::null(),
            frames: Vec::new(),
            acquired: vk::Semaphore::null(),
            extent,
            asked,
            format,
            waits: mode == vk::PresentModeKHR::FIFO,
            stale: false,
            _replaced: old.filter(|_| device.is_hanging()).map(Box::new),
            device: device.clone(),
        };
        let d = device.device();
        let attachments = [vk::AttachmentDescription::default()
            .format(format.format)
            .samples(vk::SampleCountFlags::TYPE_1)
            .load_op(vk::AttachmentLoadOp::CLEAR)
            .store_op(vk::AttachmentStoreOp::STORE)
            .stencil_load_op(vk::AttachmentLoadOp::DONT_CARE)
            .stencil_store_op(vk::AttachmentStoreOp::DONT_CARE)
            .initial_layout(vk::ImageLayout::UNDEFINED)
            .final_layout(vk::ImageLayout::PRESENT_SRC_KHR)];
        let color =
            [vk::AttachmentReference { attachment: 0, layout: vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL }];
        let subpasses = [vk::SubpassDescription::default()
            .pipeline_bind_point(vk::PipelineBindPoint::GRAPHICS)
            .color_attachments(&color)];
        // The image is not written before the stage that waits for its acquisition.
        let dependencies = [vk::SubpassDependency {
            src_subpass: vk::SUBPASS_EXTERNAL,
            dst_subpass: 0,
            src_stage_mask: vk::PipelineStageFlags::COLOR_ATTACHMENT_OUTPUT,
            dst_stage_mask: vk::PipelineStageFlags::COLOR_ATTACHMENT_OUTPUT,
            dst_access_mask: vk::AccessFlags::COLOR_ATTACHMENT_WRITE,
            ..Default::default()
        }];
        let info = vk::RenderPassCreateInfo::default()
            .attachments(&attachments)
            .subpasses(&subpasses)
            .dependencies(&dependencies);
        // SAFETY: the device is alive, the memory that the create infos point to lives until the calls
        // return, and `this` destroys each handle once.
        unsafe {
            this.render_pass = d.create_render_pass(&info, None).map_err(failed("vkCreateRenderPass"))?;
            let info = vk::SemaphoreCreateInfo::default();
            this.acquired = d.create_semaphore(&info, None).map_err(failed("vkCreateSemaphore"))?;
            let images =
                this.functions.get_swapchain_images(handle).map_err(failed("vkGetSwapchainImagesKHR"))?;
            for image in images {
                let frame = this.frames.push_mut(Frame::default());
                let info = vk::ImageViewCreateInfo::default()
                    .image(image)
                    .view_type(vk::ImageViewType::TYPE_2D)
                    .format(format.format)
                    .subresource_range(vk::ImageSubresourceRange {
                        aspect_mask: vk::ImageAspectFlags::COLOR,
                        level_count: 1,
                        layer_count: 1,
                        ..Default::default()
                    });
                frame.view = d.create_image_view(&info, None).map_err(failed("vkCreateImageView"))?;
                let views = [frame.view];
                let info = vk::FramebufferCreateInfo::default()
                    .render_pass(this.render_pass)
                    .attachments(&views)
                    .width(extent.width)
                    .height(extent.height)
                    .layers(1);
                frame.framebuffer =
                    d.create_framebuffer(&info, None).map_err(failed("vkCreateFramebuffer"))?;
                let info = vk::SemaphoreCreateInfo::default();
                frame.drawn = d.create_semaphore(&info, None).map_err(failed("vkCreateSemaphore"))?;
            }
        }
        Ok(Some(this))
    }

    /// True if the device converts linear values to sRGB when it writes them.
    pub(super) fn is_srgb(&self) -> bool {
        matches!(self.format.format, vk::Format::B8G8R8A8_SRGB | vk::Format::R8G8B8A8_SRGB)
    }

    pub(super) fn framebuffer(&self, index: u32) -> vk::Framebuffer {
        self.frames[index as usize].framebuffer
    }

    pub(super) fn drawn(&self, index: u32) -> vk::Semaphore {
        self.frames[index as usize].drawn
    }

    /// Returns the index of the next image to draw into; `None` if the surface has changed. `longest`: time
    /// limit, nanoseconds.
    pub(super) fn acquire(&mut self, longest: u64) -> Result<Option<u32>> {
        // SAFETY: the semaphore is unsignaled: the previous frame has waited for it and is done. If a frame
        // is not submitted, its swapchain is dropped, and the next swapchain has a new semaphore.
        let found = unsafe {
            self.functions.acquire_next_image(self.handle, longest, self.acquired, vk::Fence::null())
        };
        match found {
            Ok((index, suboptimal)) => {
                self.stale |= suboptimal;
                Ok(Some(index))
            }
            Err(vk::Result::ERROR_OUT_OF_DATE_KHR) => {
                self.stale = true;
                Ok(None)
            }
            Err(r) => Err(self.device.error("vkAcquireNextImageKHR", r).into()),
        }
    }

    /// Presents an image once its drawing is finished.
    pub(super) fn present(&mut self, index: u32) -> Result<()> {
        let (waits, chains, indices) = ([self.drawn(index)], [self.handle], [index]);
        let info =
            vk::PresentInfoKHR::default().wait_semaphores(&waits).swapchains(&chains).image_indices(&indices);
        // SAFETY: the queue is locked during the call, and the frame's submission signals the semaphore.
        let done = self.device.with_queue(|queue| unsafe { self.functions.queue_present(queue, &info) });
        match done {
            Ok(suboptimal) => self.stale |= suboptimal,
            Err(vk::Result::ERROR_OUT_OF_DATE_KHR) => self.stale = true,
            Err(r) => return Err(self.device.error("vkQueuePresentKHR", r).into()),
        }
        Ok(())
    }
}

/// Returns an 8-bit sRGB format if there is one, else an 8-bit format without encoding, else the first
/// format. The interface's pictures are sampled as linear values, so sRGB needs no conversion in the shader.
fn choose_format(formats: &[vk::SurfaceFormatKHR]) -> vk::SurfaceFormatKHR {
    let wanted = [
        vk::Format::B8G8R8A8_SRGB,
        vk::Format::R8G8B8A8_SRGB,
        vk::Format::B8G8R8A8_UNORM,
        vk::Format::R8G8B8A8_UNORM,
    ];
    let at = |format| {
        formats.iter().find(|f| f.format == format && f.color_space == vk::ColorSpaceKHR::SRGB_NONLINEAR)
    };
    wanted.into_iter().find_map(at).or(formats.first()).copied().unwrap_or_default()
}

/// Returns a mode that does not wait for the display's refresh, if there is one, so that a frame's time
/// contains only work.
fn choose_mode(modes: &[vk::PresentModeKHR]) -> vk::PresentModeKHR {
    [vk::PresentModeKHR::MAILBOX, vk::PresentModeKHR::IMMEDIATE]
        .into_iter()
        .find(|m| modes.contains(m))
        .unwrap_or(vk::PresentModeKHR::FIFO)
}

impl Drop for Swapchain {
    fn drop(&mut self) {
        // A hanging device may still use the objects, which are therefore leaked.
        if self.device.is_abandoned() || self.device.is_hanging() {
            return;
        }
        let d = self.device.device();
        // If the wait fails, the device is lost and runs nothing.
        // SAFETY: the queue is locked during the wait, after which the device uses none of the objects. Each
        // object is destroyed once; null handles are ignored.
        unsafe {
            let _ = self.device.with_queue(|queue| d.queue_wait_idle(queue));
            for frame in &self.frames {
                d.destroy_semaphore(frame.drawn, None);
                d.destroy_framebuffer(frame.framebuffer, None);
                d.destroy_image_view(frame.view, None);
            }
            d.destroy_render_pass(self.render_pass, None);
            self.functions.destroy_swapchain(self.handle, None);
            d.destroy_semaphore(self.acquired, None);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_encoded_by_the_device_and_do_not_wait_where_it_can_be_had() {
        let format = |format| vk::SurfaceFormatKHR { format, color_space: vk::ColorSpaceKHR::SRGB_NONLINEAR };
        let all = [format(vk::Format::B8G8R8A8_UNORM), format(vk::Format::B8G8R8A8_SRGB)];
        assert_eq!(choose_format(&all), all[1]);
        assert_eq!(choose_format(&all[..1]), all[0]);
        let other = [format(vk::Format::A2B10G10R10_UNORM_PACK32)];
        assert_eq!(choose_format(&other), other[0]);
        use vk::PresentModeKHR as M;
        assert_eq!(choose_mode(&[M::FIFO, M::IMMEDIATE, M::MAILBOX]), M::MAILBOX);
        assert_eq!(choose_mode(&[M::FIFO]), M::FIFO);
    }
}
