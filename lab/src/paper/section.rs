//! A section of the report, and the texts and tables that several sections share.

use super::description::Paper;
use super::interval;
use super::results::{CONSTANT, LVRP, Results};
use super::volumes::in_words;
use entire_report::{Chart, Table};

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
         #RMSE / that of the mean of 15 % | #RMSE / that of LVRP | #median error, % | \
         #time of a prediction, ms | #test frames",
    );
    for row in &r.rows {
        table.row(vec![
            in_words(&row.split).into(),
            row.name.as_str().into(),
            seconds(row.rmse).into(),
            (row.runs > 1).then(|| seconds(row.rmse_sd)).into(),
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
