//! A volume's voxels in the form that both renderers use: contiguous, clamped to the range, of one of three
//! types.

use entire_core::scene::{Scalars, VolumeView, normalize};
use rayon::prelude::*;

/// Number of cells along a block's edge.
pub const BLOCK_EDGE: usize = 8;

/// Contiguous voxels, x fastest.
pub(crate) enum Voxels {
    U8(Vec<u8>),
    U16(Vec<u16>),
    /// Voxels normalized to [0, 1].
    F32(Vec<f32>),
}

/// A volume's shape, and the mapping of its voxels to table positions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Geometry {
    /// Number of voxels along each axis.
    pub(crate) dims: [usize; 3],
    /// Voxel spacing along each axis, divided by the smallest of the three spacings.
    pub(crate) relative_spacing: [f64; 3],
    /// Half the extent of the box in scene space.
    pub(crate) half_extent: [f64; 3],
    /// The table position of a voxel v is `v * scale + bias`, in 0…255 for every voxel.
    pub(crate) scale: f32,
    pub(crate) bias: f32,
}

/// A prepared volume.
pub(crate) struct PreparedVolume {
    pub(crate) voxels: Voxels,
    pub(crate) geometry: Geometry,
}

impl PreparedVolume {
    pub(crate) fn new(view: &VolumeView<'_>) -> Self {
        let (voxels, scale, bias) = match view.scalars() {
            Scalars::U8(s) => integers(view, s, |v, _| (Voxels::U8(v), 0)),
            Scalars::U16(s) => integers(view, s, less_minimum),
            Scalars::I16(s) => integers(view, s, less_minimum),
            Scalars::F32(s) => (Voxels::F32(gather(view, s, |v| normalize(view.range(), v))), 255.0, 0.0),
        };
        let spacing = view.shape().spacing.to_array().map(f64::from);
        let smallest = spacing.iter().copied().fold(f64::INFINITY, f64::min);
        let dims = view.shape().dims;
        let extent = [0, 1, 2].map(|a| dims[a] as f64 * spacing[a]);
        let diagonal = extent.iter().map(|e| e * e).sum::<f64>().sqrt();
        let geometry = Geometry {
            dims,
            relative_spacing: spacing.map(|s| s / smallest),
            half_extent: extent.map(|e| e / diagonal),
            scale,
            bias,
        };
        Self { voxels, geometry }
    }
}

impl Geometry {
    /// Number of blocks along each axis.
    pub(crate) fn blocks(&self) -> [usize; 3] {
        self.dims.map(|n| n.div_ceil(BLOCK_EDGE))
    }

    /// The smallest spacing in scene space: the reference step.
    pub(crate) fn reference_step(&self) -> f64 {
        (0..3).map(|a| 2.0 * self.half_extent[a] / self.dims[a] as f64).fold(f64::INFINITY, f64::min)
    }
}

/// Keeps integer voxels, minus an offset, if the range covers them all; else requantizes them to 16 bits over
/// the range. Returns the voxels, and the scale and the bias of their table positions.
fn integers<T: Copy + Default + Send + Sync + Ord + Into<f32> + Into<i32>>(
    view: &VolumeView<'_>,
    stored: &[T],
    keep: impl FnOnce(Vec<T>, i32) -> (Voxels, i32),
) -> (Voxels, f32, f32) {
    let (low, high) = view.range();
    let voxels = gather(view, stored, |v| v);
    let ends = voxels.par_iter().copied().map(|v| (v, v)).reduce_with(|a, b| (a.0.min(b.0), a.1.max(b.1)));
    let (min, max) = ends.unwrap_or_default();
    if high <= low {
        return (keep(voxels, min.into()).0, 0.0, 0.0);
    }
    let covers = low <= min.into() && Into::<f32>::into(max) <= high;
    if covers {
        let scale = 255.0 / (f64::from(high) - f64::from(low));
        let (voxels, offset) = keep(voxels, min.into());
        (voxels, scale as f32, ((f64::from(offset) - f64::from(low)) * scale) as f32)
    } else {
        let quantized = voxels
            .into_par_iter()
            .map(|v| (normalize(view.range(), v.into()) * 65535.0 + 0.5) as u16)
            .collect();
        (Voxels::U16(quantized), 255.0 / 65535.0, 0.0)
    }
}

/// Returns 16-bit integers minus their minimum, and the minimum. The differences always fit into `u16`.
fn less_minimum<T: Copy + Send + Into<i32>>(voxels: Vec<T>, minimum: i32) -> (Voxels, i32)
where
    Vec<T>: IntoParallelIterator<Item = T>,
{
    (Voxels::U16(voxels.into_par_iter().map(|v| (v.into() - minimum) as u16).collect()), minimum)
}

/// Returns all voxels, mapped by `map`, contiguous, x fastest.
fn gather<T: Copy + Send + Sync, U: Copy + Default + Send + Sync>(
    view: &VolumeView<'_>,
    stored: &[T],
    map: impl Fn(T) -> U + Sync,
) -> Vec<U> {
    let [nx, ny, nz] = view.shape().dims;
    let [stride, along_y, along_z] = view.strides();
    let mut out = vec![U::default(); nx * ny * nz];
    out.par_chunks_mut(nx).enumerate().for_each(|(row, out)| {
        let start = row % ny * along_y + row / ny * along_z;
        if stride == 1 {
            // Without a check of each index, compilers vectorize this loop.
            out.iter_mut().zip(&stored[start..start + nx]).for_each(|(o, &v)| *o = map(v));
        } else {
            out.iter_mut().enumerate().for_each(|(x, o)| *o = map(stored[start + x * stride]));
        }
    });
    out
}

/// An element type of [`Voxels`].
pub(crate) trait Voxel: Copy + Send + Sync + PartialOrd + Into<f32> {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self.into()
    }
}
impl Voxel for u8 {}
impl Voxel for u16 {}
impl Voxel for f32 {}

/// Evaluates an expression with the slice of voxels, whatever their type.
macro_rules! with_voxels {
    ($voxels:expr, $slice:ident => $body:expr) => {
        match $voxels {
            $crate::voxels::Voxels::U8($slice) => $body,
            $crate::voxels::Voxels::U16($slice) => $body,
            $crate::voxels::Voxels::F32($slice) => $body,
        }
    };
}
pub(crate) use with_voxels;

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::scene::VolumeOptions;

    fn position(volume: &PreparedVolume, i: usize) -> f32 {
        with_voxels!(&volume.voxels, v => v[i].to_f32()) * volume.geometry.scale + volume.geometry.bias
    }

    #[test]
    fn every_type_maps_voxels_to_table_positions() {
        let bytes = [0u8, 51, 255, 7];
        let words = [100u16, 1100, 600, 100];
        let signed = [-1000i16, 1000, 0, -1000];
        let floats = [-2.0f32, f32::NAN, f32::INFINITY, 6.0];
        let close = |v: VolumeView<'_>, want: [f32; 4]| {
            let p = PreparedVolume::new(&v);
            for (i, w) in want.iter().enumerate() {
                assert!((position(&p, i) - w).abs() < 2e-2, "{i}: {} for {w}", position(&p, i));
            }
        };
        let dims = [2, 2, 1];
        close(VolumeView::new(Scalars::U8(&bytes), dims).unwrap(), [0.0, 51.0, 255.0, 7.0]);
        close(VolumeView::new(Scalars::U16(&words), dims).unwrap(), [0.0, 255.0, 127.5, 0.0]);
        close(VolumeView::new(Scalars::I16(&signed), dims).unwrap(), [0.0, 255.0, 127.5, 0.0]);
        close(VolumeView::new(Scalars::F32(&floats), dims).unwrap(), [0.0, 0.0, 255.0, 255.0]);
    }

    #[test]
    fn narrower_ranges_clamp_before_interpolation() {
        let words = [0u16, 100, 200, 60000];
        let options = VolumeOptions { range: Some((100.0, 200.0)), ..VolumeOptions::default() };
        let v = VolumeView::with(Scalars::U16(&words), [4, 1, 1], options).unwrap();
        let p = PreparedVolume::new(&v);
        assert_eq!([0, 1, 2, 3].map(|i| position(&p, i).round()), [0.0, 0.0, 255.0, 255.0]);
    }

    #[test]
    fn constants_are_at_zero_and_strides_are_followed() {
        let v = [9u16; 4];
        let p = PreparedVolume::new(&VolumeView::new(Scalars::U16(&v), [4, 1, 1]).unwrap());
        assert_eq!(position(&p, 3), 0.0);
        let data: Vec<u8> = (0..60).collect();
        let options = VolumeOptions { strides: Some([1, 3, 12]), ..VolumeOptions::default() };
        let view = VolumeView::with(Scalars::U8(&data[16..]), [2, 2, 2], options).unwrap();
        match PreparedVolume::new(&view).voxels {
            Voxels::U8(v) => assert_eq!(v, [16, 17, 19, 20, 28, 29, 31, 32]),
            _ => panic!("bytes stay bytes"),
        }
    }

    #[test]
    fn geometry_is_relative_to_the_smallest_spacing() {
        let data = [0u8; 8];
        let options = VolumeOptions { spacing: [0.5, 1.0, 4.0], ..VolumeOptions::default() };
        let v = VolumeView::with(Scalars::U8(&data), [4, 2, 1], options).unwrap();
        let p = PreparedVolume::new(&v);
        assert_eq!(p.geometry.relative_spacing, [1.0, 2.0, 8.0]);
        assert!((p.geometry.reference_step() - f64::from(v.shape().reference_step)).abs() < 1e-7);
    }
}
