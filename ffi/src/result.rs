//! Result codes, and failures that map to them.

use entire_core::{Error, ErrorKind};
use entire_steer::predict::{PREDICTED_SECONDS, check_predictions};
use std::ffi::{CStr, c_char};
use std::fmt::Display;

/// Result of a call. The numbers never change; the number of a removed code stays reserved.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum entire_result {
    /// Done; all outputs are written.
    ENTIRE_OK = 0,
    /// A value is outside what the call accepts (zero size, NaN, negative time, ...).
    ENTIRE_INVALID_ARGUMENT = 1,
    /// A buffer is too short, a count does not match or is over its limit, or a product of sizes overflows.
    ENTIRE_SIZE_MISMATCH = 2,
    /// The bytes are not a model file that this version reads, or the model's result is not a frame time.
    ENTIRE_INVALID_MODEL = 3,
    /// A tensor of the model is missing, has a shape that does not fit those of the model's other tensors, or
    /// holds invalid numbers.
    ENTIRE_INVALID_TENSOR = 4,
    /// The model needs an input group that the caller did not supply, that the caller supplied with a wrong
    /// size, or that this version does not know.
    ENTIRE_MISSING_INPUT = 5,
    /// The call needs something that was not set before it (volume, transfer function, model).
    ENTIRE_NOT_READY = 6,
    /// An observation was refused (unknown plan, non-positive time, duplicate); it changed nothing.
    ENTIRE_REJECTED_OBSERVATION = 7,
    /// A feature that this build or this model does not have.
    ENTIRE_UNSUPPORTED = 8,
    /// A pointer is NULL that must not be.
    ENTIRE_NULL_ARGUMENT = 100,
    /// `struct_size` is not set, too small, or the caller's newer struct sets fields that this library does
    /// not know.
    ENTIRE_STRUCT_SIZE = 101,
    /// A file cannot be read or written.
    ENTIRE_IO = 102,
    /// A bug in the library. Every further call on the handle fails with this code, except
    /// entire_<noun>_free.
    ENTIRE_PANIC = 103,
    /// There is not enough memory for the call.
    ENTIRE_OUT_OF_MEMORY = 104,
}

use entire_result::*;

const NAMES: [(entire_result, &CStr); 14] = [
    (ENTIRE_OK, c"ENTIRE_OK"),
    (ENTIRE_INVALID_ARGUMENT, c"ENTIRE_INVALID_ARGUMENT"),
    (ENTIRE_SIZE_MISMATCH, c"ENTIRE_SIZE_MISMATCH"),
    (ENTIRE_INVALID_MODEL, c"ENTIRE_INVALID_MODEL"),
    (ENTIRE_INVALID_TENSOR, c"ENTIRE_INVALID_TENSOR"),
    (ENTIRE_MISSING_INPUT, c"ENTIRE_MISSING_INPUT"),
    (ENTIRE_NOT_READY, c"ENTIRE_NOT_READY"),
    (ENTIRE_REJECTED_OBSERVATION, c"ENTIRE_REJECTED_OBSERVATION"),
    (ENTIRE_UNSUPPORTED, c"ENTIRE_UNSUPPORTED"),
    (ENTIRE_NULL_ARGUMENT, c"ENTIRE_NULL_ARGUMENT"),
    (ENTIRE_STRUCT_SIZE, c"ENTIRE_STRUCT_SIZE"),
    (ENTIRE_IO, c"ENTIRE_IO"),
    (ENTIRE_PANIC, c"ENTIRE_PANIC"),
    (ENTIRE_OUT_OF_MEMORY, c"ENTIRE_OUT_OF_MEMORY"),
];

/// The name of a result code, such as "ENTIRE_INVALID_MODEL"; "unknown result" for other numbers. The text is
/// static. Never NULL.
#[unsafe(no_mangle)]
pub extern "C" fn entire_result_name(result: u32) -> *const c_char {
    let known = NAMES.into_iter().find(|(code, _)| *code as u32 == result);
    known.map_or(c"unknown result", |(_, name)| name).as_ptr()
}

/// Cause of a failure: its code and its text.
#[derive(Debug)]
pub(crate) struct Failure {
    pub(crate) code: entire_result,
    pub(crate) message: String,
    /// True if the call itself panicked, so that its handle becomes unusable. False if the call got a handle
    /// that was unusable before.
    pub(crate) panicked: bool,
}

impl Failure {
    pub(crate) fn new(code: entire_result, message: impl Into<String>) -> Self {
        Self { code, message: message.into(), panicked: false }
    }

    /// Returns the failure with `place` (a field or an element of a list) and a colon before its message.
    pub(crate) fn within(self, place: impl Display) -> Self {
        Self { message: format!("{place}: {}", self.message), ..self }
    }

    pub(crate) fn null(what: &str) -> Self {
        Self::new(ENTIRE_NULL_ARGUMENT, format!("{what} is NULL; pass a valid pointer"))
    }

    #[cold]
    pub(crate) fn unusable(what: &str) -> Self {
        Self::new(
            ENTIRE_PANIC,
            format!("an earlier call panicked inside this {what}; free it and make a new one"),
        )
    }
}

/// Returns a [`Failure`] with a formatted text.
macro_rules! refuse {
    ($code:expr, $($text:tt)*) => {
        return Err(crate::result::Failure::new($code, format!($($text)*)))
    };
}
pub(crate) use refuse;

/// True if a number can be the seconds of a frame.
#[inline]
pub(crate) fn is_frame_time(seconds: f32) -> bool {
    seconds > 0.0 && seconds < *PREDICTED_SECONDS.end()
}

/// Converts a network's result to the seconds of a frame. Results under 1e-6, which networks give for cheap
/// frames, become 1e-6, the shortest prediction.
#[inline]
pub(crate) fn frame_time(answer: f32) -> Result<f32, Failure> {
    let mut seconds = answer;
    match check_predictions(std::slice::from_mut(&mut seconds)) {
        Ok(_) if is_frame_time(seconds) => Ok(seconds),
        _ => Err(no_prediction(answer)),
    }
}

/// The failure of a model whose answer is not a frame time.
#[cold]
pub(crate) fn no_prediction(seconds: f32) -> Failure {
    Failure::new(
        ENTIRE_INVALID_MODEL,
        format!(
            "the model predicts {seconds} s for this frame; a frame time is over 0 and under \
             {} s. The inputs are far from what the model was trained on, or its weights are \
             damaged: use another model",
            PREDICTED_SECONDS.end()
        ),
    )
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let number = error.kind() as u32;
        let known = NAMES.into_iter().find(|(code, _)| *code as u32 == number);
        Self::new(known.map_or(ENTIRE_UNSUPPORTED, |(code, _)| code), error.to_string())
    }
}

// Each error kind of the core has the same number in the core and in this interface. tests/suite/kinds.rs
// checks that none is missing.
const _: () = {
    assert!(ENTIRE_INVALID_ARGUMENT as u32 == ErrorKind::InvalidArgument as u32);
    assert!(ENTIRE_SIZE_MISMATCH as u32 == ErrorKind::SizeMismatch as u32);
    assert!(ENTIRE_INVALID_MODEL as u32 == ErrorKind::InvalidModel as u32);
    assert!(ENTIRE_INVALID_TENSOR as u32 == ErrorKind::InvalidTensor as u32);
    assert!(ENTIRE_MISSING_INPUT as u32 == ErrorKind::MissingInput as u32);
    assert!(ENTIRE_NOT_READY as u32 == ErrorKind::NotReady as u32);
    assert!(ENTIRE_REJECTED_OBSERVATION as u32 == ErrorKind::RejectedObservation as u32);
    assert!(ENTIRE_UNSUPPORTED as u32 == ErrorKind::Unsupported as u32);
    assert!(ENTIRE_OUT_OF_MEMORY as u32 == ErrorKind::OutOfMemory as u32);
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_has_its_own_name() {
        let mut names = std::collections::BTreeSet::new();
        let of_the_enum = |line: &&str| line.starts_with("    ENTIRE_") && line.contains(" = ");
        assert_eq!(include_str!("result.rs").lines().filter(of_the_enum).count(), NAMES.len());
        for (code, _) in NAMES {
            // SAFETY: entire_result_name returns a static C string.
            let name = unsafe { CStr::from_ptr(entire_result_name(code as u32)) };
            assert_eq!(name.to_str().unwrap(), format!("{code:?}"));
            assert!(names.insert(name));
        }
        // SAFETY: entire_result_name returns a static C string.
        assert_eq!(unsafe { CStr::from_ptr(entire_result_name(99)) }, c"unknown result");
    }

    #[test]
    fn core_errors_keep_their_number_and_text() {
        for kind in [
            ErrorKind::InvalidArgument,
            ErrorKind::SizeMismatch,
            ErrorKind::InvalidModel,
            ErrorKind::InvalidTensor,
            ErrorKind::MissingInput,
            ErrorKind::NotReady,
            ErrorKind::RejectedObservation,
            ErrorKind::Unsupported,
            ErrorKind::OutOfMemory,
        ] {
            let failure = Failure::from(Error::new(kind, "text"));
            assert_eq!((failure.code as u32, failure.message.as_str()), (kind as u32, "text"));
        }
    }

    #[test]
    fn only_positive_finite_seconds_are_frame_times() {
        for seconds in [f32::MIN_POSITIVE, 1e-6, 0.016, 1e4] {
            assert!(is_frame_time(seconds));
        }
        for seconds in [0.0, -0.0, -1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e9, f32::MAX] {
            assert!(!is_frame_time(seconds));
            let cheap = seconds <= 0.0 && seconds.is_finite();
            assert_eq!(frame_time(seconds).is_ok_and(is_frame_time), cheap, "{seconds}");
            assert_eq!(no_prediction(seconds).code, ENTIRE_INVALID_MODEL);
        }
    }
}
