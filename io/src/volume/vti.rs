//! VTK XML image data (`.vti`) in one piece or several. Arrays are ascii text, inline base64, appended base64
//! or appended raw bytes; binary arrays may be compressed in zlib or LZ4 blocks.
//!
//! The array is chosen in this order: the array that is named in the options; the active scalars of the
//! points, else of the cells; the first numeric array with one component among those of the points, else of
//! the cells, in the file's order. VTK's own arrays (`vtkGhostType` and the like) are read by name only.
//! Direction and origin are not used.
//!
//! The project has its own reader, since the crate `vtkio` 0.7 does not read appended raw data, which is
//! VTK's default.

use super::element::{byte_count, grow, parse_voxels, read_voxels};
use super::stream::Stream;
use super::{Element, Endian, Parts, VolumeData, checked_dims};
use crate::files::without_mark;
use anyhow::{Context, Result, anyhow, bail, ensure};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use flate2::bufread::ZlibDecoder;
use quick_xml::events::{BytesStart, Event};
use quick_xml::{Reader, XmlVersion};
use std::borrow::Cow;
use std::io::Read;
use std::ops::Range;

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

/// Names of VTK's own arrays, which are not read as active scalars.
const RESERVED_NAMES: &str = "vtkGhostType vtkGhostLevels vtkValidPointMask vtkOriginalPointIds \
                              vtkOriginalCellIds vtkOriginalIndices vtkInsidedness vtkProcessId";

/// Maximum number of pieces, more than any writer makes.
const MAX_PIECES: usize = 1 << 12;

#[derive(Clone, Copy, PartialEq, Eq)]
enum Compressor {
    None,
    Zlib,
    Lz4,
}

#[derive(Default)]
struct Section {
    active: Option<String>,
    /// Names of arrays that hold ids of points or cells.
    ids: Vec<String>,
    arrays: Vec<Array>,
}

struct Piece {
    extent: [i64; 6],
    points: Section,
    cells: Section,
}

struct File {
    endian: Endian,
    /// Bytes of a number in the header of a binary array: 4 or 8.
    width: u64,
    compressor: Compressor,
    extent: [i64; 6],
    spacing: [f64; 3],
    pieces: Vec<Piece>,
    /// Appended data: true if the data are base64 text, and the index of the first byte after the underscore
    /// that begins the data.
    appended: Option<(bool, usize)>,
}

pub(super) fn read(mut stream: Stream<'_>, name: Option<&str>) -> Result<Parts> {
    let bytes = stream.all(u64::MAX - 1)?;
    let bytes = without_mark(&bytes);
    let mut file = parse(bytes)?;
    file.pieces.retain(|piece| !piece.points.arrays.is_empty() || !piece.cells.arrays.is_empty());
    let first = file.pieces.first().context("the file has no point or cell data array")?;
    let mut notes = Vec::new();
    let (array, cells) = choose(first, name, &mut notes)?;
    if let [piece] = &file.pieces[..]
        && piece.extent == file.extent
    {
        let dims = checked_dims(sizes(piece.extent, cells)?)?;
        let data = voxels(bytes, &file, array, dims)?;
        return Ok(Parts { data, dims, spacing: file.spacing, name: None, notes });
    }
    // Pieces share the points of their borders; each voxel comes from at least one piece.
    let dims = checked_dims(sizes(file.extent, cells)?)?;
    // Upper bound of the voxels' bytes: the bytes of the whole file, decompressed. If many pieces refer to
    // the same data, their voxels exceed this bound and the file is refused. In text, one digit may state a
    // voxel of 8 bytes.
    let growth = match file.compressor {
        Compressor::None => 8,
        Compressor::Zlib => 1032,
        Compressor::Lz4 => LZ4_GROWTH,
    };
    let most = (bytes.len() as u64).saturating_mul(growth);
    let mut needed = 0u64;
    let mut parts = Vec::new();
    for piece in &file.pieces {
        let section = if cells { &piece.cells } else { &piece.points };
        let Some(own) = section.arrays.iter().find(|own| own.name == array.name) else {
            bail!("array {:?} is not in every piece of the file", shown(array));
        };
        if own.components != 1 || own.element != array.element {
            bail!(
                "array {:?} has another type or number of components in another piece of the file",
                shown(array)
            );
        }
        let part = checked_dims(sizes(piece.extent, cells)?)?;
        let mut at = [0usize; 3];
        for axis in 0..3 {
            let from = piece.extent[2 * axis].checked_sub(file.extent[2 * axis]);
            let from = from.and_then(|from| usize::try_from(from).ok());
            match from.filter(|from| from.checked_add(part[axis]).is_some_and(|end| end <= dims[axis])) {
                Some(from) => at[axis] = from,
                None => bail!(
                    "a piece of extent {:?} lies outside of WholeExtent {:?}",
                    piece.extent,
                    file.extent
                ),
            }
        }
        needed = needed.saturating_add(byte_count(part, array.element.unwrap_or(Element::U8))?);
        if needed > most {
            bail!("the pieces need {needed} bytes, but the file can hold {most} at most; is it cut short?");
        }
        parts.push((voxels(bytes, &file, own, part)?, at, part));
    }
    let total = dims[0] * dims[1] * dims[2];
    let stored = parts.iter().map(|(data, ..)| data.len()).fold(0, usize::saturating_add);
    ensure!(
        stored >= total,
        "the pieces hold {stored} of the {total} voxels of WholeExtent; are some of them in other files?"
    );
    let data = joined(&parts, dims)?;
    Ok(Parts { data, dims, spacing: file.spacing, name: None, notes })
}

fn shown(array: &Array) -> &str {
    array.name.as_deref().unwrap_or("unnamed")
}

/// Returns the number of points, or of cells, along each axis of an extent.
fn sizes(extent: [i64; 6], cells: bool) -> Result<[u64; 3]> {
    let mut sizes = [0u64; 3];
    for axis in 0..3 {
        let (low, high) = (extent[2 * axis], extent[2 * axis + 1]);
        let cells_along = high.checked_sub(low).filter(|n| *n >= 0);
        let Some(n) = cells_along else {
            bail!("VTK extent along {} is {low} to {high}, which holds no voxel", ["x", "y", "z"][axis]);
        };
        // An axis with one point has one layer of cells, as in VTK's images with two axes.
        sizes[axis] = if cells { (n as u64).max(1) } else { (n as u64).saturating_add(1) };
    }
    Ok(sizes)
}

/// Voxels of a piece, position of its first voxel in the volume, and its size in voxels.
type Part = (VolumeData, [usize; 3], [usize; 3]);

/// Copies the voxels of pieces, which must all have the same type, to their places in the volume.
fn joined(parts: &[Part], dims: [usize; 3]) -> Result<VolumeData> {
    macro_rules! place {
        ($variant:ident, $zero:expr) => {{
            let total = dims[0] * dims[1] * dims[2];
            let (mut all, mut there) = (Vec::new(), Vec::new());
            if all.try_reserve_exact(total).is_err() || there.try_reserve_exact(total).is_err() {
                bail!("{total} voxels do not fit into this machine's memory; scale the volume down");
            }
            all.resize(total, $zero);
            there.resize(total, false);
            for (data, at, part) in parts {
                let VolumeData::$variant(data) = data else {
                    bail!("the pieces hold voxels of different types");
                };
                for (row, values) in data.chunks_exact(part[0]).enumerate() {
                    let (y, z) = (at[1] + row % part[1], at[2] + row / part[1]);
                    let from = (z * dims[1] + y) * dims[0] + at[0];
                    all[from..from + part[0]].copy_from_slice(values);
                    there[from..from + part[0]].fill(true);
                }
            }
            let missing = there.iter().filter(|there| !**there).count();
            if missing > 0 {
                bail!("no piece of the file holds {missing} of the {total} voxels of WholeExtent");
            }
            VolumeData::$variant(all)
        }};
    }
    Ok(match parts.first().map(|(data, ..)| data) {
        Some(VolumeData::U8(_)) | None => place!(U8, 0),
        Some(VolumeData::U16(_)) => place!(U16, 0),
        Some(VolumeData::I16(_)) => place!(I16, 0),
        Some(VolumeData::F32(_)) => place!(F32, 0.0),
    })
}

fn voxels(bytes: &[u8], file: &File, array: &Array, dims: [usize; 3]) -> Result<VolumeData> {
    let shown = shown(array);
    let Some(element) = array.element else {
        bail!(
            "array {shown:?} has type {:?}, which is not read; accepted are Int8 to UInt64, Float32 and \
             Float64",
            array.kind
        );
    };
    let expected = byte_count(dims, element)?;
    let context = || format!("array {shown:?}");
    let stored: Cow<'_, [u8]> = match &array.place {
        Place::Ascii(range) => {
            let mut text = Stream::from_bytes(&bytes[range.clone()]);
            return parse_voxels(&mut text, dims, element).with_context(context);
        }
        Place::Inline(range) => {
            Cow::Owned(from_base64(&bytes[range.clone()], file, expected).with_context(context)?)
        }
        Place::Appended(offset) => {
            let Some((base64, start)) = file.appended else {
                bail!("array {shown:?} is appended, but the file has no AppendedData; is it cut short?");
            };
            let rest =
                usize::try_from(*offset).ok().and_then(|offset| bytes.get(start.checked_add(offset)?..));
            let rest = rest.with_context(|| {
                let length = bytes.len() - start;
                format!(
                    "array {shown:?} begins at byte {offset} of the appended data, which has {length} bytes; \
                     is the file cut short?"
                )
            })?;
            match base64 {
                true => Cow::Owned(from_base64(rest, file, expected).with_context(context)?),
                false => Cow::Borrowed(rest),
            }
        }
    };
    let voxels = if file.compressor != Compressor::None {
        Cow::Owned(decompress(&stored, file, expected).with_context(context)?)
    } else {
        let (header, rest) = word(&stored, file).with_context(context)?;
        ensure!(
            header == expected,
            "array {shown:?} has {header} bytes, but {} x {} x {} voxels of {} bytes need {expected}",
            dims[0],
            dims[1],
            dims[2],
            element.bytes()
        );
        Cow::Borrowed(rest)
    };
    read_voxels(&mut Stream::from_bytes(&voxels), dims, element, file.endian, None).with_context(context)
}

impl Section {
    /// True if an array may be chosen as the volume by default.
    fn offers(&self, array: &Array) -> bool {
        // Names that begin with vtk and a capital letter are VTK's own.
        let own = |name: &String| {
            name.strip_prefix("vtk").is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_uppercase()))
                || self.ids.contains(name)
        };
        array.components == 1 && array.element.is_some() && !array.name.as_ref().is_some_and(own)
    }

    /// Returns the name of the active scalars, unless it is one of VTK's own.
    fn active(&self) -> Option<&String> {
        self.active
            .as_ref()
            .filter(|name| RESERVED_NAMES.split(' ').all(|reserved| reserved != name.as_str()))
    }
}

/// Returns the array to read, and true if it is cell data.
fn choose<'a>(piece: &'a Piece, name: Option<&str>, notes: &mut Vec<String>) -> Result<(&'a Array, bool)> {
    let sections = [(&piece.points, false), (&piece.cells, true)];
    let all = || sections.iter().flat_map(|&(s, cells)| s.arrays.iter().map(move |array| (s, array, cells)));
    let names = |of: &dyn Fn(&Section, &Array) -> bool| {
        let names: Vec<_> =
            all().filter(|(s, a, _)| of(s, a)).map(|(_, a, _)| format!("{:?}", shown(a))).collect();
        if names.is_empty() { "none".to_owned() } else { names.join(", ") }
    };
    if let Some(name) = name {
        return match all().find(|(_, array, _)| array.name.as_deref() == Some(name)) {
            Some((_, array, cells)) if array.components == 1 => Ok((array, cells)),
            Some((_, array, _)) => Err(several_components(array)),
            None => bail!("array {name:?} is not in the file; the file has {}", names(&|_, _| true)),
        };
    }
    let mut refused = None;
    for (section, cells) in sections {
        let Some(active) = section.active() else { continue };
        match section.arrays.iter().find(|array| array.name.as_ref() == Some(active)) {
            Some(array) if array.components == 1 => return Ok((array, cells)),
            found => refused = refused.or(Some((active, found))),
        }
    }
    match refused {
        Some((active, Some(array))) => bail!(
            "the active scalar array {active:?} has {} components per voxel, but only 1 is accepted; save \
             one component, or the magnitude, or make another array active. Arrays with one component: {}",
            array.components,
            names(&Section::offers)
        ),
        Some((active, None)) => bail!("the active scalar array {active:?} is not in the file"),
        None => {}
    }
    let mut offered = all().filter(|(section, array, _)| section.offers(array));
    if let Some((_, array, cells)) = offered.next() {
        if offered.next().is_some() {
            notes.push(format!(
                "no array is marked as the active scalars; {:?} is read, the first of {}",
                shown(array),
                names(&Section::offers)
            ));
        }
        return Ok((array, cells));
    }
    match all().find(|(_, array, _)| array.components != 1).or_else(|| all().next()) {
        Some((_, array, _)) if array.components != 1 => Err(several_components(array)),
        Some(_) => bail!("the file has no array of numbers except VTK's own ({})", names(&|_, _| true)),
        None => bail!("the file has no point or cell data array"),
    }
}

fn several_components(array: &Array) -> anyhow::Error {
    anyhow!(
        "array {:?} has {} components per voxel, but only 1 is accepted; save one component, or the \
         magnitude",
        shown(array),
        array.components
    )
}

fn parse(bytes: &[u8]) -> Result<File> {
    let mut file = File {
        endian: Endian::Little,
        width: 4,
        compressor: Compressor::None,
        extent: [0, -1, 0, -1, 0, -1],
        spacing: [1.0; 3],
        pieces: Vec::new(),
        appended: None,
    };
    let mut reader = Reader::from_reader(bytes);
    let mut path: Vec<String> = Vec::new();
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
                    bail!(
                        "VTK file of type {kind:?}, but only ImageData is accepted; save a regular grid as \
                         .vti"
                    );
                }
                file.endian = match attribute(tag, "byte_order")?.as_deref() {
                    None | Some("LittleEndian") => Endian::Little,
                    Some("BigEndian") => Endian::Big,
                    Some(other) => bail!("byte_order is {other:?}; accepted are LittleEndian and BigEndian"),
                };
                file.width = match attribute(tag, "header_type")?.as_deref() {
                    None | Some("UInt32") => 4,
                    Some("UInt64") => 8,
                    Some(other) => bail!("header_type is {other:?}; accepted are UInt32 and UInt64"),
                };
                file.compressor = match attribute(tag, "compressor")?.as_deref() {
                    None | Some("") => Compressor::None,
                    Some("vtkZLibDataCompressor") => Compressor::Zlib,
                    Some("vtkLZ4DataCompressor") => Compressor::Lz4,
                    Some(other) => bail!(
                        "compressor {other:?} is not read; accepted are vtkZLibDataCompressor, \
                         vtkLZ4DataCompressor and none: read the file with VTK's vtkXMLImageDataReader and \
                         write it with vtkXMLImageDataWriter after its SetCompressorTypeToZLib()"
                    ),
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
                let mut extent = file.extent;
                if let Some(text) = attribute(tag, "Extent")? {
                    extent = numbers("Extent", &text)?;
                    if !extent_found {
                        // Without a WholeExtent, the piece is the image.
                        file.extent = extent;
                        extent_found = true;
                    }
                }
                if file.pieces.len() == MAX_PIECES {
                    bail!("the image is stored in more than {MAX_PIECES} pieces; save it as one");
                }
                file.pieces.push(Piece { extent, points: Section::default(), cells: Section::default() });
            }
            (Some("Piece"), section @ ("PointData" | "CellData")) => {
                if let Some(section) = file.section(section) {
                    section.active = attribute(tag, "Scalars")?.filter(|n| !n.is_empty());
                    for key in ["GlobalIds", "PedigreeIds", "ProcessIds"] {
                        section.ids.extend(attribute(tag, key)?);
                    }
                }
            }
            (Some(section @ ("PointData" | "CellData")), "DataArray") => {
                let array = array(tag, bytes, position, empty)?;
                if let Some(section) = file.section(section) {
                    section.arrays.push(array);
                }
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
                // The appended data follow, which are not XML.
                break;
            }
            _ => {}
        }
        if !empty {
            ensure!(path.len() < 64, "XML elements are nested more than 64 deep");
            path.push(name.to_owned());
        }
    }
    ensure!(extent_found, "the file has no ImageData with a WholeExtent; is it cut short?");
    Ok(file)
}

impl File {
    /// Returns a section of the current piece.
    fn section(&mut self, name: &str) -> Option<&mut Section> {
        let piece = self.pieces.last_mut()?;
        Some(if name == "PointData" { &mut piece.points } else { &mut piece.cells })
    }
}

fn array(tag: &BytesStart<'_>, bytes: &[u8], position: usize, empty: bool) -> Result<Array> {
    let name = attribute(tag, "Name")?;
    let shown = name.as_deref().unwrap_or("unnamed").to_owned();
    let kind = attribute(tag, "type")?.unwrap_or_default();
    let types =
        ["Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Float32", "Float64"];
    let element = Element::named(types.each_ref().map(std::slice::from_ref), &kind);
    let components = match attribute(tag, "NumberOfComponents")? {
        None => 1,
        Some(text) => {
            let stated = text.trim().parse::<u64>().ok();
            // Some versions of VTK write 0 or nothing for plain scalars.
            stated
                .with_context(|| format!("array {shown:?}: NumberOfComponents {text:?} is no number"))?
                .max(1)
        }
    };
    // Returns the place of the text up to the next tag.
    let inside = || {
        let text = if empty { &bytes[..0] } else { &bytes[position..] };
        position..position + text.iter().position(|&b| b == b'<').unwrap_or(text.len())
    };
    let place = match attribute(tag, "format")?.as_deref() {
        None | Some("ascii") => Place::Ascii(inside()),
        Some("binary") => Place::Inline(inside()),
        Some("appended") => {
            let offset = attribute(tag, "offset")?
                .with_context(|| format!("array {shown:?} is appended and has no offset"))?;
            let at = offset.trim().parse().ok();
            Place::Appended(at.with_context(|| {
                format!("array {shown:?}: offset is {offset:?}; a number of bytes is expected")
            })?)
        }
        Some(other) => bail!("array {shown:?}: format is {other:?}; accepted are ascii, binary and appended"),
    };
    Ok(Array { name, element, kind, components, place })
}

fn attribute(tag: &BytesStart<'_>, name: &str) -> Result<Option<String>> {
    for attribute in tag.attributes() {
        let attribute = attribute.map_err(|error| anyhow!("broken XML attribute: {error}"))?;
        if attribute.key.as_ref() == name {
            let value = attribute.normalized_value(XmlVersion::Implicit1_0);
            let value = value.map_err(|error| anyhow!("broken XML attribute {name:?}: {error}"))?;
            return Ok(Some(value.into_owned()));
        }
    }
    Ok(None)
}

fn numbers<T: std::str::FromStr, const N: usize>(name: &str, text: &str) -> Result<[T; N]> {
    let found: Option<Vec<T>> = text.split_whitespace().take(N + 1).map(|word| word.parse().ok()).collect();
    let found = found.and_then(|found| found.try_into().ok());
    found.with_context(|| format!("{name} is {text:?}; accepted are {N} numbers"))
}

/// Decodes the header and the data of one array from base64 text, which other arrays may follow.
fn from_base64(text: &[u8], file: &File, expected: u64) -> Result<Vec<u8>> {
    let width = file.width;
    let mut needed = expected.saturating_add(width);
    if file.compressor != Compressor::None {
        let (blocks, _) = word(&decode_base64(text, width)?, file)?;
        let header = blocks.saturating_mul(width).saturating_add(3 * width);
        let bytes = decode_base64(text, header)?;
        let mut table = bytes.get(3 * width as usize..).unwrap_or_default();
        needed = header;
        for _ in 0..blocks {
            let Ok((size, more)) = word(table, file) else { break };
            needed = needed.saturating_add(size);
            table = more;
        }
    }
    decode_base64(text, needed)
}

/// Decodes base64 text, which ends at the first `<`, to at least `needed` bytes if there are as many. Blanks
/// are skipped. Header and data are encoded as one part or as two; padding may end each part.
fn decode_base64(text: &[u8], needed: u64) -> Result<Vec<u8>> {
    // Each part ends in a group of four letters that may hold fewer than three bytes.
    let letters = usize::try_from(needed / 3 + 3).unwrap_or(usize::MAX).saturating_mul(4);
    let clean: Vec<u8> = text
        .iter()
        .copied()
        .take_while(|&b| b != b'<')
        .filter(|b| !b.is_ascii_whitespace())
        .take(letters)
        .collect();
    let mut out = Vec::new();
    let mut rest: &[u8] = &clean;
    while !rest.is_empty() {
        let padding = rest.iter().position(|&b| b == b'=');
        let part = match padding {
            // The part ends with the group of four letters that holds the padding.
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

/// Returns one number of a binary header, and the bytes after it.
fn word<'a>(bytes: &'a [u8], file: &File) -> Result<(u64, &'a [u8])> {
    let (head, rest) = bytes
        .split_at_checked(file.width as usize)
        .context("the binary data ends within its header; the file is cut short")?;
    let add = |number: u64, byte: &u8| number << 8 | u64::from(*byte);
    Ok(match file.endian {
        Endian::Little => (head.iter().rfold(0, add), rest),
        Endian::Big => (head.iter().fold(0, add), rest),
    })
}

/// Upper bound of decompressed bytes per compressed byte of an LZ4 block.
const LZ4_GROWTH: u64 = 255;

/// Decompresses blocks. The header has the number of blocks, the size of a decompressed block, that of the
/// last block (0: a full block), and the compressed size of each block; the compressed blocks follow.
fn decompress(bytes: &[u8], file: &File, expected: u64) -> Result<Vec<u8>> {
    let (blocks, rest) = word(bytes, file)?;
    let (block, rest) = word(rest, file)?;
    let (last, mut sizes) = word(rest, file)?;
    let full = if last == 0 { blocks } else { blocks.saturating_sub(1) };
    let total = full.checked_mul(block).and_then(|n| n.checked_add(if blocks == 0 { 0 } else { last }));
    ensure!(
        total == Some(expected),
        "the header states {blocks} blocks of {block} bytes (last block: {last}, 0 for a full one), but the \
         voxels need {expected} bytes"
    );
    let table = blocks.checked_mul(file.width).filter(|n| *n <= sizes.len() as u64);
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
        if file.compressor == Compressor::Lz4 {
            ensure!(
                wanted <= (this.len() as u64).saturating_mul(LZ4_GROWTH),
                "compressed block {index} of {blocks} has {} bytes, too few for the {wanted} bytes that the \
                     header states",
                this.len()
            );
            grow(&mut out, wanted as usize, expected as usize)?;
            let from = out.len();
            out.resize(from + wanted as usize, 0);
            match lz4_flex::block::decompress_into(this, &mut out[from..]) {
                Ok(got) if got as u64 == wanted => continue,
                Ok(got) => bail!(
                    "compressed block {index} of {blocks} decompresses to {got} bytes, but the header says \
                     {wanted}"
                ),
                Err(error) => bail!("compressed block {index} of {blocks} is damaged: {error}"),
            }
        }
        // One more byte than expected reveals a block that holds too much.
        if let Err(error) = ZlibDecoder::new(this).take(wanted.saturating_add(1)).read_to_end(&mut out) {
            bail!("compressed block {index} of {blocks} is damaged: {error}");
        }
        let got = out.len() as u64 - before;
        ensure!(
            got == wanted,
            "compressed block {index} of {blocks} decompresses to {got} or more bytes, but the header says \
                 {wanted}"
        );
    }
    Ok(out)
}
