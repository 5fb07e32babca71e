//! Construction of a summary slab by slab.

use super::entries::{Map, Voxel};
use super::scan::{Bounds, Found, Grid, nothing};
use super::{LARGEST_INDEX, SummaryOptions, VolumeSummary};
use entire_core::Result;
use entire_core::bail;
use entire_core::kernels::Executor;
use entire_core::memory::{filled, reserve};
use entire_core::scene::{Scalars, VolumeView};

/// Makes a [`VolumeSummary`] slab by slab along z, in order, without keeping any slab: for a volume that is
/// never in memory as a whole, or whose caller wants to show progress or to stop.
///
/// The summary is bit-identical to that of [`VolumeSummary::new`] for any number of slabs and threads.
///
/// ```
/// use entire_steer::features::{SummaryBuilder, SummaryOptions, VolumeSummary};
/// use entire_core::kernels::Executor;
/// use entire_core::scene::{Scalars, VolumeOptions, VolumeView};
///
/// let voxels: Vec<u16> = (0..40 * 30 * 20).map(|i| i as u16).collect();
/// let (range, options) = ((0.0, 24_000.0), SummaryOptions::default());
/// let slab = |planes: std::ops::Range<usize>| {
///     let part = &voxels[40 * 30 * planes.start..40 * 30 * planes.end];
///     let known = VolumeOptions { range: Some(range), ..VolumeOptions::default() };
///     VolumeView::with(Scalars::U16(part), [40, 30, planes.len()], known)
/// };
/// let mut builder = SummaryBuilder::new(&slab(0..8)?, 20, options)?;
/// while let Some(planes) = builder.next_planes() {
///     builder.add(&slab(planes)?, Executor::Serial)?; // or stop here, and drop the builder
/// }
/// assert_eq!(builder.finish()?, VolumeSummary::new(&slab(0..20)?, options)?);
/// # entire_core::Result::Ok(())
/// ```
#[derive(Clone, Debug)]
pub struct SummaryBuilder {
    summary: VolumeSummary,
    grid: Grid,
    map: Map,
    found: Kind,
    /// Number of planes scanned so far.
    planes: usize,
}

#[derive(Clone, Debug)]
enum Kind {
    U8(Found<u8>),
    U16(Found<u16>),
    I16(Found<i16>),
    F32(Found<f32>),
}

impl SummaryBuilder {
    /// A builder for a volume of `planes` planes along z; sizes along x and y, spacing, range and type are
    /// those of `like`, of which no voxel is read.
    ///
    /// # Errors
    /// As [`VolumeSummary::new`], [`crate::ErrorKind::InvalidArgument`] for no planes, and
    /// [`crate::ErrorKind::SizeMismatch`] for more than [`entire_core::scene::MAX_VOLUME_EDGE`].
    pub fn new(like: &VolumeView<'_>, planes: usize, options: SummaryOptions) -> Result<Self> {
        let (summary, grid) = Self::layout(like, planes, options)?;
        let found = match like.scalars() {
            Scalars::U8(_) => Kind::U8(Found::new(&grid)?),
            Scalars::U16(_) => Kind::U16(Found::new(&grid)?),
            Scalars::I16(_) => Kind::I16(Found::new(&grid)?),
            Scalars::F32(_) => Kind::F32(Found::new(&grid)?),
        };
        Ok(Self { summary, grid, map: Map::new(like), found, planes: 0 })
    }

    /// The empty summary of a volume, and its grid.
    pub(super) fn layout(
        like: &VolumeView<'_>,
        planes: usize,
        options: SummaryOptions,
    ) -> Result<(VolumeSummary, Grid)> {
        let [x, y, _] = like.dims();
        if planes == 0 {
            bail!(InvalidArgument, "a volume of 0 planes was announced; it must have at least 1");
        }
        entire_core::scene::check_edges([x, y, planes])?;
        let summary =
            VolumeSummary::layout([x, y, planes], like.spacing(), like.scalars().scalar_type(), options)?;
        let grid =
            Grid { dims: summary.shape.dims, cells: summary.cells, edge: summary.edge, block: summary.block };
        Ok((summary, grid))
    }

    /// Planes of the smallest slab that may be added next; `None` after the last one. A slab may hold any
    /// multiple of this number of planes; the last one ends with the volume.
    pub fn next_planes(&self) -> Option<core::ops::Range<usize>> {
        let [_, _, planes] = self.grid.dims;
        let end = (self.planes + self.grid.edge[2]).min(planes);
        (self.planes < planes).then_some(self.planes..end)
    }

    /// Adds the next slab. Allocates working memory of a few rows of cells for each thread.
    ///
    /// # Errors
    /// [`crate::ErrorKind::SizeMismatch`] for a slab of other sizes than announced, or of a number of planes
    /// that [`SummaryBuilder::next_planes`] does not allow; [`crate::ErrorKind::InvalidArgument`] for another
    /// type or range. Nothing is scanned in these cases.
    pub fn add(&mut self, slab: &VolumeView<'_>, executor: Executor<'_>) -> Result<()> {
        let ([x, y, planes], [width, height, all]) = (slab.dims(), self.grid.dims);
        let (edge, left) = (self.grid.edge[2], all - self.planes);
        let whole = planes % edge == 0 || planes == left;
        if [x, y] != [width, height] || planes > left || !whole {
            bail!(
                SizeMismatch,
                "a slab of {x} x {y} x {planes} voxels was added after {} of {all} planes of {width} x {height} voxels; \
                 slabs have these sizes, in whole multiples of {edge} planes or all that are left",
                self.planes
            );
        }
        if slab.range() != self.map.range() {
            bail!(
                InvalidArgument,
                "a slab has the range {:?}, the volume {:?}; give every slab the volume's range",
                slab.range(),
                self.map.range()
            );
        }
        let first = self.planes / edge;
        let per_layer = self.grid.cells[0] * self.grid.cells[1];
        let quantiles = &mut self.summary.quantiles[first * per_layer..];
        let (grid, map) = (&self.grid, &self.map);
        match (&mut self.found, slab.scalars()) {
            (Kind::U8(f), Scalars::U8(v)) => f.scan(grid, map, (slab, v), first, quantiles, executor)?,
            (Kind::U16(f), Scalars::U16(v)) => f.scan(grid, map, (slab, v), first, quantiles, executor)?,
            (Kind::I16(f), Scalars::I16(v)) => f.scan(grid, map, (slab, v), first, quantiles, executor)?,
            (Kind::F32(f), Scalars::F32(v)) => f.scan(grid, map, (slab, v), first, quantiles, executor)?,
            (_, scalars) => bail!(
                InvalidArgument,
                "a slab of {} was added to a volume of {}; slabs have the volume's type",
                scalars.scalar_type().name(),
                self.summary.scalar_type.name()
            ),
        }
        self.planes += planes;
        Ok(())
    }

    /// The summary, after every plane was added.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before.
    pub fn finish(self) -> Result<VolumeSummary> {
        if let Some(next) = self.next_planes() {
            bail!(
                NotReady,
                "{} of {} planes were added; add the planes from {} on",
                self.planes,
                self.grid.dims[2],
                next.start
            );
        }
        let Self { mut summary, grid, map, found, .. } = self;
        match found {
            Kind::U8(f) => finish(&mut summary, &grid, &map, f)?,
            Kind::U16(f) => finish(&mut summary, &grid, &map, f)?,
            Kind::I16(f) => finish(&mut summary, &grid, &map, f)?,
            Kind::F32(f) => finish(&mut summary, &grid, &map, f)?,
        }
        Ok(summary)
    }
}

/// Sets the parts of a summary that depend on all voxels: bounds of cells, histogram, `remapped`.
fn finish<T: Voxel>(summary: &mut VolumeSummary, grid: &Grid, map: &Map, found: Found<T>) -> Result<()> {
    lay_out(summary, grid)?;
    let places = Places::new(grid);
    for cell in each_cell(grid.cells) {
        gather(summary, &places, map, cell, |block| found.bounds[block]);
    }
    set_totals(summary, map, &found.counts, found.non_finite);
    set_remapped(summary, found.bounds.iter());
    Ok(())
}

/// Sets the histogram and the share of NaN and infinite voxels from counts of voxels.
pub(super) fn set_totals(summary: &mut VolumeSummary, map: &Map, counts: &[u64; 256], non_finite: u64) {
    let mut mapped = [0u64; 256];
    for (&entry, &n) in map.near.iter().zip(counts) {
        mapped[usize::from(entry)] += n;
    }
    let voxels = summary.voxels();
    for (h, &n) in summary.histogram.iter_mut().zip(&mapped) {
        *h = (n as f64 / voxels) as f32;
    }
    summary.non_finite_share = (non_finite as f64 / voxels) as f32;
}

/// Sets `remapped` from bounds that together hold all values.
pub(super) fn set_remapped<'a, T: Voxel>(
    summary: &mut VolumeSummary,
    bounds: impl Iterator<Item = &'a Bounds<T>>,
) {
    if T::IS_FLOAT {
        summary.remapped = true;
        return;
    }
    let wider = |[a, b]: Bounds<T>, [low, high]: &Bounds<T>| [a.lesser(*low), b.greater(*high)];
    let [smallest, largest] = bounds.fold(nothing(), wider).map(T::number);
    summary.remapped = smallest != 0.0 || largest > f32::from(LARGEST_INDEX);
}

/// Maps cells to their blocks.
pub(super) struct Places {
    /// Numbers along x, y, z of blocks of the volume, blocks of a cell, and cells of the volume.
    blocks: [usize; 3],
    per_cell: [usize; 3],
    cells: [usize; 3],
}

impl Places {
    pub(super) fn new(grid: &Grid) -> Self {
        let per_cell = core::array::from_fn(|a| grid.edge[a] / grid.block[a]);
        Self { blocks: grid.blocks(), per_cell, cells: grid.cells }
    }

    /// Range of a cell's blocks along each axis, counted from the volume's beginning.
    #[inline(always)]
    fn of(&self, cell: [usize; 3]) -> [core::ops::Range<usize>; 3] {
        core::array::from_fn(|a| {
            let first = cell[a] * self.per_cell[a];
            first..(first + self.per_cell[a]).min(self.blocks[a])
        })
    }
}

/// Coordinates of every cell of a grid, x fastest.
pub(super) fn each_cell([nx, ny, nz]: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (0..nz).flat_map(move |z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])))
}

/// Allocates the bounds of the blocks in each cell, where a cell holds several.
pub(super) fn lay_out(summary: &mut VolumeSummary, grid: &Grid) -> Result<()> {
    if grid.block == grid.edge {
        return Ok(());
    }
    let cells = summary.low.len();
    reserve(&mut summary.first_block, cells + 1)?;
    summary.first_block.push(0);
    let (mut end, places) = (0, Places::new(grid));
    for cell in each_cell(grid.cells) {
        end += places.of(cell).iter().map(ExactSizeIterator::len).product::<usize>();
        summary.first_block.push(end as u32);
    }
    summary.block_low = filled(end, 255)?;
    summary.block_high = filled(end, 0)?;
    Ok(())
}

/// Computes a cell's bounds from its blocks', and stores the blocks' where a cell holds several.
#[inline(always)]
pub(super) fn gather<T: Voxel>(
    summary: &mut VolumeSummary,
    places: &Places,
    map: &Map,
    place: [usize; 3],
    bounds: impl Fn(usize) -> Bounds<T>,
) {
    let ([across, down, _], [nx, ny, _]) = (places.blocks, places.cells);
    let cell = place[0] + nx * (place[1] + ny * place[2]);
    let [xs, ys, zs] = places.of(place);
    let mut at = summary.first_block.get(cell).map(|&first| first as usize);
    let (mut lowest, mut highest) = (255, 0);
    for bz in zs {
        for by in ys.clone() {
            for bx in xs.clone() {
                let [low, high] = T::ends(bounds(bx + across * (by + down * bz)), map);
                (lowest, highest) = (Ord::min(lowest, low), Ord::max(highest, high));
                if let Some(at) = &mut at {
                    summary.block_low[*at] = low;
                    summary.block_high[*at] = high;
                    *at += 1;
                }
            }
        }
    }
    (summary.low[cell], summary.high[cell]) = (lowest, highest);
}
