//! PredNet: from a frame's inputs to seconds.

use super::parts::{Dtype, PredNetParts, Target};
use crate::Result;
use crate::error::bail;
use crate::kernels::Executor;
use crate::kernels::mlp::{Dense, Mlp, MlpScratch};
use crate::kernels::{Level, Storage};
use alloc::vec::Vec;

/// Largest relative error of [`PredNet::predict`] against a float64 evaluation of the same stored weights: for
/// [`Storage::F32`], and for [`Storage::F16`] and [`Storage::Bf16`] where the file stores its weights so.
pub const PREDNET_F32_TOLERANCE: f64 = 1e-5;
/// Largest error of [`Storage::F16`] on a network whose file holds F32, relative to the largest output over the inputs.
pub const PREDNET_F16_TOLERANCE: f64 = 5e-3;
/// Largest error of [`Storage::Bf16`] on a network whose file holds F32, relative to the largest output over the inputs.
pub const PREDNET_BF16_TOLERANCE: f64 = 5e-2;
/// Largest error of [`Storage::Int8`], relative to the largest output over the inputs. Judge it on frames of your own
/// before choosing it: it depends on the network.
pub const PREDNET_INT8_TOLERANCE: f64 = 1e-1;

impl From<Dtype> for Storage {
    fn from(dtype: Dtype) -> Self {
        match dtype {
            Dtype::F32 => Storage::F32,
            Dtype::F16 => Storage::F16,
            Dtype::Bf16 => Storage::Bf16,
        }
    }
}

/// Working memory of predictions, made by [`PredNet::scratch`] or [`PredNet::batch_scratch`]; one per thread.
#[derive(Clone, Debug, Default)]
pub struct PredScratch {
    mlp: MlpScratch,
}

impl PredScratch {
    /// Rows that a batch works on at once.
    pub fn rows(&self) -> usize {
        self.mlp.rows()
    }
}

/// A prediction network ready to run: dense layers with SELU after every layer but the last, then the target's
/// transform (paper, section on the prediction network).
///
/// Weights are packed when it is built. A prediction is a pure function of the inputs, the level and the storage.
#[derive(Clone, Debug)]
pub struct PredNet {
    mlp: Mlp,
    storage: Storage,
    target: Target,
    /// Mean and std of the output.
    output: (f64, f64),
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

    /// Builds the network with another storage than the file's. Storing wider than the file costs memory and changes
    /// nothing; storing narrower rounds the weights.
    ///
    /// # Errors
    ///
    /// As [`with`](Self::with).
    pub fn with_storage(parts: &PredNetParts, storage: Storage) -> Result<Self> {
        Self::with(parts, Level::detect(), storage)
    }

    /// Builds the network for a given level and storage.
    ///
    /// # Errors
    ///
    /// As [`PredNetParts::check`]; [`InvalidTensor`](crate::ErrorKind::InvalidTensor) when a weight overflows half
    /// precision.
    pub fn with(parts: &PredNetParts, level: Level, storage: Storage) -> Result<Self> {
        parts.check()?;
        if matches!(storage, Storage::F16 | Storage::Bf16) {
            let finite = |w: f32| match storage {
                Storage::F16 => half::f16::from_f32_const(w).is_finite(),
                _ => half::bf16::from_f32_const(w).is_finite(),
            };
            for (i, layer) in parts.layers.iter().enumerate() {
                if let Some(at) = layer.weight.iter().position(|&w| !finite(w)) {
                    bail!(
                        InvalidTensor,
                        "prednet.{i}.weight[{at}] (flat index) is {}, too large for {} storage: choose another storage",
                        layer.weight[at],
                        storage.name()
                    );
                }
            }
        }
        let layers: Vec<_> = parts
            .layers
            .iter()
            .map(|l| Dense { inputs: l.inputs, outputs: l.outputs, weight: &l.weight, bias: &l.bias })
            .collect();
        let norm = parts.input.as_ref().map(|n| (n.mean.as_slice(), n.std.as_slice()));
        let output =
            parts.output.as_ref().map_or((0.0, 1.0), |n| (f64::from(n.mean[0]), f64::from(n.std[0])));
        Ok(Self { mlp: Mlp::new(level, storage, &layers, norm), storage, target: parts.target, output })
    }

    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.mlp.inputs()
    }

    /// The level the network was built for.
    pub fn level(&self) -> Level {
        self.mlp.level()
    }

    /// How the weights are kept.
    pub fn storage(&self) -> Storage {
        self.storage
    }

    /// What the raw output stands for.
    pub fn target(&self) -> Target {
        self.target
    }

    /// Bytes of weights that one prediction reads.
    pub fn bytes(&self) -> usize {
        self.mlp.bytes()
    }

    /// The packed weights as they lie in memory, for benchmarks that evict them from the caches.
    pub fn memory(&self) -> &[u8] {
        self.mlp.memory()
    }

    /// Working memory for [`predict`](Self::predict). [`predict_batch`](Self::predict_batch) works with it too, row
    /// by row.
    pub fn scratch(&self) -> PredScratch {
        self.batch_scratch(1)
    }

    /// Working memory for batches; `rows` is how many rows are worked on at once, at most 384 are used.
    pub fn batch_scratch(&self, rows: usize) -> PredScratch {
        PredScratch { mlp: self.mlp.scratch(rows) }
    }

    /// Predicts one frame's time in seconds from [`inputs`](Self::inputs) numbers in the model's order.
    ///
    /// The result is the network's own: it may be zero, negative (target `seconds`) or infinite. NaN in, NaN out
    /// (with [`Storage::Int8`], anything not finite in, NaN out); a wrong number of inputs or another network's scratch
    /// gives NaN as well. Never allocates.
    #[inline]
    pub fn predict(&self, inputs: &[f32], scratch: &mut PredScratch) -> f32 {
        match self.mlp.forward(inputs, &mut scratch.mlp) {
            Some(y) => self.seconds(y),
            None => f32::NAN,
        }
    }

    /// As [`predict`](Self::predict), each large layer split between the caller and one more thread: same bits. Worth it
    /// where the weights outgrow one core's cache and the executor is a [`Helper`](super::Helper); a pool's hand-over
    /// takes longer than it saves. A helper adds no allocation, lock or system call.
    pub fn predict_on(&self, executor: Executor<'_>, inputs: &[f32], scratch: &mut PredScratch) -> f32 {
        match self.mlp.forward_split(&executor, inputs, &mut scratch.mlp) {
            Some(y) => self.seconds(y),
            None => f32::NAN,
        }
    }

    /// As [`predict_batch`](Self::predict_batch), the rows split over as many parts as there are `scratches`: same bits.
    ///
    /// # Errors
    ///
    /// As [`predict_batch`](Self::predict_batch), and [`InvalidArgument`](crate::ErrorKind::InvalidArgument) without any
    /// scratch.
    pub fn predict_batch_on(
        &self,
        executor: Executor<'_>,
        inputs: &[f32],
        seconds: &mut [f32],
        scratches: &mut [PredScratch],
    ) -> Result<()> {
        match scratches {
            [] => bail!(InvalidArgument, "no scratch given: make one per thread with batch_scratch"),
            [scratch] => self.predict_batch(inputs, seconds, scratch),
            _ => {
                let parts = scratches.len();
                let (left, right) = scratches.split_at_mut(parts / 2);
                // Whole tiles of six rows on the left.
                let rows = (seconds.len() * left.len() / parts).next_multiple_of(6).min(seconds.len());
                let Some((inputs_left, inputs_right)) = inputs.split_at_checked(rows * self.inputs()) else {
                    return self.predict_batch(inputs, seconds, &mut right[0]);
                };
                let (seconds_left, seconds_right) = seconds.split_at_mut(rows);
                let (mut first, mut second) = (Ok(()), Ok(()));
                executor.join(
                    || first = self.predict_batch_on(executor, inputs_left, seconds_left, left),
                    || second = self.predict_batch_on(executor, inputs_right, seconds_right, right),
                );
                first.and(second)
            }
        }
    }

    /// Predicts many frames: `inputs` holds one row of [`inputs`](Self::inputs) numbers per element of `seconds`.
    /// Rows are as in [`predict`](Self::predict), up to the order of summation; a row's result does not depend on the
    /// others, nor on the scratch's size. Never allocates on success.
    ///
    /// # Errors
    ///
    /// [`SizeMismatch`](crate::ErrorKind::SizeMismatch) when the lengths disagree or the scratch is another network's.
    pub fn predict_batch(
        &self,
        inputs: &[f32],
        seconds: &mut [f32],
        scratch: &mut PredScratch,
    ) -> Result<()> {
        if self.mlp.forward_rows(inputs, seconds, &mut scratch.mlp).is_none() {
            bail!(
                SizeMismatch,
                "{} inputs for {} predictions, expected {} for each, and a scratch made by this network",
                inputs.len(),
                seconds.len(),
                self.inputs()
            );
        }
        for y in seconds {
            *y = self.seconds(*y);
        }
        Ok(())
    }

    /// From the last layer's output to seconds.
    #[inline]
    fn seconds(&self, y: f32) -> f32 {
        let y = f64::from(y) * self.output.1 + self.output.0;
        match self.target {
            Target::Seconds => y as f32,
            Target::LogSeconds => libm::exp(y) as f32,
        }
    }
}
