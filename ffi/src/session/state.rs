//! What a session learned, saved and taken up again.

use super::entire_session;
use crate::abi::{check_pointer, slice, write};
use crate::guard::{changing, reading};
use crate::limits::{ENTIRE_MAX_STATE_BYTES, at_most};
use crate::result::Failure;
use crate::result::entire_result::{self, *};

/// Saves what was learned, for entire_session_load_state in a later run: `byte_count` receives how many bytes
/// it is, and `buffer` the bytes where `capacity` suffices. `buffer` may be NULL with capacity 0 to ask for
/// the size.
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
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe {
        reading(session, |state| {
            check_pointer(byte_count, "byte_count (output)")?;
            let bytes = state.session.save_state();
            if capacity > 0 {
                check_pointer(buffer, "buffer")?;
                if capacity < bytes.len() {
                    return Err(Failure::new(
                        ENTIRE_SIZE_MISMATCH,
                        format!("buffer holds {capacity} bytes; the state has {}", bytes.len()),
                    ));
                }
                std::ptr::copy_nonoverlapping(bytes.as_ptr(), buffer, bytes.len());
            }
            write(byte_count, bytes.len(), "byte_count (output)")
        })
    }
}

/// Takes up what an earlier session saved. Pending plans are forgotten.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (bytes that are cut short, damaged or not a state),
/// ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_load_state(
    session: *mut entire_session,
    bytes: *const u8,
    byte_count: usize,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe {
        changing(session, |state| {
            at_most("byte_count", byte_count, ENTIRE_MAX_STATE_BYTES, "ENTIRE_MAX_STATE_BYTES")?;
            Ok(state.session.load_state(slice(bytes, byte_count, "bytes")?)?)
        })
    }
}
