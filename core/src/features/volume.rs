//! What is kept of a volume: a grid of cells with value bounds and quantiles.

use crate::error::bail;
use crate::scene::{ScalarType, Scalars, VolumeView, bounding_radius, check_edges, check_spacing};
use crate::{Error, ErrorKind, Result};
use alloc::vec;
use alloc::vec::Vec;
use glam::Vec3;

/// Edge of the blocks that renderers skip by, in voxels.
pub const BLOCK_EDGE: usize = 8;

/// Most cells along an axis unless [`SummaryOptions`] says otherwise.
pub const DEFAULT_CELLS_PER_AXIS: usize = 48;

/// Quantile intervals kept per cell; the `QUANTILES + 1` bounds split its voxels into shares of equal size.
pub const QUANTILES: usize = 8;

/// Largest stored integer that indexes a table of 15 bits as it stands.
pub const LARGEST_INDEX: i16 = i16::MAX;

/// Most blocks kept inside one cell along an axis; beyond that a kept block is a run of blocks.
const BLOCKS_PER_CELL_AXIS: usize = 8;

/// How a [`VolumeSummary`] is made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SummaryOptions {
    /// Most cells along each axis, 1…128. Cells have the edge of a block, doubled along an axis until this holds.
    pub cells_per_axis: usize,
}

impl Default for SummaryOptions {
    fn default() -> Self {
        Self { cells_per_axis: DEFAULT_CELLS_PER_AXIS }
    }
}

/// The box that rays meet, in scene space (origin at its center, unit = bounding-sphere radius).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geometry {
    /// Half the box.
    pub half_extent: Vec3,
    /// The reference ray step.
    pub reference_step: f32,
}

/// Value bounds and quantiles of one cell, as indices into a 256-entry table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CellStats {
    /// Lowest table entry that a sample in the cell can touch (interpolation with the voxels beyond its far side included).
    pub(super) low: u8,
    /// Highest such entry.
    pub(super) high: u8,
    /// Ascending quantile bounds of the cell's own voxels.
    pub(super) quantiles: [u8; QUANTILES + 1],
}

/// What is kept of a volume: about 12 bytes per cell of 8³ voxels, never the voxels.
///
/// Cell (i, j, k) with edge e holds the samples between the centers of voxels e·i and e·(i + 1) along each axis; so one
/// voxel beyond its far side enters its bounds. The edge is [`BLOCK_EDGE`] voxels along each axis, coarser by powers of two where the volume is larger than
/// the options allow; then the value bounds of the blocks inside each cell are kept too, so that emptiness is still
/// judged by the blocks that a renderer skips.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeSummary {
    dims: [usize; 3],
    spacing: Vec3,
    scalar_type: ScalarType,
    geometry: Geometry,
    /// Cells along each axis.
    cells: [usize; 3],
    /// Voxels along each axis of a cell.
    edge: [usize; 3],
    /// Voxels along each axis of a block.
    block: [usize; 3],
    stats: Vec<CellStats>,
    /// Bounds of the blocks inside each cell, cell after cell; `first_block[c]..first_block[c + 1]`. Empty where every
    /// cell is one block.
    blocks: Vec<[u8; 2]>,
    first_block: Vec<u32>,
    histogram: [f32; 256],
    non_finite_share: f32,
    remapped: bool,
}

impl VolumeSummary {
    /// Scans a volume once.
    ///
    /// # Errors
    /// [`ErrorKind::InvalidArgument`] for options out of range, [`ErrorKind::SizeMismatch`] for a volume with more
    /// blocks than can be indexed.
    pub fn new(volume: &VolumeView<'_>, options: SummaryOptions) -> Result<Self> {
        let mut summary = Self::layout(volume.dims(), volume.spacing(), volume.scalar_type(), options)?;
        match volume.scalars() {
            Scalars::U8(s) => {
                // Everything kept is monotone in the stored byte: bytes are counted, and mapped at the end.
                let mut positions: [f32; 256] = core::array::from_fn(|v| v as f32);
                to_positions(volume, &mut positions);
                let mut map = Entries { low: [0; 256], high: [0; 256], near: [0; 256] };
                entries(&positions, [&mut map.low, &mut map.high, &mut map.near]);
                let total = summary.scan(volume, &map, |at, [low, high, near]| {
                    copy(s, at, near, |v| v);
                    low.copy_from_slice(near);
                    high.copy_from_slice(near);
                    0
                });
                summary.remapped = total[0] == 0;
            }
            Scalars::U16(s) => summary.scan_numbers(volume, |at, row| copy(s, at, row, f32::from)),
            Scalars::I16(s) => summary.scan_numbers(volume, |at, row| copy(s, at, row, f32::from)),
            Scalars::F32(s) => summary.scan_numbers(volume, |at, row| copy(s, at, row, |v| v)),
        }
        Ok(summary)
    }

    /// From bounds that the renderer already has: one (low, high) pair of normalized scalars per brick of
    /// `brick_edge` voxels, x fastest, ⌈dims / edge⌉ bricks per axis, the apron that interpolation needs included.
    /// Values inside a brick are taken as spread evenly between its bounds. NaN bounds count as 0.
    ///
    /// # Errors
    /// [`ErrorKind::InvalidArgument`] for a size or edge of 0 or a spacing that [`VolumeView::with_spacing`] refuses,
    /// [`ErrorKind::SizeMismatch`] for a size over [`crate::scene::MAX_VOLUME_EDGE`] or when the number of bricks is not
    /// the one that sizes and edge give.
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
        check_edges(dims)?;
        let spacing = check_spacing(spacing)?;
        let cells: [usize; 3] = core::array::from_fn(|a| dims[a].div_ceil(brick_edge[a]));
        let expected = count(cells, dims)?;
        if expected != bounds.len() {
            bail!(
                SizeMismatch,
                "a volume of {dims:?} voxels in bricks of {brick_edge:?} has {expected} bricks, {} bounds were given; pass one (low, high) pair per brick, x fastest",
                bounds.len()
            );
        }
        let mut summary = Self::with_grid(dims, spacing, scalar_type, cells, brick_edge)?;
        summary.block = brick_edge;
        let mut smallest = 1.0f32;
        let clean = |v: f32| if v.is_nan() { 0.0 } else { v.clamp(0.0, 1.0) };
        for (i, bound) in bounds.iter().enumerate() {
            let (a, b) = (clean(bound[0]), clean(bound[1]));
            let (lo, hi) = (a.min(b), a.max(b));
            smallest = smallest.min(lo);
            let stats = &mut summary.stats[i];
            stats.low = entry_below(lo);
            stats.high = entry_above(hi);
            for (k, q) in stats.quantiles.iter_mut().enumerate() {
                *q = entry_near(lo + (hi - lo) * k as f32 / QUANTILES as f32);
            }
        }
        summary.remapped = scalar_type == ScalarType::F32 || smallest > 0.0;
        summary.histogram_from_quantiles();
        Ok(summary)
    }

    /// Voxels along x, y, z.
    pub fn dims(&self) -> [usize; 3] {
        self.dims
    }

    /// Voxel spacing along x, y, z.
    pub fn spacing(&self) -> Vec3 {
        self.spacing
    }

    /// Radius of the bounding sphere in world units, as in [`VolumeView::bounding_radius`].
    pub fn bounding_radius(&self) -> f32 {
        let [x, y, z] = self.dims.map(|n| n as f32);
        bounding_radius(Vec3::new(x, y, z) * self.spacing)
    }

    /// The element type of the volume.
    pub fn scalar_type(&self) -> ScalarType {
        self.scalar_type
    }

    /// The box that rays meet.
    pub fn geometry(&self) -> Geometry {
        self.geometry
    }

    /// Cells along x, y, z.
    pub fn cells(&self) -> [usize; 3] {
        self.cells
    }

    /// Voxels along each axis of a cell (the last cell of an axis may reach beyond the volume).
    pub fn cell_edge(&self) -> [usize; 3] {
        self.edge
    }

    /// Voxels along each axis of the blocks by which emptiness is judged.
    pub fn block_edge(&self) -> [usize; 3] {
        self.block
    }

    /// Lowest and highest table entry that samples in a cell can touch.
    ///
    /// # Panics
    /// When the cell lies outside the grid.
    pub fn cell_bounds(&self, x: usize, y: usize, z: usize) -> (u8, u8) {
        assert!(
            x < self.cells[0] && y < self.cells[1] && z < self.cells[2],
            "cell {x}, {y}, {z} outside the grid"
        );
        let s = &self.stats[x + self.cells[0] * (y + self.cells[1] * z)];
        (s.low, s.high)
    }

    /// Share of voxels per table entry; sums to 1.
    pub fn histogram(&self) -> &[f32; 256] {
        &self.histogram
    }

    /// Share of voxels that are NaN or infinite.
    pub fn non_finite_share(&self) -> f32 {
        self.non_finite_share
    }

    /// Whether a renderer that looks stored values up in a table must shift or scale each of them: not where they are
    /// integers from 0, which is among them, to at most [`LARGEST_INDEX`]. Of a volume made of bricks the bounds tell: 0
    /// among those of integers is taken as a stored 0.
    pub fn remapped(&self) -> bool {
        self.remapped
    }

    /// Number of voxels.
    pub fn voxels(&self) -> f64 {
        self.dims.iter().map(|&n| n as f64).product()
    }

    pub(super) fn stats(&self) -> &[CellStats] {
        &self.stats
    }

    /// Bounds of the blocks of a cell, or `None` where the cell is one block.
    pub(super) fn blocks_of(&self, cell: usize) -> Option<&[[u8; 2]]> {
        if self.first_block.is_empty() {
            return None;
        }
        Some(&self.blocks[self.first_block[cell] as usize..self.first_block[cell + 1] as usize])
    }

    fn layout(
        dims: [usize; 3],
        spacing: Vec3,
        scalar_type: ScalarType,
        options: SummaryOptions,
    ) -> Result<Self> {
        let most = options.cells_per_axis;
        if most == 0 || most > 128 {
            bail!(InvalidArgument, "{most} cells per axis were asked for; accepted are 1…128");
        }
        let mut edge = [BLOCK_EDGE; 3];
        for axis in 0..3 {
            while dims[axis].div_ceil(edge[axis]) > most {
                edge[axis] *= 2;
            }
        }
        let cells: [usize; 3] = core::array::from_fn(|a| dims[a].div_ceil(edge[a]));
        Self::with_grid(dims, spacing, scalar_type, cells, edge)
    }

    fn with_grid(
        dims: [usize; 3],
        spacing: Vec3,
        scalar_type: ScalarType,
        cells: [usize; 3],
        edge: [usize; 3],
    ) -> Result<Self> {
        let n = count(cells, dims)?;
        let extent = Vec3::new(dims[0] as f32, dims[1] as f32, dims[2] as f32) * spacing;
        let radius = bounding_radius(extent);
        let geometry =
            Geometry { half_extent: 0.5 * extent / radius, reference_step: spacing.min_element() / radius };
        let empty = CellStats { low: 255, high: 0, quantiles: [0; QUANTILES + 1] };
        Ok(Self {
            dims,
            spacing,
            scalar_type,
            geometry,
            cells,
            edge,
            block: edge.map(|e| e.min((e / BLOCKS_PER_CELL_AXIS).max(BLOCK_EDGE))),
            stats: vec![empty; n],
            blocks: Vec::new(),
            first_block: Vec::new(),
            histogram: [0.0; 256],
            non_finite_share: 0.0,
            remapped: true,
        })
    }

    /// As [`scan`](Self::scan) for numbers that are mapped first. `read((start, stride), out)` copies a row's values.
    fn scan_numbers(&mut self, volume: &VolumeView<'_>, read: impl Fn((usize, usize), &mut [f32])) {
        let mut row = vec![0.0f32; self.dims[0]];
        let same: [u8; 256] = core::array::from_fn(|v| v as u8);
        let (mut smallest, mut largest) = (f32::INFINITY, f32::NEG_INFINITY);
        self.scan(volume, &Entries { low: same, high: same, near: same }, |at, out| {
            read(at, &mut row);
            let non_finite = row.iter().map(|v| u32::from(!v.is_finite())).sum();
            for &v in &row {
                smallest = smallest.min(v);
                largest = largest.max(v);
            }
            to_positions(volume, &mut row);
            entries(&row, out);
            non_finite
        });
        self.remapped =
            self.scalar_type == ScalarType::F32 || smallest != 0.0 || largest > f32::from(LARGEST_INDEX);
    }

    /// Reads every voxel once. `fetch((start, stride), [low, high, near])` writes three bytes per voxel of a row, from
    /// which `map` leads to table entries without changing their order, and says how many of them are not finite. Gives
    /// how often each byte was written as `near`.
    ///
    /// A row enters the bounds of the blocks that it lies in and, where it is a block's first along y or z, those of the
    /// blocks before. Rows are joined voxel by voxel and reduced along x once per block.
    fn scan(
        &mut self,
        volume: &VolumeView<'_>,
        map: &Entries,
        mut fetch: impl FnMut((usize, usize), [&mut [u8]; 3]) -> u32,
    ) -> [u64; 256] {
        let (dims, edge, cells, block) = (self.dims, self.edge, self.cells, self.block);
        let n: [usize; 3] = core::array::from_fn(|a| dims[a].div_ceil(block[a]));
        let mut bounds = vec![[255u8, 0u8]; n[0] * n[1] * n[2]];
        let [mut low, mut high] = [vec![0u8; dims[0]], vec![0u8; dims[0]]];
        // Own rows of one block row, and those that the blocks before it along y, z and both see of it.
        let mut joined: [Joined; 4] = core::array::from_fn(|_| Joined::new(dims[0]));
        // The rows of one row of cells.
        let mut near = vec![0u8; edge[2].min(dims[2]) * edge[1].min(dims[1]) * dims[0]];
        let mut counts = [[0u32; 256]; 4];
        let mut total = [0u64; 256];
        let mut non_finite = 0u64;
        let span = |i: usize, size: usize, axis: usize| i * size..((i + 1) * size).min(dims[axis]);
        for (cz, cy) in (0..cells[2]).flat_map(|z| (0..cells[1]).map(move |y| (z, y))) {
            let (zs, ys) = (span(cz, edge[2], 2), span(cy, edge[1], 1));
            for bz in zs.start / block[2]..zs.end.div_ceil(block[2]) {
                for by in ys.start / block[1]..ys.end.div_ceil(block[1]) {
                    joined.iter_mut().for_each(Joined::clear);
                    for z in span(bz, block[2], 2) {
                        for y in span(by, block[1], 1) {
                            let row = ((z - zs.start) * ys.len() + y - ys.start) * dims[0];
                            let near = &mut near[row..row + dims[0]];
                            let at = (volume.index(0, y, z), volume.strides()[0]);
                            non_finite += u64::from(fetch(at, [&mut low, &mut high, near]));
                            let (first_y, first_z) = (y == by * block[1], z == bz * block[2]);
                            for (j, takes) in
                                joined.iter_mut().zip([true, first_y, first_z, first_y && first_z])
                            {
                                if takes {
                                    j.add(&low, &high);
                                }
                            }
                        }
                    }
                    for (j, back) in joined.iter().zip([[0, 0], [1, 0], [0, 1], [1, 1]]) {
                        if by >= back[0] && bz >= back[1] {
                            let line = n[0] * (by - back[0] + n[1] * (bz - back[1]));
                            j.reduce(block[0], &mut bounds[line..][..n[0]]);
                        }
                    }
                }
            }
            let rows = &near[..zs.len() * ys.len() * dims[0]];
            for cx in 0..cells[0] {
                counts.iter_mut().for_each(|c| c.fill(0));
                for row in rows.chunks_exact(dims[0]) {
                    count_entries(&row[span(cx, edge[0], 0)], &mut counts);
                }
                let [a, b, c, d] = &counts;
                let histogram: [u64; 256] =
                    core::array::from_fn(|i| [a, b, c, d].iter().map(|c| u64::from(c[i])).sum());
                total.iter_mut().zip(&histogram).for_each(|(t, &h)| *t += h);
                let stats = &mut self.stats[cx + cells[0] * (cy + cells[1] * cz)];
                stats.quantiles = quantiles(&histogram).map(|q| map.near[usize::from(q)]);
            }
        }
        for b in &mut bounds {
            *b = [map.low[usize::from(b[0])], map.high[usize::from(b[1])]];
        }
        self.gather_blocks(&bounds, n);
        let mut mapped = [0u64; 256];
        for (&entry, &t) in map.near.iter().zip(&total) {
            mapped[usize::from(entry)] += t;
        }
        let voxels = self.voxels();
        for (h, &t) in self.histogram.iter_mut().zip(&mapped) {
            *h = (t as f64 / voxels) as f32;
        }
        self.non_finite_share = (non_finite as f64 / voxels) as f32;
        total
    }

    /// Bounds of cells from those of their blocks, which are kept where a cell holds several.
    fn gather_blocks(&mut self, bounds: &[[u8; 2]], n: [usize; 3]) {
        let per_cell: [usize; 3] = core::array::from_fn(|a| self.edge[a] / self.block[a]);
        let split = self.block != self.edge;
        if split {
            self.first_block.reserve_exact(self.stats.len() + 1);
            self.first_block.push(0);
            self.blocks.reserve_exact(bounds.len());
        }
        for (index, stats) in self.stats.iter_mut().enumerate() {
            let c = [
                index % self.cells[0],
                index / self.cells[0] % self.cells[1],
                index / self.cells[0] / self.cells[1],
            ];
            let range = |a: usize| c[a] * per_cell[a]..((c[a] + 1) * per_cell[a]).min(n[a]);
            for bz in range(2) {
                for by in range(1) {
                    for bx in range(0) {
                        let b = bounds[bx + n[0] * (by + n[1] * bz)];
                        stats.low = stats.low.min(b[0]);
                        stats.high = stats.high.max(b[1]);
                        if split {
                            self.blocks.push(b);
                        }
                    }
                }
            }
            if split {
                self.first_block.push(self.blocks.len() as u32);
            }
        }
    }

    fn histogram_from_quantiles(&mut self) {
        let mut sum = [0.0f64; 256];
        let share = 1.0 / (self.stats.len() * QUANTILES) as f64;
        for stats in &self.stats {
            for pair in stats.quantiles.windows(2) {
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

/// Table entries: at or below a position, at or above it, and nearest.
struct Entries {
    low: [u8; 256],
    high: [u8; 256],
    near: [u8; 256],
}

/// Several rows, joined voxel by voxel.
struct Joined {
    low: Vec<u8>,
    high: Vec<u8>,
}

impl Joined {
    fn new(len: usize) -> Self {
        Self { low: vec![255; len], high: vec![0; len] }
    }

    fn clear(&mut self) {
        self.low.fill(255);
        self.high.fill(0);
    }

    fn add(&mut self, low: &[u8], high: &[u8]) {
        self.low.iter_mut().zip(low).for_each(|(a, &b)| *a = (*a).min(b));
        self.high.iter_mut().zip(high).for_each(|(a, &b)| *a = (*a).max(b));
    }

    /// Widens the bounds of a row of blocks: a block's values are its own and the first one of the next block.
    fn reduce(&self, block: usize, bounds: &mut [[u8; 2]]) {
        for (bx, bound) in bounds.iter_mut().enumerate() {
            let range = bx * block..(bx * block + block + 1).min(self.low.len());
            bound[0] = self.low[range.clone()].iter().fold(bound[0], |a, &b| a.min(b));
            bound[1] = self.high[range].iter().fold(bound[1], |a, &b| a.max(b));
        }
    }
}

/// The entries of positions in 0…255, in arithmetic that compilers vectorise.
fn entries(positions: &[f32], [low, high, near]: [&mut [u8]; 3]) {
    /// 2²³: adding it rounds to an integer, which then stands in the low bits.
    const SHIFT: f32 = 8_388_608.0;
    let below = |v: f32| {
        let rounded = (v + SHIFT) - SHIFT;
        if rounded > v { rounded - 1.0 } else { rounded }
    };
    let byte = |whole: f32| (whole + SHIFT).to_bits() as u8;
    for (((&p, low), high), near) in positions.iter().zip(low).zip(high).zip(near) {
        let floor = below(p);
        *low = byte(floor);
        *high = byte(if floor < p { floor + 1.0 } else { floor });
        *near = byte(below(p + 0.5));
    }
}

/// Counts bytes in four tables in turn: in one, equal neighbours would wait for each other.
fn count_entries(bytes: &[u8], counts: &mut [[u32; 256]; 4]) {
    let (fours, rest) = bytes.as_chunks::<4>();
    for four in fours {
        for (table, &b) in counts.iter_mut().zip(four) {
            table[usize::from(b)] += 1;
        }
    }
    for &b in rest {
        counts[0][usize::from(b)] += 1;
    }
}

fn copy<T: Copy, U>(from: &[T], (start, stride): (usize, usize), out: &mut [U], to: impl Fn(T) -> U) {
    if stride == 1 {
        let n = out.len();
        for (slot, &v) in out.iter_mut().zip(&from[start..start + n]) {
            *slot = to(v);
        }
    } else {
        for (i, slot) in out.iter_mut().enumerate() {
            *slot = to(from[start + i * stride]);
        }
    }
}

/// Turns stored values into table positions, 0…255, as [`VolumeView::normalize`] does.
fn to_positions(volume: &VolumeView<'_>, row: &mut [f32]) {
    let (low, high) = volume.range();
    let width = high - low;
    let scale = 255.0 / width;
    if width > 0.0 && scale > 0.0 && scale.is_finite() {
        for p in row {
            let t = (*p - low) * scale;
            // In this order NaN becomes 0.
            let t = if t > 0.0 { t } else { 0.0 };
            *p = if t < 255.0 { t } else { 255.0 };
        }
    } else {
        row.iter_mut().for_each(|p| *p = volume.normalize(*p) * 255.0);
    }
}

fn quantiles(histogram: &[u64; 256]) -> [u8; QUANTILES + 1] {
    let voxels: u64 = histogram.iter().sum();
    let mut out = [0u8; QUANTILES + 1];
    let (mut below, mut next) = (0u64, 0usize);
    for (entry, &n) in histogram.iter().enumerate() {
        below += n;
        // Bound k is the smallest entry with more than k/QUANTILES of the voxels at or below it.
        while next < QUANTILES && below * QUANTILES as u64 > next as u64 * voxels {
            out[next] = entry as u8;
            next += 1;
        }
        if next == QUANTILES {
            break;
        }
    }
    out[QUANTILES] = histogram.iter().rposition(|&n| n > 0).unwrap_or(0) as u8;
    out
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

fn entry_below(s: f32) -> u8 {
    (s * 255.0) as u8
}

fn entry_above(s: f32) -> u8 {
    ceil_entry(s * 255.0)
}

fn entry_near(s: f32) -> u8 {
    (s * 255.0 + 0.5) as u8
}
