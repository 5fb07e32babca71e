//! Executes recordings on a device: owns the device's resources and tracks the submissions.

mod play;
mod waiting;

use super::gpu::{Gpu, NamedCall};
use super::picture::Region;
use super::recording::{Command, IMAGE_BYTES, Target, WORK_BYTES, record_slices};
use super::resources::{Buffer, Image, Owned, Shape, owned};
use crate::error::{Error, Result};
use crate::setup::FrameSetup;
use ash::vk::{self, DescriptorType, WriteDescriptorSet};
use gpu_allocator::MemoryLocation;
use std::collections::HashMap;
use std::sync::Arc;

/// All compiled variants of the shader. The six numbers are shading, skipping, fetch, counting, packets and
/// bricks; the bytes are SPIR-V.
static SHADERS: &[([u32; 6], &[u8])] = &include!(concat!(env!("OUT_DIR"), "/shaders.rs"));

/// Size of a staging buffer, in bytes, unless one slice needs more.
const STAGING_BYTES: u64 = 64 << 20;

/// Largest size of a table's texels, in bytes: the limit of `vkCmdUpdateBuffer`.
const TABLE_BYTES: u64 = 65536;

/// Size of a ray's state between two dispatches, in bytes per pixel.
pub(crate) const STATE_BYTES: u64 = 32;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct ShaderKey {
    /// 1 for local lighting, plus 2 for shadow rays.
    pub(crate) shading: u32,
    pub(crate) skipping: u32,
    pub(crate) fetch: u32,
    pub(crate) counting: u32,
    pub(crate) packets: u32,
    pub(crate) bricks: u32,
}

/// Maximum number of textures that a volume may be cut into.
pub(crate) const MAX_BRICKS: usize = 64;

/// A tile whose rays are to be cast.
pub(crate) struct Cast<'a> {
    /// Name of the pass in error messages.
    pub(crate) pass: &'a str,
    pub(crate) key: ShaderKey,
    pub(crate) tile: Region,
    /// True if the tile's rays are cast in several dispatches.
    pub(crate) windowed: bool,
    /// Index of the brick that is sampled.
    pub(crate) brick: usize,
}

/// Pipeline and descriptors of a dispatch.
type Shader = (vk::Pipeline, vk::DescriptorSet);

/// A finished tile.
pub(crate) struct CastTile<'a> {
    /// Time between the timestamps around the dispatch, in seconds.
    pub(crate) seconds: Option<f64>,
    pub(crate) image: &'a [u8],
    /// Bytes of the work counts; empty if the work was not counted.
    pub(crate) work: &'a [u8],
}

/// Buffers whose size depends on the tile.
struct TileBuffers {
    pixels: u64,
    windowed: bool,
    image: Buffer,
    work: Option<Buffer>,
    state: Buffer,
    read_back: Buffer,
}

/// The device's resources. One submission runs at a time.
pub(crate) struct Engine {
    gpu: Arc<Gpu>,
    pipelines: HashMap<ShaderKey, Owned<vk::Pipeline>>,
    pipeline_layout: Owned<vk::PipelineLayout>,
    set_layout: Owned<vk::DescriptorSetLayout>,
    sampler: Owned<vk::Sampler>,
    descriptors: Owned<vk::DescriptorPool>,
    /// The descriptor sets made so far, one per brick. Each has all resources of a dispatch.
    sets: HashMap<usize, vk::DescriptorSet>,
    pool: Owned<vk::CommandPool>,
    commands: vk::CommandBuffer,
    fence: Owned<vk::Fence>,
    queries: Option<Owned<vk::QueryPool>>,
    setup: Buffer,
    table_staging: Buffer,
    tile: Option<TileBuffers>,
    images: HashMap<Target, Image>,
    staging: Option<Buffer>,
    /// True if the fence was submitted and not reset since: nothing is freed or submitted before the engine
    /// has waited for the fence.
    pending: bool,
    /// True from the time at which a submission exceeds its time limit until it ends: meanwhile, the engine
    /// polls the device instead of waiting.
    hangs: bool,
}

impl Engine {
    pub(crate) fn new(gpu: Arc<Gpu>) -> Result<Self> {
        let binding = |i: u32, kind| {
            vk::DescriptorSetLayoutBinding::default()
                .binding(i)
                .descriptor_type(kind)
                .descriptor_count(1)
                .stage_flags(vk::ShaderStageFlags::COMPUTE)
        };
        let bindings = [
            // A storage buffer, not a uniform buffer: lavapipe recompiles the shader for every set of uniform
            // values that affects the control flow, which takes about 60 ms for every camera.
            binding(0, DescriptorType::STORAGE_BUFFER),
            binding(1, DescriptorType::SAMPLED_IMAGE),
            binding(2, DescriptorType::SAMPLED_IMAGE),
            binding(3, DescriptorType::SAMPLER),
            binding(4, DescriptorType::SAMPLED_IMAGE),
            binding(5, DescriptorType::STORAGE_BUFFER),
            binding(6, DescriptorType::STORAGE_BUFFER),
            binding(7, DescriptorType::STORAGE_IMAGE),
            binding(8, DescriptorType::STORAGE_IMAGE),
            binding(9, DescriptorType::STORAGE_IMAGE),
            binding(10, DescriptorType::STORAGE_BUFFER),
        ];
        let info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
        let set_layout = owned!(
            &gpu,
            create_descriptor_set_layout(&info),
            destroy_descriptor_set_layout,
            "vkCreateDescriptorSetLayout"
        )?;
        let layouts = [set_layout.get()];
        let info = vk::PipelineLayoutCreateInfo::default().set_layouts(&layouts);
        let pipeline_layout =
            owned!(&gpu, create_pipeline_layout(&info), destroy_pipeline_layout, "vkCreatePipelineLayout")?;
        let info = vk::SamplerCreateInfo::default()
            .mag_filter(vk::Filter::LINEAR)
            .min_filter(vk::Filter::LINEAR)
            .address_mode_u(vk::SamplerAddressMode::CLAMP_TO_EDGE)
            .address_mode_v(vk::SamplerAddressMode::CLAMP_TO_EDGE)
            .address_mode_w(vk::SamplerAddressMode::CLAMP_TO_EDGE);
        let sampler = owned!(&gpu, create_sampler(&info), destroy_sampler, "vkCreateSampler")?;
        let size =
            |kind, count| vk::DescriptorPoolSize { ty: kind, descriptor_count: MAX_BRICKS as u32 * count };
        let sizes = [
            size(DescriptorType::SAMPLED_IMAGE, 3),
            size(DescriptorType::SAMPLER, 1),
            size(DescriptorType::STORAGE_BUFFER, 4),
            size(DescriptorType::STORAGE_IMAGE, 3),
        ];
        let info = vk::DescriptorPoolCreateInfo::default().max_sets(MAX_BRICKS as u32).pool_sizes(&sizes);
        let descriptors =
            owned!(&gpu, create_descriptor_pool(&info), destroy_descriptor_pool, "vkCreateDescriptorPool")?;
        let info = vk::CommandPoolCreateInfo::default()
            .queue_family_index(gpu.family)
            .flags(vk::CommandPoolCreateFlags::TRANSIENT);
        let pool = owned!(&gpu, create_command_pool(&info), destroy_command_pool, "vkCreateCommandPool")?;
        let info = vk::CommandBufferAllocateInfo::default()
            .command_pool(pool.get())
            .level(vk::CommandBufferLevel::PRIMARY)
            .command_buffer_count(1);
        // SAFETY: the command pool was made above and is alive.
        let commands =
            unsafe { gpu.device.allocate_command_buffers(&info) }.on(&gpu, "vkAllocateCommandBuffers")?[0];
        let info = vk::FenceCreateInfo::default();
        let fence = owned!(&gpu, create_fence(&info), destroy_fence, "vkCreateFence")?;
        let queries = if gpu.timestamps.is_some() {
            let info = vk::QueryPoolCreateInfo::default().query_type(vk::QueryType::TIMESTAMP).query_count(2);
            Some(owned!(&gpu, create_query_pool(&info), destroy_query_pool, "vkCreateQueryPool")?)
        } else {
            None
        };
        let on_device = |name, bytes, usage: vk::BufferUsageFlags| {
            let usage = usage | vk::BufferUsageFlags::TRANSFER_DST;
            Buffer::new(&gpu, name, bytes, usage, MemoryLocation::GpuOnly)
        };
        let setup_bytes = size_of::<FrameSetup>() as u64;
        let setup = on_device("frame setup", setup_bytes, vk::BufferUsageFlags::STORAGE_BUFFER)?;
        let table_staging =
            on_device("transfer table staging", TABLE_BYTES, vk::BufferUsageFlags::TRANSFER_SRC)?;
        Ok(Self {
            pipelines: HashMap::new(),
            pipeline_layout,
            set_layout,
            sampler,
            descriptors,
            sets: HashMap::new(),
            pool,
            commands,
            fence,
            queries,
            setup,
            table_staging,
            tile: None,
            images: HashMap::new(),
            staging: None,
            pending: false,
            hangs: false,
            gpu,
        })
    }

    pub(crate) fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Makes the image for `target`, unless it exists with this shape. Its contents are undefined. No
    /// submission may be running.
    pub(crate) fn reserve(&mut self, target: Target, shape: Shape) -> Result<()> {
        if self.image(target).is_ok_and(|i| i.shape == shape) {
            return Ok(());
        }
        self.sets.clear();
        let name = match target {
            Target::Volume(_) => "volume texture",
            Target::SkipMap => "skip map",
            Target::Table => "transfer table",
        };
        // The old image is freed first: the device's memory may not hold both.
        if let Target::Volume(brick) = target {
            self.keep_bricks(brick);
        }
        self.images.remove(&target);
        let [x, y, z] = shape.extent;
        let image = Image::new(&self.gpu, name, shape)
            .map_err(|e| Error::new(format!("the {name} of {x} x {y} x {z} texels does not fit: {e}")))?;
        self.images.insert(target, image);
        Ok(())
    }

    /// Frees all textures of the volume except the first `bricks`. No submission may be running.
    pub(crate) fn keep_bricks(&mut self, bricks: usize) {
        let more = |target: &Target| matches!(target, Target::Volume(brick) if *brick >= bricks);
        if self.images.keys().any(more) {
            self.sets.clear();
            self.images.retain(|target, _| !more(target));
        }
    }

    /// Fills a reserved image, several slices at a time: `fill` gets the index of the first of these slices,
    /// and the bytes to write.
    pub(crate) fn copy_slices(&mut self, target: Target, fill: impl Fn(usize, &mut [u8])) -> Result<()> {
        self.drain()?;
        let image = self.image(target)?;
        let (depth, texels) = image.shape.slices();
        let slice = texels * texel_bytes(image.shape.format);
        let per_copy = (STAGING_BYTES / slice).clamp(1, u64::from(depth)) as u32;
        if self.staging.as_ref().is_none_or(|s| s.size() < slice * u64::from(per_copy)) {
            self.staging = None;
            self.staging = Some(Buffer::new(
                &self.gpu,
                "staging buffer",
                slice * u64::from(per_copy),
                vk::BufferUsageFlags::TRANSFER_SRC,
                MemoryLocation::CpuToGpu,
            )?);
        }
        let mut first = 0;
        while first < depth {
            let slices = per_copy.min(depth - first);
            if let Some(staging) = &mut self.staging {
                fill(first as usize, &mut staging.bytes_mut()?[..(slice * u64::from(slices)) as usize]);
            }
            self.run("copy to the device", None, &record_slices(target, depth, first, slices))?;
            first += slices;
        }
        // A large staging buffer is not kept for later small uses.
        if self.staging.as_ref().is_some_and(|s| s.size() > STAGING_BYTES / 8) {
            self.staging = None;
        }
        Ok(())
    }

    pub(crate) fn has_pipeline(&self, key: ShaderKey) -> bool {
        self.pipelines.contains_key(&key)
    }

    /// Casts the rays of a tile and waits for the result.
    pub(crate) fn cast(&mut self, cast: &Cast<'_>, commands: &[Command]) -> Result<CastTile<'_>> {
        self.drain()?;
        let pixels = cast.tile.pixels();
        let counting = cast.key.counting != 0;
        self.reserve_tile(pixels, counting, cast.windowed)?;
        self.prepare_pipeline(cast.key)?;
        let set = self.prepare_set(cast.brick)?;
        let shader = self.pipelines.get(&cast.key).map(|p| (p.get(), set));
        self.run(cast.pass, shader, commands)?;
        let seconds = self.read_seconds()?;
        let Some(buffers) = &self.tile else { return Err(Error::new("no tile buffers")) };
        let bytes = buffers.read_back.bytes()?;
        let image_bytes = (pixels * IMAGE_BYTES) as usize;
        let work_bytes = if counting { (pixels * WORK_BYTES) as usize } else { 0 };
        let (image, rest) = bytes.split_at(image_bytes);
        Ok(CastTile { seconds, image, work: &rest[..work_bytes] })
    }

    fn reserve_tile(&mut self, pixels: u64, counting: bool, windowed: bool) -> Result<()> {
        let fits =
            |t: &TileBuffers| t.pixels >= pixels && t.work.is_some() >= counting && t.windowed >= windowed;
        if self.tile.as_ref().is_some_and(fits) {
            return Ok(());
        }
        self.sets.clear();
        self.tile = None;
        let storage = vk::BufferUsageFlags::STORAGE_BUFFER | vk::BufferUsageFlags::TRANSFER_SRC;
        let make = |name, bytes| Buffer::new(&self.gpu, name, bytes, storage, MemoryLocation::GpuOnly);
        let image = make("image buffer", pixels * IMAGE_BYTES)?;
        let work = if counting { Some(make("work counts", pixels * WORK_BYTES)?) } else { None };
        let state = make("ray states", if windowed { pixels * STATE_BYTES } else { STATE_BYTES })?;
        let read_back = Buffer::new(
            &self.gpu,
            "read-back buffer",
            pixels * (IMAGE_BYTES + if counting { WORK_BYTES } else { 0 }),
            vk::BufferUsageFlags::TRANSFER_DST,
            MemoryLocation::GpuToCpu,
        )?;
        self.tile = Some(TileBuffers { pixels, windowed, image, work, state, read_back });
        Ok(())
    }

    fn prepare_pipeline(&mut self, key: ShaderKey) -> Result<()> {
        if self.has_pipeline(key) {
            return Ok(());
        }
        let wanted = [key.shading, key.skipping, key.fetch, key.counting, key.packets, key.bricks];
        let Some((_, bytes)) = SHADERS.iter().find(|(k, _)| *k == wanted) else {
            return Err(Error::new(format!("there is no shader for {key:?}")));
        };
        let words: Vec<u32> =
            bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        let info = vk::ShaderModuleCreateInfo::default().code(&words);
        // `words` is a whole SPIR-V module, which the build script has compiled.
        let module =
            owned!(&self.gpu, create_shader_module(&info), destroy_shader_module, "vkCreateShaderModule")?;
        let stage = vk::PipelineShaderStageCreateInfo::default()
            .stage(vk::ShaderStageFlags::COMPUTE)
            .module(module.get())
            .name(c"main");
        let info = vk::ComputePipelineCreateInfo::default().stage(stage).layout(self.pipeline_layout.get());
        // SAFETY: module and layout are alive, and the module's entry point `main` uses the bindings of the
        // layout.
        let made =
            unsafe { self.gpu.device.create_compute_pipelines(vk::PipelineCache::null(), &[info], None) };
        let handle = made.map_err(|(_, r)| r).on(&self.gpu, "vkCreateComputePipelines")?[0];
        let pipeline = Owned::new(&self.gpu, handle, |d, h| {
            // SAFETY: `Owned` calls this once, when the device no longer uses the handle.
            unsafe { d.destroy_pipeline(h, None) }
        });
        self.pipelines.insert(key, pipeline);
        Ok(())
    }

    /// Returns the descriptor set of casts for a brick; makes it from the current resources if it does not
    /// exist. Sets are never rewritten: some drivers read every descriptor of a set, including those that the
    /// shader does not use and whose resources are freed.
    fn prepare_set(&mut self, brick: usize) -> Result<vk::DescriptorSet> {
        if let Some(set) = self.sets.get(&brick) {
            return Ok(*set);
        }
        let device = &self.gpu.device;
        let pool = self.descriptors.get();
        if self.sets.is_empty() {
            // SAFETY: the device does not use the pool's sets: the last submission was waited for.
            unsafe { device.reset_descriptor_pool(pool, vk::DescriptorPoolResetFlags::empty()) }
                .on(&self.gpu, "vkResetDescriptorPool")?;
        }
        let layouts = [self.set_layout.get()];
        let info = vk::DescriptorSetAllocateInfo::default().descriptor_pool(pool).set_layouts(&layouts);
        // SAFETY: the pool has room for one set per brick, and each brick gets one.
        let set =
            unsafe { device.allocate_descriptor_sets(&info) }.on(&self.gpu, "vkAllocateDescriptorSets")?[0];
        let write = |binding, kind, resource: WriteDescriptorSet<'_>| {
            let write = resource.dst_set(set).dst_binding(binding).descriptor_type(kind);
            // SAFETY: the set is new, so the device does not use it, and the resource is alive.
            unsafe { device.update_descriptor_sets(&[write], &[]) };
        };
        let write_buffer = |binding, buffer: &Buffer| {
            let info = [vk::DescriptorBufferInfo::default().buffer(buffer.get()).range(vk::WHOLE_SIZE)];
            write(binding, DescriptorType::STORAGE_BUFFER, WriteDescriptorSet::default().buffer_info(&info));
        };
        write_buffer(0, &self.setup);
        if let Some(tile) = &self.tile {
            write_buffer(5, &tile.image);
            write_buffer(10, &tile.state);
            if let Some(work) = &tile.work {
                write_buffer(6, work);
            }
        }
        let sampler = [vk::DescriptorImageInfo::default().sampler(self.sampler.get())];
        write(3, DescriptorType::SAMPLER, WriteDescriptorSet::default().image_info(&sampler));
        // Each image, its binding as a sampled image, and its binding as a storage image.
        let targets = [(Target::Table, 1, 7), (Target::Volume(brick), 2, 8), (Target::SkipMap, 4, 9)];
        for (target, sampled, storage) in targets {
            let Some(image) = self.images.get(&target) else { continue };
            let info =
                [vk::DescriptorImageInfo::default().image_view(image.view()).image_layout(image.layout())];
            let (binding, kind) = if image.shape.storage {
                (storage, DescriptorType::STORAGE_IMAGE)
            } else {
                (sampled, DescriptorType::SAMPLED_IMAGE)
            };
            write(binding, kind, WriteDescriptorSet::default().image_info(&info));
        }
        self.sets.insert(brick, set);
        Ok(set)
    }

    /// Submits a recording and waits for its end.
    fn run(&mut self, pass: &str, shader: Option<Shader>, commands: &[Command]) -> Result<()> {
        self.submit(shader, commands).map_err(|e| with_pass(&e, pass))?;
        self.pending = true;
        self.wait(pass)
    }
}

/// Returns an error with the name of the device's last pass.
fn with_pass(e: &Error, pass: &str) -> Error {
    Error::new(format!("{e} (last pass: {pass})"))
}

pub(crate) fn texel_bytes(format: vk::Format) -> u64 {
    match format {
        vk::Format::R8_UNORM | vk::Format::R8_UINT => 1,
        vk::Format::R16_UNORM => 2,
        vk::Format::R32G32B32A32_SFLOAT | vk::Format::R32G32B32A32_UINT => 16,
        _ => 4,
    }
}
