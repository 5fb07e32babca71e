//! The error type.

use alloc::borrow::Cow;
use core::fmt;

/// Kind of an [`Error`]. The numbers are stable and are the C ABI's result codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[repr(u32)]
pub enum ErrorKind {
    /// An argument is outside the range that the call accepts (zero size, NaN, negative time, …).
    InvalidArgument = 1,
    /// A buffer is too short, a count does not match or is over its limit, or a product of sizes overflows.
    SizeMismatch = 2,
    /// The bytes are not a model file that this version reads.
    InvalidModel = 3,
    /// A tensor is missing, has a shape that does not fit the other tensors, or holds an invalid number.
    InvalidTensor = 4,
    /// The model needs an input group that the caller did not supply, that the caller supplied with a wrong
    /// size, or that this version does not know.
    MissingInput = 5,
    /// The call needs a volume, transfer function or model that has not been set.
    NotReady = 6,
    /// An observation was rejected: unknown plan, invalid time, or a second time for the same plan.
    RejectedObservation = 7,
    /// This build or this model lacks the feature that the call needs.
    Unsupported = 8,
    /// An allocation failed.
    OutOfMemory = 104,
}

/// An error; `Display` writes what is wrong and the remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Error {
    kind: ErrorKind,
    message: Cow<'static, str>,
}

/// Result with this crate's error.
pub type Result<T> = core::result::Result<T, Error>;

impl Error {
    /// Makes an error; `message` names the object, what was expected, what was found, and the remedy. A
    /// static message does not allocate.
    pub fn new(kind: ErrorKind, message: impl Into<Cow<'static, str>>) -> Self {
        Self { kind, message: message.into() }
    }

    /// The kind of error.
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

/// Returns an [`Error`] of the given kind with a formatted message. The calling crate needs `extern crate
/// alloc`.
#[macro_export]
macro_rules! bail {
    ($kind:ident, $($arg:tt)*) => {
        return Err($crate::Error::new($crate::ErrorKind::$kind, alloc::format!($($arg)*)))
    };
}
pub(crate) use bail;
