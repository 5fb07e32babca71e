//! Traces against targets, under every controller.

use super::{Player, Replayable, Replayed, Tally, replay, worth_playing};
use anyhow::Result;
use entire_cli::steering::contenders::contender;
use entire_cli::steering::fit::Calibrated;
use entire_cli::steering::rivals::StepResponse;
use entire_core::control::Prior;
use entire_core::control::StepLimits;

/// One trace against one target or series of targets.
pub struct Trial {
    /// Which trace.
    pub trace: usize,
    /// The target, for people.
    pub label: String,
    /// Seconds that each frame should not exceed.
    pub targets: Vec<f64>,
}

/// What came of a trial, per controller.
pub struct Outcome {
    /// Which trial.
    pub trial: usize,
    /// Per controller, the frames of the first round.
    pub frames: Vec<Vec<Replayed>>,
    /// Per controller, over all rounds.
    pub tallies: Vec<Tally>,
}

/// The trials that are worth playing: every trace against every target that some allowed step meets in half
/// of its frames, and against those targets in turn.
pub fn trials(traces: &[Replayable], targets: &[(f64, &str)], limits: StepLimits) -> Vec<Trial> {
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

/// Plays a trial under every controller, so many rounds, each with other noise of the measured.
///
/// # Errors
/// When a prediction fails.
#[expect(clippy::too_many_arguments, reason = "a trial is told everything once, in one place")]
pub fn play(
    index: usize,
    trial: &Trial,
    trace: &Replayable,
    players: &[Player],
    calibrated: &Calibrated,
    response: &StepResponse,
    limits: StepLimits,
    rounds: u64,
) -> Result<Outcome> {
    let chosen = &calibrated.chosen().fitted;
    let mean = trial.targets.iter().sum::<f64>() / trial.targets.len() as f64;
    // The step that a user would set once: what the middle frame needs.
    let middle = &trace.curves[trace.curves.len() / 2];
    let fixed = middle.oracle(mean, f64::from(limits.finest), f64::from(limits.coarsest)) as f32;
    let mut outcome =
        Outcome { trial: index, frames: Vec::new(), tallies: vec![Tally::default(); players.len()] };
    for (k, player) in players.iter().enumerate() {
        for round in 0..rounds {
            let prior: Prior = calibrated.prior();
            let mut who = contender(player.kind, fixed, chosen.predictor()?, response, prior);
            who.acts_on = player.acts_on;
            let (features, all) = (chosen.volume_features(), 0..trial.targets.len());
            let played = replay(trace, &mut who, features, &trial.targets, limits, round + 1, all)?;
            outcome.tallies[k].merge(&Tally::of(&played));
            if round == 0 {
                outcome.frames.push(played);
            }
        }
    }
    Ok(outcome)
}
