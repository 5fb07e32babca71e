//! Matrix products over slices, and plain loops that are compiled once for each instruction set.

use entire_core::kernels::{Kernel, Level, Simd};
use ndarray::{ArrayView2, ArrayViewMut2, LinalgScalar, linalg::general_mat_mul};
use std::sync::OnceLock;

/// Returns the best instruction set of this CPU, determined once.
pub(super) fn level() -> Level {
    static LEVEL: OnceLock<Level> = OnceLock::new();
    *LEVEL.get_or_init(Level::detect)
}

struct Plain<F>(F);

impl<R, F: FnOnce() -> R> Kernel for Plain<F> {
    type Output = R;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> R {
        (self.0)()
    }
}

/// Runs a closure of plain loops, in the version that was compiled for the best instruction set of this CPU.
/// Additions and multiplications are never fused, so the results do not depend on the CPU.
#[inline(always)]
pub(super) fn vectorized<R>(loops: impl FnOnce() -> R) -> R {
    level().run(Plain(loops))
}

/// Returns a slice as a matrix of `rows` × `columns`, stored row by row.
///
/// # Panics
/// When the slice has fewer than `rows` × `columns` elements.
pub(super) fn matrix<T>(data: &[T], rows: usize, columns: usize) -> ArrayView2<'_, T> {
    ArrayView2::from_shape((rows, columns), &data[..rows * columns]).expect("as many elements as the shape")
}

/// out ← a · b; `out` is stored row by row.
///
/// # Panics
/// When the inner sizes differ or `out` is not rows(a) × columns(b) long.
pub(super) fn multiply<T: LinalgScalar>(a: ArrayView2<'_, T>, b: ArrayView2<'_, T>, out: &mut [T]) {
    assert_eq!(out.len(), a.nrows() * b.ncols(), "out must have as many elements as the product");
    let mut product = ArrayViewMut2::from_shape((a.nrows(), b.ncols()), out)
        .expect("out must have as many elements as the product");
    general_mat_mul(T::one(), &a, &b, T::zero(), &mut product);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_plain_and_transposed_matrices() {
        let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0f64]; // 2 x 3
        let b = [1.0, 0.0, -1.0, 2.0, 0.5, 1.0]; // 3 x 2
        let mut out = [f64::NAN; 4];
        multiply(matrix(&a, 2, 3), matrix(&b, 3, 2), &mut out);
        assert_eq!(out, [0.5, 7.0, 2.0, 16.0]);
        let mut out = [f64::NAN; 9];
        multiply(matrix(&a, 2, 3).reversed_axes(), matrix(&b, 3, 2).reversed_axes(), &mut out);
        assert_eq!(out, [1.0, 7.0, 4.5, 2.0, 8.0, 6.0, 3.0, 9.0, 7.5]);
    }

    #[test]
    #[should_panic(expected = "as many elements as the product")]
    fn sizes_must_fit() {
        multiply(matrix(&[0.0f32; 4], 2, 2), matrix(&[0.0; 2], 2, 1), &mut [0.0; 3]);
    }
}
