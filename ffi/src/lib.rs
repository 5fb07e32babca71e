//! libentire: the C ABI over `entire-core` and `entire-steer`. One file per C noun; conversions only, no
//! arithmetic.
//!
//! Every entry point goes through [`guard`], which checks handles and pointers, turns panics into a result
//! code and keeps the error text. The conventions that callers rely on are in `ffi/entire.h`, the first
//! comment of `include/entire/entire.h`. `ffi/tests/suite/header.rs` generates this header and `advanced.h`
//! from this crate.
//!
//! # Safety of all entry points
//!
//! A pointer is NULL or valid for the access that the function's documentation states, for the length that is
//! given with it; a handle comes from this library and was not freed; a handle that is not `const` is used by
//! one thread at a time. Objects that a call writes do not overlap its other arguments. Borrowed voxels stay
//! readable as long as the documentation of the function says. Functions state only additional conditions.
#![allow(non_camel_case_types, reason = "C names, written here as the header has them")]
#![allow(
    unreachable_pub,
    reason = "C callers use items that no Rust crate can reach; the header generator takes only `pub` items"
)]
#![allow(
    clippy::missing_safety_doc,
    reason = "the pointer rules are the same for all entry points and stand in the crate documentation"
)]

#[cfg(panic = "abort")]
compile_error!("libentire promises that no panic takes the host down; build it with panic = \"unwind\"");

mod abi;
mod handle;
mod reserve;

// The nouns, in the order of the header.
mod version;

mod result;

mod limits;

mod guard;

mod pool;

mod model;

mod volume;

mod transfer;

mod frame;

mod session;

mod budget;

#[cfg(test)]
mod calls;
