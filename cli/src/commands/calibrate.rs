//! `entire calibrate`: fit a model to this machine in a minute and a half.

use crate::calibrate::place::{DATA_FOLDER, file_of, volumes_in};
use crate::calibrate::report::{Pictures, Report};
use crate::calibrate::{MachineModel, NamedPrior, Settings, calibrate, calibrate_to_tables};
use crate::collection::{ensure_utf8, manifest_of};
use crate::program::print_line;
use crate::shipped::shipped_priors;
use anyhow::{Context, Result, ensure};
use clap::builder::{PossibleValue, PossibleValuesParser};
use entire_core::scene::{Shading, Skipping};
use entire_io::clock::{ClockChoice, clock_parser};
use entire_io::dataset::{Clock, Manifest, Writer, left_out, open_tables, read_pictures, shaded};
use entire_io::files::{
    check_model_out, ensure_distinct, ensure_not_input, make_folder_of, note, read_model_file, write_whole,
};
use entire_io::interrupt;
use entire_io::options::{
    Device, check_termination, names_software, open_renderer, shades, skip_parser, thread_pool,
};
use entire_io::volume::Reading;
use entire_steer::calibrate::fit_quality;
use entire_steer::predict::Quality;
use entire_train::fit::{typical_costs, typical_costs_of};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Fit a model to this machine in a minute and a half.
///
/// Renders frames that are chosen by optimal design of experiments, in two to four passes, depending on the
/// spread of repeats. Warm-up renderings are discarded. Then it fits unit costs (seconds per unit of each
/// kind of work, such as a sample) to the measured times. The prior is the shipped models of the shading
/// mode; on a GPU, it is typical costs of a GPU. A few frames determine the speed of this machine; hundreds
/// of frames determine each unit cost. Prints the error on held-out volumes, and warns if other programs used
/// the machine. Ctrl-C ends the measurement early; the model is then fitted to the frames measured so far.
/// `demo`, `steer`, `explore`, `predict` and libentire (entire_model_open_machine) find the model by
/// themselves.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire calibrate
        measures without shading on the volumes in data/, and stores the model
        in the user's data folder
  entire calibrate --shade all
        makes one model for each of the shading modes none, local and scatter;
        each takes a minute and a half
  entire calibrate skull.nrrd engine.vti --shade local --out here.safetensors
  entire calibrate --data log.csv --clock wall --out my-renderer.safetensors
        fits the model to frames that your own renderer logged; renders nothing
  entire calibrate --data log.csv --pictures compared.csv --clock wall \\
      --out both.safetensors
        fits the model to frame times, and the quality law to picture errors of
        coarser steps and smaller images")]
pub(crate) struct Options {
    /// Volume files; default: all volumes in data/, but of ensembles only the training members.
    #[arg(value_name = "VOLUME")]
    pub(crate) volumes: Vec<PathBuf>,
    /// Timing tables that your own renderer logged. Nothing is rendered: the model is fitted to the frames of
    /// these tables that have the shading --shade and a time by --clock. Needs --out.
    #[arg(
        long,
        num_args = 1..,
        value_name = "CSV",
        requires = "out",
        conflicts_with_all = ["volumes", "table", "seconds", "frames", "skip", "termination", "min_size",
            "max_size", "steps", "device", "seed", "array", "fill", "range"]
    )]
    pub(crate) data: Vec<PathBuf>,
    /// Table of compared pictures of the renderer of --data. A quality law (picture error as a function of
    /// ray step and image size) is fitted to the table and stored in the model file, for steering that
    /// coarsens both step and image.
    ///
    /// Columns: scene, step (multiple of the finest step), image_sample_distance (pixels), seconds, error (0
    /// for equal pictures). Each scene must be drawn at the same settings, one of which is full quality.
    #[arg(long, value_name = "CSV", requires = "data")]
    pub(crate) pictures: Option<PathBuf>,
    /// Shading of each sample; `all` calibrates none, local and scatter, one after another.
    #[arg(long, value_parser = shades_or_all(), default_value = "none")]
    pub(crate) shade: String,
    /// Clock of the predicted seconds: `cpu` is processor time of all threads, `wall` is wall time, `device`
    /// is the device's timestamps; `auto` is `device` on a GPU, else `wall`.
    #[arg(long, value_parser = clock_parser(), default_value = "auto")]
    pub(crate) clock: ClockChoice,
    /// The model file; with --shade all, `-none`, `-local` and `-scatter` are added to its name. Default:
    /// machine-MODE.safetensors in the folder entire of the user's data folder.
    #[arg(long, value_name = "FILE.safetensors")]
    pub(crate) out: Option<PathBuf>,
    /// Also write the measured frames, as a timing table.
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) table: Option<PathBuf>,
    /// Prior model of unit costs. Default: the shipped models of the shading mode; on a GPU, and for a mode
    /// without a shipped model, typical costs of this kind of renderer.
    #[arg(long, value_name = "SAFETENSORS")]
    pub(crate) prior: Option<PathBuf>,
    /// Time limit for each shading mode, in wall seconds.
    #[arg(long, default_value_t = 85.0, value_name = "SECONDS", value_parser = parse_seconds)]
    pub(crate) seconds: f64,
    /// Maximum number of frames for each shading mode.
    #[arg(long, default_value_t = 500, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=100_000))]
    pub(crate) frames: u32,
    /// Options for reading the volumes.
    #[command(flatten)]
    pub(crate) reading: Reading,
    /// Skipping of empty space.
    #[arg(long, value_parser = skip_parser(), default_value = "blocks")]
    pub(crate) skip: Skipping,
    /// Accumulated opacity at which a ray stops; 1 for never.
    #[arg(long, default_value_t = 0.99, value_name = "OPACITY", allow_hyphen_values = true)]
    pub(crate) termination: f32,
    /// Shortest image side, pixels.
    #[arg(long, default_value_t = 32, value_name = "PIXELS")]
    pub(crate) min_size: u32,
    /// Longest image side, pixels.
    #[arg(long, default_value_t = 1024, value_name = "PIXELS")]
    pub(crate) max_size: u32,
    /// Ray steps, in reference steps; each frame gets one of them at random. A step that is listed twice is
    /// chosen twice as often.
    #[arg(long, value_delimiter = ',', default_values_t = [1.0, 1.0, 1.0, 2.0, 4.0], value_name = "STEP,…")]
    pub(crate) steps: Vec<f32>,
    /// The renderer.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) device: Device,
    /// Seed of every random choice.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Folder of the tables' volumes, if it is neither the working folder nor the folder of the table.
    #[arg(long, value_name = "FOLDER", requires = "data", conflicts_with = "volumes")]
    pub(crate) root: Option<PathBuf>,
    /// Number of threads that compute scene features; default: one per logical processor.
    #[arg(long)]
    pub(crate) threads: Option<usize>,
}

fn shades_or_all() -> PossibleValuesParser {
    let all = "Unshaded, local lighting and single scattering, one after another";
    let mut values = shades();
    values.push(PossibleValue::new(ALL).help(all));
    values.into()
}

const ALL: &str = "all";

pub(super) fn parse_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if (5.0..=3600.0).contains(&s) => Ok(s),
        _ => Err("a number of wall seconds from 5 to 3600 is expected".to_owned()),
    }
}

/// Returns the shading modes with their model files, and makes the files' folders.
fn outs_of(options: &Options) -> Result<Vec<(Shading, PathBuf)>> {
    let modes = match options.shade.as_str() {
        ALL => vec![Shading::None, Shading::Local, Shading::Scatter],
        one => vec![one.parse()?],
    };
    let mut outs = Vec::new();
    for shading in modes {
        let out = match &options.out {
            None => file_of(shading).context(
                "there is no home folder to keep the machine's model in; name a file with --out, or set \
                 XDG_DATA_HOME",
            )?,
            Some(out) if options.shade == ALL => {
                let stem = out.file_stem().context("--out names no file")?.to_string_lossy().into_owned();
                out.with_file_name(format!("{stem}-{shading}.safetensors"))
            }
            Some(out) => out.clone(),
        };
        check_model_out(&out)?;
        ensure_not_input(&out, options.prior.as_deref())?;
        outs.push((shading, out));
    }
    Ok(outs)
}

pub(crate) fn run(options: &Options) -> Result<()> {
    if !options.data.is_empty() {
        return from_tables(options);
    }
    let volumes = if options.volumes.is_empty() {
        let folder = Path::new(DATA_FOLDER);
        ensure!(
            folder.is_dir(),
            "{DATA_FOLDER}/ is not here; run this in the project's root, or name volume files"
        );
        volumes_in(folder).with_context(|| format!("cannot list the files in {DATA_FOLDER}/"))?
    } else {
        // A second copy of a volume would not be held out with the first one.
        ensure_distinct(&options.volumes)?;
        options.volumes.iter().try_for_each(|volume| ensure_utf8(volume))?;
        options.volumes.clone()
    };
    check_termination(options.termination)?;
    let outs = outs_of(options)?;
    // A model that replaced the open table would lose the table's frames.
    let files: Vec<PathBuf> = outs.iter().map(|(_, out)| out).chain(&options.table).cloned().collect();
    ensure_distinct(&files).context("--table and --out")?;
    let threads = thread_pool(options.threads)?;
    let stop = interrupt::flag()?;
    let mut renderer = open_renderer(options.device)?;
    let clock = entire_io::clock::waited_for(options.clock, renderer.as_ref());
    ensure!(
        clock != Clock::Device || renderer.limits().is_some_and(|l| l.timestamps.is_some()),
        "--clock device: {} has no timestamps, so device time cannot be measured; choose --clock wall",
        renderer.device()
    );
    let prior = prior_of(options, clock)?;
    let begin = |file: &PathBuf| make_folder_of(file).and_then(|()| Writer::create(file));
    let mut table = options.table.as_ref().map(begin).transpose()?;
    let mut written = 0;
    print_line(format!("renderer   {} ({})", renderer.device(), renderer.backend()))?;
    for &(shading, ref out) in &outs {
        let priors = match &prior {
            Some(prior) => vec![prior.clone()],
            None => shipped_priors(shading, &typical_costs(renderer.backend(), &renderer.device()))?,
        };
        let settings = Settings {
            volumes: volumes.clone(),
            reading: options.reading.clone(),
            shading,
            skipping: options.skip,
            termination: options.termination,
            clock,
            seconds: options.seconds,
            frames: options.frames as usize,
            sizes: (options.min_size, options.max_size),
            steps: options.steps.clone(),
            seed: options.seed,
        };
        let stopped = || interrupt::requested(&stop);
        let MachineModel { file, report, frames } =
            calibrate(&settings, &priors, renderer.as_mut(), &threads, &stopped)?;
        write_whole(out, &file.to_bytes()?)?;
        if let Some(table) = &mut table {
            for f in &frames {
                table.append(written, &f.scene, &f.repeats)?;
                written += 1;
            }
        }
        if let Some(path) = &options.table {
            let settings = json!({ "calibration": true, "reading": options.reading });
            // The number of repeats differs between frames, so the manifest states 0.
            let manifest = manifest_of(renderer.as_ref(), options.seed, 0, settings);
            Manifest { files: report.files.clone(), ..manifest }.write(path)?;
        }
        say(&report, out)?;
        if stopped() {
            note("interrupted; the model was fitted to the frames measured until then");
            break;
        }
    }
    Ok(())
}

/// Returns the model of --prior with its name. Prints a note if this prior and the new model predict seconds
/// of different clocks.
fn prior_of(options: &Options, clock: Clock) -> Result<Option<NamedPrior>> {
    let Some(path) = &options.prior else { return Ok(None) };
    let (file, model) = read_model_file(path)?;
    let name = path.display().to_string();
    if let Some(text) = entire_io::clock::started_from(&name, entire_io::clock::of(&model), clock) {
        note(&text);
    }
    Ok(Some((name, file)))
}

fn from_tables(options: &Options) -> Result<()> {
    let outs = outs_of(options)?;
    let tables = open_tables(&options.data, options.root.as_deref())?;
    let renderer = tables.iter().find_map(|table| table.manifest.as_ref()).map(|m| m.renderer.as_str());
    let built_in = renderer.and_then(Quality::built_in);
    let pictures = options.pictures.as_deref().map(|path| compared(path, built_in)).transpose()?;
    let threads = thread_pool(options.threads)?;
    // Device timestamps of a software renderer are no better than wall time, so `auto` means wall time, as in
    // a calibration that renders frames.
    let software = |table: &entire_io::dataset::Table| {
        table.manifest.as_ref().is_some_and(|m| names_software(&m.renderer, &m.device))
    };
    let asked = match options.clock {
        None if tables.iter().all(software) => Some(Clock::Wall),
        clock => clock,
    };
    let used = outs.iter().flat_map(|(shading, _)| shaded(&tables, Some(*shading)));
    let clock = entire_io::clock::concrete(asked, used)?;
    let prior = prior_of(options, clock)?;
    for &(shading, ref out) in &outs {
        if let Some(text) = left_out(&tables, clock, Some(shading)) {
            note(&text);
        }
        let priors = match &prior {
            Some(prior) => vec![prior.clone()],
            None => shipped_priors(shading, &typical_costs_of(&tables))?,
        };
        let (file, report) = calibrate_to_tables(&tables, (shading, clock), &priors, pictures, &threads)?;
        write_whole(out, &file.to_bytes()?)?;
        say(&report, out)?;
    }
    Ok(())
}

/// The quality law of a table of compared pictures; `built_in` is the built-in law of the renderer.
fn compared(path: &Path, built_in: Option<Quality>) -> Result<Pictures> {
    let fitted = fit_quality(&read_pictures(path)?, built_in).with_context(|| path.display().to_string())?;
    Ok(Pictures { error: "given", fitted })
}

/// Prints the report of a calibration whose model was written to `out`.
fn say(report: &Report, out: &Path) -> Result<()> {
    print_line(report.text().trim_end())?;
    for warning in report.warnings() {
        print_line(format!("{:<11}{warning}", "note"))?;
    }
    print_line(format!("{:<11}{} ({:.0} s)", "wrote", out.display(), report.seconds))
}
