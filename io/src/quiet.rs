//! The switch that silences notes and progress bars.

use std::sync::atomic::{AtomicBool, Ordering};

/// For the whole process, like its standard error.
static QUIET: AtomicBool = AtomicBool::new(false);

/// Switches bars and notes off or on.
pub fn keep_quiet(quiet: bool) {
    QUIET.store(quiet, Ordering::Relaxed);
}

/// True if bars and notes are off.
pub fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}
