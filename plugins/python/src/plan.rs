//! Plans and predictions of a session.

use entire_steer::control::Plan as CorePlan;
use entire_steer::predict::{Prediction as CorePrediction, Source};
use pyo3::prelude::*;

/// Settings of a frame to draw, and its expected time.
#[pyclass(frozen, get_all, module = "entire")]
pub(crate) struct Plan {
    /// int : Number of this plan in its session; never 0.
    pub(crate) id: u64,
    /// float : Ray step in reference steps (smallest voxel spacings).
    step: f32,
    /// float : Pixels between rays along each side of the image, at least 1.
    image_sample_distance: f32,
    /// tuple of int : Width and height of the image to draw, in pixels.
    size: (u32, u32),
    /// float : Expected seconds; NaN if unknown.
    seconds: f32,
    /// float : Upper bound of the seconds; NaN if there is none.
    upper: f32,
    /// float : 0 inside the predictor's training range, larger with the distance from it; NaN if unknown.
    /// Above the session's `trust_limit`, steps are chosen from recent frames.
    out_of_range: f32,
    /// str : Reason for the step, in a word or two: "fits", "held", "damped", "finest allowed", ...
    reason: &'static str,
    /// float : Target time of the frame in seconds.
    target: f32,
}

impl Plan {
    /// Makes Python's plan from a plan of the core, the image size in pixels and the target in seconds.
    pub(crate) fn new(plan: CorePlan, size: (u32, u32), target: f32) -> Self {
        Self {
            id: plan.id,
            step: plan.step,
            image_sample_distance: plan.image_sample_distance,
            size,
            seconds: plan.seconds,
            upper: plan.upper,
            out_of_range: plan.out_of_range,
            reason: plan.reason.into(),
            target,
        }
    }
}

#[pymethods]
impl Plan {
    fn __repr__(&self) -> String {
        format!(
            "Plan(step {:.3}, {} x {} pixels, {:.2} ms expected, target {:.2} ms: {})",
            self.step,
            self.size.0,
            self.size.1,
            1e3 * self.seconds,
            1e3 * self.target,
            self.reason
        )
    }
}

/// A predicted frame time.
#[pyclass(frozen, get_all, module = "entire")]
pub(crate) struct Prediction {
    /// float : Expected seconds.
    seconds: f32,
    /// float : Upper bound of the seconds; NaN if there is none.
    upper: f32,
    /// float : As in :class:`Plan`.
    out_of_range: f32,
    /// str : Source of the prediction: "analytic" or "network".
    source: &'static str,
}

impl From<CorePrediction> for Prediction {
    fn from(p: CorePrediction) -> Self {
        let source = match p.source {
            Source::Analytic => "analytic",
            Source::Network => "network",
        };
        Self { seconds: p.seconds, upper: p.upper, out_of_range: p.out_of_range, source }
    }
}

#[pymethods]
impl Prediction {
    fn __repr__(&self) -> String {
        format!("Prediction({:.3} ms, {})", 1e3 * self.seconds, self.source)
    }

    fn __float__(&self) -> f64 {
        f64::from(self.seconds)
    }
}
