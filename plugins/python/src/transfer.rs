//! Transfer functions: opacity and color.

use crate::errors::raise;
use crate::volume::{Data, asarray, astype};
use entire_core::scene::{
    ControlPoint, GaussianLobe, Node, Nodes, TransferFunction as Description, TransferTable,
};
use numpy::{PyArray2, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::sync::Arc;

#[derive(Clone, Copy)]
enum Unit {
    ReferenceSteps(f32),
    World(f32),
}

/// A checked transfer function and its table.
pub(crate) struct Transfer {
    description: Description,
    table: TransferTable,
    unit: Unit,
}

impl Transfer {
    /// Returns the table with its unit distance in reference steps of a volume.
    pub(crate) fn table_for(&self, volume: &Data) -> PyResult<TransferTable> {
        let table = self.table.clone();
        match self.unit {
            Unit::ReferenceSteps(distance) => table.with_unit_distance(distance),
            Unit::World(distance) => table.with_unit_distance(distance / volume.spacing().min_element()),
        }
        .map_err(raise)
    }

    pub(crate) fn lobes(&self) -> Option<&[GaussianLobe]> {
        match &self.description {
            Description::Gaussian(lobes) => Some(lobes),
            _ => None,
        }
    }
}

/// Opacity and color of scalar values. Made by :meth:`lobes`, :meth:`points`, :meth:`nodes` or :meth:`table`.
///
/// An opacity applies to a fixed length along a ray: `unit_distance` reference steps (1 by default; a
/// reference step is the smallest voxel spacing), or `unit_length` in the unit of the volume's spacing.
#[pyclass(frozen, module = "entire")]
pub(crate) struct TransferFunction(pub(crate) Arc<Transfer>);

fn made(
    description: Description,
    unit_distance: Option<f32>,
    unit_length: Option<f32>,
) -> PyResult<TransferFunction> {
    let unit = match (unit_distance, unit_length) {
        (Some(_), Some(_)) => {
            return Err(PyValueError::new_err(
                "unit_distance and unit_length are both given, but opacities apply to one length; pass one of \
                 them",
            ));
        }
        (_, Some(length)) if !(length.is_finite() && length > 0.0) => {
            return Err(PyValueError::new_err(format!(
                "unit_length is {length}; it must be finite and positive"
            )));
        }
        (_, Some(length)) => Unit::World(length),
        (distance, None) => Unit::ReferenceSteps(distance.unwrap_or(1.0)),
    };
    let table = description.to_table().map_err(raise)?;
    // Only a check, so that an invalid length is reported here and not when a volume is used.
    let (Unit::ReferenceSteps(length) | Unit::World(length)) = unit;
    table.clone().with_unit_distance(length).map_err(raise)?;
    Ok(TransferFunction(Arc::new(Transfer { description, table, unit })))
}

/// Makes a point or node of each row; `make` returns `None` for a row with another number of elements than
/// `accepted` names.
fn each<N, T>(
    rows: &[Vec<N>],
    name: &str,
    accepted: &str,
    make: impl Fn(&[N]) -> Option<T>,
) -> PyResult<Vec<T>> {
    let mut all = Vec::with_capacity(rows.len());
    for (i, row) in rows.iter().enumerate() {
        all.push(make(row).ok_or_else(|| {
            PyValueError::new_err(format!("{name} {i} has {} numbers; it must have {accepted}", row.len()))
        })?);
    }
    Ok(all)
}

#[pymethods]
impl TransferFunction {
    /// Gaussian opacity lobes: opacity is the sum of ``height * exp(-(s - center)**2 / width)``.
    ///
    /// Parameters
    /// ----------
    /// lobes : sequence of (center, width, height)
    ///     `center` in the volume's range scaled to [0, 1], `width` positive, `height` not negative.
    /// unit_distance, unit_length : float, optional
    ///     Length along a ray to which opacities apply, see the class.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For an invalid lobe; the text names the lobe and the error.
    #[staticmethod]
    #[pyo3(signature = (lobes, *, unit_distance = None, unit_length = None))]
    fn lobes(lobes: Vec<[f32; 3]>, unit_distance: Option<f32>, unit_length: Option<f32>) -> PyResult<Self> {
        let lobes =
            lobes.into_iter().map(|[center, width, height]| GaussianLobe { center, width, height }).collect();
        made(Description::Gaussian(lobes), unit_distance, unit_length)
    }

    /// Control points with linear interpolation between them, constant beyond the first and the last.
    ///
    /// Parameters
    /// ----------
    /// points : sequence of (position, opacity) or (position, red, green, blue, opacity)
    ///     Points in ascending order of position; all numbers in [0, 1]. Two points at one position make a
    ///     step.
    /// unit_distance, unit_length : float, optional
    ///     Length along a ray to which opacities apply, see the class.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For an invalid point; the text names the point and the error.
    #[staticmethod]
    #[pyo3(signature = (points, *, unit_distance = None, unit_length = None))]
    fn points(points: Vec<Vec<f32>>, unit_distance: Option<f32>, unit_length: Option<f32>) -> PyResult<Self> {
        let accepted = "2 (position, opacity) or 5 (position, red, green, blue, opacity)";
        let points = each(&points, "control point", accepted, |row| match *row {
            [position, opacity] => Some(ControlPoint { position, color: [1.0; 3], opacity }),
            [position, r, g, b, opacity] => Some(ControlPoint { position, color: [r, g, b], opacity }),
            _ => None,
        })?;
        made(Description::Points(points), unit_distance, unit_length)
    }

    /// Nodes as in VTK and ParaView, evaluated like ``vtkPiecewiseFunction`` and
    /// ``vtkColorTransferFunction``.
    ///
    /// Parameters
    /// ----------
    /// opacity : sequence of (position, opacity) or (position, opacity, midpoint, sharpness)
    ///     Positions are scalar values, ascending; all other numbers lie in [0, 1]. Midpoint 0.5 and
    ///     sharpness 0 interpolate linearly.
    /// color : sequence of (position, red, green, blue[, midpoint, sharpness]), optional
    ///     Default: a color ramp.
    /// range : (float, float)
    ///     Scalar values that map to 0 and 1: the volume's range.
    /// clamp : bool, optional
    ///     True if the values of the outermost nodes continue beyond them. Default True.
    /// unit_distance, unit_length : float, optional
    ///     Length along a ray to which opacities apply, see the class.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For an invalid node; the text names the node and the error.
    #[staticmethod]
    #[pyo3(signature = (opacity, color = Vec::new(), *, range, clamp = true, unit_distance = None,
        unit_length = None))]
    fn nodes(
        opacity: Vec<Vec<f64>>,
        color: Vec<Vec<f64>>,
        range: [f64; 2],
        clamp: bool,
        unit_distance: Option<f32>,
        unit_length: Option<f32>,
    ) -> PyResult<Self> {
        let accepted = "2 (position, opacity) or 4 (position, opacity, midpoint, sharpness)";
        let opacity = each(&opacity, "opacity node", accepted, |row| match *row {
            [position, value] => Some(Node { position, value, midpoint: 0.5, sharpness: 0.0 }),
            [position, value, midpoint, sharpness] => Some(Node { position, value, midpoint, sharpness }),
            _ => None,
        })?;
        let accepted = "4 (position, red, green, blue) or 6 (also midpoint, sharpness)";
        let color = each(&color, "color node", accepted, |row| match *row {
            [position, r, g, b] => Some(Node { position, value: [r, g, b], midpoint: 0.5, sharpness: 0.0 }),
            [position, r, g, b, midpoint, sharpness] => {
                Some(Node { position, value: [r, g, b], midpoint, sharpness })
            }
            _ => None,
        })?;
        let nodes = Nodes { opacity, color, range: range.into(), clamp };
        made(Description::Nodes(nodes), unit_distance, unit_length)
    }

    /// Evenly spaced samples, the first at the low end of the volume's range and the last at its high end.
    ///
    /// Parameters
    /// ----------
    /// samples : array_like, shape (n, 4) or (n,)
    ///     Red, green, blue and opacity, or opacities alone, in [0, 1]; n at least 2.
    /// unit_distance, unit_length : float, optional
    ///     Length along a ray to which opacities apply, see the class.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For another shape, too few samples, or a sample outside [0, 1].
    #[staticmethod]
    #[pyo3(signature = (samples, *, unit_distance = None, unit_length = None))]
    fn table(
        samples: &Bound<'_, PyAny>,
        unit_distance: Option<f32>,
        unit_length: Option<f32>,
    ) -> PyResult<Self> {
        let array = astype(&asarray(samples)?, "float32")?;
        let shape: Vec<usize> = array.getattr("shape")?.extract()?;
        let samples: Vec<[f32; 4]> = match shape[..] {
            [_] => array.extract::<Vec<f32>>()?.into_iter().map(|a| [1.0, 1.0, 1.0, a]).collect(),
            [_, 4] => {
                let rows: PyReadonlyArray2<'_, f32> = array.extract()?;
                rows.as_array().outer_iter().map(|r| [r[0], r[1], r[2], r[3]]).collect()
            }
            _ => {
                return Err(PyValueError::new_err(format!(
                    "the table has the shape {shape:?}; it must be (n, 4) for red, green, blue, opacity or \
                     (n,) for opacity"
                )));
            }
        };
        made(Description::uniform(&samples).map_err(raise)?, unit_distance, unit_length)
    }

    /// numpy.ndarray : float32, shape (256, 4): red, green, blue and opacity over the volume's range.
    #[getter]
    fn rgba<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let rows: Vec<Vec<f32>> = self.0.table.rgba().iter().map(|row| row.to_vec()).collect();
        PyArray2::from_vec2(py, &rows).map_err(|e| PyValueError::new_err(e.to_string()))
    }

    fn __repr__(&self) -> String {
        let what = match &self.0.description {
            Description::Gaussian(lobes) => format!("{} Gaussian lobes", lobes.len()),
            Description::Points(points) => format!("{} points", points.len()),
            Description::Nodes(nodes) => {
                format!("{} opacity nodes, {} color nodes", nodes.opacity.len(), nodes.color.len())
            }
            _ => "a function".to_owned(),
        };
        format!("TransferFunction({what})")
    }
}
