//! Every controller under random frame times, the constants of the rules of other renderers, and the frames
//! from which OLP estimates the next frame's time.

use super::*;
use crate::steering::contenders::{ControllerKind, controller};
use clap::ValueEnum;
use entire_steer::control::{Controller, Observed, PlanRequest, StepLimits};
use entire_steer::features::Changes;
use entire_steer::predict::{CostTerms, Source};

struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

#[test]
fn every_controller_survives_any_observation() {
    let g = StepResponse::inverse_step(0.1);
    for kind in ControllerKind::value_variants() {
        let mut controller = controller(*kind, 2.0, &g, None);
        let mut noise = Noise(3);
        for i in 0..3000 {
            let target = [1e-3, 0.03, 5.0][i / 7 % 3];
            let base = (noise.normal() * 2.0).exp() as f32 * 0.02;
            let mut cost = |step: f32| CostTerms::whole(base / step, 0.0, Source::Analytic);
            let changes = Changes { transfer: i % 50 == 0, first: i == 0, ..Changes::default() };
            let limits = StepLimits { finest: 0.5, coarsest: 20.0 };
            let decision = controller.plan(&mut PlanRequest { target, limits, changes, cost: &mut cost });
            assert!((0.5..=20.0).contains(&decision.step), "{kind} {i} {decision:?}");
            let seconds = match i % 11 {
                3 => 1e-9,
                7 => 9_999.0,
                _ => base / decision.step,
            };
            let terms = cost(decision.step);
            controller.observe(&Observed {
                seconds,
                processor_seconds: f32::NAN,
                step: decision.step,
                target,
                changes,
                terms,
                scene: controller.scene(),
                unusual: i % 97 == 0,
            });
        }
    }
}

/// Returns the step that a rule plans after frames that took `times` seconds. The target is 0.1 s, and steps
/// range from 1 to `coarsest`.
fn after(kind: ControllerKind, coarsest: f32, times: &[f32]) -> f32 {
    let g = StepResponse::inverse_step(0.1);
    let mut rule = controller(kind, 1.0, &g, None);
    let limits = StepLimits { finest: 1.0, coarsest };
    let (target, changes) = (0.1, Changes::default());
    let mut cost = |_: f32| CostTerms::whole(1.0, 0.0, Source::Analytic);
    for &seconds in times {
        let step = rule.plan(&mut PlanRequest { target, limits, changes, cost: &mut cost }).step;
        let (terms, scene) = (cost(step), rule.scene());
        rule.observe(&Observed {
            seconds,
            processor_seconds: f32::NAN,
            step,
            target,
            changes,
            terms,
            scene,
            unusual: false,
        });
    }
    rule.plan(&mut PlanRequest { target, limits, changes, cost: &mut cost }).step
}

fn close(a: f32, b: f32) -> bool {
    (a / b - 1.0).abs() < 1e-3
}

/// After two slow frames the rule wants step 5, but the third frame is drawn at the limit, step 4.
#[test]
fn the_rule_of_vtks_gpu_mapper_counts_with_the_step_that_was_drawn() {
    assert_eq!(after(ControllerKind::VtkGpu, 4.0, &[10.0, 10.0, 0.03]), 2.0);
}

#[test]
fn the_rule_of_vtk_js_has_its_published_limits() {
    let step = |times: &[&[f32]]| after(ControllerKind::VtkJs, 400.0, &times.concat());
    // Each slice holds the frames of one window, which ends when at least one second has passed.
    let slow: &[f32] = &[0.4; 3];
    assert!(close(step(&[slow]), 4.0));
    assert!(close(step(&[slow, &[0.086; 12]]), 4.0));
    assert!(close(step(&[slow, &[0.084; 12]]), 3.36));
    assert_eq!(step(&[slow, &[0.03; 34]]), 1.0);
    assert!(close(step(&[slow, &[0.03; 34], &[0.12; 9]]), 1.8));
}

#[test]
fn the_heuristic_of_unreal_has_its_published_constants() {
    let side = |times: &[&[f32]]| after(ControllerKind::Unreal, 4.0, &times.concat()).sqrt().recip();
    // Fraction of each side that a frame at full resolution suggests.
    let suggested = |seconds: f32| (0.09 / seconds).sqrt();
    // The time of the first frame is ignored.
    let first: &[f32] = &[0.1];
    assert!(close(side(&[first, &[0.095; 8]]), suggested(0.095)));
    assert_eq!(side(&[first, &[0.092; 8]]), 1.0);
    let panic = (suggested(0.4) + 0.9 * suggested(0.2)) / 1.9;
    assert!(close(side(&[first, &[0.09, 0.2, 0.4]]), panic));
    // A slow frame follows the first one. Then frames at 1 / 2.22 of the pixels take 0.045 s, which is 0.1 s
    // at full resolution.
    let low = suggested(0.2);
    assert!(close(side(&[first, &[0.2]]), low));
    assert!(close(side(&[first, &[0.2], &[0.045; 8]]), low + 0.9 * (suggested(0.1) - low)));
}

#[test]
fn the_integral_of_filament_is_limited_to_a_fifth() {
    // The integral is limited to 0.2, so about 150 fast frames outweigh the slow ones.
    let times = [&[2.0f32; 60][..], &[0.001; 200]].concat();
    assert_eq!(after(ControllerKind::Filament, 1e5, &times), 1.0);
}

#[test]
fn what_the_last_frames_say_is_their_mean_the_last_or_the_larger_of_two() {
    let g = StepResponse::inverse_step(0.1);
    // Returns the planned step for a target of 10 ms, after frames at the reference step that took `times`
    // milliseconds.
    let after = |recent: Recent, times: &[f32]| {
        let mut controller = Olp::new(recent, g.clone());
        let terms = CostTerms::whole(1.0, 0.0, Source::Analytic);
        let limits = StepLimits { finest: 0.1, coarsest: 100.0 };
        let mut cost = |_: f32| terms;
        let changes = Changes::default();
        let scene = controller.scene();
        for &t in times {
            let seconds = 1e-3 * t;
            controller.observe(&Observed {
                seconds,
                processor_seconds: f32::NAN,
                step: 1.0,
                target: 0.01,
                changes,
                terms,
                scene,
                unusual: false,
            });
        }
        controller.plan(&mut PlanRequest { target: 0.01, limits, changes, cost: &mut cost }).step
    };
    let of = |t: f32| after(Recent::Last, &[t]);
    for n in 1..8 {
        let times: Vec<f32> = (0..n).map(|i| [20.0, 50.0, 30.0, 80.0][i % 4]).collect();
        let last = times[n - 1];
        let larger = if n > 1 { last.max(times[n - 2]) } else { last };
        let kept = &times[n.saturating_sub(3)..];
        let mean = kept.iter().sum::<f32>() / kept.len() as f32;
        assert_eq!(after(Recent::Last, &times), of(last), "{n}");
        assert_eq!(after(Recent::LargerOfTwo, &times), of(larger), "{n}");
        assert!((after(Recent::MeanOfThree, &times) / of(mean) - 1.0).abs() < 1e-3, "{n}");
    }
}
