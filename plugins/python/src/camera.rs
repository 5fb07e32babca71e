//! Cameras: positions from which a volume is seen.

use crate::errors::raise;
use crate::volume::Volume;
use entire_core::scene::{Arcball, Camera as CoreCamera, DEFAULT_FOV_Y_DEGREES};
use glam::{DMat3, DMat4, DVec3, Mat4, Vec3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// Camera of a view of a volume. Made by :meth:`arcball`, :meth:`look_at`, :meth:`view`, :meth:`scene` or
/// :meth:`projection`.
///
/// A camera stores lengths in radii of the volume's bounding sphere, and positions relative to its center. So
/// a camera that was made for one volume gives the same relative view of any other volume.
#[pyclass(frozen, from_py_object, module = "entire")]
#[derive(Clone, PartialEq)]
pub(crate) struct Camera {
    pub(crate) core: CoreCamera,
    lens: Lens,
}

/// Projection of a camera.
#[derive(Clone, Copy, PartialEq)]
enum Lens {
    /// Vertical field of view, degrees.
    Perspective(f32),
    /// Half of the visible height, bounding-sphere radii.
    Parallel(f32),
}

impl Lens {
    /// `scale` is half of the visible height of a parallel projection, in units in which the bounding-sphere
    /// radius is `radius`.
    fn new(fov: f32, scale: Option<f64>, radius: f32) -> Self {
        scale.map_or(Self::Perspective(fov), |scale| Self::Parallel((scale / f64::from(radius)) as f32))
    }
}

impl Camera {
    fn new(core: CoreCamera, lens: Lens) -> PyResult<Self> {
        let core = match lens {
            Lens::Perspective(fov) => core.with_fov_y_degrees(fov),
            Lens::Parallel(scale) => core.with_parallel_scale(scale),
        };
        Ok(Self { core: core.map_err(raise)?, lens })
    }
}

/// Maximum absolute cosine of the angle between two axes of a volume. Above it, the volume counts as sheared.
const SQUARE: f64 = 0.02;

fn matrix(rows: [[f64; 4]; 4]) -> DMat4 {
    DMat4::from_cols_array_2d(&rows).transpose()
}

/// Returns the camera of a world-to-eye matrix, given by its rows. `scale` is half of the visible height of a
/// parallel projection, in world units; with `None`, the projection is perspective.
pub(crate) fn from_view(
    volume: &Volume,
    rows: [[f64; 4]; 4],
    fov: f32,
    scale: Option<f64>,
) -> PyResult<Camera> {
    // Moves the origin to the volume's center in double precision: in single precision, coordinates far from
    // the origin would lose digits.
    let view = matrix(rows) * DMat4::from_translation(DVec3::from_array(volume.0.center()));
    let radius = volume.0.radius();
    Camera::new(
        CoreCamera::from_world_view(view.as_mat4(), Vec3::ZERO, radius).map_err(raise)?,
        Lens::new(fov, scale, radius),
    )
}

pub(crate) fn from_arcball(rx: f32, ry: f32, dz: f32, fov: f32, scale: Option<f64>) -> PyResult<Camera> {
    Camera::new(CoreCamera::from_arcball(Arcball { rx, ry, dz }).map_err(raise)?, Lens::new(fov, scale, 1.0))
}

/// True if the change from the camera `before` to `camera` is abrupt: see [`Camera::jumps_from`].
pub(crate) fn jumps(before: &CoreCamera, camera: &CoreCamera) -> bool {
    let (now, then) = (camera.view(), before.view());
    let turned = (now.row(2) - then.row(2)).abs();
    // Scales of parallel cameras; 0 for perspective cameras.
    let scales = [camera, before].map(|c| c.ray_basis(1, 1).0[2].length());
    let ratio = match scales {
        [0.0, 0.0] => now.w_axis.z / then.w_axis.z,
        [now, then] => now / then,
    };
    turned.x.max(turned.y).max(turned.z) > 0.5 || !(ratio > 0.67 && ratio < 1.5)
}

/// Placement of a volume in a scene that may move, turn and scale it.
pub(crate) struct Placement {
    to_world: DMat4,
    /// Its columns are the directions of the volume's axes before the placement.
    direction: DMat3,
    /// Middle of the volume's voxels before the placement.
    center: DVec3,
    radius: f32,
}

impl Placement {
    /// `to_world` and `direction` are matrices row by row; see [`Camera::scene`].
    pub(crate) fn new(volume: &Volume, to_world: &[f64; 16], direction: &[f64; 9], center: [f64; 3]) -> Self {
        Self {
            to_world: DMat4::from_cols_array(to_world).transpose(),
            direction: DMat3::from_cols_array(direction).transpose(),
            center: DVec3::from_array(center),
            radius: volume.0.radius(),
        }
    }

    /// The camera with this world-to-eye matrix (its rows); see [`Camera::scene`].
    pub(crate) fn camera(
        &self,
        to_eye: &[f64; 16],
        fov: f64,
        parallel_scale: Option<f64>,
    ) -> PyResult<Camera> {
        let to_eye = DMat4::from_cols_array(to_eye).transpose() * self.to_world;
        let axes = DMat3::from_mat4(to_eye) * self.direction;
        let scales = [axes.x_axis.length(), axes.y_axis.length(), axes.z_axis.length()];
        let scale = (scales[0] * scales[1] * scales[2]).cbrt();
        if !(scale > 0.0 && scale.is_finite()) {
            return Err(PyValueError::new_err("the volume's matrix is singular"));
        }
        let (x, y, z) = (axes.x_axis / scales[0], axes.y_axis / scales[1], axes.z_axis / scales[2]);
        if x.dot(y).abs() > SQUARE || y.dot(z).abs() > SQUARE || z.dot(x).abs() > SQUARE {
            return Err(PyValueError::new_err(
                "the volume's matrix shears the volume; use only rotations, translations and scales",
            ));
        }
        // Makes the axes a right-handed orthonormal basis, so that a mirrored volume gets the prediction of
        // the volume that is not mirrored.
        let z = x.cross(y).normalize();
        let y = z.cross(x).normalize();
        let eye = to_eye.transform_point3(self.center) / scale;
        let lens = Lens::new(fov as f32, parallel_scale.map(|p| p / scale), self.radius);
        let view = DMat4::from_cols(x.extend(0.0), y.extend(0.0), z.extend(0.0), eye.extend(1.0));
        let view: Mat4 = view.as_mat4();
        Camera::new(CoreCamera::from_world_view(view, Vec3::ZERO, self.radius).map_err(raise)?, lens)
    }
}

#[pymethods]
impl Camera {
    /// A camera on a sphere around the volume, looking at its center.
    ///
    /// Parameters
    /// ----------
    /// rx, ry : float
    ///     Elevation and azimuth in degrees; (0, 0) looks along -z.
    /// dz : float
    ///     Distance from the center in radii of the volume's bounding sphere, above 0.
    /// fov : float, optional
    ///     Vertical field of view in degrees, above 0 and at most 179. Default 45.
    /// parallel_scale : float, optional
    ///     Half of the height that a parallel (orthographic) projection shows, in radii of the volume's
    ///     bounding sphere; `fov` is not used with it.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For an angle that is not finite, a distance, a field of view or a scale out of range.
    #[staticmethod]
    #[pyo3(signature = (rx, ry, dz, fov = DEFAULT_FOV_Y_DEGREES, *, parallel_scale = None))]
    fn arcball(rx: f32, ry: f32, dz: f32, fov: f32, parallel_scale: Option<f64>) -> PyResult<Self> {
        from_arcball(rx, ry, dz, fov, parallel_scale)
    }

    /// A camera at a point of the world.
    ///
    /// Parameters
    /// ----------
    /// volume : Volume
    ///     The volume that is seen.
    /// eye : (float, float, float)
    ///     World position of the camera.
    /// target : (float, float, float), optional
    ///     World position that the camera looks at. Default: the volume's center.
    /// up : (float, float, float), optional
    ///     World direction that points up in the picture, not along the view. Default 0, 1, 0.
    /// fov : float, optional
    ///     Vertical field of view in degrees. Default 45.
    /// parallel_scale : float, optional
    ///     Half of the height that a parallel (orthographic) projection shows, in world units; `fov` is not
    ///     used with it.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     If eye and target are the same point, `up` points along the view, or a number is not finite.
    #[staticmethod]
    #[pyo3(signature = (volume, eye, target = None, up = [0.0, 1.0, 0.0], fov = DEFAULT_FOV_Y_DEGREES, *,
        parallel_scale = None))]
    fn look_at(
        volume: &Volume,
        eye: [f64; 3],
        target: Option<[f64; 3]>,
        up: [f64; 3],
        fov: f32,
        parallel_scale: Option<f64>,
    ) -> PyResult<Self> {
        let at = DVec3::from_array(eye);
        let target = target.map_or(DVec3::from_array(volume.0.center()), DVec3::from_array);
        let forward = (target - at).normalize_or_zero();
        let right = forward.cross(DVec3::from_array(up)).normalize_or_zero();
        if forward == DVec3::ZERO || right == DVec3::ZERO || !at.is_finite() {
            return Err(PyValueError::new_err(format!(
                "eye {eye:?}, target {:?} and up {up:?} give no view; eye and target must differ, up must \
                 not point along the view",
                target.to_array()
            )));
        }
        let row = |axis: DVec3| [axis.x, axis.y, axis.z, -axis.dot(at)];
        let rows = [row(right), row(right.cross(forward)), row(-forward), [0.0, 0.0, 0.0, 1.0]];
        from_view(volume, rows, fov, parallel_scale)
    }

    /// A camera from a world-to-eye matrix.
    ///
    /// Parameters
    /// ----------
    /// volume : Volume
    ///     The volume that is seen.
    /// matrix : array_like, shape (4, 4)
    ///     Maps homogeneous world coordinates (a column, ``matrix @ p``) to eye coordinates: x right, y up,
    ///     looking along -z. A rotation and a translation; no scale, no projection.
    /// fov : float, optional
    ///     Vertical field of view in degrees. Default 45.
    /// parallel_scale : float, optional
    ///     Half of the height that a parallel (orthographic) projection shows, in world units; `fov` is not
    ///     used with it.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For a matrix that is not a rotation and a translation.
    #[staticmethod]
    #[pyo3(signature = (volume, matrix, fov = DEFAULT_FOV_Y_DEGREES, *, parallel_scale = None))]
    fn view(volume: &Volume, matrix: [[f64; 4]; 4], fov: f32, parallel_scale: Option<f64>) -> PyResult<Self> {
        from_view(volume, matrix, fov, parallel_scale)
    }

    /// A camera of a scene whose volume may itself be moved, turned and scaled.
    ///
    /// Parameters
    /// ----------
    /// volume : Volume
    ///     The volume that is seen.
    /// to_eye : array_like, shape (16,)
    ///     Rows of the world-to-eye matrix.
    /// to_world : array_like, shape (16,)
    ///     Rows of the matrix that places the volume in the world.
    /// direction : array_like, shape (9,)
    ///     Rows of the matrix whose columns are the directions of the volume's axes before `to_world` is
    ///     applied.
    /// center : (float, float, float)
    ///     Middle of the volume's voxels before `to_world` is applied.
    /// fov : float
    ///     Vertical field of view in degrees; not used with `parallel_scale`.
    /// parallel_scale : float, optional
    ///     Half of the height that a parallel projection shows, in world units.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For a matrix that is singular or shears the volume.
    #[staticmethod]
    #[pyo3(signature = (volume, to_eye, to_world, direction, center, fov, parallel_scale = None))]
    fn scene(
        volume: &Volume,
        to_eye: [f64; 16],
        to_world: [f64; 16],
        direction: [f64; 9],
        center: [f64; 3],
        fov: f64,
        parallel_scale: Option<f64>,
    ) -> PyResult<Self> {
        Placement::new(volume, &to_world, &direction, center).camera(&to_eye, fov, parallel_scale)
    }

    /// A camera from the single matrix that maps the world to the picture, as in OpenGL, vispy and others.
    ///
    /// Parameters
    /// ----------
    /// volume : Volume
    ///     The volume that is seen.
    /// matrix : array_like, shape (4, 4)
    ///     Maps homogeneous world coordinates (a column, ``matrix @ p``) to clip coordinates: x and y in
    ///     [-w, w] are seen. The projection is perspective or parallel, with square pixels.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For a matrix without such a view, for example a singular one.
    #[staticmethod]
    fn projection(volume: &Volume, matrix: [[f64; 4]; 4]) -> PyResult<Self> {
        let row = |i: usize| DVec3::new(matrix[i][0], matrix[i][1], matrix[i][2]);
        let (x, y, z, w) = (row(0), row(1), row(2), row(3));
        let center = DVec3::from_array(volume.0.center());
        let parallel = w.length() <= 1e-12 * y.length();
        let (eye, forward, up, fov);
        let mut scale = None;
        if parallel {
            let back = x.cross(y).normalize_or_zero();
            let half = (matrix[3][3] / y.length()).abs();
            (fov, scale) = (f64::from(DEFAULT_FOV_Y_DEGREES), Some(half));
            // `at` is the vector from the volume's center to the point of the view axis at the center's
            // depth. The eye is put on the view axis in front of the volume.
            let at = (x / x.length_squared()) * (-matrix[0][3] - x.dot(center))
                + (y / y.length_squared()) * (-matrix[1][3] - y.dot(center));
            forward = if back.dot(z) > 0.0 { back } else { -back };
            up = y.normalize_or_zero();
            eye = center + at - forward * (2.0 * f64::from(volume.0.radius()));
        } else {
            let solve = DMat3::from_cols(x, y, w).transpose();
            let known = DVec3::new(-matrix[0][3], -matrix[1][3], -matrix[3][3]);
            eye = solve.inverse() * known;
            forward = w.normalize_or_zero();
            let across = (y - forward * y.dot(forward)) / w.length();
            up = across.normalize_or_zero();
            fov = 2.0 * (1.0 / across.length()).atan().to_degrees();
        }
        let right = forward.cross(up);
        if !eye.is_finite() || !(right.length() > 0.5) || !fov.is_finite() {
            return Err(PyValueError::new_err(
                "the matrix gives no view; it must map the world to clip coordinates by a perspective or \
                 parallel projection",
            ));
        }
        let row = |axis: DVec3| [axis.x, axis.y, axis.z, -axis.dot(eye)];
        let rows = [row(right), row(up), row(-forward), [0.0, 0.0, 0.0, 1.0]];
        from_view(volume, rows, fov as f32, scale)
    }

    /// Returns true if the change from `before` to this camera is abrupt: a component of the view direction
    /// changed by more than 0.5 (a turn of 29 to 51 degrees, depending on both directions), the distance (for
    /// parallel cameras, the scale) changed by a factor of 1.5 or more, or the projection changed between
    /// perspective and parallel.
    ///
    /// Parameters
    /// ----------
    /// before : Camera
    ///     The camera of the previous frame.
    ///
    /// Returns
    /// -------
    /// bool
    fn jumps_from(&self, before: &Self) -> bool {
        jumps(&before.core, &self.core)
    }

    /// tuple of float : Elevation and azimuth in degrees, and distance in radii, of the arcball pose with the
    /// same eye. For a parallel camera, the pose from which a perspective camera with the default field of
    /// view sees the same part of the volume.
    #[getter]
    fn pose(&self) -> (f32, f32, f32) {
        let Arcball { rx, ry, dz } = self.core.to_arcball();
        (rx, ry, dz)
    }

    /// float or None : Vertical field of view in degrees; none with a parallel projection.
    #[getter]
    fn fov(&self) -> Option<f32> {
        match self.lens {
            Lens::Perspective(fov) => Some(fov),
            Lens::Parallel(_) => None,
        }
    }

    /// float or None : Half of the visible height of a parallel projection, in radii; none with a perspective
    /// one.
    #[getter]
    fn parallel_scale(&self) -> Option<f32> {
        match self.lens {
            Lens::Perspective(_) => None,
            Lens::Parallel(scale) => Some(scale),
        }
    }

    fn __eq__(&self, other: &Self) -> bool {
        self == other
    }

    fn __repr__(&self) -> String {
        let (rx, ry, dz) = self.pose();
        match self.lens {
            Lens::Perspective(fov) => format!("Camera(rx {rx:.1}, ry {ry:.1}, dz {dz:.3}, fov {fov:.1})"),
            Lens::Parallel(scale) => format!("Camera(rx {rx:.1}, ry {ry:.1}, parallel_scale {scale:.3})"),
        }
    }
}
