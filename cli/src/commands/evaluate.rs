//! `entire evaluate`: measure how well predictors do on collected frames.

use super::train::{INPUTS_BAR, predict_rows, progress_bar, thread_pool, timed};
use crate::bound;
use crate::dataset::{Clock, NoiseFloor, Table as TimingTable, TimedFrame, fnv1a, noise_floor, read_tables};
use crate::inputs::{Layout, measure, open_volume};
use crate::machine;
use crate::metrics::{BoundMetrics, Metrics, bootstrap_by_group, percentile};
use crate::report::{Axis, Chart, Column, Mark, Page, Rule, Series, Table};
use crate::split::{GroupBy, Part, Split};
use anyhow::{Context, Result, ensure};
use entire_core::features::{
    Changes, FrameFeatures, Setting, SummaryOptions, TransferSummary, VolumeSummary,
};
use entire_core::model::Model;
use entire_core::nn::{PredNet, Storage};
use entire_core::predict::{Calibration, GroupKind, Inputs};
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Measure how well predictors do on collected frames.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  entire evaluate --model model.safetensors --data frames.csv
  entire evaluate --model a.safetensors b.safetensors --data frames.csv --unseen --out out/evaluation
        only frames of members or volumes that none of the models learned from, with plots
  entire evaluate --model models/unshaded-taught.safetensors --data data/timings/none-members.csv.gz --storage int8
        what eight-bit weights cost in accuracy")]
pub struct Options {
    /// Model files.
    #[arg(long, required = true, num_args = 1.., value_name = "SAFETENSORS")]
    pub model: Vec<PathBuf>,
    /// Timing tables written by `entire collect`.
    #[arg(long, required = true, num_args = 1.., value_name = "CSV")]
    pub data: Vec<PathBuf>,
    /// Which clock's seconds are compared with.
    #[arg(long, value_enum, default_value_t = Clock::Auto)]
    pub clock: Clock,
    /// Only frames with this shading: none, local or scatter.
    #[arg(long, value_parser = crate::dataset::parse_shading)]
    pub shading: Option<entire_core::scene::Shading>,
    /// Leave out frames of groups that a model was trained or validated on, as its file says.
    #[arg(long)]
    pub unseen: bool,
    /// What rows the second table has.
    #[arg(long, value_enum, default_value_t = GroupBy::Member)]
    pub by: GroupBy,
    /// Folder for evaluation.json, predictions.csv, report.html and the plots as SVG.
    #[arg(long, value_name = "FOLDER")]
    pub out: Option<PathBuf>,
    /// Judge each model also with its weights held in memory as f32, f16, bf16 or int8.
    #[arg(long, num_args = 1.., value_name = "STORAGE", value_parser = parse_storage)]
    pub storage: Vec<Storage>,
    /// Seed of the probes behind the constant baseline.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Threads; all logical processors unless given.
    #[arg(long)]
    pub threads: Option<usize>,
    /// No progress bar.
    #[arg(long)]
    pub quiet: bool,
}

fn parse_storage(text: &str) -> Result<Storage, String> {
    Storage::ALL.into_iter().find(|s| s.name() == text).ok_or_else(|| {
        format!("no storage of weights; there are {}", Storage::ALL.map(Storage::name).join(", "))
    })
}

/// Share of each volume's frames that the constant baseline renders to take their mean (Bruder et al. 2022).
pub const PROBE_SHARE: f64 = 0.15;

/// Warm time of one prediction, in one thread.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Latency {
    /// Median seconds of one prediction, from camera and transfer function to seconds; once-per-volume and
    /// once-per-transfer-function work is apart.
    pub seconds: f64,
    /// Of that, the network's.
    pub network_seconds: f64,
    /// Median seconds of what a new transfer function costs once; 0 where the model does not look at it.
    pub transfer_seconds: f64,
}

#[derive(Clone, Debug, Serialize)]
struct Predictor {
    name: String,
    fnv1a: Option<String>,
    metrics: Metrics,
    by_group: BTreeMap<String, Metrics>,
    latency: Option<Latency>,
    /// Frames of groups that it learned from.
    frames_seen: usize,
    /// Share of frames that took no longer than the upper bound in its file.
    bound_coverage: Option<f64>,
    /// How the upper bound does beyond that: among the slowest tenth, and its quantile loss.
    bound: Option<BoundMetrics>,
    /// 95 % interval of RMSE/SD when ensemble members (volumes that belong to none) are drawn anew with replacement.
    rmse_over_sd_interval: Option<(f64, f64)>,
    /// The same of MdAPE.
    mdape_interval: Option<(f64, f64)>,
    /// Errors by what frames are like.
    by_kind: Vec<(&'static str, Metrics)>,
    #[serde(skip)]
    predicted: Vec<f64>,
}

#[derive(Debug, Serialize)]
struct Evaluation<'a> {
    program: String,
    machine: String,
    date: String,
    load_average: Option<[f64; 3]>,
    data: Vec<String>,
    clock: &'static str,
    shading: Option<&'static str>,
    unseen_only: bool,
    frames: usize,
    noise_floor: Option<NoiseFloor>,
    predictors: &'a [Predictor],
}

struct Loaded {
    name: String,
    hash: u64,
    model: Model,
    layout: Layout,
    split: Option<Split>,
}

fn load(path: &Path) -> Result<Loaded> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let model = Model::from_bytes(&bytes).with_context(|| format!("{}", path.display()))?;
    let layout = Layout::of_model(&model).with_context(|| format!("{}", path.display()))?;
    let split = model
        .provenance()
        .and_then(|text| serde_json::from_str::<serde_json::Value>(text).ok())
        .and_then(|p| serde_json::from_value(p.get("split")?.clone()).ok());
    let name =
        path.file_stem().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned());
    Ok(Loaded { name, hash: fnv1a(&bytes), model, layout, split })
}

impl Loaded {
    fn has_seen(&self, frame: &TimedFrame) -> bool {
        self.split.as_ref().is_some_and(|s| matches!(s.part(&frame.scene), Part::Training | Part::Validation))
    }
}

/// Runs the command.
///
/// # Errors
/// When a model or table cannot be read, a model's inputs cannot be computed, or nothing is left to compare.
pub fn run(options: &Options) -> Result<()> {
    let pool = thread_pool(options.threads)?;
    let models: Vec<Loaded> = options.model.iter().map(|p| load(p)).collect::<Result<_>>()?;
    let tables = read_tables(&options.data)?;
    let mut frames = timed(&tables, options.clock, options.shading)?;
    if options.unseen {
        for m in models.iter().filter(|m| m.split.is_none()) {
            eprintln!("note: {} does not say what it learned from; --unseen cannot leave that out", m.name);
        }
        frames.retain(|(f, _)| !models.iter().any(|m| m.has_seen(f)));
        ensure!(
            !frames.is_empty(),
            "every frame is of a group that a model learned from; give other data, or leave --unseen away"
        );
    }
    let (refs, measured): (Vec<&TimedFrame>, Vec<f64>) = frames.into_iter().unzip();
    let groups: Vec<String> = refs.iter().map(|f| options.by.group(&f.scene)).collect();
    let noise = noise_floor(refs.iter().copied(), options.clock);

    let mut predictors = Vec::new();
    for m in &models {
        let bar = progress_bar(options.quiet, INPUTS_BAR);
        let rows = m.layout.rows(&tables, &refs, &pool, &bar).with_context(|| m.name.clone())?;
        bar.finish_and_clear();
        let predicted = predict_rows(&m.model, &rows, m.layout.width())?;
        let latency = match latency(m, &tables, &refs, &rows) {
            Ok(latency) => Some(latency),
            Err(e) => {
                eprintln!("note: {}: no latency ({e:#})", m.name);
                None
            }
        };
        let seen = refs.iter().filter(|f| m.has_seen(f)).count();
        predictors.push(assess(
            m.name.clone(),
            Some(format!("{:016x}", m.hash)),
            predicted,
            &measured,
            &groups,
            &refs,
            latency,
            seen,
            bound::of(&m.model),
        )?);
    }
    for (m, storage) in models.iter().flat_map(|m| options.storage.iter().map(move |&s| (m, s))) {
        let rows = m.layout.rows(&tables, &refs, &pool, &progress_bar(true, INPUTS_BAR))?;
        let parts = m.model.prednet().with_context(|| format!("{} holds no PredNet", m.name))?;
        let net = PredNet::with_storage(parts, storage)?;
        let mut scratch = net.scratch();
        let predicted = rows
            .chunks_exact(m.layout.width())
            .map(|row| f64::from(net.predict(row, &mut scratch)))
            .collect();
        predictors.push(assess(
            format!("{}, {} weights", m.name, storage.name()),
            None,
            predicted,
            &measured,
            &groups,
            &refs,
            None,
            refs.iter().filter(|f| m.has_seen(f)).count(),
            bound::of(&m.model),
        )?);
    }
    let constant = probe_means(&refs, &measured, options.seed);
    let name = format!("mean of {:.0} % probes per volume", 100.0 * PROBE_SHARE);
    predictors.push(assess(name, None, constant, &measured, &groups, &refs, None, 0, None)?);

    let evaluation = Evaluation {
        program: format!("entire {}", machine::version()),
        machine: machine::machine(),
        date: machine::now(),
        load_average: machine::load_average(),
        data: options.data.iter().map(|p| p.display().to_string()).collect(),
        clock: options.clock.name(),
        shading: options.shading.map(|s| s.name()),
        unseen_only: options.unseen,
        frames: refs.len(),
        noise_floor: noise,
        predictors: &predictors,
    };
    let (overall, bias, by_group) = tables_of(&predictors, options.by);
    println!("{}", overall.to_text());
    let more = detail_table(&predictors);
    println!("{}", more.to_text());
    println!("median of predicted / measured - 1 by tenth of the frames, fastest first, %");
    println!("{}", bias.to_text());
    println!("{}", by_group.to_text());
    println!("{}", noise_text(noise));
    if let Some(out) = &options.out {
        write_report(out, &evaluation, &refs, &measured, &groups, [&overall, &bias, &by_group, &more])?;
        println!("wrote {}", out.join("report.html").display());
    }
    Ok(())
}

fn noise_text(noise: Option<NoiseFloor>) -> String {
    match noise {
        Some(n) => format!(
            "noise floor: repeats of one frame scatter with a log-SD of {:.4} (median of repeats about {:.4}), {} repeated frames",
            n.log_sd, n.log_sd_of_median, n.frames
        ),
        None => "noise floor: not known, no frame was repeated".into(),
    }
}

#[allow(clippy::too_many_arguments, reason = "one call site per kind of predictor")]
fn assess(
    name: String,
    fnv1a: Option<String>,
    predicted: Vec<f64>,
    measured: &[f64],
    groups: &[String],
    frames: &[&TimedFrame],
    latency: Option<Latency>,
    frames_seen: usize,
    upper: Option<Calibration>,
) -> Result<Predictor> {
    let metrics = Metrics::new(&predicted, measured).context("there are no frames to compare")?;
    let mut pairs: BTreeMap<&str, (Vec<f64>, Vec<f64>)> = BTreeMap::new();
    for ((p, t), g) in predicted.iter().zip(measured).zip(groups) {
        let (ps, ts) = pairs.entry(g).or_default();
        ps.push(*p);
        ts.push(*t);
    }
    let by_group =
        pairs.into_iter().filter_map(|(g, (p, t))| Some((g.to_owned(), Metrics::new(&p, &t)?))).collect();
    let bound = upper.and_then(|u| bound::judge(&u, &predicted, measured));
    let bound_coverage = bound.as_ref().map(|b| b.coverage);
    let members: Vec<String> = frames.iter().map(|f| GroupBy::Member.group(&f.scene)).collect();
    let interval =
        |f: fn(&Metrics) -> f64| bootstrap_by_group(&predicted, measured, &members, BOOTSTRAP_ROUNDS, f);
    let (rmse_over_sd_interval, mdape_interval) = (interval(|m| m.rmse_over_sd), interval(|m| m.mdape));
    let by_kind = by_kind(frames, &predicted, measured);
    Ok(Predictor {
        name,
        fnv1a,
        metrics,
        by_group,
        latency,
        frames_seen,
        bound_coverage,
        bound,
        rmse_over_sd_interval,
        mdape_interval,
        by_kind,
        predicted,
    })
}

/// Rounds behind the intervals over members drawn anew.
const BOOTSTRAP_ROUNDS: usize = 400;

/// Errors by image size, by whether the eye is near or inside the volume, and by ray step; kinds without frames are left out.
pub(crate) fn by_kind(
    frames: &[&TimedFrame],
    predicted: &[f64],
    measured: &[f64],
) -> Vec<(&'static str, Metrics)> {
    type Test = fn(&TimedFrame) -> bool;
    fn pixels(f: &TimedFrame) -> u64 {
        u64::from(f.scene.width) * u64::from(f.scene.height)
    }
    let kinds: [(&'static str, Test); 6] = [
        ("under 128² pixels", |f| pixels(f) < 128 * 128),
        ("128² to 512² pixels", |f| (128 * 128..512 * 512).contains(&pixels(f))),
        ("512² pixels and more", |f| pixels(f) >= 512 * 512),
        ("eye within 1 radius", |f| f.scene.camera.dz <= 1.0),
        ("finer than the reference step", |f| f.scene.step < 1.0),
        ("coarser than the reference step", |f| f.scene.step > 1.0),
    ];
    kinds
        .into_iter()
        .filter_map(|(name, test)| {
            let (p, t): (Vec<f64>, Vec<f64>) = frames
                .iter()
                .zip(predicted.iter().zip(measured))
                .filter(|(f, _)| test(f))
                .map(|(_, (p, t))| (*p, *t))
                .unzip();
            Some((name, Metrics::new(&p, &t)?))
        })
        .collect()
}

/// For each frame the mean time of a random share of its volume's frames, those probes included.
pub(crate) fn probe_means(frames: &[&TimedFrame], measured: &[f64], seed: u64) -> Vec<f64> {
    let mut by_volume: BTreeMap<(usize, &str), Vec<usize>> = BTreeMap::new();
    for (i, f) in frames.iter().enumerate() {
        by_volume.entry((f.table, &f.scene.volume)).or_default().push(i);
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut means = vec![0.0; frames.len()];
    for members in by_volume.into_values() {
        let mut order = members.clone();
        order.shuffle(&mut rng);
        order.truncate(((PROBE_SHARE * members.len() as f64).ceil() as usize).max(1));
        let mean = order.iter().map(|&i| measured[i]).sum::<f64>() / order.len() as f64;
        for i in members {
            means[i] = mean;
        }
    }
    means
}

/// Warm latency over frames of the first volume: each stage by itself, median over many calls.
///
/// # Errors
/// When the model looks at the scene and that volume is not there: features kept beside a table tell what they are, not
/// what they cost.
fn latency(m: &Loaded, tables: &[TimingTable], frames: &[&TimedFrame], rows: &[f32]) -> Result<Latency> {
    const FRAMES: usize = 64;
    const ROUNDS: usize = 40;
    let first = frames.first().context("there are no frames to compare")?;
    let of_volume: Vec<&TimedFrame> = frames
        .iter()
        .filter(|f| f.table == first.table && f.scene.volume == first.scene.volume)
        .take(FRAMES)
        .copied()
        .collect();
    let parts = m.model.prednet().context("the model file holds no PredNet")?;
    let net = PredNet::new(parts)?;
    let mut scratch = net.scratch();
    let median = |mut times: Vec<f64>| {
        times.sort_by(f64::total_cmp);
        percentile(&times, 0.5)
    };
    let width = m.layout.width();
    let mut times = Vec::new();
    for _ in 0..ROUNDS {
        for row in rows.chunks_exact(width).take(FRAMES) {
            let start = Instant::now();
            std::hint::black_box(net.predict(std::hint::black_box(row), &mut scratch));
            times.push(start.elapsed().as_secs_f64());
        }
    }
    let network_seconds = median(times);
    let code = vec![0.0; m.model.volumenet().map_or(0, |v| v.features())];
    let looks = m.layout.groups().any(|g| g == GroupKind::SceneFeatures);
    let serial = thread_pool(Some(1))?;
    let hidden = indicatif::ProgressBar::hidden();
    let mut row = vec![0.0f32; width];
    if !looks {
        let times = measure(tables, &of_volume, None, None, &serial, &hidden, |_, inputs| {
            let mut row = vec![0.0f32; width];
            let inputs = Inputs { volume_features: Some(&code), ..*inputs };
            let start = Instant::now();
            for _ in 0..ROUNDS {
                m.layout.write(std::hint::black_box(&inputs), &mut row)?;
                std::hint::black_box(&row);
            }
            Ok(start.elapsed().as_secs_f64() / ROUNDS as f64)
        })?;
        return Ok(Latency {
            seconds: median(times) + network_seconds,
            network_seconds,
            transfer_seconds: 0.0,
        });
    }
    let volume = open_volume(&tables[first.table], &first.scene.volume, first.scene.dims)?;
    let summary = VolumeSummary::new(&volume.view(), SummaryOptions::default())?;
    let mut features = FrameFeatures::with_probe_side(m.layout.probe_side());
    let (mut all, mut transfer_times) = (Vec::new(), Vec::new());
    for f in of_volume {
        let (frame, table) = (f.scene.to_frame()?, f.scene.to_table()?);
        let mut transfer = TransferSummary::new(&summary, &table);
        let start = Instant::now();
        transfer.update(&summary, std::hint::black_box(&table));
        if f.scene.skipping == entire_core::scene::Skipping::Distance {
            transfer.prepare_distance();
        }
        transfer_times.push(start.elapsed().as_secs_f64());
        let setting = Setting::of(&frame);
        for _ in 0..ROUNDS {
            let start = Instant::now();
            features.measure(&summary, &transfer, std::hint::black_box(&frame));
            let inputs = Inputs {
                features: &features,
                setting,
                changes: Changes::NONE,
                camera: f.scene.camera,
                volume_features: Some(&code),
                lobes: Some(&f.scene.lobes),
            };
            m.layout.write(&inputs, &mut row)?;
            std::hint::black_box(net.predict(&row, &mut scratch));
            all.push(start.elapsed().as_secs_f64());
        }
    }
    Ok(Latency { seconds: median(all), network_seconds, transfer_seconds: median(transfer_times) })
}

fn tables_of(predictors: &[Predictor], by: GroupBy) -> (Table, Table, Table) {
    let percent = |v: f64| format!("{:.2}", 100.0 * v);
    let mut overall = Table::new(vec![
        Column::text("predictor"),
        Column::number("frames"),
        Column::number("of them seen"),
        Column::number("RMSE, s"),
        Column::number("RMSE/SD"),
        Column::number("MAE, s"),
        Column::number("MdAPE, %"),
        Column::number("p95, %"),
        Column::number("p99, %"),
        Column::number("R² in log"),
        Column::number("within bound, %"),
        Column::number("µs per prediction"),
        Column::number("of that network"),
        Column::number("µs per transfer function"),
    ]);
    for p in predictors {
        let m = &p.metrics;
        let micro =
            |f: fn(&Latency) -> f64| p.latency.as_ref().map_or("-".into(), |l| format!("{:.2}", 1e6 * f(l)));
        overall.row(vec![
            p.name.clone().into(),
            m.frames.to_string().into(),
            p.frames_seen.to_string().into(),
            format!("{:.3e}", m.rmse).into(),
            format!("{:.3}", m.rmse_over_sd).into(),
            format!("{:.3e}", m.mae).into(),
            percent(m.mdape).into(),
            percent(m.p95).into(),
            percent(m.p99).into(),
            format!("{:.4}", m.r2_log).into(),
            p.bound_coverage.map_or("-".into(), |c| format!("{:.1}", 100.0 * c)).into(),
            micro(|l| l.seconds).into(),
            micro(|l| l.network_seconds).into(),
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

    let deciles = predictors.iter().map(|p| p.metrics.bias_by_decile.len()).max().unwrap_or(0);
    let mut columns = vec![Column::text("predictor")];
    columns.extend((1..=deciles).map(|d| Column::number(format!("tenth {d}"))));
    let mut bias = Table::new(columns);
    for p in predictors {
        let mut row = vec![p.name.clone().into()];
        row.extend(p.metrics.bias_by_decile.iter().map(|b| format!("{:+.1}", 100.0 * b).into()));
        bias.row(row);
    }

    let mut columns = vec![Column::text(by.name()), Column::number("frames")];
    for p in predictors {
        columns.push(Column::number(format!("RMSE/SD, {}", p.name)));
        columns.push(Column::number(format!("MdAPE %, {}", p.name)));
    }
    let mut by_group = Table::new(columns);
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

/// Intervals, the upper bound and errors by kind of frame.
fn detail_table(predictors: &[Predictor]) -> Table {
    let mut kinds: Vec<&str> = Vec::new();
    for (name, _) in predictors.iter().flat_map(|p| &p.by_kind) {
        if !kinds.contains(name) {
            kinds.push(name);
        }
    }
    let mut columns = vec![
        Column::text("predictor"),
        Column::number("RMSE/SD, 95 % interval"),
        Column::number("MdAPE %, 95 % interval"),
        Column::number("bound held in slowest tenth, %"),
        Column::number("pinball / mean time"),
    ];
    columns.extend(kinds.iter().map(|k| Column::number(format!("MdAPE %, {k}"))));
    let mut table = Table::new(columns);
    for p in predictors {
        let range = |i: Option<(f64, f64)>, scale: f64, digits: usize| {
            i.map_or("-".to_owned(), |(a, b)| format!("{:.digits$}–{:.digits$}", scale * a, scale * b))
        };
        let mut row = vec![
            p.name.clone().into(),
            range(p.rmse_over_sd_interval, 1.0, 3).into(),
            range(p.mdape_interval, 100.0, 1).into(),
            p.bound.map_or("-".into(), |b| format!("{:.1}", 100.0 * b.slowest_coverage)).into(),
            p.bound.map_or("-".into(), |b| format!("{:.4}", b.pinball)).into(),
        ];
        for kind in &kinds {
            let m = p.by_kind.iter().find(|(k, _)| k == kind);
            row.push(m.map_or("-".into(), |(_, m)| format!("{:.2}", 100.0 * m.mdape)).into());
        }
        table.row(row);
    }
    table
}

fn scatter(p: &Predictor, measured: &[f64], color: usize) -> Chart {
    let points = measured.iter().zip(&p.predicted).map(|(t, y)| (*t, *y, String::new())).collect();
    Chart::new(
        format!("{}: predicted against measured", p.name),
        Axis::log("measured, s"),
        Axis::log("predicted, s"),
    )
    .size(620.0, 480.0)
    .rule(Rule::Diagonal("exact".into()))
    .series(Series::new("", Mark::Points(points)).color(color))
}

/// Share of frames by predicted / measured, on bins of equal ratio between a half and twice; the outermost bins hold
/// everything beyond.
fn histogram(predictors: &[Predictor], measured: &[f64]) -> Chart {
    const BINS: usize = 41;
    let span = 2f64.ln();
    let mut chart = Chart::new(
        "How predicted / measured is spread",
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
        "Bias by tenth of the frames, fastest first",
        Axis::linear("tenth of the frames by measured time"),
        Axis::linear("bias, %"),
    )
    .rule(Rule::Horizontal(0.0, String::new()));
    // The constant baseline's bias is hundreds of percent at one end: it would flatten all others.
    for (i, p) in predictors.iter().enumerate().filter(|(_, p)| p.latency.is_some()) {
        let line =
            p.metrics.bias_by_decile.iter().enumerate().map(|(d, b)| ((d + 1) as f64, 100.0 * b)).collect();
        chart = chart.series(Series::new(p.name.clone(), Mark::Line(line)).color(i));
    }
    chart
}

fn write_report(
    out: &Path,
    evaluation: &Evaluation<'_>,
    frames: &[&TimedFrame],
    measured: &[f64],
    groups: &[String],
    [overall, bias, by_group, more]: [&Table; 4],
) -> Result<()> {
    std::fs::create_dir_all(out).with_context(|| format!("cannot make {}", out.display()))?;
    let write = |name: &str, text: &str| {
        let path = out.join(name);
        std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))
    };
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
    write("predictions.csv", &String::from_utf8_lossy(&csv))?;

    let lead = format!(
        "{} frames, clock {}. {}",
        evaluation.frames,
        evaluation.clock,
        noise_text(evaluation.noise_floor)
    );
    let mut page = Page::new("Evaluation of predictors", &lead);
    page.table(
        overall,
        "RMSE over SD is 1 for a predictor that always says the mean. MdAPE: median absolute percentage error. Latency: \
         median of warm calls in one thread, scene features included.",
    );
    page.table(
        more,
        "Intervals: ensemble members (volumes that belong to none) drawn anew with replacement.",
    );
    page.heading("Errors");
    let spread = histogram(predictors, measured);
    write("errors.svg", &spread.to_svg_file())?;
    page.chart(&spread, "Bins of equal ratio between 1/2 and 2; the outermost hold everything beyond.");
    let by_time = bias_chart(predictors);
    write("bias.svg", &by_time.to_svg_file())?;
    page.chart(
        &by_time,
        "The constant baseline is left out: its bias is hundreds of percent on fast frames.",
    );
    page.table(bias, "Median of predicted / measured - 1 by tenth of the frames, fastest first, %.");
    page.heading("Predicted against measured");
    for (i, p) in predictors.iter().enumerate() {
        let chart = scatter(p, measured, i);
        write(&format!("scatter-{}.svg", i + 1), &chart.to_svg_file())?;
        page.chart(&chart, "");
    }
    page.heading("By group");
    page.table(by_group, "SD is that of the group's own frames.");
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
