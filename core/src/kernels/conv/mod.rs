//! Direct 3-D convolution, without im2col: memory layouts, packed weights, and the order of the work.
//!
//! # Layouts
//!
//! The first layer has one input channel, so its vectors run along x. Its input planes are *prepared*: every
//! row is split into `stride` phases (padded coordinate X = stride·q + phase is element q of its phase), so
//! that the samples that one tap reads for neighboring outputs are contiguous. Its output is *planar*: one
//! row per y and channel.
//!
//! Every other layer has its vectors along output channels and broadcasts one input value at a time. Its
//! input is either the planar output of the first layer or *channels last*: (z, y, x, channel) with zero
//! borders as wide as the layer's padding. Its output is channels last, with the borders of the next layer.
//!
//! The first two layers run plane by plane: a thread keeps only as many prepared planes, and planes of the
//! first layer's output, as the kernels span. Borders are zeroed at allocation and stay zero.
//!
//! # Order
//!
//! Every output starts at its bias and adds its taps in one accumulator, either in the order (kernel z, y, x,
//! input channel) or in the order (kernel z, y, input channel, x). All positions of an output channel use the
//! same order, so the result is bit-identical for every tiling and every number of threads.

mod channels_last;
mod head;
mod layout;
mod planar;
mod tiles;

use crate::Result;
use crate::kernels::{Executor, Level, mlp};
use crate::memory::{collected, room, try_vec};
use alloc::vec::Vec;
use channels_last::ChannelsLast;
use core::ops::Range;
use head::Dense;
pub(crate) use layout::{Block, Shape};
use layout::{Buffer, LINE, Output, Taps};
use planar::Planar;
pub(crate) use planar::{Prepare, PreparedPlane};

/// An encoder with weights packed for one SIMD level.
#[derive(Clone, Debug)]
pub(crate) struct Encoder {
    level: Level,
    first: Planar,
    rest: Vec<ChannelsLast>,
    /// Weights of the dense layer: for each feature, one weight per float of the last convolution's output.
    dense: Buffer,
    dense_len: usize,
    dense_bias: Vec<f32>,
}

/// Working memory of one encoder.
#[derive(Clone, Debug, Default)]
pub(crate) struct Scratch {
    workers: Vec<Worker>,
    outputs: Vec<Buffer>,
    /// Sizes and layout for which the buffers were allocated (`Encoder::sizes`).
    sizes: Vec<usize>,
}

#[derive(Clone, Debug)]
struct Worker {
    prepared: Buffer,
    ring: Buffer,
    taps: Vec<usize>,
}

impl Encoder {
    /// Packs checked blocks and the dense layer.
    ///
    /// # Errors
    /// [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the packed weights cannot be allocated.
    pub(crate) fn new(blocks: &[Block<'_>], fc: &mlp::Dense<'_>, level: Level) -> Result<Self> {
        let padding_of = |i: usize| blocks.get(i).map_or(0, |b: &Block<'_>| b.shape.padding);
        let first = Planar::new(&blocks[0], padding_of(1), level)?;
        let mut rest: Vec<ChannelsLast> = room(blocks.len() - 1)?;
        for (i, block) in blocks.iter().enumerate().skip(1) {
            let edge = block.shape.input + 2 * block.shape.padding;
            let strides = match rest.last().map(|before| before.out_channels) {
                None => [first.out_row, 1, first.padded * first.out_row, first.out_plane],
                Some(column) => [1, column, edge * column, edge * edge * column],
            };
            rest.push(ChannelsLast::new(block, strides, padding_of(i + 1), level)?);
        }
        // The dense layer's weights, reordered to the layout of the last layer's output.
        let Block { shape: Shape { output: edge, .. }, outputs: channels, .. } = blocks[blocks.len() - 1];
        let dense_len = rest.last().map_or(edge * first.out_plane, |l| l.out_len).next_multiple_of(LINE);
        let mut dense = Buffer::zeroed(dense_len * fc.outputs)?;
        for (row, weights) in
            dense.as_mut_slice().chunks_exact_mut(dense_len).zip(fc.weight.chunks_exact(fc.inputs))
        {
            let mut weights = weights.iter();
            for c in 0..channels {
                for z in 0..edge {
                    for y in 0..edge {
                        for x in 0..edge {
                            let place = match rest.last() {
                                Some(l) => l.place(z, y, x) + c,
                                None => first.place(z, y, c) - first.lead + x,
                            };
                            row[place] = weights.next().copied().unwrap_or(0.0);
                        }
                    }
                }
            }
        }
        Ok(Self { level, first, rest, dense, dense_len, dense_bias: collected(fc.bias.iter().copied())? })
    }

    fn sizes(&self) -> impl Iterator<Item = usize> {
        let f = &self.first;
        let ring = self.rest.first().map_or(0, |second| f.lead + second.shape.kernel * f.out_plane);
        let whole = if self.rest.is_empty() { f.lead + f.shape.output * f.out_plane } else { 0 };
        // The extra line keeps the reads of the last row, rounded up to whole vectors, inside the buffer.
        let buffers = [f.shape.kernel * f.plane + LINE, ring + LINE, whole + LINE];
        // The layout is included, because two encoders can have buffers of equal sizes with borders at
        // different places.
        let layout = [f.plane, f.row, f.phase, f.shape.padding, f.out_plane, f.border];
        buffers.into_iter().chain(layout).chain(
            self.rest.iter().flat_map(|l| [l.out_len.next_multiple_of(LINE), l.border, l.out_channels]),
        )
    }

    /// Reallocates the scratch unless it fits this encoder, and adds a worker for each thread that lacks one.
    fn fit(&self, scratch: &mut Scratch, threads: usize) -> Result<()> {
        if !self.sizes().eq(scratch.sizes.iter().copied()) {
            // The scratch stays empty until every allocation has succeeded. After a failed allocation, the
            // next call allocates again.
            *scratch = Scratch::default();
            let sizes: Vec<usize> = self.sizes().collect();
            scratch.outputs.push(Buffer::zeroed(sizes[2])?);
            for layer in &self.rest {
                scratch.outputs.push(Buffer::zeroed(layer.out_len)?);
            }
            scratch.sizes = sizes;
        }
        while scratch.workers.len() < threads {
            let taps =
                self.first.shape.kernel.pow(3).max(self.rest.first().map_or(0, |l| l.shape.kernel.pow(3)));
            scratch.workers.push(Worker {
                prepared: Buffer::zeroed(scratch.sizes[0])?,
                ring: Buffer::zeroed(scratch.sizes[1])?,
                taps: try_vec(taps, 0)?,
            });
        }
        Ok(())
    }

    /// Bytes of the packed weights and of one thread's working memory.
    #[cfg(test)]
    pub(crate) fn memory(&self) -> usize {
        let weights = |w: &Buffer, bias: &Buffer| w.as_slice().len() + bias.as_slice().len();
        let rest = self.rest.iter().map(|l| weights(&l.weights, &l.bias) + l.out_len + 2 * l.taps.len());
        let first = weights(&self.first.weights, &self.first.bias);
        let working: usize = self.sizes().take(3).sum();
        size_of::<f32>() * (first + rest.sum::<usize>() + working + self.dense.as_slice().len())
    }

    /// Runs the network; `features` holds one value per output of the dense layer. Reallocates the scratch if
    /// it does not fit this encoder.
    ///
    /// # Errors
    /// [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the scratch cannot be allocated.
    pub(crate) fn run(
        &self,
        prepare: &Prepare<'_>,
        scratch: &mut Scratch,
        executor: Executor<'_>,
        features: &mut [f32],
    ) -> Result<()> {
        let threads = executor.threads();
        self.fit(scratch, threads)?;
        let Scratch { workers, outputs, .. } = scratch;
        let workers = &mut workers[..threads];
        let planes = self.rest.first().map_or(self.first.shape, |second| second.shape).output;
        let (head, tail) = outputs.split_at_mut(1);
        let target = Output(tail.first_mut().unwrap_or(&mut head[0]).as_mut_slice().as_mut_ptr());
        self.front(prepare, workers, executor, target, 0..planes);
        for i in 1..self.rest.len() {
            let (before, after) = tail.split_at_mut(i);
            let target = Output(after[0].as_mut_slice().as_mut_ptr());
            let layer = &self.rest[i];
            let tasks = layer.tasks();
            spread(executor, executor.threads(), 0..tasks, &|range| {
                layer.whole(before[i - 1].as_slice(), target, range);
            });
        }
        let last = match tail.last() {
            Some(last) => last.as_slice(),
            None => &head[0].as_slice()[self.first.lead..],
        };
        let dense = self.dense.as_slice().chunks_exact(self.dense_len);
        let x = &last[..self.dense_len.min(last.len())];
        self.level.run(Dense { dense, bias: &self.dense_bias, x, features });
        Ok(())
    }

    /// Computes the first two layers, or the only one, with the output planes split over the workers.
    fn front(
        &self,
        prepare: &Prepare<'_>,
        workers: &mut [Worker],
        executor: Executor<'_>,
        target: Output,
        planes: Range<usize>,
    ) {
        if planes.is_empty() {
            return;
        }
        if let [worker] = workers {
            match self.rest.first() {
                Some(second) => self.front_planes(second, prepare, worker, target, planes),
                None => self.first_planes(prepare, worker, target, planes),
            }
            return;
        }
        let count = workers.len();
        let (left, right) = workers.split_at_mut(count / 2);
        let cut = planes.start + planes.len() * (count / 2) / count;
        executor.join(
            || self.front(prepare, left, executor, target, planes.start..cut),
            || self.front(prepare, right, executor, target, cut..planes.end),
        );
    }

    /// Computes a range of output planes of a network with one convolution.
    fn first_planes(&self, prepare: &Prepare<'_>, worker: &mut Worker, target: Output, planes: Range<usize>) {
        let mut next = 0;
        for z in planes {
            // SAFETY: plane `z` lies inside the whole output, and no other thread writes it.
            let out = unsafe { target.0.add(self.first.lead + z * self.first.out_plane) };
            self.first.plane(prepare, &mut worker.prepared, &mut worker.taps, &mut next, z, out);
        }
    }

    /// Computes the first two layers, one output plane of the second layer at a time.
    fn front_planes(
        &self,
        second: &ChannelsLast,
        prepare: &Prepare<'_>,
        worker: &mut Worker,
        target: Output,
        planes: Range<usize>,
    ) {
        let first = &self.first;
        let Shape { kernel, output, .. } = second.shape;
        let (mut next_input, mut next_first) = (0, 0);
        for z in planes {
            let (needed, skipped) = second.shape.planes(z);
            for plane in needed.start.max(next_first)..needed.end {
                let slot = plane % kernel * first.out_plane;
                let ring = worker.ring.as_mut_slice();
                let out = ring[first.lead + slot..][..first.out_plane].as_mut_ptr();
                first.plane(prepare, &mut worker.prepared, &mut worker.taps, &mut next_input, plane, out);
            }
            next_first = next_first.max(needed.end);
            let mut count = 0;
            for plane in needed.clone() {
                for b in 0..kernel {
                    for c in 0..kernel {
                        worker.taps[count] =
                            plane % kernel * first.out_plane + b * second.row + c * second.column;
                        count += 1;
                    }
                }
            }
            let taps = Taps { offsets: &worker.taps[..count], first: skipped * kernel * kernel };
            let input = &worker.ring.as_slice()[first.lead - first.border..];
            for block in 0..second.blocks.len() {
                let positions = z * output * output..(z + 1) * output * output;
                second.tiles(input, &taps, target, block, positions, 0);
            }
        }
    }
}

/// Runs `work` on a range, halved recursively over the executor's threads.
fn spread(executor: Executor<'_>, parts: usize, range: Range<usize>, work: &(dyn Fn(Range<usize>) + Sync)) {
    if parts <= 1 || range.len() <= 1 {
        if !range.is_empty() {
            work(range);
        }
        return;
    }
    let left = parts / 2;
    let cut = range.start + range.len() * left / parts;
    executor.join(
        || spread(executor, left, range.start..cut, work),
        || spread(executor, parts - left, cut..range.end, work),
    );
}
