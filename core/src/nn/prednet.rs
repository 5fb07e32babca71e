//! PredNet: from a frame's inputs to seconds.

use super::parts::{Dtype, PredNetParts, Target};
use super::{SELU_ALPHA, SELU_SCALE};
use crate::Result;
use crate::error::bail;
use crate::kernels::Level;
use alloc::vec;
use alloc::vec::Vec;

/// Largest relative error of [`PredNet::predict`] with [`Storage::F32`] against a float64 evaluation of the same
/// weights.
pub const PREDNET_F32_TOLERANCE: f64 = 1e-5;

/// How a network keeps its weights in memory; activations and sums are f32 throughout.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Storage {
    /// Single precision.
    F32,
    /// Half precision, widened when it is used.
    F16,
    /// bfloat16, widened when it is used.
    Bf16,
}

impl From<Dtype> for Storage {
    fn from(dtype: Dtype) -> Self {
        match dtype {
            Dtype::F32 => Storage::F32,
            Dtype::F16 => Storage::F16,
            Dtype::Bf16 => Storage::Bf16,
        }
    }
}

/// Working memory of a prediction, made once by [`PredNet::scratch`]; one per thread.
#[derive(Clone, Debug, Default)]
pub struct PredScratch {
    a: Vec<f32>,
    b: Vec<f32>,
}

/// A prediction network ready to run: dense layers with SELU after every layer but the last, then the target's
/// transform (paper, section on the prediction network).
#[derive(Clone, Debug)]
pub struct PredNet {
    parts: PredNetParts,
    level: Level,
    storage: Storage,
}

impl PredNet {
    /// Builds the network for this CPU's best level, weights stored as the file stores its first layer's.
    ///
    /// # Errors
    ///
    /// As [`PredNetParts::check`].
    pub fn new(parts: &PredNetParts) -> Result<Self> {
        let storage = parts.layers.first().map_or(Storage::F32, |layer| layer.dtype.into());
        Self::with(parts, Level::detect(), storage)
    }

    /// Builds the network for a given level and storage.
    ///
    /// # Errors
    ///
    /// As [`PredNetParts::check`].
    pub fn with(parts: &PredNetParts, level: Level, storage: Storage) -> Result<Self> {
        parts.check()?;
        Ok(Self { parts: parts.clone(), level, storage })
    }

    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.parts.inputs()
    }

    /// The level the network was built for.
    pub fn level(&self) -> Level {
        self.level
    }

    /// How the weights are kept.
    pub fn storage(&self) -> Storage {
        self.storage
    }

    /// What the raw output stands for.
    pub fn target(&self) -> Target {
        self.parts.target
    }

    /// Working memory for [`predict`](Self::predict) and [`predict_batch`](Self::predict_batch).
    pub fn scratch(&self) -> PredScratch {
        let widest = self.parts.layers.iter().map(|layer| layer.inputs.max(layer.outputs)).max().unwrap_or(0);
        PredScratch { a: vec![0.0; widest], b: vec![0.0; widest] }
    }

    /// Predicts one frame's time in seconds from [`inputs`](Self::inputs) numbers in the model's order.
    ///
    /// The result is the network's own: it may be zero, negative (target `seconds`) or infinite. NaN in, NaN out; a
    /// wrong number of inputs or another network's scratch gives NaN as well. Never allocates.
    pub fn predict(&self, inputs: &[f32], scratch: &mut PredScratch) -> f32 {
        if inputs.len() != self.inputs() {
            return f32::NAN;
        }
        let (mut x, mut y) = (&mut scratch.a, &mut scratch.b);
        let Some(first) = x.get_mut(..inputs.len()) else { return f32::NAN };
        first.copy_from_slice(inputs);
        if let Some(norm) = &self.parts.input {
            for (x, (mean, std)) in first.iter_mut().zip(norm.mean.iter().zip(&norm.std)) {
                *x = (*x - mean) / std;
            }
        }
        for (i, layer) in self.parts.layers.iter().enumerate() {
            if x.len() < layer.inputs || y.len() < layer.outputs {
                return f32::NAN;
            }
            for ((y, row), bias) in y.iter_mut().zip(layer.weight.chunks_exact(layer.inputs)).zip(&layer.bias)
            {
                let sum: f32 = row.iter().zip(x.iter()).map(|(w, x)| w * x).sum();
                let v = sum + bias;
                *y = if i + 1 == self.parts.layers.len() { v } else { selu(v) };
            }
            core::mem::swap(&mut x, &mut y);
        }
        self.seconds(x[0])
    }

    /// Predicts many frames: `inputs` holds one row of [`inputs`](Self::inputs) numbers per element of `seconds`.
    /// Rows are as in [`predict`](Self::predict), up to rounding. Never allocates on success.
    ///
    /// # Errors
    ///
    /// [`SizeMismatch`](crate::ErrorKind::SizeMismatch) when the lengths disagree.
    pub fn predict_batch(
        &self,
        inputs: &[f32],
        seconds: &mut [f32],
        scratch: &mut PredScratch,
    ) -> Result<()> {
        if self.inputs().checked_mul(seconds.len()) != Some(inputs.len()) {
            bail!(
                SizeMismatch,
                "{} inputs for {} predictions, expected {} for each",
                inputs.len(),
                seconds.len(),
                self.inputs()
            );
        }
        for (row, out) in inputs.chunks_exact(self.inputs()).zip(seconds) {
            *out = self.predict(row, scratch);
        }
        Ok(())
    }

    /// From the last layer's output to seconds.
    fn seconds(&self, y: f32) -> f32 {
        let mut y = f64::from(y);
        if let Some(norm) = &self.parts.output {
            y = y * f64::from(norm.std[0]) + f64::from(norm.mean[0]);
        }
        match self.parts.target {
            Target::Seconds => y as f32,
            Target::LogSeconds => libm::exp(y) as f32,
        }
    }
}

fn selu(x: f32) -> f32 {
    if x > 0.0 { SELU_SCALE as f32 * x } else { (SELU_SCALE * SELU_ALPHA) as f32 * libm::expm1f(x) }
}
