//! The report: every table and figure of the paper beside ours, with the command that makes it. It is a page
//! of HTML, and a page of the book.

use super::bars::bars;
use super::description::{Label, Paper};
use super::interval;
use super::results::Material;
use super::section::Section;
use super::sections::section;
use super::trial_sections::{also, trials};
use crate::bars::Bar;
use anyhow::{Context, Result};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use entire_io::files::{make_folder, read_bytes, write_json, write_whole};
use entire_io::machine;
use entire_report::{Page, Table};
use serde_json::json;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Instant;

/// Writes report.html and rows.json of a report that was begun at `started`; returns the bars.
pub(crate) fn write(paper: &Paper, material: &Material, out: &Path, started: Instant) -> Result<Vec<Bar>> {
    make_folder(out)?;
    let lead = format!(
        "Every table and figure of the paper beside ours, by the paper's protocol: its rule for test \
         volumes, its frames per volume, its networks, its baselines. Errors are root mean squared errors \
         (RMSE) in seconds. Hardware and volumes differ from the paper's, so compare ratios, not seconds. {} \
         Where nothing was measured, the report names the command that measures it.",
        interval::sentence()
    );
    let mut page = Page::new(paper.title.as_str(), &lead);
    let sections: Vec<(&Label, Section)> =
        paper.labels.iter().map(|l| (l, section(paper, l, material))).collect();
    page.heading("Row by row");
    page.table(&rows_table(&sections), "");
    for (label, section) in &sections {
        page.heading(&format!("{} ({})", label.title, label.label));
        if let Some(numbers) = &label.paper {
            page.table(&numbers_table(numbers), "The paper's numbers.");
        }
        if !section.there() {
            page.paragraph(&format!("Not measured. Command: {}", label.command));
        }
        tables_and_charts(&mut page, section);
        let shot = |(file, caption): &(String, String)| Ok((picture(material, file)?, caption.clone()));
        let shots = section.pictures.iter().map(shot).collect::<Result<Vec<_>>>()?;
        if !shots.is_empty() {
            page.pictures(shots.iter().map(|(png, caption)| (png.as_slice(), caption.clone())));
        }
        for text in &section.notes {
            page.paragraph(text);
        }
        if !label.note.is_empty() {
            page.paragraph(&label.note);
        }
        page.paragraph(&format!("Command: {}", label.command));
    }
    for ([title, command, _], section) in trials(paper, material) {
        page.heading(title);
        tables_and_charts(&mut page, &section);
        page.paragraph(&format!("Command: {command}"));
    }
    let missing = sections.iter().filter(|(l, s)| !s.there() || l.command.is_empty()).count();
    let seconds = started.elapsed().as_secs_f64();
    let found = bars(paper, &material.all, missing, &material.reconstructions, seconds);
    page.heading("Bars");
    page.table(&crate::bars::table(&found), "");
    page.heading("Where the numbers come from");
    let mut facts = vec![
        ("Program", format!("entire {}", machine::version())),
        ("Date of the report", machine::now()),
        ("Results", format!("{} parts", material.all.len())),
    ];
    let mut devices: Vec<String> = material
        .all
        .iter()
        .filter(|r| !r.device.is_empty())
        .map(|r| format!("{} on {}", r.device, r.machine))
        .collect();
    devices.sort();
    devices.dedup();
    facts.push(("Rendered by", devices.join("; ")));
    page.facts(facts);
    page.write(&out.join("report.html"))?;
    let rows: Vec<serde_json::Value> = sections
        .iter()
        .map(
            |(l, s)| json!({ "label": l.label, "there": s.there(), "ours": s.summary, "command": l.command }),
        )
        .collect();
    write_json(&out.join("rows.json"), &rows)?;
    Ok(found)
}

fn tables_and_charts(page: &mut Page, section: &Section) {
    for (table, caption) in &section.tables {
        page.table(table, caption);
    }
    for (chart, caption) in &section.charts {
        page.chart(chart, caption);
    }
}

/// Bytes of a picture that a step drew or the description names.
pub(super) fn picture(material: &Material, file: &str) -> Result<Vec<u8>> {
    match material.pictures.get(file) {
        Some(drawn) => STANDARD.decode(drawn).with_context(|| format!("the kept picture {file} is damaged")),
        None => read_bytes(Path::new(file)).with_context(|| format!("cannot read the picture {file}")),
    }
}

fn rows_table(sections: &[(&Label, Section)]) -> Table {
    let mut table = Table::headed("label | title | ours | command");
    for (label, s) in sections {
        let ours = if s.there() { s.summary.as_str() } else { "not measured" };
        table.row(vec![
            label.label.as_str().into(),
            label.title.as_str().into(),
            ours.into(),
            label.command.as_str().into(),
        ]);
    }
    table
}

pub(super) fn numbers_table(numbers: &super::description::Numbers) -> Table {
    let mut table = Table::headed(&numbers.columns.join(" | #"));
    for (name, row) in &numbers.rows {
        let mut cells = vec![name.as_str().into()];
        cells.extend(row.iter().map(|v| v.map(|v| format!("{v}")).into()));
        table.row(cells);
    }
    table
}

pub(crate) const BOOK_PAGE: &str = "paper-tables.md";

/// Folder of the page's charts and pictures, relative to the page.
const IMAGES: &str = "images/paper";

/// Writes the page and its pictures into the folder of the book's pages.
pub(crate) fn write_book(paper: &Paper, material: &Material, pages: &Path) -> Result<()> {
    let images = pages.join(IMAGES);
    make_folder(&images)?;
    let mut out = String::from(
        "# The paper's tables\n\n\
         This page has every table and figure of the paper that was measured for this project. The paper's\n\
         numbers are under the words *In the paper*, and in notes that name the paper. All other numbers,\n\
         charts and pictures are of this project.\n\
         [The paper](paper.md#what-the-comparison-says) explains the results. Hardware and volumes differ\n\
         from the paper's, so compare ratios, not seconds.\n\n\
         | word | meaning |\n\
         |---|---|\n\
         | RMSE | root mean squared error, in seconds of processor time (in the study \
         on a GPU: of the GPU's time) |\n\
         | SD | standard deviation |\n\
         | run | repetition with another seed: of a training; for the mean of 15 %, of the draw of frames; \
         in fine-tuning and with a share of the training frames, also of the draw of training frames |\n\
         | the network | the paper's PredNet on features of a VolumeNet |\n\
         | ours | entire's predictor: the time of an analytic model, multiplied by a learned factor |\n\
         | mean of 15 % | constant prediction: the mean time of a random 15 % of the test frames |\n\
         | LVRP | time of rendering the volume reduced to 64³ voxels (study on a GPU: \
         24³), converted by a linear fit |\n\
         | 12C256 | PredNet with a first layer of 256 outputs, 12 layers 256 → 256, and layers of 128, 64, \
         32, 16 and 1 outputs |\n\
         | 128³F2 | VolumeNet with an input of 128³ voxels and 2 features |\n\
         | shipped encoder | VolumeNet in `models/`, trained on members of all three data sets, \
         without the test members |\n\
         | left-out member | ensemble member (one simulation) whose volumes are test data, and not training \
         data of the tested networks and encoders; volumes of m04 of Nyx and Castro were validation data of \
         the shipped encoder |\n\
         | lobes | Gaussian lobes whose sum is the opacity of the transfer function |\n\n",
    );
    let _ = write!(
        out,
        "{}\n\n\
         `make bars-paper` writes the whole report from the stored results.\n\
         `entire-lab paper report --kept data/timings/paper-results.json.gz --book docs/src` writes \
         this page.\n",
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
        out += &markdown_of(&section, &label.title, &stem, &images, &mut told)?;
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
            out += "\nPictures that an earlier section shows are not repeated here.\n";
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
        out += &markdown_of(&section, title, stem, &images, &mut told)?;
    }
    for (title, command, section) in also(paper)? {
        let _ = write!(out, "\n## {title}\n\nCommand: `{command}`.\n");
        out += &markdown_of(&section, &title, "also", &images, &mut told)?;
    }
    if !missing.is_empty() {
        let mut table = Table::headed("label | title | command");
        for label in missing {
            let command = format!("`{}`", label.command);
            table.row(vec![label.label.as_str().into(), label.title.as_str().into(), command.into()]);
        }
        let _ = write!(out, "\n## Not measured\n\n{}", table.to_markdown());
    }
    write_whole(&pages.join(BOOK_PAGE), out.as_bytes())
}

/// Returns the tables and charts of a section as Markdown, and writes the charts into `images`. Their file
/// names begin with `stem`. `told` holds the texts that the page already has. Tables in `told` are left out;
/// the function adds the other tables to `told`.
fn markdown_of(
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
        out += "\nTables that an earlier section shows are not repeated here.\n";
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
