//! Averages of voxels of any type, at any ratio of sizes: weighted sums over rows, then along the row.

use super::{After, Geometry, Map, ROWS, Scalar, Span, reduced_span, spread};
use crate::kernels::Level;
use crate::kernels::simd::{Kernel, Simd};
use crate::memory::chunks;

/// Largest number of rows summed directly into one row of floats; longer sums use a second row, which bounds
/// the accumulated rounding error.
const DIRECT_ROWS: usize = 64;

/// Function that writes a row of mapped voxels; arguments: index of the row's first element, output.
pub(crate) type Fetch<'a> = dyn Fn(usize, &mut [f32]) + Sync + 'a;

/// Maps a row of voxels, from `src[at]` on and `stride` elements apart, to `out`.
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

/// Fills reduced planes of any volume, starting at plane `z0`: fetches rows, adds them with their weights,
/// then averages along x.
///
/// The code is the same for all voxel types and maps; only `fetch` depends on them.
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
        // If the output has more rows than the input, the input's rows are stored in the plane's last rows.
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

/// Adds the rows of one plane to `sum`, or sets `sum` to their sum if `first` is true. A row's weight is
/// multiplied by the plane's weight. `rows` is scratch for [`ROWS`] rows.
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
                    let (quads, rest) = chunks::<4, _>(inner);
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
    let (sum, _) = chunks::<R, _>(sum);
    for (o, s) in out.iter_mut().zip(sum) {
        let mut t = s[0];
        for &v in &s[1..] {
            t += v;
        }
        *o = after.apply(weight * t);
    }
}
