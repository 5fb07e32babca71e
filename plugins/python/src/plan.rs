//! Plans and predictions of a session.

use entire_steer::control::Plan as CorePlan;
use entire_steer::predict::{Prediction as CorePrediction, Source};
use pyo3::prelude::*;
use std::sync::Arc;

/// Settings of a frame to draw, and its expected time.
#[pyclass(frozen, module = "entire")]
#[derive(Clone)]
pub(crate) struct Plan {
    /// int : Number of this plan in its session; never 0.
    #[pyo3(get)]
    pub(crate) id: u64,
    /// float : Ray step in reference steps (smallest voxel spacings).
    #[pyo3(get)]
    pub(crate) step: f32,
    /// float : Pixels between rays along each side of the image, at least 1.
    #[pyo3(get)]
    pub(crate) image_sample_distance: f32,
    /// tuple of int : Width and height of the image to draw, in pixels.
    #[pyo3(get)]
    size: (u32, u32),
    /// float : Expected seconds; NaN if unknown.
    #[pyo3(get)]
    pub(crate) seconds: f32,
    /// float : Upper bound of the seconds; NaN if there is none.
    #[pyo3(get)]
    pub(crate) upper: f32,
    /// float : 0 inside the predictor's training range, larger with the distance from it; NaN if unknown.
    /// Above the session's `trust_limit`, steps are chosen from recent frames.
    #[pyo3(get)]
    out_of_range: f32,
    /// str : Reason for the step, in a word or two: "fits", "held", "damped", "finest allowed", ...
    #[pyo3(get)]
    pub(crate) reason: &'static str,
    /// float : Target time of the frame in seconds.
    #[pyo3(get)]
    pub(crate) target: f32,
    /// Identity of the session that made this plan.
    pub(crate) session: Arc<()>,
}

impl Plan {
    /// Makes Python's plan from a plan of the core, the image size in pixels, the target in seconds and the
    /// session's identity.
    pub(crate) fn new(plan: CorePlan, size: (u32, u32), target: f32, session: &Arc<()>) -> Self {
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
            session: session.clone(),
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
