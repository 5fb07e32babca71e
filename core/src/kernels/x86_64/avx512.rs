//! Vector operations with AVX-512 F, BW, DQ and VL, with and without VNNI. Only this file has functions that
//! enable these instructions by `#[target_feature]`.

use crate::kernels::simd::{Kernel, Simd};
use crate::memory::chunks;
use core::arch::x86_64::*;

/// Token that proves that the CPU has AVX-512 F, BW, DQ and VL, and VNNI too if `VNNI` is true; made only
/// inside [`enter`] and [`enter_vnni`].
#[derive(Clone, Copy)]
pub(crate) struct Avx512<const VNNI: bool>(());

/// Runs a kernel with AVX-512 F, BW, DQ and VL.
///
/// # Safety
/// The CPU has these instructions.
#[target_feature(enable = "avx2,fma,f16c,popcnt,avx512f,avx512bw,avx512dq,avx512vl")]
pub(crate) unsafe fn enter<K: Kernel>(kernel: K) -> K::Output {
    kernel.run(Avx512::<false>(()))
}

/// Runs a kernel with AVX-512 F, BW, DQ, VL and VNNI.
///
/// # Safety
/// The CPU has these instructions.
#[target_feature(enable = "avx2,fma,f16c,popcnt,avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
pub(crate) unsafe fn enter_vnni<K: Kernel>(kernel: K) -> K::Output {
    kernel.run(Avx512::<true>(()))
}

impl<const VNNI: bool> Simd for Avx512<VNNI> {
    type F = __m512;
    type I = __m512i;
    type M = __mmask16;
    const LANES: usize = 16;
    const TILE_VECTORS: usize = 4;
    const MAX_COUNTED_VALUES: usize = 128;

    methods! {
        fn splat(x: f32) -> Self::F { _mm512_set1_ps(x) }
        fn add(a: Self::F, b: Self::F) -> Self::F { _mm512_add_ps(a, b) }
        fn sub(a: Self::F, b: Self::F) -> Self::F { _mm512_sub_ps(a, b) }
        fn mul(a: Self::F, b: Self::F) -> Self::F { _mm512_mul_ps(a, b) }
        fn mul_add(a: Self::F, b: Self::F, c: Self::F) -> Self::F { _mm512_fmadd_ps(a, b, c) }
        fn neg_mul_add(a: Self::F, b: Self::F, c: Self::F) -> Self::F { _mm512_fnmadd_ps(a, b, c) }
        fn max(a: Self::F, b: Self::F) -> Self::F { _mm512_max_ps(a, b) }
        fn min(a: Self::F, b: Self::F) -> Self::F { _mm512_min_ps(a, b) }
        fn if_positive(x: Self::F, positive: Self::F, other: Self::F) -> Self::F {
            let mask = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(x, _mm512_setzero_ps());
            _mm512_mask_blend_ps(mask, other, positive)
        }
        fn scale_by_power(scale: f32, shifted: Self::F) -> Self::F {
            let exponent = _mm512_slli_epi32::<23>(_mm512_castps_si512(shifted));
            _mm512_castsi512_ps(_mm512_add_epi32(exponent, _mm512_set1_epi32(scale.to_bits() as i32)))
        }
        fn sum(v: Self::F) -> f32 {
            let v = _mm256_add_ps(_mm512_castps512_ps256(v), _mm512_extractf32x8_ps::<1>(v));
            let v = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps::<1>(v));
            let v = _mm_add_ps(v, _mm_movehl_ps(v, v));
            _mm_cvtss_f32(_mm_add_ss(v, _mm_movehdup_ps(v)))
        }
        fn largest(v: Self::F) -> f32 {
            let v = _mm256_max_ps(_mm512_castps512_ps256(v), _mm512_extractf32x8_ps::<1>(v));
            let v = _mm_max_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps::<1>(v));
            let v = _mm_max_ps(v, _mm_movehl_ps(v, v));
            _mm_cvtss_f32(_mm_max_ss(v, _mm_movehdup_ps(v)))
        }
        fn to_f(v: Self::I) -> Self::F { _mm512_cvtepi32_ps(v) }
        fn add_i(a: Self::I, b: Self::I) -> Self::I { _mm512_add_epi32(a, b) }
        fn div(a: Self::F, b: Self::F) -> Self::F { _mm512_div_ps(a, b) }
        fn sqrt(a: Self::F) -> Self::F { _mm512_sqrt_ps(a) }
        fn lt(a: Self::F, b: Self::F) -> Self::M { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b) }
        fn le(a: Self::F, b: Self::F) -> Self::M { _mm512_cmp_ps_mask::<_CMP_LE_OQ>(a, b) }
        fn select(m: Self::M, yes: Self::F, no: Self::F) -> Self::F { _mm512_mask_blend_ps(m, no, yes) }
        fn select_i(m: Self::M, yes: Self::I, no: Self::I) -> Self::I { _mm512_mask_blend_epi32(m, no, yes) }
        fn splat_i(x: i32) -> Self::I { _mm512_set1_epi32(x) }
        fn add_if(a: Self::I, m: Self::M, b: Self::I) -> Self::I { _mm512_mask_add_epi32(a, m, a, b) }
        fn mul_i(a: Self::I, b: i32) -> Self::I { _mm512_mullo_epi32(a, _mm512_set1_epi32(b)) }
        fn trunc(v: Self::F) -> Self::I { _mm512_cvttps_epi32(v) }
        fn as_f(v: Self::I) -> Self::F { _mm512_castsi512_ps(v) }
        fn and_i(a: Self::I, b: i32) -> Self::I { _mm512_and_si512(a, _mm512_set1_epi32(b)) }
        fn xor_i(a: Self::I, b: Self::I) -> Self::I { _mm512_xor_si512(a, b) }
        fn nonzero(a: Self::I) -> Self::M { _mm512_test_epi32_mask(a, a) }
    }

    prefetches! { prefetch _MM_HINT_T1 prefetch_near _MM_HINT_T0 }
    #[inline(always)]
    unsafe fn load(self, p: *const f32) -> Self::F {
        // SAFETY: the token proves AVX-512; the caller guarantees that `p` is valid for reading 16 floats.
        unsafe { _mm512_loadu_ps(p) }
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut f32, v: Self::F) {
        // SAFETY: the token proves AVX-512; the caller guarantees that `p` is valid for writing 16 floats.
        unsafe { _mm512_storeu_ps(p, v) }
    }
    #[inline(always)]
    unsafe fn load_f16(self, p: *const u16) -> Self::F {
        // SAFETY: the token proves AVX-512; the caller guarantees that `p` is valid for reading 16
        // half-precision numbers.
        unsafe { _mm512_cvtph_ps(_mm256_loadu_si256(p.cast())) }
    }
    #[inline(always)]
    unsafe fn load_bf16_pairs(self, p: *const u32) -> (Self::F, Self::F) {
        // SAFETY: the token proves AVX-512; the caller guarantees that `p` is valid for reading 16 words of
        // 32 bits.
        unsafe {
            let words = _mm512_loadu_si512(p.cast());
            let upper = _mm512_and_si512(words, _mm512_set1_epi32(0xffff_0000_u32 as i32));
            (_mm512_castsi512_ps(_mm512_slli_epi32::<16>(words)), _mm512_castsi512_ps(upper))
        }
    }
    #[inline(always)]
    unsafe fn load_bytes(self, p: *const i8) -> Self::I {
        // SAFETY: the token proves AVX-512; the caller guarantees that `p` is valid for reading 64 bytes.
        unsafe { _mm512_loadu_si512(p.cast()) }
    }
    #[inline(always)]
    fn dot4(self, sum: Self::I, a: Self::I, w: Self::I) -> Self::I {
        // SAFETY: the token proves AVX-512, and VNNI too if its parameter `VNNI` is true.
        unsafe {
            if VNNI {
                return _mm512_dpbusd_epi32(sum, a, w);
            }
            // Even and odd bytes are multiplied separately: the sum of two products of 255·127 would overflow
            // the 16 bits of maddubs, but fits 32 bits.
            let low = _mm512_set1_epi16(0xff);
            let even = _mm512_madd_epi16(
                _mm512_and_si512(a, low),
                _mm512_srai_epi16::<8>(_mm512_slli_epi16::<8>(w)),
            );
            let odd = _mm512_madd_epi16(_mm512_srli_epi16::<8>(a), _mm512_srai_epi16::<8>(w));
            _mm512_add_epi32(sum, _mm512_add_epi32(even, odd))
        }
    }
    #[inline(always)]
    unsafe fn store_u8(self, p: *mut u8, v: Self::F) {
        // SAFETY: the token proves AVX-512; the caller guarantees that `p` is valid for writing 16 bytes.
        unsafe {
            let v = _mm512_max_epi32(_mm512_cvtps_epi32(v), _mm512_setzero_si512());
            _mm_storeu_si128(p.cast(), _mm512_cvtusepi32_epi8(v));
        }
    }
    #[inline(always)]
    fn write_i(self, v: Self::I, to: &mut [i32; 16]) {
        // SAFETY: the token proves AVX-512; `to` has 16 elements, and 16 are written.
        unsafe { _mm512_storeu_si512(to.as_mut_ptr().cast(), v) }
    }
    #[inline(always)]
    fn and_m(self, a: Self::M, b: Self::M) -> Self::M {
        a & b
    }
    #[inline(always)]
    fn and_not_m(self, a: Self::M, b: Self::M) -> Self::M {
        a & !b
    }
    #[inline(always)]
    fn any(self, m: Self::M) -> bool {
        m != 0
    }
    #[inline(always)]
    fn lane_bits(self, m: Self::M) -> u32 {
        u32::from(m)
    }
    #[inline(always)]
    fn gather(self, from: &[u32], index: Self::I) -> Self::I {
        assert!(!from.is_empty() && from.len() <= i32::MAX as usize, "`from` is empty or too long");
        // SAFETY: the token proves AVX-512; `from` is not empty, and each index is clamped to its last word.
        unsafe {
            let index = _mm512_min_epu32(index, _mm512_set1_epi32(from.len() as i32 - 1));
            // Scalar loads replace a gather instruction, which takes two to three times as long as these
            // loads on many machines.
            let mut at = [0u32; 16];
            _mm512_storeu_si512(at.as_mut_ptr().cast(), index);
            let [low, high] = [eight_words(from, &at, 0), eight_words(from, &at, 8)];
            _mm512_inserti64x4::<1>(_mm512_castsi256_si512(low), high)
        }
    }
    #[inline(always)]
    fn overlaps(self, low: &[u8; 64], high: &[u8; 64], first: u8, last: u8) -> u64 {
        // SAFETY: the token proves AVX-512; `low` and `high` have the 64 bytes that are read.
        unsafe {
            let low = _mm512_loadu_si512(low.as_ptr().cast());
            let high = _mm512_loadu_si512(high.as_ptr().cast());
            _mm512_cmple_epu8_mask(low, _mm512_set1_epi8(last as i8))
                & _mm512_cmpge_epu8_mask(high, _mm512_set1_epi8(first as i8))
        }
    }
    #[inline(always)]
    fn count_eight(self, bytes: &[u8], first: u8) -> [u32; 8] {
        let mut counts = [0; 8];
        let (blocks, rest) = chunks::<1024, _>(bytes);
        let (halves, rest) = chunks::<512, _>(rest);
        // SAFETY: the token proves AVX-512; a block has 1024 bytes (sixteen vectors), and half a block has
        // 512.
        unsafe {
            let zero = _mm512_setzero_si512();
            let (mut sums, mut eights) = ([zero; 3], zero);
            for block in blocks {
                let [low, high] = [block.as_ptr(), block.as_ptr().add(512)];
                let (half, one) = add_eight(low, first, sums);
                let (whole, other) = add_eight(high, first, half);
                let sixteens = _mm512_ternarylogic_epi32::<0xe8>(eights, one, other);
                eights = _mm512_ternarylogic_epi32::<0x96>(eights, one, other);
                sums = whole;
                take(&mut counts, sixteens, 16);
            }
            for half in halves {
                let (whole, other) = add_eight(half.as_ptr(), first, sums);
                sums = whole;
                take(&mut counts, other, 8);
            }
            if !blocks.is_empty() {
                take(&mut counts, eights, 8);
            }
            let [ones, twos, fours] = sums;
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
        // The lanes are compressed in a register and stored as a whole vector, since compressing stores are
        // slow on some machines.
        // SAFETY: the token proves that the CPU has AVX-512.
        self.write(unsafe { _mm512_maskz_compress_ps(m, v) }, to);
        m.count_ones() as usize
    }
}

/// Returns the one-hot codes of 64 bytes: value first + i sets bit i (i < 8), any other value sets no bit.
///
/// # Safety
/// The CPU has AVX-512 F and BW, and `p` is valid for reading 64 bytes.
#[inline(always)]
unsafe fn bits_of(p: *const u8, first: u8) -> __m512i {
    // SAFETY: the caller guarantees AVX-512 F and BW, and that `p` is valid for reading 64 bytes.
    unsafe {
        let bits = _mm_setr_epi8(1, 2, 4, 8, 16, 32, 64, -128, 0, 0, 0, 0, 0, 0, 0, 0);
        let index = _mm512_sub_epi8(_mm512_loadu_si512(p.cast()), _mm512_set1_epi8(first as i8));
        // A value of `first` + 16 or more gives a shuffle index with the highest bit set, which gives zero.
        _mm512_shuffle_epi8(_mm512_broadcast_i32x4(bits), _mm512_adds_epu8(index, _mm512_set1_epi8(0x70)))
    }
}

/// Bitwise full adder: sum and carry of three vectors.
///
/// # Safety
/// The CPU has AVX-512 F.
#[inline(always)]
unsafe fn add_bits(a: __m512i, b: __m512i, c: __m512i) -> (__m512i, __m512i) {
    // SAFETY: the caller guarantees that the CPU has AVX-512 F.
    unsafe { (_mm512_ternarylogic_epi32::<0x96>(a, b, c), _mm512_ternarylogic_epi32::<0xe8>(a, b, c)) }
}

/// Carry-save adder: adds the one-hot codes ([`bits_of`]) of eight vectors to the bit planes of weight one,
/// two and four. Returns these planes, and the carry plane of weight eight.
///
/// # Safety
/// As [`bits_of`], but `p` is valid for reading 512 bytes.
#[inline(always)]
unsafe fn add_eight(p: *const u8, first: u8, [ones, twos, fours]: [__m512i; 3]) -> ([__m512i; 3], __m512i) {
    // SAFETY: the caller guarantees AVX-512 F and BW, and that `p` is valid for reading 512 bytes.
    unsafe {
        let (a, two) = add_bits(ones, bits_of(p, first), bits_of(p.add(64), first));
        let (b, second) = add_bits(a, bits_of(p.add(128), first), bits_of(p.add(192), first));
        let (twos, four) = add_bits(twos, two, second);
        let (c, third) = add_bits(b, bits_of(p.add(256), first), bits_of(p.add(320), first));
        let (ones, fourth) = add_bits(c, bits_of(p.add(384), first), bits_of(p.add(448), first));
        let (twos, other) = add_bits(twos, third, fourth);
        let (fours, eights) = add_bits(fours, four, other);
        ([ones, twos, fours], eights)
    }
}

/// Adds to count i `weight` times the number of bytes of `sums` in which bit i is set.
///
/// # Safety
/// The CPU has AVX-512 BW.
#[inline(always)]
unsafe fn take(counts: &mut [u32; 8], mut sums: __m512i, weight: u32) {
    for count in counts.iter_mut().rev() {
        // SAFETY: the caller guarantees that the CPU has AVX-512 BW.
        unsafe {
            *count += weight * _mm512_movepi8_mask(sums).count_ones();
            sums = _mm512_add_epi8(sums, sums);
        }
    }
}

/// The words of `from` at the four indices `at[i..i + 4]`.
///
/// # Safety
/// `at` has these entries, and each is less than the length of `from`.
#[inline(always)]
unsafe fn four_words(from: &[u32], at: &[u32; 16], i: usize) -> __m128i {
    // SAFETY: the caller guarantees that each index is below the length of `from`; SSE2 is part of x86-64.
    unsafe {
        let [a, b, c, d] = [at[i], at[i + 1], at[i + 2], at[i + 3]].map(|at| at as usize);
        let (a, b) = (*from.get_unchecked(a) as i32, *from.get_unchecked(b) as i32);
        _mm_setr_epi32(a, b, *from.get_unchecked(c) as i32, *from.get_unchecked(d) as i32)
    }
}

/// The words of `from` at the eight indices `at[i..i + 8]`.
///
/// # Safety
/// As [`four_words`], for eight entries; the CPU has AVX2.
#[inline(always)]
unsafe fn eight_words(from: &[u32], at: &[u32; 16], i: usize) -> __m256i {
    // SAFETY: the caller guarantees AVX2, that `at` has these eight entries, and that each is below the
    // length of `from`.
    unsafe {
        let low = _mm256_castsi128_si256(four_words(from, at, i));
        _mm256_inserti128_si256::<1>(low, four_words(from, at, i + 4))
    }
}
