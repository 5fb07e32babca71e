//! The report of a study: accuracy against latency first, then tables.

use super::bars::{bars, models};
use super::rule::{MAX_ERROR_RATIO, SENTENCE, by_rule};
use super::{CALIBRATION_FRAMES, CONSTANT, Findings, Intervals, PROXY, Set, SplitResult, Study};
use anyhow::Result;
use entire_io::files::{make_folder, write_json, write_whole};
use entire_io::machine;
use entire_io::metrics::BoundMetrics;
use entire_report::{Axis, Chart, Mark, Page, Rule, Series, Table};
use std::path::Path;

/// Definition of the intervals, for captions.
pub(super) const INTERVALS: &str = "Each interval holds the errors of 90 % of 200 draws of the volumes, with \
                                    replacement. Intervals are wide if a few frames have most of the squared \
                                    error.";

/// Caption of the chart of a group.
const CHART: &str = "Points further down and left are better. A point is the geometric mean of the errors on all machines \
                     on which the predictor was tested. The number after a name counts the fitted parameters. The \
                     frontier joins predictors whose error is at least 5 % lower than that of all faster ones; a \
                     thin line has the errors of these predictors on one machine.";

/// Errors, bounds and latencies of every predictor on a split, or of those in `panel` and the baselines.
pub(crate) fn main_table(found: &Findings, set: &str, split: &str, panel: Option<&str>) -> Table {
    let mut table = Table::headed(
        "predictor | #RMSE, ms | #RMSE/SD | #90 % interval | #median error, % | #90 % interval | #p95, % | \
         #p99, % | #R² in log | #below the upper bound, % | #… in the slowest tenth, % | #pinball loss | \
         #cold latency, µs | #work per transfer function, µs",
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

/// Table of the errors on training frames, in cross-validation, and on the main split, each with its interval
/// over volumes, and of the error by which the rule compares predictors.
pub(crate) fn fits_table(study: &Study, found: &Findings, set: &str, split: &str) -> Table {
    let mut table = Table::headed(
        "predictor | #RMSE/SD (90 %), training frames | #… cross-validated | #… test | \
         #median error % (90 %), training frames | #… cross-validated | #… test | \
         #geometric mean of both, cross-validated, without noise | #fitted parameters | \
         #cold latency, µs | rule",
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
        row.push(f.error().map(|error| format!("{error:.4}")).into());
        row.extend([(f.numbers > 0).then(|| f.numbers.to_string()).into(), cold.into(), says.into()]);
        table.row(row);
    }
    table
}

/// A predictor in the chart of a group: cold latency in µs, and median error in percent on each machine
/// (`None` where the predictor was not tested).
struct Plotted<'a> {
    name: &'a str,
    cold: f64,
    errors: Vec<Option<f64>>,
}

impl Plotted<'_> {
    /// Geometric mean of the errors.
    fn mean(&self) -> f64 {
        let logs: Vec<f64> = self.errors.iter().flatten().map(|e| e.ln()).collect();
        (logs.iter().sum::<f64>() / logs.len() as f64).exp()
    }
}

/// Chart of a group's predictors on the main split: error against latency, with the number of fitted
/// parameters.
fn frontier(study: &Study, found: &Findings, set: &Set, split: &str) -> Chart {
    let group: Vec<&Set> = study.group(set).collect();
    let mut places: Vec<Plotted<'_>> = models(found, &set.name, split)
        .filter_map(|r| {
            let name = r.predictor.as_str();
            let percent = |s: &&Set| Some(100.0 * found.of(&s.name, split, name)?.metrics.mdape);
            let cold = 1e6 * found.latency(&set.name, name)?.cold;
            Some(Plotted { name, cold, errors: group.iter().map(percent).collect() })
        })
        .collect();
    places.sort_by(|a, b| a.cold.total_cmp(&b.cold));
    let mut front: Vec<&Plotted<'_>> = Vec::new();
    for place in places.iter().filter(|p| p.errors.iter().all(Option::is_some)) {
        if front.last().is_none_or(|last| place.mean() < MAX_ERROR_RATIO * last.mean()) {
            front.push(place);
        }
    }
    // Only the frontier, the selected predictor and the references, which the rule cannot select, are
    // labeled; more labels would overlap.
    let selected = found.selected.get(&set.name);
    let reference = |name: &str| study.predictors.iter().any(|p| p.name == name && !p.cross_validated);
    let named = |place: &Plotted<'_>| {
        let &Plotted { name, cold, .. } = place;
        let chosen = selected.is_some_and(|s| s == name);
        let mut text = String::new();
        if chosen || front.iter().any(|f| f.name == name) || reference(name) {
            text = name.to_owned();
            if let Some(fit) = found.fit(&set.name, name).filter(|fit| fit.numbers > 0) {
                text += &format!(": {}", fit.numbers);
            }
            text += if chosen { " (selected)" } else { "" };
        }
        (cold, place.mean(), text)
    };
    let mut chart = Chart::new(
        format!(
            "{}: error, latency and number of fitted parameters",
            set.group.as_ref().unwrap_or(&set.name)
        ),
        Axis::log("cold latency, features included, µs"),
        Axis::log("median error, %"),
    )
    .size(860.0, 420.0);
    if group.len() > 1 {
        for (k, one) in group.iter().enumerate() {
            let line = front.iter().filter_map(|p| Some((p.cold, p.errors[k]?))).collect();
            let machine = one.machine.as_ref().unwrap_or(&one.name);
            chart = chart.series(Series::new(machine, Mark::Line(line)).color(2 + k).thin());
        }
    }
    let steps = front.iter().map(|p| (p.cold, p.mean())).collect();
    let name = if group.len() > 1 { "frontier of the mean" } else { "frontier" };
    chart = chart
        .series(Series::new(name, Mark::Steps(steps)).color(0))
        .series(Series::new("predictors", Mark::Points(places.iter().map(named).collect())).color(1));
    for (i, name) in [CONSTANT, PROXY].into_iter().enumerate() {
        if let Some(r) = found.of(&set.name, split, name) {
            let short = if i == 0 { "constant" } else { "LVRP" };
            chart = chart.rule(Rule::Horizontal(100.0 * r.metrics.mdape, short.into()));
        }
    }
    chart
}

/// Writes the report of a study into a folder: report.html, study.json and the charts as SVG.
pub(crate) fn write(out: &Path, study: &Study, found: &Findings) -> Result<()> {
    make_folder(out)?;
    write_json(&out.join("study.json"), &serde_json::json!({ "study": study, "findings": found }))?;
    let mut page = Page::new(
        study.title.as_str(),
        &format!(
            "Every predictor is trained only on the training tables of a data set, and tested on each \
             split. A frame's time is the median of its repeats by the clock {:?}. Latency is \
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
        for split in &set.splits {
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
            if split.main && study.group(set).next().is_some_and(|first| first.name == set.name) {
                let chart = frontier(study, found, set, p);
                let file = format!("frontier-{}.svg", s.replace(' ', "-"));
                write_whole(&out.join(file), chart.to_svg_file().as_bytes())?;
                page.chart(&chart, CHART);
            }
            page.table(&main_table(found, s, p, Some("main")), INTERVALS);
            for panel in ["ablation", "architecture"] {
                if found.results.iter().any(|r| r.set == s && r.split == p && r.panel == panel) {
                    page.table(&main_table(found, s, p, Some(panel)), panel);
                }
            }
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
            page.table(
                &table,
                &format!(
                    "The volumes are in two halves. Each half is predicted after a calibration to \
                     {CALIBRATION_FRAMES} frames of the other half; the errors are those of both halves \
                     together."
                ),
            );
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
