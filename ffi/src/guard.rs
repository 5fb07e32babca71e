//! Wrapper in which every entry point runs its body. Handles are checked, panics become [`ENTIRE_PANIC`] and
//! mark their handle unusable, and the text of a failure is kept for this thread.

use crate::abi::{check_pointer, write};
use crate::handle::{Handle, Held, Status, borrow, give, release};
use crate::reserve;
use crate::result::Failure;
use crate::result::entire_result::{self, *};
use std::any::Any;
use std::cell::{Cell, RefCell};
use std::ffi::c_char;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Once;

/// Result of the body of an entry point.
pub(crate) type Outcome = Result<(), Failure>;

/// Longest text of a thread's last failure, in bytes, its closing NUL included.
const TEXT_BYTES: usize = 2048;

thread_local! {
    /// True if the last call of this thread failed; its text is in `TEXT`.
    static FAILED: Cell<bool> = const { Cell::new(false) };
    /// Text of this thread's last failure. An array needs no destructor. To register the destructor of a
    /// thread-local value, the C library allocates memory; without memory, it ends the process.
    static TEXT: RefCell<[u8; TEXT_BYTES]> = const { RefCell::new([0; TEXT_BYTES]) };
    /// Number of open guards on this thread, for the panic hook.
    static DEPTH: Cell<u32> = const { Cell::new(0) };
    /// Place and message of this thread's panic inside a guard.
    static PANIC: RefCell<String> = const { RefCell::new(String::new()) };
}

/// The error text of the calling thread's last call: what was wrong and what to do; empty if that call
/// succeeded. Never NULL; valid until the thread's next call of any function but this one. A text of more
/// than 2047 bytes is cut.
#[unsafe(no_mangle)]
pub extern "C" fn entire_last_error() -> *const c_char {
    if FAILED.try_with(Cell::get).unwrap_or(false) {
        TEXT.try_with(|text| text.borrow().as_ptr().cast()).unwrap_or(c"".as_ptr())
    } else {
        c"".as_ptr()
    }
}

/// Runs the body of an entry point: an expression that requires only the pointer rules in lib.rs.
macro_rules! entry {
    ($call:expr) => {
        // SAFETY: by the pointer rules in lib.rs, which the callers of all entry points guarantee.
        unsafe { $call }
    };
}
pub(crate) use entry;

/// Runs a body that works on no handle.
pub(crate) fn guard(body: impl FnOnce() -> Outcome) -> entire_result {
    ended(contained(body), None)
}

/// Runs a body that reads a handle. Several threads may do so with the same handle.
///
/// # Safety
/// `handle` is NULL or a live handle of this library that no thread is changing.
pub(crate) unsafe fn reading<H: Handle>(
    handle: *const H,
    body: impl FnOnce(&H::Value) -> Outcome,
) -> entire_result {
    // SAFETY: the caller guarantees that `handle` is NULL, or live and not being changed.
    let result = contained(|| body(unsafe { borrow(handle)? }));
    // SAFETY: the caller guarantees that `handle` is NULL or live.
    ended(result, unsafe { handle.as_ref() }.map(|handle| &handle.held().status))
}

/// Runs a body that changes a handle.
///
/// # Safety
/// `handle` is NULL or a live handle of this library that no other thread is using.
pub(crate) unsafe fn changing<H: Handle>(
    handle: *mut H,
    body: impl FnOnce(&mut H::Value) -> Outcome,
) -> entire_result {
    let result = contained(|| {
        // SAFETY: the caller guarantees that `handle` is NULL, or live and used by this thread alone.
        let handle = unsafe { handle.as_mut() }.ok_or_else(|| Failure::null(H::NAME))?;
        let Held { status, value } = handle.held_mut();
        if status.is_unusable() {
            return Err(Failure::unusable(H::NAME));
        }
        body(value)
    });
    // SAFETY: the caller guarantees that `handle` is NULL or live; the body's exclusive borrow has ended.
    ended(result, unsafe { handle.as_ref() }.map(|handle| &handle.held().status))
}

/// Makes a value, and hands a new handle of it to C. `name` is the name of `out` in messages.
///
/// # Safety
/// `out` is NULL or valid for one write.
pub(crate) unsafe fn making<H: Handle>(
    out: *mut *mut H,
    name: &str,
    make: impl FnOnce() -> Result<H::Value, Failure>,
) -> entire_result {
    guard(|| {
        check_pointer(out, name)?;
        reserve::check()?;
        let value = make()?;
        // SAFETY: the caller guarantees that `out` is NULL or valid for one write.
        unsafe { write(out, give(value), name) }
    })
}

/// Frees a handle; NULL does nothing.
///
/// # Safety
/// `handle` is NULL or a live handle of this library that is no longer in use.
pub(crate) unsafe fn freeing<H: Handle>(handle: *mut H) {
    guard(|| {
        if !handle.is_null() {
            // SAFETY: the caller guarantees that the handle is live and that nothing else uses it.
            unsafe { release(handle) };
        }
        Ok(())
    });
}

fn contained(body: impl FnOnce() -> Outcome) -> Outcome {
    keep_panics_quiet();
    let _ = DEPTH.try_with(|depth| depth.set(depth.get() + 1));
    let result = catch_unwind(AssertUnwindSafe(body));
    let _ = DEPTH.try_with(|depth| depth.set(depth.get() - 1));
    result.unwrap_or_else(|payload| Err(panicked(payload)))
}

/// Result code of a call. The text of a failure is stored for this thread; a panic makes the call's handle
/// unusable.
#[inline]
fn ended(result: Outcome, status: Option<&Status>) -> entire_result {
    match result {
        Ok(()) => {
            let _ = FAILED.try_with(|failed| failed.set(false));
            ENTIRE_OK
        }
        Err(failure) => failed(failure, status),
    }
}

#[cold]
fn failed(failure: Failure, status: Option<&Status>) -> entire_result {
    let code = failure.code;
    if failure.panicked {
        if let Some(status) = status {
            status.mark_unusable();
        }
    }
    // A panic while the text is copied must not reach C either.
    let _ = catch_unwind(AssertUnwindSafe(|| {
        let _ = TEXT.try_with(|slot| keep(&failure.message, &mut slot.borrow_mut()));
        let _ = FAILED.try_with(|failed| failed.set(true));
    }));
    code
}

/// Writes a text and a closing NUL. A text that is too long is cut at a character boundary; a NUL inside the
/// text becomes the replacement character.
fn keep(text: &str, out: &mut [u8; TEXT_BYTES]) {
    let mut end = 0;
    for character in text.chars() {
        let character = if character == '\0' { char::REPLACEMENT_CHARACTER } else { character };
        let next = end + character.len_utf8();
        if next >= TEXT_BYTES {
            break;
        }
        character.encode_utf8(&mut out[end..next]);
        end = next;
    }
    out[end] = 0;
}

#[cold]
fn panicked(payload: Box<dyn Any + Send>) -> Failure {
    // If dropping the payload panics, the payload of that second panic is leaked. This happens only after a
    // bug.
    if let Err(second) = catch_unwind(AssertUnwindSafe(|| drop(payload))) {
        std::mem::forget(second);
    }
    let place = PANIC.try_with(|text| text.take()).unwrap_or_default();
    Failure {
        code: ENTIRE_PANIC,
        message: format!(
            "a bug in the library: {place}; please report it, free the handle and make a new one"
        ),
        panicked: true,
    }
}

/// Installs, once, a panic hook that stores the text of panics inside a guard instead of printing it; all
/// other panics go to the previous hook. The hook belongs to this library's own copy of the Rust runtime.
#[inline]
fn keep_panics_quiet() {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if DEPTH.try_with(Cell::get).unwrap_or(0) == 0 {
                return before(info);
            }
            let payload = info.payload();
            let text = payload.downcast_ref::<&str>().copied();
            let text =
                text.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("panic");
            let place = info.location().map_or(String::new(), |l| format!(" at {}:{}", l.file(), l.line()));
            let _ = PANIC.try_with(|slot| *slot.borrow_mut() = format!("{text}{place}"));
        }));
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::handle::handle;
    use std::ffi::CStr;

    struct entire_probe(Held<u32>);
    handle!(entire_probe, u32);

    fn last_error() -> String {
        // SAFETY: `entire_last_error` returns a C string that is valid until the next call.
        unsafe { CStr::from_ptr(entire_last_error()) }.to_str().unwrap().to_owned()
    }

    #[test]
    fn a_panic_becomes_a_code_and_the_handle_unusable() {
        let probe = give::<entire_probe>(7);
        // SAFETY: `probe` is a live handle, used by this thread alone.
        unsafe {
            assert_eq!(
                changing(probe, |v| {
                    *v += 1;
                    Ok(())
                }),
                ENTIRE_OK
            );
            assert_eq!(changing(probe, |_| panic!("deliberate {}", 3)), ENTIRE_PANIC);
            assert!(last_error().contains("deliberate 3 at ffi/src/guard.rs:"), "{}", last_error());
            assert_eq!(reading(probe, |_| Ok(())), ENTIRE_PANIC);
            assert!(last_error().contains("earlier call panicked inside this entire_probe"));
            assert_eq!(changing(probe, |_| Ok(())), ENTIRE_PANIC);
            freeing(probe);
        }
        assert_eq!(guard(|| Ok(())), ENTIRE_OK);
        assert_eq!(last_error(), "");
    }

    #[test]
    fn a_panic_while_reading_marks_the_handle_too() {
        let probe = give::<entire_probe>(7);
        // SAFETY: `probe` is a live handle, used by this thread alone.
        unsafe {
            assert_eq!(reading(probe, |v| panic!("value {v}")), ENTIRE_PANIC);
            assert_eq!(reading(probe, |_| Ok(())), ENTIRE_PANIC);
            freeing(probe);
        }
    }

    #[test]
    fn an_unusable_argument_leaves_the_calls_own_handle_usable() {
        let (broken, sound) = (give::<entire_probe>(7), give::<entire_probe>(8));
        // SAFETY: both are live handles, used by this thread alone.
        unsafe {
            assert_eq!(changing(broken, |_| panic!("deliberate")), ENTIRE_PANIC);
            assert_eq!(changing(sound, |_| borrow(broken).map(drop)), ENTIRE_PANIC);
            assert!(last_error().contains("earlier call panicked inside this entire_probe"));
            assert_eq!(reading(sound, |_| borrow(broken).map(drop)), ENTIRE_PANIC);
            assert_eq!(changing(sound, |_| Ok(())), ENTIRE_OK);
            assert_eq!(changing(broken, |_| Ok(())), ENTIRE_PANIC);
            freeing(sound);
            freeing(broken);
        }
    }

    #[test]
    fn payloads_that_are_no_text_are_caught() {
        assert_eq!(guard(|| std::panic::panic_any(42u8)), ENTIRE_PANIC);
        assert!(last_error().contains("a bug in the library"));
    }

    #[test]
    fn every_successful_call_forgets_the_last_error() {
        let probe = give::<entire_probe>(7);
        let fail = || Err(Failure::new(ENTIRE_IO, "no such file"));
        // SAFETY: `probe` is a live handle, used by this thread alone.
        unsafe {
            assert_eq!(reading(probe, |_| fail()), ENTIRE_IO);
            assert_eq!(last_error(), "no such file");
            assert_eq!(reading(probe, |_| Ok(())), ENTIRE_OK);
            assert_eq!(last_error(), "");
            assert_eq!(changing(probe, |_| fail()), ENTIRE_IO);
            assert_eq!(last_error(), "no such file");
            assert_eq!(changing(probe, |_| Ok(())), ENTIRE_OK);
            assert_eq!(last_error(), "");
            freeing(probe);
        }
    }

    #[test]
    fn a_text_is_cut_at_a_character_and_ends_with_its_nul() {
        let mut out = [7; TEXT_BYTES];
        let kept =
            |out: &[u8; TEXT_BYTES]| CStr::from_bytes_until_nul(out).unwrap().to_str().unwrap().to_owned();
        keep("a\0b", &mut out);
        assert_eq!(kept(&out), "a\u{fffd}b");
        keep(&"é".repeat(3000), &mut out);
        assert_eq!(kept(&out), "é".repeat((TEXT_BYTES - 1) / 2));
        keep("", &mut out);
        assert_eq!(kept(&out), "");
        assert_eq!(guard(|| Err(Failure::new(ENTIRE_IO, "x".repeat(5000)))), ENTIRE_IO);
        assert_eq!(last_error(), "x".repeat(TEXT_BYTES - 1));
    }

    #[test]
    fn null_handles_are_named() {
        // SAFETY: all three calls allow NULL.
        unsafe {
            assert_eq!(reading(std::ptr::null::<entire_probe>(), |_| Ok(())), ENTIRE_NULL_ARGUMENT);
            assert_eq!(last_error(), "entire_probe is NULL; pass a valid pointer");
            assert_eq!(changing(std::ptr::null_mut::<entire_probe>(), |_| Ok(())), ENTIRE_NULL_ARGUMENT);
            freeing(std::ptr::null_mut::<entire_probe>());
        }
    }
}
