//! Classes of cells by their distance to the nearest empty cell. A renderer whose skip map holds this
//! distance looks the map up less often far from empty cells than next to them.

use crate::memory::{replace_or_resize, try_grow};
use alloc::vec::Vec;
use entire_core::Result;

/// Smallest distance to the nearest empty cell, in cells, for each of the classes 1, 2 and 3. In class c, a
/// renderer reads its skip map once per 2^c cells.
const CLASS_DISTANCES: [usize; 3] = [2, 3, 5];

/// Number of bit vectors: one per entry of [`CLASS_DISTANCES`], and two as working memory.
const BUFFERS: usize = CLASS_DISTANCES.len() + 2;

/// For each class, a bit vector in which the cells of this class and of higher classes are set. Cells are
/// stored by rows along x; every row begins at a word boundary.
///
/// Cells outside the grid count as not empty, as in a renderer's skip map, which ends at the border of the
/// grid.
#[derive(Clone, Debug, Default)]
pub(super) struct Interior {
    bits: [Vec<u64>; BUFFERS],
    found: bool,
}

/// Number of words of a row along x.
fn row_words(grid: [usize; 3]) -> usize {
    grid[0].div_ceil(64)
}

impl Interior {
    /// Longer vectors for a grid, each `None` if the present vector is long enough.
    ///
    /// # Errors
    /// [`crate::ErrorKind::OutOfMemory`].
    pub(super) fn try_grow(&self, grid: [usize; 3]) -> Result<[Option<Vec<u64>>; BUFFERS]> {
        let words = row_words(grid) * grid[1] * grid[2];
        let mut out = [const { None }; BUFFERS];
        for (slot, present) in out.iter_mut().zip(&self.bits) {
            *slot = try_grow(present, words)?;
        }
        Ok(out)
    }

    /// Installs the longer vectors and invalidates the classes until [`Interior::find`].
    pub(super) fn fit(&mut self, longer: [Option<Vec<u64>>; BUFFERS], grid: [usize; 3]) {
        let words = row_words(grid) * grid[1] * grid[2];
        for (present, longer) in self.bits.iter_mut().zip(longer) {
            replace_or_resize(present, longer, words);
        }
        self.found = false;
    }

    /// Computes the classes, unless they are valid. `full` has one bit per cell, set where the cell is not
    /// empty. Called only when a ray needs a class.
    #[inline(always)]
    pub(super) fn find(&mut self, grid: [usize; 3], full: &[u64]) {
        if !self.found {
            self.find_now(grid, full);
        }
    }

    #[cold]
    #[inline(never)]
    fn find_now(&mut self, grid: [usize; 3], full: &[u64]) {
        let (words, [nx, ny, _]) = (row_words(grid), grid);
        self.found = true;
        let [second, third, fifth, a, b] = &mut self.bits;
        for (row, to) in b.chunks_exact_mut(words).enumerate() {
            for (w, to) in to.iter_mut().enumerate() {
                let left = nx - 64 * w;
                let outside = if left < 64 { u64::MAX << left } else { 0 };
                *to = read(full, nx * row + 64 * w) | outside;
            }
        }
        erode(b, second, a, words, ny);
        erode(second, third, a, words, ny);
        erode(third, b, a, words, ny);
        erode(b, fifth, a, words, ny);
    }

    /// Class of a cell that is not empty: 0 next to an empty cell, otherwise 1, 2 or 3 by the distance to
    /// the nearest empty cell, see [`CLASS_DISTANCES`].
    #[inline(always)]
    pub(super) fn class(&self, grid: [usize; 3], cell: usize) -> u32 {
        let (cell, nx) = (cell as u32, grid[0] as u32);
        let (row, x) = ((cell / nx) as usize, (cell % nx) as usize);
        let at = row * row_words(grid) + x / 64;
        let deep = |bits: &Vec<u64>| (bits.get(at).copied().unwrap_or(0) >> (x % 64) & 1) as u32;
        self.bits[..CLASS_DISTANCES.len()].iter().map(deep).sum()
    }
}

/// Reads 64 bits from any bit offset.
#[inline(always)]
fn read(bits: &[u64], at: usize) -> u64 {
    let word = |i: usize| bits.get(i).copied().unwrap_or(0);
    // Two shifts, because a single shift by 64 would overflow.
    word(at / 64) >> (at % 64) | word(at / 64 + 1) << 1 << (63 - at % 64)
}

/// Binary erosion, in one pass per axis: a set cell stays set if all of its neighbors inside the grid (26 at
/// most) are set.
///
/// The last word of a row has unused bits after the row's last cell. They must be set before the first
/// erosion. An erosion clears an unused bit only if it leaves the row's last cell clear. So a cleared unused
/// bit never clears a cell that would otherwise stay set.
fn erode(from: &[u64], to: &mut [u64], between: &mut [u64], words: usize, ny: usize) {
    // First pass: erosion along x, with carries between neighboring words.
    let along = |word: u64, before: u64, after: u64| word & (word << 1 | before) & (word >> 1 | after);
    if words == 1 {
        // The usual case, without carries.
        from.iter().zip(&mut *to).for_each(|(from, to)| *to = along(*from, 1, 1 << 63));
    } else {
        for (from, to) in from.chunks_exact(words).zip(to.chunks_exact_mut(words)) {
            for w in 0..words {
                let before = if w > 0 { from[w - 1] >> 63 } else { 1 };
                let after = if w + 1 < words { from[w + 1] << 63 } else { 1 << 63 };
                to[w] = along(from[w], before, after);
            }
        }
    }
    // Second pass: erosion along y, within slices. Third pass: erosion along z.
    for (from, to) in to.chunks_exact(words * ny).zip(between.chunks_exact_mut(words * ny)) {
        all_three(from, to, words);
    }
    all_three(between, to, words * ny);
}

/// Writes the bitwise AND of every word and the words `stride` before and after it, where they exist.
fn all_three(from: &[u64], to: &mut [u64], stride: usize) {
    to.copy_from_slice(from);
    let end = from.len() - stride.min(from.len());
    to[..end].iter_mut().zip(&from[from.len() - end..]).for_each(|(to, next)| *to &= next);
    to[from.len() - end..].iter_mut().zip(&from[..end]).for_each(|(to, last)| *to &= last);
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec;

    /// Chebyshev distance to the nearest clear cell inside the grid, by brute force.
    fn distance(set: &[bool], grid: [usize; 3], cell: usize) -> usize {
        let place = |c: usize| [c % grid[0], c / grid[0] % grid[1], c / grid[0] / grid[1]];
        let here = place(cell);
        let apart = |c: usize| (0..3).map(|k| place(c)[k].abs_diff(here[k])).max().unwrap();
        (0..set.len()).filter(|&c| !set[c]).map(apart).min().unwrap_or(usize::MAX)
    }

    #[test]
    fn classes_are_those_of_the_distance_to_the_nearest_empty_cell() {
        let mut seen = [0usize; CLASS_DISTANCES.len() + 1];
        let mut interior = Interior::default();
        for grid in [[20, 17, 15], [70, 9, 11], [1, 13, 30], [3, 3, 3], [129, 4, 5], [64, 1, 1], [1, 1, 1]] {
            let n: usize = grid.iter().product();
            for seed in 0..6u64 {
                // With the first seed no cell is clear; with each further seed, more cells are clear.
                let clear = |i: usize| (i as u64 * 0x9e37_79b9 + 77 * seed) % 2111 < seed * seed;
                let set: Vec<bool> = (0..n).map(|i| !clear(i)).collect();
                let mut full = vec![0u64; n.div_ceil(64)];
                set.iter().enumerate().for_each(|(i, &s)| full[i / 64] |= u64::from(s) << (i % 64));
                let longer = interior.try_grow(grid).unwrap();
                interior.fit(longer, grid);
                interior.find(grid, &full);
                for cell in (0..n).filter(|&c| set[c]) {
                    let d = distance(&set, grid, cell);
                    let class = CLASS_DISTANCES.iter().filter(|&&from| d >= from).count();
                    assert_eq!(interior.class(grid, cell) as usize, class, "{grid:?} {seed} {cell}: {d}");
                    seen[class] += 1;
                }
            }
        }
        assert!(seen.iter().all(|&n| n > 50), "{seen:?}");
    }
}
