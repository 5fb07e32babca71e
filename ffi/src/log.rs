//! Log messages and their receiver: the library's only global state that callers can set.

use crate::guard::guard;
use crate::result::entire_result::{self, ENTIRE_INVALID_ARGUMENT};
use crate::result::refuse;
use std::cell::Cell;
use std::ffi::{CString, c_char, c_void};
use std::sync::RwLock;
use std::sync::atomic::{AtomicU32, Ordering};

/// Severity of a log message: one of the `ENTIRE_LOG_*` numbers.
pub type entire_log_level = u32;
/// Nothing is logged.
pub const ENTIRE_LOG_OFF: entire_log_level = 0;
/// A call failed; the text is that of its error.
pub const ENTIRE_LOG_ERROR: entire_log_level = 1;
/// A call succeeded, but its results may be inaccurate.
pub const ENTIRE_LOG_WARNING: entire_log_level = 2;
/// Rare events: a model was loaded, a volume was read.
pub const ENTIRE_LOG_INFO: entire_log_level = 3;

/// Receives log messages. `message` is UTF-8 and valid only during the call. Runs on the thread whose call
/// logs, so it may run on several threads at the same time. Must return normally (no exception, no longjmp)
/// and must not call this library.
pub type entire_log_callback =
    Option<unsafe extern "C" fn(user_data: *mut c_void, level: entire_log_level, message: *const c_char)>;

/// A callback and its argument.
struct Sink {
    callback: unsafe extern "C" fn(*mut c_void, entire_log_level, *const c_char),
    user_data: *mut c_void,
}

// SAFETY: the library only passes the pointer to the callback, which several threads may call by its
// contract.
unsafe impl Send for Sink {}
// SAFETY: the library only passes the pointer to the callback, which several threads may call by its
// contract.
unsafe impl Sync for Sink {}

static SINK: RwLock<Option<Sink>> = RwLock::new(None);
/// The highest level that the callback receives; read first, so that calls take no lock if nothing is logged.
static LEVEL: AtomicU32 = AtomicU32::new(ENTIRE_LOG_OFF);

thread_local! {
    static IN_CALLBACK: Cell<bool> = const { Cell::new(false) };
}

/// True if a message of this level would reach anyone.
#[inline]
pub(crate) fn enabled(level: entire_log_level) -> bool {
    level <= LEVEL.load(Ordering::Relaxed)
}

/// Passes `message` to the callback, if one is set, takes this level, and is not running on this thread.
pub(crate) fn emit(level: entire_log_level, message: &str) {
    if !enabled(level) || IN_CALLBACK.get() {
        return;
    }
    let held = SINK.read().unwrap_or_else(|poisoned| poisoned.into_inner());
    if let Some(sink) = held.as_ref() {
        let text = c_text(message);
        IN_CALLBACK.set(true);
        // SAFETY: the callback and its user data were set together, and the lock keeps them from being
        // replaced. The text is a C string that outlives the call.
        unsafe { (sink.callback)(sink.user_data, level, text.as_ptr()) };
        IN_CALLBACK.set(false);
    }
}

/// A C string of `text`; a NUL inside becomes the replacement character.
pub(crate) fn c_text(text: &str) -> CString {
    CString::new(text).unwrap_or_else(|_| CString::new(text.replace('\0', "\u{fffd}")).unwrap_or_default())
}

/// Sets or, with NULL or `ENTIRE_LOG_OFF`, removes the callback that receives log messages up to `level`.
/// When the call returns, the earlier callback is no longer running and its `user_data` may be freed. Must
/// not be called from within a callback.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (an unknown level, or a call from within a callback).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_set_log(
    callback: entire_log_callback,
    user_data: *mut c_void,
    level: entire_log_level,
) -> entire_result {
    guard(|| {
        if IN_CALLBACK.get() {
            refuse!(
                ENTIRE_INVALID_ARGUMENT,
                "entire_set_log was called from within a log callback; call it from outside"
            );
        }
        if level > ENTIRE_LOG_INFO {
            refuse!(
                ENTIRE_INVALID_ARGUMENT,
                "log level is {level}; it must be one of ENTIRE_LOG_OFF (0) to ENTIRE_LOG_INFO (3)"
            );
        }
        let sink = match callback {
            Some(callback) if level != ENTIRE_LOG_OFF => Some(Sink { callback, user_data }),
            _ => None,
        };
        let mut held = SINK.write().unwrap_or_else(|poisoned| poisoned.into_inner());
        LEVEL.store(if sink.is_some() { level } else { ENTIRE_LOG_OFF }, Ordering::Relaxed);
        *held = sink;
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_with_a_nul_stays_readable() {
        assert_eq!(c_text("a\0b").to_str().unwrap(), "a\u{fffd}b");
    }
}
