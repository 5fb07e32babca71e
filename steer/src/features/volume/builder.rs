//! Computes the parts of a summary that depend on the scan of all voxels.

use super::entries::{Map, Voxel};
use super::scan::{Bounds, Found, Grid, nothing};
use super::{LARGEST_INDEX, VolumeSummary};
use entire_core::Result;
use entire_core::kernels::Executor;
use entire_core::memory::{reserve, try_vec};
use entire_core::scene::VolumeView;

/// Scans a volume and fills its empty summary.
pub(super) fn fill<T: Voxel>(
    summary: &mut VolumeSummary,
    grid: &Grid,
    (volume, voxels): (&VolumeView<'_>, &[T]),
    executor: Executor<'_>,
) -> Result<()> {
    let map = Map::new(volume);
    let found = Found::new(grid, &map, (volume, voxels), &mut summary.quantiles, executor)?;
    lay_out(summary, grid)?;
    let places = Places::new(grid);
    for cell in each_cell(grid.cells) {
        gather(summary, &places, &map, cell, |block| found.bounds[block]);
    }
    set_totals(summary, &map, &found.counts, found.non_finite);
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
    /// Along x, y, z: number of blocks in the volume, of blocks in a cell, and of cells in the volume.
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

/// Allocates the bounds of the blocks of each cell. Allocates nothing if each cell is a single block.
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
    summary.block_low = try_vec(end, 255)?;
    summary.block_high = try_vec(end, 0)?;
    Ok(())
}

/// Computes a cell's bounds from the bounds of its blocks. If cells hold several blocks, stores the bounds of
/// the blocks too.
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
