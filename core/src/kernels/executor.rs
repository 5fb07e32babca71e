//! Who runs the parallel parts: the calling thread alone, or a pool that the caller owns.

use super::Helper;
use super::helper::Join;

/// Where encoding and resampling run: on the calling thread alone ([`Executor::serial`], the default), or
/// split over a rayon pool that the caller gives.
///
/// The result never depends on it: every output is computed by one thread, with the same operations in the
/// same order, whatever the split.
#[derive(Clone, Copy, Debug, Default)]
pub struct Executor<'a> {
    #[cfg(feature = "rayon")]
    pool: Option<&'a rayon::ThreadPool>,
    helper: Option<&'a Helper>,
}

impl<'a> Executor<'a> {
    /// The calling thread does everything.
    pub const fn serial() -> Self {
        Self {
            #[cfg(feature = "rayon")]
            pool: None,
            helper: None,
        }
    }

    /// The work is split over the threads of `pool`; the caller waits.
    #[cfg(feature = "rayon")]
    pub const fn rayon(pool: &'a rayon::ThreadPool) -> Self {
        Self { pool: Some(pool), helper: None }
    }

    /// The work is split between the caller and the thread that serves `helper`: no lock and no system call.
    pub const fn helper(helper: &'a Helper) -> Self {
        Self {
            #[cfg(feature = "rayon")]
            pool: None,
            helper: Some(helper),
        }
    }

    /// Number of threads that work is split for.
    pub fn threads(&self) -> usize {
        #[cfg(feature = "rayon")]
        if let Some(pool) = self.pool {
            return pool.current_num_threads().max(1);
        }
        1 + usize::from(self.helper.is_some_and(Helper::is_served))
    }

    /// Runs both closures, at the same time where there are threads for it.
    pub fn join<A: FnOnce() + Send, B: FnOnce() + Send>(&self, a: A, b: B) {
        #[cfg(feature = "rayon")]
        if let Some(pool) = self.pool {
            pool.join(a, b);
            return;
        }
        if let Some(helper) = self.helper {
            helper.join(a, b);
            return;
        }
        a();
        b();
    }
}

impl Join for Executor<'_> {
    fn join<A: FnOnce() + Send, B: FnOnce() + Send>(&self, a: A, b: B) {
        Executor::join(self, a, b);
    }
}
