//! Runs batches of rows through the layers, as matrix-matrix products in tiles of up to six rows.

use super::int8::{quantize, tile_int8};
use super::packing::{Layer, panels};
use super::weights::{AsBf16, AsF16, widen};
use super::{Mlp, MlpScratch, Storage};
use crate::kernels::simd::{Kernel, Simd};

/// Largest number of rows per tile; the sums of a tile fit into the registers of every level.
const TILE_ROWS: usize = 6;

pub(super) struct ForwardRows<'a, const INT8: bool> {
    pub(super) net: &'a Mlp,
    pub(super) inputs: &'a [f32],
    pub(super) outputs: &'a mut [f32],
    pub(super) scratch: &'a mut MlpScratch,
}

impl<const INT8: bool> Kernel for ForwardRows<'_, INT8> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { net, inputs, outputs, scratch } = self;
        let (rows, stride) = (outputs.len(), net.width);
        let mut x: *mut f32 = scratch.a.as_mut_ptr().cast();
        let mut y: *mut f32 = scratch.b.as_mut_ptr().cast();
        let q: *mut u8 = scratch.quantized.as_mut_ptr().cast();
        let wide: *mut f32 = scratch.panel.as_mut_ptr().cast();
        // SAFETY: the batch has at most `scratch.rows` rows. `fits` has checked that `panel` holds the
        // largest panel, that `a` and `b` hold `scratch.rows` rows of `stride` floats, and that `quantized`
        // holds as many rows of `stride` bytes, padded to 32.
        unsafe {
            for (r, row) in inputs.chunks_exact(net.inputs).enumerate() {
                net.load_inputs(simd, row, x.add(r * stride));
            }
            for layer in &net.layers {
                net.layer_rows::<S, INT8>(
                    simd,
                    layer,
                    Rows { count: rows, stride, x, y, q, wide },
                    &mut scratch.ranges,
                );
                core::mem::swap(&mut x, &mut y);
            }
            for (r, output) in outputs.iter_mut().enumerate() {
                *output = net.last_row(simd, x.add(r * stride));
            }
        }
    }
}

/// Buffers of a batch of `count` rows: inputs `x`, outputs `y`, quantized inputs `q`, and one panel of
/// weights as f32 (`wide`). `stride` is the distance between rows, in floats; in `q`, rows are `stride` bytes
/// apart, padded to 32.
#[derive(Clone, Copy)]
struct Rows {
    count: usize,
    stride: usize,
    x: *const f32,
    y: *mut f32,
    q: *mut u8,
    wide: *mut f32,
}

impl Mlp {
    /// Runs one layer for a batch.
    ///
    /// # Safety
    /// The buffers must hold the rows' padded inputs and outputs, and `wide` the largest panel as f32.
    #[inline(always)]
    unsafe fn layer_rows<S: Simd, const INT8: bool>(
        &self,
        simd: S,
        layer: &Layer,
        rows: Rows,
        ranges: &mut [[f32; 2]],
    ) {
        let bytes = rows.stride.next_multiple_of(32);
        let (mut line, mut first) = (layer.start, 0);
        // SAFETY: the layer's panels are contiguous in `data`. The caller guarantees that the buffers of
        // `rows` hold the padded inputs and outputs of all rows, and that `wide` holds the largest panel.
        unsafe {
            let dot4 = INT8 && layer.storage == Storage::Int8;
            if dot4 {
                for (r, range) in ranges.iter_mut().enumerate().take(rows.count) {
                    let x = rows.x.add(r * rows.stride);
                    let found = quantize(simd, x, layer.filled, rows.q.add(r * bytes));
                    *range = [found.scale, found.zero];
                }
            }
            for n in panels(layer.width) {
                let panel = self.data.as_ptr().add(line).cast::<f32>();
                let mut weights = panel.add(n);
                match layer.storage {
                    Storage::F16 if !INT8 => {
                        weights = widen::<S, AsF16>(simd, weights, layer.inputs, n, rows.wide)
                    }
                    Storage::Bf16 if !INT8 => {
                        weights = widen::<S, AsBf16>(simd, weights, layer.inputs, n, rows.wide)
                    }
                    _ => {}
                }
                line += layer.panel_lines(n);
                // While a panel is used, the next panel is prefetched: each tile prefetches a part of the
                // next panel's cache lines.
                let tiles = rows.count.div_ceil(TILE_ROWS);
                let share = layer.panel_lines(n).div_ceil(tiles);
                let mut ahead = line;
                let mut r = 0;
                while r < rows.count {
                    for next in ahead..(ahead + share).min(self.data.len()) {
                        simd.prefetch(self.data.as_ptr().add(next).cast());
                    }
                    ahead += share;
                    let x = rows.x.add(r * rows.stride);
                    let y = rows.y.add(r * rows.stride + first);
                    let q = rows.q.wrapping_add(r * bytes);
                    // Tiles have six rows; the remaining rows form tiles of four, two and one.
                    let count = match rows.count - r {
                        // The portable level multiplies bytes one by one, so tiles of several rows would not
                        // be faster.
                        _ if dot4 && S::LANES == 4 => 1,
                        6.. => 6,
                        4.. => 4,
                        2.. => 2,
                        _ => 1,
                    };
                    macro_rules! tiles {
                        ($($rows:literal)*) => {
                            match count {
                                $($rows if dot4 && (S::LANES > 4 || $rows == 1) => {
                                    let ranges = &ranges[r..];
                                    tile_int8::<S, $rows>(simd, panel, n, layer.inputs, q, bytes, ranges, y, rows.stride);
                                }
                                $rows => tile::<S, $rows>(simd, panel, weights, n, layer.inputs, x, y, rows.stride),)*
                                _ => {}
                            }
                        };
                    }
                    tiles!(6 4 2 1);
                    selu_rows(simd, y, count, n, rows.stride);
                    r += count;
                }
                first += n;
            }
        }
    }
}

/// Applies SELU to `count` rows of `n` floats, `stride` apart. The loop is separate because SELU, inlined
/// once per sum of every tile, would be most of the library's code.
///
/// # Safety
/// `y` must hold the rows; `n` is a multiple of LANES.
#[inline(always)]
unsafe fn selu_rows<S: Simd>(simd: S, y: *mut f32, count: usize, n: usize, stride: usize) {
    for r in 0..count {
        for o in (0..n).step_by(S::LANES) {
            // SAFETY: the caller guarantees that `y` holds `count` rows of `n` floats, and that `n` is a
            // multiple of `LANES`.
            unsafe {
                let p = y.add(r * stride + o);
                simd.store(p, simd.selu(simd.load(p)));
            }
        }
    }
}

/// Multiplies `ROWS` rows by one panel: y = W·x + b. Every row is summed over the inputs in order, for any
/// `ROWS`.
///
/// # Safety
/// `panel` must start with `n` biases, `weights` hold `inputs` × `n` floats; `x` and `y` hold `ROWS` rows,
/// `stride` apart, of `inputs` and `n` floats.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "one tile's buffers")]
unsafe fn tile<S: Simd, const ROWS: usize>(
    simd: S,
    panel: *const f32,
    weights: *const f32,
    n: usize,
    inputs: usize,
    x: *const f32,
    y: *mut f32,
    stride: usize,
) {
    let mut from = 0;
    while from < n {
        let left = (n - from) / S::LANES;
        // SAFETY: the caller guarantees the sizes of all buffers for `n` outputs, and each tile ends at or
        // before output `n`.
        unsafe {
            let (panel, weights, y) = (panel.add(from), weights.add(from), y.add(from));
            if S::TILE_VECTORS == 4 && left >= 4 {
                tile_of::<S, ROWS, 4>(simd, panel, weights, n, inputs, x, y, stride);
                from += 4 * S::LANES;
            } else if left >= 2 {
                tile_of::<S, ROWS, 2>(simd, panel, weights, n, inputs, x, y, stride);
                from += 2 * S::LANES;
            } else {
                tile_of::<S, ROWS, 1>(simd, panel, weights, n, inputs, x, y, stride);
                from += S::LANES;
            }
        }
    }
}

/// Computes the part of [`tile`] that has `VECTORS` vectors of outputs.
///
/// # Safety
/// As [`tile`].
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "one tile's buffers")]
unsafe fn tile_of<S: Simd, const ROWS: usize, const VECTORS: usize>(
    simd: S,
    panel: *const f32,
    weights: *const f32,
    n: usize,
    inputs: usize,
    x: *const f32,
    y: *mut f32,
    stride: usize,
) {
    // SAFETY: the caller guarantees the sizes of all buffers; the offsets stay below `inputs`, `n` and
    // `ROWS`.
    unsafe {
        let zero = simd.splat(0.0);
        let bias = |v: usize| if v < VECTORS { simd.load(panel.add(v * S::LANES)) } else { zero };
        let biases = [bias(0), bias(1), bias(2), bias(3)];
        let mut s = [biases; 6];
        for k in 0..inputs {
            let weight = |v: usize| {
                if v < VECTORS { simd.load(weights.add(k * n + v * S::LANES)) } else { zero }
            };
            let w = [weight(0), weight(1), weight(2), weight(3)];
            macro_rules! step {
                ($r:literal, $v:literal) => {
                    if $r < ROWS && $v < VECTORS {
                        s[$r][$v] = simd.mul_add(w[$v], simd.splat(*x.add($r * stride + k)), s[$r][$v]);
                    }
                };
            }
            unrolled!(step!);
        }
        macro_rules! finish {
            ($r:literal, $v:literal) => {
                if $r < ROWS && $v < VECTORS {
                    simd.store(y.add($r * stride + $v * S::LANES), s[$r][$v]);
                }
            };
        }
        unrolled!(finish!);
    }
}
