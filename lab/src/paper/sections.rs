//! Our counterpart of each table and figure of the paper.

use super::cases::{NODES, RECORDED};
use super::control;
use super::description::{BY_VOLUMES, Label, Panel, Paper};
use super::encode::{ALL, SHIPPED};
use super::judge::NETWORK;
use super::results::{CONSTANT, Curve, DRAWN_CHART, LVRP, Material, ORBIT_CHART, Results, SORTED, box_of};
use super::section::{Section, distributions, errors_table, overall, ratio, seconds, title, with_interval};
use super::tuning::MACHINES;
use super::volumes::in_words;
use entire_report::{Axis, Chart, Mark, Series, Table};
use std::collections::{BTreeMap, BTreeSet};

/// Returns our counterpart of a table or figure of the paper, from the available results.
pub(super) fn section(paper: &Paper, label: &Label, material: &Material) -> Section {
    let of: Vec<&Results> = material.all.iter().filter(|r| r.panel == label.panel).collect();
    let mut s = Section::default();
    match label.label.as_str() {
        "tab:dataset" => times(paper, &of, &mut s),
        "tab:overall" => overall(paper, &of, &mut s),
        "fig:error_distribution" => distributions(paper, &of, &mut s),
        "fig:nyx_results" => varied_curves(paper, &of, &mut s),
        "fig:time_vis" => orbits(paper, &of, &mut s),
        "tab:quantitative" | "tab:ablation" | "tab:prednet_select_1" => each(paper, &of, &mut s),
        "fig:num_sample_search" => samples(paper, &of, &mut s),
        "tab:feature_select_1" | "tab:feature_select_2" => {
            encoders(paper, &of, &mut s);
            reconstructions(paper, material, &mut s);
        }
        "tab:final_select" => finalists(paper, &of, &mut s),
        "fig:umap_dataset" => codes(&of, &mut s),
        "fig:fine_tune_overall" => tuning(&of, &mut s),
        "fig:fine_tune_qualitative" => tuned_frames(&of, &mut s),
        "fig:control" => control::section(&of, &mut s),
        "fig:control_methods" => control::response_section(&of, &mut s),
        "fig:loadbalancing" => balancing(paper, &of, &mut s),
        "fig:data_evolve" => pictures(&of, "over time", material, &mut s),
        "fig:dataset" => pictures(&of, "rendering", material, &mut s),
        "fig:control_poses" => pictures(&of, "pose", material, &mut s),
        "fig:volunenet_reconstruction" => pictures(&of, "reconstruction", material, &mut s),
        _ => {}
    }
    if let Some(path) = &label.picture {
        s.pictures.push((path.display().to_string(), label.title.clone()));
        s.summary = "a picture".into();
    }
    let mut devices: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for r in of.iter().filter(|r| !r.device.is_empty()) {
        devices.entry(&r.device).or_default().insert(&r.machine);
    }
    if s.there() {
        for (device, machines) in devices {
            let machines: Vec<_> = machines.into_iter().collect();
            let machines = machines.join("; ");
            s.notes.push(format!("Machines that rendered frames with the device `{device}`: {machines}."));
        }
    }
    s
}

/// The split of the results that a section shows: the paper's if the results hold it, else that by random
/// volumes.
fn split_of(paper: &Paper, r: &Results) -> &'static str {
    let rule = paper.rule(&r.set).split();
    if r.rows.iter().any(|x| x.split == rule) { rule } else { BY_VOLUMES }
}

fn each(paper: &Paper, of: &[&Results], s: &mut Section) {
    for r in of.iter().filter(|r| !r.rows.is_empty()) {
        let split = split_of(paper, r);
        let frames = r.frames.get(split).map_or(String::new(), |f| {
            let split = in_words(split);
            let [training, validation, test] = f;
            format!(
                " The split by {split} has {training} training, {validation} validation and {test} test \
                 frames."
            )
        });
        let more = match r.panel {
            Panel::Varied => {
                " The table has the errors on the test frames of four experiments. In each, one parameter \
                 varies; the column `tested on` names it."
            }
            Panel::Samples => {
                " A number in the column `predictor` is the share of the training frames on which the \
                 network was trained."
            }
            _ => "",
        };
        let caption = format!("{}.{frames} {}.{more}", title(paper, r), r.encoder);
        s.tables.push((errors_table(r), caption));
        let found = r.row(split, NETWORK).or_else(|| r.rows.iter().find(|x| x.name == NETWORK));
        if let Some(row) = found {
            s.summary = format!("{}: {} ± {} s", title(paper, r), seconds(row.rmse), seconds(row.rmse_sd));
        } else if let Some(best) = r
            .rows
            .iter()
            .filter(|x| x.name != CONSTANT && x.name != LVRP)
            .min_by(|a, b| a.rmse.total_cmp(&b.rmse))
        {
            s.summary = format!("{}: best {} with {} s", title(paper, r), best.name, seconds(best.rmse));
        }
    }
}

fn times(paper: &Paper, of: &[&Results], s: &mut Section) {
    let mut table = Table::headed(
        "data set, renderer | #members | #volumes | #voxels | #frames | #mean time, s | #SD, s",
    );
    let mut parts = Vec::new();
    for r in of {
        let Some(times) = r.fact("times") else { continue };
        let v = |k: &str| times.get(k).copied().unwrap_or(0.0);
        table.row(vec![
            title(paper, r).into(),
            v("members").to_string().into(),
            v("volumes").to_string().into(),
            format!("{}×{}×{}", v("x"), v("y"), v("z")).into(),
            v("frames").to_string().into(),
            seconds(v("mean")).into(),
            seconds(v("sd")).into(),
        ]);
        parts.push(format!("{} {} ({})", title(paper, r), seconds(v("mean")), seconds(v("sd"))));
    }
    if !parts.is_empty() {
        let what = "The column `voxels` has the size of each rendered volume. SD is the standard deviation \
                    of the frame times.";
        s.tables.push((table, what.into()));
        s.summary = parts.join("; ");
    }
}

/// Adds a line for each curve to a chart, each in another color.
fn lines<'a>(chart: Chart, curves: impl IntoIterator<Item = &'a Curve>) -> Chart {
    curves.into_iter().enumerate().fold(chart, |chart, (i, c)| {
        chart.series(Series::new(c.name.as_str(), Mark::Line(c.points.clone())).color(i))
    })
}

/// Adds a chart for each experiment in which one parameter varies.
fn varied_curves(paper: &Paper, of: &[&Results], s: &mut Section) {
    for r in of {
        let names: BTreeSet<&str> = r.curves.iter().map(|c| c.chart.as_str()).collect();
        for name in names.into_iter().filter(|name| ![ORBIT_CHART, DRAWN_CHART].contains(name)) {
            let of: Vec<&Curve> = r.curves.iter().filter(|c| c.chart == name).collect();
            let x = of.first().map_or("", |c| c.x.as_str());
            let title = format!("{}: {name}", title(paper, r));
            let chart = lines(Chart::new(title, Axis::linear(x), Axis::linear("seconds")), of);
            let what = "In each chart, one parameter of the scene varies, and all other parameters are \
                        constant. The predictions are those of the first training run.";
            s.charts.push((chart, what.into()));
        }
        s.summary = format!("{}: 4 experiments with measured, predicted and LVRP's times", title(paper, r));
    }
}

/// Adds charts of the times of each volume along an orbit.
fn orbits(paper: &Paper, of: &[&Results], s: &mut Section) {
    for r in of {
        let shown: Vec<&Curve> = r.curves.iter().filter(|c| c.chart == DRAWN_CHART).collect();
        let Some(first) = shown.first() else { continue };
        s.summary = format!("{}: {} volumes along an orbit", title(paper, r), shown.len());
        let chart = Chart::new(title(paper, r), Axis::linear(&first.x), Axis::log("seconds"));
        let what = "Each line has the frame times of one volume at the camera poses of an orbit. Each pose \
                    has its own random transfer function.";
        s.charts.push((lines(chart, shown), what.into()));
    }
}

fn samples(paper: &Paper, of: &[&Results], s: &mut Section) {
    for r in of {
        let shares = r.rows.iter().filter_map(|row| Some((*row.more.get("share")?, row)));
        let points: Vec<_> = shares.clone().map(|(x, row)| (x, row.rmse)).collect();
        let band = shares.map(|(x, row)| (x, row.rmse - row.rmse_sd, row.rmse + row.rmse_sd)).collect();
        if points.is_empty() {
            continue;
        }
        let x = Axis::linear("share of the training frames");
        let chart = Chart::new(title(paper, r), x, Axis::linear("RMSE, s"))
            .series(Series::new("± standard deviation", Mark::Band(band)).color(0))
            .series(Series::new("mean over runs", Mark::Line(points)).color(0));
        s.charts.push((chart, "Each run uses its own random selection of the training frames.".into()));
    }
    each(paper, of, s);
}

fn encoders(paper: &Paper, of: &[&Results], s: &mut Section) {
    for r in of.iter().filter(|r| r.rows.iter().any(|x| x.more.contains_key("size"))) {
        let mut table = Table::headed(
            "encoder | #PSNR of training volumes, dB | #PSNR of validation volumes, dB | \
             #PSNR of test volumes, dB | #time to encode a volume, ms | #RMSE of PredNet, s | \
             #SD of the RMSE over runs, s | #RMSE / RMSE of the mean of 15 % | #epochs of the encoder",
        );
        for row in r.rows.iter().filter(|x| x.more.contains_key("size")) {
            let db = |k: &str| row.more.get(k).map(|v| format!("{v:.2}"));
            table.row(vec![
                row.name.as_str().into(),
                db("psnr train").into(),
                db("psnr validation").into(),
                db("psnr test").into(),
                row.latency.map(|l| format!("{:.2}", 1e3 * l)).into(),
                seconds(row.rmse).into(),
                row.spread().map(seconds).into(),
                with_interval(row.over_constant, r.over_constant_interval(row)).into(),
                row.more.get("epochs").map(|e| format!("{e:.0}")).into(),
            ]);
        }
        s.tables.push((
            table,
            format!("{}: PredNet {} was trained with each encoder.", title(paper, r), paper.encoder_depth),
        ));
    }
}

fn reconstructions(paper: &Paper, material: &Material, s: &mut Section) {
    if material.reconstructions.iter().all(|r| r.encoder.set == SHIPPED) {
        return;
    }
    let mut table = Table::headed(
        "data set | encoder | channels | #PSNR of training volumes, dB | #PSNR of validation volumes, dB | \
         #PSNR of test volumes, dB | #epochs | #duration of the training, s | \
         reason for the end of the training",
    );
    let mut best = Vec::new();
    for r in &material.reconstructions {
        let e = &r.encoder;
        let parts = ["train", "validation", "test"];
        let together = [ALL, SHIPPED].contains(&e.set.as_str());
        let of_all =
            if e.set == SHIPPED { "shipped encoder of all data sets" } else { "encoder of all data sets" };
        let sets: Vec<&str> = if together {
            paper.data_sets.iter().map(|d| d.name.as_str()).collect()
        } else {
            vec![e.set.as_str()]
        };
        for set in sets {
            if r.record.psnr("train", set).is_none() {
                continue;
            }
            let widths: Vec<String> = e.channels.iter().map(ToString::to_string).collect();
            let mut cells = vec![
                if together { format!("{set}: {of_all}") } else { set.to_owned() }.into(),
                format!("{}³F{}", e.size, e.features).into(),
                if widths.is_empty() { "default".into() } else { widths.join("-") }.into(),
            ];
            cells.extend(parts.map(|p| r.record.psnr(p, set).map(|v| format!("{v:.2}")).into()));
            cells.push(r.record.provenance.epochs_run.to_string().into());
            cells.push((e.set != SHIPPED).then(|| format!("{:.0}", r.record.seconds)).into());
            cells.push(r.record.provenance.stopped.as_str().into());
            table.row(cells);
        }
        if let Some(v) =
            r.psnr().filter(|_| (e.size, e.features) == paper.encoders.main && e.channels.is_empty())
        {
            best.push(format!("{} {}³F{} {v:.1} dB", e.set, e.size, e.features));
        }
    }
    let what = "The table has the mean PSNR (peak signal-to-noise ratio) of reconstructed volumes. For the \
                shipped encoders, the validation and test volumes are whole ensemble members. For any \
                other encoder, these volumes are those of the split on which it was trained.";
    s.tables.push((table, what.into()));
    s.summary = if best.is_empty() { "encoders of other sizes".into() } else { best.join("; ") };
}

fn finalists(paper: &Paper, of: &[&Results], s: &mut Section) {
    // Results that compare architectures: the name of an architecture holds an arrow.
    let shown: Vec<&&Results> = of.iter().filter(|r| r.rows.iter().any(|x| x.name.contains('→'))).collect();
    let Some(first) = shown.first() else { return };
    let names: Vec<&str> =
        first.rows.iter().filter(|x| x.name.contains('→')).map(|x| x.name.as_str()).collect();
    let columns: String = names.iter().map(|n| format!(" | #{n}: RMSE, s | #RD, %")).collect();
    let mut table = Table::headed(&format!("data set, renderer{columns}"));
    let mut deviations = vec![Vec::new(); names.len()];
    for r in &shown {
        let errors: Vec<Option<f64>> =
            names.iter().map(|n| Some(r.row(split_of(paper, r), n)?.rmse)).collect();
        let best = errors.iter().flatten().copied().fold(f64::INFINITY, f64::min);
        let mut cells = vec![title(paper, r).into()];
        for (i, e) in errors.iter().enumerate() {
            cells.push(e.map(seconds).into());
            cells.push(e.map(|e| format!("{:.1}", 100.0 * (e / best - 1.0))).into());
            deviations[i].extend(e.map(|e| e / best - 1.0));
        }
        table.row(cells);
    }
    let mut cells = vec!["mean relative deviation".into()];
    for d in &deviations {
        cells.push("".into());
        cells.push(format!("{:.1}", 100.0 * d.iter().sum::<f64>() / d.len().max(1) as f64).into());
    }
    table.row(cells);
    let what = "An arrow joins an encoder and a PredNet. RD, the relative deviation, is the RMSE divided by \
                the smallest RMSE of the row, minus 1.";
    s.tables.push((table, what.into()));
    s.summary = format!("{} on {} data sets and renderers", names.join(" and "), shown.len());
}

fn codes(of: &[&Results], s: &mut Section) {
    for (chart, encoder) in [
        ("features, own", "each data set's own encoder"),
        ("features, shipped", "the shipped encoder of all data sets"),
    ] {
        let curves: Vec<&Curve> =
            of.iter().filter(|r| r.mode != super::description::YT).flat_map(|r| &r.curves).collect();
        let mut seen = BTreeSet::new();
        let of: Vec<&&Curve> =
            curves.iter().filter(|c| c.chart == chart && seen.insert(c.name.as_str())).collect();
        if of.is_empty() {
            continue;
        }
        let title = format!("Feature vectors by {encoder}");
        let mut drawn =
            Chart::new(title, Axis::linear("feature 1"), Axis::linear("feature 2")).size(860.0, 420.0);
        for (i, c) in of.iter().enumerate() {
            let points = c.points.iter().map(|p| (p.0, p.1, String::new())).collect();
            drawn = drawn.series(Series::new(c.name.as_str(), Mark::Points(points)).color(i));
        }
        let what =
            "Each dot is a volume. Feature vectors have two numbers, so they are drawn without a projection.";
        s.charts.push((drawn, what.into()));
        s.summary = format!("{} ensemble members", of.len());
    }
}

fn tuning(of: &[&Results], s: &mut Section) {
    for r in of {
        let frames = r.frames.get("pre-training").map_or(0, |f| f[0]);
        let pretrained = format!("{} ({frames} frames).", r.encoder);
        let machine = if r.set == MACHINES {
            format!(" The pre-training frames were measured on: {}.", r.machine)
        } else {
            String::new()
        };
        let names: BTreeSet<&str> =
            r.curves.iter().filter(|c| c.x != SORTED).map(|c| c.chart.as_str()).collect();
        for name in names {
            let chart = Chart::new(name, Axis::log("training frames"), Axis::log("RMSE, s, median of runs"));
            let of = r.curves.iter().filter(|c| c.chart == name && c.x != SORTED);
            let what = format!("Fine-tuning starts from the pre-trained network. {pretrained}");
            s.charts.push((lines(chart, of), format!("{what}{machine}")));
        }
        let mut table = Table::headed(
            "target | #RMSE of the pre-trained network, s | #RMSE of ours, pre-trained, s | \
             #RMSE of the mean of the target's training frames, s | #SD of the times, s | #test frames",
        );
        for f in &r.facts {
            let v = |k: &str| f.values.get(k).map(|v| seconds(*v));
            table.row(vec![
                f.name.as_str().into(),
                v("pre-trained, as it was").into(),
                v("ours, as it was").into(),
                v("mean").into(),
                v("sd").into(),
                f.values.get("judged on").map(|v| format!("{v}")).into(),
            ]);
        }
        if !r.facts.is_empty() {
            let what = "The models were pre-trained without any frame of the renderer, device \
                        or data set in the column `target`.";
            s.tables.push((table, format!("{what} {pretrained}{machine}")));
        }
        let mut few = Table::headed("target | predictor | #training frames | #RMSE, s");
        let points =
            r.curves.iter().filter(|c| c.x != SORTED).flat_map(|c| c.points.iter().map(move |p| (c, p)));
        for (c, (frames, rmse)) in points {
            let cells = [c.chart.clone(), c.name.clone(), frames.to_string(), seconds(*rmse)];
            few.row(cells.map(Into::into).to_vec());
        }
        if !r.curves.is_empty() {
            let what = "Each model was trained on some frames of the renderer, device or data set in the \
                        column `target`. `fine-tuned` continues the training of the pre-trained network; \
                        `from nothing` is a new network. `ours, calibrated` is the pre-trained predictor of \
                        this project, calibrated to these frames; some stored results name it \
                        `ours, transferred`. The RMSE is the median of the runs.";
            s.tables.push((few, format!("{what}{machine}")));
        }
    }
    s.summary = of.iter().flat_map(|r| &r.facts).map(|f| f.name.as_str()).collect::<Vec<_>>().join(", ");
}

/// For each fine-tuning target, adds charts of the times of single frames.
fn tuned_frames(of: &[&Results], s: &mut Section) {
    let mut all: Vec<&str> = Vec::new();
    for r in of {
        let names: BTreeSet<&str> =
            r.curves.iter().filter(|c| c.x == SORTED).map(|c| c.chart.as_str()).collect();
        for name in &names {
            let chart = Chart::new(*name, Axis::linear(SORTED), Axis::log("seconds"));
            let chart = lines(chart, r.curves.iter().filter(|c| c.x == SORTED && c.chart == *name));
            let what = "Each chart shows test frames of one renderer, device or data set: their measured \
                        times, and the times that the models of the first training run predict.";
            s.charts.push((chart, what.into()));
        }
        all.extend(names);
    }
    if !all.is_empty() {
        s.summary = format!("frames of {}", all.join(", "));
    }
}

fn balancing(paper: &Paper, of: &[&Results], s: &mut Section) {
    for r in of {
        let mut methods: Vec<&str> = Vec::new();
        for f in &r.facts {
            if !methods.contains(&f.name.as_str()) {
                methods.push(&f.name);
            }
        }
        let mut chart = Chart::new(
            title(paper, r),
            Axis::categories("nodes", NODES.iter().map(ToString::to_string).collect()),
            Axis::linear("load / slowest load under GT"),
        );
        let columns: String = methods.iter().map(|m| format!(" | #{m}")).collect();
        let mut table = Table::headed(&format!("nodes{columns}"));
        let fact = |name: &str, nodes: usize| {
            r.facts.iter().find(|f| f.name == name && f.values.get("nodes") == Some(&(nodes as f64)))
        };
        for (k, name) in methods.iter().enumerate() {
            let boxes = NODES
                .iter()
                .enumerate()
                .filter_map(|(i, n)| Some((i as f64, box_of(&fact(name, *n)?.values))))
                .collect();
            chart = chart.series(Series::new(*name, Mark::Boxes(boxes)).color(k));
        }
        let mut worst = 0.0f64;
        for n in NODES {
            let slowest = |m: &str| fact(m, n).and_then(|f| f.values.get("slowest").copied());
            let mut cells = vec![n.to_string().into()];
            cells.extend(methods.iter().map(|m| ratio(slowest(m)).into()));
            if slowest("GT").is_some() {
                table.row(cells);
            }
            worst = worst.max(slowest(NETWORK).unwrap_or(0.0));
        }
        let what = "Each box shows the loads of all nodes, divided by the load of the slowest node under GT.";
        s.charts.push((chart, what.into()));
        let what = "Tasks are assigned to nodes by the times that a column names: measured times (GT, ground \
                    truth), predicted times, or equal times (`uniform`). A node's load is the sum of the \
                    measured times of its tasks. The table has the load of the slowest node, divided by the \
                    load of the slowest node under GT.";
        let which = if r.set == RECORDED {
            let tasks = r.frames.get("tasks").map_or(0, |f| f[2]);
            format!(
                "The {tasks} tasks are the frames of `data/steer/farm.json.gz` at the reference step. \
                 `{NETWORK}` is the network of use case 1."
            )
        } else {
            what.to_owned()
        };
        s.tables.push((table, which));
        s.summary = format!(
            "{}: by the network's times, the slowest node takes at most {:.1} % longer than under GT",
            title(paper, r),
            100.0 * (worst - 1.0)
        );
    }
}

fn pictures(of: &[&Results], what: &str, material: &Material, s: &mut Section) {
    for r in of {
        for (file, caption) in r.pictures.iter().filter(|(_, c)| c.starts_with(what)) {
            if material.pictures.contains_key(file) {
                s.pictures.push((file.clone(), format!("{}, {caption}", r.set)));
            }
        }
    }
    s.summary = format!("{} pictures", s.pictures.len());
}
