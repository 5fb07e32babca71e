//! Bars: goals, each with a measured value and its limit, printed one to a line.

use anyhow::{Result, ensure};
use entire_report::Table;

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Bar {
    /// Name of the bar, without blanks.
    pub(crate) name: String,
    /// Measured value; `None` where it could not be measured.
    pub(crate) value: Option<f64>,
    pub(crate) limit: f64,
    /// True if the limit is met; false without a value.
    pub(crate) ok: bool,
    /// Text printed in brackets after the bar; may be empty.
    pub(crate) note: String,
}

impl Bar {
    pub(crate) fn at_most(name: impl Into<String>, value: Option<f64>, limit: f64) -> Self {
        Self { name: name.into(), value, limit, ok: value.is_some_and(|v| v <= limit), note: String::new() }
    }

    pub(crate) fn at_least(name: impl Into<String>, value: Option<f64>, limit: f64) -> Self {
        Self { name: name.into(), value, limit, ok: value.is_some_and(|v| v >= limit), note: String::new() }
    }

    /// Returns the bar with a note, which is printed in brackets after the bar.
    pub(crate) fn with_note(self, note: impl Into<String>) -> Self {
        Self { note: note.into(), ..self }
    }

    fn in_brackets(&self) -> String {
        if self.note.is_empty() { String::new() } else { format!(" ({})", self.note) }
    }
}

impl std::fmt::Display for Bar {
    /// Writes `bar NAME VALUE LIMIT ok|short`, then the note in brackets. VALUE is `-` if there is no value.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let found = self.value.map_or("-".into(), |v| format!("{v:.4}"));
        let verdict = if self.ok { "ok" } else { "short" };
        write!(f, "bar {} {found} {:.4} {verdict}{}", self.name, self.limit, self.in_brackets())
    }
}

pub(crate) fn table(bars: &[Bar]) -> Table {
    let mut table = Table::headed("bar | #value | #limit | met");
    for b in bars {
        table.row(vec![
            b.name.as_str().into(),
            b.value.map(|v| format!("{v:.4}")).into(),
            format!("{:.4}", b.limit).into(),
            format!("{}{}", if b.ok { "yes" } else { "short" }, b.in_brackets()).into(),
        ]);
    }
    table
}

/// Prints bars, one line each. The error names every bar that is short (its limit is missed).
pub(crate) fn print(bars: &[Bar]) -> Result<()> {
    bars.iter().for_each(|b| println!("{b}"));
    let short: Vec<&str> = bars.iter().filter(|b| !b.ok).map(|b| b.name.as_str()).collect();
    ensure!(short.is_empty(), "short: {}", short.join(", "));
    Ok(())
}
