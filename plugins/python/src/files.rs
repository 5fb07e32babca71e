//! Files, whole or absent.

use crate::detach::detached;
use pyo3::exceptions::PyOSError;
use pyo3::prelude::*;
use std::path::PathBuf;

/// Writes a file, whole or not at all: under a name beside it that nobody can foresee, flushed to the disk,
/// then put in its place.
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
    detached(py, || entire_cli::files::write_whole(&path, data))
        .map_err(|error| PyOSError::new_err(format!("{error:#}")))
}
