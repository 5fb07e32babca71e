//! `entire_volume`: voxels of any scalar type, or bounds of bricks; with or without precomputed features.

mod update;

#[cfg(test)]
pub(crate) use update::*;

use crate::abi::{ByValue, by_value, check_output, init_struct, read_struct, slice, write_struct};
use crate::guard::{changing, entry, freeing, guard, making, reading};
use crate::handle::{Held, handle};
use crate::limits::{ENTIRE_MAX_BRICKS, ENTIRE_MAX_FEATURES, at_most, check_dims};
use crate::reserve;
use crate::result::entire_result::{self, *};
use crate::result::{Failure, refuse};
use entire_core::memory::collected;
use entire_core::scene::{ScalarType, Scalars, Shape, VolumeOptions, VolumeView};
use entire_steer::features::{SummarySeries, VolumeSummary};
use std::any::Any;
use std::ffi::c_void;
use std::mem::MaybeUninit;
use std::sync::OnceLock;

/// Type of a voxel: one of the `ENTIRE_SCALAR_*` numbers.
pub type entire_scalar_type = u32;
/// Unsigned 8-bit integers.
pub const ENTIRE_SCALAR_U8: entire_scalar_type = 1;
/// Signed 8-bit integers, which can only be copied (kept as 16-bit integers).
pub const ENTIRE_SCALAR_I8: entire_scalar_type = 2;
/// Unsigned 16-bit integers.
pub const ENTIRE_SCALAR_U16: entire_scalar_type = 3;
/// Signed 16-bit integers.
pub const ENTIRE_SCALAR_I16: entire_scalar_type = 4;
/// Unsigned 32-bit integers, which can only be copied (kept as 32-bit floats).
pub const ENTIRE_SCALAR_U32: entire_scalar_type = 5;
/// Signed 32-bit integers, which can only be copied (kept as 32-bit floats).
pub const ENTIRE_SCALAR_I32: entire_scalar_type = 6;
/// 32-bit floats.
pub const ENTIRE_SCALAR_F32: entire_scalar_type = 7;
/// 64-bit floats, which can only be copied (kept as 32-bit floats).
pub const ENTIRE_SCALAR_F64: entire_scalar_type = 8;
/// Unsigned 64-bit integers, which can only be copied (kept as 32-bit floats).
pub const ENTIRE_SCALAR_U64: entire_scalar_type = 9;
/// Signed 64-bit integers, which can only be copied (kept as 32-bit floats).
pub const ENTIRE_SCALAR_I64: entire_scalar_type = 10;

/// Ownership of the voxels: one of the two `ENTIRE_VOXELS_*` numbers.
pub type entire_voxels_ownership = u32;
/// The library copies the voxels; the caller may free its memory when the call returns.
pub const ENTIRE_VOXELS_COPY: entire_voxels_ownership = 1;
/// The library reads the caller's memory, which must stay valid and unchanged until the volume is freed.
/// Exception: the caller may write the voxels of the volume's next time step there (entire_volume_update).
/// Only U8, U16, I16 and F32 voxels that are aligned to their size can be borrowed.
pub const ENTIRE_VOXELS_BORROW: entire_voxels_ownership = 2;

/// Value of all three `strides` for voxels without gaps, in which x runs fastest, then y, then z.
pub const ENTIRE_STRIDE_CONTIGUOUS: usize = usize::MAX;

/// A volume of voxels. Fill with entire_volume_desc_init, then set what differs.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_volume_desc {
    /// sizeof(entire_volume_desc).
    pub struct_size: usize,
    /// The voxels. No default.
    pub voxels: *const c_void,
    /// Number of elements of the scalar type at `voxels`. No default.
    pub voxel_count: usize,
    /// One of ENTIRE_SCALAR_*. No default.
    pub scalar_type: entire_scalar_type,
    /// ENTIRE_VOXELS_COPY (default) or ENTIRE_VOXELS_BORROW.
    pub ownership: entire_voxels_ownership,
    /// Voxels along x, y, z, each 1 to ENTIRE_MAX_SIDE. No default. If zero or overlapping strides make their
    /// product larger than `voxel_count`, the product is at most ENTIRE_MAX_REPEATED_VOXELS.
    pub dims: [usize; 3],
    /// Elements from one voxel to the next along x, y, z; default ENTIRE_STRIDE_CONTIGUOUS. A stride of 0
    /// repeats a voxel.
    pub strides: [usize; 3],
    /// Voxel spacing along x, y, z in any unit, 1e-30 to 1e30, the largest at most 1e6 times the smallest;
    /// default 1, 1, 1.
    pub spacing: [f32; 3],
    /// Scalar values that map to 0 and 1. Default NaN, NaN: 0 and 255 for U8, else the finite minimum and
    /// maximum of the voxels without fill values. There are at most four fill values, found one after another
    /// in a sample of the voxels. Each is the least or the greatest of the values that remain without the
    /// previous fill values. At least four sampled voxels, and at least one in 1024, have the fill value, and
    /// the sample has at least 16 other distinct values. The distance of the fill value from all other
    /// remaining values is at least an eighth of the width of their range.
    pub range: [f32; 2],
    /// Must be 0.
    pub reserved: u32,
}

by_value!(entire_volume_desc {
    voxels: std::ptr::null(),
    voxel_count: 0,
    scalar_type: 0,
    ownership: ENTIRE_VOXELS_COPY,
    dims: [0; 3],
    strides: [ENTIRE_STRIDE_CONTIGUOUS; 3],
    spacing: [1.0; 3],
    range: [f32::NAN; 2],
    reserved: 0,
});

/// A volume that is described only by the value bounds of its bricks, which renderers keep for empty-space
/// skipping. Fill with entire_brick_desc_init, then set what differs.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_brick_desc {
    /// sizeof(entire_brick_desc).
    pub struct_size: usize,
    /// Voxels of the whole volume along x, y, z, each 1 to ENTIRE_MAX_SIDE. No default.
    pub dims: [usize; 3],
    /// Voxel spacing along x, y, z in any unit, 1e-30 to 1e30, the largest at most 1e6 times the smallest;
    /// default 1, 1, 1.
    pub spacing: [f32; 3],
    /// The voxels' scalar type, one of ENTIRE_SCALAR_*. No default.
    pub scalar_type: entire_scalar_type,
    /// Voxels of a brick along x, y, z. No default.
    pub brick_edge: [usize; 3],
    /// Lowest and highest normalized scalar value (0 to 1 over the volume's range) of each brick, x fastest,
    /// including neighboring voxels that interpolation reads: two floats per brick. Numbers under 0 and NaN
    /// count as 0, numbers over 1 as 1. No default.
    pub bounds: *const f32,
    /// Number of bricks: dims / brick_edge, rounded up along each axis, multiplied. At most
    /// ENTIRE_MAX_BRICKS.
    pub brick_count: usize,
}

by_value!(entire_brick_desc {
    dims: [0; 3],
    spacing: [1.0; 3],
    scalar_type: 0,
    brick_edge: [0; 3],
    bounds: std::ptr::null(),
    brick_count: 0,
});

/// The library's description of a volume. Set struct_size before the call.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_volume_info {
    /// sizeof(entire_volume_info).
    pub struct_size: usize,
    /// Voxels along x, y, z.
    pub dims: [usize; 3],
    /// Voxel spacing along x, y, z.
    pub spacing: [f32; 3],
    /// Radius of the bounding sphere in the unit of the spacing. entire_frame.arcball[2] is a multiple of it.
    pub bounding_radius: f32,
    /// Length of the reference step in the unit of the spacing.
    pub reference_step: f32,
    /// Scalar values that map to 0 and 1; NaN where only bricks are known.
    pub range: [f32; 2],
    /// Scalar type that the caller gave.
    pub scalar_type: entire_scalar_type,
    /// Not 0 where the volume has voxels (it can be encoded), 0 where only bricks are known.
    pub has_voxels: u32,
    /// Number of precomputed features (entire_volume_set_features); 0 where there are none.
    pub feature_count: u32,
    /// Share of voxels that are NaN or infinite as 32-bit floats, 0 to 1; NaN where only bricks are known,
    /// and before entire_session_set_volume, entire_session_set_time_step or entire_volume_update has read
    /// the voxels. Such voxels count as ends of the range: NaN and negative infinity as the low end, positive
    /// infinity as the high end.
    pub non_finite_share: f32,
    /// Must be ignored.
    pub reserved: u32,
}

by_value!(entire_volume_info {
    dims: [0; 3],
    spacing: [f32::NAN; 3],
    bounding_radius: f32::NAN,
    reference_step: f32::NAN,
    range: [f32::NAN; 2],
    scalar_type: 0,
    has_voxels: 0,
    feature_count: 0,
    non_finite_share: f32::NAN,
    reserved: 0,
});

/// Voxels, or bounds of bricks. Immutable except for its precomputed features and its time steps; may be used
/// by any number of sessions.
pub struct entire_volume(Held<Volume>);

#[derive(Default)]
pub(crate) struct Volume {
    voxels: Option<Voxels>,
    summary: OnceLock<VolumeSummary>,
    /// Holds the summary in place of `summary` once entire_volume_update was called.
    series: Option<Box<SummarySeries>>,
    scalar_type: entire_scalar_type,
    pub(crate) features: Option<Vec<f32>>,
}

/// Memory of voxels that the library copied: a vector.
type Copied = Box<dyn Any + Send + Sync>;

/// A view of the voxels and, if the library copied them, their memory.
struct Voxels {
    /// In a `MaybeUninit`, since the view must not be a live reference between calls: the owner of borrowed
    /// voxels may then write the next time step to them.
    view: MaybeUninit<VolumeView<'static>>,
    shape: Shape,
    range: (f32, f32),
    _copy: Option<Copied>,
}

impl Voxels {
    fn new(view: VolumeView<'static>, copy: Option<Copied>) -> Self {
        let (shape, range) = (view.shape(), view.range());
        Self { view: MaybeUninit::new(view), shape, range, _copy: copy }
    }

    fn view(&self) -> &VolumeView<'static> {
        // SAFETY: `new` always sets the view, and the caller leaves the voxels unchanged during calls.
        unsafe { self.view.assume_init_ref() }
    }
}

handle!(entire_volume, Volume);

impl Volume {
    fn voxels(&self) -> Result<&Voxels, Failure> {
        self.voxels.as_ref().ok_or_else(|| {
            Failure::new(
                ENTIRE_NOT_READY,
                "the volume was made from bricks and has no voxels; make it with entire_volume_new, \
                 or pass precomputed features to entire_volume_set_features",
            )
        })
    }

    /// The voxels.
    pub(crate) fn view(&self) -> Result<&VolumeView<'static>, Failure> {
        self.voxels().map(Voxels::view)
    }

    /// The summary, made at the first call.
    pub(crate) fn summary(&self) -> Result<&VolumeSummary, Failure> {
        if let Some(series) = &self.series {
            return Ok(series.summary()?);
        }
        if let Some(summary) = self.summary.get() {
            return Ok(summary);
        }
        let summary = VolumeSummary::new(self.view()?)?;
        Ok(self.summary.get_or_init(|| summary))
    }

    /// Share of voxels that are NaN or infinite; NaN before the voxels are scanned.
    fn non_finite_share(&self) -> f32 {
        let summary = self.series.as_ref().and_then(|series| series.summary().ok());
        summary.or(self.summary.get()).map_or(f32::NAN, VolumeSummary::non_finite_share)
    }
}

/// Fills a volume description with its defaults; `struct_size` is sizeof(entire_volume_desc).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_volume_desc_init(
    desc: *mut entire_volume_desc,
    struct_size: usize,
) -> entire_result {
    entry!(guard(|| init_struct(desc, struct_size)))
}

/// Fills a brick description with its defaults; `struct_size` is sizeof(entire_brick_desc).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_brick_desc_init(
    desc: *mut entire_brick_desc,
    struct_size: usize,
) -> entire_result {
    entry!(guard(|| init_struct(desc, struct_size)))
}

/// Makes a volume of voxels. NaN and negative infinity count as the low end of the range, positive infinity
/// as the high end.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (an unknown scalar type or ownership, a zero size, a spacing or range
/// that is not accepted, strides of which only some are ENTIRE_STRIDE_CONTIGUOUS, borrowed voxels that are
/// not aligned), ENTIRE_SIZE_MISMATCH (fewer voxels than sizes and strides need, or sizes over the limits of
/// entire_volume_desc), ENTIRE_OUT_OF_MEMORY (ENTIRE_VOXELS_BORROW needs no memory for
/// voxels), ENTIRE_UNSUPPORTED (a scalar type that cannot be borrowed), ENTIRE_NULL_ARGUMENT,
/// ENTIRE_STRUCT_SIZE.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_volume_new(
    desc: *const entire_volume_desc,
    volume: *mut *mut entire_volume,
) -> entire_result {
    entry!(making(volume, "volume (output)", || {
        let desc = read_struct(desc)?;
        let voxels = take_voxels(&desc)?;
        Ok(Volume { voxels: Some(voxels), scalar_type: desc.scalar_type, ..Volume::default() })
    }))
}

/// Copies or borrows the voxels that `desc` describes.
///
/// # Safety
/// `desc.voxels` is NULL or valid for reads of `desc.voxel_count` elements, for as long as the result lives
/// if they are borrowed.
unsafe fn take_voxels(desc: &entire_volume_desc) -> Result<Voxels, Failure> {
    if desc.voxels.is_null() {
        return Err(Failure::null("entire_volume_desc.voxels"));
    }
    if desc.reserved != 0 {
        refuse!(
            ENTIRE_INVALID_ARGUMENT,
            "entire_volume_desc.reserved must be 0; call entire_volume_desc_init"
        );
    }
    check_dims(desc.dims, Some(desc.voxel_count))?;
    let (at, count) = (desc.voxels, desc.voxel_count);
    let borrow = match desc.ownership {
        ENTIRE_VOXELS_COPY => false,
        ENTIRE_VOXELS_BORROW => true,
        other => refuse!(
            ENTIRE_INVALID_ARGUMENT,
            "ownership is {other}; it must be ENTIRE_VOXELS_COPY (1) or ENTIRE_VOXELS_BORROW (2)"
        ),
    };
    // SAFETY: the caller guarantees that `at` is NULL or valid for `count` elements. Each copy lives as long
    // as the view of its detached elements.
    let (scalars, copy) = unsafe {
        match (desc.scalar_type, borrow) {
            (ENTIRE_SCALAR_U8, true) => (Scalars::U8(slice(at.cast(), count, "voxels")?), None),
            (ENTIRE_SCALAR_U16, true) => (Scalars::U16(slice(at.cast(), count, "voxels")?), None),
            (ENTIRE_SCALAR_I16, true) => (Scalars::I16(slice(at.cast(), count, "voxels")?), None),
            (ENTIRE_SCALAR_F32, true) => (Scalars::F32(slice(at.cast(), count, "voxels")?), None),
            (ENTIRE_SCALAR_U8, false) => owned(convert(at, count, |v: u8| v)?, Scalars::U8),
            (ENTIRE_SCALAR_I8, false) => owned(convert(at, count, |v: i8| i16::from(v))?, Scalars::I16),
            (ENTIRE_SCALAR_U16, false) => owned(convert(at, count, |v: u16| v)?, Scalars::U16),
            (ENTIRE_SCALAR_I16, false) => owned(convert(at, count, |v: i16| v)?, Scalars::I16),
            (ENTIRE_SCALAR_U32, false) => owned(convert(at, count, |v: u32| v as f32)?, Scalars::F32),
            (ENTIRE_SCALAR_I32, false) => owned(convert(at, count, |v: i32| v as f32)?, Scalars::F32),
            (ENTIRE_SCALAR_F32, false) => owned(convert(at, count, |v: f32| v)?, Scalars::F32),
            (ENTIRE_SCALAR_F64, false) => owned(convert(at, count, |v: f64| v as f32)?, Scalars::F32),
            (ENTIRE_SCALAR_U64, false) => owned(convert(at, count, |v: u64| v as f32)?, Scalars::F32),
            (ENTIRE_SCALAR_I64, false) => owned(convert(at, count, |v: i64| v as f32)?, Scalars::F32),
            (kind @ ENTIRE_SCALAR_I8..=ENTIRE_SCALAR_I64, true) => refuse!(
                ENTIRE_UNSUPPORTED,
                "voxels of scalar type {kind} cannot be borrowed, only U8, U16, I16 and F32 can; \
                 use ENTIRE_VOXELS_COPY"
            ),
            (other, _) => return Err(unknown_scalar(other)),
        }
    };
    let contiguous = desc.strides == [ENTIRE_STRIDE_CONTIGUOUS; 3];
    if !contiguous && desc.strides.contains(&ENTIRE_STRIDE_CONTIGUOUS) {
        refuse!(
            ENTIRE_INVALID_ARGUMENT,
            "some strides are ENTIRE_STRIDE_CONTIGUOUS and some are not; set all three or none"
        );
    }
    let [low, high] = desc.range;
    let options = VolumeOptions {
        strides: (!contiguous).then_some(desc.strides),
        spacing: desc.spacing,
        range: desc.range.iter().any(|end| !end.is_nan()).then_some((low, high)),
    };
    let view = VolumeView::with(scalars, desc.dims, options)?;
    Ok(Voxels::new(view, copy))
}

/// Copies `count` elements, aligned or not.
///
/// # Safety
/// `at` is valid for reads of `count` elements of `T`, of which any bytes are a value.
unsafe fn convert<T: Copy, U>(
    at: *const c_void,
    count: usize,
    map: impl Fn(T) -> U,
) -> Result<Vec<U>, Failure> {
    let fits =
        count.checked_mul(size_of::<T>().max(size_of::<U>())).is_some_and(|b| b <= isize::MAX as usize);
    if !fits {
        refuse!(ENTIRE_SIZE_MISMATCH, "voxel_count is {count}, more than memory can hold; check the count");
    }
    let mut copy = Vec::new();
    if copy.try_reserve_exact(count).is_err() {
        refuse!(
            ENTIRE_OUT_OF_MEMORY,
            "there is no memory for a copy of {count} voxels; check voxel_count, \
             or use ENTIRE_VOXELS_BORROW"
        );
    }
    let at = at.cast::<T>();
    // SAFETY: the caller guarantees that `count` elements are readable at `at`. The read assumes no
    // alignment.
    copy.extend((0..count).map(|i| map(unsafe { at.add(i).read_unaligned() })));
    Ok(copy)
}

/// Returns the elements of a vector, detached from the lifetime of a borrow, and the vector.
///
/// # Safety
/// The vector lives and is neither grown nor changed for as long as its elements are used.
unsafe fn owned<T: Send + Sync + 'static>(
    copy: Vec<T>,
    wrap: fn(&'static [T]) -> Scalars<'static>,
) -> (Scalars<'static>, Option<Copied>) {
    // SAFETY: the caller keeps the vector unchanged, and its elements stay in place when the vector is moved.
    let elements = unsafe { std::slice::from_raw_parts(copy.as_ptr(), copy.len()) };
    (wrap(elements), Some(Box::new(copy)))
}

fn unknown_scalar(found: u32) -> Failure {
    Failure::new(
        ENTIRE_INVALID_ARGUMENT,
        format!("scalar_type is {found}; it must be one of ENTIRE_SCALAR_U8 (1) to ENTIRE_SCALAR_I64 (10)"),
    )
}

/// Makes a volume from the bounds of bricks. It has no voxels to encode: for a model with volume features,
/// call entire_volume_set_features too.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a value of the description that is out of range), ENTIRE_SIZE_MISMATCH
/// (a brick count that does not match sizes and edge, or sizes over the limits of entire_brick_desc),
/// ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT, ENTIRE_STRUCT_SIZE.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_volume_from_bricks(
    desc: *const entire_brick_desc,
    volume: *mut *mut entire_volume,
) -> entire_result {
    entry!(making(volume, "volume (output)", || {
        let desc = read_struct(desc)?;
        check_dims(desc.dims, None)?;
        at_most("brick_count", desc.brick_count, ENTIRE_MAX_BRICKS, "ENTIRE_MAX_BRICKS")?;
        let kept_as = match desc.scalar_type {
            ENTIRE_SCALAR_U8 => ScalarType::U8,
            ENTIRE_SCALAR_U16 => ScalarType::U16,
            ENTIRE_SCALAR_I8 | ENTIRE_SCALAR_I16 => ScalarType::I16,
            ENTIRE_SCALAR_U32..=ENTIRE_SCALAR_I64 => ScalarType::F32,
            other => return Err(unknown_scalar(other)),
        };
        let bounds = slice(desc.bounds.cast::<[f32; 2]>(), desc.brick_count, "entire_brick_desc.bounds")?;
        let summary = VolumeSummary::from_bricks(desc.dims, desc.spacing, kept_as, desc.brick_edge, bounds)?;
        Ok(Volume { summary: summary.into(), scalar_type: desc.scalar_type, ..Volume::default() })
    }))
}

/// Sets precomputed volume features, from entire_model_encode with the same model in this or an earlier run;
/// they are used instead of encoding the voxels. A count of 0 removes them.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a feature that is not finite), ENTIRE_SIZE_MISMATCH (over
/// ENTIRE_MAX_FEATURES), ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_volume_set_features(
    volume: *mut entire_volume,
    features: *const f32,
    feature_count: usize,
) -> entire_result {
    entry!(changing(volume, |volume| {
        reserve::check()?;
        at_most("feature_count", feature_count, ENTIRE_MAX_FEATURES, "ENTIRE_MAX_FEATURES")?;
        let features = slice(features, feature_count, "features")?;
        if let Some(i) = features.iter().position(|f| !f.is_finite()) {
            refuse!(ENTIRE_INVALID_ARGUMENT, "feature {i} is {}; all must be finite", features[i]);
        }
        let kept = collected(features.iter().copied())?;
        volume.features = (!kept.is_empty()).then_some(kept);
        Ok(())
    }))
}

/// Reads the properties of a volume; set info->struct_size first.
///
/// Fails with ENTIRE_NULL_ARGUMENT, ENTIRE_STRUCT_SIZE.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_volume_describe(
    volume: *const entire_volume,
    info: *mut entire_volume_info,
) -> entire_result {
    entry!(reading(volume, |volume| {
        check_output(info)?;
        let feature_count = volume.features.as_ref().map_or(0, |f| f.len() as u32);
        let mut out =
            entire_volume_info { scalar_type: volume.scalar_type, feature_count, ..ByValue::defaults() };
        let mut shape = volume.summary.get().map(VolumeSummary::shape);
        if let Some(voxels) = &volume.voxels {
            shape = Some(voxels.shape);
            out.range = voxels.range.into();
            out.has_voxels = 1;
            out.non_finite_share = volume.non_finite_share();
        }
        if let Some(shape) = shape {
            out.dims = shape.dims;
            out.spacing = shape.spacing.to_array();
            out.bounding_radius = shape.bounding_radius;
            out.reference_step = shape.spacing.min_element();
        }
        write_struct(info, &out)
    }))
}

/// Frees a volume; NULL does nothing. Sessions that were given the volume keep the data that they need.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_volume_free(volume: *mut entire_volume) {
    entry!(freeing(volume))
}
