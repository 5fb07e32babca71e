//! Paths: camera and transfer function of a user, frame by frame. Both are given at keyframes. Between two
//! keyframes, they are interpolated, or they remain those of the earlier keyframe until the later one.
//!
//! # File format
//!
//! JSON, one object:
//!
//! * `format`, required: `"entire-path-1"`.
//! * `name`: a name for reports.
//! * `frames`, required: number of frames, 1 to 1 000 000.
//! * `fov_y_deg`: vertical field of view, degrees; default 45.
//! * `keyframes`, required: array of keyframes, `frame` ascending, the first at frame 0 with camera and
//!   transfer function.
//!
//! A keyframe:
//!
//! * `frame`, required: frame number from 0.
//! * `camera`, required at frame 0: `{"rx_deg": …, "ry_deg": …, "dz_radii": …}`. Arcball angles, and the
//!   distance in bounding-sphere radii. An additional `"parallel_scale": …` makes the projection parallel
//!   (orthographic) and replaces the field of view: it is half of the visible height, in bounding-sphere
//!   radii.
//! * `transfer`, required at frame 0: `{"lobes": [{"center": …, "width": …, "height": …}, …]}` or
//!   `{"points": [{"position": …, "color": [r, g, b], "opacity": …}, …]}`.
//! * `switch`: with `true`, this keyframe takes effect at once at its frame, and the previous value holds
//!   until then.
//!
//! Camera and transfer function are two tracks; a keyframe may give either or both. Between keyframes of a
//! track, angles are interpolated linearly in degrees (0 to 720 is two turns), the distance and the parallel
//! scale in their logarithms. Lobes and points are paired by their position in the list. Center and height of
//! a lobe and all numbers of a point are interpolated linearly, the width of a lobe in its logarithm. Two
//! transfer functions of different kinds or lengths cannot be interpolated, nor can a perspective and a
//! parallel camera: the later keyframe must then switch.

mod generated;
#[cfg(test)]
mod tests;

pub use generated::Generated;

use crate::files::read_text;
use anyhow::{Context, Result, anyhow, ensure};
use entire_core::scene::{
    Arcball, Camera, ControlPoint, DEFAULT_FOV_Y_DEGREES, GaussianLobe, TransferFunction,
};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::path::Path;
use std::sync::Arc;

/// Value of the field `format` of a path file.
pub const PATH_FORMAT: &str = "entire-path-1";

/// Maximum number of frames of a path.
pub const MAX_FRAMES: u32 = 1_000_000;

/// Maximum number of lobes or points of a transfer function: four for each entry of its table.
const MAX_TRANSFER_PARTS: usize = 1024;

/// Maximum size of a path file, in bytes.
pub const MAX_PATH_BYTES: u64 = 64 << 20;

/// Contents of a path file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PathFile {
    /// [`PATH_FORMAT`].
    pub format: String,
    /// A name for reports.
    #[serde(default)]
    pub name: String,
    /// Number of frames.
    pub frames: u32,
    /// Vertical field of view, degrees.
    #[serde(default = "default_fov")]
    pub fov_y_deg: f32,
    /// Keyframes, in ascending order of their frames.
    pub keyframes: Vec<Keyframe>,
}

fn default_fov() -> f32 {
    DEFAULT_FOV_Y_DEGREES
}

/// A keyframe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Keyframe {
    /// Frame number from 0.
    pub frame: u32,
    /// The camera, if this keyframe gives it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraPose>,
    /// The transfer function, if this keyframe gives it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transfer: Option<Transfer>,
    /// True if the keyframe takes effect abruptly, without interpolation before it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub switch: bool,
}

/// A camera on the arcball.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraPose {
    /// Rotation about x, degrees.
    pub rx_deg: f32,
    /// Rotation about y, degrees.
    pub ry_deg: f32,
    /// Distance, bounding-sphere radii.
    pub dz_radii: f32,
    /// Half of the visible height of a parallel projection, bounding-sphere radii; `None` for a perspective
    /// projection.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parallel_scale: Option<f32>,
}

/// A transfer function.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Transfer {
    /// Gaussian lobes.
    Lobes(Vec<GaussianLobe>),
    /// Piecewise-linear control points.
    Points(Vec<ControlPoint>),
}

impl Transfer {
    /// Returns the lobes, if the function consists of lobes.
    pub fn lobes(&self) -> Option<Vec<GaussianLobe>> {
        match self {
            Self::Lobes(lobes) => Some(lobes.clone()),
            Self::Points(_) => None,
        }
    }

    /// Returns the transfer function in the type of `entire-core`.
    pub fn function(&self) -> TransferFunction {
        match self {
            Self::Points(points) => TransferFunction::Points(points.clone()),
            Self::Lobes(lobes) => TransferFunction::Gaussian(lobes.clone()),
        }
    }

    fn size(&self) -> (&'static str, usize) {
        match self {
            Self::Lobes(l) => ("lobes", l.len()),
            Self::Points(p) => ("points", p.len()),
        }
    }

    fn mix(&self, other: &Self, t: f32) -> Self {
        let go = |a, b| between(a, b, t);
        match (self, other) {
            (Self::Lobes(a), Self::Lobes(b)) => Self::Lobes(
                a.iter()
                    .zip(b)
                    .map(|(a, b)| GaussianLobe {
                        center: go(a.center, b.center),
                        width: go(a.width.ln(), b.width.ln()).exp(),
                        height: go(a.height, b.height),
                    })
                    .collect(),
            ),
            (Self::Points(a), Self::Points(b)) => Self::Points(
                a.iter()
                    .zip(b)
                    .map(|(a, b)| ControlPoint {
                        position: go(a.position, b.position),
                        color: [0, 1, 2].map(|i| go(a.color[i], b.color[i])),
                        opacity: go(a.opacity, b.opacity),
                    })
                    .collect(),
            ),
            _ => self.clone(),
        }
    }
}

/// Returns the linear interpolation between a (t = 0) and b (t = 1); finite for finite a and b.
fn between(a: f32, b: f32, t: f32) -> f32 {
    let step = t * (b - a);
    if step.is_finite() { a + step } else { a * (1.0 - t) + b * t }
}

impl CameraPose {
    fn mix(self, other: Self, t: f32) -> Self {
        let go = |a, b| between(a, b, t);
        // Rounding must not move the value out of [a, b]: outside, the camera may be refused.
        let grow = |a: f32, b: f32| go(a.ln(), b.ln()).exp().clamp(a.min(b), a.max(b));
        Self {
            rx_deg: go(self.rx_deg, other.rx_deg),
            ry_deg: go(self.ry_deg, other.ry_deg),
            dz_radii: grow(self.dz_radii, other.dz_radii),
            parallel_scale: self.parallel_scale.zip(other.parallel_scale).map(|(a, b)| grow(a, b)),
        }
    }

    fn arcball(self) -> Arcball {
        Arcball { rx: self.rx_deg, ry: self.ry_deg, dz: self.dz_radii }
    }
}

/// The transfer function of a frame, stored as a position between keyframes. The function is interpolated on
/// request, so that a long path takes no more memory than its keyframes and cameras.
#[derive(Clone, Debug)]
pub struct TransferAt {
    keys: Arc<[(u32, bool, Transfer)]>,
    /// The keyframe at or before the frame.
    key: usize,
    /// Share of the way to the next keyframe, 0 to 1.
    share: f32,
}

impl TransferAt {
    /// Returns the transfer function, interpolated between keyframes.
    pub fn get(&self) -> Cow<'_, Transfer> {
        let (_, _, value) = &self.keys[self.key];
        match self.keys.get(self.key + 1) {
            Some((_, _, next)) if self.share > 0.0 => Cow::Owned(value.mix(next, self.share)),
            _ => Cow::Borrowed(value),
        }
    }

    /// Returns the transfer function in the type of `entire-core`.
    pub fn function(&self) -> TransferFunction {
        self.get().function()
    }

    /// Returns the lobes, if the function consists of lobes.
    pub fn lobes(&self) -> Option<Vec<GaussianLobe>> {
        self.get().lobes()
    }
}

impl PartialEq for TransferAt {
    fn eq(&self, other: &Self) -> bool {
        let same = Arc::ptr_eq(&self.keys, &other.keys) && self.key == other.key && self.share == other.share;
        same || self.get() == other.get()
    }
}

/// One frame of a path.
#[derive(Clone, Debug, PartialEq)]
pub struct PathFrame {
    /// The camera's pose.
    pub camera: Arcball,
    /// Half of the visible height of a parallel projection, bounding-sphere radii; `None` for a perspective
    /// projection.
    pub parallel_scale: Option<f32>,
    /// The transfer function.
    pub transfer: TransferAt,
    /// True if the transfer function differs from that of the frame before; true for the first frame.
    pub transfer_changed: bool,
    /// True if the transfer function switches abruptly at this frame.
    pub transfer_switched: bool,
    /// True if the camera switches abruptly at this frame.
    pub camera_switched: bool,
}

impl PathFrame {
    /// True if the camera or the transfer function switches abruptly at this frame.
    pub fn switched(&self) -> bool {
        self.transfer_switched || self.camera_switched
    }
}

/// A checked path, frame by frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightPath {
    /// Name of the path.
    pub name: String,
    /// Vertical field of view, degrees.
    pub fov_y_degrees: f32,
    /// Every frame.
    pub frames: Vec<PathFrame>,
}

impl PathFile {
    /// Reads a path file.
    ///
    /// # Errors
    /// When the file cannot be read or is no path; the error names the file and the mistake.
    pub fn open(path: &Path) -> Result<Self> {
        let text = read_text(path, MAX_PATH_BYTES)
            .with_context(|| format!("cannot read the path {}", path.display()))?;
        Self::parse(&text).with_context(|| format!("{} is no path file", path.display()))
    }

    /// Reads a path file's text.
    ///
    /// # Errors
    /// When the text is no path file; if the JSON is invalid, the error names line and column.
    pub fn parse(text: &str) -> Result<Self> {
        let file: Self = serde_json::from_str(text).map_err(|e| anyhow!("{e}"))?;
        ensure!(
            file.format == PATH_FORMAT,
            "format is {:?}; this version reads {PATH_FORMAT:?}",
            file.format
        );
        Ok(file)
    }

    /// Checks the path and computes every frame.
    ///
    /// # Errors
    /// When a value is invalid; the error names the keyframe, the mistake and the accepted values.
    pub fn resolve(&self) -> Result<FlightPath> {
        ensure!(
            (1..=MAX_FRAMES).contains(&self.frames),
            "frames is {}; a path has 1 to {MAX_FRAMES} frames",
            self.frames
        );
        let first = self.keyframes.first().context("there is no keyframe; give one at frame 0")?;
        ensure!(
            first.frame == 0 && first.camera.is_some() && first.transfer.is_some(),
            "the first keyframe must be at frame 0 and give both camera and transfer"
        );
        for (i, pair) in self.keyframes.windows(2).enumerate() {
            let (number, frame, before) = (i + 1, pair[1].frame, pair[0].frame);
            ensure!(
                before < frame,
                "keyframe {number} is at frame {frame}, after a keyframe at frame {before}; order them by \
                 frame, one per frame"
            );
        }
        let (mut cameras, mut transfers) = (Vec::new(), Vec::new());
        for (i, key) in self.keyframes.iter().enumerate() {
            let place = || format!("keyframe {i} (frame {})", key.frame);
            ensure!(key.frame < self.frames, "{}: the path has frames 0 to {}", place(), self.frames - 1);
            ensure!(
                key.camera.is_some() || key.transfer.is_some(),
                "{}: gives neither camera nor transfer; give one or remove the keyframe",
                place()
            );
            if let Some(pose) = key.camera {
                camera(pose.arcball(), self.fov_y_deg, pose.parallel_scale).with_context(place)?;
                if let Some((frame, _, before)) = cameras.last() {
                    let before: &CameraPose = before;
                    ensure!(
                        key.switch || before.parallel_scale.is_some() == pose.parallel_scale.is_some(),
                        "{}: of the cameras here and at frame {frame}, only one has a parallel_scale, so \
                         they cannot be interpolated; give it to both, or \"switch\": true",
                        place()
                    );
                }
                cameras.push((key.frame, key.switch, pose));
            }
            if let Some(transfer) = &key.transfer {
                let (kind, size) = transfer.size();
                ensure!(
                    size <= MAX_TRANSFER_PARTS,
                    "{}: {size} {kind}; a transfer function has at most {MAX_TRANSFER_PARTS}",
                    place()
                );
                transfer.function().to_table().with_context(place)?;
                if let Some((frame, _, before)) = transfers.last() {
                    let before: &Transfer = before;
                    let ((kind_a, a), (kind_b, b)) = (before.size(), transfer.size());
                    ensure!(
                        key.switch || (kind_a == kind_b && a == b),
                        "{}: {a} {kind_a} of frame {frame} cannot be interpolated to {b} {kind_b}; give as \
                         many of the same kind, or \"switch\": true",
                        place()
                    );
                }
                transfers.push((key.frame, key.switch, transfer.clone()));
            }
        }
        let keys: Arc<[(u32, bool, Transfer)]> = transfers.into();
        let mut frames: Vec<PathFrame> = Vec::with_capacity(self.frames as usize);
        for index in 0..self.frames {
            let (key, share, camera_switched) = at(&cameras, index);
            let camera = match cameras.get(key + 1) {
                Some((_, _, next)) if share > 0.0 => cameras[key].2.mix(*next, share),
                _ => cameras[key].2,
            };
            let (key, share, transfer_switched) = at(&keys, index);
            let transfer = TransferAt { keys: keys.clone(), key, share };
            let transfer_changed = frames.last().is_none_or(|f| f.transfer != transfer);
            // The first frame has no predecessor, so it is never a switch.
            let real = |switched: bool| switched && index > 0;
            frames.push(PathFrame {
                camera: camera.arcball(),
                parallel_scale: camera.parallel_scale,
                transfer,
                transfer_changed,
                transfer_switched: real(transfer_switched),
                camera_switched: real(camera_switched),
            });
        }
        Ok(FlightPath { name: self.name.clone(), fov_y_degrees: self.fov_y_deg, frames })
    }
}

/// Returns the camera at a pose: parallel if a parallel scale is given, else perspective with the vertical
/// field of view `fov_y`, in degrees. The field of view is checked in both cases.
///
/// # Errors
/// Those of the core.
pub fn camera(pose: Arcball, fov_y: f32, parallel_scale: Option<f32>) -> entire_core::Result<Camera> {
    let camera = Camera::from_arcball(pose)?.with_fov_y_degrees(fov_y)?;
    parallel_scale.map_or(Ok(camera), |scale| camera.with_parallel_scale(scale))
}

/// Returns the position of a frame on a track: index of the keyframe at or before the frame, share of the way
/// to the next keyframe, and true if the track switches abruptly at this frame.
fn at<T>(track: &[(u32, bool, T)], index: u32) -> (usize, f32, bool) {
    let next = track.partition_point(|(frame, _, _)| *frame <= index);
    let (frame, switch, _) = &track[next - 1];
    if *frame == index {
        return (next - 1, 0.0, *switch);
    }
    match track.get(next) {
        Some((later, false, _)) => (next - 1, (index - frame) as f32 / (later - frame) as f32, false),
        _ => (next - 1, 0.0, false),
    }
}

impl FlightPath {
    /// Reads and checks a path file.
    ///
    /// # Errors
    /// When the file cannot be read or is no path; the error names the file and the mistake.
    pub fn open(path: &Path) -> Result<Self> {
        let mut flight =
            PathFile::open(path)?.resolve().with_context(|| format!("{} is no path file", path.display()))?;
        if flight.name.is_empty() {
            flight.name = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        }
        Ok(flight)
    }

    /// Returns the camera of a frame.
    ///
    /// # Errors
    /// Those of the core; none for a path that was [resolved](PathFile::resolve).
    pub fn camera(&self, index: usize) -> Result<Camera> {
        let at = &self.frames[index];
        Ok(camera(at.camera, self.fov_y_degrees, at.parallel_scale)?)
    }

    /// Returns the numbers of the frames with an abrupt switch.
    pub fn switches(&self) -> Vec<usize> {
        (0..self.frames.len()).filter(|i| self.frames[*i].switched()).collect()
    }
}
