//! Who runs the parallel parts: the calling thread alone, or a pool that the caller owns.

use super::Helper;
use super::helper::Join;

/// Where encoding and resampling run: on the calling thread alone, or split over threads that the caller
/// gives.
///
/// The result never depends on it: every output is computed by one thread, with the same operations in the
/// same order, whatever the split.
#[derive(Clone, Copy, Debug, Default)]
#[non_exhaustive]
pub enum Executor<'a> {
    /// The calling thread does everything.
    #[default]
    Serial,
    /// The work is split over the threads of a pool; the caller waits.
    #[cfg(feature = "rayon")]
    Rayon(&'a rayon::ThreadPool),
    /// The work is split between the caller and the thread that serves the helper: no lock and no system
    /// call.
    Helper(&'a Helper),
}

impl Executor<'_> {
    /// Number of threads that work is split for.
    pub fn threads(&self) -> usize {
        match self {
            Self::Serial => 1,
            #[cfg(feature = "rayon")]
            Self::Rayon(pool) => pool.current_num_threads().max(1),
            Self::Helper(helper) => 1 + usize::from(helper.is_served()),
        }
    }

    /// Runs both closures, at the same time where there are threads for it.
    pub fn join<A: FnOnce() + Send, B: FnOnce() + Send>(&self, a: A, b: B) {
        match self {
            Self::Serial => {
                a();
                b();
            }
            #[cfg(feature = "rayon")]
            Self::Rayon(pool) => {
                pool.join(a, b);
            }
            Self::Helper(helper) => helper.join(a, b),
        }
    }
}

impl Join for Executor<'_> {
    fn join<A: FnOnce() + Send, B: FnOnce() + Send>(&self, a: A, b: B) {
        Executor::join(self, a, b);
    }
}
