//! Upper bounds from residuals (split-conformal), and how far inputs lie outside what was seen.

use alloc::collections::BTreeMap;
use alloc::string::ToString;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::model::{Key, ModelFile};

/// Level of the upper bound.
pub const UPPER_LEVEL: f64 = 0.95;

/// A multiplicative upper bound: with probability [`UPPER_LEVEL`] a frame like the calibration frames takes
/// at most [`factor`](UpperBound::factor) times its prediction. The default was never calibrated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpperBound {
    /// ln of the factor; never calibrated where it is not finite.
    pub log_factor: f32,
}

impl Default for UpperBound {
    fn default() -> Self {
        Self { log_factor: f32::NAN }
    }
}

impl UpperBound {
    /// From ln(measured / predicted) of frames that were not used for fitting (or so many that it does not
    /// matter): the ⌈(n + 1)·level⌉-th smallest, the largest where there are too few. Sorts the slice; NaN
    /// residuals count as misses.
    pub fn from_residuals(log_residuals: &mut [f64]) -> Self {
        if log_residuals.is_empty() {
            return Self::default();
        }
        for r in log_residuals.iter_mut() {
            if r.is_nan() {
                *r = f64::INFINITY;
            }
        }
        log_residuals.sort_unstable_by(f64::total_cmp);
        let n = log_residuals.len();
        let rank = libm::ceil((n as f64 + 1.0) * UPPER_LEVEL) as usize;
        Self { log_factor: log_residuals[rank.clamp(1, n) - 1] as f32 }
    }

    /// As [`UpperBound::from_residuals`] where frames come in groups (volumes) and new frames are of new
    /// groups: every group counts alike, however many frames it has. Residuals with their group.
    pub fn from_groups<G: Ord>(residuals: impl IntoIterator<Item = (f64, G)>) -> Self {
        let mut sorted: Vec<(f64, G)> =
            residuals.into_iter().map(|(r, g)| (if r.is_nan() { f64::INFINITY } else { r }, g)).collect();
        sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut sizes: BTreeMap<&G, f64> = BTreeMap::new();
        for (_, group) in &sorted {
            *sizes.entry(group).or_default() += 1.0;
        }
        // One frame more than there are, as in split-conformal bounds.
        let wanted = UPPER_LEVEL * sizes.len() as f64 * (1.0 + 1.0 / sorted.len().max(1) as f64);
        let mut sum = 0.0;
        for (r, group) in &sorted {
            sum += 1.0 / sizes[group];
            if sum >= wanted * (1.0 - 1e-12) {
                return Self { log_factor: *r as f32 };
            }
        }
        sorted.last().map_or(Self::default(), |(r, _)| Self { log_factor: *r as f32 })
    }

    /// Puts the bound into a model file, keeping what else its calibration holds; leaves the file as it is
    /// where the bound is not known.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidModel`] when what the file holds is damaged.
    pub fn store(&self, file: &mut ModelFile) -> Result<()> {
        if !self.log_factor.is_finite() {
            return Ok(());
        }
        store_in_calibration(file, [("log_factor", serde_json::json!(self.log_factor))])
    }

    /// The factor; NaN when never calibrated.
    pub fn factor(&self) -> f32 {
        if self.log_factor.is_finite() { libm::expf(self.log_factor) } else { f32::NAN }
    }

    /// Standard deviation of ln(measured / predicted) that a normal distribution with this bound has, at
    /// least 0.02; `None` when never calibrated.
    pub(crate) fn log_sd(&self) -> Option<f32> {
        self.log_factor.is_finite().then_some((self.log_factor / 1.645).max(0.02))
    }

    /// The bound for a prediction; never below the prediction itself.
    pub fn upper(&self, seconds: f32) -> f32 {
        if self.log_factor.is_finite() { seconds * self.factor().max(1.0) } else { f32::NAN }
    }
}

/// Puts values into [`Key::Calibration`], keeping what else it holds.
pub(super) fn store_in_calibration<const N: usize>(
    file: &mut ModelFile,
    values: [(&str, serde_json::Value); N],
) -> Result<()> {
    let stored = match file.metadata.get(Key::Calibration.name()) {
        Some(text) => serde_json::from_str(text),
        None => Ok(serde_json::json!({})),
    };
    let mut stored: serde_json::Value = match stored {
        Ok(stored @ serde_json::Value::Object(_)) => stored,
        _ => bail!(InvalidModel, "{} is no object", Key::Calibration),
    };
    stored["level"] = serde_json::json!(UPPER_LEVEL);
    for (name, value) in values {
        stored[name] = value;
    }
    file.metadata.insert(Key::Calibration.into(), stored.to_string());
    Ok(())
}

/// The box of what was seen in training, in up to `N` numbers, with a margin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct FeatureRange<const N: usize = 5> {
    low: [f32; N],
    high: [f32; N],
    known: bool,
}

impl<const N: usize> FeatureRange<N> {
    /// Knows nothing: scores are NaN.
    pub(crate) const fn unknown() -> Self {
        Self { low: [0.0; N], high: [0.0; N], known: false }
    }

    /// With given ends; unknown when any is not finite.
    pub(crate) fn from_ends(low: [f32; N], high: [f32; N]) -> Self {
        let known = low.iter().chain(&high).all(|v| v.is_finite());
        if known { Self { low, high, known } } else { Self::unknown() }
    }

    /// Low and high ends, or `None` where nothing is known.
    pub(crate) fn ends(&self) -> Option<(&[f32; N], &[f32; N])> {
        self.known.then_some((&self.low, &self.high))
    }

    /// The range of the rows; values that are not finite are passed over.
    pub(crate) fn from_rows(rows: &[[f32; N]]) -> Self {
        if rows.is_empty() {
            return Self::unknown();
        }
        let mut out = Self { low: [f32::INFINITY; N], high: [f32::NEG_INFINITY; N], known: true };
        for row in rows {
            for k in 0..N {
                if row[k].is_finite() {
                    out.low[k] = out.low[k].min(row[k]);
                    out.high[k] = out.high[k].max(row[k]);
                }
            }
        }
        for k in 0..N {
            if out.low[k] > out.high[k] {
                (out.low[k], out.high[k]) = (0.0, 0.0);
            }
        }
        out
    }

    /// 0 inside the range; outside, the largest distance of any number from it, in units of half the range's
    /// width (at least 0.7, a factor of two in logarithms). 1 is the edge of trust. NaN where nothing is
    /// known.
    pub(crate) fn score(&self, row: &[f32; N]) -> f32 {
        if !self.known {
            return f32::NAN;
        }
        let mut worst = 0.0f32;
        for k in 0..N {
            let beyond = (self.low[k] - row[k]).max(row[k] - self.high[k]);
            let unit = (0.5 * (self.high[k] - self.low[k])).max(0.7);
            let score = if row[k].is_finite() { beyond / unit } else { f32::INFINITY };
            worst = worst.max(score);
        }
        worst
    }
}
