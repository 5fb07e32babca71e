//! Frame timings on disk: one CSV row per repeat of a frame, a JSON manifest beside it, and the frames that come back
//! when repeats are grouped.
//!
//! Columns, in this order (see [`COLUMNS`]): the frame and repeat numbers; the volume's path, its ensemble member, time
//! step and size; the camera (arcball degrees, distance in bounding-sphere radii, vertical field of view in degrees);
//! the image size in pixels; the ray step in reference steps; the shading and skipping modes, the opacity at which rays
//! stop; the transfer function's Gaussian lobes as `c w h` joined by `;`; seconds by each clock; and work counts. An
//! empty field means "not measured".

use crate::feature_table::{FeatureTable, read_bytes, stem};
use anyhow::{Context, Result, anyhow, bail, ensure};
use entire_core::scene::{
    Arcball, Camera, Frame, GaussianLobe, Shading, Skipping, TransferFunction, TransferTable,
};
use entire_vk_raycaster::{FrameTime, WorkCounts};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap, HashSet};
use std::fmt::Write as _;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// The columns of a timing table, in file order. Units are part of the names.
pub const COLUMNS: [&str; 26] = [
    "frame",
    "repeat",
    "volume",
    "member",
    "time_step",
    "dims_x",
    "dims_y",
    "dims_z",
    "camera_rx_deg",
    "camera_ry_deg",
    "camera_dz_radii",
    "fov_y_deg",
    "width_px",
    "height_px",
    "step_ref",
    "shading",
    "skipping",
    "termination",
    "tf",
    "seconds_device",
    "seconds_wall",
    "seconds_cpu",
    "samples",
    "skips",
    "rays",
    "shaded",
];

/// The manifest's `format` value.
pub const MANIFEST_FORMAT: &str = "entire-timings-1";

/// What a frame shows: everything that is known before it is drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The volume file, as the collector was given it.
    pub volume: String,
    /// The ensemble member (or any other name of a group of related volumes). Empty when there is none.
    pub member: String,
    /// The time step within the member, where there is one.
    pub time_step: Option<u32>,
    /// Voxels along x, y, z.
    pub dims: [u32; 3],
    /// Camera angles in degrees and distance in bounding-sphere radii.
    pub camera: Arcball,
    /// Vertical field of view, degrees.
    pub fov_y_degrees: f32,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Ray step in reference steps.
    pub step: f32,
    /// What each sample computes.
    pub shading: Shading,
    /// How empty space is skipped.
    pub skipping: Skipping,
    /// Accumulated opacity at which a ray stops.
    pub termination: f32,
    /// The transfer function's lobes.
    pub lobes: Vec<GaussianLobe>,
}

impl Scene {
    /// The frame that a renderer draws.
    ///
    /// # Errors
    /// When a value lies outside what the core accepts; the message is the core's.
    pub fn to_frame(&self) -> Result<Frame> {
        let camera = Camera::from_arcball(self.camera)?.with_fov_y_degrees(self.fov_y_degrees)?;
        Ok(Frame::new(camera, self.width, self.height)?
            .with_step(self.step)?
            .with_termination(self.termination)?
            .with_shading(self.shading)
            .with_skipping(self.skipping))
    }

    /// The transfer function.
    pub fn transfer_function(&self) -> TransferFunction {
        TransferFunction::Gaussian(self.lobes.clone())
    }

    /// The transfer function's table.
    ///
    /// # Errors
    /// When a lobe is refused by the core.
    pub fn to_table(&self) -> Result<TransferTable> {
        Ok(self.transfer_function().to_table()?)
    }

    fn check(&self) -> Result<()> {
        for (name, text) in [("volume", &self.volume), ("member", &self.member)] {
            ensure!(
                !text.chars().any(char::is_control),
                "{name} {text:?} holds a line break or another control character; rename it"
            );
        }
        ensure!(!self.volume.is_empty(), "the volume's name is empty; give the file's path");
        ensure!(self.dims.iter().all(|&n| n > 0), "volume size {:?} holds a 0", self.dims);
        self.to_frame()?;
        self.to_table()?;
        Ok(())
    }
}

/// One repeat of a frame: the seconds by each clock that there was, and what was counted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measurement {
    /// Between device timestamps, seconds.
    pub device: Option<f64>,
    /// From submission to completion on the host, seconds.
    pub wall: Option<f64>,
    /// CPU time of the process, all threads, seconds.
    pub cpu: Option<f64>,
    /// What the frame did, where the renderer counted.
    pub counts: Option<WorkCounts>,
}

impl Measurement {
    /// From what a renderer returned.
    pub fn new(time: FrameTime, counts: Option<WorkCounts>) -> Self {
        Self { device: time.device, wall: Some(time.wall), cpu: time.cpu, counts }
    }

    /// The seconds by a clock, or `None` where it was not read.
    pub fn seconds(&self, clock: Clock) -> Option<f64> {
        match clock {
            Clock::Auto => self.device.or(self.wall),
            Clock::Device => self.device,
            Clock::Wall => self.wall,
            Clock::Cpu => self.cpu,
        }
    }

    fn check(&self) -> Result<()> {
        for (name, value) in
            [("seconds_device", self.device), ("seconds_wall", self.wall), ("seconds_cpu", self.cpu)]
        {
            if let Some(v) = value {
                ensure!(v.is_finite() && v >= 0.0, "{name} is {v}; seconds must be finite and not negative");
            }
        }
        ensure!(
            self.device.is_some() || self.wall.is_some() || self.cpu.is_some(),
            "no clock was read; at least one of seconds_device, seconds_wall, seconds_cpu is needed"
        );
        Ok(())
    }
}

/// Which clock counts as a frame's time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Clock {
    /// The device's timestamps where there are any, else wall time.
    #[default]
    Auto,
    /// Device timestamps.
    Device,
    /// Wall time on the host.
    Wall,
    /// Process CPU time, all threads.
    Cpu,
}

impl Clock {
    /// The name used in options and metadata.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Device => "device",
            Self::Wall => "wall",
            Self::Cpu => "cpu",
        }
    }
}

/// A frame with all its repeats.
#[derive(Clone, Debug, PartialEq)]
pub struct TimedFrame {
    /// Which of the loaded tables it comes from.
    pub table: usize,
    /// Its number in that table.
    pub number: u64,
    /// What it shows.
    pub scene: Scene,
    /// Every repeat, in file order.
    pub repeats: Vec<Measurement>,
}

impl TimedFrame {
    /// A frame of a volume that no file needs to hold, never timed.
    #[cfg(test)]
    pub(crate) fn of_no_volume(volume: &str, member: &str) -> Self {
        let scene = Scene {
            volume: volume.into(),
            member: member.into(),
            time_step: None,
            dims: [8; 3],
            camera: Arcball { rx: 1.0, ry: 2.0, dz: 3.0 },
            fov_y_degrees: 45.0,
            width: 64,
            height: 64,
            step: 1.0,
            shading: Shading::None,
            skipping: Skipping::Blocks,
            termination: 0.99,
            lobes: parse_lobes("0.5 0.1 1").expect("a lobe"),
        };
        Self { table: 0, number: 0, scene, repeats: Vec::new() }
    }

    /// Median of the repeats by a clock (mean of the middle two where their number is even), over the repeats that have
    /// it and are longer than zero; `None` when there are none.
    pub fn seconds(&self, clock: Clock) -> Option<f64> {
        let mut seconds: Vec<f64> =
            self.repeats.iter().filter_map(|r| r.seconds(clock)).filter(|&t| t > 0.0).collect();
        median(&mut seconds)
    }

    /// The counts, where any repeat was counted.
    pub fn counts(&self) -> Option<WorkCounts> {
        self.repeats.iter().find_map(|r| r.counts)
    }
}

/// Median of some numbers, the mean of the middle two where their number is even; reorders them. `None` when empty.
pub fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    values.sort_by(f64::total_cmp);
    let mid = values.len() / 2;
    Some(if values.len() % 2 == 1 { values[mid] } else { 0.5 * (values[mid - 1] + values[mid]) })
}

/// How far repeats of one frame scatter: the floor under every predictor's error.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct NoiseFloor {
    /// Standard deviation of ln(seconds) of a single repeat about its frame's mean, pooled over frames with
    /// n − 1 degrees of freedom each.
    pub log_sd: f64,
    /// The same for the median of each frame's repeats, taking its standard error as sqrt(π/2) times the mean's for
    /// three repeats or more, and the mean's for two.
    pub log_sd_of_median: f64,
    /// Median over repeats of |t − frame median| / frame median.
    pub median_relative_deviation: f64,
    /// Frames with at least two repeats.
    pub frames: usize,
}

/// The repeat-to-repeat noise by a clock, or `None` when no frame was repeated.
pub fn noise_floor<'a>(frames: impl IntoIterator<Item = &'a TimedFrame>, clock: Clock) -> Option<NoiseFloor> {
    let (mut squares, mut freedom, mut count) = (0.0, 0usize, 0usize);
    let mut inverse_repeats = 0.0;
    let mut deviations = Vec::new();
    for frame in frames {
        let seconds: Vec<f64> =
            frame.repeats.iter().filter_map(|r| r.seconds(clock)).filter(|&t| t > 0.0).collect();
        if seconds.len() < 2 {
            continue;
        }
        let n = seconds.len() as f64;
        let mean = seconds.iter().map(|t| t.ln()).sum::<f64>() / n;
        squares += seconds.iter().map(|t| (t.ln() - mean).powi(2)).sum::<f64>();
        freedom += seconds.len() - 1;
        count += 1;
        inverse_repeats += if seconds.len() > 2 { std::f64::consts::FRAC_PI_2 / n } else { 1.0 / n };
        let mid = median(&mut seconds.clone())?;
        deviations.extend(seconds.iter().map(|t| (t - mid).abs() / mid));
    }
    if freedom == 0 {
        return None;
    }
    let log_sd = (squares / freedom as f64).sqrt();
    Some(NoiseFloor {
        log_sd,
        log_sd_of_median: log_sd * (inverse_repeats / count as f64).sqrt(),
        median_relative_deviation: median(&mut deviations)?,
        frames: count,
    })
}

/// What was measured, with what and how. Written beside the table as `NAME.manifest.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`MANIFEST_FORMAT`].
    pub format: String,
    /// When collection started, UTC, ISO 8601.
    pub created: String,
    /// Host name, CPU model, logical CPUs, operating system.
    pub machine: String,
    /// `vulkan` or `cpu`.
    pub renderer: String,
    /// The device that rendered.
    pub device: String,
    /// Its driver with version; empty where there is none.
    #[serde(default)]
    pub driver: String,
    /// The program's version and, where known, commit.
    pub commit: String,
    /// The seed of every random choice.
    pub seed: u64,
    /// Repeats per frame.
    pub repeats: u32,
    /// What one reference step is.
    pub step_reference: String,
    /// Everything else that the collector was told, free form.
    #[serde(default)]
    pub settings: serde_json::Value,
    /// Keys that this version does not know, kept as they are.
    #[serde(flatten)]
    pub other: BTreeMap<String, serde_json::Value>,
}

impl Manifest {
    /// The manifest's path beside a table: `NAME.csv` or `NAME.csv.gz` → `NAME.manifest.json`.
    pub fn path_for(table: &Path) -> PathBuf {
        let mut name = stem(table).into_os_string();
        name.push(".manifest.json");
        name.into()
    }

    /// Writes the manifest beside `table`, whole or not at all.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, table: &Path) -> Result<()> {
        let path = Self::path_for(table);
        let mut text = serde_json::to_string_pretty(self)?;
        text.push('\n');
        let part = path.with_extension("json.part");
        std::fs::write(&part, text).with_context(|| format!("cannot write {}", part.display()))?;
        std::fs::rename(&part, &path).with_context(|| format!("cannot write {}", path.display()))
    }

    /// Reads the manifest beside `table`; `None` when there is none.
    ///
    /// # Errors
    /// When it exists but is no manifest that this version reads.
    pub fn read(table: &Path) -> Result<Option<Self>> {
        let path = Self::path_for(table);
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(e).with_context(|| format!("cannot read {}", path.display())),
        };
        let manifest: Self =
            serde_json::from_str(&text).with_context(|| format!("{} is no manifest", path.display()))?;
        ensure!(
            manifest.format == MANIFEST_FORMAT,
            "{} has format {:?}; this version reads {MANIFEST_FORMAT:?}",
            path.display(),
            manifest.format
        );
        Ok(Some(manifest))
    }
}

/// A timing table in memory, repeats grouped into frames.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// Where it was read from.
    pub path: PathBuf,
    /// Its manifest, where there is one.
    pub manifest: Option<Manifest>,
    /// Its frames, in the order in which they first appear.
    pub frames: Vec<TimedFrame>,
    /// FNV-1a hash of the CSV's bytes, unfolded.
    pub hash: u64,
    /// What was computed about its frames, where that is kept beside it.
    pub features: Option<FeatureTable>,
    /// Where its volume names start from, where it is neither the working folder nor the table's.
    pub root: Option<PathBuf>,
}

/// 64-bit FNV-1a.
pub fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |h, &b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3))
}

impl Table {
    /// Reads a table, its manifest and its features. `index` is stored in each frame's `table`. Names that end in `.gz`
    /// are unfolded.
    ///
    /// # Errors
    /// When a file cannot be read, a column is missing, or a row holds something that it may not; the message names
    /// file, line and column.
    pub fn read(path: &Path, index: usize) -> Result<Self> {
        let mut table = Self::read_without_features(path, index)?;
        table.features = FeatureTable::beside(path, &table.frames, table.hash)?;
        Ok(table)
    }

    /// As [`Table::read`], passing over features kept beside the table.
    ///
    /// # Errors
    /// As [`Table::read`].
    pub fn read_without_features(path: &Path, index: usize) -> Result<Self> {
        let bytes = read_bytes(path).with_context(|| {
            let remedy =
                if path.exists() { "" } else { "; make a table with `entire collect VOLUME --out FILE.csv`" };
            format!("cannot read {}{remedy}", path.display())
        })?;
        let frames =
            parse(&bytes, index).with_context(|| format!("{} is no timing table", path.display()))?;
        Ok(Self {
            path: path.to_owned(),
            manifest: Manifest::read(path)?,
            frames,
            hash: fnv1a(&bytes),
            features: None,
            root: None,
        })
    }

    /// Finds a frame's volume file: the name below the root where one is set, the name as it stands, else relative to
    /// the table's folder.
    pub fn resolve_volume(&self, name: &str) -> Option<PathBuf> {
        if let Some(below) = self.root.as_ref().map(|r| r.join(name)).filter(|p| p.exists()) {
            return Some(below);
        }
        let as_is = PathBuf::from(name);
        if as_is.exists() {
            return Some(as_is);
        }
        let beside = self.path.parent().unwrap_or(Path::new("")).join(name);
        beside.exists().then_some(beside)
    }
}

/// Reads several tables.
///
/// # Errors
/// As [`Table::read`]; also when they hold no frame at all.
pub fn read_tables(paths: &[PathBuf]) -> Result<Vec<Table>> {
    let tables: Vec<Table> =
        paths.iter().enumerate().map(|(i, p)| Table::read(p, i)).collect::<Result<_>>()?;
    ensure!(
        tables.iter().any(|t| !t.frames.is_empty()),
        "no frames in {}; collect some with `entire collect`",
        paths.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", ")
    );
    Ok(tables)
}

fn parse(bytes: &[u8], table: usize) -> Result<Vec<TimedFrame>> {
    let mut reader = csv::ReaderBuilder::new().from_reader(bytes);
    let headers = reader.headers().context("the header line cannot be read")?.clone();
    let mut at = [0usize; COLUMNS.len()];
    for (slot, name) in at.iter_mut().zip(COLUMNS) {
        *slot = headers.iter().position(|h| h.trim() == name).ok_or_else(|| {
            anyhow!("column {name:?} is missing; the first line must name {}", COLUMNS.join(","))
        })?;
    }
    let mut frames: Vec<TimedFrame> = Vec::new();
    let mut by_number: HashMap<u64, usize> = HashMap::new();
    let mut seen: HashSet<(u64, u32)> = HashSet::new();
    for record in reader.records() {
        let record = record.map_err(|e| match e.position() {
            Some(p) => anyhow!("line {}: {}", p.line(), describe(&e)),
            None => anyhow!("{e}"),
        })?;
        let line = record.position().map_or(0, csv::Position::line);
        let row = Row { record: &record, at: &at };
        let (number, repeat, scene, measurement) = row.read().with_context(|| format!("line {line}"))?;
        ensure!(
            seen.insert((number, repeat)),
            "line {line}: frame {number}, repeat {repeat} stands there twice; remove one"
        );
        match by_number.get(&number) {
            Some(&i) => {
                ensure!(
                    frames[i].scene == scene,
                    "line {line}: repeat {repeat} of frame {number} shows another scene than its earlier rows; give it another frame number"
                );
                frames[i].repeats.push(measurement);
            }
            None => {
                by_number.insert(number, frames.len());
                frames.push(TimedFrame { table, number, scene, repeats: vec![measurement] });
            }
        }
    }
    Ok(frames)
}

fn describe(error: &csv::Error) -> String {
    match error.kind() {
        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
            format!("{len} fields found, {expected_len} expected; is the line cut off?")
        }
        csv::ErrorKind::Utf8 { .. } => "the text is not UTF-8".into(),
        other => format!("{other:?}"),
    }
}

struct Row<'a> {
    record: &'a csv::StringRecord,
    at: &'a [usize; COLUMNS.len()],
}

impl Row<'_> {
    fn text(&self, name: &'static str) -> &str {
        let column = COLUMNS.iter().position(|c| *c == name).unwrap_or(0);
        self.record.get(self.at[column]).unwrap_or("").trim()
    }

    fn number<T: std::str::FromStr>(&self, name: &'static str, accepted: &str) -> Result<T> {
        let text = self.text(name);
        text.parse().map_err(|_| anyhow!("column {name} is {text:?}; {accepted} is expected"))
    }

    fn optional<T: std::str::FromStr>(&self, name: &'static str, accepted: &str) -> Result<Option<T>> {
        if self.text(name).is_empty() { Ok(None) } else { self.number(name, accepted).map(Some) }
    }

    fn read(&self) -> Result<(u64, u32, Scene, Measurement)> {
        const WHOLE: &str = "a whole number";
        const NUMBER: &str = "a number";
        const OR_EMPTY: &str = "a number or nothing";
        let scene = Scene {
            volume: self.text("volume").to_owned(),
            member: self.text("member").to_owned(),
            time_step: self.optional("time_step", "a whole number or nothing")?,
            dims: [
                self.number("dims_x", WHOLE)?,
                self.number("dims_y", WHOLE)?,
                self.number("dims_z", WHOLE)?,
            ],
            camera: Arcball {
                rx: self.number("camera_rx_deg", NUMBER)?,
                ry: self.number("camera_ry_deg", NUMBER)?,
                dz: self.number("camera_dz_radii", NUMBER)?,
            },
            fov_y_degrees: self.number("fov_y_deg", NUMBER)?,
            width: self.number("width_px", WHOLE)?,
            height: self.number("height_px", WHOLE)?,
            step: self.number("step_ref", NUMBER)?,
            shading: parse_shading(self.text("shading")).context("column shading")?,
            skipping: parse_skipping(self.text("skipping")).context("column skipping")?,
            termination: self.number("termination", NUMBER)?,
            lobes: parse_lobes(self.text("tf")).context("column tf")?,
        };
        scene.check()?;
        let samples = self.optional("samples", OR_EMPTY)?;
        let counts = match samples {
            Some(samples) => Some(WorkCounts {
                samples,
                skips: self.optional("skips", OR_EMPTY)?.unwrap_or(0),
                rays: self.optional("rays", OR_EMPTY)?.unwrap_or(0),
                shaded: self.optional("shaded", OR_EMPTY)?.unwrap_or(0),
            }),
            None => None,
        };
        let measurement = Measurement {
            device: self.optional("seconds_device", OR_EMPTY)?,
            wall: self.optional("seconds_wall", OR_EMPTY)?,
            cpu: self.optional("seconds_cpu", OR_EMPTY)?,
            counts,
        };
        measurement.check()?;
        Ok((self.number("frame", WHOLE)?, self.number("repeat", WHOLE)?, scene, measurement))
    }
}

/// Reads a shading mode's name.
///
/// # Errors
/// For any other name; lists the accepted ones.
pub fn parse_shading(name: &str) -> Result<Shading> {
    [Shading::None, Shading::Local, Shading::Scatter]
        .into_iter()
        .find(|s| s.name() == name)
        .ok_or_else(|| anyhow!("shading is {name:?}; none, local or scatter is expected"))
}

/// Reads a skipping mode's name.
///
/// # Errors
/// For any other name; lists the accepted ones.
pub fn parse_skipping(name: &str) -> Result<Skipping> {
    [Skipping::None, Skipping::Blocks, Skipping::Distance]
        .into_iter()
        .find(|s| s.name() == name)
        .ok_or_else(|| anyhow!("skipping is {name:?}; none, blocks or distance is expected"))
}

/// Reads Gaussian lobes from `c w h;c w h;…`. An empty text is no lobe.
///
/// # Errors
/// When a lobe has another number of parts than three, or one is no number.
pub fn parse_lobes(text: &str) -> Result<Vec<GaussianLobe>> {
    text.split(';')
        .map(str::trim)
        .filter(|lobe| !lobe.is_empty())
        .enumerate()
        .map(|(i, lobe)| {
            let parts: Vec<f32> = lobe
                .split_whitespace()
                .map(|p| p.parse().map_err(|_| anyhow!("lobe {i}: {p:?} is no number")))
                .collect::<Result<_>>()?;
            let [center, width, height] = parts[..] else {
                bail!("lobe {i} is {lobe:?}; three numbers are expected: centre, width, height");
            };
            Ok(GaussianLobe { center, width, height })
        })
        .collect()
}

/// Writes Gaussian lobes so that [`parse_lobes`] gives back the same bits.
pub fn format_lobes(lobes: &[GaussianLobe]) -> String {
    let mut text = String::new();
    for (i, l) in lobes.iter().enumerate() {
        let separator = if i == 0 { "" } else { ";" };
        let _ = write!(text, "{separator}{} {} {}", l.center, l.width, l.height);
    }
    text
}

/// Appends frames to a timing table. Each frame goes out in one piece and is flushed to disk, so that a crash loses at
/// most the frame in flight.
#[derive(Debug)]
pub struct Writer {
    file: File,
    path: PathBuf,
    done: HashSet<u64>,
}

impl Writer {
    /// Starts a new table.
    ///
    /// # Errors
    /// When the file exists already (resume it or remove it) or cannot be written.
    pub fn create(path: &Path) -> Result<Self> {
        let mut file = OpenOptions::new().write(true).create_new(true).open(path).map_err(|e| {
            if e.kind() == std::io::ErrorKind::AlreadyExists {
                anyhow!("{} exists already; resume it, remove it or choose another name", path.display())
            } else {
                anyhow!("cannot write {}: {e}", path.display())
            }
        })?;
        file.write_all(format!("{}\n", COLUMNS.join(",")).as_bytes())
            .and_then(|()| file.sync_data())
            .with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self { file, path: path.to_owned(), done: HashSet::new() })
    }

    /// Goes on with a table (or starts it where there is none). A last line that was cut off, and a last frame with
    /// fewer than `repeats` repeats, are removed.
    ///
    /// # Errors
    /// When the file is no timing table, has its columns in another order, or cannot be written.
    pub fn resume(path: &Path, repeats: u32) -> Result<Self> {
        if !path.exists() {
            return Self::create(path);
        }
        let fail = || format!("cannot resume {}", path.display());
        let mut file = OpenOptions::new().read(true).write(true).open(path).with_context(fail)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).with_context(fail)?;
        let header = format!("{}\n", COLUMNS.join(","));
        if header.as_bytes().starts_with(&bytes) && bytes.len() < header.len() {
            // Cut off within its header: nothing is lost.
            drop(file);
            std::fs::remove_file(path).with_context(fail)?;
            return Self::create(path);
        }
        ensure!(
            bytes.starts_with(header.as_bytes()),
            "cannot resume {}: its first line is not {}; is it a timing table?",
            path.display(),
            header.trim_end()
        );
        let mut end = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
        let mut frames = parse(&bytes[..end], 0).with_context(fail)?;
        if frames.last().is_some_and(|f| f.repeats.len() < repeats as usize) {
            let partial = frames.pop().map_or(0, |f| f.repeats.len());
            for _ in 0..partial {
                end = bytes[..end - 1].iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
            }
        }
        file.set_len(end as u64).and_then(|()| file.seek(SeekFrom::End(0))).with_context(fail)?;
        Ok(Self { file, path: path.to_owned(), done: frames.iter().map(|f| f.number).collect() })
    }

    /// Numbers of the frames that are in the table.
    pub fn done(&self) -> &HashSet<u64> {
        &self.done
    }

    /// Appends a frame with all its repeats, numbered from 0.
    ///
    /// # Errors
    /// When the scene or a measurement is not valid, the frame is there already, or the disk refuses.
    pub fn append(&mut self, number: u64, scene: &Scene, repeats: &[Measurement]) -> Result<()> {
        scene.check().with_context(|| format!("frame {number}"))?;
        ensure!(!repeats.is_empty(), "frame {number} has no repeat");
        ensure!(!self.done.contains(&number), "frame {number} is in {} already", self.path.display());
        let lobes = format_lobes(&scene.lobes);
        let mut out = csv::WriterBuilder::new().from_writer(Vec::new());
        for (repeat, m) in repeats.iter().enumerate() {
            m.check().with_context(|| format!("frame {number}, repeat {repeat}"))?;
            let seconds = |t: Option<f64>| t.map_or(String::new(), |t| t.to_string());
            let count =
                |f: fn(&WorkCounts) -> u64| m.counts.as_ref().map_or(String::new(), |c| f(c).to_string());
            let fields: [String; COLUMNS.len()] = [
                number.to_string(),
                repeat.to_string(),
                scene.volume.clone(),
                scene.member.clone(),
                scene.time_step.map_or(String::new(), |t| t.to_string()),
                scene.dims[0].to_string(),
                scene.dims[1].to_string(),
                scene.dims[2].to_string(),
                scene.camera.rx.to_string(),
                scene.camera.ry.to_string(),
                scene.camera.dz.to_string(),
                scene.fov_y_degrees.to_string(),
                scene.width.to_string(),
                scene.height.to_string(),
                scene.step.to_string(),
                scene.shading.name().to_owned(),
                scene.skipping.name().to_owned(),
                scene.termination.to_string(),
                lobes.clone(),
                seconds(m.device),
                seconds(m.wall),
                seconds(m.cpu),
                count(|c| c.samples),
                count(|c| c.skips),
                count(|c| c.rays),
                count(|c| c.shaded),
            ];
            out.write_record(&fields)?;
        }
        let bytes = out.into_inner().map_err(|e| anyhow!("{e}"))?;
        self.file
            .write_all(&bytes)
            .and_then(|()| self.file.sync_data())
            .with_context(|| format!("cannot write {}", self.path.display()))?;
        self.done.insert(number);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn scene() -> Scene {
        Scene {
            volume: "data/a, \"b\".nrrd".into(),
            member: "m01".into(),
            time_step: Some(3),
            dims: [96, 64, 1],
            camera: Arcball { rx: -12.345_678, ry: 170.0, dz: 1.75 },
            fov_y_degrees: 45.0,
            width: 320,
            height: 200,
            step: 1.5,
            shading: Shading::Local,
            skipping: Skipping::Distance,
            termination: 0.99,
            lobes: vec![
                GaussianLobe { center: 0.1, width: 0.003, height: 0.9 },
                GaussianLobe { center: 1.0 / 3.0, width: 1e-5, height: 0.0 },
            ],
        }
    }

    fn measured(wall: f64) -> Measurement {
        let counts = Some(WorkCounts { rays: 7, samples: u64::from(u32::MAX) * 9, skips: 0, shaded: 2 });
        Measurement { device: None, wall: Some(wall), cpu: Some(wall * 1.7), counts }
    }

    fn folder() -> tempfile::TempDir {
        tempfile::tempdir().unwrap()
    }

    #[test]
    fn a_written_table_reads_back_bit_for_bit() {
        let dir = folder();
        let path = dir.path().join("t.csv");
        let mut writer = Writer::create(&path).unwrap();
        writer.append(4, &scene(), &[measured(0.1), measured(0.3), measured(0.2)]).unwrap();
        let bare = Scene { member: String::new(), time_step: None, lobes: vec![], ..scene() };
        let lone = Measurement { device: Some(1e-7), ..Measurement::default() };
        writer.append(9, &bare, &[lone]).unwrap();
        let table = Table::read(&path, 2).unwrap();
        assert_eq!(table.frames.len(), 2);
        assert_eq!((table.frames[0].number, table.frames[0].table), (4, 2));
        assert_eq!(table.frames[0].scene, scene());
        assert_eq!(table.frames[0].repeats, [measured(0.1), measured(0.3), measured(0.2)]);
        assert_eq!(table.frames[1].scene, bare);
        assert_eq!(table.frames[1].repeats, [lone]);
        assert_eq!(table.frames[0].seconds(Clock::Auto), Some(0.2));
        assert_eq!(table.frames[0].seconds(Clock::Cpu), Some(0.2 * 1.7));
        assert_eq!(table.frames[0].seconds(Clock::Device), None);
        assert_eq!(table.frames[1].seconds(Clock::Auto), Some(1e-7));
        assert!(writer.append(9, &bare, &[lone]).unwrap_err().to_string().contains("already"));
        assert!(Writer::create(&path).unwrap_err().to_string().contains("resume"));
    }

    proptest! {
        #[test]
        fn lobes_survive_text(values in prop::collection::vec((any::<f32>(), any::<f32>(), any::<f32>()), 0..6)) {
            prop_assume!(values.iter().all(|(a, b, c)| a.is_finite() && b.is_finite() && c.is_finite()));
            let lobes: Vec<_> = values.iter()
                .map(|&(center, width, height)| GaussianLobe { center, width, height }).collect();
            prop_assert_eq!(parse_lobes(&format_lobes(&lobes)).unwrap(), lobes);
        }

        #[test]
        fn any_bytes_are_an_error_and_never_a_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            let _ = parse(&bytes, 0);
            let mut with_header = format!("{}\n", COLUMNS.join(",")).into_bytes();
            with_header.extend(bytes);
            let _ = parse(&with_header, 0);
        }
    }

    #[test]
    fn resuming_repairs_any_cut_and_keeps_whole_frames() {
        let dir = folder();
        let path = dir.path().join("t.csv");
        let mut writer = Writer::create(&path).unwrap();
        for n in 0..3 {
            writer.append(n, &scene(), &[measured(0.1), measured(0.2)]).unwrap();
        }
        drop(writer);
        let whole = std::fs::read(&path).unwrap();
        let frame_ends: Vec<usize> =
            whole.iter().enumerate().filter(|(_, b)| **b == b'\n').map(|(i, _)| i + 1).step_by(2).collect();
        for cut in 0..=whole.len() {
            std::fs::write(&path, &whole[..cut]).unwrap();
            let mut writer = Writer::resume(&path, 2).unwrap();
            let kept = frame_ends.iter().filter(|e| **e <= cut).count().saturating_sub(1);
            assert_eq!(writer.done().len(), kept, "cut at {cut}");
            for n in kept as u64..3 {
                writer.append(n, &scene(), &[measured(0.1), measured(0.2)]).unwrap();
            }
            drop(writer);
            assert_eq!(std::fs::read(&path).unwrap(), whole, "cut at {cut}");
        }
        std::fs::write(&path, "something else\n").unwrap();
        assert!(Writer::resume(&path, 2).unwrap_err().to_string().contains("first line"));
    }

    #[test]
    fn every_wrong_field_is_named_with_its_line_and_column() {
        let dir = folder();
        let path = dir.path().join("t.csv");
        let plain = Scene { volume: "v.nrrd".into(), ..scene() };
        Writer::create(&path).unwrap().append(0, &plain, &[measured(0.1)]).unwrap();
        let good = std::fs::read_to_string(&path).unwrap();
        let line: Vec<String> = good.lines().nth(1).unwrap().split(',').map(str::to_owned).collect();
        let with = |column: &str, value: &str| {
            let mut fields = line.clone();
            fields[COLUMNS.iter().position(|c| *c == column).unwrap()] = value.to_owned();
            let text = format!("{}\n{}\n", COLUMNS.join(","), fields.join(","));
            std::fs::write(&path, text).unwrap();
            format!("{:#}", Table::read(&path, 0).unwrap_err())
        };
        for (column, value, expected) in [
            ("frame", "x", "column frame is \"x\""),
            ("repeat", "-1", "column repeat"),
            ("volume", "", "volume's name is empty"),
            ("dims_y", "0", "holds a 0"),
            ("dims_z", "1.5", "column dims_z"),
            ("camera_rx_deg", "NaN", "finite degrees"),
            ("camera_dz_radii", "0", "camera distance is 0"),
            ("fov_y_deg", "200", "field of view"),
            ("width_px", "0", "image size is 0"),
            ("step_ref", "0", "ray step is 0"),
            ("shading", "phong", "none, local or scatter"),
            ("skipping", "octree", "none, blocks or distance"),
            ("termination", "1.5", "termination opacity"),
            ("tf", "0.1 0.2", "three numbers"),
            ("tf", "0.1 0 1", "width is 0"),
            ("seconds_wall", "-1", "seconds_wall is -1"),
            ("seconds_wall", "inf", "seconds_wall is inf"),
            ("seconds_cpu", "fast", "column seconds_cpu"),
            ("samples", "-3", "column samples"),
        ] {
            let message = with(column, value);
            assert!(message.contains(expected) && message.contains("line 2"), "{column}={value}: {message}");
        }
        let missing = good.replacen("step_ref", "step", 1);
        std::fs::write(&path, missing).unwrap();
        assert!(format!("{:#}", Table::read(&path, 0).unwrap_err()).contains("\"step_ref\" is missing"));
        std::fs::write(&path, &good[..good.len() - 30]).unwrap();
        assert!(format!("{:#}", Table::read(&path, 0).unwrap_err()).contains("26 expected"));
        std::fs::write(&path, format!("{good}{}\n", line.join(","))).unwrap();
        assert!(format!("{:#}", Table::read(&path, 0).unwrap_err()).contains("line 3: frame 0, repeat 0"));
        std::fs::write(
            &path,
            format!("{good}{}\n", line.join(",").replacen("0,0,", "0,1,", 1).replace("320", "321")),
        )
        .unwrap();
        assert!(format!("{:#}", Table::read(&path, 0).unwrap_err()).contains("another scene"));
        std::fs::write(&path, format!("{}\n", COLUMNS.join(","))).unwrap();
        assert!(read_tables(std::slice::from_ref(&path)).unwrap_err().to_string().contains("no frames"));
    }

    #[test]
    fn the_writer_refuses_what_could_not_be_read_back() {
        let dir = folder();
        let mut writer = Writer::create(&dir.path().join("t.csv")).unwrap();
        let newline = Scene { volume: "a\nb".into(), ..scene() };
        assert!(writer.append(0, &newline, &[measured(0.1)]).is_err());
        assert!(writer.append(0, &scene(), &[]).is_err());
        assert!(writer.append(0, &scene(), &[Measurement::default()]).is_err());
        assert!(writer.append(0, &scene(), &[measured(f64::NAN)]).is_err());
        writer.append(0, &scene(), &[measured(0.1)]).unwrap();
    }

    #[test]
    fn noise_floor_is_the_pooled_log_deviation() {
        // Two frames, ratios e^±0.1 and e^±0.1: pooled variance = (2·0.01 + 2·0.01) / 2.
        let frame = |t: f64| TimedFrame {
            table: 0,
            number: 0,
            scene: scene(),
            repeats: vec![measured(t * 0.1f64.exp()), measured(t * (-0.1f64).exp())],
        };
        let floor = noise_floor(&[frame(1.0), frame(20.0)], Clock::Wall).unwrap();
        assert!((floor.log_sd - 0.02f64.sqrt()).abs() < 1e-12);
        assert!((floor.log_sd_of_median - 0.1).abs() < 1e-12);
        assert_eq!(floor.frames, 2);
        let mut once = frame(1.0);
        once.repeats.pop();
        assert_eq!(noise_floor(&[once], Clock::Wall), None);
        assert_eq!(noise_floor(&[frame(1.0)], Clock::Device), None);
    }

    #[test]
    fn medians_ignore_zero_times_and_take_the_middle() {
        assert_eq!(median(&mut []), None);
        assert_eq!(median(&mut [3.0, 1.0, 2.0, 10.0]), Some(2.5));
        let frame =
            TimedFrame { table: 0, number: 0, scene: scene(), repeats: vec![measured(0.0), measured(0.5)] };
        assert_eq!(frame.seconds(Clock::Wall), Some(0.5));
    }

    #[test]
    fn manifests_keep_unknown_keys_and_refuse_other_formats() {
        let dir = folder();
        let table = dir.path().join("run.v2.csv");
        assert_eq!(Manifest::path_for(&table), dir.path().join("run.v2.manifest.json"));
        assert_eq!(Manifest::read(&table).unwrap(), None);
        let mut manifest = Manifest {
            format: MANIFEST_FORMAT.into(),
            created: "2020-01-02T03:04:05Z".into(),
            machine: "host".into(),
            renderer: "cpu".into(),
            device: "twin".into(),
            driver: String::new(),
            commit: "0.1.0".into(),
            seed: u64::MAX,
            repeats: 3,
            step_reference: "smallest voxel spacing".into(),
            settings: serde_json::json!({"frames": 10}),
            other: BTreeMap::from([("weather".to_owned(), serde_json::json!("fine"))]),
        };
        manifest.write(&table).unwrap();
        assert_eq!(Manifest::read(&table).unwrap(), Some(manifest.clone()));
        manifest.format = "2".into();
        manifest.write(&table).unwrap();
        assert!(Manifest::read(&table).unwrap_err().to_string().contains("entire-timings-1"));
    }
}
