//! `entire collect`: render many random frames of volumes and write down how long each took.
//!
//! The protocol is the paper's (section "Data collection"): the renderer takes one volume at a time, renders all its
//! frames, each several times, then takes the next; loading is not timed. Scenes come from
//! [`SceneDistribution`], each depending on the seed, the volume and its number alone. Every repeat is a row of the
//! table (see [`crate::dataset`]); medians are taken by whoever reads it.

use crate::dataset::{
    Clock, MANIFEST_FORMAT, Manifest, Scene, Table, Timing, Writer, noise_floor, parse_shading,
    parse_skipping,
};
use crate::device::{self, Device};
use crate::enlarge::{enlarge, resample};
use crate::interrupt;
use crate::machine;
use crate::options::{ShadeOption, SkipOption};
use crate::progress::progress_bar;
use crate::scenes::{DEFAULT_RADII, SceneDistribution};
use crate::teacher::Teacher;
use crate::volume::Volume;
use anyhow::{Context, Result, bail, ensure};
use entire_core::scene::{DEFAULT_FOV_Y_DEGREES, Shading, Skipping};
use entire_vk_raycaster::Renderer;
use indicatif::ProgressBar;
use serde::Deserialize;
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Render many random frames of volumes and write down how long each took.
///
/// Cameras stand on semi-spheres of several radii, transfer functions are random Gaussian lobes, images are square and
/// not, sides log-uniform. Each frame is rendered several times and every repeat becomes a row; a manifest beside the
/// table says with what it was measured. The same seed gives the same frames of a volume, whatever else is collected.
/// Ctrl-C keeps every finished frame; go on with --resume.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire collect data/*.nrrd --out frames.csv
  entire collect castro_blast/m0?/t00*.nrrd --out castro.csv --frames 100 --shade local
  entire collect skull.nii.gz --out skull.csv --steps 0.5,1,2,4 --max-size 512 --resume
  entire collect --like data/timings/none-train.csv.gz --out again.csv")]
pub struct Options {
    /// Volume files. Files named like `t0012.nrrd` are time steps; their folder is their ensemble member.
    #[arg(required_unless_present = "like", value_name = "VOLUME")]
    pub volumes: Vec<PathBuf>,
    /// The table to write; its manifest goes beside it as NAME.manifest.json.
    #[arg(long, value_name = "FILE.csv")]
    pub out: PathBuf,
    /// Collect the frames of this table anew: volumes, frames and all settings come from its manifest. Its volume names
    /// start from the working folder.
    #[arg(long, value_name = "TABLE", conflicts_with_all = ["volumes", "frames", "repeats", "passes", "warm_up", "seed",
        "shade", "skip", "termination", "min_size", "max_size", "radii", "lobes", "steps", "member", "enlarge", "proxy"])]
    pub like: Option<PathBuf>,
    /// Frames per volume.
    #[arg(long, default_value_t = 100, value_name = "N")]
    pub frames: u32,
    /// How often each frame is rendered.
    #[arg(long, default_value_t = 5, value_name = "R")]
    pub repeats: u32,
    /// Go through all volumes so often, with --repeats renderings of each frame every time: repeats minutes apart show
    /// the machine's drift, which repeats at once do not.
    #[arg(long, default_value_t = 1, value_name = "P")]
    pub passes: u32,
    /// Frames rendered and thrown away after each volume is loaded, so that first-use work is not timed.
    #[arg(long, default_value_t = 2, value_name = "N")]
    pub warm_up: u32,
    /// Seed of every random choice.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// What each sample computes.
    #[arg(long, value_enum, default_value_t)]
    pub shade: ShadeOption,
    /// How empty space is skipped.
    #[arg(long, value_enum, default_value_t)]
    pub skip: SkipOption,
    /// Accumulated opacity at which a ray stops; 1 for never.
    #[arg(long, default_value_t = 0.99, value_name = "OPACITY")]
    pub termination: f32,
    /// What renders.
    #[arg(long, value_enum, default_value_t)]
    pub device: Device,
    /// Predict the frames by this model instead of rendering them, so that a model that needs very many frames can be
    /// distilled from one that needs few; every clock reads the prediction.
    #[arg(long, value_name = "SAFETENSORS", conflicts_with_all = ["device", "proxy"])]
    pub teacher: Option<PathBuf>,
    /// Shortest image side, pixels.
    #[arg(long, default_value_t = 32, value_name = "PIXELS")]
    pub min_size: u32,
    /// Longest image side, pixels.
    #[arg(long, default_value_t = 1024, value_name = "PIXELS")]
    pub max_size: u32,
    /// Radii of the semi-spheres that cameras stand on, bounding-sphere radii.
    #[arg(long, value_delimiter = ',', default_values_t = DEFAULT_RADII, value_name = "R,…")]
    pub radii: Vec<f32>,
    /// Gaussian lobes per transfer function: a number, or the least and most as `2-4`.
    #[arg(long, default_value = "3", value_name = "N[-M]", value_parser = parse_lobe_range)]
    pub lobes: (u32, u32),
    /// Ray steps to draw from, reference steps.
    #[arg(long, value_delimiter = ',', default_values_t = [1.0], value_name = "STEP,…")]
    pub steps: Vec<f32>,
    /// Ensemble member of the volumes: one for all, or one for each. Else it follows from the folder's name.
    #[arg(long, num_args = 1.., value_name = "NAME")]
    pub member: Vec<String>,
    /// Enlarge every volume by this factor at load, trilinearly, so that small volumes cost what large ones do.
    #[arg(long, default_value_t = 1, value_name = "FACTOR")]
    pub enlarge: usize,
    /// Render every volume resampled to so many voxels an edge instead: the low-resolution proxy of the same frames.
    #[arg(long, value_name = "EDGE", conflicts_with = "enlarge")]
    pub proxy: Option<usize>,
    /// Go on with a table that was interrupted. Settings and machine must be those of its manifest.
    #[arg(long)]
    pub resume: bool,
}

fn parse_lobe_range(text: &str) -> std::result::Result<(u32, u32), String> {
    let (least, most) = text.split_once('-').unwrap_or((text, text));
    match (least.trim().parse(), most.trim().parse()) {
        (Ok(least), Ok(most)) => Ok((least, most)),
        _ => Err(format!("{text:?} is neither a number nor two numbers like 2-4")),
    }
}

/// A volume to collect frames of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Job {
    /// The file.
    pub path: PathBuf,
    /// Its ensemble member; empty for none.
    pub member: String,
    /// Its time step, where its name tells one.
    pub time_step: Option<u32>,
}

impl Job {
    /// What can be read off a path: `…/m01/t0012.nrrd` is time step 12 of member `m01`.
    pub fn from_path(path: &Path) -> Self {
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let stem = name.split('.').next().unwrap_or_default();
        let time_step = stem
            .strip_prefix('t')
            .filter(|d| !d.is_empty() && d.bytes().all(|b| b.is_ascii_digit()))
            .and_then(|d| d.parse().ok());
        let folder =
            std::path::absolute(path).ok().and_then(|p| p.parent()?.file_name().map(|n| n.to_owned()));
        let member = match (time_step, folder) {
            (Some(_), Some(folder)) => folder.to_string_lossy().into_owned(),
            _ => String::new(),
        };
        Self { path: path.to_owned(), member, time_step }
    }

    /// The name under which random scenes are drawn: the file's name, for a time step with the two folders above it.
    /// It does not depend on the working directory or on where the data lie.
    pub fn seed_name(&self) -> String {
        let absolute = std::path::absolute(&self.path).unwrap_or_else(|_| self.path.clone());
        let parts: Vec<String> =
            absolute.components().map(|c| c.as_os_str().to_string_lossy().into_owned()).collect();
        let keep = if self.time_step.is_some() { 3 } else { 1 };
        parts[parts.len().saturating_sub(keep)..].join("/")
    }
}

/// How frames are drawn and rendered.
#[derive(Clone, Debug, PartialEq)]
pub struct Protocol {
    /// Frames per volume.
    pub frames: u32,
    /// Repeats per frame and pass.
    pub repeats: u32,
    /// How often all volumes are gone through.
    pub passes: u32,
    /// Frames discarded after each volume change.
    pub warm_up: u32,
    /// Seed.
    pub seed: u64,
    /// What scenes are drawn from.
    pub scenes: SceneDistribution,
    /// What each sample computes.
    pub shading: Shading,
    /// How empty space is skipped.
    pub skipping: Skipping,
    /// Where rays stop.
    pub termination: f32,
    /// Enlargement at load.
    pub enlarge: usize,
    /// Edge in voxels that volumes are resampled to instead.
    pub proxy: Option<usize>,
}

impl Protocol {
    /// What the options say.
    fn of_options(options: &Options) -> Self {
        Self {
            frames: options.frames,
            repeats: options.repeats,
            passes: options.passes,
            warm_up: options.warm_up,
            seed: options.seed,
            scenes: SceneDistribution {
                radii: options.radii.clone(),
                lobes: options.lobes,
                min_size: options.min_size,
                max_size: options.max_size,
                steps: options.steps.clone(),
            },
            shading: options.shade.into(),
            skipping: options.skip.into(),
            termination: options.termination,
            enlarge: options.enlarge,
            proxy: options.proxy,
        }
    }

    /// What the manifest of a table says that `entire collect` made, and the table's volumes.
    ///
    /// # Errors
    /// When a setting is missing or is nothing that this version knows; names it.
    pub fn of_manifest(manifest: &Manifest) -> Result<(Self, Vec<Job>)> {
        #[derive(Deserialize)]
        struct Settings {
            frames_per_volume: u32,
            warm_up_frames_discarded_per_volume: u32,
            shading: String,
            skipping: String,
            termination: f32,
            fov_y_deg: f32,
            enlarged_trilinearly_by: usize,
            scenes: SceneDistribution,
            volumes: Vec<VolumeOf>,
            #[serde(default)]
            resampled_to_edge: Option<usize>,
            #[serde(default = "one")]
            passes: u32,
        }
        #[derive(Deserialize)]
        struct VolumeOf {
            path: PathBuf,
            member: String,
            time_step: Option<u32>,
        }
        fn one() -> u32 {
            1
        }
        let s: Settings = serde_json::from_value(manifest.settings.clone())
            .context("its settings are not those of `entire collect`")?;
        let unknown =
            |what: &str, name: &str| format!("its {what} is {name:?}, which this version does not know");
        ensure!(
            s.fov_y_deg == DEFAULT_FOV_Y_DEGREES,
            "its field of view is {}°; this version draws {DEFAULT_FOV_Y_DEGREES}°",
            s.fov_y_deg
        );
        ensure!(
            s.passes > 0 && manifest.repeats.is_multiple_of(s.passes),
            "its {} repeats are not those of {} passes",
            manifest.repeats,
            s.passes
        );
        let protocol = Self {
            frames: s.frames_per_volume,
            repeats: manifest.repeats / s.passes,
            passes: s.passes,
            warm_up: s.warm_up_frames_discarded_per_volume,
            seed: manifest.seed,
            scenes: s.scenes,
            shading: parse_shading(&s.shading).with_context(|| unknown("shading", &s.shading))?,
            skipping: parse_skipping(&s.skipping).with_context(|| unknown("skipping", &s.skipping))?,
            termination: s.termination,
            enlarge: s.enlarged_trilinearly_by,
            proxy: s.resampled_to_edge,
        };
        let jobs =
            s.volumes.into_iter().map(|v| Job { path: v.path, member: v.member, time_step: v.time_step });
        Ok((protocol, jobs.collect()))
    }

    fn settings(&self, jobs: &[Job]) -> serde_json::Value {
        let mut settings = json!({
            "frames_per_volume": self.frames,
            "warm_up_frames_discarded_per_volume": self.warm_up,
            "shading": self.shading.name(),
            "skipping": self.skipping.name(),
            "termination": self.termination,
            "fov_y_deg": DEFAULT_FOV_Y_DEGREES,
            "enlarged_trilinearly_by": self.enlarge,
            "scenes": self.scenes,
            "volumes": jobs.iter().map(|j| json!({
                "path": j.path.to_string_lossy(), "member": j.member, "time_step": j.time_step,
                "seed_name": j.seed_name(),
            })).collect::<Vec<_>>(),
        });
        if let Some(edge) = self.proxy {
            settings["resampled_to_edge"] = json!(edge);
        }
        if self.passes > 1 {
            settings["passes"] = json!(self.passes);
        }
        settings
    }

    /// What [`Outcome`] counts.
    fn counted(&self) -> &'static str {
        if self.passes > 1 { "frames of all passes" } else { "frames" }
    }
}

/// What came of a collection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// Frames that are written down now; where there are several passes, those of each.
    pub done: u64,
    /// Frames that are to be.
    pub total: u64,
    /// Warm-up frames rendered and discarded in this run.
    pub discarded: u64,
    /// Whether it was stopped before the end.
    pub interrupted: bool,
}

/// Collects frames of each job in turn, skipping those that the table has. Frame `i` of job `j` has number
/// `j · frames + i`. `stop` is asked before every rendering; a frame in flight is then given up.
///
/// # Errors
/// A volume that cannot be read, a renderer that fails, a table that cannot be written; names the volume and frame.
pub fn collect(
    jobs: &[Job],
    protocol: &Protocol,
    renderer: &mut dyn Renderer,
    open: &mut dyn FnMut(&Path) -> Result<Volume>,
    table: &mut Writer,
    stop: &dyn Fn() -> bool,
    progress: &ProgressBar,
) -> Result<Outcome> {
    let total = jobs.len() as u64 * u64::from(protocol.frames);
    let before = (0..total).filter(|n| table.done().contains(n)).count() as u64;
    let mut outcome = Outcome { done: before, total, discarded: 0, interrupted: false };
    progress.set_length(total);
    progress.set_position(before);
    progress.reset_eta();
    for (j, job) in jobs.iter().enumerate() {
        let first = j as u64 * u64::from(protocol.frames);
        let missing: Vec<u64> =
            (0..u64::from(protocol.frames)).filter(|i| !table.done().contains(&(first + i))).collect();
        if missing.is_empty() {
            continue;
        }
        let shown = job.path.display();
        progress.set_message(format!("{shown}"));
        let volume = open(&job.path).with_context(|| format!("{shown}"))?;
        let volume = if let Some(edge) = protocol.proxy {
            resample(&volume, edge).with_context(|| format!("{shown}"))?
        } else if protocol.enlarge == 1 {
            volume
        } else {
            enlarge(&volume, protocol.enlarge).with_context(|| format!("{shown}"))?
        };
        renderer.set_volume(&volume.view()).with_context(|| format!("{shown}"))?;
        let seed_name = job.seed_name();
        let mut warm_up = protocol.warm_up;
        for index in missing {
            let drawn = protocol.scenes.draw(protocol.seed, &seed_name, index);
            let scene = Scene {
                volume: job.path.to_string_lossy().into_owned(),
                member: job.member.clone(),
                time_step: job.time_step,
                dims: volume.dims().map(|n| n as u32),
                camera: drawn.camera,
                fov_y_degrees: DEFAULT_FOV_Y_DEGREES,
                width: drawn.width,
                height: drawn.height,
                step: drawn.step,
                shading: protocol.shading,
                skipping: protocol.skipping,
                termination: protocol.termination,
                lobes: drawn.lobes,
            };
            let number = first + index;
            let place = || format!("{shown}, frame {number}");
            let frame = scene.to_frame().with_context(place)?;
            renderer.set_transfer(&scene.to_table().with_context(place)?).with_context(place)?;
            let mut repeats = Vec::with_capacity(protocol.repeats as usize);
            while repeats.len() < protocol.repeats as usize {
                if stop() {
                    outcome.interrupted = true;
                    return Ok(outcome);
                }
                let rendered = renderer.render(&frame).with_context(place)?;
                if warm_up > 0 {
                    warm_up -= 1;
                    outcome.discarded += 1;
                    continue;
                }
                repeats.push(Timing::new(rendered.time, rendered.counts));
            }
            table.append(number, &scene, &repeats)?;
            outcome.done += 1;
            progress.inc(1);
        }
    }
    Ok(outcome)
}

/// Where each pass over the volumes keeps its frames until all are done; none for a single pass.
fn pass_files(out: &Path, passes: u32) -> Vec<PathBuf> {
    let count = if passes > 1 { passes } else { 0 };
    (1..=count).map(|pass| out.with_extension(format!("pass{pass}.csv"))).collect()
}

/// As [`collect`], as many times over as the protocol has passes. Each pass has a table of its own beside `out`, so that
/// it can be gone on with; in the end `table` takes them together, the repeats of a frame in the order of the passes,
/// and they are removed.
///
/// # Errors
/// Those of [`collect`], and pass tables that cannot be read or removed.
#[expect(clippy::too_many_arguments, reason = "those of collect, and where the passes go")]
pub fn collect_passes(
    jobs: &[Job],
    protocol: &Protocol,
    renderer: &mut dyn Renderer,
    open: &mut dyn FnMut(&Path) -> Result<Volume>,
    table: &mut Writer,
    out: &Path,
    stop: &dyn Fn() -> bool,
    progress: &ProgressBar,
) -> Result<Outcome> {
    let total = jobs.len() as u64 * u64::from(protocol.frames);
    // Without passes, or interrupted between the last pass and the end of the table and its pass files' removal.
    let complete = (0..total).all(|n| table.done().contains(&n));
    if protocol.passes == 1 || complete {
        let outcome = collect(jobs, protocol, renderer, open, table, stop, progress)?;
        remove(&pass_files(out, protocol.passes))?;
        return Ok(outcome);
    }
    let files = pass_files(out, protocol.passes);
    let all = total * u64::from(protocol.passes);
    let mut outcome = Outcome { done: 0, total: all, discarded: 0, interrupted: false };
    for (i, file) in files.iter().enumerate() {
        progress.set_prefix(format!("collect, pass {} of {}", i + 1, files.len()));
        let mut pass = Writer::resume(file, protocol.repeats)?;
        let of_pass = collect(jobs, protocol, renderer, open, &mut pass, stop, progress)?;
        outcome.done += of_pass.done;
        outcome.discarded += of_pass.discarded;
        outcome.interrupted = of_pass.interrupted;
        // Later passes have not begun.
        if outcome.interrupted {
            return Ok(outcome);
        }
    }
    let mut frames: BTreeMap<u64, (Scene, Vec<Timing>)> = BTreeMap::new();
    for file in &files {
        for frame in Table::read(file, 0)?.frames {
            let entry = frames.entry(frame.number).or_insert_with(|| (frame.scene.clone(), Vec::new()));
            ensure!(
                entry.0 == frame.scene,
                "{}: frame {} shows something else than in the passes before; remove the files of the passes",
                file.display(),
                frame.number
            );
            entry.1.extend(frame.repeats);
        }
    }
    for (number, (scene, repeats)) in &frames {
        if !table.done().contains(number) {
            table.append(*number, scene, repeats)?;
        }
    }
    remove(&files)?;
    Ok(outcome)
}

fn remove(files: &[PathBuf]) -> Result<()> {
    for file in files.iter().filter(|f| f.exists()) {
        std::fs::remove_file(file).with_context(|| format!("cannot remove {}", file.display()))?;
    }
    Ok(())
}

/// Says what keeps a table from being gone on with, if anything.
fn differences(old: &Manifest, new: &Manifest) -> Vec<String> {
    let mut out = Vec::new();
    let mut compare = |name: &str, a: serde_json::Value, b: serde_json::Value| {
        if a != b {
            out.push(format!("{name} was {a} and is {b} now"));
        }
    };
    compare("seed", json!(old.seed), json!(new.seed));
    compare("repeats", json!(old.repeats), json!(new.repeats));
    compare("renderer", json!(old.renderer), json!(new.renderer));
    compare("device", json!(old.device), json!(new.device));
    compare("machine", json!(old.machine), json!(new.machine));
    let empty = serde_json::Map::new();
    let (a, b) = (old.settings.as_object().unwrap_or(&empty), new.settings.as_object().unwrap_or(&empty));
    let names: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    for name in names {
        let (old, new) = (a.get(name), b.get(name));
        if name == "volumes" && old != new {
            out.push("the list of volumes is another (paths, members and order count)".into());
        } else {
            let mut compare = |a: Option<&serde_json::Value>, b: Option<&serde_json::Value>| {
                // Numbers went through text: compare what is written.
                let text =
                    |v: Option<&serde_json::Value>| v.map_or("nothing".to_owned(), ToString::to_string);
                if text(a) != text(b) {
                    out.push(format!("{name} was {} and is {} now", text(a), text(b)));
                }
            };
            compare(old, new);
        }
    }
    out
}

/// The driver with its version: what a Vulkan device's description ends with. Empty for the CPU twin, which has none.
fn driver_of(renderer: &dyn Renderer) -> String {
    let device = renderer.device();
    match device.rsplit_once(", ") {
        Some((_, driver)) if renderer.backend() == "vulkan" => driver.to_owned(),
        _ => String::new(),
    }
}

fn jobs(options: &Options) -> Result<Vec<Job>> {
    let mut jobs: Vec<Job> = options.volumes.iter().map(|p| Job::from_path(p)).collect();
    match options.member.len() {
        0 => {}
        1 => jobs.iter_mut().for_each(|j| j.member.clone_from(&options.member[0])),
        n if n == jobs.len() => {
            for (job, member) in jobs.iter_mut().zip(&options.member) {
                job.member.clone_from(member);
            }
        }
        n => bail!("--member names {n} members for {} volumes; give one for all or one for each", jobs.len()),
    }
    check(&jobs, "give volume files")?;
    Ok(jobs)
}

/// That every volume is there, once.
fn check(jobs: &[Job], remedy: &str) -> Result<()> {
    for job in jobs {
        ensure!(job.path.is_file(), "{}: no such file; {remedy}", job.path.display());
    }
    let mut paths: Vec<&PathBuf> = jobs.iter().map(|j| &j.path).collect();
    paths.sort();
    if let Some(twice) = paths.windows(2).find(|w| w[0] == w[1]) {
        bail!("{} is given twice; give every volume once", twice[0].display());
    }
    Ok(())
}

/// Runs the command.
///
/// # Errors
/// Bad options or files, a device that fails, and interruption; the message says how to go on.
pub fn run(options: &Options) -> Result<()> {
    let (protocol, jobs) = match &options.like {
        Some(table) => {
            let shown = table.display();
            let manifest = Manifest::read(table)?.with_context(|| {
                format!("{shown} has no manifest {}", Manifest::path_for(table).display())
            })?;
            let (protocol, jobs) = Protocol::of_manifest(&manifest)
                .with_context(|| format!("{} cannot be followed", Manifest::path_for(table).display()))?;
            check(&jobs, "run from the folder that its volume names start from")?;
            (protocol, jobs)
        }
        None => (Protocol::of_options(options), jobs(options)?),
    };
    ensure!(
        protocol.frames > 0 && protocol.repeats > 0 && protocol.passes > 0,
        "--frames, --repeats and --passes must be at least 1"
    );
    let repeats = protocol.repeats.checked_mul(protocol.passes).with_context(|| {
        format!("{} repeats in {} passes are too many", protocol.repeats, protocol.passes)
    })?;
    ensure!(
        protocol.termination > 0.0 && protocol.termination <= 1.0,
        "--termination is {}; it must lie in (0, 1], 1 for never",
        protocol.termination
    );
    protocol.scenes.check()?;
    let stop = interrupt::flag()?;
    let mut renderer: Box<dyn Renderer> = match &options.teacher {
        Some(path) => {
            let (_, model) = crate::files::read_model_file(path)?;
            let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            Box::new(Teacher::new(&name, &model).with_context(|| format!("{}", path.display()))?)
        }
        None => device::open(options.device)?,
    };

    let mut manifest = Manifest {
        format: MANIFEST_FORMAT.into(),
        created: machine::now(),
        machine: machine::machine(),
        renderer: renderer.backend().into(),
        device: renderer.device(),
        driver: driver_of(renderer.as_ref()),
        commit: machine::version(),
        seed: protocol.seed,
        repeats,
        step_reference: "smallest voxel spacing".into(),
        settings: protocol.settings(&jobs),
        other: BTreeMap::new(),
    };
    let mut runs = Vec::new();
    let mut table = if options.resume {
        if let Some(old) = Manifest::read(&options.out)? {
            let differences = differences(&old, &manifest);
            ensure!(
                differences.is_empty(),
                "cannot go on with {}: {}; use the same settings and machine, or another --out",
                options.out.display(),
                differences.join("; ")
            );
            runs = old.other.get("runs").and_then(|r| r.as_array().cloned()).unwrap_or_default();
            if old.commit != manifest.commit {
                eprintln!("note: the table was begun by version {}, this is {}", old.commit, manifest.commit);
            }
            manifest.created = old.created;
            manifest.commit = old.commit;
        } else {
            ensure!(
                !options.out.exists(),
                "cannot go on with {}: its manifest {} is missing",
                options.out.display(),
                Manifest::path_for(&options.out).display()
            );
        }
        Writer::resume(&options.out, manifest.repeats)?
    } else {
        for path in pass_files(&options.out, protocol.passes) {
            ensure!(
                !path.exists(),
                "{} is left of an interrupted collection; go on with --resume, or remove it",
                path.display()
            );
        }
        Writer::create(&options.out)?
    };
    let started = json!({ "started": machine::now(), "load_average_at_start": machine::load_average(),
        "commit": machine::version() });
    let note = |outcome: Option<Outcome>| {
        let mut run = started.clone();
        if let Some(o) = outcome {
            run["ended"] = json!(machine::now());
            run["load_average_at_end"] = json!(machine::load_average());
            run["warm_up_frames_discarded"] = json!(o.discarded);
            run["interrupted"] = json!(o.interrupted);
        }
        let mut all = runs.clone();
        all.push(run);
        json!(all)
    };
    manifest.other.insert("runs".into(), note(None));
    manifest.write(&options.out)?;

    let bar = progress_bar("collect");
    let result = collect_passes(
        &jobs,
        &protocol,
        renderer.as_mut(),
        &mut |path| Volume::open(path),
        &mut table,
        &options.out,
        &|| interrupt::requested(&stop),
        &bar,
    );
    bar.finish_and_clear();
    let go_on = format!("go on with the same command and --resume ({})", options.out.display());
    let outcome = result.with_context(|| format!("finished frames are kept; {go_on}"))?;
    manifest.other.insert("runs".into(), note(Some(outcome)));
    manifest.write(&options.out)?;
    if outcome.interrupted {
        bail!("interrupted after {} of {} {}; {go_on}", outcome.done, outcome.total, protocol.counted());
    }
    println!(
        "{} frames of {} volume{} x {} repeats in {}; {} warm-up frames were rendered and discarded",
        table.done().len(),
        jobs.len(),
        if jobs.len() == 1 { "" } else { "s" },
        manifest.repeats,
        options.out.display(),
        outcome.discarded
    );
    let frames = Table::read(&options.out, 0)?.frames;
    for clock in [Clock::Auto, Clock::Cpu] {
        if let Some(floor) = noise_floor(&frames, clock) {
            println!(
                "repeats of a frame scatter by {:.1} % (standard deviation of ln seconds, clock: {})",
                100.0 * floor.log_sd,
                clock.name()
            );
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::COLUMNS;
    use crate::scripted::ScriptedRenderer;
    use crate::volume::VolumeData;
    use std::cell::Cell;

    fn protocol() -> Protocol {
        Protocol {
            frames: 4,
            repeats: 3,
            passes: 1,
            warm_up: 2,
            seed: 11,
            scenes: SceneDistribution { max_size: 64, ..Default::default() },
            shading: Shading::None,
            skipping: Skipping::Blocks,
            termination: 0.99,
            enlarge: 1,
            proxy: None,
        }
    }

    fn some_jobs() -> Vec<Job> {
        ["run/m01/t0003.nrrd", "head.nrrd"].map(|p| Job::from_path(Path::new(p))).to_vec()
    }

    fn tiny(_: &Path) -> Result<Volume> {
        Volume::new(VolumeData::U8(vec![9; 27]), [3, 3, 3], [1.0; 3], "tiny")
    }

    /// Rows without their clock columns.
    fn without_times(path: &Path) -> Vec<String> {
        let at = COLUMNS.iter().position(|c| *c == "seconds_device").unwrap();
        let text = std::fs::read_to_string(path).unwrap();
        text.lines()
            .map(|l| {
                l.split(',')
                    .enumerate()
                    .filter(|(i, _)| !(at..at + 3).contains(i))
                    .map(|(_, f)| f)
                    .collect::<Vec<_>>()
                    .join(",")
            })
            .collect()
    }

    fn run_until(path: &Path, renders: Option<u32>, jobs: &[Job]) -> Outcome {
        let mut table = Writer::resume(path, 3).unwrap();
        let mut renderer = ScriptedRenderer::default();
        let asked = Cell::new(0);
        let stop = || {
            asked.set(asked.get() + 1);
            renders.is_some_and(|n| asked.get() > n)
        };
        let bar = ProgressBar::hidden();
        collect(jobs, &protocol(), &mut renderer, &mut tiny, &mut table, &stop, &bar).unwrap()
    }

    #[test]
    fn stopping_anywhere_and_resuming_gives_the_same_table() {
        let dir = tempfile::tempdir().unwrap();
        let whole = dir.path().join("whole.csv");
        let outcome = run_until(&whole, None, &some_jobs());
        assert_eq!(outcome, Outcome { done: 8, total: 8, discarded: 4, interrupted: false });
        let expected = without_times(&whole);
        assert_eq!(expected.len(), 1 + 8 * 3);
        for stop_after in 0..28 {
            let path = dir.path().join(format!("{stop_after}.csv"));
            let first = run_until(&path, Some(stop_after), &some_jobs());
            assert!(first.interrupted, "{stop_after}");
            // Four renderings of each volume's first frame are two warm-ups and a partial frame: none is in the table.
            assert_eq!(Table::read(&path, 0).map(|t| t.frames.len() as u64).unwrap(), first.done);
            let second = run_until(&path, None, &some_jobs());
            assert!(!second.interrupted && second.done == 8);
            assert_eq!(without_times(&path), expected, "{stop_after}");
        }
    }

    #[test]
    fn passes_make_one_table_whose_repeats_are_far_apart_and_can_be_stopped_anywhere() {
        let dir = tempfile::tempdir().unwrap();
        let protocol = Protocol { passes: 2, repeats: 2, ..protocol() };
        let noisy = || {
            let mut renderer = ScriptedRenderer::default();
            renderer.noise = 0.1;
            renderer
        };
        let run = |out: &Path, renders: u32| {
            let mut table = Writer::resume(out, 4).unwrap();
            let asked = Cell::new(0);
            let stop = || {
                asked.set(asked.get() + 1);
                asked.get() > renders
            };
            let bar = ProgressBar::hidden();
            let (jobs, mut renderer) = (some_jobs(), noisy());
            collect_passes(&jobs, &protocol, &mut renderer, &mut tiny, &mut table, out, &stop, &bar).unwrap()
        };
        let whole = dir.path().join("whole.csv");
        assert_eq!(run(&whole, 1000), Outcome { done: 16, total: 16, discarded: 8, interrupted: false });
        let expected = without_times(&whole);
        assert_eq!(expected.len(), 1 + 8 * 4);
        assert!(expected[4].starts_with("0,3,") && expected[5].starts_with("1,0,"), "{}", expected[4]);
        // The first pass's repeats come first: those of a single pass with the same renderer.
        let single = dir.path().join("single.csv");
        let once = Protocol { passes: 1, ..protocol.clone() };
        let (mut table, mut renderer) = (Writer::create(&single).unwrap(), noisy());
        let bar = ProgressBar::hidden();
        collect(&some_jobs(), &once, &mut renderer, &mut tiny, &mut table, &|| false, &bar).unwrap();
        let seconds = |path: &Path| -> Vec<Vec<f64>> {
            let frames = Table::read(path, 0).unwrap().frames;
            frames.iter().map(|f| f.repeats.iter().filter_map(|r| r.seconds(Clock::Wall)).collect()).collect()
        };
        for (all, first) in seconds(&whole).iter().zip(seconds(&single)) {
            assert_eq!((all.len(), &all[..2]), (4, first.as_slice()));
            assert!(all[2] != all[0] && all[3] != all[1], "{all:?}");
        }
        std::fs::remove_file(single).unwrap();
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "pass files are left");
        for stop_after in [0, 3, 19, 20, 21, 39] {
            let out = dir.path().join(format!("{stop_after}.csv"));
            let stopped = run(&out, stop_after);
            assert!(stopped.interrupted && stopped.total == 16, "{stop_after}");
            assert_eq!(Table::read(&out, 0).map(|t| t.frames.len()).unwrap(), 0);
            assert!(!run(&out, 1000).interrupted);
            assert_eq!(without_times(&out), expected, "{stop_after}");
        }
    }

    #[test]
    fn order_of_volumes_changes_numbers_but_no_scene() {
        let dir = tempfile::tempdir().unwrap();
        let (a, b) = (dir.path().join("a.csv"), dir.path().join("b.csv"));
        run_until(&a, None, &some_jobs());
        run_until(&b, None, &some_jobs().into_iter().rev().collect::<Vec<_>>());
        let sorted = |p: &Path| {
            let mut rows: Vec<String> =
                without_times(p).into_iter().map(|l| l.split_once(',').unwrap().1.to_owned()).collect();
            rows.sort();
            rows
        };
        assert_eq!(sorted(&a), sorted(&b));
    }

    #[test]
    fn members_and_time_steps_come_from_the_path_and_seeds_do_not_depend_on_the_folder() {
        let job = Job::from_path(Path::new("x/castro_blast/m01/t0012.nrrd"));
        assert_eq!((job.member.as_str(), job.time_step), ("m01", Some(12)));
        assert_eq!(job.seed_name(), "castro_blast/m01/t0012.nrrd");
        let elsewhere = Job::from_path(Path::new("/somewhere/else/castro_blast/m01/t0012.nrrd"));
        assert_eq!(job.seed_name(), elsewhere.seed_name());
        let scan = Job::from_path(Path::new("scans/tooth.nii.gz"));
        assert_eq!(
            (scan.member.as_str(), scan.time_step, scan.seed_name().as_str()),
            ("", None, "tooth.nii.gz")
        );
        assert_eq!(Job::from_path(Path::new("t.nrrd")).time_step, None);
    }

    #[test]
    fn a_table_is_gone_on_with_under_the_same_settings_alone() {
        let manifest = |p: &Protocol, jobs: &[Job], device: &str| Manifest {
            format: MANIFEST_FORMAT.into(),
            created: "then".into(),
            machine: "m".into(),
            renderer: "cpu".into(),
            device: device.into(),
            driver: String::new(),
            commit: "1".into(),
            seed: p.seed,
            repeats: p.repeats,
            step_reference: String::new(),
            settings: p.settings(jobs),
            other: BTreeMap::new(),
        };
        let base = manifest(&protocol(), &some_jobs(), "d");
        // Through a file and back, numbers and all.
        let back: Manifest = serde_json::from_str(&serde_json::to_string(&base).unwrap()).unwrap();
        assert_eq!(differences(&back, &base), Vec::<String>::new());
        // And from the manifest to the same frames.
        let twice =
            Protocol { passes: 2, repeats: 4, proxy: Some(64), shading: Shading::Scatter, ..protocol() };
        for p in [protocol(), twice] {
            let mut written = manifest(&p, &some_jobs(), "d");
            written.repeats = p.repeats * p.passes;
            assert_eq!(Protocol::of_manifest(&written).unwrap(), (p, some_jobs()));
        }
        let mut other = back.clone();
        other.settings["shading"] = json!("path tracing");
        let error = Protocol::of_manifest(&other).unwrap_err().to_string();
        assert_eq!(error, "its shading is \"path tracing\", which this version does not know");
        let changed = |f: &dyn Fn(&mut Protocol)| {
            let mut p = protocol();
            f(&mut p);
            differences(&back, &manifest(&p, &some_jobs(), "d")).join("; ")
        };
        assert_eq!(changed(&|p| p.seed = 12), "seed was 11 and is 12 now");
        assert_eq!(changed(&|p| p.repeats = 4), "repeats was 3 and is 4 now");
        assert!(changed(&|p| p.frames = 5).starts_with("frames_per_volume was 4"));
        assert!(changed(&|p| p.shading = Shading::Local).contains("shading"));
        assert!(changed(&|p| p.scenes.steps = vec![0.1]).contains("scenes"));
        assert!(changed(&|p| p.enlarge = 2).contains("enlarged"));
        assert!(differences(&back, &manifest(&protocol(), &some_jobs(), "e"))[0].starts_with("device"));
        assert!(differences(&back, &manifest(&protocol(), &some_jobs()[..1], "d"))[0].contains("volumes"));
    }

    #[test]
    fn lobe_numbers_are_one_or_two_numbers() {
        assert_eq!(parse_lobe_range("3"), Ok((3, 3)));
        assert_eq!(parse_lobe_range("2-4"), Ok((2, 4)));
        assert!(
            parse_lobe_range("two").is_err()
                && parse_lobe_range("2-").is_err()
                && parse_lobe_range("").is_err()
        );
    }

    #[test]
    fn a_failing_volume_names_itself() {
        let dir = tempfile::tempdir().unwrap();
        let mut table = Writer::create(&dir.path().join("t.csv")).unwrap();
        let error = collect(
            &some_jobs(),
            &protocol(),
            &mut ScriptedRenderer::default(),
            &mut |_| bail!("broken header"),
            &mut table,
            &|| false,
            &ProgressBar::hidden(),
        )
        .unwrap_err();
        assert!(format!("{error:#}").contains("t0003.nrrd: broken header"), "{error:#}");
    }
}
