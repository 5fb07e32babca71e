//! Files that are written whole or not at all.

use crate::detach::detached;
use pyo3::exceptions::{PyFileNotFoundError, PyOSError, PyValueError};
use pyo3::prelude::*;
use std::path::PathBuf;

/// Writes a file that is never left in part: under an unpredictable name beside it, flushed to the disk, then
/// renamed.
///
/// Parameters
/// ----------
/// path : str or os.PathLike
/// data : bytes
///
/// Raises
/// ------
/// OSError
///     Names the file that cannot be written.
#[pyfunction]
pub(crate) fn write_whole(py: Python<'_>, path: PathBuf, data: &[u8]) -> PyResult<()> {
    detached(py, || entire_io::files::write_whole(&path, data))
        .map_err(|error| PyOSError::new_err(format!("{error:#}")))
}

/// The file of this machine's model that `entire calibrate` stored in the user's data folder.
///
/// Parameters
/// ----------
/// shading : str
///     `"none"`, `"local"` or `"scatter"`.
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
///     If the machine was not calibrated for the mode; the text has the command.
#[pyfunction]
pub(crate) fn machine_file(shading: &str) -> PyResult<PathBuf> {
    let shading = entire_io::dataset::parse_shading(shading)
        .map_err(|error| PyValueError::new_err(format!("{error:#}")))?;
    entire_cli::calibrate::place::machine_file(shading)
        .map_err(|error| PyFileNotFoundError::new_err(format!("{error:#}")))
}
