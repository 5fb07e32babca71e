//! Presents the interface with the raycaster's pictures: surface, swapchain and one submission per frame.
//!
//! Everything runs on the raycaster's own device and queue, so that a picture goes from the compute shader to
//! the window without leaving the device.

mod swapchain;

use crate::log::thread_seconds;
use anyhow::{Context, Result, anyhow};
use ash::vk;
use egui::epaint::textures::TexturesDelta;
use egui::{ClippedPrimitive, TextureId};
use egui_ash_renderer::allocator::DefaultAllocator;
use egui_ash_renderer::{Options, RenderMode, Renderer, RendererError, vulkan};
use entire_vk_raycaster::{Picture, SharedDevice};
use std::collections::HashMap;
use std::ffi::{CStr, CString};
use std::time::Instant;
use swapchain::Swapchain;
use winit::raw_window_handle::{HasDisplayHandle, HasWindowHandle};

/// Maximum number of registered pictures.
const MOST_PICTURES: u32 = 16;

/// Time limit of a wait for the device or for a swapchain image, nanoseconds.
const LONGEST_WAIT: u64 = 60_000_000_000;

/// Returns the Vulkan instance extensions that windows of a display need.
pub(crate) fn surface_extensions(display: &impl HasDisplayHandle) -> Result<Vec<CString>> {
    let handle = display.display_handle().context("the display has no handle")?;
    let names = ash_window::enumerate_required_extensions(handle.as_raw())
        .map_err(|e| anyhow!("Vulkan cannot show pictures on this display: {e}"))?;
    // SAFETY: ash-window returns C strings that are static.
    Ok(names.iter().map(|n| unsafe { CStr::from_ptr(*n) }.to_owned()).collect())
}

/// Times of presenting a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Presented {
    /// True if the frame was shown; false if the window had just changed its size.
    pub(crate) shown: bool,
    /// Seconds of waiting for a swapchain image.
    pub(crate) display: f64,
    /// Seconds of drawing and presenting the interface, until the device has finished.
    pub(crate) device: f64,
    /// Processor seconds of this thread in the call that presents the image. Software drivers copy the image
    /// in this call.
    pub(crate) handing: f64,
}

/// Presentation resources of the window.
pub(crate) struct Presenter {
    egui: Option<Renderer<DefaultAllocator>>,
    swapchain: Option<Swapchain>,
    surface: vk::SurfaceKHR,
    surface_functions: ash::khr::surface::Instance,
    pool: vk::CommandPool,
    commands: vk::CommandBuffer,
    fence: vk::Fence,
    sampler: vk::Sampler,
    set_layout: vk::DescriptorSetLayout,
    descriptors: vk::DescriptorPool,
    sets: HashMap<TextureId, vk::DescriptorSet>,
    /// True from the submission of a frame until its fence was seen to signal: meanwhile, nothing that the
    /// frame uses may change.
    pending: bool,
    device: SharedDevice,
}

impl Presenter {
    /// Returns a presenter for a window, which must outlive it: a surface, and all resources of the interface
    /// except the swapchain. The first frame makes the swapchain.
    ///
    /// # Errors
    /// When the device cannot present on this window.
    pub(crate) fn new(
        device: &SharedDevice,
        window: &(impl HasDisplayHandle + HasWindowHandle),
    ) -> Result<Self> {
        let failed = |call: &'static str| move |r| device.error(call, r);
        let display = window.display_handle().context("the window has no display")?;
        let handle = window.window_handle().context("the window has no handle")?;
        let surface_functions = ash::khr::surface::Instance::new(device.entry(), device.instance());
        // SAFETY: both handles are alive. The window outlives the presenter, as this function requires: the
        // application drops the presenter first.
        let surface = unsafe {
            ash_window::create_surface(
                device.entry(),
                device.instance(),
                display.as_raw(),
                handle.as_raw(),
                None,
            )
        }
        .map_err(failed("vkCreateSurface"))?;
        // SAFETY: surface, physical device and queue family belong to the same instance.
        let presents = unsafe {
            surface_functions.get_physical_device_surface_support(
                device.physical_device(),
                device.queue_family(),
                surface,
            )
        };
        if !matches!(presents, Ok(true)) {
            // SAFETY: the surface was made above, and nothing uses it.
            unsafe { surface_functions.destroy_surface(surface, None) };
            return Err(anyhow!(
                "{} cannot show pictures on this display; choose another device (ENTIRE_DEVICE)",
                device.name()
            ));
        }
        let mut this = Self {
            egui: None,
            swapchain: None,
            surface,
            surface_functions,
            pool: vk::CommandPool::null(),
            commands: vk::CommandBuffer::null(),
            fence: vk::Fence::null(),
            sampler: vk::Sampler::null(),
            set_layout: vk::DescriptorSetLayout::null(),
            descriptors: vk::DescriptorPool::null(),
            sets: HashMap::new(),
            pending: false,
            device: device.clone(),
        };
        let d = device.device();
        // SAFETY: the device is alive, the memory that the create infos point to lives until the calls
        // return, and `this` destroys each handle once.
        unsafe {
            let info = vk::CommandPoolCreateInfo::default().queue_family_index(device.queue_family()).flags(
                vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER | vk::CommandPoolCreateFlags::TRANSIENT,
            );
            this.pool = d.create_command_pool(&info, None).map_err(failed("vkCreateCommandPool"))?;
            let info =
                vk::CommandBufferAllocateInfo::default().command_pool(this.pool).command_buffer_count(1);
            this.commands = d.allocate_command_buffers(&info).map_err(failed("vkAllocateCommandBuffers"))?[0];
            this.fence =
                d.create_fence(&vk::FenceCreateInfo::default(), None).map_err(failed("vkCreateFence"))?;
            let info = vk::SamplerCreateInfo::default()
                .mag_filter(vk::Filter::LINEAR)
                .min_filter(vk::Filter::LINEAR)
                .address_mode_u(vk::SamplerAddressMode::CLAMP_TO_EDGE)
                .address_mode_v(vk::SamplerAddressMode::CLAMP_TO_EDGE);
            this.sampler = d.create_sampler(&info, None).map_err(failed("vkCreateSampler"))?;
        }
        this.set_layout = vulkan::create_vulkan_descriptor_set_layout(d).map_err(|e| drawing(device, &e))?;
        this.descriptors =
            vulkan::create_vulkan_descriptor_pool(d, MOST_PICTURES).map_err(|e| drawing(device, &e))?;
        Ok(this)
    }

    /// Registers a picture with the interface.
    pub(crate) fn add_picture(&mut self, picture: &Picture) -> Result<TextureId> {
        let set = vulkan::create_vulkan_descriptor_set(
            self.device.device(),
            self.set_layout,
            self.descriptors,
            picture.view(),
            self.sampler,
        )
        .map_err(|e| drawing(&self.device, &e))?;
        let Some(egui) = &mut self.egui else { return Err(anyhow!("the window was not drawn yet")) };
        let id = egui.add_user_texture(set);
        self.sets.insert(id, set);
        Ok(id)
    }

    /// Removes a picture. The device must not be drawing it; after a successful [`Presenter::prepare`], no
    /// frame is on the device.
    pub(crate) fn remove_picture(&mut self, id: TextureId) {
        if let Some(egui) = &mut self.egui {
            egui.remove_user_texture(id);
        }
        if let Some(set) = self.sets.remove(&id) {
            // The call can fail only if the device is lost.
            // SAFETY: the set was allocated from this pool, whose sets may be freed singly, and the device
            // does not use it.
            let _ = unsafe { self.device.device().free_descriptor_sets(self.descriptors, &[set]) };
        }
    }

    /// Makes a swapchain of a size, unless there is one. Returns false if the window has no area.
    ///
    /// # Errors
    /// When the device fails, or has not finished a frame that exceeded the time limit.
    pub(crate) fn prepare(&mut self, size: [u32; 2]) -> Result<bool> {
        self.wait(0)?;
        if size.contains(&0) {
            return Ok(false);
        }
        if self.swapchain.as_ref().is_some_and(|s| !s.stale && s.asked == size) {
            return Ok(true);
        }
        let old = self.swapchain.take();
        let kept = old.as_ref().map(|s| s.format);
        self.swapchain = Swapchain::new(&self.device, &self.surface_functions, self.surface, size, old)?;
        let Some(swapchain) = &self.swapchain else { return Ok(false) };
        if self.egui.is_none() {
            let options = Options { srgb_framebuffer: swapchain.is_srgb(), ..Options::default() };
            let egui = Renderer::with_default_allocator(
                self.device.instance(),
                self.device.physical_device(),
                self.device.device().clone(),
                RenderMode::RenderPass(swapchain.render_pass),
                options,
            );
            self.egui = Some(egui.map_err(|e| drawing(&self.device, &e))?);
        } else if let (Some(egui), true) = (&mut self.egui, kept != Some(swapchain.format)) {
            egui.set_render_mode(RenderMode::RenderPass(swapchain.render_pass))
                .map_err(|e| drawing(&self.device, &e))?;
        }
        Ok(true)
    }

    /// True if presenting waits for the display's next refresh.
    pub(crate) fn waits_for_display(&self) -> bool {
        self.swapchain.as_ref().is_some_and(|s| s.waits)
    }

    /// Draws the interface and presents it. Returns once the device has finished. Removes from `textures` the
    /// texture updates that were uploaded.
    ///
    /// # Errors
    /// When the device fails. A surface that has changed meanwhile is no error (see [`Presented::shown`]).
    pub(crate) fn show(
        &mut self,
        pixels_per_point: f32,
        primitives: &[ClippedPrimitive],
        textures: &mut TexturesDelta,
    ) -> Result<Presented> {
        let mut presented = Presented::default();
        let (Some(egui), Some(swapchain)) = (&mut self.egui, &mut self.swapchain) else {
            return Ok(presented);
        };
        let device = &self.device;
        // An update stays in `textures.set` until it is uploaded, since egui sends each update only once.
        while let Some(&id) = textures.set.keys().next() {
            for delta in textures.set.get(&id).into_iter().flatten() {
                device
                    .with_queue(|queue| egui.set_texture(queue, self.pool, id, delta))
                    .map_err(|e| drawing(device, &e))?;
            }
            textures.set.remove(&id);
        }
        let begin = Instant::now();
        let acquired = swapchain.acquire(LONGEST_WAIT)?;
        presented.display += begin.elapsed().as_secs_f64();
        if let Some(index) = acquired {
            let begin = Instant::now();
            presented.handing = self.draw(index, pixels_per_point, primitives)?;
            presented.device = begin.elapsed().as_secs_f64();
            presented.shown = true;
        }
        if let Some(egui) = &mut self.egui {
            for id in textures.free.drain() {
                egui.free_texture(id).map_err(|e| drawing(&self.device, &e))?;
            }
        }
        Ok(presented)
    }

    /// Records and submits the commands, presents the image and waits for the device. Returns
    /// [`Presented::handing`].
    fn draw(&mut self, index: u32, pixels_per_point: f32, primitives: &[ClippedPrimitive]) -> Result<f64> {
        let submitted = self.submit(index, pixels_per_point, primitives);
        if let Err(error) = submitted {
            let d = self.device.device();
            // If the call fails, the next frame fails too, when it begins the command buffer.
            // SAFETY: the command buffer was not submitted, so the device does not use it.
            let _ = unsafe { d.reset_command_buffer(self.commands, vk::CommandBufferResetFlags::empty()) };
            // The image stays acquired and its semaphore signaled. The next frame makes a new swapchain.
            self.swapchain = None;
            return Err(error);
        }
        let Some(swapchain) = &mut self.swapchain else { return Ok(0.0) };
        let cpu = thread_seconds();
        let done = swapchain.present(index);
        let handing = thread_seconds() - cpu;
        self.pending = true;
        self.wait(LONGEST_WAIT)?;
        // An error of the presentation is returned only after the fence is reset, since the next frame needs
        // an unsignaled fence. The image may stay acquired, so the swapchain ends here too.
        if done.is_err() {
            self.swapchain = None;
        }
        done.map(|()| handing)
    }

    /// Waits for the end of the submitted frame, if there is one, for at most `longest` nanoseconds.
    fn wait(&mut self, longest: u64) -> Result<()> {
        if !self.pending {
            return Ok(());
        }
        let device = &self.device;
        let failed = |call: &'static str| move |r| device.error(call, r);
        let d = device.device();
        // SAFETY: the fence was submitted, and it is reset only after it has signaled.
        unsafe {
            d.wait_for_fences(&[self.fence], true, longest).map_err(failed("vkWaitForFences"))?;
            d.reset_fences(&[self.fence]).map_err(failed("vkResetFences"))?;
        }
        self.pending = false;
        Ok(())
    }

    /// Records and submits the commands that draw into an acquired image.
    fn submit(&mut self, index: u32, pixels_per_point: f32, primitives: &[ClippedPrimitive]) -> Result<()> {
        let (Some(egui), Some(swapchain)) = (&mut self.egui, &self.swapchain) else { return Ok(()) };
        let device = &self.device;
        let failed = |call: &'static str| move |r| device.error(call, r);
        let d = device.device();
        let extent = swapchain.extent;
        // SAFETY: the device has finished the previous frame, whose fence was waited for. The command buffer,
        // the framebuffer and the render pass are alive, and all commands are recorded between begin and end.
        unsafe {
            let begin =
                vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
            d.begin_command_buffer(self.commands, &begin).map_err(failed("vkBeginCommandBuffer"))?;
            let clear = [vk::ClearValue { color: vk::ClearColorValue { float32: [0.0, 0.0, 0.0, 1.0] } }];
            let pass = vk::RenderPassBeginInfo::default()
                .render_pass(swapchain.render_pass)
                .framebuffer(swapchain.framebuffer(index))
                .render_area(vk::Rect2D { offset: vk::Offset2D::default(), extent })
                .clear_values(&clear);
            d.cmd_begin_render_pass(self.commands, &pass, vk::SubpassContents::INLINE);
        }
        egui.cmd_draw(self.commands, extent, pixels_per_point, primitives)
            .map_err(|e| drawing(device, &e))?;
        let (waits, stages) = ([swapchain.acquired], [vk::PipelineStageFlags::COLOR_ATTACHMENT_OUTPUT]);
        let (buffers, signals) = ([self.commands], [swapchain.drawn(index)]);
        let submit = [vk::SubmitInfo::default()
            .wait_semaphores(&waits)
            .wait_dst_stage_mask(&stages)
            .command_buffers(&buffers)
            .signal_semaphores(&signals)];
        // SAFETY: the command buffer is being recorded, the queue is locked during the call, the semaphores
        // belong to this frame, and the fence is unsignaled.
        unsafe {
            d.cmd_end_render_pass(self.commands);
            d.end_command_buffer(self.commands).map_err(failed("vkEndCommandBuffer"))?;
            device
                .with_queue(|queue| d.queue_submit(queue, &submit, self.fence))
                .map_err(failed("vkQueueSubmit"))?;
        }
        Ok(())
    }
}

/// Converts an error of the interface's renderer.
fn drawing(device: &SharedDevice, e: &RendererError) -> anyhow::Error {
    match e {
        RendererError::Vulkan(result) => device.error("drawing the interface", *result).into(),
        other => anyhow!("the interface cannot be drawn on {}: {other}", device.name()),
    }
}

impl Drop for Presenter {
    fn drop(&mut self) {
        // A hanging device may still use the objects, and a wait for its queue might never return.
        if self.device.is_abandoned() || self.device.is_hanging() {
            std::mem::forget((self.egui.take(), self.swapchain.take(), self.device.clone()));
            return;
        }
        let d = self.device.device();
        // If the call fails, the device is lost and runs nothing.
        // SAFETY: the queue belongs to this device and is locked during the call.
        let _ = self.device.with_queue(|queue| unsafe { d.queue_wait_idle(queue) });
        self.egui = None;
        self.swapchain = None;
        // SAFETY: every object was made from this device and instance, is not in use, and is destroyed once.
        // Null handles are ignored.
        unsafe {
            d.destroy_descriptor_pool(self.descriptors, None);
            d.destroy_descriptor_set_layout(self.set_layout, None);
            d.destroy_sampler(self.sampler, None);
            d.destroy_fence(self.fence, None);
            d.destroy_command_pool(self.pool, None);
            self.surface_functions.destroy_surface(self.surface, None);
        }
    }
}
