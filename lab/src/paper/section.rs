//! A section of the report, the texts and tables that several sections share, and the sections with the
//! errors of all data sets.

use super::description::{BY_VOLUMES, Paper, Rule};
use super::interval;
use super::judge::{NETWORK, OURS};
use super::results::{CONSTANT, LVRP, Results, Row, box_of};
use super::volumes::in_words;
use entire_report::{Axis, Chart, Mark, Series, Table};

/// Contents of the report for one table or figure of the paper.
#[derive(Clone, Debug, Default)]
pub(super) struct Section {
    pub(super) tables: Vec<(Table, String)>,
    pub(super) charts: Vec<(Chart, String)>,
    /// Pictures' files with captions.
    pub(super) pictures: Vec<(String, String)>,
    pub(super) notes: Vec<String>,
    /// One line for the overview.
    pub(super) summary: String,
}

impl Section {
    pub(super) fn there(&self) -> bool {
        !self.tables.is_empty() || !self.charts.is_empty() || !self.pictures.is_empty()
    }
}

pub(super) fn title(paper: &Paper, r: &Results) -> String {
    title_of(paper, &r.set, &r.mode)
}

/// A data set in a mode, in words.
pub(super) fn title_of(paper: &Paper, set: &str, mode: &str) -> String {
    let name = paper.data_set(set).map_or(set, |d| d.title.as_str());
    format!("{name}, {}", mode_in_words(mode))
}

pub(super) fn mode_in_words(mode: &str) -> &str {
    match mode {
        "none" => "unshaded",
        "local" => "local lighting",
        "scatter" => "single scattering",
        other => other,
    }
}

/// Seconds with four significant digits.
pub(super) fn seconds(v: f64) -> String {
    if v == 0.0 || !v.is_finite() {
        return "0".into();
    }
    let digits = (3 - v.abs().log10().floor() as i32).clamp(0, 8) as usize;
    format!("{v:.digits$}")
}

pub(super) fn ratio(v: Option<f64>) -> String {
    v.map_or("-".into(), |v| format!("{v:.3}"))
}

/// A ratio, with its interval beside it if there is one.
pub(super) fn with_interval(v: Option<f64>, interval: Option<(f64, f64)>) -> String {
    match (v, interval) {
        (Some(v), Some(_)) => format!("{v:.3} {}", interval::in_brackets(interval)),
        _ => ratio(v),
    }
}

/// A ratio to a baseline with its interval; the ratio of the baseline to itself (`own`) has no interval.
pub(super) fn over(v: Option<f64>, interval: Option<(f64, f64)>, own: bool) -> String {
    if own { ratio(v) } else { with_interval(v, interval) }
}

/// Table of the errors of every predictor in a part of the study.
pub(super) fn errors_table(r: &Results) -> Table {
    let mut table = Table::headed(
        "tested on | predictor | #RMSE, s | #SD of the RMSE over runs, s | #runs | #RMSE / SD of the times | \
         #RMSE / RMSE of the mean of 15 % | #RMSE / RMSE of LVRP | #median error, % | \
         #time of a prediction, ms | #test frames",
    );
    for row in &r.rows {
        table.row(vec![
            in_words(&row.split).into(),
            row.name.as_str().into(),
            seconds(row.rmse).into(),
            row.spread().map(seconds).into(),
            row.runs.to_string().into(),
            format!("{:.3}", row.rmse / row.sd).into(),
            over(row.over_constant, r.over_constant_interval(row), row.name == CONSTANT).into(),
            over(row.over_lvrp, r.over_lvrp_interval(row), row.name == LVRP).into(),
            format!("{:.1}", 100.0 * row.mdape).into(),
            row.latency.map(|l| format!("{:.3}", 1e3 * l)).into(),
            row.frames.to_string().into(),
        ]);
    }
    table
}

/// The paper's rule for test volumes, for captions.
const TEST_RULE: &str =
    "random volumes of MAESTROeX, and one left-out ensemble member each for Nyx and Castro";

/// Adds the tables and the chart of prediction errors by data set and renderer.
pub(super) fn overall(paper: &Paper, of: &[&Results], s: &mut Section) {
    let mut parts = Vec::new();
    let headline = errors_by_data_set(paper, of, |rule| rule, &mut parts);
    if parts.is_empty() {
        return;
    }
    s.summary = parts.join("; ");
    s.tables.push((headline, format!("The test volumes follow the paper's rule: {TEST_RULE}.")));
    let mut others = Vec::new();
    let other = errors_by_data_set(paper, of, Rule::other, &mut others);
    if !others.is_empty() {
        let what = "The test volumes are those of each data set's other split, on which the paper does not \
                    test: random volumes of Nyx and Castro, and a left-out member of MAESTROeX.";
        s.tables.push((other, what.into()));
    }
    for set in paper.data_sets.iter().filter(|d| !d.only_tests) {
        for mode in &set.modes {
            if !of.iter().any(|r| r.set == set.name && r.mode == *mode) {
                s.notes.push(format!(
                    "Not measured: {}. The command `entire-lab paper collect --data DATA --data-sets {} \
                     --modes {mode}` collects the frames.",
                    title_of(paper, &set.name, mode),
                    set.name
                ));
            }
        }
    }
    // The encoder is stated once for neighboring tables with the same encoder.
    let mut stated = "";
    for r in of.iter().filter(|r| r.rows.iter().any(|x| x.split != BY_VOLUMES)) {
        let mut caption = format!("{}: errors by split.", title(paper, r));
        if r.encoder != stated {
            caption += &format!(
                " {}. In the other split, the network uses the shipped encoder. In rows of scans, the \
                 frames are predicted by the models of the split by random volumes.",
                r.encoder
            );
            stated = r.encoder.as_str();
        }
        s.tables.push((errors_table(r), caption));
    }
    let mut chart = Chart::new(
        "Accuracy against latency, test volumes by the paper's rule",
        Axis::log("one prediction, ms"),
        Axis::log("RMSE / SD"),
    )
    .size(860.0, 520.0);
    for (i, name) in [NETWORK, OURS, LVRP].into_iter().enumerate() {
        let points: Vec<(f64, f64, String)> = of
            .iter()
            .filter_map(|r| {
                let row = r.row(paper.rule(&r.set).split(), name)?;
                Some((1e3 * row.latency?, row.rmse / row.sd, title(paper, r)))
            })
            .collect();
        if !points.is_empty() {
            chart = chart.series(Series::new(name, Mark::Points(points)).color(i));
        }
    }
    let what = "Points further down have a smaller error, and points further left a shorter prediction time.";
    s.charts.push((chart, what.into()));
}

/// Returns a table with one row for each data set and mode in which the network was tested on the chosen
/// split. `split` converts the data set's rule to the rule of the chosen split. For each row, the function
/// appends a text with the row's ratios of errors to `parts`.
pub(super) fn errors_by_data_set(
    paper: &Paper,
    of: &[&Results],
    split: fn(Rule) -> Rule,
    parts: &mut Vec<String>,
) -> Table {
    let mut table = Table::headed(
        "data set, renderer | tested on | #training frames | #test frames | #network: RMSE, s | \
         #network: SD of the RMSE over runs, s (runs) | #network: time of a prediction, ms | \
         #mean of 15 %: RMSE, s | #LVRP: RMSE, s | #LVRP: median time of a frame, ms | #ours: RMSE, s | \
         #ours: SD of the RMSE over runs, s | #ours: time of a prediction, ms | \
         #RMSE: network / mean of 15 % | #RMSE: network / LVRP | #RMSE: ours / network",
    );
    for r in of {
        let split = split(paper.rule(&r.set)).split();
        let find = |name: &str| r.row(split, name);
        let Some(network) = find(NETWORK) else { continue };
        let s_of = |row: Option<&Row>| row.map(|x| seconds(x.rmse));
        let ms = |row: Option<&Row>| Some(format!("{:.3}", 1e3 * row?.latency?));
        let ours = find(OURS);
        let over_mean = with_interval(network.over_constant, r.over_constant_interval(network));
        let over_lvrp = with_interval(network.over_lvrp, r.over_lvrp_interval(network));
        let interval = ours.and_then(|o| interval::of_ratio(&o.by_volume, &network.by_volume));
        let ours_over = with_interval(ours.map(|o| o.rmse / network.rmse), interval);
        parts.push(format!(
            "{}: RMSE network / mean of 15 % {over_mean}, network / LVRP {over_lvrp}, ours / network \
             {ours_over}",
            title(paper, r)
        ));
        table.row(vec![
            title(paper, r).into(),
            in_words(split).into(),
            r.frames.get(split).map_or(0, |f| f[0]).to_string().into(),
            network.frames.to_string().into(),
            seconds(network.rmse).into(),
            format!("{} ({})", network.spread().map_or("-".into(), seconds), network.runs).into(),
            ms(Some(network)).into(),
            s_of(find(CONSTANT)).into(),
            s_of(find(LVRP)).into(),
            ms(find(LVRP)).into(),
            s_of(ours).into(),
            ours.and_then(Row::spread).map(seconds).into(),
            ms(ours).into(),
            over_mean.into(),
            over_lvrp.into(),
            ours_over.into(),
        ]);
    }
    table
}

/// Adds the charts of the distributions of times and squared errors.
pub(super) fn distributions(paper: &Paper, of: &[&Results], s: &mut Section) {
    let split = |r: &Results| paper.rule(&r.set).split();
    let shown: Vec<&&Results> = of.iter().filter(|r| r.row(split(r), NETWORK).is_some()).collect();
    if shown.is_empty() {
        return;
    }
    let names: Vec<String> = shown.iter().map(|r| title(paper, r)).collect();
    let times: Vec<(f64, [f64; 5])> =
        shown.iter().enumerate().filter_map(|(i, r)| Some((i as f64, box_of(r.fact("times")?)))).collect();
    let axis = || Axis::categories("data set, renderer", names.clone());
    s.charts.push((
        Chart::new("Rendering times", axis(), Axis::log("seconds"))
            .series(Series::new("5th, 25th, 50th, 75th, 95th percentile", Mark::Boxes(times)).color(0)),
        "Each box shows percentiles of the frame times for one data set and one renderer.".into(),
    ));
    let mut chart = Chart::new("Squared errors", axis(), Axis::log("seconds squared"));
    for (k, name) in [NETWORK, OURS].into_iter().enumerate() {
        let boxes = shown
            .iter()
            .enumerate()
            .filter_map(|(i, r)| Some((i as f64, r.row(split(r), name)?.squared_errors)))
            .collect();
        chart = chart.series(Series::new(name, Mark::Boxes(boxes)).color(k));
    }
    let what = "Each box shows percentiles of a predictor's squared errors for one data set and one \
                renderer, over all runs";
    s.charts.push((chart, format!("{what}. The test volumes follow the paper's rule: {TEST_RULE}.")));
    s.summary = format!("{} distributions of times and squared errors", shown.len());
}
