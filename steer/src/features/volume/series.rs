//! Summaries of a volume that changes from one time step to the next.

use super::builder::{Places, gather, lay_out, set_remapped, set_totals};
use super::changed::{Cells, Halves, full, look, mask};
use super::entries::{Map, Voxel};
use super::scan::{Grid, Source, nothing};
use super::{SummaryBuilder, SummaryOptions, VolumeSummary};
use alloc::vec::Vec;
use core::ops::Range;
use entire_core::Result;
use entire_core::bail;
use entire_core::kernels::Executor;
use entire_core::memory::filled;
use entire_core::scene::{Scalars, VolumeView};

/// Keeps the [`VolumeSummary`] of a volume that changes: at each time step only the changed cells are
/// summarized again.
///
/// Where the caller gives the box of voxels that changed, only the cells that it touches are read. Otherwise
/// all voxels are read to find the cells that changed, which is much faster than making a summary. Either way
/// the summary is bit-identical to that of [`VolumeSummary::new`].
///
/// In addition to the summary, each cell has a checksum of 16 bytes, which misses a change with a probability
/// of about 2⁻¹²⁸ (unless voxels are chosen to collide); the number of voxels with each entry of a 256-entry
/// table, 5 bytes and mostly one for each entry from the cell's lowest to its highest; and four stored values
/// per block. For bytes in cells of one block, these are about 25 bytes per cell and one per entry, in
/// addition to the 11 of the summary.
///
/// A time step may be added slab by slab, as with [`SummaryBuilder`]: to show progress, to stop, or where the
/// volume is never in memory as a whole. After a stop the next time step also scans the cells that were left.
///
/// ```
/// use entire_steer::features::{SummaryOptions, SummarySeries, VolumeSummary};
/// use entire_core::kernels::Executor;
/// use entire_core::scene::{Scalars, VolumeView};
///
/// let mut voxels = vec![7u8; 40 * 30 * 20];
/// let options = SummaryOptions::default();
/// let view = VolumeView::new(Scalars::U8(&voxels), [40, 30, 20])?;
/// let mut series = SummarySeries::new(&view, 20, options)?;
/// series.update(&view, None, Executor::Serial)?;
/// voxels[40 * (30 * 11 + 5) + 17] = 200;
/// let view = VolumeView::new(Scalars::U8(&voxels), [40, 30, 20])?;
/// let found = series.update(&view, Some([17..18, 5..6, 11..12]), Executor::Serial)?;
/// assert_eq!(*found, VolumeSummary::new(&view, options)?);
/// # entire_core::Result::Ok(())
/// ```
#[derive(Clone, Debug)]
pub struct SummarySeries {
    summary: VolumeSummary,
    grid: Grid,
    map: Map,
    cells: Cells,
    blocks: Kind,
    /// True where unmarked cells may have changed too.
    search: bool,
    /// First layer of cells that was not scanned in this time step.
    layer: usize,
}

#[derive(Clone, Debug)]
enum Kind {
    U8(Vec<Halves<u8>>),
    U16(Vec<Halves<u16>>),
    I16(Vec<Halves<i16>>),
    F32(Vec<Halves<f32>>),
}

impl SummarySeries {
    /// A series of volumes of `planes` planes along z; sizes along x and y, spacing, range and type of every
    /// time step are those of `like`, of which no voxel is read. All time steps share the range. The first
    /// time step has begun; all of it must be read.
    ///
    /// # Errors
    /// As [`SummaryBuilder::new`].
    pub fn new(like: &VolumeView<'_>, planes: usize, options: SummaryOptions) -> Result<Self> {
        let (mut summary, grid) = SummaryBuilder::layout(like, planes, options)?;
        lay_out(&mut summary, &grid)?;
        let blocks = grid.blocks().iter().product();
        let blocks = match like.scalars() {
            Scalars::U8(_) => Kind::U8(filled(blocks, [nothing(); 2])?),
            Scalars::U16(_) => Kind::U16(filled(blocks, [nothing(); 2])?),
            Scalars::I16(_) => Kind::I16(filled(blocks, [nothing(); 2])?),
            Scalars::F32(_) => Kind::F32(filled(blocks, [nothing(); 2])?),
        };
        Ok(Self {
            summary,
            grid,
            map: Map::new(like),
            cells: Cells::new(&grid)?,
            blocks,
            search: false,
            layer: 0,
        })
    }

    /// Begins the next time step, in which only voxels in a box changed: along x, y and z from each range's
    /// start up to, but not including, its end. Without a box any voxel may have changed. Where the preceding
    /// time step was not read to its end, its changes are searched as well.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a box that extends beyond the volume; no time step has begun
    /// in this case.
    pub fn begin(&mut self, changed: Option<[Range<usize>; 3]>) -> Result<()> {
        let Some(changed) = changed else {
            (self.search, self.layer) = (true, 0);
            return Ok(());
        };
        let (dims, edge) = (self.grid.dims, self.grid.edge);
        if (0..3).any(|a| changed[a].start > changed[a].end || changed[a].end > dims[a]) {
            bail!(
                InvalidArgument,
                "voxels {:?} along x, {:?} along y and {:?} along z were announced as changed in a volume \
                 of {} x {} x {} voxels; ranges begin at 0 and end with the volume",
                changed[0],
                changed[1],
                changed[2],
                dims[0],
                dims[1],
                dims[2]
            );
        }
        // Cells left from the preceding time step are still searched.
        self.search &= self.next_planes().is_some();
        self.layer = 0;
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

    /// Planes of the smallest slab that must be added next, which need not follow the one before: planes
    /// without changes are skipped. `None` when the time step is complete. A slab may hold any multiple of
    /// this number of planes; the last one ends with the volume.
    pub fn next_planes(&self) -> Option<Range<usize>> {
        let ([_, ny, nz], edge) = (self.grid.cells, self.grid.edge[2]);
        let waits =
            |z: &usize| self.search || self.cells.changed[ny * z..ny * (z + 1)].iter().any(|&row| row != 0);
        let layer = (self.layer..nz).find(waits)?;
        Some(layer * edge..((layer + 1) * edge).min(self.grid.dims[2]))
    }

    /// Adds the slab that [`SummarySeries::next_planes`] names. Allocates working memory of a few rows of
    /// cells for each thread, and memory for cells with more entries than before.
    ///
    /// # Errors
    /// As [`SummaryBuilder::add`]; [`crate::ErrorKind::OutOfMemory`], after which a time step must be begun
    /// again.
    pub fn add(&mut self, slab: &VolumeView<'_>, executor: Executor<'_>) -> Result<()> {
        let Some(next) = self.next_planes() else {
            bail!(SizeMismatch, "a slab was added to a complete time step; begin the next one first");
        };
        let ([x, y, planes], [width, height, all]) = (slab.dims(), self.grid.dims);
        let (edge, left) = (self.grid.edge[2], all - next.start);
        if [x, y] != [width, height] || planes > left || !(planes % edge == 0 || planes == left) {
            bail!(
                SizeMismatch,
                "a slab of {x} x {y} x {planes} voxels was added where planes from {} on of {all} planes of \
                 {width} x {height} voxels are awaited; slabs have these sizes, in whole multiples of {edge} \
                 planes or all that are left",
                next.start
            );
        }
        let first = next.start / edge;
        self.look(slab, next.start, first..first + planes.div_ceil(edge), executor)
    }

    /// Adds a whole time step, in which only voxels in a box changed ([`SummarySeries::begin`]); the first
    /// one is always read completely. Returns its summary.
    ///
    /// # Errors
    /// As [`SummarySeries::begin`] and [`SummarySeries::add`]; where the volume is refused, no time step has
    /// begun.
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
                "a time step has {x} x {y} x {z} voxels, its series {nx} x {ny} x {nz}; begin another series \
                 with it"
            );
        }
        self.check(volume)?;
        self.begin(changed)?;
        if let Some(next) = self.next_planes() {
            let (first, ny) = (next.start / self.grid.edge[2], self.grid.cells[1]);
            let last = self.cells.changed.iter().rposition(|&row| row != 0).map_or(first, |row| row / ny);
            let end = if self.search { self.grid.cells[2] } else { last + 1 };
            self.look(volume, 0, first..end, executor)?;
        }
        self.summary()
    }

    /// The summary of the time step.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before all its planes were added.
    pub fn summary(&self) -> Result<&VolumeSummary> {
        if let Some(next) = self.next_planes() {
            bail!(NotReady, "a time step is not complete; add its planes from {} on", next.start);
        }
        Ok(&self.summary)
    }

    /// Refuses voxels of another type or range.
    fn check(&self, slab: &VolumeView<'_>) -> Result<()> {
        if slab.range() != self.map.range() {
            bail!(
                InvalidArgument,
                "a time step has the range {:?}, its series {:?}; give every time step the range of the \
                 series",
                slab.range(),
                self.map.range()
            );
        }
        let (found, own) = (slab.scalars().scalar_type(), self.summary.scalar_type);
        if found != own {
            bail!(
                InvalidArgument,
                "a time step of {} was added to a series of {}; time steps have the series' type",
                found.name(),
                own.name()
            );
        }
        Ok(())
    }

    /// Scans layers of cells; plane 0 of the slab is the volume's plane `plane`.
    fn look(
        &mut self,
        slab: &VolumeView<'_>,
        plane: usize,
        layers: Range<usize>,
        executor: Executor<'_>,
    ) -> Result<()> {
        self.check(slab)?;
        let end = layers.end;
        let (grid, map, search) = (&self.grid, &self.map, self.search);
        let (cells, quantiles) = (&mut self.cells, &mut *self.summary.quantiles);
        macro_rules! look {
            ($voxels:expr, $blocks:expr) => {{
                let source = Source { slab, voxels: $voxels, first: plane };
                look(grid, map, source, layers, search, (cells, $blocks, quantiles), executor)?
            }};
        }
        match (&mut self.blocks, slab.scalars()) {
            (Kind::U8(blocks), Scalars::U8(voxels)) => look!(voxels, blocks),
            (Kind::U16(blocks), Scalars::U16(voxels)) => look!(voxels, blocks),
            (Kind::I16(blocks), Scalars::I16(voxels)) => look!(voxels, blocks),
            (Kind::F32(blocks), Scalars::F32(voxels)) => look!(voxels, blocks),
            // Excluded by the check above.
            _ => {}
        }
        self.layer = end;
        if self.next_planes().is_none() {
            let Self { summary, grid, map, cells, blocks, .. } = self;
            match blocks {
                Kind::U8(blocks) => finish(summary, grid, map, cells, blocks),
                Kind::U16(blocks) => finish(summary, grid, map, cells, blocks),
                Kind::I16(blocks) => finish(summary, grid, map, cells, blocks),
                Kind::F32(blocks) => finish(summary, grid, map, cells, blocks),
            }
            (self.search, self.layer) = (false, 0);
        }
        Ok(())
    }
}

/// Updates the parts of the summary that depend on all voxels: bounds of the cells that changed or overlap
/// changed ones, histogram, `remapped`.
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
