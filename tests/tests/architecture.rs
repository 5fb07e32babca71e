//! The house rules that a compiler does not check: arrows between rooms never point back, and `unsafe` stays fenced.

use std::fs;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace root").to_path_buf()
}

fn rust_files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut stack = vec![folder.to_path_buf()];
    while let Some(path) = stack.pop() {
        let entries = fs::read_dir(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        for entry in entries {
            let path = entry.expect("a directory entry").path();
            if path.is_dir() {
                stack.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") {
                found.push(path);
            }
        }
    }
    found.sort();
    assert!(!found.is_empty(), "no Rust file under {}", folder.display());
    found
}

/// The code of a file without comments and without its unit tests (which stand last, behind `#[cfg(test)]`).
fn product_code(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let product = text.split("#[cfg(test)]").next().unwrap_or_default();
    product.lines().map(|line| line.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n")
}

/// Which rooms of `core` each room may use. Everyone may use the error type and itself.
const ROOMS: &[(&str, &[&str])] = &[
    ("scene", &[]),
    ("kernels", &[]),
    ("features", &["scene"]),
    ("nn", &["kernels", "scene"]),
    ("model", &["nn", "kernels"]),
    ("predict", &["features", "model", "nn", "kernels", "scene"]),
    ("adapt", &["predict", "features", "scene"]),
    ("control", &["adapt", "predict", "features", "scene"]),
    ("schedule", &[]),
    ("train", &["predict", "model", "nn", "kernels", "features", "scene"]),
];

#[test]
fn arrows_between_the_rooms_of_core_never_point_back() {
    let core = root().join("core/src");
    let mut wrong = Vec::new();
    for (room, allowed) in ROOMS {
        for file in rust_files(&core.join(room)) {
            let code = product_code(&file);
            for (other, _) in ROOMS {
                let used =
                    code.contains(&format!("crate::{other}::")) || code.contains(&format!("crate::{other};"));
                if used && other != room && !allowed.contains(other) {
                    wrong.push(format!("{} uses crate::{other}", file.display()));
                }
            }
        }
    }
    let listed: Vec<_> = ROOMS.iter().map(|r| r.0).collect();
    for entry in fs::read_dir(&core).expect("core/src") {
        let entry = entry.expect("a directory entry");
        let name = entry.file_name().into_string().expect("a UTF-8 name");
        if entry.path().is_dir() && !listed.contains(&name.as_str()) {
            wrong.push(format!("core/src/{name} is a room that this test does not know"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn the_raycaster_knows_nothing_of_prediction() {
    let mut wrong = Vec::new();
    for file in rust_files(&root().join("vk-raycaster/src")) {
        for part in product_code(&file).split("entire_core::").skip(1) {
            if !part.starts_with("scene") {
                wrong.push(format!("{} uses entire_core::{}", file.display(), &part[..part.len().min(20)]));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn unsafe_stays_behind_its_fences() {
    let root = root();
    let fences = ["core/src/kernels", "ffi/src", "vk-raycaster/src/vulkan"];
    let mut wrong = Vec::new();
    for folder in ["core/src", "ffi/src", "vk-raycaster/src", "cli/src"] {
        for file in rust_files(&root.join(folder)) {
            let fenced = fences.iter().any(|fence| file.starts_with(root.join(fence)));
            let code = product_code(&file);
            let uses = code.split(|c: char| !c.is_alphanumeric() && c != '_').any(|word| word == "unsafe");
            if uses && !fenced {
                wrong.push(file.display().to_string());
            }
        }
    }
    assert!(
        wrong.is_empty(),
        "unsafe outside core/src/kernels, ffi/src and vk-raycaster/src/vulkan:\n{}",
        wrong.join("\n")
    );
}
