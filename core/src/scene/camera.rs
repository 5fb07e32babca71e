//! The camera: arcball angles and distance, or any rigid view matrix, with a field of view.

use crate::Result;
use crate::error::bail;
use glam::{Mat3, Mat4, Vec3};

/// Vertical field of view used where none is given, in degrees.
pub const DEFAULT_FOV_Y_DEGREES: f32 = 45.0;

/// Arcball pose about the volume's center (paper, section "PredNet: Rendering Time Prediction").
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arcball {
    /// Rotation about the x axis, degrees. Positive raises the eye above the volume.
    pub rx: f32,
    /// Rotation about the y axis, degrees. Positive moves the eye to the volume's right (+x).
    pub ry: f32,
    /// Distance of the eye from the center along z, in multiples of the bounding-sphere radius.
    pub dz: f32,
}

/// A perspective camera in scene space: origin at the volume's center, unit = bounding-sphere radius. It
/// looks along −z of its own space, y up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    view: Mat4,
    fov_y: f32,
}

impl Camera {
    /// A camera on the arcball, with the default field of view. With all angles 0 the eye stands at (0, 0,
    /// dz) and looks at the center.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for values that are not finite, or a distance that is not
    /// positive.
    pub fn from_arcball(pose: Arcball) -> Result<Self> {
        let Arcball { rx, ry, dz } = pose;
        if !(rx.is_finite() && ry.is_finite()) {
            bail!(InvalidArgument, "camera angles are {rx}, {ry}; both must be finite degrees");
        }
        if !(dz.is_finite() && dz > 0.0 && dz <= 1e6) {
            bail!(
                InvalidArgument,
                "camera distance is {dz}; it must be finite, positive and at most 1e6 bounding-sphere radii"
            );
        }
        let rotation = Mat4::from_rotation_x(reduce_degrees(rx)) * Mat4::from_rotation_y(-reduce_degrees(ry));
        let view = Mat4::from_translation(Vec3::new(0.0, 0.0, -dz)) * rotation;
        Ok(Self { view, fov_y: DEFAULT_FOV_Y_DEGREES.to_radians() })
    }

    /// A camera from a rigid world-to-eye matrix (as OpenGL and VTK have it: column-major, looking along −z),
    /// the world position of the volume's center and the world radius of its bounding sphere.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] when the matrix is not finite, not rigid (rotation and
    /// translation only, to 1e-3), or the radius is not positive.
    pub fn from_world_view(view: Mat4, center: Vec3, radius: f32) -> Result<Self> {
        if !(radius.is_finite() && radius > 0.0) {
            bail!(InvalidArgument, "bounding-sphere radius is {radius}; it must be finite and positive");
        }
        if !(view.is_finite() && center.is_finite()) {
            bail!(InvalidArgument, "the view matrix or the volume's center holds a NaN or an infinity");
        }
        let r = Mat3::from_mat4(view);
        let gram = r.transpose() * r - Mat3::IDENTITY;
        let off = gram.to_cols_array().iter().fold(0.0f32, |m, v| m.max(v.abs()));
        let last_row = view.row(3);
        if off > 1e-3 || r.determinant() < 0.0 || (last_row - glam::Vec4::W).abs().max_element() > 1e-3 {
            bail!(
                InvalidArgument,
                "the view matrix is not a rotation and a translation; pass world-to-eye in column-major order, without scale or projection"
            );
        }
        let eye_of_center = view.transform_point3(center) / radius;
        let view = Mat4::from_cols(
            r.x_axis.extend(0.0),
            r.y_axis.extend(0.0),
            r.z_axis.extend(0.0),
            eye_of_center.extend(1.0),
        );
        Ok(Self { view, fov_y: DEFAULT_FOV_Y_DEGREES.to_radians() })
    }

    /// Sets the vertical field of view in degrees.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless it lies in (0, 179].
    pub fn with_fov_y_degrees(mut self, degrees: f32) -> Result<Self> {
        if !(degrees > 0.0 && degrees <= 179.0) {
            bail!(InvalidArgument, "vertical field of view is {degrees} degrees; it must lie in (0, 179]");
        }
        self.fov_y = degrees.to_radians();
        Ok(self)
    }

    /// Scene-to-eye matrix (rigid).
    pub fn view(&self) -> Mat4 {
        self.view
    }

    /// Vertical field of view in radians.
    pub(crate) fn fov_y(&self) -> f32 {
        self.fov_y
    }

    /// The eye in scene space.
    pub(crate) fn eye(&self) -> Vec3 {
        let r = Mat3::from_mat4(self.view);
        -(r.transpose() * self.view.w_axis.truncate())
    }

    /// The arcball pose that a model's `camera` group takes: angles from the eye's position about the center
    /// (pan and roll have no place in it), angles in (−180, 180], the distance as it is.
    pub fn to_arcball(&self) -> Arcball {
        let eye = self.eye();
        let dz = eye.length();
        if dz.is_nan() || dz <= 1e-12 {
            return Arcball { rx: 0.0, ry: 0.0, dz: 0.0 };
        }
        let rx = libm::asinf((eye.y / dz).clamp(-1.0, 1.0)).to_degrees();
        let ry = libm::atan2f(eye.x, eye.z).to_degrees();
        Arcball { rx, ry, dz }
    }

    /// The ray through the pixel position (`px`, `py`) of a `width` × `height` image, pixel centers at
    /// halves, y down: origin and unit direction in scene space.
    pub fn ray(&self, px: f32, py: f32, width: u32, height: u32) -> (Vec3, Vec3) {
        let (origin, right, up, forward) = self.ray_basis(width, height);
        let u = 2.0 * px / width as f32 - 1.0;
        let v = 1.0 - 2.0 * py / height as f32;
        (origin, (forward + u * right + v * up).normalize())
    }

    /// The basis that [`Camera::ray`] uses, for renderers: eye, then the image plane's half-width vector,
    /// half-height vector and forward unit vector. A ray's direction is `forward + u·right + v·up`, u and v
    /// in [−1, 1].
    pub fn ray_basis(&self, width: u32, height: u32) -> (Vec3, Vec3, Vec3, Vec3) {
        let r = Mat3::from_mat4(self.view).transpose();
        let half_height = libm::tanf(0.5 * self.fov_y);
        let half_width = half_height * width as f32 / height as f32;
        (self.eye(), r.x_axis * half_width, r.y_axis * half_height, -r.z_axis)
    }
}

/// Degrees to radians with whole turns removed first, so that 3600° is exactly 0°.
fn reduce_degrees(degrees: f32) -> f32 {
    (degrees % 360.0).to_radians()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arc(rx: f32, ry: f32, dz: f32) -> Camera {
        Camera::from_arcball(Arcball { rx, ry, dz }).unwrap()
    }

    #[test]
    fn eye_stands_where_the_angles_say() {
        let close = |a: Vec3, b: Vec3| assert!((a - b).length() < 1e-5, "{a} {b}");
        close(arc(0.0, 0.0, 3.0).eye(), Vec3::new(0.0, 0.0, 3.0));
        close(arc(0.0, 90.0, 2.0).eye(), Vec3::new(2.0, 0.0, 0.0));
        close(arc(90.0, 0.0, 2.0).eye(), Vec3::new(0.0, 2.0, 0.0));
        close(arc(0.0, 3600.0, 2.0).eye(), Vec3::new(0.0, 0.0, 2.0));
    }

    #[test]
    fn arcball_round_trips() {
        for rx in [-80.0, -10.0, 0.0, 45.0, 89.0] {
            for ry in [-170.0, -90.0, 0.0, 33.0, 179.0] {
                for dz in [0.3, 1.0, 4.0] {
                    let a = arc(rx, ry, dz).to_arcball();
                    assert!(
                        (a.rx - rx).abs() < 0.05 && (a.ry - ry).abs() < 0.05 && (a.dz - dz).abs() < 1e-4,
                        "{a:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn central_ray_looks_at_the_center() {
        let camera = arc(25.0, 130.0, 2.5);
        let (origin, direction) = camera.ray(32.0, 16.0, 64, 32);
        assert!((origin + direction * 2.5).length() < 1e-4);
        let (_, corner) = camera.ray(0.0, 0.0, 64, 32);
        assert!((corner.length() - 1.0).abs() < 1e-5);
    }

    #[test]
    fn world_view_matches_arcball() {
        let camera = arc(20.0, -40.0, 3.0).with_fov_y_degrees(30.0).unwrap();
        let (center, radius) = (Vec3::new(5.0, -7.0, 11.0), 40.0);
        // World to scene: subtract the center, divide by the radius; eye space in world units is scene eye
        // space x radius.
        let r = Mat4::from_mat3(Mat3::from_mat4(camera.view()));
        let view = Mat4::from_translation(camera.view().w_axis.truncate() * radius)
            * r
            * Mat4::from_translation(-center);
        let back = Camera::from_world_view(view, center, radius).unwrap();
        assert!((back.eye() - camera.eye()).length() < 1e-4);
        assert!(Camera::from_world_view(view * 2.0, center, radius).is_err());
        assert!(Camera::from_world_view(Mat4::NAN, center, radius).is_err());
        assert!(Camera::from_world_view(view, center, 0.0).is_err());
    }

    #[test]
    fn bad_poses_are_refused() {
        for (rx, ry, dz) in [
            (f32::NAN, 0.0, 1.0),
            (0.0, f32::INFINITY, 1.0),
            (0.0, 0.0, 0.0),
            (0.0, 0.0, -1.0),
            (0.0, 0.0, f32::NAN),
        ] {
            assert!(Camera::from_arcball(Arcball { rx, ry, dz }).is_err());
        }
        for fov in [0.0, -3.0, 180.0, f32::NAN] {
            assert!(arc(0.0, 0.0, 1.0).with_fov_y_degrees(fov).is_err());
        }
    }
}
