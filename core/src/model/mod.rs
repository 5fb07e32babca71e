//! The safetensors model file, read all or nothing.
//!
//! [`Model::from_bytes`] checks everything there is to check; what it returns can be run. [`ModelFile`] is
//! the writing side: it keeps the tensors and the metadata that it does not know, so that a fine-tuned file
//! loses nothing.

mod file;
mod read;
#[cfg(test)]
mod tests;

pub use file::ModelFile;
pub use read::{InputGroup, MAX_INPUT_GROUPS, MAX_VOLUMENET_INPUT, Model};

/// Metadata keys and fixed names of the model file, each stated once.
pub mod keys {
    /// Version of the file format; its value is [`FORMAT`].
    pub const FORMAT_KEY: &str = "entire.format";
    /// The one format that this version reads and writes.
    pub const FORMAT: &str = "1";
    /// JSON array of the input groups in order.
    pub const INPUTS: &str = "entire.inputs";
    /// `seconds` or `log_seconds`.
    pub const TARGET: &str = "entire.target";
    /// JSON object: input edge, stride and padding per block.
    pub const VOLUMENET: &str = "entire.volumenet";
    /// JSON array of the scene features' names in order.
    pub const SCENE_FEATURES: &str = "entire.scene_features";
    /// What rendered the frames that the timings come from (free text).
    pub const RENDERER: &str = "entire.renderer";
    /// The device that the timings come from (free text).
    pub const DEVICE: &str = "entire.device";
    /// What a step of 1 meant in the timings (free text).
    pub const STEP_REFERENCE: &str = "entire.step_reference";
    /// Where the weights come from (free text, JSON where structured).
    pub const PROVENANCE: &str = "entire.provenance";

    /// Group of VolumeNet's output.
    pub const GROUP_VOLUME_FEATURES: &str = "volume_features";
    /// Group of R_x, R_y (degrees) and D_z (bounding-sphere radii).
    pub const GROUP_CAMERA: &str = "camera";
    /// Group of the image's width and height in pixels.
    pub const GROUP_RESOLUTION: &str = "resolution";
    /// Group of (c, w, h) per Gaussian lobe.
    pub const GROUP_TRANSFER_FUNCTION: &str = "transfer_function";
    /// Group of the ray step in multiples of the reference step.
    pub const GROUP_STEP_SIZE: &str = "step_size";
    /// Group of the physical features named by [`SCENE_FEATURES`].
    pub const GROUP_SCENE_FEATURES: &str = "scene_features";
}
