//! Storage formats, and packing of a layer into panels.

use crate::Result;
use crate::memory::resize;
use crate::names::names;
use alloc::vec::Vec;
use bytemuck::{Pod, Zeroable};

/// Format in which a network keeps its weights in memory. Sums and activations are f32 throughout, except
/// with [`Int8`](Storage::Int8).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Storage {
    /// Single precision.
    F32,
    /// Half precision, widened to f32 on use.
    F16,
    /// bfloat16, widened to f32 on use.
    Bf16,
    /// Signed bytes with one scale per output. A layer's inputs are quantized at each call to unsigned bytes
    /// with a scale and a zero point; sums are exact 32-bit integers. The first and the last layer stay F32.
    Int8,
}

names! { Storage:
    F32 "f32",
    F16 "f16",
    Bf16 "bf16",
    Int8 "int8",
}

/// One cache line.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C, align(64))]
pub(crate) struct Line([f32; 16]);

pub(super) const LINE_BYTES: usize = size_of::<Line>();

/// Sizes of the panels that cover `width` outputs (a multiple of 16), in order.
pub(super) fn panels(width: usize) -> impl Iterator<Item = usize> {
    core::iter::repeat_n(64, width / 64).chain([32, 16].into_iter().filter(move |n| (width % 64) & n != 0))
}

/// One dense layer followed by SELU.
#[derive(Clone, Debug)]
pub(super) struct Layer {
    pub(super) storage: Storage,
    /// Number of inputs, padded with zero weights to a multiple of 8 (with [`Storage::Int8`]: of 32).
    pub(super) inputs: usize,
    /// Number of inputs padded to a multiple of 16: the number of values that the previous layer writes.
    pub(super) filled: usize,
    /// Number of outputs, padded to a multiple of 16.
    pub(super) width: usize,
    /// Index of the first panel's first cache line.
    pub(super) start: usize,
}

impl Layer {
    /// Number of lines of one panel of `n` outputs.
    pub(super) fn panel_lines(&self, n: usize) -> usize {
        let weights = self.inputs * n;
        let (numbers, bytes) = match self.storage {
            Storage::F32 => (n, weights * 4),
            Storage::F16 | Storage::Bf16 => (n, weights * 2),
            Storage::Int8 => (3 * n, weights),
        };
        (numbers * 4 + bytes) / LINE_BYTES
    }

    pub(super) fn lines(&self) -> usize {
        panels(self.width).map(|n| self.panel_lines(n)).sum()
    }
}

/// Row-major weights, and biases, of one layer before packing.
pub(crate) struct Dense<'a> {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    pub(crate) weight: &'a [f32],
    pub(crate) bias: &'a [f32],
}

/// Appends the panels of one layer to `data`.
///
/// # Errors
/// [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the panels cannot be allocated.
pub(super) fn pack(layer: &Dense<'_>, storage: Storage, data: &mut Vec<Line>) -> Result<Layer> {
    let pad = if storage == Storage::Int8 { 32 } else { 8 };
    let packed = Layer {
        storage,
        inputs: layer.inputs.next_multiple_of(pad),
        filled: layer.inputs.next_multiple_of(16),
        width: layer.outputs.next_multiple_of(16),
        start: data.len(),
    };
    resize(data, packed.start + packed.lines(), Line::default())?;
    let at = |o: usize, k: usize| {
        if o < layer.outputs && k < layer.inputs { layer.weight[o * layer.inputs + k] } else { 0.0 }
    };
    let (mut line, mut first) = (packed.start, 0);
    for n in panels(packed.width) {
        let end = line + packed.panel_lines(n);
        let numbers: &mut [f32] = bytemuck::cast_slice_mut(&mut data[line..end]);
        let (bias, rest) = numbers.split_at_mut(n);
        for (o, b) in bias.iter_mut().enumerate() {
            *b = layer.bias.get(first + o).copied().unwrap_or(0.0);
        }
        match storage {
            Storage::F32 => {
                for (k, row) in rest.chunks_exact_mut(n).enumerate() {
                    row.iter_mut().enumerate().for_each(|(o, w)| *w = at(first + o, k));
                }
            }
            Storage::F16 => {
                for (k, row) in bytemuck::cast_slice_mut::<_, u16>(rest).chunks_exact_mut(n).enumerate() {
                    row.iter_mut().enumerate().for_each(|(o, w)| {
                        *w = half::f16::from_f32_const(at(first + o, k)).to_bits();
                    });
                }
            }
            Storage::Bf16 => {
                // One word per output and pair of inputs, the even input in the lower half.
                for (k, row) in bytemuck::cast_slice_mut::<_, u32>(rest).chunks_exact_mut(n).enumerate() {
                    let bits = |o, k| u32::from(half::bf16::from_f32_const(at(first + o, k)).to_bits());
                    row.iter_mut().enumerate().for_each(|(o, w)| {
                        *w = bits(o, 2 * k) | bits(o, 2 * k + 1) << 16;
                    });
                }
            }
            Storage::Int8 => {
                let (scales, rest) = rest.split_at_mut(n);
                let (sums, rest) = rest.split_at_mut(n);
                let weights: &mut [i8] = bytemuck::cast_slice_mut(rest);
                for o in 0..n {
                    let row = |k| at(first + o, k);
                    let largest = (0..layer.inputs).fold(0.0f32, |m, k| m.max(row(k).abs()));
                    let scale = largest / 127.0;
                    let inverse = if scale >= f32::MIN_POSITIVE { 1.0 / f64::from(scale) } else { 0.0 };
                    let mut sum = 0;
                    for k in 0..packed.inputs {
                        let w = libm::rint(f64::from(row(k)) * inverse) as i8;
                        sum += i32::from(w);
                        weights[(k / 4 * n + o) * 4 + k % 4] = w;
                    }
                    scales[o] = scale;
                    sums[o] = sum as f32 * scale;
                }
            }
        }
        line = end;
        first += n;
    }
    Ok(packed)
}
