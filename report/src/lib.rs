//! Reports: SVG charts, tables and self-contained HTML pages.
//!
//! A page is one file that loads no other: charts are inline SVG, pictures are base64 PNG, and there is no
//! script. Colors follow the reader's light or dark setting and can be told apart by color-blind readers;
//! lines also differ in their dashes.

mod chart;
mod page;
mod table;

pub use chart::{Axis, Chart, Mark, Rule, Series};
pub use page::{Page, encode_png};
pub use table::{Cell, Table, bias_table};
