//! The few vector operations that the kernels are written in, once for every instruction set.
//!
//! A kernel implements [`Kernel`]: one generic body, everything in it `#[inline(always)]`. The module
//! `dispatch` enters a function that has a level's instructions enabled and hands the body that level's
//! [`Simd`] token, so a network is dispatched once and compiled once per instruction set.

use super::activation::{SELU_ALPHA, SELU_SCALE};

/// Work that can run on any level. `run` must be `#[inline(always)]`, and so must every generic function it
/// calls: what is not inlined is compiled without the level's instructions.
pub trait Kernel {
    /// What the work gives back.
    type Output;

    /// Does the work.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// The token of one instruction set: whoever holds one may use its instructions, so its methods are safe
/// except for those that take pointers.
///
/// Pointers need no alignment beyond that of their element.
#[allow(dead_code, reason = "one vocabulary for all kernels, whichever of them are compiled in")]
pub trait Simd: Copy + 'static {
    /// A vector of `LANES` f32.
    type F: Copy;
    /// A vector of `LANES` i32.
    type I: Copy;
    /// A choice of lanes.
    type M: Copy;
    /// 4, 8 or 16.
    const LANES: usize;
    /// Rows and vectors of the accumulator tile that fits the register file.
    const TILE_ROWS: usize;
    /// See `TILE_ROWS`.
    const TILE_VECTORS: usize;

    /// Asks for the cache line at `p` to be brought into the second-level cache; a hint that may do nothing.
    fn prefetch(self, p: *const f32);
    /// As [`prefetch`](Self::prefetch), into the first-level cache.
    fn prefetch_near(self, p: *const f32);
    /// The same number in every lane.
    fn splat(self, x: f32) -> Self::F;
    /// # Safety
    /// `p` must be valid for reading `LANES` numbers.
    unsafe fn load(self, p: *const f32) -> Self::F;
    /// # Safety
    /// `p` must be valid for writing `LANES` numbers.
    unsafe fn store(self, p: *mut f32, v: Self::F);
    /// Widens `LANES` IEEE half-precision numbers.
    /// # Safety
    /// `p` must be valid for reading `LANES` numbers.
    unsafe fn load_f16(self, p: *const u16) -> Self::F;
    /// Widens `LANES` pairs of bfloat16: the lower and the upper halves of 32-bit words.
    /// # Safety
    /// `p` must be valid for reading `LANES` words.
    unsafe fn load_bf16_pairs(self, p: *const u32) -> (Self::F, Self::F);

    /// a + b.
    fn add(self, a: Self::F, b: Self::F) -> Self::F;
    /// a − b.
    fn sub(self, a: Self::F, b: Self::F) -> Self::F;
    /// a·b.
    fn mul(self, a: Self::F, b: Self::F) -> Self::F;
    /// a·b + c, rounded once where the instruction set has it.
    fn mul_add(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// c − a·b.
    fn neg_mul_add(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// The larger; `b` where either is NaN.
    fn max(self, a: Self::F, b: Self::F) -> Self::F;
    /// The smaller; `b` where either is NaN.
    fn min(self, a: Self::F, b: Self::F) -> Self::F;
    /// `positive` in the lanes where `x > 0`, `other` in the rest (NaN included).
    fn if_positive(self, x: Self::F, positive: Self::F, other: Self::F) -> Self::F;
    /// `scale`·2ⁿ for a `shifted` = 1.5·2²³ + n, by adding n to the exponent; the result must be normal.
    fn scale_by_power(self, scale: f32, shifted: Self::F) -> Self::F;
    /// Sum of the lanes, in a fixed order.
    fn sum(self, v: Self::F) -> f32;
    /// Largest lane; lanes must not be NaN.
    fn largest(self, v: Self::F) -> f32;
    /// Smallest lane; lanes must not be NaN.
    #[inline(always)]
    fn smallest(self, v: Self::F) -> f32 {
        -self.largest(self.sub(self.splat(0.0), v))
    }

    /// Zero in every lane.
    fn zero_i(self) -> Self::I;
    /// Integers as floats, rounded to nearest.
    fn to_f(self, v: Self::I) -> Self::F;
    /// The same four bytes in every lane.
    fn splat_bytes(self, bytes: u32) -> Self::I;
    /// # Safety
    /// `p` must be valid for reading 4·`LANES` bytes.
    unsafe fn load_bytes(self, p: *const i8) -> Self::I;
    /// Adds to each 32-bit lane of `sum` the four products of unsigned bytes of `a` with signed bytes of `w`.
    /// Never saturates.
    fn dot4(self, sum: Self::I, a: Self::I, w: Self::I) -> Self::I;
    /// a + b, wrapping.
    fn add_i(self, a: Self::I, b: Self::I) -> Self::I;
    /// Rounds to the nearest integers, clamps to 0…255 and stores `LANES` bytes.
    /// # Safety
    /// `p` must be valid for writing `LANES` bytes.
    unsafe fn store_u8(self, p: *mut u8, v: Self::F);

    /// The first `LANES` numbers.
    ///
    /// # Panics
    /// When there are fewer.
    #[inline(always)]
    fn read(self, from: &[f32]) -> Self::F {
        assert!(from.len() >= Self::LANES, "fewer numbers than lanes");
        // SAFETY: as many numbers as lanes are there.
        unsafe { self.load(from.as_ptr()) }
    }
    /// Writes the first `LANES` numbers.
    ///
    /// # Panics
    /// When there is less room.
    #[inline(always)]
    fn write(self, v: Self::F, to: &mut [f32]) {
        assert!(to.len() >= Self::LANES, "less room than lanes");
        // SAFETY: there is room for as many numbers as lanes.
        unsafe { self.store(to.as_mut_ptr(), v) }
    }
    /// The first `LANES` integers.
    ///
    /// # Panics
    /// When there are fewer.
    #[inline(always)]
    fn read_i(self, from: &[i32]) -> Self::I {
        assert!(from.len() >= Self::LANES, "fewer numbers than lanes");
        // SAFETY: as many integers as lanes are there.
        unsafe { self.load_bytes(from.as_ptr().cast()) }
    }
    /// Writes the first `LANES` integers.
    fn write_i(self, v: Self::I, to: &mut [i32; 16]);
    /// a / b, correctly rounded.
    fn div(self, a: Self::F, b: Self::F) -> Self::F;
    /// Square root, correctly rounded.
    fn sqrt(self, a: Self::F) -> Self::F;
    /// a < b; not where either is NaN.
    fn lt(self, a: Self::F, b: Self::F) -> Self::M;
    /// a ≤ b; not where either is NaN.
    fn le(self, a: Self::F, b: Self::F) -> Self::M;
    /// Lanes that both choose.
    fn and_m(self, a: Self::M, b: Self::M) -> Self::M;
    /// a without b.
    fn and_not_m(self, a: Self::M, b: Self::M) -> Self::M;
    /// Whether any lane is chosen.
    fn any(self, m: Self::M) -> bool;
    /// A bit per lane, the first lane lowest.
    fn lane_bits(self, m: Self::M) -> u32;
    /// `yes` in the chosen lanes, `no` in the others.
    fn select(self, m: Self::M, yes: Self::F, no: Self::F) -> Self::F;
    /// As [`select`](Self::select), for integers.
    fn select_i(self, m: Self::M, yes: Self::I, no: Self::I) -> Self::I;
    /// The same integer in every lane.
    fn splat_i(self, x: i32) -> Self::I;
    /// a + b in the chosen lanes, a in the others.
    fn add_if(self, a: Self::I, m: Self::M, b: Self::I) -> Self::I;
    /// a·b, wrapping.
    fn mul_i(self, a: Self::I, b: i32) -> Self::I;
    /// Rounds towards zero; what no i32 holds gives anything.
    fn trunc(self, v: Self::F) -> Self::I;
    /// The same bits as floating-point numbers.
    fn as_f(self, v: Self::I) -> Self::F;
    /// The words at `index`, taken as unsigned; beyond the end, the last one. There must be one.
    fn gather(self, from: &[u32], index: Self::I) -> Self::I;
    /// Bits of a that are also in b.
    fn and_i(self, a: Self::I, b: i32) -> Self::I;
    /// Bits of either, not of both.
    fn xor_i(self, a: Self::I, b: Self::I) -> Self::I;
    /// Which lanes are not zero.
    fn nonzero(self, a: Self::I) -> Self::M;
    /// Writes the chosen lanes one after another, and gives their number. There must be room for 16.
    fn compress(self, m: Self::M, v: Self::F, to: &mut [f32]) -> usize;

    /// A bit for each pair of bounds, set where `low` ≤ `last` and `high` ≥ `first`.
    fn overlaps(self, low: &[u8; 64], high: &[u8; 64], first: u8, last: u8) -> u64;
    /// Up to how many values that bytes may have [`count_eight`](Self::count_eight) is the fastest way to
    /// count them.
    const COUNTED: usize;
    /// How many bytes have each of eight values from `first` on, which is 248 at most. There must be fewer
    /// than 2³² bytes.
    fn count_eight(self, bytes: &[u8], first: u8) -> [u32; 8];

    /// SELU(x) = λ·x for x > 0, λ·α·(eˣ − 1) otherwise, within
    /// the tolerance of [`selu`](super::selu). NaN stays NaN.
    ///
    /// eˣ − 1 = 2ⁿ·(eʳ − 1) + (2ⁿ − 1) with n = round(x / ln 2): exact near zero, where eˣ − 1 cancels.
    #[inline(always)]
    fn selu(self, x: Self::F) -> Self::F {
        /// 1.5·2²³: adding it rounds to an integer, which then stands in the low bits.
        const SHIFT: f32 = 12_582_912.0;
        const LAMBDA: f32 = SELU_SCALE as f32;
        const LAMBDA_ALPHA: f32 = (SELU_SCALE * SELU_ALPHA) as f32;
        // Minimax for (eʳ − 1 − r) / r² on |r| ≤ ln 2 / 2; relative error of eʳ − 1 below 2e-8.
        const Q: [f32; 5] = [0.499_999_97, 0.166_665_43, 0.041_667_2, 0.008_366_547_5, 0.001_388_251_7];
        // Below -20 the result is -λα to the last bit.
        let t = self.max(self.splat(-20.0), x);
        let shifted = self.mul_add(t, self.splat(core::f32::consts::LOG2_E), self.splat(SHIFT));
        let n = self.sub(shifted, self.splat(SHIFT));
        let r = self.neg_mul_add(n, self.splat(core::f32::consts::LN_2), t);
        let mut q = self.splat(Q[4]);
        q = self.mul_add(q, r, self.splat(Q[3]));
        q = self.mul_add(q, r, self.splat(Q[2]));
        q = self.mul_add(q, r, self.splat(Q[1]));
        q = self.mul_add(q, r, self.splat(Q[0]));
        let p = self.mul_add(self.mul(r, r), q, r);
        let s = self.scale_by_power(LAMBDA_ALPHA, shifted);
        let negative = self.mul_add(s, p, self.sub(s, self.splat(LAMBDA_ALPHA)));
        self.if_positive(x, self.mul(x, self.splat(LAMBDA)), negative)
    }
}
