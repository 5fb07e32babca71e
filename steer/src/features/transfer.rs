//! Emptiness and extinction of each cell of a volume under a transfer function.

use super::classify::{Visible, classify, classify_blocks};
use super::interior::Interior;
use super::{QUANTILES, VolumeSummary};
#[cfg(feature = "calibrate")]
use crate::memory::mixed;
use crate::memory::{replace_or_resize, try_grow};
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::scene::{TABLE_LEN, TransferTable};

/// Length over which values along a ray are fully correlated, in reference steps. A cell's extinction is
/// computed from its mean transmittance over this length. With a length of 0, the result would be the cell's
/// mean extinction, an overestimate for cells that hold a few opaque voxels among transparent ones.
pub(crate) const CORRELATION_LENGTH: f32 = 2.0;

/// Largest opacity α that is converted to extinction, −ln(1 − α); larger opacities are reduced to it.
const MAX_OPACITY: f32 = 1.0 - 1.0e-6;

/// Optical properties of a cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Optics {
    /// Extinction per reference step.
    pub(super) extinction: f32,
    /// Share of the cell's values with nonzero opacity.
    pub(super) visible: f32,
    /// Share of the cell's blocks that are not empty.
    pub(super) occupied: f32,
    /// Number of lookups in the skip map per crossed cell border: 2^−c for a cell of depth class c
    /// ([`Interior::class`]).
    pub(super) looks: f32,
}

/// Layout of the 32-bit word into which a cell's optics are packed, so that packets of rays can load them
/// with one gather operation. From the lowest bit on: the square root of the visible share in units of
/// 1/1023; the depth class ([`Interior::class`]); the extinction as an unsigned floating-point number (10
/// bits of mantissa, 5 of exponent, 2⁻²⁷ at least). The other bits hold the number of the edit in which the
/// word was computed. With these bits cleared, the word is zero exactly for an empty cell.
pub(super) mod packed {
    /// Mask of the bits that hold the square root of the visible share.
    pub(crate) const SHOWS: u32 = 0x0000_03ff;
    /// Mask of the bits that hold the extinction: the bits of the f32, minus [`EXPONENT`], at the same
    /// positions.
    pub(crate) const EXTINCTION: u32 = 0x0fff_e000;
    /// Offset that, added to the bits of the extinction, gives the bits of the f32.
    pub(crate) const EXPONENT: u32 = (127 - 27) << 23;
    /// Unit in which the square root of the visible share is stored.
    pub(crate) const UNIT: f32 = 1.0 / 1023.0;
    /// Mask of the bits that hold the depth class (0 to 3): the class of the cell's distance to the nearest
    /// empty cell.
    pub(crate) const DEPTH: u32 = 0x0000_0c00;
    /// Factor that shifts the class's bits to the exponent of an f32. The shifted bits, subtracted from the
    /// bits of 1.0, give 2^−class.
    pub(crate) const HALVING: u32 = 1 << 13;
    /// Mask of the bits that hold the number of the edit of the transfer function.
    pub(crate) const EDIT: u32 = !(SHOWS | EXTINCTION | DEPTH);
    /// Exclusive upper bound of edit numbers. The number after `EDITS` − 1 is 1.
    pub(super) const EDITS: u32 = 1 << 5;

    /// Returns the bits that represent an edit's number, which is less than [`EDITS`], in a word.
    pub(super) fn edit(number: u32) -> u32 {
        number << 28 | number >> 4 << 12
    }

    /// Packs the word of a cell that is not empty, without the edit's number.
    pub(super) fn pack(extinction: f32, visible: f32, class: u32) -> u32 {
        let least = f32::from_bits(EXPONENT);
        // Adds half of the last kept bit, so that the truncation below rounds to the nearest value.
        let extinction = extinction.max(least).to_bits() + (1 << 12) - EXPONENT;
        let shows = (libm::sqrtf(visible) * 1023.0 + 0.5) as u32;
        extinction.min(EXTINCTION) & EXTINCTION | shows.clamp(1, SHOWS) | class << 10
    }

    /// Unpacks a word. Returns the cell's extinction per reference step, the share of its values with nonzero
    /// opacity, and 2^−c, where c is its depth class.
    #[inline(always)]
    pub(super) fn unpack(word: u32) -> (f32, f32, f32) {
        let root = (word & SHOWS) as f32 * UNIT;
        let looks = f32::from_bits(1.0f32.to_bits() - (word & DEPTH) * HALVING);
        (f32::from_bits((word & EXTINCTION) + EXPONENT), root * root, looks)
    }
}

/// Emptiness and extinction of each cell of a volume under a transfer function.
///
/// An edit of the transfer function finds all empty cells at once. The optics of any other cell are computed
/// when a ray first meets the cell or a neighbor before it, and are kept until the next edit. The optics of
/// most cells that no ray meets are never computed.
#[derive(Clone, Debug)]
pub struct TransferSummary {
    /// One bit per cell, set where the cell is not empty.
    full: Vec<u64>,
    /// Depth classes of the cells that are not empty.
    interior: Interior,
    /// Share of each cell's blocks that are not empty; no elements unless cells hold several blocks. Valid
    /// only for cells that are not empty and whose word is computed.
    pub(super) occupied: Vec<f32>,
    /// Packed word of each cell, see [`packed`].
    cells: Vec<u32>,
    /// Bits of the present edit's number in a cell's word. Never 0, because newly allocated words are 0.
    edit: u32,
    /// Number of the present edit of the transfer function.
    edits: u32,
    /// Opacity of each table entry and the logarithm of its transmittance; zeros if the entry is not visible.
    entries: [[f32; 2]; TABLE_LEN],
    unit_distance: f32,
    /// Prefix sums, over the entries below each entry, of the transmittance over [`CORRELATION_LENGTH`] and
    /// of the number of visible entries. In double precision, because differences of sums near 256 must
    /// resolve transmittances near 1e-12.
    sums: [[f64; 2]; TABLE_LEN + 1],
    grid: [usize; 3],
    /// Chebyshev distance in cells to the nearest occupied cell; stale unless `distance_ready`.
    distance: Vec<u8>,
    distance_ready: bool,
    /// One bit per block, set where the block is not empty; used only if cells hold several blocks, and valid
    /// only for cells that are not empty.
    bits: Vec<u64>,
    /// Working memory for two lines of cells.
    line: Vec<u8>,
    /// Mean, over all cells, of the share of the cell's blocks that are not empty.
    pub(super) occupied_share: f32,
    /// Extinction per reference step averaged over the volume's voxels.
    pub(super) mean_extinction: f32,
    /// Share of voxels with nonzero opacity.
    pub(super) visible_share: f32,
}

impl TransferSummary {
    /// Makes the summary of a volume under a transfer table.
    ///
    /// # Errors
    /// [`crate::ErrorKind::OutOfMemory`] if memory does not suffice for the summary.
    pub fn new(volume: &VolumeSummary, table: &TransferTable) -> Result<Self> {
        let mut summary = Self {
            full: Vec::new(),
            interior: Interior::default(),
            occupied: Vec::new(),
            cells: Vec::new(),
            edit: 0,
            edits: 0,
            entries: [[0.0; 2]; TABLE_LEN],
            unit_distance: 1.0,
            sums: [[0.0; 2]; TABLE_LEN + 1],
            grid: volume.cells,
            distance: Vec::new(),
            distance_ready: false,
            bits: Vec::new(),
            line: Vec::new(),
            occupied_share: 0.0,
            mean_extinction: 0.0,
            visible_share: 0.0,
        };
        summary.apply(volume, Some(table))?;
        Ok(summary)
    }

    /// Applies another table, or applies a table to another volume. Allocates only if the volume needs larger
    /// buffers than all volumes before.
    ///
    /// # Errors
    /// As [`TransferSummary::new`]; on an error nothing has changed.
    pub fn update(&mut self, volume: &VolumeSummary, table: &TransferTable) -> Result<()> {
        self.apply(volume, Some(table))
    }

    /// Does the work of [`TransferSummary::update`]; `None` applies the present table to another time step.
    pub(crate) fn apply(&mut self, volume: &VolumeSummary, table: Option<&TransferTable>) -> Result<()> {
        let n = volume.low.len();
        let longest = volume.cells.into_iter().max().unwrap_or(1);
        let shares = if volume.blocks().is_some() { n } else { 0 };
        let words = block_words(volume);
        let full = try_grow(&self.full, n.div_ceil(64))?;
        let interior = self.interior.try_grow(volume.cells)?;
        let bits = try_grow(&self.bits, words)?;
        let occupied = try_grow(&self.occupied, shares)?;
        let cells = try_grow(&self.cells, n)?;
        let distance = try_grow(&self.distance, n)?;
        let line = try_grow(&self.line, 2 * longest)?;
        // No error can occur from here on.
        replace_or_resize(&mut self.full, full, n.div_ceil(64));
        replace_or_resize(&mut self.bits, bits, words);
        replace_or_resize(&mut self.occupied, occupied, shares);
        replace_or_resize(&mut self.cells, cells, n);
        replace_or_resize(&mut self.distance, distance, n);
        replace_or_resize(&mut self.line, line, 2 * longest);
        self.interior.fit(interior, volume.cells);
        self.grid = volume.cells;
        self.distance_ready = false;
        // A new number invalidates the cells' words, which were computed under the preceding table or for the
        // preceding time step.
        let edits = self.edits % (packed::EDITS - 1) + 1;
        if edits < self.edits {
            self.cells.fill(0);
        }
        (self.edits, self.edit) = (edits, packed::edit(edits));
        if let Some(table) = table {
            self.read_table(table);
        }
        self.read_histogram(volume);
        self.classify(volume);
        Ok(())
    }

    /// Reads the table's entries and computes their prefix sums.
    fn read_table(&mut self, table: &TransferTable) {
        let ratio = CORRELATION_LENGTH / table.unit_distance();
        self.unit_distance = table.unit_distance();
        for (i, entry) in table.rgba().iter().enumerate() {
            let counts = table.is_visible(i);
            let alpha = if counts { entry[3] } else { 0.0 };
            let (log, through) = if counts {
                let log = libm::log1pf(-alpha.min(MAX_OPACITY));
                (log, libm::expf(ratio * log))
            } else {
                (0.0, 1.0)
            };
            self.entries[i] = [alpha, log];
            let [transmittance, visible] = self.sums[i];
            self.sums[i + 1] = [transmittance + f64::from(through), visible + f64::from(u8::from(counts))];
        }
    }

    /// Computes the values that depend only on the table and the volume's histogram.
    fn read_histogram(&mut self, volume: &VolumeSummary) {
        let (mut extinction, mut shown) = (0.0f64, 0.0f64);
        for (i, (&[_, log], &share)) in self.entries.iter().zip(&volume.histogram).enumerate() {
            let (share, counts) = (f64::from(share), self.sums[i + 1][1] > self.sums[i][1]);
            extinction -= share * f64::from(log) / f64::from(self.unit_distance);
            shown += share * f64::from(u8::from(counts));
        }
        self.mean_extinction = extinction as f32;
        self.visible_share = shown as f32;
    }

    /// Finds the cells that are not empty. Computes the mean, over all cells, of the share of the cell's
    /// blocks that are not empty.
    fn classify(&mut self, volume: &VolumeSummary) {
        let (low, high) = (&volume.low, &volume.high);
        let n = low.len();
        let below = self.sums.map(|[_, visible]| visible as u16);
        let visible = Visible::new(&below);
        let sum = match volume.blocks() {
            None => classify(&visible, low, high, &mut self.full) as f64,
            Some(blocks) => classify_blocks(&visible, low, high, blocks, &mut self.bits, &mut self.full),
        };
        self.occupied_share = (sum / n as f64) as f32;
    }

    /// Optical properties of a cell; `None` if it is empty. If rounding carries a ray out of the grid, `cell`
    /// is too large, and the result is that of the last cell, as for packets of rays.
    #[inline(always)]
    pub(super) fn optics(&mut self, volume: &VolumeSummary, cell: usize) -> Option<Optics> {
        let cell = cell.min(self.cells.len() - 1);
        let mut word = self.cells[cell] ^ self.edit;
        if word & packed::EDIT != 0 {
            self.compute(volume, [cell as i32], 1);
            word = self.cells[cell] ^ self.edit;
        }
        let (extinction, visible, looks) = packed::unpack(word);
        let occupied = self.occupied.get(cell).copied().unwrap_or(1.0);
        (word != 0).then_some(Optics { extinction, visible, occupied, looks })
    }

    /// Computes the packed words of the `cells` whose bit in `lanes` is set, and keeps them until the next
    /// edit. The last cell of the grid replaces cells outside it. Every step of the computation runs over all
    /// cells: the steps of a single cell wait for each other, and the loads of all cells together wait for
    /// memory once.
    #[cold]
    #[inline(never)]
    pub(super) fn compute<const N: usize>(
        &mut self,
        volume: &VolumeSummary,
        cells: [i32; N],
        mut lanes: u32,
    ) {
        let last = self.cells.len() - 1;
        let (mut full, mut bounds, mut count) = ([0usize; N], [[0u8; QUANTILES + 1]; N], 0);
        while lanes != 0 {
            let cell = (cells[lanes.trailing_zeros() as usize % N] as usize).min(last);
            lanes &= lanes - 1;
            if self.is_occupied(cell) {
                (full[count], bounds[count]) = (cell, volume.quantiles[cell]);
                count += 1;
            } else {
                self.cells[cell] = self.edit;
            }
        }
        if count == 0 {
            return;
        }
        let full = &full[..count];
        let mut means = [[0.0f32; 2]; N];
        for (mean, bounds) in means.iter_mut().zip(&bounds[..count]) {
            for pair in bounds.windows(2) {
                let [a, b] = [pair[0], pair[1]].map(usize::from);
                let inverse = RECIPROCAL[(b - a) % TABLE_LEN];
                for (mean, (low, high)) in mean.iter_mut().zip(self.sums[a].iter().zip(self.sums[b + 1])) {
                    *mean += (high - low) as f32 * inverse;
                }
            }
        }
        const SHARE: f32 = 1.0 / QUANTILES as f32;
        for [t, v] in &mut means[..count] {
            *t = -libm::logf((*t * SHARE).clamp(1.0e-12, 1.0)) * (1.0 / CORRELATION_LENGTH);
            *v = (*v * SHARE).clamp(0.0, 1.0);
        }
        self.interior.find(self.grid, &self.full);
        for (&[extinction, visible], &cell) in means.iter().zip(full) {
            let class = self.interior.class(self.grid, cell);
            self.cells[cell] = packed::pack(extinction, visible, class) | self.edit;
        }
        if let Some(blocks) = volume.blocks() {
            for &cell in full {
                self.occupied[cell] = blocks.share(&self.bits, cell);
            }
        }
    }

    /// Words of all cells, for packets of rays, and the bits of the present edit's number in these words.
    #[inline(always)]
    pub(super) fn words(&self) -> (&[u32], u32) {
        (&self.cells, self.edit)
    }

    /// Hash of the table's opacities; tables with different opacities are very unlikely to collide.
    #[cfg(feature = "calibrate")]
    pub(crate) fn fingerprint(&self) -> u64 {
        let unit = u64::from(self.unit_distance.to_bits());
        self.entries.iter().fold(unit, |sum, [alpha, _]| mixed(sum, u64::from(alpha.to_bits())))
    }

    /// True if a cell is not empty; false outside the grid.
    #[inline(always)]
    pub(super) fn is_occupied(&self, cell: usize) -> bool {
        self.full.get(cell / 64).is_some_and(|word| word >> (cell % 64) & 1 != 0)
    }

    /// True if the buffers have the sizes that a volume's cells and blocks need.
    pub(super) fn suits(&self, volume: &VolumeSummary) -> bool {
        self.grid == volume.cells && self.bits.len() == block_words(volume)
    }

    /// Computes the distance map for [`entire_core::scene::Skipping::Distance`], unless it is up to date.
    /// Never allocates.
    pub(crate) fn prepare_distance(&mut self) {
        if self.distance_ready {
            return;
        }
        let [nx, ny, _] = self.grid;
        for (cells, &word) in self.distance.chunks_mut(64).zip(&self.full) {
            for (i, d) in cells.iter_mut().enumerate() {
                *d = if word >> i & 1 != 0 { 0 } else { u8::MAX };
            }
        }
        // One pass per axis replaces each distance d(x) by the minimum of max(d(x'), |x − x'|) over all cells
        // x' on its line along the axis. The result is exact, because a Chebyshev ball is a product of
        // intervals.
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

    /// Chebyshev distance of each cell to the nearest occupied cell, in cells; 255 if this distance is larger
    /// or no cell is occupied. `None` before [`TransferSummary::prepare_distance`].
    pub(super) fn distance(&self) -> Option<&[u8]> {
        self.distance_ready.then_some(&self.distance)
    }
}

/// Number of words that hold a bit for each block of a volume, plus one: `share` reads across words.
fn block_words(volume: &VolumeSummary) -> usize {
    volume.blocks().map_or(0, |blocks| blocks.low.len()).div_ceil(64) + 1
}

/// Writes to each `out[i]` the minimum of max(`line[j]`, |i − j|) over all j.
fn chebyshev_line(line: &[u8], out: &mut [u8]) {
    let n = line.len();
    for i in 0..n {
        let mut best = line[i];
        let mut r = 1;
        // Entries farther away than the minimum so far cannot lower it.
        while r < usize::from(best) && (r <= i || i + r < n) {
            let left = if r <= i { line[i - r] } else { u8::MAX };
            let right = if i + r < n { line[i + r] } else { u8::MAX };
            best = best.min(left.min(right).max(r as u8)); // r < 255
            r += 1;
        }
        out[i] = best;
    }
}

/// 1 / (n + 1) for every difference n of two neighboring quantile bounds.
static RECIPROCAL: [f32; TABLE_LEN] = {
    let mut out = [0.0; TABLE_LEN];
    let mut i = 0;
    while i < TABLE_LEN {
        out[i] = 1.0 / (i as f32 + 1.0);
        i += 1;
    }
    out
};
