//! The command `entire` inside the wheel.

use crate::detach::detached;
use pyo3::prelude::*;
use std::ffi::OsString;
use std::process::ExitCode;

/// Runs the command line `entire`.
///
/// Parameters
/// ----------
/// args : list of str
///     The program's name, then its arguments.
///
/// Returns
/// -------
/// int
///     Exit status: 0, or 1 after an error, which is written to standard error. Wrong usage ends the process
///     with status 2.
#[pyfunction]
pub(crate) fn command(py: Python<'_>, args: Vec<OsString>) -> PyResult<i32> {
    let python: Option<OsString> = py.import("sys")?.getattr("executable")?.extract()?;
    let program = vec![python.unwrap_or_else(|| "python3".into()), "-m".into(), "entire".into()];
    Ok(i32::from(detached(py, || entire_cli::main_with_args(args, program)) != ExitCode::SUCCESS))
}
