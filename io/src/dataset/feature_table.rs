//! Scene features of the frames of a timing table, kept beside it so that training and evaluation need no
//! volumes: `NAME.csv` → `NAME.features.csv.gz`.
//!
//! The first line, `# entire-features 1 schema HASH table HASH frames N`, identifies the features: a hash of
//! the quantities' names and of [`VERSION`] (a table without quantities that were added later stays valid),
//! the FNV-1a hash of the timing table's bytes (decompressed), and the number of rows. The second line names
//! the columns. Then follows one row per frame: the frame's number, every scene quantity (never its
//! logarithm), probe-dependent quantities also as `NAME@SIDE` for probes with a nonstandard number of rays,
//! then the features of each VolumeNet, as columns `volumenet_ID_I` where ID identifies the encoder's weights
//! and I is the feature's index.

use super::TimedFrame;
use crate::files::{fnv1a, gzip, read_decompressed, without_mark, write_whole};
use anyhow::{Context, Result, anyhow, ensure};
use entire_core::nn::VolumeNetParts;
use entire_steer::features::{PROBE_SIDE, SceneQuantity};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Version of the quantities' values: raised whenever the program computes a value of a frame differently, so
/// that older tables are refused.
pub const VERSION: u32 = 10;

const MARK: &str = "# entire-features 1";

/// Scene features of frames; each frame is found by its number.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureTable {
    schema: u64,
    table: u64,
    hash: u64,
    columns: Vec<String>,
    at: HashMap<u64, usize>,
    values: Vec<f32>,
}

/// Hash of [`VERSION`] and the names of the first `count` quantities.
fn schema_of(count: usize) -> u64 {
    let names: Vec<&str> = SceneQuantity::ALL.iter().take(count).map(|&q| q.into()).collect();
    fnv1a(format!("{VERSION} {}", names.join(",")).as_bytes())
}

/// True if features with this schema hash have the same meaning in this version. New quantities are added at
/// the end, so an older table stays valid; quantities that it lacks are computed from the volumes.
fn is_understood(schema: u64) -> bool {
    (1..=SceneQuantity::ALL.len()).any(|count| schema_of(count) == schema)
}

/// Returns the path of a file beside a table: the table's path with `ending` in place of `.csv` or `.csv.gz`.
pub fn beside(table: &Path, ending: &str) -> PathBuf {
    let bare =
        if table.extension().is_some_and(|e| e == "gz") { table.with_extension("") } else { table.into() };
    let bare = if bare.extension().is_some_and(|e| e == "csv") { bare.with_extension("") } else { bare };
    let mut name = bare.into_os_string();
    name.push(ending);
    name.into()
}

/// Returns the id of a VolumeNet: a hash of the first block's and the last layer's weights, eight hexadecimal
/// digits.
pub fn encoder_id(parts: &VolumeNetParts) -> String {
    let first = parts.blocks.first().map_or(&[][..], |b| &b.weight[..]);
    let bytes: Vec<u8> = first.iter().chain(&parts.fc.weight).flat_map(|w| w.to_le_bytes()).collect();
    format!("{:08x}", fnv1a(&bytes) >> 32)
}

/// Returns the column name of a quantity, for a probe with `probe_side` rays along each side.
pub fn quantity_column(quantity: SceneQuantity, probe_side: usize) -> String {
    if probe_side == PROBE_SIDE || !quantity.needs_probe() {
        quantity.to_string()
    } else {
        format!("{quantity}@{probe_side}")
    }
}

/// Returns the column name of an encoder's feature.
pub fn code_column(id: &str, feature: usize) -> String {
    format!("volumenet_{id}_{feature}")
}

impl FeatureTable {
    /// Returns the path of a timing table's features.
    pub fn path_for(table: &Path) -> PathBuf {
        beside(table, ".features.csv.gz")
    }

    /// Returns a table with one row of values for each frame number, in the columns' order. The values must
    /// be computed by this version of the program. `table` is the hash of the timing table.
    ///
    /// # Errors
    /// When the values are not one row per number, or a number appears twice.
    pub fn new(columns: Vec<String>, numbers: &[u64], values: Vec<f32>, table: u64) -> Result<Self> {
        let (found, width, frames) = (values.len(), columns.len(), numbers.len());
        ensure!(
            found == width * frames,
            "the feature table has {found} values; {frames} frames with {width} columns need one value per \
             frame and column"
        );
        let mut at = HashMap::new();
        for (i, &n) in numbers.iter().enumerate() {
            ensure!(at.insert(n, i).is_none(), "frame {n} appears twice; make the file again");
        }
        let bytes: Vec<u8> = columns
            .iter()
            .flat_map(|c| [c.as_bytes(), b","].concat())
            .chain(numbers.iter().flat_map(|n| n.to_le_bytes()))
            .chain(values.iter().flat_map(|v| v.to_le_bytes()))
            .collect();
        Ok(Self {
            schema: schema_of(SceneQuantity::ALL.len()),
            table,
            hash: fnv1a(&bytes),
            columns,
            at,
            values,
        })
    }

    /// Hash of column names, frame numbers and values.
    pub fn hash(&self) -> u64 {
        self.hash
    }

    /// Names of the columns, without that of the frame number.
    pub fn columns(&self) -> &[String] {
        &self.columns
    }

    /// Index of the column with this name, if there is one.
    pub fn column(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|c| c == name)
    }

    /// Values of the frame with this number, in the columns' order, if the table has the frame.
    pub fn row(&self, number: u64) -> Option<&[f32]> {
        let width = self.columns.len();
        self.at.get(&number).map(|i| &self.values[i * width..(i + 1) * width])
    }

    /// Writes the file, whole or not at all.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let mut numbers: Vec<u64> = self.at.keys().copied().collect();
        numbers.sort_unstable();
        let mut text = format!(
            "{MARK} schema {:016x} table {:016x} frames {}\nframe,{}\n",
            self.schema,
            self.table,
            numbers.len(),
            self.columns.join(",")
        );
        for n in numbers {
            text += &n.to_string();
            for v in self.row(n).unwrap_or_default() {
                let number = format!("{v:?}");
                text.push(',');
                text += number.strip_suffix(".0").unwrap_or(&number);
            }
            text.push('\n');
        }
        write_whole(path, &gzip(text.as_bytes())?)
    }

    /// Reads the features of a timing table; `None` if there are none.
    ///
    /// # Errors
    /// When the file is damaged, was made by a version with other features, or does not match the table with
    /// the hash `hash`.
    pub fn beside(table: &Path, frames: &[TimedFrame], hash: u64) -> Result<Option<Self>> {
        let path = Self::path_for(table);
        if !path.exists() {
            return Ok(None);
        }
        let found = Self::read(&path).with_context(|| {
            format!(
                "{} is no feature table; make it again with `entire features` or remove it",
                path.display()
            )
        })?;
        ensure!(
            is_understood(found.schema),
            "{} was made by another version of this program, whose features may differ; make it again with \
             `entire features` or remove it",
            path.display()
        );
        ensure!(
            found.table == hash,
            "{} does not belong to the present content of {}; make it again with `entire features` or remove \
             it",
            path.display(),
            table.display()
        );
        let pixels = found.column(SceneQuantity::Pixels.into());
        let step = found.column(SceneQuantity::Step.into());
        for f in frames {
            let fits = found.row(f.number).is_some_and(|row| {
                let is = |column: Option<usize>, value: f32| column.is_none_or(|c| row[c] == value);
                is(pixels, f.scene.width as f32 * f.scene.height as f32) && is(step, f.scene.step)
            });
            ensure!(
                fits,
                "{} does not match {}: frame {} is missing or has another size or step; make it again with \
                 `entire features`",
                path.display(),
                table.display(),
                f.number
            );
        }
        Ok(Some(found))
    }

    fn read(path: &Path) -> Result<Self> {
        Self::parse(&read_decompressed(path)?)
    }

    /// Reads a file's bytes, decompressed.
    ///
    /// # Errors
    /// When the content is invalid; the error names line and column if a field is invalid.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let bytes = without_mark(bytes);
        let end = bytes.iter().position(|&b| b == b'\n').map_or(bytes.len(), |i| i + 1);
        let (schema, table, rows) =
            std::str::from_utf8(&bytes[..end]).ok().and_then(made_of).with_context(|| {
                format!(
                    "its first line is not {MARK:?} with schema, table and frames, so its features are \
                unknown"
                )
            })?;
        // This CSV reader takes the first line as a comment, so its line numbers are those of the file.
        let mut reader = csv::ReaderBuilder::new().comment(Some(b'#')).from_reader(bytes);
        let header = reader.headers()?.clone();
        ensure!(
            header.get(0) == Some("frame"),
            "its first column is {:?}, not frame",
            header.get(0).unwrap_or("")
        );
        let columns: Vec<String> = header.iter().skip(1).map(str::to_owned).collect();
        let (mut numbers, mut values) = (Vec::new(), Vec::new());
        for record in reader.records() {
            let record = record?;
            let line = record.position().map_or(0, |p| p.line());
            let bad = |name: &str, text: &str| anyhow!("line {line}, column {name}: {text:?} is no number");
            let first = record.get(0).unwrap_or("");
            numbers.push(first.parse().map_err(|_| bad("frame", first))?);
            for (text, name) in record.iter().skip(1).zip(&columns) {
                let value: f32 = text.parse().map_err(|_| bad(name, text))?;
                ensure!(value.is_finite(), "line {line}, column {name}: {text:?} is not finite");
                values.push(value);
            }
        }
        ensure!(numbers.len() == rows, "it holds {} frames and its first line says {rows}", numbers.len());
        Ok(Self { schema, ..Self::new(columns, &numbers, values, table)? })
    }
}

/// Returns schema hash, table hash and number of frames from the first line.
fn made_of(line: &str) -> Option<(u64, u64, usize)> {
    let words: Vec<&str> = line.strip_prefix(MARK)?.split_whitespace().collect();
    let ["schema", schema, "table", table, "frames", rows] = words[..] else { return None };
    let hash = |text: &str| u64::from_str_radix(text, 16).ok();
    Some((hash(schema)?, hash(table)?, rows.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> FeatureTable {
        let columns = vec!["pixels".into(), "x".into()];
        FeatureTable::new(columns, &[7, 3], vec![64.0, 1.5e-9, 32.0, -2.25], 0xfeed).unwrap()
    }

    #[test]
    fn a_written_table_reads_back_bit_for_bit() {
        let dir = tempfile::tempdir().unwrap();
        let path = FeatureTable::path_for(&dir.path().join("t.csv.gz"));
        assert_eq!(path, dir.path().join("t.features.csv.gz"));
        table().write(&path).unwrap();
        let back = FeatureTable::read(&path).unwrap();
        assert_eq!(back.row(7), Some(&[64.0f32, 1.5e-9][..]));
        assert_eq!(back.row(3), Some(&[32.0f32, -2.25][..]));
        assert_eq!((back.row(4), back.column("x"), back.column("y")), (None, Some(1), None));
        assert_eq!((back.schema, back.table), (schema_of(SceneQuantity::ALL.len()), 0xfeed));
    }

    #[test]
    fn features_of_another_program_or_table_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let csv = dir.path().join("t.csv");
        let path = FeatureTable::path_for(&csv);
        assert_eq!(FeatureTable::beside(&csv, &[], 1).unwrap(), None);
        table().write(&path).unwrap();
        assert!(FeatureTable::beside(&csv, &[], 0xfeed).unwrap().is_some());
        let says = |hash: u64| format!("{:#}", FeatureTable::beside(&csv, &[], hash).unwrap_err());
        let message = says(0xfeee);
        assert!(message.contains("does not belong") && message.contains("`entire features`"), "{message}");
        let before = FeatureTable { schema: schema_of(SceneQuantity::ALL.len() - 1), ..table() };
        before.write(&path).unwrap();
        assert!(FeatureTable::beside(&csv, &[], 0xfeed).unwrap().is_some());
        FeatureTable { schema: 1, ..table() }.write(&path).unwrap();
        let message = says(0xfeed);
        assert!(message.contains("another version") && message.contains("`entire features`"), "{message}");
    }

    /// Fails when the program computes values that differ from those in stored tables. Then raise
    /// [`VERSION`], make the stored tables again with `entire features`, and put the new hash here.
    #[test]
    fn this_version_stands_for_these_values() {
        use crate::files::fnv1a_text;
        use crate::volume::{Volume, VolumeData};
        use entire_core::scene::{Arcball, Camera, Frame, Shading, TransferFunction};
        use entire_steer::features::{FrameFeatures, Setting, TransferSummary, VolumeSummary};
        // Half of the volume is empty.
        let value = |i: u32| if i % 24 < 12 { 0 } else { (i * i / 97 % 251) as u8 };
        let values: Vec<u8> = (0..24 * 20 * 18).map(value).collect();
        let volume = Volume::new(VolumeData::U8(values), [24, 20, 18], [1.0, 1.0, 1.5], "v").unwrap();
        let summary = VolumeSummary::new(&volume.view()).unwrap();
        let lobes = crate::dataset::parse_lobes("0.3 0.0005 0.4;0.8 0.0003 0.9").unwrap();
        let table = TransferFunction::Gaussian(lobes).to_table().unwrap();
        let mut transfer = TransferSummary::new(&summary, &table).unwrap();
        let mut text = String::new();
        for (shading, dz) in [(Shading::None, 2.5), (Shading::Local, 1.1), (Shading::Scatter, 0.6)] {
            let camera = Camera::from_arcball(Arcball { rx: 25.0, ry: -60.0, dz }).unwrap();
            let frame = Frame { shading, ..Frame::new(camera, 90, 70).unwrap() };
            let features = FrameFeatures::of(&summary, &mut transfer, &frame, PROBE_SIDE).unwrap();
            let of = features.quantities(Setting::from(&frame));
            for q in SceneQuantity::ALL {
                let value = of(q);
                text += &format!("{q} {value:.3e}\n");
            }
        }
        assert_eq!((VERSION, fnv1a_text(text.as_bytes())), (10, "bbd7b66e5a1e7ff5".into()), "{text}");
    }

    #[test]
    fn columns_of_other_probes_have_their_side() {
        assert_eq!(quantity_column(SceneQuantity::Samples, PROBE_SIDE), "samples");
        assert_eq!(quantity_column(SceneQuantity::Samples, 7), "samples@7");
        assert_eq!(quantity_column(SceneQuantity::Pixels, 7), "pixels");
    }

    #[test]
    fn damage_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.features.csv.gz");
        let fails = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            format!("{:#}", FeatureTable::read(&path).unwrap_err())
        };
        let says = |rows: usize, text: &str| {
            gzip(format!("{MARK} schema 0a table 0b frames {rows}\n{text}").as_bytes()).unwrap()
        };
        assert!(fails(b"frame,x\n").contains("damaged"));
        assert!(fails(&gzip(b"frame,x\n1,2\n").unwrap()).contains("first line"));
        assert!(
            fails(&gzip(b"# entire-features 1 schema 0a frames 1\nframe\n").unwrap()).contains("first line")
        );
        assert!(fails(&says(1, "number,x\n1,2\n")).contains("first column"));
        assert!(fails(&says(1, "frame,x\n1,a\n")).contains("line 3, column x"));
        assert!(fails(&says(1, "frame,x\n1\n")).contains("line: 3"));
        assert!(fails(&says(1, "frame,x\n1,inf\n")).contains("not finite"));
        assert!(fails(&says(2, "frame,x\n1,1\n1,2\n")).contains("twice"));
        assert!(fails(&says(2, "frame,x\n1,1\n")).contains("holds 1 frames and its first line says 2"));
        let whole = says(1, "frame,x\n1,1\n");
        assert!(fails(&whole[..whole.len() - 9]).contains("damaged"));
        assert!(FeatureTable::new(vec!["a".into()], &[1, 2], vec![0.0], 0).is_err());
    }
}
