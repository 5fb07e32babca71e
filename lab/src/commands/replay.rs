//! `entire-lab replay`: recorded cost curves under every controller and target, beside an oracle; the steering bars.

use crate::calibration::samples_of;
use crate::replay::{Replayable, Replayed, SETTLING, Score, Tally, replay, worth_playing};
use crate::trace::Trace;
use anyhow::{Context, Result, ensure};
use clap::ValueEnum;
use entire_cli::files::open_model;
use entire_cli::machine::Provenance;
use entire_cli::metrics::median;
use entire_cli::path::parse_target;
use entire_cli::report::{Axis, Cell, Chart, Column, Mark, Page, Rule, Series, Table};
use entire_cli::steering::calibrate::{Sample, response, response_pairs};
use entire_cli::steering::contenders::{ControllerKind, contender};
use entire_cli::steering::fit::{Calibrated, Candidate, SteeringModel};
use entire_cli::steering::report::color;
use entire_cli::steering::rivals::StepResponse;
use entire_core::adapt::Prior;
use entire_core::control::{QualityModel, QualitySample, StepLimits};
use entire_core::features::PROBE_SIDE;
use entire_core::scene::{Scalars, VolumeView};
use serde_json::json;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Replay recorded cost curves under every controller and target, beside an oracle that knows them.
///
/// Every trace (see `entire-lab record`) is played under every controller against every target that is worth playing on it
/// (some allowed step meets it in at least half of the frames), and against a series of targets. The predictor is
/// fitted to a timing table of other volumes. DIR gets report.html, scores.json and frames.csv.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire-lab replay out/steer/traces/*.json --calibration out/steer/calibration.csv --out out/steer
  entire-lab replay nyx.json --calibration calibration.csv --targets 30fps,60fps --controllers olp,hybrid --out out/nyx")]
pub struct Options {
    /// The traces.
    #[arg(value_name = "TRACE.json", required = true)]
    pub traces: Vec<PathBuf>,
    /// Timing tables that the predictor and G are fitted to: random scenes, each at several steps
    /// (`entire-lab record --calibration`).
    #[arg(long, value_delimiter = ',', value_name = "TABLE.csv", required = true)]
    pub calibration: Vec<PathBuf>,
    /// Steer by this model file instead of the predictor that is fitted to the tables.
    #[arg(long, value_name = "M.safetensors")]
    pub model: Option<PathBuf>,
    /// Times that frames should not exceed.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "5fps,10fps,15fps,20fps,30fps,45fps,60fps,90fps",
        value_name = "TIME,…",
        allow_hyphen_values = true
    )]
    pub targets: Vec<String>,
    /// Who plays; everyone where none is named.
    #[arg(long, value_enum, value_delimiter = ',', value_name = "NAME,…")]
    pub controllers: Vec<ControllerKind>,
    /// Finest and coarsest step that may be chosen, reference steps.
    #[arg(long, default_value = "1,16", value_name = "FINEST,COARSEST", value_parser = entire_cli::options::parse_limits)]
    pub limits: (f32, f32),
    /// How often everything is played, each time with other noise of the measured.
    #[arg(long, default_value_t = 2, value_name = "N")]
    pub rounds: u64,
    /// Folder for the results.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Print the steering bars, and fail when one is short.
    #[arg(long)]
    pub bars: bool,
}

/// One trace against one target or series of targets.
struct Trial {
    trace: usize,
    label: String,
    targets: Vec<f64>,
}

/// What came of it, per controller.
struct Outcome {
    trial: usize,
    frames: Vec<Vec<Replayed>>,
    tallies: Vec<Tally>,
}

/// Runs the command.
///
/// # Errors
/// Bad options or files; with --bars when one is short.
pub fn run(options: &Options) -> Result<()> {
    let limits = StepLimits::new(options.limits.0, options.limits.1)?;
    ensure!(options.rounds >= 1, "--rounds is 0; everything is played at least once");
    let mut targets =
        options.targets.iter().map(|t| Ok((parse_target(t)?, t.trim()))).collect::<Result<Vec<_>>>()?;
    targets.sort_by(|a, b| b.0.total_cmp(&a.0));
    let kinds: Vec<ControllerKind> = if options.controllers.is_empty() {
        ControllerKind::value_variants().to_vec()
    } else {
        options.controllers.clone()
    };
    let samples = samples_of(&options.calibration, PROBE_SIDE)?;
    let response = response(&samples).context("G needs scenes that were timed at several steps")?;
    let nothing = [0u8];
    let no_volume = VolumeView::new(Scalars::U8(&nothing), [1, 1, 1])?;
    let mut calibrated = Calibrated::fit(&samples, &no_volume, 1)?;
    if let Some(file) = &options.model {
        let given = SteeringModel::new(format!("{}", file.display()), open_model(file)?, &no_volume)?;
        let given =
            Candidate::of(given, &samples).context("the model cannot predict the calibration frames")?;
        calibrated.candidates.iter_mut().for_each(|c| c.chosen = false);
        calibrated.candidates.push(Candidate { chosen: true, ..given });
    }
    let traces = options
        .traces
        .iter()
        .map(|file| Replayable::new(Trace::open(file)?).with_context(|| format!("{}", file.display())))
        .collect::<Result<Vec<_>>>()?;
    let trials = trials(&traces, &targets, limits);
    ensure!(!trials.is_empty(), "no target is worth playing on any trace; the allowed steps never meet one");
    let mut outcomes = Vec::with_capacity(trials.len());
    for (index, trial) in trials.iter().enumerate() {
        outcomes.push(play(
            index,
            trial,
            &traces[trial.trace],
            &kinds,
            &calibrated,
            &response,
            limits,
            options.rounds,
        )?);
    }
    let mut totals = vec![Tally::default(); kinds.len()];
    for outcome in &outcomes {
        for (total, tally) in totals.iter_mut().zip(&outcome.tallies) {
            total.merge(tally);
        }
    }
    let scores: Vec<Score> = totals.iter().map(Tally::score).collect();
    std::fs::create_dir_all(&options.out)
        .with_context(|| format!("cannot make the folder {}", options.out.display()))?;
    let results =
        Results { kinds: &kinds, traces: &traces, trials: &trials, outcomes: &outcomes, scores: &scores };
    let frontier = frontier(&traces, &targets);
    results.write_csv(&options.out.join("frames.csv"))?;
    results.write_json(&options.out.join("scores.json"), &calibrated)?;
    results
        .page(&calibrated, &response, &samples, frontier.as_ref())
        .write(&options.out.join("report.html"))?;
    println!("{}", results.table().to_text());
    println!("* best of the column. Report: {}", options.out.join("report.html").display());
    if let Some(f) = &frontier {
        println!("{}", f.sentence());
    }
    if options.bars {
        print_bars(&kinds, &scores)?;
    }
    Ok(())
}

fn trials(traces: &[Replayable], targets: &[(f64, &str)], limits: StepLimits) -> Vec<Trial> {
    let mut out = Vec::new();
    for (i, trace) in traces.iter().enumerate() {
        let n = trace.path.frames.len();
        let worth: Vec<&(f64, &str)> =
            targets.iter().filter(|(t, _)| worth_playing(trace, *t, limits)).collect();
        for (target, label) in &worth {
            out.push(Trial { trace: i, label: (*label).to_owned(), targets: vec![*target; n] });
        }
        if worth.len() >= 2 {
            let hold = (n / 4).max(8);
            let series = (0..n).map(|f| worth[(f / hold) % worth.len()].0).collect();
            out.push(Trial { trace: i, label: "changing".into(), targets: series });
        }
    }
    out
}

#[expect(clippy::too_many_arguments, reason = "a trial is told everything once, in one place")]
fn play(
    index: usize,
    trial: &Trial,
    trace: &Replayable,
    kinds: &[ControllerKind],
    calibrated: &Calibrated,
    response: &StepResponse,
    limits: StepLimits,
    rounds: u64,
) -> Result<Outcome> {
    let chosen = &calibrated.chosen().fitted;
    let mean = trial.targets.iter().sum::<f64>() / trial.targets.len() as f64;
    // The step that a user would set once: what the middle frame needs.
    let middle = &trace.curves[trace.curves.len() / 2];
    let fixed = middle.oracle(mean, f64::from(limits.finest()), f64::from(limits.coarsest())) as f32;
    let mut outcome =
        Outcome { trial: index, frames: Vec::new(), tallies: vec![Tally::default(); kinds.len()] };
    for (k, kind) in kinds.iter().enumerate() {
        for round in 0..rounds {
            let prior: Prior = calibrated.prior();
            let mut who = contender(*kind, fixed, chosen.predictor()?, response, prior);
            let played =
                replay(trace, &mut who, chosen.volume_features(), &trial.targets, limits, round + 1)?;
            outcome.tallies[k].merge(&Tally::of(&played));
            if round == 0 {
                outcome.frames.push(played);
            }
        }
    }
    Ok(outcome)
}

/// What choosing among steps and image sizes by the quality model gives, on traces that it was not fitted to: mean
/// structural similarity of what each way picks among settings that meet the target.
struct Frontier {
    model: QualityModel,
    frames: usize,
    by_model: f64,
    by_step: f64,
    best: f64,
}

impl Frontier {
    fn sentence(&self) -> String {
        format!(
            "Quality model (step and image size) on {} choices of traces that it was not fitted to: mean SSIM {:.4} by its order, {:.4} by the step alone, {:.4} at best.",
            self.frames, self.by_model, self.by_step, self.best
        )
    }
}

fn frontier(traces: &[Replayable], targets: &[(f64, &str)]) -> Option<Frontier> {
    let points = |odd: bool| {
        traces
            .iter()
            .enumerate()
            .filter(move |(i, _)| (i % 2 == 1) == odd)
            .flat_map(|(_, t)| &t.trace.frames)
            .filter(|f| f.iter().any(|p| p.scale < 1.0))
    };
    let samples: Vec<QualitySample> = points(false)
        .flatten()
        .map(|p| QualitySample { step: p.step, scale: p.scale, error: (1.0 - p.ssim) as f32 })
        .collect();
    let model = QualityModel::from_samples(&samples).ok()?;
    let (mut frames, mut by_model, mut by_step, mut best) = (0, 0.0, 0.0, 0.0);
    for frame in points(true) {
        for (target, _) in targets {
            let seconds =
                |p: &crate::trace::TracePoint| median(&mut p.seconds.clone()).unwrap_or(f64::INFINITY);
            let fitting: Vec<_> = frame.iter().filter(|p| seconds(p) <= *target).collect();
            // Only where there is something to choose: the reference setting does not fit, some full-size one does.
            let full = fitting.iter().filter(|p| p.scale == 1.0).min_by(|a, b| a.step.total_cmp(&b.step));
            let (Some(full), false) = (full, fitting.iter().any(|p| p.scale == 1.0 && p.step <= 1.0)) else {
                continue;
            };
            let error = |p: &crate::trace::TracePoint| model.error(p.step, p.scale);
            let picked = fitting.iter().min_by(|a, b| error(a).total_cmp(&error(b)));
            frames += 1;
            by_step += full.ssim;
            by_model += picked.map_or(0.0, |p| p.ssim);
            best += fitting.iter().map(|p| p.ssim).fold(0.0, f64::max);
        }
    }
    let n = frames as f64;
    (frames > 0).then(|| Frontier {
        model,
        frames,
        by_model: by_model / n,
        by_step: by_step / n,
        best: best / n,
    })
}

struct Results<'a> {
    kinds: &'a [ControllerKind],
    traces: &'a [Replayable],
    trials: &'a [Trial],
    outcomes: &'a [Outcome],
    scores: &'a [Score],
}

fn percent(v: f64) -> String {
    if v.is_nan() { "-".into() } else { format!("{:.1}", 100.0 * v) }
}

impl Results<'_> {
    fn table(&self) -> Table {
        let mut table = Table::new(vec![
            Column::text("controller"),
            Column::number("> 1.1 T / %"),
            Column::number("|t-T|/T / %"),
            Column::number("quality / %"),
            Column::number("calm > 1.1 T / %"),
            Column::number("calm |t-T|/T / %"),
            Column::number("calm quality / %"),
            Column::number("calm jumps / %"),
            Column::number("in bound / %"),
            Column::number("first |t-T|/T / %"),
            Column::number("SSIM / %"),
            Column::number("PSNR loss / dB"),
            Column::number("longest run"),
            Column::number("worst t/T"),
        ]);
        for (kind, s) in self.kinds.iter().zip(self.scores) {
            table.row(vec![
                kind.title().into(),
                percent(s.all.missed).into(),
                percent(s.all.deviation).into(),
                percent(s.all.quality).into(),
                percent(s.calm.missed).into(),
                percent(s.calm.deviation).into(),
                percent(s.calm.quality).into(),
                percent(s.jumps).into(),
                percent(s.inside_bound).into(),
                percent(s.first_frame_deviation).into(),
                percent(s.ssim_ratio).into(),
                format!("{:.1}", s.psnr_loss).into(),
                s.longest.to_string().into(),
                format!("{:.1}", s.worst).into(),
            ]);
        }
        let mut mark = |column: usize, lowest: bool, value: &dyn Fn(&Score) -> f64| {
            table.mark_best(column, &self.scores.iter().map(value).collect::<Vec<_>>(), lowest);
        };
        mark(1, true, &|s| s.all.missed);
        mark(2, true, &|s| s.all.deviation);
        mark(3, false, &|s| s.all.quality);
        mark(4, true, &|s| s.calm.missed);
        mark(5, true, &|s| s.calm.deviation);
        mark(6, false, &|s| s.calm.quality);
        mark(7, true, &|s| s.jumps);
        mark(9, true, &|s| s.first_frame_deviation);
        mark(10, false, &|s| s.ssim_ratio);
        mark(11, true, &|s| s.psnr_loss);
        mark(12, true, &|s| s.longest as f64);
        mark(13, true, &|s| s.worst);
        table
    }

    fn per_trial(&self) -> Table {
        let mut columns =
            vec![Column::text("trace"), Column::text("target"), Column::number("reachable / %")];
        let shown: Vec<usize> = (0..self.kinds.len())
            .filter(|k| {
                matches!(
                    self.kinds[*k],
                    ControllerKind::Hybrid
                        | ControllerKind::Olp
                        | ControllerKind::Algorithm1
                        | ControllerKind::Unreal
                )
            })
            .collect();
        for k in &shown {
            columns.push(Column::number(format!("{}: > 1.1 T", self.kinds[*k].name())));
            columns.push(Column::number("|t-T|/T"));
            columns.push(Column::number("quality"));
        }
        let mut table = Table::new(columns);
        for o in self.outcomes {
            let trial = &self.trials[o.trial];
            let frames = &o.frames[0];
            let reachable = frames.iter().filter(|f| f.reachable).count() as f64 / frames.len() as f64;
            let mut row: Vec<Cell> = vec![
                self.traces[trial.trace].trace.name.clone().into(),
                trial.label.clone().into(),
                percent(reachable).into(),
            ];
            for k in &shown {
                let s = o.tallies[*k].score();
                row.extend([
                    percent(s.all.missed).into(),
                    percent(s.all.deviation).into(),
                    percent(s.all.quality).into(),
                ]);
            }
            table.row(row);
        }
        table
    }

    fn write_csv(&self, path: &Path) -> Result<()> {
        let place = || format!("cannot write {}", path.display());
        let mut out = csv::Writer::from_path(path).with_context(place)?;
        out.write_record([
            "trace",
            "target",
            "controller",
            "frame",
            "target_s",
            "seconds",
            "predicted_s",
            "upper_s",
            "step_ref",
            "oracle_step_ref",
            "psnr_db",
            "oracle_psnr_db",
            "ssim",
            "oracle_ssim",
            "switched",
            "calm",
            "reason",
        ])?;
        let known = |v: f64| if v.is_nan() { String::new() } else { v.to_string() };
        for o in self.outcomes {
            let trial = &self.trials[o.trial];
            for (kind, frames) in self.kinds.iter().zip(&o.frames) {
                for (i, f) in frames.iter().enumerate() {
                    out.write_record([
                        self.traces[trial.trace].trace.name.clone(),
                        trial.label.clone(),
                        kind.name().into(),
                        i.to_string(),
                        f.target.to_string(),
                        f.seconds.to_string(),
                        known(f.predicted),
                        known(f.upper),
                        f.step.to_string(),
                        f.oracle_step.to_string(),
                        f.psnr.to_string(),
                        f.oracle_psnr.to_string(),
                        f.ssim.to_string(),
                        f.oracle_ssim.to_string(),
                        u8::from(f.switched).to_string(),
                        u8::from(f.calm).to_string(),
                        f.reason.name().into(),
                    ])?;
                }
            }
        }
        out.flush().with_context(place)
    }

    fn write_json(&self, path: &Path, calibrated: &Calibrated) -> Result<()> {
        let by_name = |scores: Vec<Score>| -> serde_json::Map<String, serde_json::Value> {
            self.kinds.iter().zip(scores).map(|(k, s)| (k.name().to_owned(), json!(s))).collect()
        };
        let trials: Vec<serde_json::Value> = self
            .outcomes
            .iter()
            .map(|o| {
                let trial = &self.trials[o.trial];
                json!({
                    "trace": self.traces[trial.trace].trace.name,
                    "target": trial.label,
                    "controllers": by_name(o.tallies.iter().map(Tally::score).collect()),
                })
            })
            .collect();
        let all = json!({
            "controllers": by_name(self.scores.to_vec()),
            "predictors": calibrated.candidates,
            "trials": trials,
            "traces": self.traces.iter().map(|t| json!({
                "name": t.trace.name, "volumes": t.trace.volumes, "provenance": t.trace.provenance,
            })).collect::<Vec<_>>(),
        });
        std::fs::write(path, serde_json::to_string_pretty(&all)? + "\n")
            .with_context(|| format!("cannot write {}", path.display()))
    }

    fn page(
        &self,
        calibrated: &Calibrated,
        response: &StepResponse,
        samples: &[Sample],
        frontier: Option<&Frontier>,
    ) -> Page {
        let frames = self.scores.first().map_or(0, |s| s.frames);
        let mut page = Page::new(
            "Holding a frame time, beside an oracle",
            &format!(
                "{} recorded paths over real volumes, {} trials, {frames} frames per controller. None of the volumes was seen by the predictor before.",
                self.traces.len(),
                self.trials.len()
            ),
        );
        page.table(
            &self.table(),
            &format!("T is the target. > 1.1 T: share of the frames in which the coarsest allowed step meets the target. |t-T|/T: mean over the frames in which some allowed step takes exactly the target. Quality: mean of the oracle's step over the step, at most 1; the oracle knows every frame's cost curve, not its noise. Calm: nothing but the camera has changed, without a cut, in the frame and the {SETTLING} before. Jumps: calm frames whose step differs from the frame before by over 20 %. In bound: abrupt changes whose first frame stayed inside its upper bound. SSIM: mean structural similarity to the picture at the reference step, over the oracle's. Best of each column in bold."),
        );
        let mut chart = Chart::new(
            "Misses and quality",
            Axis::linear("frames over 1.1 T / %"),
            Axis::linear("mean of oracle's step / step, %").to(101.0),
        )
        .size(900.0, 420.0)
        .rule(Rule::Vertical(3.0, "3 %".into()))
        .rule(Rule::Horizontal(92.0, "92 %".into()));
        let labels: BTreeSet<&str> = self.trials.iter().map(|t| t.label.as_str()).collect();
        for (k, kind) in self.kinds.iter().enumerate() {
            let points = labels
                .iter()
                .map(|label| {
                    let mut sum = Tally::default();
                    for o in self.outcomes.iter().filter(|o| self.trials[o.trial].label == *label) {
                        sum.merge(&o.tallies[k]);
                    }
                    let s = sum.score();
                    (100.0 * s.all.missed, 100.0 * s.all.quality, String::new())
                })
                .collect();
            chart = chart.series(Series::new(kind.title(), Mark::Points(points)).color(color(kind.name())));
        }
        page.chart(&chart, "A point per controller and target, over all traces on which the target was played. Up and left is better.");
        for (t, trace) in self.traces.iter().enumerate() {
            let of_trace: Vec<&Outcome> =
                self.outcomes.iter().filter(|o| self.trials[o.trial].trace == t).collect();
            let single: Vec<&&Outcome> =
                of_trace.iter().filter(|o| self.trials[o.trial].label != "changing").collect();
            let Some(middle) = single.get(single.len() / 2) else { continue };
            let trial = &self.trials[middle.trial];
            page.heading(&format!("{} at {}", trace.trace.name, trial.label));
            self.charts(&mut page, middle, trace);
        }
        if let Some(f) = frontier {
            page.heading("Step and image size together");
            page.paragraph(&f.sentence());
            let curve = |error: &dyn Fn(f64) -> f64| -> Vec<(f64, f64)> {
                (0..=40).map(|i| 1.0 + f64::from(i) * 0.2).map(|x| (x, error(x))).collect()
            };
            let model = f.model;
            let chart = Chart::new(
                "What a picture loses",
                Axis::linear("step over the reference step, or full side over image side"),
                Axis::linear("predicted 1 - SSIM").from(0.0),
            )
            .size(900.0, 260.0)
            .series(Series::new(
                "coarser step",
                Mark::Line(curve(&|x| f64::from(model.error(x as f32, 1.0)))),
            ))
            .series(Series::new(
                "smaller image",
                Mark::Line(curve(&|x| f64::from(model.error(1.0, (1.0 / x) as f32)))),
            ));
            page.chart(&chart, "The quality model, fitted to every other trace. Settings are tried in the order of its error; the first that is expected to meet the target is drawn.");
        }
        page.heading("Every trial");
        page.table(&self.per_trial(), "Shares in percent, as in the first table.");
        page.heading("Predictors");
        let mut predictors = Table::new(vec![
            Column::text("predictor"),
            Column::number("held-out frames"),
            Column::number("median error / %"),
            Column::number("p95 error / %"),
            Column::text("steers"),
        ]);
        for c in &calibrated.candidates {
            predictors.row(vec![
                c.title.clone().into(),
                c.held_out.frames.to_string().into(),
                percent(c.held_out.median_error).into(),
                percent(c.held_out.p95_error).into(),
                if c.chosen { "yes" } else { "" }.into(),
            ]);
        }
        page.table(
            &predictors,
            "SteeringModel to random scenes of other volumes on this machine, judged by scenes that were held out.",
        );
        let wide = |p: (f32, f32)| (f64::from(p.0), f64::from(p.1));
        let chart = Chart::new(
            "G: what a coarser step saves",
            Axis::log("step / reference steps"),
            Axis::log("relative frame time"),
        )
        .size(900.0, 300.0)
        .series(
            Series::new(
                "calibration scenes",
                Mark::Points(
                    response_pairs(samples)
                        .into_iter()
                        .map(wide)
                        .map(|(x, y)| (x, y, String::new()))
                        .collect(),
                ),
            )
            .color(6),
        )
        .series(Series::new("G", Mark::Line(response.points().map(wide).collect())).color(0));
        page.chart(&chart, "Algorithm 1 and OLP use this one curve for all scenes.");
        page.heading("Where this comes from");
        page.paragraph("Every frame of a path was drawn at nine ray steps, all repeats, outside of any race; a controller's step is answered by that frame's own curve between them, times the noise of one of its renderings: the same for every controller. Changes of the transfer function and of volumes are not part of frame times.");
        let mut facts: Vec<(&str, String)> = Vec::new();
        for t in self.traces {
            let volumes: Vec<String> =
                t.trace.volumes.iter().map(|v| format!("{} x{}", v.file.display(), v.enlarge)).collect();
            facts.push((
                "Trace",
                format!(
                    "{}: {}; {} x {} pixels, clock {}; {}",
                    t.trace.name,
                    volumes.join(", "),
                    t.trace.draw.width_px,
                    t.trace.draw.height_px,
                    t.trace.draw.clock,
                    t.trace.provenance["device"].as_str().unwrap_or("unknown device")
                ),
            ));
        }
        facts.extend(Provenance::of("replayed".into()).facts());
        page.facts(facts);
        page
    }

    fn charts(&self, page: &mut Page, outcome: &Outcome, trace: &Replayable) {
        let shown =
            [ControllerKind::Hybrid, ControllerKind::Olp, ControllerKind::Algorithm1, ControllerKind::Unreal];
        let line = |k: usize, f: &dyn Fn(&Replayed) -> f64| -> Vec<(f64, f64)> {
            outcome.frames[k].iter().enumerate().map(|(i, r)| (i as f64, f(r))).collect()
        };
        let draw = |mut chart: Chart,
                    f: &dyn Fn(&Replayed) -> f64,
                    oracle: Option<&dyn Fn(&Replayed) -> f64>| {
            for (i, s) in trace.switches.iter().enumerate() {
                if *s {
                    chart = chart.rule(Rule::Vertical(i as f64, String::new()));
                }
            }
            if let Some(oracle) = oracle {
                chart = chart.series(Series::new("oracle", Mark::Line(line(0, oracle))).color(6));
            }
            for kind in shown {
                if let Some(k) = self.kinds.iter().position(|x| *x == kind) {
                    chart = chart
                        .series(Series::new(kind.title(), Mark::Line(line(k, f))).color(color(kind.name())));
                }
            }
            chart
        };
        let time = Chart::new("Time over target", Axis::linear("frame"), Axis::log("t / T"))
            .size(900.0, 280.0)
            .rule(Rule::Horizontal(1.0, "target".into()))
            .rule(Rule::Horizontal(1.1, String::new()));
        page.chart(&draw(time, &|r| r.seconds / r.target, None), "Upright lines: abrupt changes.");
        let step = Chart::new("Ray step", Axis::linear("frame"), Axis::log("step / reference steps"))
            .size(900.0, 260.0);
        page.chart(
            &draw(step, &|r| r.step, Some(&|r| r.oracle_step)),
            "Finer is better, as far as the target allows.",
        );
        let ssim = Chart::new("Picture", Axis::linear("frame"), Axis::linear("SSIM")).size(900.0, 240.0);
        page.chart(
            &draw(ssim, &|r| r.ssim, Some(&|r| r.oracle_ssim)),
            "Structural similarity to the picture at the reference step.",
        );
    }
}

/// Rules that see past times only.
const REACTIVE: [ControllerKind; 7] = [
    ControllerKind::Olp,
    ControllerKind::Pid,
    ControllerKind::VtkGpu,
    ControllerKind::VtkFixedPoint,
    ControllerKind::VtkJs,
    ControllerKind::Unreal,
    ControllerKind::Filament,
];

fn print_bars(kinds: &[ControllerKind], scores: &[Score]) -> Result<()> {
    let of = |kind: ControllerKind| {
        kinds.iter().position(|k| *k == kind).map(|i| &scores[i]).with_context(|| {
            format!("the bars compare {} and it did not play; leave --controllers out", kind.name())
        })
    };
    let ours = of(ControllerKind::Hybrid)?;
    let mut others = Vec::new();
    for kind in ControllerKind::value_variants().iter().filter(|k| **k != ControllerKind::Hybrid) {
        others.push(of(*kind)?);
    }
    // The reactive rule that comes closest to the target in calm phases.
    let mut best = of(ControllerKind::Olp)?;
    let mut name = ControllerKind::Olp;
    for kind in REACTIVE {
        let s = of(kind)?;
        if s.calm.deviation < best.calm.deviation {
            (best, name) = (s, kind);
        }
    }
    let fewest = others.iter().map(|s| s.all.missed).fold(f64::INFINITY, f64::min);
    let olp = of(ControllerKind::Olp)?;
    println!("the reactive rule that comes closest in calm phases: {}", name.name());
    let mut short = Vec::new();
    let mut bar = |name: &str, value: f64, limit: f64, most: bool| {
        let holds = if most { value <= limit } else { value >= limit };
        println!("bar {name} {value:.4} {limit:.4} {}", if holds { "ok" } else { "short" });
        if !holds {
            short.push(name.to_owned());
        }
    };
    bar("steer-missed", ours.all.missed, 0.03, true);
    bar("steer-missed-of-all-others", ours.all.missed, fewest, true);
    bar("steer-deviation", ours.all.deviation, 0.08, true);
    bar("steer-quality", ours.all.quality, 0.92, false);
    bar("steer-quality-ssim", ours.ssim_ratio, 0.92, false);
    bar("steer-calm-missed", ours.calm.missed, best.calm.missed, true);
    bar("steer-calm-deviation", ours.calm.deviation, best.calm.deviation, true);
    bar("steer-calm-quality", ours.calm.quality, best.calm.quality, false);
    bar("steer-calm-jumps-of-olp", ours.jumps / olp.jumps.max(1e-9), 0.5, true);
    bar("steer-first-frames-in-bound", ours.inside_bound, 0.9, false);
    ensure!(short.is_empty(), "short: {}", short.join(", "));
    Ok(())
}
