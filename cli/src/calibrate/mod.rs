//! A model of the machine at hand, in a minute and a half: frames that tell most, rendered in passes, and a
//! shipped model taken to what they say.
//!
//! [`pool`] draws candidate frames and computes what is known of each before it is drawn; [`design`] chooses
//! among them; [`measuring`] renders them, discards warm-ups and repeats in passes; [`others`] watches what
//! else uses the machine; [`entire_core::calibrate::PriorModel`] fits. [`place`] is where the machine's model lies.

pub mod design;
pub mod measuring;
pub mod others;
pub mod place;
pub mod pool;
pub mod report;

use crate::dataset::{Clock, Table, Timed, TimedFrame, noise_floor, timed};
use crate::fit::FitContext;
use crate::fit::analytic::counts;
use crate::inputs::{Layout, work_of};
use anyhow::{Context, Result, ensure};
use entire_core::calibrate::{FEWEST_FRAMES, Observed, PriorModel, blank_prior};
use entire_core::features::PROBE_SIDE;
use entire_core::model::ModelFile;
use entire_core::nn::Executor;
use entire_core::predict::UnitCosts;
use entire_core::scene::{Shading, Skipping};
use entire_vk_raycaster::Renderer;
use indicatif::ProgressBar;
use measuring::{Measured, Measuring};
use pool::Pool;
use report::Report;
use std::collections::HashMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Seconds that are kept back for the fit.
const FIT_SECONDS: f64 = 6.0;

/// What is calibrated, and how long it may take.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Volumes whose frames are rendered.
    pub volumes: Vec<PathBuf>,
    /// What each sample computes.
    pub shading: Shading,
    /// How empty space is skipped.
    pub skipping: Skipping,
    /// Accumulated opacity at which rays stop.
    pub termination: f32,
    /// The clock that is learned.
    pub clock: Clock,
    /// Wall seconds that all of it may take.
    pub seconds: f64,
    /// Frames at most.
    pub frames: usize,
    /// Shortest and longest image side, pixels.
    pub sizes: (u32, u32),
    /// Ray steps, reference steps.
    pub steps: Vec<f32>,
    /// Seed of every random choice.
    pub seed: u64,
}

/// A machine's model.
pub struct Calibrated {
    /// The model file.
    pub file: ModelFile,
    /// What it was made of, and what error to expect.
    pub report: Report,
    /// Every frame with its repeats.
    pub frames: Vec<TimedFrame>,
}

/// Numbers of volumes by their names.
#[derive(Default)]
struct Groups(HashMap<String, u64>);

impl Groups {
    fn number(&mut self, name: &str) -> u64 {
        let next = self.0.len() as u64;
        *self.0.entry(name.to_owned()).or_insert(next)
    }
}

/// Renders frames for as long as there is time, or until `stop` says so, and fits a model to them. `prior` is
/// a model by its name; without one, unit costs of a software renderer and no factor are what is started
/// from.
///
/// # Errors
/// When volumes cannot be read, the renderer fails or lacks the clock, or it was stopped before
/// [`FEWEST_FRAMES`] were drawn.
pub fn calibrate(
    settings: &Settings,
    prior: Option<&(String, ModelFile)>,
    renderer: &mut dyn Renderer,
    threads: &rayon::ThreadPool,
    stop: &dyn Fn() -> bool,
    bar: &ProgressBar,
) -> Result<Calibrated> {
    let start = Instant::now();
    let deadline = start + Duration::from_secs_f64((settings.seconds - FIT_SECONDS).max(1.0));
    bar.set_length(settings.seconds.ceil() as u64);
    bar.set_message("choosing frames");
    let pool = Pool::draw(settings, prior.map(|p| &p.1), threads)?;
    let mut measuring = Measuring::new(settings, &pool, renderer, deadline, start, stop, bar);
    measuring.run()?;
    let Measured { frames, passes, others, rounds, warm_ups } = measuring.finish();
    bar.set_message("fitting");
    ensure!(
        frames.len() >= FEWEST_FRAMES,
        "stopped after {} frames; at least {FEWEST_FRAMES} are needed, and nothing was written",
        frames.len()
    );
    let mut groups = Groups::default();
    let observed: Vec<Observed> = frames
        .iter()
        .map(|f| {
            let candidate = &pool.candidates[f.number as usize];
            let seconds = f.seconds(settings.clock).with_context(|| {
                format!(
                    "the renderer has no clock {}; choose another --clock (every renderer has wall)",
                    settings.clock.name()
                )
            })?;
            Ok(Observed {
                row: candidate.row.clone(),
                work: candidate.work,
                seconds,
                group: groups.number(&f.scene.volume),
            })
        })
        .collect::<Result<_>>()?;
    let split = PriorModel::new(&pool.prior)?;
    // Chosen frames are the strange ones; those drawn at random are what users draw.
    let random: Vec<bool> = frames.iter().map(|f| pool.candidates[f.number as usize].random).collect();
    let enough = random.iter().filter(|r| **r).count() >= 20;
    let judged = |i: usize| !enough || random[i];
    // On some processors rays that lie apart wait for memory, on others hardly.
    let chosen = split.choose(&observed, &UnitCosts::CONVERTING, judged, Executor::Rayon(threads))?;
    let noise = noise_floor(&frames, settings.clock, |f| passes.get(&f.number).copied().unwrap_or(1));
    let report = Report::new(
        (settings.shading, settings.clock),
        prior.map(|p| p.0.as_str()),
        &observed,
        &chosen,
        judged,
        noise,
        others,
        (rounds, warm_ups),
        start.elapsed().as_secs_f64(),
    )?;
    let mut file = chosen.file;
    report.write_into(&mut file, (renderer.backend(), &renderer.device()), &observed, &chosen.crossed)?;
    bar.finish_and_clear();
    Ok(Calibrated { file, report, frames })
}

/// Fits a model to frames that some renderer logged, as [`calibrate`] does to those that it renders: nothing
/// is drawn. Volumes are opened where features are not kept beside the tables.
///
/// # Errors
/// When fewer than [`FEWEST_FRAMES`] have the shading and the clock, or inputs cannot be computed.
pub fn calibrate_to_tables(
    tables: &[Table],
    (shading, clock): (Shading, Clock),
    prior: Option<&(String, ModelFile)>,
    threads: &rayon::ThreadPool,
) -> Result<(ModelFile, Report)> {
    let start = Instant::now();
    let (frames, seconds): (Vec<&TimedFrame>, Vec<f64>) =
        timed(tables, clock, Some(shading))?.into_iter().unzip();
    ensure!(
        frames.len() >= FEWEST_FRAMES,
        "{} frames with shading {}; at least {FEWEST_FRAMES} are needed",
        frames.len(),
        shading
    );
    let file = match prior {
        Some((_, file)) => file.clone(),
        None => blank_prior(PROBE_SIDE)?,
    };
    let layout = Layout::of_model(&file.to_model()?)?;
    let hidden = ProgressBar::hidden();
    let context = FitContext { tables, pool: threads, bar: &hidden, stop: &|| false };
    let rows = layout.rows(tables, &frames, threads, &hidden)?;
    let part = Timed { frames: &frames, seconds: &seconds };
    // Another renderer may convert stored values or wait for memory; tables from before that was counted hold
    // no such work.
    let renderer = UnitCosts::CONVERTING;
    let (renderer, work) = match counts(&context, part, &renderer, layout.probe_side()) {
        Ok(work) => (renderer, work),
        Err(_) => (UnitCosts::SOFTWARE, counts(&context, part, &UnitCosts::SOFTWARE, layout.probe_side())?),
    };
    let mut groups = Groups::default();
    let observed: Vec<Observed> = frames
        .iter()
        .zip(rows.chunks_exact(layout.width()))
        .zip(work)
        .zip(&seconds)
        .map(|(((f, row), counted), &seconds)| {
            let work = work_of(counted);
            Observed { row: row.to_vec(), work, seconds, group: groups.number(&f.scene.volume) }
        })
        .collect();
    let split = PriorModel::new(&file)?;
    let chosen = split.choose(&observed, &renderer, |_| true, Executor::Rayon(threads))?;
    let noise = noise_floor(frames.iter().copied(), clock, |f| tables[f.table].passes());
    let report = Report::new(
        (shading, clock),
        prior.map(|p| p.0.as_str()),
        &observed,
        &chosen,
        |_| true,
        noise,
        others::Others::default(),
        (0, 0),
        start.elapsed().as_secs_f64(),
    )?;
    let manifest = tables.iter().find_map(|t| t.manifest.as_ref());
    let device = manifest.map_or(("not stated", "not stated"), |m| (m.renderer.as_str(), m.device.as_str()));
    let mut file = chosen.file;
    report.write_into(&mut file, device, &observed, &chosen.crossed)?;
    Ok((file, report))
}
