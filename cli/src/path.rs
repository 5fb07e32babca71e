//! Paths: what a user looks at, frame by frame. Camera and transfer function are given at keyframes and interpolated in
//! between, or switch abruptly.
//!
//! # File format
//!
//! JSON, one object:
//!
//! | key | required | meaning |
//! |---|---|---|
//! | `format` | yes | `"entire-path-1"` |
//! | `name` | no | a name for reports |
//! | `frames` | yes | number of frames, 1 to 1 000 000 |
//! | `fov_y_deg` | no | vertical field of view, degrees; 45 where it is not given |
//! | `keyframes` | yes | array of keyframes, `frame` ascending, the first at frame 0 with camera and transfer function |
//!
//! A keyframe:
//!
//! | key | required | meaning |
//! |---|---|---|
//! | `frame` | yes | frame number from 0 |
//! | `camera` | at frame 0 | `{"rx_deg": …, "ry_deg": …, "dz_radii": …}`: arcball angles, distance in bounding-sphere radii |
//! | `transfer` | at frame 0 | `{"lobes": [{"center": …, "width": …, "height": …}, …]}` or `{"points": [{"position": …, "color": [r, g, b], "opacity": …}, …]}` |
//! | `switch` | no | `true`: what this keyframe gives holds from its frame on at once; before, the former value holds still |
//!
//! Camera and transfer function are two tracks; a keyframe may give either or both. Between keyframes of a track,
//! angles go linearly in degrees as they stand (0 to 720 is two turns), the distance in its logarithm; lobes go in pairs
//! by position in the list: centre and height linearly, width in its logarithm; points go in pairs, every number
//! linearly. Two transfer functions of different kinds or lengths cannot be interpolated; the later one must switch.

use anyhow::{Context, Result, anyhow, bail, ensure};
use entire_core::scene::{
    Arcball, Camera, ControlPoint, DEFAULT_FOV_Y_DEGREES, GaussianLobe, TransferFunction, VolumeView,
};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The `format` value.
pub const PATH_FORMAT: &str = "entire-path-1";

/// Most frames that a path may have.
pub const MAX_FRAMES: u32 = 1_000_000;

/// A path as its file holds it.
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
    /// Keyframes, ascending.
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
    /// The camera, where this keyframe gives it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraPose>,
    /// The transfer function, where this keyframe gives it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transfer: Option<Transfer>,
    /// Whether it takes effect at once.
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
}

/// A transfer function.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Transfer {
    /// Gaussian lobes.
    Lobes(Vec<Lobe>),
    /// Piecewise-linear control points.
    Points(Vec<Point>),
}

/// A Gaussian lobe (see [`GaussianLobe`]).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lobe {
    /// Where it peaks.
    pub center: f32,
    /// How wide it is.
    pub width: f32,
    /// How high it is.
    pub height: f32,
}

/// A control point (see [`ControlPoint`]).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Point {
    /// Normalized scalar.
    pub position: f32,
    /// Red, green, blue.
    pub color: [f32; 3],
    /// Opacity of one reference step.
    pub opacity: f32,
}

impl Transfer {
    /// The lobes, where there are such.
    pub fn lobes(&self) -> Option<Vec<GaussianLobe>> {
        match self {
            Self::Lobes(lobes) => Some(
                lobes
                    .iter()
                    .map(|l| GaussianLobe { center: l.center, width: l.width, height: l.height })
                    .collect(),
            ),
            Self::Points(_) => None,
        }
    }

    /// As the core has it.
    pub fn function(&self) -> TransferFunction {
        match self {
            Self::Points(points) => TransferFunction::Points(
                points
                    .iter()
                    .map(|p| ControlPoint { position: p.position, color: p.color, opacity: p.opacity })
                    .collect(),
            ),
            Self::Lobes(_) => TransferFunction::Gaussian(self.lobes().unwrap_or_default()),
        }
    }

    fn size(&self) -> (&'static str, usize) {
        match self {
            Self::Lobes(l) => ("lobes", l.len()),
            Self::Points(p) => ("points", p.len()),
        }
    }

    fn mix(&self, other: &Self, t: f32) -> Self {
        let go = |a: f32, b: f32| a + t * (b - a);
        match (self, other) {
            (Self::Lobes(a), Self::Lobes(b)) => Self::Lobes(
                a.iter()
                    .zip(b)
                    .map(|(a, b)| Lobe {
                        center: go(a.center, b.center),
                        width: go(a.width.ln(), b.width.ln()).exp(),
                        height: go(a.height, b.height),
                    })
                    .collect(),
            ),
            (Self::Points(a), Self::Points(b)) => Self::Points(
                a.iter()
                    .zip(b)
                    .map(|(a, b)| Point {
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

impl CameraPose {
    fn mix(self, other: Self, t: f32) -> Self {
        let go = |a: f32, b: f32| a + t * (b - a);
        Self {
            rx_deg: go(self.rx_deg, other.rx_deg),
            ry_deg: go(self.ry_deg, other.ry_deg),
            dz_radii: go(self.dz_radii.ln(), other.dz_radii.ln()).exp(),
        }
    }

    /// As the core has it.
    pub fn arcball(self) -> Arcball {
        Arcball { rx: self.rx_deg, ry: self.ry_deg, dz: self.dz_radii }
    }
}

/// One frame of a path.
#[derive(Clone, Debug, PartialEq)]
pub struct PathFrame {
    /// The camera.
    pub camera: Arcball,
    /// The transfer function.
    pub transfer: Transfer,
    /// Whether the transfer function differs from the frame before (true for the first).
    pub transfer_changed: bool,
    /// Whether the transfer function switched abruptly here.
    pub transfer_switched: bool,
    /// Whether the camera jumped here.
    pub camera_switched: bool,
}

impl PathFrame {
    /// Whether anything switched abruptly here.
    pub fn switched(&self) -> bool {
        self.transfer_switched || self.camera_switched
    }
}

/// A checked path, frame by frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightPath {
    /// Its name.
    pub name: String,
    /// Vertical field of view, degrees.
    pub fov_y_degrees: f32,
    /// Every frame.
    pub frames: Vec<PathFrame>,
}

impl PathFile {
    /// Reads a path file's text.
    ///
    /// # Errors
    /// What is wrong, with line and column where it is the JSON.
    pub fn parse(text: &str) -> Result<Self> {
        let file: Self = serde_json::from_str(text).map_err(|e| anyhow!("{e}"))?;
        ensure!(
            file.format == PATH_FORMAT,
            "format is {:?}; this version reads {PATH_FORMAT:?}",
            file.format
        );
        Ok(file)
    }

    /// Checks the path and works out every frame.
    ///
    /// # Errors
    /// Names the keyframe, what is wrong and what is accepted.
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
            ensure!(
                pair[0].frame < pair[1].frame,
                "keyframe {} is at frame {}, after one at frame {}; order them by frame, one per frame",
                i + 1,
                pair[1].frame,
                pair[0].frame
            );
        }
        let (mut cameras, mut transfers) = (Vec::new(), Vec::new());
        for (i, key) in self.keyframes.iter().enumerate() {
            let place = || format!("keyframe {i} (frame {})", key.frame);
            ensure!(key.frame < self.frames, "{}: the path has frames 0 to {}", place(), self.frames - 1);
            ensure!(
                key.camera.is_some() || key.transfer.is_some(),
                "{}: gives neither camera nor transfer; give one or remove it",
                place()
            );
            if let Some(pose) = key.camera {
                Camera::from_arcball(pose.arcball())
                    .and_then(|c| c.with_fov_y_degrees(self.fov_y_deg))
                    .with_context(place)?;
                cameras.push((key.frame, key.switch, pose));
            }
            if let Some(transfer) = &key.transfer {
                transfer.function().to_table().with_context(place)?;
                if let Some((frame, _, before)) = transfers.last() {
                    let before: &Transfer = before;
                    let ((kind_a, a), (kind_b, b)) = (before.size(), transfer.size());
                    ensure!(
                        key.switch || (kind_a == kind_b && a == b),
                        "{}: {a} {kind_a} of frame {frame} cannot be interpolated to {b} {kind_b}; give as many of the same kind, or \"switch\": true",
                        place()
                    );
                }
                transfers.push((key.frame, key.switch, transfer.clone()));
            }
        }
        let mut frames: Vec<PathFrame> = Vec::with_capacity(self.frames as usize);
        for index in 0..self.frames {
            let (camera, camera_switched) = at(&cameras, index, |a, b, t| a.mix(*b, t));
            let (transfer, transfer_switched) = at(&transfers, index, |a, b, t| a.mix(b, t));
            let transfer_changed = frames.last().is_none_or(|f| f.transfer != transfer);
            // A change from a frame to the next that no keyframe calls a switch is a drag.
            let real = |switched: bool| switched && index > 0;
            frames.push(PathFrame {
                camera: camera.arcball(),
                transfer,
                transfer_changed,
                transfer_switched: real(transfer_switched),
                camera_switched: real(camera_switched),
            });
        }
        Ok(FlightPath { name: self.name.clone(), fov_y_degrees: self.fov_y_deg, frames })
    }
}

/// The value of a track at a frame, and whether it switched there.
fn at<T: Clone>(track: &[(u32, bool, T)], index: u32, mix: impl Fn(&T, &T, f32) -> T) -> (T, bool) {
    let next = track.partition_point(|(frame, _, _)| *frame <= index);
    let (frame, switch, value) = &track[next - 1];
    if *frame == index {
        return (value.clone(), *switch);
    }
    match track.get(next) {
        Some((later, false, target)) => {
            (mix(value, target, (index - frame) as f32 / (later - frame) as f32), false)
        }
        _ => (value.clone(), false),
    }
}

impl FlightPath {
    /// Reads and checks a path file.
    ///
    /// # Errors
    /// Names the file and what is wrong in it.
    pub fn open(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the path {}", path.display()))?;
        let mut flight = PathFile::parse(&text)
            .and_then(|f| f.resolve())
            .with_context(|| format!("{} is no path", path.display()))?;
        if flight.name.is_empty() {
            flight.name = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        }
        Ok(flight)
    }

    /// Frames where something switched abruptly.
    pub fn switches(&self) -> Vec<usize> {
        (0..self.frames.len()).filter(|i| self.frames[*i].switched()).collect()
    }
}

/// Paths that are made to fit a volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Generated {
    /// An orbit with three abrupt transfer-function switches.
    Switches,
    /// One turn with one transfer function: a calm phase.
    Orbit,
    /// A slow orbit while a lobe is dragged over the scalar range and back.
    Drag,
    /// From afar into the volume and out again.
    FlyIn,
    /// Two switches of the camera and one of the transfer function.
    Cuts,
}

impl Generated {
    /// Its name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Switches => "switches",
            Self::Orbit => "orbit",
            Self::Drag => "drag",
            Self::FlyIn => "fly-in",
            Self::Cuts => "cuts",
        }
    }

    /// The path, `frames` long, with transfer functions set by the volume's value distribution. Every transfer
    /// function has three lobes.
    ///
    /// # Errors
    /// Fewer frames than 8.
    pub fn path(self, volume: &VolumeView<'_>, frames: u32) -> Result<PathFile> {
        ensure!(
            (8..=MAX_FRAMES).contains(&frames),
            "a generated path has 8 to {MAX_FRAMES} frames, not {frames}"
        );
        let values = Values::of(volume);
        let share = |p: u32| (u64::from(frames) * u64::from(p) / 100).min(u64::from(frames) - 1) as u32;
        let camera = |rx_deg, ry_deg, dz_radii| Some(CameraPose { rx_deg, ry_deg, dz_radii });
        let key = |p: u32, camera, transfer: Option<Transfer>, switch| Keyframe {
            frame: share(p),
            camera,
            transfer,
            switch,
        };
        let (shell, haze, core, layers) = (values.shell(), values.haze(), values.core(), values.layers());
        let keyframes = match self {
            Self::Switches => vec![
                key(0, camera(15.0, 0.0, 2.2), Some(shell), false),
                key(25, None, Some(haze), true),
                key(40, camera(30.0, 90.0, 1.7), None, false),
                key(50, None, Some(core), true),
                key(70, camera(5.0, 170.0, 2.0), None, false),
                key(75, None, Some(layers), true),
                key(100, camera(20.0, 260.0, 2.4), None, false),
            ],
            Self::Orbit => vec![
                key(0, camera(20.0, 0.0, 2.0), Some(layers), false),
                key(100, camera(20.0, 360.0, 2.0), None, false),
            ],
            Self::Drag => vec![
                key(0, camera(10.0, 0.0, 2.0), Some(core), false),
                key(50, None, Some(haze), false),
                key(100, camera(30.0, 120.0, 2.0), Some(shell), false),
            ],
            Self::FlyIn => vec![
                key(0, camera(20.0, 0.0, 4.0), Some(layers), false),
                key(60, camera(10.0, 60.0, 0.7), None, false),
                key(100, camera(25.0, 90.0, 3.0), None, false),
            ],
            Self::Cuts => vec![
                key(0, camera(10.0, 0.0, 3.5), Some(layers), false),
                key(25, camera(40.0, 120.0, 1.3), None, true),
                key(50, None, Some(shell), true),
                key(75, camera(5.0, 250.0, 2.5), None, true),
                key(100, camera(5.0, 300.0, 2.2), None, false),
            ],
        };
        Ok(PathFile {
            format: PATH_FORMAT.into(),
            name: self.name().into(),
            frames,
            fov_y_deg: DEFAULT_FOV_Y_DEGREES,
            keyframes,
        })
    }
}

/// The value distribution of a volume, background apart.
struct Values {
    sorted: Vec<f32>,
}

impl Values {
    /// From up to 100 000 voxels, evenly spread. Voxels at the low end of the range are taken for background where
    /// enough others are left.
    fn of(volume: &VolumeView<'_>) -> Self {
        let [nx, ny, nz] = volume.dims();
        let stride = (volume.voxels() / 100_000).max(1);
        // A stride that shares no factor with the rows walks through all of them.
        let stride = if stride.is_multiple_of(2) { stride + 1 } else { stride };
        let mut all: Vec<f32> = (0..volume.voxels())
            .step_by(stride as usize)
            .map(|i| {
                let (x, rest) = (i as usize % nx, i as usize / nx);
                volume.normalized(x, rest % ny, (rest / ny).min(nz - 1))
            })
            .filter(|v| v.is_finite())
            .collect();
        all.sort_by(f32::total_cmp);
        let above = all.partition_point(|v| *v <= 0.04);
        let sorted = if all.len() - above > all.len() / 200 { all.split_off(above) } else { all };
        Self { sorted }
    }

    fn quantile(&self, p: f64) -> f32 {
        match self.sorted.len() {
            0 => 0.5,
            n => self.sorted[((p * (n - 1) as f64).round() as usize).min(n - 1)],
        }
    }

    fn lobes(&self, lobes: [(f64, f32, f32); 3]) -> Transfer {
        Transfer::Lobes(
            lobes.map(|(p, width, height)| Lobe { center: self.quantile(p), width, height }).to_vec(),
        )
    }

    /// Surfaces of the denser half: rays end early.
    fn shell(&self) -> Transfer {
        self.lobes([(0.7, 0.004, 0.1), (0.85, 0.004, 0.15), (0.97, 0.01, 0.3)])
    }

    /// A thin haze over everything: rays go all the way.
    fn haze(&self) -> Transfer {
        self.lobes([(0.2, 0.01, 0.002), (0.5, 0.01, 0.003), (0.9, 0.005, 0.01)])
    }

    /// The highest values alone: much to skip.
    fn core(&self) -> Transfer {
        self.lobes([(0.985, 0.0008, 0.3), (0.993, 0.0008, 0.6), (0.999, 0.0015, 0.9)])
    }

    /// A translucent layer around a denser one.
    fn layers(&self) -> Transfer {
        self.lobes([(0.35, 0.002, 0.02), (0.65, 0.002, 0.03), (0.95, 0.003, 0.3)])
    }
}

/// Reads `33ms`, `0.033s`, `33000us`, `30fps` or `30hz` as seconds.
///
/// # Errors
/// Says what is accepted.
pub fn parse_target(text: &str) -> Result<f64> {
    let lower = text.trim().to_ascii_lowercase();
    let split = lower.find(|c: char| c.is_ascii_alphabetic() && c != 'e').unwrap_or(lower.len());
    let (number, unit) = lower.split_at(split);
    let accepted = "give a time like 33ms or 0.033s, or a rate like 30fps";
    let value: f64 =
        number.trim().parse().map_err(|_| anyhow!("target {text:?} has no number; {accepted}"))?;
    let seconds = match unit.trim() {
        "ms" => value * 1e-3,
        "s" => value,
        "us" | "µs" => value * 1e-6,
        "fps" | "hz" => 1.0 / value,
        _ => bail!("target {text:?} has no unit that is known; {accepted}"),
    };
    ensure!(
        seconds.is_finite() && seconds > 0.0 && value > 0.0,
        "target {text:?} is not a finite positive time; {accepted}"
    );
    Ok(seconds)
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::scene::Scalars;

    const GOOD: &str = r#"{
        "format": "entire-path-1", "frames": 11,
        "keyframes": [
            {"frame": 0, "camera": {"rx_deg": 0, "ry_deg": 0, "dz_radii": 4},
             "transfer": {"lobes": [{"center": 0.2, "width": 0.01, "height": 0.5}]}},
            {"frame": 4, "transfer": {"lobes": [{"center": 0.6, "width": 0.04, "height": 0.1}]}},
            {"frame": 6, "switch": true, "transfer": {"points": [{"position": 0.5, "color": [1, 0, 0], "opacity": 0.5}]}},
            {"frame": 10, "camera": {"rx_deg": 50, "ry_deg": -100, "dz_radii": 1}}
        ]}"#;

    fn good() -> FlightPath {
        PathFile::parse(GOOD).unwrap().resolve().unwrap()
    }

    #[test]
    fn tracks_interpolate_hold_and_switch() {
        let p = good();
        assert_eq!((p.frames.len(), p.fov_y_degrees), (11, 45.0));
        let camera = p.frames[5].camera;
        assert!(
            (camera.rx - 25.0).abs() < 1e-4
                && (camera.ry + 50.0).abs() < 1e-4
                && (camera.dz - 2.0).abs() < 1e-5
        );
        let Transfer::Lobes(lobes) = &p.frames[2].transfer else { panic!() };
        assert!((lobes[0].center - 0.4).abs() < 1e-6 && (lobes[0].width - 0.02).abs() < 1e-6);
        assert!((lobes[0].height - 0.3).abs() < 1e-6);
        // Held before the switch, new from its frame on.
        assert_eq!(p.frames[5].transfer, p.frames[4].transfer);
        assert!(matches!(p.frames[6].transfer, Transfer::Points(_)));
        assert_eq!(p.frames[10].transfer, p.frames[6].transfer);
        assert_eq!(p.switches(), [6]);
        let changed: Vec<usize> = (0..11).filter(|i| p.frames[*i].transfer_changed).collect();
        assert_eq!(changed, [0, 1, 2, 3, 4, 6]);
        assert!(!p.frames.iter().any(|f| f.camera_switched));
    }

    #[test]
    fn files_round_trip() {
        let file = PathFile::parse(GOOD).unwrap();
        let again = PathFile::parse(&serde_json::to_string_pretty(&file).unwrap()).unwrap();
        assert_eq!(file, again);
    }

    #[test]
    fn every_mistake_is_named() {
        let wrong = |from: &str, to: &str| {
            assert!(GOOD.contains(from), "{from}");
            let error = PathFile::parse(&GOOD.replacen(from, to, 1)).and_then(|f| f.resolve()).unwrap_err();
            format!("{error:#}")
        };
        for (from, to, expected) in [
            ("entire-path-1", "entire-path-9", "this version reads \"entire-path-1\""),
            ("\"frames\": 11", "\"frames\": 0", "frames is 0"),
            ("\"frames\": 11", "\"frames\": 9000000", "1 to 1000000"),
            ("\"frames\": 11", "\"frames\": 10", "keyframe 3 (frame 10): the path has frames 0 to 9"),
            ("\"frames\": 11", "\"frames\": \"x\"", "line 2"),
            ("\"frame\": 0", "\"frame\": 1", "first keyframe must be at frame 0"),
            ("\"frame\": 6", "\"frame\": 4", "order them by frame"),
            ("\"switch\": true, ", "", "cannot be interpolated to 1 points"),
            ("\"dz_radii\": 4", "\"dz_radii\": 0", "keyframe 0 (frame 0): camera distance is 0"),
            ("\"dz_radii\": 4", "\"dz\": 4", "unknown field `dz`"),
            ("\"width\": 0.01", "\"width\": 0", "width is 0"),
            ("\"opacity\": 0.5", "\"opacity\": 1.5", "opacity must lie in [0, 1]"),
            ("\"lobes\"", "\"spheres\"", "unknown variant `spheres`"),
            (
                "{\"frame\": 10, \"camera\": {\"rx_deg\": 50, \"ry_deg\": -100, \"dz_radii\": 1}}",
                "{\"frame\": 10}",
                "neither camera nor transfer",
            ),
            ("\"frames\": 11,", "\"frames\": 11, \"fov_y_deg\": 200,", "field of view is 200"),
            ("\"frames\": 11,", "\"frames\": 11, \"speed\": 2,", "unknown field `speed`"),
        ] {
            let message = wrong(from, to);
            assert!(message.contains(expected), "{to}: {message}");
        }
        let cut = PathFile::parse(&GOOD[..GOOD.len() - 4]).unwrap_err().to_string();
        assert!(cut.contains("line 9"), "{cut}");
        let empty = r#"{"format": "entire-path-1", "frames": 3, "keyframes": []}"#;
        assert!(PathFile::parse(empty).unwrap().resolve().unwrap_err().to_string().contains("no keyframe"));
        let missing = FlightPath::open(Path::new("/no/such/path.json")).unwrap_err().to_string();
        assert!(missing.contains("cannot read the path"), "{missing}");
    }

    #[test]
    fn generated_paths_fit_any_volume() {
        let ramp: Vec<u8> = (0..1000u32).map(|i| (i / 4) as u8).collect();
        let constant = [7u8; 1000];
        for data in [&ramp[..], &constant[..]] {
            let view = VolumeView::new(Scalars::U8(data), [10, 10, 10]).unwrap();
            for kind in
                [Generated::Switches, Generated::Orbit, Generated::Drag, Generated::FlyIn, Generated::Cuts]
            {
                for frames in [8, 120] {
                    let file = kind.path(&view, frames).unwrap();
                    let path = file.resolve().unwrap();
                    assert_eq!(path.frames.len(), frames as usize);
                    let switches = match kind {
                        Generated::Switches | Generated::Cuts => 3,
                        _ => 0,
                    };
                    assert_eq!(path.switches().len(), switches, "{}", kind.name());
                    assert!(path.frames.iter().all(|f| f.transfer.lobes().unwrap().len() == 3));
                }
                assert!(kind.path(&view, 7).is_err());
            }
        }
    }

    #[test]
    fn targets_are_times_or_rates() {
        for (text, seconds) in [
            ("33ms", 0.033),
            ("0.5 s", 0.5),
            ("500us", 5e-4),
            ("40fps", 0.025),
            ("25 Hz", 0.04),
            ("1e-2s", 0.01),
        ] {
            assert!((parse_target(text).unwrap() - seconds).abs() < 1e-12, "{text}");
        }
        for text in ["", "33", "ms", "-3ms", "0fps", "0ms", "nan s", "3 parsecs", "inf s"] {
            assert!(parse_target(text).is_err(), "{text}");
        }
    }
}
