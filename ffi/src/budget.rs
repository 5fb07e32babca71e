//! `entire_budget`: the time of a window's frame, divided among the passes that draw volumes in it.

use crate::abi::{slice, slice_mut, write};
use crate::guard::{entry, guard};
use crate::result::Failure;
use crate::result::entire_result::{self, *};
use entire_steer::control::{FrameBudget, PassShare};

/// Divides the time of a window's frame among the passes that draw volumes in it. Set all words to zero
/// before the first call; only the library reads and changes them.
///
/// Call for each frame, in this order: entire_budget_begin; entire_budget_share before and entire_budget_drew
/// after each pass that draws a volume; entire_budget_end. A frame has several passes if it has several
/// volumes, eyes or renderers. One thread at a time.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_budget {
    /// The state.
    pub words: [u32; 14],
}

/// State of one volume in a window's frames, which may draw it several times. Set all words to zero before
/// the first call; only the library reads and changes them.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_pass {
    /// The state.
    pub words: [u32; 4],
}

const _: () = {
    assert!(size_of::<FrameBudget>() == size_of::<entire_budget>());
    assert!(size_of::<PassShare>() == size_of::<entire_pass>());
};

/// Returns the caller's struct `C` as the type `T` of `entire-steer`, which has the same 32-bit words.
///
/// # Safety
/// `at` is NULL or valid for reads and writes of a `C`.
unsafe fn value<'a, C, T: bytemuck::Pod>(at: *mut C, what: &str) -> Result<&'a mut T, Failure> {
    // SAFETY: the caller guarantees that `at` is NULL or valid for a `C`, and a `C` has as many words as a
    // `T`.
    let words = unsafe { slice_mut(at.cast::<u32>(), size_of::<T>() / 4, what)? };
    Ok(bytemuck::from_bytes_mut(bytemuck::cast_slice_mut(words)))
}

/// Returns a copy of the caller's struct `C` as the type `T` of `entire-steer`.
///
/// # Safety
/// `at` is NULL or valid for reads of a `C`.
unsafe fn read<C, T: bytemuck::Pod>(at: *const C, what: &str) -> Result<T, Failure> {
    // SAFETY: the caller guarantees that `at` is NULL or valid for reads of a `C`, and a `C` has as many
    // words as a `T`.
    let words = unsafe { slice(at.cast::<u32>(), size_of::<T>() / 4, what)? };
    Ok(bytemuck::pod_read_unaligned(bytemuck::cast_slice(words)))
}

fn check_seconds(seconds: f32, what: &str) -> Result<(), Failure> {
    if seconds.is_finite() && seconds >= 0.0 {
        return Ok(());
    }
    Err(Failure::new(
        ENTIRE_INVALID_ARGUMENT,
        format!("{what} is {seconds} seconds; it must be finite and not negative"),
    ))
}

/// Begins a frame of the window, which will draw about `volumes` volumes. Pass 0 if the number is not known.
///
/// Fails with ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_budget_begin(budget: *mut entire_budget, volumes: u32) -> entire_result {
    entry!(guard(|| {
        value::<_, FrameBudget>(budget, "budget")?.begin(volumes);
        Ok(())
    }))
}

/// Computes the seconds that the next pass may take if the whole frame may take `target` seconds; pass the
/// result to entire_session_plan as its target. The shares of a frame's passes are in proportion to their
/// times at full quality, so that all passes are coarsened by the same factor. Their sum is `target` minus
/// the median time outside of the passes over the last five frames, but at least a fifth of `target`.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a target that is not finite, or negative), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_budget_share(
    budget: *const entire_budget,
    pass: *const entire_pass,
    target: f32,
    seconds: *mut f32,
) -> entire_result {
    entry!(guard(|| {
        let budget: FrameBudget = read(budget, "budget")?;
        let pass: PassShare = read(pass, "pass")?;
        check_seconds(target, "target")?;
        write(seconds, budget.share(&pass, target), "seconds (output)")
    }))
}

/// Adds a pass that took `seconds`. `full_seconds` is its estimated time at full quality: `seconds` *
/// entire_plan.step / (finest step) * entire_plan.image_sample_distance^2.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a time that is not finite, or negative), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_budget_drew(
    budget: *mut entire_budget,
    pass: *mut entire_pass,
    seconds: f32,
    full_seconds: f32,
) -> entire_result {
    // `budget` and `pass` point to different objects.
    entry!(guard(|| {
        let budget = value::<_, FrameBudget>(budget, "budget")?;
        let pass = value::<_, PassShare>(pass, "pass")?;
        check_seconds(seconds, "seconds")?;
        check_seconds(full_seconds, "full_seconds")?;
        budget.drew(pass, seconds, full_seconds);
        Ok(())
    }))
}

/// Ends the window's frame, which took `seconds` in all. Pass 0 for `usual` if the frame included unusual
/// work, such as reading a volume or compiling a shader. The time that an unusual frame spends outside of its
/// passes counts only if the previous frame was unusual, too.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a time that is not finite, or negative), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_budget_end(
    budget: *mut entire_budget,
    seconds: f32,
    usual: u32,
) -> entire_result {
    entry!(guard(|| {
        let budget = value::<_, FrameBudget>(budget, "budget")?;
        check_seconds(seconds, "seconds")?;
        budget.end(seconds, usual != 0);
        Ok(())
    }))
}
