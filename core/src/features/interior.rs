//! How deep a cell lies among cells that are not empty: what tells how far a ray gets there before its renderer
//! looks at the skip map again.

use crate::Result;
use crate::memory::zeroed;
use alloc::vec::Vec;

/// Halvings of the grid: cells of 2³ and of 4³ cells.
const LEVELS: usize = 2;

/// Classes of depth; class `c` stands for 2^c cells from the nearest empty one.
pub(super) const CLASSES: u32 = 4;

/// Bits of all cells that are not empty, halved twice: a bit of a halved grid is set where all eight cells
/// below are (those beyond the grid count as not empty, as they do to a skip map that ends there).
#[derive(Clone, Debug, Default)]
pub(super) struct Interior {
    halved: [Vec<u64>; LEVELS],
}

/// Words for the bits of a grid, and one more: bits are read 64 at a time from anywhere.
pub(super) fn words(grid: [usize; 3]) -> usize {
    grid.iter().product::<usize>().div_ceil(64) + 1
}

fn halve(grid: [usize; 3]) -> [usize; 3] {
    grid.map(|n| n.div_ceil(2))
}

impl Interior {
    /// Vectors with room for a grid, where the present ones have none.
    ///
    /// # Errors
    /// [`crate::ErrorKind::OutOfMemory`].
    pub(super) fn longer(&self, grid: [usize; 3]) -> Result<[Option<Vec<u64>>; LEVELS]> {
        let mut out = [const { None }; LEVELS];
        let mut grid = grid;
        for (slot, present) in out.iter_mut().zip(&self.halved) {
            grid = halve(grid);
            if words(grid) > present.capacity() {
                *slot = Some(zeroed(words(grid))?);
            }
        }
        Ok(out)
    }

    /// Takes the longer vectors, and fills them from the bits of a grid's cells.
    pub(super) fn update(&mut self, longer: [Option<Vec<u64>>; LEVELS], grid: [usize; 3], full: &[u64]) {
        for (present, longer) in self.halved.iter_mut().zip(longer) {
            if let Some(longer) = longer {
                *present = longer;
            }
        }
        let [first, second] = &mut self.halved;
        let half = halve(grid);
        first.clear();
        first.resize(words(half), 0);
        halve_bits(full, grid, first);
        second.clear();
        second.resize(words(halve(half)), 0);
        halve_bits(first, half, second);
    }

    /// The class of a cell that is not empty: 0 beside an empty cell, 1 two or more cells from the nearest one,
    /// 2 three or more, 3 five or more. A cell of class 1 or 2 may lie deeper, since what is seen of its
    /// surroundings is rounded to halved cells.
    pub(super) fn class(&self, full: &[u64], grid: [usize; 3], cell: usize) -> u32 {
        let mut place = [cell % grid[0], cell / grid[0] % grid[1], cell / (grid[0] * grid[1])];
        let mut grid = grid;
        let mut bits = full;
        for class in 0..CLASSES - 1 {
            if !surrounded(bits, grid, place) {
                return class;
            }
            let Some(halved) = self.halved.get(class as usize) else { break };
            (bits, grid, place) = (halved, halve(grid), place.map(|p| p / 2));
        }
        CLASSES - 1
    }
}

/// 64 bits from any place on.
#[inline(always)]
fn read(bits: &[u64], at: usize) -> u64 {
    let word = |i: usize| bits.get(i).copied().unwrap_or(0);
    // Two shifts: one by 64 has no meaning.
    word(at / 64) >> (at % 64) | word(at / 64 + 1) << 1 << (63 - at % 64)
}

/// Whether a cell and its 26 neighbors inside the grid are set.
#[inline(always)]
fn surrounded(bits: &[u64], grid: [usize; 3], [x, y, z]: [usize; 3]) -> bool {
    let span = |at: usize, n: usize| (at.saturating_sub(1), (at + 1).min(n - 1));
    let ((x0, x1), (y0, y1), (z0, z1)) = (span(x, grid[0]), span(y, grid[1]), span(z, grid[2]));
    let run = (1u64 << (x1 - x0 + 1)) - 1;
    let row = |y: usize, z: usize| read(bits, x0 + grid[0] * (y + grid[1] * z)) & run == run;
    (z0..=z1).all(|z| (y0..=y1).all(|y| row(y, z)))
}

/// Sets a bit of `to` where the eight cells below are set; those beyond the grid count as set. `to` must be
/// clear.
fn halve_bits(from: &[u64], grid: [usize; 3], to: &mut [u64]) {
    let [nx, ny, nz] = grid;
    let half = halve(grid);
    for z in 0..half[2] {
        for y in 0..half[1] {
            let rows = |k: usize| {
                let (y, z) = (2 * y + k % 2, 2 * z + k / 2);
                (y < ny && z < nz).then_some(nx * (y + ny * z))
            };
            let row = half[0] * (y + half[1] * z);
            for x in (0..nx).step_by(64) {
                let mut word = u64::MAX;
                for start in (0..4).filter_map(rows) {
                    word &= read(from, start + x);
                }
                if nx - x < 64 {
                    word |= u64::MAX << (nx - x);
                }
                let count = (nx - x).min(64).div_ceil(2);
                let pairs = even_bits(word & word >> 1) & u64::MAX >> (64 - count);
                let at = row + x / 2;
                to[at / 64] |= pairs << (at % 64);
                to[at / 64 + 1] |= pairs >> 1 >> (63 - at % 64);
            }
        }
    }
}

/// Brings every other bit, from the lowest on, into the lower half.
#[inline(always)]
fn even_bits(word: u64) -> u64 {
    let mut w = word & 0x5555_5555_5555_5555;
    w = (w | w >> 1) & 0x3333_3333_3333_3333;
    w = (w | w >> 2) & 0x0f0f_0f0f_0f0f_0f0f;
    w = (w | w >> 4) & 0x00ff_00ff_00ff_00ff;
    w = (w | w >> 8) & 0x0000_ffff_0000_ffff;
    (w | w >> 16) & 0xffff_ffff
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec;

    /// Chebyshev distance to the nearest clear cell inside the grid, by looking at every cell.
    fn distance(set: &[bool], grid: [usize; 3], cell: usize) -> usize {
        let place = |c: usize| [c % grid[0], c / grid[0] % grid[1], c / grid[0] / grid[1]];
        let here = place(cell);
        let apart = |c: usize| (0..3).map(|k| place(c)[k].abs_diff(here[k])).max().unwrap();
        (0..set.len()).filter(|&c| !set[c]).map(apart).min().unwrap_or(usize::MAX)
    }

    #[test]
    fn classes_follow_the_distance_to_the_nearest_empty_cell() {
        let mut seen = [0usize; CLASSES as usize];
        for grid in [[20, 17, 15], [70, 9, 11], [1, 13, 30], [3, 3, 3], [129, 4, 5]] {
            let n: usize = grid.iter().product();
            for seed in 0..6u64 {
                // A few clear cells: more of them with every seed, none with the first.
                let clear = |i: usize| (i as u64 * 0x9e37_79b9 + 77 * seed) % 2111 < seed * seed;
                let set: Vec<bool> = (0..n).map(|i| !clear(i)).collect();
                let mut full = vec![0u64; n.div_ceil(64)];
                set.iter().enumerate().for_each(|(i, &s)| full[i / 64] |= u64::from(s) << (i % 64));
                let mut interior = Interior::default();
                let longer = interior.longer(grid).unwrap();
                interior.update(longer, grid, &full);
                for cell in (0..n).filter(|&c| set[c]) {
                    let class = interior.class(&full, grid, cell);
                    let d = distance(&set, grid, cell);
                    // Surely so deep; and a cell that lies twice as deep, counted from what rounding hides,
                    // has the class at least.
                    let least = [1, 2, 3, 5][class as usize];
                    assert!(d >= least, "{grid:?} {seed} {cell}: class {class} at {d}");
                    let (deep, sure) =
                        [(2, 1), (4, 2), (8, 3)].into_iter().rfind(|(at, _)| d >= *at).unwrap_or((1, 0));
                    assert!(class >= sure, "{grid:?} {seed} {cell}: class {class} at {d}, {deep} or more");
                    seen[class as usize] += 1;
                }
            }
        }
        assert!(seen.iter().all(|&n| n > 50), "{seen:?}");
    }

    #[test]
    fn every_other_bit_is_kept() {
        for word in [0, u64::MAX, 0x1234_5678_9abc_def0, 1 << 62] {
            let expected = (0..32).fold(0, |sum, i| sum | (word >> (2 * i) & 1) << i);
            assert_eq!(even_bits(word), expected);
        }
    }
}
