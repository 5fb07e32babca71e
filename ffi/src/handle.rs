//! Opaque handles: the value that each type of handle (model, session, …) wraps, and the state that every
//! handle carries. The memory of a handle is reference-counted: C holds one reference, and sessions hold
//! further ones to models.

use crate::result::Failure;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// State that every handle has besides its value.
#[derive(Default)]
pub(crate) struct Status {
    unusable: AtomicBool,
}

impl Status {
    /// True if an earlier call on this handle panicked.
    #[inline]
    pub(crate) fn is_unusable(&self) -> bool {
        self.unusable.load(Ordering::Acquire)
    }

    #[cold]
    pub(crate) fn mark_unusable(&self) {
        self.unusable.store(true, Ordering::Release);
    }
}

/// Content of a handle.
pub(crate) struct Held<T> {
    pub(crate) status: Status,
    pub(crate) value: T,
}

/// A type of handle, which C holds by pointer.
pub(crate) trait Handle: Sized {
    /// Type of the value that the handle holds.
    type Value;
    /// Name of the handle's type in error messages.
    const NAME: &'static str;
    /// Makes a handle from its content.
    fn new(held: Held<Self::Value>) -> Self;
    /// The handle's content.
    fn held(&self) -> &Held<Self::Value>;
    /// The handle's content, for writing.
    fn held_mut(&mut self) -> &mut Held<Self::Value>;
}

/// Hands a new handle to C.
pub(crate) fn give<H: Handle>(value: H::Value) -> *mut H {
    Arc::into_raw(Arc::new(H::new(Held { status: Status::default(), value }))).cast_mut()
}

/// Ends the reference that [`give`] handed to C.
///
/// # Safety
/// The pointer comes from [`give`] and is released once.
pub(crate) unsafe fn release<H: Handle>(handle: *mut H) {
    // SAFETY: the caller guarantees that `give` made this pointer from an `Arc`.
    drop(unsafe { Arc::from_raw(handle.cast_const()) });
}

/// The value of a handle, for reading.
///
/// # Safety
/// `handle` is NULL or a live handle of this library that no thread is changing, for as long as the result
/// lives.
pub(crate) unsafe fn borrow<'a, H: Handle + 'a>(handle: *const H) -> Result<&'a H::Value, Failure> {
    // SAFETY: the caller guarantees that `handle` is NULL, or live and not being changed.
    let handle = unsafe { handle.as_ref() }.ok_or_else(|| Failure::null(H::NAME))?;
    let Held { status, value } = handle.held();
    if status.is_unusable() {
        return Err(Failure::unusable(H::NAME));
    }
    Ok(value)
}

/// Implements [`Handle`] for a type whose only field is a [`Held`].
macro_rules! handle {
    ($noun:ident, $value:ty) => {
        impl crate::handle::Handle for $noun {
            type Value = $value;
            const NAME: &'static str = stringify!($noun);

            fn new(held: crate::handle::Held<$value>) -> Self {
                Self(held)
            }

            fn held(&self) -> &crate::handle::Held<$value> {
                &self.0
            }

            fn held_mut(&mut self) -> &mut crate::handle::Held<$value> {
                &mut self.0
            }
        }
    };
}
pub(crate) use handle;
