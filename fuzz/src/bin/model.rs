#![no_main]

use entire_core::model::Model;

libfuzzer_sys::fuzz_target!(|input: &[u8]| entire_fuzz::checks::check_model(Model::from_bytes(input)));
