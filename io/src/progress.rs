//! Progress bars. They are hidden where standard error is no terminal, and where the program is quiet.

use crate::quiet::is_quiet;
use indicatif::{ProgressBar, ProgressStyle};

/// The template of the bar for computing inputs.
pub const INPUTS_BAR: &str = "computing inputs [{bar:30}] {pos}/{len} frames, {eta} left";

/// Returns a bar with a prefix, the time left and a message. A dropped bar disappears.
pub fn progress_bar(what: &str) -> ProgressBar {
    let bar = templated_bar("{prefix} [{bar:32}] {pos}/{len}, {eta} left  {wide_msg}");
    bar.set_prefix(what.to_owned());
    bar
}

/// Returns a bar that is drawn by a template (see [`ProgressStyle::with_template`]).
pub fn templated_bar(template: &str) -> ProgressBar {
    if is_quiet() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(0).with_style(style.progress_chars("=> "))
}
