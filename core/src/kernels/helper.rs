//! A second thread for work of a few microseconds, synchronized through one cache line, without a queue or a
//! lock. Posting and finishing work makes no system call; an idle helper thread yields its core (feature
//! `std`).

use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

/// State: no thread serves.
const ABSENT: u32 = 0;
/// State: the serving thread waits for work.
const IDLE: u32 = 1;
/// State: a caller is about to post work.
const CLAIMED: u32 = 2;
/// State: work is posted or in progress.
const POSTED: u32 = 3;
/// State: the work is done; its caller has not seen it yet.
const DONE: u32 = 4;
/// State: the work panicked.
const FAILED: u32 = 5;

/// Number of polls after which a waiting thread issues the processor's spin-loop hint.
const EAGER_ROUNDS: u32 = 4096;
/// Number of polls after which an idle helper yields its core (with the feature `std` only).
#[cfg(feature = "std")]
const IDLE_ROUNDS: u32 = 200_000;

#[derive(Clone, Copy)]
struct Job {
    data: *mut (),
    call: unsafe fn(*mut ()),
}

/// Runs the two halves of a computation concurrently.
pub(crate) trait Join {
    fn join<A: FnOnce() + Send, B: FnOnce() + Send>(&self, a: A, b: B);
}

/// A thread that the caller provides, for networks whose weights exceed one core's cache: each of the two
/// cores then caches one half of the weights.
///
/// The thread calls [`serve`](Self::serve) and spins there until [`stop`](Self::stop): it keeps one core busy
/// for as long as it serves. If no thread serves, or if the thread works for another caller, the caller does
/// all the work itself, with the same result.
///
/// ```
/// let helper = entire_core::kernels::Helper::new();
/// std::thread::scope(|scope| {
///     scope.spawn(|| helper.serve());
///     // … predict with Executor::Helper(&helper) …
///     helper.stop();
/// });
/// ```
#[derive(Debug)]
#[repr(align(128))]
pub struct Helper {
    state: AtomicU32,
    stop: AtomicBool,
    job: UnsafeCell<Option<Job>>,
}

// SAFETY: `job` is written only by the caller that moved `state` from IDLE to CLAIMED, and read only by the
// serving thread after it has seen POSTED; `data` points to closures that are Send.
unsafe impl Sync for Helper {}
// SAFETY: `data` points to closures that are Send. Between calls, `job` holds nothing that is bound to a
// thread.
unsafe impl Send for Helper {}

impl core::fmt::Debug for Job {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Job")
    }
}

impl Default for Helper {
    fn default() -> Self {
        Self::new()
    }
}

impl Helper {
    /// A helper that no thread serves yet.
    pub const fn new() -> Self {
        Self { state: AtomicU32::new(ABSENT), stop: AtomicBool::new(false), job: UnsafeCell::new(None) }
    }

    /// True while a thread serves.
    pub(crate) fn is_served(&self) -> bool {
        self.state.load(Ordering::Relaxed) != ABSENT
    }

    /// Does the work that callers post, until [`stop`](Self::stop) is called. Returns at once if another
    /// thread serves already.
    pub fn serve(&self) {
        if self.state.compare_exchange(ABSENT, IDLE, Ordering::Relaxed, Ordering::Relaxed).is_err() {
            return;
        }
        let mut waited = 0u32;
        loop {
            match self.state.load(Ordering::Acquire) {
                POSTED => {
                    waited = 0;
                    let guard = Outcome(&self.state, FAILED);
                    // SAFETY: POSTED means that the caller has written the job and waits for DONE before it
                    // touches the job or leaves the frame that `data` points into.
                    if let Some(job) = unsafe { *self.job.get() } {
                        // SAFETY: `call` is the function that `join` wrote for exactly this `data`.
                        unsafe { (job.call)(job.data) };
                    }
                    let mut guard = guard;
                    guard.1 = DONE;
                }
                IDLE if self.stop.load(Ordering::Relaxed) => {
                    if self.state.compare_exchange(IDLE, ABSENT, Ordering::Relaxed, Ordering::Relaxed).is_ok()
                    {
                        self.stop.store(false, Ordering::Relaxed);
                        return;
                    }
                }
                _ => wait(&mut waited, true),
            }
        }
    }

    /// Ends [`serve`](Self::serve) once the work in progress is done. If no thread serves yet, the next call
    /// of `serve` returns at once.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

impl Join for Helper {
    fn join<A: FnOnce() + Send, B: FnOnce() + Send>(&self, a: A, b: B) {
        /// # Safety
        ///
        /// `data` must point to an `Option<B>` that nothing else accesses.
        unsafe fn call<B: FnOnce()>(data: *mut ()) {
            // SAFETY: the caller guarantees that `data` points to an `Option<B>` that nothing else accesses.
            if let Some(b) = unsafe { &mut *data.cast::<Option<B>>() }.take() {
                b();
            }
        }
        if self.state.compare_exchange(IDLE, CLAIMED, Ordering::Acquire, Ordering::Relaxed).is_err() {
            a();
            b();
            return;
        }
        let mut b = Some(b);
        let job = Job { data: (&raw mut b).cast(), call: call::<B> };
        // SAFETY: this call has set the state to CLAIMED, so nothing else accesses the job.
        unsafe { *self.job.get() = Some(job) };
        self.state.store(POSTED, Ordering::Release);
        // The drop of `posted` waits even if `a` panics: `b` lives in this frame.
        let posted = Posted(self);
        a();
        drop(posted);
    }
}

/// Stores its state in the atomic when dropped.
struct Outcome<'a>(&'a AtomicU32, u32);

impl Drop for Outcome<'_> {
    fn drop(&mut self) {
        self.0.store(self.1, Ordering::Release);
    }
}

struct Posted<'a>(&'a Helper);

impl Drop for Posted<'_> {
    fn drop(&mut self) {
        let mut waited = 0;
        loop {
            match self.0.state.load(Ordering::Acquire) {
                DONE => break self.0.state.store(IDLE, Ordering::Release),
                FAILED => {
                    // The serving thread has ended, and half of the result is missing.
                    self.0.state.store(ABSENT, Ordering::Release);
                    panic!("the helper thread panicked");
                }
                _ => wait(&mut waited, false),
            }
        }
    }
}

fn wait(waited: &mut u32, idle: bool) {
    *waited = waited.saturating_add(1);
    #[cfg(feature = "std")]
    if idle && *waited > IDLE_ROUNDS {
        std::thread::yield_now();
        return;
    }
    let _ = idle;
    if *waited > EAGER_ROUNDS {
        core::hint::spin_loop();
    }
}

#[cfg(all(test, feature = "std"))]
mod tests {
    use super::*;

    fn sums(helper: &Helper, rounds: u64) {
        for i in 0..rounds {
            let (mut x, mut y) = (0, 0);
            helper.join(|| x = i + 1, || y = i + 2);
            assert_eq!((x, y), (i + 1, i + 2));
        }
    }

    #[test]
    fn work_is_done_with_and_without_a_thread() {
        let helper = Helper::new();
        sums(&helper, 10);
        assert!(!helper.is_served());
        std::thread::scope(|scope| {
            scope.spawn(|| helper.serve());
            while !helper.is_served() {
                std::thread::yield_now();
            }
            sums(&helper, 300);
            helper.stop();
        });
        assert!(!helper.is_served());
        sums(&helper, 10);
    }

    #[test]
    fn several_callers_share_one_helper() {
        let helper = Helper::new();
        std::thread::scope(|scope| {
            let server = scope.spawn(|| helper.serve());
            let callers: [_; 3] = core::array::from_fn(|_| scope.spawn(|| sums(&helper, 100)));
            for caller in callers {
                caller.join().unwrap();
            }
            helper.stop();
            server.join().unwrap();
        });
    }

    #[test]
    fn work_that_unwinds_is_reported_and_frees_the_helper() {
        let helper = Helper::new();
        std::thread::scope(|scope| {
            let server = scope.spawn(|| helper.serve());
            while !helper.is_served() {
                std::thread::yield_now();
            }
            let caught = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                helper.join(|| {}, || panic!("on purpose"));
            }));
            assert!(caught.is_err());
            assert!(server.join().is_err());
        });
        sums(&helper, 3);
    }
}
