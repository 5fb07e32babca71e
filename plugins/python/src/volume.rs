//! Voxels in a NumPy array.

use crate::detach::{calling, detached};
use crate::errors::raise;
use crate::lock::Guarded;
use entire_core::kernels::Executor;
use entire_core::scene::{ScalarType, Scalars, VolumeOptions, VolumeView};
use entire_steer::features::{SummarySeries, VolumeSummary};
use glam::Vec3;
use numpy::{PyArrayDescrMethods, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::PyDict;
use std::sync::{Arc, OnceLock};

/// A volume's voxels, and the summary that prediction needs.
pub(crate) struct Data {
    view: VolumeView<'static>,
    origin: [f64; 3],
    summary: OnceLock<VolumeSummary>,
    copied: bool,
    /// Fill values, which mark voxels without data.
    fill: Vec<f32>,
    /// Indices of the array's axes that run along x, y, z.
    order: [usize; 3],
    /// State that the time steps of a volume share, and the number of this step.
    series: Arc<Guarded<Series>>,
    step: u64,
    /// Keeps the memory of `view` alive.
    owner: Py<PyAny>,
}

/// Data and number of the latest time step.
#[derive(Default)]
struct Series {
    kept: Option<Box<SummarySeries>>,
    step: u64,
}

impl Data {
    pub(crate) fn view(&self) -> &VolumeView<'static> {
        &self.view
    }

    /// Summary of the voxels; scanned at the first call, with the interpreter lock released.
    pub(crate) fn summary(&self, py: Python<'_>) -> PyResult<&VolumeSummary> {
        if let Some(summary) = self.summary.get() {
            return Ok(summary);
        }
        let summary = detached(py, || VolumeSummary::new(&self.view)).map_err(raise)?;
        Ok(self.summary.get_or_init(|| summary))
    }

    /// True if this and the other volume are different time steps of one volume.
    pub(crate) fn follows(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.series, &other.series) && self.step != other.step
    }

    pub(crate) fn spacing(&self) -> Vec3 {
        self.view.shape().spacing
    }

    pub(crate) fn radius(&self) -> f32 {
        self.view.shape().bounding_radius
    }

    /// World position of the middle of the voxels.
    pub(crate) fn center(&self) -> [f64; 3] {
        let (dims, spacing) = (self.view.shape().dims, self.view.shape().spacing);
        std::array::from_fn(|a| self.origin[a] + 0.5 * (dims[a] as f64 - 1.0) * f64::from(spacing[a]))
    }
}

/// A scalar volume on a regular grid, read in place from memory.
///
/// Arrays of ``uint8``, ``uint16``, ``int16`` and ``float32`` are neither copied nor changed, even if their
/// elements are not contiguous; the array is kept alive. ``bool`` counts as ``uint8``. Other integer and
/// float types are converted once (``int8`` to ``int16``, the others to ``float32``). An array is copied once
/// if it has negative strides, unaligned data or another byte order than the machine. The array must not be
/// written to while a call reads it.
///
/// Parameters
/// ----------
/// array : array_like, 3-D
///     Voxels, indexed by `axes`.
/// spacing : (float, float, float), optional
///     Distances between neighboring voxels along x, y and z, in any unit of length; positive. Default 1, 1,
///     1.
/// origin : (float, float, float), optional
///     World position of the first voxel's center, in the same unit. Default 0, 0, 0.
/// axes : {"zyx", "xyz"}, optional
///     Order of the array's axes: ``array[z, y, x]`` (the default; x fastest in C order) or
///     ``array[x, y, z]``.
/// range : (float, float), optional
///     Scalar values at the two ends of the transfer function. Default: 0 to 255 for ``uint8``, else the
///     smallest and the largest finite voxel that is not a fill value.
/// fill : "auto", None, float or sequence of float, optional
///     Values of voxels without data. Such voxels, those that a masked array hides, and NaN count as the low
///     end of the range (in ``uint8`` and ``uint16`` arrays as 0, if that end is negative). A warning names
///     detected fill values, or says how many voxels are hidden by a mask or a given fill value. If no range
///     is given, "auto" (the default) warns of voxels that are not finite, and detects fill values: the
///     smallest or the largest value is a fill value if at least 0.1 % of the voxels have it and it is far
///     from all other values. With None, every value is data.
///
/// Masked arrays, arrays with a given fill value, and arrays with a detected fill value above all other values
/// are copied.
///
/// Raises
/// ------
/// TypeError
///     For an array that does not hold numbers.
/// ValueError
///     For an array that is empty or does not have three axes, a spacing that is not positive, a range that
///     is not finite or not ascending.
///
/// Examples
/// --------
/// >>> import numpy as np, entire
/// >>> volume = entire.Volume(np.zeros((32, 64, 64), np.uint16), (0.5, 0.5, 1.0))
/// >>> volume.shape, volume.copied
/// ((64, 64, 32), False)
#[pyclass(frozen, module = "entire")]
pub(crate) struct Volume(pub(crate) Arc<Data>);

static ASARRAY: PyOnceLock<Py<PyAny>> = PyOnceLock::new();

pub(crate) fn asarray<'py>(array: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let asarray = ASARRAY.import(array.py(), "numpy", "asarray")?;
    calling(array.py(), || asarray.call1((array,)))
}

pub(crate) fn astype<'py>(array: &Bound<'py, PyAny>, dtype: &str) -> PyResult<Bound<'py, PyAny>> {
    calling(array.py(), || array.call_method1("astype", (dtype,)))
}

fn convert<'py>(array: &Bound<'py, PyAny>, dtype: &str) -> PyResult<Bound<'py, PyUntypedArray>> {
    let py = array.py();
    let options = PyDict::new(py);
    options.set_item("order", "C")?;
    let numpy = py.import("numpy")?;
    let quiet = PyDict::new(py);
    // Values beyond those of float32 become infinities, which count as the ends of the volume's range.
    quiet.set_item("over", "ignore")?;
    let made = calling(py, || {
        let state = numpy.call_method("errstate", (), Some(&quiet))?;
        state.call_method0("__enter__")?;
        let made = array.call_method("astype", (dtype,), Some(&options));
        state.call_method1("__exit__", (py.None(), py.None(), py.None()))?;
        made
    });
    Ok(made?.cast_into::<PyUntypedArray>()?)
}

/// Scalar type in which an array is kept, and the dtype to convert it to; `None` if it is used as it is.
fn kept_as(array: &Bound<'_, PyUntypedArray>) -> PyResult<(ScalarType, Option<&'static str>)> {
    let dtype = array.dtype();
    let native = dtype.is_native_byteorder() != Some(false);
    let as_is = |kind, name: &'static str| Ok((kind, if native { None } else { Some(name) }));
    match (dtype.kind(), dtype.itemsize()) {
        (b'b' | b'u', 1) => as_is(ScalarType::U8, "uint8"),
        (b'u', 2) => as_is(ScalarType::U16, "uint16"),
        (b'i', 2) => as_is(ScalarType::I16, "int16"),
        (b'f', 4) => as_is(ScalarType::F32, "float32"),
        (b'i', 1) => Ok((ScalarType::I16, Some("int16"))),
        (b'u' | b'i' | b'f', _) => Ok((ScalarType::F32, Some("float32"))),
        _ => Err(PyTypeError::new_err(format!(
            "the array's dtype is {dtype}; integers, floats and bool can be drawn (pass one component, or \
             the magnitude)"
        ))),
    }
}

/// Fill values, as Python gives them.
pub(crate) enum Fill {
    /// Fill values are detected.
    Auto,
    /// Given fill values; empty for Python's `None`.
    Values(Vec<f32>),
    /// The fill values of an earlier time step.
    Known(Vec<f32>),
}

impl<'py> FromPyObject<'_, 'py> for Fill {
    type Error = PyErr;

    fn extract(given: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        if given.is_none() {
            return Ok(Self::Values(Vec::new()));
        }
        if let Ok(word) = given.extract::<String>() {
            return match word.as_str() {
                "auto" => Ok(Self::Auto),
                other => Err(PyValueError::new_err(format!(
                    "fill is {other:?}; it must be \"auto\", None, a number or numbers"
                ))),
            };
        }
        match given.extract::<f32>() {
            Ok(value) => Ok(Self::Values(vec![value])),
            Err(_) => Ok(Self::Values(given.extract()?)),
        }
    }
}

/// The mask of a masked array, as an array of bool.
fn mask_of<'py>(array: &Bound<'py, PyAny>) -> PyResult<Option<Bound<'py, PyAny>>> {
    let ma = array.py().import("numpy.ma")?;
    if !array.is_instance(&ma.getattr("MaskedArray")?)? {
        return Ok(None);
    }
    calling(array.py(), || ma.call_method1("getmaskarray", (array,))).map(Some)
}

/// Gives hidden voxels the low end of the range: those under a mask, and those with a value of `values`.
/// Returns the number of hidden voxels. `voxels`: array of a type in which volumes are kept; changed in
/// place. `low` is the low end of a given range; without `low`, the low end is 0 for bytes, and for other
/// types the minimum of all other finite voxels.
fn hide(
    voxels: &Bound<'_, PyAny>,
    mask: Option<&Bound<'_, PyAny>>,
    values: &[f32],
    low: Option<f32>,
) -> PyResult<usize> {
    let py = voxels.py();
    let numpy = py.import("numpy")?;
    calling(py, || {
        // Values are rounded to 32-bit floats before they are compared, as the readers of volume files do.
        let narrow = convert(voxels, "float32")?.into_any();
        let mut hidden = numpy.call_method1("isin", (&narrow, values.to_vec()))?;
        if let Some(mask) = mask {
            hidden = numpy.call_method1("logical_or", (hidden, mask))?;
        }
        let count: usize = numpy.call_method1("count_nonzero", (&hidden,))?.extract()?;
        if count == 0 {
            return Ok(0);
        }
        let seen = numpy.call_method1("logical_not", (&hidden,))?;
        let seen = numpy.call_method1("logical_and", (seen, numpy.call_method1("isfinite", (&narrow,))?))?;
        let others = voxels.get_item(&seen)?;
        if low.is_none() && others.len()? == 0 {
            return Err(PyValueError::new_err(
                "every voxel is hidden by a mask or a fill value; nothing is left to draw",
            ));
        }
        let dtype = voxels.getattr("dtype")?;
        let kind: String = dtype.getattr("kind")?.extract()?;
        let byte = kind == "u" && dtype.getattr("itemsize")?.extract::<usize>()? == 1;
        match low.or(byte.then_some(0.0)) {
            Some(low) if kind == "i" || kind == "u" => {
                let limits = numpy.call_method1("iinfo", (dtype,))?;
                let (least, most) = (limits.getattr("min")?, limits.getattr("max")?);
                voxels.set_item(&hidden, numpy.call_method1("clip", (low.floor(), least, most))?)?;
            }
            Some(low) => voxels.set_item(&hidden, low)?,
            None => voxels.set_item(&hidden, others.call_method0("min")?)?,
        }
        Ok(count)
    })
}

/// Issues a Python `UserWarning`, which Python shows once for each line that causes it.
fn warn(py: Python<'_>, text: &str) -> PyResult<()> {
    let text = std::ffi::CString::new(text)?;
    PyErr::warn(py, &py.get_type::<pyo3::exceptions::PyUserWarning>(), &text, 1)
}

/// Returns `count` elements from `at` on: the memory from the first to the last element of a strided array.
///
/// # Safety
/// `at` points at the first element of an array of `T` whose memory exists as long as the result is used, and
/// `count` elements can be read from there.
unsafe fn elements<T>(at: *const u8, count: usize) -> &'static [T] {
    // SAFETY: the caller guarantees that `count` elements are readable from `at` on, as long as the result is
    // used.
    unsafe { std::slice::from_raw_parts(at.cast(), count) }
}

impl Volume {
    /// Makes the voxels of a volume from an array, in place if possible.
    fn look_at(
        py: Python<'_>,
        array: &Bound<'_, PyAny>,
        spacing: [f32; 3],
        origin: [f64; 3],
        order: [usize; 3],
        range: Option<(f32, f32)>,
        fill: &Fill,
    ) -> PyResult<Data> {
        let mask = mask_of(array)?;
        let given = asarray(array)?;
        let mut kept = given.cast::<PyUntypedArray>()?.clone();
        if kept.ndim() != 3 {
            return Err(PyValueError::new_err(format!(
                "the array has {} axes (shape {:?}); a volume has three. Choose a time step or a component \
                 first",
                kept.ndim(),
                kept.shape()
            )));
        }
        let (kind, converted) = kept_as(&kept)?;
        let (name, size) = match kind {
            ScalarType::U8 => ("uint8", 1),
            ScalarType::U16 => ("uint16", 2),
            ScalarType::I16 => ("int16", 2),
            _ => ("float32", 4),
        };
        let (kept_fill, asked) = match fill {
            Fill::Values(values) | Fill::Known(values) => (values.clone(), !values.is_empty()),
            Fill::Auto => (Vec::new(), false),
        };
        if mask.is_some() || asked {
            // Converted first, since the low end of the range may lie beyond the array's own type.
            let voxels = convert(kept.as_any(), name)?.into_any();
            let count = hide(&voxels, mask.as_ref(), &kept_fill, range.map(|(low, _)| low))?;
            if count > 0 && !matches!(fill, Fill::Known(_)) {
                warn(
                    py,
                    &format!(
                        "{count} voxels are hidden by a mask or a fill value; they count as the low end \
                         of the range"
                    ),
                )?;
            }
            // If the caller declares fill values, all other values are data.
            let others = if matches!(fill, Fill::Auto) { Fill::Auto } else { Fill::Values(Vec::new()) };
            let mut data = Self::look_at(py, &voxels, spacing, origin, order, range, &others)?;
            data.copied = true;
            if !matches!(fill, Fill::Auto) {
                data.fill = kept_fill;
            }
            return Ok(data);
        }
        let mut copied = false;
        let plain = |a: &Bound<'_, PyUntypedArray>| {
            let whole = a.strides().iter().all(|&s| s >= 0 && (s as usize).is_multiple_of(size));
            // SAFETY: the array is alive. Its data pointer is only compared, never dereferenced.
            whole && (unsafe { (*a.as_array_ptr()).fields.data } as usize).is_multiple_of(size)
        };
        if converted.is_some() || !plain(&kept) {
            kept = convert(kept.as_any(), name)?;
            copied = true;
        }
        let dims: [usize; 3] = std::array::from_fn(|a| kept.shape()[order[a]]);
        let strides: [usize; 3] = std::array::from_fn(|a| kept.strides()[order[a]] as usize / size);
        let count =
            if dims.contains(&0) { 0 } else { 1 + (0..3).map(|a| (dims[a] - 1) * strides[a]).sum::<usize>() };
        // SAFETY: the array is alive; NumPy's data pointer is aligned (checked above), and the last of the
        // `count` elements from it on is the array's last element. `owner` keeps the memory alive as long as
        // the view.
        let scalars = unsafe {
            let at = (*kept.as_array_ptr()).fields.data.cast::<u8>().cast_const();
            match kind {
                ScalarType::U8 => Scalars::U8(elements(at, count)),
                ScalarType::U16 => Scalars::U16(elements(at, count)),
                ScalarType::I16 => Scalars::I16(elements(at, count)),
                _ => Scalars::F32(elements(at, count)),
            }
        };
        let options = VolumeOptions { strides: Some(strides), spacing, range };
        let view = detached(py, || VolumeView::with(scalars, dims, options)).map_err(raise)?;
        let (found, broken) = match (range, fill) {
            (None, Fill::Auto) => detached(py, || (view.fill_values(), view.non_finite())),
            _ => (Vec::new(), 0),
        };
        if broken > 0 {
            warn(
                py,
                &format!(
                    "{broken} of {} voxels are NaN or infinite; NaN counts as the low end of the range, \
                     infinities as its ends",
                    view.shape().voxels
                ),
            )?;
        }
        if !found.is_empty() {
            let (low, high) = view.range();
            let list = found.iter().map(f32::to_string).collect::<Vec<_>>().join(", ");
            warn(
                py,
                &format!(
                    "{list}: taken as a fill value, far from all other values ({low} to {high}). Voxels \
                     with this value count as the low end of the range. Pass fill=None if it is data"
                ),
            )?;
            // Fill values below the range need no copy, since they are clamped to its low end.
            if found.iter().any(|f| *f > high) {
                let voxels = convert(kept.as_any(), name)?.into_any();
                hide(&voxels, None, &found, Some(low))?;
                let none = Fill::Values(Vec::new());
                let mut data = Self::look_at(py, &voxels, spacing, origin, order, Some((low, high)), &none)?;
                (data.copied, data.fill) = (true, found);
                return Ok(data);
            }
        }
        // With `fill=None`, every value is data: the range contains all values, however far apart they are.
        let view = match (range, fill) {
            (None, Fill::Values(_)) if !matches!(scalars, Scalars::U8(_)) => {
                let options = VolumeOptions { range: Some(detached(py, || view.own_range())), ..options };
                VolumeView::with(scalars, dims, options).map_err(raise)?
            }
            _ => view,
        };
        let owner = kept.into_any().unbind();
        let series = Arc::new(Guarded::new(Series::default()));
        Ok(Data {
            view,
            origin,
            summary: OnceLock::new(),
            copied,
            fill: Vec::new(),
            order,
            series,
            step: 0,
            owner,
        })
    }
}

#[pymethods]
impl Volume {
    #[new]
    #[pyo3(signature = (array, spacing = [1.0, 1.0, 1.0], *, origin = [0.0, 0.0, 0.0], axes = "zyx",
        range = None, fill = Fill::Auto))]
    fn new(
        py: Python<'_>,
        array: &Bound<'_, PyAny>,
        spacing: [f32; 3],
        origin: [f64; 3],
        axes: &str,
        range: Option<[f32; 2]>,
        fill: Fill,
    ) -> PyResult<Self> {
        let order = match axes {
            "zyx" => [2, 1, 0],
            "xyz" => [0, 1, 2],
            other => {
                return Err(PyValueError::new_err(format!(
                    "axes is {other:?}; it must be \"zyx\" for array[z, y, x] or \"xyz\" for array[x, y, z]"
                )));
            }
        };
        if origin.iter().any(|v| !v.is_finite()) {
            return Err(PyValueError::new_err(format!("origin is {origin:?}; all three must be finite")));
        }
        let range = range.map(Into::into);
        Self::look_at(py, array, spacing, origin, order, range, &fill).map(|data| Self(Arc::new(data)))
    }

    /// Returns the next time step of this volume: another array of the same shape and type, or the same array
    /// with new values. Spacing, origin, axes and range stay the same. The first call scans the whole volume.
    /// Later calls find the changes in one pass over the voxels, which is much faster than such a scan, and
    /// scan only changed cells again. :meth:`Session.set_volume` with the result keeps the learned state of
    /// the scene.
    ///
    /// Parameters
    /// ----------
    /// array : array_like, 3-D
    ///     Voxels of the next time step.
    /// changed : ((int, int), (int, int), (int, int)), optional
    ///     The box that changed, if known: first index and end along each axis of the array. Nothing outside
    ///     of the box is read. Ignored unless this is the latest time step of its volume.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For an array of another shape or type, or a box that reaches beyond the array.
    ///
    /// Examples
    /// --------
    /// >>> import numpy as np, entire
    /// >>> array = np.zeros((32, 64, 64), np.uint8)
    /// >>> volume = entire.Volume(array)
    /// >>> array[4:9] = 200
    /// >>> volume = volume.next(array)
    /// >>> array[0, 0, 7] = 1
    /// >>> volume = volume.next(array, ((0, 1), (0, 1), (7, 8)))
    #[pyo3(signature = (array, changed = None))]
    fn next(
        &self,
        py: Python<'_>,
        array: &Bound<'_, PyAny>,
        changed: Option<[[i64; 2]; 3]>,
    ) -> PyResult<Self> {
        let changed = changed.map(|axes| axes.map(<(i64, i64)>::from));
        if let Some(axes) = changed
            && axes.iter().any(|&(first, end)| first.min(end) < 0)
        {
            return Err(PyValueError::new_err(format!(
                "changed is {axes:?}; first index and end along each axis must not be negative"
            )));
        }
        let before = &*self.0;
        let range = Some(before.view.range());
        let fill = Fill::Known(before.fill.clone());
        let spacing = before.spacing().to_array();
        let mut data = Self::look_at(py, array, spacing, before.origin, before.order, range, &fill)?;
        data.series = before.series.clone();
        let mut series = before.series.lock(py)?;
        // The box describes changes since this time step, but the series compares with the latest one.
        let changed = changed.filter(|_| before.step == series.step || series.kept.is_none());
        let changed =
            changed.map(|axes| before.order.map(|axis| axes[axis].0 as usize..axes[axis].1 as usize));
        let mut kept = match series.kept.take() {
            Some(kept) => kept,
            None => Box::new(SummarySeries::new(&before.view).map_err(raise)?),
        };
        let summary = detached(py, || {
            let summary = kept.update(&data.view, changed, Executor::Serial)?;
            summary.try_clone()
        });
        series.kept = Some(kept);
        data.summary = OnceLock::from(summary.map_err(raise)?);
        series.step += 1;
        data.step = series.step;
        drop(series);
        Ok(Self(Arc::new(data)))
    }

    /// tuple of int : Voxels along x, y and z.
    #[getter]
    fn shape(&self) -> (usize, usize, usize) {
        self.0.view.shape().dims.into()
    }

    /// tuple of float : Distances between voxels along x, y and z.
    #[getter]
    fn spacing(&self) -> (f32, f32, f32) {
        self.0.spacing().into()
    }

    /// tuple of float : World position of the middle of the voxels.
    #[getter]
    fn center(&self) -> (f64, f64, f64) {
        self.0.center().into()
    }

    /// float : Radius of the sphere around the volume's box, in the unit of the spacing.
    #[getter]
    fn radius(&self) -> f32 {
        self.0.radius()
    }

    /// tuple of float : Scalar values at the two ends of the transfer function.
    #[getter]
    fn range(&self) -> (f32, f32) {
        self.0.view.range()
    }

    /// float : The reference step, in the unit of the spacing: the smallest voxel spacing. Plans give ray steps
    /// in units of this length.
    #[getter]
    fn reference_step(&self) -> f32 {
        self.0.spacing().min_element()
    }

    /// bool : True if the array was copied or converted; later changes of the array then have no effect.
    #[getter]
    fn copied(&self) -> bool {
        self.0.copied
    }

    /// numpy.ndarray : The array in use: the given one, or its copy.
    #[getter]
    fn array(&self, py: Python<'_>) -> Py<PyAny> {
        self.0.owner.clone_ref(py)
    }

    fn __repr__(&self) -> String {
        let ([x, y, z], s) = (self.0.view.shape().dims, self.0.spacing());
        let (low, high) = self.0.view.range();
        let kind = self.0.view.scalars().scalar_type().to_string();
        format!("Volume({x} x {y} x {z} {kind}, spacing ({}, {}, {}), range {low} to {high})", s.x, s.y, s.z)
    }
}
