//! Who runs the parallel parts: the calling thread alone, or a pool that the caller owns.

use core::marker::PhantomData;

/// Where encoding and resampling run: on the calling thread alone ([`Executor::serial`], the default), or split over
/// a rayon pool that the caller gives.
///
/// The result never depends on it: every output is computed by one thread, with the same operations in the same
/// order, whatever the split.
#[derive(Clone, Copy, Debug, Default)]
pub struct Executor<'a> {
    #[cfg(feature = "rayon")]
    pool: Option<&'a rayon::ThreadPool>,
    lifetime: PhantomData<&'a ()>,
}

impl<'a> Executor<'a> {
    /// The calling thread does everything.
    pub const fn serial() -> Self {
        Self {
            #[cfg(feature = "rayon")]
            pool: None,
            lifetime: PhantomData,
        }
    }

    /// The work is split over the threads of `pool`; the caller waits.
    #[cfg(feature = "rayon")]
    pub const fn rayon(pool: &'a rayon::ThreadPool) -> Self {
        Self { pool: Some(pool), lifetime: PhantomData }
    }

    /// Number of threads that work is split for.
    pub fn threads(&self) -> usize {
        #[cfg(feature = "rayon")]
        if let Some(pool) = self.pool {
            return pool.current_num_threads().max(1);
        }
        1
    }

    /// Runs both closures, at the same time where there are threads for it.
    pub(crate) fn join<A: FnOnce() + Send, B: FnOnce() + Send>(&self, a: A, b: B) {
        #[cfg(feature = "rayon")]
        if let Some(pool) = self.pool {
            pool.join(a, b);
            return;
        }
        a();
        b();
    }
}
