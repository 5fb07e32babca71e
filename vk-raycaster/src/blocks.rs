//! Min–max blocks, their emptiness under a transfer function, and the distance of each block to the nearest
//! block of the other kind (empty or not).

use crate::clock::Stopwatch;
use crate::renderer::Preparation;
use crate::table::Classifier;
use crate::voxels::{BLOCK_EDGE, PreparedVolume, Voxel, with_voxels};
use rayon::prelude::*;

/// Largest distance that a [`SkipMap`] entry holds, in blocks.
const MAX_DISTANCE: u8 = 127;

/// Bit of a [`SkipMap`] entry that marks an empty block.
pub(crate) const EMPTY_BIT: u8 = 128;

/// For each block, the smallest and largest table position (0…255) of the voxels that its samples
/// interpolate: the block's voxels and one more along each axis.
pub(crate) struct BlockMap {
    pub(crate) dims: [usize; 3],
    pub(crate) ranges: Vec<[f32; 2]>,
}

impl BlockMap {
    pub(crate) fn new(volume: &PreparedVolume) -> Self {
        let dims = volume.geometry.blocks();
        Self { dims, ranges: with_voxels!(&volume.voxels, v => ranges(v, volume, dims)) }
    }
}

fn ranges<V: Voxel>(voxels: &[V], volume: &PreparedVolume, dims: [usize; 3]) -> Vec<[f32; 2]> {
    let [nx, ny, nz] = volume.geometry.dims;
    let position = |v: V| (v.to_f32() * volume.geometry.scale + volume.geometry.bias).clamp(0.0, 255.0);
    let mut out = vec![[0.0; 2]; dims[0] * dims[1] * dims[2]];
    out.par_chunks_mut(dims[0]).enumerate().for_each(|(row, out)| {
        let (by, bz) = (row % dims[1], row / dims[1]);
        // For each block of the row: minimum and maximum of the voxels visited so far.
        let mut ends: Vec<Option<(V, V)>> = vec![None; dims[0]];
        for z in bz * BLOCK_EDGE..=((bz + 1) * BLOCK_EDGE).min(nz - 1) {
            for y in by * BLOCK_EDGE..=((by + 1) * BLOCK_EDGE).min(ny - 1) {
                let line = &voxels[(z * ny + y) * nx..][..nx];
                for (bx, ends) in ends.iter_mut().enumerate() {
                    let run = &line[bx * BLOCK_EDGE..=((bx + 1) * BLOCK_EDGE).min(nx - 1)];
                    let (mut low, mut high) = ends.unwrap_or((run[0], run[0]));
                    for &v in run {
                        low = if v < low { v } else { low };
                        high = if v > high { v } else { high };
                    }
                    *ends = Some((low, high));
                }
            }
        }
        for (o, e) in out.iter_mut().zip(ends) {
            if let Some((low, high)) = e {
                *o = [position(low), position(high)];
            }
        }
    });
    out
}

/// One byte per block: bit 7 is set for an empty block; bits 0 to 6 are the Chebyshev distance in blocks to
/// the nearest block of the other kind, 1…127. All blocks closer than that distance are of the block's own
/// kind.
pub(crate) struct SkipMap {
    pub(crate) dims: [usize; 3],
    pub(crate) bytes: Vec<u8>,
}

impl SkipMap {
    /// Makes the map of a volume and a transfer function. Stores in `preparation` the seconds for finding the
    /// empty blocks and for the distances.
    pub(crate) fn new(blocks: &BlockMap, classifier: &Classifier, preparation: &mut Preparation) -> Self {
        let watch = Stopwatch::start();
        let mut map = Self::occupancy(blocks, classifier);
        preparation.occupancy = Some(watch.wall());
        let watch = Stopwatch::start();
        map.add_distances();
        preparation.distance_map = Some(watch.wall());
        map
    }

    /// Makes a map that marks the empty blocks; all its distances are 1.
    fn occupancy(blocks: &BlockMap, classifier: &Classifier) -> Self {
        let bytes = blocks
            .ranges
            .par_iter()
            .map(|&[low, high]| if classifier.is_empty(low, high) { EMPTY_BIT | 1 } else { 1 })
            .collect();
        Self { dims: blocks.dims, bytes }
    }

    fn add_distances(&mut self) {
        let to_occupied = distances(&self.bytes, self.dims, 0);
        let to_empty = distances(&self.bytes, self.dims, EMPTY_BIT);
        for ((b, o), e) in self.bytes.iter_mut().zip(to_occupied).zip(to_empty) {
            let empty = *b & EMPTY_BIT;
            *b = empty | if empty != 0 { o } else { e };
        }
    }

    pub(crate) fn empty_blocks(&self) -> usize {
        self.bytes.iter().filter(|&&b| b & EMPTY_BIT != 0).count()
    }
}

/// Returns the Chebyshev distance of every block to the nearest block whose bit 7 equals `kind`, at most
/// [`MAX_DISTANCE`].
///
/// Two passes visit the blocks in opposite orders. Each pass limits a block's distance to 1 more than the
/// smallest distance among the 13 neighbors that it has already visited. The result is exact for this metric
/// (Borgefors, Distance transformations in arbitrary dimensions, 1984). The run time does not depend on the
/// distances.
fn distances(bytes: &[u8], dims: [usize; 3], kind: u8) -> Vec<u8> {
    let [nx, ny, nz] = dims;
    // One layer of blocks at the largest distance surrounds the map.
    let (row, plane) = (nx + 2, (nx + 2) * (ny + 2));
    let start = |y: usize, z: usize| (z + 1) * plane + (y + 1) * row;
    let mut d = vec![MAX_DISTANCE; plane * (nz + 2)];
    for (at, line) in bytes.chunks_exact(nx).enumerate() {
        let inner = &mut d[start(at % ny, at / ny) + 1..][..nx];
        for (d, b) in inner.iter_mut().zip(line) {
            *d = if b & EMPTY_BIT == kind { 0 } else { MAX_DISTANCE };
        }
    }
    let mut least = vec![MAX_DISTANCE; row];
    let mut visit = |y: usize, z: usize, forward: bool| {
        let here = start(y, z);
        let side = |offset: usize| if forward { here - offset } else { here + offset };
        let visited = [row, plane - row, plane, plane + row].map(side);
        let (first, rest) = visited.split_at(1);
        least.copy_from_slice(&d[first[0]..][..row]);
        for &from in rest {
            least.iter_mut().zip(&d[from..][..row]).for_each(|(l, d)| *l = (*l).min(*d));
        }
        let line = &mut d[here..][..row];
        for (x, d) in line[1..=nx].iter_mut().enumerate() {
            *d = (*d).min(least[x].min(least[x + 1]).min(least[x + 2]) + 1);
        }
        let mut before = MAX_DISTANCE;
        let mut step = |d: &mut u8| {
            *d = (*d).min(before + 1).min(MAX_DISTANCE);
            before = *d;
        };
        if forward {
            line[1..=nx].iter_mut().for_each(&mut step)
        } else {
            line[1..=nx].iter_mut().rev().for_each(&mut step)
        }
    };
    for (y, z) in (0..nz).flat_map(|z| (0..ny).map(move |y| (y, z))) {
        visit(y, z, true);
    }
    for (y, z) in (0..nz).rev().flat_map(|z| (0..ny).rev().map(move |y| (y, z))) {
        visit(y, z, false);
    }
    let rows = (0..nz).flat_map(|z| (0..ny).map(move |y| start(y, z) + 1));
    rows.flat_map(|from| d[from..][..nx].iter().copied()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::scene::{Scalars, TABLE_LEN, TransferTable, VolumeView};

    fn block_map(data: &[u8], dims: [usize; 3]) -> BlockMap {
        BlockMap::new(&PreparedVolume::new(&VolumeView::new(Scalars::U8(data), dims).unwrap()))
    }

    #[test]
    fn blocks_hold_their_voxels_and_one_layer_more() {
        let dims = [17, 9, 8];
        let mut data = vec![10u8; 17 * 9 * 8];
        data[8] = 99; // x = 8: inside block 1, in the extra layer of block 0
        data[16 + 17 * 8] = 1; // x = 16, y = 8: inside the last block, in its neighbors' extra layers
        let map = block_map(&data, dims);
        assert_eq!(map.dims, [3, 2, 1]);
        assert_eq!(map.ranges[0], [10.0, 99.0]);
        assert_eq!(map.ranges[1], [1.0, 99.0]);
        assert_eq!(map.ranges[2], [1.0, 10.0]);
        assert_eq!(map.ranges[3], [10.0, 10.0]);
        assert_eq!(map.ranges[5], [1.0, 10.0]);
    }

    #[test]
    fn one_voxel_makes_one_block() {
        let map = block_map(&[42], [1, 1, 1]);
        assert_eq!((map.dims, map.ranges), ([1, 1, 1], vec![[42.0, 42.0]]));
    }

    #[test]
    fn distances_match_a_search_over_all_blocks() {
        let dims = [7, 5, 6];
        let mut state = 12345u32;
        for density in [2u32, 10, 100] {
            let bytes: Vec<u8> = (0..7 * 5 * 6)
                .map(|_| {
                    state = state.wrapping_mul(1664525).wrapping_add(1013904223);
                    if (state >> 16).is_multiple_of(density) { 1 } else { EMPTY_BIT | 1 }
                })
                .collect();
            let mut map = SkipMap { dims, bytes: bytes.clone() };
            map.add_distances();
            let at = |x: usize, y: usize, z: usize| (z * dims[1] + y) * dims[0] + x;
            for z in 0..dims[2] {
                for y in 0..dims[1] {
                    for x in 0..dims[0] {
                        let mut want = MAX_DISTANCE;
                        for k in 0..dims[2] {
                            for j in 0..dims[1] {
                                for i in 0..dims[0] {
                                    if (bytes[at(i, j, k)] ^ bytes[at(x, y, z)]) & EMPTY_BIT != 0 {
                                        let d = i.abs_diff(x).max(j.abs_diff(y)).max(k.abs_diff(z));
                                        want = want.min(d as u8);
                                    }
                                }
                            }
                        }
                        assert_eq!(
                            map.bytes[at(x, y, z)],
                            bytes[at(x, y, z)] & EMPTY_BIT | want,
                            "{x} {y} {z}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn occupancy_follows_the_table() {
        let mut data = vec![0u8; 16 * 8 * 8];
        data[15] = 200;
        let map = block_map(&data, [16, 8, 8]);
        let mut rgba = [[1.0, 1.0, 1.0, 0.0]; TABLE_LEN];
        rgba[150][3] = 0.5;
        let skip = SkipMap::occupancy(&map, &Classifier::new(&TransferTable::new(rgba).unwrap()));
        assert_eq!(skip.bytes, [EMPTY_BIT | 1, 1]);
        assert_eq!(skip.empty_blocks(), 1);
    }
}
