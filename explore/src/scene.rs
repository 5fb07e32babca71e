//! The volume in the window, on the device and in memory.

use crate::camera::Placement;
use crate::histogram::Histogram;
use anyhow::{Result, ensure};
use entire_core::scene::{Scalars, VolumeOptions, VolumeView};
use entire_io::volume::Volume;
use entire_vk_raycaster::VulkanRaycaster;
use glam::Vec3;
use std::path::PathBuf;
use std::sync::Arc;

/// First and last voxel of a part along each axis.
pub(crate) type Crop = [[usize; 2]; 3];

/// A volume on the device, whole or a part.
pub(crate) struct Scene {
    pub(crate) path: PathBuf,
    /// Index in a time series.
    pub(crate) index: usize,
    pub(crate) whole: Arc<Volume>,
    /// Range of values that maps to [0, 1]; `None` for the file's range.
    pub(crate) range: Option<(f32, f32)>,
    pub(crate) crop: Option<Crop>,
    pub(crate) placement: Placement,
    pub(crate) raycaster: VulkanRaycaster,
    pub(crate) histogram: Histogram,
    pub(crate) facts: Facts,
}

/// Description of a volume.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Facts {
    pub(crate) dims: [usize; 3],
    pub(crate) kind: &'static str,
    pub(crate) range: (f32, f32),
    /// Minimum and maximum of the volume's voxels.
    pub(crate) own_range: (f32, f32),
    pub(crate) spacing: Vec3,
    /// Half extents of the whole volume's box, in the scene space of the whole volume.
    pub(crate) half_extent: Vec3,
}

impl Facts {
    pub(crate) fn of(view: &VolumeView<'_>) -> Self {
        Self {
            dims: view.shape().dims,
            kind: view.scalars().scalar_type().into(),
            range: view.range(),
            own_range: view.own_range(),
            spacing: view.shape().spacing,
            half_extent: view.shape().half_extent,
        }
    }

    /// Returns the lowest and the highest corner of a part, or of the whole volume, in the scene space of the
    /// whole volume.
    pub(crate) fn corners(&self, crop: Option<Crop>) -> [Vec3; 2] {
        let end =
            |a: usize, voxel: usize| self.half_extent[a] * (2.0 * voxel as f32 / self.dims[a] as f32 - 1.0);
        let Some(crop) = crop else { return [-self.half_extent, self.half_extent] };
        [
            Vec3::from_array([0, 1, 2].map(|a| end(a, crop[a][0]))),
            Vec3::from_array([0, 1, 2].map(|a| end(a, crop[a][1] + 1))),
        ]
    }
}

/// Returns the view of a volume whose values are mapped to [0, 1] by `range`; `None` for the volume's range.
pub(crate) fn spanned(volume: &Volume, range: Option<(f32, f32)>) -> VolumeView<'_> {
    if range.is_none() {
        return volume.view();
    }
    let options = VolumeOptions { range, spacing: volume.spacing(), ..VolumeOptions::default() };
    VolumeView::with(volume.data().scalars(), volume.dims(), options)
        .expect("sizes and spacing were checked when the volume was read, and its own range is valid")
}

/// Returns the view of a part of a volume, and the part's placement. The view has the value range of the
/// whole volume.
pub(crate) fn part<'a>(view: &VolumeView<'a>, crop: Crop) -> Result<(VolumeView<'a>, Placement)> {
    let (shape, strides) = (view.shape(), view.strides());
    for (axis, ([low, high], n)) in ["x", "y", "z"].iter().zip(crop.iter().zip(shape.dims)) {
        ensure!(
            low <= high && *high < n,
            "the part has voxels {low} to {high} along {axis}; the volume has 0 to {}",
            n - 1
        );
    }
    let first: usize = crop.iter().zip(strides).map(|([low, _], stride)| low * stride).sum();
    let scalars = match view.scalars() {
        Scalars::U8(v) => Scalars::U8(&v[first..]),
        Scalars::U16(v) => Scalars::U16(&v[first..]),
        Scalars::I16(v) => Scalars::I16(&v[first..]),
        Scalars::F32(v) => Scalars::F32(&v[first..]),
    };
    let dims = crop.map(|[low, high]| high - low + 1);
    let spacing = shape.spacing.to_array();
    let options = VolumeOptions { strides: Some(strides), spacing, range: Some(view.range()) };
    let part = VolumeView::with(scalars, dims, options)?;
    let [low, high] = Facts::of(view).corners(Some(crop));
    let radius = part.shape().bounding_radius / shape.bounding_radius;
    Ok((part, Placement { center: 0.5 * (low + high), radius }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_holds_its_voxels_and_knows_where_it_lies() {
        let voxels: Vec<u16> = (0..4 * 6 * 8).collect();
        let view = VolumeView::with(
            Scalars::U16(&voxels),
            [4, 6, 8],
            VolumeOptions { spacing: [1.0, 2.0, 0.5], ..VolumeOptions::default() },
        )
        .unwrap();
        let (cut, placement) = part(&view, [[1, 2], [0, 3], [4, 7]]).unwrap();
        assert_eq!((cut.shape().dims, cut.range()), ([2, 4, 4], view.range()));
        for (x, y, z) in [(0, 0, 0), (1, 3, 3), (1, 0, 2)] {
            assert_eq!(cut.value(x, y, z), view.value(x + 1, y, z + 4));
        }
        // A voxel's corner has the same world position in the part and in the whole volume.
        let world = |v: &VolumeView<'_>, at: Vec3| {
            let corner = Vec3::from_array(v.shape().dims.map(|n| n as f32)) * v.shape().spacing * 0.5;
            at * v.shape().spacing - corner
        };
        let of_whole = world(&view, Vec3::new(1.0, 0.0, 4.0)) / view.shape().bounding_radius;
        let of_part =
            world(&cut, Vec3::ZERO) / cut.shape().bounding_radius * placement.radius + placement.center;
        assert!((of_whole - of_part).length() < 1e-6, "{of_whole} {of_part}");
        assert!(part(&view, [[1, 4], [0, 3], [4, 7]]).is_err());
        assert!(part(&view, [[2, 1], [0, 3], [4, 7]]).is_err());
    }
}
