//! Playing a path: every frame under every controller.

use super::metrics::{Metrics, Played};
use crate::pictures::{psnr, resized, sampled_size, scaled_size};
use anyhow::{Context, Result, ensure};
use entire_core::scene::{Frame, VolumeView};
use entire_io::dataset::{Clock, Timing};
use entire_io::options::{DrawSettings, is_software};
use entire_io::path::FlightPath;
use entire_io::progress::progress_bar;
use entire_steer::control::{ObserveFlags, Quality, Reason, Session, StepLimits};
use entire_steer::features::{Changes, VolumeSummary};
use entire_vk_raycaster::{Image, Renderer};

/// Quantity that a controller sets by its decision's `step`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ActsOn {
    /// The ray step.
    RayStep,
    /// Image resolution, at the reference step. A decision's step s means an image with 1/s of the pixels:
    /// each side is divided by √s.
    ImageResolution {
        /// Largest s by the rule's published constants; the smallest is 1.
        coarsest: f32,
    },
}

impl ActsOn {
    /// Name of the quantity in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::RayStep => "ray step",
            Self::ImageResolution { .. } => "image resolution",
        }
    }

    /// Limits of the quantity; `of_step` are the limits of the ray step.
    pub const fn limits(self, of_step: StepLimits) -> StepLimits {
        match self {
            Self::RayStep => of_step,
            Self::ImageResolution { coarsest } => StepLimits { finest: 1.0, coarsest },
        }
    }

    /// Returns ray step and image sample distance (pixels between rays along each side) for a decision's step
    /// `chosen`.
    pub fn drawn(self, chosen: f32) -> (f32, f32) {
        match self {
            Self::RayStep => (chosen, 1.0),
            Self::ImageResolution { .. } => (1.0, chosen.sqrt()),
        }
    }
}

/// A controller in the comparison, with its predictor and its learned state.
pub struct Contender {
    /// Name of the controller in tables.
    pub name: String,
    /// The session that plans the controller's frames and learns from their times.
    pub session: Session,
    /// True if the controller may choose the image sample distance in addition to the step, up to the
    /// course's maximum.
    pub chooses_image_sample_distance: bool,
    /// Quantity that the controller's decisions set.
    pub acts_on: ActsOn,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Record {
    /// Ray step, reference steps.
    pub(crate) step: f32,
    /// Pixels between rays along each side; 1 at full image size.
    pub(crate) image_sample_distance: f32,
    /// Size (width, height) of the drawn image, pixels.
    pub(crate) size: (u32, u32),
    /// Predicted seconds; NaN from controllers that predict nothing.
    pub(crate) predicted: f32,
    /// Upper bound, seconds; NaN where there is none.
    pub(crate) upper: f32,
    /// Out-of-range score: 0 inside the predictor's training range; outside, it grows with the distance from
    /// that range. NaN where unknown.
    pub(crate) out_of_range: f32,
    pub(crate) reason: Reason,
    /// Seconds by all clocks.
    pub(crate) measured: Timing,
    /// Seconds by the chosen clock.
    pub(crate) seconds: f64,
    /// PSNR against the reference picture, decibels.
    pub(crate) psnr: f64,
    /// The picture; `None` unless the frame is one of `Task::keep`.
    pub(crate) image: Option<Image>,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Reference {
    /// Seconds at the reference step by the chosen clock.
    pub(crate) seconds: f64,
    /// The picture; `None` unless the frame is one of `Task::keep`.
    pub(crate) image: Option<Image>,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Playback {
    pub(crate) names: Vec<String>,
    pub(crate) acts_on: Vec<ActsOn>,
    pub(crate) records: Vec<Vec<Record>>,
    pub(crate) references: Vec<Reference>,
    /// Frames at which the path switches abruptly, or the volume or the image size changes, ascending.
    pub(crate) switches: Vec<usize>,
    /// Target, seconds.
    pub(crate) target: f64,
    /// Full image size (width, height) of each frame, pixels.
    pub(crate) sizes: Vec<(u32, u32)>,
    pub(crate) volumes: Vec<usize>,
    pub(crate) limits: StepLimits,
}

impl Playback {
    /// Returns a controller's frames, as the metrics need them.
    pub(crate) fn played(&self, controller: usize) -> Vec<Played> {
        let acts_on = self.acts_on[controller];
        let limits = acts_on.limits(self.limits);
        let enlarged = |r: &Record| acts_on == ActsOn::RayStep && r.image_sample_distance > 1.0;
        let chosen = |r: &Record| match acts_on {
            ActsOn::RayStep => r.step,
            ActsOn::ImageResolution { .. } => r.image_sample_distance * r.image_sample_distance,
        };
        self.records[controller]
            .iter()
            .enumerate()
            .map(|(i, r)| Played {
                seconds: r.seconds,
                target: self.target,
                step: f64::from(chosen(r)),
                // A frame with fewer pixels than the full image is not of the finest quality, whatever its
                // step.
                finest: if enlarged(r) { 0.0 } else { f64::from(limits.finest) },
                coarsest: f64::from(limits.coarsest),
                psnr: r.psnr,
                switched: self.switches.binary_search(&i).is_ok(),
            })
            .collect()
    }

    pub(crate) fn metrics(&self) -> Vec<Metrics> {
        (0..self.names.len()).filter_map(|c| Metrics::of(&self.played(c))).collect()
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Shown<'a> {
    pub(crate) view: VolumeView<'a>,
    pub(crate) summary: VolumeSummary,
    /// VolumeNet's output for the volume, if a model uses it.
    pub(crate) volume_features: Option<Vec<f32>>,
}

/// Changes along a path that are not part of the path itself, and the limits of the controllers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Course<'a> {
    /// Frames per volume of a series; 0 for a single volume.
    pub(crate) hold: u32,
    /// Changes of the image size: first frame and share of the full side, in ascending order of the frames.
    pub(crate) scales: &'a [(u32, f32)],
    /// Largest image sample distance (pixels between rays along each side) of contenders that choose it; 1
    /// keeps the full image.
    pub(crate) max_image_sample_distance: f32,
    pub(crate) limits: StepLimits,
}

impl Course<'_> {
    pub(crate) fn steady(max_image_sample_distance: f32) -> Self {
        let limits = StepLimits::default();
        Self { hold: 0, scales: &[], max_image_sample_distance, limits }
    }
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Task<'a> {
    pub(crate) volumes: &'a [Shown<'a>],
    pub(crate) path: &'a FlightPath,
    /// Frames whose pictures are kept.
    pub(crate) keep: &'a [usize],
    pub(crate) course: Course<'a>,
    /// Target, seconds.
    pub(crate) target: f64,
}

/// Returns the index of the volume at a frame of a series: each volume is shown for `hold` frames in turn;
/// always 0 if `hold` is 0.
pub fn volume_at(hold: u32, volumes: usize, frame: usize) -> usize {
    if hold == 0 { 0 } else { (frame / hold as usize) % volumes.max(1) }
}

/// Returns the image scale at a frame: the scale of the last change at or before the frame, and 1 before the
/// first change.
pub fn scale_at(scales: &[(u32, f32)], frame: usize) -> f32 {
    scales.iter().rev().find(|(from, _)| *from as usize <= frame).map_or(1.0, |(_, scale)| *scale)
}

/// Sets the raycaster's picture quality law if the model states none.
pub(crate) fn choose_pictures(session: &mut Session) -> entire_core::Result<()> {
    session.set_quality(session.quality().or_else(|| Quality::built_in("vulkan")))
}

/// Plays a path under all contenders. Each frame is drawn at the reference step first, then under every
/// contender with its own step, so that noise of the machine affects all contenders equally. The order of the
/// contenders rotates by one from frame to frame. Changes of the transfer function are not timed.
///
/// Returns `None` when `stop` returned true.
pub(crate) fn play(
    task: &Task<'_>,
    draw: &DrawSettings,
    renderer: &mut dyn Renderer,
    contenders: &mut [Contender],
    stop: &dyn Fn() -> bool,
) -> Result<Option<Playback>> {
    ensure!(!contenders.is_empty(), "there is no controller to play");
    ensure!(!task.volumes.is_empty(), "there is no volume to show");
    for contender in contenders.iter_mut() {
        contender.session.set_limits(contender.acts_on.limits(task.course.limits))?;
        if contender.chooses_image_sample_distance {
            choose_pictures(&mut contender.session)?;
            contender.session.set_max_image_sample_distance(task.course.max_image_sample_distance, 1.0)?;
        }
    }
    let frames = task.path.frames.len();
    let volume_of = |i: usize| volume_at(task.course.hold, task.volumes.len(), i);
    let scale_of = |i: usize| scale_at(task.course.scales, i);
    let mut shown = usize::MAX;
    let mut playback = Playback {
        names: contenders.iter().map(|c| c.name.clone()).collect(),
        acts_on: contenders.iter().map(|c| c.acts_on).collect(),
        records: vec![Vec::with_capacity(task.path.frames.len()); contenders.len()],
        references: Vec::with_capacity(task.path.frames.len()),
        switches: (0..frames)
            .filter(|&i| {
                task.path.frames[i].switched()
                    || (i > 0 && (volume_of(i) != volume_of(i - 1) || (scale_of(i) != scale_of(i - 1))))
            })
            .collect(),
        target: task.target,
        sizes: (0..frames).map(|i| scaled_size((draw.width, draw.height), scale_of(i))).collect(),
        volumes: (0..frames).map(volume_of).collect(),
        limits: task.course.limits,
    };
    let bar = progress_bar("play");
    bar.set_length(task.path.frames.len() as u64);
    bar.reset_eta();
    // On a graphics device, processor time says nothing of other programs.
    let on_processors = draw.clock == Clock::Wall && is_software(renderer);
    for (index, at) in task.path.frames.iter().enumerate() {
        let place = || format!("frame {index} of the path");
        let volume = &task.volumes[volume_of(index)];
        let swapped = volume_of(index) != shown;
        if swapped {
            shown = volume_of(index);
            renderer.set_volume(&volume.view).with_context(place)?;
            for contender in contenders.iter_mut() {
                contender.session.set_volume(volume.summary.clone(), volume.volume_features.clone());
            }
        }
        if at.transfer_changed || swapped {
            let table = at.transfer.function().to_table().with_context(place)?;
            renderer.set_transfer(&table).with_context(place)?;
            let lobes = at.transfer.lobes();
            for contender in contenders.iter_mut() {
                contender.session.set_transfer(&table, lobes.as_deref()).with_context(place)?;
            }
        }
        let camera = task.path.camera(index).with_context(place)?;
        let (width, height) = playback.sizes[index];
        let frame = DrawSettings { width, height, ..*draw }.frame(camera).with_context(place)?;
        // These renderings are discarded, so that uploads and first-use work of the device count for no
        // contender.
        for _ in 0..if index == 0 { 2 } else { usize::from(swapped) } {
            renderer.render(&frame).with_context(place)?;
        }
        if stop() {
            return Ok(None);
        }
        let reference = renderer.render(&frame).with_context(place)?;
        let keep = task.keep.contains(&index);
        for turn in 0..contenders.len() {
            if stop() {
                return Ok(None);
            }
            let c = (index + turn) % contenders.len();
            let (chooses, acts_on) = (contenders[c].chooses_image_sample_distance, contenders[c].acts_on);
            let session = &mut contenders[c].session;
            if at.camera_switched {
                session.mark(Changes { camera: true, ..Changes::default() });
            }
            let plan = session.plan(&frame, task.target as f32).with_context(place)?;
            let full = (frame.width, frame.height);
            let (step, image_sample_distance, size) = if chooses {
                let distance = plan.image_sample_distance;
                (plan.step, distance, sampled_size(full, distance))
            } else {
                let (step, distance) = acts_on.drawn(plan.step);
                (step, distance, scaled_size(full, 1.0 / distance))
            };
            let drawn = DrawSettings { width: size.0, height: size.1, ..*draw }.frame(camera)?;
            let rendered = renderer.render(&Frame { step, ..drawn }.checked()?).with_context(place)?;
            let picture =
                resized(&rendered.image, frame.width, frame.height).context("an image without pixels")?;
            let measured = Timing::new(rendered.time, rendered.counts);
            let seconds = draw.seconds(&measured)?;
            if let Some(cpu) = measured.cpu.filter(|_| on_processors) {
                session.set_processor_seconds(cpu as f32);
            }
            // A coarse clock may count no time for a short frame.
            session.observe(plan.id, (seconds as f32).max(1e-9), ObserveFlags::default())?;
            playback.records[c].push(Record {
                step,
                image_sample_distance,
                size,
                predicted: plan.seconds,
                upper: plan.upper,
                out_of_range: plan.out_of_range,
                reason: plan.reason,
                measured,
                seconds,
                psnr: psnr(&picture.rgba, &reference.image.rgba).unwrap_or(0.0),
                image: keep.then_some(picture),
            });
        }
        let seconds = draw.seconds(&Timing::new(reference.time, reference.counts))?;
        playback.references.push(Reference { seconds, image: keep.then_some(reference.image) });
        bar.inc(1);
    }
    Ok(Some(playback))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scripted::ScriptedRenderer;
    use crate::steering::contenders::{ControllerKind, contender};
    use crate::steering::rivals::StepResponse;
    use entire_core::scene::{GaussianLobe, Scalars, Shading, Skipping, TransferFunction};
    use entire_io::path::{CameraPose, Keyframe, PATH_FORMAT, PathFile, Transfer};
    use entire_steer::predict::{Inputs, Prediction, Predictor, Source};

    /// A predictor that gives the seconds of the scripted renderer times `bias`.
    struct Insider {
        bias: f64,
    }

    impl Predictor for Insider {
        fn predict(&mut self, inputs: &Inputs<'_>) -> entire_core::Result<Prediction> {
            let law = ScriptedRenderer::default();
            let lobes = inputs.lobes.unwrap_or(&[]).to_vec();
            let weight = ScriptedRenderer::weight(&TransferFunction::Gaussian(lobes).to_table()?);
            let s = inputs.setting;
            let seconds = (law.seconds(weight, (s.width, s.height), s.step) * self.bias) as f32;
            Ok(Prediction { seconds, upper: f32::NAN, out_of_range: 0.0, source: Source::Network })
        }
    }

    fn path() -> FlightPath {
        let lobes = |height| Some(Transfer::Lobes(vec![GaussianLobe { center: 0.5, width: 0.05, height }]));
        let key = |frame, transfer, switch| Keyframe { frame, camera: None, transfer, switch };
        let camera = Some(CameraPose { rx_deg: 0.0, ry_deg: 0.0, dz_radii: 2.0, parallel_scale: None });
        PathFile {
            format: PATH_FORMAT.into(),
            name: "scripted".into(),
            frames: 80,
            fov_y_deg: 45.0,
            keyframes: vec![
                Keyframe { camera, ..key(0, lobes(0.15), false) },
                key(20, lobes(0.9), true),
                key(40, lobes(0.1), true),
                key(60, lobes(0.6), true),
            ],
        }
        .resolve()
        .unwrap()
    }

    fn play_scripted(noise: f64, bias: f64, stop_at: Option<u64>) -> Option<Playback> {
        play_scripted_with(&ControllerKind::DEFAULT_SET, noise, bias, stop_at, 1.0)
    }

    fn play_scripted_with(
        kinds: &[ControllerKind],
        noise: f64,
        bias: f64,
        stop_at: Option<u64>,
        distance: f32,
    ) -> Option<Playback> {
        let voxels = vec![128u8; 32 * 32 * 32];
        let view = VolumeView::new(Scalars::U8(&voxels), [32, 32, 32]).unwrap();
        let summary = VolumeSummary::new(&view).unwrap();
        let law = ScriptedRenderer::default();
        // G of the scripted renderer at a medium opacity, as samples of several scenes would give it.
        let at = |step: f64| law.fixed + 1e4 * 0.1 * law.per_sample * 100.0 / step;
        let samples: Vec<(f32, f32)> =
            [1.0, 2.0, 4.0, 8.0, 16.0].map(|s| (s as f32, (at(s) / at(1.0)) as f32)).to_vec();
        let response = StepResponse::from_samples(&samples).unwrap();
        let mut contenders: Vec<Contender> = kinds
            .iter()
            .map(|k| contender(*k, 1.0, Box::new(Insider { bias }), &response, Some(0.1)))
            .collect();
        let draw = DrawSettings {
            width: 100,
            height: 100,
            shading: Shading::None,
            skipping: Skipping::Blocks,
            termination: 0.99,
            clock: Clock::Wall,
        };
        let path = path();
        let shown = [Shown { view, summary, volume_features: None }];
        let course = Course::steady(distance);
        let task = Task { volumes: &shown, path: &path, keep: &[20], course, target: 1.4e-3 };
        let asked = std::cell::Cell::new(0u64);
        let stop = || {
            asked.set(asked.get() + 1);
            stop_at.is_some_and(|n| asked.get() > n)
        };
        let mut renderer = law;
        renderer.noise = noise;
        play(&task, &draw, &mut renderer, &mut contenders, &stop).unwrap()
    }

    #[test]
    fn prediction_beats_reaction_at_switches() {
        let playback = play_scripted(0.02, 1.1, None).unwrap();
        assert_eq!(playback.names, ["fixed", "olp", "last", "larger-of-two", "pid", "algorithm1", "hybrid"]);
        assert_eq!(playback.switches, [20, 40, 60]);
        let metrics = playback.metrics();
        let at_switches: Vec<f64> = metrics.iter().map(|m| m.mean_error_at_switches.unwrap()).collect();
        let [_, olp, last, larger, pid, algorithm1, hybrid] = at_switches[..] else { panic!() };
        // Algorithm 1 uses a single G for all scenes, so its error may be larger than that of the hybrid.
        assert!(algorithm1 < 0.7 * olp.min(pid), "{at_switches:?}");
        assert!(hybrid < 0.3 * olp.min(pid) && hybrid < last.min(larger), "{at_switches:?}");
        // The hybrid corrects the bias, so its error in calm phases is smaller than that of Algorithm 1.
        assert!(metrics[6].mean_error_in_calm.unwrap() < metrics[5].mean_error_in_calm.unwrap());
        let worst = |m: &Metrics| m.recovery_frames.iter().copied().max().unwrap();
        assert!(worst(&metrics[6]) == 0 && metrics[1..5].iter().all(|m| worst(m) > 0));
    }

    #[test]
    fn every_controller_sees_every_frame_and_kept_pictures_are_there() {
        let playback = play_scripted(0.0, 1.0, None).unwrap();
        assert!(playback.records.iter().all(|r| r.len() == 80) && playback.references.len() == 80);
        for records in &playback.records {
            for (i, r) in records.iter().enumerate() {
                assert_eq!(r.image.is_some(), i == 20);
                assert!(r.seconds > 0.0 && r.step >= 1.0 && r.step <= 16.0);
            }
        }
        // The fixed controller draws at the reference step, so its pictures equal the reference pictures.
        assert!(playback.records[0].iter().all(|r| r.psnr == f64::INFINITY && r.step == 1.0));
        let again = play_scripted(0.0, 1.0, None).unwrap();
        for (a, b) in playback.records.iter().flatten().zip(again.records.iter().flatten()) {
            assert_eq!((a.step.to_bits(), a.seconds.to_bits()), (b.step.to_bits(), b.seconds.to_bits()));
        }
    }

    #[test]
    fn who_chooses_the_size_meets_the_target_with_a_better_picture() {
        let plain = play_scripted(0.02, 1.1, None).unwrap();
        let sized = play_scripted_with(&ControllerKind::DEFAULT_SET, 0.02, 1.1, None, 2.0).unwrap();
        let hybrid = 6;
        // Only contenders that may choose the image size change it.
        assert!(plain.records.iter().flatten().all(|r| r.image_sample_distance == 1.0));
        for (k, records) in sized.records.iter().enumerate() {
            for r in records {
                assert!(
                    r.image_sample_distance == 1.0
                        || (k == hybrid && (1.0..=2.0).contains(&r.image_sample_distance)),
                    "{k}: {r:?}"
                );
            }
        }
        let smaller = sized.records[hybrid].iter().filter(|r| r.image_sample_distance > 1.0).count();
        assert!(smaller > 0, "no smaller picture");
        // By the quality law, a contender that chooses step and size has less error than one that chooses the
        // step alone. The first contender misses the target in at most one frame more than the second.
        let law = Quality::built_in("vulkan").unwrap();
        let error = |p: &Playback| -> f64 {
            p.records[hybrid][3..]
                .iter()
                .map(|r| law.error(f64::from(r.step), f64::from(r.image_sample_distance)))
                .sum()
        };
        assert!(error(&sized) < error(&plain), "{} {}", error(&sized), error(&plain));
        let missed = |p: &Playback| {
            let late = |r: &&Record| r.seconds > 1.1 * 1.4e-3;
            p.records[hybrid].iter().filter(late).count()
        };
        assert!(missed(&sized) <= missed(&plain) + 1, "{} {}", missed(&sized), missed(&plain));
        // Kept pictures have full size.
        let kept = sized.records[hybrid][20].image.as_ref().unwrap();
        assert_eq!((kept.width, kept.height), (100, 100));
    }

    #[test]
    fn rules_for_image_resolution_draw_smaller_images_at_the_reference_step() {
        let kinds = [ControllerKind::VtkFixedPoint, ControllerKind::Unreal, ControllerKind::VtkGpu];
        let playback = play_scripted_with(&kinds, 0.0, 1.0, None, 2.0).unwrap();
        let [fixed_point, unreal, gpu] = &playback.records[..] else { panic!() };
        for (records, largest) in [(fixed_point, 10.0), (unreal, 2.0)] {
            assert!(records.iter().all(|r| r.step == 1.0 && r.image_sample_distance <= largest));
            assert!(records.iter().any(|r| r.image_sample_distance > 1.1));
            let kept = records[20].image.as_ref().unwrap();
            assert_eq!((kept.width, kept.height), (100, 100));
        }
        assert!(gpu.iter().all(|r| r.image_sample_distance == 1.0) && gpu.iter().any(|r| r.step > 1.0));
        // VTK's rule draws the first frame with 1/25 of the pixels, so its work is 1/25 of the full image's.
        let law = ScriptedRenderer::default();
        let work = |r: &Record| r.seconds - law.fixed;
        let whole = playback.references[0].seconds - law.fixed;
        assert_eq!(fixed_point[0].image_sample_distance, 5.0);
        assert!((work(&fixed_point[0]) / whole * 25.0 - 1.0).abs() < 1e-3);
        // In the metrics of a controller that sets the image resolution, step and limits are numbers of
        // pixels of the full image for each drawn pixel.
        let played = playback.played(0);
        assert_eq!((played[0].step, played[0].finest, played[0].coarsest), (25.0, 1.0, 100.0));
        assert!(playback.metrics()[0].mean_step > 1.1);
    }

    #[test]
    fn stopping_gives_nothing() {
        assert!(play_scripted(0.0, 1.0, Some(7)).is_none());
    }
}
