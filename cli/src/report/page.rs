//! A self-contained HTML page.

use super::{Chart, Table, escape};
use anyhow::{Context, Result};
use base64::Engine as _;
use entire_vk_raycaster::Image;
use std::fmt::Write as _;
use std::path::Path;

/// A page under construction: a title, then whatever is added, in order.
#[derive(Clone, Debug)]
pub struct Page {
    title: String,
    body: String,
}

const STYLE: &str = "\
:root{color-scheme:light dark;--ink:#1c2024;--dim:#555b63;--line:#d9dde1;--ground:#fff;--soft:#f4f6f8;--accent:#0072b2}\
@media(prefers-color-scheme:dark){:root{--ink:#e8eaed;--dim:#a9b0b8;--line:#343a42;--ground:#15181c;--soft:#1d2127;--accent:#56a8e0}}\
body{margin:0;background:var(--ground);color:var(--ink);font:16px/1.5 system-ui,'Segoe UI','DejaVu Sans',sans-serif}\
main{max-width:940px;margin:0 auto;padding:28px 20px 60px}\
h1{font-size:27px;line-height:1.2;margin:0 0 6px}h2{font-size:20px;margin:38px 0 8px;padding-top:10px;border-top:1px solid var(--line)}\
p{margin:8px 0;max-width:74ch}.lead{font-size:17px;color:var(--dim)}\
figure{margin:18px 0}figcaption{color:var(--dim);font-size:14px;margin-top:4px;max-width:80ch}\
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:14px;margin:10px 0;font-variant-numeric:tabular-nums}\
th,td{padding:5px 11px;border-bottom:1px solid var(--line);text-align:left;vertical-align:top}\
th{background:var(--soft);font-weight:600}td.n,th.n{text-align:right}td.n{white-space:nowrap}td:first-child{min-width:9em}td b{color:var(--accent)}\
table.wide{font-size:11.5px;line-height:1.35}table.wide th,table.wide td{padding:3px 5px}table.wide td:first-child{min-width:0}\
.pictures{display:grid;grid-template-columns:repeat(auto-fill,minmax(136px,1fr));gap:12px}\
.pictures figure{margin:0}.pictures img{width:100%;display:block;background:#000;border-radius:4px}\
.facts{display:grid;grid-template-columns:max-content 1fr;gap:3px 16px;font-size:14px}.facts dt{color:var(--dim)}.facts dd{margin:0;overflow-wrap:anywhere}\
@media print{main{max-width:none}}";

impl Page {
    /// A page with a title and a sentence under it.
    pub fn new(title: impl Into<String>, lead: &str) -> Self {
        let title = title.into();
        let body = format!("<h1>{}</h1><p class=\"lead\">{}</p>", escape(&title), escape(lead));
        Self { title, body }
    }

    /// Starts a section.
    pub fn heading(&mut self, text: &str) {
        let _ = write!(self.body, "<h2>{}</h2>", escape(text));
    }

    /// Adds a paragraph.
    pub fn paragraph(&mut self, text: &str) {
        let _ = write!(self.body, "<p>{}</p>", escape(text));
    }

    /// Adds a chart with a caption below it.
    pub fn chart(&mut self, chart: &Chart, caption: &str) {
        let _ = write!(self.body, "<figure>{}{}</figure>", chart.to_svg(), figcaption(caption));
    }

    /// Adds a table with a caption below it.
    pub fn table(&mut self, table: &Table, caption: &str) {
        let _ = write!(self.body, "<figure>{}{}</figure>", table.to_html(), figcaption(caption));
    }

    /// Adds pictures side by side, each a PNG file's bytes with its caption.
    pub fn pictures<'a>(&mut self, pictures: impl IntoIterator<Item = (&'a [u8], String)>) {
        self.body += "<div class=\"pictures\">";
        for (png, caption) in pictures {
            let data = base64::engine::general_purpose::STANDARD.encode(png);
            let _ = write!(
                self.body,
                "<figure><img alt=\"{}\" src=\"data:image/png;base64,{data}\">{}</figure>",
                escape(&caption),
                figcaption(&caption)
            );
        }
        self.body += "</div>";
    }

    /// Adds name and value pairs: where the numbers come from.
    pub fn facts<'a>(&mut self, facts: impl IntoIterator<Item = (&'a str, String)>) {
        self.body += "<dl class=\"facts\">";
        for (name, value) in facts {
            let _ = write!(self.body, "<dt>{}</dt><dd>{}</dd>", escape(name), escape(&value));
        }
        self.body += "</dl>";
    }

    /// The whole document.
    pub fn finish(&self) -> String {
        format!(
            "<!DOCTYPE html><html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\"><title>{}</title>\
             <style>{STYLE}</style></head><body><main>{}</main></body></html>\n",
            escape(&self.title),
            self.body
        )
    }

    /// Writes the document.
    ///
    /// # Errors
    /// When the file cannot be written; names it.
    pub fn write(&self, path: &Path) -> Result<()> {
        std::fs::write(path, self.finish())
            .with_context(|| format!("cannot write the report {}", path.display()))
    }
}

fn figcaption(text: &str) -> String {
    if text.is_empty() { String::new() } else { format!("<figcaption>{}</figcaption>", escape(text)) }
}

/// Encodes a rendered image as PNG. The pixels are premultiplied over black; written opaque, as they look.
///
/// # Errors
/// When the buffer does not fit the size.
pub fn encode_png(picture: &Image) -> Result<Vec<u8>> {
    let rgb: Vec<u8> = picture.rgba.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
    let buffer = image::RgbImage::from_raw(picture.width, picture.height, rgb).with_context(|| {
        format!("a {} x {} picture came with {} bytes", picture.width, picture.height, picture.rgba.len())
    })?;
    let mut png = std::io::Cursor::new(Vec::new());
    buffer.write_to(&mut png, image::ImageFormat::Png).context("cannot encode a PNG")?;
    Ok(png.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::{Axis, Column, Mark, Series};

    #[test]
    fn a_page_fetches_nothing() {
        let mut page = Page::new("Steering <fast>", "One & all.");
        page.chart(
            &Chart::new("t", Axis::linear("frame"), Axis::linear("ms"))
                .series(Series::new("a", Mark::Line(vec![(0.0, 1.0), (1.0, 2.0)]))),
            "Figure.",
        );
        page.table(&Table::new(vec![Column::text("a")]), "");
        let png = encode_png(&Image { width: 2, height: 1, rgba: vec![0, 1, 2, 3, 4, 5, 6, 7] }).unwrap();
        page.pictures([(png.as_slice(), "frame 3".to_owned())]);
        page.facts([("machine", "2 cores".to_owned())]);
        let html = page.finish();
        for word in ["http:", "https:", "src=\"//", "url(", "@import", "<script", "<link"] {
            assert!(!html.contains(word), "{word}");
        }
        assert!(html.contains("Steering &lt;fast&gt;") && html.contains("data:image/png;base64,iVBORw0KGgo"));
    }

    #[test]
    fn a_wrong_buffer_is_refused() {
        let error = encode_png(&Image { width: 9, height: 9, rgba: vec![0; 8] }).unwrap_err();
        assert!(error.to_string().contains("9 x 9"), "{error}");
    }
}
