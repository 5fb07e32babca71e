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

/// A cell as the ray probe meets it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Cell {
    /// Extinction per reference step.
    pub(super) extinction: f32,
    /// Share of the cell's blocks that are not empty; 0 where a renderer skips it whole.
    pub(super) occupied: f32,
    /// Share of the cell's values with any opacity.
    pub(super) visible: f32,
}

/// Emptiness and extinction of each cell of a volume under a transfer function.
#[derive(Clone, Debug, PartialEq)]
pub struct TransferSummary {
    cells: Vec<Cell>,
    grid: [usize; 3],
    /// Chebyshev distance in cells to the nearest occupied cell; stale unless `distance_ready`.
    distance: Vec<u8>,
    distance_ready: bool,
    /// Working memory for two lines of cells.
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
    /// Where there is no memory for two numbers per cell of the volume; see [`TransferSummary::try_new`].
    pub fn new(volume: &VolumeSummary, table: &TransferTable) -> Self {
        Self::try_new(volume, table).unwrap_or_else(|error| panic!("{error}"))
    }

    /// As [`TransferSummary::new`].
    ///
    /// # Errors
    /// [`crate::ErrorKind::OutOfMemory`] where there is no room for two numbers per cell of the volume.
    pub fn try_new(volume: &VolumeSummary, table: &TransferTable) -> Result<Self> {
        let mut summary = Self {
            cells: Vec::new(),
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
        let n = volume.stats().len();
        let longest = volume.cells().into_iter().max().unwrap_or(1);
        let line = 2 * longest.max(self.line.len() / 2);
        reserve(&mut self.cells, n)?;
        reserve(&mut self.distance, n)?;
        reserve(&mut self.line, line)?;
        self.cells.resize(n, Cell { extinction: 0.0, occupied: 0.0, visible: 0.0 });
        self.distance.resize(n, 0);
        self.line.resize(line, 0);
        self.grid = volume.cells();
        self.distance_ready = false;

        // Prefix tables: entries with opacity, and transmittance over the correlation length.
        let mut opaque = [0u16; TABLE_LEN + 1];
        // In double precision: differences of sums near 256 must resolve transmittances near 1e-12.
        let mut transmittance = [0.0f64; TABLE_LEN + 1];
        let ratio = CORRELATION_LENGTH / table.unit_distance();
        let (mut mean, mut square, mut extinction, mut shown) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
        self.max_opacity = 0.0;
        for (i, entry) in table.rgba().iter().enumerate() {
            let counts = table.is_visible(i);
            let alpha = if counts { entry[3] } else { 0.0 };
            let log = libm::log1pf(-alpha.min(MAX_OPACITY));
            opaque[i + 1] = opaque[i] + u16::from(counts);
            transmittance[i + 1] = transmittance[i] + f64::from(libm::expf(ratio * log));
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

        let mut occupied_sum = 0.0f64;
        for (index, (cell, stats)) in self.cells.iter_mut().zip(volume.stats()).enumerate() {
            let is_empty = |low: u8, high: u8| opaque[usize::from(high) + 1] == opaque[usize::from(low)];
            if is_empty(stats.low, stats.high) {
                *cell = Cell { extinction: 0.0, occupied: 0.0, visible: 0.0 };
                continue;
            }
            cell.occupied = match volume.blocks_of(index) {
                None => 1.0,
                Some(blocks) => {
                    let full = blocks.iter().filter(|b| !is_empty(b[0], b[1])).count();
                    full as f32 / blocks.len() as f32
                }
            };
            occupied_sum += f64::from(cell.occupied);
            let (mut t, mut v) = (0.0f32, 0.0f32);
            for pair in stats.quantiles.windows(2) {
                let (a, b) = (usize::from(pair[0]), usize::from(pair[1]));
                let inverse = RECIPROCAL[b - a];
                t += (transmittance[b + 1] - transmittance[a]) as f32 * inverse;
                v += f32::from(opaque[b + 1] - opaque[a]) * inverse;
            }
            let t = (t * (1.0 / super::QUANTILES as f32)).clamp(1.0e-12, 1.0);
            cell.visible = (v * (1.0 / super::QUANTILES as f32)).clamp(0.0, 1.0);
            cell.extinction = -libm::logf(t) * (1.0 / CORRELATION_LENGTH);
        }
        self.occupied_share = (occupied_sum / n as f64) as f32;
        Ok(())
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
        self.cells[x + g[0] * (y + g[1] * z)].occupied == 0.0
    }

    /// Extinction of a cell per reference step.
    ///
    /// # Panics
    /// When the cell lies outside the grid.
    #[cfg(test)]
    pub(crate) fn extinction(&self, x: usize, y: usize, z: usize) -> f32 {
        let g = self.grid;
        assert!(x < g[0] && y < g[1] && z < g[2], "cell {x}, {y}, {z} outside the grid");
        self.cells[x + g[0] * (y + g[1] * z)].extinction
    }

    pub(super) fn cells(&self) -> &[Cell] {
        &self.cells
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
        for (d, c) in self.distance.iter_mut().zip(&self.cells) {
            *d = if c.occupied > 0.0 { 0 } else { u8::MAX };
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
