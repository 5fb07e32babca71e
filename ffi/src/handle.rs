//! Opaque handles: the value of each noun, its ownership in C, and the state that every handle carries.
//!
//! A type states once how its pointers are owned ([`Boxed`] or [`Counted`]); making, borrowing and freeing
//! all follow that statement, so freeing a handle in another way than it was made does not compile.

use crate::result::Failure;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

/// State that every handle has besides its value.
#[derive(Default)]
pub(crate) struct Status {
    unusable: AtomicBool,
    failed: AtomicBool,
    text: Mutex<String>,
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

    #[cold]
    pub(crate) fn record(&self, failure: &Failure) {
        let mut text = self.text.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        text.clone_from(&failure.message);
        self.failed.store(true, Ordering::Release);
    }

    /// Clears the last failure; takes no lock if there is none.
    #[inline]
    pub(crate) fn clear(&self) {
        if self.failed.load(Ordering::Acquire) {
            self.text.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).clear();
            self.failed.store(false, Ordering::Release);
        }
    }

    /// The text of the last failure, empty if there is none.
    pub(crate) fn text(&self) -> String {
        self.text.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).clone()
    }
}

/// A noun that C holds by pointer.
pub(crate) trait Handle: Sized {
    /// Type of the value that the handle holds.
    type Value;
    /// Ownership of the pointers that C holds.
    type Owner: Owner<Self>;
    /// Name of the handle's type in error messages.
    const NAME: &'static str;
    /// Makes a handle from its state and its value.
    fn assemble(status: Status, value: Self::Value) -> Self;
    /// The handle's error state.
    fn status(&self) -> &Status;
    /// The handle's value.
    fn value(&self) -> &Self::Value;
    /// The handle's error state, and its value for writing.
    fn parts_mut(&mut self) -> (&Status, &mut Self::Value);
}

/// Ownership of pointers to a handle.
pub(crate) trait Owner<H> {
    fn into_raw(handle: H) -> *mut H;
    /// Ends the ownership that `into_raw` gave away.
    ///
    /// # Safety
    /// The pointer comes from `into_raw` and is released once.
    unsafe fn release(handle: *mut H);
}

/// One owner, the C side; used by one thread at a time unless every use is `const`.
pub(crate) struct Boxed;

impl<H> Owner<H> for Boxed {
    fn into_raw(handle: H) -> *mut H {
        Box::into_raw(Box::new(handle))
    }

    unsafe fn release(handle: *mut H) {
        // SAFETY: the caller guarantees that `into_raw` made this pointer from a box.
        drop(unsafe { Box::from_raw(handle) });
    }
}

/// Shared and immutable: the library may hold further references.
pub(crate) struct Counted;

impl<H> Owner<H> for Counted {
    fn into_raw(handle: H) -> *mut H {
        Arc::into_raw(Arc::new(handle)).cast_mut()
    }

    unsafe fn release(handle: *mut H) {
        // SAFETY: the caller guarantees that `into_raw` made this pointer from an `Arc`.
        drop(unsafe { Arc::from_raw(handle.cast_const()) });
    }
}

/// Hands a new handle to C.
pub(crate) fn give<H: Handle>(value: H::Value) -> *mut H {
    H::Owner::into_raw(H::assemble(Status::default(), value))
}

/// The value of a further handle among a call's arguments, for reading.
///
/// # Safety
/// `handle` is NULL or a live handle of this library that no thread is changing, for as long as the result
/// lives.
pub(crate) unsafe fn borrow<'a, H: Handle + 'a>(handle: *const H) -> Result<&'a H::Value, Failure> {
    // SAFETY: the caller guarantees that `handle` is NULL, or live and not being changed.
    let handle = unsafe { handle.as_ref() }.ok_or_else(|| Failure::null(H::NAME))?;
    if handle.status().is_unusable() {
        return Err(Failure::unusable(H::NAME));
    }
    Ok(handle.value())
}

/// A further reference to a shared handle, for the library to keep.
///
/// # Safety
/// `handle` is a live handle of this library.
pub(crate) unsafe fn share<H: Handle<Owner = Counted>>(handle: *const H) -> Arc<H> {
    // SAFETY: `Counted::into_raw` made the pointer by `Arc::into_raw`, and its owner still holds it, so the
    // count is at least one. The count is raised before the new `Arc` takes its share.
    unsafe {
        Arc::increment_strong_count(handle);
        Arc::from_raw(handle)
    }
}

/// Declares the [`Handle`] of a C noun with the fields `status` and `value`.
macro_rules! handle {
    ($noun:ident, $value:ty, $owner:ident) => {
        impl crate::handle::Handle for $noun {
            type Value = $value;
            type Owner = crate::handle::$owner;
            const NAME: &'static str = stringify!($noun);

            fn assemble(status: crate::handle::Status, value: $value) -> Self {
                Self { status, value }
            }

            fn status(&self) -> &crate::handle::Status {
                &self.status
            }

            fn value(&self) -> &$value {
                &self.value
            }

            fn parts_mut(&mut self) -> (&crate::handle::Status, &mut $value) {
                (&self.status, &mut self.value)
            }
        }
    };
}
pub(crate) use handle;
