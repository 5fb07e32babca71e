//! A self-contained HTML page; its text is `templates/page.html`.

use super::{Chart, Table};
use anyhow::{Context, Result, ensure};
use askama::Template;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use entire_io::files::write_whole;
use entire_vk_raycaster::Image;
use std::path::Path;

/// A page: a title, then the added blocks, in order.
#[derive(Clone, Debug, Template)]
#[template(path = "page.html")]
pub struct Page {
    title: String,
    lead: String,
    blocks: Vec<Block>,
}

/// A block of a page. The template escapes plain texts. Each entry of `Pictures` is a PNG file as base64, and
/// its caption.
#[derive(Clone, Debug)]
enum Block {
    Heading(String),
    Paragraph(String),
    Chart { svg: String, caption: String },
    Table { html: String, caption: String },
    Pictures(Vec<(String, String)>),
    Facts(Vec<(String, String)>),
}

impl Page {
    /// Returns a page with a title and a sentence under it.
    pub fn new(title: impl Into<String>, lead: &str) -> Self {
        Self { title: title.into(), lead: lead.to_owned(), blocks: Vec::new() }
    }

    /// Starts a section.
    pub fn heading(&mut self, text: &str) {
        self.blocks.push(Block::Heading(text.to_owned()));
    }

    /// Adds a paragraph.
    pub fn paragraph(&mut self, text: &str) {
        self.blocks.push(Block::Paragraph(text.to_owned()));
    }

    /// Adds a chart with a caption below it.
    pub fn chart(&mut self, chart: &Chart, caption: &str) {
        self.blocks.push(Block::Chart { svg: chart.to_svg(), caption: caption.to_owned() });
    }

    /// Adds a table with a caption below it.
    pub fn table(&mut self, table: &Table, caption: &str) {
        self.blocks.push(Block::Table { html: table.to_html(), caption: caption.to_owned() });
    }

    /// Adds pictures side by side. Each is given as the bytes of a PNG file and a caption.
    pub fn pictures<'a>(&mut self, pictures: impl IntoIterator<Item = (&'a [u8], String)>) {
        let encoded = pictures.into_iter().map(|(png, caption)| (STANDARD.encode(png), caption)).collect();
        self.blocks.push(Block::Pictures(encoded));
    }

    /// Adds pairs of name and value that describe the provenance.
    pub fn facts<'a>(&mut self, facts: impl IntoIterator<Item = (&'a str, String)>) {
        let facts = facts.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
        self.blocks.push(Block::Facts(facts));
    }

    /// Returns the whole document.
    pub fn finish(&self) -> String {
        self.render().expect("writing into memory does not fail")
    }

    /// Writes the document.
    ///
    /// # Errors
    /// When the file cannot be written; the message names the file.
    pub fn write(&self, path: &Path) -> Result<()> {
        write_whole(path, self.finish().as_bytes())
    }
}

/// Encodes a rendered image as PNG. The pixels are premultiplied over black, so they are written as opaque.
///
/// # Errors
/// When the length of the pixel buffer does not fit the size.
pub fn encode_png(picture: &Image) -> Result<Vec<u8>> {
    let Image { width, height, ref rgba } = *picture;
    let rgb: Vec<u8> = rgba.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
    ensure!(
        rgb.len() == 3 * width as usize * height as usize,
        "a {width} x {height} picture came with {} bytes; 4 per pixel are needed",
        rgba.len()
    );
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    let mut writer = encoder.write_header().context("cannot encode a PNG")?;
    writer.write_image_data(&rgb).context("cannot encode a PNG")?;
    writer.finish().context("cannot encode a PNG")?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Axis, Mark, Series};

    #[test]
    fn a_page_fetches_nothing() {
        let mut page = Page::new("Steering <fast>", "One & all.");
        page.chart(
            &Chart::new("t", Axis::linear("frame"), Axis::linear("ms"))
                .series(Series::new("a", Mark::Line(vec![(0.0, 1.0), (1.0, 2.0)]))),
            "Figure.",
        );
        page.table(&Table::headed("a"), "");
        let png = encode_png(&Image { width: 2, height: 1, rgba: vec![0, 1, 2, 3, 4, 5, 6, 7] }).unwrap();
        page.pictures([(png.as_slice(), "frame 3".to_owned())]);
        page.facts([("machine", "2 cores".to_owned())]);
        let html = page.finish();
        assert_eq!(html.matches("<svg").count(), 1);
        for word in ["http:", "https:", "src=\"//", "url(", "@import", "<script", "<link"] {
            assert!(!html.contains(word), "{word}");
        }
        assert!(
            !html.contains("<fast>")
                && html.contains("One &#38; all.")
                && html.contains("data:image/png;base64,iVBORw0KGgo")
        );
    }

    #[test]
    fn a_wrong_buffer_is_refused() {
        let error = encode_png(&Image { width: 9, height: 9, rgba: vec![0; 8] }).unwrap_err();
        assert!(error.to_string().contains("9 x 9"), "{error}");
    }
}
