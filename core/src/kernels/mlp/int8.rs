//! Integer arithmetic of [`Storage::Int8`](super::Storage::Int8): inputs are quantized to unsigned bytes,
//! sums are exact.

use crate::kernels::simd::Simd;

/// Scale and zero point of a quantized row: x ≈ scale·(byte − zero).
#[derive(Clone, Copy)]
pub(super) struct Range {
    pub(super) scale: f32,
    pub(super) zero: f32,
}

/// Quantizes `n` floats (a multiple of 16) to unsigned bytes. A value that is not finite makes the scale NaN,
/// and so makes every output of the layer NaN.
///
/// # Safety
/// `x` must hold `n` floats, and `q` must hold `n` bytes.
#[inline(always)]
pub(super) unsafe fn quantize<S: Simd>(simd: S, x: *const f32, n: usize, q: *mut u8) -> Range {
    // SAFETY: the caller guarantees that `x` holds `n` floats and `q` holds `n` bytes; `n` is a multiple of
    // `LANES`.
    unsafe {
        let zero = simd.splat(0.0);
        let (mut high, mut low, mut check) = (zero, zero, zero);
        let mut i = 0;
        while i < n {
            let v = simd.load(x.add(i));
            high = simd.max(v, high);
            low = simd.min(v, low);
            check = simd.mul_add(v, zero, check);
            i += S::LANES;
        }
        let (high, low) = (simd.largest(high), -simd.smallest(low));
        let scale = (high + low) * (1.0 / 255.0);
        let inverse = if scale >= f32::MIN_POSITIVE { 1.0 / scale } else { 0.0 };
        let offset = simd.splat(libm::rintf(low * inverse));
        let factor = simd.splat(inverse);
        let mut i = 0;
        while i < n {
            simd.store_u8(q.add(i), simd.mul_add(simd.load(x.add(i)), factor, offset));
            i += S::LANES;
        }
        Range { scale: scale + simd.sum(check), zero: libm::rintf(low * inverse) }
    }
}

/// Multiplies one quantized row by one int8 panel of `N` outputs: y = SELU(W·x + b).
///
/// # Safety
/// As `panel_row` of the module `row`. `q` must hold `inputs` bytes; `inputs` must be a multiple of 32.
#[inline(always)]
pub(super) unsafe fn panel_row_int8<S: Simd, const N: usize>(
    simd: S,
    panel: *const f32,
    inputs: usize,
    q: *const u8,
    range: Range,
    y: *mut f32,
) {
    let vectors = if N / S::LANES < 4 { N / S::LANES } else { 4 };
    let pairs = 4 / vectors;
    let mut from = 0;
    while from < N {
        // SAFETY: the caller guarantees the sizes of the buffers. All offsets stay below `inputs`·N bytes in
        // the weights, below `inputs` in `q`, and below N elsewhere; `inputs` is a multiple of 32 =
        // 8·max(pairs).
        unsafe {
            let weights = panel.add(3 * N).cast::<i8>();
            let zero = simd.splat_i(0);
            let (mut e0, mut e1, mut e2, mut e3) = (zero, zero, zero, zero);
            let (mut o0, mut o1, mut o2, mut o3) = (zero, zero, zero, zero);
            let mut k = 0;
            while k < inputs {
                macro_rules! step {
                    ($j:literal, $even:ident, $odd:ident) => {
                        let at = k + 8 * ($j / vectors);
                        let o = from + $j % vectors * S::LANES;
                        let four = |at: usize| simd.splat_i(q.add(at).cast::<i32>().read_unaligned());
                        $even = simd.dot4($even, four(at), simd.load_bytes(weights.add(at * N + 4 * o)));
                        $odd =
                            simd.dot4($odd, four(at + 4), simd.load_bytes(weights.add((at + 4) * N + 4 * o)));
                    };
                }
                step!(0, e0, o0);
                step!(1, e1, o1);
                step!(2, e2, o2);
                step!(3, e3, o3);
                k += 8 * pairs;
            }
            let (mut s0, mut s1, s2, s3) =
                (simd.add_i(e0, o0), simd.add_i(e1, o1), simd.add_i(e2, o2), simd.add_i(e3, o3));
            if vectors == 2 {
                s0 = simd.add_i(s0, s2);
                s1 = simd.add_i(s1, s3);
            }
            if vectors == 1 {
                s0 = simd.add_i(simd.add_i(s0, s1), simd.add_i(s2, s3));
            }
            macro_rules! finish {
                ($sum:ident, $j:literal) => {
                    let o = from + $j * S::LANES;
                    simd.store(y.add(o), simd.selu(dequantize::<S>(simd, panel, N, o, $sum, range)));
                };
            }
            finish!(s0, 0);
            if vectors > 1 {
                finish!(s1, 1);
            }
            if vectors > 2 {
                finish!(s2, 2);
                finish!(s3, 3);
            }
        }
        from += vectors * S::LANES;
    }
}

/// Dequantizes integer sums to W·x + b = scale·(s·sum − zero·w) + bias. `scale` and `zero` are those of the
/// row's inputs (`range`), s is the scale and w the sum of an output's weights.
///
/// # Safety
/// `panel` must be a packed int8 panel of `n` outputs, `o` + LANES ≤ `n`.
#[inline(always)]
unsafe fn dequantize<S: Simd>(
    simd: S,
    panel: *const f32,
    n: usize,
    o: usize,
    sum: S::I,
    range: Range,
) -> S::F {
    // SAFETY: the caller guarantees a packed panel of `n` outputs and `o` + LANES ≤ `n`, so all loads stay
    // inside the panel.
    unsafe {
        let (bias, scales, sums) =
            (simd.load(panel.add(o)), simd.load(panel.add(n + o)), simd.load(panel.add(2 * n + o)));
        let centered = simd.neg_mul_add(sums, simd.splat(range.zero), simd.mul(simd.to_f(sum), scales));
        simd.mul_add(centered, simd.splat(range.scale), bias)
    }
}

/// Multiplies `ROWS` quantized rows by one int8 panel: y = W·x + b. `q` holds the rows, `bytes` bytes apart;
/// `ranges` holds their scales and zero points.
///
/// # Safety
/// As `tile` of the module `batch`.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "one tile's buffers")]
pub(super) unsafe fn tile_int8<S: Simd, const ROWS: usize>(
    simd: S,
    panel: *const f32,
    n: usize,
    inputs: usize,
    q: *const u8,
    bytes: usize,
    ranges: &[[f32; 2]],
    y: *mut f32,
    stride: usize,
) {
    let mut from = 0;
    while from < n {
        let left = (n - from) / S::LANES;
        // SAFETY: the caller guarantees the sizes of all buffers for `n` outputs, and each tile ends at or
        // before output `n`.
        unsafe {
            if S::TILE_VECTORS == 4 && left >= 4 {
                tile_int8_of::<S, ROWS, 4>(simd, panel, n, from, inputs, q, bytes, ranges, y, stride);
                from += 4 * S::LANES;
            } else if left >= 2 {
                tile_int8_of::<S, ROWS, 2>(simd, panel, n, from, inputs, q, bytes, ranges, y, stride);
                from += 2 * S::LANES;
            } else {
                tile_int8_of::<S, ROWS, 1>(simd, panel, n, from, inputs, q, bytes, ranges, y, stride);
                from += S::LANES;
            }
        }
    }
}

/// Computes the part of [`tile_int8`] that has `VECTORS` vectors of outputs, from output `from` on.
///
/// # Safety
/// As `tile` of the module `batch`.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "one tile's buffers")]
unsafe fn tile_int8_of<S: Simd, const ROWS: usize, const VECTORS: usize>(
    simd: S,
    panel: *const f32,
    n: usize,
    from: usize,
    inputs: usize,
    q: *const u8,
    bytes: usize,
    ranges: &[[f32; 2]],
    y: *mut f32,
    stride: usize,
) {
    // SAFETY: the caller guarantees the sizes of all buffers; the offsets stay below `inputs`, `n` and
    // `ROWS`, since `inputs` is a multiple of 4.
    unsafe {
        let weights = panel.add(3 * n).cast::<i8>();
        let zero = simd.splat_i(0);
        let mut s = [[zero; 4]; 6];
        let mut k = 0;
        while k < inputs {
            let weight = |v: usize| {
                if v < VECTORS {
                    simd.load_bytes(weights.add(k * n + 4 * (from + v * S::LANES)))
                } else {
                    zero
                }
            };
            let w = [weight(0), weight(1), weight(2), weight(3)];
            macro_rules! step {
                ($r:literal, $v:literal) => {
                    if $r < ROWS && $v < VECTORS {
                        let four = q.add($r * bytes + k).cast::<i32>().read_unaligned();
                        s[$r][$v] = simd.dot4(s[$r][$v], simd.splat_i(four), w[$v]);
                    }
                };
            }
            unrolled!(step!);
            k += 4;
        }
        macro_rules! finish {
            ($r:literal, $v:literal) => {
                if $r < ROWS && $v < VECTORS {
                    let o = from + $v * S::LANES;
                    let [scale, zero] = ranges[$r];
                    let value = dequantize::<S>(simd, panel, n, o, s[$r][$v], Range { scale, zero });
                    simd.store(y.add($r * stride + o), value);
                }
            };
        }
        unrolled!(finish!);
    }
}
