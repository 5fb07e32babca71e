//! The largest sizes that a caller may declare. A declared count over its limit is refused before anything is
//! allocated or read.

use crate::result::entire_result::*;
use crate::result::{Failure, refuse};

/// Maximum number of voxels along one axis of a volume.
pub const ENTIRE_MAX_SIDE: usize = 1_048_576;
/// Maximum number of voxels of a volume whose strides are zero or overlap, so that there are fewer elements
/// in memory than voxels.
pub const ENTIRE_MAX_REPEATED_VOXELS: usize = 134_217_728;
/// Maximum number of bricks of a volume.
pub const ENTIRE_MAX_BRICKS: usize = 134_217_728;
/// Maximum number of precomputed features of a volume.
pub const ENTIRE_MAX_FEATURES: usize = 1_048_576;
/// Maximum number of Gaussian lobes, opacity nodes, color nodes or table entries of a transfer function.
pub const ENTIRE_MAX_TRANSFER_POINTS: usize = 1_048_576;
/// Maximum number of bytes of a model file.
pub const ENTIRE_MAX_MODEL_BYTES: usize = 2_147_483_647;
/// Maximum number of bytes of a saved state.
pub const ENTIRE_MAX_STATE_BYTES: usize = 16_777_216;

// The limits of the core and of this interface agree.
const _: () = {
    assert!(ENTIRE_MAX_SIDE == entire_core::scene::MAX_VOLUME_EDGE);
    assert!(ENTIRE_MAX_REPEATED_VOXELS as u64 == entire_core::scene::MAX_REPEATED_VOXELS);
};

/// Refuses a count over its limit.
pub(crate) fn at_most(what: &str, found: usize, limit: usize, name: &str) -> Result<(), Failure> {
    if found <= limit {
        return Ok(());
    }
    Err(Failure::new(
        ENTIRE_SIZE_MISMATCH,
        format!("{what} is {found}; at most {limit} ({name}) is accepted: check the count"),
    ))
}

/// Refuses a volume that has a side over [`ENTIRE_MAX_SIDE`], or more voxels than both `voxel_count` and
/// [`ENTIRE_MAX_REPEATED_VOXELS`]. Without a `voxel_count`, only the sides are checked.
pub(crate) fn check_dims(dims: [usize; 3], voxel_count: Option<usize>) -> Result<(), Failure> {
    for (axis, &n) in ["x", "y", "z"].iter().zip(&dims) {
        if n > ENTIRE_MAX_SIDE {
            refuse!(
                ENTIRE_SIZE_MISMATCH,
                "the volume has {n} voxels along {axis}; at most {ENTIRE_MAX_SIDE} (ENTIRE_MAX_SIDE) are \
                 accepted: check the volume's sizes"
            );
        }
    }
    let Some(there) = voxel_count else { return Ok(()) };
    // The product of three sides of at most 2^20 fits in `u128`.
    let voxels = dims.iter().map(|&n| n as u128).product::<u128>();
    if voxels > (there as u128).max(ENTIRE_MAX_REPEATED_VOXELS as u128) {
        let [x, y, z] = dims;
        refuse!(
            ENTIRE_SIZE_MISMATCH,
            "a volume of {x} x {y} x {z} voxels needs {voxels} elements, but voxel_count is {there}; check \
             sizes, strides and voxel_count. If strides repeat voxels, the volume may have at most \
             {ENTIRE_MAX_REPEATED_VOXELS} voxels (ENTIRE_MAX_REPEATED_VOXELS)"
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_bounded_by_what_is_there() {
        let code = |dims, count| check_dims(dims, count).err().map(|f| f.code);
        assert_eq!(code([512, 512, 512], Some(1)), None);
        assert_eq!(code([512, 512, 513], Some(1)), Some(ENTIRE_SIZE_MISMATCH));
        assert_eq!(code([512, 512, 513], Some(512 * 512 * 513)), None);
        assert_eq!(code([200_000; 3], Some(1)), Some(ENTIRE_SIZE_MISMATCH));
        assert_eq!(code([200_000; 3], None), None);
        assert_eq!(code([65_536, 65_536, 2], Some(usize::MAX)), None);
        assert_eq!(code([ENTIRE_MAX_SIDE; 3], Some(1)), Some(ENTIRE_SIZE_MISMATCH));
        assert_eq!(code([ENTIRE_MAX_SIDE + 1, 1, 1], Some(usize::MAX)), Some(ENTIRE_SIZE_MISMATCH));
        assert_eq!(code([1, 1, usize::MAX], None), Some(ENTIRE_SIZE_MISMATCH));
    }

    #[test]
    fn refusals_name_the_limit() {
        assert!(at_most("brick_count", 7, 7, "ENTIRE_MAX_BRICKS").is_ok());
        let failure = at_most("brick_count", 8, 7, "ENTIRE_MAX_BRICKS").unwrap_err();
        assert_eq!(failure.code, ENTIRE_SIZE_MISMATCH);
        assert!(
            failure.message.contains("brick_count is 8") && failure.message.contains("7 (ENTIRE_MAX_BRICKS)")
        );
    }
}
