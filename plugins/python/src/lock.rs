//! A lock that does not block the interpreter, and that fails instead of waiting forever after a fork.

use crate::detach::detached;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, TryLockError};

/// A mutex that stores the process that locked it last.
pub(crate) struct Guarded<T> {
    value: Mutex<T>,
    process: AtomicU32,
}

impl<T: Send> Guarded<T> {
    pub(crate) fn new(value: T) -> Self {
        Self { value: Mutex::new(value), process: AtomicU32::new(0) }
    }

    /// Locks. If another thread holds the lock, the interpreter lock is released while waiting.
    ///
    /// # Errors
    /// `RuntimeError` if the lock was held by a thread of the parent when this process was forked, or if a
    /// thread has panicked while it held the lock.
    pub(crate) fn lock<'a>(&'a self, py: Python<'_>) -> PyResult<MutexGuard<'a, T>> {
        let guard = match self.value.try_lock() {
            Ok(guard) => guard,
            Err(TryLockError::Poisoned(_)) => return Err(poisoned()),
            Err(TryLockError::WouldBlock) => {
                let holder = self.process.load(Ordering::Relaxed);
                if holder != 0 && holder != std::process::id() {
                    return Err(PyRuntimeError::new_err(
                        "another thread was using this object when the process was forked; make a new one \
                         in the child",
                    ));
                }
                detached(py, || self.value.lock().map(SendGuard).map_err(drop)).map_err(|()| poisoned())?.0
            }
        };
        self.process.store(std::process::id(), Ordering::Relaxed);
        Ok(guard)
    }
}

/// A guard that a closure returns. The closure runs on the thread that uses the guard.
struct SendGuard<'a, T>(MutexGuard<'a, T>);

// SAFETY: `Python::detach` runs its closure on the thread that called it, so the guard never moves to another
// thread.
unsafe impl<T: Send> Send for SendGuard<'_, T> {}

fn poisoned() -> PyErr {
    PyRuntimeError::new_err(
        "an earlier call on this object failed inside the library; make a new object, and report the failure",
    )
}
