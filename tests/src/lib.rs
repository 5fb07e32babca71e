//! Shared parts of the tests that cross crates.

pub mod levels;
pub mod mutants;

/// The small model files that mutants and hostile tests start from.
///
/// # Panics
/// When one of them cannot be read.
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
