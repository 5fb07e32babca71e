//! SELU over a slice.

use super::Level;
use super::simd::{Kernel, Simd};

#[cfg(test)]
/// Upper bound of the relative error of [`selu`] against float64, for every finite f32 whose result is a
/// normal number. The error of subnormal results is at most one unit in the last place.
const SELU_TOLERANCE: f64 = 2e-7;

/// Applies SELU to every element: relative error at most 2e-7 against float64 wherever the result is a normal
/// number. NaN stays NaN.
pub fn selu(level: Level, values: &mut [f32]) {
    level.run(Selu(values));
}

struct Selu<'a>(&'a mut [f32]);

impl Kernel for Selu<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let mut chunks = self.0.chunks_exact_mut(S::LANES);
        for chunk in &mut chunks {
            let p = chunk.as_mut_ptr();
            // SAFETY: the chunk holds `LANES` floats, which are read and written.
            unsafe { simd.store(p, simd.selu(simd.load(p))) };
        }
        let rest = chunks.into_remainder();
        let mut padded = [0.0; 16];
        padded[..rest.len()].copy_from_slice(rest);
        let p = padded.as_mut_ptr();
        // SAFETY: `padded` has 16 floats, and `LANES` is at most 16.
        unsafe { simd.store(p, simd.selu(simd.load(p))) };
        rest.copy_from_slice(&padded[..rest.len()]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::{SELU_ALPHA, SELU_SCALE};
    use alloc::vec::Vec;

    fn exact(x: f32) -> f64 {
        let x = f64::from(x);
        if x > 0.0 { SELU_SCALE * x } else { SELU_SCALE * SELU_ALPHA * libm::expm1(x) }
    }

    /// Largest relative error over the given bit patterns on one level, and the input where it occurs.
    fn worst(level: Level, bits: impl Iterator<Item = u32>) -> (f64, f32) {
        let mut worst = (0.0, 0.0);
        let mut x: Vec<f32> = Vec::with_capacity(1 << 16);
        let mut bits = bits.peekable();
        while bits.peek().is_some() {
            x.clear();
            x.extend(bits.by_ref().take(1 << 16).map(f32::from_bits));
            let mut y = x.clone();
            selu(level, &mut y);
            for (&x, &y) in x.iter().zip(&y) {
                if x.is_nan() {
                    assert!(y.is_nan(), "{level}: SELU(NaN) = {y}");
                    continue;
                }
                let expected = exact(x);
                if expected.abs() > f64::from(f32::MAX) {
                    assert!(y.is_infinite() && y > 0.0, "{level}: SELU({x:e}) = {y:e}, expected infinity");
                } else if expected.abs() < f64::from(f32::MIN_POSITIVE) {
                    let ulp = f64::from(f32::from_bits(1));
                    assert!((f64::from(y) - expected).abs() <= ulp, "{level}: SELU({x:e}) = {y:e}");
                } else {
                    let error = ((f64::from(y) - expected) / expected).abs();
                    if !(error <= worst.0) {
                        worst = (error, x);
                    }
                }
            }
        }
        worst
    }

    #[test]
    fn selu_keeps_its_bound_on_a_dense_sweep() {
        for level in Level::available() {
            // 2²¹ bit patterns, spread evenly over both signs and all exponents. The multiplier is odd, so no
            // two patterns have the same mantissa.
            let (error, at) = worst(level, (0..1 << 21).map(|i: u32| i.wrapping_mul(2477 * 1024 + 1)));
            assert!(error <= SELU_TOLERANCE, "{level}: {error:e} at {at:e}");
        }
    }

    /// Takes some minutes. Run it by
    /// `cargo test --release --package entire-core --lib -- --ignored every_float`.
    #[test]
    #[ignore = "all 2^32 floats on every level take minutes"]
    fn selu_keeps_its_bound_on_every_float() {
        for level in Level::available() {
            let (error, at) = worst(level, 0..=u32::MAX);
            assert!(error <= SELU_TOLERANCE, "{level}: {error:e} at {at:e}");
        }
    }

    #[test]
    fn any_length_and_position_gives_the_same_bits() {
        for level in Level::available() {
            let x: Vec<f32> = (0..67).map(|i| (i as f32 - 40.0) * 0.173).collect();
            let mut whole = x.clone();
            selu(level, &mut whole);
            for start in 0..20 {
                for end in start..x.len() {
                    let mut part = x[start..end].to_vec();
                    selu(level, &mut part);
                    assert_eq!(part, whole[start..end], "{level} {start}..{end}");
                }
            }
        }
    }
}
