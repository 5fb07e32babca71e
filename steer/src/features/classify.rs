//! Finds the cells and blocks of a volume that are empty under a transfer function. Classifies 64 cells or
//! blocks at a time by their lowest and highest values.

use entire_core::kernels::{Kernel, Level, Simd};
use entire_core::memory::chunks;
use entire_core::scene::TABLE_LEN;

/// Largest number of runs of visible table entries for which each pair of bounds is compared with every run.
/// With more runs, each pair is looked up in a table of prefix sums.
const MAX_RUNS: usize = 8;

/// Visible entries of a transfer table.
pub(super) struct Visible<'a> {
    /// Prefix sums: number of visible entries below each entry.
    below: &'a [u16; TABLE_LEN + 1],
    runs: [(u8, u8); MAX_RUNS],
    /// Number of runs of visible entries; `None` if there are more than [`MAX_RUNS`].
    count: Option<usize>,
}

impl<'a> Visible<'a> {
    pub(super) fn new(below: &'a [u16; TABLE_LEN + 1]) -> Self {
        let mut runs = [(0, 0); MAX_RUNS];
        let mut count = 0;
        let mut open = false;
        for i in 0..TABLE_LEN {
            let visible = below[i + 1] > below[i];
            if visible && !open {
                if count == MAX_RUNS {
                    return Self { below, runs, count: None };
                }
                runs[count] = (i as u8, i as u8);
                count += 1;
            } else if visible {
                runs[count - 1].1 = i as u8;
            }
            open = visible;
        }
        Self { below, runs, count: Some(count) }
    }

    /// One bit per pair of bounds, set where an entry within the bounds is visible.
    #[inline(always)]
    fn bits<S: Simd>(&self, simd: S, low: &[u8; 64], high: &[u8; 64]) -> u64 {
        let Some(count) = self.count else {
            let seen = |i: usize| self.below[usize::from(high[i]) + 1] != self.below[usize::from(low[i])];
            return (0..64).fold(0, |bits, i| bits | u64::from(seen(i)) << i);
        };
        self.runs[..count].iter().fold(0, |bits, &(first, last)| bits | simd.overlaps(low, high, first, last))
    }

    /// One bit per pair of bounds after the last whole group of 64, set where an entry within the bounds is
    /// visible; bits beyond these pairs are zero.
    #[inline(always)]
    fn rest<S: Simd>(&self, simd: S, low: &[u8], high: &[u8]) -> u64 {
        let (low, high) = (chunks::<64, _>(low).1, chunks::<64, _>(high).1);
        let (mut last_low, mut last_high) = ([0; 64], [0; 64]);
        last_low[..low.len()].copy_from_slice(low);
        last_high[..high.len()].copy_from_slice(high);
        self.bits(simd, &last_low, &last_high) & ((1 << low.len()) - 1)
    }
}

/// Writes one bit per pair of bounds, 64 per word, set where an entry within the bounds is visible; returns
/// the number of bits set. `bits` must have a word for every group of 64 pairs, including a last partial
/// group.
pub(super) fn classify(visible: &Visible<'_>, low: &[u8], high: &[u8], bits: &mut [u64]) -> u64 {
    Level::detect().run(Classify { visible, low, high, bits })
}

struct Classify<'a> {
    visible: &'a Visible<'a>,
    low: &'a [u8],
    high: &'a [u8],
    bits: &'a mut [u64],
}

impl Kernel for Classify<'_> {
    type Output = u64;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> u64 {
        let ((lows, low), (highs, _)) = (chunks::<64, _>(self.low), chunks::<64, _>(self.high));
        let mut sum = 0;
        for ((word, low), high) in self.bits.iter_mut().zip(lows).zip(highs) {
            *word = self.visible.bits(simd, low, high);
            sum += u64::from(word.count_ones());
        }
        if let (Some(word), false) = (self.bits.get_mut(lows.len()), low.is_empty()) {
            *word = self.visible.rest(simd, self.low, self.high);
            sum += u64::from(word.count_ones());
        }
        sum
    }
}

/// Blocks of a volume, ordered by cell.
#[derive(Clone, Copy)]
pub(super) struct Blocks<'a> {
    /// Lowest and highest table entry that samples in each block can reach.
    pub(super) low: &'a [u8],
    pub(super) high: &'a [u8],
    /// Index of each cell's first block, and one past the last block.
    pub(super) first: &'a [u32],
    /// Number of blocks in a whole cell, which the volume's border does not cut.
    pub(super) most: usize,
    /// True if every cell has `most` blocks.
    pub(super) uniform: bool,
}

impl Blocks<'_> {
    /// True if each word of block bits covers either eight whole cells or a part of a single cell. The
    /// cells are then classified before their blocks.
    fn fill_words(&self) -> bool {
        self.uniform && (self.most == 8 || self.most % 64 == 0)
    }

    /// Share of a cell's blocks whose bit is set. `bits` must have one word more than the blocks need.
    #[inline(always)]
    pub(super) fn share(&self, bits: &[u64], cell: usize) -> f32 {
        let [begin, end] = if self.uniform {
            [cell * self.most, (cell + 1) * self.most]
        } else {
            [self.first[cell] as usize, self.first[cell + 1] as usize]
        };
        count(bits, begin, end) as f32 / (end - begin) as f32
    }
}

/// Writes one bit per cell to `full`, set where the cell has a block with a visible entry within its bounds.
/// Writes one bit per block of these cells to `bits`, set where an entry within the block's bounds is
/// visible; the bits of other cells' blocks are unspecified. Returns the sum, over all cells, of the share of
/// the cell's blocks whose bit is set. `low` and `high` are the bounds of the cells. `bits` must have one
/// word more than the blocks need.
pub(super) fn classify_blocks(
    visible: &Visible<'_>,
    low: &[u8],
    high: &[u8],
    blocks: Blocks<'_>,
    bits: &mut [u64],
    full: &mut [u64],
) -> f64 {
    if blocks.fill_words() {
        Level::detect().run(ClassifyWords { visible, low, high, blocks, bits, full })
    } else {
        Level::detect().run(Classify { visible, low: blocks.low, high: blocks.high, bits });
        Level::detect().run(Gather { bits, blocks, full })
    }
}

/// Kernel of [`classify_blocks`] if [`Blocks::fill_words`] is true. Classifies only words of cells whose own
/// bounds contain a visible entry.
struct ClassifyWords<'a> {
    visible: &'a Visible<'a>,
    low: &'a [u8],
    high: &'a [u8],
    blocks: Blocks<'a>,
    bits: &'a mut [u64],
    full: &'a mut [u64],
}

impl Kernel for ClassifyWords<'_> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> f64 {
        let Self { visible, low, high, blocks, bits, full } = self;
        Classify { visible, low, high, bits: &mut *full }.run(simd);
        let each = blocks.most;
        let (lows, highs) = (chunks::<64, _>(blocks.low).0, chunks::<64, _>(blocks.high).0);
        let mut sum = 0u64;
        if each == 8 {
            for (i, (cells, bits)) in full.iter_mut().zip(bits.chunks_mut(8)).enumerate() {
                let mut found = 0;
                // Each word of `bits` holds eight cells of eight blocks, one byte per cell.
                for (part, word) in
                    bits.iter_mut().enumerate().filter(|(part, _)| *cells >> (8 * part) & 0xff != 0)
                {
                    let at = 8 * i + part;
                    *word = match (lows.get(at), highs.get(at)) {
                        (Some(low), Some(high)) => visible.bits(simd, low, high),
                        _ => visible.rest(simd, blocks.low, blocks.high),
                    };
                    sum += u64::from(word.count_ones());
                    found |= occupied_bytes(*word) << (8 * part);
                }
                *cells = found;
            }
        } else {
            let words = each / 64;
            for (cell, bits) in bits.chunks_exact_mut(words).enumerate().take(low.len()) {
                let (word, bit) = (&mut full[cell / 64], 1 << (cell % 64));
                if *word & bit == 0 {
                    continue;
                }
                let mut ones = 0;
                for (i, bits) in bits.iter_mut().enumerate() {
                    let at = words * cell + i;
                    *bits = visible.bits(simd, &lows[at], &highs[at]);
                    ones += u64::from(bits.count_ones());
                }
                if ones == 0 {
                    *word &= !bit;
                }
                sum += ones;
            }
        }
        // The division is exact: the sum is an integer and `each` is a power of two.
        sum as f64 / each as f64
    }
}

/// One bit per byte of a word, set where the byte is not zero.
#[inline(always)]
fn occupied_bytes(word: u64) -> u64 {
    const LOW: u64 = 0x7f7f_7f7f_7f7f_7f7f;
    // The highest bit of each nonzero byte; the product gathers these bits into one byte.
    let full = (((word & LOW) + LOW) | word) & !LOW;
    (full >> 7).wrapping_mul(0x0102_0408_1020_4080) >> 56
}

/// Kernel that writes one bit per cell, set where at least one block of the cell has its bit set. Returns the
/// sum, over all cells, of the share of the cell's blocks whose bit is set.
struct Gather<'a> {
    bits: &'a [u64],
    blocks: Blocks<'a>,
    full: &'a mut [u64],
}

impl Kernel for Gather<'_> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> f64 {
        let Self { bits, blocks: Blocks { first, most, .. }, full } = self;
        let (mut eighths, mut sum) = (0u64, 0.0f64);
        let mut at = 0;
        full.fill(0);
        while at + 1 < first.len() {
            let begin = first[at] as usize;
            let aligned = most == 8 && begin % 64 == 0;
            if aligned && first.get(at + 8).is_some_and(|&end| end as usize == begin + 64) {
                // A whole word holds eight cells with eight blocks each.
                let word = bits[begin / 64];
                eighths += u64::from(word.count_ones());
                let occupied = occupied_bytes(word);
                full[at / 64] |= occupied << (at % 64);
                if at % 64 > 56 {
                    full[at / 64 + 1] |= occupied >> (64 - at % 64);
                }
                at += 8;
                continue;
            }
            let end = first[at + 1] as usize;
            let ones = count(bits, begin, end);
            sum += f64::from(ones as f32 / (end - begin) as f32);
            full[at / 64] |= u64::from(ones > 0) << (at % 64);
            at += 1;
        }
        sum + eighths as f64 * 0.125
    }
}

/// Number of bits set from `first` up to, but not including, `end`. `bits` must have a word after the word of
/// bit `end`.
#[inline(always)]
fn count(bits: &[u64], first: usize, end: usize) -> u32 {
    let (mut at, mut sum) = (first, 0);
    while at < end {
        let (word, shift) = (at / 64, at % 64);
        let len = (end - at).min(64);
        // Two shifts, because a single shift by 64 would overflow.
        let ahead = bits[word + 1] << 1 << (63 - shift);
        sum += ((bits[word] >> shift | ahead) & u64::MAX >> (64 - len)).count_ones();
        at += len;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec;
    use alloc::vec::Vec;

    #[test]
    fn bits_are_those_of_one_pair_after_another() {
        for period in [3usize, 7, 20, 100, 300] {
            let mut below = [0u16; TABLE_LEN + 1];
            for i in 0..TABLE_LEN {
                below[i + 1] = below[i] + u16::from((i / (period / 3)) % 3 == 0 && i > 40);
            }
            let visible = Visible::new(&below);
            assert_eq!(visible.count.is_none(), period < 50, "{period}");
            for n in [1usize, 63, 64, 65, 1000] {
                let low: Vec<u8> = (0..n).map(|i| (i * 37 % 256) as u8).collect();
                let high: Vec<u8> = low.iter().map(|&l| l.saturating_add(l % 9)).collect();
                let seen = |e: u8| below[usize::from(e) + 1] > below[usize::from(e)];
                let expected: Vec<bool> = low.iter().zip(&high).map(|(&l, &h)| (l..=h).any(seen)).collect();
                let bits = bits_of(&expected);
                for level in Level::available() {
                    let mut found = vec![u64::MAX; n.div_ceil(64)];
                    let kernel = Classify { visible: &visible, low: &low, high: &high, bits: &mut found };
                    let sum = level.run(kernel);
                    assert_eq!(found, bits, "{level:?}, {n} pairs, period {period}");
                    assert_eq!(sum, expected.iter().filter(|seen| **seen).count() as u64);
                }
            }
        }
    }

    fn bits_of(cells: &[bool]) -> Vec<u64> {
        let word = |cells: &[bool]| cells.iter().enumerate().map(|(i, &c)| u64::from(c) << i).sum();
        cells.chunks(64).map(word).collect()
    }

    fn mixed(words: u64) -> Vec<u64> {
        (0..words).map(|i| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5555_0f0f_3333_00ff).collect()
    }

    /// Compares [`classify_blocks`] with a loop over single blocks. In some cases, all cells have the same
    /// number of blocks: a multiple of the 64 bits of a word, or less than 64. In other cases, some cells
    /// have fewer blocks.
    #[test]
    fn shares_are_those_of_one_block_after_another() {
        let mut below = [0u16; TABLE_LEN + 1];
        for i in 0..TABLE_LEN {
            below[i + 1] = below[i] + u16::from((40..90).contains(&i) || i == 200);
        }
        let visible = Visible::new(&below);
        let seen = |l: u8, h: u8| below[usize::from(h) + 1] > below[usize::from(l)];
        for (cells, most, smaller) in [
            (60usize, 8usize, 0usize),
            (64, 8, 0),
            (77, 8, 0),
            (60, 8, 13),
            (60, 27, 5),
            (9, 64, 0),
            (5, 128, 0),
            (130, 2, 0),
        ] {
            let mut first = vec![0u32];
            for i in 0..cells {
                let len = if smaller > 0 && i % smaller == smaller - 1 { most / 2 } else { most };
                first.push(first[i] + len as u32);
            }
            let n = first[cells] as usize;
            // Neighboring blocks have similar bounds.
            let low: Vec<u8> = (0..n).map(|i| ((i / 5 * 37 + i % 7) % 256) as u8).collect();
            let high: Vec<u8> =
                low.iter().enumerate().map(|(i, &l)| l.saturating_add((i % 9) as u8)).collect();
            let of = |c: usize| first[c] as usize..first[c + 1] as usize;
            let least: Vec<u8> = (0..cells).map(|c| *low[of(c)].iter().min().unwrap()).collect();
            let largest: Vec<u8> = (0..cells).map(|c| *high[of(c)].iter().max().unwrap()).collect();
            let expected: Vec<u32> =
                (0..cells).map(|c| of(c).filter(|&b| seen(low[b], high[b])).count() as u32).collect();
            for uniform in [false, smaller == 0] {
                let blocks = Blocks { low: &low, high: &high, first: &first, most, uniform };
                let (mut bits, mut full) =
                    (vec![u64::MAX; n.div_ceil(64) + 1], vec![u64::MAX; cells.div_ceil(64)]);
                let sum = classify_blocks(&visible, &least, &largest, blocks, &mut bits, &mut full);
                let occupied: Vec<bool> = expected.iter().map(|&n| n > 0).collect();
                assert_eq!(full, bits_of(&occupied), "{cells} {most} {smaller} {uniform}");
                let mut shares = 0.0;
                for c in (0..cells).filter(|&c| occupied[c]) {
                    let share = expected[c] as f32 / of(c).len() as f32;
                    assert_eq!(blocks.share(&bits, c), share);
                    shares += f64::from(share);
                }
                assert!((sum - shares).abs() < 1e-9, "{sum} {shares}");
            }
        }
    }

    #[test]
    fn bits_are_counted_across_words() {
        let bits = mixed(5);
        let one = |i: usize| (bits[i / 64] >> (i % 64) & 1) as u32;
        for first in 0..130 {
            for end in first..250 {
                assert_eq!(count(&bits, first, end), (first..end).map(one).sum::<u32>(), "{first}..{end}");
            }
        }
    }
}
