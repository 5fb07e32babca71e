//! Forecasts a frame's time from the times of the last three frames alone. *Recent frames lead* means that
//! the controller uses this forecast instead of the model's prediction.

use crate::adapt::state::{Reader, Writer};
use entire_core::Result;

/// Clipping limit of errors, in ln(time), so that no single frame dominates the mean errors.
const LARGEST_ERROR: f64 = 2.0;

/// Initial standard deviation of the forecast's error, in ln(time). It affects only the forecast's upper
/// bound, until the first frame is compared.
const START_SD: f64 = 0.1;

/// Ratio of the standard deviation of a normal error to its mean absolute value, sqrt(π / 2).
const SD_OF_MEAN: f64 = 1.25;

/// Number of compared frames before recent frames may lead: fewer give no reliable mean error.
const MIN_COMPARISONS: u32 = 10;

/// Mean error of the prediction, in ln(time), above which recent frames may lead. So recent frames replace
/// only a prediction that is of no use. On the undisturbed training paths, recent frames never lead.
const LEAST_ERROR: f64 = 0.15;

/// Ratio of the prediction's mean error to the forecast's mean error, above which recent frames begin to
/// lead.
const LEAD_RATIO: f64 = 1.5;

/// Smallest learning rate of both mean errors, which are thus averages over about twelve frames.
const PACE: f64 = 0.08;

/// Share of a frame's time that does not depend on the step: a guess, since this share differs between
/// renderers.
const FIXED_SHARE: f64 = 0.1;

/// Ratio of the prediction's mean error to the forecast's mean error, down to which recent frames continue to
/// lead. It is lower than [`LEAD_RATIO`], so that prediction and forecast do not alternate.
const RETURN_RATIO: f64 = 1.1;

/// The last three frames, and the mean errors of two predictors of the next frame: the forecast from these
/// frames, and the corrected prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct History {
    /// (step, seconds) of the last three frames, as a ring buffer.
    frames: [(f64, f64); 3],
    pub(super) len: usize,
    next: usize,
    /// True if the last frame's time may include compilation and uploads.
    doubtful: bool,
    spread: f64,
    /// Mean |ln(measured / forecast)| over the compared frames ([`History::compare`]).
    history_error: f64,
    /// Mean |ln(measured / corrected prediction)| over the same frames.
    own_error: f64,
    pub(super) leads: bool,
    compared: u32,
}

impl History {
    pub(super) const fn new() -> Self {
        Self {
            frames: [(1.0, 1.0); 3],
            len: 0,
            next: 0,
            doubtful: false,
            spread: START_SD,
            history_error: 0.0,
            own_error: 0.0,
            leads: false,
            compared: 0,
        }
    }

    /// Returns the expected seconds of a frame at `step`, extrapolated from the last three frames, and an
    /// upper bound that is `margin` standard deviations higher in ln(time). A fixed share of the time is
    /// assumed not to depend on the step, and the remaining share to be proportional to 1/step.
    pub(super) fn forecast(&self, step: f32, margin: f64) -> (f64, f64) {
        let step = f64::from(step);
        let mut sum = 0.0;
        for &(s, t) in &self.frames[..self.len] {
            sum += t * (FIXED_SHARE + (1.0 - FIXED_SHARE) * s / step);
        }
        let seconds = sum / self.len.max(1) as f64;
        (seconds, seconds * libm::exp(margin * self.spread))
    }

    /// Updates both mean errors by a measured frame; `own` is |ln(measured / corrected prediction)|. A frame
    /// is ignored if the scene changed before it, if the previous frame was doubtful, or if there is no
    /// previous frame.
    pub(super) fn compare(&mut self, step: f32, seconds: f64, own: f64, changed: bool) {
        if self.len == 0 || changed || self.doubtful {
            return;
        }
        let (forecast, _) = self.forecast(step, 0.0);
        let history = libm::fabs(libm::log(seconds / forecast)).min(LARGEST_ERROR);
        let own = if own.is_finite() { own.min(LARGEST_ERROR) } else { LARGEST_ERROR };
        self.compared = self.compared.saturating_add(1);
        let pace = (1.0 / f64::from(self.compared)).max(PACE);
        self.history_error += pace * (history - self.history_error);
        self.own_error += pace * (own - self.own_error);
        self.spread = (SD_OF_MEAN * self.history_error).clamp(0.01, 1.0);
        if self.compared >= MIN_COMPARISONS {
            self.leads = if self.leads {
                self.own_error > RETURN_RATIO * self.history_error
            } else {
                self.own_error > LEAST_ERROR && self.own_error > LEAD_RATIO * self.history_error
            };
        }
    }

    /// Adds a measured frame; if it follows a change, the earlier frames are dropped. A `doubtful` frame,
    /// whose time may include compilation and uploads, is dropped when the next frame is added.
    pub(super) fn push(&mut self, step: f32, seconds: f64, changed: bool, doubtful: bool) {
        if changed || self.doubtful {
            self.len = 0;
            self.next = 0;
        }
        self.doubtful = doubtful;
        self.frames[self.next] = (f64::from(step), seconds);
        self.next = (self.next + 1) % 3;
        self.len = (self.len + 1).min(3);
    }

    pub(super) fn save(&self, w: &mut Writer<'_>) {
        w.f64(self.spread);
        w.f64(self.history_error);
        w.f64(self.own_error);
        w.u64(u64::from(self.leads));
        w.u64(u64::from(self.compared));
    }

    pub(super) fn load(&mut self, r: &mut Reader<'_>) -> Result<()> {
        self.spread = r.f64(0.01, 1.0)?;
        self.history_error = r.f64(0.0, LARGEST_ERROR)?;
        self.own_error = r.f64(0.0, LARGEST_ERROR)?;
        self.leads = r.u64()? == 1;
        self.compared = u32::try_from(r.u64()?).unwrap_or(u32::MAX);
        Ok(())
    }
}
