//! Safe code compiled once per instruction set, for loops that the compiler vectorises well by itself.

use super::Level;
use super::simd::{Kernel, Simd};

/// A piece of safe code. Its `run` and everything it calls must be `#[inline(always)]`, or it stays at the baseline.
pub(crate) trait Task {
    /// Does the work.
    fn run(self);
}

struct Plain<T>(T);

impl<T: Task> Kernel for Plain<T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        self.0.run();
    }
}

/// Runs a task with the instructions of `level`.
pub(crate) fn multiversion<T: Task>(level: Level, task: T) {
    level.run(Plain(task));
}
