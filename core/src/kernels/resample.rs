//! Inner loops of resampling: weighted sums of rows, then along the row. One source for every level; the order of
//! operations is the same in each and products are never fused into sums, so every level gives the same bits.

use crate::kernels::simd::{Kernel, Simd};
use crate::kernels::{Isa, Level};
use bytemuck::Pod;

/// The input voxels that one output voxel averages along one axis: `first … first + count`, with one weight for the
/// first, one for the last, and one for all between. A single voxel has weight `head`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Span {
    pub(crate) first: usize,
    pub(crate) count: usize,
    pub(crate) head: f32,
    pub(crate) middle: f32,
    pub(crate) tail: f32,
}

impl Span {
    /// The voxels and weights of output `i` when `m` voxels become `n`; weights come from exact integers.
    pub(crate) fn of(i: usize, m: usize, n: usize) -> Self {
        let (i, m, n) = (i as u64, m as u64, n as u64);
        let ratio = |a: u64, b: u64| (a as f64 / b as f64) as f32;
        if m == n {
            return Self::single(i as usize);
        }
        if m > n {
            // In units of 1/n voxel: the output covers [i·m, (i+1)·m), voxel j covers [j·n, (j+1)·n).
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
        // In units of 1/(2n) voxel: the center of the output, from the center of the first voxel.
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

/// A voxel type that rows are made of.
pub(crate) trait Scalar: Pod + Send + Sync {
    /// The stored value.
    fn to_f32(self) -> f32;

    /// The stored values of two neighbours.
    #[inline(always)]
    fn pair(pair: [Self; 2]) -> [f32; 2] {
        [pair[0].to_f32(), pair[1].to_f32()]
    }
}

impl Scalar for u8 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        f32::from(self)
    }

    /// Split by a mask and a shift of one word: compilers turn shuffles of single bytes into far more instructions.
    #[inline(always)]
    fn pair(pair: [Self; 2]) -> [f32; 2] {
        let word = i32::from(u16::from_le_bytes(pair));
        [(word & 0xff) as f32, (word >> 8) as f32]
    }
}

impl Scalar for u16 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        f32::from(self)
    }
}

impl Scalar for i16 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        f32::from(self)
    }
}

impl Scalar for f32 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self
    }
}

/// What is done to a voxel before it is averaged.
pub(crate) trait Map<T: Scalar>: Copy + Send + Sync {
    /// From a stored value to the one that enters the average.
    fn value(&self, stored: f32) -> f32;

    /// As [`Map::value`], from the voxel.
    #[inline(always)]
    fn map(&self, voxel: T) -> f32 {
        self.value(voxel.to_f32())
    }
}

/// The stored value itself.
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
    /// The map of a range, where the range has a width whose reciprocal is a normal number.
    pub(crate) fn of((low, high): (f32, f32)) -> Option<Self> {
        let (width, scale) = (high - low, 1.0 / (high - low));
        (width > 0.0 && width.is_finite() && scale.is_normal()).then_some(Self { low, scale })
    }
}

impl<T: Scalar> Map<T> for Affine {
    #[inline(always)]
    fn value(&self, stored: f32) -> f32 {
        let t = (stored - self.low) * self.scale;
        // Comparisons, not max and min: NaN fails the first one and becomes 0.
        let t = if t > 0.0 { t } else { 0.0 };
        if t < 1.0 { t } else { 1.0 }
    }
}

/// What is done to an average: `v·scale + offset`, then clamped to [0, 1].
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

/// Sizes of one call.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Geometry<'a> {
    /// Input voxels along x, y, z.
    pub(crate) dims: [usize; 3],
    /// Elements between neighbours along x, y, z.
    pub(crate) strides: [usize; 3],
    /// Output voxels per axis.
    pub(crate) n: usize,
    /// One span per output column.
    pub(crate) columns: &'a [Span],
    /// Which instructions to use.
    pub(crate) level: Level,
}

/// Floats of scratch that one thread needs: a row sum, a second one for long sums, rows of voxels, and two rows for the
/// spread.
pub(crate) fn scratch_len(row: usize, n: usize) -> usize {
    (2 + ROWS) * row + 2 * n
}

/// Rows that are added to a sum at once.
const ROWS: usize = 4;

/// Rows summed straight into one row of floats; longer sums go through a second one, which keeps rounding errors
/// from piling up.
const DIRECT_ROWS: usize = 64;

/// Rows of bytes whose sum fits 16 bits.
const BYTE_ROWS: usize = 65535 / 255;

/// Whether every axis is an integer multiple of `n` and the sums of bytes fit.
pub(crate) fn integer_ratio(dims: &[usize; 3], n: usize) -> bool {
    dims.iter().all(|&d| d % n == 0)
        && (dims[1] / n).saturating_mul(dims[2] / n) <= BYTE_ROWS
        // Exact in a float's 24 bits.
        && dims.iter().map(|&d| d / n).fold(1usize, usize::saturating_mul) <= (1 << 24) / 255
}

/// The span of plane `z` of the reduced planes: the output's planes, or the input's where z grows.
#[inline(always)]
fn reduced_span(i: usize, m: usize, n: usize) -> Span {
    if m < n { Span::single(i) } else { Span::of(i, m, n) }
}

/// Fills reduced planes `z0 …`: averages of bytes at integer ratios, with integer sums. The result is
/// `sum·scale / voxels + offset`, clamped to [0, 1].
pub(crate) fn bytes(
    g: &Geometry<'_>,
    src: &[u8],
    scale: f64,
    offset: f64,
    z0: usize,
    planes: &mut [f32],
    scratch: &mut [f32],
) {
    let voxels: usize = g.dims.iter().map(|&d| d / g.n).product();
    let after = After { scale: (scale / voxels as f64) as f32, offset: offset as f32 };
    struct Body<'a>(&'a Geometry<'a>, &'a [u8], After, usize, &'a mut [f32], &'a mut [f32]);
    impl Kernel for Body<'_> {
        type Output = ();

        #[inline(always)]
        fn run<S: Simd>(self, _: S) {
            bytes_body(self.0, self.1, self.2, self.3, self.4, self.5);
        }
    }
    if g.dims[0] == 4 * g.n && g.strides[0] == 1 && g.level.isa() != Isa::Scalar {
        g.level.run_dot4(Quads { g, src, after, z0, planes });
    } else {
        g.level.run(Body(g, src, after, z0, planes, scratch));
    }
}

/// As [`bytes`] for contiguous rows that shrink to a quarter: sums of four neighbours are dot products with ones, and no
/// sum leaves its register before all rows are in.
struct Quads<'a> {
    g: &'a Geometry<'a>,
    src: &'a [u8],
    after: After,
    z0: usize,
    planes: &'a mut [f32],
}

impl Kernel for Quads<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { g, src, after, z0, planes } = self;
        let n = g.n;
        let [_, ry, rz] = g.dims.map(|d| d / n);
        for (dz, plane) in planes.chunks_exact_mut(n * n).enumerate() {
            for (y, out) in plane.chunks_exact_mut(n).enumerate() {
                let rows = QuadRows { src, g, z: (z0 + dz) * rz, rz, y: y * ry, ry };
                let mut x = 0;
                while n - x >= 8 * S::LANES {
                    rows.eight(simd, x, &mut out[x..x + 8 * S::LANES]);
                    x += 8 * S::LANES;
                }
                while n - x >= S::LANES {
                    rows.one(simd, x, &mut out[x..x + S::LANES]);
                    x += S::LANES;
                }
                for (x, o) in out.iter_mut().enumerate().skip(x) {
                    let sum: u32 = rows
                        .each()
                        .map(|row| row[4 * x..4 * x + 4].iter().map(|&v| u32::from(v)).sum::<u32>())
                        .sum();
                    *o = sum as f32;
                }
                for o in out {
                    *o = after.apply(*o);
                }
            }
        }
    }
}

/// The rows that one output row averages.
struct QuadRows<'a> {
    src: &'a [u8],
    g: &'a Geometry<'a>,
    z: usize,
    rz: usize,
    y: usize,
    ry: usize,
}

impl QuadRows<'_> {
    #[inline(always)]
    fn each(&self) -> impl Iterator<Item = &[u8]> {
        (self.z..self.z + self.rz).flat_map(move |z| {
            (self.y..self.y + self.ry).map(move |y| {
                let at = z * self.g.strides[2] + y * self.g.strides[1];
                &self.src[at..at + self.g.dims[0]]
            })
        })
    }

    /// Sums of eight vectors of outputs.
    #[inline(always)]
    fn eight<S: Simd>(&self, simd: S, x: usize, out: &mut [f32]) {
        let ones = simd.splat_bytes(0x0101_0101);
        let zero = simd.zero_i();
        let (mut s0, mut s1, mut s2, mut s3) = (zero, zero, zero, zero);
        let (mut s4, mut s5, mut s6, mut s7) = (zero, zero, zero, zero);
        for z in self.z..self.z + self.rz {
            for y in self.y..self.y + self.ry {
                let at = z * self.g.strides[2] + y * self.g.strides[1] + 4 * x;
                let row = &self.src[at..at + 32 * S::LANES];
                // Each plane is a stream of its own that stops after these rows: ask for its next ones early.
                prefetch(self.src, at + self.ry * self.g.strides[1], 32 * S::LANES);
                macro_rules! add {
                    ($($sum:ident $i:literal),*) => {$(
                        // SAFETY: the row's slice has eight vectors of bytes.
                        let bytes = unsafe { simd.load_bytes(row.as_ptr().add($i * 4 * S::LANES).cast()) };
                        $sum = simd.dot4($sum, bytes, ones);
                    )*};
                }
                add!(s0 0, s1 1, s2 2, s3 3, s4 4, s5 5, s6 6, s7 7);
            }
        }
        for (sum, out) in [s0, s1, s2, s3, s4, s5, s6, s7].into_iter().zip(out.chunks_exact_mut(S::LANES)) {
            // SAFETY: the chunk has a vector's length.
            unsafe { simd.store(out.as_mut_ptr(), simd.to_f(sum)) };
        }
    }

    /// Sums of one vector of outputs.
    #[inline(always)]
    fn one<S: Simd>(&self, simd: S, x: usize, out: &mut [f32]) {
        let ones = simd.splat_bytes(0x0101_0101);
        let mut sum = simd.zero_i();
        for row in self.each() {
            let bytes = &row[4 * x..4 * (x + S::LANES)];
            // SAFETY: the slice has a vector of bytes.
            sum = simd.dot4(sum, unsafe { simd.load_bytes(bytes.as_ptr().cast()) }, ones);
        }
        let out = &mut out[..S::LANES];
        // SAFETY: the slice has a vector's length.
        unsafe { simd.store(out.as_mut_ptr(), simd.to_f(sum)) };
    }
}

#[inline(always)]
fn bytes_body(
    g: &Geometry<'_>,
    src: &[u8],
    after: After,
    z0: usize,
    planes: &mut [f32],
    scratch: &mut [f32],
) {
    let n = g.n;
    let [rx, ry, rz] = g.dims.map(|d| d / n);
    let sums: &mut [u16] = &mut bytemuck::cast_slice_mut(scratch)[..g.dims[0]];
    for (dz, plane) in planes.chunks_exact_mut(n * n).enumerate() {
        for (y, out) in plane.chunks_exact_mut(n).enumerate() {
            let mut first = true;
            for z in (z0 + dz) * rz..(z0 + dz + 1) * rz {
                let mut row = y * ry;
                let end = row + ry;
                // Each plane is a stream of its own that stops after these rows: ask for its next ones early.
                for next in end..end + ry {
                    prefetch(src, z * g.strides[2] + next * g.strides[1], g.dims[0]);
                }
                let at = |row: usize| z * g.strides[2] + row * g.strides[1];
                if g.strides[0] != 1 {
                    for row in row..end {
                        add_bytes_strided(sums, &src[at(row)..], g.strides[0], first);
                        first = false;
                    }
                    continue;
                }
                while end - row >= 4 {
                    let rows = [at(row), at(row + 1), at(row + 2), at(row + 3)];
                    add_bytes(sums, rows.map(|o| &src[o..o + g.dims[0]]), first);
                    first = false;
                    row += 4;
                }
                while row < end {
                    add_bytes(sums, [&src[at(row)..at(row) + g.dims[0]]], first);
                    first = false;
                    row += 1;
                }
            }
            match rx {
                1 => fold_sums::<1>(sums, out, after),
                2 => fold_sums::<2>(sums, out, after),
                3 => fold_sums::<3>(sums, out, after),
                4 => fold_sums::<4>(sums, out, after),
                8 => fold_sums::<8>(sums, out, after),
                _ => {
                    for (o, s) in out.iter_mut().zip(sums.chunks_exact(rx)) {
                        *o = after.apply(s.iter().map(|&v| u32::from(v)).sum::<u32>() as f32);
                    }
                }
            }
        }
    }
}

/// Asks for a row's cache lines; a row beyond the end is ignored.
#[inline(always)]
fn prefetch(src: &[u8], at: usize, len: usize) {
    let Some(row) = src.get(at..at.saturating_add(len)) else { return };
    for line in row.chunks(64) {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: SSE is part of x86-64; a prefetch reads nothing.
        unsafe {
            core::arch::x86_64::_mm_prefetch::<{ core::arch::x86_64::_MM_HINT_T0 }>(line.as_ptr().cast());
        }
        #[cfg(not(target_arch = "x86_64"))]
        let _ = line;
    }
}

#[inline(always)]
fn add_bytes<const R: usize>(sums: &mut [u16], rows: [&[u8]; R], first: bool) {
    let n = sums.len();
    let rows = rows.map(|r| &r[..n]);
    if first {
        for (x, sum) in sums.iter_mut().enumerate() {
            let mut s = u16::from(rows[0][x]);
            for row in &rows[1..] {
                s += u16::from(row[x]);
            }
            *sum = s;
        }
    } else {
        for (x, sum) in sums.iter_mut().enumerate() {
            let mut s = u16::from(rows[0][x]);
            for row in &rows[1..] {
                s += u16::from(row[x]);
            }
            *sum += s;
        }
    }
}

#[inline(always)]
fn add_bytes_strided(sums: &mut [u16], src: &[u8], stride: usize, first: bool) {
    for (x, sum) in sums.iter_mut().enumerate() {
        let v = u16::from(src[x * stride]);
        *sum = if first { v } else { *sum + v };
    }
}

#[inline(always)]
fn fold_sums<const R: usize>(sums: &[u16], out: &mut [f32], after: After) {
    let (sums, _) = sums.as_chunks::<R>();
    for (o, s) in out.iter_mut().zip(sums) {
        let mut t = 0u32;
        for &v in s {
            t += u32::from(v);
        }
        *o = after.apply(t as f32);
    }
}

/// Writes a row's voxels, as they enter the average: of the row that starts at a given element.
pub(crate) type Fetch<'a> = dyn Fn(usize, &mut [f32]) + Sync + 'a;

/// Copies a row of mapped voxels that start at `src[at]` and follow at `stride`.
pub(crate) fn fetch<T: Scalar, M: Map<T>>(
    level: Level,
    src: &[T],
    map: M,
    at: usize,
    stride: usize,
    out: &mut [f32],
) {
    struct Body<'a, T, M>(&'a [T], M, usize, &'a mut [f32]);
    impl<T: Scalar, M: Map<T>> Kernel for Body<'_, T, M> {
        type Output = ();

        #[inline(always)]
        fn run<S: Simd>(self, _: S) {
            let Body(src, map, stride, out) = self;
            if stride == 1 {
                for (o, &v) in out.iter_mut().zip(src) {
                    *o = map.map(v);
                }
            } else {
                for (x, o) in out.iter_mut().enumerate() {
                    *o = map.map(src[x * stride]);
                }
            }
        }
    }
    level.run(Body(&src[at..], map, stride, out));
}

/// Fills reduced planes `z0 …` of any volume: rows are fetched and summed with their weights, then along x.
///
/// One body for all voxel types and maps: only fetching knows them.
pub(crate) fn planes(
    g: &Geometry<'_>,
    fetch: &Fetch<'_>,
    after: After,
    z0: usize,
    planes: &mut [f32],
    scratch: &mut [f32],
) {
    struct Body<'a>(&'a Geometry<'a>, &'a Fetch<'a>, After, usize, &'a mut [f32], &'a mut [f32]);
    impl Kernel for Body<'_> {
        type Output = ();

        #[inline(always)]
        fn run<S: Simd>(self, _: S) {
            planes_body(self.0, self.1, self.2, self.3, self.4, self.5);
        }
    }
    g.level.run(Body(g, fetch, after, z0, planes, scratch));
}

#[inline(always)]
fn planes_body(
    g: &Geometry<'_>,
    fetch: &Fetch<'_>,
    after: After,
    z0: usize,
    planes: &mut [f32],
    scratch: &mut [f32],
) {
    let n = g.n;
    let (sum, rest) = scratch.split_at_mut(g.dims[0]);
    let (long, rest) = rest.split_at_mut(g.dims[0]);
    let (rows, spare) = rest.split_at_mut(ROWS * g.dims[0]);
    let height = g.dims[1].min(n);
    for (dz, plane) in planes.chunks_exact_mut(n * n).enumerate() {
        let zs = reduced_span(z0 + dz, g.dims[2], n);
        // Where y grows, the input's rows go to the last places of the plane.
        for (y, out) in plane[(n - height) * n..].chunks_exact_mut(n).enumerate() {
            let ys = reduced_span(y, g.dims[1], n);
            if ys.count.saturating_mul(zs.count) <= DIRECT_ROWS {
                for z in 0..zs.count {
                    sum_rows(g, fetch, (zs.first + z, zs.weight(z)), &ys, rows, sum, z == 0);
                }
                fold(sum, g.columns, after, out);
            } else {
                for z in 0..zs.count {
                    sum_rows(g, fetch, (zs.first + z, 1.0), &ys, rows, sum, true);
                    let w = zs.weight(z);
                    if z == 0 {
                        for (l, &s) in long.iter_mut().zip(&*sum) {
                            *l = w * s;
                        }
                    } else {
                        for (l, &s) in long.iter_mut().zip(&*sum) {
                            *l += w * s;
                        }
                    }
                }
                fold(long, g.columns, after, out);
            }
        }
        if height < n {
            spread(plane, height, n, n, &mut spare[..2 * n]);
        }
    }
}

/// Adds the rows of one plane to `sum`, weighted by the plane's weight times the row's. `rows` has room for [`ROWS`].
#[inline(always)]
fn sum_rows(
    g: &Geometry<'_>,
    fetch: &Fetch<'_>,
    (z, wz): (usize, f32),
    ys: &Span,
    rows: &mut [f32],
    sum: &mut [f32],
    mut first: bool,
) {
    let len = sum.len();
    let mut row = 0;
    while row < ys.count {
        let count = if ys.count - row >= ROWS { ROWS } else { 1 };
        for r in 0..count {
            let at = z * g.strides[2] + (ys.first + row + r) * g.strides[1];
            fetch(at, &mut rows[r * len..(r + 1) * len]);
        }
        let weight = |r: usize| wz * ys.weight(row + r);
        if count == ROWS {
            let weights = [weight(0), weight(1), weight(2), weight(3)];
            let slice = |r: usize| &rows[r * len..(r + 1) * len];
            add_rows(sum, [slice(0), slice(1), slice(2), slice(3)], weights, first);
        } else {
            add_rows(sum, [&rows[..len]], [weight(0)], first);
        }
        first = false;
        row += count;
    }
}

#[inline(always)]
fn add_rows<const R: usize>(sum: &mut [f32], rows: [&[f32]; R], weights: [f32; R], first: bool) {
    let n = sum.len();
    let rows = rows.map(|r| &r[..n]);
    let at = |x: usize| {
        let mut t = weights[0] * rows[0][x];
        for r in 1..R {
            t += weights[r] * rows[r][x];
        }
        t
    };
    if first {
        for (x, s) in sum.iter_mut().enumerate() {
            *s = at(x);
        }
    } else {
        for (x, s) in sum.iter_mut().enumerate() {
            *s += at(x);
        }
    }
}

/// Averages a row of sums along x.
#[inline(always)]
fn fold(sum: &[f32], columns: &[Span], after: After, out: &mut [f32]) {
    if sum.len() == out.len() {
        for (o, &s) in out.iter_mut().zip(sum) {
            *o = after.apply(s);
        }
        return;
    }
    match sum.len() / out.len() {
        2 if sum.len() == 2 * out.len() => fold_exact::<2>(sum, columns, after, out),
        4 if sum.len() == 4 * out.len() => fold_exact::<4>(sum, columns, after, out),
        _ => {
            for (o, c) in out.iter_mut().zip(columns) {
                let s = &sum[c.first..c.first + c.count];
                let t = if c.count == 1 {
                    s[0]
                } else {
                    let inner = &s[1..c.count - 1];
                    let (quads, rest) = inner.as_chunks::<4>();
                    let mut lanes = [0.0f32; 4];
                    for quad in quads {
                        for (lane, v) in lanes.iter_mut().zip(quad) {
                            *lane += v;
                        }
                    }
                    let mut middle = (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]);
                    for v in rest {
                        middle += v;
                    }
                    c.head * s[0] + c.middle * middle + c.tail * s[c.count - 1]
                };
                *o = after.apply(t);
            }
        }
    }
}

#[inline(always)]
fn fold_exact<const R: usize>(sum: &[f32], columns: &[Span], after: After, out: &mut [f32]) {
    let weight = columns[0].head;
    let (sum, _) = sum.as_chunks::<R>();
    for (o, s) in out.iter_mut().zip(sum) {
        let mut t = s[0];
        for &v in &s[1..] {
            t += v;
        }
        *o = after.apply(weight * t);
    }
}

/// Linear interpolation in place from the last `m` slabs of `data` to all `n` slabs of `slab` values each. `spare` holds
/// two rows of any equal length that divides `slab`.
///
/// Going up, slab `i` is written after everything that reads the source slab in the same place: that source is number
/// `i - (n - m)`, and output `i` reads source `floor((i + ½)·m/n - ½)`, which is never below it.
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
