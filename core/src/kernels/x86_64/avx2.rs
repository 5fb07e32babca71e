//! Vector operations with AVX2, FMA, F16C and POPCNT. `enter` enables these instructions for all code that
//! is inlined into it; no other function of this file has `#[target_feature]`.

use crate::kernels::simd::{Kernel, Simd};
use crate::memory::chunks;
use core::arch::x86_64::*;

/// Token that proves that the CPU has AVX2, FMA, F16C and POPCNT; made only inside [`enter`].
#[derive(Clone, Copy)]
pub(crate) struct Avx2(());

/// Runs a kernel with AVX2, FMA, F16C and POPCNT.
///
/// # Safety
/// The CPU has these instructions.
#[target_feature(enable = "avx2,fma,f16c,popcnt")]
pub(crate) unsafe fn enter<K: Kernel>(kernel: K) -> K::Output {
    kernel.run(Avx2(()))
}

impl Simd for Avx2 {
    type F = __m256;
    type I = __m256i;
    /// Mask of lanes: the sign bits of eight floats.
    type M = __m256;
    const LANES: usize = 8;
    const TILE_VECTORS: usize = 2;
    const MAX_COUNTED_VALUES: usize = 48;

    methods! {
        fn splat(x: f32) -> Self::F { _mm256_set1_ps(x) }
        fn add(a: Self::F, b: Self::F) -> Self::F { _mm256_add_ps(a, b) }
        fn sub(a: Self::F, b: Self::F) -> Self::F { _mm256_sub_ps(a, b) }
        fn mul(a: Self::F, b: Self::F) -> Self::F { _mm256_mul_ps(a, b) }
        fn mul_add(a: Self::F, b: Self::F, c: Self::F) -> Self::F { _mm256_fmadd_ps(a, b, c) }
        fn neg_mul_add(a: Self::F, b: Self::F, c: Self::F) -> Self::F { _mm256_fnmadd_ps(a, b, c) }
        fn max(a: Self::F, b: Self::F) -> Self::F { _mm256_max_ps(a, b) }
        fn min(a: Self::F, b: Self::F) -> Self::F { _mm256_min_ps(a, b) }
        fn if_positive(x: Self::F, positive: Self::F, other: Self::F) -> Self::F {
            let mask = _mm256_cmp_ps::<_CMP_GT_OQ>(x, _mm256_setzero_ps());
            _mm256_blendv_ps(other, positive, mask)
        }
        fn scale_by_power(scale: f32, shifted: Self::F) -> Self::F {
            let exponent = _mm256_slli_epi32::<23>(_mm256_castps_si256(shifted));
            _mm256_castsi256_ps(_mm256_add_epi32(exponent, _mm256_set1_epi32(scale.to_bits() as i32)))
        }
        fn sum(v: Self::F) -> f32 {
            let v = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps::<1>(v));
            let v = _mm_add_ps(v, _mm_movehl_ps(v, v));
            _mm_cvtss_f32(_mm_add_ss(v, _mm_movehdup_ps(v)))
        }
        fn largest(v: Self::F) -> f32 {
            let v = _mm_max_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps::<1>(v));
            let v = _mm_max_ps(v, _mm_movehl_ps(v, v));
            _mm_cvtss_f32(_mm_max_ss(v, _mm_movehdup_ps(v)))
        }
        fn to_f(v: Self::I) -> Self::F { _mm256_cvtepi32_ps(v) }
        fn dot4(sum: Self::I, a: Self::I, w: Self::I) -> Self::I {
            // Even and odd bytes are multiplied separately: the sum of two products of 255·127 would overflow
            // the 16 bits of maddubs, but fits 32 bits.
            let low = _mm256_set1_epi16(0xff);
            let even = _mm256_madd_epi16(
                _mm256_and_si256(a, low),
                _mm256_srai_epi16::<8>(_mm256_slli_epi16::<8>(w)),
            );
            let odd = _mm256_madd_epi16(_mm256_srli_epi16::<8>(a), _mm256_srai_epi16::<8>(w));
            _mm256_add_epi32(sum, _mm256_add_epi32(even, odd))
        }
        fn add_i(a: Self::I, b: Self::I) -> Self::I { _mm256_add_epi32(a, b) }
        fn div(a: Self::F, b: Self::F) -> Self::F { _mm256_div_ps(a, b) }
        fn sqrt(a: Self::F) -> Self::F { _mm256_sqrt_ps(a) }
        fn lt(a: Self::F, b: Self::F) -> Self::M { _mm256_cmp_ps::<_CMP_LT_OQ>(a, b) }
        fn le(a: Self::F, b: Self::F) -> Self::M { _mm256_cmp_ps::<_CMP_LE_OQ>(a, b) }
        fn and_m(a: Self::M, b: Self::M) -> Self::M { _mm256_and_ps(a, b) }
        fn and_not_m(a: Self::M, b: Self::M) -> Self::M { _mm256_andnot_ps(b, a) }
        fn any(m: Self::M) -> bool { _mm256_movemask_ps(m) != 0 }
        fn lane_bits(m: Self::M) -> u32 { _mm256_movemask_ps(m) as u32 }
        fn select(m: Self::M, yes: Self::F, no: Self::F) -> Self::F { _mm256_blendv_ps(no, yes, m) }
        fn select_i(m: Self::M, yes: Self::I, no: Self::I) -> Self::I {
            let (yes, no) = (_mm256_castsi256_ps(yes), _mm256_castsi256_ps(no));
            _mm256_castps_si256(_mm256_blendv_ps(no, yes, m))
        }
        fn splat_i(x: i32) -> Self::I { _mm256_set1_epi32(x) }
        fn mul_i(a: Self::I, b: i32) -> Self::I { _mm256_mullo_epi32(a, _mm256_set1_epi32(b)) }
        fn trunc(v: Self::F) -> Self::I { _mm256_cvttps_epi32(v) }
        fn as_f(v: Self::I) -> Self::F { _mm256_castsi256_ps(v) }
        fn and_i(a: Self::I, b: i32) -> Self::I { _mm256_and_si256(a, _mm256_set1_epi32(b)) }
        fn xor_i(a: Self::I, b: Self::I) -> Self::I { _mm256_xor_si256(a, b) }
        fn nonzero(a: Self::I) -> Self::M {
            // The comparison marks the lanes that are zero; the exclusive or inverts the mask.
            let zero = _mm256_cmpeq_epi32(a, _mm256_setzero_si256());
            _mm256_castsi256_ps(_mm256_xor_si256(zero, _mm256_set1_epi32(-1)))
        }
    }

    prefetches! { prefetch _MM_HINT_T1 prefetch_near _MM_HINT_T0 }
    #[inline(always)]
    unsafe fn load(self, p: *const f32) -> Self::F {
        // SAFETY: the token proves AVX2; the caller guarantees that `p` is valid for reading 8 floats.
        unsafe { _mm256_loadu_ps(p) }
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut f32, v: Self::F) {
        // SAFETY: the token proves AVX2; the caller guarantees that `p` is valid for writing 8 floats.
        unsafe { _mm256_storeu_ps(p, v) }
    }
    #[inline(always)]
    unsafe fn load_f16(self, p: *const u16) -> Self::F {
        // SAFETY: the token proves F16C; the caller guarantees that `p` is valid for reading 8 half-precision
        // numbers.
        unsafe { _mm256_cvtph_ps(_mm_loadu_si128(p.cast())) }
    }
    #[inline(always)]
    unsafe fn load_bf16_pairs(self, p: *const u32) -> (Self::F, Self::F) {
        // SAFETY: the token proves AVX2; the caller guarantees that `p` is valid for reading 8 words of 32
        // bits.
        unsafe {
            let words = _mm256_loadu_si256(p.cast());
            let upper = _mm256_and_si256(words, _mm256_set1_epi32(0xffff_0000_u32 as i32));
            (_mm256_castsi256_ps(_mm256_slli_epi32::<16>(words)), _mm256_castsi256_ps(upper))
        }
    }
    #[inline(always)]
    unsafe fn load_bytes(self, p: *const i8) -> Self::I {
        // SAFETY: the token proves AVX2; the caller guarantees that `p` is valid for reading 32 bytes.
        unsafe { _mm256_loadu_si256(p.cast()) }
    }
    #[inline(always)]
    unsafe fn store_u8(self, p: *mut u8, v: Self::F) {
        // SAFETY: the token proves AVX2; the caller guarantees that `p` is valid for writing 8 bytes.
        unsafe {
            let v = _mm256_cvtps_epi32(v);
            let v = _mm_packs_epi32(_mm256_castsi256_si128(v), _mm256_extracti128_si256::<1>(v));
            _mm_storel_epi64(p.cast(), _mm_packus_epi16(v, v));
        }
    }
    #[inline(always)]
    fn write_i(self, v: Self::I, to: &mut [i32; 16]) {
        // SAFETY: the token proves AVX2; `to` has 16 elements, and 8 are written.
        unsafe { _mm256_storeu_si256(to.as_mut_ptr().cast(), v) }
    }
    #[inline(always)]
    fn add_if(self, a: Self::I, m: Self::M, b: Self::I) -> Self::I {
        self.select_i(m, self.add_i(a, b), a)
    }
    #[inline(always)]
    fn gather(self, from: &[u32], index: Self::I) -> Self::I {
        assert!(!from.is_empty() && from.len() <= i32::MAX as usize, "`from` is empty or too long");
        // SAFETY: the token proves AVX2; `from` is not empty, and each index is clamped to its last word.
        unsafe {
            let index = _mm256_min_epu32(index, _mm256_set1_epi32(from.len() as i32 - 1));
            _mm256_i32gather_epi32::<4>(from.as_ptr().cast(), index)
        }
    }
    #[inline(always)]
    fn overlaps(self, low: &[u8; 64], high: &[u8; 64], first: u8, last: u8) -> u64 {
        let half = |at: usize| {
            // SAFETY: the token proves AVX2; `low` and `high` have 64 bytes, and the 32 bytes from `at` (0 or
            // 32) on are read.
            unsafe {
                let (first, last) = (_mm256_set1_epi8(first as i8), _mm256_set1_epi8(last as i8));
                let low = _mm256_loadu_si256(low.as_ptr().add(at).cast());
                let high = _mm256_loadu_si256(high.as_ptr().add(at).cast());
                let begins = _mm256_cmpeq_epi8(_mm256_min_epu8(low, last), low);
                let ends = _mm256_cmpeq_epi8(_mm256_max_epu8(high, first), high);
                u64::from(_mm256_movemask_epi8(_mm256_and_si256(begins, ends)) as u32)
            }
        };
        half(0) | half(32) << 32
    }
    #[inline(always)]
    fn count_eight(self, bytes: &[u8], first: u8) -> [u32; 8] {
        let mut counts = [0; 8];
        let (blocks, rest) = chunks::<256, _>(bytes);
        // SAFETY: the token proves AVX2; each block has 256 bytes, which are eight vectors.
        unsafe {
            let zero = _mm256_setzero_si256();
            let (mut ones, mut twos, mut fours) = (zero, zero, zero);
            for block in blocks {
                let p = block.as_ptr();
                let (a, two) = add_bits(ones, bits_of(p, first), bits_of(p.add(32), first));
                let (b, second) = add_bits(a, bits_of(p.add(64), first), bits_of(p.add(96), first));
                let (c, third) = add_bits(b, bits_of(p.add(128), first), bits_of(p.add(160), first));
                let (d, fourth) = add_bits(c, bits_of(p.add(192), first), bits_of(p.add(224), first));
                let (e, four) = add_bits(twos, two, second);
                let (f, other) = add_bits(e, third, fourth);
                let (g, eights) = add_bits(fours, four, other);
                (ones, twos, fours) = (d, f, g);
                take(&mut counts, eights, 8);
            }
            take(&mut counts, fours, 4);
            take(&mut counts, twos, 2);
            take(&mut counts, ones, 1);
        }
        for &byte in rest {
            if let Some(count) = counts.get_mut(usize::from(byte.wrapping_sub(first))) {
                *count += 1;
            }
        }
        counts
    }
    #[inline(always)]
    fn compress(self, m: Self::M, v: Self::F, to: &mut [f32]) -> usize {
        let mut lanes = [0.0f32; 8];
        self.write(v, &mut lanes);
        let chosen = self.lane_bits(m);
        let mut n = 0;
        for (i, lane) in lanes.into_iter().enumerate() {
            to[n] = lane;
            n += (chosen >> i & 1) as usize;
        }
        n
    }
}

/// Returns the one-hot codes of 32 bytes: value first + i sets bit i (i < 8), any other value sets no bit.
///
/// # Safety
/// The CPU has AVX2, and `p` is valid for reading 32 bytes.
#[inline(always)]
unsafe fn bits_of(p: *const u8, first: u8) -> __m256i {
    // SAFETY: the caller guarantees AVX2, and that `p` is valid for reading 32 bytes.
    unsafe {
        let bits = _mm_setr_epi8(1, 2, 4, 8, 16, 32, 64, -128, 0, 0, 0, 0, 0, 0, 0, 0);
        let index = _mm256_sub_epi8(_mm256_loadu_si256(p.cast()), _mm256_set1_epi8(first as i8));
        // A value of `first` + 16 or more gives a shuffle index with the highest bit set, which gives zero.
        let index = _mm256_adds_epu8(index, _mm256_set1_epi8(0x70));
        _mm256_shuffle_epi8(_mm256_broadcastsi128_si256(bits), index)
    }
}

/// Bitwise full adder: sum and carry of three vectors.
///
/// # Safety
/// The CPU has AVX2.
#[inline(always)]
unsafe fn add_bits(a: __m256i, b: __m256i, c: __m256i) -> (__m256i, __m256i) {
    // SAFETY: the caller guarantees that the CPU has AVX2.
    unsafe {
        let ab = _mm256_xor_si256(a, b);
        let carry = _mm256_or_si256(_mm256_and_si256(a, b), _mm256_and_si256(ab, c));
        (_mm256_xor_si256(ab, c), carry)
    }
}

/// Adds to count i `weight` times the number of bytes of `sums` in which bit i is set.
///
/// # Safety
/// The CPU has AVX2.
#[inline(always)]
unsafe fn take(counts: &mut [u32; 8], mut sums: __m256i, weight: u32) {
    for count in counts.iter_mut().rev() {
        // SAFETY: the caller guarantees that the CPU has AVX2.
        unsafe {
            *count += weight * _mm256_movemask_epi8(sums).count_ones();
            sums = _mm256_add_epi8(sums, sums);
        }
    }
}
