//! Bars: measured value beside its limit, one line each.

use anyhow::{Result, ensure};
use entire_report::{Column, Table};

/// A bar.
#[derive(Clone, Debug, PartialEq)]
pub struct Bar {
    /// Name of the bar, without blanks.
    pub name: String,
    /// Measured value; `None` where it could not be measured.
    pub value: Option<f64>,
    /// Limit of the value.
    pub limit: f64,
    /// True if the limit is met; false without a value.
    pub ok: bool,
    /// Text printed in brackets behind the bar; may be empty.
    pub note: String,
}

impl Bar {
    /// Met if the value is no more than the limit.
    pub fn at_most(name: impl Into<String>, value: Option<f64>, limit: f64) -> Self {
        Self { name: name.into(), value, limit, ok: value.is_some_and(|v| v <= limit), note: String::new() }
    }

    /// Met if the value is no less than the limit.
    pub fn at_least(name: impl Into<String>, value: Option<f64>, limit: f64) -> Self {
        Self { name: name.into(), value, limit, ok: value.is_some_and(|v| v >= limit), note: String::new() }
    }

    /// The same with something behind it in brackets.
    pub fn with_note(self, note: impl Into<String>) -> Self {
        Self { note: note.into(), ..self }
    }

    fn in_brackets(&self) -> String {
        if self.note.is_empty() { String::new() } else { format!(" ({})", self.note) }
    }
}

impl std::fmt::Display for Bar {
    /// `bar NAME VALUE LIMIT ok|short`, the value `-` where nothing was found; then the note, where there is one.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let found = self.value.map_or("-".into(), |v| format!("{v:.4}"));
        let verdict = if self.ok { "ok" } else { "short" };
        write!(f, "bar {} {found} {:.4} {verdict}{}", self.name, self.limit, self.in_brackets())
    }
}

/// Bars as a table.
pub fn table(bars: &[Bar]) -> Table {
    let mut table = Table::new(vec![
        Column::text("bar"),
        Column::number("found"),
        Column::number("asked for"),
        Column::text("holds"),
    ]);
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

/// Prints bars, one line each.
///
/// # Errors
/// Names those that are short.
pub fn print(bars: &[Bar]) -> Result<()> {
    bars.iter().for_each(|b| println!("{b}"));
    let short: Vec<&str> = bars.iter().filter(|b| !b.ok).map(|b| b.name.as_str()).collect();
    ensure!(short.is_empty(), "short: {}", short.join(", "));
    Ok(())
}
