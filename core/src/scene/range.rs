//! Default range of a volume's scalars.

use super::{Scalars, VolumeView};
use crate::memory::chunks;
use alloc::vec::Vec;

/// Largest number of voxels sampled in search of fill values.
const SAMPLE: usize = 4096;

/// Smallest share of the sampled voxels that must have a value for it to count as a fill value.
const MIN_SHARE: f32 = 1.0 / 1024.0;

/// Smallest distance of a fill value from the nearest other value, as a fraction of the width of the range of
/// all other values.
const MIN_GAP: f32 = 1.0 / 8.0;

/// Smallest number of distinct values in the sample besides the fill value. With fewer, the values may be
/// labels, and the gaps between labels are not signs of a fill value.
const MIN_OTHER_VALUES: usize = 16;

/// Largest number of fill values that are searched for.
const MAX_FILL_VALUES: usize = 4;

impl VolumeView<'_> {
    /// Fill values: values of voxels without data, such as -9999, 9.97e36, or the padding of a CT scan. The
    /// default range excludes fill values; unsigned bytes have none.
    ///
    /// At most 4 fill values are found, one after another. Each is the minimum or the maximum of the values
    /// that remain. At least four sampled voxels, and at least one in 1024, have it. Its distance from all
    /// other remaining values is at least an eighth of the width of the range of these other values. At least
    /// 16 distinct values must be left in the sample without it.
    ///
    /// Samples at most 4096 voxels. If the sample suggests a fill value, scans all voxels.
    pub fn fill_values(&self) -> Vec<f32> {
        if matches!(self.scalars(), Scalars::U8(_)) {
            return Vec::new();
        }
        let mut sample = self.sample();
        sample.sort_unstable_by(f32::total_cmp);
        let mut left = &sample[..];
        let mut fill: Vec<f32> = Vec::new();
        while fill.len() < MAX_FILL_VALUES {
            let Some((&low, &high)) = left.first().zip(left.last()) else { break };
            let lows = left.partition_point(|v| *v <= low);
            let highs = left.len() - left.partition_point(|v| *v < high);
            let frequent = |count: usize| count >= 4 && count as f32 >= MIN_SHARE * sample.len() as f32;
            let candidates = [(low, lows, &left[lows..]), (high, highs, &left[..left.len() - highs])];
            // The candidate that lies farther from all other values is taken first, because it widens the
            // range with which the distance of the other candidate is compared.
            let far = |rest: &[f32], value: f32| {
                let (Some(&least), Some(&most)) = (rest.first(), rest.last()) else { return None };
                let gap = if value < least { half(least) - half(value) } else { half(value) - half(most) };
                let width = half(most) - half(least);
                (gap >= MIN_GAP * width).then_some(gap / width)
            };
            let found = candidates
                .into_iter()
                .filter(|(_, count, rest)| frequent(*count) && many(rest))
                .filter_map(|(value, _, rest)| Some((far(rest, value)?, value, rest)))
                .max_by(|a, b| a.0.total_cmp(&b.0));
            let Some((_, value, rest)) = found else { break };
            // The sample may have missed values inside the gap, so the gap is measured again on all voxels.
            fill.push(value);
            let (least, most) = self.extremes_without(&fill);
            if far(&[least, most], value).is_none() {
                fill.pop();
                break;
            }
            left = rest;
        }
        fill
    }

    /// Returns 0…255 for unsigned bytes, otherwise the finite minimum…maximum without fill values, or 0…1 if
    /// no value remains.
    pub(super) fn default_range(&self) -> (f32, f32) {
        if matches!(self.scalars(), Scalars::U8(_)) {
            return (0.0, 255.0);
        }
        self.range_without(&self.fill_values())
    }

    /// Finite minimum…maximum of the voxels of any type, including fill values; 0…1 if no voxel is finite.
    pub fn own_range(&self) -> (f32, f32) {
        self.range_without(&[])
    }

    /// Number of voxels that are NaN or infinite.
    pub fn non_finite(&self) -> usize {
        let Scalars::F32(values) = self.scalars() else { return 0 };
        let ([nx, ny, nz], stride) = (self.dims, self.strides[0]);
        let row = |(z, y)| {
            let at = self.index(0, y, z);
            if stride == 1 {
                values[at..at + nx].iter().filter(|v| !v.is_finite()).count()
            } else {
                (0..nx).filter(|x| !values[at + x * stride].is_finite()).count()
            }
        };
        (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))).map(row).sum()
    }

    fn range_without(&self, fill: &[f32]) -> (f32, f32) {
        let (lo, hi) = self.extremes_without(fill);
        if lo <= hi { (lo, hi) } else { (0.0, 1.0) }
    }

    /// Finite values of voxels spread over the volume.
    fn sample(&self) -> Vec<f32> {
        let [nx, ny, nz] = self.dims;
        let voxels = nx * ny * nz;
        let at = |i: usize| {
            // Multiples of the golden ratio sample rows, slices and columns evenly.
            let i = if voxels <= SAMPLE {
                i
            } else {
                let turn = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
                ((u128::from(turn) * voxels as u128) >> 64) as usize
            };
            self.value(i % nx, i / nx % ny, i / (nx * ny))
        };
        (0..voxels.min(SAMPLE)).map(at).filter(|v| v.is_finite()).collect()
    }

    /// Minimum and maximum of the finite values that are not in `fill`; minimum > maximum if there is no such
    /// value.
    fn extremes_without(&self, fill: &[f32]) -> (f32, f32) {
        match self.scalars() {
            Scalars::U8(values) => self.extremes(values, f32::from, fill),
            Scalars::U16(values) => self.extremes(values, f32::from, fill),
            Scalars::I16(values) => self.extremes(values, f32::from, fill),
            Scalars::F32(values) => self.extremes(values, |v| v, fill),
        }
    }

    fn extremes<T: bytemuck::Pod>(
        &self,
        values: &[T],
        number: impl Fn(T) -> f32,
        fill: &[f32],
    ) -> (f32, f32) {
        /// Number of minima, and of maxima, that are computed independently, so that compilers vectorize the
        /// loop.
        const LANES: usize = 32;
        let mut lanes = ([f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES]);
        // Unused elements are NaN, which equals no value.
        let mut left_out = [f32::NAN; MAX_FILL_VALUES];
        left_out.iter_mut().zip(fill).for_each(|(slot, &v)| *slot = v);
        let mut take = |values: &[T]| {
            for ((lo, hi), &v) in lanes.0.iter_mut().zip(&mut lanes.1).zip(values) {
                let v = number(v);
                let v = if v.is_finite() & left_out.iter().all(|f| v != *f) { v } else { f32::NAN };
                *lo = if v < *lo { v } else { *lo };
                *hi = if v > *hi { v } else { *hi };
            }
        };
        let ([nx, ny, nz], stride) = (self.dims, self.strides[0]);
        for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
            let at = self.index(0, y, z);
            if stride == 1 {
                let (chunks, rest) = chunks::<LANES, _>(&values[at..at + nx]);
                chunks.iter().for_each(|chunk| take(chunk));
                take(rest);
            } else {
                (0..nx).for_each(|x| take(&values[at + x * stride..][..1]));
            }
        }
        let lo = lanes.0.into_iter().fold(f32::INFINITY, f32::min);
        (lo, lanes.1.into_iter().fold(f32::NEG_INFINITY, f32::max))
    }
}

/// Half of a value, so that differences of the largest floats stay finite.
fn half(value: f32) -> f32 {
    0.5 * value
}

/// True if `sorted` has at least [`MIN_OTHER_VALUES`] distinct values.
fn many(sorted: &[f32]) -> bool {
    let changes = sorted.windows(2).filter(|pair| pair[0] < pair[1]).take(MIN_OTHER_VALUES - 1).count();
    changes == MIN_OTHER_VALUES - 1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fill_of(values: &[f32]) -> (Vec<f32>, (f32, f32)) {
        let view = VolumeView::new(Scalars::F32(values), [values.len(), 1, 1]).unwrap();
        (view.fill_values(), view.range())
    }

    /// Values from 0 to 1, and `count` copies of `fill`.
    fn data(count: usize, fill: f32) -> Vec<f32> {
        let mut values: Vec<f32> = (0..=1000).map(|i| i as f32 / 1000.0).collect();
        values.extend(core::iter::repeat_n(fill, count));
        values
    }

    #[test]
    fn fill_values_are_frequent_far_and_alone() {
        for fill in [-9999.0, 1e20, 9.969_21e36, -f32::MAX, f32::MAX, -1.0, 1.126] {
            assert_eq!(fill_of(&data(50, fill)), (alloc::vec![fill], (0.0, 1.0)), "{fill}");
        }
        // No fill values: 1.12 lies too near, three copies are too rare, and -10 in `trail` has near values.
        assert_eq!(fill_of(&data(50, 1.12)), (Vec::new(), (0.0, 1.12)));
        assert_eq!(fill_of(&data(3, -9999.0)).1, (-9999.0, 1.0));
        let mut trail = data(50, -10.0);
        trail.extend([-9.9, -5.0, -0.1]);
        assert_eq!(fill_of(&trail), (Vec::new(), (-10.0, 1.0)));
        // This data has two fill values at the lower end and one at the upper end.
        let mut both = data(50, -9999.0);
        both.extend(core::iter::repeat_n(1e20, 40));
        both.extend(core::iter::repeat_n(-999.0, 30));
        let (mut fill, range) = fill_of(&both);
        fill.sort_unstable_by(f32::total_cmp);
        assert_eq!((fill, range), (alloc::vec![-9999.0, -999.0, 1e20], (0.0, 1.0)));
    }

    #[test]
    fn labels_and_constant_volumes_have_no_fill_values() {
        let labels: Vec<f32> = (0..900).map(|i| (i % 9) as f32).collect();
        assert_eq!(fill_of(&labels), (Vec::new(), (0.0, 8.0)));
        assert_eq!(fill_of(&[5.0; 64]), (Vec::new(), (5.0, 5.0)));
        assert_eq!(fill_of(&[f32::NAN; 64]), (Vec::new(), (0.0, 1.0)));
        let bytes: Vec<u8> = (0..200).map(|i| if i < 100 { 255 } else { i as u8 % 50 }).collect();
        let view = VolumeView::new(Scalars::U8(&bytes), [200, 1, 1]).unwrap();
        assert_eq!(
            (view.fill_values(), view.range(), view.own_range()),
            (Vec::new(), (0.0, 255.0), (0.0, 255.0))
        );
    }

    #[test]
    fn rare_values_between_are_found_in_large_volumes() {
        let mut values: Vec<i16> = (0..64i32 * 64 * 64).map(|i| (i % 4000 - 1000) as i16).collect();
        values.iter_mut().step_by(3).for_each(|v| *v = -3024);
        let dims = [64; 3];
        let view = VolumeView::new(Scalars::I16(&values), dims).unwrap();
        assert_eq!((view.fill_values(), view.range()), (alloc::vec![-3024.0], (-1000.0, 2999.0)));
        values[77] = -3000;
        let view = VolumeView::new(Scalars::I16(&values), dims).unwrap();
        assert_eq!((view.fill_values(), view.range()), (Vec::new(), (-3024.0, 2999.0)));
    }
}
