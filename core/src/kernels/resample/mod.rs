//! Inner loops of resampling: weighted sums over rows, then along the row. The same source is compiled for
//! every level. At every level, the operations run in the same order, and multiplications and additions are
//! never fused. So every level gives the same bits.

mod bytes;
mod planes;

use crate::kernels::Level;
use bytemuck::Pod;
pub(crate) use bytes::{bytes, integer_ratio};
pub(crate) use planes::{Fetch, fetch, planes};

/// Input voxels whose weighted average is one output voxel, along one axis: `count` voxels from `first` on.
/// The first voxel has weight `head`, the last has weight `tail`, and all others have weight `middle`. A
/// single voxel has weight `head`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Span {
    pub(crate) first: usize,
    pub(crate) count: usize,
    pub(crate) head: f32,
    pub(crate) middle: f32,
    pub(crate) tail: f32,
}

impl Span {
    /// Voxels and weights of output `i` when `m` voxels become `n`; weights are quotients of exact integers.
    pub(crate) fn of(i: usize, m: usize, n: usize) -> Self {
        let (i, m, n) = (i as u64, m as u64, n as u64);
        let ratio = |a: u64, b: u64| (a as f64 / b as f64) as f32;
        if m == n {
            return Self::single(i as usize);
        }
        if m > n {
            // In units of 1/n voxel: output i covers [i·m, (i+1)·m), voxel j covers [j·n, (j+1)·n).
            let (low, high) = (i * m, (i + 1) * m);
            let (first, last) = (low / n, (high - 1) / n);
            if first == last {
                return Self::single(first as usize);
            }
            return Self {
                first: first as usize,
                count: (last - first + 1) as usize,
                head: ratio((first + 1) * n - low, m),
                middle: ratio(n, m),
                tail: ratio(high - last * n, m),
            };
        }
        // In units of 1/(2n) voxel: distance from the center of the first voxel to the center of the output.
        let at = ((2 * i + 1) * m).saturating_sub(n);
        let (first, rest) = (at / (2 * n), at % (2 * n));
        if rest == 0 || first + 1 >= m {
            return Self::single(first.min(m - 1) as usize);
        }
        Self {
            first: first as usize,
            count: 2,
            head: ratio(2 * n - rest, 2 * n),
            middle: 0.0,
            tail: ratio(rest, 2 * n),
        }
    }

    pub(crate) const fn single(first: usize) -> Self {
        Self { first, count: 1, head: 1.0, middle: 0.0, tail: 0.0 }
    }

    #[inline(always)]
    fn weight(&self, j: usize) -> f32 {
        if j == 0 {
            self.head
        } else if j + 1 == self.count {
            self.tail
        } else {
            self.middle
        }
    }
}

pub(crate) trait Scalar: Pod + Into<f32> + Send + Sync {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self.into()
    }

    /// The stored values of two neighboring voxels, as f32.
    #[inline(always)]
    fn pair(pair: [Self; 2]) -> [f32; 2] {
        [pair[0].to_f32(), pair[1].to_f32()]
    }
}

impl Scalar for u8 {
    /// Splits one word by a mask and a shift. Without them, compilers shuffle single bytes, which takes far
    /// more instructions.
    #[inline(always)]
    fn pair(pair: [Self; 2]) -> [f32; 2] {
        let word = i32::from(u16::from_le_bytes(pair));
        [(word & 0xff) as f32, (word >> 8) as f32]
    }
}

impl Scalar for u16 {}
impl Scalar for i16 {}
impl Scalar for f32 {}

/// Mapping of a voxel before it is averaged.
pub(crate) trait Map<T: Scalar>: Copy + Send + Sync {
    /// Maps a stored value to the value that enters the average.
    fn value(&self, stored: f32) -> f32;

    /// Returns [`Map::value`] of the voxel's stored value.
    #[inline(always)]
    fn map(&self, voxel: T) -> f32 {
        self.value(voxel.to_f32())
    }
}

/// Map that returns the stored value unchanged.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Raw;

impl<T: Scalar> Map<T> for Raw {
    #[inline(always)]
    fn value(&self, stored: f32) -> f32 {
        stored
    }
}

/// `(v - low)·scale` clamped to [0, 1]; NaN gives 0.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Affine {
    pub(crate) low: f32,
    pub(crate) scale: f32,
}

impl Affine {
    /// Returns the map of a range to [0, 1], or `None` if the reciprocal of the range's width is not a normal
    /// number.
    pub(crate) fn of((low, high): (f32, f32)) -> Option<Self> {
        let (width, scale) = (high - low, 1.0 / (high - low));
        (width > 0.0 && width.is_finite() && scale.is_normal()).then_some(Self { low, scale })
    }
}

impl<T: Scalar> Map<T> for Affine {
    #[inline(always)]
    fn value(&self, stored: f32) -> f32 {
        let t = (stored - self.low) * self.scale;
        // Comparisons are used instead of max and min, because NaN fails the first comparison and so becomes
        // 0.
        let t = if t > 0.0 { t } else { 0.0 };
        if t < 1.0 { t } else { 1.0 }
    }
}

/// Mapping of an average: `v·scale + offset`, then clamped to [0, 1].
#[derive(Clone, Copy, Debug)]
pub(crate) struct After {
    pub(crate) scale: f32,
    pub(crate) offset: f32,
}

impl After {
    #[inline(always)]
    fn apply(&self, v: f32) -> f32 {
        let t = v * self.scale + self.offset;
        let t = if t > 0.0 { t } else { 0.0 };
        if t < 1.0 { t } else { 1.0 }
    }
}

/// Sizes and strides of one resampling call.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Geometry<'a> {
    /// Number of input voxels along x, y and z.
    pub(crate) dims: [usize; 3],
    /// Elements from one voxel to the next along x, y, z.
    pub(crate) strides: [usize; 3],
    /// Number of output voxels per axis.
    pub(crate) n: usize,
    /// One span per output column.
    pub(crate) columns: &'a [Span],
    pub(crate) level: Level,
}

/// Number of floats of scratch per thread: two rows of sums (the second for long sums), [`ROWS`] rows of
/// voxels, and two rows for [`spread`].
pub(crate) fn scratch_len(row: usize, n: usize) -> usize {
    (2 + ROWS) * row + 2 * n
}

/// Number of rows added to a sum at once.
const ROWS: usize = 4;

/// Returns the input planes (or rows) whose average is reduced plane (or row) `i`. A reduced plane is an
/// output plane or, if the input has fewer planes than the output, an input plane.
#[inline(always)]
fn reduced_span(i: usize, m: usize, n: usize) -> Span {
    if m < n { Span::single(i) } else { Span::of(i, m, n) }
}

/// Interpolates linearly, in place, from the last `m` slabs of `data` to all `n` slabs of `slab` values each.
/// `spare` holds two rows of equal length, which divides `slab`.
///
/// Slabs are written in ascending order. Slab `i` overwrites source number `i - (n - m)`, which no later
/// output reads: output `i` reads source `floor((i + ½)·m/n - ½)` and the next one, never a lower one.
pub(crate) fn spread(data: &mut [f32], m: usize, n: usize, slab: usize, spare: &mut [f32]) {
    let row = spare.len() / 2;
    let (low, high) = spare.split_at_mut(row);
    for i in 0..n {
        let span = Span::of(i, m, n);
        let source = (n - m + span.first) * slab;
        for at in (0..slab).step_by(row) {
            low.copy_from_slice(&data[source + at..source + at + row]);
            if span.count == 1 {
                data[i * slab + at..i * slab + at + row].copy_from_slice(low);
                continue;
            }
            high.copy_from_slice(&data[source + slab + at..source + slab + at + row]);
            let out = &mut data[i * slab + at..i * slab + at + row];
            for ((o, &a), &b) in out.iter_mut().zip(&*low).zip(&*high) {
                *o = span.head * a + span.tail * b;
            }
        }
    }
}
