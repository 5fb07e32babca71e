//! Scenes of real geometry: the CPU twin of the raycaster counts each frame's work, and a law that the predictor was
//! fitted to on an ordinary volume turns counts into seconds.

use super::{Limits, Noise, Seen, Verdict, judge};
use anyhow::{Context, Result, bail};
use entire_cli::dataset::Clock;
use entire_cli::steering::contenders::{ControllerKind, contender};
use entire_cli::steering::play::Contender;
use entire_cli::steering::rivals::StepResponse;
use entire_core::adapt::{ObserveFlags, Prior};
use entire_core::control::StepLimits;
use entire_core::features::{
    Changes, FrameFeatures, Setting, SummaryOptions, TransferSummary, VolumeSummary,
};
use entire_core::model::Model;
use entire_core::predict::{AnalyticModel, Inputs, WorkSample, load};
use entire_core::scene::{
    Arcball, Camera, Frame, GaussianLobe, Scalars, TransferFunction, TransferTable, VolumeView,
};
use entire_vk_raycaster::{CpuRaycaster, Renderer, WorkCounts};

/// Steps that may be chosen.
const FINEST: f32 = 1.0;
const COARSEST: f32 = 12.0;
/// Spread of the scripted clock in ln(seconds).
const SIGMA: f64 = 0.02;

/// The machine: seconds of a frame's work. Other ratios than the predictor's defaults.
fn law(pixels: f64, counts: &WorkCounts) -> f64 {
    let n = |v: u64| v as f64;
    5e-5 + 3e-9 * pixels + 4e-8 * n(counts.rays) + 1.5e-8 * n(counts.skips) + 3e-8 * n(counts.samples)
}

/// A volume of a scene.
#[derive(Clone)]
struct Block {
    dims: [usize; 3],
    spacing: [f32; 3],
    voxels: Vec<f32>,
}

impl Block {
    fn new(dims: [usize; 3], f: impl Fn([f32; 3]) -> f32) -> Self {
        let mut voxels = Vec::with_capacity(dims.iter().product());
        for z in 0..dims[2] {
            for y in 0..dims[1] {
                for x in 0..dims[0] {
                    let at = |i: usize, n: usize| (i as f32 + 0.5) / n as f32 * 2.0 - 1.0;
                    voxels.push(f([at(x, dims[0]), at(y, dims[1]), at(z, dims[2])]));
                }
            }
        }
        Self { dims, spacing: [1.0; 3], voxels }
    }

    fn ball(n: usize, wave: f32) -> Self {
        Self::new([n; 3], |p| {
            let r = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
            (1.0 - r + wave * (9.0 * p[0]).sin() * (7.0 * p[1]).cos()).clamp(0.0, 1.0)
        })
    }

    fn noise(n: usize, seed: u64) -> Self {
        let mut source = Noise::new(seed);
        let mut block = Self::new([n; 3], |_| 0.0);
        block.voxels.iter_mut().for_each(|v| *v = source.uniform() as f32);
        block
    }

    fn view(&self) -> Result<VolumeView<'_>> {
        Ok(VolumeView::new(Scalars::F32(&self.voxels), self.dims)?.with_spacing(self.spacing)?)
    }
}

fn lobes(center: f32, width: f32, height: f32) -> Vec<GaussianLobe> {
    vec![GaussianLobe { center, width, height }]
}

fn shell() -> Vec<GaussianLobe> {
    lobes(0.5, 0.01, 0.4)
}

fn haze() -> Vec<GaussianLobe> {
    lobes(0.5, 0.5, 0.004)
}

/// What a frame of a scene is.
#[derive(Clone)]
struct Shot {
    volume: usize,
    lobes: Vec<GaussianLobe>,
    camera: Arcball,
    size: (u32, u32),
    /// The twin draws at this size and its counts are scaled: for images too large to draw.
    drawn: (u32, u32),
    /// What nobody models.
    speed: f64,
    camera_cut: bool,
}

impl Shot {
    fn plain(i: usize) -> Self {
        Self {
            volume: 0,
            lobes: shell(),
            camera: Arcball { rx: 20.0, ry: 5.0 * i as f32, dz: 2.2 },
            size: (48, 48),
            drawn: (48, 48),
            speed: 1.0,
            camera_cut: false,
        }
    }
}

struct World {
    blocks: Vec<Block>,
    shot: Box<dyn Fn(usize) -> Shot>,
    frames: usize,
    /// Share of the median frame's time at the finest step that is the target.
    share: f64,
    limits: Limits,
}

/// What draws, and what clock runs.
pub enum Machine<'a> {
    /// The CPU twin counts work and `law` makes seconds of it: the same in every run.
    Scripted(Box<CpuRaycaster>),
    /// A real renderer and its clock. Images are [`GROWN`] times as large, so that there is something to time.
    Real(&'a mut dyn Renderer, Clock),
}

/// Factor of image sides on a real clock.
pub const GROWN: u32 = 4;

/// Scenes that make sense on a real renderer. The image sizes of scene 12 are more than a software driver can be asked
/// for; scene 28 draws nothing.
pub const REAL: [usize; 12] = [3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 14, 15];

impl Machine<'_> {
    fn renderer(&mut self) -> &mut dyn Renderer {
        match self {
            Self::Scripted(twin) => twin.as_mut(),
            Self::Real(renderer, _) => &mut **renderer,
        }
    }

    fn grown(&self) -> u32 {
        match self {
            Self::Scripted(_) => 1,
            Self::Real(..) => GROWN,
        }
    }

    fn is_real(&self) -> bool {
        matches!(self, Self::Real(..))
    }

    /// Draws a frame and says how long it took.
    fn seconds(&mut self, frame: &Frame) -> Result<f64> {
        let rendered = self.renderer().render(frame)?;
        match self {
            Self::Scripted(_) => Ok(law(frame.pixels() as f64, &rendered.counts.context("the twin counts")?)),
            Self::Real(_, clock) => {
                entire_cli::dataset::Timing::new(rendered.time, rendered.counts).seconds(*clock).with_context(
                    || format!("the renderer has no {} clock; choose another with --clock", clock.name()),
                )
            }
        }
    }
}

/// The predictor: fitted to frames of an ordinary ball on the machine.
fn fitted(machine: &mut Machine<'_>) -> Result<AnalyticModel> {
    let block = Block::ball(32, 0.05);
    let view = block.view()?;
    let summary = VolumeSummary::new(&view, SummaryOptions::default())?;
    machine.renderer().set_volume(&view)?;
    let mut rows = Vec::new();
    let mut features = FrameFeatures::new();
    let mut noise = Noise::new(3);
    for k in 0..24 {
        let table = TransferFunction::Gaussian(lobes(
            noise.uniform() as f32,
            libm::exp(-6.0 + 4.0 * noise.uniform()) as f32,
            libm::exp(-5.0 + 5.0 * noise.uniform()) as f32,
        ))
        .to_table()?;
        machine.renderer().set_transfer(&table)?;
        let transfer = TransferSummary::new(&summary, &table);
        let camera =
            Arcball { rx: 90.0 * noise.uniform() as f32, ry: 15.0 * k as f32, dz: 1.3 + 0.1 * k as f32 };
        let side = machine.grown() * [24, 40, 64][k % 3];
        for step in [1.0, 2.0, 5.0] {
            let frame = Frame::new(Camera::from_arcball(camera)?, side, side)?.with_step(step)?;
            features.measure(&summary, &transfer, &frame);
            let seconds = machine.seconds(&frame)?;
            rows.push(WorkSample::new(&features, &Setting::of(&frame), seconds));
        }
    }
    let mut model = AnalyticModel::new();
    model.fit(&rows)?;
    Ok(model)
}

fn scene(number: usize) -> Option<World> {
    let strict = |missed, run| Limits { missed, run, quality: 0.6, inside: 0.9 };
    let loose = |missed| Limits { quality: 0.5, ..Limits::missed(missed) };
    let world = |blocks: Vec<Block>, limits: Limits, shot: Box<dyn Fn(usize) -> Shot>| World {
        blocks,
        shot,
        frames: 60,
        share: 0.5,
        limits,
    };
    let ball = || vec![Block::ball(32, 0.05)];
    Some(match number {
        3 => world(
            ball(),
            strict(0.10, 3),
            Box::new(|i| Shot {
                camera: Arcball { rx: 10.0, ry: 2.0 * i as f32, dz: (2.4 - 0.045 * i as f32).max(0.02) },
                ..Shot::plain(i)
            }),
        ),
        4 => world(
            ball(),
            strict(0.10, 3),
            Box::new(|i| Shot {
                // In to a single block, out to a few pixels, in steps of a few percent.
                camera: Arcball {
                    rx: 10.0,
                    ry: 30.0,
                    dz: if i < 30 { 2.0 * 0.9f32.powi(i as i32) } else { 0.1 * 1.2f32.powi(i as i32 - 30) },
                },
                ..Shot::plain(i)
            }),
        ),
        5 => world(
            ball(),
            loose(0.10),
            Box::new(|i| Shot {
                lobes: if i / 15 % 2 == 1 { lobes(0.5, 0.01, 0.0) } else { shell() },
                ..Shot::plain(i)
            }),
        ),
        6 => world(
            ball(),
            strict(0.10, 2),
            Box::new(|i| Shot {
                lobes: if i / 15 % 2 == 1 { lobes(0.5, 100.0, 1.0) } else { haze() },
                ..Shot::plain(i)
            }),
        ),
        7 => world(
            ball(),
            strict(0.10, 2),
            Box::new(|i| Shot { lobes: if i / 12 % 2 == 1 { haze() } else { shell() }, ..Shot::plain(i) }),
        ),
        8 => world(
            vec![Block::noise(32, 5)],
            strict(0.10, 3),
            Box::new(|i| Shot {
                lobes: if i / 15 % 2 == 1 { lobes(0.9, 0.01, 0.3) } else { lobes(0.5, 0.05, 0.02) },
                ..Shot::plain(i)
            }),
        ),
        9 => {
            let constant = Block::new([24; 3], |_| 0.7);
            let two = Block::new([24; 3], |p| if p[0] + p[1] > 0.3 { 1.0 } else { 0.0 });
            let mut single = Block::new([24; 3], |_| 0.0);
            single.voxels[24 * 24 * 12 + 24 * 12 + 12] = 1.0;
            world(
                vec![constant, two, single],
                loose(0.10),
                Box::new(|i| Shot {
                    volume: i / 20,
                    lobes: [haze(), lobes(0.9, 0.05, 0.3), lobes(1.0, 0.1, 0.5)][i / 7 % 3].clone(),
                    ..Shot::plain(i)
                }),
            )
        }
        10 => {
            let mut holes = Block::ball(24, 0.0);
            holes.voxels.iter_mut().step_by(7).for_each(|v| *v = f32::NAN);
            holes.voxels.iter_mut().step_by(11).for_each(|v| *v = f32::INFINITY);
            let mut none = Block::ball(24, 0.0);
            none.voxels.fill(f32::NAN);
            let mut signed = Block::ball(24, 0.0);
            signed.voxels.iter_mut().for_each(|v| *v *= -3000.0);
            let mut squeezed = Block::ball(24, 0.0);
            squeezed.voxels.iter_mut().for_each(|v| *v *= 600.0);
            squeezed.voxels[0] = 65_535.0;
            world(
                vec![holes, none, signed, squeezed],
                loose(0.10),
                Box::new(|i| Shot {
                    volume: i / 15,
                    lobes: [haze(), shell()][i / 5 % 2].clone(),
                    ..Shot::plain(i)
                }),
            )
        }
        11 => {
            let wave = |p: [f32; 3]| 0.5 + 0.5 * (6.0 * p[0]).sin() * (5.0 * p[1]).cos();
            let mut flat = Block::new([48, 48, 4], wave);
            flat.spacing = [1.0, 1.0, 10.0];
            let slice = Block::new([40, 40, 1], wave);
            let needle = Block::new([256, 4, 4], wave);
            let flat = world(
                vec![flat, slice, needle],
                loose(0.10),
                Box::new(|i| Shot {
                    volume: i / 20,
                    camera: Arcball { rx: 30.0, ry: 3.0 * i as f32, dz: 1.8 },
                    lobes: lobes(0.6, 0.05, 0.1),
                    ..Shot::plain(i)
                }),
            );
            // Few samples are all there are: little can be saved.
            World { share: 1.1, ..flat }
        }
        12 => world(
            ball(),
            loose(0.15),
            Box::new(|i| {
                let size = [(32, 32), (8192, 8192), (3, 900), (1920, 80), (64, 64), (4096, 2160)][i / 10];
                let shrink = (f64::from(size.0.max(size.1)) / 64.0).max(1.0);
                let side = |n: u32| ((f64::from(n) / shrink).round() as u32).max(1);
                Shot { size, drawn: (side(size.0), side(size.1)), ..Shot::plain(i) }
            }),
        ),
        13 => world(
            ball(),
            strict(0.10, 2),
            Box::new(|i| {
                let n = [48, 96, 24, 64][i / 15];
                Shot { size: (n, n), drawn: (n, n), ..Shot::plain(i) }
            }),
        ),
        14 => world(
            (0..6).map(|k| Block::ball(28, 0.04 + 0.03 * k as f32)).collect(),
            strict(0.10, 3),
            Box::new(|i| Shot { volume: i % 6, ..Shot::plain(i) }),
        ),
        15 => world(
            vec![
                Block::new([32; 3], |p| {
                    // Labels: whole numbers that jump.
                    ((p[0] * 3.0).floor() + 3.0 * (p[1] * 3.0).floor() + 5.0 * (p[2] * 2.0).floor())
                        .rem_euclid(7.0)
                }),
                Block::noise(32, 9),
                Block::new([32; 3], |p| ((40.0 * p[2] + 6.0 * (4.0 * p[0]).sin()).sin() * 0.5 + 0.5).powi(6)),
            ],
            strict(0.12, 3),
            Box::new(|i| Shot {
                volume: i / 20,
                lobes: [lobes(0.5, 0.02, 0.2), haze()][i / 10 % 2].clone(),
                speed: 2.0,
                ..Shot::plain(i)
            }),
        ),
        _ => return None,
    })
}

/// One frame's time at a step.
fn truth(machine: &mut Machine<'_>, shot: &Shot, frame: &Frame, step: f32) -> Result<f64> {
    let twin = match machine {
        Machine::Scripted(twin) => twin.as_mut(),
        Machine::Real(..) => return Ok(shot.speed * machine.seconds(&frame.with_step(step)?)?),
    };
    let drawn = Frame::new(*frame.camera(), shot.drawn.0, shot.drawn.1)?.with_step(step)?;
    let counts = twin.render(&drawn)?.counts.context("the twin counts")?;
    let scale = frame.pixels() as f64 / drawn.pixels() as f64;
    let up = |n: u64| (n as f64 * scale) as u64;
    let counts = WorkCounts {
        rays: up(counts.rays),
        samples: up(counts.samples),
        skips: up(counts.skips),
        shaded: up(counts.shaded),
    };
    Ok(shot.speed * law(frame.pixels() as f64, &counts))
}

/// Plays a scene of this file. On a real machine the rules leave room for its noise, which nobody can foresee: a twentieth
/// more frames may be over, two more in a row, and quality may be a tenth lower.
///
/// # Errors
/// When it cannot be set up, or is not one of them.
pub fn play(number: usize, method: ControllerKind, machine: &mut Machine<'_>) -> Result<Verdict> {
    if number == 28 {
        return damaged(method, machine);
    }
    let Some(mut world) = scene(number) else {
        bail!("there is no stress scene {number}; they are numbered 1 to 28")
    };
    if machine.is_real() {
        let l = &mut world.limits;
        l.missed += 0.05;
        l.run = l.run.saturating_add(2);
        l.quality -= 0.1;
        l.inside = l.inside.min(0.8);
    }
    let grown = machine.grown();
    let model = fitted(machine)?;
    let response = StepResponse::inverse_step(0.1);
    let mut who: Contender =
        contender(method, 2.0, Box::new(model), &response, Prior::Fitted { log_sd: 0.2 });
    let limits = StepLimits::new(FINEST, COARSEST)?;
    who.session.set_limits(limits);
    let views: Vec<VolumeView<'_>> = world.blocks.iter().map(Block::view).collect::<Result<_>>()?;
    let summaries: Vec<VolumeSummary> =
        views.iter().map(|v| Ok(VolumeSummary::new(v, SummaryOptions::default())?)).collect::<Result<_>>()?;
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
            machine.renderer().set_volume(&views[shot.volume])?;
            who.session.set_volume(summaries[shot.volume].clone(), None);
        }
        if edited {
            let table: TransferTable = TransferFunction::Gaussian(shot.lobes.clone()).to_table()?;
            machine.renderer().set_transfer(&table)?;
            who.session.set_transfer(&table, Some(&shot.lobes))?;
        }
        shown = Some((shot.volume, shot.lobes.clone()));
        if shot.camera_cut {
            who.session.mark(Changes { camera: true, ..Changes::NONE });
        }
        let frame = Frame::new(Camera::from_arcball(shot.camera)?, grown * shot.size.0, grown * shot.size.1)?;
        if machine.is_real() && edited {
            // Uploads and first use are not part of frame times.
            truth(machine, &shot, &frame, FINEST)?;
        }
        // The grid that the oracle knows.
        let grid: Vec<(f64, f64)> = [1.0f32, 1.5, 2.2, 3.3, 5.0, 7.7, 12.0]
            .into_iter()
            .map(|s| Ok((f64::from(s), truth(machine, &shot, &frame, s)?)))
            .collect::<Result<_>>()?;
        if i == 0 || (number == 12 && sized != shot.size) {
            // Every image size has a target of its own there; else one holds for the whole path.
            target = world.share
                * grid[0].1
                * if i == 0 && number != 12 { typical(machine, &world, &views)? / grid[0].1 } else { 1.0 };
            if number != 12 {
                machine.renderer().set_volume(&views[shot.volume])?;
                machine
                    .renderer()
                    .set_transfer(&TransferFunction::Gaussian(shot.lobes.clone()).to_table()?)?;
            }
        }
        let first = i > 0 && (edited || sized != shot.size);
        sized = shot.size;
        let plan = who.session.plan(&frame, target as f32)?;
        let clean = truth(machine, &shot, &frame, plan.step)?;
        let seconds = if machine.is_real() { clean } else { clean * (SIGMA * noise.normal()).exp() };
        who.session.observe(plan.id, seconds as f32, ObserveFlags::default())?;
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
            part: shot.volume,
        });
    }
    let feasible = seen.iter().filter(|s| s.feasible).count();
    if 2 * feasible < seen.len() {
        broken.push(format!("the script asks for what cannot be in {} frames", seen.len() - feasible));
    }
    if number == 12 {
        // The first frame of a size is where its target is set too.
        seen.iter_mut().for_each(|s| s.first = false);
    }
    Ok(judge(number, method, &seen, world.limits, broken))
}

/// Median over some frames of the time at the finest step.
fn typical(machine: &mut Machine<'_>, world: &World, views: &[VolumeView<'_>]) -> Result<f64> {
    let mut times = Vec::new();
    for i in (0..world.frames).step_by(4) {
        let shot = (world.shot)(i);
        machine.renderer().set_volume(&views[shot.volume])?;
        machine.renderer().set_transfer(&TransferFunction::Gaussian(shot.lobes.clone()).to_table()?)?;
        let frame = Frame::new(
            Camera::from_arcball(shot.camera)?,
            machine.grown() * shot.size.0,
            machine.grown() * shot.size.1,
        )?;
        times.push(truth(machine, &shot, &frame, FINEST)?);
    }
    entire_cli::metrics::median(&mut times).context("a scene without frames")
}

/// The step that takes the target, between the grid's.
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

/// Scene 28: model files and states that were damaged.
fn damaged(method: ControllerKind, machine: &mut Machine<'_>) -> Result<Verdict> {
    let mut broken = Vec::new();
    let model = fitted(machine)?;
    let good = model.to_model_file()?.to_bytes()?;
    let block = Block::ball(16, 0.0);
    let summary = VolumeSummary::new(&block.view()?, SummaryOptions::default())?;
    let table = TransferFunction::Gaussian(shell()).to_table()?;
    let transfer = TransferSummary::new(&summary, &table);
    let frame = Frame::new(Camera::from_arcball(Arcball { rx: 0.0, ry: 0.0, dz: 2.0 })?, 64, 64)?;
    let mut features = FrameFeatures::new();
    features.measure(&summary, &transfer, &frame);
    let mut noise = Noise::new(28);
    let (mut refused, mut read) = (0, 0);
    let mut check = |bytes: &[u8], what: &str| match Model::from_bytes(bytes).and_then(|m| load(&m)) {
        Err(e) if e.message().is_empty() => broken.push(format!("{what}: refused without a reason")),
        Err(_) => refused += 1,
        Ok(mut predictor) => {
            read += 1;
            let inputs = Inputs {
                features: &features,
                setting: Setting::of(&frame),
                changes: Changes::NONE,
                camera: features.pose(),
                volume_features: None,
                lobes: None,
            };
            match predictor.predict(&inputs) {
                Ok(p) if p.seconds.is_finite() && p.seconds > 0.0 => {}
                Ok(p) => broken.push(format!("{what}: predicts {} s", p.seconds)),
                Err(_) => refused += 1,
            }
        }
    };
    for k in 0..200 {
        let mut bytes = good.clone();
        match k % 4 {
            0 => bytes.truncate((noise.uniform() * good.len() as f64) as usize),
            1 => {
                let at = (noise.uniform() * good.len() as f64) as usize;
                bytes[at] ^= 1 << (k % 8);
            }
            2 => {
                let at = (noise.uniform() * (good.len() - 8) as f64) as usize;
                bytes[at..at + 8].fill(0xff);
            }
            _ => bytes.extend_from_slice(b"trailing"),
        }
        check(&bytes, &format!("damage {k}"));
    }
    for (what, bytes) in [("an empty file", &b""[..]), ("text", b"not a model"), ("zeros", &[0; 64])] {
        check(bytes, what);
    }
    if refused < 100 {
        broken.push(format!("only {refused} of 203 damaged files were refused, {read} were read"));
    }
    // States of this method, cut and of another one.
    let mut session = contender(
        method,
        2.0,
        Box::new(model),
        &StepResponse::inverse_step(0.1),
        Prior::Fitted { log_sd: 0.2 },
    )
    .session;
    session.set_volume(summary, None);
    session.set_transfer(&table, None)?;
    let state = session.save_state();
    let before = session.plan(&frame, 0.01)?.step;
    for cut in 0..state.len() {
        if session.load_state(&state[..cut]).is_ok() {
            broken.push(format!("a state cut to {cut} bytes was taken"));
        }
    }
    if session.load_state(b"ENS1not a state").is_ok() {
        broken.push("a foreign state was taken".into());
    }
    session.load_state(&state)?;
    let after = session.plan(&frame, 0.01)?.step;
    if !(after.is_finite() && (after / before).ln().abs() < 1.0) {
        broken.push(format!("step {after} after refused states, {before} before"));
    }
    Ok(judge(28, method, &[], Limits::missed(1.0), broken))
}
