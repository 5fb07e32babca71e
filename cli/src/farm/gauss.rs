//! The normal distribution and triangular systems: the arithmetic of the model of times.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

/// A number from the standard normal distribution.
pub(crate) fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let mut unit = || ((rng.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
    (-2.0 * unit().ln()).sqrt() * (std::f64::consts::TAU * unit()).cos()
}

/// The share of the standard normal distribution below `x`, by its continued fraction and its series.
pub(super) fn normal_below(x: f64) -> f64 {
    let density = (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt();
    if x.abs() > 3.0 {
        let tail = (1..=40).rev().fold(x.abs(), |below, k| x.abs() + f64::from(k) / below);
        return if x > 0.0 { 1.0 - density / tail } else { density / tail };
    }
    let (mut term, mut sum) = (x, x);
    for k in 1..60 {
        term *= x * x / f64::from(2 * k + 1);
        sum += term;
    }
    0.5 + density * sum
}

/// Replaces a symmetric positive definite matrix by its lower triangular factor.
pub(super) fn cholesky(a: &mut [f64], d: usize) {
    for j in 0..d {
        for k in 0..j {
            let l = a[j * d + k];
            for i in j..d {
                a[i * d + j] -= a[i * d + k] * l;
            }
        }
        let root = a[j * d + j].max(1e-300).sqrt();
        for i in j..d {
            a[i * d + j] /= root;
        }
    }
}

/// Solves L·x = b.
pub(super) fn forward(l: &[f64], b: &[f64], d: usize) -> Vec<f64> {
    let mut x = b.to_vec();
    for i in 0..d {
        for k in 0..i {
            x[i] -= l[i * d + k] * x[k];
        }
        x[i] /= l[i * d + i];
    }
    x
}

/// Solves Lᵀ·x = b.
pub(super) fn back(l: &[f64], b: &[f64], d: usize) -> Vec<f64> {
    let mut x = b.to_vec();
    for i in (0..d).rev() {
        for k in i + 1..d {
            x[i] -= l[k * d + i] * x[k];
        }
        x[i] /= l[i * d + i];
    }
    x
}
