//! Shared parts of the tests that cross crates.

pub mod levels;
pub mod mutants;

/// Returns the small model files from which mutants and tests of hostile weights start.
///
/// # Panics
/// When one of the files cannot be read.
pub fn small_models() -> Vec<Vec<u8>> {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("golden");
    ["single_layer", "odd_sizes", "volume16_kernels", "volume16"]
        .iter()
        .map(|name| {
            let path = folder.join(format!("{name}.safetensors"));
            std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
        })
        .collect()
}
