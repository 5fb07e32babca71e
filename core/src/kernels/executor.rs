//! Executors of parallel work: the calling thread alone, or threads that the caller owns.

use super::Helper;
use super::helper::Join;

/// Threads on which encoding and resampling run: the calling thread alone, or threads that the caller
/// provides.
///
/// The executor never changes the result: every output is computed by one thread, with the same operations in
/// the same order.
#[derive(Clone, Copy, Debug, Default)]
#[non_exhaustive]
pub enum Executor<'a> {
    /// The calling thread does all the work.
    #[default]
    Serial,
    /// The work is split over the threads of a pool; the caller waits.
    #[cfg(feature = "rayon")]
    Rayon(&'a rayon::ThreadPool),
    /// The work is split between the caller and the thread that serves the helper, without locks or system
    /// calls.
    Helper(&'a Helper),
}

impl Executor<'_> {
    /// Number of threads over which work is split.
    pub fn threads(&self) -> usize {
        match self {
            Self::Serial => 1,
            #[cfg(feature = "rayon")]
            Self::Rayon(pool) => pool.current_num_threads().max(1),
            Self::Helper(helper) => 1 + usize::from(helper.is_served()),
        }
    }

    /// Runs both closures, concurrently where a second thread is free.
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
