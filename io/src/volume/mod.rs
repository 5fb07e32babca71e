//! Scalar volumes in files: NRRD, MetaImage, VTK XML image data, NIfTI, and raw voxels beside a JSON
//! description.
//!
//! [`Volume::open`] picks the format by the file name's ending, else by the first bytes. Readers read files,
//! memory and decompressed data alike. They allocate in proportion to the bytes that really exist. A header
//! that claims a huge volume over a few bytes of data is an error, not an allocation.
//!
//! # Bytes behind the voxels
//!
//! One rule holds for all formats, compressed or not. If fewer bytes follow the voxels than the voxels occupy
//! (a line end, padding), they are ignored, and [`Volume::notes`] says so. If as many or more follow, the
//! file is refused: the sizes or the type do not fit the data, or another volume follows. The length that a
//! VTK file states for an array must be exact, and text data must have as many numbers as the sizes require.
//!
//! # Stored types and their types in memory
//!
//! | in the file | in memory |
//! |---|---|
//! | unsigned 8, 16 bit; signed 16 bit; 32-bit float | the same |
//! | signed 8 bit | signed 16 bit, exactly |
//! | signed and unsigned 32 and 64 bit | 32-bit float, rounded to nearest (whole numbers to 2^24 exactly) |
//! | 64-bit float | 32-bit float, rounded to nearest (beyond its range: an infinity) |
//! | any type with a NIfTI slope, intercept other than 1, 0 | 32-bit float of value × slope + intercept |
//!
//! NaN and infinite voxels are kept; they count as the ends of the range when a view normalizes them (see
//! [`normalize`](entire_core::scene::normalize)). Voxels with a fill value ([`VolumeView::fill_values`], or
//! those that [`Reading::fill`] names) get the low end of the range that maps to [0, 1], or the minimum of
//! all other values if that is lower; [`Volume::notes`] says so. Axes stay in the file's order, and x is the
//! fastest. Voxel spacings are used; positions and directions in space are not.

mod element;
#[cfg(feature = "fuzzing")]
pub mod hostile;
mod metaimage;
mod nifti;
mod nrrd;
mod openscivis;
mod reading;
mod resample;
mod several;
mod stream;
mod vti;

pub(crate) use element::{Element, Endian};
pub use reading::{Fill, Range, Reading, open_volume, open_watched_volume};
pub use resample::MAX_FACTOR;
pub use stream::Watcher;
pub(crate) use stream::{Companions, Folder, Stream};

use crate::files::without_mark;
use anyhow::{Context, Result, ensure};
use entire_core::scene::{Scalars, VolumeOptions, VolumeView};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Owned voxels in one of the types that the core takes.
#[derive(Clone, Debug, PartialEq)]
pub enum VolumeData {
    /// Unsigned bytes.
    U8(Vec<u8>),
    /// Unsigned 16-bit integers.
    U16(Vec<u16>),
    /// Signed 16-bit integers.
    I16(Vec<i16>),
    /// 32-bit floats.
    F32(Vec<f32>),
}

impl VolumeData {
    /// Returns the voxels as a view for the core.
    pub fn scalars(&self) -> Scalars<'_> {
        match self {
            Self::U8(v) => Scalars::U8(v),
            Self::U16(v) => Scalars::U16(v),
            Self::I16(v) => Scalars::I16(v),
            Self::F32(v) => Scalars::F32(v),
        }
    }

    /// Number of voxels.
    pub fn len(&self) -> usize {
        match self {
            Self::U8(v) => v.len(),
            Self::U16(v) => v.len(),
            Self::I16(v) => v.len(),
            Self::F32(v) => v.len(),
        }
    }

    /// True if there is no voxel.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A checked scalar volume that owns its voxels: x fastest, one component, no padding.
#[derive(Clone, Debug)]
pub struct Volume {
    data: VolumeData,
    dims: [usize; 3],
    spacing: [f32; 3],
    /// The scalar range that maps to [0, 1].
    range: (f32, f32),
    name: String,
    source: PathBuf,
    notes: Vec<String>,
}

/// The file formats that volumes are read from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Format {
    /// NRRD: `.nrrd`, or `.nhdr` with the voxels in another file.
    Nrrd,
    /// MetaImage: `.mha`, or `.mhd` with the voxels in another file.
    MetaImage,
    /// VTK XML image data: `.vti`.
    VtkImage,
    /// NIfTI-1 or -2 in one file: `.nii`, `.nii.gz`.
    Nifti,
    /// A JSON description, with raw voxels in another file: `.json`.
    Json,
    /// Raw voxels, with a JSON description in another file: `.raw`, `.raw.gz`.
    Raw,
}

impl Format {
    /// The endings of the names of each format's files.
    const ENDINGS: [(Self, &[&str]); 6] = [
        (Self::Nrrd, &[".nrrd", ".nhdr"]),
        (Self::MetaImage, &[".mhd", ".mha"]),
        (Self::VtkImage, &[".vti"]),
        (Self::Nifti, &[".nii", ".nii.gz"]),
        (Self::Json, &[".json"]),
        (Self::Raw, &[".raw", ".raw.gz"]),
    ];

    pub(crate) fn of_name(name: &str) -> Option<Self> {
        let name = name.to_ascii_lowercase();
        let found =
            Self::ENDINGS.into_iter().find(|(_, all)| all.iter().any(|ending| name.ends_with(ending)));
        found.map(|(format, _)| format)
    }

    /// Returns the format of a file, from its first bytes (512 are enough).
    pub(crate) fn of_content(head: &[u8]) -> Option<Self> {
        let head = without_mark(head);
        let text = head.trim_ascii_start();
        if head.starts_with(b"NRRD") {
            Some(Self::Nrrd)
        } else if head.starts_with(&[0x1f, 0x8b])
            || matches!(head.get(344..347), Some(b"n+1" | b"ni1"))
            || matches!(head.get(4..7), Some(b"n+2" | b"ni2"))
        {
            Some(Self::Nifti)
        } else if text.starts_with(b"<?xml") || text.starts_with(b"<VTKFile") {
            Some(Self::VtkImage)
        } else if text.starts_with(b"ObjectType") || text.starts_with(b"NDims") {
            Some(Self::MetaImage)
        } else if text.starts_with(b"{") {
            Some(Self::Json)
        } else {
            None
        }
    }
}

/// Result of a format's reader, before the checks that all formats share.
pub(crate) struct Parts {
    pub(crate) data: VolumeData,
    pub(crate) dims: [usize; 3],
    pub(crate) spacing: [f64; 3],
    pub(crate) name: Option<String>,
    pub(crate) notes: Vec<String>,
}

impl Volume {
    /// Makes a volume of voxels in memory, x fastest.
    ///
    /// # Errors
    /// A zero size, a number of voxels that differs from the sizes' product, a spacing that is not finite and
    /// positive.
    pub fn new(
        data: VolumeData,
        dims: [usize; 3],
        spacing: [f32; 3],
        name: impl Into<String>,
    ) -> Result<Self> {
        let options = VolumeOptions { spacing, ..VolumeOptions::default() };
        let view = VolumeView::with(data.scalars(), dims, options)?;
        let ([x, y, z], voxels, there) = (dims, view.shape().voxels, data.len());
        ensure!(
            voxels == there as u64,
            "volume of {x} x {y} x {z} has {voxels} voxels, the data has {there}; check the sizes"
        );
        let range = view.range();
        let (name, source) = (name.into(), PathBuf::new());
        Ok(Self { data, dims, spacing, range, name, source, notes: Vec::new() })
    }

    /// Returns a view of the voxels for the core, with the spacing, and with the range that was set, else the
    /// default range of [`VolumeView::new`] (computed once, when the volume was made).
    pub fn view(&self) -> VolumeView<'_> {
        self.checked_view(self.range).expect("sizes, spacing and range were checked when they were set")
    }

    fn checked_view(&self, range: (f32, f32)) -> Result<VolumeView<'_>, entire_core::Error> {
        VolumeView::with(
            self.data.scalars(),
            self.dims,
            VolumeOptions { range: Some(range), spacing: self.spacing, ..VolumeOptions::default() },
        )
    }

    /// Sets the scalar range that maps to [0, 1].
    ///
    /// # Errors
    /// When an end is not finite, or the low end is above the high end.
    pub(crate) fn set_range(&mut self, range: (f32, f32)) -> Result<()> {
        self.checked_view(range)?;
        self.range = range;
        Ok(())
    }

    /// The voxels.
    pub fn data(&self) -> &VolumeData {
        &self.data
    }

    /// Voxels along x, y, z.
    pub fn dims(&self) -> [usize; 3] {
        self.dims
    }

    /// Voxel spacing along x, y, z, in the file's unit of length (1 where the file states none).
    pub fn spacing(&self) -> [f32; 3] {
        self.spacing
    }

    /// The volume's name: from its description, else the file's name without its ending.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Notes to the user about the reading: a line each, without the file's name.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The file that the volume was read from; empty for a volume made in memory.
    pub fn source(&self) -> &Path {
        &self.source
    }
}

/// Returns a name without a given ASCII ending, in upper or lower case; `None` if the name ends otherwise.
pub(crate) fn strip_ending<'a>(name: &'a str, ending: &str) -> Option<&'a str> {
    let (rest, found) = name.split_at_checked(name.len().checked_sub(ending.len())?)?;
    found.eq_ignore_ascii_case(ending).then_some(rest)
}

/// Checks three sizes from a header.
///
/// # Errors
/// When a size is 0 (the error names the axis), or the product of the sizes cannot be addressed.
pub(crate) fn checked_dims(sizes: [u64; 3]) -> Result<[usize; 3]> {
    for (size, axis) in sizes.iter().zip(["x", "y", "z"]) {
        ensure!(*size > 0, "size along {axis} is 0; every axis needs at least one voxel");
    }
    let [x, y, z] = sizes;
    ensure!(
        x.checked_mul(y).and_then(|p| p.checked_mul(z)).is_some_and(|n| n <= (isize::MAX as u64) / 8),
        "{x} x {y} x {z} voxels are more than can be addressed; check the sizes in the header"
    );
    Ok(sizes.map(|s| s as usize))
}

/// Reduces sizes and spacings to three axes. Fewer than three axes are refused; surplus axes must have one
/// element. `spatial` is false for axes without a direction in space; missing entries count as true.
///
/// # Errors
/// When there are fewer than three axes, or the data has several components or time steps; the error then
/// names their axis.
pub(crate) fn three_axes<T: Copy>(
    sizes: &[u64],
    values: &[T],
    spatial: &[bool],
) -> Result<([u64; 3], [T; 3])> {
    ensure!(
        sizes.len() >= 3,
        "the data has {} axes; a volume needs three (give a single slice a third axis of size 1)",
        sizes.len()
    );
    let is_spatial = |a: usize| spatial.get(a).copied().unwrap_or(true);
    let mut keep: Vec<usize> = (0..sizes.len()).collect();
    // Axes of one element carry no data: those without a direction in space are dropped first, then the last
    // ones.
    while keep.len() > 3 {
        let dropped = keep
            .iter()
            .rposition(|&a| sizes[a] == 1 && !is_spatial(a))
            .or_else(|| keep.iter().rposition(|&a| sizes[a] == 1));
        let Some(at) = dropped else { return Err(not_a_volume(sizes, spatial)) };
        keep.remove(at);
    }
    if keep.iter().any(|&a| sizes[a] != 1 && !is_spatial(a)) {
        return Err(not_a_volume(sizes, spatial));
    }
    Ok(([0, 1, 2].map(|i| sizes[keep[i]]), [0, 1, 2].map(|i| values[keep[i]])))
}

pub(crate) fn number<T: FromStr>(field: &str, value: &str) -> Result<T> {
    value.parse().ok().with_context(|| format!("{field:?} has {value:?} where a number is expected"))
}

/// Parses the numbers of a header's field, at most `most`, with blanks between them.
pub(crate) fn numbers<T: FromStr>(field: &str, value: &str, most: usize) -> Result<Vec<T>> {
    let found: Vec<T> =
        value.split_whitespace().take(most + 1).map(|word| number(field, word)).collect::<Result<_>>()?;
    ensure!(found.len() <= most, "{field:?} has more than {most} entries");
    Ok(found)
}

fn not_a_volume(sizes: &[u64], spatial: &[bool]) -> anyhow::Error {
    let list = sizes.iter().map(u64::to_string).collect::<Vec<_>>().join(" x ");
    let culprit = (0..sizes.len())
        .find(|&a| sizes[a] != 1 && !spatial.get(a).copied().unwrap_or(true))
        .or_else(|| (sizes[0] <= 4).then_some(0))
        .unwrap_or(sizes.len() - 1);
    anyhow::anyhow!(
        "the data has {} axes ({list}), and axis {culprit} holds {} components or time steps; save one \
         component of one time step",
        sizes.len(),
        sizes[culprit]
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn single_element_axes_are_dropped_and_others_named() {
        let s = |sizes: &[u64], spatial: &[bool]| {
            three_axes(sizes, &(0..sizes.len()).collect::<Vec<_>>(), spatial).map(|(s, _)| s)
        };
        assert_eq!(s(&[1, 5, 7, 11], &[false, true, true, true]).unwrap(), [5, 7, 11]);
        assert_eq!(s(&[1, 7, 11, 1], &[]).unwrap(), [1, 7, 11]);
        assert_eq!(s(&[5, 7, 1], &[]).unwrap(), [5, 7, 1]);
        let message = s(&[3, 5, 7, 11], &[]).unwrap_err().to_string();
        assert!(message.contains("axis 0 holds 3"), "{message}");
        let message = s(&[5, 7, 11, 20], &[]).unwrap_err().to_string();
        assert!(message.contains("axis 3 holds 20"), "{message}");
        assert!(s(&[3, 5, 7], &[false, true, true]).unwrap_err().to_string().contains("axis 0 holds 3"));
        assert!(s(&[5, 7], &[]).unwrap_err().to_string().contains("2 axes"));
    }

    #[test]
    fn volumes_in_memory_are_checked() {
        let ok = Volume::new(VolumeData::I16(vec![1, 2, 3, 4]), [2, 2, 1], [1.0, 2.0, 3.0], "v").unwrap();
        assert_eq!(ok.view().range(), (1.0, 4.0));
        assert!(Volume::new(VolumeData::U8(vec![0; 5]), [2, 2, 1], [1.0; 3], "v").is_err());
        assert!(Volume::new(VolumeData::U8(vec![0; 3]), [2, 2, 1], [1.0; 3], "v").is_err());
        assert!(Volume::new(VolumeData::U8(vec![0; 4]), [2, 2, 1], [1.0, f32::NAN, 1.0], "v").is_err());
        let mut v = ok.clone();
        assert!(v.set_range((2.0, 1.0)).is_err());
        assert_eq!(v.range, (1.0, 4.0));
        v.set_range((0.0, 8.0)).unwrap();
        assert_eq!(entire_core::scene::normalize(v.view().range(), v.view().value(1, 1, 0)), 0.5);
    }
}
