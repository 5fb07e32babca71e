//! Translation of a recording to a command buffer: one Vulkan call, or a few, for each command.

use super::{Engine, Shader};
use crate::error::{Error, Result};
use crate::vulkan::gpu::{NamedCall, seconds_between};
use crate::vulkan::recording::{Command, Hazard, Target};
use crate::vulkan::resources::{Buffer, COLOR_RANGE, Image, Shape};
use ash::vk;

impl Engine {
    pub(super) fn submit(&self, shader: Option<Shader>, commands: &[Command]) -> Result<()> {
        let device = &self.gpu.device;
        // SAFETY: the device does not use the pool's one command buffer: the last submission was waited for.
        unsafe { device.reset_command_pool(self.pool.get(), vk::CommandPoolResetFlags::empty()) }
            .on(&self.gpu, "vkResetCommandPool")?;
        let begin = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: resetting its pool has put the command buffer into its initial state.
        unsafe { device.begin_command_buffer(self.commands, &begin) }
            .on(&self.gpu, "vkBeginCommandBuffer")?;
        for command in commands {
            self.play(shader, command)?;
        }
        // SAFETY: the command buffer is being recorded since `begin_command_buffer`.
        unsafe { device.end_command_buffer(self.commands) }.on(&self.gpu, "vkEndCommandBuffer")?;
        let buffers = [self.commands];
        let submit = [vk::SubmitInfo::default().command_buffers(&buffers)];
        // SAFETY: the command buffer is complete, everything that it uses lives until the fence has signaled,
        // the fence is unsignaled, and the lock keeps other threads from the queue.
        unsafe { device.queue_submit(*self.gpu.queue(), &submit, self.fence.get()) }
            .on(&self.gpu, "vkQueueSubmit")
    }

    pub(super) fn image(&self, target: Target) -> Result<&Image> {
        self.images.get(&target).ok_or_else(|| Error::new("an image that a command names was not reserved"))
    }

    fn play(&self, shader: Option<Shader>, command: &Command) -> Result<()> {
        let device = &self.gpu.device;
        let commands = self.commands;
        // SAFETY: the command buffer is being recorded. Every resource that a command names belongs to this
        // engine and lives until the submission was waited for. All ranges lie inside their buffers and
        // images, since these were reserved with the same tile and image sizes from which recordings are
        // made.
        unsafe {
            let copy = |from: &Buffer, to, region| {
                device.cmd_copy_buffer_to_image(commands, from.get(), to, FILL_LAYOUT, &[region]);
            };
            match command {
                Command::WriteSetup(setup) => {
                    device.cmd_update_buffer(commands, self.setup.get(), 0, bytemuck::bytes_of(&**setup));
                }
                Command::WriteTable(table) => {
                    device.cmd_update_buffer(commands, self.table_staging.get(), 0, table);
                }
                Command::PrepareCopy { target, keep } => {
                    let old = if *keep { FILL_LAYOUT } else { vk::ImageLayout::UNDEFINED };
                    let earlier = (vk::PipelineStageFlags::COMPUTE_SHADER | WRITE_ACCESS.0, WRITE_ACCESS.1);
                    self.layout_barrier(self.image(*target)?.get(), old, FILL_LAYOUT, earlier, WRITE_ACCESS);
                }
                Command::FinishCopy { target } => {
                    let image = self.image(*target)?;
                    let read = (vk::PipelineStageFlags::COMPUTE_SHADER, vk::AccessFlags::SHADER_READ);
                    self.layout_barrier(image.get(), FILL_LAYOUT, image.layout(), WRITE_ACCESS, read);
                }
                Command::CopySlices { target, first_slice, slices } => {
                    let image = self.image(*target)?;
                    let Some(staging) = &self.staging else {
                        return Err(Error::new("the commands copy from a staging buffer, but there is none"));
                    };
                    copy(staging, image.get(), copy_region(&image.shape, *first_slice, *slices));
                }
                Command::CopyTable => {
                    let image = self.image(Target::Table)?;
                    let region = copy_region(&image.shape, 0, image.shape.slices().0);
                    copy(&self.table_staging, image.get(), region);
                }
                Command::BufferBarrier(hazard) => {
                    let (source, target) = barrier_masks(*hazard);
                    let barrier =
                        [vk::MemoryBarrier::default().src_access_mask(source.1).dst_access_mask(target.1)];
                    let flags = vk::DependencyFlags::empty();
                    device.cmd_pipeline_barrier(commands, source.0, target.0, flags, &barrier, &[], &[]);
                }
                Command::ResetTimestamps => {
                    if let Some(queries) = &self.queries {
                        device.cmd_reset_query_pool(commands, queries.get(), 0, 2);
                    }
                }
                Command::Timestamp(index) => {
                    if let Some(queries) = &self.queries {
                        // At the bottom of the pipeline, a timestamp is written once all earlier work is
                        // done.
                        let stage = vk::PipelineStageFlags::BOTTOM_OF_PIPE;
                        device.cmd_write_timestamp(commands, stage, queries.get(), *index);
                    }
                }
                Command::Dispatch { groups } => {
                    let Some((pipeline, set)) = shader else {
                        return Err(Error::new("the commands dispatch a shader before they bind a pipeline"));
                    };
                    let (point, layout) = (vk::PipelineBindPoint::COMPUTE, self.pipeline_layout.get());
                    device.cmd_bind_pipeline(commands, point, pipeline);
                    device.cmd_bind_descriptor_sets(commands, point, layout, 0, &[set], &[]);
                    device.cmd_dispatch(commands, groups[0], groups[1], 1);
                }
                Command::CopyToPicture { image, fresh, tile: at } => {
                    let Some(tile) = &self.tile else {
                        return Err(Error::new(
                            "the commands copy a tile to a picture, but there are no tile buffers",
                        ));
                    };
                    let shown = vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL;
                    // A viewer samples the picture in a fragment shader. A queue without graphics lacks this
                    // stage, so the barriers name all stages.
                    let readers = vk::PipelineStageFlags::ALL_COMMANDS;
                    let old = if *fresh { vk::ImageLayout::UNDEFINED } else { shown };
                    self.layout_barrier(*image, old, FILL_LAYOUT, (readers, WRITE_ACCESS.1), WRITE_ACCESS);
                    let region = vk::BufferImageCopy::default()
                        .image_subresource(COLOR_LAYER)
                        .image_offset(vk::Offset3D { x: at.x as i32, y: at.y as i32, z: 0 })
                        .image_extent(vk::Extent3D { width: at.width, height: at.height, depth: 1 });
                    copy(&tile.image, *image, region);
                    self.layout_barrier(
                        *image,
                        FILL_LAYOUT,
                        shown,
                        WRITE_ACCESS,
                        (readers, vk::AccessFlags::SHADER_READ),
                    );
                }
                Command::ReadBack { image_bytes, work_bytes } => {
                    let Some(tile) = &self.tile else {
                        return Err(Error::new(
                            "the commands read a tile back, but there are no tile buffers",
                        ));
                    };
                    let region = [vk::BufferCopy { src_offset: 0, dst_offset: 0, size: *image_bytes }];
                    device.cmd_copy_buffer(commands, tile.image.get(), tile.read_back.get(), &region);
                    if let (Some(work), 1..) = (&tile.work, *work_bytes) {
                        let region =
                            [vk::BufferCopy { src_offset: 0, dst_offset: *image_bytes, size: *work_bytes }];
                        device.cmd_copy_buffer(commands, work.get(), tile.read_back.get(), &region);
                    }
                }
            }
        }
        Ok(())
    }

    /// Records a layout change of an image of one level and layer.
    ///
    /// # Safety
    /// The command buffer is being recorded, and `old` is the image's layout at that point (or undefined).
    unsafe fn layout_barrier(
        &self,
        image: vk::Image,
        old: vk::ImageLayout,
        new: vk::ImageLayout,
        source: Access,
        target: Access,
    ) {
        let barrier = [vk::ImageMemoryBarrier::default()
            .image(image)
            .old_layout(old)
            .new_layout(new)
            .src_access_mask(source.1)
            .dst_access_mask(target.1)
            .src_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
            .dst_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
            .subresource_range(COLOR_RANGE)];
        let (device, commands, flags) = (&self.gpu.device, self.commands, vk::DependencyFlags::empty());
        // SAFETY: the caller guarantees that the command buffer is being recorded, and that `old` is the
        // image's layout or undefined.
        unsafe { device.cmd_pipeline_barrier(commands, source.0, target.0, flags, &[], &[], &barrier) };
    }

    /// Returns the seconds between the two timestamps of the last cast, or `None` without timestamps.
    pub(super) fn read_seconds(&self) -> Result<Option<f64>> {
        let (Some(queries), Some(clock)) = (&self.queries, self.gpu.timestamps) else {
            return Ok(None);
        };
        let mut ticks = [0u64; 2];
        let flags = vk::QueryResultFlags::TYPE_64;
        // SAFETY: the submission that wrote both queries was waited for, so both results are available.
        unsafe { self.gpu.device.get_query_pool_results(queries.get(), 0, &mut ticks, flags) }
            .on(&self.gpu, "vkGetQueryPoolResults")?;
        Ok(Some(seconds_between(clock, ticks[0], ticks[1])))
    }
}

/// The one mip level and layer of an image, for copies.
const COLOR_LAYER: vk::ImageSubresourceLayers = vk::ImageSubresourceLayers {
    aspect_mask: vk::ImageAspectFlags::COLOR,
    mip_level: 0,
    base_array_layer: 0,
    layer_count: 1,
};

/// Returns the region of `count` slices (of a 2-D image: rows) from `first` on.
fn copy_region(shape: &Shape, first: u32, count: u32) -> vk::BufferImageCopy {
    let [width, height, _] = shape.extent;
    let (y, z, height, depth) =
        if shape.is_flat() { (first, 0, count, 1) } else { (0, first, height, count) };
    vk::BufferImageCopy::default()
        .image_subresource(COLOR_LAYER)
        .image_offset(vk::Offset3D { x: 0, y: y as i32, z: z as i32 })
        .image_extent(vk::Extent3D { width, height, depth })
}

type Access = (vk::PipelineStageFlags, vk::AccessFlags);

/// Layout of an image while copies fill it.
const FILL_LAYOUT: vk::ImageLayout = vk::ImageLayout::TRANSFER_DST_OPTIMAL;
/// Access of a transfer that writes.
const WRITE_ACCESS: Access = (vk::PipelineStageFlags::TRANSFER, vk::AccessFlags::TRANSFER_WRITE);

fn barrier_masks(hazard: Hazard) -> (Access, Access) {
    let transfer = (vk::PipelineStageFlags::TRANSFER, vk::AccessFlags::TRANSFER_READ);
    let shader = vk::PipelineStageFlags::COMPUTE_SHADER;
    match hazard {
        Hazard::TransferToTransfer => (WRITE_ACCESS, transfer),
        Hazard::TransferToShader => (WRITE_ACCESS, (shader, vk::AccessFlags::SHADER_READ)),
        Hazard::ShaderToTransfer => ((shader, vk::AccessFlags::SHADER_WRITE), transfer),
        Hazard::TransferToHost => (WRITE_ACCESS, (vk::PipelineStageFlags::HOST, vk::AccessFlags::HOST_READ)),
    }
}
