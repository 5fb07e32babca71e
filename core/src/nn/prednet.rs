//! PredNet: prediction of seconds from a frame's inputs.

use super::parts::{Dtype, PredNetParts, Target};
use crate::Result;
use crate::error::bail;
use crate::kernels::Executor;
use crate::kernels::mlp::{Dense, Mlp, MlpScratch};
use crate::kernels::{Level, Storage};
use crate::memory::collected;

impl From<Dtype> for Storage {
    fn from(dtype: Dtype) -> Self {
        match dtype {
            Dtype::F32 => Storage::F32,
            Dtype::F16 => Storage::F16,
            Dtype::Bf16 => Storage::Bf16,
        }
    }
}

/// Working memory of predictions, made by [`PredNet::scratch`]; one per thread.
#[derive(Clone, Debug, Default)]
pub struct PredScratch {
    mlp: MlpScratch,
}

/// A prediction network ready to run: dense layers with SELU after every layer but the last, then the inverse
/// of the target's transform (paper, section on the prediction network).
///
/// Weights are packed when the network is built. A prediction is a pure function of the inputs, the level and
/// the storage.
///
/// Nothing is cached between predictions. A cache of unchanged input groups could save at most the first
/// layer: 0.5 % of the weights of the paper's network 12C256, and tens of nanoseconds in the smallest
/// networks. The check for changed inputs would take longer. Quantities that change once per volume or
/// transfer function are cached with the scene features.
#[derive(Clone, Debug)]
pub struct PredNet {
    mlp: Mlp,
    target: Target,
    /// Mean and standard deviation of the output.
    output: (f64, f64),
}

impl PredNet {
    /// Builds the network for this CPU's best level. Weights are stored in the file's format if all layers
    /// have the same one, otherwise as F32, so that no weight is rounded.
    ///
    /// # Errors
    /// [`InvalidTensor`](crate::ErrorKind::InvalidTensor) for parts that do not fit together, values that are
    /// not finite, a standard deviation that is zero, negative or subnormal, or a weight that overflows half
    /// precision; [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the packed weights cannot be allocated.
    pub fn new(parts: &PredNetParts) -> Result<Self> {
        let format = parts.layers.first().map_or(Dtype::F32, |layer| layer.dtype);
        let same = parts.layers.iter().all(|layer| layer.dtype == format);
        Self::with(parts, Level::detect(), if same { format.into() } else { Storage::F32 })
    }

    /// Returns the upper bound of a prediction's error against a float64 evaluation of the same file.
    /// `storage` is the weights' format in memory, `file` their format in the file.
    ///
    /// If no weight is rounded ([`Storage::F32`], or the file's own format), the bound is 1e-5 of the
    /// prediction. Otherwise it is a fraction of the largest absolute prediction of all compared frames: 5e-3
    /// for [`Storage::F16`], 5e-2 for [`Storage::Bf16`], 1e-1 for [`Storage::Int8`]. The error of
    /// [`Storage::Int8`] depends on the network: measure it on your own frames first.
    pub fn tolerance(storage: Storage, file: Dtype) -> f64 {
        match storage {
            Storage::F32 => 1e-5,
            exact if exact == file.into() => 1e-5,
            Storage::F16 => 5e-3,
            Storage::Bf16 => 5e-2,
            Storage::Int8 => 1e-1,
        }
    }

    /// Builds the network for a given level and storage. A storage that is wider than the format in the file
    /// takes more memory and changes no result; a narrower storage rounds the weights.
    ///
    /// # Errors
    /// As [`PredNet::new`].
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
                        "prednet.{i}.weight[{at}] (flat index) is {}, too large for {} storage: choose \
                         another storage",
                        layer.weight[at],
                        storage.name()
                    );
                }
            }
        }
        let layers = collected(parts.layers.iter().map(|l| Dense {
            inputs: l.inputs,
            outputs: l.outputs,
            weight: &l.weight,
            bias: &l.bias,
        }))?;
        let norm = parts.input.as_ref().map(|n| (n.mean.as_slice(), n.std.as_slice()));
        let output =
            parts.output.as_ref().map_or((0.0, 1.0), |n| (f64::from(n.mean[0]), f64::from(n.std[0])));
        Ok(Self { mlp: Mlp::new(level, storage, &layers, norm)?, target: parts.target, output })
    }

    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.mlp.inputs()
    }

    /// The packed weights, for benchmarks that evict them from the caches.
    pub fn memory(&self) -> &[u8] {
        self.mlp.memory()
    }

    /// Allocates working memory for [`predict`](Self::predict) and for batches. `rows` is the number of rows
    /// that a batch processes at once, clamped to 1…384; single predictions need 1.
    ///
    /// # Errors
    /// [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the memory cannot be allocated.
    pub fn scratch(&self, rows: usize) -> Result<PredScratch> {
        Ok(PredScratch { mlp: self.mlp.scratch(rows)? })
    }

    /// Predicts one frame's time in seconds. `inputs` holds one value per [input](Self::inputs), in the
    /// model's order.
    ///
    /// The result is not clamped: it may be zero, negative (target `seconds`) or infinite. It is NaN for a
    /// NaN input (with [`Storage::Int8`], for any input that is not finite), for a wrong number of inputs,
    /// and for a scratch that is too small because another network made it. Never allocates.
    #[inline]
    pub fn predict(&self, inputs: &[f32], scratch: &mut PredScratch) -> f32 {
        match self.mlp.forward(inputs, &mut scratch.mlp) {
            Some(y) => self.seconds(y),
            None => f32::NAN,
        }
    }

    /// Predicts many frames: `inputs` holds one row of values, as for [`predict`](Self::predict), per element
    /// of `seconds`. Results equal those of [`predict`](Self::predict) up to the order of summation. The rows
    /// are split into as many parts as there are `scratches`. A row's result does not depend on the other
    /// rows, the executor or the scratches. Never allocates on success.
    ///
    /// # Errors
    /// [`SizeMismatch`](crate::ErrorKind::SizeMismatch) if the lengths disagree or a scratch of another
    /// network is too small; [`InvalidArgument`](crate::ErrorKind::InvalidArgument) if `scratches` is empty.
    pub fn predict_batch(
        &self,
        executor: Executor<'_>,
        inputs: &[f32],
        seconds: &mut [f32],
        scratches: &mut [PredScratch],
    ) -> Result<()> {
        match scratches {
            [] => bail!(InvalidArgument, "no scratch given: make one per thread with PredNet::scratch"),
            [scratch] => self.rows(inputs, seconds, scratch),
            _ => {
                let parts = scratches.len();
                let (left, right) = scratches.split_at_mut(parts / 2);
                // The left part has a multiple of six rows, so that it consists of whole tiles.
                let rows = (seconds.len() * left.len() / parts).next_multiple_of(6).min(seconds.len());
                let Some((inputs_left, inputs_right)) = inputs.split_at_checked(rows * self.inputs()) else {
                    return self.rows(inputs, seconds, &mut right[0]);
                };
                let (seconds_left, seconds_right) = seconds.split_at_mut(rows);
                let (mut first, mut second) = (Ok(()), Ok(()));
                executor.join(
                    || first = self.predict_batch(executor, inputs_left, seconds_left, left),
                    || second = self.predict_batch(executor, inputs_right, seconds_right, right),
                );
                first.and(second)
            }
        }
    }

    fn rows(&self, inputs: &[f32], seconds: &mut [f32], scratch: &mut PredScratch) -> Result<()> {
        if self.mlp.forward_rows(inputs, seconds, &mut scratch.mlp).is_none() {
            let (found, rows, each) = (inputs.len(), seconds.len(), self.inputs());
            bail!(
                SizeMismatch,
                "{found} inputs for {rows} predictions, expected {each} for each, and a scratch made by this \
                 network"
            );
        }
        for y in seconds {
            *y = self.seconds(*y);
        }
        Ok(())
    }

    /// Returns the seconds that the last layer's output `y` stands for.
    #[inline]
    fn seconds(&self, y: f32) -> f32 {
        let y = f64::from(y) * self.output.1 + self.output.0;
        match self.target {
            Target::Seconds => y as f32,
            Target::LogSeconds => libm::exp(y) as f32,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::{SELU_ALPHA, SELU_SCALE};
    use crate::nn::{DenseParts, Normalization};
    use alloc::vec;
    use alloc::vec::Vec;
    use proptest::prelude::*;

    fn parts(sizes: &[usize], target: Target, seed: u32) -> PredNetParts {
        let mut state = seed | 1;
        let mut number = || {
            state ^= state << 13;
            state ^= state >> 17;
            state ^= state << 5;
            (state >> 8) as f32 / (1 << 23) as f32 - 1.0
        };
        let mut layers = Vec::new();
        for size in sizes.windows(2) {
            let scale = 1.5 / libm::sqrtf(size[0] as f32);
            layers.push(DenseParts {
                inputs: size[0],
                outputs: size[1],
                weight: (0..size[0] * size[1]).map(|_| scale * number()).collect(),
                bias: (0..size[1]).map(|_| number()).collect(),
                dtype: Dtype::F32,
            });
        }
        let n = sizes[0];
        let input = Normalization {
            mean: (0..n).map(|_| 3.0 * number()).collect(),
            std: (0..n).map(|_| 1.5 + number()).collect(),
        };
        let output = Normalization { mean: vec![-4.0], std: vec![0.5] };
        PredNetParts { layers, input: Some(input), output: Some(output), target }
    }

    /// Reference: plain loops in float64.
    fn plain(parts: &PredNetParts, row: &[f32]) -> f64 {
        let norm = parts.input.as_ref().unwrap();
        let mut x: Vec<f64> = (0..row.len())
            .map(|i| (f64::from(row[i]) - f64::from(norm.mean[i])) / f64::from(norm.std[i]))
            .collect();
        for (i, layer) in parts.layers.iter().enumerate() {
            x = (0..layer.outputs)
                .map(|o| {
                    let weights = &layer.weight[o * layer.inputs..][..layer.inputs];
                    let dot: f64 = weights.iter().zip(&x).map(|(&w, x)| f64::from(w) * x).sum();
                    match dot + f64::from(layer.bias[o]) {
                        y if i + 1 == parts.layers.len() => y,
                        y if y > 0.0 => SELU_SCALE * y,
                        y => SELU_SCALE * SELU_ALPHA * libm::expm1(y),
                    }
                })
                .collect();
        }
        libm::exp(x[0] * 0.5 - 4.0)
    }

    /// Predicts all rows at once.
    fn predicted(net: &PredNet, inputs: &[f32], rows: usize) -> Vec<f32> {
        let mut seconds = vec![0.0; rows];
        net.predict_batch(Executor::Serial, inputs, &mut seconds, &mut [net.scratch(rows).unwrap()]).unwrap();
        seconds
    }

    /// Compares predictions of rows, one by one and all at once, with plain loops, on every level and for
    /// every storage. `tolerance` returns the largest accepted relative error for a storage and exact
    /// seconds.
    fn check_rows(sizes: &[usize], rows: usize, seed: u32, tolerance: impl Fn(Storage, f64) -> f64) {
        let parts = parts(sizes, Target::LogSeconds, seed);
        let inputs: Vec<f32> = (0..rows * sizes[0]).map(|i| (i * 7919 % 1000) as f32 / 250.0 - 2.0).collect();
        for (level, storage) in Level::available().flat_map(|level| Storage::ALL.map(|s| (level, s))) {
            let net = PredNet::with(&parts, level, storage).unwrap();
            let mut scratch = net.scratch(1).unwrap();
            let batch = predicted(&net, &inputs, rows);
            for (row, &in_batch) in inputs.chunks(sizes[0]).zip(&batch) {
                let exact = plain(&parts, row);
                for found in [net.predict(row, &mut scratch), in_batch] {
                    let error = (f64::from(found) - exact).abs() / exact;
                    let what = storage.name();
                    assert!(error <= tolerance(storage, exact), "{sizes:?} {level} {what}: {found} {exact}");
                }
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        /// Compares networks with plain loops, on every instruction set, for random layer widths and numbers
        /// of rows. Random widths use every kind of weight panel and padding.
        #[test]
        fn any_shape_agrees_with_plain_loops(
            sizes in prop::collection::vec(1usize..150, 1..5),
            rows in 1usize..23,
            seed in any::<u32>(),
        ) {
            let mut sizes = sizes;
            sizes.push(1);
            check_rows(&sizes, rows, seed, |storage, exact| {
                // Errors of rounded weights are relative to the last layer's output: the logarithm of the
                // seconds, normalized.
                let size = ((libm::log(exact) + 4.0) / 0.5).abs().max(1.0);
                let size = if storage == Storage::F32 { 1.0 } else { size };
                PredNet::tolerance(storage, Dtype::F32) * size
            });
        }
    }

    /// Compares networks that are small enough for Miri with plain loops: every storage, single rows and
    /// batches, whole and partial panels.
    #[test]
    fn small_networks_agree_with_plain_loops() {
        for (sizes, rows) in [(&[3, 5, 1][..], 2), (&[7, 17, 4, 1], 7), (&[2, 1], 1)] {
            check_rows(sizes, rows, 11, |storage, _| {
                if storage == Storage::F32 { PredNet::tolerance(storage, Dtype::F32) } else { 0.3 }
            });
        }
    }

    #[test]
    fn parts_of_a_batch_change_no_bit() {
        let parts = parts(&[16, 256, 256, 320, 192, 128, 1], Target::Seconds, 5);
        let x: Vec<f32> = (0..16 * 50).map(|i| (i % 31) as f32 * 0.1 - 1.5).collect();
        let run = |executor: Executor<'_>| {
            for level in Level::available() {
                for storage in Storage::ALL {
                    let net = PredNet::with(&parts, level, storage).unwrap();
                    let (mut parted, mut scratches) = ([0.0; 50], [(); 3].map(|()| net.scratch(9).unwrap()));
                    net.predict_batch(executor, &x, &mut parted, &mut scratches).unwrap();
                    assert_eq!(predicted(&net, &x, 50), parted, "{level}");
                }
            }
        };
        run(Executor::Serial);
        #[cfg(feature = "rayon")]
        run(Executor::Rayon(&rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap()));
    }

    #[test]
    fn weights_that_overflow_half_precision_are_refused_by_name() {
        let mut parts = parts(&[4, 8, 1], Target::Seconds, 3);
        parts.layers[1].weight[5] = 1e6;
        let error = PredNet::with(&parts, Level::detect(), Storage::F16).unwrap_err();
        assert!(error.to_string().contains("prednet.1.weight[5]"), "{error}");
        assert!(PredNet::with(&parts, Level::detect(), Storage::Bf16).is_ok());
    }

    #[test]
    fn layers_in_several_formats_are_not_rounded() {
        let mut parts = parts(&[4, 8, 8, 1], Target::LogSeconds, 3);
        let first = &mut parts.layers[0];
        first.dtype = Dtype::F16;
        first.weight.iter_mut().for_each(|w| *w = half::f16::from_f32_const(*w).to_f32_const());
        let row = [0.3, -0.7, 1.0, 0.1];
        let net = PredNet::new(&parts).unwrap();
        let exact = plain(&parts, &row);
        let found = f64::from(net.predict(&row, &mut net.scratch(1).unwrap()));
        let error = (found - exact).abs() / exact;
        assert!(error <= PredNet::tolerance(Storage::F32, Dtype::F32), "{error:e}");
        // This weight overflows half precision.
        parts.layers[1].weight[5] = 1e6;
        assert!(PredNet::new(&parts).is_ok());
    }

    #[test]
    fn a_batch_without_scratch_or_with_wrong_sizes_is_refused() {
        let net = PredNet::new(&parts(&[4, 8, 1], Target::Seconds, 3)).unwrap();
        let mut y = [0.0; 3];
        assert!(net.predict_batch(Executor::Serial, &[0.0; 12], &mut y, &mut []).is_err());
        let mut scratches = [net.scratch(1).unwrap(), net.scratch(1).unwrap()];
        assert!(net.predict_batch(Executor::Serial, &[0.0; 11], &mut y, &mut scratches).is_err());
        assert!(net.predict_batch(Executor::Serial, &[0.0; 1], &mut y, &mut scratches).is_err());
    }
}
