//! The book's page of the paper's tables and figures: the report in Markdown, with its charts beside it.

use super::description::{Label, Paper};
use super::interval;
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

pub(crate) const PAGE: &str = "paper-tables.md";

/// Folder of the page's charts and pictures, relative to the page.
const IMAGES: &str = "images/paper";

/// Writes the page and its pictures into the folder of the book's pages.
pub(crate) fn write(paper: &Paper, material: &Material, pages: &Path) -> Result<()> {
    let images = pages.join(IMAGES);
    make_folder(&images)?;
    let mut out = String::from(
        "# The paper's tables\n\n\
         This page has every table and figure of the paper that was measured for this project. The words\n\
         *In the paper* stand above the paper's numbers; all other numbers, charts and pictures are ours.\n\
         [The paper](paper.md#what-the-comparison-says) explains the results. Hardware and volumes differ\n\
         from the paper's, so compare ratios, not seconds.\n\n\
         | word | meaning |\n\
         |---|---|\n\
         | RMSE | root mean squared error, in seconds of processor time |\n\
         | SD | standard deviation |\n\
         | run | one of several trainings that differ in the seed |\n\
         | the network | the paper's PredNet on features of a VolumeNet |\n\
         | ours | entire's predictor: the time of an analytic model, multiplied by a learned factor |\n\
         | mean of 15 % | constant prediction: the mean time of a random 15 % of the test frames |\n\
         | LVRP | time of rendering the volume reduced to 64³ voxels, scaled by a linear fit |\n\
         | 12C256 | PredNet with 12 layers 256 → 256, before layers that narrow to one output |\n\
         | 128³F2 | VolumeNet with an input of 128³ voxels and 2 features |\n\n",
    );
    let _ = write!(
        out,
        "{}\n\n\
         `make bars-paper` writes the whole report from the results that are kept in the repository.\n\
         `entire-lab paper report --kept data/timings/paper-results.json.gz --book docs/src` writes this page.\n",
        interval::sentence()
    );
    let mut missing: Vec<&Label> = Vec::new();
    let mut told: BTreeSet<String> = BTreeSet::new();
    for label in &paper.labels {
        let section = section(paper, label, material);
        if !section.there() {
            missing.push(label);
            continue;
        }
        let _ = write!(
            out,
            "\n## {}\n\nLabel in the paper: `{}`. Command: `{}`.\n",
            label.title, label.label, label.command
        );
        if let Some(numbers) = &label.paper {
            let _ = write!(out, "\nIn the paper:\n\n{}", numbers_table(numbers).to_markdown());
        }
        let stem = label.label.replace(':', "-");
        out += &tables_and_charts(&section, &label.title, &stem, &images, &mut told)?;
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
            out.push('\n');
            for caption in drawn {
                let _ = write!(out, "\n{caption}.\n");
            }
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
    for ([title, command, stem], section) in trials(paper, material) {
        let _ = write!(out, "\n## {title}\n\nCommand: `{command}`.\n");
        out += &tables_and_charts(&section, title, stem, &images, &mut told)?;
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
/// names begin with `stem`. `told` has the texts that are on the page; the tables are added to it.
fn tables_and_charts(
    section: &Section,
    title: &str,
    stem: &str,
    images: &Path,
    told: &mut BTreeSet<String>,
) -> Result<String> {
    let mut out = String::new();
    let mut repeated = false;
    for (table, caption) in &section.tables {
        let text = format!("\n{caption}\n\n{}", table.to_markdown());
        if told.insert(text.clone()) {
            out += &text;
        } else {
            repeated = true;
        }
    }
    if repeated {
        out += "\nThe tables of this section are shown further up.\n";
    }
    for (i, (chart, caption)) in section.charts.iter().enumerate() {
        let file = format!("{stem}-{i}.svg");
        write_whole(&images.join(&file), chart.to_svg_file().as_bytes())?;
        let _ = write!(out, "\n![{title}: {caption}]({IMAGES}/{file})\n");
        // Neighboring charts with the same caption share it.
        if section.charts.get(i + 1).is_none_or(|(_, next)| next != caption) {
            let _ = write!(out, "\n{caption}\n");
        }
    }
    Ok(out)
}
