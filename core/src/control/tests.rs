//! Closed loops with a scripted clock: no renderer, a known cost law.

use super::*;
use crate::adapt::{ObserveFlags, Prior};
use crate::features::{SummaryOptions, VolumeSummary};
use crate::predict::{AnalyticModel, Source, TERMS};
use crate::scene::{Arcball, Camera, Frame, GaussianLobe, Scalars, TransferFunction, VolumeView};
use std::boxed::Box;
use std::vec::Vec;

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

fn sphere(n: usize) -> Vec<u8> {
    let mut out = Vec::with_capacity(n * n * n);
    for z in 0..n {
        for y in 0..n {
            for x in 0..n {
                let r = [x, y, z].map(|i| (i as f32 + 0.5) / n as f32 * 2.0 - 1.0);
                let d = (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]).sqrt();
                out.push((255.0 * (1.0 - d).max(0.0)) as u8);
            }
        }
    }
    out
}

fn lobes(center: f32, height: f32) -> Vec<GaussianLobe> {
    std::vec![GaussianLobe { center, width: 0.002, height }]
}

fn frame(rx: f32, ry: f32, dz: f32) -> Frame {
    Frame::new(Camera::from_arcball(Arcball { rx, ry, dz }).unwrap(), 512, 512).unwrap()
}

#[test]
fn a_session_learns_an_unknown_machine_and_holds_its_target() {
    let voxels = sphere(64);
    let view = VolumeView::new(Scalars::U8(&voxels), [64; 3]).unwrap();
    let summary = VolumeSummary::new(&view, SummaryOptions::default()).unwrap();
    let mut session = Session::untrained();
    session.set_volume(summary, None);
    // The machine: another mix of unit costs, 40 times slower than the defaults.
    let truth = AnalyticModel::from_costs([4e-3, 1e-8, 2e-7, 1e-7, 3e-7, 0.0, 1e-6, 1e-6, 1e-6]).unwrap();
    let mut noise = Noise(7);
    let target = 1.0;
    let mut misses = 0;
    for i in 0..240 {
        if i % 60 == 0 {
            let l = lobes([0.3, 0.7, 0.5, 0.2][i / 60], [0.05, 0.9, 0.3, 0.02][i / 60]);
            session
                .set_transfer(&TransferFunction::Gaussian(l.clone()).to_table().unwrap(), Some(&l))
                .unwrap();
        }
        let frame = frame(20.0, i as f32 * 2.0, 1.6);
        let plan = session.plan(&frame, target).unwrap();
        let work = session.features().clone();
        let setting = crate::features::Setting::of(&frame).with_step(plan.step);
        let seconds = truth.parts(&work, &setting).seconds() * (0.03 * noise.normal()).exp() as f32;
        if i > 20 {
            misses += usize::from(seconds > 1.1 * target);
            if plan.reason != Reason::FinestAllowed && plan.step > 1.01 && i % 60 > 3 {
                assert!(
                    seconds > 0.6 * target,
                    "frame {i}: {seconds} at step {} ({:?})",
                    plan.step,
                    plan.reason
                );
            }
        }
        assert!(!session.observe(plan.id, seconds, ObserveFlags::default()).is_refused());
    }
    assert!(misses <= 8, "{misses} misses");
}

#[test]
fn costs_that_are_not_numbers_lead_to_the_coarsest_step() {
    let mut hybrid = Hybrid::new(HybridOptions { prior: Prior::Unknown, ..HybridOptions::default() });
    let mut cost =
        |_: f32| CostTerms { parts: [f32::NAN; TERMS], out_of_range: f32::NAN, source: Source::Analytic };
    let mut request =
        PlanRequest { target: 0.02, limits: StepLimits::default(), changes: Changes::NONE, cost: &mut cost };
    let d = hybrid.plan(&mut request);
    assert_eq!((d.step, d.reason), (16.0, Reason::NoInformation));
}

#[test]
fn every_controller_survives_any_observation() {
    let g = StepResponse::inverse_step(0.1);
    let controllers: Vec<Box<dyn Controller>> = std::vec![
        Box::new(Fixed::new(2.0)),
        Box::new(Olp::new(g.clone())),
        Box::new(Pid::new(Pid::PAPER_GAINS)),
        Box::new(Algorithm1::new(g)),
        Box::new(VtkGpu::new()),
        Box::new(VtkFixedPoint::new()),
        Box::new(VtkJs::new()),
        Box::new(Unreal::new()),
        Box::new(Filament::new()),
        Box::new(Hybrid::new(HybridOptions::default())),
    ];
    for mut controller in controllers {
        let mut noise = Noise(3);
        for i in 0..3000 {
            let target = [1e-3, 0.03, 5.0][i / 7 % 3];
            let base = (noise.normal() * 2.0).exp() as f32 * 0.02;
            let mut cost = |step: f32| CostTerms::whole(base / step, 0.0, Source::Analytic);
            let changes = Changes { transfer: i % 50 == 0, first: i == 0, ..Changes::NONE };
            let limits = StepLimits::new(0.5, 20.0).unwrap();
            let decision = controller.plan(&mut PlanRequest { target, limits, changes, cost: &mut cost });
            assert!((0.5..=20.0).contains(&decision.step), "{} {i} {decision:?}", controller.name());
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
                unusual: i % 97 == 0,
            });
        }
    }
}
