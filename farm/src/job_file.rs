//! Contents of a job file, before checks and expansion into tasks.

use anyhow::{Context, Result, anyhow, bail, ensure};
use clap::ValueEnum;
use entire_core::scene::{Arcball, Camera, DEFAULT_FOV_Y_DEGREES, Frame, Shading, Skipping};
use entire_io::options::Device;
use entire_io::volume::{Fill, Range, Reading};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Functions that return the default values.
macro_rules! defaults {
    ($($name:ident: $kind:ty = $value:expr;)*) => { $(fn $name() -> $kind { $value })* };
}

defaults! {
    default_fov: f32 = DEFAULT_FOV_Y_DEGREES;
    default_steps: Vec<f32> = vec![1.0];
    full_turn: f32 = 360.0;
    default_shade: String = "none".into();
    default_skip: String = "blocks".into();
    default_termination: f32 = 0.99;
    default_device: String = "auto".into();
    default_pvbatch: String = "pvbatch".into();
}

/// Contents of a job file. Relative paths start at the job file's folder.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JobFile {
    /// The database's name: letters, digits, `-`, `_` and `.`.
    pub name: String,
    /// Folder of the database; default: `NAME.cdb` beside the job file.
    pub output: Option<PathBuf>,
    /// Vertical field of view, degrees.
    #[serde(default = "default_fov")]
    pub fov_y_deg: f32,
    /// Image sizes, `WIDTHxHEIGHT`.
    pub sizes: Vec<String>,
    /// Ray steps in reference steps.
    #[serde(default = "default_steps")]
    pub steps: Vec<f32>,
    /// Volumes to render.
    pub volumes: Vec<VolumesEntry>,
    /// Views.
    pub cameras: Vec<CamerasEntry>,
    /// The transfer functions.
    pub transfer: Vec<TransferEntry>,
    /// The renderer.
    pub renderer: Renderer,
    /// Source of expected times.
    #[serde(default)]
    pub predict: Predict,
    /// Retries of failed tasks.
    #[serde(default)]
    pub retry: Retry,
}

impl JobFile {
    /// Reads the text of a job file (TOML).
    ///
    /// # Errors
    /// When the text is no job file. The message names the line.
    pub fn parse(text: &str) -> Result<Self> {
        toml::from_str(text).map_err(|e| {
            let at = e.span().map_or(0, |s| text[..s.start.min(text.len())].matches('\n').count() + 1);
            anyhow!("line {at}: {}", e.message())
        })
    }
}

/// One or several volume files: separate volumes, or the time steps of one volume.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VolumesEntry {
    /// Name of the volume. Several files that are no series have the names `NAME-STEM`, with the stem of each
    /// file. Default: the stem of the first file, or of each file if `series` is false.
    pub name: Option<String>,
    /// Files or glob patterns. The files are sorted by path; numbers in paths are compared by value.
    pub files: Vec<String>,
    /// True if the files are time steps of one volume.
    #[serde(default)]
    pub series: bool,
    /// Scalar range that maps to 0 … 1: two numbers, or `"data"` for minimum and maximum of the voxels.
    pub range: Option<RangeEntry>,
    /// Name of the array to read from a VTK file with several arrays.
    pub array: Option<String>,
    /// Fill values, which mark voxels without data: `"none"`, or numbers separated by commas.
    #[serde(default)]
    pub fill: Fill,
}

/// A scalar range.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(untagged, expecting = "two numbers, the low one first, or \"data\"")]
pub enum RangeEntry {
    /// Low and high end.
    Numbers([f32; 2]),
    /// A word, or numbers as in `--range`.
    Text(Range),
}

impl VolumesEntry {
    /// Returns the options with which the files are read: array, fill values and scalar range.
    pub fn reading(&self) -> Reading {
        let range = match self.range {
            Some(RangeEntry::Numbers([low, high])) => Range::Given(low, high),
            Some(RangeEntry::Text(range)) => range,
            None => Range::Default,
        };
        Reading { array: self.array.clone(), fill: self.fill.clone(), range }
    }
}

/// Views of a database.
#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum CamerasEntry {
    /// Views on a turn about the y axis, for each distance.
    Orbit {
        /// Number of views on each turn.
        views: u32,
        /// Rotation about x, degrees.
        #[serde(default)]
        elevation_deg: f32,
        /// Distances of the camera, bounding-sphere radii.
        distances_radii: Vec<f32>,
        /// Start of the turn, degrees.
        #[serde(default)]
        from_deg: f32,
        /// End of the turn (not reached), degrees.
        #[serde(default = "full_turn")]
        to_deg: f32,
    },
    /// Evenly spread directions on the upper half of spheres (Fibonacci lattice).
    SemiSphere {
        /// Number of views on each sphere.
        views: u32,
        /// Distances of the camera, bounding-sphere radii.
        distances_radii: Vec<f32>,
    },
    /// Poses one by one: rotation about x and y in degrees, distance in bounding-sphere radii.
    List {
        /// The poses.
        poses: Vec<[f32; 3]>,
    },
}

/// A named transfer function: lobes (center, width, height) or points.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransferEntry {
    /// Its name.
    pub name: String,
    /// Gaussian lobes: center, width, height.
    pub lobes: Option<Vec<[f32; 3]>>,
    /// Control points: position, red, green, blue, opacity.
    pub points: Option<Vec<[f32; 5]>>,
}

/// A renderer of images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Renderer {
    /// The project's raycaster.
    Entire {
        /// `none`, `local`, `scatter` or `local-scatter`.
        #[serde(default = "default_shade")]
        shade: String,
        /// `none`, `blocks` or `distance`.
        #[serde(default = "default_skip")]
        skip: String,
        /// Accumulated opacity at which a ray stops.
        #[serde(default = "default_termination")]
        termination: f32,
        /// `auto`, `vulkan` or `cpu`.
        #[serde(default = "default_device")]
        device: String,
    },
    /// A program that renders one image and ends. Its arguments hold placeholders; no shell reads them.
    Command {
        /// Program and arguments.
        command: Vec<String>,
        /// Time limit of a task, seconds. At the limit the program is ended, and the task counts as failed.
        timeout_s: Option<f64>,
    },
    /// A persistent program: it reads a task per line of its standard input (JSON) and answers each with a
    /// line of its standard output (JSON).
    Session {
        /// Program and arguments.
        command: Vec<String>,
        /// Time limit of a task, seconds. At the limit the program is ended, and the task counts as failed.
        timeout_s: Option<f64>,
    },
    /// A persistent ParaView script, run by `pvbatch`. It uses the protocol of `session`.
    Pvbatch {
        /// The script.
        script: PathBuf,
        /// Additional arguments of the script.
        #[serde(default)]
        args: Vec<String>,
        /// The program.
        #[serde(default = "default_pvbatch")]
        program: String,
        /// Time limit of a task, seconds. At the limit the program is ended, and the task counts as failed.
        timeout_s: Option<f64>,
    },
}

/// Source of expected times.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Predict {
    /// A model file.
    pub model: Option<PathBuf>,
    /// A task list with `task` (an id) and `predicted_s`; tasks without `predicted_s` have `measured_s`.
    pub list: Option<PathBuf>,
    /// True if the analytic model predicts the times, unless a model or list is given. Default: true for the
    /// project's raycaster, false for other renderers. If false, expected times are proportional to pixels /
    /// step until tasks have been measured.
    pub analytic: Option<bool>,
    /// Number of rays along each side of the analytic model's probe.
    pub probe_side: Option<usize>,
}

/// Retries of failed tasks.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Retry {
    /// Number of failures after which a task is quarantined.
    pub attempts: u32,
    /// Number of losses of a task with its worker after which the task is quarantined.
    pub losses: u32,
}

impl Default for Retry {
    fn default() -> Self {
        Self { attempts: 3, losses: 8 }
    }
}

/// Shading, skipping and termination of the raycaster's frames.
pub(crate) type Draw = (Shading, Skipping, f32);

pub(crate) fn frame(
    pose: Arcball,
    fov_y_deg: f32,
    [width, height]: [u32; 2],
    step: f32,
    (shading, skipping, termination): Draw,
) -> Result<Frame> {
    let camera = Camera::from_arcball(pose)?.with_fov_y_degrees(fov_y_deg)?;
    let frame = Frame { step, termination, shading, skipping, ..Frame::new(camera, width, height)? };
    Ok(frame.checked()?)
}

/// Returns the settings of the raycaster, and its device.
///
/// # Errors
/// When the renderer is not the project's raycaster, a word is unknown (the message names the accepted
/// words), or `termination` is not above 0 and at most 1.
pub(crate) fn draw_settings(renderer: &Renderer) -> Result<(Draw, Device)> {
    let Renderer::Entire { shade, skip, termination, device } = renderer else {
        bail!("the renderer is not the project's raycaster, so it has no settings of the raycaster")
    };
    let known = |text: &str| {
        let all = Device::value_variants().iter().filter_map(|v| v.to_possible_value());
        let names = all.map(|p| p.get_name().to_owned()).collect::<Vec<_>>().join(", ");
        Device::from_str(text, false)
            .map_err(|_| anyhow!("renderer: device is {text:?}; accepted are {names}"))
    };
    ensure!(
        *termination > 0.0 && *termination <= 1.0,
        "renderer: termination is {termination}; it must be above 0 and at most 1"
    );
    let shade = shade.parse().context("renderer: shade")?;
    let skip = skip.parse().context("renderer: skip")?;
    Ok(((shade, skip, *termination), known(device)?))
}
