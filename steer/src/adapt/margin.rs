//! An upper-bound margin that keeps a given miss rate for any distribution of errors.

use super::state::{Reader, Writer};
use entire_core::Result;

/// Multiple of the expected error that an upper bound adds to the expected ln(time). It is adjusted after
/// every frame so that the share of frames above the bound tends to the requested miss rate (adaptive
/// conformal inference: Gibbs and Candès 2021).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Margin {
    pub(crate) multiple: f64,
    rate: f64,
    pace: f64,
}

/// Smallest multiple: with a smaller one, the bound would hardly exceed the expected time.
const MIN_MULTIPLE: f64 = 0.5;
/// Largest multiple: larger errors are outliers that a larger multiple would not cover either.
const MAX_MULTIPLE: f64 = 8.0;

impl Margin {
    /// Returns a margin with the given initial multiple, miss rate `rate` and learning rate `pace`. These
    /// values are clamped to 0.5…8, 0.0001…0.5 and 0.001…1, respectively.
    pub(crate) fn starting_at(multiple: f64, rate: f32, pace: f64) -> Self {
        let rate = if rate.is_finite() { f64::from(rate).clamp(1.0e-4, 0.5) } else { 0.05 };
        let pace = if pace.is_finite() { pace.clamp(1.0e-3, 1.0) } else { 0.1 };
        let multiple = if multiple.is_finite() { multiple.clamp(MIN_MULTIPLE, MAX_MULTIPLE) } else { 2.0 };
        Self { multiple, rate, pace }
    }

    /// Adjusts the multiple after a frame. `normalized_error` is the frame's error divided by the expected
    /// error; it is positive if the frame was slower than predicted.
    pub(crate) fn observe(&mut self, normalized_error: f64) {
        if normalized_error.is_nan() {
            return;
        }
        let missed = if normalized_error > self.multiple { 1.0 } else { 0.0 };
        self.multiple = (self.multiple + self.pace * (missed - self.rate)).clamp(MIN_MULTIPLE, MAX_MULTIPLE);
    }

    pub(crate) fn save(&self, w: &mut Writer<'_>) {
        w.f64(self.multiple);
    }

    pub(crate) fn load(&mut self, r: &mut Reader<'_>) -> Result<()> {
        self.multiple = r.f64(MIN_MULTIPLE, MAX_MULTIPLE)?;
        Ok(())
    }
}

/// Returns the probability that a standard normal number exceeds `limit`.
pub(crate) fn exceeded(limit: f64) -> f64 {
    0.5 * libm::erfc(limit * core::f64::consts::FRAC_1_SQRT_2)
}

/// Returns the quantile of the standard normal distribution that is exceeded with this probability, clamped
/// to 0…8; 0 for a probability that is NaN or not positive.
pub(crate) fn normal_quantile(probability: f64) -> f64 {
    let (mut low, mut high) = (0.0, 8.0);
    for _ in 0..30 {
        let middle = 0.5 * (low + high);
        if exceeded(middle) > probability { low = middle } else { high = middle }
    }
    if probability > 0.0 { low } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::Noise;

    #[test]
    fn the_miss_rate_tends_to_the_rate_asked_for() {
        // The errors are heavy-tailed and from a fixed generator. For each rate, the share of frames above
        // the bound must differ from the rate by less than a quarter of the rate.
        for rate in [0.03f32, 0.05, 0.2] {
            let mut margin = Margin::starting_at(2.0, rate, 0.1);
            let mut noise = Noise(1);
            let (mut misses, n) = (0, 20_000);
            for _ in 0..n {
                let u = noise.uniform();
                let e = 0.3 * (u - 0.5) / (u * (1.0 - u) + 0.02);
                misses += usize::from(e > margin.multiple);
                margin.observe(e);
            }
            let share = misses as f32 / n as f32;
            assert!((share - rate).abs() < 0.25 * rate, "{share} {rate}");
        }
    }

    #[test]
    fn nothing_drives_it_out_of_bounds() {
        let mut margin = Margin::starting_at(f64::NAN, f32::NAN, f64::NAN);
        for e in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300] {
            for _ in 0..1000 {
                margin.observe(e);
                assert!((MIN_MULTIPLE..=MAX_MULTIPLE).contains(&margin.multiple));
            }
        }
    }

    #[test]
    fn quantiles_are_those_of_the_normal_distribution() {
        for (rate, sd) in [(0.158_655_3, 1.0), (0.022_750_13, 2.0), (0.001_349_898, 3.0)] {
            assert!((normal_quantile(rate) - sd).abs() < 1e-6, "{rate}: {}", normal_quantile(rate));
            assert!((exceeded(sd) - rate).abs() < 1e-7, "{sd}: {}", exceeded(sd));
        }
        assert_eq!([f64::NAN, 0.0, -1.0].map(normal_quantile), [0.0; 3]);
    }
}
