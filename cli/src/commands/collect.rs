//! `entire collect`: render many random frames of volumes and write their times to a table.

use crate::collection::{
    Job, Outcome, Protocol, collect_passes, differences, ensure_utf8, pass_files, remove,
};
use anyhow::{Context, Result, bail, ensure};
use entire_io::clock::concrete;
use entire_io::dataset::{Clock, Manifest, Table, Writer, noise_floor};
use entire_io::files::{ensure_distinct, fnv1a_text, make_folder_of, note, parse_model, read_model_bytes};
use entire_io::identity::{self, Identity};
use entire_io::options::{RenderArgs, check_termination, open_renderer};
use entire_io::progress::progress_bar;
use entire_io::scenes::SceneDistribution;
use entire_io::volume::{Reading, open_watched_volume};
use entire_io::{interrupt, machine};
use entire_train::split::Split;
use entire_train::teacher::Teacher;
use entire_vk_raycaster::Renderer;
use serde_json::json;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Render many random frames of volumes and write their render times to a table.
///
/// Cameras lie on hemispheres of several radii, transfer functions are sums of random Gaussian lobes, image
/// sides are log-uniformly distributed, and half of the images are square. Each frame is rendered several
/// times, and each repeat is a row of the table. A manifest beside the table states machine, renderer and
/// settings. The frames of a volume depend only on the settings, the seed and the volume's name. Ctrl-C ends
/// the collection and keeps every finished frame; --resume continues the collection.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire collect data/*.nrrd --out frames.csv
  entire collect castro_blast/m0?/t00*.nrrd --out castro.csv --shade local
  entire collect skull.nii.gz --out skull.csv --steps 0.5,1,2,4 --resume
  entire collect --like data/timings/none-train.csv.gz --out again.csv")]
pub(crate) struct Options {
    /// Volume files. A file named like `t0012.nrrd` is a time step; its folder is an ensemble member.
    #[arg(required_unless_present = "like", value_name = "VOLUME")]
    pub(crate) volumes: Vec<PathBuf>,
    /// The table to write. Its manifest, NAME.manifest.json, is written beside it.
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) out: PathBuf,
    /// Collect the frames of this table again: volumes, frames and settings come from its manifest, and
    /// --repeats, --passes and --warm-up-repeats override it. The volume names in the manifest are relative
    /// to the working folder.
    #[arg(long, value_name = "TABLE", conflicts_with_all = [
        "volumes", "frames", "warm_up", "seed", "shade", "skip", "termination",
        "min_size", "max_size", "steps", "enlarge", "proxy", "array", "fill", "range",
    ])]
    pub(crate) like: Option<PathBuf>,
    /// Frames per volume.
    #[arg(long, default_value_t = 100, value_name = "N")]
    pub(crate) frames: u32,
    /// Timed renderings of each frame in each pass [default: 5].
    #[arg(long, value_name = "R")]
    pub(crate) repeats: Option<u32>,
    /// Number of passes over all volumes; each pass renders every frame --repeats times. Repeats that are
    /// minutes apart show changes of the machine's speed [default: 1].
    #[arg(long, value_name = "P")]
    pub(crate) passes: Option<u32>,
    /// Untimed renderings of each frame before the timed ones: the first rendering with a new image size and
    /// transfer function is slower than later ones [default: 1].
    #[arg(long, value_name = "N")]
    pub(crate) warm_up_repeats: Option<u32>,
    /// Untimed renderings after each volume is loaded; they include the one-time work for a new volume.
    #[arg(long, default_value_t = 2, value_name = "N")]
    pub(crate) warm_up: u32,
    /// Seed of every random choice.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Rendering options.
    #[command(flatten)]
    pub(crate) render: RenderArgs,
    /// Options for reading the volumes.
    #[command(flatten)]
    pub(crate) reading: Reading,
    /// Write the times that this model predicts, instead of rendering the frames; another model can then be
    /// distilled from it. A predicted time is written as wall time and as time by the model's clock, or as
    /// time by every clock if the model states none.
    #[arg(long, value_name = "SAFETENSORS", conflicts_with_all = ["device", "proxy"])]
    pub(crate) teacher: Option<PathBuf>,
    /// Shortest image side, pixels.
    #[arg(long, default_value_t = 32, value_name = "PIXELS")]
    pub(crate) min_size: u32,
    /// Longest image side, pixels.
    #[arg(long, default_value_t = 1024, value_name = "PIXELS")]
    pub(crate) max_size: u32,
    /// Ray steps, in reference steps; each frame gets one of them at random.
    #[arg(long, value_delimiter = ',', default_values_t = [1.0], value_name = "STEP,…")]
    pub(crate) steps: Vec<f32>,
    /// Enlarge every volume trilinearly by this factor along each axis, so that frames of small volumes take
    /// as long as frames of large ones.
    #[arg(long, default_value_t = 1, value_name = "FACTOR")]
    pub(crate) enlarge: usize,
    /// Resample every volume to EDGE voxels per side, a low-resolution proxy. Render the proxy with the
    /// cameras, transfer functions, image sizes and steps of the original volume's frames.
    #[arg(long, value_name = "EDGE", conflicts_with = "enlarge")]
    pub(crate) proxy: Option<usize>,
    /// Continue an interrupted table. Settings, machine and volume files must be those that its manifest
    /// states.
    #[arg(long)]
    pub(crate) resume: bool,
}

fn protocol(options: &Options) -> Protocol {
    Protocol {
        frames: options.frames,
        repeats: options.repeats.unwrap_or(5),
        passes: options.passes.unwrap_or(1),
        warm_up: options.warm_up,
        warm_up_repeats: options.warm_up_repeats.unwrap_or(1),
        seed: options.seed,
        scenes: SceneDistribution {
            min_size: options.min_size,
            max_size: options.max_size,
            steps: options.steps.clone(),
            ..SceneDistribution::default()
        },
        shading: options.render.shade,
        skipping: options.render.skip,
        termination: options.render.termination,
        enlarge: options.enlarge,
        proxy: options.proxy,
        reading: options.reading.clone(),
    }
}

/// Checks that every volume exists, is given once and has a path that tables can hold.
fn check(jobs: &[Job], remedy: &str) -> Result<()> {
    for job in jobs {
        ensure_utf8(&job.path)?;
        let shown = job.path.display();
        ensure!(!job.path.is_dir(), "{shown}: is a folder; name volume files in it");
        ensure!(job.path.is_file(), "{shown}: no such file; {remedy}");
    }
    ensure_distinct(&jobs.iter().map(|j| j.path.clone()).collect::<Vec<_>>())
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let (protocol, jobs) = match &options.like {
        Some(table) => {
            let shown = table.display();
            let manifest = Manifest::read(table)?.with_context(|| {
                format!("{shown} has no manifest {}", Manifest::path_for(table).display())
            })?;
            let (mut protocol, jobs) = Protocol::of_manifest(&manifest).with_context(|| {
                let file = Manifest::path_for(table);
                format!(
                    "the frames of {shown} cannot be collected again from its manifest {}",
                    file.display()
                )
            })?;
            protocol.repeats = options.repeats.unwrap_or(protocol.repeats);
            protocol.passes = options.passes.unwrap_or(protocol.passes);
            protocol.warm_up_repeats = options.warm_up_repeats.unwrap_or(protocol.warm_up_repeats);
            check(&jobs, "run from the folder to which the manifest's volume names are relative")?;
            for job in &jobs {
                if let Some(what) = manifest.changed(&job.name(), &job.path)? {
                    note(&format!(
                        "{} is not the file that {shown} was collected from: {what}",
                        job.path.display()
                    ));
                }
            }
            (protocol, jobs)
        }
        None => {
            let jobs: Vec<Job> = options.volumes.iter().map(|p| Job::from_path(p)).collect();
            check(&jobs, "give volume files")?;
            (protocol(options), jobs)
        }
    };
    ensure!(
        protocol.frames > 0 && protocol.repeats > 0 && protocol.passes > 0,
        "--frames, --repeats and --passes must be at least 1"
    );
    check_termination(protocol.termination)?;
    protocol.scenes.check()?;
    let stop = interrupt::flag()?;
    let mut teacher = None;
    let mut renderer: Box<dyn Renderer> = match &options.teacher {
        Some(path) => {
            let bytes = read_model_bytes(path)?;
            let model = parse_model(path, &bytes)?;
            let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            let splits = Split::all_of(&model);
            teacher = Some(json!({ "file": name, "fnv1a": fnv1a_text(&bytes), "splits": splits }));
            Box::new(Teacher::new(&name, &model).with_context(|| format!("{}", path.display()))?)
        }
        None => open_renderer(options.render.device)?,
    };

    let mut manifest = protocol.manifest(&jobs, renderer.as_ref())?;
    // A teacher's device states only the name of the model file, and files of several models may have the
    // same name.
    if let Some(teacher) = teacher {
        manifest.settings["teacher"] = teacher;
    }
    for job in &jobs {
        manifest.files.insert(job.name(), identity::of_volume(&job.path)?);
    }
    make_folder_of(&options.out)?;
    let mut runs = Vec::new();
    let mut table = if options.resume {
        if let Some(old) = Manifest::read(&options.out)? {
            let differences = differences(&old, &manifest);
            ensure!(
                differences.is_empty(),
                "cannot continue {}: {}; use the same settings, files and machine, or another --out",
                options.out.display(),
                differences.join("; ")
            );
            if old.files.is_empty() {
                note(&format!(
                    "{} has no checksums of the volume files, so the files are assumed to be unchanged",
                    Manifest::path_for(&options.out).display()
                ));
            }
            runs = old.other.get("runs").and_then(|r| r.as_array().cloned()).unwrap_or_default();
            if old.commit != manifest.commit {
                note(&format!(
                    "the table was begun by version {}; this program is version {}",
                    old.commit, manifest.commit
                ));
            }
            manifest.created = old.created;
            manifest.commit = old.commit;
            // Keys that this version does not know are kept. The noise is measured anew.
            manifest.other = old.other;
            manifest.other.remove("noise");
        } else {
            // A collection that was killed before its manifest was written has no frames, so it may begin
            // anew.
            ensure!(
                Writer::is_fresh(&options.out)?,
                "cannot continue {}: its manifest {} is missing",
                options.out.display(),
                Manifest::path_for(&options.out).display()
            );
        }
        Writer::resume(&options.out, manifest.repeats)?
    } else {
        for path in pass_files(&options.out, protocol.passes) {
            ensure!(
                !path.exists(),
                "{} is left over from an interrupted collection; continue with --resume, or remove it",
                path.display()
            );
        }
        Writer::create(&options.out)?
    };
    let started = json!({ "started": machine::now(), "load_average_at_start": machine::load_average(),
        "commit": machine::version() });
    let with_run = |outcome: Option<Outcome>| {
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
    manifest.other.insert("runs".into(), with_run(None));
    manifest.write(&options.out)?;
    let files: HashMap<PathBuf, Vec<Identity>> =
        jobs.iter().filter_map(|j| Some((j.path.clone(), manifest.files.get(&j.name())?.clone()))).collect();
    let mut open = |path: &Path| {
        let volume = open_watched_volume(path, &protocol.reading, Some(stop.clone()))?;
        if let Some(then) = files.get(path)
            && let Some(what) = identity::difference(then, &identity::of_volume(path)?)
        {
            bail!("the file changed while frames were collected: {what}; restore it, or begin another table");
        }
        Ok(volume)
    };

    let bar = progress_bar("collect");
    let (renderer, out) = (renderer.as_mut(), &options.out);
    let stop = || interrupt::requested(&stop);
    let result = collect_passes(&jobs, &protocol, renderer, &mut open, &mut table, out, &stop, &bar);
    bar.finish_and_clear();
    let done = table.done().len();
    // Some systems let no other handle read a locked file, so the table is unlocked before it is read.
    drop(table);
    let go_on = format!("to continue {}, repeat the same command with --resume", options.out.display());
    let mut tables = pass_files(&options.out, protocol.passes);
    tables.push(options.out.clone());
    let outcome = match result {
        Err(error)
            if tables.iter().try_fold(true, |all, file| anyhow::Ok(all && Writer::is_fresh(file)?))? =>
        {
            // If no table has frames, all tables are removed, so that a corrected command can start.
            tables.push(Manifest::path_for(&options.out));
            remove(&tables)?;
            return Err(error);
        }
        result => result.with_context(|| format!("finished frames are kept; {go_on}"))?,
    };
    manifest.other.insert("runs".into(), with_run(Some(outcome)));
    if outcome.interrupted {
        manifest.write(&options.out)?;
        let counted = if protocol.passes > 1 { "frames of all passes" } else { "frames" };
        bail!("interrupted after {} of {} {counted}; {go_on}", outcome.done, outcome.total);
    }
    // A resumed table may have a feature table from an earlier run, which may lack new frames. So this call
    // does not read the feature table.
    let frames = Table::read_without_features(&options.out, 0)?.frames;
    let mut noise = serde_json::Map::new();
    let mut said = Vec::new();
    for clock in concrete(None, &frames).into_iter().chain([Clock::Cpu]) {
        if let Some(floor) = noise_floor(&frames, clock, |_| protocol.passes as usize) {
            said.push(format!("{} time: {}", clock.name(), floor.describe()));
            noise.insert(clock.name().into(), json!(floor));
        }
    }
    if !noise.is_empty() {
        manifest.other.insert("noise".into(), noise.into());
    }
    manifest.write(&options.out)?;
    println!(
        "{done} frames of {} volume{} x {} repeats in {}; {} warm-up renderings were discarded",
        jobs.len(),
        if jobs.len() == 1 { "" } else { "s" },
        manifest.repeats,
        options.out.display(),
        outcome.discarded
    );
    said.iter().for_each(|line| println!("{line}"));
    Ok(())
}
