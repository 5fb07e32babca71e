//! Fits a model to this machine in a minute and a half: chooses informative frames, renders them in passes,
//! and fits unit costs to their times. The prior is the given models, else typical costs.
//!
//! `pool` draws candidate frames and computes their features; `design` chooses among them; `measuring`
//! renders them in several passes, short frames after untimed warm-up renderings, and compares pictures with
//! those at full quality; `others` measures the load of other programs;
//! [`entire_steer::calibrate::fit_frames`] fits the model. [`place`] finds the file of the machine's model.

mod design;
mod measuring;
mod others;
pub mod place;
pub(crate) mod pool;
pub(crate) mod report;

pub use report::Report;

use anyhow::{Context, Result, ensure};
use entire_core::model::ModelFile;
use entire_core::scene::{Shading, Skipping};
use entire_io::dataset::{Clock, Groups, Table, Timed, TimedFrame, manifests_of, mixed, noise_floor, timed};
use entire_io::files::note;
use entire_io::progress::templated_bar;
use entire_io::volume::Reading;
use entire_steer::calibrate::{Chosen, FEWEST_FRAMES, Observed, fit_frames, fit_quality, prior_costs};
use entire_steer::predict::{Quality, UnitCosts};
use entire_train::fit::{FitContext, counts, expected_costs, typical_costs};
use entire_train::inputs::work_of;
use entire_train::split::shortest;
use entire_vk_raycaster::Renderer;
use indicatif::ProgressBar;
use measuring::Measuring;
use pool::Pool;
use report::Pictures;
use std::collections::BTreeSet;
#[cfg(test)]
use std::path::Path;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Seconds that are reserved for the fit.
const FIT_SECONDS: f64 = 1.0;

/// Share of the calibration's time in which pictures are compared.
const PICTURES_SHARE: f64 = 0.08;

/// Seconds of measurement in which most machines draw more than [`FEWEST_FRAMES`] frames.
const MEASUREMENT_SECONDS: f64 = 10.0;

#[derive(Clone, Debug)]
pub(crate) struct Settings {
    pub(crate) volumes: Vec<PathBuf>,
    pub(crate) reading: Reading,
    pub(crate) shading: Shading,
    pub(crate) skipping: Skipping,
    pub(crate) termination: f32,
    /// Clock whose seconds the model predicts.
    pub(crate) clock: Clock,
    /// Time limit of the whole calibration, wall seconds.
    pub(crate) seconds: f64,
    pub(crate) frames: usize,
    /// Shortest and longest image side, pixels.
    pub(crate) sizes: (u32, u32),
    /// Ray steps, in reference steps.
    pub(crate) steps: Vec<f32>,
    pub(crate) seed: u64,
}

#[cfg(test)]
impl Settings {
    pub(crate) fn brief(volumes: Vec<PathBuf>) -> Self {
        Self {
            volumes,
            reading: Reading::default(),
            shading: Shading::None,
            skipping: Skipping::None,
            termination: 0.99,
            clock: Clock::Wall,
            seconds: 1.0,
            frames: 8,
            sizes: (16, 32),
            steps: vec![1.0],
            seed: 1,
        }
    }

    /// Writes a volume of `edge`³ bytes into a folder; `value` gives each voxel from its index. Returns the
    /// file.
    pub(crate) fn write_volume(folder: &Path, edge: usize, value: impl Fn(usize) -> u8) -> PathBuf {
        let path = folder.join("v.nrrd");
        let header = "NRRD0004\ntype: uint8\ndimension: 3\nencoding: raw\n";
        let mut bytes = format!("{header}sizes: {edge} {edge} {edge}\n\n").into_bytes();
        bytes.extend((0..edge.pow(3)).map(value));
        std::fs::write(&path, bytes).unwrap();
        path
    }
}

pub(crate) struct MachineModel {
    pub(crate) file: ModelFile,
    /// Inputs of the fit, and its error on held-out volumes.
    pub(crate) report: Report,
    /// Every frame with its repeats.
    pub(crate) frames: Vec<TimedFrame>,
}

/// Name and model file of a prior.
pub type NamedPrior = (String, ModelFile);

/// True if a calibration can take the model as prior, and so adapt it to another machine. Other models are
/// adapted by fine-tuning.
pub fn can_be_prior(file: &ModelFile) -> bool {
    prior_costs(std::slice::from_ref(file), &UnitCosts::SOFTWARE).is_ok()
}

/// The model files of the priors, and their names, joined by commas; `None` for the names if there are no
/// priors.
fn named(priors: &[NamedPrior]) -> (Vec<ModelFile>, Option<String>) {
    let names: Vec<&str> = priors.iter().map(|p| p.0.as_str()).collect();
    let names = (!names.is_empty()).then(|| names.join(", "));
    (priors.iter().map(|p| p.1.clone()).collect(), names)
}

/// The reason why a calibration of `seconds` drew too few frames, and the remedy. The first `choosing`
/// seconds were spent on the choice of frames.
fn too_short(seconds: f64, choosing: f64) -> String {
    let measured = (1.0 - PICTURES_SHARE) * seconds - FIT_SECONDS - choosing;
    let needed = MEASUREMENT_SECONDS.max(2.0 * measured) + FIT_SECONDS + choosing;
    format!(
        "within {seconds} s, of which the choice of frames took {choosing:.1} s; give --seconds {:.0}, or \
         name fewer or smaller volumes",
        (needed / (1.0 - PICTURES_SHARE)).ceil()
    )
}

/// Renders frames until the time is over, the maximum number of frames is drawn or `stop` returns true,
/// and fits a model to them. [`prior_costs`] makes the prior from the models `priors`.
///
/// # Errors
/// When volumes cannot be read, the renderer fails or lacks the clock, or fewer than [`FEWEST_FRAMES`] were
/// drawn.
pub(crate) fn calibrate(
    settings: &Settings,
    priors: &[NamedPrior],
    renderer: &mut dyn Renderer,
    threads: &rayon::ThreadPool,
    stop: &dyn Fn() -> bool,
) -> Result<MachineModel> {
    let start = Instant::now();
    let bar = templated_bar("calibrate [{bar:32}] {pos}/{len} s  {wide_msg}");
    let deadline = start + Duration::from_secs_f64((settings.seconds - FIT_SECONDS).max(0.0));
    bar.set_length(settings.seconds.ceil() as u64);
    bar.set_message("choosing frames");
    let (files, names) = named(priors);
    let typical = typical_costs(renderer.backend(), &renderer.device());
    let pool = Pool::draw(settings, (&files, &typical), threads)?;
    let choosing = start.elapsed().as_secs_f64();
    let frames_end =
        deadline - Duration::from_secs_f64(PICTURES_SHARE * settings.seconds).min(deadline - start);
    let built_in = Quality::built_in(renderer.backend());
    let mut measuring = Measuring::new(settings, &pool, renderer, frames_end, start, stop, &bar);
    measuring.run()?;
    let compared = measuring.pictures(deadline)?;
    // With too few scenes the model states no quality law.
    let quality = fit_quality(&compared, built_in).ok();
    let frames = measuring.frames();
    let noise = measuring.noise(&frames);
    let Measuring { others, rounds, warm_ups, .. } = measuring;
    bar.set_message("fitting");
    ensure!(
        frames.len() >= FEWEST_FRAMES,
        "{} frames were drawn {}; a fit needs at least {FEWEST_FRAMES} frames, so no model was made",
        frames.len(),
        if stop() { "before the interruption".to_owned() } else { too_short(settings.seconds, choosing) }
    );
    let mut groups = Groups::default();
    let observed: Vec<Observed> = frames
        .iter()
        .map(|f| {
            let candidate = &pool.candidates[f.number as usize];
            let seconds = f.undisturbed(settings.clock).with_context(|| {
                let (number, clock) = (f.number, settings.clock.name());
                format!("calibration frame {number} took no {clock} time; choose another --clock")
            })?;
            Ok(Observed { work: candidate.work, seconds, group: groups.number(&f.scene.volume) })
        })
        .collect::<Result<_>>()?;
    // Frames chosen by design are extreme; random frames represent users' frames. So the error is measured on
    // random frames alone if there are at least 20.
    let random: Vec<bool> = frames.iter().map(|f| pool.candidates[f.number as usize].random).collect();
    let enough = random.iter().filter(|r| **r).count() >= 20;
    let judged = |i: usize| !enough || random[i];
    let chosen = fit_frames(&files, &[typical], &observed)?;
    let (kind, seconds) = ((settings.shading, settings.clock), start.elapsed().as_secs_f64());
    let volumes = settings.volumes.iter().map(|path| path.to_string_lossy().into_owned());
    let report = Report {
        rounds,
        warm_ups,
        others,
        pictures: quality.map(|fitted| Pictures { error: "rmse", fitted }),
        files: volumes.zip(pool.files).collect(),
        ..Report::new(kind, names, &observed, &chosen, judged, noise, seconds)?
    };
    let mut file = chosen.file;
    report.write_into(&mut file, (renderer.backend(), &renderer.device()), &observed, &chosen.crossed)?;
    Ok(MachineModel { file, report, frames })
}

/// Fits a model to timed frames of any renderer. Returns the fit, and the frames as inputs of the fit.
fn fit_to_frames(
    context: &FitContext<'_>,
    part: Timed<'_>,
    priors: &[ModelFile],
) -> Result<(Chosen, Vec<Observed>)> {
    let mut groups = Groups::default();
    let volumes: BTreeSet<String> = part.frames.iter().map(|f| f.scene.volume.clone()).collect();
    let renderer = expected_costs(context, part);
    let (_, side) = prior_costs(priors, &renderer)?;
    let unknown = UnitCosts::OF_UNKNOWN;
    // A renderer of unknown kind may run on a GPU, where the longest ray has unit costs of its own. Its work
    // is counted in the volumes; if they are missing, a software renderer is assumed.
    let longest = || counts(context, part, &unknown[1], side).ok();
    let (renderers, work) = match (renderer == unknown[0]).then(longest).flatten() {
        Some(work) => (&unknown[..], work),
        None => (std::slice::from_ref(&renderer), counts(context, part, &renderer, side)?),
    };
    let observed: Vec<Observed> = part
        .frames
        .iter()
        .zip(work)
        .zip(part.seconds)
        .map(|((frame, counted), &seconds)| Observed {
            work: work_of(counted),
            seconds,
            group: groups.number(shortest(&frame.scene.volume, &volumes)),
        })
        .collect();
    Ok((fit_frames(priors, renderers, &observed)?, observed))
}

/// Fits a model to any number of timed frames and returns its file, without provenance.
///
/// # Errors
/// When there are no frames, inputs cannot be computed, or the models cannot be priors.
pub fn calibrate_to_frames(
    priors: &[ModelFile],
    context: &FitContext<'_>,
    frames: Timed<'_>,
) -> Result<ModelFile> {
    Ok(fit_to_frames(context, frames, priors)?.0.file)
}

/// Fits a model to frames that a renderer logged; nothing is drawn. The model gets the quality law of
/// `pictures`, if given. If a table has no stored scene features, its volumes are opened.
///
/// # Errors
/// When fewer than [`FEWEST_FRAMES`] have the shading and the clock, or inputs cannot be computed.
pub fn calibrate_to_tables(
    tables: &[Table],
    (shading, clock): (Shading, Clock),
    priors: &[NamedPrior],
    pictures: Option<Pictures>,
    threads: &rayon::ThreadPool,
) -> Result<(ModelFile, Report)> {
    let start = Instant::now();
    let (frames, seconds): (Vec<&TimedFrame>, Vec<f64>) = timed(tables, clock, Some(shading))?
        .into_iter()
        .map(|(frame, seconds)| (frame, frame.undisturbed(clock).unwrap_or(seconds)))
        .unzip();
    ensure!(
        frames.len() >= FEWEST_FRAMES,
        "the tables have {} frames with shading {} and a time by --clock; at least {FEWEST_FRAMES} are \
         needed: log more frames, or choose another --shade or --clock",
        frames.len(),
        shading
    );
    let manifests = manifests_of(tables, &frames);
    if let Some(text) = mixed(&manifests) {
        note(&text);
    }
    let (files, names) = named(priors);
    let hidden = ProgressBar::hidden();
    let context = FitContext { tables, pool: threads, bar: &hidden, stop: &|| false };
    let (chosen, observed) = fit_to_frames(&context, Timed { frames: &frames, seconds: &seconds }, &files)?;
    let noise = noise_floor(frames.iter().copied(), clock, |f| tables[f.table].passes());
    let seconds = start.elapsed().as_secs_f64();
    if pictures.is_some() && manifests.is_empty() {
        note(
            "the frames have no manifest, so the model does not name the renderer of the compared pictures; \
             a session that names its renderer ignores the model's quality law",
        );
    }
    let report = Report {
        pictures,
        files: manifests.iter().flat_map(|m| m.files.clone()).collect(),
        ..Report::new((shading, clock), names, &observed, &chosen, |_| true, noise, seconds)?
    };
    let device =
        manifests.first().map_or(("not stated", "not stated"), |m| (m.renderer.as_str(), m.device.as_str()));
    let mut file = chosen.file;
    report.write_into(&mut file, device, &observed, &chosen.crossed)?;
    Ok((file, report))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scripted::ScriptedRenderer;
    use entire_vk_raycaster::CpuRaycaster;

    #[test]
    fn a_clock_that_the_renderer_lacks_is_found_at_the_first_frame() {
        let folder = tempfile::tempdir().unwrap();
        let path = Settings::write_volume(folder.path(), 6, |i| i as u8);
        let settings = Settings { seconds: 30.0, clock: Clock::Device, ..Settings::brief(vec![path]) };
        let threads = entire_io::options::thread_pool(Some(1)).unwrap();
        let mut renderer = CpuRaycaster::new();
        let error = calibrate(&settings, &[], &mut renderer, &threads, &|| false);
        let text = format!("{:#}", error.err().unwrap());
        assert!(text.contains("calibration frame") && text.contains("no clock device"), "{text}");
    }

    #[test]
    fn a_calibration_without_time_for_frames_names_enough_seconds() {
        let folder = tempfile::tempdir().unwrap();
        let path = Settings::write_volume(folder.path(), 6, |i| i as u8);
        let settings = Settings { seconds: FIT_SECONDS, ..Settings::brief(vec![path]) };
        let threads = entire_io::options::thread_pool(Some(1)).unwrap();
        let mut renderer = ScriptedRenderer::default();
        let error = calibrate(&settings, &[], &mut renderer, &threads, &|| false);
        let text = error.err().unwrap().to_string();
        for part in ["0 frames were drawn within 1 s", "choice of frames took", "give --seconds "] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }
}
