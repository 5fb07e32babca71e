//! The scan of a volume: bounds of blocks, quantiles of cells and the histogram, in one pass over the voxels.

use super::QUANTILES;
use super::entries::{Map, Voxel};
use crate::memory::each;
use alloc::vec::Vec;
use core::ops::Range;
use entire_core::Result;
use entire_core::kernels::{Executor, Kernel, Level, Simd};
use entire_core::memory::{chunks, room, try_vec};
use entire_core::scene::VolumeView;

/// Sizes of a volume, its cells and its blocks, each along x, y, z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Grid {
    /// Number of voxels of the volume.
    pub(super) dims: [usize; 3],
    /// Number of cells of the volume.
    pub(super) cells: [usize; 3],
    /// Edges of a cell, in voxels.
    pub(super) edge: [usize; 3],
    /// Edges of a block, in voxels; they divide the edges of a cell.
    pub(super) block: [usize; 3],
}

impl Grid {
    /// Number of blocks of the volume along x, y and z.
    pub(super) fn blocks(&self) -> [usize; 3] {
        core::array::from_fn(|a| self.dims[a].div_ceil(self.block[a]))
    }

    /// Distance in bytes between the entries of neighboring cells. It is not a power of two; otherwise, cells
    /// would map to few cache sets.
    pub(super) fn room(&self) -> usize {
        self.edge.iter().product::<usize>() + 64
    }

    /// Range of voxels along an axis of cell `i`, or of block `i`; `size` is the edge of the cell or block.
    pub(super) fn span(&self, i: usize, size: usize, axis: usize) -> Range<usize> {
        i * size..((i + 1) * size).min(self.dims[axis])
    }
}

/// Bounds of the values in a block.
pub(super) type Bounds<T> = [T; 2];

/// Bounds of an empty set.
pub(super) fn nothing<T: Voxel>() -> Bounds<T> {
    [T::HIGHEST, T::LOWEST]
}

/// Intermediate results of a scan.
#[derive(Clone, Debug)]
pub(super) struct Found<T> {
    /// Bounds of each block of the volume, including the first voxels of the next blocks.
    pub(super) bounds: Vec<Bounds<T>>,
    /// Number of voxels nearest to each table entry; for bytes, number of voxels with each stored value.
    pub(super) counts: [u64; 256],
    /// Number of voxels that are NaN or infinite.
    pub(super) non_finite: u64,
}

impl<T: Voxel> Found<T> {
    /// Scans a volume; `quantiles` has one element for each of its cells.
    pub(super) fn new(
        grid: &Grid,
        map: &Map,
        (volume, voxels): (&VolumeView<'_>, &[T]),
        quantiles: &mut [[u8; QUANTILES + 1]],
        executor: Executor<'_>,
    ) -> Result<Self> {
        let mut out = Self {
            bounds: try_vec(grid.blocks().iter().product(), nothing())?,
            counts: [0; 256],
            non_finite: 0,
        };
        let layers = grid.cells[2];
        let [across, down, _] = grid.blocks();
        let plane = across * down;
        let per_layer = grid.edge[2] / grid.block[2];
        let (mut quantiles, mut bounds) = (quantiles, &mut *out.bounds);
        let parts = executor.threads().clamp(1, layers);
        let mut tasks = room(parts)?;
        for i in 0..parts {
            let own = layers * i / parts..layers * (i + 1) / parts;
            let (q, more) = quantiles.split_at_mut(own.len() * grid.cells[0] * grid.cells[1]);
            let blocks = (own.len() * per_layer * plane).min(bounds.len());
            let (b, rest) = bounds.split_at_mut(blocks);
            (quantiles, bounds) = (more, rest);
            tasks.push(Layers {
                grid,
                map,
                source: Source { volume, voxels },
                layers: own,
                quantiles: q,
                bounds: b,
                back: try_vec(plane, nothing())?,
                scratch: Scratch::new(grid, volume)?,
                counts: [0; 256],
                non_finite: 0,
            });
        }
        let level = Level::detect();
        each(executor, &mut tasks, &|task| level.run(task));
        // The bounds of a task's last blocks also include the first plane of voxels of the next task.
        let mut previous: Option<&mut [Bounds<T>]> = None;
        for task in tasks {
            if let Some(blocks) = previous {
                for (block, [low, high]) in blocks.iter_mut().zip(task.back) {
                    *block = [block[0].lesser(low), block[1].greater(high)];
                }
            }
            out.counts.iter_mut().zip(task.counts).for_each(|(a, b)| *a += b);
            out.non_finite += task.non_finite;
            previous = last(task.bounds, plane);
        }
        Ok(out)
    }
}

/// The last `count` elements; `None` if there are fewer.
fn last<T>(of: &mut [T], count: usize) -> Option<&mut [T]> {
    let at = of.len().checked_sub(count)?;
    Some(&mut of[at..])
}

/// Voxels of a volume, and the view that gives their locations.
#[derive(Clone, Copy)]
pub(super) struct Source<'a, T> {
    pub(super) volume: &'a VolumeView<'a>,
    pub(super) voxels: &'a [T],
}

impl<T: Voxel> Source<'_, T> {
    #[inline(always)]
    fn index(&self, x: usize, y: usize, z: usize) -> usize {
        let [along_x, along_y, along_z] = self.volume.strides();
        x * along_x + y * along_y + z * along_z
    }

    /// The voxels `xs` of a row as a slice, copied to `scratch` if they are not contiguous.
    #[inline(always)]
    pub(super) fn row<'s>(&'s self, scratch: &'s mut [T], xs: &Range<usize>, y: usize, z: usize) -> &'s [T] {
        let (at, [stride, ..]) = (self.index(xs.start, y, z), self.volume.strides());
        if stride == 1 {
            return &self.voxels[at..at + xs.len()];
        }
        let scratch = &mut scratch[..xs.len()];
        for (i, slot) in scratch.iter_mut().enumerate() {
            *slot = self.voxels[at + i * stride];
        }
        scratch
    }

    /// Prefetches the voxels `xs` of a row if they are contiguous. The row in the next plane or in the next
    /// row of cells is not adjacent in memory, so the hardware does not prefetch it.
    #[inline(always)]
    pub(super) fn fetch<S: Simd>(&self, simd: S, xs: &Range<usize>, y: usize, z: usize) {
        let [_, height, planes] = self.volume.dims();
        if self.volume.strides()[0] != 1 || y >= height || z >= planes {
            return;
        }
        let row = &self.voxels[self.index(xs.start, y, z)..][..xs.len()];
        for line in row.chunks(64 / size_of::<T>()) {
            simd.prefetch_near(line.as_ptr().cast());
        }
    }
}

/// Layers of cells that one thread scans.
struct Layers<'a, T> {
    grid: &'a Grid,
    map: &'a Map,
    source: Source<'a, T>,
    layers: Range<usize>,
    /// Quantiles of the cells of these layers.
    quantiles: &'a mut [[u8; QUANTILES + 1]],
    /// Bounds of the blocks of these layers.
    bounds: &'a mut [Bounds<T>],
    /// Bounds of the voxels in the first plane of these layers, one pair per block of a plane. They widen the
    /// bounds of the last blocks before these layers, which include this plane, too.
    back: Vec<Bounds<T>>,
    counts: [u64; 256],
    non_finite: u64,
    scratch: Scratch<T>,
}

impl<T: Voxel> Kernel for &mut Layers<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        for cz in self.layers.clone() {
            for cy in 0..self.grid.cells[1] {
                self.bound(simd, cz, cy);
                self.count(simd, cz, cy);
            }
        }
    }
}

/// Working memory of one thread.
pub(super) struct Scratch<T> {
    /// Combined rows of voxels of one row of blocks: all its rows, and the rows that also belong to the
    /// preceding blocks along y, along z, and along both.
    pub(super) joined: [Joined<T>; 4],
    /// Copy of a row whose voxels are not contiguous.
    pub(super) row: Vec<T>,
    /// Table entry of each voxel of a row.
    pub(super) line: Vec<u8>,
    /// Table entries of one row of cells, contiguous per cell.
    pub(super) cells: Vec<u8>,
    pub(super) counts: Counts,
}

/// Four tables of counts, used in turn; cleared after each cell.
pub(super) type Counts = [[u32; 256]; 4];

impl<T: Voxel> Scratch<T> {
    pub(super) fn new(grid: &Grid, volume: &VolumeView<'_>) -> Result<Self> {
        let dims = grid.dims;
        let joined = || Joined::new(dims[0]);
        Ok(Self {
            joined: [joined()?, joined()?, joined()?, joined()?],
            row: try_vec(if volume.strides()[0] == 1 { 0 } else { dims[0] }, T::LOWEST)?,
            line: try_vec(if T::IS_ENTRY { 0 } else { dims[0] }, 0)?,
            cells: try_vec(grid.cells[0] * grid.room(), 0)?,
            counts: [[0; 256]; 4],
        })
    }
}

impl<T: Voxel> Layers<'_, T> {
    /// Computes the bounds of the blocks in a row of cells, and the table entries of its voxels.
    ///
    /// A row of voxels belongs to the blocks that contain it and, if it is the first of a block along y or z,
    /// to the preceding blocks as well. Rows are combined voxel by voxel and reduced along x once per row of
    /// blocks.
    #[inline(always)]
    fn bound<S: Simd>(&mut self, simd: S, cz: usize, cy: usize) {
        let grid = *self.grid;
        let (source, scratch) = (self.source, &mut self.scratch);
        let (block, per_cell) = (grid.block, grid.room());
        let [across, down, _] = grid.blocks();
        let first_block = self.layers.start * (grid.edge[2] / block[2]);
        let (zs, ys) = (grid.span(cz, grid.edge[2], 2), grid.span(cy, grid.edge[1], 1));
        let xs = 0..grid.dims[0];
        let mut non_finite = 0;
        for bz in zs.start / block[2]..zs.end.div_ceil(block[2]) {
            for by in ys.start / block[1]..ys.end.div_ceil(block[1]) {
                scratch.joined.iter_mut().for_each(|joined| joined.clear(grid.dims[0]));
                let planes = grid.span(bz, block[2], 2);
                for z in planes.clone() {
                    for y in grid.span(by, block[1], 1) {
                        if z + 1 < planes.end {
                            source.fetch(simd, &xs, y, z + 1);
                        } else {
                            source.fetch(simd, &xs, y + block[1], planes.start);
                        }
                        let row = source.row(&mut scratch.row, &xs, y, z);
                        let (first_y, first_z) = (y == by * block[1], z == bz * block[2]);
                        let takes = [true, first_y, first_z, first_y && first_z];
                        for (joined, _) in scratch.joined.iter_mut().zip(takes).filter(|(_, takes)| *takes) {
                            joined.add(row);
                        }
                        let entries = if T::IS_ENTRY {
                            T::bytes(row)
                        } else {
                            non_finite += u64::from(T::entries(row, self.map, &mut scratch.line));
                            &scratch.line
                        };
                        let place = (z - zs.start) * ys.len() + y - ys.start;
                        deal(entries, grid.edge[0], place, per_cell, &mut scratch.cells);
                    }
                }
                for (joined, back) in scratch.joined.iter_mut().zip([[0, 0], [1, 0], [0, 1], [1, 1]]) {
                    if by < back[0] || bz < back[1] {
                        continue;
                    }
                    let line = across * (by - back[0]);
                    if bz - back[1] < first_block {
                        joined.reduce(block[0], self.back[line..][..across].iter_mut());
                    } else {
                        let line = line + across * down * (bz - back[1] - first_block);
                        joined.reduce(block[0], self.bounds[line..][..across].iter_mut());
                    }
                }
            }
        }
        self.non_finite += non_finite;
    }

    /// Computes the quantiles of each cell of a row, and adds the row's voxels to `counts` by entry.
    #[inline(always)]
    fn count<S: Simd>(&mut self, simd: S, cz: usize, cy: usize) {
        let grid = *self.grid;
        let (scratch, per_cell) = (&mut self.scratch, grid.room());
        let (zs, ys) = (grid.span(cz, grid.edge[2], 2), grid.span(cy, grid.edge[1], 1));
        for cx in 0..grid.cells[0] {
            let xs = grid.span(cx, grid.edge[0], 0);
            let total = xs.len() * ys.len() * zs.len();
            let first_block = self.layers.start * (grid.edge[2] / grid.block[2]);
            let [low, high] = bounds_of(&grid, self.bounds, first_block, [&xs, &ys, &zs], |b| *b);
            let bounds = [T::entry_of(low, self.map), T::entry_of(high, self.map)];
            let cell = cx + grid.cells[0] * (cy + grid.cells[1] * (cz - self.layers.start));
            let entries = &scratch.cells[cx * per_cell..][..total];
            let counts = &mut self.counts;
            let tally = Tally { simd, map: self.map, bounds };
            self.quantiles[cell] = tally.count(entries, &mut scratch.counts, |entry, n| {
                counts[usize::from(entry)] += n;
            });
        }
    }
}

/// Counts a cell's entries, all of which lie within `bounds`.
pub(super) struct Tally<'a, S> {
    pub(super) simd: S,
    pub(super) map: &'a Map,
    pub(super) bounds: [u8; 2],
}

impl<S: Simd> Tally<'_, S> {
    /// Computes the quantiles of a cell's entries. Calls `each` with every entry that occurs and its count,
    /// in ascending order. `counts` must be zero, and is zero again afterwards.
    #[inline(always)]
    pub(super) fn count(
        &self,
        entries: &[u8],
        counts: &mut Counts,
        mut each: impl FnMut(u8, u64),
    ) -> [u8; QUANTILES + 1] {
        let ([low, high], total) = (self.bounds, entries.len());
        if low == high {
            each(low, total as u64);
            return [self.map.near[usize::from(low)]; QUANTILES + 1];
        }
        self.batch(entries, counts);
        let mut out = [0; QUANTILES + 1];
        let range = usize::from(low)..usize::from(high) + 1;
        let [a, b, c, d] = counts;
        let (mut below, mut next) = (0u64, 0usize);
        let mut last = low;
        for entry in range.clone() {
            let n = u64::from(a[entry]) + u64::from(b[entry]) + u64::from(c[entry]) + u64::from(d[entry]);
            if n == 0 {
                continue;
            }
            each(entry as u8, n);
            below += n;
            last = entry as u8;
            // Bound k is the smallest entry with more than k/QUANTILES of the voxels at or below it.
            while next < QUANTILES && below * QUANTILES as u64 > (next * total) as u64 {
                out[next] = self.map.near[entry];
                next += 1;
            }
        }
        out[QUANTILES] = self.map.near[usize::from(last)];
        // Only this range needs clearing: no entry lies outside the bounds, so the other counts are zero.
        for table in [a, b, c, d] {
            table[range.clone()].fill(0);
        }
        out
    }

    /// Counts the bytes. If few distinct values can occur, counts eight values at a time, each over all
    /// bytes. Otherwise adds the bytes to four tables in turn: in a single table, each of several equal bytes
    /// in a row would wait for the addition before it.
    #[inline(always)]
    fn batch(&self, bytes: &[u8], counts: &mut Counts) {
        let [low, high] = self.bounds;
        let [a, b, c, d] = counts;
        if usize::from(high - low) < S::MAX_COUNTED_VALUES {
            for first in (low..=high).step_by(8) {
                // The last group of eight values may overlap the preceding group; the counts of their common
                // values are then stored twice.
                let first = usize::from(first.min(u8::MAX - 7));
                a[first..first + 8].copy_from_slice(&self.simd.count_eight(bytes, first as u8));
            }
            return;
        }
        let (eights, rest) = chunks::<8, _>(bytes);
        for &eight in eights {
            let word = u64::from_le_bytes(eight);
            let byte = |i: u32| (word >> (8 * i)) as u8 as usize;
            a[byte(0)] += 1;
            b[byte(1)] += 1;
            c[byte(2)] += 1;
            d[byte(3)] += 1;
            a[byte(4)] += 1;
            b[byte(5)] += 1;
            c[byte(6)] += 1;
            d[byte(7)] += 1;
        }
        for &byte in rest {
            a[usize::from(byte)] += 1;
        }
    }
}

/// Bounds of a cell, from the bounds of its blocks; `bounds` begins at block layer `first`.
#[inline(always)]
pub(super) fn bounds_of<T: Voxel, B>(
    grid: &Grid,
    bounds: &[B],
    first: usize,
    cell: [&Range<usize>; 3],
    of: impl Fn(&B) -> Bounds<T>,
) -> Bounds<T> {
    let [across, down, _] = grid.blocks();
    let [xs, ys, zs]: [Range<usize>; 3] =
        core::array::from_fn(|a| cell[a].start / grid.block[a]..cell[a].end.div_ceil(grid.block[a]));
    let mut out = nothing::<T>();
    for (z, y) in zs.flat_map(|z| ys.clone().map(move |y| (z, y))) {
        let line = across * (y + down * (z - first));
        for [low, high] in bounds[line + xs.start..line + xs.end].iter().map(&of) {
            out = [out[0].lesser(low), out[1].greater(high)];
        }
    }
    out
}

/// Several rows, combined voxel by voxel into minima and maxima.
pub(super) struct Joined<T> {
    low: Vec<T>,
    high: Vec<T>,
    /// Working memory.
    other: Vec<T>,
}

impl<T: Voxel> Joined<T> {
    fn new(len: usize) -> Result<Self> {
        Ok(Self {
            low: try_vec(len, T::HIGHEST)?,
            high: try_vec(len, T::LOWEST)?,
            other: try_vec(len, T::LOWEST)?,
        })
    }

    /// Starts a new set of rows of `len` voxels, at most the capacity.
    #[inline(always)]
    pub(super) fn clear(&mut self, len: usize) {
        self.low.clear();
        self.high.clear();
        self.low.resize(len, T::HIGHEST);
        self.high.resize(len, T::LOWEST);
    }

    #[inline(always)]
    pub(super) fn add(&mut self, row: &[T]) {
        for ((low, high), &v) in self.low.iter_mut().zip(&mut self.high).zip(row) {
            let v = v.known();
            *low = low.lesser(v);
            *high = high.greater(v);
        }
    }

    /// Widens the bounds of a row of blocks by the combined rows. A block's values include the first value of
    /// the next block. `block`, the number of voxels of a block along x, must be a power of two.
    #[inline(always)]
    pub(super) fn reduce<'a>(&mut self, block: usize, bounds: impl Iterator<Item = &'a mut Bounds<T>>)
    where
        T: 'a,
    {
        // After the loop, every element holds the bounds of the `block` values that begin with it.
        let mut reach = 1;
        while reach < block.min(self.low.len()) {
            slide(&mut self.low, &mut self.other, reach, T::lesser);
            slide(&mut self.high, &mut self.other, reach, T::greater);
            reach *= 2;
        }
        for (bx, bound) in bounds.enumerate() {
            // Two ranges of `block` values: the second begins and ends one value later.
            for place in [bx * block, (bx * block + 1).min(self.low.len() - 1)] {
                *bound = [bound[0].lesser(self.low[place]), bound[1].greater(self.high[place])];
            }
        }
    }
}

/// Combines each value with the value `reach` elements after it, if there is one.
#[inline(always)]
fn slide<T: Voxel>(values: &mut [T], other: &mut [T], reach: usize, join: impl Fn(T, T) -> T) {
    let len = values.len();
    let to = &mut other[..len];
    for ((to, &a), &b) in to.iter_mut().zip(&values[..len - reach]).zip(&values[reach..]) {
        *to = join(a, b);
    }
    to[len - reach..].copy_from_slice(&values[len - reach..]);
    values.copy_from_slice(to);
}

/// Copies the entries of a row of voxels to the cells that the row crosses: `edge` entries to each cell, as
/// row number `place` of the cell. In `cells`, each cell takes `per_cell` bytes.
#[inline(always)]
pub(super) fn deal(entries: &[u8], edge: usize, place: usize, per_cell: usize, cells: &mut [u8]) {
    #[inline(always)]
    fn fixed<const N: usize>(entries: &[u8], place: usize, per_cell: usize, cells: &mut [u8]) {
        let (parts, rest) = chunks::<N, _>(entries);
        for (part, cell) in parts.iter().zip(cells.chunks_exact_mut(per_cell)) {
            cell[N * place..N * place + N].copy_from_slice(part);
        }
        let last = &mut cells[parts.len() * per_cell..];
        if !rest.is_empty() {
            last[rest.len() * place..][..rest.len()].copy_from_slice(rest);
        }
    }
    // Common edges are compiled as constants, so that no function is called for them.
    match edge {
        4 => fixed::<4>(entries, place, per_cell, cells),
        8 => fixed::<8>(entries, place, per_cell, cells),
        16 => fixed::<16>(entries, place, per_cell, cells),
        32 => fixed::<32>(entries, place, per_cell, cells),
        _ => {
            for (part, cell) in entries.chunks(edge).zip(cells.chunks_exact_mut(per_cell)) {
                cell[part.len() * place..][..part.len()].copy_from_slice(part);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec;

    /// Kernel that counts the bytes with each of eight values, the given one and the next seven.
    struct CountEight<'a>(&'a [u8], u8);

    impl Kernel for CountEight<'_> {
        type Output = [u32; 8];

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> [u32; 8] {
            simd.count_eight(self.0, self.1)
        }
    }

    #[test]
    fn eight_values_are_counted_on_every_level() {
        let mut state = 3u32;
        for len in [0usize, 1, 63, 255, 256, 511, 512, 1000, 1024, 1536, 5000] {
            for spread in [8u32, 40, 256] {
                let mut random = || {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    (state >> 8) % spread
                };
                let base = random();
                let bytes: Vec<u8> = (0..len).map(|_| (base + random()) as u8).collect();
                for first in [0u8, 7, 8, 100, 247, 248] {
                    let count = |value: u8| bytes.iter().filter(|b| **b == value).count() as u32;
                    let expected: [u32; 8] = core::array::from_fn(|i| count(first + i as u8));
                    for level in Level::available() {
                        assert_eq!(level.run(CountEight(&bytes, first)), expected, "{level:?} {len} {first}");
                    }
                }
            }
        }
    }

    #[test]
    fn blocks_reach_to_the_first_value_of_the_next() {
        for (len, block) in [(1usize, 8usize), (8, 8), (9, 8), (37, 8), (64, 16), (70, 32)] {
            let values: Vec<u16> = (0..len).map(|i| (i * 7919 % 251) as u16).collect();
            let mut joined = Joined::new(len).unwrap();
            joined.clear(len);
            joined.add(&values);
            let mut bounds = vec![nothing(); len.div_ceil(block)];
            joined.reduce(block, bounds.iter_mut());
            for (bx, found) in bounds.iter().enumerate() {
                let own = &values[bx * block..(bx * block + block + 1).min(len)];
                assert_eq!(*found, [*own.iter().min().unwrap(), *own.iter().max().unwrap()]);
            }
        }
    }
}
