//! Frames and cameras from Python's arguments.

use crate::camera::{Camera, from_arcball, from_view};
use crate::errors::raise;
use crate::volume::{Volume, asarray, astype};
use entire_core::scene::{Camera as CoreCamera, Frame, Shading, Skipping};
use numpy::{PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use std::str::FromStr;

/// Parameters of a frame besides its camera.
#[derive(Clone, Copy)]
pub(crate) struct Shape {
    pub(crate) size: (u32, u32),
    pub(crate) step: f32,
    pub(crate) shading: Shading,
    pub(crate) skipping: Skipping,
    pub(crate) termination: f32,
}

pub(crate) fn mode<T: FromStr<Err = entire_core::Error>>(name: &str) -> PyResult<T> {
    name.parse().map_err(|error: T::Err| PyValueError::new_err(error.to_string()))
}

impl Shape {
    pub(crate) fn new(
        size: [i64; 2],
        step: f32,
        shading: &str,
        skipping: &str,
        termination: f32,
    ) -> PyResult<Self> {
        let (shading, skipping) = (mode(shading)?, mode(skipping)?);
        Ok(Self { size: sides(size), step, shading, skipping, termination })
    }

    /// Returns these parameters with the given size, and with the given step if there is one.
    pub(crate) fn at(self, size: [i64; 2], step: Option<f32>) -> Self {
        Self { size: sides(size), step: step.unwrap_or(self.step), ..self }
    }

    pub(crate) fn frame(&self, camera: CoreCamera) -> PyResult<Frame> {
        let build = || {
            Frame {
                step: self.step,
                termination: self.termination,
                shading: self.shading,
                skipping: self.skipping,
                ..Frame::new(camera, self.size.0, self.size.1)?
            }
            .checked()
        };
        build().map_err(raise)
    }
}

/// Returns `number` as a count. A negative number becomes 0, which no caller accepts.
pub(crate) fn count(number: i64) -> usize {
    usize::try_from(number).unwrap_or(0)
}

/// Returns width and height. A number that is out of range becomes 0, which no frame accepts.
pub(crate) fn sides(size: [i64; 2]) -> (u32, u32) {
    let side = |v: i64| u32::try_from(v).unwrap_or(0);
    size.map(side).into()
}

/// Many cameras: camera objects, arcball poses (n, 3) or world-to-eye matrices (n, 4, 4).
pub(crate) fn cameras(given: &Bound<'_, PyAny>, volume: &Volume, fov: f32) -> PyResult<Vec<CoreCamera>> {
    if let Ok(camera) = given.cast::<Camera>() {
        return Ok(vec![camera.get().core]);
    }
    if let Ok(list) = given.extract::<Vec<Camera>>() {
        return Ok(list.into_iter().map(|c| c.core).collect());
    }
    let array = asarray(given)?;
    let shape: Vec<usize> = array.getattr("shape")?.extract()?;
    let py = given.py();
    let at = |i: usize| move |e: PyErr| PyValueError::new_err(format!("camera {i}: {}", e.value(py)));
    match shape[..] {
        [_, 3] => {
            let rows: PyReadonlyArray2<'_, f32> = astype(&array, "float32")?.extract()?;
            let rows = rows.as_array();
            let poses = rows.outer_iter().enumerate();
            poses
                .map(|(i, r)| from_arcball(r[0], r[1], r[2], fov, None).map(|c| c.core).map_err(at(i)))
                .collect()
        }
        [_, 4, 4] => {
            let all: PyReadonlyArray3<'_, f64> = astype(&array, "float64")?.extract()?;
            let all = all.as_array();
            let matrices = all.outer_iter().enumerate();
            matrices
                .map(|(i, m)| {
                    let rows = std::array::from_fn(|r| std::array::from_fn(|c| m[[r, c]]));
                    from_view(volume, rows, fov, None).map(|c| c.core).map_err(at(i))
                })
                .collect()
        }
        _ => Err(PyTypeError::new_err(format!(
            "cameras have the shape {shape:?}; pass Camera objects, an array (n, 3) of rx, ry, dz or an \
             array (n, 4, 4) of world-to-eye matrices"
        ))),
    }
}
