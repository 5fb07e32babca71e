//! MetaImage: lines of `Key = Value` that end with `ElementDataFile`, which names the file of the voxels
//! (`.mhd`) or says `LOCAL` if the voxels follow (`.mha`). Several files are named by `LIST [2D]`, with a
//! name in each further line, or by `name%03d.raw FIRST LAST STEP`.
//!
//! The following rules are those of the format's own library. `HeaderSize` counts from the start of the file
//! that holds the voxels; with `LOCAL`, that is the header's own file. With a `HeaderSize` of -1, voxels that
//! are not compressed are the last bytes of the file; compressed voxels begin right after the header, or at
//! the start of their own file. Of the two fields of byte order, `BinaryDataByteOrderMSB` takes precedence.
//!
//! The project has its own reader, since the crate that reads MetaImage, `bioformats` 0.1, supports neither
//! voxels in text nor 64-bit integers.

use super::element::{byte_count, expect_end, parse_voxels, read_voxels};
use super::several::Several;
use super::stream::{Companions, Remaining, Stream};
use super::{Element, Endian, Parts, VolumeData, checked_dims, number, numbers, three_axes};
use anyhow::{Context, Result, bail, ensure};

const MAX_LINES: usize = 1 << 14;
const MAX_AXES: usize = 10;

#[derive(Default)]
struct Header {
    element: Option<Element>,
    axes: Option<usize>,
    sizes: Option<Vec<u64>>,
    spacing: Option<Vec<f64>>,
    element_size: Option<Vec<f64>>,
    channels: u64,
    binary: bool,
    /// Values of BinaryDataByteOrderMSB and of ElementByteOrderMSB.
    big_endian: [Option<bool>; 2],
    compressed: bool,
    header_size: i64,
    length: u64,
    data_file: String,
    several: Option<Several>,
}

pub(super) fn read(mut stream: Stream<'_>, companions: &dyn Companions) -> Result<Parts> {
    let mut header = header(&mut stream)?;
    let element = header.element.context("MetaImage header has no ElementType")?;
    let axes = header.axes.context("MetaImage header has no NDims")?;
    let sizes = header.sizes.take().context("MetaImage header has no DimSize")?;
    let spacing = header.spacing.take().or(header.element_size.take()).unwrap_or_else(|| vec![1.0; axes]);
    for (found, key) in [(sizes.len(), "DimSize"), (spacing.len(), "ElementSpacing or ElementSize")] {
        ensure!(found == axes, "MetaImage {key} has {found} entries, but NDims says {axes}");
    }
    ensure!(
        header.channels == 1,
        "MetaImage ElementNumberOfChannels is {}, but only 1 is accepted; save one of the channels",
        header.channels
    );
    let ([x, y, z], spacing) = three_axes(&sizes, &spacing, &[])?;
    let dims = checked_dims([x, y, z])?;
    let mut notes = Vec::new();
    let mut read =
        |stream: Stream<'_>, begin, dims| voxels(stream, &header, begin, element, dims, &mut notes);
    let data = match (&header.several, header.data_file.as_str()) {
        (Some(several), _) => several.read(&sizes, companions, |stream, each| read(stream, 0, each))?,
        (None, "LOCAL" | "Local" | "local") => read(stream, header.length, dims)?,
        (None, name) => read(companions.open(name)?, 0, dims)?,
    };
    Ok(Parts { data, dims, spacing, name: None, notes })
}

/// Reads the voxels of one data file. `begin` is the number of bytes of this file that were read before:
/// those of the header if the voxels follow the header in the same file, else 0.
fn voxels(
    mut stream: Stream<'_>,
    header: &Header,
    begin: u64,
    element: Element,
    dims: [usize; 3],
    notes: &mut Vec<String>,
) -> Result<VolumeData> {
    match u64::try_from(header.header_size) {
        Ok(0) => {}
        Ok(size) if size < begin => bail!(
            "MetaImage HeaderSize is {size}, but the header alone has {begin} bytes; set HeaderSize to the \
             offset of the first voxel in bytes, or to -1"
        ),
        Ok(size) => stream.skip(size - begin)?,
        // The remaining cases have a HeaderSize of -1.
        Err(_) if !header.binary => {
            bail!("MetaImage HeaderSize -1 is accepted only for binary data; state the number of bytes")
        }
        // The voxels are compressed. They begin right after the header or at the start of the data file, so
        // nothing is skipped.
        Err(_) if header.compressed => {}
        // The voxels are the last bytes of the file.
        Err(_) => {
            let expected = byte_count(dims, element)?;
            if let Remaining::Exact(left) = stream.remaining() {
                stream.skip(left.saturating_sub(expected))?;
            }
        }
    }
    if header.compressed {
        stream = stream.inflate()?;
    }
    if !header.binary {
        return parse_voxels(&mut stream, dims, element);
    }
    let [binary, other] = header.big_endian;
    let endian = if binary.or(other).unwrap_or(false) { Endian::Big } else { Endian::Little };
    let data = read_voxels(&mut stream, dims, element, endian, None)?;
    notes.extend(expect_end(&mut stream, dims, element)?);
    Ok(data)
}

fn header(stream: &mut Stream<'_>) -> Result<Header> {
    let mut header = Header { channels: 1, binary: true, ..Header::default() };
    stream.skip_mark()?;
    for number in 1..=MAX_LINES {
        let Some(line) = stream.line()? else {
            bail!(
                "MetaImage header ends after {} lines without ElementDataFile, which closes it",
                number - 1
            );
        };
        let line = String::from_utf8_lossy(&line);
        if line.trim().is_empty() {
            continue;
        }
        let Some((key, value)) = line.split_once('=') else {
            bail!("MetaImage header line {number} is not \"Key = Value\"");
        };
        let (key, value) = (key.trim(), value.trim());
        let last = header.set(key, value).with_context(|| format!("MetaImage header line {number}"))?;
        if last {
            header.length = stream.position();
            if value.split_whitespace().next() == Some("LIST") {
                let several = Several::list(value, stream);
                header.several = Some(several.with_context(|| format!("MetaImage header line {number}"))?);
            }
            return Ok(header);
        }
    }
    bail!("MetaImage header has more than {MAX_LINES} lines without ElementDataFile, which closes it");
}

impl Header {
    /// Stores one entry; returns true if the entry closes the header.
    fn set(&mut self, key: &str, value: &str) -> Result<bool> {
        match key {
            "ObjectType" if !value.eq_ignore_ascii_case("image") => {
                bail!("ObjectType is {value:?}; accepted is Image");
            }
            "NDims" => {
                let axes = number(key, value)?;
                ensure!((1..=MAX_AXES).contains(&axes), "NDims is {axes}; 1 to {MAX_AXES} are possible");
                self.axes = Some(axes);
            }
            "DimSize" => self.sizes = Some(numbers(key, value, MAX_AXES)?),
            "ElementSpacing" => self.spacing = Some(numbers(key, value, MAX_AXES)?),
            "ElementSize" => self.element_size = Some(numbers(key, value, MAX_AXES)?),
            "ElementNumberOfChannels" => self.channels = number(key, value)?,
            "ElementType" => {
                let types: [&[&str]; 10] = [
                    &["MET_CHAR"],
                    &["MET_UCHAR"],
                    &["MET_SHORT"],
                    &["MET_USHORT"],
                    &["MET_INT", "MET_LONG"],
                    &["MET_UINT", "MET_ULONG"],
                    &["MET_LONG_LONG"],
                    &["MET_ULONG_LONG"],
                    &["MET_FLOAT"],
                    &["MET_DOUBLE"],
                ];
                let element = Element::named(types, value);
                self.element = Some(element.with_context(|| {
                    format!(
                        "ElementType {value:?} is not read; accepted are MET_CHAR to MET_ULONG_LONG, \
                         MET_FLOAT and MET_DOUBLE"
                    )
                })?);
            }
            "BinaryData" => self.binary = flag(key, value)?,
            "BinaryDataByteOrderMSB" => self.big_endian[0] = Some(flag(key, value)?),
            "ElementByteOrderMSB" => self.big_endian[1] = Some(flag(key, value)?),
            "CompressedData" => self.compressed = flag(key, value)?,
            "HeaderSize" => {
                self.header_size = number(key, value)?;
                ensure!(self.header_size >= -1, "HeaderSize is {value}; accepted are -1 and up");
            }
            "ElementDataFile" => {
                ensure!(!value.is_empty(), "ElementDataFile names no file");
                self.several = Several::pattern(value)?;
                self.data_file = value.to_owned();
                return Ok(true);
            }
            _ => {}
        }
        Ok(false)
    }
}

fn flag(key: &str, value: &str) -> Result<bool> {
    match value.as_bytes().first() {
        Some(b'T' | b't' | b'1' | b'Y' | b'y') => Ok(true),
        Some(b'F' | b'f' | b'0' | b'N' | b'n') => Ok(false),
        _ => bail!("{key} is {value:?}; accepted are True and False"),
    }
}
