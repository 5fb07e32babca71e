//! Runs one row of inputs through the layers, as matrix-vector products.

use super::int8::{panel_row_int8, quantize};
use super::packing::Layer;
use super::weights::{AsBf16, AsF16, AsF32, Format};
use super::{Mlp, MlpScratch, Storage};
use crate::kernels::simd::{Kernel, Simd};

/// Multiplies one row by one panel of `N` outputs: y = SELU(W·x + b).
///
/// # Safety
/// `panel` must be the packed panel (biases first), `x` must hold `inputs` floats, and `y` must hold `N`
/// floats.
#[inline(always)]
unsafe fn panel_row<S: Simd, W: Format, const N: usize>(
    simd: S,
    panel: *const f32,
    inputs: usize,
    x: *const f32,
    y: *mut f32,
) {
    // Eight vectors of sums: `vectors` vectors of outputs × `pairs` pairs of inputs × 2, since the even and
    // the odd input of a pair have separate sums.
    let vectors = if N / S::LANES < 4 { N / S::LANES } else { 4 };
    let pairs = 4 / vectors;
    let mut from = 0;
    while from < N {
        // SAFETY: the caller guarantees the sizes of the buffers. All offsets stay below `inputs`·N in the
        // weights, below `inputs` in `x`, and below N in the biases and `y`; `inputs` is a multiple of 8 =
        // 2·max(pairs).
        unsafe {
            let weights = panel.add(N);
            let zero = simd.splat(0.0);
            let bias = |j: usize| if j < vectors { simd.load(panel.add(from + j * S::LANES)) } else { zero };
            let (mut e0, mut e1, mut e2, mut e3) = (bias(0), bias(1), bias(2), bias(3));
            let (mut o0, mut o1, mut o2, mut o3) = (zero, zero, zero, zero);
            let mut k = 0;
            while k < inputs {
                macro_rules! step {
                    ($j:literal, $even:ident, $odd:ident) => {
                        let at = k + 2 * ($j / vectors);
                        let (even, odd) = W::pair(simd, weights, N, at, from + $j % vectors * S::LANES);
                        $even = simd.mul_add(even, simd.splat(*x.add(at)), $even);
                        $odd = simd.mul_add(odd, simd.splat(*x.add(at + 1)), $odd);
                    };
                }
                step!(0, e0, o0);
                step!(1, e1, o1);
                step!(2, e2, o2);
                step!(3, e3, o3);
                k += 2 * pairs;
            }
            let (mut s0, mut s1, s2, s3) =
                (simd.add(e0, o0), simd.add(e1, o1), simd.add(e2, o2), simd.add(e3, o3));
            if vectors == 2 {
                s0 = simd.add(s0, s2);
                s1 = simd.add(s1, s3);
            }
            if vectors == 1 {
                s0 = simd.add(simd.add(s0, s1), simd.add(s2, s3));
            }
            simd.store(y.add(from), simd.selu(s0));
            if vectors > 1 {
                simd.store(y.add(from + S::LANES), simd.selu(s1));
            }
            if vectors > 2 {
                simd.store(y.add(from + 2 * S::LANES), simd.selu(s2));
                simd.store(y.add(from + 3 * S::LANES), simd.selu(s3));
            }
        }
        from += vectors * S::LANES;
    }
}

pub(super) struct Forward<'a, const INT8: bool> {
    pub(super) net: &'a Mlp,
    pub(super) inputs: &'a [f32],
    pub(super) scratch: &'a mut MlpScratch,
}

impl<const INT8: bool> Kernel for Forward<'_, INT8> {
    type Output = f32;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> f32 {
        let Self { net, inputs, scratch } = self;
        let mut x: *mut f32 = scratch.a.as_mut_ptr().cast();
        let mut y: *mut f32 = scratch.b.as_mut_ptr().cast();
        let q: *mut u8 = scratch.quantized.as_mut_ptr().cast();
        // SAFETY: `fits` has checked that `a` and `b` hold the inputs and outputs of the widest layer, padded
        // to 16 floats, and `quantized` its inputs, padded to 32 bytes. Packing has laid out the panels in
        // the order of the loops below.
        unsafe {
            net.load_inputs(simd, inputs, x);
            for layer in &net.layers {
                net.layer_row::<S, INT8>(simd, layer, x, q, y);
                core::mem::swap(&mut x, &mut y);
            }
            net.last_row(simd, x)
        }
    }
}

impl Mlp {
    /// Copies one row of inputs, normalizes it, and zeroes the padding after it.
    ///
    /// # Safety
    /// `inputs` must have the network's number of inputs; `x` must hold this number of floats, padded to 16.
    #[inline(always)]
    pub(super) unsafe fn load_inputs<S: Simd>(&self, simd: S, inputs: &[f32], x: *mut f32) {
        let padded = self.inputs.next_multiple_of(16);
        // SAFETY: the caller guarantees that `x` holds `padded` floats; `norm` is empty or holds `padded`
        // means and as many reciprocals.
        unsafe {
            core::ptr::copy_nonoverlapping(inputs.as_ptr(), x, self.inputs);
            for i in self.inputs..padded {
                *x.add(i) = 0.0;
            }
            if !self.norm.is_empty() {
                let mean: *const f32 = self.norm.as_ptr().cast();
                for i in (0..padded).step_by(S::LANES) {
                    let centered = simd.sub(simd.load(x.add(i)), simd.load(mean.add(i)));
                    simd.store(x.add(i), simd.mul(centered, simd.load(mean.add(padded + i))));
                }
            }
        }
    }

    /// Computes one layer for one row.
    ///
    /// # Safety
    /// `x` must hold the layer's padded inputs, `y` its padded outputs, and `q` (int8 only) one byte per
    /// padded input.
    #[inline(always)]
    unsafe fn layer_row<S: Simd, const INT8: bool>(
        &self,
        simd: S,
        layer: &Layer,
        x: *const f32,
        q: *mut u8,
        y: *mut f32,
    ) {
        macro_rules! walk {
            ($panel:ident, $($arg:tt)*) => {{
                // SAFETY: panels are contiguous in `data`; the caller guarantees the sizes of `x`, `y` and
                // `q` for this layer.
                unsafe {
                    let mut panel = self.data.as_ptr().add(layer.start).cast::<f32>();
                    let mut o = 0;
                    while layer.width - o >= 64 {
                        walk!(@ $panel, 64, panel, y.add(o), $($arg)*);
                        panel = panel.add(layer.panel_lines(64) * 16);
                        o += 64;
                    }
                    if layer.width - o >= 32 {
                        walk!(@ $panel, 32, panel, y.add(o), $($arg)*);
                        panel = panel.add(layer.panel_lines(32) * 16);
                        o += 32;
                    }
                    if layer.width - o >= 16 {
                        walk!(@ $panel, 16, panel, y.add(o), $($arg)*);
                    }
                }
            }};
            (@ panel_row, $n:literal, $p:ident, $y:expr, $format:ty) => {
                panel_row::<S, $format, $n>(simd, $p, layer.inputs, x, $y)
            };
            (@ panel_row_int8, $n:literal, $p:ident, $y:expr, $range:ident) => {
                panel_row_int8::<S, $n>(simd, $p, layer.inputs, q, $range, $y)
            };
        }
        // In an int8 network the first and the last layer are F32, all other layers Int8.
        match layer.storage {
            Storage::F32 => walk!(panel_row, AsF32),
            Storage::F16 if !INT8 => walk!(panel_row, AsF16),
            Storage::Bf16 if !INT8 => walk!(panel_row, AsBf16),
            _ if !INT8 => {}
            _ => {
                // The bytes of `q` at index `filled` and above are multiplied by weights that are zero.
                // SAFETY: the caller guarantees that `x` and `q` have room for `layer.inputs` elements, the
                // padded number of inputs. This number is at least `filled`.
                let range = unsafe { quantize(simd, x, layer.filled, q) };
                walk!(panel_row_int8, range);
            }
        }
    }

    /// Computes the last layer for one row.
    ///
    /// # Safety
    /// `x` must hold the layer's inputs padded to 16.
    #[inline(always)]
    pub(super) unsafe fn last_row<S: Simd>(&self, simd: S, x: *const f32) -> f32 {
        let (inputs, start) = self.last;
        let padded = inputs.next_multiple_of(16);
        // SAFETY: the weights and `x` are padded to 16 floats, a multiple of `LANES`.
        unsafe {
            let row = self.data.as_ptr().add(start).cast::<f32>();
            let mut sum = simd.splat(0.0);
            let mut i = 0;
            while i < padded {
                sum = simd.mul_add(simd.load(row.add(i)), simd.load(x.add(i)), sum);
                i += S::LANES;
            }
            simd.sum(sum) + self.last_bias
        }
    }
}
