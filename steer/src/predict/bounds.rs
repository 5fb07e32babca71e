//! Upper bounds from residuals (split-conformal).

use alloc::collections::BTreeMap;
use alloc::string::ToString;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::model::{Key, ModelFile};

/// Probability that a frame stays below its upper bound.
pub const UPPER_LEVEL: f64 = 0.95;

/// A multiplicative upper bound: with probability [`UPPER_LEVEL`] a frame like the calibration frames takes
/// at most [`factor`](UpperBound::factor) times its prediction. The default is uncalibrated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpperBound {
    /// ln of the factor; not finite if the bound is uncalibrated.
    pub log_factor: f32,
}

impl Default for UpperBound {
    fn default() -> Self {
        Self { log_factor: f32::NAN }
    }
}

impl UpperBound {
    /// Returns the bound from held-out residuals ln(measured / predicted) of frames in groups (volumes), for
    /// new frames that belong to new groups. `residuals` are pairs of residual and group; all groups have the
    /// same weight, regardless of their numbers of frames. Residuals of fitted frames may be used if there
    /// are so many frames that holding out makes no difference. NaN residuals count as infinite.
    ///
    /// The bound of n frames of one group is the ⌈(n + 1)·[`UPPER_LEVEL`]⌉-th smallest residual, or the
    /// largest if there are fewer.
    pub fn from_groups<G: Ord>(residuals: impl IntoIterator<Item = (f64, G)>) -> Self {
        let mut sorted: Vec<(f64, G)> =
            residuals.into_iter().map(|(r, g)| (if r.is_nan() { f64::INFINITY } else { r }, g)).collect();
        sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut sizes: BTreeMap<&G, f64> = BTreeMap::new();
        for (_, group) in &sorted {
            *sizes.entry(group).or_default() += 1.0;
        }
        // The factor 1 + 1/n for n frames is the finite-sample correction of split-conformal bounds.
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

    /// Stores the bound in a model file and keeps the other entries of its calibration; leaves the file
    /// unchanged if the bound is uncalibrated.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidModel`] if the file's calibration is damaged.
    pub fn store(&self, file: &mut ModelFile) -> Result<()> {
        if !self.log_factor.is_finite() {
            return Ok(());
        }
        store_in_calibration(file, [("log_factor", serde_json::json!(self.log_factor))])
    }

    /// The factor; NaN if the bound is uncalibrated.
    pub fn factor(&self) -> f32 {
        if self.log_factor.is_finite() { libm::expf(self.log_factor) } else { f32::NAN }
    }

    /// Standard deviation of ln(measured / predicted), derived from the bound for normally distributed
    /// errors, at least 0.02; `None` if the bound is uncalibrated.
    pub(crate) fn log_sd(&self) -> Option<f32> {
        self.log_factor.is_finite().then_some((self.log_factor / 1.645).max(0.02))
    }

    /// Returns the upper bound for a prediction, in seconds: at least the prediction; NaN if the bound is
    /// uncalibrated.
    pub fn upper(&self, seconds: f32) -> f32 {
        if self.log_factor.is_finite() { seconds * self.factor().max(1.0) } else { f32::NAN }
    }
}

/// Stores values in [`Key::Calibration`] and keeps its other entries.
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
        _ => bail!(InvalidModel, "{} is not a JSON object", Key::Calibration),
    };
    stored["level"] = serde_json::json!(UPPER_LEVEL);
    for (name, value) in values {
        stored[name] = value;
    }
    file.metadata.insert(Key::Calibration.into(), stored.to_string());
    Ok(())
}
