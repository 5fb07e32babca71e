//! The first layer: prepared input planes, vectors along x, planar output.

use super::layout::{Block, Buffer, LINE, Shape, cut};
use super::tiles::{self, Cut, Row};
use crate::Result;
use crate::kernels::Level;
use crate::kernels::resample::{Map, Scalar};
use crate::kernels::simd::{Kernel, Simd};
use crate::memory::chunks;

#[derive(Clone, Debug)]
pub(super) struct Planar {
    pub(super) level: Level,
    pub(super) cut: Cut,
    pub(super) shape: Shape,
    /// Strides of the prepared input, in floats: phase, row, plane.
    pub(super) phase: usize,
    pub(super) row: usize,
    pub(super) plane: usize,
    /// Number of output channels, padded to whole groups.
    pub(super) padded: usize,
    pub(super) weights: Buffer,
    pub(super) bias: Buffer,
    /// Layout of the output: border width, floats per row, floats per plane, floats before the first plane.
    pub(super) border: usize,
    pub(super) out_row: usize,
    pub(super) out_plane: usize,
    pub(super) lead: usize,
}

/// Function that writes the prepared input plane `z`.
pub(crate) type Prepare<'a> = dyn Fn(usize, &mut PreparedPlane<'_>) + Sync + 'a;

/// Destination of one prepared plane (layout: see `conv`).
#[derive(Debug)]
pub(crate) struct PreparedPlane<'a> {
    data: &'a mut [f32],
    shape: Shape,
    phase: usize,
    row: usize,
    level: Level,
}

impl PreparedPlane<'_> {
    /// Fills the plane from rows of voxels that start at `base`, `stride` elements apart; values are mapped
    /// to [0, 1] by `map`, then to [-1, 1].
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
                        let (pairs, rest) = chunks::<2, _>(row);
                        // The first voxel has padded coordinate `padding`.
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

impl Planar {
    pub(super) fn new(block: &Block<'_>, border: usize, level: Level) -> Result<Self> {
        let cut = cut(level);
        let shape = block.shape;
        let (kernel, stride) = (shape.kernel, shape.stride);
        // A phase is long enough for every voxel, and for reads of whole steps at every tap.
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
        // The zeros after a row are also the border before the next row.
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

    /// Offset of x = 0 of a row in the whole output, in floats.
    pub(super) fn place(&self, z: usize, y: usize, channel: usize) -> usize {
        self.lead + z * self.out_plane + ((y + self.border) * self.padded + channel) * self.out_row
    }

    /// Computes output plane `z` into `out`. First prepares the input planes that are missing; `next` is the
    /// first plane that is not prepared yet.
    #[allow(clippy::too_many_arguments, reason = "one call site per caller; a struct would only rename them")]
    pub(super) fn plane(
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

/// Kernel that computes the rows of one output plane of the first layer.
struct Rows<'a> {
    first: &'a Planar,
    input: &'a [f32],
    taps: &'a [usize],
    /// Number of packed taps before the first one of `taps`.
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
                // SAFETY: from the offset of each tap on, `run_row` reads the width, rounded up to whole
                // steps; the prepared planes are long enough for these reads. The group's rows stay inside
                // the output plane, which no other thread writes.
                unsafe { tiles::run_row(s, &row) };
            }
        }
    }
}
