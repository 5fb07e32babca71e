//! Vector operations of the kernels, with the same names for every instruction set.
//!
//! A kernel implements [`Kernel`]: one generic body in which every function is `#[inline(always)]`. The
//! module `dispatch` enters a function that has a level's instructions enabled and passes the level's
//! [`Simd`] token to the body. So the level is chosen once per run of a kernel, and the kernel is compiled
//! once per instruction set.

/// SELU's scale λ (Klambauer et al. 2017, self-normalizing networks).
pub const SELU_SCALE: f64 = 1.050_700_987_355_480_5;
/// SELU's α: SELU(x) = λ·x for x > 0, λ·α·(eˣ − 1) otherwise.
pub const SELU_ALPHA: f64 = 1.673_263_242_354_377_2;

/// Work that can run on any level. `run` must be `#[inline(always)]`, and so must every generic function it
/// calls: code that is not inlined is compiled without the level's instructions.
pub trait Kernel {
    /// Result of the work.
    type Output;

    /// Does the work with the instructions of `simd`.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// Token of one instruction set. A token exists only if the CPU has the instructions, so its methods are
/// safe, except for those that read or write through a pointer.
///
/// Pointers need no alignment beyond that of their element.
#[allow(dead_code, reason = "one vocabulary for all kernels, whichever of them are compiled in")]
pub trait Simd: Copy + 'static {
    /// A vector of `LANES` f32.
    type F: Copy;
    /// A vector of `LANES` i32.
    type I: Copy;
    /// A mask of lanes.
    type M: Copy;
    /// Number of lanes: 4, 8 or 16.
    const LANES: usize;
    /// Number of vectors per row of the largest accumulator tile that fits the register file.
    const TILE_VECTORS: usize;

    /// Prefetches the cache line at `p` into the second-level cache; a hint that may do nothing.
    fn prefetch(self, p: *const f32);
    /// Prefetches the cache line at `p` into the first-level cache; a hint that may do nothing.
    fn prefetch_near(self, p: *const f32);
    /// `x` in every lane.
    fn splat(self, x: f32) -> Self::F;
    /// Loads `LANES` floats.
    /// # Safety
    /// `p` must be valid for reading `LANES` floats.
    unsafe fn load(self, p: *const f32) -> Self::F;
    /// Stores `LANES` floats.
    /// # Safety
    /// `p` must be valid for writing `LANES` floats.
    unsafe fn store(self, p: *mut f32, v: Self::F);
    /// Widens `LANES` IEEE half-precision numbers.
    /// # Safety
    /// `p` must be valid for reading `LANES` numbers.
    unsafe fn load_f16(self, p: *const u16) -> Self::F;
    /// Widens `LANES` pairs of bfloat16, the lower and the upper halves of 32-bit words.
    /// # Safety
    /// `p` must be valid for reading `LANES` words.
    unsafe fn load_bf16_pairs(self, p: *const u32) -> (Self::F, Self::F);

    /// a + b.
    fn add(self, a: Self::F, b: Self::F) -> Self::F;
    /// a − b.
    fn sub(self, a: Self::F, b: Self::F) -> Self::F;
    /// a·b.
    fn mul(self, a: Self::F, b: Self::F) -> Self::F;
    /// a·b + c, fused where the instruction set allows.
    fn mul_add(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// c − a·b, fused where the instruction set allows.
    fn neg_mul_add(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// The larger of `a` and `b`; `b` if one of them is NaN.
    fn max(self, a: Self::F, b: Self::F) -> Self::F;
    /// The smaller of `a` and `b`; `b` if one of them is NaN.
    fn min(self, a: Self::F, b: Self::F) -> Self::F;
    /// `positive` in the lanes where `x > 0`, `other` in all other lanes (also where `x` is NaN).
    fn if_positive(self, x: Self::F, positive: Self::F, other: Self::F) -> Self::F;
    /// `scale`·2ⁿ for `shifted` = 1.5·2²³ + n, computed by adding n to the exponent; the result must be a
    /// normal number.
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

    /// Integers as floats, rounded to nearest.
    fn to_f(self, v: Self::I) -> Self::F;
    /// Loads 4·`LANES` bytes, four per lane.
    /// # Safety
    /// `p` must be valid for reading 4·`LANES` bytes.
    unsafe fn load_bytes(self, p: *const i8) -> Self::I;
    /// Adds to each 32-bit lane of `sum` the dot product of four unsigned bytes of `a` and four signed bytes
    /// of `w`. Never saturates.
    fn dot4(self, sum: Self::I, a: Self::I, w: Self::I) -> Self::I;
    /// a + b, wrapping.
    fn add_i(self, a: Self::I, b: Self::I) -> Self::I;
    /// Rounds to the nearest integers, clamps to 0…255 and stores `LANES` bytes.
    /// # Safety
    /// `p` must be valid for writing `LANES` bytes.
    unsafe fn store_u8(self, p: *mut u8, v: Self::F);

    /// Loads the first `LANES` floats.
    ///
    /// # Panics
    /// If `from` has fewer than `LANES` elements.
    #[inline(always)]
    fn read(self, from: &[f32]) -> Self::F {
        assert!(from.len() >= Self::LANES, "fewer numbers than lanes");
        // SAFETY: the assertion has checked that `from` has `LANES` floats to read.
        unsafe { self.load(from.as_ptr()) }
    }
    /// Stores `v` to the first `LANES` floats.
    ///
    /// # Panics
    /// If `to` has fewer than `LANES` elements.
    #[inline(always)]
    fn write(self, v: Self::F, to: &mut [f32]) {
        assert!(to.len() >= Self::LANES, "fewer elements than lanes");
        // SAFETY: the assertion has checked that `to` has `LANES` floats to write.
        unsafe { self.store(to.as_mut_ptr(), v) }
    }
    /// Loads the first `LANES` integers.
    ///
    /// # Panics
    /// If `from` has fewer than `LANES` elements.
    #[inline(always)]
    fn read_i(self, from: &[i32]) -> Self::I {
        assert!(from.len() >= Self::LANES, "fewer numbers than lanes");
        // SAFETY: the assertion has checked that `from` has `LANES` integers to read.
        unsafe { self.load_bytes(from.as_ptr().cast()) }
    }
    /// Stores `v` to the first `LANES` integers.
    fn write_i(self, v: Self::I, to: &mut [i32; 16]);
    /// a / b, correctly rounded.
    fn div(self, a: Self::F, b: Self::F) -> Self::F;
    /// Square root, correctly rounded.
    fn sqrt(self, a: Self::F) -> Self::F;
    /// a < b; false in lanes where a or b is NaN.
    fn lt(self, a: Self::F, b: Self::F) -> Self::M;
    /// a ≤ b; false in lanes where a or b is NaN.
    fn le(self, a: Self::F, b: Self::F) -> Self::M;
    /// Intersection of two masks.
    fn and_m(self, a: Self::M, b: Self::M) -> Self::M;
    /// Lanes of `a` that are not in `b`.
    fn and_not_m(self, a: Self::M, b: Self::M) -> Self::M;
    /// True if the mask has a lane set.
    fn any(self, m: Self::M) -> bool;
    /// The mask as bits; the first lane is the lowest bit.
    fn lane_bits(self, m: Self::M) -> u32;
    /// `yes` in the lanes of `m`, `no` in the others.
    fn select(self, m: Self::M, yes: Self::F, no: Self::F) -> Self::F;
    /// The integers of `yes` in the lanes of `m`, those of `no` in the others.
    fn select_i(self, m: Self::M, yes: Self::I, no: Self::I) -> Self::I;
    /// `x` in every lane.
    fn splat_i(self, x: i32) -> Self::I;
    /// a + b in the lanes of `m`, a in the others.
    fn add_if(self, a: Self::I, m: Self::M, b: Self::I) -> Self::I;
    /// a·b, wrapping.
    fn mul_i(self, a: Self::I, b: i32) -> Self::I;
    /// Rounds towards zero; unspecified for values that no i32 holds.
    fn trunc(self, v: Self::F) -> Self::I;
    /// Reinterprets the bits of integers as floats.
    fn as_f(self, v: Self::I) -> Self::F;
    /// Gathers the words of `from` at the lanes of `index`, which are read as unsigned numbers. An index
    /// beyond the end reads the last word. `from` must have 1 to 2³¹ − 1 words.
    fn gather(self, from: &[u32], index: Self::I) -> Self::I;
    /// Bitwise and.
    fn and_i(self, a: Self::I, b: i32) -> Self::I;
    /// Bitwise exclusive or.
    fn xor_i(self, a: Self::I, b: Self::I) -> Self::I;
    /// Mask of the lanes that are not zero.
    fn nonzero(self, a: Self::I) -> Self::M;
    /// Stores the lanes of `v` that `m` selects, contiguously, and returns their number. `to` must have at
    /// least 16 elements.
    fn compress(self, m: Self::M, v: Self::F, to: &mut [f32]) -> usize;

    /// One bit per pair of bounds, set where `low` ≤ `last` and `high` ≥ `first`.
    fn overlaps(self, low: &[u8; 64], high: &[u8; 64], first: u8, last: u8) -> u64;
    /// Largest number of distinct values for which [`count_eight`](Self::count_eight) counts bytes faster
    /// than tables of counters do.
    const MAX_COUNTED_VALUES: usize;
    /// Counts the bytes with each of the eight values from `first` to `first + 7`; `first` is at most 248.
    /// There must be fewer than 2³² bytes.
    fn count_eight(self, bytes: &[u8], first: u8) -> [u32; 8];

    /// SELU(x) = λ·x for x > 0, λ·α·(eˣ − 1) otherwise, within the tolerance of [`selu`](super::selu). NaN
    /// stays NaN.
    ///
    /// eˣ − 1 is computed as 2ⁿ·(eʳ − 1) + (2ⁿ − 1) with n = round(x / ln 2) and r = x − n·ln 2. Near zero,
    /// this sum is accurate, but the subtraction of 1 from eˣ would lose digits.
    #[inline(always)]
    fn selu(self, x: Self::F) -> Self::F {
        /// 1.5·2²³: adding this number rounds a value to an integer, which the low bits then hold.
        const SHIFT: f32 = 12_582_912.0;
        const LAMBDA: f32 = SELU_SCALE as f32;
        const LAMBDA_ALPHA: f32 = (SELU_SCALE * SELU_ALPHA) as f32;
        // Minimax polynomial for (eʳ − 1 − r) / r² on |r| ≤ ln 2 / 2; relative error of eʳ − 1 below 2e-8.
        const Q: [f32; 5] = [0.499_999_97, 0.166_665_43, 0.041_667_2, 0.008_366_547_5, 0.001_388_251_7];
        // Below -20 the result equals -λα to the last bit.
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
