//! The switch that silences notes and progress bars.

use std::sync::atomic::{AtomicBool, Ordering};

/// True if notes and progress bars are off, for the whole process.
static QUIET: AtomicBool = AtomicBool::new(false);

/// Switches notes and progress bars off (`true`) or on (`false`).
pub fn keep_quiet(quiet: bool) {
    QUIET.store(quiet, Ordering::Relaxed);
}

/// True if notes and progress bars are off.
pub fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}
