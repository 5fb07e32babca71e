//! Scalar types in files, and conversion of their bytes to voxels.

use super::VolumeData;
use super::stream::{Remaining, Stream};
use anyhow::{Context, Result, anyhow, bail, ensure};
use std::io::{self, Read};

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Element {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl Element {
    /// Returns the type with this name. `names` has the names of every type, in the order of this enum.
    pub(super) fn named(names: [&[&str]; 10], name: &str) -> Option<Self> {
        use Element::*;
        let types = [I8, U8, I16, U16, I32, U32, I64, U64, F32, F64];
        let (found, _) = types.into_iter().zip(names).find(|(_, known)| known.contains(&name))?;
        Some(found)
    }

    pub(crate) const fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Endian {
    Little,
    Big,
}

/// Returns the number of bytes that the voxels occupy in the file.
pub(crate) fn byte_count(dims: [usize; 3], element: Element) -> Result<u64> {
    dims.iter()
        .try_fold(element.bytes() as u64, |product, &n| product.checked_mul(n as u64))
        .context("the sizes in the header multiply to more bytes than can be addressed")
}

/// Calls the macro `$do` with the kind of [`VolumeData`] that holds an element's voxels, the stored type, and
/// the type in memory.
macro_rules! with_types {
    ($element:expr, $do:ident) => {
        match $element {
            Element::U8 => $do!(U8, u8, u8),
            Element::I8 => $do!(I16, i8, i16),
            Element::U16 => $do!(U16, u16, u16),
            Element::I16 => $do!(I16, i16, i16),
            Element::U32 => $do!(F32, u32, f32),
            Element::I32 => $do!(F32, i32, f32),
            Element::U64 => $do!(F32, u64, f32),
            Element::I64 => $do!(F32, i64, f32),
            Element::F32 => $do!(F32, f32, f32),
            Element::F64 => $do!(F32, f64, f32),
        }
    };
}

/// Reads the voxels of a volume; memory grows with the received bytes. With a slope and an intercept in
/// `scale`, a voxel's value is number · slope + intercept for the stored number, computed in 64-bit floats
/// and then rounded to a 32-bit float.
///
/// # Errors
/// When there are fewer bytes than sizes and type require, or the compressed data is broken; the error states
/// the numbers of bytes expected and found.
pub(crate) fn read_voxels(
    stream: &mut Stream<'_>,
    dims: [usize; 3],
    element: Element,
    endian: Endian,
    scale: Option<(f64, f64)>,
) -> Result<VolumeData> {
    check_length(stream, dims, element)?;
    let voxels = dims[0] * dims[1] * dims[2];
    macro_rules! collect_as {
        ($kind:ident, $stored:ty, $kept:ty, $from_bytes:ident) => {
            match scale {
                None => VolumeData::$kind(collect(stream, voxels, |b| <$stored>::$from_bytes(b) as $kept)?),
                Some((slope, intercept)) => VolumeData::F32(collect(stream, voxels, |b| {
                    (<$stored>::$from_bytes(b) as f64 * slope + intercept) as f32
                })?),
            }
        };
    }
    macro_rules! convert {
        ($kind:ident, $stored:ty, $kept:ty) => {
            match endian {
                Endian::Little => collect_as!($kind, $stored, $kept, from_le_bytes),
                Endian::Big => collect_as!($kind, $stored, $kept, from_be_bytes),
            }
        };
    }
    Ok(with_types!(element, convert))
}

/// Describes voxels of a size and type, for messages.
fn described([x, y, z]: [usize; 3], element: Element) -> String {
    let size = element.bytes();
    format!("{x} x {y} x {z} voxels of {size} byte{}", if size == 1 { "" } else { "s" })
}

/// Refuses a stream that cannot hold the voxels.
fn check_length(stream: &Stream<'_>, dims: [usize; 3], element: Element) -> Result<()> {
    let expected = byte_count(dims, element)?;
    let found = match stream.remaining() {
        Remaining::Exact(found) if found < expected => format!("the file has {found}"),
        Remaining::AtMost(most) if most < expected => format!("the encoded data can hold {most} at most"),
        _ => return Ok(()),
    };
    bail!(
        "{}{} need {expected} bytes, but {found}; the file is cut short or its header is wrong",
        stream.prefix(),
        described(dims, element)
    )
}

/// Checks the bytes after the voxels. If these bytes are fewer than those of the voxels, they are ignored,
/// and a note about them is returned.
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
            .with_context(|| format!("{prefix}cannot read the data after the voxels"))?,
    };
    if behind == 0 {
        return Ok(None);
    }
    let voxels = described(dims, element);
    if behind >= expected {
        let found = match stream.remaining() {
            Remaining::Exact(_) => (expected + behind).to_string(),
            Remaining::AtMost(_) => format!("{} or more", expected + behind),
        };
        bail!(
            "{prefix}{voxels} need {expected} bytes, but the data has {found}; check sizes and type in the \
             header. If the file holds a second volume, save each volume to a file of its own"
        );
    }
    Ok(Some(format!(
        "{prefix}{behind} bytes after the {expected} bytes of {voxels} are left out; check sizes and type in \
         the header if no bytes should follow"
    )))
}

/// Number of bytes that are read and converted at a time.
const CHUNK: usize = 1 << 16;

fn collect<const BYTES: usize, T>(
    stream: &mut Stream<'_>,
    voxels: usize,
    convert: impl Fn([u8; BYTES]) -> T,
) -> Result<Vec<T>> {
    let (prefix, total) = (stream.prefix(), voxels * BYTES);
    let mut out: Vec<T> = Vec::new();
    // All memory is reserved at once if the bytes are known to exist.
    if matches!(stream.remaining(), Remaining::Exact(_)) {
        reserve(&mut out, voxels)?;
    }
    let mut buffer = vec![0u8; CHUNK.min(total)];
    while out.len() < voxels {
        let more = (CHUNK / BYTES).min(voxels - out.len());
        grow(&mut out, more, voxels)?;
        let (at, part) = (out.len() * BYTES, &mut buffer[..more * BYTES]);
        let got = fill(stream, part).map_err(|error| {
            anyhow!(
                "{prefix}the voxels cannot be read after byte {at} of {total}: {error}; the file is damaged"
            )
        })?;
        ensure!(
            got == part.len(),
            "{prefix}the voxels end after {} of {total} bytes; the file is cut short or its header is wrong",
            at + got
        );
        out.extend(part.as_chunks::<BYTES>().0.iter().map(|&b| convert(b)));
    }
    Ok(out)
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
    ensure!(
        out.try_reserve_exact(more).is_ok(),
        "{} bytes of voxels do not fit into this machine's memory; scale the volume down",
        (out.len() + more).saturating_mul(size_of::<T>())
    );
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
            // The compressed data ends early.
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => break,
            Err(error) => return Err(error),
        }
    }
    Ok(filled)
}

/// Reads voxels from numbers in text, separated by whitespace (or commas). A whole-number type takes whole
/// numbers only.
///
/// # Errors
/// When there are fewer or more numbers than voxels, or a number cannot be read or is outside the type's
/// range; the error names the index of such a number.
pub(crate) fn parse_voxels(
    stream: &mut Stream<'_>,
    dims: [usize; 3],
    element: Element,
) -> Result<VolumeData> {
    let [x, y, z] = dims;
    let voxels = x * y * z;
    // A number and the blank behind it take at least two bytes.
    let (Remaining::Exact(most) | Remaining::AtMost(most)) = stream.remaining();
    ensure!(
        most.saturating_add(1) / 2 >= voxels as u64,
        "{}{x} x {y} x {z} voxels as text need at least {} bytes, but the data has {most}; the file is cut \
             short or its header is wrong",
        stream.prefix(),
        (voxels as u64).saturating_mul(2) - 1
    );
    macro_rules! parse_as {
        ($kind:ident, $stored:ty, $kept:ty) => {
            VolumeData::$kind(parse(stream, voxels, |text| {
                // Some writers put a decimal point into whole numbers.
                let number = text.parse::<$stored>().ok().or_else(|| {
                    let f: f64 = text.parse().ok()?;
                    let inside = f.fract() == 0.0 && f >= <$stored>::MIN as f64 && f <= <$stored>::MAX as f64;
                    inside.then_some(f as $stored)
                });
                Some(number? as $kept)
            })?)
        };
    }
    Ok(with_types!(element, parse_as))
}

/// Largest length of a number in text, in characters; a longer number is an error.
const MAX_TOKEN: usize = 512;

fn parse<T>(stream: &mut Stream<'_>, voxels: usize, number: impl Fn(&str) -> Option<T>) -> Result<Vec<T>> {
    let prefix = stream.prefix();
    let mut out = Vec::new();
    let mut token: Vec<u8> = Vec::new();
    loop {
        let mut byte = [0u8];
        let end =
            fill(stream, &mut byte).map_err(|error| anyhow!("{prefix}number {}: {error}", out.len()))? == 0;
        if !end && !byte[0].is_ascii_whitespace() && byte[0] != b',' {
            token.push(byte[0]);
            ensure!(
                token.len() <= MAX_TOKEN,
                "{prefix}number {} is longer than {MAX_TOKEN} characters; the data is not text",
                out.len()
            );
            continue;
        }
        if !token.is_empty() {
            ensure!(
                out.len() != voxels,
                "{prefix}there are more than the {voxels} numbers that the sizes call for; check the sizes \
                     in the header"
            );
            let Some(value) = std::str::from_utf8(&token).ok().and_then(&number) else {
                bail!(
                    "{prefix}number {} is {:?}; the type in the header does not allow it",
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
    ensure!(
        out.len() >= voxels,
        "{prefix}there are {} of the {voxels} numbers that the sizes call for; the file is cut short or its \
             header is wrong",
        out.len()
    );
    Ok(out)
}
