//! Output of a replay: tables and files.

use super::{Outcome, Player, Replayable, Replayed, SETTLING, Score, Tally, Trial};
use crate::fitted::FittedPredictor;
use anyhow::Result;
use entire_cli::steering::contenders::ControllerKind;
use entire_cli::steering::model::Sample;
use entire_cli::steering::play::ActsOn;
use entire_cli::steering::report::ResponseCurve;
use entire_cli::steering::rivals::StepResponse;
use entire_io::files::{write_json, write_whole};
use entire_io::machine::Provenance;
use entire_report::{Cell, Page, Table};
use serde_json::json;
use std::path::Path;

/// Results of all replays, for reports.
pub(crate) struct Results<'a> {
    pub(crate) players: &'a [Player],
    pub(crate) traces: &'a [Replayable],
    pub(crate) trials: &'a [Trial],
    pub(crate) outcomes: &'a [Outcome],
    pub(crate) scores: &'a [Score],
}

/// Controllers in the table of all trials.
const SHOWN_CONTROLLERS: [ControllerKind; 4] =
    [ControllerKind::Hybrid, ControllerKind::Olp, ControllerKind::Algorithm1, ControllerKind::Unreal];

fn percent(v: f64) -> Option<String> {
    (!v.is_nan()).then(|| format!("{:.1}", 100.0 * v))
}

fn tenths(v: f64) -> Option<String> {
    Some(format!("{v:.1}"))
}

/// A column of scores: heading, value, text, and true if the lowest value is the best (`None`: no mark).
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
        row("oracle: knows every frame time but not the noise", ActsOn::RayStep.name(), &self.oracle());
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
            (0..self.players.len()).filter(|k| SHOWN_CONTROLLERS.contains(&self.players[*k].kind)).collect();
        for k in &shown {
            let name = self.players[*k].kind.name();
            columns += &format!(" | #{name}: > 1.1 T | #|t-T|/T | #quality");
        }
        let mut table = Table::headed(&columns);
        for (trial, o) in self.trials.iter().zip(self.outcomes) {
            let frames = &o.frames[0];
            let reachable = frames.iter().filter(|f| f.reachable).count() as f64 / frames.len() as f64;
            let mut row: Vec<Cell> = vec![
                self.traces[trial.trace].trace.name.clone().into(),
                trial.label.clone().into(),
                percent(reachable).into(),
            ];
            for k in &shown {
                let s = o.tallies[*k].score();
                row.extend([s.all.missed, s.all.deviation, s.all.quality].map(|v| percent(v).into()));
            }
            table.row(row);
        }
        table
    }

    pub(crate) fn write_csv(&self, path: &Path) -> Result<()> {
        let mut out = csv::Writer::from_writer(Vec::new());
        let header = "trace,target,controller,frame,target_s,seconds,predicted_s,upper_s,step_ref,image_scale,\
                      oracle_step_ref,psnr_db,oracle_psnr_db,ssim,oracle_ssim,switched,calm,reason";
        out.write_record(header.split(','))?;
        let known = |v: f64| if v.is_nan() { String::new() } else { v.to_string() };
        for (trial, o) in self.trials.iter().zip(self.outcomes) {
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

    pub(crate) fn write_json(&self, path: &Path, calibrated: &FittedPredictor) -> Result<()> {
        let by_name = |scores: Vec<Score>| -> serde_json::Map<String, serde_json::Value> {
            self.players.iter().zip(scores).map(|(p, s)| (p.kind.name().to_owned(), json!(s))).collect()
        };
        let acts_on: serde_json::Map<String, serde_json::Value> =
            self.players.iter().map(|p| (p.kind.name().to_owned(), json!(p.acts_on_name()))).collect();
        let trials: Vec<serde_json::Value> = self
            .trials
            .iter()
            .zip(self.outcomes)
            .map(|(trial, o)| {
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
            "predictors": [calibrated],
            "trials": trials,
            "traces": self.traces.iter().map(|t| json!({
                "name": t.trace.name, "volumes": t.trace.volumes, "provenance": t.trace.provenance,
            })).collect::<Vec<_>>(),
        });
        write_json(path, &all)
    }

    pub(crate) fn page(&self, response: &StepResponse, samples: &[Sample], frontier: Option<&str>) -> Page {
        let frames = self.scores.first().map_or(0, |s| s.frames);
        let mut page = Page::new(
            "Frame times on target, compared with an oracle",
            &format!(
                "{} recorded paths over real volumes, {} trials, {frames} frames per controller. Without \
                 --model, the predictor is fitted to the tables of --calibration.",
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
                 stayed below its upper bound. First: |t-T|/T over the first frames after abrupt changes. SSIM: \
                 mean structural similarity to the picture at the reference step, divided by the oracle's. PSNR \
                 loss: mean PSNR of the oracle's pictures minus that of the controller's. Longest run: largest \
                 number of successive frames over 1.1 T. Worst t/T: largest frame time divided by T. Both count \
                 the frames of > 1.1 T. The best value of each column except In bound is bold."
            ),
        );
        if let Some(f) = frontier {
            page.heading("Step and image size together");
            page.paragraph(f);
        }
        page.heading("Every trial");
        page.table(&self.per_trial(), "Shares in percent, as in the first table.");
        page.heading("Frame time by ray step");
        page.chart(
            &ResponseCurve::new(samples, response).chart(),
            "Algorithm 1 and OLP use this one curve for all scenes.",
        );
        page.heading("Where the numbers come from");
        page.paragraph(
            "Every frame of a path was drawn several times at nine ray steps. The time of a controller's \
             step is interpolated between these steps and multiplied by the noise of one rendering, the same \
             rendering for every controller. For rules that change the image resolution, smaller images at \
             the reference step were drawn and enlarged to full size before the comparison. Frame times \
             exclude changes of the transfer function and of volumes.",
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
                    t.trace.draw.width,
                    t.trace.draw.height,
                    t.trace.draw.clock,
                    t.trace.provenance["device"].as_str().unwrap_or("unknown device")
                ),
            ));
        }
        facts.extend(Provenance::of("replayed".into()).facts());
        page.facts(facts);
        page
    }
}
