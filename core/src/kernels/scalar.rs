//! The portable level: four lanes of plain Rust, in a form that compilers vectorize.

use super::simd::Simd;
use crate::memory::chunks;

/// Token of the portable level, which needs no special instructions.
#[derive(Clone, Copy)]
pub(crate) struct Scalar;

#[derive(Clone, Copy)]
#[repr(C, align(16))]
pub(crate) struct Four<T>([T; 4]);

#[inline(always)]
fn map<T: Copy, U>(v: Four<T>, f: impl Fn(T) -> U) -> Four<U> {
    Four([f(v.0[0]), f(v.0[1]), f(v.0[2]), f(v.0[3])])
}

#[inline(always)]
fn zip<T: Copy>(a: Four<T>, b: Four<T>, f: impl Fn(T, T) -> T) -> Four<T> {
    Four([f(a.0[0], b.0[0]), f(a.0[1], b.0[1]), f(a.0[2], b.0[2]), f(a.0[3], b.0[3])])
}

/// Defines methods of the token. The first argument, `self`, is added.
macro_rules! methods {
    ($(fn $name:ident($($argument:ident: $type:ty),*) -> $result:ty { $($body:tt)* })*) => {$(
        #[inline(always)]
        fn $name(self, $($argument: $type),*) -> $result {
            $($body)*
        }
    )*};
}

impl Simd for Scalar {
    type F = Four<f32>;
    type I = Four<i32>;
    type M = Four<bool>;
    const LANES: usize = 4;
    const TILE_VECTORS: usize = 2;
    const MAX_COUNTED_VALUES: usize = 12;

    methods! {
        fn splat(x: f32) -> Self::F { Four([x; 4]) }
        fn add(a: Self::F, b: Self::F) -> Self::F { zip(a, b, |a, b| a + b) }
        fn sub(a: Self::F, b: Self::F) -> Self::F { zip(a, b, |a, b| a - b) }
        fn mul(a: Self::F, b: Self::F) -> Self::F { zip(a, b, |a, b| a * b) }
        fn max(a: Self::F, b: Self::F) -> Self::F { zip(a, b, |a, b| if a > b { a } else { b }) }
        fn min(a: Self::F, b: Self::F) -> Self::F { zip(a, b, |a, b| if a < b { a } else { b }) }
        fn if_positive(x: Self::F, positive: Self::F, other: Self::F) -> Self::F {
            let pick = |i: usize| if x.0[i] > 0.0 { positive.0[i] } else { other.0[i] };
            Four([pick(0), pick(1), pick(2), pick(3)])
        }
        fn scale_by_power(scale: f32, shifted: Self::F) -> Self::F {
            map(shifted, |s| f32::from_bits((s.to_bits() << 23).wrapping_add(scale.to_bits())))
        }
        fn sum(v: Self::F) -> f32 { (v.0[0] + v.0[2]) + (v.0[1] + v.0[3]) }
        fn largest(v: Self::F) -> f32 { v.0[0].max(v.0[1]).max(v.0[2].max(v.0[3])) }
        fn to_f(v: Self::I) -> Self::F { map(v, |v| v as f32) }
        fn dot4(sum: Self::I, a: Self::I, w: Self::I) -> Self::I {
            let dot = |a: i32, w: i32| {
                let product = |shift: u32| (a >> shift & 0xff) * i32::from((w >> shift) as i8);
                product(0) + product(8) + product(16) + product(24)
            };
            zip(sum, zip(a, w, dot), i32::wrapping_add)
        }
        fn add_i(a: Self::I, b: Self::I) -> Self::I { zip(a, b, i32::wrapping_add) }
        fn div(a: Self::F, b: Self::F) -> Self::F { zip(a, b, |a, b| a / b) }
        fn sqrt(a: Self::F) -> Self::F { map(a, libm::sqrtf) }
        fn lt(a: Self::F, b: Self::F) -> Self::M { Four(core::array::from_fn(|i| a.0[i] < b.0[i])) }
        fn le(a: Self::F, b: Self::F) -> Self::M { Four(core::array::from_fn(|i| a.0[i] <= b.0[i])) }
        fn and_m(a: Self::M, b: Self::M) -> Self::M { zip(a, b, |a, b| a & b) }
        fn and_not_m(a: Self::M, b: Self::M) -> Self::M { zip(a, b, |a, b| a & !b) }
        fn any(m: Self::M) -> bool { m.0[0] | m.0[1] | m.0[2] | m.0[3] }
        fn lane_bits(m: Self::M) -> u32 { (0..4).map(|i| u32::from(m.0[i]) << i).sum() }
        fn select(m: Self::M, yes: Self::F, no: Self::F) -> Self::F {
            Four(core::array::from_fn(|i| if m.0[i] { yes.0[i] } else { no.0[i] }))
        }
        fn select_i(m: Self::M, yes: Self::I, no: Self::I) -> Self::I {
            Four(core::array::from_fn(|i| if m.0[i] { yes.0[i] } else { no.0[i] }))
        }
        fn splat_i(x: i32) -> Self::I { Four([x; 4]) }
        fn add_if(a: Self::I, m: Self::M, b: Self::I) -> Self::I {
            Four(core::array::from_fn(|i| if m.0[i] { a.0[i].wrapping_add(b.0[i]) } else { a.0[i] }))
        }
        fn mul_i(a: Self::I, b: i32) -> Self::I { map(a, |a| a.wrapping_mul(b)) }
        fn trunc(v: Self::F) -> Self::I { map(v, |v| v as i32) }
        fn as_f(v: Self::I) -> Self::F { map(v, |v| f32::from_bits(v as u32)) }
        fn gather(from: &[u32], index: Self::I) -> Self::I {
            let last = from.len() - 1;
            map(index, |i| from[(i as u32 as usize).min(last)] as i32)
        }
        fn and_i(a: Self::I, b: i32) -> Self::I { map(a, |a| a & b) }
        fn xor_i(a: Self::I, b: Self::I) -> Self::I { zip(a, b, |a, b| a ^ b) }
        fn nonzero(a: Self::I) -> Self::M { map(a, |a| a != 0) }
        fn count_eight(bytes: &[u8], first: u8) -> [u32; 8] {
            core::array::from_fn(|i| bytes.iter().map(|&b| u32::from(b == first + i as u8)).sum())
        }
    }

    #[inline(always)]
    fn prefetch(self, _: *const f32) {}
    #[inline(always)]
    fn prefetch_near(self, _: *const f32) {}
    #[inline(always)]
    unsafe fn load(self, p: *const f32) -> Self::F {
        // SAFETY: the caller guarantees that `p` is valid for reading four floats.
        Four(unsafe { p.cast::<[f32; 4]>().read() })
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut f32, v: Self::F) {
        // SAFETY: the caller guarantees that `p` is valid for writing four floats.
        unsafe { p.cast::<[f32; 4]>().write(v.0) }
    }
    #[inline(always)]
    unsafe fn load_f16(self, p: *const u16) -> Self::F {
        // SAFETY: the caller guarantees that `p` is valid for reading four half-precision numbers.
        map(Four(unsafe { p.cast::<[u16; 4]>().read() }), f16_to_f32)
    }
    #[inline(always)]
    unsafe fn load_bf16_pairs(self, p: *const u32) -> (Self::F, Self::F) {
        // SAFETY: the caller guarantees that `p` is valid for reading four words of 32 bits.
        let words = Four(unsafe { p.cast::<[u32; 4]>().read() });
        (map(words, |w| f32::from_bits(w << 16)), map(words, |w| f32::from_bits(w & 0xffff_0000)))
    }
    #[inline(always)]
    fn mul_add(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        self.add(self.mul(a, b), c)
    }
    #[inline(always)]
    fn neg_mul_add(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        self.sub(c, self.mul(a, b))
    }
    #[inline(always)]
    unsafe fn load_bytes(self, p: *const i8) -> Self::I {
        // SAFETY: the caller guarantees that `p` is valid for reading sixteen bytes.
        let bytes = unsafe { p.cast::<[[u8; 4]; 4]>().read() };
        map(Four(bytes), i32::from_ne_bytes)
    }
    #[inline(always)]
    unsafe fn store_u8(self, p: *mut u8, v: Self::F) {
        // Adding 2²³ rounds to nearest even, as the vector units do; values are below 2²².
        const SHIFT: f32 = 8_388_608.0;
        let bytes = map(v, |v| (v.clamp(0.0, 255.0) + SHIFT - SHIFT) as u8);
        // SAFETY: the caller guarantees that `p` is valid for writing four bytes.
        unsafe { p.cast::<[u8; 4]>().write(bytes.0) }
    }
    #[inline(always)]
    fn write_i(self, v: Self::I, to: &mut [i32; 16]) {
        to[..4].copy_from_slice(&v.0);
    }
    #[inline(always)]
    fn overlaps(self, low: &[u8; 64], high: &[u8; 64], first: u8, last: u8) -> u64 {
        let mut bits = 0;
        for (i, (low, high)) in chunks::<8, _>(low).0.iter().zip(chunks::<8, _>(high).0).enumerate() {
            let flags: [u8; 8] =
                core::array::from_fn(|k| u8::from(low[k] <= last) & u8::from(high[k] >= first));
            // Bit 8k of the flags moves to bit 56 + k of the product; no other term reaches those bits.
            let byte = u64::from_le_bytes(flags).wrapping_mul(0x0102_0408_1020_4080) >> 56;
            bits |= byte << (8 * i);
        }
        bits
    }
    #[inline(always)]
    fn compress(self, m: Self::M, v: Self::F, to: &mut [f32]) -> usize {
        let mut n = 0;
        for i in 0..4 {
            to[n] = v.0[i];
            n += usize::from(m.0[i]);
        }
        n
    }
}

/// Widens an IEEE half-precision number exactly.
#[inline(always)]
pub(crate) fn f16_to_f32(bits: u16) -> f32 {
    let sign = u32::from(bits & 0x8000) << 16;
    let rest = u32::from(bits & 0x7fff);
    // A multiplication adjusts the exponent and normalizes subnormals; infinity and NaN get the largest
    // exponent.
    let scaled = f32::from_bits(rest << 13) * f32::from_bits(0x7780_0000);
    let magnitude = if rest >= 0x7c00 { rest << 13 | 0x7f80_0000 } else { scaled.to_bits() };
    f32::from_bits(sign | magnitude)
}

#[cfg(test)]
mod tests {
    use super::{Scalar, f16_to_f32};
    use crate::kernels::simd::Simd;

    #[test]
    fn integers_are_read_in_the_machines_byte_order() {
        let integers = [1, -2, 1 << 20, i32::MIN];
        let mut read = [0; 16];
        Scalar.write_i(Scalar.read_i(&integers), &mut read);
        assert_eq!(read[..4], integers);
    }

    #[test]
    fn every_half_widens_exactly() {
        // Miri tests a sample of the half-precision numbers.
        for bits in (0..=u16::MAX).step_by(if cfg!(miri) { 97 } else { 1 }) {
            let expected = half::f16::from_bits(bits).to_f32_const();
            let found = f16_to_f32(bits);
            assert!(
                found == expected || (found.is_nan() && expected.is_nan()),
                "{bits:#06x}: {found} {expected}"
            );
            assert_eq!(found.is_sign_negative(), expected.is_sign_negative(), "{bits:#06x}");
        }
    }
}
