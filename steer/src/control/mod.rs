//! Step choice under a budget.
//!
//! A [`Controller`] sees one frame at a time: the target, the limits of the step, what the caller knows to
//! have changed, and the predicted cost of any step. It answers with a step and a [`Reason`],
//! and later hears how long the frame took. None of them allocates after construction. [`Session`] joins a
//! controller with a predictor and the scene's features for one render loop.

#[cfg(test)]
mod caller_tests;
mod coarsening;
mod constants;
mod history;
mod hybrid;
#[cfg(test)]
mod load_tests;
mod session;
#[cfg(test)]
mod tests;

pub use crate::adapt::{CorrectionConstants, ObserveFlags, Prior, Verdict};
pub use crate::predict::Quality;
pub use constants::HybridConstants;
pub use hybrid::{Hybrid, HybridOptions};
pub use session::{PENDING_PLANS, Plan, Session};

use crate::features::Changes;
use crate::predict::{CostTerms, Prediction};
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::names;

/// The steps that a controller may choose, in multiples of the reference step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepLimits {
    /// The finest step; at least 1/64.
    pub finest: f32,
    /// The coarsest step; not below the finest, at most 4096.
    pub coarsest: f32,
}

impl StepLimits {
    /// Checks the limits; [`Session::set_limits`] does so too.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless 1/64 ≤ finest ≤ coarsest ≤ 4096.
    pub fn check(&self) -> Result<()> {
        let Self { finest, coarsest } = *self;
        if !(finest >= 1.0 / 64.0 && finest <= coarsest && coarsest <= 4096.0) {
            bail!(
                InvalidArgument,
                "step limits are {finest}…{coarsest} reference steps; they must satisfy 0.015625 <= finest \
                 <= coarsest <= 4096"
            );
        }
        Ok(())
    }

    /// The nearest step within the limits; the coarsest for NaN.
    pub fn clamp(&self, step: f32) -> f32 {
        if step.is_nan() { self.coarsest } else { step.max(self.finest).min(self.coarsest) }
    }
}

impl Default for StepLimits {
    /// From the reference step to sixteen of them.
    fn default() -> Self {
        Self { finest: 1.0, coarsest: 16.0 }
    }
}

/// Why a plan is what it is. Stable numbers: they are part of the C ABI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[repr(u32)]
pub enum Reason {
    /// The finest step whose upper bound fits the target.
    Fits = 1,
    /// As before, but moved there slowly because nothing has changed abruptly.
    Damped = 2,
    /// The step before still fits and is close to the best: kept.
    Held = 3,
    /// Nothing finer is allowed, and it fits.
    FinestAllowed = 4,
    /// Nothing coarser is allowed, and even that is not expected to fit.
    TargetUnreachable = 5,
    /// The prediction is not trusted (out of range, or wrong lately): recent frames decide.
    History = 6,
    /// Neither a prediction nor a timing is there: the coarsest step allowed.
    NoInformation = 7,
    /// Steering is off: the step asked for.
    Off = 8,
    /// A rule that reacts to past frames only.
    Reactive = 9,
}

names! { Reason:
    Fits "fits",
    Damped "damped",
    Held "held",
    FinestAllowed "finest allowed",
    TargetUnreachable "target unreachable",
    History "history",
    NoInformation "no information",
    Off "off",
    Reactive "reactive",
}

/// One frame as a controller sees it before it is drawn.
pub struct PlanRequest<'a> {
    /// Seconds that the frame should not exceed; finite and positive.
    pub target: f32,
    /// Steps that may be chosen.
    pub limits: StepLimits,
    /// What differs from the frame before.
    pub changes: Changes,
    /// The predicted cost of the frame at a ray step, uncorrected; NaN where nothing is known.
    pub cost: &'a mut dyn FnMut(f32) -> CostTerms,
}

/// A controller's answer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Decision {
    /// The ray step to draw with.
    pub step: f32,
    /// Expected seconds; NaN from rules that expect nothing.
    pub seconds: f32,
    /// Upper bound, seconds; NaN where there is none.
    pub upper: f32,
    /// As [`Prediction::out_of_range`]; NaN where nothing is known.
    pub out_of_range: f32,
    /// Why.
    pub reason: Reason,
}

/// A drawn frame as a controller hears of it. The time has been checked: finite and positive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observed {
    /// Measured seconds.
    pub seconds: f32,
    /// The step it was drawn with.
    pub step: f32,
    /// The target it was planned for.
    pub target: f32,
    /// What differed from the frame before it.
    pub changes: Changes,
    /// The uncorrected prediction for it.
    pub terms: CostTerms,
    /// The scene that it belongs to, as [`Controller::scene`] said when it was planned.
    pub scene: SceneMark,
    /// The time holds other work too (see [`crate::adapt::ObserveFlags`]).
    pub unusual: bool,
}

/// A run of frames that continue each other, as a controller counts them, and what it makes of one of them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SceneMark {
    /// Counts scenes.
    pub number: u64,
    /// Whether the frame is the scene's first.
    pub first: bool,
}

/// Chooses ray steps frame by frame.
pub trait Controller {
    /// A short name for tables.
    fn name(&self) -> &'static str;

    /// Chooses the step of the next frame.
    fn plan(&mut self, request: &mut PlanRequest<'_>) -> Decision;

    /// Takes note of a frame's time.
    fn observe(&mut self, observed: &Observed) -> Verdict;

    /// Forgets every frame.
    fn reset(&mut self);

    /// Tells whether the frames that are observed are timed by another clock than the predictor's, where that
    /// changes; [`Controller::reset`] follows.
    fn convert(&mut self, converted: bool) {
        let _ = converted;
    }

    /// Tells that a frame begins whose setting is chosen elsewhere; [`Controller::plan`] needs no such call.
    /// Frames are compared at `step`.
    fn begin(&mut self, changes: Changes, step: f32, cost: &mut dyn FnMut(f32) -> CostTerms) {
        let _ = (changes, step, cost);
    }

    /// Tells that the frame that began last is not drawn.
    fn withdraw(&mut self) {}

    /// The scene that the frame that began last belongs to.
    fn scene(&self) -> SceneMark {
        SceneMark::default()
    }

    /// Whether a frame with this corrected prediction is expected to meet a target.
    fn fits(&self, prediction: &Prediction, target: f32) -> bool {
        let bound = if prediction.upper.is_nan() { prediction.seconds } else { prediction.upper };
        bound <= target
    }

    /// A prediction as this controller corrects it; as it is, where the controller corrects nothing.
    /// `changes` are those of a frame that has not begun yet; none for the frame at hand.
    fn correct(&self, terms: &CostTerms, changes: Changes) -> Prediction {
        let _ = changes;
        Prediction {
            seconds: terms.seconds(),
            upper: f32::NAN,
            out_of_range: terms.out_of_range,
            source: terms.source,
        }
    }

    /// Appends what was learned to a byte string.
    fn save(&self, out: &mut Vec<u8>) {
        let _ = out;
    }

    /// Takes up what [`Controller::save`] wrote; on an error nothing changes.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for bytes of another controller, cut short or damaged.
    fn load(&mut self, bytes: &[u8]) -> Result<()> {
        if !bytes.is_empty() {
            bail!(
                InvalidArgument,
                "controller {} keeps no state, {} bytes were given",
                self.name(),
                bytes.len()
            );
        }
        Ok(())
    }
}
