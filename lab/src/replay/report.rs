//! Output of a replay: tables, charts and files.

use super::frontier::Frontier;
use super::{Outcome, Player, Replayable, Replayed, SETTLING, Score, Tally, Trial};
use crate::fitted::Calibrated;
use crate::fitted::candidates_table;
use anyhow::Result;
use entire_cli::steering::calibrate::Sample;
use entire_cli::steering::contenders::ControllerKind;
use entire_cli::steering::play::ActsOn;
use entire_cli::steering::report::{ResponseCurve, color};
use entire_cli::steering::rivals::StepResponse;
use entire_io::files::{write_json, write_whole};
use entire_io::machine::Provenance;
use entire_report::{Axis, Cell, Chart, Mark, Page, Rule, Series, Table};
use serde_json::json;
use std::collections::BTreeSet;
use std::path::Path;

/// Results of all replays, for reports.
pub(crate) struct Results<'a> {
    /// Controllers.
    pub(crate) players: &'a [Player],
    /// Recorded paths.
    pub(crate) traces: &'a [Replayable],
    /// Paths with their targets.
    pub(crate) trials: &'a [Trial],
    /// Outcome of each trial.
    pub(crate) outcomes: &'a [Outcome],
    /// Scores over all trials, per controller.
    pub(crate) scores: &'a [Score],
}

/// Controllers in the charts of single paths and in the table of all trials.
const SHOWN: [ControllerKind; 4] =
    [ControllerKind::Hybrid, ControllerKind::Olp, ControllerKind::Algorithm1, ControllerKind::Unreal];

fn percent(v: f64) -> Option<String> {
    (!v.is_nan()).then(|| format!("{:.1}", 100.0 * v))
}

fn tenths(v: f64) -> Option<String> {
    Some(format!("{v:.1}"))
}

/// A column of the table of scores: heading, value, text of the value, and true if the lowest value is the
/// best (`None` if no value is marked as the best).
type Figure = (&'static str, fn(&Score) -> f64, fn(f64) -> Option<String>, Option<bool>);

const FIGURES: [Figure; 13] = [
    ("> 1.1 T / %", |s| s.all.missed, percent, Some(true)),
    ("|t-T|/T / %", |s| s.all.deviation, percent, Some(true)),
    ("quality / %", |s| s.all.quality, percent, Some(false)),
    ("calm > 1.1 T / %", |s| s.calm.missed, percent, Some(true)),
    ("calm |t-T|/T / %", |s| s.calm.deviation, percent, Some(true)),
    ("calm quality / %", |s| s.calm.quality, percent, Some(false)),
    ("calm jumps / %", |s| s.jumps, percent, Some(true)),
    ("in bound / %", |s| s.inside_bound, percent, None),
    ("first |t-T|/T / %", |s| s.first_frame_deviation, percent, Some(true)),
    ("SSIM / %", |s| s.ssim_ratio, percent, Some(false)),
    ("PSNR loss / dB", |s| s.psnr_loss, tenths, Some(true)),
    ("longest run", |s| s.longest as f64, |v| Some(v.to_string()), Some(true)),
    ("worst t/T", |s| s.worst, tenths, Some(true)),
];

impl Results<'_> {
    /// Score of the oracle, which misses targets only because of the frames' noise.
    pub(crate) fn oracle(&self) -> Score {
        let mut total = Tally::default();
        for frames in self.outcomes.iter().filter_map(|o| o.frames.first()) {
            let played: Vec<Replayed> = frames.iter().map(Replayed::by_oracle).collect();
            total.merge(&Tally::of(&played));
        }
        total.score()
    }

    /// Returns a table with the scores of every controller and of the oracle.
    pub(crate) fn table(&self) -> Table {
        let columns = FIGURES.map(|(heading, ..)| format!(" | #{heading}")).concat();
        let mut table = Table::headed(&format!("controller | acts on{columns}"));
        let mut row = |title: &str, acts_on: &str, s: &Score| {
            let mut cells: Vec<Cell> = vec![title.into(), acts_on.into()];
            cells.extend(FIGURES.iter().map(|(_, value, shown, _)| Cell::from(shown(value(s)))));
            table.row(cells);
        };
        for (player, s) in self.players.iter().zip(self.scores) {
            row(player.kind.title(), player.acts_on_name(), s);
        }
        row("oracle: knows every cost but not the noise", ActsOn::RayStep.name(), &self.oracle());
        for (column, (_, value, _, lowest)) in (2..).zip(FIGURES) {
            if let Some(lowest) = lowest {
                table.mark_best(column, &self.scores.iter().map(value).collect::<Vec<_>>(), lowest);
            }
        }
        table
    }

    fn per_trial(&self) -> Table {
        let mut columns = "trace | target | #reachable / %".to_owned();
        let shown: Vec<usize> =
            (0..self.players.len()).filter(|k| SHOWN.contains(&self.players[*k].kind)).collect();
        for k in &shown {
            let name = self.players[*k].kind.name();
            columns += &format!(" | #{name}: > 1.1 T | #|t-T|/T | #quality");
        }
        let mut table = Table::headed(&columns);
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

    /// Writes every frame as CSV.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(crate) fn write_csv(&self, path: &Path) -> Result<()> {
        let mut out = csv::Writer::from_writer(Vec::new());
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
            "image_scale",
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
            for (player, frames) in self.players.iter().zip(&o.frames) {
                for (i, f) in frames.iter().enumerate() {
                    let (step, distance) = player.acts_on.drawn(f.step as f32);
                    out.write_record([
                        self.traces[trial.trace].trace.name.clone(),
                        trial.label.clone(),
                        player.kind.name().into(),
                        i.to_string(),
                        f.target.to_string(),
                        f.seconds.to_string(),
                        known(f.predicted),
                        known(f.upper),
                        f64::from(step).to_string(),
                        (1.0 / f64::from(distance)).to_string(),
                        f.oracle_step.to_string(),
                        f.psnr.to_string(),
                        f.oracle_psnr.to_string(),
                        f.ssim.to_string(),
                        f.oracle_ssim.to_string(),
                        u8::from(f.switched).to_string(),
                        u8::from(f.calm).to_string(),
                        f.reason.to_string(),
                    ])?;
                }
            }
        }
        write_whole(path, &out.into_inner()?)
    }

    /// Writes scores as JSON.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(crate) fn write_json(&self, path: &Path, calibrated: &Calibrated) -> Result<()> {
        let by_name = |scores: Vec<Score>| -> serde_json::Map<String, serde_json::Value> {
            self.players.iter().zip(scores).map(|(p, s)| (p.kind.name().to_owned(), json!(s))).collect()
        };
        let acts_on: serde_json::Map<String, serde_json::Value> =
            self.players.iter().map(|p| (p.kind.name().to_owned(), json!(p.acts_on_name()))).collect();
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
            "acts_on": acts_on,
            "predictors": calibrated.candidates,
            "trials": trials,
            "traces": self.traces.iter().map(|t| json!({
                "name": t.trace.name, "volumes": t.trace.volumes, "provenance": t.trace.provenance,
            })).collect::<Vec<_>>(),
        });
        write_json(path, &all)
    }

    /// The report.
    pub(crate) fn page(
        &self,
        calibrated: &Calibrated,
        response: &StepResponse,
        samples: &[Sample],
        frontier: Option<&Frontier>,
    ) -> Page {
        let frames = self.scores.first().map_or(0, |s| s.frames);
        let mut page = Page::new(
            "Frame times on target, compared with an oracle",
            &format!(
                "{} recorded paths over real volumes, {} trials, {frames} frames per controller. Without --model, \
                 the predictor was not trained on any of the volumes.",
                self.traces.len(),
                self.trials.len()
            ),
        );
        page.table(
            &self.table(),
            &format!(
                "T is the target. > 1.1 T: share of frames that took longer than 1.1 T, among the frames in \
                 which the coarsest allowed step meets the target. |t-T|/T: mean over the frames whose time \
                 equals the target at some allowed step. Quality: mean of the oracle's step divided by the \
                 chosen step, at most 1; the oracle knows the time of every frame at every step, but not its \
                 noise. Rules that change the image resolution draw 1/s of the pixels at the reference step; \
                 their quality is the least s of their range that meets the target, divided by the chosen s. \
                 A frame is calm if in the last {SETTLING} frames, including this frame, only the camera has \
                 changed, and not abruptly. Jumps: share of the calm frames whose step differs from that of \
                 the previous frame by over 20 %. In bound: share of the abrupt changes whose first frame \
                 stayed below its upper bound. SSIM: mean structural similarity to the picture at the \
                 reference step, divided by the oracle's. The best value of each column is bold."
            ),
        );
        let mut chart = Chart::new(
            "Misses and quality",
            Axis::linear("frames over 1.1 T / %"),
            Axis::linear("quality / %").to(101.0),
        )
        .size(900.0, 420.0)
        .rule(Rule::Vertical(3.0, "3 %".into()))
        .rule(Rule::Horizontal(92.0, "92 %".into()));
        let labels: BTreeSet<&str> = self.trials.iter().map(|t| t.label.as_str()).collect();
        for (k, Player { kind, .. }) in self.players.iter().enumerate() {
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
        page.chart(
            &chart,
            "One point per controller and target, over all traces on which the target was \
             played. Points further up and left are better.",
        );
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
            let law = f.law.quality;
            let chart = Chart::new(
                "Picture error over step and image size",
                Axis::linear("step over the reference step, or full side over image side"),
                Axis::linear("distance from full quality over that at twice the step").from(0.0),
            )
            .size(900.0, 260.0)
            .series(Series::new("coarser step", Mark::Line(curve(&|x| law.error(x, 1.0)))))
            .series(Series::new("smaller image", Mark::Line(curve(&|x| law.error(1.0, x)))));
            page.chart(
                &chart,
                "The quality law, fitted to 1 - SSIM of every second trace. Settings are tried in the order \
                 of its error; the first one whose expected time meets the target is drawn.",
            );
        }
        page.heading("Every trial");
        page.table(&self.per_trial(), "Shares in percent, as in the first table.");
        page.heading("Predictors");
        page.table(
            &candidates_table(&calibrated.candidates),
            "Fitted to random scenes of other volumes on this machine, tested on held-out scenes.",
        );
        page.chart(
            &ResponseCurve::new(samples, response).chart(),
            "Algorithm 1 and OLP use this one curve for all scenes.",
        );
        page.heading("Where this comes from");
        page.paragraph(
            "Every frame of a path was drawn several times at nine ray steps. The time of a controller's \
             step is interpolated between these, times the noise of one of the renderings, which is the same \
             for every controller. For rules that change the image resolution, smaller images at the \
             reference step were drawn and enlarged to full size before the comparison. Frame times exclude \
             changes of the transfer function and of volumes.",
        );
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
        let line = |k: usize, f: &dyn Fn(&Replayed) -> f64| -> Vec<(f64, f64)> {
            outcome.frames[k].iter().enumerate().map(|(i, r)| (i as f64, f(r))).collect()
        };
        let draw = |mut chart: Chart,
                    on: &dyn Fn(ActsOn) -> bool,
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
            for kind in SHOWN {
                if let Some(k) = self.players.iter().position(|p| p.kind == kind && on(p.acts_on)) {
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
        page.chart(&draw(time, &|_| true, &|r| r.seconds / r.target, None), "Vertical line: abrupt change.");
        let step = Chart::new("Ray step", Axis::linear("frame"), Axis::log("step / reference steps"))
            .size(900.0, 260.0);
        page.chart(
            &draw(step, &|on| on == ActsOn::RayStep, &|r| r.step, Some(&|r| r.oracle_step)),
            "Finer is better while the target is met.",
        );
        let on_images = |on: ActsOn| on != ActsOn::RayStep;
        if self.players.iter().any(|p| SHOWN.contains(&p.kind) && on_images(p.acts_on)) {
            let image = Chart::new(
                "Image resolution",
                Axis::linear("frame"),
                Axis::linear("image side / full side").from(0.0),
            )
            .size(900.0, 220.0);
            page.chart(
                &draw(image, &on_images, &|r| 1.0 / r.step.sqrt(), None),
                "Of controllers that act on image resolution, at the reference step.",
            );
        }
        let ssim = Chart::new("Picture", Axis::linear("frame"), Axis::linear("SSIM")).size(900.0, 240.0);
        page.chart(
            &draw(ssim, &|_| true, &|r| r.ssim, Some(&|r| r.oracle_ssim)),
            "Structural similarity to the picture at the reference step.",
        );
    }
}
