//! Volumes, transfer functions and frames of the tests.
#![allow(dead_code, reason = "every test binary uses a part of this")]

use entire_core::scene::{
    Arcball, Camera, ControlPoint, Frame, Scalars, TransferFunction, TransferTable, VolumeView,
};
use entire_vk_raycaster::{Renderer, Result};

/// A camera on the arcball with a field of view of 30 degrees.
pub(crate) fn camera(rx: f32, ry: f32, dz: f32) -> Camera {
    Camera::from_arcball(Arcball { rx, ry, dz }).unwrap().with_fov_y_degrees(30.0).unwrap()
}

pub(crate) fn frame(rx: f32, ry: f32, dz: f32, width: u32, height: u32) -> Frame {
    Frame::new(camera(rx, ry, dz), width, height).unwrap()
}

/// A frame of parallel rays: `scale` is half of the visible height, in bounding-sphere radii.
pub(crate) fn parallel((rx, ry, dz): (f32, f32, f32), scale: f32, width: u32, height: u32) -> Frame {
    Frame::new(camera(rx, ry, dz).with_parallel_scale(scale).unwrap(), width, height).unwrap()
}

/// A smooth field with empty corners: three blobs on a gentle ramp inside a ball, in [0, 1].
pub(crate) fn field(x: f32, y: f32, z: f32) -> f32 {
    let ball = 1.0 - (x * x + y * y + z * z).sqrt();
    if ball <= 0.0 {
        return 0.0;
    }
    let blob = |cx: f32, cy: f32, cz: f32, w: f32| {
        (-((x - cx).powi(2) + (y - cy).powi(2) + (z - cz).powi(2)) / w).exp()
    };
    let sum = 0.25 * (x + 1.0) * ball
        + 0.8 * blob(0.3, 0.2, 0.1, 0.05)
        + 0.7 * blob(-0.4, -0.1, 0.3, 0.03)
        + 0.6 * blob(0.0, -0.4, -0.4, 0.08);
    sum.min(1.0)
}

/// Samples [`field`] at the voxel centers of a box of edge 2.
pub(crate) fn field_voxels(dims: [usize; 3]) -> Vec<f32> {
    let at = |i: usize, n: usize| (i as f32 + 0.5) / n as f32 * 2.0 - 1.0;
    let mut out = Vec::with_capacity(dims[0] * dims[1] * dims[2]);
    for z in 0..dims[2] {
        for y in 0..dims[1] {
            for x in 0..dims[0] {
                out.push(field(at(x, dims[0]), at(y, dims[1]), at(z, dims[2])));
            }
        }
    }
    out
}

pub(crate) fn field_bytes(dims: [usize; 3]) -> Vec<u8> {
    field_voxels(dims).iter().map(|v| (v * 255.0).round() as u8).collect()
}

/// A volume of bytes.
pub(crate) fn bytes(data: &[u8], dims: [usize; 3]) -> VolumeView<'_> {
    VolumeView::new(Scalars::U8(data), dims).unwrap()
}

/// Sets a volume of the bytes of [`field`], and a transfer function.
pub(crate) fn set_field(renderer: &mut dyn Renderer, dims: [usize; 3], table: &TransferTable) -> Result<()> {
    renderer.set_volume(&bytes(&field_bytes(dims), dims))?;
    renderer.set_transfer(table).map(drop)
}

fn points(list: &[(f32, [f32; 3], f32)]) -> TransferTable {
    let points =
        list.iter().map(|&(position, color, opacity)| ControlPoint { position, color, opacity }).collect();
    TransferFunction::Points(points).to_table().unwrap()
}

/// Low opacity everywhere except in the background, which is transparent.
pub(crate) fn transparent() -> TransferTable {
    points(&[(0.0, [0.2, 0.3, 0.9], 0.0), (0.1, [0.2, 0.4, 0.9], 0.0), (1.0, [1.0, 0.6, 0.2], 0.02)])
}

pub(crate) fn medium() -> TransferTable {
    points(&[(0.0, [0.2, 0.3, 0.9], 0.0), (0.15, [0.2, 0.7, 0.5], 0.0), (1.0, [1.0, 0.7, 0.3], 0.15)])
}

pub(crate) fn opaque() -> TransferTable {
    points(&[
        (0.0, [0.2, 0.3, 0.9], 0.0),
        (0.3, [0.2, 0.7, 0.5], 0.0),
        (0.5, [0.9, 0.5, 0.2], 0.6),
        (1.0, [1.0, 0.9, 0.8], 0.9),
    ])
}

/// The same color and opacity everywhere.
pub(crate) fn constant(opacity: f32) -> TransferTable {
    points(&[(0.0, [1.0, 0.5, 0.25], opacity)])
}
