//! Reports: SVG charts, tables, self-contained HTML pages, and model cards in Markdown.
//!
//! A page is one file that loads no other: charts are inline SVG, pictures are base64 PNG, and there is no
//! script. Colors follow the reader's light or dark setting and can be told apart by color-blind readers;
//! lines also differ in their dashes.

mod card;
mod chart;
mod page;
mod table;

pub use card::{Card, CardFigures};
pub use chart::{Axis, Chart, Mark, Rule, Series};
pub use page::{Page, encode_png};
pub use table::{Cell, Table, bias_table};
