//! The convolutions after the first one: their vectors run along output channels, and their output is in
//! channels-last layout.

use super::layout::{Block, Buffer, Output, Shape, Taps, cut};
use super::tiles::{self, Cut, MAX_POSITIONS, Tile};
use crate::Result;
use crate::kernels::Level;
use crate::kernels::simd::{Kernel, Simd};
use crate::memory::room;
use alloc::vec::Vec;
use core::ops::Range;

/// Number of output positions that are computed for one block of channels before the next block, so that the
/// inputs of these positions stay in the cache.
const CHUNK: usize = 256;

#[derive(Clone, Debug)]
pub(super) struct ChannelsLast {
    pub(super) level: Level,
    pub(super) cut: Cut,
    pub(super) shape: Shape,
    pub(super) inputs: usize,
    /// Strides of the input, in floats: channel, column, row and plane (the plane stride is used only if the
    /// whole input is in memory).
    pub(super) channel_stride: usize,
    pub(super) column: usize,
    pub(super) row: usize,
    pub(super) plane: usize,
    /// Offsets of the kernel's taps in the input, in floats. They are used only if the whole input is in
    /// memory.
    pub(super) taps: Vec<usize>,
    /// Blocks of channels: first channel, number of vectors, offset of the weights in floats.
    pub(super) blocks: Vec<(usize, usize, usize)>,
    pub(super) weights: Buffer,
    pub(super) bias: Buffer,
    /// Layout of the output: border in voxels, floats per position, total length in floats.
    pub(super) border: usize,
    pub(super) out_channels: usize,
    pub(super) out_len: usize,
}

impl ChannelsLast {
    /// Offset of channel 0 of an output position, in floats.
    pub(super) fn place(&self, z: usize, y: usize, x: usize) -> usize {
        let edge = self.shape.output + 2 * self.border;
        (((z + self.border) * edge + y + self.border) * edge + x + self.border) * self.out_channels
    }

    pub(super) fn new(
        block: &Block<'_>,
        [channel_stride, column, row, plane]: [usize; 4],
        border: usize,
        level: Level,
    ) -> Result<Self> {
        let cut = cut(level);
        let shape = block.shape;
        let k = shape.kernel;
        let all = k.pow(3);
        let out_channels = block.outputs.next_multiple_of(cut.lanes);
        let mut taps = room(all)?;
        for a in 0..k {
            for b in 0..k {
                taps.extend((0..k).map(|c| a * plane + b * row + c * column));
            }
        }
        let mut blocks = Vec::new();
        let (mut channel, mut place) = (0, 0);
        while channel < out_channels {
            let vectors = ((out_channels - channel) / cut.lanes).min(2);
            blocks.push((channel, vectors, place));
            channel += vectors * cut.lanes;
            place += all * block.inputs * vectors * cut.lanes;
        }
        let mut weights = Buffer::zeroed(place)?;
        let packed = weights.as_mut_slice();
        for &(channel, vectors, place) in &blocks {
            let wide = vectors * cut.lanes;
            for o in channel..(channel + wide).min(block.outputs) {
                for i in 0..block.inputs {
                    for tap in 0..all {
                        packed[place + (tap * block.inputs + i) * wide + o - channel] =
                            block.weight[(o * block.inputs + i) * all + tap];
                    }
                }
            }
        }
        let mut bias = Buffer::zeroed(out_channels)?;
        bias.as_mut_slice()[..block.outputs].copy_from_slice(block.bias);
        let out_len = (shape.output + 2 * border).pow(3) * out_channels;
        Ok(Self {
            level,
            cut,
            shape,
            inputs: block.inputs,
            channel_stride,
            column,
            row,
            plane,
            taps,
            blocks,
            weights,
            bias,
            border,
            out_channels,
            out_len,
        })
    }

    fn positions(&self) -> usize {
        self.shape.output.pow(3)
    }

    /// Number of tasks of a layer whose whole input is in memory: chunks of positions × blocks of channels ×
    /// tiles per chunk.
    pub(super) fn tasks(&self) -> usize {
        self.positions().div_ceil(CHUNK) * self.blocks.len() * CHUNK.div_ceil(self.cut.positions)
    }

    /// Runs a range of tasks. `input` is the whole input, with its borders on every side.
    pub(super) fn whole(&self, input: &[f32], target: Output, tasks: Range<usize>) {
        let tiles = CHUNK.div_ceil(self.cut.positions);
        let taps = Taps { offsets: &self.taps, first: 0 };
        let mut task = tasks.start;
        while task < tasks.end {
            // One iteration computes consecutive tiles of one block of channels in one chunk.
            let (chunk, block, tile) =
                (task / tiles / self.blocks.len(), task / tiles % self.blocks.len(), task % tiles);
            let run = (tiles - tile).min(tasks.end - task);
            let low = chunk * CHUNK;
            let high = (low + CHUNK).min(self.positions());
            let at = |tile: usize| (low + tile * self.cut.positions).min(high);
            self.tiles(input, &taps, target, block, at(tile)..at(tile + run), self.shape.stride * self.plane);
            task += run;
        }
    }

    /// Computes one block of output channels for a range of positions. The inputs of neighboring output planes
    /// are `plane` floats apart; 0 if the offsets in `taps` already contain this distance.
    pub(super) fn tiles(
        &self,
        input: &[f32],
        taps: &Taps<'_>,
        target: Output,
        block: usize,
        positions: Range<usize>,
        plane: usize,
    ) {
        self.level.run(Tiles { layer: self, input, taps, target, block, positions, plane });
    }
}

/// Kernel that computes one block of channels for a range of positions.
struct Tiles<'a> {
    layer: &'a ChannelsLast,
    input: &'a [f32],
    taps: &'a Taps<'a>,
    target: Output,
    block: usize,
    positions: Range<usize>,
    plane: usize,
}

impl Kernel for Tiles<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { layer, input, taps, target, block, positions, plane } = self;
        let (channel, vectors, place) = layer.blocks[block];
        let skipped = taps.first * layer.inputs * vectors * layer.cut.lanes;
        let mut tile = Tile {
            input: [core::ptr::null(); MAX_POSITIONS],
            output: [core::ptr::null_mut(); MAX_POSITIONS],
            distinct: 0,
            two_apart: false,
            tap_triples: layer.shape.kernel == 3 && layer.column == 1,
            next: core::ptr::null(),
            taps: taps.offsets.as_ptr(),
            tap_count: taps.offsets.len(),
            channels: layer.inputs,
            channel_stride: layer.channel_stride,
            weights: layer.weights.as_slice()[place + skipped..].as_ptr(),
            bias: layer.bias.as_slice()[channel..].as_ptr(),
        };
        let Shape { output: edge, stride, .. } = layer.shape;
        // True if the positions are whole groups of 16 that each lie in one row. The inputs of such a group
        // are equally spaced.
        let rows_of_16 = [edge, positions.start, positions.end].iter().all(|n| n % 16 == 0);
        let step = if layer.cut.wide && vectors == 1 && rows_of_16 { 16 } else { layer.cut.positions };
        let (mut z, mut y, mut x) =
            (positions.start / (edge * edge), positions.start / edge % edge, positions.start % edge);
        let mut p = positions.start;
        while p < positions.end {
            tile.distinct = step.min(positions.end - p);
            tile.two_apart = stride * layer.column == 2 && x + step <= edge && tile.distinct == step;
            for i in 0..step {
                let from = z * plane + stride * (y * layer.row + x * layer.column);
                tile.input[i] = input[from..].as_ptr();
                // SAFETY: `place` returns an offset inside the layer's output, and the block's channels after
                // this offset lie inside the output too.
                tile.output[i] = unsafe { target.0.add(layer.place(z, y, x) + channel) };
                // The last tile is filled up with its last position: the same values are written to the same
                // place again.
                if p + i + 1 < positions.end {
                    x += 1;
                    if x == edge {
                        (x, y) = (0, y + 1);
                    }
                    if y == edge {
                        (y, z) = (0, z + 1);
                    }
                }
            }
            tile.next = input.as_ptr().wrapping_add(z * plane + stride * (y * layer.row + x * layer.column));
            // SAFETY: every position's offset plus any tap and channel lies inside the bordered input.
            // Weights and biases are packed for whole blocks. No other thread writes these positions and
            // channels.
            unsafe { tiles::run_tile(s, &tile, step, vectors) };
            p += step;
        }
    }
}
