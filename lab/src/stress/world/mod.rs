//! Scenes of real geometry: the CPU version of the raycaster counts the work of each frame, and a law
//! converts the counts to seconds. The predictor was fitted to frames of an ordinary volume.

mod scenes;

use super::{Noise, Seen, Verdict, judge};
use anyhow::{Context, Result, bail};
use entire_cli::steering::contenders::{ControllerKind, contender};
use entire_cli::steering::rivals::StepResponse;
use entire_core::scene::{Arcball, Camera, Frame, GaussianLobe, TransferFunction, TransferTable, VolumeView};
use entire_io::dataset::{Clock, Timing};
use entire_steer::control::{ObserveFlags, Session, StepLimits};
use entire_steer::features::{Changes, FrameFeatures, PROBE_SIDE, Setting, TransferSummary, VolumeSummary};
use entire_steer::predict::{AnalyticModel, UnitCosts};
use entire_vk_raycaster::{Renderer, WorkCounts};
use scenes::{Block, Shot, World, lobes, scene};

/// Limits of the ray step, reference steps.
const FINEST_STEP: f32 = 1.0;
const COARSEST_STEP: f32 = 12.0;
/// Standard deviation of the scripted clock's noise, in ln(seconds).
const SIGMA: f64 = 0.02;

/// Seconds of a frame on the scripted machine, whose unit costs have other ratios than the predictor's
/// defaults.
fn law(pixels: f64, counts: &WorkCounts) -> f64 {
    let n = |v: u64| v as f64;
    5e-5 + 3e-9 * pixels + 4e-8 * n(counts.rays) + 1.5e-8 * n(counts.skips) + 3e-8 * n(counts.samples)
}

pub(crate) struct Machine<'a> {
    /// The renderer; the CPU version on the scripted clock.
    pub(crate) renderer: &'a mut dyn Renderer,
    /// Clock of a real renderer. `None` for the scripted clock: the renderer counts work and `law` converts
    /// it to seconds, the same in every run.
    pub(crate) clock: Option<Clock>,
}

/// Factor on image sides on a real renderer, so that frame times are long enough to be measured.
const IMAGE_FACTOR: u32 = 4;

/// Numbers of this module's scenes that can be played on a real renderer. Scene number 12 is left out, since its
/// images are too large for a software driver. The scenes of other modules have no geometry.
pub(crate) const REAL_SCENES: [usize; 12] = [3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 14, 15];

impl Machine<'_> {
    fn is_real(&self) -> bool {
        self.clock.is_some()
    }

    fn grown(&self) -> u32 {
        if self.is_real() { IMAGE_FACTOR } else { 1 }
    }

    /// Shows the volume and the transfer function of a frame of a script.
    fn show(&mut self, shot: &Shot, views: &[VolumeView<'_>]) -> Result<()> {
        self.renderer.set_volume(&views[shot.volume])?;
        self.renderer.set_transfer(&TransferFunction::Gaussian(shot.lobes.clone()).to_table()?)?;
        Ok(())
    }

    /// A frame of a script. On a real renderer, the image sides are enlarged by [`IMAGE_FACTOR`].
    fn frame(&self, shot: &Shot) -> Result<Frame> {
        let camera = Camera::from_arcball(shot.camera)?;
        Ok(Frame::new(camera, self.grown() * shot.size.0, self.grown() * shot.size.1)?)
    }

    fn seconds(&mut self, frame: &Frame) -> Result<f64> {
        let rendered = self.renderer.render(frame)?;
        match self.clock {
            None => Ok(law(pixels(frame), &rendered.counts.context("counts are missing")?)),
            Some(clock) => Timing::new(rendered.time, rendered.counts).seconds(clock).with_context(|| {
                format!("the renderer has no {} clock; choose another with --clock", clock.name())
            }),
        }
    }
}

/// The predictor, fitted to frames of an ordinary ball on this machine.
fn fitted(machine: &mut Machine<'_>) -> Result<AnalyticModel> {
    let block = Block::ball(32, 0.05);
    let view = block.view()?;
    let summary = VolumeSummary::new(&view)?;
    machine.renderer.set_volume(&view)?;
    let mut rows = Vec::new();
    let mut noise = Noise::new(3);
    for k in 0..24 {
        let table = TransferFunction::Gaussian(lobes(
            noise.uniform() as f32,
            libm::exp(-6.0 + 4.0 * noise.uniform()) as f32,
            libm::exp(-5.0 + 5.0 * noise.uniform()) as f32,
        ))
        .to_table()?;
        machine.renderer.set_transfer(&table)?;
        let mut transfer = TransferSummary::new(&summary, &table)?;
        let camera =
            Arcball { rx: 90.0 * noise.uniform() as f32, ry: 15.0 * k as f32, dz: 1.3 + 0.1 * k as f32 };
        let side = machine.grown() * [24, 40, 64][k % 3];
        for step in [1.0, 2.0, 5.0] {
            let frame = Frame { step, ..Frame::new(Camera::from_arcball(camera)?, side, side)? }.checked()?;
            let features = FrameFeatures::of(&summary, &mut transfer, &frame, PROBE_SIDE)?;
            let seconds = machine.seconds(&frame)?;
            rows.push((features.cost_work(&Setting::from(&frame)), seconds));
        }
    }
    Ok(AnalyticModel::fit(&UnitCosts::SOFTWARE, &rows, PROBE_SIDE)?.0)
}

fn pixels(frame: &Frame) -> f64 {
    f64::from(frame.width) * f64::from(frame.height)
}

/// Seconds of a frame at a step, without noise of the scripted clock.
fn truth(machine: &mut Machine<'_>, shot: &Shot, frame: &Frame, step: f32) -> Result<f64> {
    if machine.is_real() {
        return Ok(shot.speed * machine.seconds(&Frame { step, ..*frame }.checked()?)?);
    }
    let drawn = Frame { step, ..Frame::new(frame.camera, shot.drawn.0, shot.drawn.1)? }.checked()?;
    let counts = machine.renderer.render(&drawn)?.counts.context("counts are missing")?;
    let scale = pixels(frame) / pixels(&drawn);
    let up = |n: u64| (n as f64 * scale) as u64;
    let counts = WorkCounts {
        rays: up(counts.rays),
        samples: up(counts.samples),
        skips: up(counts.skips),
        shaded: up(counts.shaded),
    };
    Ok(shot.speed * law(pixels(frame), &counts))
}

/// A session of a method with a fitted predictor.
fn session_of(method: ControllerKind, model: AnalyticModel) -> Session {
    let response = StepResponse::inverse_step(0.1);
    contender(method, 2.0, Box::new(model), &response, Some(0.2)).session
}

/// Plays a scene of real geometry. On a real machine the limits are wider, since the noise is unpredictable.
/// The share of frames over 1.1 times the target may be 5 percentage points higher, with two more in a row;
/// quality may be 0.1 lower; 80 % of first frames within their bound suffice.
pub(crate) fn play(number: usize, method: ControllerKind, machine: &mut Machine<'_>) -> Result<Verdict> {
    let Some(mut world) = scene(number) else {
        bail!("there is no stress scene {number}; they are numbered 1 to {}", super::SCENES.len())
    };
    if machine.is_real() {
        let l = &mut world.limits;
        l.missed += 0.05;
        l.run = l.run.saturating_add(2);
        l.quality -= 0.1;
        l.inside = l.inside.min(0.8);
    }
    let mut session = session_of(method, fitted(machine)?);
    session.set_limits(StepLimits { finest: FINEST_STEP, coarsest: COARSEST_STEP })?;
    let views: Vec<VolumeView<'_>> = world.blocks.iter().map(Block::view).collect::<Result<_>>()?;
    let summaries: Vec<VolumeSummary> =
        views.iter().map(|v| Ok(VolumeSummary::new(v)?)).collect::<Result<_>>()?;
    let mut noise = Noise::new(number as u64);
    let mut seen: Vec<Seen> = Vec::with_capacity(world.frames);
    let mut broken = Vec::new();
    let mut shown: Option<(usize, Vec<GaussianLobe>)> = None;
    let mut target = 0.0;
    let mut sized = (0, 0);
    for i in 0..world.frames {
        let shot = (world.shot)(i);
        let swapped = shown.as_ref().is_none_or(|(v, _)| *v != shot.volume);
        let edited = swapped || shown.as_ref().is_none_or(|(_, l)| *l != shot.lobes);
        if swapped {
            machine.renderer.set_volume(&views[shot.volume])?;
            session.set_volume(summaries[shot.volume].clone(), None);
        }
        if edited {
            let table: TransferTable = TransferFunction::Gaussian(shot.lobes.clone()).to_table()?;
            machine.renderer.set_transfer(&table)?;
            session.set_transfer(&table, Some(&shot.lobes))?;
        }
        shown = Some((shot.volume, shot.lobes.clone()));
        if shot.camera_cut {
            session.mark(Changes { camera: true, ..Changes::default() });
        }
        let frame = machine.frame(&shot)?;
        if machine.is_real() && edited {
            // Uploads and the first use of a volume or transfer function are not part of frame times.
            truth(machine, &shot, &frame, FINEST_STEP)?;
        }
        // The oracle knows these times at a grid of steps.
        let grid: Vec<(f64, f64)> = [1.0f32, 1.5, 2.2, 3.3, 5.0, 7.7, 12.0]
            .into_iter()
            .map(|s| Ok((f64::from(s), truth(machine, &shot, &frame, s)?)))
            .collect::<Result<_>>()?;
        if i == 0 || (number == 12 && sized != shot.size) {
            // In scene 12, every image size has its own target; in other scenes, one target holds for the
            // whole path.
            target = world.share
                * grid[0].1
                * if i == 0 && number != 12 { typical(machine, &world, &views)? / grid[0].1 } else { 1.0 };
            if number != 12 {
                machine.show(&shot, &views)?;
            }
        }
        let first = i > 0 && (edited || sized != shot.size);
        sized = shot.size;
        let plan = session.plan(&frame, target as f32)?;
        let clean = truth(machine, &shot, &frame, plan.step)?;
        let seconds = if machine.is_real() { clean } else { clean * (SIGMA * noise.normal()).exp() };
        session.observe(plan.id, seconds as f32, ObserveFlags::default())?;
        if method == ControllerKind::Hybrid
            && !(plan.seconds.is_finite()
                && plan.seconds > 0.0
                && plan.upper.is_finite()
                && plan.upper >= plan.seconds)
        {
            broken.push(format!("frame {i}: {} s expected, bound {} s", plan.seconds, plan.upper));
        }
        let oracle = oracle(&grid, target);
        seen.push(Seen {
            target,
            seconds,
            clean,
            step: f64::from(plan.step),
            oracle,
            feasible: grid[grid.len() - 1].1 <= target,
            upper: f64::from(plan.upper),
            predicted: f64::from(plan.seconds),
            first,
            excused: i == 0,
            part: 0,
        });
    }
    let feasible = seen.iter().filter(|s| s.feasible).count();
    if 2 * feasible < seen.len() {
        broken.push(format!("the coarsest step misses the target in {} frames", seen.len() - feasible));
    }
    if number == 12 {
        // The target of an image size is computed from the first frame of this size, so this frame is not
        // compared with its upper bound.
        seen.iter_mut().for_each(|s| s.first = false);
    }
    Ok(judge(number, method, &seen, world.limits, broken))
}

/// Median of the seconds at the finest step, over every fourth frame.
fn typical(machine: &mut Machine<'_>, world: &World, views: &[VolumeView<'_>]) -> Result<f64> {
    let mut times = Vec::new();
    for i in (0..world.frames).step_by(4) {
        let shot = (world.shot)(i);
        machine.show(&shot, views)?;
        let frame = machine.frame(&shot)?;
        times.push(truth(machine, &shot, &frame, FINEST_STEP)?);
    }
    entire_io::metrics::median(&mut times).context("a scene without frames")
}

/// Returns the finest step that meets the target, interpolated on the grid of (step, seconds).
fn oracle(grid: &[(f64, f64)], target: f64) -> f64 {
    if grid[0].1 <= target {
        return grid[0].0;
    }
    for pair in grid.windows(2) {
        let ((s0, t0), (s1, t1)) = (pair[0], pair[1]);
        if t1 <= target {
            let share = if t0 > t1 { (t0 / target).ln() / (t0 / t1).ln() } else { 1.0 };
            return s0 * (s1 / s0).powf(share);
        }
    }
    grid[grid.len() - 1].0
}

#[cfg(test)]
mod tests {
    use super::scenes::shell;
    use super::*;
    use clap::ValueEnum;
    use entire_core::model::Model;
    use entire_steer::predict::{Inputs, load};
    use entire_vk_raycaster::CpuRaycaster;

    /// Seconds that the model in `bytes` predicts for a frame; `None` if the file or the frame is refused.
    fn predicted(bytes: &[u8], features: &FrameFeatures, frame: &Frame) -> Option<f32> {
        let mut predictor = match Model::from_bytes(bytes).and_then(|model| load(&model)) {
            Ok(predictor) => predictor,
            Err(error) => {
                assert!(!error.to_string().is_empty());
                return None;
            }
        };
        let inputs = Inputs {
            features,
            setting: Setting::from(frame),
            changes: Changes::default(),
            camera: frame.camera.to_arcball(),
            volume_features: None,
            lobes: None,
        };
        predictor.predict(&inputs).ok().map(|p| p.seconds)
    }

    #[test]
    fn damaged_models_and_states_are_refused_or_every_prediction_is_finite() {
        let mut twin = CpuRaycaster::new();
        let model = fitted(&mut Machine { renderer: &mut twin, clock: None }).unwrap();
        let good = model.to_model_file().unwrap().to_bytes().unwrap();
        let block = Block::ball(16, 0.0);
        let summary = VolumeSummary::new(&block.view().unwrap()).unwrap();
        let table = TransferFunction::Gaussian(shell()).to_table().unwrap();
        let mut transfer = TransferSummary::new(&summary, &table).unwrap();
        let camera = Camera::from_arcball(Arcball { rx: 0.0, ry: 0.0, dz: 2.0 }).unwrap();
        let frame = Frame::new(camera, 64, 64).unwrap();
        let features = FrameFeatures::of(&summary, &mut transfer, &frame, PROBE_SIDE).unwrap();
        assert!(predicted(&good, &features, &frame).is_some());
        let mut noise = Noise::new(28);
        let mut files = vec![Vec::new(), b"not a model".to_vec(), vec![0; 64]];
        for k in 0..200 {
            let mut bytes = good.clone();
            let at = (noise.uniform() * (good.len() - 8) as f64) as usize;
            match k % 4 {
                0 => bytes.truncate(at),
                1 => bytes[at] ^= 1 << (k % 8),
                2 => bytes[at..at + 8].fill(0xff),
                _ => bytes.extend_from_slice(b"trailing"),
            }
            files.push(bytes);
        }
        let read: Vec<f32> = files.iter().filter_map(|f| predicted(f, &features, &frame)).collect();
        assert!(read.iter().all(|s| s.is_finite() && *s > 0.0), "{read:?}");
        assert!(read.len() <= 103, "{} of {} damaged files were read", read.len(), files.len());
        for &method in ControllerKind::value_variants() {
            let mut session = session_of(method, model.clone());
            session.set_volume(summary.clone(), None);
            session.set_transfer(&table, None).unwrap();
            let state = session.save_state();
            let before = session.plan(&frame, 0.01).unwrap().step;
            for cut in 0..state.len() {
                assert!(session.load_state(&state[..cut]).is_err(), "{}: cut to {cut} bytes", method.name());
            }
            assert!(session.load_state(b"ENS1not a state").is_err());
            session.load_state(&state).unwrap();
            let after = session.plan(&frame, 0.01).unwrap().step;
            assert!(
                after.is_finite() && (after / before).ln().abs() < 1.0,
                "{}: {before} {after}",
                method.name()
            );
        }
    }
}
