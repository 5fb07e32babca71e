//! `readers CRATE FILE`: reads a volume and prints its sizes, the spacing, and a checksum of its voxels as
//! 32-bit floats. `judge.py` runs it.
//!
//! `readers lines`: reads each file that a line of standard input names with the readers of `entire`, and prints a line
//! of JSON for it: `{"dims", "type", "spacing", "range", "crc32", "notes"}`, `{"refused"}` or `{"panic"}`.
//! `differential.py` runs it.

use anyhow::{Result, bail};
use entire_io::volume;
use serde_json::{Value, json};
use std::io::{BufRead, Write};
use std::path::Path;
use volume::VolumeData;

/// Options to read every value as stored, fill values included.
fn as_stored() -> volume::Reading {
    volume::Reading { fill: volume::Fill::None, ..volume::Reading::default() }
}

struct Found {
    sizes: Vec<usize>,
    spacing: Vec<f32>,
    /// Voxels, x fastest.
    voxels: Vec<f32>,
}

fn ours(path: &Path) -> Result<Found> {
    let volume = volume::Volume::open_as(path, &as_stored(), None)?;
    let scalars = volume.data().scalars();
    let voxels = scalars.iter().collect();
    Ok(Found { sizes: volume.dims().to_vec(), spacing: volume.spacing().to_vec(), voxels })
}

/// Description of a volume, with the values that `cli/tests/suite/independent_readers.rs` compares with its table: the
/// range of the finite voxels, and the CRC-32 of all voxels in their type in memory, little-endian, with every NaN
/// replaced by the one without payload.
fn line_of(path: &Path) -> Value {
    let volume = match volume::Volume::open_as(path, &as_stored(), None) {
        Ok(volume) => volume,
        Err(error) => return json!({ "refused": format!("{error:#}") }),
    };
    let (kind, bytes): (_, Vec<u8>) = match volume.data() {
        VolumeData::U8(v) => ("uint8", v.clone()),
        VolumeData::U16(v) => ("uint16", v.iter().flat_map(|v| v.to_le_bytes()).collect()),
        VolumeData::I16(v) => ("int16", v.iter().flat_map(|v| v.to_le_bytes()).collect()),
        VolumeData::F32(v) => {
            let one = |v: &f32| if v.is_nan() { f32::from_bits(0x7fc0_0000) } else { *v };
            ("float32", v.iter().flat_map(|v| one(v).to_le_bytes()).collect())
        }
    };
    let mut range = None;
    for value in volume.data().scalars().iter().filter(|v| v.is_finite()) {
        let (low, high) = range.unwrap_or((value, value));
        range = Some((value.min(low), value.max(high)));
    }
    json!({
        "dims": volume.dims(),
        "type": kind,
        "spacing": volume.spacing(),
        "range": range.map(|(low, high)| [low, high]),
        "crc32": format!("{:08x}", crc32fast::hash(&bytes)),
        "notes": volume.notes(),
    })
}

fn lines() -> Result<()> {
    for line in std::io::stdin().lock().lines() {
        let path = line?;
        let found = std::panic::catch_unwind(|| line_of(Path::new(&path)));
        println!("{}", found.unwrap_or_else(|_| json!({ "panic": path })));
        std::io::stdout().flush()?;
    }
    Ok(())
}

#[cfg(feature = "peers")]
fn with_nifti(path: &Path) -> Result<Found> {
    use nifti::{IntoNdArray, NiftiObject, NiftiVolume, ReaderOptions};
    let object = ReaderOptions::new().read_file(path)?;
    let spacing = object.header().pixdim[1..4].to_vec();
    let sizes = object.volume().dim().iter().map(|n| usize::from(*n)).collect();
    let array = object.into_volume().into_ndarray::<f32>()?;
    Ok(Found { sizes, spacing, voxels: array.t().iter().copied().collect() })
}

#[cfg(feature = "peers")]
fn with_vtkio(path: &Path) -> Result<Found> {
    use anyhow::Context;
    use vtkio::model::{Attribute, DataSet, Extent, Piece, Vtk};
    let file: Vtk = Vtk::import(path)?;
    let DataSet::ImageData { extent, spacing, pieces, .. } = file.data else { bail!("not image data") };
    let Extent::Ranges([x, y, z]) = extent else { bail!("no ranges") };
    let sizes = [x, y, z].map(|r| usize::try_from(i64::from(*r.end()) - i64::from(*r.start()) + 1));
    let mut sizes = sizes.into_iter().collect::<Result<Vec<_>, _>>()?;
    let Some(Piece::Inline(piece)) = pieces.into_iter().next() else { bail!("no piece") };
    let mut arrays = piece.data.point;
    if arrays.is_empty() {
        arrays = piece.data.cell;
        sizes.iter_mut().for_each(|n| *n -= 1);
    }
    // The name of the active array in the fixtures.
    let at = arrays.iter().position(|a| a.name() == "density").unwrap_or(0);
    let Some(Attribute::DataArray(array)) = arrays.into_iter().nth(at) else { bail!("no array") };
    let voxels = array.data.cast_into::<f32>().context("voxels that are no numbers")?;
    if voxels.len() != sizes.iter().product::<usize>() {
        bail!("{} voxels for {sizes:?}", voxels.len());
    }
    Ok(Found { sizes, spacing: spacing.to_vec(), voxels })
}

#[cfg(feature = "bioformats")]
fn with_bioformats(path: &Path) -> Result<Found> {
    use bioformats::{ImageReader, PixelType};
    let mut reader = ImageReader::open(path)?;
    let meta = reader.metadata().clone();
    let mut bytes = Vec::new();
    for plane in 0..meta.image_count {
        bytes.extend(reader.open_bytes(plane)?);
    }
    macro_rules! floats {
        ($kind:ty) => {
            bytes
                .chunks_exact(size_of::<$kind>())
                .map(|b| {
                    let b = b.try_into().unwrap();
                    (if meta.is_little_endian {
                        <$kind>::from_le_bytes(b)
                    } else {
                        <$kind>::from_be_bytes(b)
                    }) as f32
                })
                .collect()
        };
    }
    let voxels: Vec<f32> = match meta.pixel_type {
        PixelType::Int8 => floats!(i8),
        PixelType::Uint8 => floats!(u8),
        PixelType::Int16 => floats!(i16),
        PixelType::Uint16 => floats!(u16),
        PixelType::Int32 => floats!(i32),
        PixelType::Uint32 => floats!(u32),
        PixelType::Float32 => floats!(f32),
        PixelType::Float64 => floats!(f64),
        other => bail!("pixels of type {other:?}"),
    };
    let sizes = [meta.size_x, meta.size_y, meta.size_z].map(|n| n as usize).to_vec();
    // This crate does not state the spacing of every format.
    Ok(Found { sizes, spacing: Vec::new(), voxels })
}

fn main() -> Result<()> {
    let mut words = std::env::args_os().skip(1);
    let (Some(name), path) = (words.next(), words.next()) else {
        bail!("usage: readers CRATE FILE, readers lines")
    };
    let path = match path {
        Some(path) => path,
        None if name == "lines" => return lines(),
        None => bail!("usage: readers CRATE FILE, readers lines"),
    };
    let path = Path::new(&path);
    let found = match name.to_str() {
        Some("ours") => ours(path),
        #[cfg(feature = "peers")]
        Some("nifti") => with_nifti(path),
        #[cfg(feature = "peers")]
        Some("vtkio") => with_vtkio(path),
        #[cfg(feature = "bioformats")]
        Some("bioformats") => with_bioformats(path),
        _ => bail!("CRATE is ours, nifti, vtkio or bioformats"),
    }?;
    // FNV-1a.
    let sum =
        found.voxels.iter().flat_map(|v| v.to_le_bytes()).fold(0xcbf2_9ce4_8422_2325_u64, |sum, byte| {
            (sum ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
        });
    println!("{:?} {:?} {} {sum:x}", found.sizes, found.spacing, found.voxels.len());
    Ok(())
}
