//! Scalar types in files, and conversion of their bytes to voxels.

use super::VolumeData;
use super::stream::{Remaining, Stream};
use anyhow::{Context, Result, bail};
use std::io::{self, Read};

/// The scalar types that files hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Element {
    /// Signed bytes.
    I8,
    /// Unsigned bytes.
    U8,
    /// Signed 16-bit integers.
    I16,
    /// Unsigned 16-bit integers.
    U16,
    /// Signed 32-bit integers.
    I32,
    /// Unsigned 32-bit integers.
    U32,
    /// Signed 64-bit integers.
    I64,
    /// Unsigned 64-bit integers.
    U64,
    /// 32-bit floats.
    F32,
    /// 64-bit floats.
    F64,
}

impl Element {
    /// Returns the number of bytes per element in the file.
    pub(crate) const fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }
}

/// Byte order of stored numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Endian {
    /// Least significant byte first.
    Little,
    /// Most significant byte first.
    Big,
}

/// Returns the number of bytes that the voxels occupy in the file.
pub(crate) fn byte_count(dims: [usize; 3], element: Element) -> Result<u64> {
    dims.iter()
        .try_fold(element.bytes() as u64, |product, &n| product.checked_mul(n as u64))
        .context("the sizes in the header multiply to more bytes than can be addressed")
}

/// Reads the voxels of a volume; memory grows with the received bytes.
///
/// # Errors
/// When there are fewer bytes than sizes and type require, or the compressed data is broken; the error states
/// the numbers of bytes expected and found.
pub(crate) fn read_voxels(
    stream: &mut Stream<'_>,
    dims: [usize; 3],
    element: Element,
    endian: Endian,
) -> Result<VolumeData> {
    check_length(stream, dims, element)?;
    let voxels = dims[0] * dims[1] * dims[2];
    macro_rules! convert {
        ($variant:ident, $stored:ty, |$v:ident| $converted:expr) => {
            VolumeData::$variant(match endian {
                Endian::Little => collect(stream, voxels, |b| {
                    let $v = <$stored>::from_le_bytes(b);
                    $converted
                })?,
                Endian::Big => collect(stream, voxels, |b| {
                    let $v = <$stored>::from_be_bytes(b);
                    $converted
                })?,
            })
        };
    }
    Ok(match element {
        Element::U8 => VolumeData::U8(bytes(stream, voxels)?),
        Element::I8 => convert!(I16, i8, |v| i16::from(v)),
        Element::U16 => convert!(U16, u16, |v| v),
        Element::I16 => convert!(I16, i16, |v| v),
        Element::I32 => convert!(F32, i32, |v| v as f32),
        Element::U32 => convert!(F32, u32, |v| v as f32),
        Element::I64 => convert!(F32, i64, |v| v as f32),
        Element::U64 => convert!(F32, u64, |v| v as f32),
        Element::F32 => convert!(F32, f32, |v| v),
        Element::F64 => convert!(F32, f64, |v| v as f32),
    })
}

/// Reads voxels as [`read_voxels`] does; a voxel's value is its stored `number * slope + intercept`, rounded
/// once.
///
/// # Errors
/// Those of [`read_voxels`].
pub(crate) fn read_scaled_voxels(
    stream: &mut Stream<'_>,
    dims: [usize; 3],
    element: Element,
    endian: Endian,
    slope: f64,
    intercept: f64,
) -> Result<VolumeData> {
    check_length(stream, dims, element)?;
    let voxels = dims[0] * dims[1] * dims[2];
    let scale = |value: f64| (value * slope + intercept) as f32;
    macro_rules! convert {
        ($stored:ty) => {
            match endian {
                Endian::Little => collect(stream, voxels, |b| scale(<$stored>::from_le_bytes(b) as f64))?,
                Endian::Big => collect(stream, voxels, |b| scale(<$stored>::from_be_bytes(b) as f64))?,
            }
        };
    }
    Ok(VolumeData::F32(match element {
        Element::U8 => convert!(u8),
        Element::I8 => convert!(i8),
        Element::U16 => convert!(u16),
        Element::I16 => convert!(i16),
        Element::U32 => convert!(u32),
        Element::I32 => convert!(i32),
        Element::U64 => convert!(u64),
        Element::I64 => convert!(i64),
        Element::F32 => convert!(f32),
        Element::F64 => convert!(f64),
    }))
}

/// Refuses a stream that cannot hold the voxels.
fn check_length(stream: &Stream<'_>, dims: [usize; 3], element: Element) -> Result<()> {
    let expected = byte_count(dims, element)?;
    match stream.remaining() {
        Remaining::Exact(found) if found < expected => bail!(
            "{}{} x {} x {} voxels of {} byte{} need {expected} bytes, the file has {found}; it is cut short \
             or its header is wrong",
            stream.prefix(),
            dims[0],
            dims[1],
            dims[2],
            element.bytes(),
            if element.bytes() == 1 { "" } else { "s" }
        ),
        Remaining::AtMost(most) if most < expected => bail!(
            "{}{} x {} x {} voxels of {} byte{} need {expected} bytes, the compressed data can hold {most} \
             at most; it is cut short or its header is wrong",
            stream.prefix(),
            dims[0],
            dims[1],
            dims[2],
            element.bytes(),
            if element.bytes() == 1 { "" } else { "s" }
        ),
        _ => {}
    }
    Ok(())
}

/// Checks the bytes after the voxels. If fewer bytes follow than the voxels occupy, they are ignored, and a
/// note about them is returned.
///
/// # Errors
/// When at least as many bytes follow as the voxels have: sizes or type in the header do not fit the
/// data, or a second volume follows.
pub(crate) fn expect_end(
    stream: &mut Stream<'_>,
    dims: [usize; 3],
    element: Element,
) -> Result<Option<String>> {
    let prefix = stream.prefix();
    let expected = byte_count(dims, element)?;
    let behind = match stream.remaining() {
        Remaining::Exact(left) => left,
        Remaining::AtMost(_) => io::copy(&mut stream.take(expected), &mut io::sink())
            .with_context(|| format!("{prefix}after the voxels"))?,
    };
    if behind == 0 {
        return Ok(None);
    }
    let [x, y, z] = dims;
    let size = element.bytes();
    let bytes = if size == 1 { "byte" } else { "bytes" };
    if behind >= expected {
        let found = match stream.remaining() {
            Remaining::Exact(_) => (expected + behind).to_string(),
            Remaining::AtMost(_) => format!("{} or more", expected + behind),
        };
        bail!(
            "{prefix}{x} x {y} x {z} voxels of {size} {bytes} need {expected} bytes, the data has {found}; check \
             sizes and type in the header, and save a second volume to a file of its own"
        );
    }
    Ok(Some(format!(
        "{prefix}{behind} bytes after the {expected} bytes of {x} x {y} x {z} voxels of {size} {bytes} are \
         left out; check sizes and type in the header if no bytes should follow"
    )))
}

/// Number of bytes that are read and converted at a time.
const CHUNK: usize = 1 << 16;

fn bytes(stream: &mut Stream<'_>, voxels: usize) -> Result<Vec<u8>> {
    let mut out: Vec<u8> = Vec::new();
    start(&mut out, stream, voxels)?;
    while out.len() < voxels {
        let more = CHUNK.min(voxels - out.len());
        grow(&mut out, more, voxels)?;
        let from = out.len();
        out.resize(from + more, 0);
        let got = fill(stream, &mut out[from..]).map_err(|error| broken(stream, &error, from, voxels, 1))?;
        if got < more {
            return Err(short(stream, from + got, voxels, 1));
        }
    }
    Ok(out)
}

fn collect<const BYTES: usize, T>(
    stream: &mut Stream<'_>,
    voxels: usize,
    convert: impl Fn([u8; BYTES]) -> T,
) -> Result<Vec<T>> {
    let mut out: Vec<T> = Vec::new();
    start(&mut out, stream, voxels)?;
    let mut buffer = vec![0u8; CHUNK.min(voxels * BYTES)];
    while out.len() < voxels {
        let more = (CHUNK / BYTES).min(voxels - out.len());
        grow(&mut out, more, voxels)?;
        let part = &mut buffer[..more * BYTES];
        let got =
            fill(stream, part).map_err(|error| broken(stream, &error, out.len() * BYTES, voxels, BYTES))?;
        if got < part.len() {
            return Err(short(stream, out.len() * BYTES + got, voxels, BYTES));
        }
        out.extend(part.as_chunks::<BYTES>().0.iter().map(|&b| convert(b)));
    }
    Ok(out)
}

/// Reserves all memory at once if the bytes are known to exist.
fn start<T>(out: &mut Vec<T>, stream: &Stream<'_>, voxels: usize) -> Result<()> {
    if matches!(stream.remaining(), Remaining::Exact(_)) {
        reserve(out, voxels)?;
    }
    Ok(())
}

/// Reserves space for `more` elements; the capacity at least doubles, but not beyond `total`.
pub(crate) fn grow<T>(out: &mut Vec<T>, more: usize, total: usize) -> Result<()> {
    let needed = out.len() + more;
    if needed > out.capacity() {
        let target = total.min(needed.max(out.capacity().saturating_mul(2)));
        reserve(out, target.max(needed) - out.len())?;
    }
    Ok(())
}

fn reserve<T>(out: &mut Vec<T>, more: usize) -> Result<()> {
    if out.try_reserve_exact(more).is_err() {
        bail!(
            "{} bytes of voxels do not fit into this machine's memory; scale the volume down",
            (out.len() + more).saturating_mul(size_of::<T>())
        );
    }
    Ok(())
}

/// Reads until `out` is full or the stream ends; returns the number of bytes.
fn fill(stream: &mut Stream<'_>, out: &mut [u8]) -> io::Result<usize> {
    let mut filled = 0;
    while filled < out.len() {
        match stream.read(&mut out[filled..]) {
            Ok(0) => break,
            Ok(count) => filled += count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            // A compressed stream that ends early.
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => break,
            Err(error) => return Err(error),
        }
    }
    Ok(filled)
}

fn short(stream: &Stream<'_>, got: usize, voxels: usize, bytes: usize) -> anyhow::Error {
    anyhow::anyhow!(
        "{}the voxels end after {got} of {} bytes; the file is cut short or its header is wrong",
        stream.prefix(),
        voxels * bytes
    )
}

fn broken(stream: &Stream<'_>, error: &io::Error, at: usize, voxels: usize, bytes: usize) -> anyhow::Error {
    anyhow::anyhow!(
        "{}the voxels cannot be read after byte {at} of {}: {error}; the file is damaged",
        stream.prefix(),
        voxels * bytes
    )
}

/// Reads voxels from numbers in text, separated by whitespace (or commas). A whole-number type takes whole
/// numbers only.
///
/// # Errors
/// When there are fewer or more numbers than voxels, or a number cannot be read or is outside the type's
/// range; the error names the number's index.
pub(crate) fn parse_voxels(
    stream: &mut Stream<'_>,
    dims: [usize; 3],
    element: Element,
) -> Result<VolumeData> {
    let voxels = dims[0] * dims[1] * dims[2];
    // A number and the blank behind it take at least two bytes.
    let (Remaining::Exact(most) | Remaining::AtMost(most)) = stream.remaining();
    if most.saturating_add(1) / 2 < voxels as u64 {
        bail!(
            "{}{} x {} x {} voxels as text need at least {} bytes, the data has {most}; it is cut short or \
             its header is wrong",
            stream.prefix(),
            dims[0],
            dims[1],
            dims[2],
            (voxels as u64).saturating_mul(2) - 1
        );
    }
    macro_rules! whole {
        ($variant:ident, $stored:ty, |$v:ident| $converted:expr) => {
            VolumeData::$variant(parse(stream, voxels, |text| {
                // Some writers put a decimal point into whole numbers.
                let $v: $stored = match text.parse() {
                    Ok(v) => v,
                    Err(_) => {
                        let f: f64 = text.parse().ok()?;
                        let inside =
                            f.fract() == 0.0 && f >= <$stored>::MIN as f64 && f <= <$stored>::MAX as f64;
                        if !inside {
                            return None;
                        }
                        f as $stored
                    }
                };
                Some($converted)
            })?)
        };
    }
    Ok(match element {
        Element::U8 => whole!(U8, u8, |v| v),
        Element::I8 => whole!(I16, i8, |v| i16::from(v)),
        Element::U16 => whole!(U16, u16, |v| v),
        Element::I16 => whole!(I16, i16, |v| v),
        Element::I32 => whole!(F32, i32, |v| v as f32),
        Element::U32 => whole!(F32, u32, |v| v as f32),
        Element::I64 => whole!(F32, i64, |v| v as f32),
        Element::U64 => whole!(F32, u64, |v| v as f32),
        Element::F32 => VolumeData::F32(parse(stream, voxels, |text| text.parse().ok())?),
        Element::F64 => {
            VolumeData::F32(parse(stream, voxels, |text| text.parse::<f64>().ok().map(|v| v as f32))?)
        }
    })
}

/// Largest length of a number in text, in characters; a longer number is an error.
const MAX_TOKEN: usize = 512;

fn parse<T>(stream: &mut Stream<'_>, voxels: usize, number: impl Fn(&str) -> Option<T>) -> Result<Vec<T>> {
    let mut out = Vec::new();
    let mut token: Vec<u8> = Vec::new();
    loop {
        let mut byte = [0u8];
        let end = fill(stream, &mut byte)
            .map_err(|error| anyhow::anyhow!("{}number {}: {error}", stream.prefix(), out.len()))?
            == 0;
        if !end && !byte[0].is_ascii_whitespace() && byte[0] != b',' {
            token.push(byte[0]);
            if token.len() > MAX_TOKEN {
                bail!(
                    "{}number {} is longer than {MAX_TOKEN} characters; the data is not text",
                    stream.prefix(),
                    out.len()
                );
            }
            continue;
        }
        if !token.is_empty() {
            if out.len() == voxels {
                bail!(
                    "{}there are more than the {voxels} numbers that the sizes call for; check the sizes in \
                     the header",
                    stream.prefix()
                );
            }
            let value = std::str::from_utf8(&token).ok().and_then(&number);
            let Some(value) = value else {
                bail!(
                    "{}number {} is {:?}; the type in the header does not allow it",
                    stream.prefix(),
                    out.len(),
                    String::from_utf8_lossy(&token)
                );
            };
            grow(&mut out, 1, voxels)?;
            out.push(value);
            token.clear();
        }
        if end {
            break;
        }
    }
    if out.len() < voxels {
        bail!(
            "{}there are {} of the {voxels} numbers that the sizes call for; the file is cut short or its \
             header is wrong",
            stream.prefix(),
            out.len()
        );
    }
    Ok(out)
}
