//! The book's page of the paper's tables and figures: the report in Markdown, with its charts beside it.

use super::description::{Label, Paper};
use super::material::Material;
use super::report::{numbers_table, picture};
use super::section::Section;
use super::sections::{section, trials};
use anyhow::Result;
use entire_io::files::{make_folder, write_whole};
use entire_report::Table;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

/// The page's file name.
pub(crate) const PAGE: &str = "paper-tables.md";

/// Folder of the page's charts and pictures, relative to the page.
const IMAGES: &str = "images/paper";

/// Writes the page and its pictures into the folder of the book's pages.
pub(crate) fn write(paper: &Paper, material: &Material, pages: &Path) -> Result<()> {
    let images = pages.join(IMAGES);
    make_folder(&images)?;
    let mut out = String::from(
        "# The paper's tables\n\n\
         This page has every table and figure of the paper that was measured here: first the paper's numbers, then\n\
         ours.\n\
         [The paper](paper.md#what-the-comparison-says) explains the results. Errors are root mean squared errors in\n\
         seconds of processor time. Hardware and volumes differ from the paper's: compare ratios, not seconds.\n\
         `make bars-paper` writes the whole report from the results that are kept in the repository;\n\
         `entire-lab paper report --kept data/timings/paper-results.json.gz --book docs/src` writes this page.\n",
    );
    let mut missing: Vec<&Label> = Vec::new();
    let mut told: BTreeSet<String> = BTreeSet::new();
    for label in &paper.labels {
        let section = section(paper, label, material);
        if !section.there() {
            missing.push(label);
            continue;
        }
        let _ = write!(out, "\n## {}\n\nThe paper's `{}`. `{}`\n", label.title, label.label, label.command);
        if let Some(numbers) = &label.paper {
            let _ = write!(out, "\nIn the paper:\n\n{}", numbers_table(numbers).to_markdown());
        }
        out += &tables_and_charts(&section, &label.title, &label.label.replace(':', "-"), &images)?;
        let mut drawn = Vec::new();
        for (file, caption) in &section.pictures {
            let name =
                Path::new(file).file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
            // A picture that the book already has is not written again.
            let place = if pages.join("images").join(&name).is_file() {
                format!("images/{name}")
            } else {
                write_whole(&images.join(&name), &picture(material, file)?)?;
                format!("{IMAGES}/{name}")
            };
            if told.insert(place.clone()) {
                let _ = write!(out, "\n![{caption}]({place})");
                drawn.push(caption.as_str());
            }
        }
        if !drawn.is_empty() {
            drawn.dedup();
            let _ = write!(out, "\n\n{}.\n", drawn.join("; "));
        } else if !section.pictures.is_empty() {
            out += "\nThe pictures of this section are shown further up.\n";
        }
        // A note is written once, under the first label that has it.
        for note in section.notes.iter().chain((!label.note.is_empty()).then_some(&label.note)) {
            if told.insert(note.clone()) {
                let _ = write!(out, "\n{note}\n");
            }
        }
    }
    for trial in trials(paper, material) {
        let _ = write!(out, "\n## {}\n\n`{}`\n", trial.title, trial.command);
        out += &tables_and_charts(&trial.section, trial.title, trial.stem, &images)?;
    }
    if !missing.is_empty() {
        let mut table = Table::headed("label | title | command");
        for label in missing {
            let command = format!("`{}`", label.command);
            table.row(vec![label.label.as_str().into(), label.title.as_str().into(), command.into()]);
        }
        let _ = write!(out, "\n## Not measured\n\n{}", table.to_markdown());
    }
    write_whole(&pages.join(PAGE), out.as_bytes())
}

/// Returns the tables and charts of a section as Markdown, and writes the charts into `images`. Their file
/// names begin with `stem`.
fn tables_and_charts(section: &Section, title: &str, stem: &str, images: &Path) -> Result<String> {
    let mut out = String::new();
    for (table, caption) in &section.tables {
        let _ = write!(out, "\nMeasured here: {caption}\n\n{}", table.to_markdown());
    }
    for (i, (chart, caption)) in section.charts.iter().enumerate() {
        let file = format!("{stem}-{i}.svg");
        write_whole(&images.join(&file), chart.to_svg_file().as_bytes())?;
        let _ = write!(out, "\n![{title}: {caption}]({IMAGES}/{file})\n\n{caption}\n");
    }
    Ok(out)
}
