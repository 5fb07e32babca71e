//! `entire_set_log`: the receiver of log messages.

use crate::guard::guard;
use crate::result::entire_result::{self, ENTIRE_INVALID_ARGUMENT};
use crate::result::refuse;
use crate::sink::{self, ENTIRE_LOG_INFO, ENTIRE_LOG_OFF, Sink, entire_log_callback, entire_log_level};
use std::ffi::c_void;

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
        if sink::in_callback() {
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
        sink::set(sink, level);
        Ok(())
    })
}
