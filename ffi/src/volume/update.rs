//! The next time step of a volume.

use super::{Volume, entire_volume, entire_volume_desc, take_voxels};
use crate::abi::{read_struct, slice};
use crate::guard::{Outcome, changing, entry};
use crate::reserve;
use crate::result::entire_result::{self, *};
use crate::result::refuse;
use entire_core::kernels::Executor;
use entire_steer::features::SummarySeries;
use std::ops::Range;
use std::sync::OnceLock;

/// Sets the next time step of a volume. The time step must have the volume's sizes, spacing and scalar type.
/// `desc` describes its voxels: new ones, or the borrowed ones, overwritten by the caller. A range of NaN,
/// NaN keeps the volume's range; any other range must equal the volume's. Precomputed features are removed,
/// since they belong to the previous time step. After this call, call entire_session_set_time_step for each
/// session. No other call may use the volume during this one.
///
/// One pass over the voxels, much faster than the scan of a new volume, finds the changed parts. Only these
/// are scanned again. The first call scans the whole volume, because the data for comparisons (some 50 bytes
/// per 8 x 8 x 8 voxels) are not kept for volumes that never change.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a scalar type, spacing or range that differs from the volume's, and
/// the cases of entire_volume_new), ENTIRE_SIZE_MISMATCH (sizes that differ from the volume's, and the cases
/// of entire_volume_new), ENTIRE_NOT_READY (a volume made from bricks), ENTIRE_OUT_OF_MEMORY,
/// ENTIRE_UNSUPPORTED (a scalar type that cannot be borrowed), ENTIRE_NULL_ARGUMENT, ENTIRE_STRUCT_SIZE.
/// After a failure, the volume keeps the previous time step. After ENTIRE_OUT_OF_MEMORY, the next use of the
/// volume may scan it again. If the caller has overwritten borrowed voxels, this scan finds the new ones.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_volume_update(
    volume: *mut entire_volume,
    desc: *const entire_volume_desc,
) -> entire_result {
    entry!(changing(volume, |volume| update(volume, desc, None)))
}

/// Like entire_volume_update, for changes inside a known box of voxels, which starts at voxel `first` (three
/// numbers, along x, y, z) and has `size` voxels (three numbers). Only blocks that the box touches are read.
///
/// Fails like entire_volume_update, and with ENTIRE_INVALID_ARGUMENT for a box that reaches beyond the
/// volume.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_volume_update_box(
    volume: *mut entire_volume,
    desc: *const entire_volume_desc,
    first: *const usize,
    size: *const usize,
) -> entire_result {
    entry!(changing(volume, |volume| {
        let (first, size) = (slice(first, 3, "first")?, slice(size, 3, "size")?);
        let changed = std::array::from_fn(|a| first[a]..first[a].saturating_add(size[a]));
        update(volume, desc, Some(changed))
    }))
}

/// # Safety
/// As [`take_voxels`].
unsafe fn update(
    volume: &mut Volume,
    desc: *const entire_volume_desc,
    changed: Option<[Range<usize>; 3]>,
) -> Outcome {
    reserve::check()?;
    // SAFETY: the caller guarantees that `desc` is NULL or valid.
    let mut desc = unsafe { read_struct(desc)? };
    let range = volume.voxels()?.range;
    if desc.scalar_type != volume.scalar_type {
        refuse!(
            ENTIRE_INVALID_ARGUMENT,
            "a time step has the scalar type {}, but its volume has {}; make a new volume for this time step",
            desc.scalar_type,
            volume.scalar_type
        );
    }
    if desc.range.iter().all(|end| end.is_nan()) {
        desc.range = range.into();
    }
    // SAFETY: the caller guarantees that `desc.voxels` is NULL or valid for `voxel_count` elements.
    let voxels = unsafe { take_voxels(&desc)? };
    let next = *voxels.view();
    let mut series = match volume.series.take() {
        Some(series) => series,
        // The series refuses a time step of other sizes, spacing or range than the volume's.
        None => Box::new(SummarySeries::new(volume.view()?)?),
    };
    if let Err(error) = series.update(&next, changed, Executor::Serial) {
        // A series that ran out of memory has no summary; the next use makes a new summary from the volume's
        // voxels.
        volume.series = series.summary().is_ok().then_some(series);
        return Err(error.into());
    }
    volume.series = Some(series);
    volume.summary = OnceLock::new();
    volume.features = None;
    volume.voxels = Some(voxels);
    Ok(())
}
