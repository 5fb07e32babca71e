//! Number types of training: `f32` in use, `f64` in tests.

use super::matmul::level;
use entire_core::kernels::{SELU_ALPHA, SELU_SCALE, selu};
use ndarray::NdFloat;

/// `f32` or `f64`.
pub trait Real: NdFloat {
    /// Returns the nearest number of this type.
    fn of(value: f64) -> Self {
        Self::from(value).expect("both types hold NaN and infinities")
    }
    /// Converts to `f64`, exactly.
    fn wide(self) -> f64 {
        self.to_f64().expect("a wider type holds every number")
    }
    /// x ← selu(x) for every element.
    fn selu(values: &mut [Self]);
}

impl Real for f64 {
    fn selu(values: &mut [Self]) {
        for x in values {
            *x = SELU_SCALE * if *x > 0.0 { *x } else { SELU_ALPHA * libm::expm1(*x) };
        }
    }
}

impl Real for f32 {
    fn selu(values: &mut [Self]) {
        selu(level(), values);
    }
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
