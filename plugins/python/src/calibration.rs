//! The result of a calibration for Python.

use crate::detach::detached;
use crate::errors::raise;
use entire_core::Error;
use entire_steer::calibrate::Calibrated;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

/// A model file's bytes, and its calibration's report.
pub(crate) type Fitted<'py> = (Bound<'py, PyBytes>, Bound<'py, PyDict>);

/// Runs a fit with the interpreter lock released, and returns its result for Python.
pub(crate) fn fitted<'py>(
    py: Python<'py>,
    fit: impl FnOnce() -> Result<Calibrated, Error> + Send,
) -> PyResult<Fitted<'py>> {
    let made = detached(py, || {
        let fitted = fit()?;
        Ok((fitted.file.to_bytes()?, fitted))
    });
    let (bytes, fitted): (Vec<u8>, Calibrated) = made.map_err(raise)?;
    let report = PyDict::new(py);
    report.set_item("frames", fitted.frames)?;
    report.set_item("held_out", fitted.held_out.to_string())?;
    report.set_item("median_error", fitted.median_error)?;
    report.set_item("rmse_over_sd", fitted.rmse_over_sd)?;
    report.set_item("upper_factor", fitted.upper.factor())?;
    report.set_item("scenes", fitted.quality.map_or(0, |q| q.scenes))?;
    Ok((PyBytes::new(py, &bytes), report))
}
