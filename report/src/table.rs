//! Tables that print on a terminal, in an HTML page and in Markdown from one description.

use askama::Template;
use entire_io::metrics::Metrics;

/// A column: its heading, with unit, and true if it holds numbers, which are aligned at the right.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Column {
    name: String,
    number: bool,
}

/// A cell: its text, and true if it is the best of its column.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cell {
    text: String,
    best: bool,
}

impl From<String> for Cell {
    fn from(text: String) -> Self {
        Self { text, best: false }
    }
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        text.to_owned().into()
    }
}

/// A missing value becomes a dash.
impl<T: Into<Self>> From<Option<T>> for Cell {
    fn from(value: Option<T>) -> Self {
        value.map_or_else(|| "-".into(), Into::into)
    }
}

/// Largest number of columns at normal text size; wider tables have smaller text, so that they fit the page.
const MAX_COLUMNS: usize = 8;

/// A table. Each row has as many cells as the heading.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Table {
    columns: Vec<Column>,
    rows: Vec<Vec<Cell>>,
}

#[derive(Template)]
#[template(path = "table.html")]
struct Html<'a> {
    columns: &'a [Column],
    rows: &'a [Vec<(&'a Column, &'a Cell)>],
}

impl Table {
    /// An empty table. `headings` are separated by ` | `; a `#` before a heading marks a column of numbers.
    pub fn headed(headings: &str) -> Self {
        let column =
            |h: &str| Column { name: h.strip_prefix('#').unwrap_or(h).into(), number: h.starts_with('#') };
        Self { columns: headings.split(" | ").map(column).collect(), rows: Vec::new() }
    }

    /// Adds columns of numbers with these names, which may contain any character.
    #[must_use]
    pub fn with_numbers(mut self, names: impl IntoIterator<Item = String>) -> Self {
        self.columns.extend(names.into_iter().map(|name| Column { name, number: true }));
        self
    }

    /// Adds a row. A row that is shorter than the heading is padded with empty cells.
    pub fn row(&mut self, mut cells: Vec<Cell>) {
        cells.resize(self.columns.len(), "".into());
        self.rows.push(cells);
    }

    /// Marks the best cells of a numeric column: the lowest if `lowest` is true, else the highest. `values`
    /// has one entry per row; those that are not finite are ignored.
    pub fn mark_best(&mut self, column: usize, values: &[f64], lowest: bool) {
        let sign = if lowest { 1.0 } else { -1.0 };
        let best = values.iter().filter(|v| v.is_finite()).map(|v| v * sign).fold(f64::INFINITY, f64::min);
        for (row, value) in self.rows.iter_mut().zip(values) {
            if let Some(cell) = row.get_mut(column) {
                cell.best = value.is_finite() && value * sign <= best;
            }
        }
    }

    /// Returns the table as text for a terminal, padded with spaces; asterisks mark best cells.
    pub fn to_text(&self) -> String {
        let show = |cell: &Cell| format!("{}{}", cell.text, if cell.best { "*" } else { "" });
        let shown: Vec<Vec<String>> = self.rows.iter().map(|row| row.iter().map(show).collect()).collect();
        let wide = |text: &String| text.chars().count();
        let width = |(c, column): (usize, &Column)| {
            shown.iter().map(|row| wide(&row[c])).fold(wide(&column.name), usize::max)
        };
        let widths: Vec<usize> = self.columns.iter().enumerate().map(width).collect();
        let line = |texts: Vec<String>| {
            let mut out = String::new();
            for (c, text) in texts.iter().enumerate() {
                let pad = " ".repeat(widths[c].saturating_sub(text.chars().count()));
                out +=
                    &if self.columns[c].number { format!("{pad}{text}  ") } else { format!("{text}{pad}  ") };
            }
            out.trim_end().to_owned() + "\n"
        };
        let mut out = line(self.columns.iter().map(|c| c.name.clone()).collect());
        out += &line(widths.iter().map(|w| "-".repeat(*w)).collect());
        for row in shown {
            out += &line(row);
        }
        out
    }

    /// Returns the table as HTML; best cells are bold.
    pub(crate) fn to_html(&self) -> String {
        let rows: Vec<Vec<(&Column, &Cell)>> =
            self.rows.iter().map(|row| self.columns.iter().zip(row).collect()).collect();
        Html { columns: &self.columns, rows: &rows }.render().expect("writing into memory does not fail")
    }

    /// Returns the table as Markdown; best cells are bold.
    pub fn to_markdown(&self) -> String {
        let safe = |t: &str| t.replace('|', "\\|").replace('\n', " ");
        let show =
            |cell: &Cell| if cell.best { format!("**{}**", safe(&cell.text)) } else { safe(&cell.text) };
        let line = |texts: Vec<String>| format!("| {} |\n", texts.join(" | "));
        let rules = self.columns.iter().map(|c| if c.number { "|---:" } else { "|---" });
        let mut out = line(self.columns.iter().map(|c| safe(&c.name)).collect());
        out.extend(rules.chain(["|\n"]));
        out.extend(self.rows.iter().map(|row| line(row.iter().map(show).collect())));
        out
    }
}

/// Returns a table of each predictor's median of predicted / measured − 1, in %, for each tenth of the
/// frames, from the fastest to the slowest tenth.
pub fn bias_table(predictors: &[(&str, &Metrics)]) -> Table {
    let deciles = predictors.iter().map(|(_, m)| m.bias_by_decile.len()).max().unwrap_or(0);
    let columns: String = (1..=deciles).map(|d| format!(" | #tenth {d}")).collect();
    let mut table = Table::headed(&format!("predictor{columns}"));
    for (name, metrics) in predictors {
        let mut row = vec![(*name).into()];
        row.extend(metrics.bias_by_decile.iter().map(|b| format!("{:+.1}", 100.0 * b).into()));
        table.row(row);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        let mut t = Table::headed("who | #misses / %");
        t.row(vec!["fixed".into(), "50.0".into()]);
        t.row(vec!["a|<b>".into(), "2.5".into()]);
        t.row(vec!["short".into()]);
        t.row(vec!["nothing".into(), None::<String>.into()]);
        t.mark_best(1, &[50.0, 2.5, f64::NAN, f64::NAN], true);
        t
    }

    #[test]
    fn names_of_numbers_may_contain_the_separator() {
        let mut t = Table::headed("group").with_numbers(["a | #b".to_owned()]);
        t.row(vec!["all".into(), "1".into()]);
        let text = t.to_text();
        assert!(text.contains("a | #b") && t.columns.len() == 2, "{text}");
    }

    #[test]
    fn one_description_prints_three_ways() {
        assert_eq!(
            table().to_text(),
            "who      misses / %\n-------  ----------\nfixed          50.0\na|<b>          2.5*\nshort\n\
             nothing           -\n"
        );
        assert!(table().to_html().contains("<td>a|&#60;b&#62;</td><td class=\"n\"><b>2.5</b></td>"));
        assert!(table().to_markdown().contains("| a\\|<b> | **2.5** |"));
    }

    #[test]
    fn tables_of_many_columns_are_set_smaller() {
        let of = |n: usize| Table::headed(&vec!["#n"; n].join(" | ")).to_html();
        assert!(
            of(MAX_COLUMNS).contains("<table>") && of(MAX_COLUMNS + 1).contains("<table class=\"wide\">")
        );
    }
}
