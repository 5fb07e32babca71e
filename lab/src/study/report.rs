//! The report of a study: accuracy against latency first, then tables.

use super::bars::{DISTILLED, PAPER, bars, models};
use super::rule::{SENTENCE, by_rule};
use super::{CALIBRATION_FRAMES, CONSTANT, Findings, Intervals, PROXY, SplitResult, Study};
use anyhow::Result;
use entire_io::files::{make_folder, write_json, write_whole};
use entire_io::machine;
use entire_io::metrics::BoundMetrics;
use entire_report::{Axis, Chart, Mark, Page, Rule, Series, Table, bias_table};
use std::path::Path;

/// Definition of the intervals, for captions.
pub(super) const INTERVALS: &str = "Each interval holds the errors of 90 % of 200 draws of the volumes, with \
                                    replacement. Intervals are wide if a few frames have most of the squared \
                                    error.";

/// Table of the errors, bounds and latencies of every predictor on a split. If `panel` is given, only of the predictors
/// listed there and of the baselines.
pub(crate) fn main_table(found: &Findings, set: &str, split: &str, panel: Option<&str>) -> Table {
    let mut table = Table::headed(
        "predictor | #RMSE, ms | #RMSE/SD | #90 % interval | #median error, % | #90 % interval | #p95, % | \
         #p99, % | #R² in log | #below the upper bound, % | #slowest tenth | #pinball | #cold µs | \
         #per transfer function",
    );
    let rows: Vec<&SplitResult> = found
        .results
        .iter()
        .filter(|r| {
            r.set == set && r.split == split && panel.is_none_or(|p| r.panel == p || r.panel == "baseline")
        })
        .collect();
    let interval =
        |i: Option<(f64, f64)>, f: &dyn Fn(f64) -> String| i.map(|(a, b)| format!("{}–{}", f(a), f(b)));
    let percent = |v: f64| format!("{:.1}", 100.0 * v);
    for r in &rows {
        let m = &r.metrics;
        let bound = |f: &dyn Fn(&BoundMetrics) -> String| r.bound.as_ref().map(f);
        let latency = found.latency(set, &r.predictor);
        table.row(vec![
            r.predictor.clone().into(),
            format!("{:.2}", 1e3 * m.rmse).into(),
            format!("{:.3}", m.rmse_over_sd).into(),
            interval(r.intervals.map(|i| i.rmse_over_sd), &|v| format!("{v:.3}")).into(),
            percent(m.mdape).into(),
            interval(r.intervals.map(|i| i.mdape), &percent).into(),
            percent(m.p95).into(),
            percent(m.p99).into(),
            format!("{:.4}", m.r2_log).into(),
            bound(&|b| percent(b.coverage)).into(),
            bound(&|b| percent(b.slowest_coverage)).into(),
            bound(&|b| format!("{:.4}", b.pinball)).into(),
            latency.map(|l| format!("{:.2}", 1e6 * l.cold)).into(),
            latency.map(|l| format!("{:.1}", 1e6 * l.transfer)).into(),
        ]);
    }
    let values = |f: fn(&SplitResult) -> f64| rows.iter().map(|r| f(r)).collect::<Vec<f64>>();
    table.mark_best(2, &values(|r| r.metrics.rmse_over_sd), true);
    table.mark_best(4, &values(|r| r.metrics.mdape), true);
    table.mark_best(8, &values(|r| r.metrics.r2_log), false);
    table
}

/// Table of the errors on training frames, in cross-validation, and on the main split, each with its interval over
/// volumes.
pub(crate) fn fits_table(study: &Study, found: &Findings, set: &str, split: &str) -> Table {
    let mut table = Table::headed(
        "predictor | #RMSE/SD (90 %), training frames | #… cross-validated | #… test | \
         #median error % (90 %), training frames | #… cross-validated | #… test | #fitted parameters | \
         #cold µs | rule",
    );
    let rule = by_rule(study, found, set).map(|p| p.name.as_str());
    for f in found.fits.iter().filter(|f| f.set == set) {
        let shown = |r: &&SplitResult| r.panel == "main";
        let Some(test) = found.of(set, split, &f.predictor).filter(shown) else { continue };
        let cold = found.latency(set, &f.predictor).map(|l| format!("{:.1}", 1e6 * l.cold));
        let says = if rule == Some(f.predictor.as_str()) { "selected" } else { "" };
        let columns = [
            (Some(&f.seen), f.seen_intervals.as_ref()),
            (f.crossed.as_ref(), f.crossed_intervals.as_ref()),
            (Some(&test.metrics), test.intervals.as_ref()),
        ];
        let mut row = vec![f.predictor.clone().into()];
        row.extend(columns.map(|(m, i)| m.map(|m| Intervals::beside_rmse(i, m)).into()));
        row.extend(columns.map(|(m, i)| m.map(|m| Intervals::beside_mdape(i, m)).into()));
        row.extend([(f.numbers > 0).then(|| f.numbers.to_string()).into(), cold.into(), says.into()]);
        table.row(row);
    }
    table
}

/// Chart of accuracy against latency, and a table of the predictors on the frontier with the gain per microsecond.
fn frontier(found: &Findings, set: &str, split: &str) -> (Chart, Table) {
    let mut points: Vec<(f64, f64, f64, String)> = models(found, set, split)
        .filter_map(|r| {
            Some((
                1e6 * found.latency(set, &r.predictor)?.cold,
                100.0 * r.metrics.mdape,
                r.metrics.rmse_over_sd,
                r.predictor.clone(),
            ))
        })
        .collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut front: Vec<&(f64, f64, f64, String)> = Vec::new();
    for p in &points {
        if front.last().is_none_or(|l| p.2 < l.2) {
            front.push(p);
        }
    }
    // Only predictors on the frontier, the selected one and the paper's networks are labeled: other points are too
    // close to each other.
    let selected = found.selected.get(set);
    let named = |p: &(f64, f64, f64, String)| {
        let name = front.iter().any(|f| f.3 == p.3) || [PAPER, DISTILLED].contains(&p.3.as_str());
        let text = match () {
            () if selected == Some(&p.3) => format!("{} (selected)", p.3),
            () if name => p.3.clone(),
            () => String::new(),
        };
        (p.0, p.2, text)
    };
    let mut chart = Chart::new(
        format!("{set}, split by {split}"),
        Axis::log("cold latency, features included, µs"),
        Axis::log("RMSE / SD"),
    )
    .size(860.0, 380.0)
    .series(Series::new("frontier", Mark::Steps(front.iter().map(|p| (p.0, p.2)).collect())).color(0))
    .series(Series::new("predictors", Mark::Points(points.iter().map(named).collect())).color(1));
    for (i, name) in [CONSTANT, PROXY].into_iter().enumerate() {
        if let Some(r) = found.of(set, split, name) {
            let short = if i == 0 { "constant" } else { "LVRP" };
            chart = chart.rule(Rule::Horizontal(r.metrics.rmse_over_sd, short.into()));
        }
    }
    let mut knee = Table::headed(
        "on the frontier | #cold µs | #RMSE/SD | #median error, % | #RMSE/SD gained per additional µs",
    );
    let mut before: Option<&(f64, f64, f64, String)> = None;
    for p in front {
        let gain = before.map(|b| format!("{:.4}", (b.2 - p.2) / (p.0 - b.0).max(1e-9)));
        knee.row(vec![
            p.3.clone().into(),
            format!("{:.2}", p.0).into(),
            format!("{:.3}", p.2).into(),
            format!("{:.1}", p.1).into(),
            gain.into(),
        ]);
        before = Some(p);
    }
    (chart, knee)
}

fn parts_table(found: &Findings, set: &str, split: &str) -> Table {
    let rows: Vec<&SplitResult> = models(found, set, split).collect();
    let mut names: Vec<&str> = Vec::new();
    for (name, _) in rows.iter().flat_map(|r| &r.parts) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    let columns: String = names.iter().map(|n| format!(" | #median error %, {n}")).collect();
    let mut table = Table::headed(&format!("predictor{columns}"));
    for r in rows {
        let mut row = vec![r.predictor.clone().into()];
        for name in &names {
            let m = r.parts.iter().find(|(n, _)| n == name).map(|(_, m)| m);
            row.push(m.map(|m| format!("{:.1} ({} frames)", 100.0 * m.mdape, m.frames)).into());
        }
        table.row(row);
    }
    table
}

fn spread(found: &Findings, set: &str, split: &str) -> Chart {
    let rows: Vec<&SplitResult> = models(found, set, split).collect();
    let names = rows.iter().map(|r| r.predictor.clone()).collect();
    // The boxes' axis is the ratio predicted / measured.
    let boxes = rows
        .iter()
        .enumerate()
        .map(|(i, r)| {
            let [_, a, b, c, d, e, _] = r.log_errors.map(f64::exp);
            (i as f64, [a, b, c, d, e])
        })
        .collect();
    Chart::new(
        format!("Predicted over measured: {set}, split by {split}"),
        Axis::categories("predictor", names),
        Axis::log("predicted / measured"),
    )
    .rule(Rule::Horizontal(1.0, "exact".into()))
    .series(Series::new("5th, 25th, 50th, 75th, 95th percentile", Mark::Boxes(boxes)).color(0))
}

/// Writes the report of a study into a folder: report.html, study.json and the charts as SVG.
///
/// # Errors
/// When a file cannot be written.
pub(crate) fn write(out: &Path, study: &Study, found: &Findings) -> Result<()> {
    make_folder(out)?;
    let put = |name: &str, text: &str| write_whole(&out.join(name), text.as_bytes());
    write_json(&out.join("study.json"), &serde_json::json!({ "study": study, "findings": found }))?;
    let mut page = Page::new(
        study.title.as_str(),
        &format!(
            "Every predictor is trained on the training tables of a data set only and tested on other \
             splits. A frame's time is the median of its repeats by the clock {:?}. Latency is \
             measured on one thread, with caches evicted before every call. It includes the scene features but \
             not the work per volume. The work per transfer function has its own column.",
            study.clock
        ),
    );
    page.heading("Bars");
    page.table(&crate::bars::table(&bars(study, found)), "");
    for set in &study.sets {
        if let Some(split) = set.splits.iter().find(|s| s.main) {
            page.heading(&format!("{}: training frames, cross-validation, test", set.name));
            page.table(
                &fits_table(study, found, &set.name, &split.name),
                &format!(
                    "Cross-validated: every training frame is predicted by a model that was trained without the \
                     frame's ensemble member. Upper bounds follow from these errors; all members have the same \
                     weight. {SENTENCE} {INTERVALS}"
                ),
            );
        }
        for (i, split) in set.splits.iter().enumerate() {
            let (s, p) = (set.name.as_str(), split.name.as_str());
            page.heading(&format!("{s}: split by {p}"));
            if let Some((_, _, n, frames)) = found.noise.iter().find(|n| n.0 == s && n.1 == p) {
                page.paragraph(&format!(
                    "{frames} frames. Noise floor: {}; perfect predictions would have a median error of about \
                     {:.1} %.",
                    n.describe(),
                    100.0 * found.noise_mdape(s, p)
                ));
            }
            let (chart, knee) = frontier(found, s, p);
            put(
                &format!("frontier-{}-{}.svg", s.replace(' ', "-"), p.replace(' ', "-")),
                &chart.to_svg_file(),
            )?;
            page.chart(
                &chart,
                "Points further down and left are better. The frontier joins predictors that are better than all \
                 faster ones.",
            );
            page.table(&knee, "");
            page.table(&main_table(found, s, p, Some("main")), INTERVALS);
            for panel in ["ablation", "architecture"] {
                if found.results.iter().any(|r| r.set == s && r.split == p && r.panel == panel) {
                    page.table(&main_table(found, s, p, Some(panel)), panel);
                }
            }
            let boxes = spread(found, s, p);
            put(&format!("errors-{}-{}.svg", s.replace(' ', "-"), i + 1), &boxes.to_svg_file())?;
            page.chart(&boxes, "");
            let rows: Vec<_> = models(found, s, p).map(|r| (r.predictor.as_str(), &r.metrics)).collect();
            page.table(
                &bias_table(&rows),
                "Median of predicted / measured - 1, in %, for each tenth of the frames, from the fastest to the \
                 slowest.",
            );
            page.table(
                &parts_table(found, s, p),
                "Errors by image size, and of frames whose eye is near or inside the volume.",
            );
        }
        let calibrated: Vec<_> = found.calibrated.iter().filter(|c| c.set == set.name).collect();
        if !calibrated.is_empty() {
            page.heading(&format!("{}: calibrated to {CALIBRATION_FRAMES} frames of other data", set.name));
            let mut table = Table::headed("predictor | data | #RMSE/SD | #median error, %");
            for c in calibrated {
                table.row(vec![
                    c.predictor.clone().into(),
                    c.split.clone().into(),
                    format!("{:.3}", c.metrics.rmse_over_sd).into(),
                    format!("{:.1}", 100.0 * c.metrics.mdape).into(),
                ]);
            }
            page.table(&table, "Errors on each half of the volumes after a calibration to the other half.");
        }
    }
    if !found.left_out.is_empty() {
        page.heading("Left out");
        for (set, what, why) in &found.left_out {
            page.paragraph(&format!("{set}, {what}: {why}"));
        }
    }
    page.heading("Where the numbers come from");
    let load = machine::load_average()
        .map_or("not known".into(), |l| format!("{:.2} {:.2} {:.2}", l[0], l[1], l[2]));
    page.facts([
        ("Program", format!("entire {}", machine::version())),
        ("Machine (latencies)", machine::machine()),
        ("Date", machine::now()),
        ("Load average", load),
    ]);
    page.write(&out.join("report.html"))
}
