//! Algorithm 1 of the paper, and its baselines: a fixed step, OLP and PID.

use super::{Rule, StepResponse};
use entire_steer::control::{Controller, Decision, Observed, PlanRequest, Reason, StepLimits, Verdict};

fn decision(step: f32, seconds: f32, out_of_range: f32, reason: Reason) -> Decision {
    Decision { step, seconds, upper: f32::NAN, out_of_range, reason }
}

/// Returns the decision for a step that depends on earlier frames alone.
pub(super) fn reactive(step: f32) -> Decision {
    decision(step, f32::NAN, f32::NAN, Reason::Reactive)
}

/// No steering: always the same step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Fixed {
    /// The step, which the limits clamp.
    pub(crate) step: f32,
}

impl Controller for Fixed {
    fn name(&self) -> &'static str {
        "fixed"
    }

    fn plan(&mut self, request: &mut PlanRequest<'_>) -> Decision {
        decision(request.limits.clamp(self.step), f32::NAN, f32::NAN, Reason::Off)
    }

    fn observe(&mut self, _: &Observed) -> Verdict {
        Verdict::Ignored
    }

    fn reset(&mut self) {}
}

/// Algorithm 1: the ray step is δ = δ_ref · G⁻¹(t_target / t_predict), with the reference step δ_ref, the
/// response curve G, the target t_target, and the prediction at the reference step t_predict.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Algorithm1 {
    pub(crate) response: StepResponse,
}

impl Controller for Algorithm1 {
    fn name(&self) -> &'static str {
        "algorithm1"
    }

    fn plan(&mut self, request: &mut PlanRequest<'_>) -> Decision {
        let terms = (request.cost)(1.0);
        let at_reference = terms.parts.iter().sum::<f32>();
        if !(at_reference.is_finite() && at_reference > 0.0) {
            return decision(request.limits.coarsest, f32::NAN, f32::NAN, Reason::NoInformation);
        }
        let step = request.limits.clamp(self.response.step_ratio(request.target / at_reference));
        decision(step, at_reference * self.response.time_ratio(step), terms.out_of_range, Reason::Fits)
    }

    fn observe(&mut self, _: &Observed) -> Verdict {
        Verdict::Ignored
    }

    fn reset(&mut self) {}
}

/// Rule by which recent frame times predict the next one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Recent {
    MeanOfThree,
    Last,
    LargerOfTwo,
}

/// Reactive rules on recent frame times. Each time is converted to the reference step by G. The predicted
/// time is the mean of the last three times (the paper's OLP), the last time, or the longer one of the last
/// two; G gives the step at which the predicted time equals the target. The first frame is drawn at the
/// reference step.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Olp {
    recent: Recent,
    response: StepResponse,
    window: [f32; 3],
    seen: usize,
}

impl Olp {
    pub(crate) fn new(recent: Recent, response: StepResponse) -> Self {
        Self { recent, response, window: [0.0; 3], seen: 0 }
    }

    /// Returns the time of an observed frame, converted to the reference step; `frames` is 0 for the last
    /// frame, 1 for the frame before it.
    fn ago(&self, frames: usize) -> f32 {
        self.window[(self.seen + 2 - frames) % 3]
    }
}

impl Controller for Olp {
    fn name(&self) -> &'static str {
        match self.recent {
            Recent::MeanOfThree => "olp",
            Recent::Last => "last",
            Recent::LargerOfTwo => "larger-of-two",
        }
    }

    fn plan(&mut self, request: &mut PlanRequest<'_>) -> Decision {
        let n = self.seen.min(3);
        if n == 0 {
            return reactive(request.limits.clamp(1.0));
        }
        let at_reference = match self.recent {
            Recent::MeanOfThree => self.window[..n].iter().sum::<f32>() / n as f32,
            Recent::LargerOfTwo if n > 1 => self.ago(0).max(self.ago(1)),
            _ => self.ago(0),
        };
        let step = request.limits.clamp(self.response.step_ratio(request.target / at_reference));
        decision(step, at_reference * self.response.time_ratio(step), f32::NAN, Reason::Reactive)
    }

    fn observe(&mut self, observed: &Observed) -> Verdict {
        self.window[self.seen % 3] = observed.seconds / self.response.time_ratio(observed.step);
        // The count goes from 5 back to 3: `seen % 3` stays cyclic, `seen` stays at least 3 (a full window),
        // and it cannot overflow.
        self.seen = if self.seen >= 5 { 3 } else { self.seen + 1 };
        Verdict::Learned
    }

    fn reset(&mut self) {
        self.seen = 0;
    }
}

/// PID on the step. With the error e = (t − t_target) / t_target of the last frame, the next step is
/// step · (1 + P e) + I Σe + D Δe. Σe is reset to 0 when the limits clamp the step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pid {
    gains: [f32; 3],
    step: f32,
    integral: f32,
    last: Option<f32>,
}

/// Proportional, integral and differential gain of PID: the best on the recorded training paths, by
/// `entire-lab tune`. The paper has 0.3, 0.05 and 0.1.
pub const PID_GAINS: [f32; 3] = [1.18, 0.78, 0.012];

impl Pid {
    /// Returns the rule with these gains, before the first frame.
    pub(crate) const fn with_gains(gains: [f32; 3]) -> Self {
        Self { gains, ..Self::START }
    }
}

impl Rule for Pid {
    const NAME: &'static str = "pid";
    const START: Self = Self { gains: PID_GAINS, step: 1.0, integral: 0.0, last: None };

    fn step(&mut self, _: f32, limits: StepLimits) -> f32 {
        let clamped = limits.clamp(self.step);
        if clamped != self.step {
            self.integral = 0.0;
            self.step = clamped;
        }
        self.step
    }

    fn learn(&mut self, observed: &Observed) -> Verdict {
        // The error is clamped, so that a single stall does not dominate the integral for a hundred frames.
        let error = ((observed.seconds - observed.target) / observed.target).clamp(-1.0, 10.0);
        self.integral = (self.integral + error).clamp(-20.0, 20.0);
        let difference = error - self.last.unwrap_or(error);
        self.last = Some(error);
        let [p, i, d] = self.gains;
        self.step =
            (observed.step * (1.0 + p * error) + i * self.integral + d * difference).clamp(1.0e-3, 1.0e4);
        Verdict::Learned
    }

    fn reset(&mut self) {
        *self = Self::with_gains(self.gains);
    }
}
