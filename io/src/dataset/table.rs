//! Reading of timing tables: rows grouped into frames, every wrong field named with its line and column.

use super::feature_table::FeatureTable;
use super::{Manifest, Scene, TimedFrame, Timing, parse_lobes};
use crate::files::{ensure_distinct, fnv1a, read_decompressed};
use anyhow::{Context, Result, anyhow, ensure};
use entire_core::scene::Arcball;
use entire_vk_raycaster::WorkCounts;
use std::collections::{HashMap, HashSet};
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

/// A timing table in memory, repeats grouped into frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Table {
    /// File of the table.
    pub path: PathBuf,
    /// Manifest of the table, if there is one.
    pub manifest: Option<Manifest>,
    /// Frames of the table, in the order in which they first appear.
    pub frames: Vec<TimedFrame>,
    /// FNV-1a hash of the CSV's bytes, decompressed.
    pub hash: u64,
    /// Scene features of the frames, if a feature table lies beside the table.
    pub features: Option<FeatureTable>,
    /// Folder of the volumes, if it is neither the working folder nor the table's folder.
    pub root: Option<PathBuf>,
}

impl Table {
    /// Reads a table, its manifest and its features. `index` is stored in each frame's `table`. Files whose
    /// names end in `.gz` are decompressed.
    ///
    /// # Errors
    /// When a file cannot be read, a column is missing, or a row holds an invalid value; the message names
    /// file, line and column.
    pub fn read(path: &Path, index: usize) -> Result<Self> {
        let mut table = Self::read_without_features(path, index)?;
        table.features = FeatureTable::beside(path, &table.frames, table.hash)?;
        Ok(table)
    }

    /// Reads a table as [`Table::read`] does, but without the features beside the table.
    ///
    /// # Errors
    /// Those of [`Table::read`].
    pub fn read_without_features(path: &Path, index: usize) -> Result<Self> {
        let bytes = read_decompressed(path).with_context(|| {
            let remedy =
                if path.exists() { "" } else { "; make a table with `entire collect VOLUME --out FILE.csv`" };
            format!("cannot read {}{remedy}", path.display())
        })?;
        let frames =
            parse(&bytes, index).with_context(|| format!("{} is no timing table", path.display()))?;
        let (path, manifest, hash) = (path.to_owned(), Manifest::read(path)?, fnv1a(&bytes));
        Ok(Self { path, manifest, frames, hash, features: None, root: None })
    }

    /// Returns the number of passes in which the repeats were measured, from the manifest; 1 if the manifest
    /// does not state it.
    pub fn passes(&self) -> usize {
        let stated = self.manifest.as_ref().and_then(|m| m.settings.get("passes")?.as_u64());
        stated.and_then(|p| usize::try_from(p).ok()).unwrap_or(1).max(1)
    }

    /// Returns the path of a volume file: the first existing path of `name` below the root folder (if set),
    /// `name` itself, and `name` below the table's folder. `None` if none of these exists.
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
/// Those of [`Table::read`]; when no table has a frame.
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

/// Reads the tables that a command's user names. Their volumes are below the folder `root`, if it is given.
///
/// # Errors
/// Those of [`read_tables`], and a table that is given twice: its frames would count twice.
pub fn open_tables(paths: &[PathBuf], root: Option<&Path>) -> Result<Vec<Table>> {
    ensure_distinct(paths)?;
    let mut tables = read_tables(paths)?;
    tables.iter_mut().for_each(|t| t.root = root.map(Path::to_owned));
    Ok(tables)
}

/// Reads a timing table's bytes; `table` is stored in each frame.
///
/// # Errors
/// When a column is missing or a row is invalid; the error names the missing column, or the row's line and
/// the invalid value.
pub fn parse(bytes: &[u8], table: usize) -> Result<Vec<TimedFrame>> {
    let mut reader = csv::ReaderBuilder::new().from_reader(bytes);
    let headers = reader.headers().context("the header line cannot be read")?.clone();
    let at = positions(&headers, COLUMNS).map_err(|name| {
        anyhow!("column {name:?} is missing; the first line must name {}", COLUMNS.join(","))
    })?;
    let mut frames: Vec<TimedFrame> = Vec::new();
    let mut by_number: HashMap<u64, usize> = HashMap::new();
    let mut seen: HashSet<(u64, u32)> = HashSet::new();
    for record in reader.records() {
        let record = record.map_err(|e| unreadable(&e))?;
        let line = record.position().map_or(0, csv::Position::line);
        let row = Row { record: &record, at: &at };
        let (number, repeat, scene, measurement) = row.read().with_context(|| format!("line {line}"))?;
        ensure!(
            seen.insert((number, repeat)),
            "line {line}: frame {number}, repeat {repeat} appears twice; remove one"
        );
        match by_number.get(&number) {
            Some(&i) => {
                ensure!(
                    frames[i].scene == scene,
                    "line {line}: repeat {repeat} of frame {number} has another scene than its earlier rows; \
                     give it another frame number"
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

/// Returns the positions of the columns with these names; the error is the first missing name.
pub(super) fn positions<const N: usize>(
    headers: &csv::StringRecord,
    names: [&'static str; N],
) -> Result<[usize; N], &'static str> {
    let mut at = [0; N];
    for (slot, name) in at.iter_mut().zip(names) {
        *slot = headers.iter().position(|h| h.trim() == name).ok_or(name)?;
    }
    Ok(at)
}

/// Returns the reason why a record cannot be read, with its line.
pub(super) fn unreadable(error: &csv::Error) -> anyhow::Error {
    let Some(position) = error.position() else { return anyhow!("{error}") };
    let why = match error.kind() {
        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => format!(
            "{len} fields found, {expected_len} expected; is the line cut off, or is there a comma too many?"
        ),
        csv::ErrorKind::Utf8 { .. } => "the text is not UTF-8".into(),
        other => format!("{other:?}"),
    };
    anyhow!("line {}: {why}", position.line())
}

struct Row<'a> {
    record: &'a csv::StringRecord,
    at: &'a [usize; COLUMNS.len()],
}

impl Row<'_> {
    fn raw(&self, name: &'static str) -> &str {
        let column = COLUMNS.iter().position(|c| *c == name).unwrap_or(0);
        self.record.get(self.at[column]).unwrap_or("")
    }

    fn text(&self, name: &'static str) -> &str {
        self.raw(name).trim()
    }

    fn number<T: std::str::FromStr>(&self, name: &'static str, accepted: &str) -> Result<T> {
        let text = self.text(name);
        text.parse().map_err(|_| anyhow!("column {name} is {text:?}; {accepted} is expected"))
    }

    fn optional<T: std::str::FromStr>(&self, name: &'static str, accepted: &str) -> Result<Option<T>> {
        if self.text(name).is_empty() { Ok(None) } else { self.number(name, accepted).map(Some) }
    }

    fn read(&self) -> Result<(u64, u32, Scene, Timing)> {
        const WHOLE_NUMBER: &str = "a whole number";
        const NUMBER: &str = "a number";
        const OR_EMPTY: &str = "a number or an empty field";
        const WHOLE_OR_EMPTY: &str = "a whole number or an empty field";
        let scene = Scene {
            // Spaces at the ends of a name belong to it.
            volume: self.raw("volume").to_owned(),
            member: self.raw("member").to_owned(),
            time_step: self.optional("time_step", WHOLE_OR_EMPTY)?,
            dims: [
                self.number("dims_x", WHOLE_NUMBER)?,
                self.number("dims_y", WHOLE_NUMBER)?,
                self.number("dims_z", WHOLE_NUMBER)?,
            ],
            camera: Arcball {
                rx: self.number("camera_rx_deg", NUMBER)?,
                ry: self.number("camera_ry_deg", NUMBER)?,
                dz: self.number("camera_dz_radii", NUMBER)?,
            },
            fov_y_degrees: self.number("fov_y_deg", NUMBER)?,
            width: self.number("width_px", WHOLE_NUMBER)?,
            height: self.number("height_px", WHOLE_NUMBER)?,
            step: self.number("step_ref", NUMBER)?,
            shading: self.text("shading").parse().context("column shading")?,
            skipping: self.text("skipping").parse().context("column skipping")?,
            termination: self.number("termination", NUMBER)?,
            lobes: parse_lobes(self.text("tf")).context("column tf")?,
        };
        scene.check()?;
        let samples = self.optional("samples", WHOLE_OR_EMPTY)?;
        let counts = match samples {
            Some(samples) => Some(WorkCounts {
                samples,
                skips: self.optional("skips", WHOLE_OR_EMPTY)?.unwrap_or(0),
                rays: self.optional("rays", WHOLE_OR_EMPTY)?.unwrap_or(0),
                shaded: self.optional("shaded", WHOLE_OR_EMPTY)?.unwrap_or(0),
            }),
            None => None,
        };
        let measurement = Timing {
            device: self.optional("seconds_device", OR_EMPTY)?,
            wall: self.optional("seconds_wall", OR_EMPTY)?,
            cpu: self.optional("seconds_cpu", OR_EMPTY)?,
            counts,
        };
        measurement.check()?;
        Ok((self.number("frame", WHOLE_NUMBER)?, self.number("repeat", WHOLE_NUMBER)?, scene, measurement))
    }
}
