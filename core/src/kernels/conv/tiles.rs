//! The inner loops of the convolutions: every accumulator is a variable of its own, so that all of them stay
//! in registers.

use crate::kernels::simd::Simd;

/// Largest number of output positions per tile.
pub(super) const MAX_POSITIONS: usize = 16;

/// One tile of a channels-last layer: a few output positions times one block of channels.
pub(super) struct Tile {
    /// Per position: pointer to the input value of tap 0 and channel 0.
    pub(super) input: [*const f32; MAX_POSITIONS],
    /// Per position: pointer to the output of the block's first channel.
    pub(super) output: [*mut f32; MAX_POSITIONS],
    /// Number of distinct positions; the entries after them repeat the last distinct position.
    pub(super) distinct: usize,
    /// True if the inputs of neighboring positions are two floats apart.
    pub(super) two_apart: bool,
    /// True if the taps come in triples whose inputs are one float apart.
    pub(super) tap_triples: bool,
    /// `input[0]` of the next tile, for prefetching.
    pub(super) next: *const f32,
    /// Offset of each tap from `input`, in floats.
    pub(super) taps: *const usize,
    pub(super) tap_count: usize,
    pub(super) channels: usize,
    /// Floats from one input channel to the next.
    pub(super) channel_stride: usize,
    /// Weights in the order (tap, input channel, output channel of the block).
    pub(super) weights: *const f32,
    pub(super) bias: *const f32,
}

/// One output row of the first layer, for one group of channels.
pub(super) struct Row {
    /// Pointer to the input value of tap 0 for x = 0.
    pub(super) input: *const f32,
    pub(super) taps: *const usize,
    pub(super) tap_count: usize,
    /// Weights in the order (tap, channel of the group): `tap_count` × `channels` floats.
    pub(super) weights: *const f32,
    pub(super) bias: *const f32,
    /// Pointer to x = 0 of the group's first channel.
    pub(super) output: *mut f32,
    /// Floats from one output channel to the next.
    pub(super) channel_stride: usize,
    /// Number of channels of the group.
    pub(super) channels: usize,
    pub(super) width: usize,
}

/// Prefetch distance of weights, in floats.
const WEIGHTS_AHEAD: usize = 1024;

/// Tile sizes of one SIMD level.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cut {
    /// Number of floats per vector.
    pub(super) lanes: usize,
    /// Number of channels per group in the first layer.
    pub(super) group: usize,
    /// Number of outputs along x per step in the first layer.
    pub(super) width: usize,
    /// Number of positions per tile in the channels-last layers.
    pub(super) positions: usize,
    /// True if the level has tiles of 16 positions and one vector.
    pub(super) wide: bool,
}

impl Cut {
    pub(super) const fn of<S: Simd>() -> Self {
        // With AVX-512, the 32 registers hold 16 sums and their operands. At the other levels, the 16
        // registers hold 12 sums (2 × positions) or 8 sums (2 × group).
        let big = S::LANES == 16;
        Self {
            lanes: S::LANES,
            group: if big { 8 } else { 4 },
            width: 2 * S::LANES,
            positions: if big { 8 } else { 6 },
            wide: big,
        }
    }
}

macro_rules! two_vectors {
    ($name:ident: $($p:literal $x:ident $a:ident $b:ident),*) => {
        /// Computes a tile of two vectors of channels. Integer instructions compete with the sums for
        /// execution ports, so addresses are shared: with `TWO_APART`, positions are two floats apart and
        /// share a pointer; with `CONTIGUOUS_CHANNELS`, channels are contiguous and are processed four at a
        /// time.
        #[inline(always)]
        unsafe fn $name<S: Simd, const TWO_APART: bool, const CONTIGUOUS_CHANNELS: bool>(s: S, tile: &Tile) {
            // SAFETY: the caller of `run_tile` guarantees that every pointer is valid for the reads and
            // writes made here.
            unsafe {
                let origin = tile.input[0];
                $(let $x = tile.input[$p];)*
                let (b0, b1) = (s.load(tile.bias), s.load(tile.bias.add(S::LANES)));
                $(let (mut $a, mut $b) = (b0, b1);)*
                let mut w = tile.weights;
                let mut tap = tile.taps;
                let taps_end = tap.add(tile.tap_count);
                let stride = tile.channel_stride;
                while tap != taps_end {
                    let mut at = *tap;
                    let mut left = tile.channels;
                    while left > 0 {
                        let run = if CONTIGUOUS_CHANNELS { 4 } else { 1 };
                        for _ in 0..run {
                        let (w0, w1) = (s.load(w), s.load(w.add(S::LANES)));
                        s.prefetch_near(w.wrapping_add(WEIGHTS_AHEAD));
                        if S::LANES == 16 {
                            s.prefetch_near(w.wrapping_add(WEIGHTS_AHEAD + 16));
                        }
                        $(
                            let x = s.splat(if TWO_APART { *origin.add(at + 2 * $p) } else { *$x.add(at) });
                            $a = s.mul_add(x, w0, $a);
                            $b = s.mul_add(x, w1, $b);
                        )*
                        w = w.add(2 * S::LANES);
                        at += if CONTIGUOUS_CHANNELS { 1 } else { stride };
                        }
                        left -= run;
                    }
                    tap = tap.add(1);
                }
                $(
                    s.store(tile.output[$p], $a);
                    s.store(tile.output[$p].add(S::LANES), $b);
                )*
            }
        }
    };
}

macro_rules! one_vector {
    ($name:ident: $($p:literal $x:ident $a:ident),*) => {
        /// Computes a tile of one vector of channels.
        #[inline(always)]
        unsafe fn $name<S: Simd>(s: S, tile: &Tile) {
            // SAFETY: the caller of `run_tile` guarantees that every pointer is valid for the reads and
            // writes made here.
            unsafe {
                $(let $x = tile.input[$p];)*
                let b0 = s.load(tile.bias);
                $(let mut $a = b0;)*
                let mut w = tile.weights;
                let mut tap = tile.taps;
                let taps_end = tap.add(tile.tap_count);
                let stride = tile.channel_stride;
                while tap != taps_end {
                    let mut at = *tap;
                    for _ in 0..tile.channels {
                        let w0 = s.load(w);
                        $($a = s.mul_add(s.splat(*$x.add(at)), w0, $a);)*
                        w = w.add(S::LANES);
                        at += stride;
                    }
                    tap = tap.add(1);
                }
                $(s.store(tile.output[$p], $a);)*
            }
        }
    };
}

macro_rules! wide {
    ($name:ident: $($p:literal $x:ident $a:ident $b:ident),*) => {
        /// Computes a tile of 16 positions and one vector. The distance from position p to p + 8 is the same
        /// for every p.
        #[inline(always)]
        unsafe fn $name<S: Simd>(s: S, tile: &Tile) {
            // SAFETY: the caller of `run_tile` guarantees that every pointer is valid for the reads and
            // writes made here.
            unsafe {
                $(let $x = tile.input[$p];)*
                let distance = tile.input[8].offset_from(tile.input[0]) as usize;
                let b0 = s.load(tile.bias);
                $(let (mut $a, mut $b) = (b0, b0);)*
                let mut w = tile.weights;
                let mut tap = tile.taps;
                let taps_end = tap.add(tile.tap_count);
                let stride = tile.channel_stride;
                while tap != taps_end {
                    let mut at = *tap;
                    let mut far = at + distance;
                    for _ in 0..tile.channels {
                        let w0 = s.load(w);
                        $(
                            $a = s.mul_add(s.splat(*$x.add(at)), w0, $a);
                            $b = s.mul_add(s.splat(*$x.add(far)), w0, $b);
                        )*
                        w = w.add(S::LANES);
                        at += stride;
                        far += stride;
                    }
                    tap = tap.add(1);
                }
                $(
                    s.store(tile.output[$p], $a);
                    s.store(tile.output[$p + 8], $b);
                )*
            }
        }
    };
}

/// Computes a tile of 16 positions and one vector, for kernels with rows of three taps. The inputs of
/// neighboring positions are two floats apart. The three taps of a channel are added in one pass, so that an
/// input that two neighboring positions share is read once.
#[inline(always)]
unsafe fn sixteen_by_tap_triples<S: Simd>(s: S, tile: &Tile) {
    macro_rules! body {
        ($first:ident, $($p:literal $a:ident $before:ident),*; $last:ident) => {{
            // SAFETY: the caller of `run_tile` guarantees that every pointer is valid for the reads and
            // writes made here.
            unsafe {
                let b0 = s.load(tile.bias);
                let mut $first = b0;
                $(let mut $a = b0;)*
                let stride = tile.channel_stride;
                let to_next_tap = tile.channels * S::LANES;
                let mut w = tile.weights;
                for row in 0..tile.tap_count / 3 {
                    let mut x = tile.input[0].add(*tile.taps.add(3 * row));
                    let mut next = tile.next.wrapping_add(*tile.taps.add(3 * row));
                    for _ in 0..tile.channels {
                        let (w0, w1, w2) =
                            (s.load(w), s.load(w.add(to_next_tap)), s.load(w.add(2 * to_next_tap)));
                        s.prefetch_near(next);
                        s.prefetch_near(next.wrapping_add(16));
                        s.prefetch_near(next.wrapping_add(32));
                        $first = s.mul_add(s.splat(*x), w0, $first);
                        $first = s.mul_add(s.splat(*x.add(1)), w1, $first);
                        $(
                            let shared = s.splat(*x.add(2 * $p));
                            $before = s.mul_add(shared, w2, $before);
                            $a = s.mul_add(shared, w0, $a);
                            $a = s.mul_add(s.splat(*x.add(2 * $p + 1)), w1, $a);
                        )*
                        $last = s.mul_add(s.splat(*x.add(32)), w2, $last);
                        w = w.add(S::LANES);
                        x = x.add(stride);
                        next = next.wrapping_add(stride);
                    }
                    w = w.add(2 * to_next_tap);
                }
                s.store(tile.output[0], $first);
                $(s.store(tile.output[$p], $a);)*
            }
        }};
    }
    body!(a0, 1 a1 a0, 2 a2 a1, 3 a3 a2, 4 a4 a3, 5 a5 a4, 6 a6 a5, 7 a7 a6, 8 a8 a7, 9 a9 a8, 10 a10 a9, 11 a11 a10, 12 a12 a11, 13 a13 a12, 14 a14 a13, 15 a15 a14; a15);
}

two_vectors!(two_by_eight: 0 x0 a0 b0, 1 x1 a1 b1, 2 x2 a2 b2, 3 x3 a3 b3, 4 x4 a4 b4, 5 x5 a5 b5, 6 x6 a6 b6, 7 x7 a7 b7);
two_vectors!(two_by_six: 0 x0 a0 b0, 1 x1 a1 b1, 2 x2 a2 b2, 3 x3 a3 b3, 4 x4 a4 b4, 5 x5 a5 b5);
one_vector!(one_by_eight: 0 x0 a0, 1 x1 a1, 2 x2 a2, 3 x3 a3, 4 x4 a4, 5 x5 a5, 6 x6 a6, 7 x7 a7);
one_vector!(one_by_six: 0 x0 a0, 1 x1 a1, 2 x2 a2, 3 x3 a3, 4 x4 a4, 5 x5 a5);
wide!(one_by_sixteen: 0 x0 a0 b0, 1 x1 a1 b1, 2 x2 a2 b2, 3 x3 a3 b3, 4 x4 a4 b4, 5 x5 a5 b5, 6 x6 a6 b6, 7 x7 a7 b7);

/// Computes a tile of `positions` positions and `vectors` vectors of channels.
///
/// # Safety
/// `positions` is [`Cut::positions`]. It may also be 16 if [`Cut::wide`] is true, `vectors` is 1, and the
/// distance from position p to p + 8 is the same for every p. Where [`Tile::two_apart`] is true, position p
/// lies 2·p floats from position 0. Where [`Tile::tap_triples`] is true, taps come in triples of neighbors.
/// Every input pointer plus any tap plus any channel is readable, weights and biases are packed for the tile,
/// and every output pointer is writable for its vectors, which no other thread accesses.
#[inline(always)]
pub(super) unsafe fn run_tile<S: Simd>(s: S, tile: &Tile, positions: usize, vectors: usize) {
    const { assert!(MAX_POSITIONS >= 16) };
    // SAFETY: the caller guarantees (see `# Safety`) that inputs, weights and biases of the tile are
    // readable, and that each output is writable for `vectors` vectors. The functions called here require no
    // more.
    unsafe {
        let contiguous_channels = tile.channel_stride == 1 && tile.channels % 4 == 0;
        match (vectors, S::LANES == 16) {
            (2, true) if tile.two_apart => two_by_eight::<S, true, false>(s, tile),
            (2, true) if contiguous_channels => two_by_eight::<S, false, true>(s, tile),
            (2, true) => two_by_eight::<S, false, false>(s, tile),
            (2, false) if tile.two_apart => two_by_six::<S, true, false>(s, tile),
            (2, false) if contiguous_channels => two_by_six::<S, false, true>(s, tile),
            (2, false) => two_by_six::<S, false, false>(s, tile),
            (_, true) if positions == 16 && tile.two_apart && tile.tap_triples => {
                sixteen_by_tap_triples(s, tile)
            }
            (_, true) if positions == 16 => one_by_sixteen(s, tile),
            (_, true) => one_by_eight(s, tile),
            (_, false) => one_by_six(s, tile),
        }
        // SELU runs in a separate loop: inlined once per sum, it would be most of the code. Only distinct
        // positions are processed, so that SELU is applied once to each output.
        for output in &tile.output[..tile.distinct] {
            for v in 0..vectors {
                let p = output.add(v * S::LANES);
                s.store(p, s.selu(s.load(p)));
            }
        }
    }
}

macro_rules! row_step {
    ($name:ident: $($c:literal $a:ident $b:ident),*) => {
        /// Computes one step of a first-layer row: two vectors along x for every channel of the group.
        #[inline(always)]
        unsafe fn $name<S: Simd>(s: S, row: &Row, x: usize) {
            const GROUP: usize = [$($c),*].len();
            // SAFETY: the caller of `run_row` guarantees that every pointer is valid for the reads and writes
            // made here.
            unsafe {
                $(
                    let mut $a = s.splat(*row.bias.add($c));
                    let mut $b = $a;
                )*
                let mut w = row.weights;
                let mut tap = row.taps;
                let taps_end = tap.add(row.tap_count);
                let input = row.input.add(x);
                while tap != taps_end {
                    let v0 = s.load(input.add(*tap));
                    let v1 = s.load(input.add(*tap + S::LANES));
                    $(
                        let weight = s.splat(*w.add($c));
                        $a = s.mul_add(weight, v0, $a);
                        $b = s.mul_add(weight, v1, $b);
                    )*
                    w = w.add(GROUP);
                    tap = tap.add(1);
                }
                let output = row.output.add(x);
                if row.width - x >= 2 * S::LANES {
                    $(
                        let out = output.add($c * row.channel_stride);
                        s.store(out, $a);
                        s.store(out.add(S::LANES), $b);
                    )*
                } else {
                    let mut spare = [0.0f32; 32];
                    $(
                        s.store(spare.as_mut_ptr(), $a);
                        s.store(spare.as_mut_ptr().add(S::LANES), $b);
                        let out = output.add($c * row.channel_stride);
                        core::ptr::copy_nonoverlapping(spare.as_ptr(), out, row.width - x);
                    )*
                }
            }
        }
    };
}

row_step!(eight_channels: 0 a0 b0, 1 a1 b1, 2 a2 b2, 3 a3 b3, 4 a4 b4, 5 a5 b5, 6 a6 b6, 7 a7 b7);
row_step!(four_channels: 0 a0 b0, 1 a1 b1, 2 a2 b2, 3 a3 b3);

/// Computes one row of the first layer for one group of channels.
///
/// # Safety
/// The input pointer plus any tap plus the width, rounded up to whole steps, is readable; weights and biases
/// are packed for the group; the output holds `width` floats per channel, rounded up to whole vectors. The
/// floats after `width` are zero and stay zero (SELU(0) = 0). No other thread accesses the output.
#[inline(always)]
pub(super) unsafe fn run_row<S: Simd>(s: S, row: &Row) {
    let mut x = 0;
    while x < row.width {
        // SAFETY: the caller guarantees (see `# Safety`) that input, weights and biases are readable for
        // every step, and that the output is writable.
        unsafe {
            if S::LANES == 16 {
                eight_channels(s, row, x);
            } else {
                four_channels(s, row, x);
            }
        }
        x += 2 * S::LANES;
    }
    for c in 0..row.channels {
        for x in (0..row.width).step_by(S::LANES) {
            // SAFETY: the caller guarantees that the output holds `width` floats per channel, rounded up to
            // whole vectors.
            unsafe {
                let p = row.output.add(c * row.channel_stride + x);
                s.store(p, s.selu(s.load(p)));
            }
        }
    }
}
