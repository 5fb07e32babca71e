//! Observation alone, on frames that a real renderer was timed at (software Vulkan, process-CPU time): a session without
//! any model file comes to know a renderer that it was never told of.

use entire_cli::steering::play::Contender;
use entire_cli::steering::replay::{Replayable, Tally, replay};
use entire_cli::steering::trace::Trace;
use entire_core::control::{Session, StepLimits};
use std::path::Path;

fn recorded(name: &str) -> Replayable {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut trace = Trace::open(&here.join("tests/data").join(name)).unwrap();
    for volume in &mut trace.volumes {
        volume.file = here.join("..").join(&volume.file);
    }
    Replayable::new(trace).unwrap()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn sixty_observed_frames_bring_an_unknown_renderer_within_ten_percent() {
    for (name, fps) in [("nyx-switches.json", 30.0), ("castro-cuts.json", 45.0)] {
        let recorded = recorded(name);
        let n = recorded.path.frames.len();
        let errors = |seed: u64| {
            let mut who = Contender { name: "untrained".into(), session: Session::untrained(), sizes: false };
            let played =
                replay(&recorded, &mut who, None, &vec![1.0 / fps; n], StepLimits::default(), seed).unwrap();
            let error = |range: std::ops::Range<usize>| {
                median(played[range].iter().map(|f| (f.predicted / f.seconds - 1.0).abs()).collect())
            };
            (error(0..2), error(60..n), Tally::of(&played[60..]).score())
        };
        for seed in 1..4 {
            let (before, after, score) = errors(seed);
            assert!(after <= 0.10, "{name}: {after}");
            assert!(before > 2.0 * after, "{name}: there was nothing to learn: {before} {after}");
            // And the target is held with it.
            assert!(score.all.missed < 0.15 && score.all.quality > 0.8, "{name}: {score:?}");
        }
    }
}
