//! Summary of a volume: a grid of cells with value bounds and quantiles.

mod builder;
mod changed;
mod entries;
mod scan;
mod series;
#[cfg(test)]
mod tests;

pub use series::SummarySeries;

use super::classify::Blocks;
use alloc::vec::Vec;
use entire_core::bail;
use entire_core::kernels::Executor;
use entire_core::memory::{collected, try_vec};
use entire_core::scene::{ScalarType, Scalars, Shape, VolumeView};
use entire_core::{Error, ErrorKind, Result};
use scan::Grid;

/// Edge of the blocks that renderers skip, in voxels.
pub(crate) const BLOCK_EDGE: usize = 8;

/// Largest number of cells along each axis. A cell has the edge of a block, doubled along an axis until the
/// number of cells is within this limit.
const CELLS_PER_AXIS: usize = 48;

/// Number of quantile intervals per cell; their `QUANTILES + 1` bounds split the cell's voxels into equal
/// shares.
pub(crate) const QUANTILES: usize = 8;

/// Largest stored integer that can index a table of 2¹⁵ entries directly.
pub(crate) const LARGEST_INDEX: i16 = i16::MAX;

/// Largest number of blocks kept along an axis of a cell; beyond it, several blocks are merged into one.
const BLOCKS_PER_CELL_AXIS: usize = 8;

/// Summary of a volume: about 11 bytes per cell of 8³ voxels, without the voxels.
///
/// Along each axis, cell i with edge e covers the samples between the centers of voxels e·i and e·(i + 1). So
/// the bounds of a cell include one voxel beyond its far side. In a summary of voxels, the edge is 8 voxels,
/// or a larger power of two along an axis that would otherwise have more than 48 cells. Cells with larger
/// edges also keep the value bounds of the blocks inside them, because a renderer skips single blocks. In a
/// summary of bricks ([`VolumeSummary::from_bricks`]), each brick is a cell.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeSummary {
    pub(crate) scalar_type: ScalarType,
    shape: Shape,
    /// Number of cells along each axis.
    pub(crate) cells: [usize; 3],
    /// Edges of a cell, in voxels (the last cell of an axis may extend beyond the volume).
    pub(super) edge: [usize; 3],
    /// Edges in voxels of the blocks by which emptiness is decided.
    pub(crate) block: [usize; 3],
    /// Lowest and highest entry of a 256-entry table that a sample in each cell can reach, including
    /// interpolation with the voxels beyond the cell's far side.
    pub(super) low: Vec<u8>,
    pub(super) high: Vec<u8>,
    /// Ascending quantile bounds of each cell's own voxels, as table entries.
    pub(super) quantiles: Vec<[u8; QUANTILES + 1]>,
    /// Bounds of the blocks, ordered by cell; cell c has the blocks `first_block[c]..first_block[c + 1]`.
    /// Empty if every cell is one block.
    block_low: Vec<u8>,
    block_high: Vec<u8>,
    first_block: Vec<u32>,
    /// Number of blocks in a whole cell, which the volume's border does not cut.
    most_blocks: usize,
    /// True if every cell has `most_blocks` blocks.
    uniform: bool,
    /// Share of voxels per table entry; sums to 1.
    pub(super) histogram: [f32; 256],
    non_finite_share: f32,
    /// True if a renderer that looks stored values up in a table must shift or scale them first. False for
    /// integers whose minimum is 0 and whose maximum is at most [`LARGEST_INDEX`]. In a summary made from
    /// bricks, stored values are unknown: false for an integer type if the smallest bound is 0, which is
    /// assumed to be a stored 0.
    pub(super) remapped: bool,
}

impl VolumeSummary {
    /// Scans a volume once, on the calling thread.
    ///
    /// # Errors
    /// [`ErrorKind::OutOfMemory`] if memory does not suffice for the summary.
    pub fn new(volume: &VolumeView<'_>) -> Result<Self> {
        Self::new_on(volume, Executor::Serial)
    }

    /// Scans a volume once, on the executor's threads; the summary has the same bits as that of
    /// [`VolumeSummary::new`]. Allocates working memory of a few rows of cells for each thread.
    ///
    /// # Errors
    /// As [`VolumeSummary::new`].
    pub fn new_on(volume: &VolumeView<'_>, executor: Executor<'_>) -> Result<Self> {
        Self::with_cells(volume, CELLS_PER_AXIS, executor)
    }

    /// Scans a volume as [`VolumeSummary::new_on`] does, with at most `most` cells along each axis, 1…128.
    pub(crate) fn with_cells(volume: &VolumeView<'_>, most: usize, executor: Executor<'_>) -> Result<Self> {
        let (mut summary, grid) = Self::layout(volume, most)?;
        match volume.scalars() {
            Scalars::U8(v) => builder::fill(&mut summary, &grid, (volume, v), executor)?,
            Scalars::U16(v) => builder::fill(&mut summary, &grid, (volume, v), executor)?,
            Scalars::I16(v) => builder::fill(&mut summary, &grid, (volume, v), executor)?,
            Scalars::F32(v) => builder::fill(&mut summary, &grid, (volume, v), executor)?,
        }
        Ok(summary)
    }

    /// Hash of the summary's sizes and histogram; volumes that differ in either are very unlikely to collide.
    #[cfg(feature = "calibrate")]
    pub(crate) fn fingerprint(&self) -> u64 {
        let sizes = self.shape.dims.iter().map(|&n| n as u64);
        let shares = self.histogram.iter().map(|h| u64::from(h.to_bits()));
        sizes.chain(shares).fold(0, crate::memory::mixed)
    }

    /// Makes a summary from bounds that the renderer already has: one (low, high) pair of normalized scalars
    /// per brick of `brick_edge` voxels, x fastest. Each axis has ⌈dims / `brick_edge`⌉ bricks. The bounds
    /// must include the neighboring voxels that interpolation inside the brick uses. Values inside a brick
    /// are assumed to be uniformly distributed between its bounds. Bounds are clamped to 0…1; NaN counts as
    /// 0.
    ///
    /// # Errors
    /// [`ErrorKind::InvalidArgument`] for a size or edge of 0 or a spacing that [`VolumeView::with`] refuses,
    /// [`ErrorKind::SizeMismatch`] for a size over [`entire_core::scene::MAX_VOLUME_EDGE`], for more than 2²⁸
    /// bricks, or unless there is one pair of bounds per brick, [`ErrorKind::OutOfMemory`] if memory does not
    /// suffice for the summary.
    pub fn from_bricks(
        dims: [usize; 3],
        spacing: [f32; 3],
        scalar_type: ScalarType,
        brick_edge: [usize; 3],
        bounds: &[[f32; 2]],
    ) -> Result<Self> {
        if dims.contains(&0) || brick_edge.contains(&0) {
            bail!(
                InvalidArgument,
                "volume of {dims:?} voxels in bricks of {brick_edge:?}; every size must be at least 1"
            );
        }
        let shape = Shape::checked(dims, spacing)?;
        let cells: [usize; 3] = core::array::from_fn(|a| dims[a].div_ceil(brick_edge[a]));
        let expected = count(cells, dims)?;
        if expected != bounds.len() {
            bail!(
                SizeMismatch,
                "a volume of {dims:?} voxels in bricks of {brick_edge:?} has {expected} bricks, but {} \
                 bounds were given; pass one (low, high) pair per brick, x fastest",
                bounds.len()
            );
        }
        let mut summary = Self::with_grid(shape, scalar_type, cells, brick_edge)?;
        summary.block = brick_edge;
        let mut smallest = 1.0f32;
        let clean = |v: f32| if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) };
        for (i, bound) in bounds.iter().enumerate() {
            let (a, b) = (clean(bound[0]), clean(bound[1]));
            let (lo, hi) = (a.min(b), a.max(b));
            smallest = smallest.min(lo);
            summary.low[i] = (lo * 255.0) as u8;
            summary.high[i] = ceil_entry(hi * 255.0);
            for (k, q) in summary.quantiles[i].iter_mut().enumerate() {
                let nearest = (lo + (hi - lo) * k as f32 / QUANTILES as f32) * 255.0 + 0.5;
                *q = nearest as u8;
            }
        }
        summary.remapped = scalar_type == ScalarType::F32 || smallest > 0.0;
        summary.histogram_from_quantiles();
        Ok(summary)
    }

    /// Returns a copy of the summary.
    ///
    /// # Errors
    /// [`ErrorKind::OutOfMemory`] if memory does not suffice for the copy.
    pub fn try_clone(&self) -> Result<Self> {
        Ok(Self {
            low: collected(self.low.iter().copied())?,
            high: collected(self.high.iter().copied())?,
            quantiles: collected(self.quantiles.iter().copied())?,
            block_low: collected(self.block_low.iter().copied())?,
            block_high: collected(self.block_high.iter().copied())?,
            first_block: collected(self.first_block.iter().copied())?,
            ..*self
        })
    }

    /// Sizes of the volume and the lengths derived from them.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// Share of voxels that are NaN or infinite.
    pub fn non_finite_share(&self) -> f32 {
        self.non_finite_share
    }

    pub(crate) fn voxels(&self) -> f64 {
        self.shape.dims.iter().map(|&n| n as f64).product()
    }

    /// Blocks of the cells; `None` if each cell is one block.
    #[inline(always)]
    pub(super) fn blocks(&self) -> Option<Blocks<'_>> {
        (!self.first_block.is_empty()).then_some(Blocks {
            low: &self.block_low,
            high: &self.block_high,
            first: &self.first_block,
            most: self.most_blocks,
            uniform: self.uniform,
        })
    }

    /// The empty summary of a volume with at most `most` cells along each axis, and its grid.
    fn layout(volume: &VolumeView<'_>, most: usize) -> Result<(Self, Grid)> {
        let dims = volume.dims();
        let mut edge = [BLOCK_EDGE; 3];
        for axis in 0..3 {
            while dims[axis].div_ceil(edge[axis]) > most {
                edge[axis] *= 2;
            }
        }
        let cells: [usize; 3] = core::array::from_fn(|a| dims[a].div_ceil(edge[a]));
        let summary = Self::with_grid(volume.shape(), volume.scalars().scalar_type(), cells, edge)?;
        let grid = Grid { dims, cells, edge, block: summary.block };
        Ok((summary, grid))
    }

    fn with_grid(shape: Shape, scalar_type: ScalarType, cells: [usize; 3], edge: [usize; 3]) -> Result<Self> {
        let dims = shape.dims;
        let n = count(cells, dims)?;
        let block = edge.map(|e| e.min((e / BLOCKS_PER_CELL_AXIS).max(BLOCK_EDGE)));
        let per_cell = |a: usize| edge[a] / block[a];
        Ok(Self {
            scalar_type,
            shape,
            cells,
            edge,
            block,
            most_blocks: (0..3).map(per_cell).product(),
            uniform: (0..3).all(|a| dims[a].div_ceil(block[a]) == cells[a] * per_cell(a)),
            low: try_vec(n, 255)?,
            high: try_vec(n, 0)?,
            quantiles: try_vec(n, [0; QUANTILES + 1])?,
            block_low: Vec::new(),
            block_high: Vec::new(),
            first_block: Vec::new(),
            histogram: [0.0; 256],
            non_finite_share: 0.0,
            remapped: true,
        })
    }

    fn histogram_from_quantiles(&mut self) {
        let mut sum = [0.0f64; 256];
        let share = 1.0 / (self.quantiles.len() * QUANTILES) as f64;
        for quantiles in &self.quantiles {
            for pair in quantiles.windows(2) {
                let (a, b) = (usize::from(pair[0]), usize::from(pair[1]));
                let each = share / (b - a + 1) as f64;
                sum[a..=b].iter_mut().for_each(|s| *s += each);
            }
        }
        for (h, s) in self.histogram.iter_mut().zip(sum) {
            *h = s as f32;
        }
    }
}

fn count(cells: [usize; 3], dims: [usize; 3]) -> Result<usize> {
    let n = cells.iter().try_fold(1u64, |p, &c| p.checked_mul(c as u64)).filter(|&n| n <= 1 << 28);
    n.map(|n| n as usize).ok_or_else(|| {
        Error::new(
            ErrorKind::SizeMismatch,
            alloc::format!("a volume of {dims:?} voxels has more than 2^28 bricks; use a larger brick edge"),
        )
    })
}

fn ceil_entry(position: f32) -> u8 {
    let below = position as u8;
    if f32::from(below) < position { below.saturating_add(1) } else { below }
}
