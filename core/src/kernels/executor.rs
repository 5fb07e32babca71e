//! Executors of parallel work: the calling thread alone, or threads that the caller owns.

/// Threads on which parallel work runs: the calling thread alone, or threads that the caller provides.
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
    /// Cannot be constructed. It uses the lifetime parameter in builds without the feature `rayon`.
    #[cfg(not(feature = "rayon"))]
    #[doc(hidden)]
    Never(core::convert::Infallible, core::marker::PhantomData<&'a ()>),
}

impl Executor<'_> {
    /// Number of threads over which work is split.
    pub fn threads(&self) -> usize {
        match self {
            Self::Serial => 1,
            #[cfg(feature = "rayon")]
            Self::Rayon(pool) => pool.current_num_threads().max(1),
            #[cfg(not(feature = "rayon"))]
            Self::Never(never, _) => match *never {},
        }
    }

    /// Runs both closures, concurrently if a second thread is free.
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
            #[cfg(not(feature = "rayon"))]
            Self::Never(never, _) => match *never {},
        }
    }
}
