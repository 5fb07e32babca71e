//! The time of a window's frame, divided among the passes that draw volumes in it.

use entire_steer::control as core;
use pyo3::prelude::*;

/// Divides the time of a window's frame among the passes that draw volumes in it
/// (`entire_steer::control::FrameBudget`), for the adapters of this package.
#[pyclass(module = "entire._native")]
pub(crate) struct FrameBudget(core::FrameBudget);

/// State of one volume in a window's frames, which may draw it several times.
#[pyclass(module = "entire._native")]
pub(crate) struct PassShare(core::PassShare);

#[pymethods]
impl FrameBudget {
    #[new]
    fn new() -> Self {
        Self(core::FrameBudget::default())
    }

    /// Begins a frame of the window, which will draw about `volumes` volumes; 0 if the number is not known.
    #[pyo3(signature = (volumes, /))]
    fn begin(&mut self, volumes: u32) {
        self.0.begin(volumes);
    }

    /// Seconds that the next pass may take if the whole frame may take `target` seconds.
    #[pyo3(signature = (passed, target, /))]
    fn share(&self, passed: &PassShare, target: f32) -> f32 {
        self.0.share(&passed.0, target)
    }

    /// Adds a pass that took `seconds`; `full` is its estimated time in seconds at full quality.
    #[pyo3(signature = (passed, seconds, full, /))]
    fn drew(&mut self, passed: &mut PassShare, seconds: f32, full: f32) {
        self.0.drew(&mut passed.0, seconds, full);
    }

    /// Ends a frame that took `seconds`; `usual` is false if it included work that most frames do not.
    #[pyo3(signature = (seconds, usual, /))]
    fn end(&mut self, seconds: f32, usual: bool) {
        self.0.end(seconds, usual);
    }
}

#[pymethods]
impl PassShare {
    #[new]
    fn new() -> Self {
        Self(core::PassShare::default())
    }
}
