//! The report: every table and figure of the paper beside ours, with the command that makes it.

use super::bars::bars;
use super::description::{Label, Paper};
use super::interval;
use super::material::Material;
use super::section::Section;
use super::sections::{section, trials};
use crate::bars::Bar;
use anyhow::{Context, Result};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use entire_io::files::{make_folder, read_bytes, write_json};
use entire_io::machine;
use entire_report::{Page, Table};
use serde_json::json;
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
