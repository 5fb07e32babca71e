//! Saved states of a session.

use super::entire_session;
use crate::abi::{check_pointer, slice, text, write};
use crate::guard::{changing, entry, reading};
use crate::limits::{ENTIRE_MAX_STATE_BYTES, at_most};
use crate::reserve;
use crate::result::entire_result::{self, *};
use crate::result::refuse;
use entire_steer::predict::Clock;
use std::ffi::c_char;

/// Names the renderer whose frames are observed and the clock that times them, such as
/// "vtkGPUVolumeRayCastMapper" and "wall". A correction learned for one renderer or clock is not valid for
/// another: it is forgotten, with all recorded frames, if a name that was not empty changes. Saved states
/// contain both names, and entire_session_load_state refuses a state whose names differ from the session's.
/// Both names are empty in a new session; a state saved with empty names loads only into a session with empty
/// names. Call this function before states are loaded or saved. A clock named "cpu", "wall" or "device" is
/// compared with the model's clock (entire_session_clocks); if the result of the comparison changes, the
/// learned correction is forgotten, too.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a name of more than 256 bytes, or that is not UTF-8),
/// ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_set_timing_source(
    session: *mut entire_session,
    renderer: *const c_char,
    clock: *const c_char,
) -> entire_result {
    entry!(changing(session, |state| {
        reserve::check()?;
        let (renderer, clock) = (text(renderer, "renderer")?, text(clock, "clock")?);
        Ok(state.session.set_timing_source(renderer, clock)?)
    }))
}

/// Clock of a time: one of the `ENTIRE_CLOCK_*` numbers.
pub type entire_clock = u32;
/// No clock was named, or none of those below.
pub const ENTIRE_CLOCK_UNSTATED: entire_clock = 0;
/// "cpu": processor time of the rendering process, over all of its threads.
pub const ENTIRE_CLOCK_CPU: entire_clock = 1;
/// "wall": wall time from the start of a frame to its end.
pub const ENTIRE_CLOCK_WALL: entire_clock = 2;
/// "device": time on the rendering device, by its own timestamps.
pub const ENTIRE_CLOCK_DEVICE: entire_clock = 3;

fn number_of(clock: Option<Clock>) -> entire_clock {
    match clock {
        None => ENTIRE_CLOCK_UNSTATED,
        Some(Clock::Cpu) => ENTIRE_CLOCK_CPU,
        Some(Clock::Wall) => ENTIRE_CLOCK_WALL,
        Some(Clock::Device) => ENTIRE_CLOCK_DEVICE,
    }
}

/// Reads the clock of the model's predictions (`model`: entire.clock in its file) and the clock that times
/// the session's frames (`own`: from entire_session_set_timing_source). If both are given and differ, the
/// session uses the model only for ratios between scenes and learns the factor between the clocks from the
/// first frames; the first frame is drawn coarsely.
///
/// Fails with ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_clocks(
    session: *const entire_session,
    model: *mut entire_clock,
    own: *mut entire_clock,
) -> entire_result {
    entry!(reading(session, |state| {
        check_pointer(own, "own (output)")?;
        let [frames, predicted] = state.session.clocks();
        write(model, number_of(predicted), "model (output)")?;
        write(own, number_of(frames), "own (output)")
    }))
}

/// Saves the learned correction, for entire_session_load_state in a later run: `byte_count` receives its
/// size, and `buffer` the bytes if `capacity` suffices. `buffer` may be NULL with capacity 0 to query the
/// size.
///
/// Fails with ENTIRE_SIZE_MISMATCH (a capacity that is too small and not 0; the size is in the error text),
/// ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_save_state(
    session: *const entire_session,
    buffer: *mut u8,
    capacity: usize,
    byte_count: *mut usize,
) -> entire_result {
    entry!(reading(session, |state| {
        check_pointer(byte_count, "byte_count (output)")?;
        let bytes = state.session.save_state();
        let size = bytes.len();
        if capacity > 0 {
            check_pointer(buffer, "buffer")?;
            if capacity < size {
                refuse!(ENTIRE_SIZE_MISMATCH, "buffer holds {capacity} bytes; the state has {size}");
            }
            std::ptr::copy_nonoverlapping(bytes.as_ptr(), buffer, size);
        }
        write(byte_count, bytes.len(), "byte_count (output)")
    }))
}

/// Loads the state that an earlier session saved. Pending plans are forgotten. A failed call changes nothing.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (bytes that are cut short, damaged or not a state), ENTIRE_UNSUPPORTED
/// (a valid state whose model, renderer or clock is not the session's, see entire_session_set_timing_source),
/// ENTIRE_SIZE_MISMATCH (over ENTIRE_MAX_STATE_BYTES), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_load_state(
    session: *mut entire_session,
    bytes: *const u8,
    byte_count: usize,
) -> entire_result {
    entry!(changing(session, |state| {
        at_most("byte_count", byte_count, ENTIRE_MAX_STATE_BYTES, "ENTIRE_MAX_STATE_BYTES")?;
        Ok(state.session.load_state(slice(bytes, byte_count, "bytes")?)?)
    }))
}
