//! The part of the image that the volume's box covers, computed exactly.

use entire_core::scene::Camera;
use glam::Vec3;

/// Region of the image covered by a box, in image coordinates u, v in [−1, 1] (u to the right, v up). The
/// default is that of a box outside the image.
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Zeroable)]
pub(crate) struct Footprint {
    /// Share of the image's area that the box covers, 0…1.
    pub share: f32,
    /// Lower corner of the covered region's bounding rectangle.
    pub low: [f32; 2],
    /// Upper corner of the bounding rectangle.
    pub high: [f32; 2],
    /// Centroid of the covered region.
    pub center: [f32; 2],
    /// True if the eye is inside the box.
    pub inside: bool,
}

impl Footprint {
    /// Projects a box of half size `half_extent` about the origin into a `width` × `height` image.
    ///
    /// The back faces of the box are those through which rays leave it. For any position of the eye, they
    /// project one to one onto the covered region. Each projected face is clipped to the image, and the areas
    /// are summed. With parallel rays, the faces are also clipped to the half-space in front of the plane
    /// where the rays start. The region is not rounded to whole pixels.
    pub(crate) fn new(half_extent: Vec3, camera: &Camera, width: u32, height: u32) -> Self {
        let (origin, direction) = camera.ray_basis(width, height);
        let parallel = origin[1] != Vec3::ZERO;
        let (eye, forward) = (origin[0], direction[0]);
        let [_, right, up] = if parallel { origin } else { direction };
        let (inv_u, inv_v) = (1.0 / right.length_squared(), 1.0 / up.length_squared());
        let inside = eye.abs().cmple(half_extent).all();
        let mut out =
            Self { inside, low: [f32::INFINITY; 2], high: [f32::NEG_INFINITY; 2], ..Self::default() };
        let mut area = 0.0f32;
        let mut moment = [0.0f32; 2];
        for axis in 0..3 {
            for sign in [-1.0f32, 1.0] {
                let behind = if parallel {
                    sign * forward[axis] <= 0.0
                } else {
                    sign * eye[axis] >= half_extent[axis]
                };
                if behind {
                    continue;
                }
                let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
                let mut polygon = Polygon::default();
                for (sb, sc) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
                    let mut corner = [0.0; 3];
                    corner[axis] = sign * half_extent[axis];
                    corner[b] = sb * half_extent[b];
                    corner[c] = sc * half_extent[c];
                    let q = Vec3::from_array(corner) - eye;
                    polygon.push([q.dot(right) * inv_u, q.dot(up) * inv_v, q.dot(forward)]);
                }
                if parallel {
                    polygon = polygon.before_the_plane();
                }
                for plane in [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]] {
                    polygon = polygon.clip(plane);
                }
                polygon.measure(&mut area, &mut moment, &mut out.low, &mut out.high);
            }
        }
        // The image has area 4 in image coordinates.
        if !(area > 0.0) {
            return Self { inside, ..Self::default() };
        }
        out.share = (0.25 * area).min(1.0);
        out.center = [moment[0] / area, moment[1] / area];
        for k in 0..2 {
            out.low[k] = out.low[k].clamp(-1.0, 1.0);
            out.high[k] = out.high[k].clamp(out.low[k], 1.0);
            out.center[k] = out.center[k].clamp(out.low[k], out.high[k]);
        }
        out
    }
}

/// Largest number of corners of a polygon: a quadrilateral clipped by five planes.
const CORNERS: usize = 9;

/// A convex polygon in homogeneous image coordinates (x, y, w): the image is |x| ≤ w, |y| ≤ w.
#[derive(Clone, Copy)]
struct Polygon {
    corners: [[f32; 3]; CORNERS],
    len: usize,
}

impl Default for Polygon {
    fn default() -> Self {
        Self { corners: [[0.0; 3]; CORNERS], len: 0 }
    }
}

impl Polygon {
    fn push(&mut self, corner: [f32; 3]) {
        if self.len < self.corners.len() {
            self.corners[self.len] = corner;
            self.len += 1;
        }
    }

    /// Returns the part of the polygon with w + plane·(x, y) ≥ 0.
    fn clip(&self, plane: [f32; 2]) -> Self {
        let side = |c: &[f32; 3]| c[2] + plane[0] * c[0] + plane[1] * c[1];
        let mut out = Self::default();
        for i in 0..self.len {
            let (a, b) = (&self.corners[i], &self.corners[(i + 1) % self.len]);
            let (da, db) = (side(a), side(b));
            if da >= 0.0 {
                out.push(*a);
            }
            if (da >= 0.0) != (db >= 0.0) {
                let t = da / (da - db);
                out.push(core::array::from_fn(|k| a[k] + t * (b[k] - a[k])));
            }
        }
        out
    }

    /// Returns the part of the polygon that parallel rays can meet: the part with depth ≥ 0. The corners of
    /// `self` are (x, y, depth), the corners of the result are (x, y, 1).
    fn before_the_plane(&self) -> Self {
        let mut out = self.clip([0.0, 0.0]);
        for corner in &mut out.corners[..out.len] {
            corner[2] = 1.0;
        }
        out
    }

    fn measure(&self, area: &mut f32, moment: &mut [f32; 2], low: &mut [f32; 2], high: &mut [f32; 2]) {
        if self.len < 3 {
            return;
        }
        let mut points = [[0.0f32; 2]; CORNERS];
        for (p, c) in points.iter_mut().zip(&self.corners[..self.len]) {
            let inv = 1.0 / c[2].max(1.0e-20);
            *p = [(c[0] * inv).clamp(-1.0, 1.0), (c[1] * inv).clamp(-1.0, 1.0)];
            for k in 0..2 {
                low[k] = low[k].min(p[k]);
                high[k] = high[k].max(p[k]);
            }
        }
        // Sums triangles that share the first corner. The back faces of a box never overlap in the image, so
        // no area is counted twice.
        for pair in points[1..self.len].windows(2) {
            let (o, a, b) = (points[0], pair[0], pair[1]);
            let twice = (a[0] - o[0]) * (b[1] - o[1]) - (b[0] - o[0]) * (a[1] - o[1]);
            let part = 0.5 * twice.abs();
            *area += part;
            for k in 0..2 {
                moment[k] += part * (o[k] + a[k] + b[k]) / 3.0;
            }
        }
    }
}

/// Origin and unit direction, in scene space, of the ray through a pixel's center in an image of `size`
/// pixels.
#[cfg(test)]
pub(super) fn ray(camera: &Camera, pixel: [u32; 2], size: [u32; 2]) -> (Vec3, Vec3) {
    let (origin, direction) = camera.ray_basis(size[0], size[1]);
    let [u, v] = [0, 1].map(|k| 2.0 * (pixel[k] as f32 + 0.5) / size[k] as f32 - 1.0);
    let at = |basis: [Vec3; 3]| basis[0] + u * basis[1] - v * basis[2];
    (at(origin), at(direction).normalize())
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::scene::Arcball;

    fn camera(rx: f32, ry: f32, dz: f32) -> Camera {
        Camera::from_arcball(Arcball { rx, ry, dz }).unwrap()
    }

    /// True if a ray meets the box (slab method).
    fn hits(h: Vec3, o: Vec3, d: Vec3) -> bool {
        let (a, b) = ((-h - o) / d, (h - o) / d);
        let (near, far) = (a.min(b).max_element(), a.max(b).min_element());
        near.max(0.0) < far
    }

    #[test]
    fn share_is_the_share_of_rays_that_hit() {
        let boxes = [Vec3::splat(0.577), Vec3::new(0.9, 0.4, 0.15), Vec3::new(0.02, 0.7, 0.7)];
        for h in boxes {
            for (rx, ry, dz) in [
                (0.0, 0.0, 3.0),
                (30.0, 40.0, 1.4),
                (-70.0, 10.0, 0.9),
                (15.0, 200.0, 0.3),
                (10.0, 20.0, 8.0),
            ] {
                let lens = camera(rx, ry, dz);
                // Cases: the box is wholly visible, the image's border cuts it, or (from near, with parallel
                // rays) the plane where the rays start cuts it.
                let parallel = [0.4, 1.3].map(|scale| lens.with_parallel_scale(scale).unwrap());
                let sizes = [(200, 200), (300, 120), (90, 240)];
                for ((w, height), camera) in
                    sizes.into_iter().flat_map(|size| [lens, parallel[0], parallel[1]].map(|c| (size, c)))
                {
                    let f = Footprint::new(h, &camera, w, height);
                    let mut count = 0;
                    for y in 0..height {
                        for x in 0..w {
                            let (o, d) = ray(&camera, [x, y], [w, height]);
                            if hits(h, o, d) {
                                count += 1;
                                let u = 2.0 * (x as f32 + 0.5) / w as f32 - 1.0;
                                let v = 1.0 - 2.0 * (y as f32 + 0.5) / height as f32;
                                assert!(u >= f.low[0] - 1e-4 && u <= f.high[0] + 1e-4);
                                assert!(v >= f.low[1] - 1e-4 && v <= f.high[1] + 1e-4);
                            }
                        }
                    }
                    let share = count as f32 / (w * height) as f32;
                    let found = f.share;
                    assert!((share - found).abs() < 0.01, "{h} {camera:?} {w}x{height}: {share} {found}");
                }
            }
        }
    }

    #[test]
    fn inside_covers_everything_and_away_covers_nothing() {
        let h = Vec3::splat(0.577);
        let inside = Footprint::new(h, &camera(0.0, 0.0, 0.1), 64, 32);
        assert!(inside.inside && (inside.share - 1.0).abs() < 1e-4, "{inside:?}");
        // A rotation after the view matrix turns the camera by 180° about the eye, so that it looks away from
        // the volume.
        let back = Camera::from_world_view(
            glam::Mat4::from_rotation_y(core::f32::consts::PI) * camera(0.0, 0.0, 3.0).view(),
            Vec3::ZERO,
            1.0,
        );
        let back = back.unwrap();
        let f = Footprint::new(h, &back, 64, 64);
        assert_eq!((f.share, f.inside), (0.0, false));
    }

    #[test]
    fn far_away_shrinks_with_the_square_of_distance() {
        let h = Vec3::splat(0.577);
        let a = Footprint::new(h, &camera(0.0, 0.0, 100.0), 64, 64).share;
        let b = Footprint::new(h, &camera(0.0, 0.0, 200.0), 64, 64).share;
        assert!((a / b - 4.0).abs() < 0.1 && b > 0.0);
    }
}
