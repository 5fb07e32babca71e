//! Resampling of volumes that were read: enlargement, and the low-resolution copy that the baseline LVRP
//! renders.

use super::{Volume, VolumeData};
use anyhow::{Context, Result, ensure};
use entire_core::memory::try_vec;
use entire_core::scene::{MAX_VOLUME_EDGE, VolumeView};
use rayon::prelude::*;

/// Maximum enlargement factor along each axis.
pub const MAX_FACTOR: usize = 8;

impl Volume {
    /// Enlarges a volume by a whole factor along every axis, by trilinear interpolation, so that a small
    /// volume costs as much to render as a large one. Voxel centers lie at half-integer positions; positions
    /// outside the outermost centers get the value of the nearest center. The spacing shrinks by the same
    /// factor, so that the box stays the same. Whole-number types round to the nearest value. The scalar
    /// range is that of the source. A factor of 1 returns the volume itself.
    ///
    /// # Errors
    /// When `factor` is 0 or over [`MAX_FACTOR`], or the enlarged volume is too large for the program or the
    /// memory.
    pub fn enlarged(self, factor: usize) -> Result<Self> {
        ensure!(
            (1..=MAX_FACTOR).contains(&factor),
            "volumes can be enlarged by whole factors of 1 to {MAX_FACTOR}; {factor} was asked for"
        );
        if factor == 1 {
            return Ok(self);
        }
        let dims = self.dims.map(|n| n * factor);
        let [x, y, z] = dims;
        ensure!(
            dims.iter().all(|n| *n <= MAX_VOLUME_EDGE),
            "enlarged {factor} times, the volume would have {x} x {y} x {z} voxels; at most \
             {MAX_VOLUME_EDGE} along each axis are accepted"
        );
        let spacing = self.spacing.map(|s| s / factor as f32);
        self.with_size(dims, spacing)
    }

    /// Resamples a volume to `edge` voxels along every axis, by trilinear interpolation at the new voxels'
    /// centers, for the baseline LVRP. Type, box and scalar range stay the same. Whole-number types round to
    /// the nearest value.
    ///
    /// # Errors
    /// When `edge` is 0 or over 512, or the resampled volume is too large for the memory.
    pub fn resampled(self, edge: usize) -> Result<Self> {
        ensure!(
            (1..=512).contains(&edge),
            "volumes can be resampled to 1 to 512 voxels an edge; {edge} was asked for"
        );
        let (from, spacing) = (self.dims, self.spacing);
        self.with_size([edge; 3], std::array::from_fn(|a| spacing[a] * from[a] as f32 / edge as f32))
    }

    /// Returns the volume in another size, of the same type and with the same range.
    fn with_size(self, dims: [usize; 3], spacing: [f32; 3]) -> Result<Self> {
        let values = trilinear(&self.view(), dims)?;
        let data = match &self.data {
            VolumeData::U8(_) => VolumeData::U8(values.iter().map(|v| v.round() as u8).collect()),
            VolumeData::U16(_) => VolumeData::U16(values.iter().map(|v| v.round() as u16).collect()),
            VolumeData::I16(_) => VolumeData::I16(values.iter().map(|v| v.round() as i16).collect()),
            VolumeData::F32(_) => VolumeData::F32(values),
        };
        let mut out = Self::new(data, dims, spacing, self.name)?;
        out.set_range(self.range)?;
        Ok(Self { source: self.source, notes: self.notes, ..out })
    }
}

fn trilinear(view: &VolumeView<'_>, dims: [usize; 3]) -> Result<Vec<f32>> {
    // For each axis and each index in the new volume: two indices in the old volume, and the weight of the
    // second.
    let axes: [Vec<(usize, usize, f32)>; 3] = std::array::from_fn(|a| {
        let n = view.shape().dims[a];
        (0..dims[a])
            .map(|i| {
                let at = ((i as f32 + 0.5) * n as f32 / dims[a] as f32 - 0.5).clamp(0.0, (n - 1) as f32);
                let low = at as usize;
                (low, (low + 1).min(n - 1), at - low as f32)
            })
            .collect()
    });
    let [x, y, z] = dims;
    let count = dims.iter().try_fold(1usize, |n, d| n.checked_mul(*d)).unwrap_or(usize::MAX);
    let fail = || {
        format!(
            "{x} x {y} x {z} voxels of 4 bytes do not fit into this machine's memory; choose a smaller size"
        )
    };
    let mut out = try_vec(count, 0.0f32).with_context(fail)?;
    // Without the second condition, two infinities of one sign would give NaN.
    let mix = |a: f32, b: f32, t: f32| if t == 0.0 || a.is_infinite() { a } else { a + t * (b - a) };
    out.par_chunks_mut(dims[0] * dims[1]).enumerate().for_each(|(z, slice)| {
        let (z0, z1, tz) = axes[2][z];
        for (y, row) in slice.chunks_mut(dims[0]).enumerate() {
            let (y0, y1, ty) = axes[1][y];
            for (value, &(x0, x1, tx)) in row.iter_mut().zip(&axes[0]) {
                let line = |y, z| mix(view.value(x0, y, z), view.value(x1, y, z), tx);
                *value = mix(mix(line(y0, z0), line(y1, z0), ty), mix(line(y0, z1), line(y1, z1), ty), tz);
            }
        }
    });
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_lie_between_their_neighbors_and_the_box_stays() {
        let v = Volume::new(VolumeData::U8(vec![0, 100, 200, 40]), [2, 2, 1], [1.0, 2.0, 3.0], "v").unwrap();
        let e = v.clone().enlarged(2).unwrap();
        assert_eq!(e.dims(), [4, 4, 2]);
        assert_eq!(e.spacing(), [0.5, 1.0, 1.5]);
        let VolumeData::U8(d) = e.data() else { panic!("the type changed") };
        // Along x at y = 0, the values are 0, a quarter of 100, three quarters of 100, and 100; both slices
        // are equal.
        assert_eq!(d[..4], [0, 25, 75, 100]);
        assert_eq!(d[..16], d[16..]);
        assert_eq!(e.view().shape().half_extent, v.view().shape().half_extent);
        assert_eq!(e.view().range(), (0.0, 255.0));
        assert!(v.clone().enlarged(0).is_err() && v.enlarged(9).is_err());
        let long = Volume::new(VolumeData::U8(vec![0; 200_000]), [200_000, 1, 1], [1.0; 3], "v").unwrap();
        let said = long.enlarged(8).unwrap_err().to_string();
        assert!(said.contains("1600000 x 8 x 8 voxels"), "{said}");
    }

    #[test]
    fn resampling_keeps_type_box_and_range() {
        let v = Volume::new(VolumeData::U8((0..64).collect()), [4, 4, 4], [1.0, 2.0, 3.0], "v").unwrap();
        let r = v.clone().resampled(2).unwrap();
        assert_eq!((r.dims(), r.spacing()), ([2; 3], [2.0, 4.0, 6.0]));
        assert_eq!(r.view().shape().half_extent, v.view().shape().half_extent);
        assert_eq!(r.view().range(), (0.0, 255.0));
        // The value is the mean of the eight voxels around the new voxel's center.
        let VolumeData::U8(d) = r.data() else { panic!("the type changed") };
        assert_eq!(d[0], ((1 + 4 + 5 + 16 + 17 + 20 + 21) as f32 / 8.0).round() as u8);
        assert!(v.clone().resampled(0).is_err() && v.resampled(513).is_err());
    }

    #[test]
    fn floats_keep_their_sources_range_and_infinities_stay_where_they_are() {
        let infinity = f32::INFINITY;
        let doubled = |voxels: [f32; 3]| {
            let v = Volume::new(VolumeData::F32(voxels.to_vec()), [3, 1, 1], [1.0; 3], "v").unwrap();
            let e = v.clone().enlarged(2).unwrap();
            let VolumeData::F32(d) = e.data() else { panic!("the type changed") };
            (e.view().range(), d[..6].to_vec())
        };
        let row = vec![1.0, 1.5, 2.5, infinity, infinity, infinity];
        assert_eq!(doubled([1.0, 3.0, infinity]), ((1.0, 3.0), row));
        let (_, row) = doubled([infinity, infinity, 1.0]);
        assert!(row.iter().all(|v| !v.is_nan()) && row[..3] == [infinity; 3], "{row:?}");
    }
}
