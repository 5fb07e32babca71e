//! A borrowed view of a scalar volume.

use crate::error::bail;
use crate::names::names;
use crate::{Error, ErrorKind, Result};
use glam::Vec3;

/// Largest number of voxels along one axis.
pub const MAX_VOLUME_EDGE: usize = 1 << 20;

/// Largest number of voxels of a volume whose strides read elements more than once (a stride of 0, or axes
/// that overlap). Other volumes are limited by their number of elements.
pub const MAX_REPEATED_VOXELS: u64 = 1 << 27;

/// Scalar types of volumes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ScalarType {
    /// Unsigned bytes.
    U8,
    /// Unsigned 16-bit integers.
    U16,
    /// Signed 16-bit integers.
    I16,
    /// 32-bit floats.
    F32,
}

names! { ScalarType:
    U8 "u8",
    U16 "u16",
    I16 "i16",
    F32 "f32",
}

/// Borrowed voxels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scalars<'a> {
    /// Unsigned bytes.
    U8(&'a [u8]),
    /// Unsigned 16-bit integers.
    U16(&'a [u16]),
    /// Signed 16-bit integers.
    I16(&'a [i16]),
    /// 32-bit floats; NaN and −∞ count as the low end of the range, +∞ as the high end.
    F32(&'a [f32]),
}

impl Scalars<'_> {
    /// The elements as f32, in order.
    pub fn iter(&self) -> impl Iterator<Item = f32> + '_ {
        (0..self.len()).map(|i| self.get(i))
    }

    pub(crate) fn len(&self) -> usize {
        match self {
            Self::U8(s) => s.len(),
            Self::U16(s) => s.len(),
            Self::I16(s) => s.len(),
            Self::F32(s) => s.len(),
        }
    }

    /// The element type.
    pub fn scalar_type(&self) -> ScalarType {
        match self {
            Self::U8(_) => ScalarType::U8,
            Self::U16(_) => ScalarType::U16,
            Self::I16(_) => ScalarType::I16,
            Self::F32(_) => ScalarType::F32,
        }
    }

    /// The element at `index`, as f32.
    #[inline]
    pub(crate) fn get(&self, index: usize) -> f32 {
        match self {
            Self::U8(s) => f32::from(s[index]),
            Self::U16(s) => f32::from(s[index]),
            Self::I16(s) => f32::from(s[index]),
            Self::F32(s) => s[index],
        }
    }
}

/// Sizes of a volume and the lengths derived from them.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Shape {
    /// Voxels along x, y, z.
    pub dims: [usize; 3],
    /// Number of voxels.
    pub voxels: u64,
    /// Voxel spacing along x, y, z, in world units.
    pub spacing: Vec3,
    /// `spacing`, scaled by the power of two that brings its largest component into 0.5…1. It has the same
    /// bits in all units of length that differ by a power of two.
    pub relative_spacing: Vec3,
    /// Radius of the volume's bounding sphere in world units: the unit of length of scene space. The sphere
    /// encloses the volume's box, which extends half a voxel beyond the outermost voxel centers.
    pub bounding_radius: f32,
    /// Half of the box's edge lengths along x, y, z in scene space; a vector of length 1.
    pub half_extent: Vec3,
    /// The reference ray step in scene space: the smallest voxel spacing.
    pub reference_step: f32,
}

impl Shape {
    /// Sizes of a volume without voxels in memory, such as one that is stored in bricks.
    ///
    /// # Errors
    /// [`ErrorKind::InvalidArgument`] for a size of 0 or a spacing that [`VolumeView::with`] refuses,
    /// [`ErrorKind::SizeMismatch`] for a size over [`MAX_VOLUME_EDGE`].
    pub fn checked(dims: [usize; 3], spacing: [f32; 3]) -> Result<Self> {
        check_not_empty(dims)?;
        check_edges(dims)?;
        Ok(Self::new(dims, check_spacing(spacing)?))
    }

    /// Sizes of a grid of `dims` voxels with a spacing in world units.
    fn new(dims: [usize; 3], spacing: Vec3) -> Self {
        let extent = Vec3::new(dims[0] as f32, dims[1] as f32, dims[2] as f32) * spacing;
        let bounding_radius = bounding_radius(extent);
        Self {
            dims,
            voxels: dims.iter().map(|&n| n as u64).product(),
            spacing,
            relative_spacing: normalized(spacing).0,
            bounding_radius,
            half_extent: 0.5 * extent / bounding_radius,
            reference_step: spacing.min_element() / bounding_radius,
        }
    }
}

/// Strides, spacing and value range of a volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VolumeOptions {
    /// Elements from one voxel to the next along x, y, z; `None` for a contiguous volume, x fastest. A stride
    /// may be 0 (a broadcast axis) and axes may overlap; such a volume may have at most
    /// [`MAX_REPEATED_VOXELS`] voxels.
    pub strides: Option<[usize; 3]>,
    /// Voxel spacing along x, y, z, in any common unit of length; 1 by default.
    pub spacing: [f32; 3],
    /// The scalar range that maps to [0, 1]; use one range for all members of an ensemble. `None` is the
    /// default: 0…255 for unsigned bytes; for other types, the finite minimum…maximum without
    /// [fill values](VolumeView::fill_values), for which the voxels are scanned.
    pub range: Option<(f32, f32)>,
}

impl Default for VolumeOptions {
    fn default() -> Self {
        Self { strides: None, spacing: [1.0; 3], range: None }
    }
}

/// A checked, borrowed scalar volume: voxels, sizes, strides, spacing and the scalar range that maps to
/// [0, 1].
///
/// Axis order is (x, y, z) everywhere; in the usual contiguous layout x runs fastest.
#[derive(Clone, Copy, Debug)]
pub struct VolumeView<'a> {
    scalars: Scalars<'a>,
    pub(super) dims: [usize; 3],
    pub(super) strides: [usize; 3],
    spacing: Vec3,
    range: (f32, f32),
}

impl<'a> VolumeView<'a> {
    /// A contiguous volume (x fastest) with unit spacing and the default range: 0…255 for unsigned bytes; for
    /// other types, the finite minimum…maximum without [fill values](Self::fill_values), for which the voxels
    /// are scanned.
    ///
    /// # Errors
    /// [`ErrorKind::InvalidArgument`] for a size of 0; [`ErrorKind::SizeMismatch`] for a size over
    /// [`MAX_VOLUME_EDGE`], a product of the sizes that overflows, or a slice shorter than that product. No
    /// voxel is read before these checks.
    pub fn new(scalars: Scalars<'a>, dims: [usize; 3]) -> Result<Self> {
        Self::with(scalars, dims, VolumeOptions::default())
    }

    /// A volume with the strides, spacing and range of `options`. If `options` has a range, no voxel is read.
    ///
    /// # Errors
    /// As [`VolumeView::new`]; [`ErrorKind::SizeMismatch`] for more than [`MAX_REPEATED_VOXELS`] voxels with
    /// strides that read elements more than once; [`ErrorKind::InvalidArgument`] for a spacing outside
    /// 1e-30…1e30, for a largest spacing over 1e6 times the smallest, and for a range unless both ends are
    /// finite and `low <= high`.
    pub fn with(scalars: Scalars<'a>, dims: [usize; 3], options: VolumeOptions) -> Result<Self> {
        let strides = match options.strides {
            Some(strides) => strides,
            None => [1, dims[0], dims[0].checked_mul(dims[1]).ok_or_else(|| overflow(dims))?],
        };
        let mut view = Self::unranged(scalars, dims, strides)?;
        view.spacing = check_spacing(options.spacing)?;
        view.range = match options.range {
            Some(range) => check_range(range)?,
            None => view.default_range(),
        };
        Ok(view)
    }

    fn unranged(scalars: Scalars<'a>, dims: [usize; 3], strides: [usize; 3]) -> Result<Self> {
        check_not_empty(dims)?;
        let voxels = (dims[0] as u64).checked_mul(dims[1] as u64).and_then(|p| p.checked_mul(dims[2] as u64));
        let Some(voxels) = voxels else { return Err(overflow(dims)) };
        check_edges(dims)?;
        let mut last = 0u64;
        for axis in 0..3 {
            last = (dims[axis] as u64 - 1)
                .checked_mul(strides[axis] as u64)
                .and_then(|o| o.checked_add(last))
                .ok_or_else(|| overflow(dims))?;
        }
        let needed = last.checked_add(1).ok_or_else(|| overflow(dims))?;
        let (found, [x, y, z]) = (scalars.len() as u64, dims);
        if needed > found {
            bail!(
                SizeMismatch,
                "volume of {x} x {y} x {z} voxels with strides {strides:?} needs {needed} elements, the slice \
                 has {found}; check sizes and strides"
            );
        }
        if voxels > needed && voxels > MAX_REPEATED_VOXELS {
            bail!(
                SizeMismatch,
                "volume of {x} x {y} x {z} voxels with strides {strides:?} reads {needed} elements repeatedly, \
                 {voxels} times in total; at most {MAX_REPEATED_VOXELS} voxels are accepted if strides \
                 repeat elements"
            );
        }
        Ok(Self { scalars, dims, strides, spacing: Vec3::ONE, range: (0.0, 1.0) })
    }

    /// The voxels.
    pub fn scalars(&self) -> Scalars<'a> {
        self.scalars
    }

    /// Sizes and lengths of the volume.
    pub fn shape(&self) -> Shape {
        Shape::new(self.dims, self.spacing)
    }

    /// Voxels along x, y, z.
    pub fn dims(&self) -> [usize; 3] {
        self.dims
    }

    /// Elements from one voxel to the next along x, y, z.
    pub fn strides(&self) -> [usize; 3] {
        self.strides
    }

    /// The scalar range that maps to [0, 1].
    pub fn range(&self) -> (f32, f32) {
        self.range
    }

    /// Element index of a voxel. Panics in debug builds if the voxel is out of bounds.
    #[inline]
    pub(crate) fn index(&self, x: usize, y: usize, z: usize) -> usize {
        debug_assert!(x < self.dims[0] && y < self.dims[1] && z < self.dims[2]);
        x * self.strides[0] + y * self.strides[1] + z * self.strides[2]
    }

    /// The stored value of a voxel.
    #[inline]
    pub fn value(&self, x: usize, y: usize, z: usize) -> f32 {
        self.scalars.get(self.index(x, y, z))
    }

    /// The value of a voxel mapped to [0, 1] over the range.
    #[inline]
    #[cfg(test)]
    pub(crate) fn normalized(&self, x: usize, y: usize, z: usize) -> f32 {
        normalize(self.range, self.value(x, y, z))
    }
}

/// Maps a stored value from a volume's range to [0, 1]. Values outside the range are clamped, NaN gives 0,
/// and a range of width 0 gives 0 for every value.
#[inline]
pub fn normalize((lo, hi): (f32, f32), value: f32) -> f32 {
    let width = hi - lo;
    if width <= 0.0 || value.is_nan() {
        return 0.0;
    }
    // An infinite width (f32::MIN…f32::MAX) still gives a value in [0, 1].
    let t = if width.is_finite() {
        (value - lo) / width
    } else {
        (value * 0.5 - lo * 0.5) / (hi * 0.5 - lo * 0.5)
    };
    t.clamp(0.0, 1.0)
}

fn check_spacing(spacing: [f32; 3]) -> Result<Vec3> {
    if spacing.iter().any(|s| !(s.is_finite() && *s > 0.0)) {
        bail!(
            InvalidArgument,
            "voxel spacing is {spacing:?}; all three must be finite and positive (use 1, 1, 1 when unknown)"
        );
    }
    if spacing.iter().any(|s| !(1e-30..=1e30).contains(s)) {
        bail!(
            InvalidArgument,
            "voxel spacing is {spacing:?}; all three must lie in 1e-30…1e30 (choose another unit of length)"
        );
    }
    let (lo, hi) =
        (spacing.iter().copied().fold(f32::MAX, f32::min), spacing.iter().copied().fold(0.0, f32::max));
    if hi / lo > 1e6 {
        bail!(InvalidArgument, "voxel spacings {spacing:?} differ by a factor over 1e6; check their units");
    }
    Ok(Vec3::from_array(spacing))
}

fn check_not_empty(dims: [usize; 3]) -> Result<()> {
    for (axis, &n) in ["x", "y", "z"].iter().zip(&dims) {
        if n == 0 {
            bail!(InvalidArgument, "volume size along {axis} is 0; every size must be at least 1");
        }
    }
    Ok(())
}

/// Refuses sizes over [`MAX_VOLUME_EDGE`].
fn check_edges([x, y, z]: [usize; 3]) -> Result<()> {
    if x.max(y).max(z) > MAX_VOLUME_EDGE {
        bail!(
            SizeMismatch,
            "volume of {x} x {y} x {z} voxels; an axis has at most {MAX_VOLUME_EDGE} voxels; check the sizes"
        );
    }
    Ok(())
}

/// Returns `v` divided by the power of two that brings its largest component into 0.5…1, and the exponent of
/// this power. The division rounds nothing. For any unit of length, the squared length of the quotient is
/// within the range of `f32`.
fn normalized(v: Vec3) -> (Vec3, i32) {
    let (_, exponent) = libm::frexpf(v.max_element());
    (Vec3::from_array(v.to_array().map(|c| libm::ldexpf(c, -exponent))), exponent)
}

fn bounding_radius(extent: Vec3) -> f32 {
    let (scaled, exponent) = normalized(extent);
    libm::ldexpf(0.5 * scaled.length(), exponent)
}

#[cold]
fn overflow([x, y, z]: [usize; 3]) -> Error {
    let message = alloc::format!("volume of {x} x {y} x {z} voxels is too large to address; check the sizes");
    Error::new(ErrorKind::SizeMismatch, message)
}

fn check_range((low, high): (f32, f32)) -> Result<(f32, f32)> {
    if !(low.is_finite() && high.is_finite() && low <= high) {
        bail!(
            InvalidArgument,
            "scalar range is {low}…{high}; both ends must be finite and the low end not above the high one"
        );
    }
    Ok((low, high))
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec::Vec;

    fn ranged(low: f32, high: f32) -> VolumeOptions {
        VolumeOptions { range: Some((low, high)), ..VolumeOptions::default() }
    }

    fn strided(strides: [usize; 3]) -> VolumeOptions {
        VolumeOptions { strides: Some(strides), ..VolumeOptions::default() }
    }

    #[test]
    fn u8_keeps_the_full_byte_range_and_f32_finds_its_finite_range() {
        let bytes = [3u8; 8];
        assert_eq!(VolumeView::new(Scalars::U8(&bytes), [2, 2, 2]).unwrap().range(), (0.0, 255.0));
        let floats = [f32::NAN, -2.0, f32::INFINITY, 6.0, 0.0, 1.0];
        let v = VolumeView::new(Scalars::F32(&floats), [1, 2, 3]).unwrap();
        assert_eq!(v.range(), (-2.0, 6.0));
        assert_eq!(v.normalized(0, 0, 0), 0.0);
        assert_eq!(v.normalized(0, 0, 1), 1.0);
        assert_eq!(v.normalized(0, 0, 2), 0.25);
    }

    #[test]
    fn a_known_range_is_taken_without_a_scan() {
        let floats = [f32::NAN, -2.0, 9.0, 6.0];
        let scalars = Scalars::F32(&floats);
        let v = VolumeView::with(scalars, [4, 1, 1], ranged(0.0, 12.0)).unwrap();
        assert_eq!((v.range(), v.normalized(3, 0, 0)), ((0.0, 12.0), 0.5));
        assert!(VolumeView::with(scalars, [4, 1, 1], ranged(1.0, 0.0)).is_err());
        assert!(VolumeView::with(scalars, [4, 2, 1], ranged(0.0, 1.0)).is_err());
    }

    #[test]
    fn constant_and_non_finite_volumes_normalize_to_zero() {
        let constant = [7i16; 4];
        let v = VolumeView::new(Scalars::I16(&constant), [4, 1, 1]).unwrap();
        assert_eq!(v.normalized(3, 0, 0), 0.0);
        let nan = [f32::NAN; 4];
        let v = VolumeView::new(Scalars::F32(&nan), [4, 1, 1]).unwrap();
        assert_eq!((v.range(), v.normalized(1, 0, 0)), ((0.0, 1.0), 0.0));
    }

    #[test]
    fn whole_float_range_does_not_overflow() {
        let v = [f32::MIN, f32::MAX, 0.0];
        let v = VolumeView::new(Scalars::F32(&v), [3, 1, 1]).unwrap();
        assert_eq!(v.normalized(0, 0, 0), 0.0);
        assert_eq!(v.normalized(1, 0, 0), 1.0);
        assert!((v.normalized(2, 0, 0) - 0.5).abs() < 1e-6);
    }

    #[test]
    fn strides_address_a_sub_block() {
        // The 2 x 2 x 2 corner at (1, 1, 1) of a 3 x 4 x 5 volume.
        let data: Vec<u16> = (0..60).collect();
        let scalars = Scalars::U16(&data[1 + 3 + 12..]);
        let v = VolumeView::with(scalars, [2, 2, 2], strided([1, 3, 12])).unwrap();
        assert_eq!(v.value(0, 0, 0), 16.0);
        assert_eq!(v.value(1, 1, 1), 32.0);
    }

    #[test]
    fn bad_sizes_are_refused_with_a_remedy() {
        let data = [0u8; 10];
        let kind = |d| VolumeView::new(Scalars::U8(&data), d).unwrap_err();
        assert_eq!(kind([0, 1, 1]).kind(), ErrorKind::InvalidArgument);
        assert_eq!(kind([11, 1, 1]).kind(), ErrorKind::SizeMismatch);
        assert!(kind([3, 2, 2]).to_string().contains("needs 12 elements, the slice has 10"));
        assert_eq!(kind([usize::MAX, usize::MAX, 2]).kind(), ErrorKind::SizeMismatch);
        let with = |options| VolumeView::with(Scalars::U8(&data), [10, 1, 1], options).map_err(|e| e.kind());
        let refused = Some(ErrorKind::InvalidArgument);
        for bad in [
            [0.0, 1.0, 1.0],
            [1.0, -1.0, 1.0],
            [f32::NAN, 1.0, 1.0],
            [1.0, 1.0, f32::INFINITY],
            [1.0, 1.0, 1e7],
        ] {
            assert_eq!(with(VolumeOptions { spacing: bad, ..VolumeOptions::default() }).err(), refused);
        }
        for (low, high) in [(2.0, 1.0), (f32::NAN, 1.0), (0.0, f32::INFINITY)] {
            assert_eq!(with(ranged(low, high)).err(), refused);
        }
        assert_eq!(with(VolumeOptions::default()).unwrap().range(), (0.0, 255.0));
    }

    #[test]
    fn declared_sizes_are_refused_before_a_voxel_is_read() {
        let one = [0.0f32];
        let repeated = |n: [usize; 3], strides| VolumeView::with(Scalars::F32(&one), n, strided(strides));
        for (n, says) in [
            (200_000, "at most 134217728 voxels"),
            (1 << 21, "an axis has at most 1048576"),
            (1 << 24, "too large to address"),
        ] {
            let error = repeated([n; 3], [0; 3]).unwrap_err();
            assert_eq!(error.kind(), ErrorKind::SizeMismatch, "{n}");
            assert!(error.to_string().contains(says), "{error}");
        }
        // The number of elements that this stride needs overflows.
        let error = repeated([2, 1, 1], [usize::MAX, 0, 0]).unwrap_err();
        assert!(!error.to_string().contains("needs 0 elements"), "{error}");
        // Overlapping axes repeat elements, too.
        let voxels = [0u8; 3 * 512 + 1];
        let scalars = Scalars::U8(&voxels);
        let overlapping = |n: usize| VolumeView::with(scalars, [n; 3], strided([1; 3]));
        assert!(overlapping(512).is_ok(), "2^27 voxels are accepted");
        assert!(overlapping(513).is_err());
        // A volume without repeated elements is limited only by its number of elements.
        assert!(VolumeView::with(scalars, [512, 1, 1], strided([3, 9, 9])).is_ok());
    }

    #[test]
    fn geometry_is_that_of_the_spacing_in_any_unit_of_length() {
        let spaced = |spacing| Shape::checked([4, 2, 1], spacing);
        let expected = spaced([0.5, 1.0, 4.0]).unwrap();
        let extent = 2.0 * expected.half_extent * expected.bounding_radius;
        assert!((extent - Vec3::new(2.0, 2.0, 4.0)).length() < 1e-6, "{extent}");
        assert!((expected.bounding_radius - 0.5 * 24f32.sqrt()).abs() < 1e-6);
        assert!((expected.half_extent.length() - 1.0).abs() < 1e-6);
        assert!((expected.reference_step - 0.5 / expected.bounding_radius).abs() < 1e-7);
        for unit in [1e-29f32, 1e-12, 1e24, 1e29] {
            let shape = spaced([0.5 * unit, unit, 4.0 * unit]).unwrap();
            assert!((shape.half_extent - expected.half_extent).length() < 1e-6, "{unit}");
            assert!((shape.reference_step - expected.reference_step).abs() < 1e-6, "{unit}");
        }
        for unit in [1e-31, 1e31] {
            assert!(spaced([unit; 3]).is_err());
        }
    }
}
