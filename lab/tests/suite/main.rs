//! The tests of the lab that run under cargo's harness, as one program.

mod commands;
mod constants;
mod farm;
mod paper;
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod plans;
mod reference;
mod replay;
mod study;

#[path = "../../../cli/tests/support/reference.rs"]
mod page;

use entire_lab::replay::Replayable;
use entire_lab::trace::Trace;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Runs `entire-lab` in a folder. A panic fails the test.
fn lab_in(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_entire-lab"));
    let output = command.args(arguments).current_dir(folder).output().unwrap();
    let said = printed(&output.stderr);
    assert!(!said.contains("panicked"), "{said}");
    output
}

/// Runs `entire-lab` in the repository's folder.
fn lab(arguments: &[&str]) -> Output {
    lab_in(&repository(), arguments)
}

fn read_json(path: &Path) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Path and bytes of every file of a folder.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| p.is_file())
        .map(|p| (p.clone(), std::fs::read(p).unwrap()))
        .collect()
}

fn printed(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// A recorded path of the tests' data, as drawn by a renderer that is slower by a factor.
fn recorded(name: &str, times: f64) -> Replayable {
    let mut trace = Trace::open(&repository().join("lab/tests/data").join(name)).unwrap();
    trace.volumes.iter_mut().for_each(|v| v.file = repository().join(&v.file));
    trace.frames.iter_mut().flatten().flat_map(|p| &mut p.seconds).for_each(|s| *s *= times);
    Replayable::new(trace).unwrap()
}
