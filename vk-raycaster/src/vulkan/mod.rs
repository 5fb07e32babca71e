//! The ray caster on Vulkan.

mod cast;
#[allow(unsafe_code, reason = "calls into Vulkan")]
mod engine;
#[allow(unsafe_code, reason = "calls into Vulkan")]
mod gpu;
#[allow(unsafe_code, reason = "calls into Vulkan")]
mod picture;
mod recording;
#[allow(unsafe_code, reason = "calls into Vulkan")]
mod resources;
mod shared;
mod upload;

use crate::blocks::{BlockMap, SkipMap};
use crate::clock::Stopwatch;
use crate::error::{Error, Result};
use crate::renderer::{DeviceLimits, Preparation, Rendered, Renderer, WorkCounts};
use crate::setup::{FrameSetup, NO_SAMPLE, check};
use crate::table::Classifier;
use crate::voxels::{Geometry, PreparedVolume};
use engine::{Engine, STATE_BYTES, ShaderKey};
use entire_core::scene::{Frame, Shading, Skipping, TransferTable, VolumeView};
use gpu::{Gpu, WrapDevice};
pub use picture::{Picture, Region};
use recording::{Target, WORK_BYTES};
use resources::Shape;
pub use shared::SharedDevice;
use std::ffi::CString;
use std::ops::RangeInclusive;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;
use upload::Brick;

/// Time of a dispatch, in seconds, above which the tiles of its shading mode shrink from the next frame on.
/// Tiles on software devices do not shrink unless the options set their size. Such a device gives each thread
/// an equal part of the dispatch's workgroups, in order. The shader spreads the rows of a large tile over all
/// threads (`dealt`), but a tile with few rows and all its work in one half occupies only half of the
/// threads.
const LONG_DISPATCH_SECONDS: f64 = 0.5;

/// Largest number of loop iterations of an invocation on a software device. llvmpipe ends loops after 65535
/// iterations, so longer rays are cast in several dispatches.
const LOOP_LIMIT: f64 = 60_000.0;

/// Largest edge of tiles on a GPU, in pixels.
const LARGEST_TILE: u32 = 1024;

/// Largest edge of tiles on a software device, in pixels.
const LARGEST_TILE_SOFTWARE: u32 = 4096;

/// Smallest edge of tiles that shrink, in pixels.
const SMALLEST_TILE: u32 = 64;

/// Source of voxels in the shader.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum VoxelFetch {
    /// A 3-D texture through a sampler that interpolates: fastest on GPUs.
    Sampler,
    /// Eight texels of a 3-D texture, interpolated by the shader in 32 bits.
    Texels,
    /// Two texels that hold four neighboring voxels each, interpolated by the shader: fastest on software
    /// devices. Only for volumes of bytes; takes four times the memory.
    Packed,
}

/// Options of opening a [`VulkanRaycaster`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct VulkanOptions {
    /// Part of the device's name (case is ignored), or its index. `None` takes the best device: discrete,
    /// then integrated, virtual, CPU.
    pub device: Option<String>,
    /// True to run under the Khronos validation layer with synchronization validation.
    pub validation: bool,
    /// Source of voxels. `None` takes the fastest source on the device.
    pub fetch: Option<VoxelFetch>,
    /// True to count rays, samples, skips and shaded samples, by a variant of the shader; frames take a
    /// little longer.
    pub count_work: bool,
    /// Edge of the tiles that large images are cut into, in pixels. `None` is 1024, on software devices 4096.
    pub tile: Option<u32>,
    /// Maximum number of voxels along an axis of one texture; larger volumes are cut into bricks. `None` is
    /// the device's limit.
    pub largest_texture: Option<u32>,
    /// Time limit of one submission (a tile, a copy), after which the device counts as hanging. `None` is
    /// 30 s, on software devices 30 min.
    pub longest_wait: Option<Duration>,
    /// Instance extensions of a window system (`VK_KHR_surface` and the like). If there are any, the device
    /// is opened so that it can present in a window: with `VK_KHR_swapchain`, and a queue with graphics.
    pub surface_extensions: Vec<CString>,
}

impl VulkanOptions {
    /// Reads `ENTIRE_DEVICE`, `ENTIRE_VALIDATION` (1 or 0), `ENTIRE_TILE` (pixels) and `ENTIRE_DEVICE_WAIT`
    /// (seconds, [`VulkanOptions::longest_wait`]); a variable that is not set leaves the default.
    ///
    /// # Errors
    /// When a variable has an invalid value.
    pub fn from_env() -> Result<Self> {
        // Bytes that are not UTF-8 become U+FFFD, so such a value is refused or matches no device.
        Self::from_variables(|name| std::env::var_os(name).map(|value| value.to_string_lossy().into_owned()))
    }

    fn from_variables(get: impl Fn(&str) -> Option<String>) -> Result<Self> {
        let validation = match get("ENTIRE_VALIDATION").as_deref() {
            None | Some("" | "0") => false,
            Some("1") => true,
            Some(other) => {
                return Err(Error::new(format!("ENTIRE_VALIDATION is {other:?}; it must be 1 or 0")));
            }
        };
        let set = |name: &str| get(name).filter(|text| !text.is_empty());
        let tile = number("ENTIRE_TILE", set("ENTIRE_TILE"), 8..=16384, "8…16384 pixels")?;
        let wait = set("ENTIRE_DEVICE_WAIT");
        let wait = number("ENTIRE_DEVICE_WAIT", wait, 0.001..=86400.0, "0.001…86400 seconds")?;
        let longest_wait = wait.map(Duration::from_secs_f64);
        Ok(Self { device: set("ENTIRE_DEVICE"), validation, tile, longest_wait, ..Self::default() })
    }
}

/// Reads the number in an environment variable, which must lie in `range`; `accepted` describes the range.
fn number<T: FromStr + PartialOrd>(
    name: &str,
    text: Option<String>,
    range: RangeInclusive<T>,
    accepted: &str,
) -> Result<Option<T>> {
    let Some(text) = text else { return Ok(None) };
    match text.parse::<T>() {
        Ok(value) if range.contains(&value) => Ok(Some(value)),
        _ => Err(Error::new(format!("{name} is {text:?}; it must be {accepted}"))),
    }
}

/// The Vulkan renderer: a compute shader that renders the picture that the crate documentation defines.
///
/// With [`VoxelFetch::Texels`] it follows the CPU version in every operation, and with [`VoxelFetch::Packed`]
/// in all but the colors, which are rounded to a sixteenth of a table entry and to 10 or 11 bits. A sampler
/// interpolates with the device's precision.
pub struct VulkanRaycaster {
    engine: Engine,
    options: VulkanOptions,
    volume: Option<DeviceVolume>,
    classifier: Option<Classifier>,
    /// Ray step whose table is on the device; `None` if the device has no table of the current transfer
    /// function.
    table_step: Option<f32>,
    has_skip_map: bool,
    /// Number of non-empty blocks under the current transfer function, and of all blocks.
    occupied: Option<(usize, usize)>,
    /// Edge of the tiles for each shading mode, in pixels.
    tile: [u32; Shading::ALL.len()],
}

/// Parameters that all dispatches of a frame share.
struct DispatchSetup {
    setup: FrameSetup,
    key: ShaderKey,
    /// Length of a window: maximum number of samples that a dispatch takes along a ray.
    window: f32,
    /// Number of the first sample of the last window of the longest possible ray.
    last_window: f32,
    table: Option<Vec<u8>>,
}

/// The host's record of a volume on the device.
struct DeviceVolume {
    geometry: Geometry,
    blocks: BlockMap,
    fetch: VoxelFetch,
    /// Parts of the volume, one per texture; a single brick if the whole volume fits a texture.
    bricks: Vec<Brick>,
    /// Number of bricks along each axis.
    grid: [usize; 3],
}

impl VulkanRaycaster {
    /// Opens a device.
    ///
    /// # Errors
    /// When there is no Vulkan loader, no driver or no such device. The error names the package to install or
    /// the devices to choose from.
    pub fn new(options: VulkanOptions) -> Result<Self> {
        Self::open(options, &|device| device)
    }

    /// Opens a device whose functions `wrap` may replace, so that tests can make Vulkan calls fail.
    ///
    /// # Errors
    /// As [`VulkanRaycaster::new`].
    ///
    /// # Safety
    /// The functions of the device that `wrap` returns must follow the Vulkan specification, also when they
    /// return an error.
    #[doc(hidden)]
    #[allow(unsafe_code, reason = "Vulkan is called through the functions that `wrap` returns")]
    pub unsafe fn with_device_functions(
        options: VulkanOptions,
        wrap: &dyn Fn(ash::Device) -> ash::Device,
    ) -> Result<Self> {
        Self::open(options, wrap)
    }

    fn open(options: VulkanOptions, wrap: WrapDevice<'_>) -> Result<Self> {
        Self::on(Arc::new(Gpu::open(&options, wrap)?), options)
    }

    /// Makes a raycaster on an open device.
    fn on(gpu: Arc<Gpu>, options: VulkanOptions) -> Result<Self> {
        let groups = gpu.limits.max_compute_work_group_count;
        let pixels = u64::from(gpu.limits.max_storage_buffer_range) / STATE_BYTES.max(WORK_BYTES);
        let largest = (groups[0].min(groups[1]).saturating_mul(recording::GROUP_EDGE))
            .min(pixels.isqrt().try_into().unwrap_or(u32::MAX));
        let default = if gpu.is_software { LARGEST_TILE_SOFTWARE } else { LARGEST_TILE };
        let edge = options.tile.unwrap_or(default).clamp(recording::GROUP_EDGE, largest);
        Ok(Self {
            engine: Engine::new(gpu)?,
            options,
            volume: None,
            classifier: None,
            table_step: None,
            has_skip_map: false,
            occupied: None,
            tile: [edge; Shading::ALL.len()],
        })
    }

    /// True if frames have device times.
    pub fn has_timestamps(&self) -> bool {
        self.engine.gpu().timestamps.is_some()
    }

    /// True if the device is a software implementation (llvmpipe, SwiftShader).
    pub fn is_software(&self) -> bool {
        self.engine.gpu().is_software
    }

    /// Number of textures of the current volume: one, or the bricks of a volume that is larger than a texture
    /// can be; 0 without a volume.
    pub fn bricks(&self) -> usize {
        self.volume.as_ref().map_or(0, |v| v.bricks.len())
    }

    /// Number of non-empty blocks under the current transfer function, and of all blocks; `None` before both
    /// volume and transfer function were set.
    pub fn occupied_blocks(&self) -> Option<(usize, usize)> {
        self.occupied
    }

    /// Returns the parameters that all dispatches of a frame share.
    fn plan(&self, frame: &Frame) -> Result<DispatchSetup> {
        let (Some(volume), Some(classifier)) = (&self.volume, &self.classifier) else {
            let missing = if self.volume.is_none() { "volume" } else { "transfer function" };
            return Err(Error::new(format!("nothing to render: no {missing} was set")));
        };
        check(frame, &volume.geometry)?;
        if !self.has_skip_map {
            return Err(Error::new(
                "nothing to render: the last change of volume or transfer function failed; set it again",
            ));
        }
        let bricked = volume.bricks.len() > 1;
        if bricked && frame.shading.scatters() {
            return Err(Error::new(format!(
                "single scattering needs the volume in one texture, but on {} the volume takes {} bricks; \
                 crop or downsample the volume, or render on the CPU",
                self.engine.gpu().name,
                volume.bricks.len()
            )));
        }
        let key = ShaderKey {
            shading: u32::from(frame.shading.is_lit()) + 2 * u32::from(frame.shading.scatters()),
            skipping: match frame.skipping {
                Skipping::None => 0,
                Skipping::Blocks => 1,
                _ => 2,
            },
            fetch: volume.fetch as u32,
            counting: u32::from(self.options.count_work),
            packets: u32::from(
                volume.fetch == VoxelFetch::Packed
                    && frame.skipping != Skipping::None
                    && !self.options.count_work
                    && self.engine.gpu().subgroup_arithmetic,
            ),
            bricks: u32::from(bricked),
        };
        let step = volume.geometry.reference_step() * f64::from(frame.step);
        let window = if self.is_software() { window(step, frame.shading) } else { NO_SAMPLE };
        let longest = longest_ray(step) as f32;
        Ok(DispatchSetup {
            setup: FrameSetup {
                parts: self.engine.gpu().threads,
                ..FrameSetup::new(&volume.geometry, frame)
            },
            key,
            window,
            last_window: (longest / window).ceil().max(1.0).mul_add(window, -window).max(0.0),
            table: (self.table_step != Some(frame.step))
                .then(|| upload::table_texels(volume.fetch, &classifier.step_table(frame.step))),
        })
    }

    /// Makes the skip map of the current volume and transfer function and uploads it to the device.
    fn update_skip_map(&mut self, preparation: &mut Preparation) -> Result<()> {
        self.has_skip_map = false;
        if let (Some(volume), Some(classifier)) = (&self.volume, &self.classifier) {
            let limit = self.engine.gpu().limits.max_image_dimension3_d as usize;
            if let Some(count) = volume.blocks.dims.iter().find(|n| **n > limit) {
                return Err(Error::new(format!(
                    "the skip map has {count} blocks along an axis, but {} takes at most {limit}; crop the \
                     volume",
                    self.engine.gpu().name
                )));
            }
            let map = SkipMap::new(&volume.blocks, classifier, preparation);
            self.occupied = Some((map.bytes.len() - map.empty_blocks(), map.bytes.len()));
            let watch = Stopwatch::start();
            let fetch = volume.fetch;
            self.engine.reserve(Target::SkipMap, upload::skip_map_shape(fetch, map.dims))?;
            let slice = map.dims[0] * map.dims[1];
            self.engine.copy_slices(Target::SkipMap, |first, out| {
                upload::fill_skip_map(fetch, &map.bytes[first * slice..], out);
            })?;
            preparation.upload = Some(preparation.upload.unwrap_or(0.0) + watch.wall());
            self.has_skip_map = true;
        }
        Ok(())
    }
}

impl Renderer for VulkanRaycaster {
    fn count_work(&mut self, on: bool) {
        self.options.count_work = on;
    }

    fn device(&self) -> String {
        let gpu = self.engine.gpu();
        if gpu.driver.is_empty() { gpu.name.clone() } else { format!("{}, {}", gpu.name, gpu.driver) }
    }

    fn backend(&self) -> &'static str {
        "vulkan"
    }

    fn limits(&self) -> Option<DeviceLimits> {
        Some(self.engine.gpu().reported.clone())
    }

    fn set_volume(&mut self, view: &VolumeView<'_>) -> Result<Preparation> {
        let all = Stopwatch::start();
        let mut preparation = Preparation::default();
        upload::check_size(self.engine.gpu(), view.shape().dims, self.options.largest_texture)?;
        self.engine.drain()?;
        let prepared = PreparedVolume::new(view);
        let plan =
            upload::plan(self.engine.gpu(), &prepared, self.options.fetch, self.options.largest_texture)?;
        self.volume = None;
        self.has_skip_map = false;
        let dims = prepared.geometry.dims;
        self.engine.keep_bricks(plan.bricks.len());
        for (i, brick) in plan.bricks.iter().enumerate() {
            let shape = match plan.fetch {
                VoxelFetch::Packed => upload::packed_shape(dims),
                _ => Shape { extent: brick.dims.map(|n| n as u32), format: plan.format, storage: false },
            };
            self.engine.reserve(Target::Volume(i), shape)?;
        }
        self.engine.reserve(Target::Table, upload::table_shape(plan.fetch))?;
        self.table_step = None;
        for (i, brick) in plan.bricks.iter().enumerate() {
            self.engine.copy_slices(Target::Volume(i), |first, out| {
                upload::fill_slices(&prepared, &plan, brick, first, out);
            })?;
        }
        preparation.upload = Some(all.wall());
        let watch = Stopwatch::start();
        let blocks = BlockMap::new(&prepared);
        preparation.block_map = Some(watch.wall());
        let mut geometry = prepared.geometry;
        geometry.scale *= plan.unit;
        self.volume =
            Some(DeviceVolume { geometry, blocks, fetch: plan.fetch, bricks: plan.bricks, grid: plan.grid });
        self.update_skip_map(&mut preparation)?;
        preparation.wall = all.wall();
        Ok(preparation)
    }

    fn set_transfer(&mut self, table: &TransferTable) -> Result<Preparation> {
        let all = Stopwatch::start();
        let mut preparation = Preparation::default();
        self.engine.drain()?;
        self.classifier = Some(Classifier::new(table));
        self.table_step = None;
        self.update_skip_map(&mut preparation)?;
        preparation.wall = all.wall();
        Ok(preparation)
    }

    fn render(&mut self, frame: &Frame) -> Result<Rendered> {
        self.render_region(frame, Region::whole(frame))
    }
}

fn add_counts(counts: &mut WorkCounts, work: &[u8]) {
    for pixel in work.chunks_exact(WORK_BYTES as usize) {
        let number =
            |i: usize| u64::from(u32::from_le_bytes([pixel[i], pixel[i + 1], pixel[i + 2], pixel[i + 3]]));
        counts.rays += number(0);
        counts.samples += number(4);
        counts.skips += number(8);
        counts.shaded += number(12);
    }
}

/// Returns the bricks from front to back. With a perspective camera, the first brick is the one nearest to
/// the eye. With parallel rays, it is the brick in the corner of the box that the rays reach first. Along
/// each axis, no ray moves towards the first brick. The bricks are therefore sorted by their distance from
/// the first brick, in bricks, summed over the axes.
fn brick_order(volume: &DeviceVolume, setup: &FrameSetup) -> Vec<usize> {
    let parallel = setup.origin_up != [0.0; 3];
    let inside = |brick: &Brick, a: usize| {
        let from = match parallel {
            true if setup.forward[a] > 0.0 => 0.0,
            true => setup.dims[a],
            false => setup.eye[a],
        };
        let cell = (from - 0.5).clamp(0.0, setup.dims[a] - 1.0).floor();
        brick.low[a] as f32 <= cell && cell <= brick.high[a] as f32
    };
    let at = |i: usize| {
        [i % volume.grid[0], i / volume.grid[0] % volume.grid[1], i / (volume.grid[0] * volume.grid[1])]
    };
    let eye = [0, 1, 2]
        .map(|a| (0..volume.bricks.len()).find(|&i| inside(&volume.bricks[i], a)).map_or(0, |i| at(i)[a]));
    let mut order: Vec<usize> = (0..volume.bricks.len()).collect();
    order.sort_by_key(|&i| (0..3).map(|a| at(i)[a].abs_diff(eye[a])).sum::<usize>());
    order
}

/// Returns the maximum number of samples of a ray: the diagonal of the box, which is 2 in scene space, in
/// steps of length `step`.
fn longest_ray(step: f64) -> f64 {
    (2.0 / step).ceil() + 1.0
}

/// Returns the number of samples of a ray that one dispatch may take on a software device, so that all loops
/// together stay below [`LOOP_LIMIT`].
fn window(step: f64, shading: Shading) -> f32 {
    let shadow = longest_ray(step * f64::from(crate::setup::SHADOW_STEP));
    // A sample costs one iteration of its own loop and at most one of the enclosing loop; so does each
    // shadow sample.
    let turns = if shading.scatters() { 2.0 + 2.0 * shadow } else { 2.0 };
    (LOOP_LIMIT / turns).floor().max(1.0) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_keep_loops_below_the_limit() {
        // 256³ voxels: the box's diagonal is 443 voxels.
        let step = 2.0 / (256.0 * 3f64.sqrt());
        assert!(f64::from(window(step, Shading::None)) >= longest_ray(step));
        let w = f64::from(window(step, Shading::Scatter));
        assert!(w * 2.0 * longest_ray(2.0 * step) <= LOOP_LIMIT && w > 50.0);
        assert!(f64::from(window(step / 64.0, Shading::None)) < 65536.0);
        assert_eq!(window(1e-9, Shading::Scatter), 1.0);
    }

    #[test]
    fn environment_variables_are_read_and_checked() {
        let read = |pairs: &[(&str, &str)]| {
            VulkanOptions::from_variables(|name| {
                pairs.iter().find(|(n, _)| *n == name).map(|(_, v)| (*v).to_owned())
            })
        };
        assert_eq!(read(&[]).unwrap(), VulkanOptions::default());
        let o =
            read(&[("ENTIRE_DEVICE", "llvm"), ("ENTIRE_VALIDATION", "1"), ("ENTIRE_TILE", "256")]).unwrap();
        assert_eq!((o.device.as_deref(), o.validation, o.tile), (Some("llvm"), true, Some(256)));
        let wait = |text| read(&[("ENTIRE_DEVICE_WAIT", text)]).map(|o| o.longest_wait);
        assert_eq!(wait("2.5").unwrap(), Some(Duration::from_millis(2500)));
        for bad in ["0", "-1", "nan", "inf", "1e9", "long"] {
            assert!(wait(bad).unwrap_err().to_string().contains("ENTIRE_DEVICE_WAIT"), "{bad}");
        }
        assert!(read(&[("ENTIRE_VALIDATION", "yes")]).unwrap_err().to_string().contains("\"yes\""));
        for bad in ["0", "7", "big", "-8", "99999"] {
            assert!(read(&[("ENTIRE_TILE", bad)]).is_err());
        }
    }
}
