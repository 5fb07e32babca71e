//! Inference of the two networks that predict how long a volume-rendered frame takes: VolumeNet reduces a
//! volume to a short feature vector, PredNet maps features, camera, transfer function and resolution to
//! seconds. The crate also has the types that describe a scene and the safetensors model file.
//!
//! Sessions, cost models and controllers that choose a ray step are in the crate `entire-steer`.
//!
//! # Units
//!
//! | quantity | unit |
//! |---|---|
//! | time | seconds (`f32`) |
//! | angles | degrees in the interface (`Arcball`), radians inside |
//! | scene space | origin at the volume's center, unit length = radius of its bounding sphere |
//! | image sizes | pixels |
//!
//! # Predicting
//!
//! [`Model::from_bytes`] reads a model file; [`nn::PredNet`] packs its weights for this CPU and predicts
//! without allocating:
//!
//! ```
//! use entire_core::Model;
//! use entire_core::model::{InputGroup, ModelFile};
//! use entire_core::nn::{DenseParts, Dtype, PredNet, PredNetParts, Target};
//!
//! // Bytes of a model file; here one with a single layer: seconds = exp(0.5·a − 0.25·b − 4).
//! let layer =
//!     DenseParts { inputs: 2, outputs: 1, weight: vec![0.5, -0.25], bias: vec![-4.0], dtype: Dtype::F32 };
//! let parts = PredNetParts { layers: vec![layer], input: None, output: None, target: Target::LogSeconds };
//! let mut file = ModelFile::default();
//! file.set_prednet(&parts, &[InputGroup { name: "resolution".into(), size: 2 }])?;
//! let bytes = file.to_bytes()?;
//!
//! let model = Model::from_bytes(&bytes)?;
//! let net = PredNet::new(model.prednet.as_ref().expect("the file has a PredNet"))?;
//! let mut scratch = net.scratch(1)?;
//! let seconds = net.predict(&[2.0, 4.0], &mut scratch);
//! assert!((seconds - (-4.0f32).exp()).abs() < 1e-6);
//! # Ok::<(), entire_core::Error>(())
//! ```
//!
//! # Contract
//!
//! The crate is `no_std` with `alloc`. It uses no files, no GPU and no threads except those of the caller. A
//! prediction is a pure function: the same model, inputs and SIMD level give the same bits, with and without
//! the feature `std`.
#![cfg_attr(not(any(feature = "std", test)), no_std)]
#![deny(unsafe_code)]

extern crate alloc;

mod error;
pub mod kernels;
pub mod memory;
pub mod model;
mod names;
pub mod nn;
pub mod scene;

pub use error::{Error, ErrorKind, Result};
pub use model::Model;
pub use scene::{Frame, GaussianLobe, VolumeView};
