//! The normal distribution.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

/// Returns a random number from the standard normal distribution (Box and Muller 1958).
pub(crate) fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let mut unit = || ((rng.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
    (-2.0 * unit().ln()).sqrt() * (std::f64::consts::TAU * unit()).cos()
}

/// Returns the probability that a standard normal number is below `x`: by a continued fraction beyond ±3,
/// else by a power series.
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
