//! Learning from observed frame times, on recorded times of a real renderer (software Vulkan, process-CPU time): a
//! session without a model learns the costs of an unknown renderer.

use crate::recorded;
use entire_cli::steering::play::{ActsOn, Contender};
use entire_lab::replay::{Tally, replay};
use entire_steer::control::{Session, StepLimits};

fn median(mut values: Vec<f64>) -> f64 {
    entire_io::metrics::median(&mut values).expect("values")
}

#[test]
fn sixty_observed_frames_bring_an_unknown_renderer_within_ten_percent() {
    // Factor on the recorded seconds, so that the renderer's costs differ from a session's default costs.
    const TIMES: f64 = 3.0;
    for (name, fps) in [("nyx-switches.json", 30.0), ("castro-cuts.json", 45.0)] {
        let recorded = recorded(name, TIMES);
        let n = recorded.path.frames.len();
        let errors = |seed: u64| {
            let mut who = Contender {
                name: "untrained".into(),
                session: Session::untrained(),
                chooses_image_sample_distance: false,
                acts_on: ActsOn::RayStep,
            };
            let played =
                replay(&recorded, &mut who, &[], &vec![TIMES / fps; n], StepLimits::default(), seed, 0..n)
                    .unwrap();
            let error = |range: std::ops::Range<usize>| {
                median(played[range].iter().map(|f| (f.predicted / f.seconds - 1.0).abs()).collect())
            };
            (error(0..2), error(60..n), Tally::of(&played[60..]).score())
        };
        for seed in 1..4 {
            let (before, after, score) = errors(seed);
            assert!(after <= 0.10, "{name}: {after}");
            assert!(before > 2.0 * after, "{name}: there was nothing to learn: {before} {after}");
            // With this error, most frames meet the target.
            assert!(score.all.missed < 0.15 && score.all.quality > 0.8, "{name}: {score:?}");
        }
    }
}
