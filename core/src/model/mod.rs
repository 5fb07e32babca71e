//! The safetensors model file, which is read completely or refused.
//!
//! [`Model::from_bytes`] checks the whole file; a model that it returns can be run. [`ModelFile`] edits and
//! writes a file. It keeps unknown tensors and metadata, so that a fine-tuned file loses nothing.

mod file;
mod key;
mod read;
#[cfg(test)]
mod tests;

pub use file::ModelFile;
pub use key::{GroupKind, Key};
pub use read::{InputGroup, Model};
