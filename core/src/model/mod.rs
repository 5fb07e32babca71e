//! The safetensors model file, read all or nothing.
//!
//! [`Model::from_bytes`] checks everything there is to check; what it returns can be run. [`ModelFile`] is
//! the writing side: it keeps the tensors and the metadata that it does not know, so that a fine-tuned file
//! loses nothing.

mod file;
mod key;
mod read;
#[cfg(test)]
mod tests;

pub use file::ModelFile;
pub use key::{GroupKind, Key};
pub use read::{InputGroup, Model};
