//! Writes one chart of every kind, and a page that holds them all: `cargo run -p entire-cli --example charts
//! -- DIR`.

use entire_report::{Axis, Chart, Column, Mark, Page, Rule, Series, Table};
use std::path::PathBuf;

/// Returns the frame time, in milliseconds, of an invented playback whose scene changes abruptly at frames 40
/// and 80.
fn frame_time(frame: usize, controller: usize) -> f64 {
    let wave = (frame as f64 * 0.21 + controller as f64).sin();
    let switch = if (40..80).contains(&frame) { 2.6 } else { 1.0 };
    let since = frame.saturating_sub(if frame >= 80 { 80 } else { 40 }) as f64;
    let settled = if frame < 40 { 1.0 } else { 1.0 + 1.8 * (-since / (1.0 + 3.0 * controller as f64)).exp() };
    (18.0 + 3.0 * wave) * if controller == 0 { switch } else { settled }
}

fn frames() -> Chart {
    let line = |c: usize| (0..120).map(|i| (i as f64, frame_time(i, c))).collect::<Vec<_>>();
    let target = (0..120).map(|i| (i as f64, if i < 60 { 22.0 } else { 16.0 })).collect();
    let spare = (0..120).map(|i| (i as f64, 16.0, 70.0 + 20.0 * (i as f64 / 9.0).cos())).collect();
    let mut chart = Chart::new("Frame time", Axis::linear("frame"), Axis::log("frame time / ms"))
        .size(900.0, 380.0)
        .rule(Rule::Vertical(40.0, "switch 1".into()))
        .rule(Rule::Vertical(80.0, "switch 2".into()))
        .rule(Rule::Horizontal(60.0, "limit".into()))
        .series(Series::new("target", Mark::Steps(target)).color(10))
        .series(Series::new("reference step", Mark::Band(spare)).color(6));
    for (c, name) in ["fixed step", "PID", "Algorithm 1", "hybrid"].into_iter().enumerate() {
        let mut points = line(c);
        if c == 2 {
            // A frame without a measurement breaks the line.
            points[20].1 = f64::NAN;
        }
        chart = chart.series(Series::new(name, Mark::Line(points)).color([5, 3, 2, 0][c]));
    }
    chart
}

fn palette() -> Chart {
    let mut chart =
        Chart::new("Every color and dash", Axis::linear("x / s"), Axis::linear("y / m").from(0.0));
    for color in 0..11 {
        let points = (0..=40).map(|i| {
            let x = f64::from(i) / 10.0;
            (x, f64::from(color) + 0.4 * (x * 2.0).sin() + 1.0)
        });
        chart = chart.series(
            Series::new(format!("color {color}"), Mark::Line(points.collect())).color(color as usize),
        );
    }
    chart
}

fn steps() -> Chart {
    let points = |c: usize| (0..60).map(|i| (i as f64, [1.0, 1.5, 2.2, 1.2][(i / 7 + c) % 4])).collect();
    Chart::new("Ray step", Axis::linear("frame"), Axis::log("step / reference steps"))
        .size(900.0, 300.0)
        .series(Series::new("hybrid", Mark::Steps(points(0))).color(0))
        .series(Series::new("OLP", Mark::Steps(points(2))).color(1))
}

fn scatter() -> Chart {
    let points = (0..400).map(|i| {
        let t = 0.004 * 1.012_f64.powi(i);
        (t, t * (0.5 * (f64::from(i) * 2.3).sin()).exp(), String::new())
    });
    Chart::new("Predicted over measured", Axis::log("measured / s"), Axis::log("predicted / s"))
        .size(560.0, 420.0)
        .series(Series::new("held-out frames", Mark::Points(points.collect())).color(0))
        .rule(Rule::Diagonal("exact".into()))
}

fn frontier() -> Chart {
    let places =
        [(0.8, 22.0), (1.0, 20.5), (1.05, 20.4), (4.0, 14.0), (4.2, 13.9), (40.0, 9.0), (300.0, 8.7)];
    let names = ["table", "OLP", "OLP, two terms", "network", "network, int8", "trees", "ensemble of all"];
    let points = places.iter().zip(names).map(|(p, n)| (p.0, p.1, n.to_owned()));
    Chart::new("Error against latency", Axis::log("latency / µs"), Axis::linear("median error / %").from(0.0))
        .series(Series::new("", Mark::Line(places.to_vec())).color(5))
        .series(Series::new("predictors", Mark::Points(points.collect())).color(1))
        .rule(Rule::Horizontal(10.0, "paper".into()))
}

fn boxes() -> Chart {
    let names = ["uniform", "random", "stratified"].map(str::to_owned).to_vec();
    let boxes = |c: usize| {
        (0..3).map(|i| (i as f64, [0.2, 0.6, 1.0, 1.7, 4.0].map(|q| q * (1.0 + (i + c) as f64)))).collect()
    };
    Chart::new("Errors", Axis::categories("split", names), Axis::log("absolute error / %"))
        .series(Series::new("OLP", Mark::Boxes(boxes(1))).color(1))
        .series(Series::new("network", Mark::Boxes(boxes(0))).color(0))
        .rule(Rule::Horizontal(5.0, "noise of the clock".into()))
}

fn matrix() -> Chart {
    let scenes = ["zoom", "isovalue sweep", "switching light"].map(str::to_owned).to_vec();
    let points = [(1.0, 0.0), (1.3, 1.0), (2.4, 2.0), (1.1, 0.0)].map(|(x, y)| (x, y, String::new()));
    Chart::new(
        "Worst frame",
        Axis::linear("largest t / T").from(0.0).to(2.0),
        Axis::categories("scene", scenes),
    )
    .size(700.0, 220.0)
    .series(Series::new("hybrid", Mark::Points(points.to_vec())).color(0))
    .rule(Rule::Vertical(1.0, "target".into()))
}

fn empty() -> Chart {
    Chart::new("Nothing measured", Axis::log("x"), Axis::linear("y")).size(500.0, 200.0)
}

/// Returns a chart of each kind, with its name.
pub fn samples() -> Vec<(&'static str, Chart)> {
    vec![
        ("frames", frames()),
        ("palette", palette()),
        ("steps", steps()),
        ("scatter", scatter()),
        ("frontier", frontier()),
        ("boxes", boxes()),
        ("matrix", matrix()),
        ("empty", empty()),
    ]
}

/// Returns a page with every chart.
pub fn page() -> Page {
    let mut page = Page::new("Every kind of chart", "The charts and tables that reports may contain.");
    for (name, chart) in samples() {
        page.heading(name);
        page.chart(&chart, "A caption: the content of the chart, and the origin of its numbers.");
    }
    let mut table = Table::new(vec![Column::text("controller"), Column::number("misses / %")]);
    table.row(vec!["fixed".into(), "50.0".into()]);
    table.row(vec!["hybrid".into(), "2.5".into()]);
    table.mark_best(1, &[50.0, 2.5], true);
    page.table(&table, "Best of each column in bold.");
    page.facts([("machine", "2 cores".to_owned()), ("clock", "monotonic".to_owned())]);
    page
}

fn main() -> anyhow::Result<()> {
    let folder = PathBuf::from(std::env::args_os().nth(1).unwrap_or_else(|| "charts".into()));
    std::fs::create_dir_all(&folder)?;
    for (name, chart) in samples() {
        std::fs::write(folder.join(name).with_extension("svg"), chart.to_svg_file())?;
    }
    page().write(&folder.join("report.html"))?;
    println!("wrote {}", folder.join("report.html").display());
    Ok(())
}
