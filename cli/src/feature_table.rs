//! What the core computes about the frames of a timing table, kept beside it, so that training and evaluation need no
//! volumes: `NAME.csv` → `NAME.features.csv.gz`.
//!
//! One row per frame: its number, every quantity of the core's schema as it stands (never its logarithm), those that
//! need the probe again as `NAME@SIDE` for probes of other than the standard number of rays, then the features of each VolumeNet that the file was made with, as columns `volumenet_ID_I` where ID tells the encoder's weights.

use crate::dataset::TimedFrame;
use anyhow::{Context, Result, anyhow, ensure};
use entire_core::features::{PROBE_SIDE, SceneQuantity};
use entire_core::nn::VolumeNetParts;
use flate2::{Compression, read::MultiGzDecoder, write::GzEncoder};
use std::collections::HashMap;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// Most bytes that a compressed table may unfold to.
const MAX_BYTES: u64 = 4 << 30;

/// Features of frames, by frame number.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureTable {
    columns: Vec<String>,
    at: HashMap<u64, usize>,
    values: Vec<f32>,
}

/// A table's name without `.csv` or `.csv.gz`.
pub fn stem(table: &Path) -> PathBuf {
    let bare =
        if table.extension().is_some_and(|e| e == "gz") { table.with_extension("") } else { table.into() };
    bare.with_extension("")
}

/// A whole file, unfolded where its name ends in `.gz`.
///
/// # Errors
/// When it cannot be read, is damaged, or unfolds to more than 4 GiB.
pub fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    let bytes = std::fs::read(path)?;
    if path.extension().is_none_or(|e| e != "gz") {
        return Ok(bytes);
    }
    let mut out = Vec::new();
    MultiGzDecoder::new(&bytes[..])
        .take(MAX_BYTES + 1)
        .read_to_end(&mut out)
        .map_err(|e| anyhow!("the gzip stream is damaged: {e}"))?;
    ensure!(out.len() as u64 <= MAX_BYTES, "it unfolds to more than {} GiB", MAX_BYTES >> 30);
    Ok(out)
}

/// Compresses bytes as gzip; the same bytes give the same file.
///
/// # Errors
/// Never in practice: memory is written to.
pub fn gzip(bytes: &[u8]) -> Result<Vec<u8>> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(bytes)?;
    Ok(encoder.finish()?)
}

/// Tells VolumeNets apart: a hash of the first block's and the last layer's weights, eight hexadecimal digits.
pub fn encoder_id(parts: &VolumeNetParts) -> String {
    let first = parts.blocks.first().map_or(&[][..], |b| &b.weight[..]);
    let bytes: Vec<u8> = first.iter().chain(&parts.fc.weight).flat_map(|w| w.to_le_bytes()).collect();
    format!("{:08x}", crate::dataset::fnv1a(&bytes) >> 32)
}

/// The column of a quantity, for a probe with so many rays along each side.
pub fn quantity_column(quantity: SceneQuantity, probe_side: usize) -> String {
    if probe_side == PROBE_SIDE || !quantity.needs_probe() {
        quantity.name().to_owned()
    } else {
        format!("{}@{probe_side}", quantity.name())
    }
}

/// The column of an encoder's feature.
pub fn code_column(id: &str, feature: usize) -> String {
    format!("volumenet_{id}_{feature}")
}

impl FeatureTable {
    /// The path beside a timing table.
    pub fn path_for(table: &Path) -> PathBuf {
        let mut name = stem(table).into_os_string();
        name.push(".features.csv.gz");
        name.into()
    }

    /// From frame numbers and one row of values each, in the columns' order.
    ///
    /// # Errors
    /// When the values are not one row per number, or a number stands there twice.
    pub fn new(columns: Vec<String>, numbers: &[u64], values: Vec<f32>) -> Result<Self> {
        ensure!(
            values.len() == columns.len() * numbers.len(),
            "{} values for {} frames of {} columns",
            values.len(),
            numbers.len(),
            columns.len()
        );
        let mut at = HashMap::new();
        for (i, &n) in numbers.iter().enumerate() {
            ensure!(at.insert(n, i).is_none(), "frame {n} stands there twice; make the file anew");
        }
        Ok(Self { columns, at, values })
    }

    /// The columns, without the frame number.
    pub fn columns(&self) -> &[String] {
        &self.columns
    }

    /// Where a column stands.
    pub fn column(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|c| c == name)
    }

    /// A frame's values.
    pub fn row(&self, number: u64) -> Option<&[f32]> {
        let width = self.columns.len();
        self.at.get(&number).map(|i| &self.values[i * width..(i + 1) * width])
    }

    /// Writes the file, whole or not at all.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let mut numbers: Vec<u64> = self.at.keys().copied().collect();
        numbers.sort_unstable();
        let mut text = format!("frame,{}\n", self.columns.join(","));
        for n in numbers {
            text += &n.to_string();
            for v in self.row(n).unwrap_or_default() {
                let number = format!("{v:?}");
                text.push(',');
                text += number.strip_suffix(".0").unwrap_or(&number);
            }
            text.push('\n');
        }
        let mut part = path.as_os_str().to_owned();
        part.push(".part");
        let part = PathBuf::from(part);
        std::fs::write(&part, gzip(text.as_bytes())?)
            .and_then(|()| std::fs::rename(&part, path))
            .with_context(|| format!("cannot write {}", path.display()))
    }

    /// Reads the file beside a timing table; `None` where there is none.
    ///
    /// # Errors
    /// When it exists and is damaged, or does not go with the table's frames.
    pub fn beside(table: &Path, frames: &[TimedFrame]) -> Result<Option<Self>> {
        let path = Self::path_for(table);
        if !path.exists() {
            return Ok(None);
        }
        let found = Self::read(&path).with_context(|| {
            format!(
                "{} is no feature table; make it anew with `entire features` or remove it",
                path.display()
            )
        })?;
        let pixels = found.column(SceneQuantity::Pixels.name());
        let rays = found.column(SceneQuantity::Step.name());
        for f in frames {
            let fits = found.row(f.number).is_some_and(|row| {
                let is = |column: Option<usize>, value: f32| column.is_none_or(|c| row[c] == value);
                is(pixels, f.scene.width as f32 * f.scene.height as f32) && is(rays, f.scene.step)
            });
            ensure!(
                fits,
                "{} does not go with {}: frame {} is missing or has another size or step; make it anew with `entire features`",
                path.display(),
                table.display(),
                f.number
            );
        }
        Ok(Some(found))
    }

    fn read(path: &Path) -> Result<Self> {
        let bytes = read_bytes(path)?;
        let mut reader = csv::ReaderBuilder::new().from_reader(&bytes[..]);
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
            let line = record.position().map_or(0, csv::Position::line);
            let bad = |name: &str, text: &str| anyhow!("line {line}, column {name}: {text:?} is no number");
            let first = record.get(0).unwrap_or("");
            numbers.push(first.parse().map_err(|_| bad("frame", first))?);
            for (text, name) in record.iter().skip(1).zip(&columns) {
                let value: f32 = text.parse().map_err(|_| bad(name, text))?;
                ensure!(value.is_finite(), "line {line}, column {name}: {text:?} is not finite");
                values.push(value);
            }
        }
        Self::new(columns, &numbers, values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> FeatureTable {
        FeatureTable::new(vec!["pixels".into(), "x".into()], &[7, 3], vec![64.0, 1.5e-9, 32.0, -2.25])
            .unwrap()
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
        assert!(fails(b"frame,x\n").contains("damaged"));
        assert!(fails(&gzip(b"number,x\n1,2\n").unwrap()).contains("first column"));
        assert!(fails(&gzip(b"frame,x\n1,a\n").unwrap()).contains("line 2, column x"));
        assert!(fails(&gzip(b"frame,x\n1,inf\n").unwrap()).contains("not finite"));
        assert!(fails(&gzip(b"frame,x\n1,1\n1,2\n").unwrap()).contains("twice"));
        let whole = gzip(b"frame,x\n1,1\n").unwrap();
        assert!(fails(&whole[..whole.len() - 9]).contains("damaged"));
        assert!(FeatureTable::new(vec!["a".into()], &[1, 2], vec![0.0]).is_err());
    }
}
