//! `entire-lab study`: a whole study in one report, accuracy against latency first.

use crate::bars::Bar;
use crate::study::{
    CALIBRATION_FRAMES, CONSTANT, Findings, Named, PROXY, Point, Runner, SplitResult, Study, read,
};
use anyhow::{Context, Result, ensure};
use entire_cli::interrupt;
use entire_cli::machine;
use entire_cli::metrics::Metrics;
use entire_cli::options::thread_pool;
use entire_cli::progress::templated_bar;
use entire_cli::report::{Axis, Chart, Column, Mark, Page, Rule, Series, Table};
use std::path::{Path, PathBuf};

/// Make and judge every predictor of a study; write one report: accuracy against latency, tables, curves.
///
/// Predictors that were made before of the same data are taken from OUT/models, so that a study that was stopped goes
/// on where it was.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  entire-lab study --study data/timings/study.json --out out/study
  entire-lab study --study study.json --only selected,paper --bars")]
pub struct Options {
    /// The study: data sets, splits and predictors as JSON.
    #[arg(long, value_name = "JSON")]
    pub study: PathBuf,
    /// Folder for report.html, study.json, the charts as SVG and the models.
    #[arg(long, value_name = "FOLDER", default_value = "out/study")]
    pub out: PathBuf,
    /// Only these predictors.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    pub only: Vec<String>,
    /// Only these data sets.
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    pub sets: Vec<String>,
    /// Print one line per bar, `bar NAME VALUE LIMIT ok|short`, and fail when one is short.
    ///
    /// The value is - where what the bar is about is missing.
    #[arg(long)]
    pub bars: bool,
    /// Write the predictors that the study ships, each with its card, into this folder.
    #[arg(long, value_name = "FOLDER", conflicts_with = "only")]
    pub ship: Option<PathBuf>,
    /// Threads; all logical processors unless given.
    #[arg(long)]
    pub threads: Option<usize>,
    /// No progress bar.
    #[arg(long)]
    pub quiet: bool,
}

/// Runs the command.
///
/// # Errors
/// When the study or its tables cannot be read, a file cannot be written, or, with `--bars`, one is short.
pub fn run(options: &Options) -> Result<()> {
    let mut study = read(&options.study)?;
    if !options.only.is_empty() {
        study.predictors.retain(|p| options.only.contains(&p.name));
        let kept: Vec<String> = study.predictors.iter().map(|p| p.name.clone()).collect();
        study.curves.retain(|c| kept.contains(c));
        ensure!(!kept.is_empty(), "--only names no predictor of {}", options.study.display());
    }
    if !options.sets.is_empty() {
        study.sets.retain(|s| options.sets.contains(&s.name));
        ensure!(!study.sets.is_empty(), "--sets names no data set of {}", options.study.display());
    }
    let pool = thread_pool(options.threads)?;
    let stop = interrupt::flag()?;
    let bar = templated_bar(options.quiet, "study [{bar:30}] {pos}/{len} {msg}");
    let stopped = || interrupt::requested(&stop);
    let runner = Runner { pool: &pool, models: options.out.join("models"), bar: &bar, stop: &stopped };
    let found = runner.run(&study)?;
    bar.finish_and_clear();
    for (set, what, why) in &found.left_out {
        eprintln!("note: {set}, {what}: left out ({why})");
    }
    write(&options.out, &study, &found)?;
    if let Some(folder) = &options.ship {
        ensure!(!study.ship.is_empty(), "{} ships nothing", options.study.display());
        for path in crate::ship::ship(folder, &study, &found, &runner)? {
            println!("wrote {}", path.display());
        }
    }
    for set in &study.sets {
        if let Some(split) = set.splits.iter().find(|s| s.main) {
            println!("{}: frames learned from, cross-validation, test", set.name);
            println!("{}", fits_table(&study, &found, &set.name, &split.name).to_text());
        }
        for split in &set.splits {
            println!("{}, split by {}", set.name, split.name);
            println!("{}", main_table(&found, &set.name, &split.name, None).to_text());
        }
    }
    let mut short = 0;
    if options.bars {
        let bars = bars(&study, &found);
        bars.iter().for_each(|b| println!("{b}"));
        short = bars.iter().filter(|b| !b.ok).count();
    }
    println!("wrote {}", options.out.join("report.html").display());
    ensure!(short == 0, "{short} of the bars above are short");
    Ok(())
}

/// The predictor of a study that most bars are about.
const SELECTED: &str = "selected";

/// The paper's network where it is distilled from another predictor.
const DISTILLED: &str = "distilled";

/// The predictors with a model file, main panel.
fn models<'a>(found: &'a Findings, set: &'a str, split: &'a str) -> impl Iterator<Item = &'a SplitResult> {
    found.results.iter().filter(move |r| r.set == set && r.split == split && r.panel == "main")
}

fn best<'a>(found: &'a Findings, set: &'a str, split: &'a str) -> Option<&'a SplitResult> {
    models(found, set, split).min_by(|a, b| a.metrics.rmse.total_cmp(&b.metrics.rmse))
}

/// `selected` where the study has one, the best on the test frames otherwise.
fn chosen<'a>(study: &Study, found: &'a Findings, set: &'a str, split: &'a str) -> Option<&'a SplitResult> {
    if study.predictors.iter().any(|p| p.name == SELECTED) {
        found.of(set, split, SELECTED)
    } else {
        best(found, set, split)
    }
}

/// What a study says about its bars: one for every limit of its sets, short where what it is about is missing. Most
/// are about the predictor `selected` where the study has one, about the best on the test frames otherwise.
pub fn bars(study: &Study, found: &Findings) -> Vec<Bar> {
    let mut out = Vec::new();
    let mut at_most = |name: String, value: Option<f64>, limit: f64| {
        out.push(Bar::at_most(name, value, limit));
    };
    let word = |s: &str| s.replace(' ', "-");
    for set in &study.sets {
        let limits = &set.limits;
        let s = set.name.as_str();
        let p = set.splits.iter().find(|s| s.main).map_or("main", |s| s.name.as_str());
        let name = |what: &str| format!("{}/{}/{what}", word(s), word(p));
        let noise = found.noise_mdape(s, p);
        let ours = chosen(study, found, s, p);
        let bound = ours.and_then(|r| r.bound.as_ref());
        if let Some(limit) = limits.rmse_over_sd {
            at_most(name("best-rmse-over-sd"), ours.map(|r| r.metrics.rmse_over_sd), limit);
            at_most(name("best-mdape"), ours.map(|r| r.metrics.mdape), (2.0 * noise).max(0.05));
        }
        if limits.rmse_over_sd.is_some() || bound.is_some() {
            at_most(name("q95-coverage-off-by"), bound.map(|b| (b.coverage - 0.95).abs()), 0.015);
            at_most(name("q95-missed-in-slowest-tenth"), bound.map(|b| 1.0 - b.slowest_coverage), 0.1);
        }
        let rmse = |predictor: &str| found.of(s, p, predictor).map(|r| r.metrics.rmse);
        let over = |a: Option<f64>, b: Option<f64>| Some(a? / b?);
        let paper = rmse("paper");
        // The paper's network as the paper trains it and, where the study has it, distilled from another predictor.
        let distilled = study.predictors.iter().any(|p| p.name == DISTILLED).then_some(DISTILLED);
        for network in std::iter::once("paper").chain(distilled) {
            for (baseline, wanted, what) in
                [(CONSTANT, limits.constant_over_paper, "constant"), (PROXY, limits.proxy_over_paper, "lvrp")]
            {
                if let Some(wanted) = wanted {
                    let value = over(rmse(network), rmse(baseline));
                    at_most(name(&format!("{network}-rmse-over-{what}")), value, 1.0 / wanted);
                }
            }
        }
        if limits.latency {
            let cold = |predictor: &str| found.latency(s, predictor).map(|l| l.cold);
            let lowest = best(found, s, p).map(|r| r.metrics.rmse);
            at_most(name("selected-rmse-over-best"), over(rmse(SELECTED), lowest), 1.1);
            at_most(name("selected-latency-over-paper"), over(cold(SELECTED), cold("paper")), 0.2);
            let quick = cold("paper").and_then(|theirs| {
                models(found, s, p)
                    .filter(|r| cold(&r.predictor).is_some_and(|c| c <= theirs / 40.0))
                    .map(|r| r.metrics.rmse)
                    .min_by(f64::total_cmp)
            });
            at_most(name("rmse-at-a-fortieth-of-paper-latency-over-paper"), over(quick, paper), 0.5);
        }
        if limits.modality {
            let p = set.calibration_split.as_deref().unwrap_or("calibration");
            let name = |what: &str| format!("{}/{}/{what}", word(s), word(p));
            let ours = chosen(study, found, s, p);
            at_most(name("mdape"), ours.map(|r| r.metrics.mdape), 0.15);
            at_most(name("one-less-r2-log"), ours.map(|r| 1.0 - r.metrics.r2_log), 0.03);
            let tuned = ours.and_then(|r| {
                let curve = format!("{}, calibrated", r.predictor);
                found.tuning.iter().find(|t| {
                    t.set == s && t.split == p && t.curve == curve && t.frames == CALIBRATION_FRAMES
                })
            });
            let limit = (2.0 * found.noise_mdape(s, p)).max(0.07);
            at_most(name("mdape-after-100-frames"), tuned.map(|t| t.metrics.mdape), limit);
            at_most(name("one-less-r2-log-after-100-frames"), tuned.map(|t| 1.0 - t.metrics.r2_log), 0.015);
        }
    }
    out
}

fn main_table(found: &Findings, set: &str, split: &str, panel: Option<&str>) -> Table {
    let mut table = Table::new(vec![
        Column::text("predictor"),
        Column::number("RMSE, ms"),
        Column::number("RMSE/SD"),
        Column::number("95 % interval"),
        Column::number("MdAPE, %"),
        Column::number("95 % interval"),
        Column::number("p95, %"),
        Column::number("p99, %"),
        Column::number("R² in log"),
        Column::number("q95 held, %"),
        Column::number("slowest tenth"),
        Column::number("pinball"),
        Column::number("cold µs"),
        Column::number("per transfer function"),
    ]);
    let rows: Vec<&SplitResult> = found
        .results
        .iter()
        .filter(|r| {
            r.set == set && r.split == split && panel.is_none_or(|p| r.panel == p || r.panel == "baseline")
        })
        .collect();
    let interval = |i: Option<(f64, f64)>, f: &dyn Fn(f64) -> String| {
        i.map_or("-".into(), |(a, b)| format!("{}–{}", f(a), f(b)))
    };
    let percent = |v: f64| format!("{:.1}", 100.0 * v);
    for r in &rows {
        let m = &r.metrics;
        let bound =
            |f: &dyn Fn(&entire_cli::metrics::BoundMetrics) -> String| r.bound.as_ref().map_or("-".into(), f);
        let latency = found.latency(set, &r.predictor);
        table.row(vec![
            r.predictor.clone().into(),
            format!("{:.2}", 1e3 * m.rmse).into(),
            format!("{:.3}", m.rmse_over_sd).into(),
            interval(r.rmse_interval, &|v| format!("{v:.3}")).into(),
            percent(m.mdape).into(),
            interval(r.mdape_interval, &percent).into(),
            percent(m.p95).into(),
            percent(m.p99).into(),
            format!("{:.4}", m.r2_log).into(),
            bound(&|b| percent(b.coverage)).into(),
            bound(&|b| percent(b.slowest_coverage)).into(),
            bound(&|b| format!("{:.4}", b.pinball)).into(),
            latency.map_or("-".into(), |l| format!("{:.2}", 1e6 * l.cold)).into(),
            latency.map_or("-".into(), |l| format!("{:.1}", 1e6 * l.transfer)).into(),
        ]);
    }
    let values = |f: fn(&SplitResult) -> f64| rows.iter().map(|r| f(r)).collect::<Vec<f64>>();
    table.mark_best(2, &values(|r| r.metrics.rmse_over_sd), true);
    table.mark_best(4, &values(|r| r.metrics.mdape), true);
    table.mark_best(8, &values(|r| r.metrics.r2_log), false);
    table
}

/// How much worse than the best in cross-validation the selected predictor may be.
const SELECTION_TOLERANCE: f64 = 0.05;

/// The predictor that the rule selects from the training frames alone: among those that were cross-validated and take no
/// more than the set's share of the paper's latency, the quickest whose cross-validated error is within
/// [`SELECTION_TOLERANCE`] of the least. Recipes that are there twice count once.
fn by_rule<'a>(study: &'a Study, found: &Findings, set: &str) -> Option<&'a str> {
    let limits = &study.sets.iter().find(|s| s.name == set)?.limits;
    let paper = found.latency(set, "paper").map(|l| l.cold);
    let candidates: Vec<(&str, f64, f64)> = study
        .predictors
        .iter()
        .filter_map(|p| {
            let cold = found.latency(set, &p.name)?.cold;
            let quick = match (limits.cold_over_paper, paper) {
                (Some(share), Some(paper)) => cold <= share * paper,
                _ => true,
            };
            let crossed = found.fit(set, &p.name)?.crossed.as_ref()?.rmse;
            (quick && !p.trees).then_some((p.name.as_str(), crossed, cold))
        })
        .collect();
    let least = candidates.iter().map(|c| c.1).fold(f64::INFINITY, f64::min);
    let taken = candidates
        .iter()
        .filter(|c| c.1 <= (1.0 + SELECTION_TOLERANCE) * least)
        .min_by(|a, b| a.2.total_cmp(&b.2))?;
    // `selected` stands for the one that has the same recipe.
    let recipe = study.predictors.iter().find(|p| p.name == taken.0)?.recipe_for(set);
    let same = |p: &&Named| p.name == SELECTED && p.recipe_for(set) == recipe;
    Some(study.predictors.iter().find(same).map_or(taken.0, |p| p.name.as_str()))
}

/// Errors on frames that a predictor was made of, on members that it was made without, and on those of the main split.
fn fits_table(study: &Study, found: &Findings, set: &str, split: &str) -> Table {
    let mut table = Table::new(vec![
        Column::text("predictor"),
        Column::number("RMSE/SD, frames learned from"),
        Column::number("… cross-validated"),
        Column::number("… test"),
        Column::number("MdAPE %, frames learned from"),
        Column::number("… cross-validated"),
        Column::number("… test"),
        Column::number("cold µs"),
        Column::text("rule"),
    ]);
    let rule = by_rule(study, found, set);
    for f in found.fits.iter().filter(|f| f.set == set) {
        let Some(test) = found.of(set, split, &f.predictor).filter(|r| r.panel == "main") else { continue };
        let of = |m: Option<&Metrics>, v: &dyn Fn(&Metrics) -> String| m.map_or("-".into(), v);
        let share = |m: &Metrics| format!("{:.3}", m.rmse_over_sd);
        let percent = |m: &Metrics| format!("{:.1}", 100.0 * m.mdape);
        let (seen, crossed) = (Some(&f.seen), f.crossed.as_ref());
        let cold = found.latency(set, &f.predictor).map_or("-".into(), |l| format!("{:.1}", 1e6 * l.cold));
        table.row(vec![
            f.predictor.clone().into(),
            of(seen, &share).into(),
            of(crossed, &share).into(),
            share(&test.metrics).into(),
            of(seen, &percent).into(),
            of(crossed, &percent).into(),
            percent(&test.metrics).into(),
            cold.into(),
            if rule == Some(f.predictor.as_str()) { "selected" } else { "" }.into(),
        ]);
    }
    table
}

/// Accuracy against latency with its frontier, and what each predictor on it gains per microsecond.
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
    let mut chart = Chart::new(
        format!("{set}, split by {split}"),
        Axis::log("cold latency, features included, µs"),
        Axis::log("RMSE / SD"),
    )
    .size(860.0, 380.0)
    .series(Series::new("frontier", Mark::Steps(front.iter().map(|p| (p.0, p.2)).collect())).color(0))
    .series(
        Series::new("predictors", Mark::Points(points.iter().map(|p| (p.0, p.2, p.3.clone())).collect()))
            .color(1),
    );
    for (i, name) in [CONSTANT, PROXY].into_iter().enumerate() {
        if let Some(r) = found.of(set, split, name) {
            let short = if i == 0 { "constant" } else { "LVRP" };
            chart = chart.rule(Rule::Horizontal(r.metrics.rmse_over_sd, short.into()));
        }
    }
    let mut knee = Table::new(vec![
        Column::text("on the frontier"),
        Column::number("cold µs"),
        Column::number("RMSE/SD"),
        Column::number("MdAPE, %"),
        Column::number("RMSE/SD gained per µs more"),
    ]);
    let mut before: Option<&(f64, f64, f64, String)> = None;
    for p in front {
        let gain = before.map_or("-".into(), |b| format!("{:.4}", (b.2 - p.2) / (p.0 - b.0).max(1e-9)));
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

fn curve_chart(title: &str, points: &[&Point]) -> Chart {
    let mut chart = Chart::new(title, Axis::log("frames learned from"), Axis::log("MdAPE, %"));
    let mut names: Vec<&str> = points.iter().map(|p| p.curve.as_str()).collect();
    names.dedup();
    names.sort_unstable();
    names.dedup();
    for (i, name) in names.into_iter().enumerate() {
        let mut line: Vec<(f64, f64)> = points
            .iter()
            .filter(|p| p.curve == name)
            // Before any frame was seen: drawn at one.
            .map(|p| (p.frames.max(1) as f64, 100.0 * p.metrics.mdape))
            .collect();
        line.sort_by(|a, b| a.0.total_cmp(&b.0));
        chart = chart.series(Series::new(name, Mark::Line(line)).color(i));
    }
    chart
}

fn curve_table(points: &[&Point]) -> Table {
    let mut table = Table::new(vec![
        Column::text("curve"),
        Column::number("frames"),
        Column::number("RMSE/SD"),
        Column::number("MdAPE, %"),
        Column::number("R² in log"),
    ]);
    for p in points {
        table.row(vec![
            p.curve.clone().into(),
            p.frames.to_string().into(),
            format!("{:.3}", p.metrics.rmse_over_sd).into(),
            format!("{:.1}", 100.0 * p.metrics.mdape).into(),
            format!("{:.4}", p.metrics.r2_log).into(),
        ]);
    }
    table
}

fn bias_table(found: &Findings, set: &str, split: &str) -> Table {
    let rows: Vec<&SplitResult> = models(found, set, split).collect();
    let deciles = rows.iter().map(|r| r.metrics.bias_by_decile.len()).max().unwrap_or(0);
    let mut columns = vec![Column::text("predictor")];
    columns.extend((1..=deciles).map(|d| Column::number(format!("tenth {d}"))));
    let mut table = Table::new(columns);
    for r in rows {
        let mut row = vec![r.predictor.clone().into()];
        row.extend(r.metrics.bias_by_decile.iter().map(|b| format!("{:+.1}", 100.0 * b).into()));
        table.row(row);
    }
    table
}

fn parts_table(found: &Findings, set: &str, split: &str) -> Table {
    let rows: Vec<&SplitResult> = models(found, set, split).collect();
    let mut names: Vec<&str> = Vec::new();
    for (name, _) in rows.iter().flat_map(|r| &r.parts) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    let mut columns = vec![Column::text("predictor")];
    columns.extend(names.iter().map(|n| Column::number(format!("MdAPE %, {n}"))));
    let mut table = Table::new(columns);
    for r in rows {
        let mut row = vec![r.predictor.clone().into()];
        for name in &names {
            let m = r.parts.iter().find(|(n, _)| n == name).map(|(_, m)| m);
            row.push(
                m.map_or("-".into(), |m| format!("{:.1} ({} frames)", 100.0 * m.mdape, m.frames)).into(),
            );
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

fn write(out: &Path, study: &Study, found: &Findings) -> Result<()> {
    std::fs::create_dir_all(out).with_context(|| format!("cannot make {}", out.display()))?;
    let put = |name: &str, text: &str| {
        let path = out.join(name);
        std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))
    };
    put(
        "study.json",
        &(serde_json::to_string_pretty(&serde_json::json!({ "study": study, "findings": found }))? + "\n"),
    )?;
    let mut page = Page::new(
        study.title.as_str(),
        &format!(
            "Every predictor is made from the training tables of a data set alone and judged on splits that it never saw. A frame's \
             time is the median of its repeats by the clock {:?}. Latency: one thread, caches evicted before every call, scene \
             features included; what is done once per volume is not, and what is done once per transfer function has a column of its own.",
            study.clock
        ),
    );
    page.heading("Bars");
    let mut table = Table::new(vec![
        Column::text("bar"),
        Column::number("found"),
        Column::number("at most"),
        Column::text("holds"),
    ]);
    for b in bars(study, found) {
        table.row(vec![
            b.name.into(),
            b.value.map_or("-".into(), |v| format!("{v:.4}")).into(),
            format!("{:.4}", b.limit).into(),
            if b.ok { "yes" } else { "short" }.into(),
        ]);
    }
    page.table(&table, "");
    for set in &study.sets {
        if let Some(split) = set.splits.iter().find(|s| s.main) {
            page.heading(&format!("{}: frames learned from, cross-validation, test", set.name));
            page.table(
                &fits_table(study, found, &set.name, &split.name),
                &format!(
                    "Cross-validated: every training frame predicted without its ensemble member; upper bounds follow from these errors, every member counting alike. The rule takes the quickest predictor whose cross-validated RMSE is within {:.0} % of the least{}; it sees no test frame.",
                    100.0 * SELECTION_TOLERANCE,
                    set.limits.cold_over_paper.map_or(String::new(), |s| format!(
                        " among those that take at most {:.0} % of the latency of `paper`",
                        100.0 * s
                    ))
                ),
            );
        }
        for (i, split) in set.splits.iter().enumerate() {
            let (s, p) = (set.name.as_str(), split.name.as_str());
            page.heading(&format!("{s}: split by {p}"));
            if let Some((_, _, n, frames)) = found.noise.iter().find(|n| n.0 == s && n.1 == p) {
                page.paragraph(&format!(
                    "{frames} frames. Noise floor: repeats of one frame scatter with a log-SD of {:.3} (its median about {:.3}), so \
                     that knowing the truth would leave an MdAPE of about {:.1} %.",
                    n.log_sd,
                    n.log_sd_of_median,
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
                "Lower left is better. The frontier joins predictors that no quicker one beats.",
            );
            page.table(&knee, "");
            page.table(
                &main_table(found, s, p, Some("main")),
                "Intervals: ensemble members (volumes that belong to none) drawn anew with replacement.",
            );
            for panel in ["ablation", "architecture"] {
                if found.results.iter().any(|r| r.set == s && r.split == p && r.panel == panel) {
                    page.table(&main_table(found, s, p, Some(panel)), panel);
                }
            }
            let boxes = spread(found, s, p);
            put(&format!("errors-{}-{}.svg", s.replace(' ', "-"), i + 1), &boxes.to_svg_file())?;
            page.chart(&boxes, "");
            page.table(
                &bias_table(found, s, p),
                "Median of predicted / measured - 1 by tenth of the frames, fastest first, %.",
            );
            page.table(
                &parts_table(found, s, p),
                "By image size, and with the eye near or inside the volume.",
            );
        }
        for (points, title, caption) in [
            (&found.samples, "frames to learn from", "Error on the main split by number of training frames."),
            (
                &found.tuning,
                "adapting to other data",
                "Error on frames not learned from. Calibrated: the model of the training tables, its last layer fitted anew; from nothing: trained on those frames alone.",
            ),
        ] {
            let of_set: Vec<&Point> = points.iter().filter(|p| p.set == set.name).collect();
            if !of_set.is_empty() {
                page.heading(&format!("{}: {title}", set.name));
                let chart = curve_chart(&format!("{}: {title}", set.name), &of_set);
                put(
                    &format!("{}-{}.svg", title.replace(' ', "-"), set.name.replace(' ', "-")),
                    &chart.to_svg_file(),
                )?;
                page.chart(&chart, caption);
                page.table(&curve_table(&of_set), "");
            }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::study::Fit;

    fn study(predictors: &str, limits: &str) -> Study {
        serde_json::from_str(&format!(
            r#"{{ "title": "t", "latency_volume": ["v.nrrd", 1], "predictors": [{predictors}], "sets": [{{
                "name": "a set", "training": [], "calibration_split": "other", "limits": {limits},
                "splits": [{{ "name": "seen", "tables": [] }}, {{ "name": "member", "tables": [], "main": true }}] }}] }}"#
        ))
        .unwrap()
    }

    fn result(split: &str, predictor: &str, off: f64) -> SplitResult {
        let measured = [1.0, 2.0, 4.0];
        let predicted = measured.map(|t| t * off);
        SplitResult {
            set: "a set".into(),
            split: split.into(),
            predictor: predictor.into(),
            panel: "main".into(),
            metrics: Metrics::new(&predicted, &measured).unwrap(),
            rmse_interval: None,
            mdape_interval: None,
            bound: None,
            parts: Vec::new(),
            log_errors: [0.0; 7],
        }
    }

    const ALL: &str = r#"{ "rmse_over_sd": 0.5, "constant_over_paper": 4, "proxy_over_paper": 3, "modality": true, "latency": true }"#;

    #[test]
    fn a_limit_without_anything_to_hold_against_it_is_short_and_not_silent() {
        let study = study("", ALL);
        let bars = bars(&study, &Findings::default());
        let names: Vec<&str> = bars.iter().map(|b| b.name.as_str()).collect();
        for name in [
            "a-set/member/best-rmse-over-sd",
            "a-set/member/best-mdape",
            "a-set/member/q95-coverage-off-by",
            "a-set/member/q95-missed-in-slowest-tenth",
            "a-set/member/paper-rmse-over-constant",
            "a-set/member/paper-rmse-over-lvrp",
            "a-set/member/selected-rmse-over-best",
            "a-set/member/selected-latency-over-paper",
            "a-set/member/rmse-at-a-fortieth-of-paper-latency-over-paper",
            "a-set/other/mdape",
            "a-set/other/one-less-r2-log",
            "a-set/other/mdape-after-100-frames",
            "a-set/other/one-less-r2-log-after-100-frames",
        ] {
            assert!(names.contains(&name), "{name}: {names:?}");
        }
        assert_eq!(bars.len(), 13);
        assert!(bars.iter().all(|b| !b.ok && b.value.is_none()));
        assert_eq!(bars[4].to_string(), "bar a-set/member/paper-rmse-over-constant - 0.2500 short");
        assert!(super::bars(&self::study("", "{}"), &Findings::default()).is_empty());
    }

    #[test]
    fn the_rule_takes_the_quickest_of_the_good_ones_and_looks_at_no_test_frame() {
        let trained =
            |name: &str, kind: &str| format!(r#"{{ "name": "{name}", "recipe": {{ "kind": "{kind}" }} }}"#);
        let all = [
            ("paper", "prednet"),
            ("slow", "residual"),
            ("good", "linear"),
            ("quick", "analytic"),
            ("t", "trees"),
        ]
        .map(|(n, k)| trained(n, k))
        .join(",");
        let latency = |cold: f64| crate::latency::Latency { cold, warm: cold, transfer: 0.0 };
        let rule = |limits: &str, good: f64| {
            let study = study(&all, limits);
            let mut found = Findings::default();
            // Measured 1, 2, 4; predictions off by a factor. The test frames say the opposite.
            for (name, off, cold) in
                [("slow", 1.10, 50e-6), ("good", good, 19e-6), ("quick", 1.30, 2e-6), ("t", 1.01, 1e-6)]
            {
                let crossed = Some(result("member", name, off).metrics);
                let seen = result("member", name, 1.0).metrics;
                found.fits.push(Fit { set: "a set".into(), predictor: name.into(), seen, crossed, folds: 5 });
                found.latencies.push(("a set".into(), name.into(), latency(cold)));
                found.results.push(result("member", name, 2.5 - off));
            }
            found.latencies.push(("a set".into(), "paper".into(), latency(100e-6)));
            let table = fits_table(&study, &found, "a set", "member").to_text();
            assert_eq!(table.matches("selected").count(), 1, "{table}");
            by_rule(&study, &found, "a set").unwrap().to_owned()
        };
        assert_eq!(rule("{}", 1.104), "good");
        assert_eq!(rule("{}", 1.106), "slow");
        assert_eq!(rule(r#"{ "cold_over_paper": 0.2 }"#, 1.106), "good");
        assert_eq!(rule(r#"{ "cold_over_paper": 0.1 }"#, 1.106), "quick");
    }

    #[test]
    fn bars_are_about_the_selected_predictor_where_the_study_has_one() {
        let found = Findings {
            results: vec![
                result("member", "selected", 1.04),
                result("member", "lucky", 1.01),
                result("seen", "lucky", 1.3),
                result("member", "paper", 1.2),
                result("member", CONSTANT, 1.6),
            ],
            ..Findings::default()
        };
        let limits = r#"{ "rmse_over_sd": 0.5, "constant_over_paper": 4 }"#;
        let value = |study: &Study, what: &str| {
            let bars = bars(study, &found);
            let bar = bars.iter().find(|b| b.name == format!("a-set/member/{what}")).unwrap().clone();
            (bar.value.unwrap(), bar.ok)
        };
        let with = study(r#"{ "name": "selected" }, { "name": "lucky" }"#, limits);
        assert!((value(&with, "best-mdape").0 - 0.04).abs() < 1e-12);
        let without = study(r#"{ "name": "lucky" }"#, limits);
        assert!((value(&without, "best-mdape").0 - 0.01).abs() < 1e-12);
        assert!(value(&without, "best-rmse-over-sd").1);
        let (ratio, ok) = value(&with, "paper-rmse-over-constant");
        assert!((ratio - 0.2 / 0.6).abs() < 1e-12 && !ok);
        // A study that has a selected predictor which could not be made is not judged by another one.
        let gone = Findings { results: found.results[1..].to_vec(), ..Findings::default() };
        let bars = bars(&with, &gone);
        assert!(bars.iter().filter(|b| b.name.contains("best-")).all(|b| b.value.is_none() && !b.ok));
    }
}
