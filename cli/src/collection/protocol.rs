//! Protocol of a collection, as a manifest stores it.

use anyhow::{Context, Result, ensure};
use entire_core::scene::{DEFAULT_FOV_Y_DEGREES, Shading, Skipping};
use entire_io::dataset::{MANIFEST_FORMAT, Manifest, STEP_REFERENCE, Scene};
use entire_io::files::without_dots;
use entire_io::identity::{self, Identity};
use entire_io::machine;
use entire_io::scenes::{RandomScene, SceneDistribution};
use entire_io::volume::{Reading, Volume};
use entire_vk_raycaster::Renderer;
use serde::Deserialize;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A volume to collect frames of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Job {
    /// The file.
    pub path: PathBuf,
    /// Name of the volume's ensemble member; empty if there is none.
    pub member: String,
    /// Time step of the volume, if the file's name contains one.
    pub time_step: Option<u32>,
}

/// Checks that tables can hold the path of a volume.
///
/// # Errors
/// When the path is not UTF-8.
pub(crate) fn ensure_utf8(path: &Path) -> Result<()> {
    ensure!(
        path.to_str().is_some(),
        "{}: the path is not UTF-8, which tables cannot hold; rename it",
        path.display()
    );
    Ok(())
}

/// Returns the absolute path of a volume, without `..`.
fn place_of(path: &Path) -> PathBuf {
    without_dots(&std::path::absolute(path).unwrap_or_else(|_| path.to_owned()))
}

impl Job {
    /// Parses a path: `…/m01/t0012.nrrd` is time step 12 of member `m01`.
    pub fn from_path(path: &Path) -> Self {
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let stem = name.split('.').next().unwrap_or_default();
        let time_step = stem
            .strip_prefix('t')
            .filter(|d| !d.is_empty() && d.bytes().all(|b| b.is_ascii_digit()))
            .and_then(|d| d.parse().ok());
        let place = place_of(path);
        let folder = place.parent().and_then(Path::file_name);
        let member = match (time_step, folder) {
            (Some(_), Some(folder)) => folder.to_string_lossy().into_owned(),
            _ => String::new(),
        };
        Self { path: path.to_owned(), member, time_step }
    }

    /// Returns the volume's name in tables: the path as given.
    pub fn name(&self) -> String {
        self.path.to_string_lossy().into_owned()
    }

    /// Returns the name that seeds the volume's random scenes: the name of the file and, for a time step, the
    /// names of the two folders above it. This name does not depend on the working folder or on the location
    /// of the data.
    pub(crate) fn seed_name(&self) -> String {
        let place = place_of(&self.path);
        let parts: Vec<String> =
            place.components().map(|c| c.as_os_str().to_string_lossy().into_owned()).collect();
        let keep = if self.time_step.is_some() { 3 } else { 1 };
        parts[parts.len().saturating_sub(keep)..].join("/")
    }

    /// Returns the scene of a frame of the volume, which is rendered with `dims` voxels (x, y, z).
    pub(crate) fn scene(
        &self,
        drawn: RandomScene,
        dims: [usize; 3],
        (shading, skipping, termination): (Shading, Skipping, f32),
    ) -> Scene {
        let RandomScene { camera, width, height, step, lobes } = drawn;
        Scene {
            volume: self.name(),
            member: self.member.clone(),
            time_step: self.time_step,
            dims: dims.map(|n| n as u32),
            camera,
            fov_y_degrees: DEFAULT_FOV_Y_DEGREES,
            width,
            height,
            step,
            shading,
            skipping,
            termination,
            lobes,
        }
    }
}

/// Settings by which scenes are chosen at random and rendered.
#[derive(Clone, Debug, PartialEq)]
pub struct Protocol {
    /// Frames per volume.
    pub frames: u32,
    /// Repeats per frame and pass.
    pub repeats: u32,
    /// Number of passes over all volumes.
    pub passes: u32,
    /// Renderings discarded after each volume change.
    pub warm_up: u32,
    /// Renderings of each frame that are discarded before its repeats. Renderings that are discarded after a
    /// volume change count towards this number.
    pub warm_up_repeats: u32,
    /// Seed of the random scenes.
    pub seed: u64,
    /// Distribution of the scenes.
    pub scenes: SceneDistribution,
    /// Shading of each sample.
    pub shading: Shading,
    /// Skipping of empty space.
    pub skipping: Skipping,
    /// Accumulated opacity at which rays stop.
    pub termination: f32,
    /// Factor by which volumes are enlarged along every axis at load.
    pub enlarge: usize,
    /// Voxels per side to which volumes are resampled; `None` for the original volumes.
    pub proxy: Option<usize>,
    /// Options with which volume files are read.
    pub reading: Reading,
}

impl Protocol {
    /// Returns the protocol and the volumes of a table that `entire collect` wrote, from its manifest.
    ///
    /// # Errors
    /// When a setting is missing or unknown to this version; the error names the setting.
    pub(crate) fn of_manifest(manifest: &Manifest) -> Result<(Self, Vec<Job>)> {
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
            #[serde(default)]
            reading: Reading,
            #[serde(default = "one")]
            passes: u32,
            #[serde(default)]
            warm_up_repeats_discarded_per_frame: u32,
        }
        #[derive(Deserialize)]
        struct VolumeOf {
            path: PathBuf,
            member: String,
            time_step: Option<u32>,
            #[serde(default)]
            seed_name: Option<String>,
        }
        fn one() -> u32 {
            1
        }
        let s: Settings = serde_json::from_value(manifest.settings.clone())
            .context("the manifest's settings are not those of `entire collect`")?;
        let unknown = |what: &str, name: &str| {
            format!("the manifest's {what} is {name:?}, which this version does not know")
        };
        ensure!(
            s.fov_y_deg == DEFAULT_FOV_Y_DEGREES,
            "the manifest's field of view is {}°; this version draws {DEFAULT_FOV_Y_DEGREES}°",
            s.fov_y_deg
        );
        ensure!(
            s.passes > 0 && manifest.repeats.is_multiple_of(s.passes),
            "the manifest's {} repeats cannot be split evenly over {} passes",
            manifest.repeats,
            s.passes
        );
        let protocol = Self {
            frames: s.frames_per_volume,
            repeats: manifest.repeats / s.passes,
            passes: s.passes,
            warm_up: s.warm_up_frames_discarded_per_volume,
            warm_up_repeats: s.warm_up_repeats_discarded_per_frame,
            seed: manifest.seed,
            scenes: s.scenes,
            shading: s.shading.parse().with_context(|| unknown("shading", &s.shading))?,
            skipping: s.skipping.parse().with_context(|| unknown("skipping", &s.skipping))?,
            termination: s.termination,
            enlarge: s.enlarged_trilinearly_by,
            proxy: s.resampled_to_edge,
            reading: s.reading,
        };
        let mut jobs = Vec::new();
        for v in s.volumes {
            let job = Job { path: v.path, member: v.member, time_step: v.time_step };
            // This name seeds the random scenes.
            let name = job.seed_name();
            ensure!(
                v.seed_name.as_ref().is_none_or(|seed_name| *seed_name == name),
                "the random frames of {} were drawn from the name {:?}, but the file now has the name \
                 {name:?}; give the file, and for a time step also its two folders, the former name",
                job.name(),
                v.seed_name.unwrap_or_default()
            );
            jobs.push(job);
        }
        Ok((protocol, jobs))
    }

    /// Returns the scene of frame `index` of a job whose rendered volume has `dims` voxels (x, y, z).
    pub fn scene(&self, job: &Job, dims: [usize; 3], index: u64) -> Scene {
        let drawn = self.scenes.draw(self.seed, &job.seed_name(), index);
        job.scene(drawn, dims, (self.shading, self.skipping, self.termination))
    }

    /// Returns the volume to render: resampled or enlarged if the protocol says so.
    ///
    /// # Errors
    /// For an edge or a factor that is not accepted.
    pub fn sized(&self, volume: Volume) -> Result<Volume> {
        match self.proxy {
            Some(edge) => volume.resampled(edge),
            None => volume.enlarged(self.enlarge),
        }
    }

    /// Returns the manifest of a new table of these jobs.
    ///
    /// # Errors
    /// For more repeats than can be counted.
    pub fn manifest(&self, jobs: &[Job], renderer: &dyn Renderer) -> Result<Manifest> {
        let repeats = self.repeats.checked_mul(self.passes).with_context(|| {
            let (repeats, passes) = (self.repeats, self.passes);
            format!("{repeats} repeats in {passes} passes are too many; their product must be below 2^32")
        })?;
        Ok(manifest_of(renderer, self.seed, repeats, self.settings(jobs)))
    }

    pub(crate) fn settings(&self, jobs: &[Job]) -> Value {
        let mut settings = json!({
            "frames_per_volume": self.frames,
            "warm_up_frames_discarded_per_volume": self.warm_up,
            "shading": self.shading.to_string(),
            "skipping": self.skipping.to_string(),
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
        if self.reading != Reading::default() {
            settings["reading"] = json!(self.reading);
        }
        if self.passes > 1 {
            settings["passes"] = json!(self.passes);
        }
        if self.warm_up_repeats > 0 {
            settings["warm_up_repeats_discarded_per_frame"] = json!(self.warm_up_repeats);
        }
        settings
    }
}

/// Returns the manifest of a new table, without the identities of volume files.
pub(crate) fn manifest_of(renderer: &dyn Renderer, seed: u64, repeats: u32, settings: Value) -> Manifest {
    Manifest {
        format: MANIFEST_FORMAT.into(),
        created: machine::now(),
        machine: machine::machine(),
        renderer: renderer.backend().into(),
        device: renderer.device(),
        driver: driver_of(renderer),
        commit: machine::version(),
        seed,
        repeats,
        step_reference: STEP_REFERENCE.into(),
        settings,
        files: BTreeMap::new(),
        other: BTreeMap::new(),
    }
}

/// The driver with its version: the end of a Vulkan device's description. Empty for the CPU version of the
/// raycaster, which has no driver.
fn driver_of(renderer: &dyn Renderer) -> String {
    let device = renderer.device();
    match device.rsplit_once(", ") {
        Some((_, driver)) if renderer.backend() == "vulkan" => driver.to_owned(),
        _ => String::new(),
    }
}

/// Differences between two manifests that prevent a table's continuation.
pub fn differences(old: &Manifest, new: &Manifest) -> Vec<String> {
    let mut out = Vec::new();
    let mut compare = |name: &str, old: Option<&Value>, new: Option<&Value>| {
        // The old manifest was read from text, so a value counts as changed only if both the value and its
        // text differ.
        let [was, is] = [old, new].map(|v| v.map_or("nothing".to_owned(), ToString::to_string));
        if old != new && was != is {
            let volumes = "the list of volumes differs (paths, members and order must be the same)";
            out.push(match name {
                "volumes" => volumes.to_owned(),
                _ => format!("{name} was {was} and is {is} now"),
            });
        }
    };
    for (name, old, new) in [
        ("seed", json!(old.seed), json!(new.seed)),
        ("repeats", json!(old.repeats), json!(new.repeats)),
        ("renderer", json!(old.renderer), json!(new.renderer)),
        ("device", json!(old.device), json!(new.device)),
        ("machine", json!(old.machine), json!(new.machine)),
    ] {
        compare(name, Some(&old), Some(&new));
    }
    let empty = serde_json::Map::new();
    let (a, b) = (old.settings.as_object().unwrap_or(&empty), new.settings.as_object().unwrap_or(&empty));
    let names: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    names.into_iter().for_each(|name| compare(name, a.get(name), b.get(name)));
    let changed = |(name, then): (&String, &Vec<Identity>)| {
        let what = identity::difference(then, new.files.get(name)?)?;
        Some(format!("{name} changed since the table was begun ({what})"))
    };
    out.extend(old.files.iter().filter_map(changed));
    out
}
