//! Fitting a model to frames of the host's renderer.

use crate::camera::Camera;
use crate::detach::detached;
use crate::errors::raise;
use crate::frame::{Shape, count};
use crate::lock::Guarded;
use crate::model::Model;
use crate::transfer::TransferFunction;
use crate::volume::Volume;
use entire_core::Error;
use entire_steer::calibrate::{Calibrated, Calibration as Core, Picture};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

/// Timed frames of one renderer, to which a model is fitted.
///
/// Parameters
/// ----------
/// model : Model, str, os.PathLike or bytes, optional
///     The model to start from, fitted on another machine or renderer, such as
///     ``"unshaded-selected"``. Default: the unit costs of a software renderer.
/// frames : int, optional
///     Number of frames to keep, 8 to 65536: a uniform random sample if more are added. Default 1000.
///
/// Raises
/// ------
/// ValueError
///     If `frames` is outside its range.
/// ModelError
///     If a calibration cannot start from a model of this kind.
///
/// Examples
/// --------
/// >>> calibration = entire.Calibration()                                   # doctest: +SKIP
/// >>> for camera in cameras:                                               # doctest: +SKIP
/// ...     calibration.add(volume, camera, tf, size, seconds=draw(camera))
/// >>> session = entire.Session(volume, model=calibration.fit())            # doctest: +SKIP
#[pyclass(frozen, subclass, module = "entire._native")]
pub(crate) struct Calibration(Guarded<Core>);

#[pymethods]
impl Calibration {
    #[new]
    #[pyo3(signature = (model = None, *, frames = 1000))]
    fn new(model: Option<&Model>, frames: i64) -> PyResult<Self> {
        let prior = model.map(|model| model.0.model_file()).transpose()?;
        Ok(Self(Guarded::new(Core::new(prior.as_ref(), count(frames)).map_err(raise)?)))
    }

    /// Adds a timed frame.
    ///
    /// Parameters
    /// ----------
    /// volume : Volume
    /// camera : Camera
    /// tf : TransferFunction
    /// size : (int, int)
    ///     Width and height of the image that was drawn, in pixels.
    /// seconds : float
    ///     Measured time of the frame.
    /// step : float, optional
    ///     Ray step of the frame, in reference steps. Default 1.
    /// shading, skipping, termination
    ///     As in :meth:`Session.plan`.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For a size, step or termination out of range.
    #[pyo3(signature = (volume, camera, tf, size, seconds, *, step = 1.0, shading = "none",
        skipping = "blocks",
        termination = 0.99))]
    fn add(
        &self,
        py: Python<'_>,
        volume: &Volume,
        camera: &Camera,
        tf: &TransferFunction,
        size: [i64; 2],
        seconds: f64,
        step: f32,
        shading: &str,
        skipping: &str,
        termination: f32,
    ) -> PyResult<()> {
        let frame = Shape::new(size, step, shading, skipping, termination)?.frame(camera.core)?;
        let summary = volume.0.summary(py)?;
        let table = tf.0.table_for(&volume.0)?;
        let mut core = self.0.lock(py)?;
        let core: &mut Core = &mut core;
        detached(py, || core.add(summary, &table, &frame, seconds)).map_err(raise)
    }

    /// Adds the error of a picture against the same view at full quality.
    ///
    /// The model then contains the renderer's quality law: picture error as a function of ray step and image
    /// size (:meth:`Session.set_quality`). The law needs at least 3 scenes, drawn at the same settings: full
    /// quality, coarser steps alone, smaller images alone, and both.
    ///
    /// Parameters
    /// ----------
    /// scene : int
    ///     Number of the view; all pictures of one view have the same number.
    /// step : float
    ///     Ray step as a multiple of the finest; 1 for full quality.
    /// image_sample_distance : float
    ///     Pixels between neighboring rays; 1 for full quality.
    /// seconds : float
    ///     Measured time of the picture.
    /// error : float
    ///     Difference from the picture at full quality, by any measure that is 0 for equal pictures and grows
    ///     with the difference, such as the root mean square difference of colors, or 1 - SSIM.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For numbers out of range.
    fn add_picture(
        &self,
        py: Python<'_>,
        scene: u64,
        step: f32,
        image_sample_distance: f32,
        seconds: f64,
        error: f64,
    ) -> PyResult<()> {
        let picture = Picture { scene, step, distance: image_sample_distance, seconds, error };
        self.0.lock(py)?.add_picture(picture).map_err(raise)
    }

    fn __len__(&self, py: Python<'_>) -> PyResult<usize> {
        Ok(self.0.lock(py)?.frames())
    }

    /// Fits the model; returns the bytes of its file, and its report.
    ///
    /// Parameters
    /// ----------
    /// renderer, clock : str, optional
    ///     Names of the renderer and of the clock that timed the frames.
    #[pyo3(signature = (renderer = "", clock = ""))]
    fn fit_bytes<'py>(&self, py: Python<'py>, renderer: &str, clock: &str) -> PyResult<Fitted<'py>> {
        let core = self.0.lock(py)?;
        let core: &Core = &core;
        fitted(py, || core.fit([renderer, clock]))
    }
}

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
