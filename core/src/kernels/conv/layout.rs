//! Sizes, aligned buffers and offsets shared by the layers.

use super::tiles::Cut;
use crate::Result;
use crate::kernels::Level;
use crate::kernels::simd::{Kernel, Simd};
use crate::memory::try_vec;
use alloc::vec::Vec;
use core::ops::Range;

/// Number of floats per cache line and in the widest vector. Rows are padded to a multiple of this number.
pub(super) const LINE: usize = 16;

/// Zero-initialized floats, aligned to a cache line.
#[derive(Clone, Debug, Default)]
pub(crate) struct Buffer(Vec<Line>);

#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([f32; LINE]);

impl Buffer {
    /// # Errors
    /// [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the allocation fails.
    pub(super) fn zeroed(len: usize) -> Result<Self> {
        Ok(Self(try_vec(len.div_ceil(LINE), Line([0.0; LINE]))?))
    }

    pub(super) fn as_slice(&self) -> &[f32] {
        bytemuck::cast_slice(&self.0)
    }

    pub(super) fn as_mut_slice(&mut self) -> &mut [f32] {
        bytemuck::cast_slice_mut(&mut self.0)
    }
}

pub(super) fn cut(level: Level) -> Cut {
    struct CutOfLevel;
    impl Kernel for CutOfLevel {
        type Output = Cut;

        #[inline(always)]
        fn run<S: Simd>(self, _: S) -> Cut {
            Cut::of::<S>()
        }
    }
    level.run(CutOfLevel)
}

/// Sizes and weights of one convolution (outputs × inputs × kernel³, one bias per output).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Block<'a> {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    pub(crate) shape: Shape,
    pub(crate) weight: &'a [f32],
    pub(crate) bias: &'a [f32],
}

/// Kernel edge, stride, padding, and edges of input and output.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Shape {
    pub(crate) input: usize,
    pub(crate) output: usize,
    pub(crate) kernel: usize,
    pub(crate) stride: usize,
    pub(crate) padding: usize,
}

impl Shape {
    /// Returns the range of input planes that output plane `z` reads, and the index of the kernel plane that
    /// lies on the first of them. Kernel planes without an input plane lie in the padding.
    pub(super) fn planes(&self, z: usize) -> (Range<usize>, usize) {
        let low = z * self.stride;
        let first = low.max(self.padding);
        let end = (low + self.kernel).min(self.padding + self.input).max(first);
        (first - self.padding..end - self.padding, (first - low).min(self.kernel))
    }
}

/// Kernel taps of one tile: their offsets in the input, in floats, and the number of packed taps before the
/// first of them.
pub(super) struct Taps<'a> {
    pub(super) offsets: &'a [usize],
    pub(super) first: usize,
}

/// Pointer to an output that several threads write. No two threads write the same floats.
#[derive(Clone, Copy)]
pub(super) struct Output(pub(super) *mut f32);

// SAFETY: the tasks of one layer write disjoint floats through this pointer, and the owner of the buffer
// waits for all tasks before it uses the floats.
unsafe impl Send for Output {}
// SAFETY: the tasks of one layer write disjoint floats through this pointer, so threads may share it.
unsafe impl Sync for Output {}
