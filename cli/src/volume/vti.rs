//! VTK XML image data (`.vti`): ascii, base64 in place, appended raw or base64, with or without zlib blocks.
//!
//! The active scalar array of the point data is read, else the first array with one component; where there is
//! no point data, the same of the cell data. Direction and origin are not used.
//!
//! The project's own reader: `vtkio` reads no appended raw data, which is what VTK writes by default
//! (`lab/scripts/readers`).

use super::element::{byte_count, parse_voxels, read_voxels};
use super::stream::Stream;
use super::{Element, Endian, Parts, checked_dims};
use anyhow::{Context, Result, bail};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use flate2::bufread::ZlibDecoder;
use quick_xml::events::{BytesStart, Event};
use quick_xml::{Reader, XmlVersion};
use std::borrow::Cow;
use std::io::Read;
use std::ops::Range;

/// One `DataArray`.
struct Array {
    name: Option<String>,
    element: Option<Element>,
    kind: String,
    components: u64,
    place: Place,
}

enum Place {
    Ascii(Range<usize>),
    Inline(Range<usize>),
    Appended(u64),
}

/// The arrays of the point or cell data.
#[derive(Default)]
struct Section {
    active: Option<String>,
    arrays: Vec<Array>,
}

struct File {
    big_endian: bool,
    wide_header: bool,
    compressed: bool,
    extent: [i64; 6],
    spacing: [f64; 3],
    points: Section,
    cells: Section,
    /// Encoding and first byte behind the underscore.
    appended: Option<(bool, usize)>,
}

pub(super) fn read(mut stream: Stream<'_>) -> Result<Parts> {
    let bytes = stream.all(u64::MAX - 1)?;
    let file = parse(&bytes)?;
    let (section, cells) =
        if file.points.arrays.is_empty() { (&file.cells, true) } else { (&file.points, false) };
    let array = choose(section)?;
    let shown = array.name.as_deref().unwrap_or("unnamed").to_owned();
    let mut sizes = [0u64; 3];
    for axis in 0..3 {
        let (low, high) = (file.extent[2 * axis], file.extent[2 * axis + 1]);
        let cells_along = high.checked_sub(low).filter(|n| *n >= 0);
        let Some(n) = cells_along else {
            bail!("VTK extent along {} is {low} to {high}, which holds no voxel", ["x", "y", "z"][axis]);
        };
        sizes[axis] = if cells { n as u64 } else { (n as u64).saturating_add(1) };
    }
    let dims = checked_dims(sizes)?;
    let Some(element) = array.element else {
        bail!(
            "array {shown:?} has type {:?}, which is not read; accepted are Int8 to UInt64, Float32 and \
             Float64",
            array.kind
        );
    };
    let endian = if file.big_endian { Endian::Big } else { Endian::Little };
    let expected = byte_count(dims, element)?;
    let data = match &array.place {
        Place::Ascii(range) => {
            let mut text = Stream::from_bytes(&bytes[range.clone()]);
            parse_voxels(&mut text, dims, element)
        }
        place => {
            let stored = match place {
                Place::Appended(offset) => {
                    let Some((base64, start)) = file.appended else {
                        bail!("array {shown:?} is appended, the file has no AppendedData; is it cut short?");
                    };
                    let rest = usize::try_from(*offset)
                        .ok()
                        .and_then(|offset| bytes.get(start.checked_add(offset)?..));
                    let Some(rest) = rest else {
                        bail!(
                            "array {shown:?} begins at byte {offset} of the appended data, which has {}; is \
                             the file cut short?",
                            bytes.len() - start
                        );
                    };
                    if base64 { Cow::Owned(decode_base64(rest)?) } else { Cow::Borrowed(rest) }
                }
                Place::Inline(range) | Place::Ascii(range) => {
                    Cow::Owned(decode_base64(&bytes[range.clone()])?)
                }
            };
            let voxels = if file.compressed {
                decompress(&stored, &file, expected)?
            } else {
                let (header, rest) = word(&stored, &file)?;
                if header != expected {
                    bail!(
                        "array {shown:?} has {header} bytes, {} x {} x {} voxels of {} bytes need {expected}",
                        dims[0],
                        dims[1],
                        dims[2],
                        element.bytes()
                    );
                }
                Cow::Borrowed(rest)
            };
            read_voxels(&mut Stream::from_bytes(&voxels), dims, element, endian)
        }
    }
    .with_context(|| format!("array {shown:?}"))?;
    Ok(Parts { data, dims, spacing: file.spacing, name: None })
}

/// The active array, else the first with one component.
fn choose(section: &Section) -> Result<&Array> {
    if let Some(active) = &section.active {
        match section.arrays.iter().find(|array| array.name.as_ref() == Some(active)) {
            Some(array) if array.components == 1 => return Ok(array),
            Some(array) => bail!(
                "the active scalar array {active:?} has {} components per voxel; one is accepted, save one \
                 component or its magnitude",
                array.components
            ),
            None => bail!("the active scalar array {active:?} is not in the file"),
        }
    }
    match section.arrays.iter().find(|array| array.components == 1) {
        Some(array) => Ok(array),
        None => match section.arrays.first() {
            Some(array) => bail!(
                "array {:?} has {} components per voxel; one is accepted, save one component or its \
                 magnitude",
                array.name.as_deref().unwrap_or("unnamed"),
                array.components
            ),
            None => bail!("the file has no point or cell data array"),
        },
    }
}

fn parse(bytes: &[u8]) -> Result<File> {
    let mut file = File {
        big_endian: false,
        wide_header: false,
        compressed: false,
        extent: [0, -1, 0, -1, 0, -1],
        spacing: [1.0; 3],
        points: Section::default(),
        cells: Section::default(),
        appended: None,
    };
    let mut reader = Reader::from_reader(bytes);
    let mut path: Vec<String> = Vec::new();
    let mut pieces = 0;
    let mut extent_found = false;
    loop {
        let event = match reader.read_event() {
            Ok(event) => event,
            Err(error) => bail!("not well-formed XML at byte {}: {error}", reader.error_position()),
        };
        let position = reader.buffer_position() as usize;
        let (tag, empty) = match &event {
            Event::Start(tag) => (tag, false),
            Event::Empty(tag) => (tag, true),
            Event::End(_) => {
                path.pop();
                continue;
            }
            Event::Eof => break,
            _ => continue,
        };
        let name = tag.name();
        let name = name.as_ref();
        let parent = path.last().map(String::as_str);
        match (parent, name) {
            (None, "VTKFile") => {
                let kind = attribute(tag, "type")?.unwrap_or_default();
                if kind != "ImageData" {
                    bail!("VTK file of type {kind:?}; accepted is ImageData (save a regular grid as .vti)");
                }
                file.big_endian = match attribute(tag, "byte_order")?.as_deref() {
                    None | Some("LittleEndian") => false,
                    Some("BigEndian") => true,
                    Some(other) => bail!("byte_order is {other:?}; accepted are LittleEndian and BigEndian"),
                };
                file.wide_header = match attribute(tag, "header_type")?.as_deref() {
                    None | Some("UInt32") => false,
                    Some("UInt64") => true,
                    Some(other) => bail!("header_type is {other:?}; accepted are UInt32 and UInt64"),
                };
                file.compressed = match attribute(tag, "compressor")?.as_deref() {
                    None | Some("") => false,
                    Some("vtkZLibDataCompressor") => true,
                    Some(other) => bail!("compressor {other:?} is not read; save with zlib or none"),
                };
            }
            (None, other) => bail!("not a VTK XML file: its first element is {other:?}, not VTKFile"),
            (Some("VTKFile"), "ImageData") => {
                if let Some(text) = attribute(tag, "WholeExtent")? {
                    file.extent = numbers("WholeExtent", &text)?;
                    extent_found = true;
                }
                if let Some(text) = attribute(tag, "Spacing")? {
                    file.spacing = numbers("Spacing", &text)?;
                }
            }
            (Some("ImageData"), "Piece") => {
                pieces += 1;
                if pieces > 1 {
                    bail!("the image is stored in several pieces; save it as one");
                }
                if let Some(text) = attribute(tag, "Extent")? {
                    file.extent = numbers("Extent", &text)?;
                    extent_found = true;
                }
            }
            (Some("Piece"), "PointData") => {
                file.points.active = attribute(tag, "Scalars")?.filter(|n| !n.is_empty())
            }
            (Some("Piece"), "CellData") => {
                file.cells.active = attribute(tag, "Scalars")?.filter(|n| !n.is_empty())
            }
            (Some(section @ ("PointData" | "CellData")), "DataArray") => {
                let points = section == "PointData";
                let array = array(tag, bytes, position, empty)?;
                if points { &mut file.points } else { &mut file.cells }.arrays.push(array);
            }
            (Some("VTKFile"), "AppendedData") if !empty => {
                let base64 = match attribute(tag, "encoding")?.as_deref() {
                    Some("raw") => false,
                    None | Some("base64") => true,
                    Some(other) => bail!("AppendedData encoding is {other:?}; accepted are raw and base64"),
                };
                let marker = bytes[position..].iter().position(|b| !b.is_ascii_whitespace());
                match marker {
                    Some(at) if bytes[position + at] == b'_' => {
                        file.appended = Some((base64, position + at + 1))
                    }
                    _ => bail!("AppendedData does not begin with an underscore; is the file cut short?"),
                }
                // What follows is not XML.
                break;
            }
            _ => {}
        }
        if !empty {
            if path.len() == 64 {
                bail!("XML elements are nested more than 64 deep");
            }
            path.push(name.to_owned());
        }
    }
    if !extent_found {
        bail!("the file has no ImageData with a WholeExtent; is it cut short?");
    }
    Ok(file)
}

fn array(tag: &BytesStart<'_>, bytes: &[u8], position: usize, empty: bool) -> Result<Array> {
    let name = attribute(tag, "Name")?;
    let shown = name.as_deref().unwrap_or("unnamed").to_owned();
    let kind = attribute(tag, "type")?.unwrap_or_default();
    let element = match kind.as_str() {
        "Int8" => Some(Element::I8),
        "UInt8" => Some(Element::U8),
        "Int16" => Some(Element::I16),
        "UInt16" => Some(Element::U16),
        "Int32" => Some(Element::I32),
        "UInt32" => Some(Element::U32),
        "Int64" => Some(Element::I64),
        "UInt64" => Some(Element::U64),
        "Float32" => Some(Element::F32),
        "Float64" => Some(Element::F64),
        _ => None,
    };
    let components = match attribute(tag, "NumberOfComponents")? {
        None => 1,
        Some(text) => match text.trim().parse() {
            // VTK writes 0 or nothing for plain scalars in some versions.
            Ok(0) => 1,
            Ok(n) => n,
            Err(_) => bail!("array {shown:?}: NumberOfComponents is {text:?}"),
        },
    };
    // The text up to the next tag.
    let inside = || {
        let length = if empty {
            0
        } else {
            bytes[position..].iter().position(|&b| b == b'<').unwrap_or(bytes.len() - position)
        };
        position..position + length
    };
    let place = match attribute(tag, "format")?.as_deref() {
        None | Some("ascii") => Place::Ascii(inside()),
        Some("binary") => Place::Inline(inside()),
        Some("appended") => {
            let offset = attribute(tag, "offset")?
                .with_context(|| format!("array {shown:?} is appended and has no offset"))?;
            match offset.trim().parse() {
                Ok(offset) => Place::Appended(offset),
                Err(_) => bail!("array {shown:?}: offset is {offset:?}"),
            }
        }
        Some(other) => bail!("array {shown:?}: format is {other:?}; accepted are ascii, binary and appended"),
    };
    Ok(Array { name, element, kind, components, place })
}

fn attribute(tag: &BytesStart<'_>, name: &str) -> Result<Option<String>> {
    for attribute in tag.attributes() {
        let attribute = match attribute {
            Ok(attribute) => attribute,
            Err(error) => bail!("broken XML attribute: {error}"),
        };
        if attribute.key.as_ref() == name {
            return match attribute.normalized_value(XmlVersion::Implicit1_0) {
                Ok(value) => Ok(Some(value.into_owned())),
                Err(error) => bail!("broken XML attribute {name:?}: {error}"),
            };
        }
    }
    Ok(None)
}

fn numbers<T: std::str::FromStr, const N: usize>(name: &str, text: &str) -> Result<[T; N]> {
    let found: Option<Vec<T>> = text.split_whitespace().take(N + 1).map(|word| word.parse().ok()).collect();
    match found.and_then(|found| found.try_into().ok()) {
        Some(found) => Ok(found),
        None => bail!("{name} is {text:?}; accepted are {N} numbers"),
    }
}

/// Bytes from base64 text: blanks are passed over, padding may end one part and another follow, and the text
/// ends at the first `<`. Within a part, header and data may share a group or not.
fn decode_base64(text: &[u8]) -> Result<Vec<u8>> {
    let end = text.iter().position(|&b| b == b'<').unwrap_or(text.len());
    let clean: Cow<'_, [u8]> = if text[..end].iter().any(u8::is_ascii_whitespace) {
        Cow::Owned(text[..end].iter().copied().filter(|b| !b.is_ascii_whitespace()).collect())
    } else {
        Cow::Borrowed(&text[..end])
    };
    let mut out = Vec::new();
    let mut rest: &[u8] = &clean;
    while !rest.is_empty() {
        let padding = rest.iter().position(|&b| b == b'=');
        let part = match padding {
            // To the end of the group of four that holds the padding.
            Some(at) => (at / 4 * 4 + 4).min(rest.len()),
            None => rest.len(),
        };
        if let Err(error) = STANDARD.decode_vec(&rest[..part], &mut out) {
            bail!("broken base64 text: {error}; is the file cut short?");
        }
        rest = &rest[part..];
    }
    Ok(out)
}

/// One number of a binary header, and what follows it.
fn word<'a>(bytes: &'a [u8], file: &File) -> Result<(u64, &'a [u8])> {
    let cut = || anyhow::anyhow!("the binary data ends within its header; the file is cut short");
    Ok(if file.wide_header {
        let (head, rest) = bytes.split_first_chunk::<8>().ok_or_else(cut)?;
        (if file.big_endian { u64::from_be_bytes(*head) } else { u64::from_le_bytes(*head) }, rest)
    } else {
        let (head, rest) = bytes.split_first_chunk::<4>().ok_or_else(cut)?;
        (u64::from(if file.big_endian { u32::from_be_bytes(*head) } else { u32::from_le_bytes(*head) }), rest)
    })
}

/// Decompresses zlib blocks: a header of block count, block size, size of the last block (0: a full one) and
/// the packed sizes, then the blocks.
fn decompress<'a>(bytes: &[u8], file: &File, expected: u64) -> Result<Cow<'a, [u8]>> {
    let (blocks, rest) = word(bytes, file)?;
    let (block, rest) = word(rest, file)?;
    let (last, mut sizes) = word(rest, file)?;
    let full = if last == 0 { blocks } else { blocks.saturating_sub(1) };
    let total = full.checked_mul(block).and_then(|n| n.checked_add(if blocks == 0 { 0 } else { last }));
    if total != Some(expected) {
        bail!(
            "the compressed blocks hold {blocks} x {block} (last {last}) bytes, the voxels need {expected}"
        );
    }
    let width = if file.wide_header { 8 } else { 4 };
    let table = blocks.checked_mul(width).filter(|n| *n <= sizes.len() as u64);
    let Some(table) = table else {
        bail!("the binary data ends within its table of {blocks} blocks; the file is cut short");
    };
    let mut packed = &sizes[table as usize..];
    let mut out = Vec::new();
    for index in 0..blocks {
        let (size, more) = word(sizes, file)?;
        sizes = more;
        let size = usize::try_from(size).ok().filter(|n| *n <= packed.len());
        let Some(size) = size else {
            bail!("compressed block {index} of {blocks} reaches beyond the data; the file is cut short");
        };
        let (this, more) = packed.split_at(size);
        packed = more;
        let wanted = if index + 1 == blocks && last != 0 { last } else { block };
        let before = out.len() as u64;
        // One byte more than wanted shows a block that holds too much.
        if let Err(error) = ZlibDecoder::new(this).take(wanted.saturating_add(1)).read_to_end(&mut out) {
            bail!("compressed block {index} of {blocks} is damaged: {error}");
        }
        let got = out.len() as u64 - before;
        if got != wanted {
            bail!(
                "compressed block {index} of {blocks} decompresses to {got} or more bytes, its header says \
                 {wanted}"
            );
        }
    }
    Ok(Cow::Owned(out))
}
