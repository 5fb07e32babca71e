//! Progress bars, and whether anything is said beside results. Bars are silent where standard error is no terminal.

use indicatif::{ProgressBar, ProgressStyle};
use std::sync::atomic::{AtomicBool, Ordering};

/// Of the process, as its standard error is.
static QUIET: AtomicBool = AtomicBool::new(false);

/// Shows no bars and says no notes from now on, or shows and says them again.
pub fn keep_quiet(quiet: bool) {
    QUIET.store(quiet, Ordering::Relaxed);
}

/// Whether bars and notes are left away.
pub fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// The template of the bar for computing inputs.
pub const INPUTS_BAR: &str = "computing inputs [{bar:30}] {pos}/{len} frames, {eta} left";

/// A bar with a prefix, the time left and a message.
pub fn progress_bar(what: &str) -> ProgressBar {
    let bar = templated_bar("{prefix} [{bar:32}] {pos}/{len}, {eta} left  {wide_msg}");
    bar.set_prefix(what.to_owned());
    bar
}

/// A bar of a template (see [`ProgressStyle::with_template`]).
pub fn templated_bar(template: &str) -> ProgressBar {
    if is_quiet() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(0).with_style(style.progress_chars("=> "))
}
