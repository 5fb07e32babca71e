//! A volume that an adapter steers.

use crate::camera::Placement;
use crate::frame::Shape;
use crate::volume::Volume;
use entire_core::scene::Frame;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

/// Parameters of a held volume that seldom change: its placement in the scene and its render modes. For
/// :meth:`Session.steer`.
///
/// Parameters
/// ----------
/// volume : Volume
/// to_world, direction, center
///     As in :meth:`Camera.scene`.
/// step : float
///     Ray step of frames that are not steered, in reference steps.
/// shading, skipping, termination
///     As in :meth:`Session.plan`.
///
/// Raises
/// ------
/// ValueError
///     For an unknown shading or skipping mode.
#[pyclass(frozen, module = "entire._native")]
pub(crate) struct Held {
    placement: Placement,
    shape: Shape,
}

#[pymethods]
impl Held {
    #[new]
    #[pyo3(signature = (volume, to_world, direction, center, *, step, shading, skipping, termination))]
    fn new(
        volume: &Volume,
        to_world: [f64; 16],
        direction: [f64; 9],
        center: [f64; 3],
        step: f32,
        shading: &str,
        skipping: &str,
        termination: f32,
    ) -> PyResult<Self> {
        Ok(Self {
            placement: Placement::new(volume, &to_world, &direction, center),
            shape: Shape::new([1, 1], step, shading, skipping, termination)?,
        })
    }
}

impl Held {
    /// Returns the frame that a camera sees; `to_eye` has the rows of its world-to-eye matrix.
    pub(crate) fn frame(
        &self,
        to_eye: &Bound<'_, PyTuple>,
        fov: f64,
        parallel_scale: Option<f64>,
        size: [i64; 2],
        step: Option<f32>,
    ) -> PyResult<Frame> {
        let mut rows = [0.0; 16];
        if to_eye.len() != rows.len() {
            return Err(PyValueError::new_err(format!(
                "to_eye has {} elements; it must have the 16 elements of a matrix, row by row",
                to_eye.len()
            )));
        }
        for (i, row) in rows.iter_mut().enumerate() {
            *row = to_eye.get_borrowed_item(i)?.extract()?;
        }
        let camera = self.placement.camera(&rows, fov, parallel_scale)?;
        self.shape.at(size, step).frame(camera.core)
    }
}
