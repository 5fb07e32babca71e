//! VolumeNet's encoder: from a volume to a few numbers that stand for it.

use super::conv3d;
use super::parts::VolumeNetParts;
use super::{Executor, Resampler};
use crate::Result;
use crate::error::bail;
use crate::kernels::Level;
use crate::scene::VolumeView;
use alloc::vec;
use alloc::vec::Vec;

/// Largest error of [`VolumeNet::encode`]'s features against a float64 evaluation of the same weights on the same
/// volume, as a fraction of the feature vector's Euclidean norm.
pub const VOLUMENET_TOLERANCE: f64 = 1e-4;

/// Working memory of an encoding, made once by [`VolumeNet::scratch`]; one per thread that calls.
#[derive(Clone, Debug)]
pub struct EncodeScratch {
    resampler: Resampler,
    a: Vec<f32>,
    b: Vec<f32>,
}

/// The encoder, ready to run: blocks of convolution (batch normalisation folded in) and SELU, then one dense layer
/// (paper, section on the volume network). Any number of blocks, kernel edges, strides and paddings.
///
/// The input is the volume mapped to [0, 1] over its range, resampled to a cube of [`input_size`](Self::input_size)³
/// voxels (see [`Resampler`]) and mapped to [-1, 1]; its axes are (D, H, W) = (z, y, x).
#[derive(Clone, Debug)]
pub struct VolumeNet {
    parts: VolumeNetParts,
    level: Level,
}

impl VolumeNet {
    /// Builds the network for this CPU's best level.
    ///
    /// # Errors
    /// [`InvalidTensor`](crate::ErrorKind::InvalidTensor) where blocks do not fit together.
    pub fn new(parts: &VolumeNetParts) -> Result<Self> {
        Self::with(parts, Level::detect())
    }

    /// Builds the network for a given level.
    ///
    /// # Errors
    /// As [`VolumeNet::new`].
    pub fn with(parts: &VolumeNetParts, level: Level) -> Result<Self> {
        check(parts)?;
        Ok(Self { parts: parts.clone(), level })
    }

    /// Edge of the cubic input, in voxels.
    pub fn input_size(&self) -> usize {
        self.parts.input
    }

    /// Number of features.
    pub fn feature_len(&self) -> usize {
        self.parts.fc.outputs
    }

    /// The level the network was built for.
    pub fn level(&self) -> Level {
        self.level
    }

    /// Working memory for [`encode`](Self::encode).
    pub fn scratch(&self) -> EncodeScratch {
        EncodeScratch { resampler: Resampler::new(self.level), a: Vec::new(), b: Vec::new() }
    }

    /// Writes the volume's features to `features`.
    ///
    /// The same volume, range, network and level give the same bits, whatever the executor. Allocates only where the
    /// volume's rows are longer or the executor has more threads than in every earlier call with this scratch.
    ///
    /// # Errors
    /// [`SizeMismatch`](crate::ErrorKind::SizeMismatch) unless `features` holds [`feature_len`](Self::feature_len)
    /// numbers; [`InvalidArgument`](crate::ErrorKind::InvalidArgument) for a volume that [`Resampler::resample`] refuses.
    pub fn encode(
        &self,
        view: &VolumeView<'_>,
        scratch: &mut EncodeScratch,
        executor: Executor<'_>,
        features: &mut [f32],
    ) -> Result<()> {
        let (n, fc) = (self.parts.input, &self.parts.fc);
        if features.len() != fc.outputs {
            bail!(
                SizeMismatch,
                "VolumeNet gives {} features, the output holds {} numbers",
                fc.outputs,
                features.len()
            );
        }
        scratch.a.resize(n * n * n, 0.0);
        scratch.resampler.resample(view, n, &mut scratch.a, executor)?;
        for v in &mut scratch.a {
            *v = 2.0 * *v - 1.0;
        }
        for block in &self.parts.blocks {
            conv3d::reference(block, &scratch.a, &mut scratch.b);
            core::mem::swap(&mut scratch.a, &mut scratch.b);
        }
        for (f, (row, bias)) in features.iter_mut().zip(fc.weight.chunks_exact(fc.inputs).zip(&fc.bias)) {
            let sum: f64 = row.iter().zip(&scratch.a).map(|(&w, &x)| f64::from(w) * f64::from(x)).sum();
            *f = (sum + f64::from(*bias)) as f32;
        }
        Ok(())
    }
}

fn check(parts: &VolumeNetParts) -> Result<()> {
    let (mut edge, mut channels) = (parts.input, 1usize);
    if edge == 0 {
        bail!(InvalidTensor, "VolumeNet's input edge is 0: it must be at least 1 voxel");
    }
    if parts.blocks.is_empty() {
        bail!(InvalidTensor, "VolumeNet has no block: expected at least volumenet.encoder.0.conv.weight");
    }
    for (i, block) in parts.blocks.iter().enumerate() {
        let name = alloc::format!("volumenet.encoder.{i}.conv");
        if block.inputs != channels || block.outputs == 0 || block.input_edge != edge {
            bail!(
                InvalidTensor,
                "{name}: {} channels of edge {} in, {} out; the layer before gives {channels} channels of edge {edge}",
                block.inputs,
                block.input_edge,
                block.outputs
            );
        }
        let padded = block.padding.checked_mul(2).and_then(|p| p.checked_add(edge));
        let output = match padded {
            Some(padded) if block.stride > 0 && (1..=padded).contains(&block.kernel) => {
                (padded - block.kernel) / block.stride + 1
            }
            _ => 0,
        };
        if output == 0 || output != block.output_edge {
            bail!(
                InvalidTensor,
                "{name}: kernel {}, stride {}, padding {} on an edge of {edge} give an edge of {output}, not {}",
                block.kernel,
                block.stride,
                block.padding,
                block.output_edge
            );
        }
        let wanted = [block.outputs, block.inputs, block.kernel, block.kernel, block.kernel]
            .iter()
            .try_fold(1usize, |product, &n| product.checked_mul(n));
        if wanted != Some(block.weight.len()) || block.bias.len() != block.outputs {
            bail!(
                InvalidTensor,
                "{name}: {} weights and {} biases do not fit {} x {} x {}³",
                block.weight.len(),
                block.bias.len(),
                block.outputs,
                block.inputs,
                block.kernel
            );
        }
        (edge, channels) = (output, block.outputs);
    }
    let flat = edge.checked_mul(edge).and_then(|e| e.checked_mul(edge)).and_then(|e| e.checked_mul(channels));
    if flat != Some(parts.fc.inputs) {
        bail!(
            InvalidTensor,
            "volumenet.fc.weight takes {} numbers, the last block gives {channels} x {edge}³",
            parts.fc.inputs
        );
    }
    parts.fc.check("volumenet.fc")
}
