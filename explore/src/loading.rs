//! Loads volumes in the background: reads a volume, summarizes it, uploads it to the device by a separate
//! raycaster, and draws it once at small size. So the frame in which the volume appears takes no longer than
//! later frames.

use crate::camera::Placement;
use crate::histogram::Histogram;
use crate::host::{Host, Progress, Steering};
use crate::scene::{Crop, Facts, Scene, part, spanned};
use crate::transfer::Curve;
use anyhow::{Context, Result};
use entire_core::scene::{Arcball, Camera, Frame, Shading, Skipping};
use entire_io::volume::Volume;
use entire_steer::VolumeSummary;
use entire_vk_raycaster::{Renderer, SharedDevice, VulkanOptions, VulkanRaycaster};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Instant;
use winit::event_loop::EventLoopProxy;

/// Message to the event loop that a load has ended.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Wake;

/// A volume to load.
#[derive(Clone, Default)]
pub(crate) struct Load {
    pub(crate) path: PathBuf,
    /// Index in a time series.
    pub(crate) index: usize,
    /// True if the user opened the file, so that it becomes a recent file.
    pub(crate) opened: bool,
    /// The volume, if it is in memory.
    pub(crate) source: Option<Arc<Volume>>,
    /// Range of values that maps to [0, 1]; `None` for the file's range.
    pub(crate) range: Option<(f32, f32)>,
    pub(crate) crop: Option<Crop>,
    /// The initial transfer function; by default a preset for the volume.
    pub(crate) curve: Option<Curve>,
    pub(crate) shading: Shading,
    pub(crate) skipping: Skipping,
}

/// A volume that is ready for display.
pub(crate) struct Loaded {
    pub(crate) scene: Scene,
    pub(crate) summary: VolumeSummary,
    pub(crate) steering: Vec<Arc<dyn Steering>>,
    pub(crate) curve: Curve,
    /// Seconds from the request to the end of the load.
    pub(crate) seconds: f64,
}

/// The stages of a load, for display, by [`Progress::stage`].
const STAGES: [&str; 4] = ["reading", "summarizing", "uploading to the device", "first picture"];

pub(crate) struct Loading {
    pub(crate) job: Load,
    /// Time of the request.
    pub(crate) asked: Instant,
    progress: Arc<Progress>,
    result: Receiver<Result<Box<Loaded>>>,
}

impl Loading {
    /// Starts a thread that loads the volume and then wakes the event loop.
    pub(crate) fn start(
        job: Load,
        host: &Arc<dyn Host>,
        device: &SharedDevice,
        options: &VulkanOptions,
        wake: EventLoopProxy<Wake>,
    ) -> Result<Self> {
        let progress = Arc::new(Progress::default());
        let (send, result): (Sender<Result<Box<Loaded>>>, _) = channel();
        let started = job.clone();
        let begin = Instant::now();
        let (host, device, options) = (Arc::clone(host), device.clone(), options.clone());
        let followed = Arc::clone(&progress);
        std::thread::Builder::new()
            .name("load".into())
            .spawn(move || {
                let shown = job.path.display().to_string();
                let loaded = load(job, &*host, &device, options, &followed, begin).with_context(|| shown);
                // The receiver is gone if the window was closed.
                let _ = send.send(loaded.map(Box::new));
                let _ = wake.send_event(Wake);
            })
            .context("cannot start a thread")?;
        Ok(Self { job: started, asked: begin, progress, result })
    }

    pub(crate) fn cancel(&self) {
        self.progress.cancel();
    }

    /// Returns the current stage, and the share of the file that was read.
    pub(crate) fn state(&self) -> (&'static str, f32) {
        (STAGES[self.progress.stage.load(Ordering::Relaxed)], self.progress.share())
    }

    /// Returns the loaded volume or the error once the load has ended.
    pub(crate) fn poll(&self) -> Option<Result<Box<Loaded>>> {
        self.result.try_recv().ok()
    }
}

fn load(
    job: Load,
    host: &dyn Host,
    device: &SharedDevice,
    options: VulkanOptions,
    progress: &Arc<Progress>,
    begin: Instant,
) -> Result<Loaded> {
    let enter = |stage: usize| {
        progress.stage.store(stage, Ordering::Relaxed);
        progress.check()
    };
    let whole = match job.source {
        Some(source) => source,
        None => Arc::new(host.open(&job.path, progress)?),
    };
    enter(1)?;
    let all = spanned(&whole, job.range);
    let facts = Facts::of(&all);
    let (view, placement) = match job.crop {
        Some(crop) => part(&all, crop)?,
        None => (all, Placement::WHOLE),
    };
    let mut raycaster = VulkanRaycaster::on_device(device, options)?;
    let drawn_by = raycaster.device();
    // The processor summarizes the volume while its voxels are uploaded to the device, in separate
    // threads.
    let (summed, uploaded) = std::thread::scope(|scope| {
        let summed = scope.spawn(|| -> Result<_> {
            let summary = VolumeSummary::new(&view)?;
            let histogram = Histogram::of(&view);
            let of = |shading| host.steering(&view, shading, &drawn_by);
            let steering = Shading::ALL.into_iter().map(of).collect::<Result<_>>()?;
            Ok((summary, histogram, steering))
        });
        progress.stage.store(2, Ordering::Relaxed);
        let uploaded = raycaster.set_volume(&view);
        (summed.join(), uploaded)
    });
    uploaded?;
    let Ok(summed) = summed else { anyhow::bail!("summarizing the volume failed") };
    let (summary, histogram, steering) = summed?;
    enter(3)?;
    let curve = match job.curve {
        Some(curve) => curve,
        None => Curve::preset("layers", &histogram).context("a preset")?,
    };
    raycaster.set_transfer(&curve.table()?)?;
    warm(&mut raycaster, job.shading, job.skipping)?;
    progress.check()?;
    let scene = Scene {
        path: job.path,
        index: job.index,
        whole,
        range: job.range,
        crop: job.crop,
        placement,
        raycaster,
        histogram,
        facts,
    };
    Ok(Loaded { scene, summary, steering, curve, seconds: begin.elapsed().as_secs_f64() })
}

/// Draws a few pixels, so that the shader of these modes is compiled.
pub(crate) fn warm(raycaster: &mut VulkanRaycaster, shading: Shading, skipping: Skipping) -> Result<()> {
    let camera = Camera::from_arcball(Arcball { rx: 20.0, ry: 30.0, dz: 2.6 })?;
    let frame = Frame { step: 8.0, shading, skipping, ..Frame::new(camera, 16, 16)? }.checked()?;
    raycaster.render(&frame)?;
    Ok(())
}
