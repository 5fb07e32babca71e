//! Printed and written output of `entire evaluate`.

use anyhow::Result;
use entire_io::dataset::{NoiseFloor, TimedFrame};
use entire_io::files::{make_folder, write_whole};
use entire_io::metrics::{BoundMetrics, Metrics};
use entire_report::{Axis, Chart, Mark, Page, Rule, Series, Table, bias_table};
use entire_train::evaluation::WarmLatency;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

#[derive(Clone, Debug, Serialize)]
pub(super) struct Predictor {
    pub(super) name: String,
    pub(super) fnv1a: Option<String>,
    pub(super) metrics: Metrics,
    pub(super) by_group: BTreeMap<String, Metrics>,
    pub(super) latency: Option<WarmLatency>,
    /// Number of evaluated frames whose group the model was trained or validated on; `None` if its file does
    /// not state these groups, as after `entire calibrate`, and for a predictor without a model.
    pub(super) frames_seen: Option<usize>,
    /// Share of frames that took no longer than the model's upper bound.
    pub(super) bound_coverage: Option<f64>,
    /// Measures of the upper bound: coverage of all frames and of the slowest tenth, and quantile (pinball)
    /// loss.
    pub(super) bound: Option<BoundMetrics>,
    /// 95 % interval of RMSE/SD by bootstrap over ensemble members; a volume outside any ensemble counts as a
    /// member of its own.
    pub(super) rmse_over_sd_interval: Option<(f64, f64)>,
    /// 95 % interval of the median error, by bootstrap as for `rmse_over_sd_interval`.
    pub(super) mdape_interval: Option<(f64, f64)>,
    /// Errors by kind of frame.
    pub(super) by_kind: Vec<(&'static str, Metrics)>,
    #[serde(skip)]
    pub(super) predicted: Vec<f64>,
    /// True for the constant baseline.
    #[serde(skip)]
    pub(super) constant: bool,
}

#[derive(Debug, Serialize)]
pub(super) struct Evaluation<'a> {
    pub(super) program: String,
    pub(super) machine: String,
    pub(super) date: String,
    pub(super) load_average: Option<[f64; 3]>,
    pub(super) data: Vec<String>,
    pub(super) clock: &'static str,
    pub(super) shading: Option<&'static str>,
    pub(super) unseen_only: bool,
    pub(super) frames: usize,
    pub(super) noise_floor: Option<NoiseFloor>,
    /// Noise floor for each kind of frame.
    pub(super) noise_by_kind: &'a [(&'static str, NoiseFloor)],
    /// Errors of each model in a session, by the model's name, without the first `--observed` frames.
    pub(super) in_session: &'a BTreeMap<String, Metrics>,
    pub(super) predictors: &'a [Predictor],
}

pub(super) fn noise_text(noise: Option<NoiseFloor>) -> String {
    match noise {
        Some(n) => format!("noise floor: {}", n.describe()),
        None => "noise floor: unknown, since no frame was repeated".into(),
    }
}

pub(super) fn tables_of(predictors: &[Predictor]) -> (Table, Table, Table) {
    let percent = |v: f64| format!("{:.2}", 100.0 * v);
    let mut overall = Table::headed(
        "predictor | #frames | #in training or validation | #RMSE, s | #RMSE/SD | #MAE, s | \
         #median error, % | #p95, % | #p99, % | #R² in log | #within upper bound, % | #µs per prediction | \
         #µs per transfer function",
    );
    for p in predictors {
        let m = &p.metrics;
        let micro = |f: fn(&WarmLatency) -> f64| p.latency.as_ref().map(|l| format!("{:.2}", 1e6 * f(l)));
        overall.row(vec![
            p.name.clone().into(),
            m.frames.to_string().into(),
            p.frames_seen.map(|n| n.to_string()).into(),
            format!("{:.3e}", m.rmse).into(),
            format!("{:.3}", m.rmse_over_sd).into(),
            format!("{:.3e}", m.mae).into(),
            percent(m.mdape).into(),
            percent(m.p95).into(),
            percent(m.p99).into(),
            format!("{:.4}", m.r2_log).into(),
            p.bound_coverage.map(|c| format!("{:.1}", 100.0 * c)).into(),
            micro(|l| l.seconds).into(),
            micro(|l| l.transfer_seconds).into(),
        ]);
    }
    let best = |t: &mut Table, column, f: fn(&Metrics) -> f64, lowest| {
        let values: Vec<f64> = predictors.iter().map(|p| f(&p.metrics)).collect();
        t.mark_best(column, &values, lowest);
    };
    best(&mut overall, 3, |m| m.rmse, true);
    best(&mut overall, 6, |m| m.mdape, true);
    best(&mut overall, 9, |m| m.r2_log, false);

    let rows: Vec<_> = predictors.iter().map(|p| (p.name.as_str(), &p.metrics)).collect();
    let bias = bias_table(&rows);

    let of = |p: &Predictor| ["RMSE/SD", "median error %"].map(|what| format!("{what}, {}", p.name));
    let mut by_group = Table::headed("member | #frames").with_numbers(predictors.iter().flat_map(of));
    if let Some(first) = predictors.first() {
        for (group, m) in &first.by_group {
            let mut row = vec![group.clone().into(), m.frames.to_string().into()];
            for p in predictors {
                match p.by_group.get(group) {
                    Some(m) => row.extend([format!("{:.3}", m.rmse_over_sd).into(), percent(m.mdape).into()]),
                    None => row.extend(["-".into(), "-".into()]),
                }
            }
            by_group.row(row);
        }
    }
    (overall, bias, by_group)
}

/// Returns a table of the predictors' intervals, bounds, and errors by kind of frame; its last row is the
/// noise floor.
pub(super) fn detail_table(predictors: &[Predictor], noise: &[(&'static str, NoiseFloor)]) -> Table {
    let mut kinds: Vec<&str> = Vec::new();
    for (name, _) in predictors.iter().flat_map(|p| &p.by_kind) {
        if !kinds.contains(name) {
            kinds.push(name);
        }
    }
    let mut headings = "predictor | #RMSE/SD, 95 % interval | #median error %, 95 % interval | \
                        #slowest tenth within upper bound, % | #pinball loss / mean time"
        .to_owned();
    kinds.iter().for_each(|kind| headings += &format!(" | #median error %, {kind}"));
    let mut table = Table::headed(&headings);
    for p in predictors {
        let range = |i: Option<(f64, f64)>, scale: f64, digits: usize| {
            i.map(|(a, b)| format!("{:.digits$}–{:.digits$}", scale * a, scale * b))
        };
        let mut row = vec![
            p.name.clone().into(),
            range(p.rmse_over_sd_interval, 1.0, 3).into(),
            range(p.mdape_interval, 100.0, 1).into(),
            p.bound.map(|b| format!("{:.1}", 100.0 * b.slowest_coverage)).into(),
            p.bound.map(|b| format!("{:.4}", b.pinball)).into(),
        ];
        for kind in &kinds {
            let m = p.by_kind.iter().find(|(k, _)| k == kind);
            row.push(m.map(|(_, m)| format!("{:.2}", 100.0 * m.mdape)).into());
        }
        table.row(row);
    }
    if !noise.is_empty() {
        let mut row = vec!["noise floor, from repeats of a frame".into()];
        row.extend((0..4).map(|_| "-".into()));
        for kind in &kinds {
            let floor = noise.iter().find(|(k, _)| k == kind);
            row.push(floor.map(|(_, n)| format!("{:.2}", 100.0 * n.mdape())).into());
        }
        table.row(row);
    }
    table
}

/// Largest number of points of a scatter chart; a browser needs seconds to draw more.
const MOST_POINTS: usize = 10_000;

/// Returns the distance between the frames that a scatter chart shows, in frames; 1 for all frames.
fn thinning(frames: usize) -> usize {
    frames.div_ceil(MOST_POINTS).max(1)
}

fn scatter(p: &Predictor, measured: &[f64], color: usize) -> Chart {
    let shown = measured.iter().zip(&p.predicted).step_by(thinning(measured.len()));
    let points = shown.map(|(t, y)| (*t, *y, String::new())).collect();
    Chart::new(p.name.as_str(), Axis::log("measured, s"), Axis::log("predicted, s"))
        .size(620.0, 480.0)
        .rule(Rule::Diagonal("exact".into()))
        .series(Series::new("", Mark::Points(points)).color(color))
}

/// Returns a chart of the share of frames by predicted / measured, in bins of equal ratio between 1/2 and 2;
/// the outermost bins include all smaller and larger values.
fn histogram(predictors: &[Predictor], measured: &[f64]) -> Chart {
    const BINS: usize = 41;
    let span = 2f64.ln();
    let mut chart = Chart::new(
        "Distribution of predicted / measured",
        Axis::log("predicted / measured"),
        Axis::linear("share of frames, %").from(0.0),
    )
    .rule(Rule::Vertical(1.0, "exact".into()));
    for (i, p) in predictors.iter().enumerate() {
        let mut counts = [0usize; BINS];
        for (y, t) in p.predicted.iter().zip(measured) {
            let at = ((y.max(1e-30) / t).ln() / span + 1.0) * 0.5 * BINS as f64;
            counts[(at.max(0.0) as usize).min(BINS - 1)] += 1;
        }
        let line = counts
            .iter()
            .enumerate()
            .map(|(b, c)| {
                let ratio = (((b as f64 + 0.5) / BINS as f64 * 2.0 - 1.0) * span).exp();
                (ratio, 100.0 * *c as f64 / measured.len() as f64)
            })
            .collect();
        chart = chart.series(Series::new(p.name.clone(), Mark::Line(line)).color(i));
    }
    chart
}

fn bias_chart(predictors: &[Predictor]) -> Chart {
    let mut chart = Chart::new(
        "Bias per tenth of the frames, from the fastest to the slowest",
        Axis::linear("tenth of the frames by measured time"),
        Axis::linear("bias, %"),
    )
    .rule(Rule::Horizontal(0.0, String::new()));
    // The constant baseline is left out: its bias is hundreds of percent on fast frames, which would flatten
    // all other lines.
    for (i, p) in predictors.iter().enumerate().filter(|(_, p)| !p.constant) {
        let line =
            p.metrics.bias_by_decile.iter().enumerate().map(|(d, b)| ((d + 1) as f64, 100.0 * b)).collect();
        chart = chart.series(Series::new(p.name.clone(), Mark::Line(line)).color(i));
    }
    chart
}

/// The file of every frame's predictions, in the folder of --out.
pub(super) const PREDICTIONS: &str = "predictions.csv";

pub(super) fn write_report(
    out: &Path,
    evaluation: &Evaluation<'_>,
    frames: &[&TimedFrame],
    measured: &[f64],
    groups: &[String],
    [overall, bias, by_group, more]: [&Table; 4],
) -> Result<()> {
    make_folder(out)?;
    let write = |name: &str, text: &str| write_whole(&out.join(name), text.as_bytes());
    let predictors = evaluation.predictors;
    write("evaluation.json", &(serde_json::to_string_pretty(evaluation)? + "\n"))?;

    let mut csv = csv::Writer::from_writer(Vec::new());
    let mut header = vec!["table".to_owned(), "frame".into(), "group".into(), "seconds_measured".into()];
    header.extend(predictors.iter().map(|p| format!("seconds_{}", p.name)));
    csv.write_record(&header)?;
    for (i, f) in frames.iter().enumerate() {
        let mut row = vec![
            evaluation.data[f.table].clone(),
            f.number.to_string(),
            groups[i].clone(),
            measured[i].to_string(),
        ];
        row.extend(predictors.iter().map(|p| p.predicted[i].to_string()));
        csv.write_record(&row)?;
    }
    let csv = csv.into_inner().map_err(|e| anyhow::anyhow!("{e}"))?;
    write(PREDICTIONS, &String::from_utf8_lossy(&csv))?;

    let lead = format!(
        "{} frames, clock {}; {}",
        evaluation.frames,
        evaluation.clock,
        noise_text(evaluation.noise_floor)
    );
    let mut page = Page::new("Evaluation of predictors", &lead);
    page.table(
        overall,
        "RMSE/SD is the RMSE divided by the standard deviation of the measured times; it is 1 for a \
         predictor that always gives their mean. The median error, p95 and p99 are the median, the 95th and \
         the 99th percentile of the absolute percentage error. A dash under \"in training or validation\": \
         the model's file does not state its training data, or the predictor has no model. A time per \
         prediction is the median of warm calls in one thread, scene features included.",
    );
    page.table(
        more,
        "Intervals are computed by bootstrap over ensemble members; a volume that belongs to no ensemble \
         counts as a member.",
    );
    page.heading("Errors");
    let spread = histogram(predictors, measured);
    write("errors.svg", &spread.to_svg_file())?;
    page.chart(&spread, "Bins of equal ratio between 1/2 and 2; the outer bins include all other values.");
    let by_time = bias_chart(predictors);
    write("bias.svg", &by_time.to_svg_file())?;
    page.chart(
        &by_time,
        "The constant baseline is left out: its bias is hundreds of percent on fast frames.",
    );
    page.table(
        bias,
        "Median of predicted / measured - 1, in %, for each tenth of the frames, from the fastest to the \
         slowest.",
    );
    page.heading("Predicted against measured");
    let drawn = match thinning(measured.len()) {
        1 => String::new(),
        every => format!("One of {every} frames is drawn."),
    };
    for (i, p) in predictors.iter().enumerate() {
        let chart = scatter(p, measured, i);
        write(&format!("scatter-{}.svg", i + 1), &chart.to_svg_file())?;
        page.chart(&chart, &drawn);
    }
    page.heading("By member");
    page.table(by_group, "SD is the standard deviation of the measured seconds of the member's frames.");
    page.heading("Where the numbers come from");
    let load = evaluation
        .load_average
        .map_or("not known".into(), |l| format!("{:.2} {:.2} {:.2}", l[0], l[1], l[2]));
    page.facts([
        ("Program", evaluation.program.clone()),
        ("Evaluated on", evaluation.machine.clone()),
        ("Date", evaluation.date.clone()),
        ("Load average", load),
        ("Data", evaluation.data.join(", ")),
    ]);
    page.write(&out.join("report.html"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bias_chart_shows_every_predictor_but_the_constant_one() {
        let seconds: Vec<f64> = (1..=20).map(f64::from).collect();
        let predicted: Vec<f64> = seconds.iter().map(|t| t * (1.0 + 0.01 * t)).collect();
        let frames = vec![TimedFrame::of_no_volume("v", ""); seconds.len()];
        let (frames, groups): (Vec<&TimedFrame>, Vec<String>) =
            (frames.iter().collect(), vec!["v".into(); 20]);
        let predictor = |name: &str, constant: bool| {
            let made =
                super::super::assess(name.into(), predicted.clone(), (&frames, &seconds, &groups), None);
            Predictor { constant, ..made.unwrap() }
        };
        let all = [predictor("m", false), predictor("m, int8 weights", false), predictor("the mean", true)];
        let svg = bias_chart(&all).to_svg_file();
        assert!(svg.contains("m, int8 weights") && !svg.contains("the mean"), "{svg}");
    }
}
