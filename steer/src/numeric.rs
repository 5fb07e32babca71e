//! Numerics shared by the modules: small dense linear algebra in `f64`, medians, prediction errors.

use alloc::vec::Vec;

/// Replaces a symmetric positive definite n × n matrix in row-major order by its Cholesky factor; reads and
/// writes only the lower half. Returns false, and leaves the matrix in an unspecified state, if the matrix is
/// not positive definite.
pub(crate) fn cholesky(a: &mut [f64], n: usize) -> bool {
    for j in 0..n {
        for k in 0..j {
            let f = a[j * n + k];
            for i in j..n {
                a[i * n + j] -= a[i * n + k] * f;
            }
        }
        let d = a[j * n + j];
        if !(d.is_finite() && d > 0.0) {
            return false;
        }
        let root = libm::sqrt(d);
        for i in j..n {
            a[i * n + j] /= root;
        }
    }
    true
}

/// Returns the solution x of L·x = b for a Cholesky factor L, an n × n matrix in row-major order; b has n
/// elements.
pub fn forward(l: &[f64], mut b: Vec<f64>) -> Vec<f64> {
    let n = b.len();
    for i in 0..n {
        let sum: f64 = (0..i).map(|k| l[i * n + k] * b[k]).sum();
        b[i] = (b[i] - sum) / l[i * n + i];
    }
    b
}

/// Returns the solution x of Lᵀ·x = b; L and b are as in [`forward`].
pub fn back(l: &[f64], mut b: Vec<f64>) -> Vec<f64> {
    let n = b.len();
    for i in (0..n).rev() {
        let sum: f64 = (i + 1..n).map(|k| l[k * n + i] * b[k]).sum();
        b[i] = (b[i] - sum) / l[i * n + i];
    }
    b
}

/// Returns the solution x of A·x = b, or `None` if A is not positive definite. A is a symmetric n × n matrix
/// in row-major order, of which only the lower half is read; b has n elements. Replaces A by its Cholesky
/// factor.
pub fn solve(a: &mut [f64], b: Vec<f64>) -> Option<Vec<f64>> {
    cholesky(a, b.len()).then(|| back(a, forward(a, b)))
}

/// Median of the values; for an even number of values, the mean of the middle two. Reorders the slice. `None`
/// when empty.
pub fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    values.sort_unstable_by(f64::total_cmp);
    let mid = values.len() / 2;
    Some(if values.len() % 2 == 1 { values[mid] } else { 0.5 * (values[mid - 1] + values[mid]) })
}

/// Dot product.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// RMSE of (predicted, measured) pairs, divided by the standard deviation of the measured values; `None`
/// without pairs, or if all measured values are equal.
#[cfg(feature = "calibrate")]
pub(crate) fn rmse_over_sd(pairs: &[(f64, f64)]) -> Option<f64> {
    // The mean of equal values is rounded, so their computed variance may be above 0.
    if pairs.iter().all(|p| p.1 == pairs[0].1) {
        return None;
    }
    let n = pairs.len() as f64;
    let mean = pairs.iter().map(|p| p.1).sum::<f64>() / n;
    let variance = pairs.iter().map(|(_, t)| (t - mean) * (t - mean)).sum::<f64>() / n;
    let square = pairs.iter().map(|(p, t)| (p - t) * (p - t)).sum::<f64>() / n;
    (variance > 0.0).then(|| libm::sqrt(square / variance))
}

/// A deterministic source of noise for tests.
#[cfg(test)]
pub(crate) struct Noise(pub(crate) u64);

#[cfg(test)]
impl Noise {
    /// A number over 0 and at most 1.
    pub(crate) fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    /// A number from the standard normal distribution.
    pub(crate) fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (core::f64::consts::TAU * self.uniform()).cos()
    }
}
