//! Checked weights without a memory layout: the interface between model files, training and the networks.

use crate::Result;
use crate::error::bail;
use crate::names::names;
use alloc::vec::Vec;

/// Number format in which weights are stored in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Dtype {
    /// IEEE 754 single precision.
    F32,
    /// IEEE 754 half precision.
    F16,
    /// bfloat16: the upper half of a single-precision number.
    Bf16,
}

impl Dtype {
    /// Number of bytes per stored value.
    pub(crate) const fn bytes(self) -> usize {
        match self {
            Dtype::F32 => 4,
            Dtype::F16 | Dtype::Bf16 => 2,
        }
    }
}

names! { Dtype:
    F32 "F32",
    F16 "F16",
    Bf16 "BF16",
}

/// Quantity that PredNet's last layer predicts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Target {
    /// Seconds.
    Seconds,
    /// The natural logarithm of seconds.
    LogSeconds,
}

names! { Target:
    Seconds "seconds",
    LogSeconds "log_seconds",
}

/// One dense layer: y = W·x + b.
#[derive(Clone, Debug, PartialEq)]
pub struct DenseParts {
    /// Number of inputs, which is the length of x.
    pub inputs: usize,
    /// Number of outputs, which is the length of y.
    pub outputs: usize,
    /// W, row-major: `outputs` × `inputs` values.
    pub weight: Vec<f32>,
    /// b: `outputs` values.
    pub bias: Vec<f32>,
    /// Format of W in the file; `weight` holds the stored values exactly.
    pub dtype: Dtype,
}

impl DenseParts {
    /// Checks sizes, and that every value is finite.
    ///
    /// # Errors
    /// [`InvalidTensor`](crate::ErrorKind::InvalidTensor), naming `name` and the first invalid index.
    pub(crate) fn check(&self, name: &str) -> Result<()> {
        let (inputs, outputs) = (self.inputs, self.outputs);
        let (weights, biases) = (self.weight.len(), self.bias.len());
        if inputs == 0 || outputs == 0 {
            bail!(
                InvalidTensor,
                "{name}.weight has shape [{outputs}, {inputs}]: both sizes must be at least 1"
            );
        }
        if outputs.checked_mul(inputs) != Some(weights) {
            bail!(InvalidTensor, "{name}.weight holds {weights} numbers, expected {outputs} x {inputs}");
        }
        if biases != outputs {
            bail!(InvalidTensor, "{name}.bias holds {biases} numbers, expected {outputs}");
        }
        check_finite(&self.weight, name, "weight")?;
        check_finite(&self.bias, name, "bias")
    }
}

/// Normalization of inputs, x ← (x − mean) / std, or of the output, y ← y·std + mean.
#[derive(Clone, Debug, PartialEq)]
pub struct Normalization {
    /// Mean of each normalized value.
    pub mean: Vec<f32>,
    /// Standard deviation of each value: finite, above zero and not subnormal.
    pub std: Vec<f32>,
}

impl Normalization {
    /// Checks the lengths, that every value is finite, and that every standard deviation is above zero and
    /// not subnormal.
    ///
    /// # Errors
    /// [`InvalidTensor`](crate::ErrorKind::InvalidTensor), naming `name` and the first invalid index.
    pub(crate) fn check(&self, name: &str, length: usize) -> Result<()> {
        for (part, values) in [("mean", &self.mean), ("std", &self.std)] {
            if values.len() != length {
                bail!(InvalidTensor, "{name}.{part} holds {} numbers, expected {length}", values.len());
            }
            check_finite(values, name, part)?;
        }
        // A subnormal std has no finite reciprocal.
        if let Some(i) = self.std.iter().position(|&s| s < f32::MIN_POSITIVE) {
            bail!(
                InvalidTensor,
                "{name}.std[{i}] is {}: it must be at least {:e} (drop or rescale an input that never varies)",
                self.std[i],
                f32::MIN_POSITIVE
            );
        }
        Ok(())
    }
}

fn check_finite(values: &[f32], name: &str, part: &str) -> Result<()> {
    match values.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(i) => bail!(
            InvalidTensor,
            "{name}.{part}[{i}] is {} (flat index): every number in a model must be finite",
            values[i]
        ),
    }
}

/// PredNet (paper, section on the prediction network): dense layers with SELU after every layer but the last.
#[derive(Clone, Debug, PartialEq)]
pub struct PredNetParts {
    /// The layers, first to last; the last has one output.
    pub layers: Vec<DenseParts>,
    /// Normalization of the inputs, if any.
    pub input: Option<Normalization>,
    /// The mean and the standard deviation that undo the normalization of the output; `None` if the output is
    /// in the target's unit.
    pub output: Option<Normalization>,
    /// Quantity that the network's output states.
    pub target: Target,
}

impl PredNetParts {
    /// Number of inputs; 0 if there is no layer.
    pub(crate) fn inputs(&self) -> usize {
        self.layers.first().map_or(0, |layer| layer.inputs)
    }

    /// Checks that the layers fit together and that every value is valid.
    ///
    /// # Errors
    /// [`InvalidTensor`](crate::ErrorKind::InvalidTensor), naming the tensor, the expected and the actual
    /// shape or value.
    pub(crate) fn check(&self) -> Result<()> {
        let Some(last) = self.layers.last() else {
            bail!(InvalidTensor, "PredNet has no layer: expected at least prednet.0.weight");
        };
        for (i, layer) in self.layers.iter().enumerate() {
            layer.check(&alloc::format!("prednet.{i}"))?;
            let (inputs, outputs) = (layer.inputs, layer.outputs);
            let before = if i > 0 { self.layers[i - 1].outputs } else { inputs };
            if inputs != before {
                bail!(
                    InvalidTensor,
                    "prednet.{i}.weight has shape [{outputs}, {inputs}], expected [{outputs}, {before}]: the \
                     layer before it has {before} outputs"
                );
            }
        }
        let (i, DenseParts { inputs, outputs, .. }) = (self.layers.len() - 1, last);
        if *outputs != 1 {
            bail!(
                InvalidTensor,
                "prednet.{i}.weight has shape [{outputs}, {inputs}], expected [1, {inputs}]: the last layer \
                 gives one number"
            );
        }
        if let Some(norm) = &self.input {
            norm.check("prednet.input", self.inputs())?;
        }
        if let Some(norm) = &self.output {
            norm.check("prednet.output", 1)?;
        }
        Ok(())
    }
}

/// One block of VolumeNet's encoder with batch normalization folded in: SELU(conv(x, weight) + bias).
#[derive(Clone, Debug, PartialEq)]
pub struct ConvBlockParts {
    /// Input channels.
    pub inputs: usize,
    /// Output channels.
    pub outputs: usize,
    /// Edge of the cubic kernel, in voxels.
    pub kernel: usize,
    /// Distance between neighboring outputs along each axis, in input voxels.
    pub stride: usize,
    /// Number of zero voxels added on each side of each axis.
    pub padding: usize,
    /// `outputs` × `inputs` × kernel × kernel × kernel, the last axis along x.
    pub weight: Vec<f32>,
    /// Biases: one value per output channel.
    pub bias: Vec<f32>,
    /// Edge of the cubic input, in voxels.
    pub input_edge: usize,
    /// Edge of the cubic output, in voxels: (input_edge + 2·padding − kernel) / stride + 1, rounded down.
    pub output_edge: usize,
    /// Format of the weights in the file.
    pub dtype: Dtype,
}

/// VolumeNet's encoder (paper, section on the volume network): blocks, then one dense layer without
/// activation.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeNetParts {
    /// Edge of the cubic input volume, in voxels.
    pub input: usize,
    /// The blocks, first to last; the first has one input channel.
    pub blocks: Vec<ConvBlockParts>,
    /// Dense layer from the last block's output, flattened in the order (channel, z, y, x), to the features.
    pub fc: DenseParts,
}

impl VolumeNetParts {
    pub(crate) fn features(&self) -> usize {
        self.fc.outputs
    }
}
