#![no_main]

use entire_fuzz::volume::{Format, hostile::read_any};

libfuzzer_sys::fuzz_target!(|input: &[u8]| entire_fuzz::checks::check_volume(read_any(
    Format::MetaImage,
    input
)));
