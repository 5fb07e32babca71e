//! Summaries of a volume that changes from one time step to the next.

use super::builder::{Places, gather, lay_out, set_remapped, set_totals};
use super::changed::{Cells, Halves, full, look, mask};
use super::entries::{Map, Voxel};
use super::scan::{Grid, Source, nothing};
use super::{CELLS_PER_AXIS, VolumeSummary};
use alloc::vec::Vec;
use core::ops::Range;
use entire_core::Result;
use entire_core::bail;
use entire_core::kernels::Executor;
use entire_core::memory::try_vec;
use entire_core::scene::{Scalars, VolumeView};

/// Keeps the [`VolumeSummary`] of a volume that changes: at each time step only the changed cells are
/// summarized again.
///
/// If the caller gives the box of voxels that changed, only the cells that the box touches are read.
/// Otherwise all voxels are read to find the cells that changed; this search is much faster than making a
/// summary. Either way the summary is bit-identical to that of [`VolumeSummary::new`].
///
/// In addition to the summary, a series keeps for each cell:
///
/// * a checksum of 16 bytes, which misses a change with a probability of about 2⁻¹²⁸ (unless voxels are
///   chosen to collide),
/// * the number of voxels with each entry of a 256-entry table: 5 bytes, plus usually one byte for each entry
///   from the cell's lowest to its highest,
/// * four stored values for each of its blocks.
///
/// For volumes of bytes whose cells are one block each, this state takes about 25 bytes per cell plus one
/// byte per entry, in addition to the summary's 11 bytes per cell.
///
/// ```
/// use entire_steer::features::{SummarySeries, VolumeSummary};
/// use entire_core::kernels::Executor;
/// use entire_core::scene::{Scalars, VolumeView};
///
/// let mut voxels = vec![7u8; 40 * 30 * 20];
/// let view = VolumeView::new(Scalars::U8(&voxels), [40, 30, 20])?;
/// let mut series = SummarySeries::new(&view)?;
/// series.update(&view, None, Executor::Serial)?;
/// voxels[40 * (30 * 11 + 5) + 17] = 200;
/// let view = VolumeView::new(Scalars::U8(&voxels), [40, 30, 20])?;
/// let found = series.update(&view, Some([17..18, 5..6, 11..12]), Executor::Serial)?;
/// assert_eq!(*found, VolumeSummary::new(&view)?);
/// # entire_core::Result::Ok(())
/// ```
#[derive(Clone, Debug)]
pub struct SummarySeries {
    summary: VolumeSummary,
    grid: Grid,
    map: Map,
    cells: Cells,
    blocks: Kind,
    /// True if unmarked cells may have changed too.
    search: bool,
}

#[derive(Clone, Debug)]
enum Kind {
    U8(Vec<Halves<u8>>),
    U16(Vec<Halves<u16>>),
    I16(Vec<Halves<i16>>),
    F32(Vec<Halves<f32>>),
}

impl SummarySeries {
    /// A series of volumes with the sizes, spacing, range and type of `like`; reads no voxel of `like`. All
    /// time steps share the range.
    ///
    /// # Errors
    /// As [`VolumeSummary::new`].
    pub fn new(like: &VolumeView<'_>) -> Result<Self> {
        Self::with_cells(like, CELLS_PER_AXIS)
    }

    /// Returns a series as [`SummarySeries::new`] does, with at most `most` cells along each axis, 1…128.
    pub(super) fn with_cells(like: &VolumeView<'_>, most: usize) -> Result<Self> {
        let (mut summary, grid) = VolumeSummary::layout(like, most)?;
        lay_out(&mut summary, &grid)?;
        let blocks = grid.blocks().iter().product();
        let blocks = match like.scalars() {
            Scalars::U8(_) => Kind::U8(try_vec(blocks, [nothing(); 2])?),
            Scalars::U16(_) => Kind::U16(try_vec(blocks, [nothing(); 2])?),
            Scalars::I16(_) => Kind::I16(try_vec(blocks, [nothing(); 2])?),
            Scalars::F32(_) => Kind::F32(try_vec(blocks, [nothing(); 2])?),
        };
        let (map, cells) = (Map::new(like), Cells::new(&grid)?);
        Ok(Self { summary, grid, map, cells, blocks, search: false })
    }

    /// Updates the summary to the next time step and returns it. If `changed` is given, its ranges of voxels
    /// along x, y and z form a box, and only voxels in this box may differ from the preceding time step.
    /// Without a box any voxel may differ. The first time step is always read completely. Allocates working
    /// memory of a few rows of cells for each thread, and memory for cells with more entries than before.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a box that extends beyond the volume or has a range that
    /// ends before it starts, and for a volume whose type, spacing or range is not that of the series;
    /// [`crate::ErrorKind::SizeMismatch`] if the sizes differ. In these cases nothing has changed.
    /// [`crate::ErrorKind::OutOfMemory`] if memory does not suffice; there is then no summary until another
    /// update succeeds.
    pub fn update(
        &mut self,
        volume: &VolumeView<'_>,
        changed: Option<[Range<usize>; 3]>,
        executor: Executor<'_>,
    ) -> Result<&VolumeSummary> {
        if volume.dims() != self.grid.dims {
            let ([x, y, z], [nx, ny, nz]) = (volume.dims(), self.grid.dims);
            bail!(
                SizeMismatch,
                "a time step has {x} x {y} x {z} voxels, but the time steps before it have {nx} x {ny} x {nz}; \
                 a time step of another size needs a new volume or series"
            );
        }
        self.check(volume)?;
        match changed {
            Some(changed) => self.announce(changed)?,
            None => self.search = true,
        }
        if let Some(layers) = self.awaited() {
            self.look(volume, layers, executor)?;
        }
        self.summary()
    }

    /// Marks the cells that a box of voxels touches as changed.
    fn announce(&mut self, changed: [Range<usize>; 3]) -> Result<()> {
        let (dims, edge) = (self.grid.dims, self.grid.edge);
        if (0..3).any(|a| changed[a].start > changed[a].end || changed[a].end > dims[a]) {
            bail!(
                InvalidArgument,
                "voxels {:?} along x, {:?} along y and {:?} along z were announced as changed in a volume \
                 of {} x {} x {} voxels; ranges must not end before they start, nor beyond the volume",
                changed[0],
                changed[1],
                changed[2],
                dims[0],
                dims[1],
                dims[2]
            );
        }
        if changed.iter().any(Range::is_empty) {
            return Ok(());
        }
        let [xs, ys, zs] =
            core::array::from_fn(|a| changed[a].start / edge[a]..changed[a].end.div_ceil(edge[a]));
        for (z, y) in zs.flat_map(|z| ys.clone().map(move |y| (z, y))) {
            self.cells.changed[y + self.grid.cells[1] * z] |= mask(xs.clone());
        }
        Ok(())
    }

    /// Layers of cells from the first to the last that must be scanned; `None` if the summary is
    /// complete.
    fn awaited(&self) -> Option<Range<usize>> {
        let ([_, ny, nz], rows) = (self.grid.cells, &self.cells.changed);
        if self.search {
            return Some(0..nz);
        }
        let first = rows.iter().position(|&row| row != 0)?;
        let last = rows.iter().rposition(|&row| row != 0)?;
        Some(first / ny..last / ny + 1)
    }

    /// The summary of the last time step.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before the first update, and after one that failed for lack of memory.
    pub fn summary(&self) -> Result<&VolumeSummary> {
        if self.awaited().is_some() {
            bail!(NotReady, "the series has no complete time step; update it with a time step");
        }
        Ok(&self.summary)
    }

    /// Refuses a volume whose type, spacing or range is not that of the series.
    fn check(&self, volume: &VolumeView<'_>) -> Result<()> {
        let (found, own) = (volume.shape().spacing, self.summary.shape.spacing);
        if found != own {
            bail!(
                InvalidArgument,
                "a time step has the voxel spacing {found}, but the time steps before it have {own}; \
                 give every time step the same spacing"
            );
        }
        if volume.range() != self.map.range {
            bail!(
                InvalidArgument,
                "a time step has the range {:?}, but the time steps before it have {:?}; give every time \
                 step the same range",
                volume.range(),
                self.map.range
            );
        }
        let (found, own) = (volume.scalars().scalar_type(), self.summary.scalar_type);
        if found != own {
            bail!(
                InvalidArgument,
                "a time step of {} was given to a series of {}; give every time step the type of the series",
                found.name(),
                own.name()
            );
        }
        Ok(())
    }

    /// Scans a range of layers of cells, which must include every cell that must be scanned.
    fn look(&mut self, volume: &VolumeView<'_>, layers: Range<usize>, executor: Executor<'_>) -> Result<()> {
        let Self { summary, grid, map, cells, blocks, search } = self;
        macro_rules! look {
            ($voxels:expr, $blocks:expr) => {{
                let source = Source { volume, voxels: $voxels };
                let state = (&mut *cells, &mut **$blocks, &mut *summary.quantiles);
                look(grid, map, source, layers, *search, state, executor)?;
                finish(summary, grid, map, cells, $blocks);
            }};
        }
        match (blocks, volume.scalars()) {
            (Kind::U8(blocks), Scalars::U8(voxels)) => look!(voxels, blocks),
            (Kind::U16(blocks), Scalars::U16(voxels)) => look!(voxels, blocks),
            (Kind::I16(blocks), Scalars::I16(voxels)) => look!(voxels, blocks),
            (Kind::F32(blocks), Scalars::F32(voxels)) => look!(voxels, blocks),
            // Never reached: the scalar type has been checked.
            _ => {}
        }
        *search = false;
        Ok(())
    }
}

/// Updates the bounds of the cells that changed or overlap changed cells, and the parts of the summary that
/// depend on all voxels: the histogram, the share of NaN and infinite voxels, and `remapped`.
fn finish<T: Voxel>(
    summary: &mut VolumeSummary,
    grid: &Grid,
    map: &Map,
    cells: &mut Cells,
    blocks: &[Halves<T>],
) {
    let ([nx, ny, nz], [across, down, _]) = (grid.cells, grid.blocks());
    let places = Places::new(grid);
    let fresh = |y: usize, z: usize| if y < ny && z < nz { cells.fresh[y + ny * z] } else { 0 };
    for (z, y) in (0..nz).flat_map(|z| (0..ny).map(move |y| (z, y))) {
        let reached = fresh(y, z) | fresh(y + 1, z) | fresh(y, z + 1) | fresh(y + 1, z + 1);
        let reached = (reached | reached >> 1) & full(nx);
        for x in (0..nx).filter(|x| reached >> x & 1 != 0) {
            gather(summary, &places, map, [x, y, z], |block| {
                let [own, _] = blocks[block];
                let beyond = blocks.get(block + across * down).map_or(nothing(), |[_, first]| *first);
                [own[0].lesser(beyond[0]), own[1].greater(beyond[1])]
            });
        }
    }
    cells.fresh.fill(0);
    set_totals(summary, map, &cells.counts, cells.non_finite);
    set_remapped(summary, blocks.iter().map(|[own, _]| own));
}
