//! The door that every network's output goes through: what comes out is a finite, positive number of seconds,
//! or an error.

use core::ops::RangeInclusive;
use entire_core::Result;
use entire_core::bail;

/// Shortest and longest time that a prediction is taken for, seconds. A network trained on seconds goes to zero and
/// below for cheap frames, and the exponential of a network trained on their logarithm can vanish.
pub const PREDICTED_SECONDS: RangeInclusive<f32> = 1.0e-6..=1.0e9;

/// Longest frame time that is believed, seconds: of an observation, and of a frame that a model is fitted to.
pub const LONGEST_FRAME: f32 = 10_000.0;

/// Least out-of-range score of a prediction that had to be brought into [`PREDICTED_SECONDS`]: far beyond
/// any edge of trust.
pub(crate) const CLAMPED_SCORE: f32 = 1000.0;

/// A network's output as a time: its seconds, and whether they had to be brought into [`PREDICTED_SECONDS`]; the least out-of-range score is 1000 then.
///
/// # Errors
/// [`crate::ErrorKind::InvalidModel`] for NaN or an infinity: weights so large that sums of them leave `f32`.
pub(crate) fn checked_seconds(raw: f32) -> Result<(f32, bool)> {
    if !raw.is_finite() {
        bail!(
            InvalidModel,
            "the network's prediction is {raw} seconds; a finite number is expected: its weights are too large for these \
             inputs, train the model again or use another"
        );
    }
    let seconds = raw.clamp(*PREDICTED_SECONDS.start(), *PREDICTED_SECONDS.end());
    Ok((seconds, seconds != raw))
}

/// Networks' outputs as times, in place: seconds, brought into [`PREDICTED_SECONDS`]. Gives how many had to be.
///
/// # Errors
/// [`crate::ErrorKind::InvalidModel`] for NaN or an infinity, naming the first row at fault: weights so large that
/// sums of them leave `f32`. The batch is then as it was.
pub fn check_predictions(seconds: &mut [f32]) -> Result<usize> {
    if let Some(row) = seconds.iter().position(|s| !s.is_finite()) {
        bail!(
            InvalidModel,
            "the network's prediction for row {row} is {} seconds; a finite number is expected: its weights are too large \
             for these inputs, train the model again or use another",
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
