//! Sessions without a model that start anywhere on a path, as in a program that knows only its own frame times.

use super::{LIMITS, Replayable, Trial, replay};
use crate::bars::Bar;
use anyhow::Result;
use entire_cli::steering::play::{ActsOn, Contender};
use entire_steer::control::{Hybrid, HybridOptions, Prior, Session};
use entire_steer::predict::{AnalyticModel, Predictor};
use std::ops::Range;

/// Number of frames between the starts of two sessions.
const EVERY: usize = 8;

/// Promised share of sessions whose second frame takes at most the upper bound of its plan.
const PROMISED: f64 = 0.95;

/// Frame ranges of sessions with `frames` frames each that start at regular intervals on a path of `n` frames.
pub(crate) fn starts(n: usize, frames: usize) -> impl Iterator<Item = Range<usize>> {
    (0..(n + 1).saturating_sub(frames)).step_by(EVERY).map(move |start| start..start + frames)
}

pub(crate) fn hybrid(predictor: Box<dyn Predictor + Send>, options: HybridOptions) -> Contender {
    Contender {
        name: "hybrid".into(),
        session: Session::with_controller(predictor, Box::new(Hybrid::new(options))),
        chooses_image_sample_distance: false,
        acts_on: ActsOn::RayStep,
    }
}

pub(crate) fn without_model(options: HybridOptions) -> Contender {
    hybrid(Box::new(AnalyticModel::default()), HybridOptions { prior: Prior::Unknown, ..options })
}

/// Returns the bar of the cold start: sessions without a model start at several frames of every trial. The
/// value is the share of sessions whose second frame took no longer than the upper bound of its plan.
pub(crate) fn second_in_bound(traces: &[Replayable], trials: &[Trial]) -> Result<Bar> {
    let (mut seconds, mut inside) = (0u32, 0u32);
    for trial in trials {
        for frames in starts(trial.targets.len(), 2) {
            let mut who = without_model(HybridOptions::default());
            let played = replay(&traces[trial.trace], &mut who, &[], &trial.targets, LIMITS, 1, frames)?;
            seconds += 1;
            inside += u32::from(played[1].seconds <= played[1].upper);
        }
    }
    let share = (seconds > 0).then(|| f64::from(inside) / f64::from(seconds));
    Ok(Bar::at_least("cold/second-in-bound", share, PROMISED))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sessions_begin_along_the_path_and_end_on_it() {
        let of = |n, frames| starts(n, frames).collect::<Vec<_>>();
        assert_eq!(of(18, 2), [0..2, 8..10, 16..18]);
        assert_eq!(of(17, 2), [0..2, 8..10]);
        assert!(of(1, 2).is_empty() && of(0, 6).is_empty());
    }
}
