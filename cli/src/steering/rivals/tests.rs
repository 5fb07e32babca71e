//! Closed loops without a renderer: frame times follow a known formula, under the hybrid and every other
//! controller.

use super::*;
use crate::steering::contenders::{ControllerKind, controller};
use clap::ValueEnum;
use entire_steer::control::{Controller, HybridOptions, Observed, PlanRequest, Prior, StepLimits};
use entire_steer::features::Changes;
use entire_steer::predict::{CostTerms, Source, TERMS};

/// A deterministic source of noise.
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
        let mut controller = controller(*kind, 2.0, &g, HybridOptions::default().prior);
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

/// A machine and a path: the cost of a frame at each step, and its prediction.
struct Plant {
    /// For each frame: seconds that do not depend on the step, and additional seconds at the reference step.
    law: fn(usize) -> (f64, f64),
    /// Number of frames between switches of the transfer function.
    switch_every: usize,
    /// Factor by which every prediction is wrong.
    bias: f64,
    /// Factor on the measured time of each frame: the state of the machine.
    speed: fn(usize) -> f64,
    target: fn(usize) -> f32,
    limits: StepLimits,
}

impl Plant {
    fn steady() -> Self {
        Self {
            law: |_| (2e-3, 60e-3),
            switch_every: usize::MAX,
            bias: 1.0,
            speed: |_| 1.0,
            target: |_| 25e-3,
            limits: StepLimits { finest: 1.0, coarsest: 32.0 },
        }
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Outcome {
    /// Share of frames longer than 1.1 times the target.
    miss: f64,
    /// Share of switch frames longer than their upper bound.
    above_bound: f64,
    /// Mean of |frame time − target| / target over the frames in which some allowed step meets the target
    /// exactly.
    deviation: f64,
    /// Mean of oracle's step / chosen step; each ratio counts as at most 1.
    quality: f64,
    /// Share of calm frames whose step differs by over 20 % from the step of the frame before.
    jumps: f64,
}

const EXPONENT: f64 = 0.9;

fn play(controller: &mut dyn Controller, plant: &Plant, frames: usize, seed: u64) -> Outcome {
    let mut noise = Noise(seed);
    let (mut scene_bias, mut drift) = (1.0, 0.0f64);
    let (mut out, mut feasible, mut calm, mut switches) = (Outcome::default(), 0.0, 0.0, 0.0);
    let mut last_step = f32::NAN;
    for i in 0..frames {
        let (fixed, work) = (plant.law)(i);
        let switched = i > 0 && i % plant.switch_every == 0;
        if i == 0 || switched {
            scene_bias = plant.bias * (0.12 * noise.normal()).exp();
        }
        // Autocorrelated errors of the prediction along a path.
        drift = 0.95 * drift + 0.05 * (1.0f64 - 0.95 * 0.95).sqrt() * noise.normal();
        let wrong = scene_bias * drift.exp();
        let mut cost = |step: f32| {
            let mut parts = [0.0; TERMS];
            parts[0] = (wrong * fixed) as f32;
            parts[4] = (wrong * work * f64::from(step).powf(-EXPONENT)) as f32;
            CostTerms { parts, out_of_range: 0.0, source: Source::Analytic }
        };
        let changes = Changes { first: i == 0, transfer: switched, ..Changes::default() };
        let target = (plant.target)(i);
        let decision =
            controller.plan(&mut PlanRequest { target, limits: plant.limits, changes, cost: &mut cost });
        let speed = (plant.speed)(i);
        let clean = |step: f64| speed * (fixed + work * step.powf(-EXPONENT));
        let spike = if noise.uniform() < 0.01 { 3.0 } else { 1.0 };
        let seconds = clean(f64::from(decision.step)) * (0.03 * noise.normal()).exp() * spike;
        let relative = seconds / f64::from(target);
        out.miss += f64::from(u8::from(relative > 1.1));
        // The oracle's step: the step at which the time without noise equals the target.
        let room = f64::from(target) / speed - fixed;
        let oracle = if room > 0.0 { (work / room).powf(1.0 / EXPONENT) } else { f64::INFINITY };
        let (finest, coarsest) = (f64::from(plant.limits.finest), f64::from(plant.limits.coarsest));
        if oracle > finest && oracle < coarsest {
            feasible += 1.0;
            out.deviation += (relative - 1.0).abs();
        }
        out.quality += (oracle.clamp(finest, coarsest) / f64::from(decision.step)).min(1.0);
        if switched {
            switches += 1.0;
            out.above_bound += f64::from(u8::from(seconds > f64::from(decision.upper)));
        } else if i > 0 {
            calm += 1.0;
            out.jumps += f64::from(u8::from((decision.step / last_step).ln().abs() > 0.182));
        }
        last_step = decision.step;
        let terms = cost(decision.step);
        controller.observe(&Observed {
            seconds: seconds as f32,
            step: decision.step,
            target,
            changes,
            terms,
            scene: controller.scene(),
            unusual: false,
        });
    }
    let n = frames as f64;
    out.miss /= n;
    out.quality /= n;
    out.deviation /= f64::max(feasible, 1.0);
    out.jumps /= f64::max(calm, 1.0);
    out.above_bound /= f64::max(switches, 1.0);
    out
}

fn mean_of(plant: &Plant, seeds: u64, frames: usize, kind: ControllerKind) -> Outcome {
    let mut sum = Outcome::default();
    for seed in 0..seeds {
        let o = play(&mut *made(kind), plant, frames, 1 + 77 * seed);
        let n = seeds as f64;
        sum.miss += o.miss / n;
        sum.above_bound += o.above_bound / n;
        sum.deviation += o.deviation / n;
        sum.quality += o.quality / n;
        sum.jumps += o.jumps / n;
    }
    sum
}

fn plants() -> Vec<(&'static str, Plant)> {
    let s = Plant::steady;
    vec![
        (
            "switch",
            Plant { law: |i| (2e-3, if i / 40 % 2 == 0 { 20e-3 } else { 160e-3 }), switch_every: 40, ..s() },
        ),
        ("orbit", Plant { law: |i| (2e-3, 60e-3 * (1.0 + 0.6 * (i as f64 / 60.0).sin())), ..s() }),
        (
            "fixed cost",
            Plant {
                law: |i| (20e-3, if (50..80).contains(&i) { 400e-3 } else { 40e-3 }),
                target: |_| 66e-3,
                ..s()
            },
        ),
        ("half", Plant { law: |i| (2e-3, 60e-3 * (1.0 + 0.6 * (i as f64 / 60.0).sin())), bias: 0.5, ..s() }),
        ("throttle", Plant { speed: |i| if i / 100 % 2 == 0 { 1.0 } else { 1.6 }, ..s() }),
        ("ramp", Plant { speed: |i| 1.0 + (i as f64 / 600.0), ..s() }),
        ("targets", Plant { target: |i| [33e-3, 16e-3, 11e-3][i / 50 % 3], ..s() }),
    ]
}

/// The controllers that are compared; the hybrid is the last one.
const COMPARED: [ControllerKind; 10] = [
    ControllerKind::Fixed,
    ControllerKind::Olp,
    ControllerKind::Pid,
    ControllerKind::Algorithm1,
    ControllerKind::VtkGpu,
    ControllerKind::VtkFixedPoint,
    ControllerKind::VtkJs,
    ControllerKind::Unreal,
    ControllerKind::Filament,
    ControllerKind::Hybrid,
];

fn made(kind: ControllerKind) -> Box<dyn Controller + Send> {
    let samples: Vec<(f32, f32)> =
        (0..12).map(|i| 1.4f32.powi(i)).map(|s| (s, (2.0 + 60.0 * s.powf(-0.9)) / 62.0)).collect();
    let g = StepResponse::from_samples(&samples).unwrap();
    controller(kind, 1.0, &g, Prior::Fitted { log_sd: 0.2 })
}

#[test]
fn prediction_with_feedback_beats_reaction_at_switches_and_in_calm() {
    let (ours, others) = COMPARED.split_last().unwrap();
    let mut wrong = Vec::new();
    let mut sum = (0.0, 0.0);
    for (name, plant) in plants() {
        let o = mean_of(&plant, 4, 400, *ours);
        eprintln!("{name:12} ours {o:.3?}");
        let mut expect = |holds: bool, what: String| {
            if !holds {
                wrong.push(format!("{name}: {what} {o:?}"));
            }
        };
        expect(o.miss <= 0.03, "misses".into());
        expect(o.deviation <= 0.08, "deviation".into());
        expect(o.quality >= 0.92, "quality".into());
        expect(o.above_bound <= 0.1, "bound at switches".into());
        for rival in others {
            let other = mean_of(&plant, 4, 400, *rival);
            eprintln!("{:12} {:16} {other:.3?}", "", rival.name());
            // No other controller has both fewer misses and more quality than the hybrid.
            expect(
                o.miss <= other.miss + 0.004 || o.quality >= other.quality - 0.02,
                format!("{rival} has fewer misses and more quality: {other:?}"),
            );
            if *rival == ControllerKind::Olp {
                sum.0 += o.jumps;
                sum.1 += other.jumps;
                expect(o.deviation <= other.deviation + 0.004, format!("deviation of OLP: {other:?}"));
                expect(o.miss <= other.miss + 0.003, format!("misses of OLP: {other:?}"));
                expect(o.quality >= other.quality - 0.015, format!("quality of OLP: {other:?}"));
            }
        }
    }
    eprintln!("jumps in all {sum:?}");
    if sum.0 > 0.5 * sum.1 {
        wrong.push(format!("step jumps: {sum:?}"));
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn an_unreachable_target_leaves_the_step_alone() {
    let plant = Plant { law: |_| (30e-3, 60e-3), ..Plant::steady() };
    let o = mean_of(&plant, 4, 400, ControllerKind::Hybrid);
    assert!(o.miss >= 0.99 && o.jumps <= 0.01, "{o:?}");
}

#[test]
fn what_the_last_frames_say_is_their_mean_the_last_or_the_larger_of_two() {
    let g = StepResponse::inverse_step(0.1);
    // Returns the planned step for a target of 10 ms, after frames at the reference step that took `times`
    // milliseconds.
    let after = |mut controller: Olp, times: &[f32]| {
        let terms = CostTerms::whole(1.0, 0.0, Source::Analytic);
        let limits = StepLimits { finest: 0.1, coarsest: 100.0 };
        let mut cost = |_: f32| terms;
        let changes = Changes::default();
        let scene = controller.scene();
        for &t in times {
            let seconds = 1e-3 * t;
            controller.observe(&Observed {
                seconds,
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
    let of = |t: f32| after(Olp::last(g.clone()), &[t]);
    for n in 1..8 {
        let times: Vec<f32> = (0..n).map(|i| [20.0, 50.0, 30.0, 80.0][i % 4]).collect();
        let last = times[n - 1];
        let larger = if n > 1 { last.max(times[n - 2]) } else { last };
        let kept = &times[n.saturating_sub(3)..];
        let mean = kept.iter().sum::<f32>() / kept.len() as f32;
        assert_eq!(after(Olp::last(g.clone()), &times), of(last), "{n}");
        assert_eq!(after(Olp::larger_of_two(g.clone()), &times), of(larger), "{n}");
        assert!((after(Olp::new(g.clone()), &times) / of(mean) - 1.0).abs() < 1e-3, "{n}");
    }
}
