//! PredNet training and fine-tuning: mini-batch Adam with a cosine learning rate, gradient clipping and early
//! stopping (paper, supplement "Implementation"), on a rayon pool that the caller gives.
//!
//! The result depends on the data, the settings and the seed, and not on the number of threads: for any pool,
//! the batch is cut into the same parts, and sums are taken in the same order.

mod loss;
mod matmul;
mod network;
mod optimizer;
mod real;
mod run;

pub use loss::Loss;
pub use network::Network;
pub use optimizer::{Step, Trainer, cosine_learning_rate};
pub use real::Real;
pub use run::{
    EpochRecord, Progress, Samples, Settings, Standardization, Stop, Trained, preset_widths, train,
};
