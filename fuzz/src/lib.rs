//! The readers under test, invariants of their results, and mutations that know their formats.

#![allow(dead_code, unused_imports, reason = "parts of modules that no target calls")]

pub use entire_farm as farm;
pub use entire_io::{dataset, path, volume};

#[path = "../../lab/src/trace/format.rs"]
pub mod trace;

#[path = "../../tests/src/mutants.rs"]
pub mod mutants;

pub mod checks;
pub mod mutate;
pub mod records;
pub mod state;
pub mod traces;

/// Defines a target that mutates bytes as text and gives them to a check.
#[macro_export]
macro_rules! text_target {
    ($check:path) => {
        libfuzzer_sys::fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
            $crate::mutate::text(data, size, max_size, seed, libfuzzer_sys::fuzzer_mutate)
        });

        libfuzzer_sys::fuzz_target!(|input: &[u8]| $check(input));
    };
}

/// Defines a target that reads volumes of a format.
#[macro_export]
macro_rules! volume_target {
    ($format:ident) => {
        libfuzzer_sys::fuzz_target!(|input: &[u8]| {
            let read = $crate::volume::hostile::read_any($crate::volume::Format::$format, input);
            $crate::checks::check_volume(read)
        });
    };
}
