//! Measures the costs of a frame's parts on this machine.

use crate::cpu::CpuRaycaster;
use crate::error::{Error, Result};
use crate::renderer::{DeviceLimits, FrameTime, Renderer, WorkCounts};
use entire_core::scene::{
    Arcball, Camera, ControlPoint, Frame, Scalars, Shading, Skipping, TransferFunction, TransferTable,
    VolumeView,
};
use glam::{Mat4, Vec3};

/// Voxels along each axis of the probe's volumes.
const EDGE: usize = 64;

/// Largest edge of the probe's images, in pixels.
const LARGEST_IMAGE: u32 = 4096;

/// Options of a probe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProbeOptions {
    /// Smallest time of a frame that is measured, in seconds. Images grow until their frames take this long,
    /// so that the clock's error is small in comparison.
    pub frame_seconds: f64,
    /// Number of frames of each scene. The time of a scene is the median of their times.
    pub repeats: usize,
}

impl Default for ProbeOptions {
    fn default() -> Self {
        Self { frame_seconds: 0.02, repeats: 9 }
    }
}

/// Results of a probe.
#[derive(Clone, Debug, PartialEq)]
pub struct Probe {
    /// [`Renderer::device`].
    pub device: String,
    /// [`Renderer::backend`].
    pub backend: &'static str,
    /// Clock of [`Probe::numbers`], `device` or `wall`.
    pub clock: &'static str,
    /// Limits of the device; `None` if it is no Vulkan device.
    pub limits: Option<DeviceLimits>,
    /// Agreement of this renderer's frame with the CPU version's.
    pub agreement: Agreement,
    /// Quality of device timestamps; `None` if there are none.
    pub timestamps: Option<TimestampQuality>,
    /// Time of a frame of 64 × 64 pixels in which every ray misses the volume, in seconds: the fixed cost of
    /// a frame.
    pub frame_seconds: f64,
    /// Rays per second that end at their first sample.
    pub rays_per_second: f64,
    /// Samples per second of nearly parallel rays of equal length, none of which skips or stops.
    pub coherent_samples_per_second: f64,
    /// Samples per second of rays that diverge, start with a random offset and end at random depths.
    pub divergent_samples_per_second: f64,
    /// Skips of empty blocks per second, each of one block.
    pub skips_per_second: f64,
}

impl Probe {
    /// The five numbers that describe the machine, by name.
    pub fn numbers(&self) -> [(&'static str, f64); 5] {
        [
            ("frame_seconds", self.frame_seconds),
            ("rays_per_second", self.rays_per_second),
            ("coherent_samples_per_second", self.coherent_samples_per_second),
            ("divergent_samples_per_second", self.divergent_samples_per_second),
            ("skips_per_second", self.skips_per_second),
        ]
    }
}

/// Comparison of a frame with the CPU version's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Agreement {
    /// Largest difference of a color or opacity, in units of 1/255.
    pub largest: u8,
    /// Mean difference of colors and opacities, in units of 1/255.
    pub mean: f64,
    /// The renderer's counts; `None` if it does not count work.
    pub counts: Option<WorkCounts>,
    /// Work counts of the CPU renderer.
    pub twin: WorkCounts,
}

/// Device timestamps compared with the host's clock, over the frames of coherent rays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimestampQuality {
    /// Median of device seconds ÷ wall seconds.
    pub device_to_wall: f64,
    /// (Largest − smallest) ÷ median of the device's seconds for one frame.
    pub spread: f64,
}

/// Returns a hash of `i`, from 0 to 255.
fn hash(i: usize) -> u8 {
    let h = (i as u32).wrapping_mul(0x9e37_79b1);
    let h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    ((h ^ (h >> 12)) >> 24) as u8
}

/// Smooth blobs, for the comparison with the CPU version.
fn blobs() -> Vec<u8> {
    let at = |i: usize| (i as f32 + 0.5) / EDGE as f32 * 2.0 - 1.0;
    let mut out = Vec::with_capacity(EDGE * EDGE * EDGE);
    for z in 0..EDGE {
        for y in 0..EDGE {
            for x in 0..EDGE {
                let (x, y, z) = (at(x), at(y), at(z));
                let near = |a: f32, b: f32, c: f32, w: f32| {
                    (1.0 - ((x - a).powi(2) + (y - b).powi(2) + (z - c).powi(2)) / w).max(0.0)
                };
                let v =
                    near(0.3, 0.2, 0.1, 0.4) + near(-0.4, -0.2, 0.3, 0.2) + 0.5 * near(0.0, 0.4, -0.5, 0.3);
                out.push((v.min(1.0) * 255.0) as u8);
            }
        }
    }
    out
}

fn table(points: &[(f32, f32)]) -> Result<TransferTable> {
    let points = points
        .iter()
        .map(|&(position, opacity)| ControlPoint { position, color: [1.0, 0.7, 0.4], opacity })
        .collect();
    TransferFunction::Points(points).to_table().map_err(from_core)
}

fn from_core(e: impl std::fmt::Display) -> Error {
    Error::new(e.to_string())
}

/// A frame of `edge` × `edge` pixels without early termination.
fn frame(pose: (f32, f32, f32), fov: f32, edge: u32) -> Result<Frame> {
    let (rx, ry, dz) = pose;
    Camera::from_arcball(Arcball { rx, ry, dz })
        .and_then(|c| c.with_fov_y_degrees(fov))
        .and_then(|c| Frame::new(c, edge, edge))
        .and_then(|f| Frame { termination: 1.0, ..f }.checked())
        .map_err(from_core)
}

/// Returns a frame of a camera that looks away from the volume.
fn turned_away(edge: u32) -> Result<Frame> {
    Camera::from_world_view(Mat4::from_translation(Vec3::new(0.0, 0.0, 3.0)), Vec3::ZERO, 1.0)
        .and_then(|c| Frame::new(c, edge, edge))
        .map_err(from_core)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Renders a shaded frame with work counts, and compares it with the CPU version's.
fn agree(renderer: &mut dyn Renderer, view: &VolumeView<'_>) -> Result<Agreement> {
    let table = table(&[(0.0, 0.0), (0.1, 0.0), (1.0, 0.3)])?;
    let frame = Frame { shading: Shading::Local, ..frame((25.0, 40.0, 2.5), 45.0, 96)? };
    let mut twin = CpuRaycaster::new();
    twin.set_volume(view)?;
    twin.set_transfer(&table)?;
    renderer.set_volume(view)?;
    renderer.set_transfer(&table)?;
    renderer.count_work(true);
    let found = renderer.render(&frame);
    renderer.count_work(false);
    let (found, wanted) = (found?, twin.render(&frame)?);
    let apart = || found.image.rgba.iter().zip(&wanted.image.rgba).map(|(a, b)| a.abs_diff(*b));
    let sum: u64 = apart().map(u64::from).sum();
    Ok(Agreement {
        largest: apart().max().unwrap_or(0),
        mean: sum as f64 / found.image.rgba.len() as f64,
        counts: found.counts,
        twin: wanted.counts.unwrap_or_default(),
    })
}

/// Returns the ratio of device to host times and the spread of the device times, or `None` without device
/// times.
fn quality(times: &[FrameTime]) -> Option<TimestampQuality> {
    let device: Vec<f64> = times.iter().filter_map(|t| t.device).collect();
    let (low, high) = device.iter().fold((f64::INFINITY, 0.0f64), |(l, h), &t| (l.min(t), h.max(t)));
    (!device.is_empty()).then(|| TimestampQuality {
        device_to_wall: median(times.iter().filter_map(|t| Some(t.device? / t.wall)).collect()),
        spread: (high - low) / median(device),
    })
}

/// Times a scene. If `scene.grows` is true, its image grows until a frame takes
/// [`ProbeOptions::frame_seconds`]. Returns the median time in seconds, all times, and the CPU version's
/// counts.
fn time(
    renderer: &mut dyn Renderer,
    options: ProbeOptions,
    scene: &Scene<'_>,
) -> Result<(f64, Vec<FrameTime>, WorkCounts)> {
    renderer.set_volume(&scene.view)?;
    renderer.set_transfer(&scene.table)?;
    renderer.count_work(false);
    let mut edge = 64;
    loop {
        let frame = (scene.frame)(edge)?;
        // The first frames compile shaders and fill caches.
        for _ in 0..2 {
            renderer.render(&frame)?;
        }
        let mut times = vec![renderer.render(&frame)?.time];
        let long = times[0].seconds() >= options.frame_seconds;
        if scene.grows && !long && edge < LARGEST_IMAGE {
            edge *= 2;
            continue;
        }
        for _ in 1..options.repeats.max(1) {
            times.push(renderer.render(&frame)?.time);
        }
        let mut twin = CpuRaycaster::new();
        twin.set_volume(&scene.view)?;
        twin.set_transfer(&scene.table)?;
        // Counts are proportional to the number of pixels, so they are computed from a smaller image of
        // the same view.
        let counted = edge.min(256);
        let (_, counts) = twin.render_linear(&(scene.frame)(counted)?)?;
        let ratio = u64::from(edge / counted).pow(2);
        let counts = WorkCounts {
            rays: counts.rays * ratio,
            samples: counts.samples * ratio,
            skips: counts.skips * ratio,
            shaded: counts.shaded * ratio,
        };
        return Ok((median(times.iter().map(FrameTime::seconds).collect()), times, counts));
    }
}

struct Scene<'a> {
    view: VolumeView<'a>,
    table: TransferTable,
    frame: fn(u32) -> Result<Frame>,
    grows: bool,
}

/// Renders known scenes and measures this machine's rates for the parts of a frame. Takes a second or so;
/// afterwards the renderer has a volume and a transfer function of the probe, and does not count work.
///
/// # Errors
/// When the renderer fails.
pub fn probe(renderer: &mut dyn Renderer, options: ProbeOptions) -> Result<Probe> {
    let dims = [EDGE; 3];
    let blobs = blobs();
    let empty = vec![0u8; EDGE * EDGE * EDGE];
    // One voxel in 64 is opaque and stops a ray.
    let specks: Vec<u8> = (0..EDGE * EDGE * EDGE).map(|i| if hash(i) < 4 { 255 } else { 20 }).collect();
    let view = |data| VolumeView::new(Scalars::U8(data), dims).map_err(from_core);
    let agreement = agree(renderer, &view(&blobs)?)?;

    let mut time = |scene: Scene<'_>| time(renderer, options, &scene);
    let faint = table(&[(0.0, 0.001), (1.0, 0.002)])?;
    let (frame_seconds, ..) =
        time(Scene { view: view(&blobs)?, table: faint.clone(), frame: turned_away, grows: false })?;
    let positive = |what: &str, seconds: f64| {
        if seconds > 0.0 {
            return Ok(seconds);
        }
        Err(Error::new(format!(
            "the clock is too noisy for frames of {:.1} ms: {what} took {:.3} ms less than the sum of the \
             times measured for its parts; probe with longer frames (--frame-ms), on an idle machine",
            options.frame_seconds * 1e3,
            seconds * -1e3
        )))
    };
    let (seconds, _, counts) = time(Scene {
        view: view(&blobs)?,
        table: table(&[(0.0, 1.0)])?,
        frame: |edge| {
            let f = Frame { skipping: Skipping::None, ..frame((0.0, 0.0, 50.0), 1.0, edge)? };
            Frame { termination: 0.99, ..f }.checked().map_err(from_core)
        },
        grows: true,
    })?;
    let ray = positive("a frame of rays", seconds - frame_seconds)? / counts.rays.max(1) as f64;
    let (seconds, times, counts) = time(Scene {
        view: view(&blobs)?,
        table: faint,
        frame: |edge| Ok(Frame { skipping: Skipping::None, ..frame((0.0, 0.0, 50.0), 1.0, edge)? }),
        grows: true,
    })?;
    let rest = |what: &str, seconds: f64, counts: &WorkCounts| {
        positive(what, seconds - frame_seconds - ray * counts.rays as f64)
    };
    let coherent =
        counts.samples.saturating_sub(counts.rays) as f64 / rest("a frame of samples", seconds, &counts)?;
    let timestamps = quality(&times);
    let (seconds, _, counts) = time(Scene {
        view: view(&specks)?,
        table: table(&[(0.0, 0.001), (0.2, 0.002), (0.5, 1.0)])?,
        frame: |edge| {
            let f =
                Frame { skipping: Skipping::None, jitter: true, ..frame((20.0, 30.0, 0.05), 120.0, edge)? };
            Frame { termination: 0.95, ..f }.checked().map_err(from_core)
        },
        grows: true,
    })?;
    let divergent = counts.samples.saturating_sub(counts.rays) as f64
        / rest("a frame of diverging rays", seconds, &counts)?;
    let (seconds, _, counts) = time(Scene {
        view: view(&empty)?,
        table: table(&[(0.0, 0.0), (0.5, 0.0), (1.0, 1.0)])?,
        frame: |edge| Ok(Frame { skipping: Skipping::Blocks, ..frame((20.0, 30.0, 50.0), 2.0, edge)? }),
        grows: true,
    })?;
    // The time of a ray includes one sample. In this scene, the ray's first skip replaces this sample, so one
    // skip per ray is subtracted.
    let skips = counts.skips.saturating_sub(counts.rays) as f64 / rest("a frame of skips", seconds, &counts)?;
    Ok(Probe {
        device: renderer.device(),
        backend: renderer.backend(),
        clock: times.first().map_or("wall", FrameTime::source),
        limits: renderer.limits(),
        agreement,
        timestamps,
        frame_seconds,
        rays_per_second: 1.0 / ray,
        coherent_samples_per_second: coherent,
        divergent_samples_per_second: divergent,
        skips_per_second: skips,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::renderer::{Preparation, Rendered};

    const FRAME: f64 = 1e-3;
    const RAY: f64 = 1e-7;
    const SAMPLE: f64 = 1e-8;

    /// The CPU version, with a clock that is computed from its counts.
    struct Clockwork(CpuRaycaster);

    impl Renderer for Clockwork {
        fn device(&self) -> String {
            self.0.device()
        }

        fn backend(&self) -> &'static str {
            self.0.backend()
        }

        fn set_volume(&mut self, volume: &VolumeView<'_>) -> Result<Preparation> {
            self.0.set_volume(volume)
        }

        fn set_transfer(&mut self, table: &TransferTable) -> Result<Preparation> {
            self.0.set_transfer(table)
        }

        fn render(&mut self, frame: &Frame) -> Result<Rendered> {
            let mut rendered = self.0.render(frame)?;
            let counts = rendered.counts.unwrap();
            let wall = FRAME + RAY * counts.rays as f64 + SAMPLE * (counts.samples + counts.skips) as f64;
            rendered.time = FrameTime { device: None, wall, cpu: None };
            Ok(rendered)
        }
    }

    #[test]
    fn the_twin_agrees_with_itself_and_the_numbers_are_those_of_its_clock() {
        let options = ProbeOptions { frame_seconds: 1e-4, repeats: 2 };
        let p = probe(&mut Clockwork(CpuRaycaster::new()), options).unwrap();
        assert_eq!((p.agreement.largest, p.agreement.mean), (0, 0.0));
        assert_eq!(p.agreement.counts, Some(p.agreement.twin));
        assert!(p.agreement.twin.samples > 10_000 && p.agreement.twin.shaded > 1000);
        assert_eq!((p.backend, p.clock), ("cpu", "wall"));
        assert!(p.limits.is_none() && p.timestamps.is_none());
        let expected = [FRAME, 1.0 / (RAY + SAMPLE), 1.0 / SAMPLE, 1.0 / SAMPLE, 1.0 / SAMPLE];
        for ((name, value), expected) in p.numbers().into_iter().zip(expected) {
            assert!((value / expected - 1.0).abs() < 1e-6, "{name} is {value}, not {expected}");
        }
    }

    #[test]
    fn a_camera_that_is_turned_away_sees_nothing() {
        let data = blobs();
        let mut twin = CpuRaycaster::new();
        twin.set_volume(&VolumeView::new(Scalars::U8(&data), [EDGE; 3]).unwrap()).unwrap();
        twin.set_transfer(&table(&[(0.0, 1.0)]).unwrap()).unwrap();
        let (_, counts) = twin.render_linear(&turned_away(16).unwrap()).unwrap();
        assert_eq!(counts, WorkCounts::default());
    }

    #[test]
    fn device_times_are_judged_only_where_there_are_some() {
        let time = |device, wall| FrameTime { device, wall, cpu: None };
        assert_eq!(quality(&[time(None, 1.0)]), None);
        let q = quality(&[time(Some(0.5), 1.0), time(Some(0.6), 1.0), time(Some(0.4), 1.0)]).unwrap();
        assert!((q.device_to_wall - 0.5).abs() < 1e-12 && (q.spread - 0.4).abs() < 1e-12);
    }
}
