//! `entire schedule`: which node renders what, in which order, and when it will be done.

use crate::commands::replay::samples_of;
use crate::dataset::median;
use crate::machine::Provenance;
use crate::report::{Axis, Chart, Column, Mark, Page, Series, Table};
use crate::steering::calibrate::{Quality, Sample};
use crate::steering::factor::Factor;
use crate::steering::fit::{Calibrated, Fitted};
use crate::steering::trace::{Curve, Trace};
use anyhow::{Context, Result, bail, ensure};
use entire_core::features::{Changes, FrameFeatures, MAX_PROBE_SIDE, PROBE_SIDE, Setting, TransferSummary};
use entire_core::predict::{AnalyticModel, Inputs, Measurement, Predictor};
use entire_core::scene::{Scalars, Skipping, VolumeView};
use entire_core::schedule::{
    AffinityTask, Assignment, Span, Timeline, assign_longest_first, longest_first, lower_bound,
    simulate_affinity, simulate_queue,
};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Decide which node renders what, in which order, and say when it will be done.
///
/// Reads tasks (CSV with a header line, or a JSON array of objects): `predicted_s` or `measured_s` (either may be
/// missing, not both), and where there are any `task` (a name), `volume` (which data it needs) and `load_s` (seconds to
/// load that data). Writes the assignment or the order as CSV or JSON, by the file's ending. With --trace the tasks are
/// the frames of a recorded path, predicted by a model fitted to other volumes.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire schedule tasks.csv --nodes 16 --out assignment.csv
  entire schedule tasks.json --speeds 1,1,2,0.5 --method queue --out order.json
  entire schedule tasks.csv --nodes 8 --method affinity --window 32 --out order.csv
  entire schedule --trace farm.json --training before.json --probe-side 24 --report out/schedule --bars")]
pub struct Options {
    /// The task list.
    #[arg(value_name = "TASKS", required_unless_present = "trace")]
    pub tasks: Option<PathBuf>,
    /// Take the frames of a recorded path at the reference step as tasks.
    #[arg(long, value_name = "TRACE.json", conflicts_with = "tasks")]
    pub trace: Option<PathBuf>,
    /// Timing tables that the predictor of --trace is fitted to, where there is no --training.
    #[arg(long, value_delimiter = ',', value_name = "TABLE.csv", requires = "trace")]
    pub calibration: Vec<PathBuf>,
    /// Recorded frames of other volumes that the predictor of --trace is fitted to: what a farm has rendered before, with the
    /// same transfer function. The analytic model is fitted to them, and a factor on it that depends on the view.
    #[arg(long, value_delimiter = ',', value_name = "TRACE.json", requires = "trace")]
    pub training: Vec<PathBuf>,
    /// Rays along each side of the probe that predicts the tasks of --trace, 1 to 24. A schedule is made once, beforehand: it
    /// can pay for more than the 11 that steering uses.
    #[arg(long, default_value_t = PROBE_SIDE, value_name = "N")]
    pub probe_side: usize,
    /// Write the tasks of --trace down as a task list (CSV).
    #[arg(long, value_name = "TASKS.csv", requires = "trace")]
    pub save_tasks: Option<PathBuf>,
    /// Nodes of equal speed.
    #[arg(long, value_name = "N", conflicts_with = "speeds")]
    pub nodes: Option<usize>,
    /// Nodes by speed; a node of speed 2 takes half of a task's seconds.
    #[arg(long, value_delimiter = ',', value_name = "SPEED,…")]
    pub speeds: Vec<f64>,
    /// How tasks come to nodes.
    #[arg(long, value_enum, default_value_t)]
    pub method: Method,
    /// Which times decide.
    #[arg(long, value_enum, default_value_t)]
    pub by: By,
    /// Seconds of a node that every dispatch from a queue costs.
    #[arg(long, default_value_t = 0.0, value_name = "SECONDS")]
    pub dispatch: f64,
    /// Tasks that a node looks at for one on the volume that it holds (--method affinity).
    #[arg(long, default_value_t = 64, value_name = "TASKS")]
    pub window: usize,
    /// Scatter of ln(measured / predicted) for the interval of the end, where the tasks do not hold both times.
    #[arg(long, default_value_t = 0.15, value_name = "SD")]
    pub log_sd: f64,
    /// Where the assignment or order goes (.csv or .json).
    #[arg(long, value_name = "FILE", required_unless_present = "report")]
    pub out: Option<PathBuf>,
    /// Compare every method for 2 to 64 nodes and write a report into this folder; the tasks need both times.
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
    /// Print the bars of the comparison, and fail when one is short.
    #[arg(long, requires = "report")]
    pub bars: bool,
}

/// How tasks come to nodes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Method {
    /// Fixed beforehand: longest first, each to the node that would finish it first; then tasks are exchanged between nodes as
    /// long as that helps.
    #[default]
    Static,
    /// Fixed beforehand: longest first alone.
    Longest,
    /// A queue, longest first: whichever node is free takes the next.
    Queue,
    /// A queue in the order of the list.
    Arrival,
    /// A queue, longest first, in which a node prefers tasks on the volume that it holds.
    Affinity,
}

/// Which times decide.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum By {
    /// `predicted_s`.
    #[default]
    Predicted,
    /// `measured_s`.
    Measured,
    /// All tasks alike.
    Uniform,
}

/// A task as its list has it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Task {
    /// Its name; its number where it has none.
    pub task: String,
    /// Predicted seconds on a node of speed 1.
    pub predicted_s: Option<f64>,
    /// Measured seconds on a node of speed 1.
    pub measured_s: Option<f64>,
    /// Which data it needs.
    pub volume: String,
    /// Seconds to load that data.
    pub load_s: f64,
}

/// Reads a task list, JSON where the name ends so, else CSV.
///
/// # Errors
/// Names the file, the task and what is wrong.
pub fn read_tasks(path: &Path) -> Result<Vec<Task>> {
    let place = || format!("task list {}", path.display());
    let bytes =
        std::fs::read(path).with_context(|| format!("cannot read the task list {}", path.display()))?;
    let mut tasks: Vec<Task> = if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
        serde_json::from_slice(&bytes).with_context(place)?
    } else {
        csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .from_reader(&bytes[..])
            .deserialize()
            .collect::<std::result::Result<_, _>>()
            .with_context(place)?
    };
    ensure!(!tasks.is_empty(), "{} holds no task", path.display());
    for (i, t) in tasks.iter_mut().enumerate() {
        if t.task.is_empty() {
            t.task = i.to_string();
        }
        ensure!(
            t.predicted_s.is_some() || t.measured_s.is_some(),
            "{}: task {i} ({}) has neither predicted_s nor measured_s; one of them is needed",
            place(),
            t.task
        );
        for (name, value) in [
            ("predicted_s", t.predicted_s.unwrap_or(0.0)),
            ("measured_s", t.measured_s.unwrap_or(0.0)),
            ("load_s", t.load_s),
        ] {
            ensure!(
                value.is_finite() && value >= 0.0,
                "{}: task {i} ({}): {name} is {value}; it must be finite and not negative",
                place(),
                t.task
            );
        }
    }
    Ok(tasks)
}

/// Frames of recorded paths as samples, one scene per frame, and the volume that each of them shows.
#[derive(Default)]
struct Recorded {
    samples: Vec<Sample>,
    volumes: Vec<usize>,
    scenes: usize,
}

impl Recorded {
    /// Adds what a trace's frames cost at every full-size point of their grids.
    fn add(&mut self, trace: &Trace, probe_side: usize) -> Result<()> {
        let (path, draw, summaries) = (trace.path.resolve()?, trace.draw_settings()?, trace.summaries()?);
        let mut features = FrameFeatures::with_probe_side(probe_side);
        let before = self.volumes.iter().max().map_or(0, |v| v + 1);
        for (index, at) in path.frames.iter().enumerate() {
            let volume = trace.volume_at(index);
            let table = at.transfer.function().to_table()?;
            let mut transfer = TransferSummary::new(&summaries[volume], &table);
            transfer.prepare_distance();
            let frame = trace.frame(&path, &draw, index)?;
            features.measure(&summaries[volume], &transfer, &frame);
            for p in trace.frames[index].iter().filter(|p| p.scale == 1.0) {
                self.samples.push(Sample {
                    scene: self.scenes,
                    features: features.clone(),
                    setting: Setting::of(&frame).with_step(p.step),
                    camera: at.camera,
                    lobes: at.transfer.lobes().unwrap_or_default(),
                    seconds: median(&mut p.seconds.clone()).context("a point without a time")?,
                });
                self.volumes.push(before + volume);
            }
            self.scenes += 1;
        }
        Ok(())
    }

    /// The analytic model and the factor on it, fitted to the samples that `keep` keeps.
    fn fit(&self, keep: impl Fn(usize) -> bool) -> Result<(AnalyticModel, Factor)> {
        let kept: Vec<&Sample> =
            self.samples.iter().zip(&self.volumes).filter(|(_, v)| keep(**v)).map(|(s, _)| s).collect();
        let measured: Vec<Measurement> =
            kept.iter().map(|s| Measurement::new(&s.features, &s.setting, s.seconds)).collect();
        let mut model = AnalyticModel::new();
        model.fit(&measured)?;
        let pairs = kept.iter().map(|s| Ok((*s, predicted(&mut model, s)?))).collect::<Result<Vec<_>>>()?;
        Ok((model, Factor::fit(&pairs)))
    }

    /// How the model alone and the model with the factor do on every volume when fitted to the others.
    fn leave_one_out(&self) -> Result<Option<[Quality; 2]>> {
        let volumes: std::collections::BTreeSet<usize> = self.volumes.iter().copied().collect();
        if volumes.len() < 2 {
            return Ok(None);
        }
        let (mut plain, mut with) = (Vec::new(), Vec::new());
        for &out in &volumes {
            let (mut model, factor) = self.fit(|v| v != out)?;
            for (s, _) in self.samples.iter().zip(&self.volumes).filter(|(_, v)| **v == out) {
                let t = predicted(&mut model, s)?;
                plain.push((t, s.seconds));
                with.push((t * factor.of(&s.features, &s.setting, s.camera), s.seconds));
            }
        }
        Ok(Quality::of(&plain).zip(Quality::of(&with)).map(|(a, b)| [a, b]))
    }
}

fn predicted(model: &mut AnalyticModel, s: &Sample) -> Result<f64> {
    Ok(f64::from(model.predict(&s.predictor_inputs(None))?.seconds))
}

/// What predicts the tasks of a recorded path.
struct Foreteller {
    predictor: Box<dyn Predictor + Send>,
    volume_features: Option<Vec<f32>>,
    factor: Factor,
}

/// Fits to recorded frames where there are any, else to timing tables.
fn foreteller(options: &Options) -> Result<Foreteller> {
    let side = options.probe_side;
    ensure!(
        (1..=MAX_PROBE_SIDE).contains(&side),
        "--probe-side is {side}; it must lie in 1 to {MAX_PROBE_SIDE}"
    );
    let say = |title: &str, q: &Quality, how: &str| {
        println!(
            "predictor  {title} ({side} x {side} rays; {how} {} frames: median error {:.1} %, scatter {:.3})",
            q.frames,
            100.0 * q.median_error,
            q.log_sd
        );
    };
    // Frames like the tasks count alone where there are any: other transfer functions teach little about this one.
    if !options.training.is_empty() {
        let mut recorded = Recorded::default();
        for file in &options.training {
            recorded.add(&Trace::open(file)?, side)?;
        }
        let (model, mut factor) = recorded.fit(|_| true)?;
        if let Some([plain, with]) = recorded.leave_one_out()? {
            let how = "each volume left out in turn,";
            say("analytic cost model", &plain, how);
            say("… times a factor learned from the view", &with, how);
            if with.log_sd > plain.log_sd {
                factor = Factor::none();
            }
        }
        return Ok(Foreteller { predictor: Box::new(model), volume_features: None, factor });
    }
    ensure!(
        !options.calibration.is_empty(),
        "nothing to predict the frames of --trace from: give --training (recorded frames of other volumes) or --calibration (timing tables)"
    );
    let samples = samples_of(&options.calibration, side)?;
    let nothing = [0u8];
    let no_volume = VolumeView::new(Scalars::U8(&nothing), [1, 1, 1])?;
    let calibrated = Calibrated::fit(&samples, &no_volume, 1)?;
    let chosen: &Fitted = &calibrated.chosen().fitted;
    say(chosen.title(), &calibrated.chosen().held_out, "fitted to other volumes,");
    Ok(Foreteller {
        predictor: chosen.predictor()?,
        volume_features: chosen.volume_features().map(<[f32]>::to_vec),
        factor: Factor::none(),
    })
}

/// Tasks of a recorded path: its frames at the reference step, predicted by what was recorded of other volumes.
fn tasks_of_trace(trace: &Trace, options: &Options) -> Result<Vec<Task>> {
    let Foreteller { mut predictor, volume_features, factor } = foreteller(options)?;
    let (path, draw, summaries) = (trace.path.resolve()?, trace.draw_settings()?, trace.summaries()?);
    let mut features = FrameFeatures::with_probe_side(options.probe_side);
    let mut tasks = Vec::with_capacity(trace.frames.len());
    let mut took = std::time::Duration::ZERO;
    for (index, at) in path.frames.iter().enumerate() {
        let volume = trace.volume_at(index);
        let table = at.transfer.function().to_table()?;
        let mut transfer = TransferSummary::new(&summaries[volume], &table);
        if draw.skipping == Skipping::Distance {
            transfer.prepare_distance();
        }
        let frame = trace.frame(&path, &draw, index)?;
        let begin = std::time::Instant::now();
        features.measure(&summaries[volume], &transfer, &frame);
        let lobes = at.transfer.lobes();
        let setting = Setting::of(&frame);
        let predicted = predictor.predict(&Inputs {
            features: &features,
            setting,
            changes: Changes::NONE,
            camera: at.camera,
            volume_features: volume_features.as_deref(),
            lobes: lobes.as_deref(),
        })?;
        let seconds = f64::from(predicted.seconds) * factor.of(&features, &setting, at.camera);
        took += begin.elapsed();
        tasks.push(Task {
            task: format!("frame {index}"),
            predicted_s: Some(seconds),
            measured_s: Some(Curve::of(&trace.frames[index]).seconds(1.0)),
            volume: trace.volumes[volume].file.display().to_string(),
            load_s: 0.0,
        });
    }
    println!("prediction {:.3} ms per task", 1e3 * took.as_secs_f64() / tasks.len().max(1) as f64);
    Ok(tasks)
}

/// What a second measurement would reach in place of a prediction: longest first on the medians of all repeats but one,
/// judged by that one beside longest first on itself, the worst of 2 to 64 nodes; least and most over the repeats.
fn second_measurement(trace: &Trace) -> Result<Option<(f64, f64)>> {
    let repeats: Vec<&[f64]> =
        trace.frames.iter().filter_map(|f| f.first()).map(|p| &p.seconds[..]).collect();
    let count = repeats.iter().map(|r| r.len()).min().unwrap_or(0);
    let mut range: Option<(f64, f64)> = None;
    for judge in 0..if count < 2 { 0 } else { count } {
        let judged: Vec<f64> = repeats.iter().map(|r| r[judge]).collect();
        let others = |r: &[f64]| -> Option<f64> {
            let mut rest: Vec<f64> =
                r.iter().enumerate().filter(|(i, _)| *i != judge).map(|(_, t)| *t).collect();
            median(&mut rest)
        };
        let decided: Vec<f64> = repeats.iter().filter_map(|r| others(r)).collect();
        let mut worst = 0.0f64;
        for nodes in 2..=64 {
            let speeds = vec![1.0; nodes];
            let of = |times: &[f64]| assign_longest_first(times, &speeds)?.makespan(&judged, &speeds);
            worst = worst.max(of(&decided)? / of(&judged)?);
        }
        range = Some(range.map_or((worst, worst), |(low, high)| (low.min(worst), high.max(worst))));
    }
    Ok(range)
}

fn times(tasks: &[Task], by: By) -> Result<Vec<f64>> {
    tasks
        .iter()
        .map(|t| match by {
            By::Predicted => t.predicted_s.with_context(|| format!("task {} has no predicted_s", t.task)),
            By::Measured => t.measured_s.with_context(|| format!("task {} has no measured_s", t.task)),
            By::Uniform => Ok(1.0),
        })
        .collect()
}

/// Numbers of the volumes by name.
fn volume_numbers(tasks: &[Task]) -> Vec<usize> {
    let mut numbers: HashMap<&str, usize> = HashMap::new();
    tasks
        .iter()
        .map(|t| {
            let next = numbers.len();
            *numbers.entry(&t.volume).or_insert(next)
        })
        .collect()
}

/// What a plan makes of true times: every task's node, start and end.
fn play(plan: &Plan, seconds: &[f64], tasks: &[Task], speeds: &[f64], options: &Options) -> Result<Timeline> {
    match plan {
        Plan::Assigned(assignment, order) => {
            let mut free = vec![0.0; speeds.len()];
            let mut spans = Vec::with_capacity(order.len());
            for &task in order {
                let node = assignment.node_of[task];
                let start = free[node];
                let end = start + seconds[task] / speeds[node];
                free[node] = end;
                spans.push(Span { task, node, start, end });
            }
            Ok(Timeline { spans, makespan: free.into_iter().fold(0.0, f64::max) })
        }
        Plan::Queued(order) => Ok(simulate_queue(order, seconds, speeds, options.dispatch)?),
        Plan::Near(order) => {
            let volumes = volume_numbers(tasks);
            let near: Vec<AffinityTask> = tasks
                .iter()
                .zip(seconds)
                .zip(volumes)
                .map(|((t, &seconds), volume)| AffinityTask {
                    volume,
                    seconds: seconds + options.dispatch,
                    load: t.load_s,
                })
                .collect();
            Ok(simulate_affinity(order, &near, speeds, options.window)?)
        }
    }
}

/// What is decided before anything runs.
enum Plan {
    Assigned(Assignment, Vec<usize>),
    Queued(Vec<usize>),
    Near(Vec<usize>),
}

fn plan(method: Method, deciding: &[f64], speeds: &[f64]) -> Result<Plan> {
    let order = longest_first(deciding)?;
    Ok(match method {
        Method::Longest => Plan::Assigned(assign_longest_first(deciding, speeds)?, order),
        Method::Static => {
            let mut assignment = assign_longest_first(deciding, speeds)?;
            assignment.exchange(deciding, speeds)?;
            Plan::Assigned(assignment, order)
        }
        Method::Queue => Plan::Queued(order),
        Method::Arrival => Plan::Queued((0..deciding.len()).collect()),
        Method::Affinity => Plan::Near(order),
    })
}

/// When everything will be done: expected, and the interval that nine in ten ends fall into. Errors are drawn from the
/// tasks' own ln(measured / predicted) where they hold both, else from a normal distribution.
fn eta(plan: &Plan, expected: &[f64], tasks: &[Task], speeds: &[f64], options: &Options) -> Result<[f64; 3]> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut unit = || ((rng.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
    let own: Vec<f64> = tasks
        .iter()
        .filter_map(|t| Some((t.measured_s.filter(|m| *m > 0.0)? / t.predicted_s.filter(|p| *p > 0.0)?).ln()))
        .collect();
    const DRAWS: usize = 400;
    let mut ends = Vec::with_capacity(DRAWS);
    for _ in 0..DRAWS {
        let drawn: Vec<f64> = expected
            .iter()
            .map(|t| {
                let error = if own.len() == tasks.len() {
                    own[((unit() * own.len() as f64) as usize).min(own.len() - 1)]
                } else {
                    options.log_sd * (-2.0 * unit().ln()).sqrt() * (std::f64::consts::TAU * unit()).cos()
                };
                t * error.exp()
            })
            .collect();
        ends.push(play(plan, &drawn, tasks, speeds, options)?.makespan);
    }
    ends.sort_by(f64::total_cmp);
    Ok([ends[DRAWS / 20], ends[DRAWS / 2], ends[DRAWS - 1 - DRAWS / 20]])
}

/// Runs the command.
///
/// # Errors
/// Bad options or tasks; with --bars when one is short.
pub fn run(options: &Options) -> Result<()> {
    let trace = options.trace.as_ref().map(|file| Trace::open(file)).transpose()?;
    let tasks = match (&options.tasks, &trace) {
        (Some(file), _) => read_tasks(file)?,
        (None, Some(trace)) => tasks_of_trace(trace, options)?,
        (None, None) => bail!("give a task list or --trace"),
    };
    ensure!(
        options.log_sd.is_finite() && (0.0..=3.0).contains(&options.log_sd),
        "--log-sd is {}; it must lie in 0 to 3",
        options.log_sd
    );
    if let Some(file) = &options.save_tasks {
        let place = || format!("cannot write {}", file.display());
        let mut out = csv::Writer::from_path(file).with_context(place)?;
        tasks.iter().try_for_each(|t| out.serialize(t)).with_context(place)?;
        out.flush().with_context(place)?;
    }
    if let Some(out) = &options.out {
        let speeds = match (options.nodes, options.speeds.is_empty()) {
            (Some(0), _) => bail!("--nodes is 0; at least one is needed"),
            (Some(n), _) => vec![1.0; n],
            (None, false) => options.speeds.clone(),
            (None, true) => bail!("say how many nodes there are (--nodes N, or --speeds S,…)"),
        };
        write(&tasks, &speeds, options, out)?;
    }
    if let Some(folder) = &options.report {
        let noise = trace.as_ref().map(second_measurement).transpose()?.flatten();
        compare(&tasks, options, folder, noise)?;
    }
    Ok(())
}

fn write(tasks: &[Task], speeds: &[f64], options: &Options, out: &Path) -> Result<()> {
    let deciding = times(tasks, options.by)?;
    let plan = plan(options.method, &deciding, speeds)?;
    // What is expected: predictions where there are any.
    let expected: Vec<f64> = tasks.iter().filter_map(|t| t.predicted_s.or(t.measured_s)).collect();
    let line = play(&plan, &expected, tasks, speeds, options)?;
    let [low, middle, high] = eta(&plan, &expected, tasks, speeds, options)?;
    let bound = lower_bound(&expected, speeds)?;
    let place = || format!("cannot write {}", out.display());
    if out.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
        let spans: Vec<serde_json::Value> = line
            .spans
            .iter()
            .enumerate()
            .map(|(i, s)| {
                json!({ "order": i, "task": tasks[s.task].task, "node": s.node, "start_s": s.start, "end_s": s.end })
            })
            .collect();
        let all = json!({
            "method": options.method_name(), "nodes": speeds, "makespan_s": line.makespan, "lower_bound_s": bound,
            "eta_s": { "p5": low, "p50": middle, "p95": high }, "tasks": spans,
        });
        std::fs::write(out, serde_json::to_string_pretty(&all)? + "\n").with_context(place)?;
    } else {
        let mut csv = csv::Writer::from_path(out).with_context(place)?;
        csv.write_record(["order", "task", "node", "start_s", "end_s"])?;
        for (i, s) in line.spans.iter().enumerate() {
            csv.write_record([
                i.to_string(),
                tasks[s.task].task.clone(),
                s.node.to_string(),
                s.start.to_string(),
                s.end.to_string(),
            ])?;
        }
        csv.flush().with_context(place)?;
    }
    println!(
        "{} tasks on {} nodes: done after {:.3} s expected, {low:.3} to {high:.3} s in nine of ten cases (lower bound {bound:.3} s)",
        tasks.len(),
        speeds.len(),
        middle
    );
    println!("{}", out.display());
    Ok(())
}

impl Options {
    fn method_name(&self) -> &'static str {
        match self.method {
            Method::Static => "static",
            Method::Longest => "longest",
            Method::Queue => "queue",
            Method::Arrival => "arrival",
            Method::Affinity => "affinity",
        }
    }
}

/// Methods of the comparison: title, how, by which times, colour.
const COMPARED: [(&str, Method, By, usize); 6] = [
    ("static longest first, measured", Method::Longest, By::Measured, 2),
    ("static longest first, predicted", Method::Longest, By::Predicted, 0),
    ("static longest first, uniform", Method::Longest, By::Uniform, 5),
    ("queue, arrival order", Method::Arrival, By::Uniform, 1),
    ("queue, predicted longest first", Method::Queue, By::Predicted, 3),
    ("static with exchanges, predicted", Method::Static, By::Predicted, 4),
];

fn compare(tasks: &[Task], options: &Options, folder: &Path, noise: Option<(f64, f64)>) -> Result<()> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let measured = times(tasks, By::Measured).context("the comparison judges by measured times")?;
    let all: Vec<usize> = (2..=64).collect();
    // makespan[method][nodes]
    let mut makespans = vec![Vec::new(); COMPARED.len()];
    let mut loads: HashMap<(usize, usize), Vec<f64>> = HashMap::new();
    let mut bounds = Vec::new();
    for &nodes in &all {
        let speeds = vec![1.0; nodes];
        bounds.push(lower_bound(&measured, &speeds)?);
        for (k, &(_, method, by, _)) in COMPARED.iter().enumerate() {
            let line = play(&plan(method, &times(tasks, by)?, &speeds)?, &measured, tasks, &speeds, options)?;
            let mut load = vec![0.0; nodes];
            for s in &line.spans {
                load[s.node] += s.end - s.start;
            }
            load.sort_by(f64::total_cmp);
            loads.insert((k, nodes), load);
            makespans[k].push(line.makespan);
        }
    }
    let shown = [2usize, 4, 8, 16, 32, 64];
    let at = |nodes: usize| nodes - 2;
    let errors: Vec<f64> = tasks
        .iter()
        .filter_map(|t| Some((t.predicted_s? / t.measured_s.filter(|m| *m > 0.0)? - 1.0).abs()))
        .collect();
    let mut sorted = errors.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN);
    let mut page = Page::new(
        "Balancing a render farm",
        &format!(
            "{} tasks on 2 to 64 nodes, judged by measured times ({:.1} s in all); median error of the predictions {:.1} %.",
            tasks.len(),
            measured.iter().sum::<f64>(),
            100.0 * median
        ),
    );
    let mut table = Table::new(
        std::iter::once(Column::text("method"))
            .chain(shown.iter().map(|n| Column::number(format!("N = {n}"))))
            .collect(),
    );
    for (k, (title, ..)) in COMPARED.iter().enumerate() {
        let mut row = vec![(*title).into()];
        row.extend(shown.iter().map(|&n| format!("{:.3}", makespans[k][at(n)] / bounds[at(n)]).into()));
        table.row(row);
    }
    page.table(&table, "Time until the last node is done over the lower bound (all work over all nodes, and the longest tasks).");
    println!("{}", table.to_text());
    let mut chart = Chart::new(
        "Loads of the nodes",
        Axis::categories("nodes", shown.iter().map(ToString::to_string).collect()),
        Axis::linear("load / longest load of longest first, measured"),
    )
    .size(900.0, 400.0);
    for (k, (title, _, _, hue)) in COMPARED.iter().enumerate() {
        let boxes = shown
            .iter()
            .enumerate()
            .map(|(slot, &n)| {
                let unit = makespans[0][at(n)];
                let load = &loads[&(k, n)];
                let q = |p: f64| load[((p * (n - 1) as f64).round() as usize).min(n - 1)] / unit;
                let place = slot as f64;
                (place, [q(0.05), q(0.25), q(0.5), q(0.75), q(0.95)])
            })
            .collect();
        chart = chart.series(Series::new(*title, Mark::Boxes(boxes)).color(*hue));
    }
    page.chart(&chart, "Per method, the spread of what the nodes have to do, normalised to the longest load that static balancing on measured times leaves. 5th, 25th, 50th, 75th and 95th percentile.");
    let mut chart = Chart::new(
        "Longest load",
        Axis::log("nodes"),
        Axis::linear("longest load / longest first, measured"),
    )
    .size(900.0, 360.0);
    for (k, (title, _, _, hue)) in COMPARED.iter().enumerate() {
        let line = all.iter().map(|&n| (n as f64, makespans[k][at(n)] / makespans[0][at(n)])).collect();
        chart = chart.series(Series::new(*title, Mark::Line(line)).color(*hue));
    }
    let bound = all.iter().map(|&n| (n as f64, bounds[at(n)] / makespans[0][at(n)])).collect();
    chart = chart.series(Series::new("lower bound", Mark::Line(bound)).color(6));
    page.chart(&chart, "What decides when a farm is done, normalised to static balancing on measured times.");
    if let Some((low, high)) = noise {
        let text = format!(
            "What measuring a second time reaches instead of predicting: static longest first on the medians of all repeats but one takes, by that one, up to {low:.3} to {high:.3} of what longest first on itself takes."
        );
        println!("{text}");
        page.paragraph(&text);
    }
    mixed(tasks, &measured, options, &mut page)?;
    page.heading("Where this comes from");
    let source = options.trace.as_ref().or(options.tasks.as_ref()).map(|p| p.display().to_string());
    let mut facts = vec![("Tasks", source.unwrap_or_default())];
    facts.extend(Provenance::of("scheduled, not rendered".into()).facts());
    page.facts(facts);
    page.write(&folder.join("report.html"))?;
    println!("report     {}", folder.join("report.html").display());
    if options.bars {
        let mut short = Vec::new();
        let mut bar = |name: &str, value: f64, limit: f64| {
            println!("bar {name} {value:.4} {limit:.4} {}", if value <= limit { "ok" } else { "short" });
            if value > limit {
                short.push(name.to_owned());
            }
        };
        bar("farm-queue-of-bound-16", makespans[4][at(16)] / bounds[at(16)], 1.02);
        bar("farm-queue-of-bound-64", makespans[4][at(64)] / bounds[at(64)], 1.04);
        let worst = |a: usize, b: usize| {
            makespans[a].iter().zip(&makespans[b]).map(|(x, y)| x / y).fold(0.0, f64::max)
        };
        bar("farm-queue-of-arrival-worst", worst(4, 3), 1.0);
        println!(
            "static longest first on predicted times, of the same on measured ones: at most {:.4}",
            worst(1, 0)
        );
        bar("farm-static-predicted-of-measured-worst", worst(5, 0), 1.04);
        ensure!(short.is_empty(), "short: {}", short.join(", "));
    }
    Ok(())
}

/// What the plain case lacks: nodes of different speeds, and volumes that take time to load.
fn mixed(tasks: &[Task], measured: &[f64], options: &Options, page: &mut Page) -> Result<()> {
    page.heading("Unequal nodes, and volumes that must be loaded");
    let mut table = Table::new(vec![
        Column::text("case"),
        Column::number("static, predicted"),
        Column::number("queue, arrival"),
        Column::number("queue, predicted longest first"),
        Column::number("same, near its volume"),
    ]);
    let mean = measured.iter().sum::<f64>() / measured.len() as f64;
    for nodes in [8usize, 16, 32] {
        for (name, speeds, load) in [
            ("equal nodes, no loading", vec![1.0; nodes], 0.0),
            ("speeds 0.5, 1, 1, 2", (0..nodes).map(|i| [0.5, 1.0, 1.0, 2.0][i % 4]).collect(), 0.0),
            ("loading a volume takes 4 mean frames", vec![1.0; nodes], 4.0 * mean),
        ] {
            let loaded: Vec<Task> = tasks.iter().map(|t| Task { load_s: load, ..t.clone() }).collect();
            let predicted = times(&loaded, By::Predicted)?;
            let volumes = volume_numbers(&loaded);
            let with_loads: Vec<AffinityTask> = (0..loaded.len())
                .map(|i| AffinityTask { volume: volumes[i], seconds: measured[i], load })
                .collect();
            let bound = lower_bound(measured, &speeds)?;
            let assigned = assign_longest_first(&predicted, &speeds)?;
            // A node that renders its share volume by volume loads each of them once.
            let mut held = vec![std::collections::BTreeSet::new(); nodes];
            let mut ends = vec![0.0f64; nodes];
            for (task, &node) in assigned.node_of.iter().enumerate() {
                ends[node] += measured[task] / speeds[node];
                if held[node].insert(volumes[task]) {
                    ends[node] += load;
                }
            }
            let fixed = ends.into_iter().fold(0.0, f64::max);
            let arrival: Vec<usize> = (0..loaded.len()).collect();
            let longest = longest_first(&predicted)?;
            let row = [
                fixed,
                simulate_affinity(&arrival, &with_loads, &speeds, 1)?.makespan,
                simulate_affinity(&longest, &with_loads, &speeds, 1)?.makespan,
                simulate_affinity(&longest, &with_loads, &speeds, options.window)?.makespan,
            ];
            let mut cells = vec![format!("{nodes} nodes, {name}").into()];
            cells.extend(row.iter().map(|m| format!("{:.3}", m / bound).into()));
            table.row(cells);
        }
    }
    page.table(&table, "Time until the last node is done over the lower bound without loading.");
    println!("{}", table.to_text());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(text: &str, name: &str) -> Result<Vec<Task>> {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join(name);
        std::fs::write(&file, text).unwrap();
        read_tasks(&file)
    }

    #[test]
    fn lists_are_read_in_both_forms_and_every_mistake_is_named() {
        let csv = list("task,predicted_s,measured_s,volume,load_s\na,1,2,v,0.5\n,3,,,0\n", "t.csv").unwrap();
        assert_eq!((csv[0].predicted_s, csv[0].measured_s, csv[0].load_s), (Some(1.0), Some(2.0), 0.5));
        assert_eq!((csv[1].task.as_str(), csv[1].measured_s), ("1", None));
        let few = list("predicted_s\n1\n2\n", "t.csv").unwrap();
        assert_eq!(few.len(), 2);
        let json = list(r#"[{"predicted_s": 1.5, "volume": "v"}]"#, "t.json").unwrap();
        assert_eq!((json[0].predicted_s, json[0].volume.as_str()), (Some(1.5), "v"));
        for (text, name, expected) in [
            ("predicted_s\n-1\n", "t.csv", "predicted_s is -1"),
            ("predicted_s\nNaN\n", "t.csv", "predicted_s is NaN"),
            ("predicted_s\nx\n", "t.csv", "invalid float"),
            ("task\na\n", "t.csv", "neither predicted_s nor measured_s"),
            ("predicted_s,speed\n1,2\n", "t.csv", "unknown field"),
            ("predicted_s\n", "t.csv", "no task"),
            ("[]", "t.json", "no task"),
            ("{", "t.json", "task list"),
        ] {
            let message = format!("{:#}", list(text, name).unwrap_err());
            assert!(message.contains(expected), "{text:?}: {message}");
        }
    }
}
