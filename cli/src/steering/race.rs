//! A comparison of controllers: random frames of a volume at several ray steps, from which the time saved by
//! coarser steps, the predictor's errors and the default target follow; then a path under every controller.

use super::contenders::{ControllerKind, contender};
use super::model::{Sample, SteeringModel, Steers};
use super::play::{Contender, Course, Playback, Shown, Task, play};
use super::report::ResponseCurve;
use super::rivals::{StepResponse, response};
use anyhow::{Context, Result, ensure};
use entire_core::scene::{Camera, DEFAULT_FOV_Y_DEGREES, Frame, TransferFunction, VolumeView};
use entire_io::dataset::Timing;
use entire_io::metrics::median;
use entire_io::options::DrawSettings;
use entire_io::path::FlightPath;
use entire_io::progress::progress_bar;
use entire_io::scenes::SceneDistribution;
use entire_io::volume::Volume;
use entire_steer::features::{FrameFeatures, PROBE_SIDE, Setting, TransferSummary, VolumeSummary};
use entire_vk_raycaster::Renderer;

/// Ray steps at which every random scene is rendered, reference steps. The first one is the reference step.
pub(crate) const CALIBRATION_STEPS: [f32; 6] = [1.0, 1.5, 2.0, 4.0, 8.0, 16.0];

/// A comparison of controllers.
#[derive(Clone, Debug)]
pub(crate) struct Race<'a> {
    /// The volume, or the volumes of a series. Random scenes are of the first volume only.
    pub(crate) volumes: &'a [Volume],
    pub(crate) path: &'a FlightPath,
    /// Frames whose pictures are kept.
    pub(crate) keep: &'a [usize],
    pub(crate) course: Course<'a>,
    /// Seed of the random scenes.
    pub(crate) seed: u64,
    /// Number of random scenes, and of their renderings at each step.
    pub(crate) scenes: (usize, usize),
    pub(crate) draw: DrawSettings,
    pub(crate) controllers: &'a [ControllerKind],
    /// Target, seconds; `None` for [`TARGET_SHARE`] of the median time of the random scenes.
    pub(crate) target: Option<f64>,
    pub(crate) model: &'a SteeringModel,
}

/// Message of the error of an interrupted comparison.
pub(crate) const INTERRUPTED: &str = "interrupted; no report was written";

/// Renders `scenes` random scenes at six ray steps, each `repeats` times, and keeps the median time. `seed`
/// and `name` choose the scenes; their transfer functions are random and differ from those of a path. The
/// progress bar is labeled `label`.
///
/// Returns `None` when `stop` returned true.
///
/// # Errors
/// When the renderer fails or has no times by the clock of `draw`.
#[expect(clippy::too_many_arguments, reason = "each parameter is one setting of the measurement")]
pub fn measure(
    volume: &VolumeView<'_>,
    summary: &VolumeSummary,
    draw: &DrawSettings,
    (seed, name): (u64, &str),
    (scenes, repeats): (usize, usize),
    renderer: &mut dyn Renderer,
    stop: &dyn Fn() -> bool,
    label: &str,
) -> Result<Option<Vec<Sample>>> {
    ensure!(scenes > 0 && repeats > 0, "calibration needs at least one scene, rendered at least once");
    renderer.set_volume(volume)?;
    let mut samples = Vec::with_capacity(scenes * CALIBRATION_STEPS.len());
    let bar = progress_bar(label);
    bar.set_length(scenes as u64);
    bar.reset_eta();
    // Collections draw three lobes by default. With one to three lobes, some scenes show a nearly empty
    // volume.
    let distribution = SceneDistribution { lobes: (1, 3), ..SceneDistribution::default() };
    for scene in 0..scenes {
        let place = || format!("random scene {scene}");
        let drawn = distribution.draw(seed, name, scene as u64);
        let table = TransferFunction::Gaussian(drawn.lobes.clone()).to_table().with_context(place)?;
        renderer.set_transfer(&table).with_context(place)?;
        let mut transfer = TransferSummary::new(summary, &table)?;
        let camera = Camera::from_arcball(drawn.camera)?.with_fov_y_degrees(DEFAULT_FOV_Y_DEGREES)?;
        let frame = draw.frame(camera).with_context(place)?;
        let features = FrameFeatures::of(summary, &mut transfer, &frame, PROBE_SIDE)?;
        // The first renderings on a device or after a change of scene are slower than later ones, so they are
        // discarded.
        for _ in 0..if scene == 0 { 2 } else { 1 } {
            if stop() {
                return Ok(None);
            }
            renderer.render(&frame).with_context(place)?;
        }
        for step in CALIBRATION_STEPS {
            if stop() {
                return Ok(None);
            }
            let frame = Frame { step, ..frame }.checked()?;
            let mut seconds = Vec::with_capacity(repeats);
            for _ in 0..repeats {
                let rendered = renderer.render(&frame).with_context(place)?;
                seconds.push(draw.seconds(&Timing::new(rendered.time, rendered.counts))?);
            }
            let seconds = median(&mut seconds).unwrap_or(f64::NAN);
            samples.push(Sample {
                scene,
                features: features.clone(),
                setting: Setting::from(&frame),
                camera: drawn.camera,
                lobes: drawn.lobes.clone(),
                seconds,
            });
        }
        bar.inc(1);
    }
    Ok(Some(samples))
}

#[derive(Clone, Debug)]
pub(crate) struct Prepared {
    pub(crate) summary: VolumeSummary,
    /// G, the frame time at a ray step divided by that at the reference step.
    pub(crate) response: StepResponse,
    /// G with the samples that it was fitted to.
    pub(crate) curve: ResponseCurve,
    pub(crate) predictor: Steers,
    /// Target, seconds.
    pub(crate) target: f64,
    /// Median seconds of the random scenes at the reference step.
    pub(crate) full_quality: f64,
    /// Origin of the target; empty if the target was given.
    pub(crate) target_reason: String,
    pub(crate) fixed_step: f32,
}

/// Default target as a share of the median time of the random scenes at the reference step. At this target,
/// most scenes must be drawn at steps coarser than the reference step, and few at the coarsest step.
pub(crate) const TARGET_SHARE: f64 = 0.5;

/// Renders random scenes of the volume at several steps and derives from them G, the predictor's errors, the
/// default target and the fixed step. The predictor is not fitted to these scenes. It is an error if `stop`
/// returns true.
pub(crate) fn prepare(
    race: &Race<'_>,
    renderer: &mut dyn Renderer,
    stop: &dyn Fn() -> bool,
) -> Result<Prepared> {
    let volume = &race.volumes[0];
    let view = volume.view();
    let summary = VolumeSummary::new(&view)?;
    ensure!(!stop(), INTERRUPTED);
    let seed = (race.seed, volume.name());
    let samples = measure(&view, &summary, &race.draw, seed, race.scenes, renderer, stop, "measure")?;
    let samples = samples.context(INTERRUPTED)?;
    let response = response(&samples)?;
    let predictor = Steers {
        title: race.model.title().to_owned(),
        on_this_volume: race
            .model
            .quality(&samples)
            .context("the model cannot predict frames of the volume")?,
        calibrated_on_this_volume: race.model.calibrated_on(volume.source())?,
    };
    let at_reference = samples.iter().filter(|s| s.setting.step == 1.0).map(|s| s.seconds);
    let full_quality = median(&mut at_reference.collect::<Vec<_>>()).context("no scene was timed")?;
    let (target, target_reason) = match race.target {
        Some(target) => (target, String::new()),
        None => {
            let target = TARGET_SHARE * full_quality;
            // Over a millisecond, the target is rounded to a tenth of a millisecond.
            let target = if target > 1e-3 { (target * 1e4).round() / 1e4 } else { target };
            let share = 100.0 * TARGET_SHARE;
            (target, format!("{share:.0} % of the median random scene's time at the reference step"))
        }
    };
    let fixed_step = response.step_ratio((target / full_quality) as f32);
    let curve = ResponseCurve::new(&samples, &response);
    Ok(Prepared { summary, response, curve, predictor, target, full_quality, target_reason, fixed_step })
}

impl Race<'_> {
    /// Plays the path, until `stop` returns true, which is an error.
    pub(crate) fn run(
        &self,
        prepared: &Prepared,
        renderer: &mut dyn Renderer,
        stop: &dyn Fn() -> bool,
    ) -> Result<Playback> {
        let contender = |kind: &ControllerKind| {
            let predictor = self.model.predictor()?;
            Ok(contender(*kind, prepared.fixed_step, predictor, &prepared.response, self.model.log_sd))
        };
        let mut contenders: Vec<Contender> = self.controllers.iter().map(contender).collect::<Result<_>>()?;
        let mut shown = Vec::new();
        for (i, volume) in self.volumes.iter().enumerate() {
            let view = volume.view();
            let (summary, volume_features) = if i == 0 {
                (prepared.summary.clone(), self.model.volume_features().map(<[f32]>::to_vec))
            } else {
                ensure!(!stop(), INTERRUPTED);
                (VolumeSummary::new(&view)?, self.model.encode(&view)?)
            };
            shown.push(Shown { view, summary, volume_features });
        }
        let (path, keep, course) = (self.path, self.keep, self.course);
        let task = Task { volumes: &shown, path, keep, course, target: prepared.target };
        play(&task, &self.draw, renderer, &mut contenders, stop)?.context(INTERRUPTED)
    }
}
