//! Checks that the same scene gives the same prediction in any unit of length, from 1e-29 to 1e29.

use entire_core::scene::{
    Arcball, Camera, Frame, GaussianLobe, ScalarType, Scalars, TransferFunction, TransferTable,
    VolumeOptions, VolumeView,
};
use entire_steer::control::Session;
use entire_steer::features::VolumeSummary;
use glam::Vec3;

const DIMS: [usize; 3] = [24, 20, 36];
/// Voxel spacing along x, y, z, in the reference unit of length.
const SPACING: [f32; 3] = [1.0, 1.5, 0.5];

/// Largest relative difference between predictions of one scene in two units, due to rounding of lengths.
const TOLERANCE: f32 = 1e-3;

fn voxels() -> Vec<u8> {
    (0..DIMS.iter().product::<usize>()).map(|i| (i * i / 61 % 251) as u8).collect()
}

fn table() -> TransferTable {
    let lobes = vec![
        GaussianLobe { center: 0.3, width: 0.01, height: 0.2 },
        GaussianLobe { center: 0.8, width: 0.01, height: 0.6 },
    ];
    TransferFunction::Gaussian(lobes).to_table().expect("a table")
}

/// Returns the predicted seconds of two cameras around a volume: the first is given by angles, the second by
/// a view matrix in the volume's unit of length.
fn predicted(summary: VolumeSummary) -> [f32; 2] {
    let radius = summary.shape().bounding_radius;
    let mut session = Session::untrained();
    session.set_volume(summary, None);
    session.set_transfer(&table(), None).expect("a transfer function");
    let pose = Camera::from_arcball(Arcball { rx: 20.0, ry: 35.0, dz: 2.0 }).expect("a camera");
    // The distance of this pose is converted from radii to the volume's unit of length.
    let other = Camera::from_arcball(Arcball { rx: -15.0, ry: 250.0, dz: 2.6 }).expect("a camera");
    let mut view = other.view();
    view.w_axis *= Vec3::splat(radius).extend(1.0);
    let view = Camera::from_world_view(view, Vec3::ZERO, radius)
        .unwrap_or_else(|e| panic!("a camera around a radius of {radius}: {e}"));
    [pose, view].map(|camera| {
        let frame = Frame::new(camera, 200, 160).expect("a frame");
        session.predict(&frame).expect("a prediction").seconds
    })
}

fn equal(found: [f32; 2], expected: [f32; 2], what: &str, unit: f32) {
    for (found, expected) in found.into_iter().zip(expected) {
        let off = (found / expected - 1.0).abs();
        assert!(off <= TOLERANCE, "{what} in a unit of {unit:e}: {found} s, expected {expected} s");
    }
}

/// Returns every power of ten with which all spacings can be multiplied and are still accepted.
fn units() -> impl Iterator<Item = f32> {
    (-29..=29).map(|power| 10f64.powi(power) as f32)
}

#[test]
fn a_volume_of_voxels_costs_the_same_in_any_unit() {
    let voxels = voxels();
    let of = |unit: f32| {
        let options = VolumeOptions { spacing: SPACING.map(|s| s * unit), ..VolumeOptions::default() };
        let view = VolumeView::with(Scalars::U8(&voxels), DIMS, options).expect("a volume");
        predicted(VolumeSummary::new(&view).expect("a summary"))
    };
    let expected = of(1.0);
    assert!(expected.iter().all(|s| *s > 0.0 && s.is_finite()) && expected[0] != expected[1]);
    for unit in units() {
        equal(of(unit), expected, "voxels", unit);
    }
}

#[test]
fn a_volume_of_bricks_costs_the_same_in_any_unit() {
    let bounds: Vec<[f32; 2]> = (0..3 * 3 * 5).map(|i| [0.01 * (i % 7) as f32, 0.02 * i as f32]).collect();
    let of = |unit: f32| {
        let spacing = SPACING.map(|s| s * unit);
        predicted(VolumeSummary::from_bricks(DIMS, spacing, ScalarType::U8, [8; 3], &bounds).expect("bricks"))
    };
    let expected = of(1.0);
    assert!(expected.iter().all(|s| *s > 0.0 && s.is_finite()));
    for unit in units() {
        equal(of(unit), expected, "bricks", unit);
    }
}
