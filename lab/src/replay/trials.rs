//! Trials: traces with targets, played under every controller.

use super::cold::hybrid;
use super::{LIMITS, Player, Replayable, Replayed, Tally, replay, worth_playing};
use crate::fitted::Calibrated;
use anyhow::Result;
use entire_cli::steering::contenders::contender;
use entire_cli::steering::rivals::StepResponse;
use entire_io::metrics::median;
use entire_steer::control::{HybridOptions, Prior};

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

/// Returns trials of every trace with each of its useful targets, and with a series of these targets. A
/// target is useful for a trace if some allowed step meets it exactly in at least half of the trace's frames.
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

/// Returns the trials of [`trials`], and one further trial for every trace without a useful target (a target
/// that some allowed step meets exactly in at least half of the frames). The target of this trial is halfway,
/// in ln(seconds), between the trace's median frame times at the finest and at the coarsest step. Also
/// returns the names of the traces for which this target is not useful either; they have no trial.
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

/// A target of the trace: halfway, in ln(seconds), between its median times at finest and coarsest step.
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
    calibrated: &Calibrated,
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
            let prior: Prior = calibrated.prior();
            let predictor = model.predictor()?;
            let mut who = if player.ignore_load {
                hybrid(predictor, HybridOptions { prior, ignore_load: true, ..HybridOptions::default() })
            } else {
                contender(player.kind, fixed, predictor, response, prior)
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
}
