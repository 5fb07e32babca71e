//! The switch that silences notes and progress bars.

use std::sync::atomic::{AtomicBool, Ordering};

/// Of the process, as its standard error is.
static QUIET: AtomicBool = AtomicBool::new(false);

/// Shows no bars and says no notes from now on, or shows and says them again.
pub fn keep_quiet(quiet: bool) {
    QUIET.store(quiet, Ordering::Relaxed);
}

/// True where bars and notes are left away.
pub fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}
