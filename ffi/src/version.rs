//! The library's version. All numbers come from the package version.

use std::ffi::{CStr, c_char};

const fn decimal(text: &str) -> u32 {
    match u32::from_str_radix(text, 10) {
        Ok(value) => value,
        Err(_) => panic!("a part of the package version is no number"),
    }
}

const MAJOR: u32 = decimal(env!("CARGO_PKG_VERSION_MAJOR"));
const MINOR: u32 = decimal(env!("CARGO_PKG_VERSION_MINOR"));
const PATCH: u32 = decimal(env!("CARGO_PKG_VERSION_PATCH"));

const VERSION: &CStr = match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
    Ok(version) => version,
    Err(_) => panic!("the package version holds a NUL"),
};

/// The library's version, such as "0.1.0". The text is static.
#[unsafe(no_mangle)]
pub extern "C" fn entire_version() -> *const c_char {
    VERSION.as_ptr()
}

/// The library's version as one number: MAJOR * 1000000 + MINOR * 1000 + PATCH. Compare with
/// `ENTIRE_VERSION_NUMBER` of the header that you compiled with.
#[unsafe(no_mangle)]
pub extern "C" fn entire_version_number() -> u32 {
    MAJOR * 1_000_000 + MINOR * 1000 + PATCH
}

/// The version of the binary interface: MAJOR * 1000, or MINOR before version 1.0. Programs must be
/// recompiled if and only if it changes. A library loaded at run time is compatible if this version equals
/// `ENTIRE_ABI_VERSION` of the header.
#[unsafe(no_mangle)]
pub extern "C" fn entire_abi_version() -> u32 {
    if MAJOR == 0 { MINOR } else { MAJOR * 1000 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_text_agree() {
        // SAFETY: entire_version returns a static C string.
        let text = unsafe { CStr::from_ptr(entire_version()) }.to_str().unwrap();
        assert_eq!(text, env!("CARGO_PKG_VERSION"));
        let parts: Vec<u32> = text.split(['.', '-', '+']).take(3).map(|part| part.parse().unwrap()).collect();
        assert_eq!(entire_version_number(), parts[0] * 1_000_000 + parts[1] * 1000 + parts[2]);
        assert_eq!(decimal("10205"), 10205);
    }
}
