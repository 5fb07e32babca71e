//! Eye and view direction, and their change by the user.

use anyhow::Result;
use entire_core::scene::{Arcball, Camera, DEFAULT_FOV_Y_DEGREES};
use glam::{Mat3, Mat4, Vec3};

/// Nearest and farthest distance from the target point, bounding-sphere radii.
pub(crate) const DISTANCES: std::ops::RangeInclusive<f32> = 0.02..=200.0;

/// Distance of an orthographic view's eye from the target point, bounding-sphere radii. The length of the pan
/// is added, so that the volume lies in front of the eye. The picture does not depend on this distance.
const ORTHOGRAPHIC_DISTANCE: f32 = 2.0;

/// Position and size of a part of a volume, in the scene space of the whole volume.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Placement {
    pub(crate) center: Vec3,
    /// Bounding-sphere radius of the part, divided by the radius of the whole volume.
    pub(crate) radius: f32,
}

impl Placement {
    pub(crate) const WHOLE: Self = Self { center: Vec3::ZERO, radius: 1.0 };
}

/// The eye, in the scene space of the whole volume: angles and distance about a target point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Viewpoint {
    /// Angles as in [`Arcball`], degrees.
    pub(crate) rx: f32,
    pub(crate) ry: f32,
    /// Distance from the target point, bounding-sphere radii. In an orthographic view, it is the distance
    /// from which a perspective view would show the same height at the target point.
    pub(crate) distance: f32,
    /// The target point.
    pub(crate) target: Vec3,
    /// Vertical field of view, degrees.
    pub(crate) fov_y: f32,
    /// True if rays are parallel.
    pub(crate) orthographic: bool,
}

impl Default for Viewpoint {
    fn default() -> Self {
        Self {
            rx: 20.0,
            ry: 30.0,
            distance: 2.6,
            target: Vec3::ZERO,
            fov_y: DEFAULT_FOV_Y_DEGREES,
            orthographic: false,
        }
    }
}

/// A view along an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Axis {
    Front,
    Right,
    Top,
    Back,
    Left,
    Bottom,
}

entire_core::names! { Axis:
    Front "front",
    Right "right",
    Top "top",
    Back "back",
    Left "left",
    Bottom "bottom",
}

impl Viewpoint {
    fn rotation(&self) -> Mat4 {
        let radians = |degrees: f32| (degrees % 360.0).to_radians();
        Mat4::from_rotation_x(radians(self.rx)) * Mat4::from_rotation_y(-radians(self.ry))
    }

    /// Unit vectors of the eye in scene space: right, up and backward.
    fn axes(&self) -> [Vec3; 3] {
        let r = Mat3::from_mat4(self.rotation()).transpose();
        [r.x_axis, r.y_axis, r.z_axis]
    }

    pub(crate) fn eye(&self) -> Vec3 {
        self.target + self.distance * self.axes()[2]
    }

    /// Half of the visible height at the target point, bounding-sphere radii.
    fn half_height(&self) -> f32 {
        self.distance * (0.5 * self.fov_y.to_radians()).tan()
    }

    /// Half of the visible height of an orthographic view, bounding-sphere radii; `None` for a perspective
    /// view.
    pub(crate) fn parallel_scale(&self) -> Option<f32> {
        self.orthographic.then(|| self.half_height())
    }

    /// Sets half of the visible height at the target point, bounding-sphere radii.
    pub(crate) fn set_parallel_scale(&mut self, scale: f32) {
        self.zoom(scale / self.half_height());
    }

    /// Resets the view to the default; field of view and projection stay.
    pub(crate) fn reset(&mut self) {
        *self = Self { fov_y: self.fov_y, orthographic: self.orthographic, ..Self::default() };
    }

    /// Returns the camera that shows a part of the volume in this view.
    pub(crate) fn camera(&self, placement: Placement) -> Result<Camera> {
        let camera = if self.target == Vec3::ZERO && placement == Placement::WHOLE {
            Camera::from_arcball(self.arcball())?
        } else {
            let distance =
                if self.orthographic { ORTHOGRAPHIC_DISTANCE + self.target.length() } else { self.distance };
            let back = Mat4::from_translation(Vec3::new(0.0, 0.0, -distance));
            let view = back * self.rotation() * Mat4::from_translation(-self.target);
            Camera::from_world_view(view, placement.center, placement.radius)?
        };
        Ok(match self.parallel_scale() {
            Some(scale) => camera.with_parallel_scale(scale / placement.radius)?,
            None => camera.with_fov_y_degrees(self.fov_y)?,
        })
    }

    /// The view as a pose about the volume's center. For a panned view, the pose has the position of the eye,
    /// but looks at the center. For an orthographic view, it has the view direction and a fixed distance.
    pub(crate) fn arcball(&self) -> Arcball {
        if self.orthographic {
            return Arcball { rx: self.rx, ry: self.ry, dz: ORTHOGRAPHIC_DISTANCE };
        }
        if self.target == Vec3::ZERO {
            return Arcball { rx: self.rx, ry: self.ry, dz: self.distance };
        }
        let eye = self.eye();
        let dz = eye.length().max(1e-3);
        Arcball {
            rx: (eye.y / dz).clamp(-1.0, 1.0).asin().to_degrees(),
            ry: eye.x.atan2(eye.z).to_degrees(),
            dz,
        }
    }

    pub(crate) fn set_arcball(&mut self, pose: Arcball) {
        *self = Self { rx: pose.rx, ry: pose.ry, distance: pose.dz, target: Vec3::ZERO, ..*self };
    }

    /// Turns the eye about the target point, degrees.
    pub(crate) fn orbit(&mut self, right: f32, down: f32) {
        self.ry = (self.ry - right) % 360.0;
        self.rx = (self.rx + down).clamp(-90.0, 90.0);
    }

    /// Moves the picture right and down, in visible heights at the target point.
    pub(crate) fn pan(&mut self, right: f32, down: f32) {
        let height = 2.0 * self.half_height();
        let [x, y, _] = self.axes();
        self.shift(height * (down * y - right * x));
    }

    /// Moves the target point, at most to the bounds of a box; a point outside of the box moves no farther
    /// out.
    fn shift(&mut self, by: Vec3) {
        let most = self.target.abs().max(Vec3::splat(4.0));
        self.target = (self.target + by).clamp(-most, most);
    }

    /// Multiplies the distance, and with it the scale of an orthographic view, by `factor`.
    pub(crate) fn zoom(&mut self, factor: f32) {
        if factor.is_finite() && factor > 0.0 {
            self.distance = (self.distance * factor).clamp(*DISTANCES.start(), *DISTANCES.end());
        }
    }

    /// Turns the view direction at the eye, degrees.
    pub(crate) fn look(&mut self, right: f32, down: f32) {
        let eye = self.eye();
        self.orbit(right, down);
        self.target = eye - self.distance * self.axes()[2];
    }

    /// Moves the eye and the target point by distances in bounding-sphere radii. In an orthographic view,
    /// `forward` zooms instead.
    pub(crate) fn walk(&mut self, mut forward: f32, right: f32, up: f32) {
        if self.orthographic {
            self.zoom((-forward).exp());
            forward = 0.0;
        }
        let [x, y, z] = self.axes();
        self.shift(right * x + up * y - forward * z);
    }

    /// Looks along an axis at the volume's center, from the current distance.
    pub(crate) fn look_along(&mut self, axis: Axis) {
        (self.rx, self.ry) = match axis {
            Axis::Front => (0.0, 0.0),
            Axis::Right => (0.0, 90.0),
            Axis::Top => (90.0, 0.0),
            Axis::Back => (0.0, 180.0),
            Axis::Left => (0.0, -90.0),
            Axis::Bottom => (-90.0, 0.0),
        };
        self.target = Vec3::ZERO;
    }

    /// Changes the field of view and keeps the volume's size in the picture.
    pub(crate) fn set_fov(&mut self, degrees: f32) {
        let degrees = degrees.clamp(1.0, 120.0);
        self.distance =
            (self.distance * self.distance_factor(degrees)).clamp(*DISTANCES.start(), *DISTANCES.end());
        self.fov_y = degrees;
    }

    /// Returns the factor by which the distance must be multiplied so that the volume keeps its size in the
    /// image when the field of view becomes `fov_y` degrees.
    pub(crate) fn distance_factor(&self, fov_y: f32) -> f32 {
        let half = |degrees: f32| (0.5 * degrees.to_radians()).tan();
        half(self.fov_y) / half(fov_y)
    }

    /// Projects a point of the scene into the image: x to the right and y up, both in [−1, 1] within the
    /// image; `None` behind the eye. `aspect` is width over height.
    pub(crate) fn project(&self, point: Vec3, aspect: f32) -> Option<[f32; 2]> {
        let [x, y, z] = self.axes();
        if let Some(scale) = self.parallel_scale() {
            let across = point - self.target;
            return Some([across.dot(x) / (scale * aspect), across.dot(y) / scale]);
        }
        let from_eye = point - self.eye();
        let depth = -from_eye.dot(z);
        let half = (0.5 * self.fov_y.to_radians()).tan();
        (depth > 1e-3).then(|| [from_eye.dot(x) / (depth * half * aspect), from_eye.dot(y) / (depth * half)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: Mat4, b: Mat4) {
        assert!((a - b).to_cols_array().iter().all(|d| d.abs() < 1e-5), "{a} {b}");
    }

    #[test]
    fn an_unpanned_view_is_the_arcball_camera_to_the_bit() {
        let view = Viewpoint { rx: 25.0, ry: 130.0, distance: 2.5, ..Default::default() };
        let arcball = Camera::from_arcball(Arcball { rx: 25.0, ry: 130.0, dz: 2.5 }).unwrap();
        assert_eq!(view.camera(Placement::WHOLE).unwrap(), arcball);
        // The cameras of panned and centered views are computed by different formulas; the results agree up
        // to rounding.
        let panned = Viewpoint { target: Vec3::splat(1e-9), ..view };
        close(panned.camera(Placement::WHOLE).unwrap().view(), arcball.view());
    }

    #[test]
    fn looking_about_and_panning_do_what_they_say() {
        let mut view = Viewpoint::default();
        let eye = view.eye();
        view.look(12.0, -7.0);
        assert!((view.eye() - eye).length() < 1e-5, "only the view direction changes, not the eye");
        view.walk(0.5, 0.0, 0.0);
        assert!(((view.eye() - eye).length() - 0.5).abs() < 1e-5);
        let mut view = Viewpoint::default();
        view.pan(0.25, 0.0);
        let [x, y] = view.project(Vec3::ZERO, 1.0).unwrap();
        // A quarter of the height is 0.5 in image coordinates, which span a height of 2.
        assert!((x - 0.5).abs() < 1e-5 && y.abs() < 1e-5, "{x} {y}");
    }

    #[test]
    fn a_part_is_seen_where_it_lies_in_the_whole() {
        let view = Viewpoint { target: Vec3::new(0.1, -0.2, 0.05), ..Default::default() };
        let part = Placement { center: Vec3::new(0.3, 0.1, -0.2), radius: 0.4 };
        let (whole, cut) = (view.camera(Placement::WHOLE).unwrap(), view.camera(part).unwrap());
        for p in [Vec3::new(0.35, 0.0, -0.1), Vec3::new(0.2, 0.3, -0.4)] {
            let a = whole.view().transform_point3(p);
            let b = cut.view().transform_point3((p - part.center) / part.radius);
            assert!((a / a.z - b / b.z).length() < 1e-5, "{a} {b}");
        }
    }

    #[test]
    fn an_orthographic_view_shows_as_much_of_what_is_looked_at() {
        let mut view = Viewpoint { target: Vec3::new(0.1, -0.2, 0.05), ..Default::default() };
        let across = view.target + 0.4 * view.axes()[1];
        let before = view.project(across, 1.5).unwrap();
        view.orthographic = true;
        let after = view.project(across, 1.5).unwrap();
        assert!((before[1] - after[1]).abs() < 1e-5, "{before:?} {after:?}");
        // A point at another depth has the same height in the image.
        assert!((view.project(across + 0.7 * view.axes()[2], 1.5).unwrap()[1] - after[1]).abs() < 1e-5);
        let scale = view.parallel_scale().unwrap();
        view.zoom(0.5);
        assert!((view.parallel_scale().unwrap() - 0.5 * scale).abs() < 1e-6);
        view.walk(0.3, 0.0, 0.0);
        assert!(view.parallel_scale().unwrap() < 0.45 * scale, "going forward zooms");
        view.set_parallel_scale(0.8);
        assert!((view.parallel_scale().unwrap() - 0.8).abs() < 1e-6);
        view.reset();
        assert_eq!(view, Viewpoint { orthographic: true, ..Default::default() });
    }

    #[test]
    fn an_orthographic_camera_projects_as_the_view_does() {
        let view = Viewpoint { orthographic: true, target: Vec3::new(0.3, 0.1, -0.6), ..Default::default() };
        let part = Placement { center: Vec3::new(0.3, 0.1, -0.2), radius: 0.4 };
        for placement in [Placement::WHOLE, part] {
            let camera = view.camera(placement).unwrap();
            let (origin, direction) = camera.ray_basis(300, 200);
            // Checks that the ray through the projection of a point passes through the point.
            for point in [Vec3::new(0.35, 0.0, -0.1), Vec3::new(0.2, 0.3, -0.4)] {
                let [u, v] = view.project(point, 1.5).unwrap();
                let from = origin[0] + u * origin[1] + v * origin[2];
                let to = (point - placement.center) / placement.radius - from;
                let depth = to.dot(direction[0]);
                assert!((to - depth * direction[0]).length() < 1e-4 && depth > 0.0, "{to} {depth}");
            }
        }
    }

    #[test]
    fn views_along_axes_look_along_them() {
        let eyes = [[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0]];
        for (axis, eye) in Axis::ALL.into_iter().zip(eyes) {
            let mut view = Viewpoint::default();
            view.look_along(axis);
            let expected = Vec3::from_array(eye.map(|v| v as f32));
            assert!((view.axes()[2] - expected).length() < 1e-6, "{}", axis.name());
        }
    }

    #[test]
    fn a_longer_lens_keeps_the_size() {
        let mut view = Viewpoint::default();
        let before = view.project(Vec3::new(0.0, 0.5, 0.0), 1.0).unwrap();
        view.set_fov(1.0);
        let after = view.project(Vec3::new(0.0, 0.5, 0.0), 1.0).unwrap();
        assert!((before[1] / after[1] - 1.0).abs() < 0.3 && view.distance > 50.0);
    }
}
