//! Loss functions of training.

use super::Real;
use anyhow::{Result, bail};

/// The loss of one frame, on standardized targets. Training minimizes its mean over the batch.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Loss {
    /// (prediction − target)² (paper, section "Loss Functions").
    SquaredError,
    /// ((prediction − target) / target)² in seconds, scaled to a mean weight of 1. Only with the target
    /// `seconds`.
    Relative,
    /// The Huber loss times two: equal to [`Loss::SquaredError`] for errors up to `delta` standard
    /// deviations, linear beyond.
    Huber {
        /// Error above which the loss is linear, in standard deviations of the target.
        delta: f64,
    },
    /// The quantile loss: its minimum is the `quantile` of the target given the inputs.
    Pinball {
        /// The quantile to be predicted, between 0 and 1.
        quantile: f64,
    },
}

impl Loss {
    pub(crate) fn check(self) -> Result<()> {
        match self {
            Self::Huber { delta } if !(delta.is_finite() && delta as f32 > 0.0) => {
                bail!("Huber delta is {delta}; it must be finite and positive, also as a 32-bit float")
            }
            Self::Pinball { quantile } if !(quantile as f32 > 0.0 && (quantile as f32) < 1.0) => {
                bail!(
                    "pinball quantile is {quantile}; it must lie between 0 and 1, both excluded, also as a \
                     32-bit float"
                )
            }
            _ => Ok(()),
        }
    }

    /// Returns the loss and its derivative with respect to the prediction, both multiplied by the frame's
    /// `weight`.
    #[inline]
    pub(crate) fn value_and_slope<T: Real>(self, prediction: T, target: T, weight: T) -> (T, T) {
        let error = prediction - target;
        let (value, slope) = match self {
            Self::SquaredError | Self::Relative => (error * error, error + error),
            Self::Huber { delta } => {
                let delta = T::of(delta);
                let size = if error < T::ZERO { -error } else { error };
                if size <= delta {
                    (error * error, error + error)
                } else {
                    let sign = if error < T::ZERO { -T::ONE } else { T::ONE };
                    let two = T::ONE + T::ONE;
                    (two * delta * size - delta * delta, two * delta * sign)
                }
            }
            Self::Pinball { quantile } => {
                let q = T::of(quantile);
                if error < T::ZERO { (-q * error, -q) } else { ((T::ONE - q) * error, T::ONE - q) }
            }
        };
        (value * weight, slope * weight)
    }
}
