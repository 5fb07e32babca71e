//! What the rule chooses and what nested cross-validation says of it, as paragraphs and tables.

use super::report::INTERVALS;
use super::rule::same;
use super::{Findings, Intervals, Nested, Set, Study};
use entire_cli::report::{Column, Page, Table};
use std::collections::BTreeMap;

fn percent(share: f64) -> String {
    format!("{:.1}", 100.0 * share)
}

/// How often each predictor was chosen: `selected × 3; analytic × 2`.
fn chosen(nested: &Nested) -> String {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for fold in &nested.folds {
        *counts.entry(&fold.chosen).or_default() += 1;
    }
    let mut counts: Vec<(&str, usize)> = counts.into_iter().collect();
    counts.sort_by_key(|c| std::cmp::Reverse(c.1));
    counts.iter().map(|(name, n)| format!("{name} × {n}")).collect::<Vec<_>>().join("; ")
}

/// The choices of a set, a sentence each.
pub fn choices(found: &Findings, set: &str) -> Vec<String> {
    found.choices.iter().filter(|c| c.set == set).map(super::Choice::sentence).collect()
}

/// Errors of each procedure on a set's training members, by nested cross-validation.
pub fn nested_table(found: &Findings, set: &str) -> Table {
    let mut table = Table::new(vec![
        Column::text("procedure"),
        Column::number("candidates"),
        Column::number("longest, cold µs"),
        Column::number("RMSE/SD (90 % interval)"),
        Column::number("MdAPE, % (90 % interval)"),
        Column::number("q95 held, %"),
        Column::number("slowest tenth"),
        Column::number("q95 held, every frame alike"),
        Column::text("chosen, by member left out"),
    ]);
    for n in found.nested.iter().filter(|n| n.set == set) {
        table.row(vec![
            n.what.clone().into(),
            n.candidates.to_string().into(),
            n.longest.map_or_else(|| "any".into(), |l| format!("{:.1}", 1e6 * l)).into(),
            Intervals::beside_rmse(n.intervals.as_ref(), &n.metrics).into(),
            Intervals::beside_mdape(n.intervals.as_ref(), &n.metrics).into(),
            percent(n.bound.coverage).into(),
            percent(n.bound.slowest_coverage).into(),
            percent(n.bound_by_frame.coverage).into(),
            chosen(n).into(),
        ]);
    }
    table
}

/// The same by outer part.
pub fn outer_table(found: &Findings, set: &str) -> Table {
    let mut table = Table::new(vec![
        Column::text("procedure"),
        Column::text("left out"),
        Column::text("chosen"),
        Column::number("RMSE/SD by which it was chosen"),
        Column::number("RMSE of the part left out, ms"),
        Column::number("RMSE/SD"),
        Column::number("MdAPE, %"),
        Column::number("q95 held, %"),
    ]);
    for n in found.nested.iter().filter(|n| n.set == set) {
        for fold in &n.folds {
            table.row(vec![
                n.what.clone().into(),
                fold.without.join(", ").into(),
                fold.chosen.clone().into(),
                format!("{:.3}", fold.inner.rmse_over_sd).into(),
                format!("{:.2}", 1e3 * fold.metrics.rmse).into(),
                format!("{:.3}", fold.metrics.rmse_over_sd).into(),
                percent(fold.metrics.mdape).into(),
                percent(fold.bound.coverage).into(),
            ]);
        }
    }
    table
}

/// All sets side by side, for the book: RMSE/SD and median error with their intervals, and the share of
/// frames below the upper bound; of the chosen predictors also what cross-validation and the main split say.
pub fn book_table(study: &Study, found: &Findings) -> Table {
    let mut columns = vec![Column::text("RMSE/SD (90 %) · median error, % (90 %) · below the bound, %")];
    columns.extend(study.sets.iter().map(|s| Column::text(s.name.as_str())));
    let mut table = Table::new(columns);
    let cell = |n: &Nested| {
        format!(
            "{} · {} · {}",
            Intervals::beside_rmse(n.intervals.as_ref(), &n.metrics),
            Intervals::beside_mdape(n.intervals.as_ref(), &n.metrics),
            percent(n.bound.coverage)
        )
    };
    let mut procedures: Vec<&str> = Vec::new();
    for n in &found.nested {
        if !procedures.contains(&n.what.as_str()) {
            procedures.push(&n.what);
        }
    }
    let of = |set: &Set, what: &str| found.nested.iter().find(|n| n.set == set.name && n.what == what);
    for what in procedures {
        let mut row = vec![what.into()];
        row.extend(study.sets.iter().map(|s| of(s, what).map(cell).into()));
        table.row(row);
        let mut row = vec!["… chosen, by member left out".into()];
        row.extend(study.sets.iter().map(|s| of(s, what).map(chosen).into()));
        table.row(row);
    }
    let mut lists: Vec<&str> = Vec::new();
    for c in &found.choices {
        if !lists.contains(&c.among.as_str()) {
            lists.push(&c.among);
        }
    }
    for among in lists {
        let choice = |s: &Set| found.choices.iter().find(|c| c.set == s.name && c.among == among);
        let mut row = vec![format!("chosen from all training members, {among} candidates").into()];
        row.extend(study.sets.iter().map(|s| choice(s).map(|c| c.predictor.clone()).into()));
        table.row(row);
        let mut row = vec!["… what ships".into()];
        row.extend(study.sets.iter().map(|s| {
            choice(s)
                .and_then(|c| Some(if c.same? { "the same".to_owned() } else { c.ships.clone()? }))
                .into()
        }));
        table.row(row);
        let mut row = vec!["… cross-validated, by which it was chosen".into()];
        row.extend(study.sets.iter().map(|s| {
            choice(s)
                .and_then(|c| Some((c.crossed.as_ref()?, c.crossed_intervals.as_ref())))
                .map(|(m, i)| format!("{} · {}", Intervals::beside_rmse(i, m), Intervals::beside_mdape(i, m)))
                .into()
        }));
        table.row(row);
        let mut row = vec!["… on the main split".into()];
        row.extend(study.sets.iter().map(|s| {
            let split = s.splits.iter().find(|p| p.main);
            choice(s)
                .and_then(|c| judged_as(study, found, &s.name, &split?.name, &c.predictor))
                .map(|r| {
                    let held = r.bound.as_ref().map_or_else(|| "-".into(), |b| percent(b.coverage));
                    format!(
                        "{} · {} · {held}",
                        Intervals::beside_rmse(r.intervals.as_ref(), &r.metrics),
                        Intervals::beside_mdape(r.intervals.as_ref(), &r.metrics)
                    )
                })
                .into()
        }));
        table.row(row);
    }
    table
}

/// A predictor's result, or that of the study's predictor that has the same recipe: a candidate of the grid
/// that the study names too is judged once.
fn judged_as<'a>(
    study: &Study,
    found: &'a Findings,
    set: &str,
    split: &str,
    predictor: &str,
) -> Option<&'a super::SplitResult> {
    found.of(set, split, predictor).or_else(|| {
        let grid = study.grid_predictors().ok()?;
        let named = grid.iter().find(|p| p.name == predictor)?;
        let same = study.predictors.iter().find(|p| same(p.recipe_for(set), &named.recipe))?;
        found.of(set, split, &same.name)
    })
}

/// What the grid is, a line each.
pub fn grid_lines(study: &Study) -> Vec<String> {
    study.grid.iter().map(super::Grid::sentence).collect()
}

/// The part of a card that is about the choice.
pub fn on_card(found: &Findings, set: &str) -> String {
    let mut md: String = choices(found, set).iter().map(|text| format!("\n{text}\n")).collect();
    let mut nested = found.nested.iter().filter(|n| n.set == set).peekable();
    if nested.peek().is_some() {
        md += "\nNested cross-validation (`make study-nested`): choice, fit and upper bound follow from the \
               other training members alone, then the member left out is predicted.\n\n\
               | procedure | RMSE/SD (90 %) | MdAPE, % (90 %) | q95 held, % | chosen, by member left out |\n\
               |---|---|---|---|---|\n";
    }
    for n in nested {
        let cells = [
            n.what.clone(),
            Intervals::beside_rmse(n.intervals.as_ref(), &n.metrics),
            Intervals::beside_mdape(n.intervals.as_ref(), &n.metrics),
            percent(n.bound.coverage),
            chosen(n),
        ];
        md += &format!("| {} |\n", cells.join(" | "));
    }
    md
}

/// The part of a set's page that is about the choice.
pub(super) fn on_page(page: &mut Page, study: &Study, found: &Findings, set: &Set) {
    for text in choices(found, &set.name) {
        page.paragraph(&text);
    }
    if !found.nested.iter().any(|n| n.set == set.name) {
        return;
    }
    page.heading(&format!("{}: nested cross-validation", set.name));
    page.paragraph(
        "One ensemble member after another is left out, and the whole procedure runs on the others: every \
         candidate is cross-validated there, the rule chooses, the chosen recipe is fitted, its upper bound \
         follows from the same cross-validation; then it predicts the member left out. No test frame has a \
         part in it. Latencies are those of this study.",
    );
    if study.grid.is_empty() {
        page.paragraph(
            "The named candidates are the predictors of the study's description. That list was drawn up by \
             hand, with the test members in view.",
        );
    } else {
        page.paragraph(&format!(
            "The named candidates are the predictors of the study's description: a list drawn up by hand, \
             with the test members in view. The candidates of the grid are all combinations of: {}.",
            grid_lines(study).join("; ")
        ));
    }
    page.table(&nested_table(found, &set.name), INTERVALS);
    page.table(&outer_table(found, &set.name), "By member left out.");
}
