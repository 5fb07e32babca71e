//! Tests that a scene's predicted time does not depend on the unit of length. The units span 60 orders of
//! magnitude. The summaries are made from voxels and from bricks, and the cameras from arcball poses and from
//! view matrices.

use entire_core::scene::{
    Arcball, Camera, Frame, GaussianLobe, ScalarType, Scalars, Shading, Skipping, TransferFunction,
    VolumeOptions, VolumeView,
};
use entire_steer::control::Session;
use entire_steer::features::VolumeSummary;
use entire_steer::predict::Prediction;
use glam::{Mat3, Mat4, Vec3};

/// Largest relative difference of predictions in units whose ratio is not a power of two: f32 rounds the
/// spacing.
const TOLERANCE: f32 = 1e-5;

const DIMS: [usize; 3] = [40, 24, 31];
/// Voxel spacing in units.
const SPACING: [f32; 3] = [1.0, 1.4, 2.0];

fn voxels() -> Vec<u8> {
    (0..DIMS.iter().product::<usize>()).map(|i| (i * 37 % 251) as u8).collect()
}

/// Returns summaries of the scene in the given unit of length: from voxels and from bricks.
fn summaries(unit: f32) -> [VolumeSummary; 2] {
    let spacing = SPACING.map(|s| s * unit);
    let voxels = voxels();
    let view =
        VolumeView::with(Scalars::U8(&voxels), DIMS, VolumeOptions { spacing, ..VolumeOptions::default() })
            .unwrap();
    let whole = VolumeSummary::new(&view).unwrap();
    assert_eq!(whole.shape().bounding_radius.to_bits(), view.shape().bounding_radius.to_bits(), "{unit}");
    let bricks: Vec<[f32; 2]> = (0..5 * 3 * 4).map(|i| [0.01 * i as f32, 0.4 + 0.01 * i as f32]).collect();
    let bricks = VolumeSummary::from_bricks(DIMS, spacing, ScalarType::U8, [8; 3], &bricks).unwrap();
    [whole, bricks]
}

/// Returns a camera given as arcball, and the same camera given as view matrix in world units.
fn cameras(radius: f32) -> [Camera; 2] {
    let arcball = Camera::from_arcball(Arcball { rx: 20.0, ry: -40.0, dz: 2.5 }).unwrap();
    let center = radius * Vec3::new(0.25, -0.5, 0.125);
    let rotation = Mat4::from_mat3(Mat3::from_mat4(arcball.view()));
    let moved = Mat4::from_translation(arcball.view().w_axis.truncate() * radius);
    let world = moved * rotation * Mat4::from_translation(-center);
    [arcball, Camera::from_world_view(world, center, radius).unwrap()]
}

/// Returns predictions of the scene in the given unit of length: for both summaries, each with both cameras,
/// each without shading and with single scattering.
fn predictions(unit: f32) -> Vec<Prediction> {
    let table = TransferFunction::Gaussian(vec![GaussianLobe { center: 0.4, width: 0.05, height: 0.3 }])
        .to_table()
        .unwrap();
    let mut out = Vec::new();
    for summary in summaries(unit) {
        let cameras = cameras(summary.shape().bounding_radius);
        let mut session = Session::default();
        session.set_volume(summary, None);
        session.set_transfer(&table, None).unwrap();
        for camera in cameras {
            let frame = Frame::new(camera, 320, 240).unwrap();
            for frame in [frame, Frame { shading: Shading::Scatter, skipping: Skipping::Distance, ..frame }] {
                out.push(session.predict(&frame).unwrap());
            }
        }
    }
    out
}

fn bits(p: &Prediction) -> [u32; 2] {
    [p.seconds, p.upper].map(f32::to_bits)
}

#[test]
fn units_that_are_powers_of_two_change_no_bit() {
    let expected = predictions(1.0);
    assert!(expected[0].seconds != expected[1].seconds, "shading costs");
    for exponent in -99..=98 {
        let found = predictions(2f32.powi(exponent));
        for (found, expected) in found.iter().zip(&expected) {
            assert_eq!(bits(found), bits(expected), "2^{exponent}: {found:?} {expected:?}");
        }
    }
}

#[test]
fn any_other_unit_changes_rounding_alone() {
    let expected = predictions(1.0);
    for exponent in -30..=29 {
        for digit in [1.0f32, 3.7] {
            let unit = (f64::from(digit) * 10f64.powi(exponent)) as f32;
            for (found, expected) in predictions(unit).iter().zip(&expected) {
                let ratio = found.seconds / expected.seconds;
                assert!((ratio - 1.0).abs() <= TOLERANCE, "{unit:e}: {found:?} {expected:?}");
            }
        }
    }
}

#[test]
fn bricks_refuse_the_spacings_that_voxels_refuse() {
    let voxels = voxels();
    for spacing in [[1e-31; 3], [1e31; 3], [1.0, 1.0, 1e7], [0.0, 1.0, 1.0], [f32::NAN, 1.0, 1.0]] {
        let options = VolumeOptions { spacing, ..VolumeOptions::default() };
        let from_voxels = VolumeView::with(Scalars::U8(&voxels), DIMS, options).unwrap_err();
        let from_bricks =
            VolumeSummary::from_bricks(DIMS, spacing, ScalarType::U8, [64; 3], &[[0.0, 1.0]]).unwrap_err();
        assert_eq!(from_voxels, from_bricks);
    }
    let wide = [1 << 25, 1, 1];
    assert!(
        VolumeSummary::from_bricks(wide, [1.0; 3], ScalarType::U8, [1 << 25, 1, 1], &[[0.0, 1.0]]).is_err()
    );
}
