//! Fitting the cost model to frames of the host's renderer.

use crate::camera::Camera;
use crate::detach::detached;
use crate::errors::raise;
use crate::frame::Shape;
use crate::lock::Guarded;
use crate::transfer::TransferFunction;
use crate::volume::Volume;
use entire_core::features::{FrameFeatures, Setting, TransferSummary};
use entire_core::predict::{AnalyticModel, Measurement, UnitCosts};
use entire_core::scene::Skipping;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

/// Timed frames of one renderer, and the cost model that fits them.
///
/// Examples
/// --------
/// >>> calibration = entire.Calibration()                                   # doctest: +SKIP
/// >>> for camera in cameras:                                               # doctest: +SKIP
/// ...     calibration.add(volume, camera, tf, size, seconds=draw(camera))
/// >>> session = entire.Session(volume, model=calibration.fit())            # doctest: +SKIP
#[pyclass(frozen, subclass, module = "entire._native")]
pub(crate) struct Calibration(Guarded<Vec<Measurement>>);

#[pymethods]
impl Calibration {
    #[new]
    fn new() -> Self {
        Self(Guarded::new(Vec::new()))
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
    ///     How long it took.
    /// step : float, optional
    ///     Ray step that it was drawn with, in reference steps. Default 1.
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
    #[allow(clippy::too_many_arguments, reason = "Python names them")]
    fn add(
        &self,
        py: Python<'_>,
        volume: &Volume,
        camera: &Camera,
        tf: &TransferFunction,
        size: (i64, i64),
        seconds: f64,
        step: f32,
        shading: &str,
        skipping: &str,
        termination: f32,
    ) -> PyResult<()> {
        let frame = Shape::new(size, step, shading, skipping, termination)?.frame(camera.core)?;
        let summary = volume.0.summary(py)?;
        let table = tf.0.table_for(&volume.0)?;
        let measurement: entire_core::Result<Measurement> = detached(py, || {
            let mut transfer = TransferSummary::new(summary, &table)?;
            if frame.skipping == Skipping::Distance {
                transfer.prepare_distance();
            }
            let mut features = FrameFeatures::default();
            features.measure(summary, &mut transfer, &frame)?;
            Ok(Measurement::new(&features, &Setting::from(&frame), seconds))
        });
        let measurement = measurement.map_err(raise)?;
        self.0.lock(py)?.push(measurement);
        Ok(())
    }

    fn __len__(&self, py: Python<'_>) -> PyResult<usize> {
        Ok(self.0.lock(py)?.len())
    }

    /// Fits the cost model, as the bytes of a model file and the median relative error over the frames.
    fn fit_bytes<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyBytes>, f64)> {
        let measurements = self.0.lock(py)?;
        let measurements: &Vec<Measurement> = &measurements;
        let (bytes, error) = detached(py, || {
            let mut model = AnalyticModel::default();
            let report = model.fit(&UnitCosts::SOFTWARE, measurements)?;
            Ok((model.to_model_file()?.to_bytes()?, report.median_error))
        })
        .map_err(raise)?;
        Ok((PyBytes::new(py, &bytes), error))
    }
}
