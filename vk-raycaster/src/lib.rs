//! The reference volume raycaster whose frame times entire predicts: a compute shader on Vulkan, and a CPU
//! version of it (the *twin*) that renders the same picture and counts every sample.
//!
//! Both implement [`Renderer`]. Of the project's crates, this crate uses only `entire_core::scene`, so its
//! times are independent of the predictor.
//!
//! # Definition of the picture
//!
//! Both renderers follow this specification, in 32-bit floats and with the operations in the same order.
//!
//! *Space.* Voxel coordinates p: the box spans 0…n along each axis (n voxels), voxel i is centered at i +
//! 0.5. A ray goes through a pixel's center, from the eye or, with parallel rays, from the plane through the
//! eye. The frame's step δ is in multiples of the reference step, the smallest spacing.
//!
//! *Samples.* The ray is inside the box from t_in to t_out, measured in steps from the ray's origin, with
//! t_in ≥ 0. Sample k = 0, 1, … lies at t_k = t_in + ½ + k while t_k < t_out. With jitter, ½ is replaced by
//! a hash of the pixel in \[0, 1).
//!
//! *Value.* Voxels are mapped to \[0, 1] over the volume's range (clamped; NaN is the low end) and
//! interpolated trilinearly between voxel centers, clamped to the edge. The result is the normalized scalar
//! s. Integer voxels keep their stored precision; if the range is narrower than the data, they are
//! requantized to 16 bits over the range.
//!
//! *Classification.* The 256-entry table is looked up at 255·s, linear between neighbors. Its opacities α
//! hold over the table's unit distance (in reference steps) and are corrected to the step: α′ = 1 −
//! (1 − α)^(δ / unit distance). Opacities below 1/32768 per reference step count as zero
//! ([`TransferTable::is_visible`](entire_core::scene::TransferTable::is_visible)), so that the tails of a
//! Gaussian lobe leave empty space to skip.
//!
//! *Compositing.* Each sample, with color c, is added to the ray's color C and opacity A, from front to back:
//! C += (1 − A)·α′·c, A += (1 − A)·α′. The ray stops once A reaches the frame's termination opacity; 1 means
//! never. The image holds C and A, 8 bits each, over black.
//!
//! *Local shading.* Samples with α′ > 0 are lit by a headlight, which shines along the ray: gradient g by
//! central differences of one voxel to each side along each axis (in world proportions), N·L = |g·v| / |g|
//! with v the ray's direction, c ← c·(0.3 + 0.7·N·L) + 0.2·(N·L)³², at most 1 (Blinn–Phong, the half vector
//! being v). A sample whose gradient is nearly zero keeps its c.
//!
//! *Single scattering.* Each sample with α′ > 0 casts a shadow ray towards a directional light that is fixed
//! in scene space ([`LIGHT_DIRECTION`]). The shadow ray is sampled every [`SHADOW_STEP`] steps, for the first
//! time at that distance from the sample. Its transmittance T is 1 at first; T ← T·(1 − α′)^[`SHADOW_STEP`]
//! at each sample, until the ray leaves the box or T falls below 0.25. Then c ← c·(0.25 + 0.75·T).
//! With local shading and single scattering, c is lit first; the shadow ray attenuates the lit color.
//!
//! *Skipping.* Blocks of [`BLOCK_EDGE`]³ cells (a cell lies between eight voxel centers) store the smallest
//! and largest value of their samples; a block is empty when the table is transparent over that interval. A
//! sample inside an empty block is not taken: the ray continues with the first sample beyond the block
//! (`blocks`), or beyond all blocks that the Chebyshev distance map shows to be empty (`distance`). Sample
//! positions are the same with every skipping mode, and so is the picture. Shadow rays skip empty blocks,
//! too.
//!
//! *Counts.* See [`WorkCounts`].

#![deny(unsafe_code)]

mod blocks;
mod clock;
mod cpu;
mod error;
mod probe;
mod renderer;
mod setup;
mod table;
mod voxels;
mod vulkan;

pub use cpu::CpuRaycaster;
pub use error::{Error, Result};
pub use probe::{Agreement, Probe, ProbeOptions, TimestampQuality, probe};
pub use renderer::{DeviceLimits, FrameTime, Image, Preparation, Rendered, Renderer, WorkCounts};
pub use setup::{LIGHT_DIRECTION, SHADOW_STEP};
pub use voxels::BLOCK_EDGE;
pub use vulkan::{Picture, Region, SharedDevice, VoxelFetch, VulkanOptions, VulkanRaycaster};
