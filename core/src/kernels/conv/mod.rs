//! Direct 3-D convolution: memory layouts, packed weights, and the order of the work. No im2col.
//!
//! # Layouts
//!
//! The first layer has one input channel, so its vectors run along x. Its input planes are *prepared*: every row is split
//! into `stride` phases (padded coordinate X = stride·q + phase goes to place q of its phase), so that the samples which
//! one tap needs for neighbouring outputs lie side by side. Its output is *planar*: one row per y and channel.
//!
//! Every later layer has its vectors along output channels and takes its input one number at a time, broadcast. Its input
//! is either the planar output of the first layer, or *channels last*: (z, y, x, channel) with zero borders as wide as the
//! layer's padding. Its output is channels last, with the borders of the layer that follows.
//!
//! The first two layers run plane by plane: a thread keeps only as many prepared planes and planes of the first layer's
//! output as the kernels span. Borders are zeroed once and never written.
//!
//! # Order
//!
//! Every output starts at its bias and adds its taps in one accumulator, in the order (kernel z, y, x, input channel), or
//! (kernel z, y, input channel, x) at all positions of a channel. So neither the tile an output falls into nor the number of
//! threads changes a bit.

mod tiles;

use crate::Result;
use crate::error::bail;
use crate::kernels::resample::{Map, Scalar};
use crate::kernels::simd::{Kernel, Simd};
use crate::kernels::{Executor, Level};
use alloc::vec;
use alloc::vec::Vec;
use core::ops::Range;
use tiles::Cut;

/// Output positions per tile at most.
const MAX_POSITIONS: usize = 16;
/// Floats per cache line, the widest vector, and the unit that rows are padded to.
const LINE: usize = 16;
/// Output positions after which the next block of channels is taken, so that inputs stay in the cache.
const CHUNK: usize = 256;

/// Floats on a cache line boundary, zero at first.
#[derive(Clone, Debug, Default)]
pub(crate) struct Buffer(Vec<Line>);

#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([f32; LINE]);

impl Buffer {
    /// # Errors
    /// [`SizeMismatch`](crate::ErrorKind::SizeMismatch) where the allocator has no such room.
    fn zeroed(len: usize) -> Result<Self> {
        let lines = len.div_ceil(LINE);
        let mut data = Vec::new();
        if data.try_reserve_exact(lines).is_err() {
            bail!(
                SizeMismatch,
                "the volume encoder needs a buffer of {} bytes, and memory has no room for it: use a model with a \
                 smaller encoder, or give the process more memory",
                lines.saturating_mul(size_of::<Line>())
            );
        }
        data.resize(lines, Line([0.0; LINE]));
        Ok(Self(data))
    }

    fn as_slice(&self) -> &[f32] {
        bytemuck::cast_slice(&self.0)
    }

    fn as_mut_slice(&mut self) -> &mut [f32] {
        bytemuck::cast_slice_mut(&mut self.0)
    }
}

/// One tile of a later layer: a few output positions times one block of channels.
struct Tile {
    /// Per position: the input number that tap 0 and channel 0 take.
    input: [*const f32; MAX_POSITIONS],
    /// Per position: the first channel of the block.
    output: [*mut f32; MAX_POSITIONS],
    /// How many positions from the first on are not repetitions of the one before.
    distinct: usize,
    /// Whether the positions lie two floats apart.
    near: bool,
    /// Whether the taps come in threes that lie one float apart.
    threes: bool,
    /// As `input[0]`, of the tile after this one.
    next: *const f32,
    /// Offset of each tap from `input`, in floats.
    taps: *const usize,
    tap_count: usize,
    channels: usize,
    /// Floats from one input channel to the next.
    channel_stride: usize,
    /// `tap_count` × `channels` × block of channels.
    weights: *const f32,
    bias: *const f32,
}

/// One output row of the first layer, for one group of channels.
struct Row {
    /// The prepared number that tap 0 takes for x = 0.
    input: *const f32,
    taps: *const usize,
    tap_count: usize,
    /// `tap_count` × group of channels.
    weights: *const f32,
    bias: *const f32,
    /// x = 0 of the group's first channel.
    output: *mut f32,
    /// Floats from one output channel to the next.
    channel_stride: usize,
    /// Channels of the group.
    channels: usize,
    width: usize,
}

fn cut(level: Level) -> Cut {
    struct Of;
    impl Kernel for Of {
        type Output = Cut;

        #[inline(always)]
        fn run<S: Simd>(self, _: S) -> Cut {
            Cut::of::<S>()
        }
    }
    level.run(Of)
}

/// One block's sizes and weights (outputs × inputs × kernel³, one bias per output).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Block<'a> {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    pub(crate) kernel: usize,
    pub(crate) stride: usize,
    pub(crate) padding: usize,
    pub(crate) input_edge: usize,
    pub(crate) output_edge: usize,
    pub(crate) weight: &'a [f32],
    pub(crate) bias: &'a [f32],
}

/// The dense layer's weights (outputs × inputs) and biases.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Head<'a> {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    pub(crate) weight: &'a [f32],
    pub(crate) bias: &'a [f32],
}

/// Cubic kernel, stride and padding, and edges in and out.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Shape {
    input: usize,
    output: usize,
    kernel: usize,
    stride: usize,
    padding: usize,
}

impl Shape {
    fn of(block: &Block<'_>) -> Self {
        Self {
            input: block.input_edge,
            output: block.output_edge,
            kernel: block.kernel,
            stride: block.stride,
            padding: block.padding,
        }
    }

    /// The input planes that output plane `z` needs, and the first kernel plane among them: the rest is padding.
    fn planes(&self, z: usize) -> (Range<usize>, usize) {
        let low = z * self.stride;
        let first = low.max(self.padding);
        let end = (low + self.kernel).min(self.padding + self.input).max(first);
        (first - self.padding..end - self.padding, (first - low).min(self.kernel))
    }
}

#[derive(Clone, Debug)]
struct First {
    level: Level,
    cut: Cut,
    shape: Shape,
    /// Floats per phase, per prepared row and per prepared plane.
    phase: usize,
    row: usize,
    plane: usize,
    /// Output channels, in whole groups.
    padded: usize,
    weights: Buffer,
    bias: Buffer,
    /// Of the output: zeros on each side, floats per row and per plane, floats before the first plane.
    border: usize,
    out_row: usize,
    out_plane: usize,
    lead: usize,
}

#[derive(Clone, Debug)]
struct Later {
    level: Level,
    cut: Cut,
    shape: Shape,
    inputs: usize,
    /// Floats between input channels, columns, rows and planes (planes only where the input is whole).
    channel_stride: usize,
    column: usize,
    row: usize,
    plane: usize,
    /// Offsets of the taps where the input is whole.
    taps: Vec<usize>,
    /// First channel, vectors, and place of the weights of each block of channels.
    blocks: Vec<(usize, usize, usize)>,
    weights: Buffer,
    bias: Buffer,
    /// Of the output: borders, floats per position, size.
    border: usize,
    out_channels: usize,
    out_len: usize,
}

impl Later {
    /// Place of an output position, channel 0.
    fn place(&self, z: usize, y: usize, x: usize) -> usize {
        let edge = self.shape.output + 2 * self.border;
        (((z + self.border) * edge + y + self.border) * edge + x + self.border) * self.out_channels
    }
}

/// An encoder with weights packed for one level.
#[derive(Clone, Debug)]
pub(crate) struct Encoder {
    level: Level,
    first: First,
    later: Vec<Later>,
    /// Per feature: one weight per float of the last layer's output.
    dense: Buffer,
    dense_len: usize,
    dense_bias: Vec<f32>,
}

/// Working memory of one encoder.
#[derive(Clone, Debug, Default)]
pub(crate) struct Scratch {
    workers: Vec<Worker>,
    outputs: Vec<Buffer>,
    /// What the buffers were made for.
    sizes: Vec<usize>,
}

#[derive(Clone, Debug)]
struct Worker {
    prepared: Buffer,
    ring: Buffer,
    taps: Vec<usize>,
}

/// Writes the prepared plane `z` of the input.
pub(crate) type Prepare<'a> = dyn Fn(usize, &mut PreparedPlane<'_>) + Sync + 'a;

/// Where a prepared plane goes; see the module's text.
#[derive(Debug)]
pub(crate) struct PreparedPlane<'a> {
    data: &'a mut [f32],
    shape: Shape,
    phase: usize,
    row: usize,
    level: Level,
}

impl PreparedPlane<'_> {
    /// Fills the plane from rows of voxels that start at `base` and follow at `stride`, mapped to [0, 1] by `map` and
    /// from there to [-1, 1].
    pub(crate) fn fill<T: Scalar, M: Map<T>>(&mut self, src: &[T], base: usize, stride: usize, map: M) {
        struct Body<'a, 'b, T, M>(&'a mut PreparedPlane<'b>, &'a [T], usize, usize, M);
        impl<T: Scalar, M: Map<T>> Kernel for Body<'_, '_, T, M> {
            type Output = ();

            #[inline(always)]
            fn run<S: Simd>(self, _: S) {
                let Body(plane, src, base, stride, map) = self;
                let Shape { input: n, stride: phases, padding, .. } = plane.shape;
                let signed = |stored: f32| 2.0 * map.value(stored) - 1.0;
                for y in 0..n {
                    let row = &src[base + y * stride..base + y * stride + n];
                    let out = &mut plane.data[(y + padding) * plane.row..(y + padding + 1) * plane.row];
                    if phases == 2 {
                        let (even, odd) = out.split_at_mut(plane.phase);
                        let (pairs, rest) = row.as_chunks::<2>();
                        // The first voxel lies at padded place `padding`.
                        let (a, b) = if padding % 2 == 0 {
                            (&mut even[padding / 2..], &mut odd[padding / 2..])
                        } else {
                            (&mut odd[padding / 2..], &mut even[padding / 2 + 1..])
                        };
                        let (a, b) = (&mut a[..n.div_ceil(2)], &mut b[..n / 2]);
                        for ((a, b), pair) in a.iter_mut().zip(b.iter_mut()).zip(pairs) {
                            let [first, second] = T::pair(*pair);
                            *a = signed(first);
                            *b = signed(second);
                        }
                        if let (Some(a), Some(&v)) = (a.last_mut(), rest.first()) {
                            *a = signed(v.to_f32());
                        }
                    } else {
                        for (x, &v) in row.iter().enumerate() {
                            let at = x + padding;
                            out[at % phases * plane.phase + at / phases] = signed(v.to_f32());
                        }
                    }
                }
            }
        }
        self.level.run(Body(self, src, base, stride, map));
    }
}

impl Encoder {
    /// Packs checked blocks and the dense layer.
    ///
    /// # Errors
    /// [`SizeMismatch`](crate::ErrorKind::SizeMismatch) where memory has no room for the packed weights.
    pub(crate) fn new(blocks: &[Block<'_>], fc: &Head<'_>, level: Level) -> Result<Self> {
        let padding_of = |i: usize| blocks.get(i).map_or(0, |b: &Block<'_>| b.padding);
        let first = First::new(&blocks[0], padding_of(1), level)?;
        let mut later: Vec<Later> = Vec::with_capacity(blocks.len() - 1);
        for (i, block) in blocks.iter().enumerate().skip(1) {
            let edge = block.input_edge + 2 * block.padding;
            let (channel_stride, column, row, plane) = match later.last() {
                None => (first.out_row, 1, first.padded * first.out_row, first.out_plane),
                Some(before) => {
                    let column = before.out_channels;
                    (1, column, edge * column, edge * edge * column)
                }
            };
            later.push(Later::new(block, [channel_stride, column, row, plane], padding_of(i + 1), level)?);
        }
        // The dense layer's weights, moved to where the last layer writes.
        let edge = blocks[blocks.len() - 1].output_edge;
        let channels = blocks[blocks.len() - 1].outputs;
        let dense_len = later.last().map_or(edge * first.out_plane, |l| l.out_len).next_multiple_of(LINE);
        let mut dense = Buffer::zeroed(dense_len * fc.outputs)?;
        for (row, weights) in
            dense.as_mut_slice().chunks_exact_mut(dense_len).zip(fc.weight.chunks_exact(fc.inputs))
        {
            let mut weights = weights.iter();
            for c in 0..channels {
                for z in 0..edge {
                    for y in 0..edge {
                        for x in 0..edge {
                            let place = match later.last() {
                                Some(l) => l.place(z, y, x) + c,
                                None => first.place(z, y, c) - first.lead + x,
                            };
                            row[place] = weights.next().copied().unwrap_or(0.0);
                        }
                    }
                }
            }
        }
        Ok(Self { level, first, later, dense, dense_len, dense_bias: fc.bias.to_vec() })
    }

    fn sizes(&self) -> impl Iterator<Item = usize> {
        let f = &self.first;
        let ring = match self.later.first() {
            Some(second) => f.lead + second.shape.kernel * f.out_plane,
            None => 0,
        };
        let whole = if self.later.is_empty() { f.lead + f.shape.output * f.out_plane } else { 0 };
        // The tail keeps the last row's reads, rounded up to whole vectors, inside.
        [f.shape.kernel * f.plane + LINE, ring + LINE, whole + LINE, f.plane, f.row, f.phase]
            .into_iter()
            .chain(
                self.later.iter().flat_map(|l| [l.out_len.next_multiple_of(LINE), l.border, l.out_channels]),
            )
    }

    /// Makes the scratch fit this encoder and number of threads.
    fn fit(&self, scratch: &mut Scratch, threads: usize) -> Result<()> {
        if !self.sizes().eq(scratch.sizes.iter().copied()) {
            // Empty until everything is there, so that a scratch which memory had no room for is made anew.
            *scratch = Scratch::default();
            let sizes: Vec<usize> = self.sizes().collect();
            scratch.outputs.push(Buffer::zeroed(sizes[2])?);
            for layer in &self.later {
                scratch.outputs.push(Buffer::zeroed(layer.out_len)?);
            }
            scratch.sizes = sizes;
        }
        while scratch.workers.len() < threads {
            let taps =
                self.first.shape.kernel.pow(3).max(self.later.first().map_or(0, |l| l.shape.kernel.pow(3)));
            scratch.workers.push(Worker {
                prepared: Buffer::zeroed(scratch.sizes[0])?,
                ring: Buffer::zeroed(scratch.sizes[1])?,
                taps: vec![0; taps],
            });
        }
        Ok(())
    }

    /// Bytes of the packed weights and of one thread's working memory.
    #[cfg(test)]
    pub(crate) fn memory(&self) -> usize {
        let weights = |w: &Buffer, bias: &Buffer| w.as_slice().len() + bias.as_slice().len();
        let later: usize =
            self.later.iter().map(|l| weights(&l.weights, &l.bias) + l.out_len + 2 * l.taps.len()).sum();
        let working: usize = self.sizes().take(3).sum();
        size_of::<f32>()
            * (weights(&self.first.weights, &self.first.bias) + later + working + self.dense.as_slice().len())
    }

    /// Runs the network; `features` has one place per output of the dense layer. Makes the scratch fit first.
    ///
    /// # Errors
    /// [`SizeMismatch`](crate::ErrorKind::SizeMismatch) where memory has no room for the scratch.
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
        let planes = match self.later.first() {
            Some(second) => second.shape.output,
            None => self.first.shape.output,
        };
        let (head, tail) = outputs.split_at_mut(1);
        let target = match tail.first_mut() {
            Some(second) => Output(second.as_mut_slice().as_mut_ptr()),
            None => Output(head[0].as_mut_slice().as_mut_ptr()),
        };
        self.front(prepare, workers, executor, target, 0..planes);
        for i in 1..self.later.len() {
            let (before, after) = tail.split_at_mut(i);
            let target = Output(after[0].as_mut_slice().as_mut_ptr());
            let layer = &self.later[i];
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
        self.level.run(Dense {
            dense,
            bias: &self.dense_bias,
            x: &last[..self.dense_len.min(last.len())],
            features,
        });
        Ok(())
    }

    /// The first layers, split over the workers by output planes.
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
            match self.later.first() {
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

    /// The only layer of a one-layer network.
    fn first_planes(&self, prepare: &Prepare<'_>, worker: &mut Worker, target: Output, planes: Range<usize>) {
        let mut next = 0;
        for z in planes {
            // SAFETY: plane `z` lies inside the whole output, and no other thread has it.
            let out = unsafe { target.0.add(self.first.lead + z * self.first.out_plane) };
            self.first.plane(prepare, &mut worker.prepared, &mut worker.taps, &mut next, z, out);
        }
    }

    /// The first two layers, plane by plane of the second's output.
    fn front_planes(
        &self,
        second: &Later,
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

/// Which taps a tile adds: offsets in the input, and how many of the packed ones come before them.
struct Taps<'a> {
    offsets: &'a [usize],
    first: usize,
}

/// Where several threads write, each its own positions and channels.
#[derive(Clone, Copy)]
struct Output(*mut f32);

// SAFETY: the tasks of one layer write disjoint floats, and whoever owns the buffer waits for all of them.
unsafe impl Send for Output {}
// SAFETY: as above.
unsafe impl Sync for Output {}

impl First {
    fn new(block: &Block<'_>, border: usize, level: Level) -> Result<Self> {
        let cut = cut(level);
        let shape = Shape::of(block);
        let (kernel, stride) = (shape.kernel, shape.stride);
        // Long enough for every voxel and for reads of whole vectors at every tap.
        let width = shape.output.next_multiple_of(cut.width);
        let phase = (shape.input + 2 * shape.padding)
            .div_ceil(stride)
            .max(width + (kernel - 1) / stride)
            .next_multiple_of(LINE);
        let row = stride * phase;
        let padded = block.outputs.next_multiple_of(cut.group);
        let mut weights = Buffer::zeroed(padded * kernel.pow(3))?;
        let mut bias = Buffer::zeroed(padded)?;
        bias.as_mut_slice()[..block.outputs].copy_from_slice(block.bias);
        let taps = kernel.pow(3);
        for c in 0..block.outputs {
            for tap in 0..taps {
                let place = (c / cut.group * taps + tap) * cut.group + c % cut.group;
                weights.as_mut_slice()[place] = block.weight[c * taps + tap];
            }
        }
        // The zeros after a row are the zeros before the next one.
        let out_row = (shape.output + border).next_multiple_of(LINE);
        let out_plane = (shape.output + 2 * border) * padded * out_row;
        Ok(Self {
            level,
            cut,
            shape,
            phase,
            row,
            plane: (shape.input + 2 * shape.padding) * row,
            padded,
            weights,
            bias,
            border,
            out_row,
            out_plane,
            lead: border.next_multiple_of(LINE),
        })
    }

    /// Place of x = 0 in a row of the whole output.
    fn place(&self, z: usize, y: usize, channel: usize) -> usize {
        self.lead + z * self.out_plane + ((y + self.border) * self.padded + channel) * self.out_row
    }

    /// Computes output plane `z` into `out`, preparing the input planes from `next` on that it lacks.
    #[allow(clippy::too_many_arguments, reason = "one call site per caller; a struct would only rename them")]
    fn plane(
        &self,
        prepare: &Prepare<'_>,
        prepared: &mut Buffer,
        taps: &mut [usize],
        next: &mut usize,
        z: usize,
        out: *mut f32,
    ) {
        let Shape { kernel, stride, .. } = self.shape;
        let (needed, skipped) = self.shape.planes(z);
        for plane in needed.start.max(*next)..needed.end {
            let data = &mut prepared.as_mut_slice()[plane % kernel * self.plane..][..self.plane];
            let (shape, phase, row) = (self.shape, self.phase, self.row);
            prepare(plane, &mut PreparedPlane { data, shape, phase, row, level: self.level });
        }
        *next = (*next).max(needed.end);
        let mut count = 0;
        for plane in needed {
            for b in 0..kernel {
                for c in 0..kernel {
                    taps[count] =
                        plane % kernel * self.plane + b * self.row + c % stride * self.phase + c / stride;
                    count += 1;
                }
            }
        }
        self.level.run(Rows {
            first: self,
            input: prepared.as_slice(),
            taps: &taps[..count],
            skipped: skipped * kernel * kernel,
            output: out,
        });
    }
}

/// The rows of one plane of the first layer.
struct Rows<'a> {
    first: &'a First,
    input: &'a [f32],
    taps: &'a [usize],
    /// Taps left out before the first one.
    skipped: usize,
    output: *mut f32,
}

impl Kernel for Rows<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { first, input, taps, skipped, output } = self;
        let (group, all) = (first.cut.group, first.shape.kernel.pow(3));
        for y in 0..first.shape.output {
            for g in 0..first.padded / group {
                let place = ((y + first.border) * first.padded + g * group) * first.out_row;
                let row = Row {
                    input: input[y * first.shape.stride * first.row..].as_ptr(),
                    taps: taps.as_ptr(),
                    tap_count: taps.len(),
                    weights: first.weights.as_slice()[(g * all + skipped) * group..].as_ptr(),
                    bias: first.bias.as_slice()[g * group..].as_ptr(),
                    // SAFETY: the row lies inside the plane that `output` points to.
                    output: unsafe { output.add(place) },
                    channel_stride: first.out_row,
                    channels: group,
                    width: first.shape.output,
                };
                // SAFETY: every tap plus the width in whole steps stays inside the prepared planes (phases are long
                // enough for it), the group's rows inside the output plane, which nobody else has.
                unsafe { tiles::run_row(s, &row) };
            }
        }
    }
}

impl Later {
    fn new(
        block: &Block<'_>,
        [channel_stride, column, row, plane]: [usize; 4],
        border: usize,
        level: Level,
    ) -> Result<Self> {
        let cut = cut(level);
        let shape = Shape::of(block);
        let k = shape.kernel;
        let all = k.pow(3);
        let out_channels = block.outputs.next_multiple_of(cut.lanes);
        let mut taps = Vec::with_capacity(all);
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

    /// Number of tasks that a layer with its whole input at hand falls into: chunks of positions, then blocks of
    /// channels, then tiles.
    fn tasks(&self) -> usize {
        self.positions().div_ceil(CHUNK) * self.blocks.len() * CHUNK.div_ceil(self.cut.positions)
    }

    /// Runs tasks; the input has its borders in every direction.
    fn whole(&self, input: &[f32], target: Output, tasks: Range<usize>) {
        let tiles = CHUNK.div_ceil(self.cut.positions);
        let taps = Taps { offsets: &self.taps, first: 0 };
        let mut task = tasks.start;
        while task < tasks.end {
            // A run of tiles in one block of channels and one chunk.
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

    /// Computes one block of channels at a range of positions, whose inputs lie `plane` floats apart from one output
    /// plane to the next (0 where the taps say where the planes lie).
    fn tiles(
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

/// One block of channels at a range of positions.
struct Tiles<'a> {
    layer: &'a Later,
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
            near: false,
            threes: layer.shape.kernel == 3 && layer.column == 1,
            next: core::ptr::null(),
            taps: taps.offsets.as_ptr(),
            tap_count: taps.offsets.len(),
            channels: layer.inputs,
            channel_stride: layer.channel_stride,
            weights: layer.weights.as_slice()[place + skipped..].as_ptr(),
            bias: layer.bias.as_slice()[channel..].as_ptr(),
        };
        let Shape { output: edge, stride, .. } = layer.shape;
        // Sixteen positions of one row lie at equal distances.
        let rows_of_16 = edge.is_multiple_of(16) && positions.start.is_multiple_of(16);
        let step = if layer.cut.wide && vectors == 1 && rows_of_16 { 16 } else { layer.cut.positions };
        let (mut z, mut y, mut x) =
            (positions.start / (edge * edge), positions.start / edge % edge, positions.start % edge);
        let mut p = positions.start;
        while p < positions.end {
            tile.distinct = step.min(positions.end - p);
            tile.near = stride * layer.column == 2 && x + step <= edge && tile.distinct == step;
            for i in 0..step {
                let from = z * plane + stride * (y * layer.row + x * layer.column);
                tile.input[i] = input[from..].as_ptr();
                // SAFETY: the place lies inside the layer's output, and so does the block of channels after it.
                tile.output[i] = unsafe { target.0.add(layer.place(z, y, x) + channel) };
                // The last tile repeats its last position: the same numbers go to the same places.
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
            // SAFETY: a position's place plus any tap and channel lies inside the bordered input; weights and biases
            // are packed for whole blocks; no other thread has these positions and channels.
            unsafe { tiles::run_tile(s, &tile, step, vectors) };
            p += step;
        }
    }
}

/// Runs `work` on a range, halved over the executor's threads.
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

/// The dense layer at the end: sums in lines of 16 partial sums.
struct Dense<'a> {
    dense: core::slice::ChunksExact<'a, f32>,
    bias: &'a [f32],
    x: &'a [f32],
    features: &'a mut [f32],
}

impl Kernel for Dense<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let (x, _) = self.x.as_chunks::<LINE>();
        for ((feature, row), bias) in self.features.iter_mut().zip(self.dense).zip(self.bias) {
            let (row, _) = row.as_chunks::<LINE>();
            let mut sums = [0.0f32; LINE];
            for (w, x) in row.iter().zip(x) {
                for ((sum, w), x) in sums.iter_mut().zip(w).zip(x) {
                    *sum += w * x;
                }
            }
            let mut half = LINE / 2;
            while half > 0 {
                for i in 0..half {
                    sums[i] += sums[i + half];
                }
                half /= 2;
            }
            *feature = sums[0] + bias;
        }
    }
}
