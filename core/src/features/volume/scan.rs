//! The scan of a volume: bounds of blocks, quantiles of cells and the histogram, in one pass over the rows.

use super::{LARGEST_INDEX, QUANTILES, VolumeSummary};
use crate::scene::{ScalarType, VolumeView};
use alloc::vec;
use alloc::vec::Vec;

impl VolumeSummary {
    /// As [`scan`](Self::scan) for numbers that are mapped first. `read((start, stride), out)` copies a row's
    /// values.
    pub(super) fn scan_numbers(
        &mut self,
        volume: &VolumeView<'_>,
        read: impl Fn((usize, usize), &mut [f32]),
    ) {
        let mut row = vec![0.0f32; self.dims[0]];
        let same: [u8; 256] = core::array::from_fn(|v| v as u8);
        let (mut smallest, mut largest) = (f32::INFINITY, f32::NEG_INFINITY);
        self.scan(volume, &Entries { low: same, high: same, near: same }, |at, out| {
            read(at, &mut row);
            let non_finite = row.iter().map(|v| u32::from(!v.is_finite())).sum();
            for &v in &row {
                smallest = smallest.min(v);
                largest = largest.max(v);
            }
            to_positions(volume, &mut row);
            entries(&row, out);
            non_finite
        });
        self.remapped =
            self.scalar_type == ScalarType::F32 || smallest != 0.0 || largest > f32::from(LARGEST_INDEX);
    }

    /// Reads every voxel once. `fetch((start, stride), [low, high, near])` writes three bytes per voxel of a
    /// row, from which `map` leads to table entries without changing their order, and says how many of them
    /// are not finite. Gives how often each byte was written as `near`.
    ///
    /// A row enters the bounds of the blocks that it lies in and, where it is a block's first along y or z,
    /// those of the blocks before. Rows are joined voxel by voxel and reduced along x once per block.
    pub(super) fn scan(
        &mut self,
        volume: &VolumeView<'_>,
        map: &Entries,
        mut fetch: impl FnMut((usize, usize), [&mut [u8]; 3]) -> u32,
    ) -> [u64; 256] {
        let (dims, edge, cells, block) = (self.dims, self.edge, self.cells, self.block);
        let n: [usize; 3] = core::array::from_fn(|a| dims[a].div_ceil(block[a]));
        let mut bounds = vec![[255u8, 0u8]; n[0] * n[1] * n[2]];
        let [mut low, mut high] = [vec![0u8; dims[0]], vec![0u8; dims[0]]];
        // Own rows of one block row, and those that the blocks before it along y, z and both see of it.
        let mut joined: [Joined; 4] = core::array::from_fn(|_| Joined::new(dims[0]));
        // The rows of one row of cells.
        let mut near = vec![0u8; edge[2].min(dims[2]) * edge[1].min(dims[1]) * dims[0]];
        let mut counts = [[0u32; 256]; 4];
        let mut total = [0u64; 256];
        let mut non_finite = 0u64;
        let span = |i: usize, size: usize, axis: usize| i * size..((i + 1) * size).min(dims[axis]);
        for (cz, cy) in (0..cells[2]).flat_map(|z| (0..cells[1]).map(move |y| (z, y))) {
            let (zs, ys) = (span(cz, edge[2], 2), span(cy, edge[1], 1));
            for bz in zs.start / block[2]..zs.end.div_ceil(block[2]) {
                for by in ys.start / block[1]..ys.end.div_ceil(block[1]) {
                    joined.iter_mut().for_each(Joined::clear);
                    for z in span(bz, block[2], 2) {
                        for y in span(by, block[1], 1) {
                            let row = ((z - zs.start) * ys.len() + y - ys.start) * dims[0];
                            let near = &mut near[row..row + dims[0]];
                            let at = (volume.index(0, y, z), volume.strides()[0]);
                            non_finite += u64::from(fetch(at, [&mut low, &mut high, near]));
                            let (first_y, first_z) = (y == by * block[1], z == bz * block[2]);
                            for (j, takes) in
                                joined.iter_mut().zip([true, first_y, first_z, first_y && first_z])
                            {
                                if takes {
                                    j.add(&low, &high);
                                }
                            }
                        }
                    }
                    for (j, back) in joined.iter().zip([[0, 0], [1, 0], [0, 1], [1, 1]]) {
                        if by >= back[0] && bz >= back[1] {
                            let line = n[0] * (by - back[0] + n[1] * (bz - back[1]));
                            j.reduce(block[0], &mut bounds[line..][..n[0]]);
                        }
                    }
                }
            }
            let rows = &near[..zs.len() * ys.len() * dims[0]];
            for cx in 0..cells[0] {
                counts.iter_mut().for_each(|c| c.fill(0));
                for row in rows.chunks_exact(dims[0]) {
                    count_entries(&row[span(cx, edge[0], 0)], &mut counts);
                }
                let [a, b, c, d] = &counts;
                let histogram: [u64; 256] =
                    core::array::from_fn(|i| [a, b, c, d].iter().map(|c| u64::from(c[i])).sum());
                total.iter_mut().zip(&histogram).for_each(|(t, &h)| *t += h);
                self.quantiles[cx + cells[0] * (cy + cells[1] * cz)] =
                    quantiles(&histogram).map(|q| map.near[usize::from(q)]);
            }
        }
        for b in &mut bounds {
            *b = [map.low[usize::from(b[0])], map.high[usize::from(b[1])]];
        }
        self.gather_blocks(&bounds, n);
        let mut mapped = [0u64; 256];
        for (&entry, &t) in map.near.iter().zip(&total) {
            mapped[usize::from(entry)] += t;
        }
        let voxels = self.voxels();
        for (h, &t) in self.histogram.iter_mut().zip(&mapped) {
            *h = (t as f64 / voxels) as f32;
        }
        self.non_finite_share = (non_finite as f64 / voxels) as f32;
        total
    }

    /// Bounds of cells from those of their blocks, which are kept where a cell holds several.
    fn gather_blocks(&mut self, bounds: &[[u8; 2]], n: [usize; 3]) {
        let per_cell: [usize; 3] = core::array::from_fn(|a| self.edge[a] / self.block[a]);
        let split = self.block != self.edge;
        if split {
            self.first_block.reserve_exact(self.low.len() + 1);
            self.first_block.push(0);
            self.block_low.reserve_exact(bounds.len());
            self.block_high.reserve_exact(bounds.len());
        }
        for index in 0..self.low.len() {
            let c = [
                index % self.cells[0],
                index / self.cells[0] % self.cells[1],
                index / self.cells[0] / self.cells[1],
            ];
            let range = |a: usize| c[a] * per_cell[a]..((c[a] + 1) * per_cell[a]).min(n[a]);
            for bz in range(2) {
                for by in range(1) {
                    for bx in range(0) {
                        let b = bounds[bx + n[0] * (by + n[1] * bz)];
                        self.low[index] = self.low[index].min(b[0]);
                        self.high[index] = self.high[index].max(b[1]);
                        if split {
                            self.block_low.push(b[0]);
                            self.block_high.push(b[1]);
                        }
                    }
                }
            }
            if split {
                self.first_block.push(self.block_low.len() as u32);
            }
        }
    }
}

/// Table entries: at or below a position, at or above it, and nearest.
pub(super) struct Entries {
    pub(super) low: [u8; 256],
    pub(super) high: [u8; 256],
    pub(super) near: [u8; 256],
}

/// Several rows, joined voxel by voxel.
struct Joined {
    low: Vec<u8>,
    high: Vec<u8>,
}

impl Joined {
    fn new(len: usize) -> Self {
        Self { low: vec![255; len], high: vec![0; len] }
    }

    fn clear(&mut self) {
        self.low.fill(255);
        self.high.fill(0);
    }

    fn add(&mut self, low: &[u8], high: &[u8]) {
        self.low.iter_mut().zip(low).for_each(|(a, &b)| *a = (*a).min(b));
        self.high.iter_mut().zip(high).for_each(|(a, &b)| *a = (*a).max(b));
    }

    /// Widens the bounds of a row of blocks: a block's values are its own and the first one of the next
    /// block.
    fn reduce(&self, block: usize, bounds: &mut [[u8; 2]]) {
        for (bx, bound) in bounds.iter_mut().enumerate() {
            let range = bx * block..(bx * block + block + 1).min(self.low.len());
            bound[0] = self.low[range.clone()].iter().fold(bound[0], |a, &b| a.min(b));
            bound[1] = self.high[range].iter().fold(bound[1], |a, &b| a.max(b));
        }
    }
}

/// The entries of positions in 0…255, in arithmetic that compilers vectorize.
pub(super) fn entries(positions: &[f32], [low, high, near]: [&mut [u8]; 3]) {
    /// 2²³: adding it rounds to an integer, which then stands in the low bits.
    const SHIFT: f32 = 8_388_608.0;
    let below = |v: f32| {
        let rounded = (v + SHIFT) - SHIFT;
        if rounded > v { rounded - 1.0 } else { rounded }
    };
    let byte = |whole: f32| (whole + SHIFT).to_bits() as u8;
    for (((&p, low), high), near) in positions.iter().zip(low).zip(high).zip(near) {
        let floor = below(p);
        *low = byte(floor);
        *high = byte(if floor < p { floor + 1.0 } else { floor });
        *near = byte(below(p + 0.5));
    }
}

/// Counts bytes in four tables in turn: in one, equal neighbors would wait for each other.
fn count_entries(bytes: &[u8], counts: &mut [[u32; 256]; 4]) {
    let (fours, rest) = bytes.as_chunks::<4>();
    for four in fours {
        for (table, &b) in counts.iter_mut().zip(four) {
            table[usize::from(b)] += 1;
        }
    }
    for &b in rest {
        counts[0][usize::from(b)] += 1;
    }
}

pub(super) fn copy<T: Copy, U>(
    from: &[T],
    (start, stride): (usize, usize),
    out: &mut [U],
    to: impl Fn(T) -> U,
) {
    if stride == 1 {
        let n = out.len();
        for (slot, &v) in out.iter_mut().zip(&from[start..start + n]) {
            *slot = to(v);
        }
    } else {
        for (i, slot) in out.iter_mut().enumerate() {
            *slot = to(from[start + i * stride]);
        }
    }
}

/// Turns stored values into table positions, 0…255, as [`VolumeView::normalize`] does.
pub(super) fn to_positions(volume: &VolumeView<'_>, row: &mut [f32]) {
    let (low, high) = volume.range();
    let width = high - low;
    let scale = 255.0 / width;
    if width > 0.0 && scale > 0.0 && scale.is_finite() {
        for p in row {
            let t = (*p - low) * scale;
            // In this order NaN becomes 0.
            let t = if t > 0.0 { t } else { 0.0 };
            *p = if t < 255.0 { t } else { 255.0 };
        }
    } else {
        row.iter_mut().for_each(|p| *p = volume.normalize(*p) * 255.0);
    }
}

fn quantiles(histogram: &[u64; 256]) -> [u8; QUANTILES + 1] {
    let voxels: u64 = histogram.iter().sum();
    let mut out = [0u8; QUANTILES + 1];
    let (mut below, mut next) = (0u64, 0usize);
    for (entry, &n) in histogram.iter().enumerate() {
        below += n;
        // Bound k is the smallest entry with more than k/QUANTILES of the voxels at or below it.
        while next < QUANTILES && below * QUANTILES as u64 > next as u64 * voxels {
            out[next] = entry as u8;
            next += 1;
        }
        if next == QUANTILES {
            break;
        }
    }
    out[QUANTILES] = histogram.iter().rposition(|&n| n > 0).unwrap_or(0) as u8;
    out
}
