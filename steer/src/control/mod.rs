//! Choice of the ray step under a time budget.
//!
//! A [`Controller`] plans one frame at a time. It receives the target, the limits of the step, the announced
//! changes, and the predicted cost at any step, and returns a step and a [`Reason`]. Later it receives the
//! frame's time. Controllers do not allocate after construction. [`Session`] combines a controller with a
//! predictor and the scene's features for one render loop.

mod budget;
#[cfg(test)]
mod caller_tests;
mod constants;
mod history;
mod hybrid;
#[cfg(test)]
mod load_tests;
mod session;
#[cfg(test)]
mod tests;

pub use crate::adapt::{CorrectionConstants, ObserveFlags, Verdict};
pub use crate::predict::Quality;
pub use budget::{FrameBudget, PassShare};
pub use constants::HybridConstants;
pub use hybrid::HybridOptions;
pub use session::{Plan, Session};

use crate::features::Changes;
use crate::predict::{CostTerms, Prediction};
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::names;

/// Range of steps that a controller may choose, in multiples of the reference step.
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

    /// Returns the step within the limits that is nearest to `step`; the coarsest step for NaN.
    pub fn clamp(&self, step: f32) -> f32 {
        if step.is_nan() { self.coarsest } else { step.max(self.finest).min(self.coarsest) }
    }
}

impl Default for StepLimits {
    /// Limits of one and sixteen reference steps.
    fn default() -> Self {
        Self { finest: 1.0, coarsest: 16.0 }
    }
}

/// Reason for a plan's step. The numbers are stable: they are part of the C ABI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[repr(u32)]
pub enum Reason {
    /// The finest step that is expected to meet the target and whose upper bound is within the tolerance. If
    /// no upper bound is within the tolerance: the step with the least expected cost of late frames and of
    /// lost quality, among the steps that are expected to meet the target.
    Fits = 1,
    /// The step of `Fits`, but with a limited change, since the scene has not changed abruptly.
    Damped = 2,
    /// The previous step still fits and is close to the best step.
    Held = 3,
    /// The finest allowed step, which is expected to meet the target; its upper bound may exceed the
    /// tolerance.
    FinestAllowed = 4,
    /// Even the coarsest allowed step is not expected to fit. The plan has this step, or the step of the
    /// previous frame if that step is expected to exceed the target by less than 1 %.
    TargetUnreachable = 5,
    /// The step was chosen from recent frame times, since the prediction is missing, is out of range at the
    /// step that it would choose, or was recently wrong.
    History = 6,
    /// The coarsest allowed step, because no prediction exists and no time was observed after the last announced
    /// change of the scene.
    NoInformation = 7,
    /// The frame's own step, since steering is off.
    Off = 8,
    /// The step was chosen by a rule that uses only the times of past frames.
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

/// Request for a plan of one frame.
pub struct PlanRequest<'a> {
    /// Target: seconds that the frame should not exceed; finite and positive.
    pub target: f32,
    /// Range of steps. If plans may coarsen the image ([`Session::set_max_image_sample_distance`]), every
    /// step that a controller receives or returns stands for step · (image sample distance)².
    pub limits: StepLimits,
    /// Changes of the scene since the previous frame.
    pub changes: Changes,
    /// Predicted cost of the frame at a ray step, uncorrected; NaN if it is unknown.
    pub cost: &'a mut dyn FnMut(f32) -> CostTerms,
}

/// A controller's plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Decision {
    /// Chosen step, in reference steps; see [`PlanRequest::limits`].
    pub step: f32,
    /// Expected seconds; NaN if the controller predicts no time.
    pub seconds: f32,
    /// Upper bound in seconds; NaN if there is none.
    pub upper: f32,
    /// [`Prediction::out_of_range`] at `step`; NaN if the score is unknown.
    pub out_of_range: f32,
    /// Reason for the step.
    pub reason: Reason,
}

impl Decision {
    pub(crate) fn of(step: f32, p: Prediction, reason: Reason) -> Self {
        Self { step, seconds: p.seconds, upper: p.upper, out_of_range: p.out_of_range, reason }
    }
}

/// Observation of a drawn frame. The time has been checked: finite and positive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observed {
    /// Measured seconds.
    pub seconds: f32,
    /// Processor seconds of the renderer's process in the frame; NaN if they are unknown.
    pub processor_seconds: f32,
    /// Step of the frame, as in [`Decision::step`].
    pub step: f32,
    /// Target of the frame's plan.
    pub target: f32,
    /// Changes of the scene from the preceding frame to this one.
    pub changes: Changes,
    /// Uncorrected prediction of the frame.
    pub terms: CostTerms,
    /// Scene of the frame, from [`Controller::scene`] when it was planned.
    pub scene: SceneMark,
    /// True if the time includes work that most frames do not include (see
    /// [`crate::adapt::ObserveFlags`]).
    pub unusual: bool,
}

/// Scene of a frame. A scene is a run of consecutive frames from one scene change to the next; the controller
/// numbers its scenes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SceneMark {
    /// Number of the scene.
    pub number: u64,
    /// True for the scene's first frame.
    pub first: bool,
}

/// Chooses ray steps frame by frame.
pub trait Controller {
    /// Short name for tables.
    fn name(&self) -> &'static str;

    /// Chooses the step of the next frame.
    fn plan(&mut self, request: &mut PlanRequest<'_>) -> Decision;

    /// Updates the controller by a frame's time.
    fn observe(&mut self, observed: &Observed) -> Verdict;

    /// Forgets all observations.
    fn reset(&mut self);

    /// Sets `converted`, which is true if observed times come from another clock than the predicted times.
    /// When the value changes, the caller calls this method and then [`Controller::reset`].
    fn convert(&mut self, converted: bool) {
        let _ = converted;
    }

    /// Begins a frame whose setting the caller chooses; [`Controller::plan`] begins its frame itself. `step`
    /// is the frame's ray step, `cost` returns its uncorrected prediction at a ray step.
    fn begin(&mut self, changes: Changes, step: f32, cost: &mut dyn FnMut(f32) -> CostTerms) {
        let _ = (changes, step, cost);
    }

    /// Withdraws the last begun frame, which will not be drawn.
    fn withdraw(&mut self) {}

    /// Scene of the last begun frame.
    fn scene(&self) -> SceneMark {
        SceneMark::default()
    }

    /// Returns the prediction by which settings are chosen; by default, that of [`Controller::correct`]. The
    /// default controller leaves out a load that it ignores, and gives the upper bound by which it chooses
    /// steps.
    fn judged(&self, terms: &CostTerms, changes: Changes) -> Prediction {
        self.correct(terms, changes)
    }

    /// True if this prediction of [`Controller::judged`] meets the target: by default, if its upper bound is
    /// at most the target; without a bound, if its expected time is. The default controller compares the
    /// expected time with the target, and the bound with (1 + tolerance) × target.
    fn fits(&self, prediction: &Prediction, target: f32) -> bool {
        let bound = if prediction.upper.is_nan() { prediction.seconds } else { prediction.upper };
        bound <= target
    }

    /// Returns the corrected prediction; by default, the prediction without correction. For a frame that has
    /// not begun yet, `changes` are its changes since the previous frame; for the present frame, they are
    /// empty.
    fn correct(&self, terms: &CostTerms, changes: Changes) -> Prediction {
        let _ = changes;
        Prediction {
            seconds: terms.seconds(),
            upper: f32::NAN,
            out_of_range: terms.out_of_range,
            source: terms.source,
        }
    }

    /// Appends the learned state to a byte vector.
    fn save(&self, out: &mut Vec<u8>) {
        let _ = out;
    }

    /// Restores state written by [`Controller::save`]; on an error nothing changes.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for bytes that are cut short or damaged, or that a different
    /// kind of controller saved.
    fn load(&mut self, bytes: &[u8]) -> Result<()> {
        if !bytes.is_empty() {
            bail!(
                InvalidArgument,
                "the controller {} keeps no state, but {} bytes were given; start without them",
                self.name(),
                bytes.len()
            );
        }
        Ok(())
    }
}
