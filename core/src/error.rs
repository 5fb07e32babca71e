//! The one error type: what went wrong, where, and what to change.

use alloc::borrow::Cow;
use core::fmt;

/// What kind of mistake an [`Error`] reports. The numbers are stable and are the C ABI's result codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[repr(u32)]
pub enum ErrorKind {
    /// A value handed in is outside what the call accepts (zero size, NaN, negative time, …).
    InvalidArgument = 1,
    /// A buffer is too short, or a product of sizes overflows.
    SizeMismatch = 2,
    /// The bytes are not a model file that this version reads.
    InvalidModel = 3,
    /// A tensor is missing or has another shape than its neighbors require.
    InvalidTensor = 4,
    /// The model needs an input group that the caller did not supply, or the reverse.
    MissingInput = 5,
    /// The call needs something that was not set before it (volume, transfer function, model).
    NotReady = 6,
    /// An observation was rejected (unknown plan, a time that is not positive, duplicate).
    RejectedObservation = 7,
    /// A feature that this build or this model does not have.
    Unsupported = 8,
    /// There is no memory for what was asked for.
    OutOfMemory = 104,
}

/// An error that says what was wrong and what to do about it: `Display` writes the text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Error {
    kind: ErrorKind,
    message: Cow<'static, str>,
}

/// Shorthand used throughout the crate.
pub type Result<T> = core::result::Result<T, Error>;

impl Error {
    /// Makes an error; `message` names the thing, what was expected, what was found, and the remedy.
    /// A text that stands in the program allocates nothing.
    pub fn new(kind: ErrorKind, message: impl Into<Cow<'static, str>>) -> Self {
        Self { kind, message: message.into() }
    }

    /// The kind, for code that decides.
    pub fn kind(&self) -> ErrorKind {
        self.kind
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl core::error::Error for Error {}

/// Returns an [`Error`] of a kind with a formatted message. The calling crate needs `extern crate alloc`.
#[macro_export]
macro_rules! bail {
    ($kind:ident, $($arg:tt)*) => {
        return Err($crate::Error::new($crate::ErrorKind::$kind, alloc::format!($($arg)*)))
    };
}
pub(crate) use bail;
