//! Which cells and blocks of a volume a transfer function leaves empty: 64 pairs of bounds at a time.

use crate::kernels::{Kernel, Level, Simd};
use crate::scene::TABLE_LEN;

/// Runs of visible table entries up to which bounds are compared with each run; with more, each pair is looked
/// up in a prefix table.
const MAX_RUNS: usize = 8;

/// The visible entries of a table.
pub(super) struct Visible<'a> {
    /// Visible entries below each entry.
    below: &'a [u16; TABLE_LEN + 1],
    runs: [(u8, u8); MAX_RUNS],
    /// Runs of visible entries, or `None` where there are more than [`MAX_RUNS`].
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

    /// A bit for each of 64 pairs of bounds, set where an entry between them is visible.
    #[inline(always)]
    fn bits<S: Simd>(&self, simd: S, low: &[u8; 64], high: &[u8; 64]) -> u64 {
        let Some(count) = self.count else {
            let seen = |i: usize| self.below[usize::from(high[i]) + 1] != self.below[usize::from(low[i])];
            return (0..64).fold(0, |bits, i| bits | u64::from(seen(i)) << i);
        };
        self.runs[..count].iter().fold(0, |bits, &(first, last)| bits | simd.overlaps(low, high, first, last))
    }
}

/// Writes a bit for each pair of bounds, 64 in a word, set where an entry between them is visible; gives how many
/// are set. There must be a word for every 64 pairs and the rest of them.
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
        let ((lows, low), (highs, high)) = (self.low.as_chunks::<64>(), self.high.as_chunks::<64>());
        let mut sum = 0;
        for ((word, low), high) in self.bits.iter_mut().zip(lows).zip(highs) {
            *word = self.visible.bits(simd, low, high);
            sum += u64::from(word.count_ones());
        }
        if let (Some(word), false) = (self.bits.get_mut(lows.len()), low.is_empty()) {
            let (mut last_low, mut last_high) = ([0; 64], [0; 64]);
            last_low[..low.len()].copy_from_slice(low);
            last_high[..high.len()].copy_from_slice(high);
            *word = self.visible.bits(simd, &last_low, &last_high) & ((1 << low.len()) - 1);
            sum += u64::from(word.count_ones());
        }
        sum
    }
}

/// Writes the share of each cell's blocks whose bit is set, and a bit for each cell, set where that is above zero;
/// gives the sum of the shares. `first` says where the blocks of each cell begin and where the last one's
/// end, `most` how many a cell has that the volume's end does not cut. `bits` must have a word beyond that of
/// the last block.
pub(super) fn share(bits: &[u64], first: &[u32], most: usize, shares: &mut [f32], full: &mut [u64]) -> f64 {
    Level::detect().run(Share { bits, first, most, shares, full })
}

struct Share<'a> {
    bits: &'a [u64],
    first: &'a [u32],
    most: usize,
    shares: &'a mut [f32],
    full: &'a mut [u64],
}

impl Kernel for Share<'_> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> f64 {
        let (mut eighths, mut sum) = (0u64, 0.0f64);
        let mut at = 0;
        self.full.fill(0);
        while at < self.shares.len() {
            let begin = self.first[at] as usize;
            let aligned = self.most == 8 && begin.is_multiple_of(64);
            if aligned && self.first.get(at + 8).is_some_and(|&end| end as usize == begin + 64) {
                // Eight cells of eight blocks: a byte each.
                let word = self.bits[begin / 64];
                eighths += u64::from(word.count_ones());
                for (share, byte) in self.shares[at..at + 8].iter_mut().zip(word.to_le_bytes()) {
                    *share = byte.count_ones() as f32 * 0.125;
                }
                const LOW: u64 = 0x7f7f_7f7f_7f7f_7f7f;
                // The highest bit of each byte that is not zero, all of them brought together by a product.
                let full = (((word & LOW) + LOW) | word) & !LOW;
                let full = (full >> 7).wrapping_mul(0x0102_0408_1020_4080) >> 56;
                self.full[at / 64] |= full << (at % 64);
                if at % 64 > 56 {
                    self.full[at / 64 + 1] |= full >> (64 - at % 64);
                }
                at += 8;
                continue;
            }
            let end = self.first[at + 1] as usize;
            let full = count(self.bits, begin, end);
            let share = full as f32 / (end - begin) as f32;
            self.shares[at] = share;
            sum += f64::from(share);
            self.full[at / 64] |= u64::from(full > 0) << (at % 64);
            at += 1;
        }
        sum + eighths as f64 * 0.125
    }
}

/// How many of the bits from `first` to before `end` are set. `bits` must have a word beyond that of `end`.
#[inline(always)]
fn count(bits: &[u64], first: usize, end: usize) -> u32 {
    let (mut at, mut sum) = (first, 0);
    while at < end {
        let (word, shift) = (at / 64, at % 64);
        let len = (end - at).min(64);
        // Two shifts: one by 64 has no meaning.
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
                below[i + 1] = below[i] + u16::from((i / (period / 3)).is_multiple_of(3) && i > 40);
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

    #[test]
    fn shares_are_those_of_one_block_after_another() {
        let bits = mixed(40);
        // Cells of eight blocks, with smaller ones among them.
        for (most, smaller) in [(8usize, 0usize), (8, 13), (27, 5)] {
            let mut first = vec![0u32];
            for i in 0..60 {
                let len = if smaller > 0 && i % smaller == smaller - 1 { most / 2 } else { most };
                first.push(first[i] + len as u32);
            }
            let (mut shares, mut full) = (vec![0.0; 60], vec![u64::MAX; 1]);
            let sum = share(&bits, &first, most, &mut shares, &mut full);
            let mut expected = 0.0;
            for (i, &share) in shares.iter().enumerate() {
                let own = first[i]..first[i + 1];
                let full: u64 = own.clone().map(|b| bits[b as usize / 64] >> (b % 64) & 1).sum();
                assert_eq!(share, full as f32 / own.len() as f32, "cell {i} of {most} blocks");
                expected += f64::from(share);
            }
            assert!((sum - expected).abs() < 1e-9, "{sum} {expected}");
            let above: Vec<bool> = shares.iter().map(|&share| share > 0.0).collect();
            assert_eq!(full, bits_of(&above));
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
