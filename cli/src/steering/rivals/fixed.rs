//! The controller without steering: one step for every frame.

use entire_steer::control::{Controller, Decision, Observed, PlanRequest, Reason, Verdict};

/// Always the same step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Fixed {
    step: f32,
}

impl Fixed {
    /// Draws every frame with `step`, clamped to the limits.
    pub(crate) fn new(step: f32) -> Self {
        Self { step }
    }
}

impl Controller for Fixed {
    fn name(&self) -> &'static str {
        "fixed"
    }

    fn plan(&mut self, request: &mut PlanRequest<'_>) -> Decision {
        Decision {
            step: request.limits.clamp(self.step),
            seconds: f32::NAN,
            upper: f32::NAN,
            out_of_range: f32::NAN,
            reason: Reason::Off,
        }
    }

    fn observe(&mut self, _: &Observed) -> Verdict {
        Verdict::Ignored
    }

    fn reset(&mut self) {}
}
