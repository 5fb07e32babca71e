//! Averages of bytes at integer ratios: integer sums over rows, then over neighbors along the row.

use super::{After, Geometry};
use crate::kernels::level::Isa;
use crate::kernels::simd::{Kernel, Simd};
use crate::memory::chunks;

/// Largest number of rows of bytes whose sum fits 16 bits.
const BYTE_ROWS: usize = 65535 / 255;

/// True if the length of every axis is an integer multiple of `n` and the sums of bytes fit their types.
pub(crate) fn integer_ratio(dims: &[usize; 3], n: usize) -> bool {
    dims.iter().all(|&d| d % n == 0)
        && (dims[1] / n).saturating_mul(dims[2] / n) <= BYTE_ROWS
        // Sums stay exact in the 24 bits of a float's significand.
        && dims.iter().map(|&d| d / n).fold(1usize, usize::saturating_mul) <= (1 << 24) / 255
}

/// Fills reduced planes, starting at plane `z0`, with averages of bytes at integer ratios. The result is
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
    if g.dims[0] == 4 * g.n && g.strides[0] == 1 && g.level.isa != Isa::Scalar {
        g.level.run_dot4(Quads { g, src, after, z0, planes });
    } else {
        g.level.run(Body(g, src, after, z0, planes, scratch));
    }
}

/// Kernel of [`bytes`] for contiguous rows whose length shrinks to a quarter. Sums of four neighbors are dot
/// products with ones, and every sum stays in its register until all rows are added.
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

/// Input rows whose average is one output row.
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

    /// Computes eight vectors of outputs, as sums of their input bytes.
    #[inline(always)]
    fn eight<S: Simd>(&self, simd: S, x: usize, out: &mut [f32]) {
        let ones = simd.splat_i(0x0101_0101);
        let zero = simd.splat_i(0);
        let (mut s0, mut s1, mut s2, mut s3) = (zero, zero, zero, zero);
        let (mut s4, mut s5, mut s6, mut s7) = (zero, zero, zero, zero);
        for z in self.z..self.z + self.rz {
            for y in self.y..self.y + self.ry {
                let at = z * self.g.strides[2] + y * self.g.strides[1] + 4 * x;
                let row = &self.src[at..at + 32 * S::LANES];
                // In each plane, the present output row reads only these rows. The plane's next rows, which
                // the next output row reads, are prefetched.
                prefetch(self.src, at + self.ry * self.g.strides[1], 32 * S::LANES);
                macro_rules! add {
                    ($($sum:ident $i:literal),*) => {$(
                        // SAFETY: `row` has 32·`LANES` bytes, which are eight vectors, and this is one of
                        // them.
                        let bytes = unsafe { simd.load_bytes(row.as_ptr().add($i * 4 * S::LANES).cast()) };
                        $sum = simd.dot4($sum, bytes, ones);
                    )*};
                }
                add!(s0 0, s1 1, s2 2, s3 3, s4 4, s5 5, s6 6, s7 7);
            }
        }
        for (sum, out) in [s0, s1, s2, s3, s4, s5, s6, s7].into_iter().zip(out.chunks_exact_mut(S::LANES)) {
            // SAFETY: the chunk has the `LANES` floats that are written.
            unsafe { simd.store(out.as_mut_ptr(), simd.to_f(sum)) };
        }
    }

    /// Computes one vector of outputs, as sums of their input bytes.
    #[inline(always)]
    fn one<S: Simd>(&self, simd: S, x: usize, out: &mut [f32]) {
        let ones = simd.splat_i(0x0101_0101);
        let mut sum = simd.splat_i(0);
        for row in self.each() {
            let bytes = &row[4 * x..4 * (x + S::LANES)];
            // SAFETY: `bytes` has the 4·`LANES` bytes that are read.
            sum = simd.dot4(sum, unsafe { simd.load_bytes(bytes.as_ptr().cast()) }, ones);
        }
        let out = &mut out[..S::LANES];
        // SAFETY: `out` has the `LANES` floats that are written.
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
                // In each plane, the present output row reads only these rows. The plane's next rows, which
                // the next output row reads, are prefetched.
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

/// Prefetches a row's cache lines; does nothing if the row ends beyond `src`.
#[inline(always)]
fn prefetch(src: &[u8], at: usize, len: usize) {
    let Some(row) = src.get(at..at.saturating_add(len)) else { return };
    for line in row.chunks(64) {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: SSE is part of x86-64, and a prefetch returns no data and never faults.
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
    let (sums, _) = chunks::<R, _>(sums);
    for (o, s) in out.iter_mut().zip(sums) {
        let mut t = 0u32;
        for &v in s {
            t += u32::from(v);
        }
        *o = after.apply(t as f32);
    }
}
