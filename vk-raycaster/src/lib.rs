//! The reference volume raycaster whose frame times entire predicts: a compute shader on Vulkan, and a CPU twin of it
//! that renders the same picture and counts every sample.
//!
//! Both stand behind [`Renderer`]. This crate depends on `entire_core::scene` alone and knows nothing of prediction:
//! it is an honest judge of the predictor.

mod renderer;

pub use renderer::{Error, FrameTime, Image, Preparation, Rendered, Renderer, Result, WorkCounts};
