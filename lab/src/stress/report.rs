//! The report: a matrix of scenes and methods, and all failures.

use super::{Verdict, scenes};
use entire_cli::steering::contenders::ControllerKind;
use entire_io::machine::Provenance;
use entire_report::{Page, Table};

/// Table with a row per scene and a column per method: `ok`, or the first failure.
pub(crate) fn matrix(verdicts: &[Verdict], methods: &[ControllerKind]) -> Table {
    let columns: String = methods.iter().map(|m| format!(" | {}", m.name())).collect();
    let mut table = Table::headed(&format!("## | scene{columns}"));
    for (number, title) in scenes().filter(|s| verdicts.iter().any(|v| v.scene == s.0)) {
        let mut row = vec![number.to_string().into(), title.into()];
        for method in methods {
            let text = match verdicts.iter().find(|v| v.scene == number && v.method == method.name()) {
                Some(v) if v.passed() => "ok".to_owned(),
                Some(v) => v.failures[0].clone(),
                None => "-".to_owned(),
            };
            row.push(text.into());
        }
        table.row(row);
    }
    let mut row = vec!["".into(), "passed".into()];
    for method in methods {
        let mine: Vec<&Verdict> = verdicts.iter().filter(|v| v.method == method.name()).collect();
        row.push(format!("{} of {}", mine.iter().filter(|v| v.passed()).count(), mine.len()).into());
    }
    table.row(row);
    table
}

/// The report as a page.
///
/// `real` are verdicts of scenes that were also played on a real renderer, under `real_methods`.
pub(crate) fn page(
    verdicts: &[Verdict],
    methods: &[ControllerKind],
    (real, real_methods): (&[Verdict], &[ControllerKind]),
    device: &str,
) -> Page {
    let mut page = Page::new(
        "Stress scenes",
        "Scenes in which methods of holding a frame time are known to fail, on a scripted clock that is the \
         same in every run, each with a rule for passing (docs/src/stress.md).",
    );
    page.table(
        &matrix(verdicts, methods),
        "First failure of each method in each scene, or ok without a failure. T is the target; shares are of the \
         frames in which the coarsest step meets it.",
    );
    if !real.is_empty() {
        page.heading("On a real renderer");
        page.table(
            &matrix(real, real_methods),
            "The scenes that can be played on a real renderer, with images four times as wide and high and a \
             real clock. Because of the clock's noise, 5 % more of the frames may be over 1.1 T, two more in a \
             row, and quality may be lower by 0.1 than the rules say.",
        );
    }
    page.heading("All failures");
    let mut failed = Table::headed("## | method | failures");
    for v in verdicts.iter().filter(|v| !v.passed()) {
        failed.row(vec![v.scene.to_string().into(), v.method.into(), v.failures.join("; ").into()]);
    }
    page.table(&failed, "");
    page.facts(Provenance::of(device.to_owned()).facts());
    page
}
