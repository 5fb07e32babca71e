//! This crate reads the timing table that a C program writes (`examples/c/04_fine_tune_log.c`).
//!
//! Run by `make test-ffi`, which runs the example and names its table in `ENTIRE_C_LOG`.

use entire_io::dataset::{Clock, Table};
use std::path::PathBuf;

#[test]
#[ignore = "needs the table that a C program of `make test-ffi` writes; ENTIRE_C_LOG names it"]
fn a_log_written_from_c_is_a_timing_table() {
    let path = PathBuf::from(std::env::var_os("ENTIRE_C_LOG").expect("ENTIRE_C_LOG names the table"));
    let table = Table::read(&path, 0).unwrap();
    assert_eq!(table.frames.len(), 24);
    for frame in &table.frames {
        assert_eq!(frame.repeats.len(), 3);
        assert!(frame.seconds(Clock::Wall).unwrap() > 0.0);
        assert_eq!(frame.scene.dims, [5, 7, 11]);
        assert_eq!(frame.scene.lobes.len(), 1);
    }
}
