//! Ctrl-C and similar signals: they raise a flag, so that a command can finish its current piece of work.

use crate::volume::Watcher;
use anyhow::{Context, Result};
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

#[cfg(unix)]
const SIGNALS: [i32; 3] =
    [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM, signal_hook::consts::SIGHUP];
#[cfg(not(unix))]
const SIGNALS: [i32; 1] = [signal_hook::consts::SIGINT];

/// True if the parent process has set a signal to be ignored; false on systems other than Linux, which do not
/// report this.
fn ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}

static REQUESTED: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Takes over Ctrl-C (and on Unix SIGTERM and SIGHUP): the first one raises the returned flag, a second one
/// ends the program at once with exit status 1. Signals that the parent process has set to be ignored stay
/// ignored, as `nohup` requires. Later calls return the same flag.
///
/// # Errors
/// When the system refuses a handler.
pub fn flag() -> Result<Arc<AtomicBool>> {
    if let Some(flag) = REQUESTED.get() {
        return Ok(flag.clone());
    }
    let flag = Arc::new(AtomicBool::new(false));
    for signal in SIGNALS.iter().copied().filter(|signal| !ignored(*signal)) {
        // The order of the two handlers matters: the first signal finds the flag down and raises it, and the
        // second signal ends the program.
        signal_hook::flag::register_conditional_shutdown(signal, 1, flag.clone())
            .and_then(|_| signal_hook::flag::register(signal, flag.clone()))
            .context("cannot watch for Ctrl-C")?;
    }
    Ok(REQUESTED.get_or_init(|| flag).clone())
}

/// A raised flag stops the reading of a volume.
impl Watcher for AtomicBool {
    fn expect(&self, _bytes: u64) {}

    fn advance(&self, _bytes: u64) -> io::Result<()> {
        if requested(self) { Err(io::Error::other("interrupted")) } else { Ok(()) }
    }
}

/// True if the flag was raised.
pub fn requested(flag: &AtomicBool) -> bool {
    flag.load(Ordering::SeqCst)
}
