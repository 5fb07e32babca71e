//! Converts every network's output to a finite, positive number of seconds, or returns an error.

use core::ops::RangeInclusive;
use entire_core::bail;
use entire_core::{Error, ErrorKind, Result};

/// Range to which networks' predictions are clamped, in seconds. A network trained on seconds may predict
/// zero or less for cheap frames, and the exponential of a network trained on log-seconds can underflow.
pub const PREDICTED_SECONDS: RangeInclusive<f32> = 1.0e-6..=1.0e9;

/// Longest accepted time of an observed frame, and of a frame that a model is fitted to, in seconds.
pub const LONGEST_FRAME: f32 = 10_000.0;

/// Smallest out-of-range score of a prediction that was clamped to [`PREDICTED_SECONDS`]; far above the
/// default of [`crate::control::HybridOptions::trust_limit`], 2.
pub(crate) const CLAMPED_SCORE: f32 = 1000.0;

/// Returns a network's output in seconds, clamped to [`PREDICTED_SECONDS`], and true if clamping changed it.
/// The caller then raises the out-of-range score to at least [`CLAMPED_SCORE`].
///
/// # Errors
/// [`crate::ErrorKind::InvalidModel`] for NaN or infinity: the weights are so large that sums overflow `f32`.
pub(crate) fn checked_seconds(raw: f32) -> Result<(f32, bool)> {
    if !raw.is_finite() {
        // The message is a constant text, so that no memory is allocated: a plan may evaluate the network
        // many times.
        return Err(Error::new(
            ErrorKind::InvalidModel,
            "the network's prediction is not finite, since its weights are too large for these inputs; \
             train the model again, or use another model",
        ));
    }
    let seconds = raw.clamp(*PREDICTED_SECONDS.start(), *PREDICTED_SECONDS.end());
    Ok((seconds, seconds != raw))
}

/// Clamps networks' outputs to [`PREDICTED_SECONDS`], in place; returns the number of clamped values.
///
/// # Errors
/// [`crate::ErrorKind::InvalidModel`] for NaN or infinity, naming the first such row: the weights are so
/// large that sums overflow `f32`. The batch is unchanged in this case.
pub fn check_predictions(seconds: &mut [f32]) -> Result<usize> {
    if let Some(row) = seconds.iter().position(|s| !s.is_finite()) {
        bail!(
            InvalidModel,
            "the network's prediction for row {row} is not finite ({} seconds), since its weights are too \
             large for these inputs; train the model again, or use another model",
            seconds[row]
        );
    }
    let mut clamped = 0;
    for s in seconds {
        let (checked, changed) = checked_seconds(*s)?;
        *s = checked;
        clamped += usize::from(changed);
    }
    Ok(clamped)
}
