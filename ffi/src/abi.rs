//! Pointers and by-value structs at the boundary: all code that reads or writes the caller's memory.

use crate::result::entire_result::*;
use crate::result::{Failure, refuse};
use std::ffi::{CStr, c_char};
use std::mem::size_of;

/// Implements [`ByValue`] for a struct of the ABI, from the default values of all fields after `struct_size`.
/// Checks at compile time that the struct has no padding on 64-bit targets. A later version adds fields at
/// the end, and `struct_size` could not tell these fields from padding.
macro_rules! by_value {
    ($noun:ident { $($field:ident: $default:expr),+ $(,)? }) => {
        // SAFETY: the ABI's structs are `repr(C)` and begin with `struct_size`; any bits are values of their
        // fields (integers, floats and raw pointers).
        unsafe impl crate::abi::ByValue for $noun {
            const NAME: &'static str = stringify!($noun);
            fn defaults() -> Self {
                Self { struct_size: size_of::<Self>(), $($field: $default),+ }
            }
        }

        #[cfg(target_pointer_width = "64")]
        const _: () = {
            const fn size<T, F>(_: fn(&T) -> &F) -> usize {
                size_of::<F>()
            }
            assert!(size_of::<usize>() $(+ size::<$noun, _>(|value| &value.$field))+ == size_of::<$noun>());
        };
    };
}
pub(crate) use by_value;

/// Upper limit of `struct_size` in bytes, itself excluded. No struct of this ABI is nearly that large, so a
/// larger value comes from uninitialized memory.
const LARGEST_STRUCT: usize = 1 << 16;

/// A by-value struct whose first field is `struct_size: usize`, the size in the caller's header.
///
/// # Safety
/// The type is `repr(C)`, its first field is `struct_size: usize`, padding may have any bytes, and every bit
/// pattern of every field is a value (integers, floats, pointers).
pub(crate) unsafe trait ByValue: Copy {
    /// Name of the struct in error messages.
    const NAME: &'static str;
    /// Size in bytes of the struct in its first release. A struct that has grown since then overrides the
    /// default.
    const FIRST_SIZE: usize = size_of::<Self>();
    /// Returns the default values. The `_init` functions write them, and [`read_struct`] uses them for the
    /// fields that the struct of an older caller does not have.
    fn defaults() -> Self;
}

fn check_size<T: ByValue>(size: usize) -> Result<(), Failure> {
    if !(T::FIRST_SIZE..LARGEST_STRUCT).contains(&size) {
        refuse!(
            ENTIRE_STRUCT_SIZE,
            "{name}.struct_size is {size}, but the struct has {} bytes; set struct_size to sizeof({name})",
            size_of::<T>(),
            name = T::NAME
        );
    }
    Ok(())
}

/// Reads the caller's struct. Fields that an older caller's struct does not have get their default values.
/// Fields that this library does not know, because the caller's header is newer, must be zero.
///
/// # Safety
/// `at` is NULL or valid for reads of the bytes that its `struct_size` states.
pub(crate) unsafe fn read_struct<T: ByValue>(at: *const T) -> Result<T, Failure> {
    if at.is_null() {
        return Err(Failure::null(T::NAME));
    }
    // SAFETY: `at` is not NULL and points to a struct whose first field is `struct_size`. The read assumes no
    // alignment.
    let size = unsafe { at.cast::<usize>().read_unaligned() };
    check_size::<T>(size)?;
    let known = size.min(size_of::<T>());
    let mut value = T::defaults();
    // SAFETY: the caller guarantees that `size` bytes are readable at `at`. `value` has `known` bytes, and
    // `ByValue` guarantees that any bits are a value of its fields.
    let unknown = unsafe {
        std::ptr::copy_nonoverlapping(at.cast::<u8>(), (&raw mut value).cast::<u8>(), known);
        std::slice::from_raw_parts(at.cast::<u8>().add(known), size - known)
    };
    if unknown.iter().any(|&byte| byte != 0) {
        refuse!(
            ENTIRE_STRUCT_SIZE,
            "{}.struct_size is {size}, and fields beyond the {} bytes that this library knows are set; \
             use a library as new as the header, or set these fields to zero",
            T::NAME,
            size_of::<T>()
        );
    }
    Ok(value)
}

/// Checks that the caller's output struct can be written, before the call does any work.
///
/// # Safety
/// As [`write_struct`].
pub(crate) unsafe fn check_output<T: ByValue>(at: *const T) -> Result<(), Failure> {
    if at.is_null() {
        return Err(Failure::null(T::NAME));
    }
    // SAFETY: `at` is not NULL and points to a struct whose first field is `struct_size`. The read assumes no
    // alignment.
    check_size::<T>(unsafe { at.cast::<usize>().read_unaligned() })
}

/// Fills the fields that the caller's version of the struct has, except `struct_size`.
///
/// # Safety
/// `at` is NULL or valid for reads and writes of the bytes that its `struct_size` states.
pub(crate) unsafe fn write_struct<T: ByValue>(at: *mut T, value: &T) -> Result<(), Failure> {
    // SAFETY: the caller guarantees that `at` is NULL or valid for `struct_size` bytes, as `check_output`
    // requires.
    unsafe { check_output(at)? };
    // SAFETY: the caller guarantees that `at` is valid for `size` bytes. Both structs have at least `known`
    // bytes, and they are different objects.
    unsafe {
        let size = at.cast::<usize>().read_unaligned();
        let known = size.min(size_of::<T>());
        let field = size_of::<usize>();
        let from = std::ptr::from_ref(value).cast::<u8>();
        std::ptr::copy_nonoverlapping(from.add(field), at.cast::<u8>().add(field), known - field);
    }
    Ok(())
}

/// Fills a struct of `size` bytes with its defaults and sets its `struct_size` to `size`. Bytes beyond the
/// fields that this library knows become zero.
///
/// # Safety
/// `at` is NULL or valid for writes of `size` bytes.
pub(crate) unsafe fn init_struct<T: ByValue>(at: *mut T, size: usize) -> Result<(), Failure> {
    if at.is_null() {
        return Err(Failure::null(T::NAME));
    }
    check_size::<T>(size)?;
    let known = size.min(size_of::<T>());
    let value = T::defaults();
    // SAFETY: the caller guarantees that `size` bytes are writable at `at`; `value` has `known` readable
    // bytes.
    unsafe {
        at.cast::<u8>().write_bytes(0, size);
        std::ptr::copy_nonoverlapping((&raw const value).cast::<u8>(), at.cast::<u8>(), known);
        at.cast::<usize>().write_unaligned(size);
    }
    Ok(())
}

/// Returns the caller's array. If `len` is 0, it is empty, and `at` may be NULL.
///
/// # Safety
/// `at` is NULL or valid for reads of `len` elements for as long as the result lives.
pub(crate) unsafe fn slice<'a, T>(at: *const T, len: usize, what: &str) -> Result<&'a [T], Failure> {
    if len == 0 {
        return Ok(&[]);
    }
    check_array(at, len, what)?;
    // SAFETY: `check_array` has checked that `at` is not NULL, aligned, and not longer than an object can be.
    // The caller guarantees that `len` elements are readable.
    Ok(unsafe { std::slice::from_raw_parts(at, len) })
}

/// The caller's output array. Its contents are not read here and may be any numbers.
///
/// # Safety
/// `at` is NULL or valid for reads and writes of `len` elements, which nothing else accesses as long as the
/// result lives.
pub(crate) unsafe fn slice_mut<'a, T: Number>(
    at: *mut T,
    len: usize,
    what: &str,
) -> Result<&'a mut [T], Failure> {
    if len == 0 {
        return Ok(&mut []);
    }
    check_array(at, len, what)?;
    // SAFETY: `check_array` has checked that `at` is not NULL, aligned, and not longer than an object can be.
    // The caller guarantees that `len` elements are writable. Any bytes are a value of a `Number`.
    Ok(unsafe { std::slice::from_raw_parts_mut(at, len) })
}

/// Types for which any bytes are a valid value.
pub(crate) trait Number: Copy {}
impl Number for u32 {}
impl Number for f32 {}

fn check_array<T>(at: *const T, len: usize, what: &str) -> Result<(), Failure> {
    if at.is_null() {
        return Err(Failure::null(what));
    }
    if !at.is_aligned() {
        refuse!(
            ENTIRE_INVALID_ARGUMENT,
            "{what} is not aligned to {} bytes; pass an aligned pointer",
            align_of::<T>()
        );
    }
    if len.checked_mul(size_of::<T>()).is_none_or(|bytes| bytes > isize::MAX as usize) {
        refuse!(
            ENTIRE_SIZE_MISMATCH,
            "{what} is said to have {len} elements, more than memory can hold; check the count"
        );
    }
    Ok(())
}

/// The caller's string, which must be UTF-8.
///
/// # Safety
/// `at` is NULL or a C string that lives as long as the result.
pub(crate) unsafe fn text<'a>(at: *const c_char, what: &str) -> Result<&'a str, Failure> {
    if at.is_null() {
        return Err(Failure::null(what));
    }
    // SAFETY: `at` is not NULL, and the caller guarantees that it is a C string.
    unsafe { CStr::from_ptr(at) }.to_str().map_err(|e| {
        Failure::new(
            ENTIRE_INVALID_ARGUMENT,
            format!("{what} is not UTF-8 at byte {}; convert it to UTF-8 before the call", e.valid_up_to()),
        )
    })
}

/// Checks that an output pointer is aligned and not NULL, before the call does any work.
pub(crate) fn check_pointer<T>(at: *const T, what: &str) -> Result<(), Failure> {
    check_array(at, 1, what)
}

/// Writes an output.
///
/// # Safety
/// `at` is NULL or valid for one write.
pub(crate) unsafe fn write<T>(at: *mut T, value: T, what: &str) -> Result<(), Failure> {
    check_pointer(at, what)?;
    // SAFETY: `check_pointer` has checked that `at` is not NULL and is aligned. The caller guarantees that it
    // is valid for one write.
    unsafe { at.write(value) };
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[repr(C)]
    #[derive(Clone, Copy)]
    struct Probe {
        struct_size: usize,
        a: u64,
        b: f64,
    }

    // SAFETY: the type is `repr(C)` and begins with `struct_size`; any bits are values of its fields
    // (integers and floats).
    unsafe impl ByValue for Probe {
        const NAME: &'static str = "probe";
        const FIRST_SIZE: usize = 16;
        fn defaults() -> Self {
            Self { struct_size: size_of::<Self>(), a: 5, b: f64::NAN }
        }
    }

    #[repr(C)]
    #[derive(Clone, Copy)]
    struct Newer {
        old: Probe,
        tail: u64,
    }

    #[test]
    fn an_older_caller_gets_defaults_and_keeps_what_it_set() {
        let old = [16u64, 9];
        // SAFETY: `old` has the 16 readable bytes that its first field states.
        let value = unsafe { read_struct(old.as_ptr().cast::<Probe>()) }.unwrap();
        assert_eq!(value.a, 9);
        assert!(value.b.is_nan());
    }

    #[test]
    fn a_newer_caller_is_refused_only_when_it_uses_what_is_new() {
        let mut newer = Newer { old: Probe { struct_size: size_of::<Newer>(), a: 1, b: 2.0 }, tail: 0 };
        let read = |n: &Newer| {
            // SAFETY: `n` has as many readable bytes as its `struct_size` states.
            unsafe { read_struct(std::ptr::from_ref(n).cast::<Probe>()) }.map_err(|e| e.code)
        };
        assert_eq!(read(&newer).unwrap().b, 2.0);
        newer.tail = 1;
        assert_eq!(read(&newer).err(), Some(ENTIRE_STRUCT_SIZE));
    }

    #[test]
    fn sizes_that_cannot_be_are_refused() {
        for size in [0usize, 8, 15, 1 << 16, usize::MAX] {
            let probe = Probe { struct_size: size, a: 0, b: 0.0 };
            // SAFETY: the call refuses this size after it has read the first field, which `probe` has.
            let failure = unsafe { read_struct(&raw const probe) }.err().unwrap();
            assert_eq!(failure.code, ENTIRE_STRUCT_SIZE);
            assert!(failure.message.contains("sizeof(probe)"));
            let mut probe = probe;
            // SAFETY: the call refuses this size after it has read the first field, which `probe` has.
            let refused = unsafe { write_struct(&raw mut probe, &Probe::defaults()) }.err();
            assert_eq!(refused.unwrap().code, ENTIRE_STRUCT_SIZE);
        }
        // SAFETY: `read_struct` allows NULL.
        let refused = unsafe { read_struct(std::ptr::null::<Probe>()) }.err();
        assert_eq!(refused.unwrap().code, ENTIRE_NULL_ARGUMENT);
    }

    #[test]
    fn outputs_are_written_as_far_as_the_caller_knows_them() {
        let mut old = [16u64, 0, 77];
        // SAFETY: `old` has more than the 16 writable bytes that its first field states.
        unsafe {
            write_struct(old.as_mut_ptr().cast::<Probe>(), &Probe { struct_size: 0, a: 3, b: 4.0 }).unwrap()
        };
        assert_eq!(old, [16, 3, 77]);
        // SAFETY: `old` has more than the 16 writable bytes that the call states.
        unsafe { init_struct(old.as_mut_ptr().cast::<Probe>(), 16).unwrap() };
        assert_eq!(old, [16, 5, 77]);
        let mut newer = [0xffu64; 4];
        // SAFETY: `newer` has the 32 writable bytes that the call states.
        unsafe { init_struct(newer.as_mut_ptr().cast::<Probe>(), 32).unwrap() };
        assert_eq!((newer[0], newer[1], newer[3]), (32, 5, 0));
    }

    #[test]
    fn arrays_are_checked() {
        let data = [1.0f32, 2.0];
        // SAFETY: the arrays have the stated lengths, or the call refuses them before it reads them.
        unsafe {
            assert_eq!(slice(data.as_ptr(), 2, "x").unwrap(), &data);
            assert!(slice::<f32>(std::ptr::null(), 0, "x").unwrap().is_empty());
            assert_eq!(slice::<f32>(std::ptr::null(), 1, "x").unwrap_err().code, ENTIRE_NULL_ARGUMENT);
            let odd = data.as_ptr().cast::<u8>().wrapping_add(1).cast::<f32>();
            assert_eq!(slice(odd, 1, "x").unwrap_err().code, ENTIRE_INVALID_ARGUMENT);
            assert_eq!(slice(data.as_ptr(), usize::MAX, "x").unwrap_err().code, ENTIRE_SIZE_MISMATCH);
        }
    }

    #[test]
    fn strings_must_be_utf8() {
        // SAFETY: each pointer is a C string or NULL.
        unsafe {
            assert_eq!(text(c"pfad/ä".as_ptr(), "path").unwrap(), "pfad/ä");
            assert_eq!(text(c"\xff".as_ptr(), "path").unwrap_err().code, ENTIRE_INVALID_ARGUMENT);
            assert_eq!(text(std::ptr::null(), "path").unwrap_err().code, ENTIRE_NULL_ARGUMENT);
        }
    }
}
