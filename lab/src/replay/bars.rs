//! The steering bars.

use super::trials::{starts, without_model};
use super::{LIMITS, Player, Replayable, Score, Three, Trial, replay};
use crate::bars::Bar;
use anyhow::{Context, Result};
use clap::ValueEnum;
use entire_cli::steering::contenders::ControllerKind;
use entire_steer::control::HybridOptions;

/// Lower limit of the share of sessions whose second frame takes no longer than the upper bound of its plan.
const BOUND_SHARE: f64 = 0.95;

/// Controllers that use past frame times only.
const REACTIVE_CONTROLLERS: [ControllerKind; 9] = [
    ControllerKind::Olp,
    ControllerKind::Last,
    ControllerKind::LargerOfTwo,
    ControllerKind::Pid,
    ControllerKind::VtkGpu,
    ControllerKind::VtkFixedPoint,
    ControllerKind::VtkJs,
    ControllerKind::Unreal,
    ControllerKind::Filament,
];

/// The steering bars: scores of the hybrid, against fixed limits and against the other controllers.
pub(crate) fn bars(players: &[Player], scores: &[Score]) -> Result<Vec<Bar>> {
    let of = |kind: ControllerKind| {
        players.iter().position(|p| p.kind == kind).map(|i| &scores[i]).with_context(|| {
            format!("the bars need {}, which did not play; leave out --controllers", kind.name())
        })
    };
    let ours = of(ControllerKind::Hybrid)?;
    let mut others = Vec::new();
    for kind in ControllerKind::value_variants().iter().filter(|k| **k != ControllerKind::Hybrid) {
        others.push(of(*kind)?);
    }
    // In calm phases the hybrid is compared with the best reactive rule, which may differ from score to
    // score.
    let reactive = REACTIVE_CONTROLLERS.into_iter().map(&of).collect::<Result<Vec<_>>>()?;
    let calm_least =
        |figure: fn(&Three) -> f64| reactive.iter().map(|s| figure(&s.calm)).fold(f64::INFINITY, f64::min);
    let calm_quality = reactive.iter().map(|s| s.calm.quality).fold(0.0, f64::max);
    let fewest = others.iter().map(|s| s.all.missed).fold(f64::INFINITY, f64::min);
    let olp = of(ControllerKind::Olp)?;
    let most = |name: &str, value: f64, limit: f64| Bar::at_most(name, Some(value), limit);
    let least = |name: &str, value: f64, limit: f64| Bar::at_least(name, Some(value), limit);
    Ok(vec![
        most("steer-missed", ours.all.missed, 0.03),
        most("steer-missed-of-all-others", ours.all.missed, fewest),
        most("steer-deviation", ours.all.deviation, 0.08),
        least("steer-quality", ours.all.quality, 0.92),
        least("steer-quality-ssim", ours.ssim_ratio, 0.92),
        most("steer-calm-missed", ours.calm.missed, calm_least(|c| c.missed)),
        most("steer-calm-deviation", ours.calm.deviation, calm_least(|c| c.deviation)),
        least("steer-calm-quality", ours.calm.quality, calm_quality),
        most("steer-calm-jumps-of-olp", ours.jumps / olp.jumps.max(1e-9), 0.5),
        least("steer-first-frames-in-bound", ours.inside_bound, 0.9),
    ])
}

/// Bars on the number of played paths: one for all `paths`, and a missed bar for each path that was not
/// played.
pub(crate) fn played(paths: usize, unplayed: &[String]) -> Vec<Bar> {
    let mut out =
        vec![Bar::at_least("steer-paths-played", Some((paths - unplayed.len()) as f64), paths as f64)];
    out.extend(unplayed.iter().map(|name| Bar::at_least(format!("steer-played/{name}"), None, 1.0)));
    out
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
    Ok(Bar::at_least("cold/second-in-bound", share, BOUND_SHARE))
}
