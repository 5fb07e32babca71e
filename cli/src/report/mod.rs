//! Reports: SVG charts, tables and self-contained HTML pages.
//!
//! A page needs nothing but itself: charts are inline SVG, pictures are base64 PNG, there is no script and no address
//! to fetch. Colours follow the reader's light or dark setting and can be told apart by colour-blind readers; lines
//! also differ in their dashes.

mod chart;
mod page;
mod table;

pub use chart::{Axis, Chart, Mark, Rule, Scale, Series};
pub use page::{Page, encode_png};
pub use table::{Align, Cell, Column, Table};

/// Escapes text for HTML and SVG.
pub(crate) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            _ => out.push(c),
        }
    }
    out
}
