//! The report: a matrix of scenes and methods, charts, rules, and all failures.

use super::{Verdict, scenes};
use entire_cli::steering::contenders::ControllerKind;
use entire_cli::steering::report::color;
use entire_io::machine::Provenance;
use entire_report::{Axis, Chart, Column, Mark, Page, Rule, Series, Table};

fn of(verdicts: &[Verdict], scene: usize, method: ControllerKind) -> Option<&Verdict> {
    verdicts.iter().find(|v| v.scene == scene && v.method == method.name())
}

/// Number, description and rule of the scenes that were played.
fn played(verdicts: &[Verdict]) -> impl Iterator<Item = (usize, &'static str, &'static str)> {
    scenes().filter(move |s| verdicts.iter().any(|v| v.scene == s.0))
}

/// Table with a row per scene and a column per method: `ok`, or the first failure.
pub(crate) fn matrix(verdicts: &[Verdict], methods: &[ControllerKind]) -> Table {
    let mut columns = vec![Column::number("#"), Column::text("scene")];
    columns.extend(methods.iter().map(|m| Column::text(m.name())));
    let mut table = Table::new(columns);
    for (number, title, _) in played(verdicts) {
        let mut row = vec![number.to_string().into(), title.into()];
        for method in methods {
            let text = match of(verdicts, number, *method) {
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
         same in every run, each with a rule for passing.",
    );
    page.table(
        &matrix(verdicts, methods),
        "First failure of each method in each scene, or ok without a failure. T is the target; shares are of the \
         frames in which the coarsest step meets it.",
    );
    let names: Vec<String> = played(verdicts).map(|s| s.0.to_string()).collect();
    let mut chart =
        Chart::new("Worst frame", Axis::categories("scene", names.clone()), Axis::log("largest t / T"))
            .size(900.0, 340.0)
            .rule(Rule::Horizontal(1.1, "1.1 T".into()));
    let mut misses = Chart::new(
        "Misses",
        Axis::categories("scene", names.clone()),
        Axis::linear("frames over 1.1 T / %").from(0.0),
    )
    .size(900.0, 340.0);
    for method in methods {
        let points = |f: &dyn Fn(&Verdict) -> f64| -> Vec<(f64, f64, String)> {
            names
                .iter()
                .enumerate()
                .filter_map(|(slot, n)| {
                    let v = of(verdicts, n.parse().ok()?, *method)?;
                    let y = f(v);
                    y.is_finite().then(|| (slot as f64, y, String::new()))
                })
                .collect()
        };
        let hue = color(method.name());
        chart = chart.series(
            Series::new(
                method.title(),
                Mark::Points(points(&|v| if v.worst > 0.0 { v.worst } else { f64::NAN })),
            )
            .color(hue),
        );
        misses = misses
            .series(Series::new(method.title(), Mark::Points(points(&|v| 100.0 * v.missed))).color(hue));
    }
    page.chart(&chart, "Time of the slowest frame of each scene, divided by its target, per method.");
    page.chart(&misses, "Share of the feasible frames that took over 1.1 times the target.");
    if !real.is_empty() {
        page.heading("On a real renderer");
        page.table(
            &matrix(real, real_methods),
            "The scenes that can be played on a real renderer, with images four times as wide and high and a \
             real clock. Because of the clock's noise, 5 % more of the frames may be over 1.1 T, two more in a \
             row, and quality may be lower by 0.1 than the rules below say.",
        );
    }
    page.heading("Rules");
    let mut rules = Table::headed("## | scene | passes when");
    for (number, title, rule) in scenes() {
        rules.row(vec![number.to_string().into(), title.into(), rule.into()]);
    }
    page.table(
        &rules,
        "\"At most 5 % over 1.1 T\": at most 5 % of the frames take longer than 1.1 T. The bound is the \
         upper bound that was predicted before the frame. \"Quality\" is the least accepted mean ratio of \
         the oracle's step to the chosen step.",
    );
    page.heading("All failures");
    let mut failed = Table::headed("## | method | failures");
    for v in verdicts.iter().filter(|v| !v.passed()) {
        failed.row(vec![v.scene.to_string().into(), v.method.into(), v.failures.join("; ").into()]);
    }
    page.table(&failed, "");
    page.facts(Provenance::of(device.to_owned()).facts());
    page
}
