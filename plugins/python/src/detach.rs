//! Long calls without the interpreter's lock, calls into Python that may release this lock, and the end of
//! the interpreter while such calls run.
//!
//! A thread that asks for the lock of an ending interpreter is unwound by force, which Rust frames turn into
//! an abort. So once the interpreter is about to end, such threads do not ask for the lock again: they block
//! until the process is over. Only daemon threads block so; Python waits for all other threads.

use pyo3::prelude::*;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

/// The thread that ends the interpreter; empty until the interpreter is about to end. Written while the
/// thread holds the interpreter's lock.
static ENDING: OnceLock<ThreadId> = OnceLock::new();
/// Number of threads that are in a long call or in Python code, and will ask for the lock again.
static AWAY: AtomicUsize = AtomicUsize::new(0);

/// Maximum time that [`end`] waits for threads that will ask for the lock.
const MAX_WAIT: Duration = Duration::from_millis(500);

/// True if another thread is about to end the interpreter.
fn is_ending() -> bool {
    ENDING.get().is_some_and(|by| *by != std::thread::current().id())
}

/// Blocks until the process is over.
fn stay() -> ! {
    loop {
        std::thread::park();
    }
}

/// During its lifetime, a thread counts as one that will ask for the lock.
struct Away;

impl Away {
    /// Counts this thread. Blocks if another thread is about to end the interpreter.
    fn new(py: Python<'_>) -> Self {
        if is_ending() {
            py.detach(|| stay());
        }
        AWAY.fetch_add(1, Ordering::SeqCst);
        Self
    }
}

impl Drop for Away {
    fn drop(&mut self) {
        AWAY.fetch_sub(1, Ordering::SeqCst);
    }
}

/// Runs a long call without the interpreter's lock.
pub(crate) fn detached<T: Send>(py: Python<'_>, call: impl FnOnce() -> T + Send) -> T {
    let _away = Away::new(py);
    py.detach(|| {
        let result = call();
        if is_ending() {
            AWAY.fetch_sub(1, Ordering::SeqCst);
            stay();
        }
        result
    })
}

/// Calls Python code, which may release the interpreter's lock and ask for it again.
pub(crate) fn calling<T>(py: Python<'_>, call: impl FnOnce() -> T) -> T {
    let _away = Away::new(py);
    call()
}

/// Called by `atexit`: afterwards no other thread asks for the lock again.
#[pyfunction]
pub(crate) fn end(py: Python<'_>) {
    let _ = ENDING.set(std::thread::current().id());
    let begin = Instant::now();
    while AWAY.load(Ordering::SeqCst) > 0 && begin.elapsed() < MAX_WAIT {
        py.detach(|| std::thread::sleep(Duration::from_millis(1)));
    }
}
