//! Progress display of a farm: a bar with rate and remaining time on a terminal, else a line at intervals.

use entire_io::progress::templated_bar;
use entire_io::quiet::is_quiet;
use indicatif::ProgressBar;
use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

/// Interval between lines of progress without a terminal.
const LINE_EVERY: Duration = Duration::from_secs(30);
/// Number of nodes up to which the display shows their activity.
const NODES: usize = 8;

#[derive(Clone, Debug, Default)]
pub(crate) struct View {
    pub(crate) done: usize,
    pub(crate) all: usize,
    pub(crate) quarantined: usize,
    /// Tasks per second of this run.
    pub(crate) rate: f64,
    pub(crate) elapsed: f64,
    /// Quantiles 0.05, 0.5 and 0.95 of the end, seconds since the run began.
    pub(crate) eta: [f64; 3],
    pub(crate) nodes: Vec<String>,
}

pub(crate) struct Show {
    bar: ProgressBar,
    lines: bool,
    line_at: Instant,
    /// Time that it takes to compute the contents of the display. It limits the update rate.
    pub(crate) cost: Duration,
}

impl Show {
    pub(crate) fn begin() -> Self {
        let terminal = std::io::stderr().is_terminal();
        Self {
            bar: templated_bar("[{bar:28}] {pos}/{len} {wide_msg}"),
            lines: !is_quiet() && !terminal,
            line_at: Instant::now(),
            cost: Duration::ZERO,
        }
    }

    pub(crate) fn update(&mut self, view: &View) {
        self.bar.set_length(view.all as u64);
        self.bar.set_position(view.done as u64);
        let text = text(view);
        let nodes = if view.nodes.is_empty() || view.nodes.len() > NODES {
            String::new()
        } else {
            format!(" | {}", view.nodes.join(", "))
        };
        self.bar.set_message(format!("{text}{nodes}"));
        if self.lines && self.line_at.elapsed() >= LINE_EVERY {
            self.line_at = Instant::now();
            // A closed standard error is no reason to fail.
            let _ = writeln!(std::io::stderr().lock(), "{}/{} {text}", view.done, view.all);
        }
    }

    pub(crate) fn note(&self, text: &str) {
        if self.lines {
            entire_io::files::note(text);
        } else {
            self.bar.println(format!("note: {text}"));
        }
    }

    pub(crate) fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

fn text(view: &View) -> String {
    let left = view.eta.map(|e| (e - view.elapsed).max(0.0));
    let mut out = format!("{:.2}/s", view.rate);
    if left.iter().all(|l| l.is_finite()) {
        let [low, middle, high] = left.map(duration);
        out += &format!(", {middle} left (90 % interval {low} to {high})");
    }
    if view.quarantined > 0 {
        out += &format!(", {} quarantined", view.quarantined);
    }
    out
}

/// Returns the text of a duration in seconds: `8.5 s`, `3:07 min`, `2:05 h`, `3.5 days`.
pub fn duration(seconds: f64) -> String {
    let s = seconds.round() as u64;
    match seconds {
        x if !x.is_finite() => "unknown".into(),
        x if x < 99.5 => format!("{x:.1} s"),
        _ if s < 3600 => format!("{}:{:02} min", s / 60, s % 60),
        x if x < 172_800.0 => format!("{}:{:02} h", s / 3600, s % 3600 / 60),
        x => format!("{:.1} days", x / 86400.0),
    }
}

/// Parses a duration such as `90s`, `30m`, `2h` or `1.5d`. Returns its seconds.
///
/// # Errors
/// When the text is no such duration, or the duration is not positive.
pub fn parse_duration(text: &str) -> Result<f64, String> {
    let wrong = || {
        format!("{text:?} is no duration; write a positive number and a unit (s, m, h or d), such as 1.5d")
    };
    let units = [("s", 1.0), ("m", 60.0), ("h", 3600.0), ("d", 86400.0)];
    let found = units.into_iter().find_map(|(unit, scale)| Some((text.strip_suffix(unit)?, scale)));
    let (number, scale) = found.ok_or_else(wrong)?;
    let value: f64 = number.trim().parse().map_err(|_| wrong())?;
    if value.is_finite() && value > 0.0 { Ok(value * scale) } else { Err(wrong()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_go_both_ways() {
        for (seconds, text) in [
            (8.54, "8.5 s"),
            (187.0, "3:07 min"),
            (3599.6, "1:00 h"),
            (7500.0, "2:05 h"),
            (302_400.0, "3.5 days"),
        ] {
            assert_eq!(duration(seconds), text);
        }
        assert_eq!(parse_duration("1.5h"), Ok(5400.0));
        for text in ["", "h", "5", "-1s", "nanm", "5 minutes"] {
            assert!(parse_duration(text).is_err(), "{text}");
        }
    }
}
