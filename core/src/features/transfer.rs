//! What a transfer function makes of a volume: emptiness and extinction of each cell.

use super::VolumeSummary;
use crate::Result;
use crate::memory::reserve;
use crate::scene::{TABLE_LEN, TransferTable};
use alloc::vec::Vec;

/// Length over which neighboring values along a ray are taken as one, in reference steps. A cell's extinction
/// is that of its mean transmittance over this length: with 0 it would be the mean extinction, which
/// overrates cells that hold a few opaque voxels among transparent ones.
pub(crate) const CORRELATION_LENGTH: f32 = 2.0;

/// Opacities are capped here where extinction (−ln(1 − α)) is formed.
const MAX_OPACITY: f32 = 1.0 - 1.0e-6;

/// What a cell does to a ray that crosses it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Optics {
    /// Extinction per reference step.
    pub(super) extinction: f32,
    /// Share of the cell's values with any opacity.
    pub(super) visible: f32,
    /// Share of the cell's blocks that are not empty.
    pub(super) occupied: f32,
}

/// Numbers kept of a cell's [`Optics`]: extinction and visible.
pub(super) const OPTICS: usize = 2;

/// Cells whose flags share a word: in the lower half, whether a cell is not empty, in the upper half, whether
/// its [`Optics`] are those of the present table.
pub(super) const FLAGGED: usize = 16;

/// Runs of visible table entries up to which cells are compared with each run, many cells at a time; with
/// more, each cell is looked up in a prefix table.
const MAX_RANGES: usize = 8;

/// Emptiness and extinction of each cell of a volume under a transfer function.
///
/// An edit decides at once which cells are empty. What a cell that is not empty does to a ray is computed
/// when a ray first meets the cell, and kept until the next edit: an edit costs what its frame looks at, not
/// what the volume holds.
#[derive(Clone, Debug)]
pub struct TransferSummary {
    /// Two bits per cell, of [`FLAGGED`] cells in a word.
    flags: Vec<u32>,
    /// Share of each cell's blocks that are not empty, where cells hold several blocks; else nothing.
    occupied: Vec<f32>,
    /// The [`Optics`] of each cell whose flag says that they are known.
    optics: Vec<[f32; OPTICS]>,
    /// Table entries with opacity below each entry.
    opaque: [u16; TABLE_LEN + 1],
    /// Sum of transmittances over the correlation length below each entry. In double precision: differences
    /// of sums near 256 must resolve transmittances near 1e-12.
    transmittance: [f64; TABLE_LEN + 1],
    grid: [usize; 3],
    /// Chebyshev distance in cells to the nearest occupied cell; stale unless `distance_ready`.
    distance: Vec<u8>,
    distance_ready: bool,
    /// Working memory: flags of blocks, or two lines of cells.
    line: Vec<u8>,
    occupied_share: f32,
    mean_opacity: f32,
    mean_square_opacity: f32,
    mean_extinction: f32,
    visible_share: f32,
    max_opacity: f32,
}

impl TransferSummary {
    /// Applies a table to a volume.
    ///
    /// # Panics
    /// Where there is no memory for three numbers per cell of the volume; see [`TransferSummary::try_new`].
    pub fn new(volume: &VolumeSummary, table: &TransferTable) -> Self {
        Self::try_new(volume, table).unwrap_or_else(|error| panic!("{error}"))
    }

    /// As [`TransferSummary::new`].
    ///
    /// # Errors
    /// [`crate::ErrorKind::OutOfMemory`] where there is no room for three numbers per cell of the volume.
    pub fn try_new(volume: &VolumeSummary, table: &TransferTable) -> Result<Self> {
        let mut summary = Self {
            flags: Vec::new(),
            occupied: Vec::new(),
            optics: Vec::new(),
            opaque: [0; TABLE_LEN + 1],
            transmittance: [0.0; TABLE_LEN + 1],
            grid: volume.cells(),
            distance: Vec::new(),
            distance_ready: false,
            line: Vec::new(),
            occupied_share: 0.0,
            mean_opacity: 0.0,
            mean_square_opacity: 0.0,
            mean_extinction: 0.0,
            visible_share: 0.0,
            max_opacity: 0.0,
        };
        summary.try_update(volume, table)?;
        Ok(summary)
    }

    /// Applies another table, or the table to another volume. Allocates only when the volume has more cells
    /// than any before it.
    ///
    /// # Panics
    /// As [`TransferSummary::new`].
    pub fn update(&mut self, volume: &VolumeSummary, table: &TransferTable) {
        if let Err(error) = self.try_update(volume, table) {
            panic!("{error}");
        }
    }

    /// As [`TransferSummary::update`].
    ///
    /// # Errors
    /// As [`TransferSummary::try_new`]; nothing has changed then.
    pub fn try_update(&mut self, volume: &VolumeSummary, table: &TransferTable) -> Result<()> {
        let n = volume.cell_count();
        let longest = volume.cells().into_iter().max().unwrap_or(1);
        let line = (2 * longest).max(n).max(volume.block_ranges().0.len()).max(self.line.len());
        let shares = if volume.first_blocks().is_some() { n } else { 0 };
        reserve(&mut self.flags, n.div_ceil(FLAGGED))?;
        reserve(&mut self.occupied, shares)?;
        reserve(&mut self.optics, n)?;
        reserve(&mut self.distance, n)?;
        reserve(&mut self.line, line)?;
        self.flags.resize(n.div_ceil(FLAGGED), 0);
        self.occupied.resize(shares, 0.0);
        self.optics.resize(n, [0.0; OPTICS]);
        self.distance.resize(n, 0);
        self.line.resize(line, 0);
        self.grid = volume.cells();
        self.distance_ready = false;
        self.read_table(volume, table);
        self.classify(volume);
        Ok(())
    }

    /// Prefix tables, and what follows from the table and the volume's histogram alone.
    fn read_table(&mut self, volume: &VolumeSummary, table: &TransferTable) {
        let ratio = CORRELATION_LENGTH / table.unit_distance();
        let (mut mean, mut square, mut extinction, mut shown) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
        self.max_opacity = 0.0;
        for (i, entry) in table.rgba().iter().enumerate() {
            let counts = table.is_visible(i);
            let alpha = if counts { entry[3] } else { 0.0 };
            let (log, through) = if counts {
                let log = libm::log1pf(-alpha.min(MAX_OPACITY));
                (log, libm::expf(ratio * log))
            } else {
                (0.0, 1.0)
            };
            self.opaque[i + 1] = self.opaque[i] + u16::from(counts);
            self.transmittance[i + 1] = self.transmittance[i] + f64::from(through);
            let share = f64::from(volume.histogram()[i]);
            mean += share * f64::from(alpha);
            square += share * f64::from(alpha) * f64::from(alpha);
            extinction -= share * f64::from(log) / f64::from(table.unit_distance());
            shown += share * f64::from(u8::from(counts));
            self.max_opacity = self.max_opacity.max(alpha);
        }
        self.mean_opacity = mean as f32;
        self.mean_square_opacity = square as f32;
        self.mean_extinction = extinction as f32;
        self.visible_share = shown as f32;
    }

    /// Which cells are empty, and what share of the others' blocks is not.
    fn classify(&mut self, volume: &VolumeSummary) {
        let (low, high) = volume.cell_ranges();
        let n = low.len();
        let mut ranges = [(0u8, 0u8); MAX_RANGES];
        let ranges = self.visible_ranges(&mut ranges);
        let mut sum = 0.0f64;
        match volume.first_blocks() {
            None => {
                let flags = &mut self.line[..n];
                flag(low, high, ranges, &self.opaque, flags);
                // 128 flags at most: their sum fits a byte.
                let count: u64 = flags.chunks(128).map(|f| u64::from(f.iter().copied().sum::<u8>())).sum();
                sum = count as f64;
                pack(flags, &mut self.flags);
            }
            Some(first) => {
                let (block_low, block_high) = volume.block_ranges();
                let flags = &mut self.line[..block_low.len()];
                flag(block_low, block_high, ranges, &self.opaque, flags);
                for (occupied, range) in self.occupied.iter_mut().zip(first.windows(2)) {
                    let flags = &flags[range[0] as usize..range[1] as usize];
                    let full = match <[u8; 8]>::try_from(flags) {
                        // Eight flags of 0 or 1: the product's highest byte is their sum.
                        Ok(eight) => {
                            (u64::from_le_bytes(eight).wrapping_mul(0x0101_0101_0101_0101) >> 56) as usize
                        }
                        Err(_) => flags.iter().map(|&f| usize::from(f)).sum(),
                    };
                    *occupied = if full == 0 { 0.0 } else { full as f32 / flags.len() as f32 };
                    sum += f64::from(*occupied);
                }
                let flags = &mut self.line[..n];
                for (flag, &occupied) in flags.iter_mut().zip(&self.occupied) {
                    *flag = u8::from(occupied > 0.0);
                }
                pack(flags, &mut self.flags);
            }
        }
        self.occupied_share = (sum / n as f64) as f32;
    }

    /// The runs of visible entries as (first, last), or `None` where there are more than [`MAX_RANGES`].
    fn visible_ranges<'a>(&self, out: &'a mut [(u8, u8); MAX_RANGES]) -> Option<&'a [(u8, u8)]> {
        let mut len = 0;
        let mut open = false;
        for i in 0..TABLE_LEN {
            let visible = self.opaque[i + 1] > self.opaque[i];
            if visible && !open {
                if len == MAX_RANGES {
                    return None;
                }
                out[len] = (i as u8, i as u8);
                len += 1;
            } else if visible {
                out[len - 1].1 = i as u8;
            }
            open = visible;
        }
        Some(&out[..len])
    }

    /// What a cell that is not empty does to a ray.
    #[inline(always)]
    pub(super) fn optics(&mut self, volume: &VolumeSummary, cell: usize) -> Optics {
        let known = self.flags[cell / FLAGGED] >> (FLAGGED + cell % FLAGGED) & 1 != 0;
        if !known {
            self.compute(volume, cell);
        }
        let [extinction, visible] = self.optics[cell];
        Optics { extinction, visible, occupied: self.occupied.get(cell).copied().unwrap_or(1.0) }
    }

    /// Computes what a cell does to a ray, and keeps it until the next edit.
    #[cold]
    #[inline(never)]
    pub(super) fn compute(&mut self, volume: &VolumeSummary, cell: usize) {
        let (mut t, mut v) = (0.0f32, 0.0f32);
        for pair in volume.quantiles(cell).windows(2) {
            let (a, b) = (usize::from(pair[0]), usize::from(pair[1]));
            let inverse = RECIPROCAL[b - a];
            t += (self.transmittance[b + 1] - self.transmittance[a]) as f32 * inverse;
            v += f32::from(self.opaque[b + 1] - self.opaque[a]) * inverse;
        }
        let t = (t * (1.0 / super::QUANTILES as f32)).clamp(1.0e-12, 1.0);
        let visible = (v * (1.0 / super::QUANTILES as f32)).clamp(0.0, 1.0);
        let extinction = -libm::logf(t) * (1.0 / CORRELATION_LENGTH);
        self.optics[cell] = [extinction, visible];
        self.flags[cell / FLAGGED] |= 1 << (FLAGGED + cell % FLAGGED);
    }

    /// What is kept of all cells, for packets of rays: [`OPTICS`] numbers per cell, good where its flag says
    /// so.
    #[inline(always)]
    pub(super) fn kept_optics(&self) -> &[f32] {
        self.optics.as_flattened()
    }

    /// Share of each cell's blocks that are not empty, where cells hold several blocks; else nothing.
    #[inline(always)]
    pub(super) fn occupied_shares(&self) -> &[f32] {
        &self.occupied
    }

    /// Number of cells.
    pub(super) fn cell_count(&self) -> usize {
        self.optics.len()
    }

    /// Flags of [`FLAGGED`] cells in each word.
    #[inline(always)]
    pub(super) fn flags(&self) -> &[u32] {
        &self.flags
    }

    /// Whether a cell is not empty; what lies outside the grid is.
    #[inline(always)]
    pub(super) fn is_occupied(&self, cell: usize) -> bool {
        self.flags.get(cell / FLAGGED).is_some_and(|word| word >> (cell % FLAGGED) & 1 != 0)
    }

    /// Share of the volume's blocks that are not empty.
    pub(crate) fn occupied_share(&self) -> f32 {
        self.occupied_share
    }

    /// Opacity of the table averaged over the volume's voxels.
    pub(crate) fn mean_opacity(&self) -> f32 {
        self.mean_opacity
    }

    /// Squared opacity averaged over the volume's voxels.
    pub(crate) fn mean_square_opacity(&self) -> f32 {
        self.mean_square_opacity
    }

    /// Extinction per reference step averaged over the volume's voxels.
    pub(crate) fn mean_extinction(&self) -> f32 {
        self.mean_extinction
    }

    /// Share of voxels with any opacity.
    pub(crate) fn visible_share(&self) -> f32 {
        self.visible_share
    }

    /// Largest opacity in the table.
    pub(crate) fn max_opacity(&self) -> f32 {
        self.max_opacity
    }

    /// Whether a cell is empty, so that a renderer skips it whole.
    ///
    /// # Panics
    /// When the cell lies outside the grid.
    #[cfg(test)]
    pub(crate) fn is_empty(&self, x: usize, y: usize, z: usize) -> bool {
        let g = self.grid;
        assert!(x < g[0] && y < g[1] && z < g[2], "cell {x}, {y}, {z} outside the grid");
        !self.is_occupied(x + g[0] * (y + g[1] * z))
    }

    /// Extinction of a cell per reference step; 0 where it is empty.
    ///
    /// # Panics
    /// When the cell lies outside the grid.
    #[cfg(test)]
    pub(crate) fn extinction(&mut self, volume: &VolumeSummary, [x, y, z]: [usize; 3]) -> f32 {
        let g = self.grid;
        assert!(x < g[0] && y < g[1] && z < g[2], "cell {x}, {y}, {z} outside the grid");
        let cell = x + g[0] * (y + g[1] * z);
        if self.is_occupied(cell) { self.optics(volume, cell).extinction } else { 0.0 }
    }

    pub(super) fn grid(&self) -> [usize; 3] {
        self.grid
    }

    /// Makes the distance map that [`crate::scene::Skipping::Distance`] needs, unless it is there. Never
    /// allocates.
    pub fn prepare_distance(&mut self) {
        if self.distance_ready {
            return;
        }
        let [nx, ny, _] = self.grid;
        for (cells, &word) in self.distance.chunks_mut(FLAGGED).zip(&self.flags) {
            for (i, d) in cells.iter_mut().enumerate() {
                *d = if word >> i & 1 != 0 { 0 } else { u8::MAX };
            }
        }
        // One pass per axis, each exact because the Chebyshev ball is a product of intervals:
        // d(x) becomes the least max(d(x'), |x − x'|) along the axis.
        let strides = [1, nx, nx * ny];
        for axis in 0..3 {
            let (n, stride) = (self.grid[axis], strides[axis]);
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            for b in 0..self.grid[v] {
                for a in 0..self.grid[u] {
                    let start = a * strides[u] + b * strides[v];
                    let (line, out) = self.line.split_at_mut(n);
                    for (i, slot) in line.iter_mut().enumerate() {
                        *slot = self.distance[start + i * stride];
                    }
                    chebyshev_line(line, &mut out[..n]);
                    for (i, &d) in out[..n].iter().enumerate() {
                        self.distance[start + i * stride] = d;
                    }
                }
            }
        }
        self.distance_ready = true;
    }

    /// Chebyshev distances in cells to the nearest occupied cell (255 where there is none), once prepared.
    pub(super) fn distance(&self) -> Option<&[u8]> {
        self.distance_ready.then_some(&self.distance)
    }
}

/// Writes 1 for each pair of bounds between which a table entry is visible, else 0.
fn flag(low: &[u8], high: &[u8], ranges: Option<&[(u8, u8)]>, opaque: &[u16; TABLE_LEN + 1], out: &mut [u8]) {
    let Some(ranges) = ranges else {
        for ((&low, &high), out) in low.iter().zip(high).zip(out) {
            *out = u8::from(opaque[usize::from(high) + 1] != opaque[usize::from(low)]);
        }
        return;
    };
    /// Pairs at a time: small enough that they stay in the nearest cache from range to range.
    const BATCH: usize = 4096;
    for ((low, high), out) in low.chunks(BATCH).zip(high.chunks(BATCH)).zip(out.chunks_mut(BATCH)) {
        out.fill(0);
        for &(first, last) in ranges {
            for ((&low, &high), out) in low.iter().zip(high).zip(&mut *out) {
                *out |= u8::from(low <= last) & u8::from(high >= first);
            }
        }
    }
}

/// Packs flags of 0 and 1 into the lower halves of words.
fn pack(flags: &[u8], words: &mut [u32]) {
    for (flags, word) in flags.chunks(FLAGGED).zip(words) {
        *word = 0;
        for (i, eight) in flags.chunks(8).enumerate() {
            let mut bytes = [0; 8];
            bytes[..eight.len()].copy_from_slice(eight);
            // Bit 8k of the flags goes to bit 56 + k of the product; nothing else reaches those bits.
            let byte = u64::from_le_bytes(bytes).wrapping_mul(0x0102_0408_1020_4080) >> 56;
            *word |= (byte as u32) << (8 * i);
        }
    }
}

/// Writes the least max(d(j), |i − j|) over j for each i.
fn chebyshev_line(line: &[u8], out: &mut [u8]) {
    let n = line.len();
    for i in 0..n {
        let mut best = line[i];
        let mut r = 1;
        // Nothing farther away than the best so far can be better.
        while r < usize::from(best) && (r <= i || i + r < n) {
            let left = if r <= i { line[i - r] } else { u8::MAX };
            let right = if i + r < n { line[i + r] } else { u8::MAX };
            best = best.min(left.min(right).max(r as u8)); // r < 255
            r += 1;
        }
        out[i] = best;
    }
}

/// 1 / (n + 1) for the lengths of quantile intervals.
static RECIPROCAL: [f32; TABLE_LEN] = {
    let mut out = [0.0; TABLE_LEN];
    let mut i = 0;
    while i < TABLE_LEN {
        out[i] = 1.0 / (i as f32 + 1.0);
        i += 1;
    }
    out
};
