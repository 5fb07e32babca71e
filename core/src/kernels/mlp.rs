//! Dense layers packed for streaming, and the networks made of them.
//!
//! A layer's outputs are padded to a multiple of 16 and cut into panels of 64, 32 and 16. A panel lies in memory in
//! the order in which it is read: its biases, then for each input the weights of all its outputs. So a matrix-vector
//! product is one sequential stream with all sums in registers, and the same panel serves a tile of several rows. The
//! last layer, which has one output, stays a plain row. Padding is zero, and SELU(0) = 0 keeps it so.

use super::Level;
use super::helper::Join;
use super::simd::{Kernel, Simd};
use alloc::vec;
use alloc::vec::Vec;
use bytemuck::{Pod, Zeroable};

/// How a network keeps its weights in memory. Sums and activations are f32 throughout, except for
/// [`Int8`](Storage::Int8).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Storage {
    /// Single precision.
    F32,
    /// Half precision, widened when it is used.
    F16,
    /// bfloat16, widened when it is used.
    Bf16,
    /// Signed bytes with one scale per output; a layer's inputs become unsigned bytes with a scale and a zero point found
    /// at each call, sums are exact 32-bit integers. The first and the last layer stay F32.
    Int8,
}

impl Storage {
    /// Every storage, widest first.
    pub const ALL: [Storage; 4] = [Storage::F32, Storage::F16, Storage::Bf16, Storage::Int8];

    /// A short lower-case name, as reports print it.
    pub const fn name(self) -> &'static str {
        match self {
            Storage::F32 => "f32",
            Storage::F16 => "f16",
            Storage::Bf16 => "bf16",
            Storage::Int8 => "int8",
        }
    }
}

/// Rows that a batch works on at once: two buffers of them and a layer's weights stay in a second-level cache.
pub(crate) const BLOCK_ROWS: usize = 384;

/// Lines of weights from which on a layer is worth splitting over two threads: 64 KiB.
const SPLIT_LINES: usize = 1024;

/// One cache line.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C, align(64))]
pub(crate) struct Line([f32; 16]);

const LINE_BYTES: usize = size_of::<Line>();

/// Outputs of the panels that `width` (a multiple of 16) is cut into, in order.
fn panels(width: usize) -> impl Iterator<Item = usize> {
    core::iter::repeat_n(64, width / 64).chain([32, 16].into_iter().filter(move |n| (width % 64) & n != 0))
}

/// One dense layer followed by SELU.
#[derive(Clone, Debug)]
struct Layer {
    storage: Storage,
    /// Inputs padded with zero weights: to 8, or to 32 with [`Storage::Int8`].
    inputs: usize,
    /// Inputs padded to 16: how far the layer before has written.
    filled: usize,
    /// Outputs padded to 16.
    width: usize,
    /// Where the first panel starts, in lines.
    start: usize,
}

impl Layer {
    /// Lines of one panel of `n` outputs.
    fn panel_lines(&self, n: usize) -> usize {
        let weights = self.inputs * n;
        let (numbers, bytes) = match self.storage {
            Storage::F32 => (n, weights * 4),
            Storage::F16 | Storage::Bf16 => (n, weights * 2),
            Storage::Int8 => (3 * n, weights),
        };
        (numbers * 4 + bytes) / LINE_BYTES
    }

    fn lines(&self) -> usize {
        panels(self.width).map(|n| self.panel_lines(n)).sum()
    }
}

/// Row-major weights and biases of one layer, as the packing reads them.
pub(crate) struct Dense<'a> {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    pub(crate) weight: &'a [f32],
    pub(crate) bias: &'a [f32],
}

/// A network of dense layers with SELU after every layer but the last, which has one output.
#[derive(Clone, Debug)]
pub(crate) struct Mlp {
    level: Level,
    /// Whether the layers between the first and the last are [`Storage::Int8`].
    int8: bool,
    inputs: usize,
    layers: Vec<Layer>,
    /// Inputs of the last layer, and where its row starts.
    last: (usize, usize),
    last_bias: f32,
    /// Mean, then reciprocal of std, each padded to whole lines; empty without normalisation.
    norm: Vec<Line>,
    data: Vec<Line>,
    /// Widest activation, in numbers.
    width: usize,
    /// Numbers in the largest panel, for widening.
    panel: usize,
}

/// Working memory: activations of one or more rows, and room for one widened panel.
#[derive(Clone, Debug, Default)]
pub(crate) struct MlpScratch {
    rows: usize,
    a: Vec<Line>,
    b: Vec<Line>,
    quantized: Vec<Line>,
    ranges: Vec<[f32; 2]>,
    panel: Vec<Line>,
}

impl MlpScratch {
    pub(crate) fn rows(&self) -> usize {
        self.rows
    }
}

impl Mlp {
    /// Packs the layers, first to last. `norm` is the mean and the std of each input.
    ///
    /// Sizes must agree, the last layer must have one output, and nothing may be empty: callers have checked that.
    pub(crate) fn new(
        level: Level,
        storage: Storage,
        layers: &[Dense<'_>],
        norm: Option<(&[f32], &[f32])>,
    ) -> Self {
        let (last, hidden) = layers.split_last().expect("callers have checked that there is a layer");
        let inputs = layers[0].inputs;
        let mut data = Vec::new();
        let mut packed = Vec::with_capacity(hidden.len());
        for (i, layer) in hidden.iter().enumerate() {
            // The first layer sees inputs of any scale, and it is small.
            let storage = if i == 0 && storage == Storage::Int8 { Storage::F32 } else { storage };
            packed.push(pack(layer, storage, &mut data));
        }
        let last_start = data.len();
        data.resize(last_start + last.inputs.div_ceil(16), Line::default());
        bytemuck::cast_slice_mut::<_, f32>(&mut data[last_start..])[..last.inputs]
            .copy_from_slice(last.weight);
        let lines = inputs.div_ceil(16);
        let mut normal = Vec::new();
        if let Some((mean, std)) = norm {
            normal = vec![Line::default(); 2 * lines];
            let (first, second) = bytemuck::cast_slice_mut::<_, f32>(&mut normal).split_at_mut(lines * 16);
            first[..inputs].copy_from_slice(mean);
            second.iter_mut().zip(std).for_each(|(to, s)| *to = 1.0 / s);
        }
        let widest = packed.iter().map(|l: &Layer| l.inputs.max(l.width)).max().unwrap_or(0);
        let panel = packed.iter().map(|l: &Layer| l.inputs * l.width.min(64)).max().unwrap_or(0);
        Self {
            level,
            int8: storage == Storage::Int8,
            inputs,
            layers: packed,
            last: (last.inputs, last_start),
            last_bias: last.bias[0],
            norm: normal,
            data,
            width: widest.max(inputs).next_multiple_of(16),
            panel: if matches!(storage, Storage::F16 | Storage::Bf16) { panel } else { 0 },
        }
    }

    pub(crate) fn inputs(&self) -> usize {
        self.inputs
    }

    pub(crate) fn level(&self) -> Level {
        self.level
    }

    /// Bytes read by one prediction.
    pub(crate) fn bytes(&self) -> usize {
        (self.data.len() + self.norm.len()) * LINE_BYTES
    }

    /// The weights as the caches see them, for benchmarks that evict them.
    pub(crate) fn memory(&self) -> &[u8] {
        bytemuck::cast_slice(&self.data)
    }

    pub(crate) fn scratch(&self, rows: usize) -> MlpScratch {
        let rows = rows.clamp(1, BLOCK_ROWS);
        let lines = vec![Line::default(); rows * self.width / 16];
        // Bytes per row, padded to 32 for the int8 layers.
        let bytes = rows * self.width.next_multiple_of(32);
        let int8 = self.int8;
        MlpScratch {
            rows,
            a: lines.clone(),
            b: lines,
            quantized: vec![Line::default(); if int8 { bytes.div_ceil(LINE_BYTES) } else { 0 }],
            ranges: vec![[0.0; 2]; if int8 { rows } else { 0 }],
            panel: vec![Line::default(); self.panel.div_ceil(16)],
        }
    }

    /// Whether the scratch was made by a network of these sizes.
    fn fits(&self, scratch: &MlpScratch) -> bool {
        let numbers = scratch.rows * self.width;
        let int8 = self.int8;
        scratch.rows > 0
            && scratch.a.len() * 16 >= numbers
            && scratch.b.len() * 16 >= numbers
            && scratch.panel.len() * 16 >= self.panel
            && (!int8
                || (scratch.ranges.len() >= scratch.rows
                    && scratch.quantized.len() * LINE_BYTES
                        >= scratch.rows * self.width.next_multiple_of(32)))
    }

    /// The last layer's output for one row of inputs, or `None` for a wrong number of inputs or a foreign scratch.
    #[inline]
    pub(crate) fn forward(&self, inputs: &[f32], scratch: &mut MlpScratch) -> Option<f32> {
        if inputs.len() != self.inputs || !self.fits(scratch) {
            return None;
        }
        Some(self.run_row(inputs, scratch))
    }

    /// One row whose sizes have been checked.
    #[inline]
    fn run_row(&self, inputs: &[f32], scratch: &mut MlpScratch) -> f32 {
        if self.int8 {
            self.level.run_dot4(Forward::<true> { net: self, inputs, scratch })
        } else {
            self.level.run(Forward::<false> { net: self, inputs, scratch })
        }
    }

    /// As [`forward`](Self::forward), the outputs of each large layer split in two: same bits.
    pub(crate) fn forward_split<J: Join>(
        &self,
        threads: &J,
        inputs: &[f32],
        scratch: &mut MlpScratch,
    ) -> Option<f32> {
        if inputs.len() != self.inputs || !self.fits(scratch) {
            return None;
        }
        // Int8 is faster alone: what a core gains from its half is less than the two cores' talk.
        if self.int8 || self.layers.iter().all(|layer| layer.lines() < SPLIT_LINES) {
            return Some(self.run_row(inputs, scratch));
        }
        let MlpScratch { a, b, .. } = scratch;
        let (mut x, mut y): (&mut [f32], &mut [f32]) =
            (bytemuck::cast_slice_mut(a), bytemuck::cast_slice_mut(b));
        self.level.run(LoadInputs { net: self, inputs, x });
        for layer in &self.layers {
            let whole = LayerPart { net: self, layer, from: 0, to: layer.width, x, y };
            if layer.lines() < SPLIT_LINES || layer.width < 128 {
                self.level.run(whole);
            } else {
                let half = layer.width / 128 * 64;
                let (low, high) = y.split_at_mut(half);
                let x = &*x;
                threads.join(
                    || self.level.run(LayerPart { net: self, layer, from: 0, to: half, x, y: low }),
                    || {
                        let to = layer.width;
                        self.level.run(LayerPart { net: self, layer, from: half, to, x, y: high });
                    },
                );
            }
            core::mem::swap(&mut x, &mut y);
        }
        Some(self.level.run(LastRow { net: self, x }))
    }

    /// The last layer's output for as many rows as `outputs` has elements; `None` as in [`forward`](Self::forward).
    pub(crate) fn forward_rows(
        &self,
        inputs: &[f32],
        outputs: &mut [f32],
        scratch: &mut MlpScratch,
    ) -> Option<()> {
        if self.inputs.checked_mul(outputs.len()) != Some(inputs.len()) || !self.fits(scratch) {
            return None;
        }
        let block = scratch.rows;
        for (inputs, outputs) in inputs.chunks(block * self.inputs).zip(outputs.chunks_mut(block)) {
            if self.int8 {
                self.level.run_dot4(ForwardRows::<true> { net: self, inputs, outputs, scratch });
            } else {
                self.level.run(ForwardRows::<false> { net: self, inputs, outputs, scratch });
            }
        }
        Some(())
    }
}

/// Appends the panels of one layer.
fn pack(layer: &Dense<'_>, storage: Storage, data: &mut Vec<Line>) -> Layer {
    let pad = if storage == Storage::Int8 { 32 } else { 8 };
    let packed = Layer {
        storage,
        inputs: layer.inputs.next_multiple_of(pad),
        filled: layer.inputs.next_multiple_of(16),
        width: layer.outputs.next_multiple_of(16),
        start: data.len(),
    };
    data.resize(packed.start + packed.lines(), Line::default());
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
                // One word per output and pair of inputs: the even input in the lower half.
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
    packed
}

/// Reads weights of two successive inputs.
trait Format {
    /// Vectors of the weights of inputs `k` and `k + 1` (`k` even), starting at output `o` of a panel of `n`.
    /// # Safety
    /// The panel must hold them.
    unsafe fn pair<S: Simd>(simd: S, panel: *const f32, n: usize, k: usize, o: usize) -> (S::F, S::F);
}

struct AsF32;
struct AsF16;
struct AsBf16;

impl Format for AsF32 {
    #[inline(always)]
    unsafe fn pair<S: Simd>(simd: S, panel: *const f32, n: usize, k: usize, o: usize) -> (S::F, S::F) {
        // SAFETY: the caller vouches for the panel.
        unsafe { (simd.load(panel.add(k * n + o)), simd.load(panel.add((k + 1) * n + o))) }
    }
}

impl Format for AsF16 {
    #[inline(always)]
    unsafe fn pair<S: Simd>(simd: S, panel: *const f32, n: usize, k: usize, o: usize) -> (S::F, S::F) {
        let panel = panel.cast::<u16>();
        // SAFETY: the caller vouches for the panel.
        unsafe { (simd.load_f16(panel.add(k * n + o)), simd.load_f16(panel.add((k + 1) * n + o))) }
    }
}

impl Format for AsBf16 {
    #[inline(always)]
    unsafe fn pair<S: Simd>(simd: S, panel: *const f32, n: usize, k: usize, o: usize) -> (S::F, S::F) {
        // SAFETY: the caller vouches for the panel.
        unsafe { simd.load_bf16_pairs(panel.cast::<u32>().add(k / 2 * n + o)) }
    }
}

/// One row through one panel of `N` outputs: y = SELU(W·x + b).
///
/// # Safety
/// `panel` must be the packed panel (bias first), `x` hold `inputs` numbers, `y` have room for `N`.
#[inline(always)]
unsafe fn panel_row<S: Simd, W: Format, const N: usize>(
    simd: S,
    panel: *const f32,
    inputs: usize,
    x: *const f32,
    y: *mut f32,
) {
    // Eight sums: `vectors` outputs at a time, even and odd inputs apart, 4 / `vectors` pairs of inputs at a time.
    let vectors = if N / S::LANES < 4 { N / S::LANES } else { 4 };
    let pairs = 4 / vectors;
    let mut from = 0;
    while from < N {
        // SAFETY: all offsets stay below `inputs`·N in the weights, `inputs` in x and N in bias and y; `inputs` is a
        // multiple of 8 = 2·max(pairs).
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

/// Scale and zero point of a row that was turned into bytes: x ≈ scale·(byte − zero).
#[derive(Clone, Copy)]
struct Range {
    scale: f32,
    zero: f32,
}

/// Turns `n` numbers (a multiple of 16) into unsigned bytes. Anything not finite makes the scale NaN, and with it
/// every result.
///
/// # Safety
/// `x` must hold `n` numbers and `q` have room for `n` bytes.
#[inline(always)]
unsafe fn quantize<S: Simd>(simd: S, x: *const f32, n: usize, q: *mut u8) -> Range {
    // SAFETY: offsets stay below n, which the caller vouches for.
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

/// One row of bytes through one int8 panel of `N` outputs.
///
/// # Safety
/// As [`panel_row`], with `inputs` bytes at `q`, `inputs` a multiple of 32.
#[inline(always)]
unsafe fn panel_row_int8<S: Simd, const N: usize>(
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
        // SAFETY: all offsets stay below `inputs`·N bytes in the weights, `inputs` in q and N elsewhere; `inputs` is a
        // multiple of 32 = 8·max(pairs).
        unsafe {
            let weights = panel.add(3 * N).cast::<i8>();
            let zero = simd.zero_i();
            let (mut e0, mut e1, mut e2, mut e3) = (zero, zero, zero, zero);
            let (mut o0, mut o1, mut o2, mut o3) = (zero, zero, zero, zero);
            let mut k = 0;
            while k < inputs {
                macro_rules! step {
                    ($j:literal, $even:ident, $odd:ident) => {
                        let at = k + 8 * ($j / vectors);
                        let o = from + $j % vectors * S::LANES;
                        let four = |at: usize| simd.splat_bytes(q.add(at).cast::<u32>().read_unaligned());
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

/// From integer sums to W·x + b: scale·(weight scale·sum − zero·weight sum) + bias.
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
    // SAFETY: the caller vouches for the panel.
    unsafe {
        let (bias, scales, sums) =
            (simd.load(panel.add(o)), simd.load(panel.add(n + o)), simd.load(panel.add(2 * n + o)));
        let centered = simd.neg_mul_add(sums, simd.splat(range.zero), simd.mul(simd.to_f(sum), scales));
        simd.mul_add(centered, simd.splat(range.scale), bias)
    }
}

struct Forward<'a, const INT8: bool> {
    net: &'a Mlp,
    inputs: &'a [f32],
    scratch: &'a mut MlpScratch,
}

impl<const INT8: bool> Kernel for Forward<'_, INT8> {
    type Output = f32;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> f32 {
        let Self { net, inputs, scratch } = self;
        let mut x: *mut f32 = scratch.a.as_mut_ptr().cast();
        let mut y: *mut f32 = scratch.b.as_mut_ptr().cast();
        let q: *mut u8 = scratch.quantized.as_mut_ptr().cast();
        // SAFETY: `fits` has checked that both buffers hold the widest activation, padded to 16 (and `quantized` to
        // 32), and packing has laid the panels out as the loops below walk them.
        unsafe {
            net.load_inputs(simd, inputs, x);
            for layer in &net.layers {
                net.layer_row::<S, INT8>(simd, layer, 0, layer.width, x, q, y);
                core::mem::swap(&mut x, &mut y);
            }
            net.last_row(simd, x)
        }
    }
}

struct LoadInputs<'a> {
    net: &'a Mlp,
    inputs: &'a [f32],
    x: &'a mut [f32],
}

impl Kernel for LoadInputs<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        // SAFETY: `fits` has checked the length of `x`, `forward_split` that of `inputs`.
        unsafe { self.net.load_inputs(simd, self.inputs, self.x.as_mut_ptr()) };
    }
}

/// Outputs `from` to `to` of one layer, written to the start of `y`.
struct LayerPart<'a> {
    net: &'a Mlp,
    layer: &'a Layer,
    from: usize,
    to: usize,
    x: &'a [f32],
    y: &'a mut [f32],
}

impl Kernel for LayerPart<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { net, layer, from, to, x, y } = self;
        assert!(x.len() >= layer.inputs.min(net.width) && y.len() >= to - from && to <= layer.width);
        // SAFETY: `x` and `y` are long enough; `q` is not used without int8 layers.
        unsafe {
            net.layer_row::<S, false>(
                simd,
                layer,
                from,
                to,
                x.as_ptr(),
                core::ptr::null_mut(),
                y.as_mut_ptr(),
            );
        }
    }
}

struct LastRow<'a> {
    net: &'a Mlp,
    x: &'a [f32],
}

impl Kernel for LastRow<'_> {
    type Output = f32;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> f32 {
        // SAFETY: `fits` has checked the length of `x`.
        unsafe { self.net.last_row(simd, self.x.as_ptr()) }
    }
}

impl Mlp {
    /// Copies one row of inputs, normalised, and clears the padding behind it.
    ///
    /// # Safety
    /// `inputs` must have the network's length and `x` room for it, padded to 16.
    #[inline(always)]
    unsafe fn load_inputs<S: Simd>(&self, simd: S, inputs: &[f32], x: *mut f32) {
        let padded = self.inputs.next_multiple_of(16);
        // SAFETY: the caller vouches for `x`; `norm` holds two runs of `padded` numbers or none.
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

    /// Outputs `from` to `to` (multiples of 64, or the layer's width) of one layer for one row, written to the start
    /// of `y`.
    ///
    /// # Safety
    /// `x` must hold the layer's padded inputs, `y` have room for its width, `q` (int8 only) for its padded inputs in
    /// bytes.
    #[inline(always)]
    #[allow(clippy::too_many_arguments, reason = "one row's buffers")]
    unsafe fn layer_row<S: Simd, const INT8: bool>(
        &self,
        simd: S,
        layer: &Layer,
        from: usize,
        to: usize,
        x: *const f32,
        q: *mut u8,
        y: *mut f32,
    ) {
        macro_rules! walk {
            ($panel:ident, $($arg:tt)*) => {{
                // SAFETY: panels follow one another in `data`; the caller vouches for the buffers.
                unsafe {
                    let mut panel = self.data.as_ptr().add(layer.start + from / 64 * layer.panel_lines(64)).cast::<f32>();
                    let mut o = from;
                    while to - o >= 64 {
                        walk!(@ $panel, 64, panel, y.add(o - from), $($arg)*);
                        panel = panel.add(layer.panel_lines(64) * 16);
                        o += 64;
                    }
                    if to - o >= 32 {
                        walk!(@ $panel, 32, panel, y.add(o - from), $($arg)*);
                        panel = panel.add(layer.panel_lines(32) * 16);
                        o += 32;
                    }
                    if to - o >= 16 {
                        walk!(@ $panel, 16, panel, y.add(o - from), $($arg)*);
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
        // The first and the last layer of an int8 network are F32, the rest of it Int8.
        match layer.storage {
            Storage::F32 => walk!(panel_row, AsF32),
            Storage::F16 if !INT8 => walk!(panel_row, AsF16),
            Storage::Bf16 if !INT8 => walk!(panel_row, AsBf16),
            _ if !INT8 => {}
            _ => {
                // SAFETY: the caller vouches for the buffers; what lies in `q` beyond `filled` meets zero weights.
                let range = unsafe { quantize(simd, x, layer.filled, q) };
                walk!(panel_row_int8, range);
            }
        }
    }

    /// The last layer for one row.
    ///
    /// # Safety
    /// `x` must hold the layer's inputs padded to 16.
    #[inline(always)]
    unsafe fn last_row<S: Simd>(&self, simd: S, x: *const f32) -> f32 {
        let (inputs, start) = self.last;
        let padded = inputs.next_multiple_of(16);
        // SAFETY: the packed row is padded to 16 as well; 16 is a multiple of LANES.
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

struct ForwardRows<'a, const INT8: bool> {
    net: &'a Mlp,
    inputs: &'a [f32],
    outputs: &'a mut [f32],
    scratch: &'a mut MlpScratch,
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
        // SAFETY: `fits` has checked that the buffers hold `scratch.rows` rows of `stride` numbers each (`quantized`
        // the same in bytes, padded to 32) and the largest panel; there are at most that many rows.
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

/// Buffers of a block of rows; rows are `stride` numbers apart (bytes in `q`: padded to 32).
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
    /// One layer for a block of rows.
    ///
    /// # Safety
    /// The buffers must hold the rows' padded inputs and outputs, and `wide` the widened panel.
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
        // SAFETY: panels follow one another in `data`; the caller vouches for the buffers.
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
                // The next panel arrives while this one is used: some of its lines with each tile.
                let tiles = rows.count.div_ceil(S::TILE_ROWS);
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
                    // Six rows, or what is left of them in four, two and one.
                    let count = match rows.count - r {
                        // Without vectors, bytes are multiplied one by one: a tile would gain nothing.
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

/// Widens a panel's weights to f32, and says where they are.
///
/// # Safety
/// `weights` must hold `inputs` × `n` numbers of the format, `wide` have room for them.
#[inline(always)]
unsafe fn widen<S: Simd, W: Format>(
    simd: S,
    weights: *const f32,
    inputs: usize,
    n: usize,
    wide: *mut f32,
) -> *const f32 {
    for k in (0..inputs).step_by(2) {
        for o in (0..n).step_by(S::LANES) {
            // SAFETY: the caller vouches for both; `n` is a multiple of LANES and `inputs` is even.
            unsafe {
                let (even, odd) = W::pair(simd, weights, n, k, o);
                simd.store(wide.add(k * n + o), even);
                simd.store(wide.add((k + 1) * n + o), odd);
            }
        }
    }
    wide
}

/// Writes out every row and vector of a tile with literal indices, so that each sum has a register of its own: in loops
/// the compiler keeps arrays of sums in memory. Rows beyond `ROWS` and vectors beyond `VECTORS` vanish.
#[rustfmt::skip]
macro_rules! unrolled {
    ($do:ident!) => {
        $do!(0, 0); $do!(0, 1); $do!(0, 2); $do!(0, 3);
        $do!(1, 0); $do!(1, 1); $do!(1, 2); $do!(1, 3);
        $do!(2, 0); $do!(2, 1); $do!(2, 2); $do!(2, 3);
        $do!(3, 0); $do!(3, 1); $do!(3, 2); $do!(3, 3);
        $do!(4, 0); $do!(4, 1); $do!(4, 2); $do!(4, 3);
        $do!(5, 0); $do!(5, 1); $do!(5, 2); $do!(5, 3);
    };
}

/// SELU over `count` rows of `n` numbers, `stride` apart: a loop of its own, since one copy per sum of every tile would be
/// most of the library's code.
///
/// # Safety
/// `y` must hold the rows; `n` is a multiple of LANES.
#[inline(always)]
unsafe fn selu_rows<S: Simd>(simd: S, y: *mut f32, count: usize, n: usize, stride: usize) {
    for r in 0..count {
        for o in (0..n).step_by(S::LANES) {
            // SAFETY: the caller vouches for the rows.
            unsafe {
                let p = y.add(r * stride + o);
                simd.store(p, simd.selu(simd.load(p)));
            }
        }
    }
}

/// `ROWS` rows through one panel: y = W·x + b. Every row's sums run over the inputs in order, whatever `ROWS` is.
///
/// # Safety
/// `panel` must start with `n` biases, `weights` hold `inputs` × `n` numbers; `x` and `y` hold `ROWS` rows, `stride`
/// apart, of `inputs` and `n` numbers.
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
        // SAFETY: offsets stay within what the caller vouches for.
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

/// As [`tile`], for `VECTORS` vectors of outputs.
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
    // SAFETY: offsets stay within what the caller vouches for.
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

/// As [`tile`] for an int8 panel: `q` holds the rows' bytes, `bytes` apart, `ranges` their scales and zero points.
///
/// # Safety
/// As [`tile`].
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "one tile's buffers")]
unsafe fn tile_int8<S: Simd, const ROWS: usize>(
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
        // SAFETY: as for `tile`.
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

/// As [`tile_int8`], for `VECTORS` vectors of outputs beginning at output `from`.
///
/// # Safety
/// As [`tile`].
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
    // SAFETY: offsets stay within what the caller vouches for; `inputs` is a multiple of 4.
    unsafe {
        let weights = panel.add(3 * n).cast::<i8>();
        let zero = simd.zero_i();
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
                        let four = q.add($r * bytes + k).cast::<u32>().read_unaligned();
                        s[$r][$v] = simd.dot4(s[$r][$v], simd.splat_bytes(four), w[$v]);
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
