//! The job file: contents of an image database, and its renderer.

use super::command;
pub use super::job_file::{CamerasEntry, JobFile, Predict, Renderer, Retry, TransferEntry, VolumesEntry};
pub(crate) use super::job_file::{Draw, draw_settings, frame};
use super::natural;
use anyhow::{Context, Result, bail, ensure};
use entire_core::scene::{Arcball, Camera, Frame};
use entire_io::files::{fnv1a, read_text};
use entire_io::identity::{self, Identity};
use entire_io::options::parse_size;
use entire_io::path::Transfer;
use entire_io::volume::Reading;
use entire_report::Table;
use entire_steer::features::MAX_PROBE_SIDE;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::{Path, PathBuf};

const MAX_JOB_BYTES: u64 = 16 << 20;

const MAX_TASKS: usize = 20_000_000;

/// A volume file of a job.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeFile {
    /// The volume's name.
    pub name: String,
    /// Time step.
    pub time: u32,
    /// Absolute path.
    pub path: PathBuf,
    /// Size of the file and of its data files, bytes.
    pub bytes: u64,
    /// Options of reading the file.
    pub reading: Reading,
    /// Identities of the volume file and of the data files that its header names.
    pub files: Vec<Identity>,
}

/// A transfer function with its name.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedTransfer {
    /// Its name.
    pub name: String,
    /// The transfer function.
    pub transfer: Transfer,
}

/// Indices of a task along each of a job's dimensions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    /// Volume file.
    pub volume: usize,
    /// Camera.
    pub camera: usize,
    /// Transfer function.
    pub transfer: usize,
    /// Image size.
    pub size: usize,
    /// Step.
    pub step: usize,
}

/// A checked job. Its tasks are all combinations of volume files, cameras, transfer functions, sizes and
/// steps, numbered from 0. A task's id is a hash of all inputs of its picture: it stays the same when the job
/// grows, and changes when an input file changes.
#[derive(Clone, Debug)]
pub struct Job {
    /// The database's name.
    pub name: String,
    /// The database: a folder whose name ends in `.cdb`.
    pub output: PathBuf,
    /// Vertical field of view, degrees.
    pub fov_y_deg: f32,
    /// Volume files.
    pub volumes: Vec<VolumeFile>,
    /// Cameras.
    pub cameras: Vec<Arcball>,
    /// Transfer functions.
    pub transfers: Vec<NamedTransfer>,
    /// Image sizes.
    pub sizes: Vec<[u32; 2]>,
    /// Ray steps, in reference steps.
    pub steps: Vec<f32>,
    /// The renderer.
    pub renderer: Renderer,
    /// Source of expected times.
    pub predict: Predict,
    /// Retries of failed tasks.
    pub retry: Retry,
    folder: PathBuf,
    hashes: [Vec<u64>; 5],
    salt: u64,
}

impl Job {
    /// Reads and checks a job file.
    ///
    /// # Errors
    /// When the file cannot be read or an entry is invalid. The message names the file, the entry, its value
    /// and the accepted values.
    pub fn open(path: &Path) -> Result<Self> {
        let text = read_text(path, MAX_JOB_BYTES)
            .with_context(|| format!("cannot read the job file {}", path.display()))?;
        let file = JobFile::parse(&text).map_err(|e| anyhow::anyhow!("{}, {e}", path.display()))?;
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let folder = std::fs::canonicalize(folder)
            .with_context(|| format!("cannot find the folder {}", folder.display()))?;
        Self::new(file, &folder).with_context(|| format!("{}", path.display()))
    }

    /// Checks the contents of a job file, and finds its volume files. Relative paths start at `folder`.
    ///
    /// # Errors
    /// When an entry is invalid or a file cannot be read. The message names the entry, its value and the
    /// accepted values.
    pub fn new(file: JobFile, folder: &Path) -> Result<Self> {
        check_name("name", &file.name)?;
        let output = folder.join(file.output.unwrap_or_else(|| format!("{}.cdb", file.name).into()));
        ensure!(
            output.extension().is_some_and(|e| e == "cdb"),
            "output is {}; a Cinema database is a folder whose name ends in .cdb",
            output.display()
        );
        let fov = file.fov_y_deg;
        let camera = Camera::from_arcball(Arcball { rx: 0.0, ry: 0.0, dz: 2.0 })?
            .with_fov_y_degrees(fov)
            .context("fov_y_deg")?;
        let size = |text: &String| parse_size(text).map_err(|e| anyhow::anyhow!("sizes: {e}"));
        let sizes =
            file.sizes.iter().map(|text| Ok(size(text)?.into())).collect::<Result<Vec<[u32; 2]>>>()?;
        for step in &file.steps {
            ensure!(
                step.is_finite() && *step > 0.0,
                "steps: {step} was found; a step is a positive number of reference steps"
            );
        }
        let volumes = volumes(&file.volumes, folder)?;
        let cameras = cameras(&file.cameras)?;
        let transfers = transfers(&file.transfer)?;
        let renderer = renderer(file.renderer, folder)?;
        if matches!(renderer, Renderer::Entire { .. }) {
            for &step in &file.steps {
                Frame { step, ..Frame::new(camera, 1, 1)? }.checked().context("steps")?;
            }
        }
        ensure!(
            file.retry.attempts > 0 && file.retry.losses > 0,
            "retry: attempts and losses are {} and {}; each must be at least 1",
            file.retry.attempts,
            file.retry.losses
        );
        let under = |p: Option<PathBuf>| p.map(|p| folder.join(p));
        let predict =
            Predict { model: under(file.predict.model), list: under(file.predict.list), ..file.predict };
        ensure!(
            predict.model.is_none() || predict.list.is_none(),
            "predict: both model and list are given; give one of them"
        );
        ensure!(
            predict.probe_side.is_none_or(|side| (1..=MAX_PROBE_SIDE).contains(&side)),
            "predict: probe_side is {}; it must lie in 1 to {MAX_PROBE_SIDE}",
            predict.probe_side.unwrap_or(0)
        );
        let mut names = HashSet::new();
        if let Some(volume) = volumes.iter().find(|v| !names.insert((v.name.as_str(), v.time))) {
            bail!(
                "volumes: {} has the name {} of an earlier file; give it another `name`, in its own entry",
                volume.path.display(),
                volume.name
            );
        }
        // Task ids are computed from hashes of the following texts.
        let hash = |text: String| fnv1a(text.as_bytes());
        let transfer_text =
            |t: &NamedTransfer| serde_json::to_string(&t.transfer).unwrap_or_default() + &t.name;
        let hashes = [
            volume_hashes(&volumes, &renderer),
            cameras.iter().map(|c| hash(format!("{},{},{}", c.rx, c.ry, c.dz))).collect(),
            transfers.iter().map(|t| hash(transfer_text(t))).collect(),
            sizes.iter().map(|[width, height]| hash(format!("{width}x{height}"))).collect(),
            file.steps.iter().map(|step| hash(step.to_string())).collect(),
        ];
        let salt = fnv1a(format!("{} {fov}", settings(&renderer)?).as_bytes());
        let job = Self {
            name: file.name,
            output,
            fov_y_deg: fov,
            volumes,
            cameras,
            transfers,
            sizes,
            steps: file.steps,
            renderer,
            predict,
            retry: file.retry,
            folder: folder.to_owned(),
            hashes,
            salt,
        };
        let dimensions = ["volumes", "cameras", "transfer", "sizes", "steps"];
        for (what, count) in dimensions.iter().zip(job.dims()) {
            ensure!(count > 0, "{what} is empty; a job needs at least one entry");
        }
        let count = job.dims().iter().try_fold(1usize, |a, b| a.checked_mul(*b));
        ensure!(
            count.is_some_and(|n| n <= MAX_TASKS),
            "the job has more than {MAX_TASKS} tasks; split it into several"
        );
        for (what, hashes) in dimensions.iter().zip(&job.hashes) {
            let mut seen = HashSet::new();
            if let Some(i) = hashes.iter().position(|h| !seen.insert(h)) {
                bail!("{what}: entry {} repeats an earlier one; give each entry once", i + 1);
            }
        }
        Ok(job)
    }

    pub(crate) fn dims(&self) -> [usize; 5] {
        [self.volumes.len(), self.cameras.len(), self.transfers.len(), self.sizes.len(), self.steps.len()]
    }

    /// Number of tasks.
    #[allow(clippy::len_without_is_empty, reason = "a job is never empty")]
    pub fn len(&self) -> usize {
        self.dims().iter().product()
    }

    /// Indices of a task.
    pub fn place(&self, task: usize) -> Place {
        let [_, c, t, s, p] = self.dims();
        let (rest, step) = (task / p, task % p);
        let (rest, size) = (rest / s, rest % s);
        let (rest, transfer) = (rest / t, rest % t);
        Place { volume: rest / c, camera: rest % c, transfer, size, step }
    }

    /// A task's id: a 64-bit hash of the inputs of its picture and of the renderer's settings. The name of
    /// the transfer function is included. The volume's name and time step are included only if the renderer
    /// gets them. The name of the volume file is included without its folder; the names of its data files are
    /// included as in the header, perhaps with a folder.
    pub fn id(&self, task: usize) -> u64 {
        let at = self.place(task);
        self.id_with(self.hashes[0][at.volume], at)
    }

    fn id_with(&self, volume: u64, at: Place) -> u64 {
        let parts = [
            self.salt,
            volume,
            self.hashes[1][at.camera],
            self.hashes[2][at.transfer],
            self.hashes[3][at.size],
            self.hashes[4][at.step],
        ];
        let mut bytes = [0u8; 48];
        for (part, place) in parts.iter().zip(bytes.chunks_exact_mut(8)) {
            place.copy_from_slice(&part.to_le_bytes());
        }
        // FNV-1a mixes the last bytes into some bits only. The finalizer of SplitMix64 mixes all bits.
        let mut x = fnv1a(&bytes);
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }

    pub(crate) fn tasks_of(&self, volume: usize) -> std::ops::Range<usize> {
        let each = self.len() / self.volumes.len();
        volume * each..(volume + 1) * each
    }

    /// Returns a function that computes the task ids of a volume from the earlier identities of its files,
    /// `then`, which are keyed by [`Job::shown`].
    pub(crate) fn ids_then(&self, then: &BTreeMap<String, Vec<Identity>>) -> impl Fn(usize) -> Vec<u64> {
        let mut volumes = self.volumes.clone();
        for (i, volume) in volumes.iter_mut().enumerate() {
            if let Some(files) = then.get(&self.shown(i)) {
                volume.files.clone_from(files);
            }
        }
        let hashes = volume_hashes(&volumes, &self.renderer);
        move |volume| self.tasks_of(volume).map(|t| self.id_with(hashes[volume], self.place(t))).collect()
    }

    /// Path of a volume's file for messages: relative to the job file's folder if it is inside that folder.
    pub fn shown(&self, volume: usize) -> String {
        let path = &self.volumes[volume].path;
        path.strip_prefix(&self.folder).unwrap_or(path).display().to_string()
    }

    /// Returns the list of volumes in their order, one line each: number, time step, name and file.
    pub fn listing(&self) -> String {
        let mut table = Table::headed("#index | #time | volume | file");
        for (i, volume) in self.volumes.iter().enumerate() {
            let (index, time) = (i.to_string(), volume.time.to_string());
            table.row(vec![index.into(), time.into(), volume.name.as_str().into(), self.shown(i).into()]);
        }
        table.to_text()
    }

    /// Path of a task's image, relative to the database.
    pub fn image(&self, id: u64) -> String {
        let text = format!("{id:016x}");
        format!("image/{}/{text}.png", &text[..2])
    }

    /// The folder of journal, lock, orders and logs.
    pub fn state(&self) -> PathBuf {
        self.output.join(".farm")
    }

    /// Task numbers by id, for [`Predict::list`] and journals.
    pub fn numbers(&self) -> HashMap<u64, u32> {
        (0..self.len()).map(|i| (self.id(i), i as u32)).collect()
    }
}

/// Returns a hash of each volume, for the ids of its tasks. Volumes with equal inputs have equal pictures;
/// the hash includes a counter of equal volumes, so that their tasks have different ids.
fn volume_hashes(volumes: &[VolumeFile], renderer: &Renderer) -> Vec<u64> {
    let mut same: HashMap<String, usize> = HashMap::new();
    // True if the renderer gets the name or the time step of a volume, besides the path of its file.
    let [gets_name, gets_time] = ["volume_name", "time"].map(|name| match renderer {
        Renderer::Entire { .. } => false,
        Renderer::Command { command, .. } => command.iter().any(|a| command::has(a, name)),
        Renderer::Session { .. } | Renderer::Pvbatch { .. } => true,
    });
    let text = |v: &VolumeFile| {
        let name = if gets_name { v.name.as_str() } else { "" };
        let time = if gets_time { v.time.to_string() } else { String::new() };
        format!("{}\n{}\n{name}\n{time}", identity::key(&v.files), v.reading.key())
    };
    let number = |text: String| {
        let count = same.entry(text.clone()).or_insert(0);
        *count += 1;
        fnv1a(format!("{text}\n{count}").as_bytes())
    };
    volumes.iter().map(text).map(number).collect()
}

/// Returns the settings of a renderer that affect pictures. Name and content of a script are included, its
/// folder is not.
fn settings(renderer: &Renderer) -> Result<String> {
    let mut renderer = renderer.clone();
    let mut script_key = String::new();
    match &mut renderer {
        Renderer::Entire { .. } => {}
        Renderer::Command { timeout_s, .. } | Renderer::Session { timeout_s, .. } => *timeout_s = None,
        Renderer::Pvbatch { timeout_s, script, .. } => {
            *timeout_s = None;
            script_key = Identity::of(script, "")?.key();
            *script = script.file_name().unwrap_or_default().into();
        }
    }
    Ok(serde_json::to_string(&renderer)? + &script_key)
}

fn check_name(what: &str, name: &str) -> Result<()> {
    let ok = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    ensure!(
        !name.is_empty() && name.len() <= 200 && name.chars().all(ok) && !name.starts_with('.'),
        "{what} is {name:?}; it must be 1 to 200 bytes of letters, digits, - _ and ., not beginning with a dot"
    );
    Ok(())
}

fn volumes(entries: &[VolumesEntry], folder: &Path) -> Result<Vec<VolumeFile>> {
    let mut out = Vec::new();
    for entry in entries {
        let mut paths = Vec::new();
        for pattern in &entry.files {
            let whole = folder.join(pattern);
            let before = paths.len();
            if whole.exists() {
                paths.push(whole);
            } else {
                let folder = folder.to_str().with_context(|| format!("{} is not UTF-8", folder.display()))?;
                let text = Path::new(&glob::Pattern::escape(folder)).join(pattern);
                for found in glob::glob(&text.to_string_lossy())
                    .with_context(|| format!("volumes: the pattern {pattern:?}"))?
                {
                    paths.push(found.with_context(|| format!("volumes: the pattern {pattern:?}"))?);
                }
            }
            ensure!(
                paths.len() > before,
                "volumes: no file matches {pattern:?} in {}; check the path",
                folder.display()
            );
        }
        natural::sort(&mut paths);
        paths.dedup();
        let stem = |p: &Path| p.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let single = paths.len() == 1;
        for (time, path) in paths.iter().enumerate() {
            let name = match &entry.name {
                Some(name) if entry.series || single => name.clone(),
                Some(name) => format!("{name}-{}", stem(path)),
                None if entry.series => stem(&paths[0]),
                None => stem(path),
            };
            let meta = std::fs::metadata(path).with_context(|| format!("cannot read {}", path.display()))?;
            ensure!(meta.is_file(), "volumes: {} is no file; give volume files", path.display());
            let time = if entry.series { time as u32 } else { 0 };
            let (path, reading, files) = (path.clone(), entry.reading(), Vec::new());
            out.push(VolumeFile { name, time, path, bytes: 0, reading, files });
        }
    }
    out.par_iter_mut().try_for_each(|volume| -> Result<()> {
        volume.files = identity::of_volume(&volume.path)?;
        volume.bytes = volume.files.iter().map(|f| f.bytes).sum();
        Ok(())
    })?;
    Ok(out)
}

/// Adds views at each of the distances. `angles`: rotation about x and y of a view, degrees.
fn add_views(
    out: &mut Vec<Arcball>,
    distances: &[f32],
    views: u32,
    angles: impl Fn(u32) -> [f32; 2],
) -> Result<()> {
    let count = (views as usize).saturating_mul(distances.len()).saturating_add(out.len());
    ensure!(
        count <= MAX_TASKS,
        "cameras: {count} views are more than a job's maximum of {MAX_TASKS} tasks; split the job"
    );
    for &dz in distances {
        out.extend((0..views).map(&angles).map(|[rx, ry]| Arcball { rx, ry, dz }));
    }
    Ok(())
}

fn cameras(entries: &[CamerasEntry]) -> Result<Vec<Arcball>> {
    let mut out: Vec<Arcball> = Vec::new();
    for entry in entries {
        match entry {
            CamerasEntry::Orbit { views, elevation_deg, distances_radii, from_deg, to_deg } => {
                add_views(&mut out, distances_radii, *views, |i| {
                    [*elevation_deg, from_deg + (to_deg - from_deg) * i as f32 / *views as f32]
                })?;
            }
            CamerasEntry::SemiSphere { views, distances_radii } => {
                let golden = 180.0 * (3.0 - 5.0f64.sqrt());
                add_views(&mut out, distances_radii, *views, |i| {
                    let height = (f64::from(i) + 0.5) / f64::from(*views);
                    [height.asin().to_degrees() as f32, (f64::from(i) * golden).rem_euclid(360.0) as f32]
                })?;
            }
            CamerasEntry::List { poses } => {
                out.extend(poses.iter().map(|&[rx, ry, dz]| Arcball { rx, ry, dz }));
            }
        }
    }
    for (i, pose) in out.iter().enumerate() {
        Camera::from_arcball(*pose).with_context(|| format!("cameras: view {}", i + 1))?;
    }
    Ok(out)
}

fn transfers(entries: &[TransferEntry]) -> Result<Vec<NamedTransfer>> {
    let mut out: Vec<NamedTransfer> = Vec::new();
    for entry in entries {
        check_name("transfer: name", &entry.name)?;
        ensure!(
            out.iter().all(|earlier| earlier.name != entry.name),
            "transfer: two entries have the name {}; give each a name of its own",
            entry.name
        );
        let value = match (&entry.lobes, &entry.points) {
            (Some(lobes), None) => serde_json::json!({ "lobes": lobes.iter().map(|[c, w, h]|
                serde_json::json!({"center": c, "width": w, "height": h})).collect::<Vec<_>>() }),
            (None, Some(points)) => serde_json::json!({ "points": points.iter().map(|[p, r, g, b, o]|
                serde_json::json!({"position": p, "color": [r, g, b], "opacity": o})).collect::<Vec<_>>() }),
            (found, _) => {
                let has = if found.is_some() { "both lobes and points" } else { "neither lobes nor points" };
                bail!("transfer {} has {has}; give either lobes or points", entry.name)
            }
        };
        let transfer: Transfer = serde_json::from_value(value)?;
        transfer.function().to_table().with_context(|| format!("transfer {}", entry.name))?;
        out.push(NamedTransfer { name: entry.name.clone(), transfer });
    }
    Ok(out)
}

fn renderer(mut renderer: Renderer, folder: &Path) -> Result<Renderer> {
    match &mut renderer {
        own @ Renderer::Entire { .. } => {
            draw_settings(own)?;
        }
        Renderer::Command { command, timeout_s } => {
            check_program(command, *timeout_s)?;
            command.iter().try_for_each(|argument| command::check(argument))?;
            ensure!(
                command.iter().any(|a| command::has(a, "out")),
                "renderer: no argument of the command holds {{out}}, where the image goes; add it"
            );
        }
        Renderer::Session { command, timeout_s } => check_program(command, *timeout_s)?,
        Renderer::Pvbatch { script, program, timeout_s, .. } => {
            check_program(std::slice::from_ref(program), *timeout_s)?;
            *script = folder.join(&*script);
            ensure!(script.is_file(), "renderer: there is no script {}; check the path", script.display());
        }
    }
    Ok(renderer)
}

fn check_program(command: &[String], timeout: Option<f64>) -> Result<()> {
    ensure!(
        command.first().is_some_and(|p| !p.is_empty()),
        "renderer: the command is empty; a program and its arguments are expected"
    );
    ensure!(
        timeout.is_none_or(|t| t > 0.0 && std::time::Duration::try_from_secs_f64(t).is_ok()),
        "renderer: timeout_s is {}; it must be positive and below 1.8e19, in seconds",
        timeout.unwrap_or(f64::NAN)
    );
    Ok(())
}

#[cfg(test)]
#[path = "job_tests.rs"]
mod tests;
