//! Files that are written completely or not at all.

use crate::detach::detached;
use crate::frame::mode;
use pyo3::exceptions::{PyFileNotFoundError, PyOSError};
use pyo3::prelude::*;
use std::path::PathBuf;

/// Writes a file completely or not at all. The data go to a file with an unpredictable name beside it, which
/// is flushed to the disk and then renamed.
///
/// Parameters
/// ----------
/// path : str or os.PathLike
/// data : bytes
///
/// Raises
/// ------
/// OSError
///     If the file cannot be written; the text names it.
#[pyfunction]
pub(crate) fn write_whole(py: Python<'_>, path: PathBuf, data: &[u8]) -> PyResult<()> {
    detached(py, || entire_io::files::write_whole(&path, data))
        .map_err(|error| PyOSError::new_err(format!("{error:#}")))
}

/// Path of this machine's model, which `entire calibrate` stored in the user's data folder.
///
/// Parameters
/// ----------
/// shading : str
///     `"none"`, `"local"`, `"scatter"` or `"local-scatter"`.
///
/// Returns
/// -------
/// pathlib.Path
///
/// Raises
/// ------
/// ValueError
///     For another shading mode.
/// FileNotFoundError
///     If the machine was not calibrated for the mode; the text gives the command to do so.
#[pyfunction]
pub(crate) fn machine_file(shading: &str) -> PyResult<PathBuf> {
    let shading = mode(shading)?;
    entire_cli::calibrate::place::machine_file(shading).map_err(|_| {
        PyFileNotFoundError::new_err(format!(
            "this machine has no model for shading {shading}; make one with \
             `entire calibrate --shade {shading}`, or pass another model (entire.models() names them)"
        ))
    })
}
