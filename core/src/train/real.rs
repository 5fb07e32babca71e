//! The numbers a network is trained in: `f32` for use, `f64` to check it.

use crate::nn::{SELU_ALPHA, SELU_SCALE};
use core::fmt::{Debug, Display};
use core::iter::Sum;
use core::ops::{Add, AddAssign, Div, Mul, MulAssign, Neg, Sub, SubAssign};

mod sealed {
    pub trait Sealed: crate::kernels::matmul::MatrixElement {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// `f32` or `f64`.
pub trait Real:
    sealed::Sealed
    + Copy
    + Default
    + PartialOrd
    + Debug
    + Display
    + Send
    + Sync
    + Sum
    + Neg<Output = Self>
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + AddAssign
    + SubAssign
    + MulAssign
    + 'static
{
    /// 0.
    const ZERO: Self;
    /// 1.
    const ONE: Self;
    /// The nearest number of this type.
    fn of(value: f64) -> Self;
    /// As `f64`, exactly.
    fn wide(self) -> f64;
    /// √x.
    fn sqrt(self) -> Self;
    /// Neither NaN nor infinite.
    fn is_finite(self) -> bool;
    /// x ← selu(x) for every element.
    fn selu(values: &mut [Self]);
}

impl Real for f64 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    fn of(value: f64) -> Self {
        value
    }
    fn wide(self) -> f64 {
        self
    }
    fn sqrt(self) -> Self {
        libm::sqrt(self)
    }
    fn is_finite(self) -> bool {
        self.is_finite()
    }
    fn selu(values: &mut [Self]) {
        for x in values {
            *x = SELU_SCALE * if *x > 0.0 { *x } else { SELU_ALPHA * libm::expm1(*x) };
        }
    }
}

impl Real for f32 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    fn of(value: f64) -> Self {
        value as f32
    }
    fn wide(self) -> f64 {
        self.into()
    }
    fn sqrt(self) -> Self {
        libm::sqrtf(self)
    }
    fn is_finite(self) -> bool {
        self.is_finite()
    }
    fn selu(values: &mut [Self]) {
        for x in values {
            *x = selu_f32(*x);
        }
    }
}

/// SELU without branches, so that a loop over it becomes vector code. Absolute error below 4e-7.
#[inline(always)]
fn selu_f32(x: f32) -> f32 {
    const SCALE: f32 = SELU_SCALE as f32;
    const SCALE_ALPHA: f32 = (SELU_SCALE * SELU_ALPHA) as f32;
    // exp(x) = 2^n · exp(r), |r| ≤ ln2/2; below -87 the result is -λα whatever x is. Comparisons are written so that
    // NaN stays NaN.
    let low = if x < -87.0 { -87.0 } else { x };
    let y = if low > 0.0 { 0.0 } else { low };
    // Adding and taking away 1.5·2^23 rounds to the nearest integer.
    const ROUND: f32 = 12_582_912.0;
    let shifted = y * core::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = y - n * 0.693_359_4 + n * 2.121_944_4e-4;
    let p = 1.0 / 720.0;
    let p = p * r + 1.0 / 120.0;
    let p = p * r + 1.0 / 24.0;
    let p = p * r + 1.0 / 6.0;
    let p = p * r + 0.5;
    let p = p * r + 1.0;
    let p = p * r; // exp(r) − 1
    let power = f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3f80_0000));
    let negative = SCALE_ALPHA * (power * p + (power - 1.0));
    if x > 0.0 { SCALE * x } else { negative }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selu_in_single_precision_follows_double() {
        let mut worst = 0.0f64;
        for i in -120_000..20_000 {
            let x = i as f32 * 1e-3;
            let mut single = [x];
            let mut double = [f64::from(x)];
            Real::selu(&mut single);
            Real::selu(&mut double);
            worst = worst.max((f64::from(single[0]) - double[0]).abs() / double[0].abs().max(1.0));
        }
        assert!(worst < 4e-7, "{worst:e}");
        let mut odd = [f32::NAN, f32::NEG_INFINITY, f32::INFINITY, -0.0, f32::MIN];
        Real::selu(&mut odd);
        let floor = -(SELU_SCALE * SELU_ALPHA) as f32;
        assert!(odd[0].is_nan());
        assert!((odd[1] - floor).abs() < 1e-6 && odd[2] == f32::INFINITY);
        assert!(odd[3] == 0.0 && (odd[4] - floor).abs() < 1e-6);
    }
}
