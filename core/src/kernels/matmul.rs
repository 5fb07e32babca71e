//! What training needs of the CPU: matrix products over the crate `matrixmultiply` (the one place that hands
//! it pointers), and plain loops compiled for this CPU's best level.

use super::simd::{Kernel, Simd};
use super::{Level, selu};
use std::sync::OnceLock;

/// This CPU's best level, asked for once.
fn level() -> Level {
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

/// Runs a small closure of plain loops, compiled with the instructions of this CPU's best level. Additions
/// and multiplications are never fused, so the results do not depend on the level.
#[inline(always)]
pub(crate) fn vectorized<R>(f: impl FnOnce() -> R) -> R {
    level().run(Plain(f))
}

/// SELU in single precision, in place.
pub(crate) fn selu_f32(values: &mut [f32]) {
    selu(level(), values);
}

/// A matrix in a slice, by rows: `data[row * row_stride + column * column_stride]`.
#[derive(Clone, Copy, Debug)]
#[allow(unreachable_pub, reason = "stands in MatrixElement")]
pub struct Matrix<'a, T> {
    data: &'a [T],
    rows: usize,
    columns: usize,
    strides: [usize; 2],
}

impl<'a, T> Matrix<'a, T> {
    /// `rows` × `columns`, rows one after the other.
    ///
    /// # Panics
    /// When the slice is shorter than that.
    pub(crate) fn new(data: &'a [T], rows: usize, columns: usize) -> Self {
        assert!(data.len() >= rows * columns, "matrix of {rows} x {columns} in {} elements", data.len());
        Self { data, rows, columns, strides: [columns, 1] }
    }

    /// The transposed matrix over the same slice.
    pub(crate) fn transposed(self) -> Self {
        Self {
            data: self.data,
            rows: self.columns,
            columns: self.rows,
            strides: [self.strides[1], self.strides[0]],
        }
    }
}

/// Numbers that networks are trained in.
#[allow(unreachable_pub, reason = "a bound of the public trait Real, sealed by being unreachable")]
pub trait MatrixElement: Copy {
    /// out ← a · b, `out` by rows.
    ///
    /// # Panics
    /// When the inner sizes differ or `out` is not rows(a) × columns(b) long.
    fn multiply(a: Matrix<'_, Self>, b: Matrix<'_, Self>, out: &mut [Self]);
}

macro_rules! matrix_element {
    ($type:ty, $gemm:path) => {
        impl MatrixElement for $type {
            fn multiply(a: Matrix<'_, Self>, b: Matrix<'_, Self>, out: &mut [Self]) {
                assert_eq!(a.columns, b.rows, "inner sizes of a matrix product");
                assert_eq!(out.len(), a.rows * b.columns, "size of a matrix product");
                // SAFETY: `Matrix::new` checked that the slices of `a` and `b` hold rows × columns elements
                // at these strides (transposing keeps the set of offsets), the assertion above that `out`
                // does; `out` is borrowed exclusively, so it overlaps neither. Strides are below isize::MAX
                // because slices are.
                unsafe {
                    $gemm(
                        a.rows,
                        a.columns,
                        b.columns,
                        1.0,
                        a.data.as_ptr(),
                        a.strides[0] as isize,
                        a.strides[1] as isize,
                        b.data.as_ptr(),
                        b.strides[0] as isize,
                        b.strides[1] as isize,
                        0.0,
                        out.as_mut_ptr(),
                        b.columns as isize,
                        1,
                    );
                }
            }
        }
    };
}

matrix_element!(f32, matrixmultiply::sgemm);
matrix_element!(f64, matrixmultiply::dgemm);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_plain_and_transposed_matrices() {
        let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0f64]; // 2 x 3
        let b = [1.0, 0.0, -1.0, 2.0, 0.5, 1.0]; // 3 x 2
        let mut out = [f64::NAN; 4];
        f64::multiply(Matrix::new(&a, 2, 3), Matrix::new(&b, 3, 2), &mut out);
        assert_eq!(out, [0.5, 7.0, 2.0, 16.0]);
        let mut out = [f64::NAN; 9];
        f64::multiply(Matrix::new(&a, 2, 3).transposed(), Matrix::new(&b, 3, 2).transposed(), &mut out);
        assert_eq!(out, [1.0, 7.0, 4.5, 2.0, 8.0, 6.0, 3.0, 9.0, 7.5]);
    }

    #[test]
    #[should_panic(expected = "inner sizes")]
    fn sizes_must_fit() {
        f32::multiply(Matrix::new(&[0.0; 4], 2, 2), Matrix::new(&[0.0; 3], 3, 1), &mut [0.0; 2]);
    }
}
