//! NRRD ("nearly raw raster data"): a text header of `field: value` lines, a blank line, and the voxels. The
//! field `data file` names another file with the voxels, or several (`LIST [axes]` with a name in each line
//! that follows, or `name%03d.raw FIRST LAST STEP [axes]`). Encodings raw, gzip, bzip2, hex and ascii are
//! read.
//!
//! A spacing of NaN, or a direction of `none` or NaN, is unknown; the spacing is then taken from the other
//! field: directions if the spacing is unknown, spacings if the directions of all axes are unknown. If both
//! are unknown, the spacing is 1, with a note. A direction of `none` or NaN beside directions of other axes
//! marks an axis that is not spatial.
//!
//! The project has its own reader, since the crate that reads NRRD, `bioformats` 0.1, reserves as much memory
//! as a header claims, and has no 64-bit integers.

use super::element::{byte_count, expect_end, parse_voxels, read_voxels};
use super::several::Several;
use super::stream::{Companions, Stream};
use super::{Element, Endian, Parts, VolumeData, checked_dims, number, numbers, three_axes};
use anyhow::{Context, Result, bail, ensure};

const MAX_LINES: usize = 1 << 14;
/// Largest number of axes: NRRD_DIM_MAX of the format's own library.
const MAX_AXES: usize = 16;

#[derive(Clone, Copy, PartialEq, Eq)]
enum Encoding {
    Raw,
    Gzip,
    Bzip2,
    Hex,
    Text,
}

#[derive(Default)]
struct Header {
    element: Option<Element>,
    dimension: Option<usize>,
    sizes: Option<Vec<u64>>,
    encoding: Option<Encoding>,
    endian: Option<Endian>,
    spacings: Option<Vec<f64>>,
    directions: Option<Vec<Option<f64>>>,
    kinds: Option<Vec<String>>,
    data_file: Option<String>,
    several: Option<Several>,
    byte_skip: i64,
    line_skip: u64,
}

pub(super) fn read(mut stream: Stream<'_>, companions: &dyn Companions) -> Result<Parts> {
    let mut header = header(&mut stream)?;
    let element = header.element.context("NRRD header has no \"type\" field")?;
    let dimension = header.dimension.context("NRRD header has no \"dimension\" field")?;
    let sizes = header.sizes.take().context("NRRD header has no \"sizes\" field")?;
    let encoding = header.encoding.context("NRRD header has no \"encoding\" field")?;
    for (found, field) in [
        (Some(sizes.len()), "sizes"),
        (header.spacings.as_ref().map(Vec::len), "spacings"),
        (header.directions.as_ref().map(Vec::len), "space directions"),
        (header.kinds.as_ref().map(Vec::len), "kinds"),
    ] {
        if let Some(found) = found
            && found != dimension
        {
            bail!("NRRD field \"{field}\" has {found} entries, but \"dimension\" says {dimension}");
        }
    }
    // If no axis has a direction, the field "space directions" is ignored.
    let directions = header.directions.as_ref().filter(|d| d.iter().any(Option::is_some));
    let spatial: Vec<bool> = (0..dimension)
        .map(|axis| {
            let placed = directions.is_none_or(|d| d[axis].is_some());
            let kind = header.kinds.as_ref().map_or("???", |k| k[axis].as_str());
            placed && matches!(kind, "domain" | "space" | "???" | "none")
        })
        .collect();
    let spacings: Vec<f64> = (0..dimension)
        .map(|axis| {
            let stated = header.spacings.as_ref().map_or(f64::NAN, |s| s[axis]);
            directions.and_then(|d| d[axis]).unwrap_or(stated)
        })
        .collect();
    let (file_sizes, stated) = (sizes, header.spacings.is_some() || header.directions.is_some());
    let (sizes, mut spacing) = three_axes(&file_sizes, &spacings, &spatial)?;
    let mut notes = Vec::new();
    for (value, axis) in spacing.iter_mut().zip(["x", "y", "z"]) {
        if value.is_nan() {
            *value = 1.0;
            if stated {
                notes.push(format!("the header says that the spacing along {axis} is not known; 1 is taken"));
            }
        }
    }
    let dims = checked_dims(sizes)?;
    let endian = match header.endian {
        Some(endian) => endian,
        None if element.bytes() == 1 || encoding == Encoding::Text => Endian::Little,
        None => bail!(
            "NRRD header has no \"endian\" field, which {} bytes per voxel need; add \"endian: little\" or \
             \"endian: big\"",
            element.bytes()
        ),
    };
    let mut read = |stream: Stream<'_>, dims| voxels(stream, &header, element, endian, dims, &mut notes);
    let data = match (&header.several, &header.data_file) {
        (Some(several), _) => several.read(&file_sizes, companions, read)?,
        (None, Some(name)) => read(companions.open(name)?, dims)?,
        (None, None) => read(stream, dims)?,
    };
    Ok(Parts { data, dims, spacing, name: None, notes })
}

/// Reads the voxels of one data file.
fn voxels(
    mut stream: Stream<'_>,
    header: &Header,
    element: Element,
    endian: Endian,
    dims: [usize; 3],
    notes: &mut Vec<String>,
) -> Result<VolumeData> {
    for _ in 0..header.line_skip {
        if stream.line()?.is_none() {
            bail!(
                "{}the header says to skip {} lines, but the file has fewer",
                stream.prefix(),
                header.line_skip
            );
        }
    }
    stream = match header.encoding {
        Some(Encoding::Gzip) => stream.gunzip(),
        Some(Encoding::Bzip2) => stream.bunzip(),
        Some(Encoding::Hex | Encoding::Text) if header.byte_skip < 0 => {
            bail!(
                "NRRD \"byte skip: {}\" is accepted only for binary encodings; state the number of bytes",
                header.byte_skip
            )
        }
        _ => stream,
    };
    match u64::try_from(header.byte_skip) {
        Ok(skip) => stream.skip(skip)?,
        // A skip of -1 means that the voxels are the last bytes; -5, that four bytes follow the voxels.
        Err(_) => {
            let behind = header.byte_skip.unsigned_abs() - 1;
            stream = stream.last(byte_count(dims, element)?, behind)?;
        }
    }
    match header.encoding {
        Some(Encoding::Text) => return parse_voxels(&mut stream, dims, element),
        Some(Encoding::Hex) => stream = stream.unhex(),
        _ => {}
    }
    let data = read_voxels(&mut stream, dims, element, endian, None)?;
    notes.extend(expect_end(&mut stream, dims, element)?);
    Ok(data)
}

fn header(stream: &mut Stream<'_>) -> Result<Header> {
    stream.skip_mark()?;
    let magic = stream.line()?.unwrap_or_default();
    match magic.as_slice() {
        [b'N', b'R', b'R', b'D', b'0', b'0', b'0', b'1'..=b'5'] => {}
        [b'N', b'R', b'R', b'D', ..] => {
            let version = String::from_utf8_lossy(&magic[..magic.len().min(40)]);
            bail!("NRRD version {version:?} is not known; accepted are NRRD0001 to NRRD0005")
        }
        _ => bail!("not a NRRD file: its first bytes are not \"NRRD\""),
    }
    let mut header = Header::default();
    let mut seen: Vec<String> = Vec::new();
    for number in 2.. {
        if number > MAX_LINES {
            bail!("NRRD header has more than {MAX_LINES} lines without a blank line that ends it");
        }
        let Some(line) = stream.line()? else { break };
        if line.is_empty() {
            break;
        }
        let line = String::from_utf8_lossy(&line);
        if line.starts_with('#') {
            continue;
        }
        // "field: value" describes the data, "key:=value" is user data; the first separator decides.
        let (field, value) = match (line.find(": "), line.find(":=")) {
            (Some(at), pair) if pair.is_none_or(|p| at < p) => (&line[..at], line[at + 2..].trim()),
            (_, Some(_)) => continue,
            _ => match line.strip_suffix(':') {
                Some(field) => (field, ""),
                None => bail!("NRRD header line {number} is neither \"field: value\" nor \"key:=value\""),
            },
        };
        let field = field.trim().to_ascii_lowercase();
        ensure!(!seen.contains(&field), "NRRD header line {number}: field \"{field}\" appears twice");
        header.set(&field, value).with_context(|| format!("NRRD header line {number}"))?;
        if field.replace(' ', "") == "datafile" && value.split_whitespace().next() == Some("LIST") {
            // Every further line is the name of a data file.
            let several = Several::list(value, stream);
            header.several = Some(several.with_context(|| format!("NRRD header line {number}"))?);
            break;
        }
        seen.push(field);
    }
    Ok(header)
}

impl Header {
    fn set(&mut self, field: &str, value: &str) -> Result<()> {
        match field {
            "type" => self.element = Some(element(value)?),
            "dimension" => {
                let dimension: usize = number(field, value)?;
                if !(1..=MAX_AXES).contains(&dimension) {
                    bail!("\"dimension\" is {dimension}; 1 to {MAX_AXES} are possible");
                }
                self.dimension = Some(dimension);
            }
            "sizes" => self.sizes = Some(numbers(field, value, MAX_AXES)?),
            "encoding" => {
                self.encoding = Some(match value.to_ascii_lowercase().as_str() {
                    "raw" => Encoding::Raw,
                    "gzip" | "gz" => Encoding::Gzip,
                    "bzip2" | "bz2" => Encoding::Bzip2,
                    "hex" => Encoding::Hex,
                    "ascii" | "text" | "txt" => Encoding::Text,
                    other => bail!("encoding {other:?} is not read; save as raw, gzip, bzip2, hex or ascii"),
                });
            }
            "endian" => {
                self.endian = Some(match value.to_ascii_lowercase().as_str() {
                    "little" => Endian::Little,
                    "big" => Endian::Big,
                    other => bail!("endian {other:?} is not known; accepted are little and big"),
                });
            }
            "spacings" => self.spacings = Some(numbers(field, value, MAX_AXES)?),
            "space directions" => self.directions = Some(directions(value)?),
            "kinds" => self.kinds = Some(value.split_whitespace().map(str::to_ascii_lowercase).collect()),
            "byte skip" | "byteskip" => self.byte_skip = number(field, value)?,
            "line skip" | "lineskip" => self.line_skip = number(field, value)?,
            "data file" | "datafile" => {
                ensure!(!value.is_empty(), "\"{field}\" names no file");
                self.several = Several::pattern(value)?;
                self.data_file = Some(value.to_owned());
            }
            _ => {}
        }
        Ok(())
    }
}

fn element(value: &str) -> Result<Element> {
    let types: [&[&str]; 10] = [
        &["signed char", "int8", "int8_t"],
        &["uchar", "unsigned char", "uint8", "uint8_t"],
        &["short", "short int", "signed short", "signed short int", "int16", "int16_t"],
        &["ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"],
        &["int", "signed int", "int32", "int32_t"],
        &["uint", "unsigned int", "uint32", "uint32_t"],
        &[
            "longlong",
            "long long",
            "long long int",
            "signed long long",
            "signed long long int",
            "int64",
            "int64_t",
        ],
        &["ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"],
        &["float"],
        &["double"],
    ];
    let words = value.to_ascii_lowercase().split_whitespace().collect::<Vec<_>>().join(" ");
    Element::named(types, &words).with_context(|| {
        format!("type {words:?} is not read; accepted are 8- to 64-bit integers, float and double")
    })
}

/// Returns the lengths of the vectors `(x,y,z)` in "space directions", one per axis; `None` for the word
/// `none` and for a vector with a NaN.
fn directions(value: &str) -> Result<Vec<Option<f64>>> {
    let mut found = Vec::new();
    let mut rest = value.trim();
    while !rest.is_empty() {
        ensure!(found.len() < MAX_AXES, "\"space directions\" has more than {MAX_AXES} entries");
        if let Some(after) = rest.strip_prefix("none") {
            found.push(None);
            rest = after.trim_start();
            continue;
        }
        let Some((inner, after)) = rest.strip_prefix('(').and_then(|r| r.split_once(')')) else {
            bail!("\"space directions\" has {rest:?} where a vector (x,y,z) or none is expected");
        };
        let mut length = 0.0f64;
        for word in inner.split(',') {
            length = length.hypot(number::<f64>("space directions", word.trim())?);
        }
        found.push(Some(length).filter(|length| !length.is_nan()));
        rest = after.trim_start();
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::super::{Folder, Format, Reading, Volume, VolumeData};
    use super::*;
    use flate2::{Compression, write::GzEncoder};
    use std::io::Write;

    fn open(bytes: &[u8]) -> Result<Volume> {
        let (stream, folder) = (Stream::from_bytes(bytes), Folder::new("none", None));
        Volume::read(Format::Nrrd, stream, "v.nrrd", &folder, &Reading::default())
    }

    fn message(bytes: &[u8]) -> String {
        format!("{:#}", open(bytes).unwrap_err())
    }

    fn with(fields: &str, data: &[u8]) -> Vec<u8> {
        [b"NRRD0004\n".as_slice(), fields.as_bytes(), b"\n", data].concat()
    }

    const PLAIN: &str = "type: uint8\ndimension: 3\nsizes: 2 3 4\nencoding: raw\n";

    #[test]
    fn comments_pairs_line_ends_and_spelling_are_taken_as_the_format_allows() {
        let data: Vec<u8> = (0..24).collect();
        let fields = "# made by hand\r\nType: unsigned   char\r\ndimension: 3\r\nsizes: 2 3 4\r\nkey: \
         of=x\r\nmy:=own: pair\r\nspace directions: (0,3,4) (1,0,0) (0,0,-2)\r\nencoding: \
         RAW\r\ncontent:\r\n\r";
        let volume = open(&with(fields, &data)).unwrap();
        assert_eq!((volume.dims(), volume.spacing()), ([2, 3, 4], [5.0, 1.0, 2.0]));
        assert_eq!(volume.data(), &VolumeData::U8(data));
    }

    #[test]
    fn skips_and_text_are_honored() {
        let data: Vec<u8> = (0..24).collect();
        let junk = [b"two\nlines\n###".as_slice(), &data].concat();
        let volume = open(&with(&format!("{PLAIN}line skip: 2\nbyte skip: 3\n"), &junk)).unwrap();
        assert_eq!(volume.data(), &VolumeData::U8(data.clone()));
        let volume = open(&with(&format!("{PLAIN}byte skip: -1\n"), &junk)).unwrap();
        assert_eq!(volume.data(), &VolumeData::U8(data.clone()));
        let text = data.iter().map(|v| format!("{v}\n")).collect::<String>();
        let ascii = PLAIN.replace("raw", "ascii").replace("uint8", "short");
        let volume = open(&with(&ascii, text.as_bytes())).unwrap();
        assert_eq!(volume.data(), &VolumeData::I16((0..24).collect()));
        assert!(message(&with(&ascii, text.replace("7", "x").as_bytes())).contains("number 7 is \"x\""));
        assert!(message(&with(&ascii, &text.as_bytes()[..50])).contains("of the 24 numbers"));
        assert!(message(&with(&ascii, &text.as_bytes()[..10])).contains("need at least 47 bytes"));
    }

    #[test]
    fn lies_are_named_with_what_was_expected_and_found() {
        let packed = PLAIN.replace("2 3 4", "10000 10000 10000").replace("raw", "bzip2");
        for (bytes, expected) in [
            (with(PLAIN, &[0; 23]), "need 24 bytes, but the file has 23"),
            (with(PLAIN, &[0; 48]), "need 24 bytes, but the data has 48"),
            (
                with(&PLAIN.replace("2 3 4", "10000 10000 10000"), &[0; 100]),
                "need 1000000000000 bytes, but the file has 100",
            ),
            (
                with(&PLAIN.replace("2 3 4", "10000 10000 10000").replace("raw", "gzip"), &[0; 100]),
                "can hold 103200 at most",
            ),
            (with(&packed, &[0; 100]), "can hold 419430400 at most"),
            (with(&packed, &[0; 1 << 20]), "can hold 4294967296 at most"),
            (
                with(&format!("{packed}byte skip: -1\n"), &[0; 100]),
                "1000000000000 bytes of voxels and 0 bytes after them, but at most 419430400 bytes follow",
            ),
            (
                with(&PLAIN.replace("2 3 4", "4294967296 4294967296 4294967296"), &[]),
                "more than can be addressed",
            ),
            // 2⁶³ fits into an unsigned 64-bit number, but is more voxels than a process can address.
            (with(&PLAIN.replace("2 3 4", "2097152 2097152 2097152"), &[]), "more than can be addressed"),
            (with(&PLAIN.replace("2 3 4", "2 0 4"), &[]), "size along y is 0"),
            (with(&PLAIN.replace("2 3 4", "2 -3 4"), &[]), "\"-3\" where a number"),
            (with(&PLAIN.replace("2 3 4", "2 3"), &[]), "\"sizes\" has 2 entries, but \"dimension\" says 3"),
            (with(&format!("{PLAIN}spacings: 1 0 1\n"), &[0; 24]), "finite and positive"),
            (with(&format!("{PLAIN}spacings: 1 -1 1\n"), &[0; 24]), "finite and positive"),
            (with(&format!("{PLAIN}sizes: 2 3 4\n"), &[0; 24]), "appears twice"),
            (with(&format!("{PLAIN}data file: gone.raw\n"), &[]), "gone.raw"),
            (
                with(&format!("{PLAIN}data file: LIST\na\nb\n"), &[]),
                "over 4 files of 2 axes each, but 2 are named",
            ),
            (with(&format!("{PLAIN}data file: LIST\n"), &[]), "followed by no file name"),
            (with(&format!("{PLAIN}data file: a%s 1 4 1\n"), &[]), "no pattern of file names"),
            (
                with(&format!("{PLAIN}byte skip: -3\n"), &[0; 25]),
                "24 bytes of voxels and 2 bytes after them, but 25 bytes",
            ),
            (with(&PLAIN.replace("raw", "hex"), b"00 0x"), "can hold 2 at most"),
            (with(&PLAIN.replace("raw", "hex"), &[b'x'; 48]), "no hexadecimal digit"),
            (with(&format!("{PLAIN}kinds: vector space space\n"), &[0; 24]), "axis 0 holds 2"),
            (with(&PLAIN.replace("uint8", "short"), &[0; 48]), "no \"endian\""),
            (with(&PLAIN.replace("uint8", "block"), &[0; 48]), "type \"block\" is not read"),
            (with(&PLAIN.replace("raw", "zrl"), &[0; 48]), "save as raw, gzip, bzip2, hex or ascii"),
            (with("dimension: 3\n", &[]), "no \"type\" field"),
            (with("what is this\n", &[]), "line 2 is neither"),
            (b"NRRD0009\n".to_vec(), "version \"NRRD0009\""),
            (b"NRRX".to_vec(), "not a NRRD file"),
            (Vec::new(), "not a NRRD file"),
            ([b"NRRD0004\n".as_slice(), &[b'a'; 1 << 17]].concat(), "longer than 65536 bytes"),
        ] {
            let message = message(&bytes);
            assert!(message.contains(expected), "{message:?} should contain {expected:?}");
            assert!(!message.contains('\n'), "{message:?}");
        }
    }

    #[test]
    fn compressed_data_is_bounded_by_what_the_header_calls_for() {
        let pack = |bytes: &[u8]| {
            let mut packed = GzEncoder::new(Vec::new(), Compression::best());
            packed.write_all(bytes).unwrap();
            packed.finish().unwrap()
        };
        let gzip = PLAIN.replace("raw", "gzip");
        assert_eq!(open(&with(&gzip, &pack(&[7; 24]))).unwrap().data(), &VolumeData::U8(vec![7; 24]));
        assert!(message(&with(&gzip, &pack(&[7; 1 << 24]))).contains("the data has 48 or more"));
        // Of 4 MiB of decompressed data, only the voxels at the end are kept.
        let end: Vec<u8> = (0..1 << 22).map(|i| (i % 251) as u8).collect();
        let last = open(&with(&format!("{gzip}byte skip: -3\n"), &pack(&end))).unwrap();
        assert_eq!(last.data(), &VolumeData::U8(end[end.len() - 26..end.len() - 2].to_vec()));
        let behind = open(&with(&gzip, &pack(&[7; 25]))).unwrap();
        assert!(behind.notes()[0].contains("1 bytes after the 24 bytes"), "{:?}", behind.notes());
        assert!(message(&with(&gzip, &pack(&[7; 20]))).contains("end after 20 of 24 bytes"));
        let whole = pack(&(0..24).collect::<Vec<u8>>());
        assert!(message(&with(&gzip, &whole[..whole.len() - 12])).contains("of 24"));
        assert!(!message(&with(&gzip, b"not gzip at all")).is_empty());
        let mut broken = whole;
        let at = broken.len() - 6;
        broken[at] ^= 0x55;
        assert!(!message(&with(&gzip, &broken)).is_empty());
    }
}
