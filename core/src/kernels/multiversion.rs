//! Safe code compiled once per instruction set, for loops that the compiler vectorises well by itself.

use crate::kernels::{Isa, Level};

/// A piece of safe code. Its `run` and everything it calls must be `#[inline(always)]`, or it stays at the baseline.
pub(crate) trait Task {
    /// Does the work.
    fn run(self);
}

/// Runs a task with the instructions of `level`.
#[allow(unsafe_code, reason = "calls functions compiled for instruction sets that the level proves")]
pub(crate) fn multiversion<T: Task>(level: Level, task: T) {
    match level.isa() {
        Isa::Scalar => task.run(),
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a level of this instruction set exists only where the CPU has all of these features.
        Isa::Avx2 => unsafe { avx2(task) },
        #[cfg(target_arch = "x86_64")]
        // SAFETY: as above.
        Isa::Avx512 => unsafe { avx512(task) },
        #[cfg(not(target_arch = "x86_64"))]
        _ => task.run(),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,f16c")]
fn avx2<T: Task>(task: T) {
    task.run();
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,f16c,avx512f,avx512bw,avx512dq,avx512vl")]
fn avx512<T: Task>(task: T) {
    task.run();
}
