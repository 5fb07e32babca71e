//! Finds the volume's cells that changed since the last time step, and summarizes them again.

use super::QUANTILES;
use super::entries::{Map, Voxel};
use super::scan::{Bounds, Grid, Scratch, Source, Tally, bounds_of, deal, nothing};
use crate::memory::{each, mixed};
use alloc::vec::Vec;
use core::ops::Range;
use entire_core::Result;
use entire_core::kernels::{Executor, Kernel, Level, Simd};
use entire_core::memory::{chunks, collected, reserve, room, try_vec};

/// One bit per cell of a row along x; a row has at most 128 cells.
pub(super) type Mask = u128;

/// Checksum of a cell's voxels, two sums of 64 bits each; different voxels have the same checksum with a
/// probability of about 2⁻¹²⁸.
type Sums = [u64; 2];

/// Bounds of the voxels in all planes of a block, and bounds of those in its first plane. The first plane
/// also belongs to the preceding block along z, whose samples reach to it. Both bounds include the first
/// voxels of the next blocks along x and y.
pub(super) type Halves<T> = [Bounds<T>; 2];

/// State kept for the cells between time steps, independent of the voxels' type.
#[derive(Clone, Debug)]
pub(super) struct Cells {
    sums: Vec<Sums>,
    /// Per row of cells: the tallies of its cells in order, see [`write_tally`]. Empty for a row that was
    /// never scanned.
    tallies: Vec<Vec<u8>>,
    /// Cells that must be scanned, by rows.
    pub(super) changed: Vec<Mask>,
    /// Cells that were scanned and whose bounds are not yet in the summary, one mask per row of cells.
    pub(super) fresh: Vec<Mask>,
    /// Number of voxels nearest to each table entry; for bytes, number of voxels with each stored value.
    pub(super) counts: [u64; 256],
    /// Number of voxels that are NaN or infinite.
    pub(super) non_finite: u64,
}

impl Cells {
    /// The state before the first scan: every cell is marked as changed.
    pub(super) fn new(grid: &Grid) -> Result<Self> {
        let [nx, ny, nz] = grid.cells;
        let mut tallies = room(ny * nz)?;
        tallies.resize_with(ny * nz, Vec::new);
        Ok(Self {
            sums: try_vec(nx * ny * nz, [0; 2])?,
            tallies,
            changed: try_vec(ny * nz, full(nx))?,
            fresh: try_vec(ny * nz, 0)?,
            counts: [0; 256],
            non_finite: 0,
        })
    }
}

/// Mask of the first `count` cells.
pub(super) fn full(count: usize) -> Mask {
    if count < Mask::BITS as usize { (1 << count) - 1 } else { Mask::MAX }
}

pub(super) fn mask(cells: Range<usize>) -> Mask {
    full(cells.end) & !full(cells.start)
}

/// Ranges of consecutive set bits.
#[inline(always)]
fn runs(bits: Mask) -> impl Iterator<Item = Range<usize>> {
    let mut left = bits;
    core::iter::from_fn(move || {
        let first = left.trailing_zeros() as usize;
        if left == 0 {
            return None;
        }
        let end = first + (left >> first).trailing_ones() as usize;
        left &= !full(end);
        Some(first..end)
    })
}

/// In a range of layers, scans the cells that are marked as changed. With `search`, first computes the
/// checksum of every cell in these layers, and marks the cells whose checksum changed. `quantiles` and
/// `blocks` are those of the whole volume.
///
/// # Errors
/// [`crate::ErrorKind::OutOfMemory`]; cells that were not scanned stay marked.
pub(super) fn look<T: Voxel>(
    grid: &Grid,
    map: &Map,
    source: Source<'_, T>,
    layers: Range<usize>,
    search: bool,
    (cells, blocks, quantiles): (&mut Cells, &mut [Halves<T>], &mut [[u8; QUANTILES + 1]]),
    executor: Executor<'_>,
) -> Result<()> {
    let [nx, ny, _] = grid.cells;
    let [across, down, _] = grid.blocks();
    let (rows, per_layer) = (layers.start * ny, across * down * (grid.edge[2] / grid.block[2]));
    let parts = executor.threads().clamp(1, layers.len().max(1));
    let mut tasks = room(parts)?;
    let mut sums = &mut cells.sums[rows * nx..];
    let mut tallies = &mut cells.tallies[rows..];
    let mut changed = &mut cells.changed[rows..];
    let mut fresh = &mut cells.fresh[rows..];
    let mut quantiles = &mut quantiles[rows * nx..];
    let mut blocks = &mut blocks[layers.start * per_layer..];
    for i in 0..parts {
        let place = |i: usize| layers.start + layers.len() * i / parts;
        let own = place(i)..place(i + 1);
        let rows = own.len() * ny;
        tasks.push(Part {
            grid,
            map,
            source,
            search,
            sums: take(&mut sums, rows * nx),
            tallies: take(&mut tallies, rows),
            changed: take(&mut changed, rows),
            fresh: take(&mut fresh, rows),
            quantiles: take(&mut quantiles, rows * nx),
            blocks: take(&mut blocks, own.len() * per_layer),
            layers: own,
            more: [0; 256],
            less: [0; 256],
            non_finite: [0; 2],
            scratch: Scratch::new(grid, source.volume)?,
            words: [
                try_vec(words(grid.dims[0] * size_of::<T>()), 0)?,
                try_vec(words(grid.dims[0] * size_of::<T>()), 0)?,
            ],
            infinite: try_vec(if T::IS_FLOAT { nx } else { 0 }, 0)?,
            row: Vec::new(),
            outcome: Ok(()),
        });
    }
    let level = Level::detect();
    each(executor, &mut tasks, &|task| level.run(task));
    let mut outcome = Ok(());
    for task in tasks {
        let counts = cells.counts.iter_mut().zip(task.more.iter().zip(&task.less));
        counts.for_each(|(n, (more, less))| *n = *n + more - less);
        cells.non_finite = cells.non_finite + task.non_finite[0] - task.non_finite[1];
        outcome = outcome.and(task.outcome);
    }
    outcome
}

/// Splits off the first `count` elements, or all if there are fewer; `from` keeps the rest.
fn take<'a, T>(from: &mut &'a mut [T], count: usize) -> &'a mut [T] {
    let all = core::mem::take(from);
    let (first, rest) = all.split_at_mut(count.min(all.len()));
    *from = rest;
    first
}

/// Number of words that hold `bytes` bytes.
fn words(bytes: usize) -> usize {
    bytes.div_ceil(size_of::<u64>())
}

/// Layers of cells that one thread scans.
struct Part<'a, T> {
    grid: &'a Grid,
    map: &'a Map,
    source: Source<'a, T>,
    layers: Range<usize>,
    search: bool,
    /// State of the cells, rows of cells and blocks of these layers.
    sums: &'a mut [Sums],
    tallies: &'a mut [Vec<u8>],
    changed: &'a mut [Mask],
    fresh: &'a mut [Mask],
    quantiles: &'a mut [[u8; QUANTILES + 1]],
    blocks: &'a mut [Halves<T>],
    /// Numbers of voxels added to and removed from each entry.
    more: [u64; 256],
    less: [u64; 256],
    /// Numbers of NaN or infinite voxels added and removed.
    non_finite: [u64; 2],
    scratch: Scratch<T>,
    /// The first and the second partial checksum of each word of a row.
    words: [Vec<u64>; 2],
    /// Number of NaN or infinite voxels of each cell of a row.
    infinite: Vec<u64>,
    /// Tallies of a row of cells.
    row: Vec<u8>,
    outcome: Result<()>,
}

impl<T: Voxel> Kernel for &mut Part<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        self.outcome = self.look(simd);
    }
}

impl<T: Voxel> Part<'_, T> {
    #[inline(always)]
    fn look<S: Simd>(&mut self, simd: S) -> Result<()> {
        let ny = self.grid.cells[1];
        for cz in self.layers.clone() {
            let first = ny * (cz - self.layers.start);
            if !self.search && self.changed[first..first + ny].iter().all(|&row| row == 0) {
                continue;
            }
            // The bounds of a row's last blocks include voxels of the next row, so changes of the next row
            // are found before the bounds are computed.
            self.compare(simd, cz, 0);
            for cy in 0..ny {
                if cy + 1 < ny {
                    self.compare(simd, cz, cy + 1);
                }
                self.bound(cz, cy);
                self.count(simd, cz, cy)?;
                let row = first + cy;
                self.fresh[row] |= self.changed[row];
                self.changed[row] = 0;
            }
        }
        Ok(())
    }

    /// Computes checksums in a row of cells: of all cells with `search`, otherwise of the marked cells. Marks
    /// the cells whose checksum changed.
    #[inline(always)]
    fn compare<S: Simd>(&mut self, simd: S, cz: usize, cy: usize) {
        let (grid, source) = (*self.grid, self.source);
        let row = cy + grid.cells[1] * (cz - self.layers.start);
        let (zs, ys) = (grid.span(cz, grid.edge[2], 2), grid.span(cy, grid.edge[1], 1));
        let per_cell = grid.edge[0] * size_of::<T>() / size_of::<u64>();
        for run in runs(if self.search { full(grid.cells[0]) } else { self.changed[row] }) {
            let xs = grid.span(run.start, grid.edge[0], 0).start..grid.span(run.end - 1, grid.edge[0], 0).end;
            let [first, second] = &mut self.words;
            let n = words(xs.len() * size_of::<T>());
            first[..n].fill(0);
            second[..n].fill(0);
            let mut place = 0;
            for (z, y) in zs.clone().flat_map(|z| ys.clone().map(move |y| (z, y))) {
                if z + 1 < zs.end {
                    source.fetch(simd, &xs, y, z + 1);
                } else {
                    source.fetch(simd, &xs, y + ys.len(), zs.start);
                }
                let voxels = source.row(&mut self.scratch.row, &xs, y, z);
                place += 1;
                let keys = [mixed(0, place), mixed(u64::MAX, place)];
                absorb(bytemuck::cast_slice(voxels), keys, &mut first[..n], &mut second[..n]);
            }
            for cell in run.clone() {
                let at = (cell - run.start) * per_cell;
                let of = |words: &[u64]| words[at..(at + per_cell).min(n)].iter().copied().fold(place, mixed);
                let sums = [of(first), of(second)];
                let kept = &mut self.sums[row * grid.cells[0] + cell];
                self.changed[row] |= Mask::from(*kept != sums) << cell;
                *kept = sums;
            }
        }
    }

    /// Computes the bounds of the blocks that overlap changed cells.
    #[inline(always)]
    fn bound(&mut self, cz: usize, cy: usize) {
        let (grid, source, scratch) = (*self.grid, self.source, &mut self.scratch);
        let row = cy + grid.cells[1] * (cz - self.layers.start);
        let ([across, down, _], block) = (grid.blocks(), grid.block);
        let first_block = self.layers.start * (grid.edge[2] / block[2]);
        let (zs, ys) = (grid.span(cz, grid.edge[2], 2), grid.span(cy, grid.edge[1], 1));
        let (bys, per_cell) = (ys.start / block[1]..ys.end.div_ceil(block[1]), grid.edge[0] / block[0]);
        let next = if cy + 1 < grid.cells[1] { self.changed[row + 1] } else { 0 };
        let [own, first, ..] = &mut scratch.joined;
        for bz in zs.start / block[2]..zs.end.div_ceil(block[2]) {
            for by in bys.clone() {
                let changed = self.changed[row] | if by + 1 == bys.end { next } else { 0 };
                for run in runs(changed) {
                    // The bounds of the block before the run include the run's first voxels.
                    let bxs = (run.start * per_cell).saturating_sub(1)..(run.end * per_cell).min(across);
                    let xs = bxs.start * block[0]..(bxs.end * block[0] + 1).min(grid.dims[0]);
                    own.clear(xs.len());
                    first.clear(xs.len());
                    let planes = grid.span(bz, block[2], 2);
                    for z in planes.clone() {
                        for y in by * block[1]..((by + 1) * block[1] + 1).min(grid.dims[1]) {
                            let voxels = source.row(&mut scratch.row, &xs, y, z);
                            own.add(voxels);
                            if z == planes.start {
                                first.add(voxels);
                            }
                        }
                    }
                    let line = across * (by + down * (bz - first_block));
                    let blocks = &mut self.blocks[line + bxs.start..line + bxs.end];
                    blocks.fill([nothing(); 2]);
                    own.reduce(block[0], blocks.iter_mut().map(|[own, _]| own));
                    first.reduce(block[0], blocks.iter_mut().map(|[_, first]| first));
                }
            }
        }
    }

    /// Computes quantiles and tallies of the changed cells of a row.
    #[inline(always)]
    fn count<S: Simd>(&mut self, simd: S, cz: usize, cy: usize) -> Result<()> {
        let (grid, source, scratch) = (*self.grid, self.source, &mut self.scratch);
        let (nx, per_cell) = (grid.cells[0], grid.room());
        let row = cy + grid.cells[1] * (cz - self.layers.start);
        let changed = self.changed[row];
        if changed == 0 {
            return Ok(());
        }
        let (zs, ys) = (grid.span(cz, grid.edge[2], 2), grid.span(cy, grid.edge[1], 1));
        self.infinite.fill(0);
        for run in runs(changed) {
            let xs = grid.span(run.start, grid.edge[0], 0).start..grid.span(run.end - 1, grid.edge[0], 0).end;
            for (z, y) in zs.clone().flat_map(|z| ys.clone().map(move |y| (z, y))) {
                let voxels = source.row(&mut scratch.row, &xs, y, z);
                let entries = if T::IS_ENTRY {
                    T::bytes(voxels)
                } else {
                    let line = &mut scratch.line[..xs.len()];
                    if T::entries(voxels, self.map, line) > 0 {
                        let cells = self.infinite[run.clone()].iter_mut().zip(voxels.chunks(grid.edge[0]));
                        cells.for_each(|(n, part)| {
                            *n += part.iter().map(|v| u64::from(v.is_non_finite())).sum::<u64>()
                        });
                    }
                    line
                };
                let place = (z - zs.start) * ys.len() + y - ys.start;
                deal(entries, grid.edge[0], place, per_cell, &mut scratch.cells[run.start * per_cell..]);
            }
        }
        self.row.clear();
        let (mut old, first_block) =
            (&*self.tallies[row], self.layers.start * (grid.edge[2] / grid.block[2]));
        let (mut more, mut less, mut non_finite) = ([0; 256], [0; 256], [0; 2]);
        for cx in 0..nx {
            let before = split_tally(&mut old);
            if changed >> cx & 1 == 0 {
                let len = self.row.len() + before.len();
                reserve(&mut self.row, len)?;
                self.row.extend_from_slice(before);
                continue;
            }
            non_finite[1] += read_tally(before, |entry, n| less[usize::from(entry)] += n);
            let xs = grid.span(cx, grid.edge[0], 0);
            let [low, high] = bounds_of(&grid, self.blocks, first_block, [&xs, &ys, &zs], |[own, _]| *own);
            let bounds = [T::entry_of(low, self.map), T::entry_of(high, self.map)];
            let entries = &scratch.cells[cx * per_cell..][..xs.len() * ys.len() * zs.len()];
            let infinite = self.infinite.get(cx).copied().unwrap_or(0);
            non_finite[0] += infinite;
            let mut own = [0u64; 256];
            let tally = Tally { simd, map: self.map, bounds };
            self.quantiles[row * nx + cx] = tally.count(entries, &mut scratch.counts, |entry, n| {
                own[usize::from(entry)] = n;
                more[usize::from(entry)] += n;
            });
            write_tally(&mut self.row, bounds, &own, infinite)?;
        }
        // From here on, only the allocation below can fail. This allocation precedes every change of the
        // tallies and totals.
        let kept = &mut self.tallies[row];
        if kept.capacity() < self.row.len() {
            *kept = collected(self.row.iter().copied())?;
        } else {
            kept.clear();
            kept.extend_from_slice(&self.row);
        }
        self.more.iter_mut().zip(more).for_each(|(sum, n)| *sum += n);
        self.less.iter_mut().zip(less).for_each(|(sum, n)| *sum += n);
        self.non_finite.iter_mut().zip(non_finite).for_each(|(sum, n)| *sum += n);
        Ok(())
    }
}

/// Adds a row of voxels to partial checksums: each 8-byte word of the row to one checksum in `first` and one
/// in `second`. The word is XORed with the first or second of the row's two `keys`, so that the checksum
/// depends on the row, and the product of the two halves of the result is added.
#[inline(always)]
fn absorb(bytes: &[u8], keys: Sums, first: &mut [u64], second: &mut [u64]) {
    let (whole, rest) = chunks::<8, _>(bytes);
    let product = |word: u64, key: u64| ((word ^ key) & 0xffff_ffff) * ((word ^ key) >> 32);
    for ((a, b), word) in first.iter_mut().zip(second.iter_mut()).zip(whole) {
        let word = u64::from_le_bytes(*word);
        *a = a.wrapping_add(product(word, keys[0]));
        *b = b.wrapping_add(product(word, keys[1]));
    }
    if !rest.is_empty() {
        let mut last = [0; 8];
        last[..rest.len()].copy_from_slice(rest);
        let word = u64::from_le_bytes(last);
        let at = whole.len();
        first[at] = first[at].wrapping_add(product(word, keys[0]));
        second[at] = second[at].wrapping_add(product(word, keys[1]));
    }
}

/// Length of a tally's length field, in bytes.
const LENGTH: usize = 2;

/// Marker before a count that does not fit in one byte.
const LARGE_COUNT: u8 = u8::MAX;

/// Appends a cell's tally: the tally's length in bytes, the bounds of the cell's entries, the number of
/// voxels that are not finite, and the number of voxels with each entry from the lower bound to the upper. A
/// number below 255 takes one byte, any other nine bytes. A cell of 8³ voxels takes 14 bytes if all voxels
/// have the same entry, otherwise usually 5 bytes plus one byte per entry from the lower bound to the upper.
fn write_tally(to: &mut Vec<u8>, [low, high]: [u8; 2], counts: &[u64; 256], non_finite: u64) -> Result<()> {
    let counts = &counts[usize::from(low)..=usize::from(high)];
    let at = to.len();
    reserve(to, at + LENGTH + 2 + 9 * (1 + counts.len()))?;
    to.extend_from_slice(&[0; LENGTH]);
    to.extend_from_slice(&[low, high]);
    for &n in [non_finite].iter().chain(counts) {
        match u8::try_from(n) {
            Ok(n) if n < LARGE_COUNT => to.push(n),
            _ => {
                to.push(LARGE_COUNT);
                to.extend_from_slice(&n.to_le_bytes());
            }
        }
    }
    let len = (to.len() - at) as u16;
    to[at..at + LENGTH].copy_from_slice(&len.to_le_bytes());
    Ok(())
}

/// Removes the first tally from `tallies` and returns it, or an empty slice if there is none.
fn split_tally<'a>(tallies: &mut &'a [u8]) -> &'a [u8] {
    let Some(&len) = tallies.first_chunk::<LENGTH>() else { return &[] };
    let (first, rest) = tallies.split_at(usize::from(u16::from_le_bytes(len)).min(tallies.len()));
    *tallies = rest;
    first
}

/// Reads a tally: calls `each` with the number of voxels of each entry; returns the number of voxels that are
/// not finite.
fn read_tally(tally: &[u8], mut each: impl FnMut(u8, u64)) -> u64 {
    let Some((&[_, _, low, high], mut rest)) = tally.split_first_chunk::<{ LENGTH + 2 }>() else { return 0 };
    let mut next = || {
        let (&byte, after) = rest.split_first()?;
        match after.split_first_chunk::<8>() {
            Some((&large, after)) if byte == LARGE_COUNT => {
                rest = after;
                Some(u64::from_le_bytes(large))
            }
            _ => {
                rest = after;
                Some(u64::from(byte))
            }
        }
    };
    let non_finite = next().unwrap_or(0);
    for (entry, n) in (low..=high).map_while(|entry| Some((entry, next()?))) {
        each(entry, n);
    }
    non_finite
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tallies_are_read_as_they_were_written() {
        let mut tallies = Vec::new();
        let mut counts = [0u64; 256];
        counts[3] = 254;
        counts[4] = 255;
        counts[9] = 1 << 40;
        let cells: [([u8; 2], u64); 4] = [([3, 9], 0), ([0, 255], 7), ([200, 200], 255), ([9, 9], 1 << 33)];
        for (bounds, non_finite) in cells {
            write_tally(&mut tallies, bounds, &counts, non_finite).unwrap();
        }
        let mut left = &*tallies;
        for ([low, high], non_finite) in cells {
            let mut found = [0u64; 256];
            let tally = split_tally(&mut left);
            assert_eq!(read_tally(tally, |entry, n| found[usize::from(entry)] = n), non_finite);
            let inside = |i: usize| (usize::from(low)..=usize::from(high)).contains(&i);
            assert!((0..256).all(|i| found[i] == if inside(i) { counts[i] } else { 0 }));
        }
        assert!(split_tally(&mut left).is_empty());
        assert_eq!(read_tally(&[], |_, _| panic!("nothing")), 0);
    }

    #[test]
    fn runs_are_those_of_set_bits() {
        for bits in [0, 1, 6, Mask::MAX, 1 << 127, 0b1011_0001, Mask::MAX ^ 1 << 64] {
            let mut found = 0;
            let mut before = None;
            for run in runs(bits) {
                assert!(before.is_none_or(|end| end < run.start) && run.start < run.end);
                before = Some(run.end);
                found |= mask(run);
            }
            assert_eq!(found, bits);
        }
    }

    /// Checks that a change of any bit changes both sums of its word and of no other word, and that every
    /// level gives the same sums.
    #[test]
    fn sums_tell_words_and_places_apart() {
        struct Absorb<'a>(&'a [u8], &'a mut [u64], &'a mut [u64]);
        impl Kernel for Absorb<'_> {
            type Output = ();
            #[inline(always)]
            fn run<S: Simd>(self, _: S) {
                absorb(self.0, [mixed(0, 1), mixed(u64::MAX, 1)], self.1, self.2);
            }
        }
        let mut bytes: Vec<u8> = (0..77u8).map(|i| i.wrapping_mul(37)).collect();
        let sums = |bytes: &[u8]| {
            let mut all = Level::available().map(|level| {
                let (mut a, mut b) = ([1u64; 10], [2u64; 10]);
                level.run(Absorb(bytes, &mut a, &mut b));
                (a, b)
            });
            let first = all.next().unwrap();
            assert!(all.all(|other| other == first));
            first
        };
        let expected = sums(&bytes);
        for i in 0..77 {
            for bit in 0..8 {
                bytes[i] ^= 1 << bit;
                let (a, b) = sums(&bytes);
                assert!((0..10).all(|w| (a[w] != expected.0[w]) == (w == i / 8)), "{i} {bit}");
                assert!((0..10).all(|w| (b[w] != expected.1[w]) == (w == i / 8)), "{i} {bit}");
                bytes[i] ^= 1 << bit;
            }
        }
    }
}
