//! Loss functions of training.

use super::Real;
use anyhow::{Result, bail};

/// The loss of one frame, on standardized targets. Training minimizes its mean over the batch.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Loss {
    /// (prediction − target)² (paper, section "Loss Functions").
    SquaredError,
    /// The Huber loss times two: equal to [`Loss::SquaredError`] for errors up to `delta` standard
    /// deviations, linear beyond.
    Huber {
        /// Error above which the loss is linear, in standard deviations of the target.
        delta: f64,
    },
}

impl Loss {
    pub(crate) fn check(self) -> Result<()> {
        match self {
            Self::Huber { delta } if !(delta.is_finite() && delta as f32 > 0.0) => {
                bail!("Huber delta is {delta}; it must be finite and positive, also as a 32-bit float")
            }
            _ => Ok(()),
        }
    }

    /// Returns the loss and its derivative with respect to the prediction.
    #[inline]
    pub(crate) fn value_and_slope<T: Real>(self, prediction: T, target: T) -> (T, T) {
        let error = prediction - target;
        match self {
            Self::SquaredError => (error * error, error + error),
            Self::Huber { delta } => {
                let delta = T::of(delta);
                let size = if error < T::zero() { -error } else { error };
                if size <= delta {
                    (error * error, error + error)
                } else {
                    let sign = if error < T::zero() { -T::one() } else { T::one() };
                    let two = T::one() + T::one();
                    (two * delta * size - delta * delta, two * delta * sign)
                }
            }
        }
    }
}
