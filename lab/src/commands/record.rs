//! `entire-lab record`: time and picture quality of every frame of a path at a grid of ray steps and image
//! scales.

use crate::trace::{Recording, TRACE_FORMAT, TRACE_STEPS, Trace, TraceVolume, record};
use anyhow::{Context, Result, bail, ensure};
use entire_cli::steering::race::measure;
use entire_core::scene::DEFAULT_FOV_Y_DEGREES;
use entire_io::clock::{ClockChoice, clock_parser, waited_for};
use entire_io::dataset::{Clock, Scene, Timing, Writer};
use entire_io::files::make_folder_of;
use entire_io::interrupt;
use entire_io::options::{DrawSettings, RenderArgs, open_renderer, parse_hold, parse_scale, parse_size};
use entire_io::path::{Generated, PathFile};
use entire_io::progress::progress_bar;
use entire_steer::features::VolumeSummary;
use entire_vk_raycaster::Renderer;
use std::path::PathBuf;

/// Seed of the calibration scenes.
const SEED: u64 = 1;

/// Record time and picture quality of every frame of a path at a grid of ray steps.
///
/// Every frame is drawn at nine ray steps from 1 to 16 reference steps, and at the reference step in eleven
/// smaller image sizes, down to a tenth of each side. Every fourth frame is also drawn in smaller sizes at
/// coarser steps. `entire-lab replay` then simulates controllers on the recorded times without rendering, and
/// compares them with an oracle that knows these times.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire-lab record data/nyx_cosmology/m04/t0010.nrrd --enlarge 2 \\
      --generate switches --clock cpu --out out/steer/nyx.json
  entire-lab record a.nrrd b.nrrd --enlarge 2 --calibration 24 --clock cpu \\
      --out out/steer/calibration.csv
  entire-lab record t0001.nrrd t0002.nrrd t0003.nrrd --hold 20 \\
      --generate orbit --out series.json")]
pub(crate) struct Options {
    /// The volume files, shown one after the other (see --hold).
    #[arg(value_name = "VOLUME", required = true)]
    pub(crate) volumes: Vec<PathBuf>,
    /// The path file (JSON; the format is documented with the examples in examples/paths).
    #[arg(
        long,
        value_name = "FILE.json",
        conflicts_with = "generate",
        required_unless_present_any = ["generate", "calibration"]
    )]
    pub(crate) path: Option<PathBuf>,
    /// Generate a path of this kind for the first volume, instead of --path.
    #[arg(long, value_enum)]
    pub(crate) generate: Option<Generated>,
    /// Instead of a path, render this many random scenes of each volume, at six steps each, and write a
    /// timing table. `entire-lab replay` fits its predictor to this table.
    #[arg(long, value_name = "SCENES", conflicts_with_all = ["generate", "path", "hold", "scales"])]
    pub(crate) calibration: Option<usize>,
    /// Frames of a generated path.
    #[arg(long, default_value_t = 96, value_name = "N", conflicts_with = "path")]
    pub(crate) frames: u32,
    /// Frames for which each volume is shown, if there are several volumes.
    #[arg(long, value_name = "N")]
    pub(crate) hold: Option<u32>,
    /// Changes of the image size, comma-separated: FRAME:SCALE multiplies both sides of the full image by
    /// SCALE from frame FRAME on.
    #[arg(long, value_delimiter = ',', value_name = "FRAME:SCALE,…", value_parser = parse_scale)]
    pub(crate) scales: Vec<(u32, f32)>,
    /// Name in reports; default: the file name of the result.
    #[arg(long)]
    pub(crate) name: Option<String>,
    /// The trace (recorded path) to write, compressed if the name ends in .gz; with --calibration, the timing
    /// table (CSV).
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// Continue an interrupted recording.
    #[arg(long, conflicts_with = "calibration")]
    pub(crate) resume: bool,
    /// Ray steps of the grid at full image size, in reference steps: at least two, ascending. Smaller images
    /// are drawn only if the steps are the default ones.
    #[arg(long, value_delimiter = ',', value_name = "STEP,…", default_values_t = TRACE_STEPS)]
    pub(crate) steps: Vec<f32>,
    /// Number of renderings of each point of the grid.
    #[arg(long, default_value_t = 2, value_name = "R")]
    pub(crate) repeats: usize,
    /// Image size, pixels.
    #[arg(long, default_value = "256x256", value_name = "WxH", value_parser = parse_size)]
    pub(crate) size: (u32, u32),
    /// Rendering options.
    #[command(flatten)]
    pub(crate) render: RenderArgs,
    /// The clock of frame times; `auto`: the device's timestamps on a GPU, else wall time.
    #[arg(long, value_parser = clock_parser(), default_value = "auto")]
    pub(crate) clock: ClockChoice,
    /// Enlarge the volumes trilinearly by this factor along each axis.
    #[arg(long, default_value_t = 1, value_name = "FACTOR")]
    pub(crate) enlarge: usize,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    ensure!(options.repeats >= 1, "--repeats is 0; every point must be drawn at least once");
    if let Some(scenes) = options.calibration {
        return calibrate(options, scenes);
    }
    ensure!(
        options.steps.len() >= 2
            && options.steps.windows(2).all(|w| w[0] < w[1])
            && options.steps.iter().all(|s| (1.0 / 64.0..=4096.0).contains(s)),
        "--steps are {:?}; give at least two, ascending, each in [0.015625, 4096] reference steps",
        options.steps
    );
    let hold = parse_hold(options.volumes.len(), options.hold)?;
    ensure!(options.scales.is_sorted_by_key(|s| s.0), "--scales must be ordered by frame");
    let (mut named, mut volumes) = (Vec::new(), Vec::new());
    for file in &options.volumes {
        let files = entire_io::identity::of_volume(file)?;
        let volume = TraceVolume { file: file.clone(), enlarge: options.enlarge, files };
        volumes.push(volume.open()?);
        named.push(volume);
    }
    let path = match (&options.path, options.generate) {
        (Some(file), _) => PathFile::open(file)?,
        (None, Some(kind)) => kind.path(&volumes[0].view(), options.frames)?,
        (None, None) => bail!("give --path or --generate"),
    };
    let (mut renderer, draw) = opened(options)?;
    let name = options.name.clone().unwrap_or_else(|| {
        let file = options.out.file_name().unwrap_or_default().to_string_lossy();
        file.trim_end_matches(".gz").trim_end_matches(".json").to_owned()
    });
    let empty = Trace {
        format: TRACE_FORMAT.into(),
        name,
        volumes: named,
        path,
        hold,
        scales: options.scales.clone(),
        draw,
        frames: Vec::new(),
        provenance: serde_json::Value::Null,
    };
    let recording = Recording { empty, volumes: &volumes, steps: &options.steps, repeats: options.repeats };
    let begun = begun(options, &recording)?;
    let stop = interrupt::flag()?;
    make_folder_of(&options.out)?;
    let bar = progress_bar("record");
    let trace = record(
        &recording,
        renderer.as_mut(),
        begun,
        &|| interrupt::requested(&stop),
        &mut |trace| trace.write(&options.out),
        &bar,
    );
    bar.finish_and_clear();
    let trace = trace?;
    ensure!(
        trace.is_complete(),
        "interrupted after {} of {} frames; to continue {}, repeat the same command with --resume",
        trace.frames.len(),
        trace.path.frames,
        options.out.display()
    );
    println!("{}: {} frames", options.out.display(), trace.frames.len());
    Ok(())
}

/// Trace of an interrupted recording; `None` without --resume, or if there is no such recording.
fn begun(options: &Options, recording: &Recording<'_>) -> Result<Option<Trace>> {
    if !options.resume || !options.out.exists() {
        return Ok(None);
    }
    let begun = Trace::open_begun(&options.out)?;
    let differences = begun.differences(recording);
    ensure!(
        differences.is_empty(),
        "cannot continue {}: its {} differ; use the same settings, or another --out",
        options.out.display(),
        differences.join(", ")
    );
    Ok(Some(begun))
}

/// Opens the renderer, and returns it with the settings with which it draws.
fn opened(options: &Options) -> Result<(Box<dyn Renderer>, DrawSettings)> {
    let renderer = open_renderer(options.render.device)?;
    let clock = waited_for(options.clock, renderer.as_ref());
    Ok((renderer, DrawSettings::new(options.size, &options.render, clock)))
}

/// Writes a timing table of random scenes; each scene is rendered at all six ray steps of a calibration.
fn calibrate(options: &Options, scenes: usize) -> Result<()> {
    ensure!(scenes >= 8, "--calibration is {scenes}; at least 8 scenes per volume are needed");
    let (mut renderer, draw) = opened(options)?;
    let timing: fn(f64) -> Timing = match draw.clock {
        Clock::Cpu => |seconds| Timing { cpu: Some(seconds), ..Timing::default() },
        Clock::Device => |seconds| Timing { device: Some(seconds), ..Timing::default() },
        Clock::Wall => |seconds| Timing { wall: Some(seconds), ..Timing::default() },
    };
    let stop = interrupt::flag()?;
    make_folder_of(&options.out)?;
    let mut table = Writer::create(&options.out)?;
    let mut rows = Vec::new();
    for file in &options.volumes {
        let volume =
            TraceVolume { file: file.clone(), enlarge: options.enlarge, files: Vec::new() }.open()?;
        let view = volume.view();
        let shown = file.display().to_string();
        let samples = measure(
            &view,
            &VolumeSummary::new(&view)?,
            &draw,
            (SEED, &shown),
            (scenes, options.repeats),
            renderer.as_mut(),
            &|| interrupt::requested(&stop),
            &format!("calibrate {shown}"),
        )?;
        let samples = samples.context("interrupted; nothing is kept")?;
        for s in samples {
            let scene = Scene {
                volume: shown.clone(),
                member: String::new(),
                time_step: None,
                dims: volume.dims().map(|n| n as u32),
                camera: s.camera,
                fov_y_degrees: DEFAULT_FOV_Y_DEGREES,
                width: draw.width,
                height: draw.height,
                step: s.setting.step,
                shading: draw.shading,
                skipping: draw.skipping,
                termination: draw.termination,
                lobes: s.lobes,
            };
            rows.push((scene, timing(s.seconds)));
        }
    }
    // The rows are written only now: `replay` would accept a table that lacks some of the volumes, and no
    // command could complete this table.
    for (number, (scene, timing)) in (0..).zip(&rows) {
        table.append(number, scene, &[*timing])?;
    }
    println!("{}: {} frames", options.out.display(), rows.len());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_are_read_and_checked() {
        assert_eq!(parse_scale("40:0.5"), Ok((40, 0.5)));
        for bad in ["", "40", "x:1", "4:0", "4:nan", "4:9"] {
            assert!(parse_scale(bad).unwrap_err().contains("FRAME:SCALE"), "{bad}");
        }
    }
}
