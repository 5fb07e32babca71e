//! `entire demo`: calibrate, play a path under several controllers, and report.

use crate::calibrate::place::{DATA_FOLDER, calibrated_on, machine_model_for, volumes_in};
use crate::calibrate::pool::SMALL_VOLUME;
use crate::calibrate::{MachineModel, Settings, calibrate};
use crate::commands::calibrate::parse_seconds;
use crate::commands::steer::describe;
use crate::program::print_line;
use crate::shipped::shipped_priors;
use crate::steering::contenders::ControllerKind;
use crate::steering::metrics::{Metrics, SWITCH_FRAMES};
use crate::steering::model::steering_model;
use crate::steering::play::Course;
use crate::steering::race::{CALIBRATION_STEPS, INTERRUPTED, Race, prepare};
use crate::steering::report::{Story, make_report_folder, table, write};
use crate::steering::rivals::PID_GAINS;
use anyhow::{Context, Result, ensure};
use entire_core::model::ModelFile;
use entire_core::scene::{Arcball, Camera, Frame, VolumeView};
use entire_io::clock::{ClockChoice, clock_parser};
use entire_io::files::{write_json, write_whole};
use entire_io::machine::Provenance;
use entire_io::options::{DrawSettings, RenderArgs, open_renderer, parse_distance, parse_size, thread_pool};
use entire_io::path::Generated;
use entire_io::volume::{Reading, open_volume};
use entire_io::{identity, interrupt};
use entire_train::fit::typical_costs;
use entire_vk_raycaster::Renderer;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Default volume, relative to the project's root.
const DEFAULT_VOLUME: &str = "data/nyx_cosmology/m04/t0010.nrrd";

/// Time limit of all rendering, seconds; images are reduced to meet it.
const RENDERING_BUDGET: f64 = 150.0;

/// Shortest image side to which images are reduced, pixels.
const SMALLEST_SIDE: u32 = 96;

/// Calibrate a model to this machine, play a path of cameras and transfer functions under several
/// controllers, and write a report.
///
/// If this machine has no model, or its model was calibrated on the given volume, the command calibrates one
/// with the other volumes in data/. Without other volumes, it uses the machine's model, else the shipped one;
/// the report says if the model was calibrated on the volume. The command then plays 120 frames of the
/// volume, with three abrupt switches of the transfer function, under seven controllers (fixed step, OLP, the
/// last frame time, the larger of the last two frame times, PID, Algorithm 1, entire's). It prints the
/// distance of each controller's frame times from the target, and writes a report.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire demo
  entire demo skull.nii.gz --out out/skull")]
pub(crate) struct Options {
    /// The volume file; default: a time step of a cosmology simulation.
    #[arg(value_name = "VOLUME")]
    pub(crate) volume: Option<PathBuf>,
    /// Folder for report.html, frames.csv, summary.json, path.json and model.safetensors.
    #[arg(long, default_value = "out/demo", value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Image size, pixels; reduced if rendering would take too long.
    #[arg(long, default_value = "256x256", value_name = "WxH", value_parser = parse_size)]
    pub(crate) size: (u32, u32),
    /// Frames of the path.
    #[arg(long, default_value_t = 120, value_name = "N")]
    pub(crate) frames: u32,
    /// Wall seconds for the calibration.
    #[arg(long, default_value_t = 25.0, value_name = "SECONDS", value_parser = parse_seconds)]
    pub(crate) seconds: f64,
    /// Number of random scenes of the volume that are rendered first, at six steps each, to measure the time
    /// that coarser steps save.
    #[arg(long, default_value_t = 16, value_name = "N")]
    pub(crate) scenes: usize,
    /// Options for reading the volume.
    #[command(flatten)]
    pub(crate) reading: Reading,
    /// Rendering options.
    #[command(flatten)]
    pub(crate) render: RenderArgs,
    /// The clock of frame times. `auto`: the clock of the machine's model (`entire calibrate`), else the
    /// device's timestamps on a GPU, else wall time.
    #[arg(long, value_parser = clock_parser(), default_value = "auto")]
    pub(crate) clock: ClockChoice,
    /// Enlarge the volume trilinearly by this factor along each axis; default: 2 for volumes of fewer than
    /// 160³ voxels, else 1.
    #[arg(long, value_name = "FACTOR")]
    pub(crate) enlarge: Option<usize>,
    /// Largest distance between rays along each image side under entire's controller, in pixels; 1 keeps the
    /// full image size. This controller coarsens the step or the image, whichever adds less error.
    #[arg(long, default_value_t = 4.0, value_name = "PIXELS", value_parser = parse_distance)]
    pub(crate) max_image_sample_distance: f32,
    /// Seed of the random scenes.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
}

/// Calibrates a model of this machine with the volumes in data/, but without the played volume and its
/// copies, and with only the training members of ensembles. Returns the model and its description; `None` if
/// there are no such volumes.
fn calibrated(
    options: &Options,
    draw: &DrawSettings,
    played: &Path,
    renderer: &mut dyn Renderer,
    stop: &dyn Fn() -> bool,
) -> Result<Option<(String, ModelFile)>> {
    let data = Path::new(DATA_FOLDER);
    let volumes = if data.is_dir() { volumes_in(data)? } else { Vec::new() };
    let files = identity::of_volume(played)?;
    let same = |path: &PathBuf| anyhow::Ok(identity::contained(&files, &identity::of_volume(path)?));
    let others = volumes.into_iter().map(|path| anyhow::Ok((!same(&path)?).then_some(path)));
    let volumes: Vec<PathBuf> = others.filter_map(Result::transpose).collect::<Result<_>>()?;
    if volumes.is_empty() {
        return Ok(None);
    }
    let settings = Settings {
        volumes,
        reading: Reading::default(),
        shading: draw.shading,
        skipping: draw.skipping,
        termination: draw.termination,
        clock: draw.clock,
        seconds: options.seconds,
        frames: 500,
        sizes: (32, draw.width.max(draw.height).max(64)),
        steps: CALIBRATION_STEPS.to_vec(),
        seed: options.seed,
    };
    let priors = shipped_priors(draw.shading, &typical_costs(renderer.backend(), &renderer.device()))?;
    let threads = thread_pool(None)?;
    let MachineModel { file, report, .. } = calibrate(&settings, &priors, renderer, &threads, stop)?;
    for warning in report.warnings() {
        print_line(format!("{:<11}{warning}", "note"))?;
    }
    let title = format!(
        "a model calibrated in {:.0} s to {} frames of {} other volumes",
        report.seconds, report.frames, report.volumes
    );
    Ok(Some((title, file)))
}

/// Returns `draw` with an image size at which `renderings` frames take at most [`RENDERING_BUDGET`], or with
/// sides of [`SMALLEST_SIDE`]. The time is estimated by rendering a typical frame a few times.
fn fit_size(
    mut draw: DrawSettings,
    view: &VolumeView<'_>,
    renderings: f64,
    renderer: &mut dyn Renderer,
    stop: &dyn Fn() -> bool,
) -> Result<DrawSettings> {
    let transfer = Generated::Switches.path(view, 8)?.resolve()?.frames[3].transfer.function().to_table()?;
    renderer.set_volume(view)?;
    renderer.set_transfer(&transfer)?;
    let camera = Camera::from_arcball(Arcball { rx: 15.0, ry: 30.0, dz: 2.2 })?;
    let frame = Frame { step: 2.0, ..draw.frame(camera)? }.checked()?;
    ensure!(!stop(), INTERRUPTED);
    renderer.render(&frame)?;
    const TRIALS: u32 = 4;
    let begin = Instant::now();
    for _ in 0..TRIALS {
        ensure!(!stop(), INTERRUPTED);
        renderer.render(&frame)?;
    }
    let seconds = begin.elapsed().as_secs_f64() / f64::from(TRIALS) * renderings;
    if seconds > RENDERING_BUDGET {
        let scale = (RENDERING_BUDGET / seconds).sqrt();
        let side = |n: u32| ((f64::from(n) * scale / 8.0).round() as u32 * 8).clamp(SMALLEST_SIDE.min(n), n);
        (draw.width, draw.height) = (side(draw.width), side(draw.height));
    }
    Ok(draw)
}

/// Returns a sentence that compares predicting and reactive controllers at switches; empty if one of them was
/// not played, or the path has no switch.
fn verdict(names: &[String], metrics: &[Metrics]) -> String {
    let at = |name: &str| {
        let i = names.iter().position(|n| n == name)?;
        Some(100.0 * metrics[i].mean_error_at_switches?)
    };
    let (Some(hybrid), Some(algorithm1), Some(olp), Some(last), Some(larger), Some(pid)) =
        (at("hybrid"), at("algorithm1"), at("olp"), at("last"), at("larger-of-two"), at("pid"))
    else {
        return String::new();
    };
    let (predicting, reacting) = (hybrid.min(algorithm1), olp.min(last).min(larger).min(pid));
    let outcome = if hybrid < reacting && algorithm1 < reacting {
        "both predicting controllers were closer to the target than the reactive ones"
    } else if predicting < reacting {
        "one of the two predicting controllers was closer to the target than the reactive ones"
    } else {
        "neither predicting controller was closer to the target than the reactive ones in this run"
    };
    format!(
        "In the first {SWITCH_FRAMES} frames after each abrupt switch, the mean distance from the target was \
         {hybrid:.0} % (entire) and {algorithm1:.0} % (Algorithm 1), against {olp:.0} % (OLP), {last:.0} % \
         (last frame), {larger:.0} % (larger of 2) and {pid:.0} % (PID): {outcome}."
    )
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let begin = Instant::now();
    let file = match &options.volume {
        Some(file) => file.clone(),
        None => {
            let file = PathBuf::from(DEFAULT_VOLUME);
            ensure!(
                file.is_file(),
                "{DEFAULT_VOLUME} is not here; run this in the project's root, or give a volume file"
            );
            file
        }
    };
    ensure!(options.scenes >= 4, "--scenes is {}; at least 4 scenes are needed", options.scenes);
    make_report_folder(&options.out)?;
    let volume = open_volume(&file, &options.reading)?;
    // By default, a small volume is enlarged, so that its frames take as long as those of larger volumes.
    let factor = options.enlarge.unwrap_or(if volume.view().shape().voxels < SMALL_VOLUME { 2 } else { 1 });
    let volume = volume.enlarged(factor)?;
    let view = volume.view();
    let described = describe(&volume, factor);
    print_line(format!("volume     {described}"))?;
    let path_file = Generated::Switches.path(&view, options.frames)?;
    let path = path_file.resolve()?;

    let stop = interrupt::flag()?;
    let stop = || interrupt::requested(&stop);
    let mut renderer = open_renderer(options.render.device)?;
    print_line(format!("renderer   {} ({})", renderer.device(), renderer.backend()))?;
    let (machines, clock) = machine_model_for(options.render.shade, options.clock, renderer.as_ref())?;
    print_line(format!("clock      {}", clock.name()))?;
    let asked = DrawSettings::new(options.size, &options.render, clock);
    let renderings =
        (7 * options.scenes + (ControllerKind::DEFAULT_SET.len() + 1) * options.frames as usize) as f64;
    let draw = fit_size(asked, &view, renderings, renderer.as_mut(), &stop)?;
    let shrunk = draw != asked;
    print_line(format!(
        "images     {} x {} pixels{}",
        draw.width,
        draw.height,
        if shrunk { ", made smaller so that the demo ends in time" } else { "" }
    ))?;
    let seen = |(_, model): &(String, ModelFile)| calibrated_on(&model.metadata, &file);
    let seen = machines.as_ref().map(seen).transpose()?.flatten() == Some(true);
    let machines = match machines {
        Some(unseen) if !seen => Some(unseen),
        machines => calibrated(options, &draw, &file, renderer.as_mut(), &stop)
            .context("cannot calibrate")?
            .or(machines),
    };
    ensure!(!stop(), INTERRUPTED);
    let made = machines.as_ref().map(|(_, file)| file.to_bytes()).transpose()?;
    let steers = steering_model(None, machines, draw.shading, &view)?;
    let keep = path.switches();
    let race = Race {
        volumes: std::slice::from_ref(&volume),
        path: &path,
        keep: &keep,
        course: Course::steady(options.max_image_sample_distance),
        seed: options.seed,
        scenes: (options.scenes, 1),
        draw,
        controllers: &ControllerKind::DEFAULT_SET,
        target: None,
        model: &steers,
    };
    let prepared = prepare(&race, renderer.as_mut(), &stop)?;
    print_line(format!("predictor  {}", prepared.predictor.sentence()))?;
    print_line(format!(
        "reference  {:.1} ms at the reference step, median of {} random scenes",
        prepared.full_quality * 1e3,
        options.scenes
    ))?;
    let target = format!("{:.1} ms: {}", prepared.target * 1e3, prepared.target_reason);
    print_line(format!("target     {target}"))?;
    print_line(format!(
        "fixed step {:.2}, at which the median random scene meets the target",
        prepared.fixed_step
    ))?;

    let playback = race.run(&prepared, renderer.as_mut(), &stop)?;
    let verdict = verdict(&playback.names, &playback.metrics());
    let mut remarks = vec![
        "Each frame was drawn under every controller before the next frame began. The order of the \
         controllers rotated from frame to frame, so that load by other programs affected all of them alike. \
         Each frame was also drawn at the reference step; the time of that drawing counts for no controller. \
         Changes of the transfer function are not part of frame times."
            .to_owned(),
        format!(
            "The fixed step ({:.2}) is the step at which the median random scene meets the target. OLP takes \
             the mean of the last three frame times, converted to the reference step by G, the frame \
             time as a function of the step. Two controllers take the last frame time, or the larger of \
             the last two, in place of this mean. PID has the gains {}. Algorithm 1 predicts at \
             the reference step and converts to other steps by G. entire's controller predicts at every \
             step, corrects predictions by the times of earlier frames, and keeps a margin.",
            prepared.fixed_step,
            PID_GAINS.map(|gain| gain.to_string()).join(", ")
        ),
    ];
    if factor != 1 {
        remarks.push(format!(
            "The volume was enlarged trilinearly by {factor} along every axis, so that its frames \
             cost as much as those of larger volumes."
        ));
    }
    let story = Story {
        title: "Holding a frame time".into(),
        lead: verdict.clone(),
        target,
        volume: described,
        path: format!(
            "{} frames on an orbit, abrupt transfer-function switches at frames {}",
            path.frames.len(),
            path.switches().iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
        ),
        predictor: prepared.predictor.clone(),
        response: prepared.curve.clone(),
        remarks,
        provenance: Provenance::of(renderer.device()),
    };
    let metrics = write(&options.out, &story, &draw, &playback)?;
    write_json(&options.out.join("path.json"), &path_file)?;
    if let Some(bytes) = made {
        write_whole(&options.out.join("model.safetensors"), &bytes)?;
    }
    println!("\n{}", table(&playback, &metrics).to_text());
    println!(
        "* best of the column. T: target; t: frame time. At switches: mean |t-T|/T of the {SWITCH_FRAMES} \
         frames from each switch on. Calm: the same mean of all other frames except the first \
         {SWITCH_FRAMES} of the path."
    );
    println!("\n{verdict}");
    println!(
        "\nReport: {} ({:.0} s in all)",
        options.out.join("report.html").display(),
        begin.elapsed().as_secs_f64()
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metrics(at_switches: f64) -> Metrics {
        Metrics {
            frames: 9,
            missed_by_10_percent: 0.0,
            missed_by_25_percent: 0.0,
            mean_error: 0.0,
            mean_error_at_switches: Some(at_switches),
            mean_error_in_calm: None,
            recovery_frames: vec![],
            p95_seconds: 1.0,
            worst_seconds: 1.0,
            mean_psnr: 0.0,
            mean_step: 1.0,
        }
    }

    #[test]
    fn the_verdict_says_who_won_whoever_did() {
        let names: Vec<String> = ControllerKind::DEFAULT_SET.iter().map(|k| k.name().to_owned()).collect();
        let say = |errors: [f64; 7]| verdict(&names, &errors.map(metrics));
        assert!(
            say([0.9, 0.5, 0.7, 0.8, 0.6, 0.2, 0.1])
                .ends_with("both predicting controllers were closer to the target than the reactive ones.")
        );
        assert!(say([0.9, 0.5, 0.7, 0.8, 0.6, 0.55, 0.1]).contains("one of the two"));
        for reactive in 1..5 {
            let mut errors = [0.9, 0.5, 0.7, 0.8, 0.6, 0.2, 0.2];
            errors[reactive] = 0.1;
            assert!(say(errors).contains("neither predicting"), "{reactive}");
        }
        let said = say([0.9, 0.5, 0.7, 0.8, 0.6, 0.2, 0.1]);
        assert!(
            said.contains("10 % (entire) and 20 % (Algorithm 1), against 50 % (OLP), 70 % (last"),
            "{said}"
        );
        assert_eq!(verdict(&names[..1], &[metrics(0.1)]), "");
    }
}
