//! Every error kind of the core has a code in this crate.

use std::path::Path;

/// The core's error kinds are read from its source: the enumeration is non-exhaustive, so a match cannot list
/// them all.
#[test]
fn no_kind_of_the_core_is_missing() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    if here.join("Cargo.toml.orig").exists() {
        // A published package does not contain the core's sources. The tests of the repository compare them.
        return;
    }
    let read =
        |path: &str| std::fs::read_to_string(here.join(path)).unwrap_or_else(|e| panic!("{path}: {e}"));
    let core = read("../core/src/error.rs");
    let kinds = core.split("pub enum ErrorKind {").nth(1).and_then(|s| s.split('}').next()).unwrap();
    let kinds: Vec<&str> = kinds
        .lines()
        .filter(|line| !line.trim_start().starts_with("//"))
        .filter_map(|line| line.split_once('=').map(|(name, _)| name.trim()))
        .collect();
    assert!(kinds.len() >= 7, "ErrorKind is not written as this test reads it");
    let codes = read("src/result.rs");
    for kind in kinds {
        let listed = codes.contains(&format!("ErrorKind::{kind} as u32"));
        assert!(listed, "entire_core::ErrorKind::{kind} has no code in entire_result (ffi/src/result.rs)");
    }
}
