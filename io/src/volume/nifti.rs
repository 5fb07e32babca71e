//! NIfTI-1 and NIfTI-2 in one file (`.nii`, `.nii.gz`), either byte order. The header's slope and intercept
//! are applied to the stored numbers; its orientation and its units are not used.
//!
//! The following rules are those of the format's own library. A slope that is 0 or not finite means no
//! scaling, an intercept that is not finite counts as 0, and a size of 0 after the third axis counts as 1.
//!
//! A spacing that is not finite is unknown: 1 is taken, with a note.
//!
//! The project has its own reader, since the crate `nifti` 0.18 reads only NIfTI-1 and panics where a
//! header's sizes contradict each other.

use super::element::{expect_end, read_voxels};
use super::stream::Stream;
use super::{Element, Endian, Parts, checked_dims, three_axes};
use anyhow::{Context, Result, bail, ensure};
use std::io::Read;

const NIFTI1_BYTES: usize = 348;
const NIFTI2_BYTES: usize = 540;

/// Fields that both kinds of header have.
struct Header {
    endian: Endian,
    axes: i64,
    sizes: [i64; 7],
    spacing: [f64; 7],
    data_type: i16,
    offset: f64,
    slope: f64,
    intercept: f64,
    /// Number of bytes that were read from the stream so far.
    taken: u64,
}

pub(super) fn read(mut stream: Stream<'_>) -> Result<Parts> {
    if stream.peek().context("reading the header")?.starts_with(&[0x1f, 0x8b]) {
        stream = stream.gunzip();
    }
    let header = header(&mut stream)?;
    ensure!((1..=7).contains(&header.axes), "NIfTI dim[0] is {}; 1 to 7 are possible", header.axes);
    let axes = header.axes as usize;
    let mut sizes = Vec::with_capacity(axes);
    for (axis, &size) in header.sizes[..axes].iter().enumerate() {
        match u64::try_from(size) {
            Ok(0) if axis >= 3 => sizes.push(1),
            Ok(size) => sizes.push(size),
            Err(_) => bail!("NIfTI dim[{}] is {size}; sizes are positive", axis + 1),
        }
    }
    let mut spacing = header.spacing;
    let mut notes = Vec::new();
    for (axis, value) in spacing[..axes.min(3)].iter_mut().enumerate() {
        if !value.is_finite() {
            notes.push(format!("pixdim[{}] is {value}, so the spacing is not known; 1 is taken", axis + 1));
            *value = 1.0;
        }
        // Writers store 0 where the spacing is unknown, and an orientation in the sign.
        *value = if *value == 0.0 { 1.0 } else { value.abs() };
    }
    let spatial: Vec<bool> = (0..axes).map(|axis| axis < 3).collect();
    let (sizes, spacing) = three_axes(&sizes, &spacing[..axes], &spatial)?;
    let dims = checked_dims(sizes)?;
    let element = match header.data_type {
        2 => Element::U8,
        4 => Element::I16,
        8 => Element::I32,
        16 => Element::F32,
        64 => Element::F64,
        256 => Element::I8,
        512 => Element::U16,
        768 => Element::U32,
        1024 => Element::I64,
        1280 => Element::U64,
        32 | 1792 | 2048 => bail!("NIfTI voxels are complex numbers; save their magnitude"),
        128 | 2304 => bail!("NIfTI voxels have several color components; save one of them"),
        other => bail!(
            "NIfTI datatype {other} is not read; accepted are 8- to 64-bit integers and 32- and 64-bit floats"
        ),
    };
    if !(header.offset >= header.taken as f64 && header.offset < 9e15) {
        bail!("NIfTI vox_offset is {}; the voxels cannot begin before byte {}", header.offset, header.taken);
    }
    stream.skip(header.offset as u64 - header.taken)?;
    let Header { endian, slope, .. } = header;
    let intercept = if header.intercept.is_finite() { header.intercept } else { 0.0 };
    let scaled = slope.is_finite() && slope != 0.0 && (slope, intercept) != (1.0, 0.0);
    let data = read_voxels(&mut stream, dims, element, endian, scaled.then_some((slope, intercept)))?;
    notes.extend(expect_end(&mut stream, dims, element)?);
    Ok(Parts { data, dims, spacing, name: None, notes })
}

fn header(stream: &mut Stream<'_>) -> Result<Header> {
    let mut bytes = [0u8; NIFTI2_BYTES];
    let mut size = [0u8; 4];
    take(stream, &mut size, 0)?;
    let (endian, second) = match (i32::from_le_bytes(size), i32::from_be_bytes(size)) {
        (348, _) => (Endian::Little, false),
        (_, 348) => (Endian::Big, false),
        (540, _) => (Endian::Little, true),
        (_, 540) => (Endian::Big, true),
        (found, _) => {
            bail!("not a NIfTI file: it begins with {found}; a NIfTI header begins with 348 or 540")
        }
    };
    let length = if second { NIFTI2_BYTES } else { NIFTI1_BYTES };
    bytes[..4].copy_from_slice(&size);
    take(stream, &mut bytes[4..length], 4)?;
    let magic = if second { &bytes[4..8] } else { &bytes[344..348] };
    match (magic, second) {
        (b"n+1\0", false) | (b"n+2\0", true) => {}
        (b"ni1\0", false) | (b"ni2\0", true) => {
            bail!("the voxels are in a second file (.hdr and .img); convert the pair to one .nii file")
        }
        _ => bail!(
            "not a NIfTI file: its magic is {:?} (an Analyze 7.5 file has none); convert it to NIfTI",
            String::from_utf8_lossy(magic)
        ),
    }
    let short = |offset| i16::from_le_bytes(at(&bytes, offset, endian));
    let long = |offset| i64::from_le_bytes(at(&bytes, offset, endian));
    let float = |offset| f32::from_le_bytes(at(&bytes, offset, endian));
    let double = |offset| f64::from_le_bytes(at(&bytes, offset, endian));
    // The arguments are the offsets of a number in NIfTI-1 and in NIfTI-2.
    let whole = |one, two| if second { long(two) } else { i64::from(short(one)) };
    let real = |one, two| if second { double(two) } else { f64::from(float(one)) };
    let axis = [0, 1, 2, 3, 4, 5, 6];
    Ok(Header {
        endian,
        axes: whole(40, 16),
        sizes: axis.map(|i| whole(42 + 2 * i, 24 + 8 * i)),
        spacing: axis.map(|i| real(80 + 4 * i, 112 + 8 * i)),
        data_type: short(if second { 12 } else { 70 }),
        offset: if second { long(168) as f64 } else { f64::from(float(108)) },
        slope: real(112, 176),
        intercept: real(116, 184),
        taken: length as u64,
    })
}

/// Returns the bytes of a number, the least significant byte first.
fn at<const N: usize>(bytes: &[u8; NIFTI2_BYTES], offset: usize, endian: Endian) -> [u8; N] {
    let mut number = std::array::from_fn(|i| bytes[offset + i]);
    if endian == Endian::Big {
        number.reverse();
    }
    number
}

fn take(stream: &mut Stream<'_>, out: &mut [u8], from: usize) -> Result<()> {
    if let Err(error) = stream.read_exact(out) {
        if error.kind() == std::io::ErrorKind::UnexpectedEof {
            bail!("NIfTI header is cut short: the file ends before byte {}", from + out.len());
        }
        return Err(error).context("reading the NIfTI header");
    }
    Ok(())
}
