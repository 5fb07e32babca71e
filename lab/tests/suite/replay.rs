//! Replays of recorded paths: rules that act on image resolution get the times of smaller images, rules that
//! act on the ray step those of coarser steps; and a session without a model learns the costs of an unknown
//! renderer (recorded times of software Vulkan, process-CPU time).

use crate::recorded;
use entire_cli::steering::contenders::{ControllerKind, contender};
use entire_cli::steering::play::{ActsOn, Contender};
use entire_cli::steering::rivals::StepResponse;
use entire_lab::replay::{Player, Replayable, Replayed, Tally, replay};
use entire_lab::trace::{Trace, TracePoint};
use entire_steer::control::{Session, StepLimits};
use entire_steer::predict::AnalyticModel;

/// A trace without smaller images.
const RECORDED: &str = "nyx-switches.json";

/// Seconds of an image with 1 / s of the pixels, different from those at any ray step.
fn seconds(s: f64) -> f64 {
    0.2 / s
}

fn ssim(s: f64) -> f64 {
    0.3 + 0.2 / s
}

/// The trace [`RECORDED`] with smaller images, down to a sixteenth of the pixels.
fn with_images() -> Replayable {
    let mut trace = recorded(RECORDED, 1.0).trace;
    for frame in &mut trace.frames {
        for s in [1.0f64, 2.0, 4.0, 8.0, 16.0] {
            let image = TracePoint {
                step: 1.0,
                scale: (1.0 / s.sqrt()) as f32,
                seconds: vec![seconds(s)],
                psnr: 50.0 - s,
                ssim: ssim(s),
            };
            match frame.iter_mut().find(|p| p.step == 1.0 && p.scale == image.scale) {
                Some(point) => *point = image,
                None => frame.push(image),
            }
        }
    }
    Replayable::new(Trace::parse(&serde_json::to_string(&trace).unwrap()).unwrap()).unwrap()
}

const LIMITS: StepLimits = StepLimits { finest: 1.0, coarsest: 12.0 };

fn play(recorded: &Replayable, player: Player, target: f64) -> anyhow::Result<Vec<Replayed>> {
    let n = recorded.path.frames.len();
    let response = StepResponse::inverse_step(0.1);
    let mut who = contender(player.kind, 3.0, Box::new(AnalyticModel::default()), &response, None);
    who.acts_on = player.acts_on;
    replay(recorded, &mut who, &[], &vec![target; n], LIMITS, 1, 0..n)
}

fn close(a: f64, b: f64) -> bool {
    (a / b - 1.0).abs() < 1e-3
}

#[test]
fn image_resolution_is_answered_by_images_and_the_step_by_steps() {
    let recorded = with_images();
    for player in Player::all(&[], std::slice::from_ref(&recorded)) {
        assert!(!player.stands_in());
        let frames = play(&recorded, player, 0.02).unwrap();
        for (index, (f, curve)) in frames.iter().zip(&recorded.curves).enumerate() {
            let place = format!("{} at {index}: {f:?}", player.kind.name());
            // The oracle chooses a ray step, so a frame is feasible if the coarsest ray step meets the
            // target.
            assert_eq!(f.oracle_step, curve.oracle(0.02, 1.0, 12.0), "{place}");
            assert!(close(f.oracle_ssim, curve.ssim(f.oracle_step)), "{place}");
            assert_eq!(f.feasible, curve.seconds(12.0) <= 0.02, "{place}");
            // All controllers get the same noise of a frame.
            let noise = f.oracle_seconds / curve.seconds(f.oracle_step);
            match player.acts_on {
                ActsOn::RayStep => {
                    assert!((1.0..=12.0).contains(&f.step), "{place}");
                    assert!(close(f.seconds, noise * curve.seconds(f.step)), "{place}");
                    assert!(close(f.ssim, curve.ssim(f.step)), "{place}");
                    assert_eq!(f.finest_step, f.oracle_step, "{place}");
                }
                ActsOn::ImageResolution { coarsest } => {
                    // The range of s is the rule's own, within the recorded images; step limits do not apply.
                    let coarsest = f64::from(coarsest).min(16.0);
                    assert!((1.0..=1.0001 * coarsest).contains(&f.step), "{place}");
                    assert!(close(f.seconds, noise * seconds(f.step)), "{place}");
                    assert!(close(f.psnr, recorded.images.as_ref().unwrap()[index].psnr(f.step)), "{place}");
                    // A tenth of the pixels meets the target; Unreal and Filament draw at least a fourth.
                    assert!(close(f.finest_step, coarsest.min(10.0)), "{place}");
                }
            }
        }
        let last = frames.last().unwrap();
        match player.kind {
            // VTK's rule draws the first frame at half of the largest image sample distance, here that of the
            // smallest image (s = 16). The distance of a later frame depends on the time of the frame before.
            ControllerKind::VtkFixedPoint => {
                assert!(close(frames[0].step, 16.0) && frames[20].step > 7.0, "{:?}", frames[20]);
                assert!(close(last.ssim, recorded.images.as_ref().unwrap()[0].ssim(last.step)));
            }
            ControllerKind::Unreal => assert!(close(last.step, 4.0), "{last:?}"),
            _ => {}
        }
    }
}

#[test]
fn traces_without_images_open_and_rules_for_them_are_played_on_the_step_and_said_to_be() {
    let old = recorded(RECORDED, 1.0);
    assert!(old.images.is_none());
    let both = [old, with_images()];
    let players = Player::all(&[ControllerKind::Filament, ControllerKind::Hybrid], &both);
    assert_eq!(players[0].acts_on_name(), "ray step instead");
    assert!(players[0].stands_in() && !players[1].stands_in());
    assert_eq!(players[1].acts_on_name(), "ray step");
    for f in play(&both[0], players[0], 0.02).unwrap() {
        assert!((1.0..=12.0).contains(&f.step) && f.finest_step == f.oracle_step);
    }
    // A rule that acts on the image resolution needs smaller images in the trace; the error says so.
    let filament = Player {
        kind: ControllerKind::Filament,
        acts_on: ControllerKind::Filament.acts_on(),
        ignore_load: false,
    };
    let refused = play(&both[0], filament, 0.02).unwrap_err().to_string();
    assert!(refused.contains("without smaller images") && refused.contains("record it again"), "{refused}");
    assert_eq!(Player::all(&[ControllerKind::Filament], &both[1..]), [filament]);
    assert_eq!(filament.acts_on_name(), "image resolution");
}

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
                name: "without a model".into(),
                session: Session::default(),
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
