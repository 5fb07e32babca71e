//! The dense layer after the convolutions.

use super::layout::LINE;
use crate::kernels::simd::{Kernel, Simd};
use crate::memory::chunks;

/// Kernel that computes the dense layer after the convolutions, with 16 partial sums per output.
pub(super) struct Dense<'a> {
    pub(super) dense: core::slice::ChunksExact<'a, f32>,
    pub(super) bias: &'a [f32],
    pub(super) x: &'a [f32],
    pub(super) features: &'a mut [f32],
}

impl Kernel for Dense<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let (x, _) = chunks::<LINE, _>(self.x);
        for ((feature, row), bias) in self.features.iter_mut().zip(self.dense).zip(self.bias) {
            let (row, _) = chunks::<LINE, _>(row);
            let mut sums = [0.0f32; LINE];
            for (w, x) in row.iter().zip(x) {
                for ((sum, w), x) in sums.iter_mut().zip(w).zip(x) {
                    *sum += w * x;
                }
            }
            let mut half = LINE / 2;
            while half > 0 {
                for i in 0..half {
                    sums[i] += sums[i + half];
                }
                half /= 2;
            }
            *feature = sums[0] + bias;
        }
    }
}
