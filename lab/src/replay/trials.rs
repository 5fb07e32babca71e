//! Trials: traces with targets, played under every controller; and sessions without a model that start
//! anywhere on a path, as in a program that knows only its own frame times.

use super::{LIMITS, Replayable, Replayed, Tally, replay, worth_playing};
use crate::fitted::FittedPredictor;
use anyhow::Result;
use clap::ValueEnum;
use entire_cli::steering::contenders::{ControllerKind, contender};
use entire_cli::steering::play::{ActsOn, Contender};
use entire_cli::steering::rivals::StepResponse;
use entire_io::files::note;
use entire_io::metrics::median;
use entire_steer::control::{HybridOptions, Session};
use entire_steer::predict::{AnalyticModel, Predictor};
use std::ops::Range;

/// One trace with one target or a series of targets.
pub(crate) struct Trial {
    pub(crate) trace: usize,
    /// Name of the target in reports.
    pub(crate) label: String,
    /// Target of each frame, seconds.
    pub(crate) targets: Vec<f64>,
}

pub(crate) struct Outcome {
    /// Frames of the first round, by controller.
    pub(crate) frames: Vec<Vec<Replayed>>,
    /// Sums over all rounds, by controller.
    pub(crate) tallies: Vec<Tally>,
}

/// Returns trials of every trace with each of its useful targets ([`worth_playing`]), and with a series of
/// these.
pub(crate) fn trials(traces: &[Replayable], targets: &[(f64, &str)]) -> Vec<Trial> {
    let mut out = Vec::new();
    for (i, trace) in traces.iter().enumerate() {
        let n = trace.path.frames.len();
        let worth: Vec<&(f64, &str)> = targets.iter().filter(|(t, _)| worth_playing(trace, *t)).collect();
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

/// Returns the trials of [`trials`], and one further trial with its [`own_target`] for every trace without a
/// useful target. Also returns the names of the traces for which this target is not useful either; they have
/// no trial.
pub(crate) fn trials_of_all(traces: &[Replayable], targets: &[(f64, &str)]) -> (Vec<Trial>, Vec<String>) {
    let (mut out, mut unplayed) = (trials(traces, targets), Vec::new());
    for (i, trace) in traces.iter().enumerate() {
        if out.iter().any(|t| t.trace == i) {
            continue;
        }
        match own_target(trace).filter(|t| worth_playing(trace, *t)) {
            Some(target) => out.push(Trial {
                trace: i,
                label: format!("its own, {:.1} ms", 1e3 * target),
                targets: vec![target; trace.path.frames.len()],
            }),
            None => unplayed.push(trace.trace.name.clone()),
        }
    }
    out.sort_by_key(|t| t.trace);
    (out, unplayed)
}

/// A target of the trace, seconds: the geometric mean of its median times at the finest and coarsest steps.
fn own_target(trace: &Replayable) -> Option<f64> {
    let middle = |step: f32| {
        let mut seconds: Vec<f64> = trace.curves.iter().map(|c| c.seconds(f64::from(step))).collect();
        median(&mut seconds)
    };
    Some((middle(LIMITS.finest)? * middle(LIMITS.coarsest)?).sqrt())
}

/// Plays a trial under every controller, for several rounds, each with another draw of the measured noise.
pub(crate) fn play(
    trial: &Trial,
    trace: &Replayable,
    players: &[Player],
    calibrated: &FittedPredictor,
    response: &StepResponse,
    rounds: u64,
) -> Result<Outcome> {
    let model = &calibrated.model;
    let mut codes = Vec::new();
    if model.volume_features().is_some() {
        for volume in &trace.trace.volumes {
            codes.extend(model.encode(&volume.open()?.view())?);
        }
    }
    let mean = trial.targets.iter().sum::<f64>() / trial.targets.len() as f64;
    // The fixed step is that at which the middle frame of the path meets the mean target.
    let middle = &trace.curves[trace.curves.len() / 2];
    let fixed = middle.oracle(mean, f64::from(LIMITS.finest), f64::from(LIMITS.coarsest)) as f32;
    let mut outcome = Outcome { frames: Vec::new(), tallies: vec![Tally::default(); players.len()] };
    for (k, player) in players.iter().enumerate() {
        for round in 0..rounds {
            let log_sd = calibrated.log_sd();
            let predictor = model.predictor()?;
            let mut who = if player.ignore_load {
                hybrid(predictor, HybridOptions { log_sd, ignore_load: true, ..HybridOptions::default() })
            } else {
                contender(player.kind, fixed, predictor, response, log_sd)
            };
            who.acts_on = player.acts_on;
            let all = 0..trial.targets.len();
            let played = replay(trace, &mut who, &codes, &trial.targets, LIMITS, round + 1, all)?;
            outcome.tallies[k].merge(&Tally::of(&played));
            if round == 0 {
                outcome.frames.push(played);
            }
        }
    }
    Ok(outcome)
}

/// A controller in a replay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Player {
    /// The controller.
    pub kind: ControllerKind,
    /// The quantity that the controller sets in this replay.
    pub acts_on: ActsOn,
    /// True if the controller's steps ignore a detected load
    /// ([`entire_steer::control::HybridOptions::ignore_load`]).
    pub ignore_load: bool,
}

impl Player {
    /// Returns players of the given controllers; of all controllers if `kinds` is empty.
    ///
    /// If a trace holds no smaller images, rules that act on image resolution act on the ray step instead, on
    /// all traces, so that each row of a table has one meaning. A note and the tables say so.
    pub fn all(kinds: &[ControllerKind], traces: &[Replayable]) -> Vec<Self> {
        let kinds = if kinds.is_empty() { ControllerKind::value_variants() } else { kinds };
        let without: Vec<&str> =
            traces.iter().filter(|t| t.images.is_none()).map(|t| t.trace.name.as_str()).collect();
        let players: Vec<Self> = kinds
            .iter()
            .map(|&kind| Self {
                kind,
                acts_on: if without.is_empty() { kind.acts_on() } else { ActsOn::RayStep },
                ignore_load: false,
            })
            .collect();
        let standing_in: Vec<&str> =
            players.iter().filter(|p| p.stands_in()).map(|p| p.kind.name()).collect();
        if !standing_in.is_empty() {
            note(&format!(
                "played on the ray step instead of image resolution: {}; {} of {} traces hold no smaller images \
                 ({}), which `entire-lab record` adds when it records them again",
                standing_in.join(", "),
                without.len(),
                traces.len(),
                without.join(", ")
            ));
        }
        players
    }

    /// True if the controller sets the ray step instead of its own quantity.
    pub fn stands_in(&self) -> bool {
        self.acts_on != self.kind.acts_on()
    }

    /// Name of the quantity that the controller sets, for tables.
    pub const fn acts_on_name(&self) -> &'static str {
        match (self.acts_on, self.kind.acts_on()) {
            (ActsOn::RayStep, ActsOn::ImageResolution { .. }) => "ray step instead",
            (acts_on, _) => acts_on.name(),
        }
    }
}

/// Number of frames from the start of a session to the start of the next session.
const START_EVERY: usize = 8;

/// Frame ranges of sessions with `frames` frames each that start at regular intervals on a path of `n`
/// frames.
pub(crate) fn starts(n: usize, frames: usize) -> impl Iterator<Item = Range<usize>> {
    (0..(n + 1).saturating_sub(frames)).step_by(START_EVERY).map(move |start| start..start + frames)
}

pub(crate) fn hybrid(predictor: Box<dyn Predictor + Send>, options: HybridOptions) -> Contender {
    Contender {
        name: "hybrid".into(),
        session: Session::with_controller(predictor, options.controller()),
        chooses_image_sample_distance: false,
        acts_on: ActsOn::RayStep,
    }
}

pub(crate) fn without_model(options: HybridOptions) -> Contender {
    hybrid(Box::new(AnalyticModel::default()), HybridOptions { log_sd: None, ..options })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::Trace;
    use std::path::Path;

    /// A recorded path with other frame times, which `seconds` returns from a frame's index and recorded
    /// seconds.
    fn path(name: &str, seconds: impl Fn(usize, f64) -> f64) -> Replayable {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let mut trace = Trace::open(&root.join(format!("data/steer/traces/{name}.json.gz"))).unwrap();
        trace.volumes.iter_mut().for_each(|v| v.file = root.join(&v.file));
        for (i, frame) in trace.frames.iter_mut().enumerate() {
            frame.iter_mut().flat_map(|p| &mut p.seconds).for_each(|s| *s = seconds(i, *s));
        }
        Replayable::new(trace).unwrap()
    }

    #[test]
    fn no_path_is_left_out_without_a_word() {
        let targets = [(1.0 / 30.0, "30fps"), (1.0 / 60.0, "60fps"), (1.0 / 90.0, "90fps")];
        // The first path is faster than every target; the times of the third do not depend on the step.
        let paths = [
            path("banana-resize", |_, s| s),
            path("castro-cuts", |_, s| s),
            path("nyx-orbit", |i, _| if i % 2 == 0 { 1.0 } else { 100.0 }),
        ];
        assert!(trials(&paths[..1], &targets).is_empty());
        let (trials, unplayed) = trials_of_all(&paths, &targets);
        assert_eq!(unplayed, ["nyx-orbit"]);
        let labels = |trace: usize| -> Vec<&str> {
            trials.iter().filter(|t| t.trace == trace).map(|t| t.label.as_str()).collect()
        };
        assert_eq!(labels(0), ["its own, 6.2 ms"]);
        assert!(worth_playing(&paths[0], trials[0].targets[0]));
        assert_eq!(labels(1), ["60fps", "90fps", "changing"]);
        assert!(labels(2).is_empty());
        let bars: Vec<String> = super::super::played(3, &unplayed).iter().map(ToString::to_string).collect();
        assert_eq!(
            bars,
            ["bar steer-paths-played 2.0000 3.0000 short", "bar steer-played/nyx-orbit - 1.0000 short"]
        );
    }

    #[test]
    fn sessions_begin_along_the_path_and_end_on_it() {
        let of = |n, frames| starts(n, frames).collect::<Vec<_>>();
        assert_eq!(of(18, 2), [0..2, 8..10, 16..18]);
        assert_eq!(of(17, 2), [0..2, 8..10]);
        assert!(of(1, 2).is_empty() && of(0, 6).is_empty());
    }
}
