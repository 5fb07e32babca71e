#![no_main]

use entire_fuzz::{mutants, mutate};

libfuzzer_sys::fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    mutate::model(data, size, max_size, seed, libfuzzer_sys::fuzzer_mutate)
});

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    mutants::exercise(input);
});
