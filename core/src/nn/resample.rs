//! Resampling of any volume to a cube of floats.
//!
//! Each axis is resampled on its own, in voxel coordinates (the spacing is not used):
//!
//! - An axis of `m` voxels **shrinks** to `n < m` by area average: output `i` is the mean of the input over
//!   `[i·m/n, (i+1)·m/n)`, in which each voxel is weighted by its exact fraction inside this interval.
//! - An axis **grows** to `n > m` by linear interpolation between voxel centers: output `i` sits at
//!   `(i + ½)·m/n − ½` in voxel coordinates, clamped to the first and last voxel.
//! - An axis with `m = n` is copied.
//!
//! Voxels are first mapped to [0, 1] by the view's range ([`normalize`]), so values outside the
//! range, NaN and infinities never enter an average.

use crate::Result;
use crate::error::bail;
use crate::kernels::resample::{self as kernel, Affine, Map, Span};
use crate::kernels::{Executor, Level};
use crate::memory::{reserve, resize};
use crate::scene::{Scalars, VolumeView, normalize};
use alloc::vec::Vec;

#[cfg(test)]
/// Upper bound of the absolute difference between [`Resampler::resample`]'s values and the exact average of
/// the exactly normalized voxels, for at most 64 input voxels per output voxel and axis.
const RESAMPLE_TOLERANCE: f32 = 2e-6;

/// Longest axis that [`Resampler::resample`] accepts, in voxels.
const MAX_AXIS: u64 = 1 << 31;

/// Resamples volumes. Holds the SIMD level, and working memory that is kept between calls: a second call with
/// the same sizes and number of threads does not allocate.
#[derive(Clone, Debug)]
pub struct Resampler {
    level: Level,
    rows: Vec<f32>,
    columns: Vec<Span>,
}

impl Default for Resampler {
    fn default() -> Self {
        Self::new(Level::detect())
    }
}

impl Resampler {
    /// A resampler that uses the instructions of `level`. Every level gives the same bits.
    pub const fn new(level: Level) -> Self {
        Self { level, rows: Vec::new(), columns: Vec::new() }
    }

    /// Resamples a volume to `n`³ values in [0, 1], written to `out` with x fastest, then y, then z.
    ///
    /// The result depends on the volume, its range and `n`, and not on the executor or the level. With at
    /// most 64 input voxels per output voxel and axis, values are within 2e-6 of the exact average of the
    /// exactly normalized voxels; with more, the error grows with their number.
    ///
    /// # Errors
    /// [`ErrorKind::InvalidArgument`](crate::ErrorKind) when `n` is 0, or `n` or an axis exceeds 2³¹ voxels,
    /// [`ErrorKind::SizeMismatch`](crate::ErrorKind) when `out` does not hold exactly `n`³ values,
    /// [`ErrorKind::OutOfMemory`](crate::ErrorKind) if the scratch for rows cannot be allocated.
    pub fn resample(
        &mut self,
        view: &VolumeView<'_>,
        n: usize,
        out: &mut [f32],
        executor: Executor<'_>,
    ) -> Result<()> {
        if n == 0 {
            bail!(InvalidArgument, "resampling to 0 voxels per axis; the size must be at least 1");
        }
        let dims @ [x, y, z] = view.dims();
        if [x, y, z, n].iter().any(|&d| d as u64 > MAX_AXIS) {
            bail!(
                InvalidArgument,
                "resampling {x} x {y} x {z} voxels to {n} per axis; an axis has at most {MAX_AXIS} voxels"
            );
        }
        let wanted = (n as u64).checked_mul(n as u64).and_then(|p| p.checked_mul(n as u64));
        if wanted != Some(out.len() as u64) {
            bail!(SizeMismatch, "resampling to {n} x {n} x {n} values, the output holds {}", out.len());
        }
        self.columns.clear();
        reserve(&mut self.columns, n)?;
        self.columns.extend((0..n).map(|i| Span::of(i, dims[0], n)));
        let row_len = kernel::scratch_len(dims[0], n);
        // With a few parts per thread, the other threads take over work of a thread that the system delays.
        let parts = match executor.threads() {
            1 => 1,
            threads => (4 * threads).min(n),
        };
        if self.rows.len() < row_len * parts {
            resize(&mut self.rows, row_len * parts, 0.0)?;
        }
        let rows = &mut self.rows[..row_len * parts];
        let columns = self.columns.as_slice();
        let geometry = kernel::Geometry { dims, strides: view.strides(), n, columns, level: self.level };
        let job = Resampling { geometry: &geometry, executor };
        let (low, high) = view.range();
        let affine = Affine::of((low, high));
        match view.scalars() {
            Scalars::U8(s) if low <= 0.0 && high >= 255.0 && affine.is_some() => {
                // The range holds every voxel: nothing is clamped, so the map can be applied to the averages.
                let width = f64::from(high) - f64::from(low);
                let (scale, offset) = (1.0 / width, -f64::from(low) / width);
                if kernel::integer_ratio(&dims, n) {
                    job.run(out, rows, &|z0, planes, rows| {
                        kernel::bytes(&geometry, s, scale, offset, z0, planes, rows);
                    });
                } else {
                    let after = kernel::After { scale: scale as f32, offset: offset as f32 };
                    job.typed(s, kernel::Raw, after, out, rows);
                }
            }
            Scalars::U8(s) => job.mapped(s, view, affine, out, rows),
            Scalars::U16(s) => job.mapped(s, view, affine, out, rows),
            Scalars::I16(s) => job.mapped(s, view, affine, out, rows),
            Scalars::F32(s) => job.mapped(s, view, affine, out, rows),
        }
        Ok(())
    }
}

/// Function that fills planes. Arguments: index of the first plane, the planes, scratch for rows.
type Fill<'a> = dyn Fn(usize, &mut [f32], &mut [f32]) + Sync + 'a;

/// Map that normalizes a voxel as the view does; used if the reciprocal of the range's width is not a normal
/// number.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exact<'a>(pub(super) &'a VolumeView<'a>);

impl<T: kernel::Scalar> Map<T> for Exact<'_> {
    #[inline(always)]
    fn value(&self, stored: f32) -> f32 {
        normalize(self.0.range(), stored)
    }
}

struct Resampling<'a> {
    geometry: &'a kernel::Geometry<'a>,
    executor: Executor<'a>,
}

impl Resampling<'_> {
    fn mapped<T: kernel::Scalar>(
        &self,
        scalars: &[T],
        view: &VolumeView<'_>,
        affine: Option<Affine>,
        out: &mut [f32],
        rows: &mut [f32],
    ) {
        let after = kernel::After { scale: 1.0, offset: 0.0 };
        match affine {
            Some(map) => self.typed(scalars, map, after, out, rows),
            None => self.typed(scalars, Exact(view), after, out, rows),
        }
    }

    fn typed<T: kernel::Scalar, M: Map<T>>(
        &self,
        scalars: &[T],
        map: M,
        after: kernel::After,
        out: &mut [f32],
        rows: &mut [f32],
    ) {
        let (level, stride) = (self.geometry.level, self.geometry.strides[0]);
        self.planes(&|at, row| kernel::fetch(level, scalars, map, at, stride, row), after, out, rows);
    }

    fn planes(&self, fetch: &kernel::Fetch<'_>, after: kernel::After, out: &mut [f32], rows: &mut [f32]) {
        self.run(out, rows, &|z0, planes, rows| {
            kernel::planes(self.geometry, fetch, after, z0, planes, rows);
        });
    }

    /// Fills the planes of the output, split over the executor's threads. If the output has more planes than
    /// the input, the input's planes are stored in the last planes of the output and then interpolated in
    /// place.
    fn run(&self, out: &mut [f32], rows: &mut [f32], fill: &Fill<'_>) {
        let g = self.geometry;
        let plane = g.n * g.n;
        let depth = g.dims[2].min(g.n);
        let row_len = kernel::scratch_len(g.dims[0], g.n);
        split(self.executor, plane, row_len, 0, &mut out[(g.n - depth) * plane..], rows, fill);
        if depth < g.n {
            kernel::spread(out, depth, g.n, plane, &mut rows[..2 * g.n]);
        }
    }
}

/// Halves the planes and the scratch recursively. Fills each part of the planes, with one piece of the
/// scratch as working memory.
fn split(
    executor: Executor<'_>,
    plane: usize,
    row_len: usize,
    z0: usize,
    planes: &mut [f32],
    rows: &mut [f32],
    fill: &Fill<'_>,
) {
    let parts = rows.len() / row_len;
    let depth = planes.len() / plane;
    if parts <= 1 || depth <= 1 {
        fill(z0, planes, &mut rows[..row_len]);
        return;
    }
    let left = parts / 2;
    let cut = depth * left / parts;
    let (planes_a, planes_b) = planes.split_at_mut(cut * plane);
    let (rows_a, rows_b) = rows.split_at_mut(left * row_len);
    executor.join(
        || {
            if cut > 0 {
                split(executor, plane, row_len, z0, planes_a, rows_a, fill);
            }
        },
        || split(executor, plane, row_len, z0 + cut, planes_b, rows_b, fill),
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ErrorKind;
    use crate::nn::random;
    use crate::scene::VolumeOptions;
    use alloc::vec;

    /// Reference in float64: weight of input voxel `j` in output `i` along one axis.
    fn weight(i: usize, j: usize, m: usize, n: usize) -> f64 {
        let ratio = m as f64 / n as f64;
        if m >= n {
            let (low, high) = (i as f64 * ratio, (i + 1) as f64 * ratio);
            return (high.min(j as f64 + 1.0) - low.max(j as f64)).max(0.0) / ratio;
        }
        let p = ((i as f64 + 0.5) * ratio - 0.5).clamp(0.0, (m - 1) as f64);
        (1.0 - (p - j as f64).abs()).max(0.0)
    }

    /// Reference: every output as the sum over all voxels of the product of three weights.
    fn definition(view: &VolumeView<'_>, n: usize) -> Vec<f64> {
        let [nx, ny, nz] = view.dims();
        let mut out = vec![0.0; n * n * n];
        for z in 0..n {
            for y in 0..n {
                for x in 0..n {
                    let mut sum = 0.0;
                    for k in 0..nz {
                        let wz = weight(z, k, nz, n);
                        for j in (0..ny).filter(|_| wz > 0.0) {
                            let wy = weight(y, j, ny, n);
                            for i in (0..nx).filter(|_| wy > 0.0) {
                                let w = wz * wy * weight(x, i, nx, n);
                                if w > 0.0 {
                                    sum += w * normalized(view, i, j, k);
                                }
                            }
                        }
                    }
                    out[(z * n + y) * n + x] = sum;
                }
            }
        }
        out
    }

    fn normalized(view: &VolumeView<'_>, x: usize, y: usize, z: usize) -> f64 {
        let (low, high) = (f64::from(view.range().0), f64::from(view.range().1));
        let v = f64::from(view.value(x, y, z));
        if v.is_nan() || high <= low { 0.0 } else { ((v - low) / (high - low)).clamp(0.0, 1.0) }
    }

    /// Resamples at every level. Checks that all levels give the same bits, and that these are within the
    /// tolerance of the definition.
    fn check(view: &VolumeView<'_>, n: usize) {
        let expected = definition(view, n);
        let mut bits: Option<Vec<u32>> = None;
        for level in Level::available() {
            let mut out = vec![f32::NAN; n * n * n];
            Resampler::new(level).resample(view, n, &mut out, Executor::Serial).unwrap();
            for (i, (&o, &e)) in out.iter().zip(&expected).enumerate() {
                let error = (f64::from(o) - e).abs();
                assert!(
                    error <= f64::from(RESAMPLE_TOLERANCE) && (0.0..=1.0).contains(&o),
                    "{:?} {:?} to {n} at {level}: output {i} is {o}, expected {e}",
                    view.scalars().scalar_type(),
                    view.dims()
                );
            }
            let found: Vec<u32> = out.iter().map(|v| v.to_bits()).collect();
            assert_eq!(*bits.get_or_insert_with(|| found.clone()), found, "{:?} at {level}", view.dims());
        }
    }

    const SHAPES: [([usize; 3], usize); 16] = [
        ([5, 7, 11], 8),
        ([11, 5, 7], 8),
        ([7, 11, 5], 8),
        ([8, 8, 8], 8),
        ([16, 8, 24], 8),
        ([32, 32, 32], 8),
        ([33, 31, 17], 8),
        ([64, 48, 40], 8),
        ([1, 1, 1], 4),
        ([1, 9, 30], 4),
        ([9, 1, 30], 4),
        ([30, 9, 1], 4),
        ([2, 3, 2], 1),
        ([100, 3, 2], 3),
        ([2, 70, 65], 3),
        ([23, 130, 140], 2),
    ];

    /// The rows are long enough for every width of the inner loops.
    #[test]
    fn bytes_give_the_same_bits_on_every_level() {
        for (dims, n) in
            [([556, 139, 139], 139), ([360, 90, 180], 90), ([300, 100, 100], 100), ([64, 32, 16], 16)]
        {
            let mut next = random(77);
            let bytes: Vec<u8> = (0..dims.iter().product()).map(|_| next() as u8).collect();
            let view = VolumeView::new(Scalars::U8(&bytes), dims).unwrap();
            let resampled = |level| {
                let mut out = vec![f32::NAN; n * n * n];
                Resampler::new(level).resample(&view, n, &mut out, Executor::Serial).unwrap();
                out.iter().map(|v| v.to_bits()).collect::<Vec<u32>>()
            };
            let standard = resampled(Level::SCALAR);
            for level in Level::available() {
                assert!(resampled(level) == standard, "{dims:?} to {n} at {level}");
            }
        }
    }

    /// Returns a view of the same voxels with another range.
    fn ranged<'a>(view: &VolumeView<'a>, range: (f32, f32)) -> VolumeView<'a> {
        let options = VolumeOptions { range: Some(range), ..VolumeOptions::default() };
        VolumeView::with(view.scalars(), view.dims(), options).unwrap()
    }

    #[test]
    fn every_type_and_shape_meets_the_definition() {
        for (seed, (dims, n)) in SHAPES.into_iter().enumerate() {
            let voxels = dims.iter().product();
            let mut next = random(seed as u64 + 1);
            let bytes: Vec<u8> = (0..voxels).map(|_| next() as u8).collect();
            let view = VolumeView::new(Scalars::U8(&bytes), dims).unwrap();
            check(&view, n);
            check(&ranged(&view, (-3.5, 300.0)), n);
            check(&ranged(&view, (40.0, 200.5)), n);
            let words: Vec<u16> = (0..voxels).map(|_| 60000 + next() as u16 % 1000).collect();
            check(&VolumeView::new(Scalars::U16(&words), dims).unwrap(), n);
            let signed: Vec<i16> = (0..voxels).map(|_| next() as i16).collect();
            let view = VolumeView::new(Scalars::I16(&signed), dims).unwrap();
            check(&view, n);
            check(&ranged(&view, (-100.0, 9000.0)), n);
            let floats: Vec<f32> = (0..voxels)
                .map(|_| match next() % 50 {
                    0 => f32::NAN,
                    1 => f32::INFINITY,
                    2 => f32::NEG_INFINITY,
                    v => v as f32 * 1e-3 - 0.02,
                })
                .collect();
            check(&VolumeView::new(Scalars::F32(&floats), dims).unwrap(), n);
        }
    }

    #[test]
    fn ranges_without_a_reciprocal_meet_the_definition() {
        let dims = [5, 7, 11];
        let mut next = random(99);
        let huge: Vec<f32> = (0..385).map(|_| if next() % 2 == 0 { f32::MIN } else { f32::MAX }).collect();
        check(&VolumeView::new(Scalars::F32(&huge), dims).unwrap(), 8);
        let tiny: Vec<f32> = (0..385).map(|_| f32::from_bits((next() % 100) as u32)).collect();
        check(&VolumeView::new(Scalars::F32(&tiny), dims).unwrap(), 8);
        let constant = [4.5f32; 385];
        let view = VolumeView::new(Scalars::F32(&constant), dims).unwrap();
        check(&view, 8);
        check(&ranged(&view, (0.0, 5.0)), 8);
        check(&VolumeView::new(Scalars::F32(&[f32::NAN; 385]), dims).unwrap(), 8);
    }

    #[test]
    fn strided_views_read_the_right_voxels() {
        let mut next = random(5);
        let data: Vec<u8> = (0..40 * 40 * 40).map(|_| next() as u8).collect();
        let words: Vec<i16> = data.iter().map(|&b| i16::from(b) * 3 - 200).collect();
        // Cases: padded rows, a transposed volume, every second voxel, a broadcast axis.
        for (dims, strides) in [
            ([16, 8, 24], [1, 40, 1600]),
            ([17, 9, 23], [1, 40, 1600]),
            ([11, 13, 9], [1600, 40, 1]),
            ([16, 16, 16], [2, 80, 3200]),
            ([8, 5, 16], [1, 0, 40]),
            ([8, 16, 16], [0, 1, 40]),
        ] {
            for scalars in [Scalars::U8(&data), Scalars::I16(&words)] {
                let options = VolumeOptions { strides: Some(strides), ..VolumeOptions::default() };
                check(&VolumeView::with(scalars, dims, options).unwrap(), 8);
            }
        }
    }

    #[test]
    fn long_averages_do_not_pile_up_rounding_errors() {
        // 64 input voxels per output voxel and axis. In a constant volume, all rounding errors have the same
        // sign.
        let dims = [128, 128, 128];
        for value in [0.1f32, 0.7, 0.3333] {
            let floats = vec![value; 128 * 128 * 128];
            let view = ranged(&VolumeView::new(Scalars::F32(&floats), dims).unwrap(), (0.0, 1.0));
            let mut out = [0.0; 8];
            Resampler::default().resample(&view, 2, &mut out, Executor::Serial).unwrap();
            for o in out {
                assert!((o - value).abs() <= RESAMPLE_TOLERANCE, "{o} for {value}");
            }
        }
    }

    #[test]
    fn a_copy_is_exact_to_a_rounding_and_a_ramp_stays_a_ramp() {
        let bytes: Vec<u8> = (0..64).map(|v| v * 4).collect();
        let view = VolumeView::new(Scalars::U8(&bytes), [4, 4, 4]).unwrap();
        let mut out = [0.0; 64];
        Resampler::default().resample(&view, 4, &mut out, Executor::Serial).unwrap();
        for (o, &b) in out.iter().zip(&bytes) {
            assert!((o - f32::from(b) / 255.0).abs() <= 6e-8);
        }
        let ramp: Vec<f32> = (0..8).map(|x| x as f32).collect();
        let view = VolumeView::new(Scalars::F32(&ramp), [8, 1, 1]).unwrap();
        let mut out = [0.0; 8];
        Resampler::default().resample(&view, 2, &mut out, Executor::Serial).unwrap();
        for (o, e) in out.iter().zip([1.5 / 7.0, 5.5 / 7.0].iter().cycle()) {
            assert!((o - e).abs() < 1e-6);
        }
    }

    #[cfg(feature = "rayon")]
    #[test]
    fn threads_change_no_bit() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        let mut next = random(77);
        for (dims, n) in SHAPES {
            let voxels: usize = dims.iter().product();
            let bytes: Vec<u8> = (0..voxels).map(|_| next() as u8).collect();
            let floats: Vec<f32> = (0..voxels).map(|_| next() as f32).collect();
            for scalars in [Scalars::U8(&bytes), Scalars::F32(&floats)] {
                let view = VolumeView::new(scalars, dims).unwrap();
                let (mut one, mut many) = (vec![0.0f32; n * n * n], vec![0.0f32; n * n * n]);
                Resampler::default().resample(&view, n, &mut one, Executor::Serial).unwrap();
                Resampler::default().resample(&view, n, &mut many, Executor::Rayon(&pool)).unwrap();
                assert!(one.iter().zip(&many).all(|(a, b)| a.to_bits() == b.to_bits()), "{dims:?}");
            }
        }
    }

    #[test]
    fn a_resampler_serves_volumes_of_any_size_in_turn() {
        let mut resampler = Resampler::default();
        let bytes = [9u8; 27 * 64];
        for (dims, n) in [([3, 9, 64], 4), ([64, 9, 3], 2), ([1, 1, 1], 5), ([1728, 1, 1], 3)] {
            let view = VolumeView::new(Scalars::U8(&bytes), dims).unwrap();
            let mut out = vec![0.0; n * n * n];
            resampler.resample(&view, n, &mut out, Executor::Serial).unwrap();
            assert!(out.iter().all(|o| (o - 9.0 / 255.0).abs() < 1e-6), "{dims:?}");
        }
    }

    #[test]
    fn bad_sizes_are_refused() {
        let view = VolumeView::new(Scalars::U8(&[1, 2]), [2, 1, 1]).unwrap();
        let mut resampler = Resampler::default();
        let e = resampler.resample(&view, 0, &mut [], Executor::Serial).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::InvalidArgument);
        let e = resampler.resample(&view, 2, &mut [0.0; 7], Executor::Serial).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::SizeMismatch);
        assert!(e.to_string().contains("2 x 2 x 2") && e.to_string().contains('7'));
        let e = resampler.resample(&view, usize::MAX, &mut [0.0; 7], Executor::Serial).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::InvalidArgument);
    }
}
