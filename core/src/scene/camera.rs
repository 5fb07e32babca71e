//! The camera: arcball angles and distance, or any rigid view matrix, with a field of view or parallel rays.

use crate::Result;
use crate::error::bail;
use glam::{Mat3, Mat4, Vec3};

/// Default vertical field of view, in degrees.
pub const DEFAULT_FOV_Y_DEGREES: f32 = 45.0;

/// Arcball pose about the volume's center (paper, section "PredNet: Rendering Time Prediction").
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arcball {
    /// Rotation about the x axis, degrees. Positive raises the eye above the volume.
    pub rx: f32,
    /// Rotation about the y axis, degrees. Positive moves the eye to the volume's right (+x).
    pub ry: f32,
    /// Distance of the eye from the center, in multiples of the bounding-sphere radius.
    pub dz: f32,
}

/// Projection of a camera.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Lens {
    /// Perspective: rays leave the eye. `fov_y` is the vertical field of view in radians.
    Perspective { fov_y: f32 },
    /// Orthographic: rays leave the plane through the eye, all in the view direction. `scale` is half of the
    /// visible height, in bounding-sphere radii.
    Parallel { scale: f32 },
}

impl Lens {
    const DEFAULT: Self = Self::Perspective { fov_y: DEFAULT_FOV_Y_DEGREES.to_radians() };
}

/// A camera in scene space: origin at the volume's center, unit = bounding-sphere radius. It looks along −z
/// of its own space, y up. Its projection is perspective ([`Camera::with_fov_y_degrees`]) or parallel
/// ([`Camera::with_parallel_scale`]). Anything behind the eye, or behind the plane from which parallel rays
/// start, is invisible.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    view: Mat4,
    lens: Lens,
}

/// Scales that [`Camera::with_parallel_scale`] accepts, in bounding-sphere radii.
const PARALLEL_SCALES: core::ops::RangeInclusive<f32> = 1e-6..=1e6;

/// Largest distance between the volume's center and the plane from which parallel rays start, in
/// bounding-sphere radii. For a farther eye, the plane is moved to this distance. It is then still in front
/// of the whole volume, and positions on it lose no precision.
const PARALLEL_DISTANCE: f32 = 2.0;

impl Camera {
    /// Returns a camera on the arcball, with the default field of view. With both angles 0, the eye is at
    /// (0, 0, dz) and looks at the center.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for values that are not finite, or a distance that is not
    /// positive or over 1e6 bounding-sphere radii.
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
        Ok(Self { view, lens: Lens::DEFAULT })
    }

    /// A camera from a rigid world-to-eye matrix (the convention of OpenGL and VTK: column-major, looking
    /// along −z), the world position of the volume's center and the world radius of its bounding sphere.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] when the matrix is not finite or not rigid (a rotation and a
    /// translation, within 1e-3), when the center is not finite, when the radius is not finite and positive,
    /// or when the distance of the center from the eye, divided by the radius, is not finite.
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
        if !eye_of_center.is_finite() {
            bail!(
                InvalidArgument,
                "the volume's center is too far from the eye for a radius of {radius}: their quotient is not finite"
            );
        }
        let view = Mat4 { w_axis: eye_of_center.extend(1.0), ..Mat4::from_mat3(r) };
        Ok(Self { view, lens: Lens::DEFAULT })
    }

    /// Sets a perspective projection with a vertical field of view in degrees.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless `degrees` lies in (0, 179].
    pub fn with_fov_y_degrees(mut self, degrees: f32) -> Result<Self> {
        if !(degrees > 0.0 && degrees <= 179.0) {
            bail!(InvalidArgument, "vertical field of view is {degrees} degrees; it must lie in (0, 179]");
        }
        self.lens = Lens::Perspective { fov_y: degrees.to_radians() };
        Ok(self)
    }

    /// Sets a parallel (orthographic) projection. `scale` is half of the visible height in bounding-sphere
    /// radii: VTK's `ParallelScale` divided by the world radius. The picture does not depend on the distance
    /// of an eye that is in front of the volume.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless `scale` lies in 1e-6 … 1e6.
    pub fn with_parallel_scale(mut self, scale: f32) -> Result<Self> {
        if !PARALLEL_SCALES.contains(&scale) {
            bail!(
                InvalidArgument,
                "parallel scale is {scale} bounding-sphere radii; it must lie in {:e} to {:e}",
                PARALLEL_SCALES.start(),
                PARALLEL_SCALES.end()
            );
        }
        self.lens = Lens::Parallel { scale };
        Ok(self)
    }

    /// Scene-to-eye matrix (rigid).
    pub fn view(&self) -> Mat4 {
        self.view
    }

    /// Visible height at a depth, both in bounding-sphere radii.
    pub fn height_at(&self, depth: f32) -> f32 {
        match self.lens {
            Lens::Perspective { fov_y } => 2.0 * libm::tanf(0.5 * fov_y) * depth,
            Lens::Parallel { scale } => 2.0 * scale,
        }
    }

    /// Position of the eye in scene space.
    pub fn eye(&self) -> Vec3 {
        let r = Mat3::from_mat4(self.view);
        -(r.transpose() * self.view.w_axis.truncate())
    }

    /// The arcball pose for a model's `camera` group: angles in (−180, 180] from the eye's position about the
    /// center (pan and roll are ignored), and the eye's distance.
    ///
    /// For a parallel camera: the angles of its direction, and the distance at which the default field of
    /// view shows the same height, scale / tan([`DEFAULT_FOV_Y_DEGREES`] / 2).
    pub fn to_arcball(&self) -> Arcball {
        let (from, dz) = match self.lens {
            Lens::Perspective { .. } => {
                let eye = self.eye();
                (eye, eye.length())
            }
            Lens::Parallel { scale } => {
                let dz = scale / libm::tanf(0.5 * DEFAULT_FOV_Y_DEGREES.to_radians());
                (Mat3::from_mat4(self.view).row(2) * dz, dz)
            }
        };
        if dz.is_nan() || dz <= 1e-12 {
            return Arcball { rx: 0.0, ry: 0.0, dz: 0.0 };
        }
        let rx = libm::asinf((from.y / dz).clamp(-1.0, 1.0)).to_degrees();
        let ry = libm::atan2f(from.x, from.z).to_degrees();
        Arcball { rx, ry, dz }
    }

    /// The basis of primary rays, for renderers, as `(origin, direction)`. The ray at (u, v) of the image,
    /// both in [−1, 1], u to the right and v up, starts at `origin[0] + u·origin[1] + v·origin[2]` and has
    /// the direction `direction[0] + u·direction[1] + v·direction[2]` (not of unit length).
    ///
    /// `origin[0]` is the eye (for parallel rays at most 2 bounding-sphere radii in front of the center),
    /// `direction[0]` the unit vector forward. For a perspective projection, `direction[1]` and
    /// `direction[2]` are half of the visible width and height at distance 1, and `origin[1]` and `origin[2]`
    /// are 0. For a parallel projection, `origin[1]` and `origin[2]` are half of the visible width and
    /// height, and `direction[1]` and `direction[2]` are 0.
    pub fn ray_basis(&self, width: u32, height: u32) -> ([Vec3; 3], [Vec3; 3]) {
        let r = Mat3::from_mat4(self.view).transpose();
        let half_height = 0.5 * self.height_at(1.0);
        let half_width = half_height * width as f32 / height as f32;
        let (right, up, forward) = (r.x_axis * half_width, r.y_axis * half_height, -r.z_axis);
        match self.lens {
            Lens::Perspective { .. } => ([self.eye(), Vec3::ZERO, Vec3::ZERO], [forward, right, up]),
            Lens::Parallel { .. } => {
                let mut view = self.view;
                view.w_axis.z = view.w_axis.z.max(-PARALLEL_DISTANCE);
                ([Self { view, ..*self }.eye(), right, up], [forward, Vec3::ZERO, Vec3::ZERO])
            }
        }
    }
}

/// Degrees to radians, reduced modulo 360 first, so that 3600° is exactly 0°.
fn reduce_degrees(degrees: f32) -> f32 {
    (degrees % 360.0).to_radians()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arc(rx: f32, ry: f32, dz: f32) -> Camera {
        Camera::from_arcball(Arcball { rx, ry, dz }).unwrap()
    }

    /// Origin and unit direction of the ray through a position of an image of 64 × 32 pixels.
    fn ray(camera: &Camera, px: f32, py: f32) -> (Vec3, Vec3) {
        let (origin, direction) = camera.ray_basis(64, 32);
        let at = |basis: [Vec3; 3]| basis[0] + (px / 32.0 - 1.0) * basis[1] + (1.0 - py / 16.0) * basis[2];
        (at(origin), at(direction).normalize())
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
        let (origin, direction) = ray(&camera, 32.0, 16.0);
        assert!((origin + direction * 2.5).length() < 1e-4);
        let (_, corner) = ray(&camera, 0.0, 0.0);
        assert!((corner.length() - 1.0).abs() < 1e-5);
    }

    #[test]
    fn world_view_matches_arcball() {
        let camera = arc(20.0, -40.0, 3.0).with_fov_y_degrees(30.0).unwrap();
        let (center, radius) = (Vec3::new(5.0, -7.0, 11.0), 40.0);
        // The world-to-scene transform subtracts the center and divides by the radius. So eye-space positions
        // in world units are those in scene units times the radius.
        let r = Mat4::from_mat3(Mat3::from_mat4(camera.view()));
        let view = Mat4::from_translation(camera.view().w_axis.truncate() * radius)
            * r
            * Mat4::from_translation(-center);
        let back = Camera::from_world_view(view, center, radius).unwrap();
        assert!((back.eye() - camera.eye()).length() < 1e-4);
        assert!(Camera::from_world_view(view * 2.0, center, radius).is_err());
        assert!(Camera::from_world_view(Mat4::NAN, center, radius).is_err());
        let far = Mat4::from_translation(Vec3::new(0.0, 0.0, -1e30));
        assert!(Camera::from_world_view(far, Vec3::ZERO, 1e-30).is_err());
        assert!(Camera::from_world_view(view, center, 0.0).is_err());
    }

    #[test]
    fn parallel_rays_run_along_the_view_and_leave_its_plane() {
        for (rx, ry, dz) in [(0.0, 0.0, 1.5), (25.0, 130.0, 0.3), (-70.0, 10.0, 2e5)] {
            let camera = arc(rx, ry, dz).with_parallel_scale(0.8).unwrap();
            let (_, forward) = ray(&camera, 32.0, 16.0);
            for (x, y) in [(0.0, 0.0), (64.0, 32.0), (10.5, 30.5)] {
                let (origin, direction) = ray(&camera, x, y);
                assert_eq!(direction, forward);
                let eye = camera.view().transform_point3(origin);
                let (u, v) = (x / 32.0 - 1.0, 1.0 - y / 16.0);
                // The image is twice as wide as high. Rays start in the eye's plane, or 2 bounding-sphere
                // radii in front of the center if the eye is farther away.
                let depth = if dz > PARALLEL_DISTANCE { dz - PARALLEL_DISTANCE } else { 0.0 };
                assert!((eye.truncate() - glam::Vec2::new(1.6 * u, 0.8 * v)).length() < 1e-5 * dz.max(1.0));
                assert!((eye.z + depth).abs() < 1e-5 * dz.max(1.0), "{eye} {dz}");
            }
        }
    }

    #[test]
    fn a_parallel_camera_counts_as_the_default_lens_that_sees_as_much() {
        let half = (0.5 * DEFAULT_FOV_Y_DEGREES.to_radians()).tan();
        let lens = arc(25.0, 130.0, 2.5);
        let parallel = arc(25.0, 130.0, 7.0).with_parallel_scale(2.5 * half).unwrap();
        let (a, b) = (lens.to_arcball(), parallel.to_arcball());
        assert!((a.rx - b.rx).abs() < 1e-3 && (a.ry - b.ry).abs() < 1e-3 && (a.dz - b.dz).abs() < 1e-5);
        assert!((lens.height_at(2.5) - parallel.height_at(9.0)).abs() < 1e-5);
        // A translation in the image plane keeps the direction.
        let across = Mat4::from_translation(Vec3::new(0.3, -0.2, 0.0)) * parallel.view();
        let across =
            Camera::from_world_view(across, Vec3::ZERO, 1.0).unwrap().with_parallel_scale(1.0).unwrap();
        assert!((across.to_arcball().rx - b.rx).abs() < 1e-3);
        // Setting a field of view turns the parallel camera into a perspective camera.
        assert_eq!(parallel.with_fov_y_degrees(45.0).unwrap(), arc(25.0, 130.0, 7.0));
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
        for scale in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e-7, 2e6] {
            assert!(arc(0.0, 0.0, 1.0).with_parallel_scale(scale).is_err());
        }
    }
}
