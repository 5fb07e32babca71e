//! The result of a calibration for Python.

use crate::detach::detached;
use crate::errors::raise;
use entire_core::Error;
use entire_steer::Session;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

/// A model file's bytes, and its calibration's report.
pub(crate) type Fitted<'py> = (Bound<'py, PyBytes>, Bound<'py, PyDict>);

/// Fits a model to a session's recorded frames with the interpreter lock released, and returns the result for
/// Python. Access to the session is exclusive, since predictors are not `Sync`.
pub(crate) fn fitted<'py>(py: Python<'py>, session: &mut Session) -> PyResult<Fitted<'py>> {
    let (bytes, fitted) = detached(py, move || {
        let fitted = session.calibrate()?;
        Ok::<_, Error>((fitted.file.to_bytes()?, fitted))
    })
    .map_err(raise)?;
    let report = PyDict::new(py);
    report.set_item("frames", fitted.frames)?;
    report.set_item("held_out", fitted.held_out.to_string())?;
    report.set_item("median_error", fitted.median_error)?;
    report.set_item("rmse_over_sd", fitted.rmse_over_sd)?;
    report.set_item("upper_factor", fitted.upper.factor())?;
    report.set_item("scenes", fitted.quality.map_or(0, |q| q.scenes))?;
    Ok((PyBytes::new(py, &bytes), report))
}
