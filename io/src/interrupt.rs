//! Ctrl-C: finish the current piece of work, and name the way to continue.

use anyhow::{Context, Result};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

static REQUESTED: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Takes over Ctrl-C (and SIGTERM, SIGHUP): the first one raises the returned flag, a second one ends the
/// program at once with exit status 1. Later calls return the same flag.
///
/// # Errors
/// When the system refuses a handler.
pub fn flag() -> Result<Arc<AtomicBool>> {
    if let Some(flag) = REQUESTED.get() {
        return Ok(flag.clone());
    }
    let flag = Arc::new(AtomicBool::new(false));
    let raised = flag.clone();
    ctrlc::set_handler(move || {
        if raised.swap(true, Ordering::SeqCst) {
            std::process::exit(1);
        }
    })
    .context("cannot watch for Ctrl-C")?;
    Ok(REQUESTED.get_or_init(|| flag).clone())
}

/// True if the flag was raised.
pub fn requested(flag: &AtomicBool) -> bool {
    flag.load(Ordering::SeqCst)
}
