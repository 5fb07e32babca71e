//! `entire steer`: play a path against a target frame time under several controllers.

use crate::calibrate::place::machine_model_for;
use crate::collection::{Job, ensure_utf8, manifest_of};
use crate::steering::contenders::ControllerKind;
use crate::steering::model::steering_model;
use crate::steering::play::{Course, Playback};
use crate::steering::race::{Race, prepare};
use crate::steering::report::{FILES, Story, make_report_folder, table, write};
use anyhow::{Context, Result, bail, ensure};
use entire_io::clock::{ClockChoice, agreed, clock_parser, unstated, waited_for};
use entire_io::dataset::{Scene, Writer};
use entire_io::files::{ensure_not_input, ensure_not_own, make_folder_of, note, open_model, write_json};
use entire_io::machine::Provenance;
use entire_io::options::{
    DrawSettings, RenderArgs, open_renderer, parse_distance, parse_hold, parse_limits, parse_scale,
    parse_size, parse_target,
};
use entire_io::path::{FlightPath, Generated};
use entire_io::scenes::RandomScene;
use entire_io::volume::{Reading, Volume, open_volume};
use entire_io::{identity, interrupt};
use entire_steer::control::StepLimits;
use serde_json::json;
use std::path::{Path, PathBuf};

/// Play a path of cameras and transfer functions under several controllers, and compare the frame times with
/// a target.
///
/// First, random frames of the volume are rendered at several steps, to measure the time that coarser steps
/// save; the predictor is not fitted to these frames. Then the path is played. Each frame is drawn under
/// every controller before the next frame begins; the order of the controllers rotates from frame to frame.
/// Each frame is also drawn at the reference step; the time of this drawing counts for no controller. Writes
/// frames.csv (every frame under every controller), summary.json and report.html to the folder of --out.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire steer skull.nrrd --generate switches --target 30fps --out out/steer
  entire steer skull.nrrd --path examples/paths/switches.json --target 33ms \\
      --controllers olp,hybrid --out out/skull
  entire steer t1.nrrd t2.nrrd t3.nrrd --hold 20 --generate orbit \\
      --target 30fps --out out/series
  entire steer skull.nrrd --generate fly-in --target 60fps \\
      --max-image-sample-distance 1 --table observed.csv --out out/skull")]
pub(crate) struct Options {
    /// The volume file; several files are a series of volumes (see --hold).
    #[arg(value_name = "VOLUME", required = true)]
    pub(crate) volumes: Vec<PathBuf>,
    /// Frames per volume of a series.
    #[arg(long, value_name = "N")]
    pub(crate) hold: Option<u32>,
    /// The path file to play (JSON; the format is documented with the examples in examples/paths).
    #[arg(long, value_name = "FILE.json", conflicts_with = "generate", required_unless_present = "generate")]
    pub(crate) path: Option<PathBuf>,
    /// Generate a path of this kind for the volume, instead of --path.
    #[arg(long, value_enum)]
    pub(crate) generate: Option<Generated>,
    /// Frames of a generated path.
    #[arg(long, default_value_t = 120, value_name = "N", conflicts_with = "path")]
    pub(crate) frames: u32,
    /// Also write the generated path to a file.
    #[arg(long, value_name = "FILE.json", conflicts_with = "path")]
    pub(crate) save_path: Option<PathBuf>,
    /// Target frame time: 33ms, 0.033s or 30fps.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    pub(crate) target: String,
    /// Changes of the image size, comma-separated: FRAME:SCALE multiplies both sides of the full image by
    /// SCALE from frame FRAME on, as if a window were resized.
    #[arg(long, value_delimiter = ',', value_name = "FRAME:SCALE,…", value_parser = parse_scale)]
    pub(crate) scales: Vec<(u32, f32)>,
    /// Largest distance between rays along each image side under the controller hybrid, in pixels; 1 keeps
    /// the full image size. This controller coarsens the step or the image, whichever adds less error.
    /// Smaller images are enlarged to full size before pictures are compared.
    #[arg(
        long,
        default_value_t = MAX_IMAGE_SAMPLE_DISTANCE,
        value_name = "PIXELS",
        value_parser = parse_distance
    )]
    pub(crate) max_image_sample_distance: f32,
    /// Write all frames of all controllers into a timing table, for `entire train --fine-tune`.
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) table: Option<PathBuf>,
    /// Controllers to compare. Controllers that act on image resolution draw smaller images at the reference
    /// step.
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        default_values_t = ControllerKind::DEFAULT_SET,
        value_name = "NAME,…"
    )]
    pub(crate) controllers: Vec<ControllerKind>,
    /// Number of random scenes of the volume that are rendered first, at six steps each, to measure the time
    /// that coarser steps save.
    #[arg(long, default_value_t = 16, value_name = "N")]
    pub(crate) scenes: usize,
    /// Renderings of each random scene at each step; the median time is used.
    #[arg(long, default_value_t = 1, value_name = "R")]
    pub(crate) repeats: usize,
    /// Model file; default: the machine's model (`entire calibrate`), else the shipped model, corrected by
    /// the measured time of every frame.
    #[arg(long, value_name = "M.safetensors")]
    pub(crate) model: Option<PathBuf>,
    /// Folder for the results.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Image size, pixels.
    #[arg(long, default_value = "256x256", value_name = "WxH", value_parser = parse_size)]
    pub(crate) size: (u32, u32),
    /// Rendering options.
    #[command(flatten)]
    pub(crate) render: RenderArgs,
    /// Options for reading the volumes.
    #[command(flatten)]
    pub(crate) reading: Reading,
    /// The clock of frame times; `auto`: the clock of --model or of the machine's model (`entire calibrate`),
    /// else the device's timestamps on a GPU, else wall time. A --model of another clock is refused; the
    /// machine's model is ignored if it states another clock.
    #[arg(long, value_parser = clock_parser(), default_value = "auto")]
    pub(crate) clock: ClockChoice,
    /// Finest and coarsest allowed step, in reference steps. Controllers that act on image resolution have
    /// their own ranges.
    #[arg(long, default_value = "1,16", value_name = "FINEST,COARSEST", value_parser = parse_limits)]
    pub(crate) limits: StepLimits,
    /// Enlarge the volume trilinearly by this factor along each axis.
    #[arg(long, default_value_t = 1, value_name = "FACTOR")]
    pub(crate) enlarge: usize,
    /// Seed of the random scenes.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Frames whose pictures are added to the report, besides the frames of the first 20 switches.
    #[arg(long, value_delimiter = ',', value_name = "FRAME,…")]
    pub(crate) pictures: Vec<usize>,
}

/// Default of `--max-image-sample-distance`, in pixels between rays.
const MAX_IMAGE_SAMPLE_DISTANCE: f32 = 4.0;

/// Number of switches whose pictures are kept for the report.
const PICTURED_SWITCHES: usize = 20;

pub(crate) fn run(options: &Options) -> Result<()> {
    let target = parse_target(&options.target).context("--target")?;
    ensure!(!options.controllers.is_empty(), "--controllers names no controller");
    for (i, kind) in options.controllers.iter().enumerate() {
        ensure!(!options.controllers[..i].contains(kind), "--controllers names {} twice", kind.name());
    }
    ensure!(
        options.scenes >= 4 && options.repeats >= 1,
        "--scenes is {} and --repeats {}; at least 4 scenes, rendered at least once, are needed",
        options.scenes,
        options.repeats
    );
    ensure!(
        options.max_image_sample_distance == MAX_IMAGE_SAMPLE_DISTANCE
            || options.controllers.contains(&ControllerKind::Hybrid),
        "--max-image-sample-distance is for the controller hybrid; leave it out, or name hybrid too"
    );
    if options.table.is_some() {
        options.volumes.iter().try_for_each(|volume| ensure_utf8(volume))?;
    }
    let hold = parse_hold(options.volumes.len(), options.hold)?;
    ensure!(options.scales.is_sorted_by_key(|s| s.0), "--scales must be ordered by frame");
    if let Some(to) = &options.save_path {
        let inputs = options.volumes.iter().chain(&options.model);
        ensure_not_input(to, inputs.map(PathBuf::as_path)).context("--save-path")?;
        make_folder_of(to)?;
        ensure_not_own(to, &options.out, &FILES).context("--save-path")?;
    }
    let model = options.model.as_deref().map(open_model).transpose()?;
    let named = options.model.as_ref().map(|p| p.display().to_string());
    let given = named.as_deref().zip(model.as_ref());
    let clock = agreed(options.clock, given)?;
    if let Some(text) = clock.and_then(|clock| unstated(clock, given)) {
        note(&text);
    }
    // The path is checked before the volumes are read, which may take minutes.
    let stored =
        options.path.as_deref().map(|file| anyhow::Ok((FlightPath::open(file)?, file))).transpose()?;
    let frames = stored.as_ref().map_or(options.frames as usize, |(path, _)| path.frames.len());
    let named_frames = options.scales.iter().map(|s| ("--scales", s.0 as usize));
    for (option, frame) in named_frames.chain(options.pictures.iter().map(|&frame| ("--pictures", frame))) {
        let last = frames.saturating_sub(1);
        ensure!(frame < frames, "{option} names frame {frame}; the path has frames 0 to {last}");
    }
    let volumes = options
        .volumes
        .iter()
        .map(|file| open_volume(file, &options.reading)?.enlarged(options.enlarge))
        .collect::<Result<Vec<Volume>>>()?;
    let view = volumes[0].view();
    let (path, path_name) = match (stored, options.generate) {
        (Some((path, file)), _) => {
            let name = format!("{} ({})", path.name, file.display());
            (path, name)
        }
        (None, Some(kind)) => {
            let file = kind.path(&view, options.frames)?;
            if let Some(to) = &options.save_path {
                write_json(to, &file)?;
            }
            (file.resolve()?, format!("{} (generated, {} frames)", kind.name(), options.frames))
        }
        (None, None) => bail!("give --path or --generate"),
    };
    let stop = interrupt::flag()?;
    let stop = || interrupt::requested(&stop);
    make_report_folder(&options.out)?;
    let mut renderer = open_renderer(options.render.device)?;
    let (machines, clock) = match model {
        Some(_) => (None, waited_for(clock, renderer.as_ref())),
        None => machine_model_for(options.render.shade, clock, renderer.as_ref())?,
    };
    let draw = DrawSettings::new(options.size, &options.render, clock);
    let steers = steering_model(named.zip(model), machines, draw.shading, &view)?;
    let mut keep = path.switches();
    keep.truncate(PICTURED_SWITCHES);
    keep.extend(&options.pictures);
    let race = Race {
        volumes: &volumes,
        path: &path,
        keep: &keep,
        course: Course {
            hold,
            scales: &options.scales,
            max_image_sample_distance: options.max_image_sample_distance,
            limits: options.limits,
        },
        seed: options.seed,
        scenes: (options.scenes, options.repeats),
        draw,
        controllers: &options.controllers,
        target: Some(target),
        model: &steers,
    };
    let mut timings =
        options.table.as_ref().map(|file| begin_table(file, &options.out, &path)).transpose()?;
    let prepared = prepare(&race, renderer.as_mut(), &stop)?;
    let playback = race.run(&prepared, renderer.as_mut(), &stop)?;
    let story = Story {
        title: "Steering a frame time".into(),
        lead: format!(
            "{}, path {}: {} frames, target {:.1} ms, {} controllers.",
            volumes[0].source().display(),
            path.name,
            path.frames.len(),
            target * 1e3,
            options.controllers.len()
        ),
        target: format!("{:.2} ms, as requested ({})", target * 1e3, options.target),
        volume: volumes.iter().map(|volume| describe(volume, options.enlarge)).collect::<Vec<_>>().join("; "),
        path: path_name,
        predictor: prepared.predictor.clone(),
        response: prepared.curve.clone(),
        remarks: Vec::new(),
        provenance: Provenance::of(renderer.device()),
    };
    let metrics = write(&options.out, &story, &draw, &playback)?;
    if let (Some(timings), Some(file)) = (&mut timings, &options.table) {
        let written = write_table(timings, &volumes, &path, &draw, &playback)?;
        let settings = json!({ "steering": true, "reading": options.reading });
        let mut manifest = manifest_of(renderer.as_ref(), 0, 1, settings);
        for file in volumes.iter().map(Volume::source) {
            manifest.files.insert(file.display().to_string(), identity::of_volume(file)?);
        }
        manifest.write(file)?;
        println!("table      {}: {written} frames", file.display());
    }
    println!("{}", table(&playback, &metrics).to_text());
    println!("steered by {}", prepared.predictor.sentence());
    println!("frame times are {} time", draw.clock.name());
    println!(
        "* best of the column. T: target; t: frame time. Report: {}",
        options.out.join("report.html").display()
    );
    Ok(())
}

/// Begins a timing table for the frames of a path; `out` is the folder of the results.
///
/// # Errors
/// When a table cannot hold the path's frames, or the file exists, is one of the results, or cannot be
/// written.
fn begin_table(file: &Path, out: &Path, path: &FlightPath) -> Result<Writer> {
    for (i, at) in path.frames.iter().enumerate() {
        ensure!(
            at.transfer.lobes().is_some(),
            "--table needs transfer functions made of lobes; frame {i} has control points, which timing \
             tables do not hold"
        );
        ensure!(
            at.parallel_scale.is_none(),
            "--table needs perspective cameras; frame {i} has a parallel one, which timing tables do not hold"
        );
    }
    make_folder_of(file)?;
    ensure_not_own(file, out, &FILES).context("--table")?;
    Writer::create(file)
}

/// Writes every frame that each controller drew to a timing table; returns their number.
fn write_table(
    table: &mut Writer,
    volumes: &[Volume],
    path: &FlightPath,
    draw: &DrawSettings,
    playback: &Playback,
) -> Result<u64> {
    let mut number = 0;
    let jobs: Vec<Job> = volumes.iter().map(|volume| Job::from_path(volume.source())).collect();
    for (i, at) in path.frames.iter().enumerate() {
        let volume = playback.volumes[i];
        let job = &jobs[volume];
        for records in &playback.records {
            let r = &records[i];
            let (camera, (width, height), step) = (at.camera, r.size, r.step);
            let lobes = at.transfer.lobes().unwrap_or_default();
            let drawn = RandomScene { camera, width, height, step, lobes };
            let modes = (draw.shading, draw.skipping, draw.termination);
            let scene = job.scene(drawn, volumes[volume].dims(), modes);
            let scene = Scene { fov_y_degrees: path.fov_y_degrees, ..scene };
            table.append(number, &scene, &[r.measured])?;
            number += 1;
        }
    }
    Ok(number)
}

pub(super) fn describe(volume: &Volume, factor: usize) -> String {
    let (shown, [x, y, z]) = (volume.source().display(), volume.dims());
    let enlarged = if factor == 1 { String::new() } else { format!(", enlarged trilinearly x{factor}") };
    format!("{shown}: {x} x {y} x {z} voxels{enlarged}")
}
