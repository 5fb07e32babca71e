//! Plain loops compiled for a level.

use super::Level;
use super::simd::{Kernel, Simd};

struct Plain<F>(F);

impl<R, F: FnOnce() -> R> Kernel for Plain<F> {
    type Output = R;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> R {
        (self.0)()
    }
}

impl Level {
    /// Runs a closure of plain loops, compiled with the instructions of this level. Additions and
    /// multiplications are never fused, so the results do not depend on the level.
    #[inline(always)]
    pub fn vectorize<R>(self, loops: impl FnOnce() -> R) -> R {
        self.run(Plain(loops))
    }
}
