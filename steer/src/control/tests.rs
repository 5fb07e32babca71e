//! Tests of controllers and sessions in closed loops, with frame times from known cost functions.

use super::hybrid::Hybrid;
use super::session::PENDING_PLANS;
use super::*;
use crate::adapt::{ObserveFlags, Verdict};
use crate::features::Setting;
use crate::features::tests::summary;
use crate::numeric::Noise;
use crate::predict::{AnalyticModel, COSTS, Source, TERMS, UnitCosts};
use entire_core::ErrorKind;
use entire_core::scene::{Arcball, Camera, Frame, GaussianLobe, TransferFunction};
use std::boxed::Box;
use std::vec::Vec;

/// Returns a controller for a model whose errors have the standard deviation `log_sd`.
pub(super) fn fitted(log_sd: f32) -> Hybrid {
    Hybrid::new(HybridOptions { log_sd: Some(log_sd), ..HybridOptions::default() })
}

/// Changes of a frame, which starts a session if `first` is true.
pub(super) fn starts(first: bool) -> Changes {
    Changes { first, ..Changes::default() }
}

/// Plans a frame with steps from 1 to `coarsest`. Returns the plan, and the observation of the frame if it
/// takes the predicted time.
pub(super) fn planned(
    hybrid: &mut Hybrid,
    (target, coarsest): (f32, f32),
    changes: Changes,
    mut cost: impl FnMut(f32) -> CostTerms,
) -> (Decision, Observed) {
    let limits = StepLimits { finest: 1.0, coarsest };
    let plan = hybrid.plan(&mut PlanRequest { target, limits, changes, cost: &mut cost });
    let (step, terms, scene) = (plan.step, cost(plan.step), hybrid.scene());
    let seconds = terms.seconds();
    (
        plan,
        Observed {
            seconds,
            processor_seconds: f32::NAN,
            step,
            target,
            changes,
            terms,
            scene,
            unusual: false,
        },
    )
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

pub(super) fn lobes(center: f32, height: f32) -> Vec<GaussianLobe> {
    std::vec![GaussianLobe { center, width: 0.002, height }]
}

pub(super) fn frame(rx: f32, ry: f32, dz: f32) -> Frame {
    Frame::new(Camera::from_arcball(Arcball { rx, ry, dz }).unwrap(), 512, 512).unwrap()
}

#[test]
fn a_session_learns_an_unknown_machine_and_holds_its_target() {
    let mut session = Session::default();
    session.set_volume(summary(&sphere(64), [64; 3], 48), None);
    // The simulated machine's ratios of unit costs differ from the default, and it is far slower than the
    // default costs predict.
    let truth = AnalyticModel::from_costs(UnitCosts::new([
        4e-3, 1e-8, 2e-7, 1e-7, 3e-7, 0.0, 0.0, 0.0, 1e-6, 1e-6, 1e-6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
    ]))
    .unwrap();
    let mut noise = Noise(7);
    let target = 1.0;
    let mut misses = 0;
    for i in 0..240 {
        if i % 60 == 0 {
            let l = lobes([0.3, 0.7, 0.5, 0.2][i / 60], [0.05, 0.9, 0.3, 0.02][i / 60]);
            let table = TransferFunction::Gaussian(l.clone()).to_table().unwrap();
            session.set_transfer(&table, Some(&l)).unwrap();
        }
        let frame = frame(20.0, i as f32 * 2.0, 1.6);
        let plan = session.plan(&frame, target).unwrap();
        let work = session.features.clone();
        let setting = Setting { step: plan.step, ..Setting::from(&frame) };
        let seconds = truth.parts(&work, &setting).seconds() * (0.03 * noise.normal()).exp() as f32;
        if i > 20 {
            misses += usize::from(seconds > 1.1 * target);
            if plan.reason != Reason::FinestAllowed && plan.step > 1.01 && i % 60 > 3 {
                assert!(seconds > 0.6 * target, "frame {i}: {seconds} at {plan:?}");
            }
        }
        session.observe(plan.id, seconds, ObserveFlags::default()).unwrap();
    }
    assert!(misses <= 8, "{misses} misses");
}

#[test]
fn costs_that_are_not_numbers_lead_to_the_coarsest_step() {
    let mut hybrid = Hybrid::new(HybridOptions::default());
    let cost =
        |_: f32| CostTerms { parts: [f32::NAN; TERMS], out_of_range: f32::NAN, source: Source::Analytic };
    let (d, seen) = planned(&mut hybrid, (0.02, 16.0), Changes::default(), cost);
    assert_eq!((d.step, d.reason), (16.0, Reason::NoInformation));
    assert_eq!(hybrid.observe(&Observed { seconds: 0.01, ..seen }), Verdict::Ignored);
}

#[test]
fn a_step_without_a_prediction_does_not_fit() {
    let mut hybrid = fitted(0.1);
    let cost = |step: f32| CostTerms::whole(0.04 / step, 0.0, Source::Network);
    let (before, seen) = planned(&mut hybrid, (0.02, 16.0), starts(true), cost);
    hybrid.observe(&seen);
    assert!(before.step < 12.0);
    // In the next scene, steps below 12 have no prediction, and the coarsest step is too slow.
    let transfer = Changes { transfer: true, ..Changes::default() };
    let (plan, _) = planned(&mut hybrid, (0.02, 16.0), transfer, |step| {
        CostTerms::whole(if step < 12.0 { f32::NAN } else { 1.6 / step }, 0.0, Source::Network)
    });
    assert_eq!((plan.step, plan.reason), (16.0, Reason::TargetUnreachable));
}

#[test]
fn a_step_without_a_bound_follows_from_lateness_and_quality_and_not_from_the_coarsest_step() {
    let cost = |step: f32| CostTerms::whole(0.03 / step, 0.0, Source::Analytic);
    let step = |log_sd: f32, coarsest: f32| {
        let (plan, _) = planned(&mut fitted(log_sd), (0.02, coarsest), starts(true), cost);
        assert_eq!(plan.reason, Reason::Fits);
        assert!(plan.upper > 0.022, "{plan:?}");
        plan.step
    };
    // Step 1.5 is expected to meet the target. With a standard deviation of 0.66 in ln(time), the normal
    // density at (ln(step / 1.5) + ln 1.1) / 0.66 equals 0.375 * 0.66 at step 2.6.
    for coarsest in [3.0, 4.5] {
        assert!((2.5..2.7).contains(&step(0.6, coarsest)), "{}", step(0.6, coarsest));
    }
    // The less is known, the less a coarser step avoids late frames.
    assert!((1.5..2.5).contains(&step(1.0, 4.5)), "{}", step(1.0, 4.5));
}

#[test]
fn an_impossible_target_is_said_and_leaves_nothing_behind() {
    let mut hybrid = fitted(0.2);
    let cost = |step: f32| CostTerms::whole(0.016 / step, 0.0, Source::Analytic);
    // Draws some frames. Returns the last plan.
    let mut drive = |frames: usize, target: f32| {
        let mut last = None;
        for _ in 0..frames {
            let (plan, seen) = planned(&mut hybrid, (target, 16.0), Changes::default(), cost);
            hybrid.observe(&seen);
            last = Some(plan);
        }
        last.unwrap()
    };
    drive(200, 0.004);
    for _ in 0..500 {
        let d = drive(1, 1e-6);
        assert_eq!((d.reason, d.step), (Reason::TargetUnreachable, 16.0));
    }
    // No windup: after the unreachable target, the step is back at 4 within nine damped frames.
    let d = drive(9, 0.004);
    assert!((d.step / 4.0).ln().abs() < 0.1, "{d:?}");
    let d = drive(9, 10.0);
    assert!(d.step < 1.05, "{d:?}");
}

#[test]
fn a_prediction_that_is_out_of_range_or_wrong_gives_way_to_recent_frames() {
    // The predictions are random and far out of range.
    let mut hybrid = fitted(0.2);
    let mut noise = Noise(11);
    let (mut history, mut misses) = (0, 0);
    for i in 0..300 {
        let nonsense = (1.5 * noise.normal()).exp() as f32;
        let cost = |step: f32| CostTerms::whole(0.06 * nonsense / step, 9.0, Source::Network);
        let (decision, seen) = planned(&mut hybrid, (0.02, 32.0), starts(i == 0), cost);
        let seconds = (0.002 + 0.058 / decision.step) * (0.03 * noise.normal()).exp() as f32;
        history += i32::from(decision.reason == Reason::History);
        misses += i32::from(i > 5 && seconds > 0.022);
        hybrid.observe(&Observed { seconds, ..seen });
    }
    assert!(history > 280 && misses < 15, "{history} {misses}");
}

#[test]
fn a_prediction_is_distrusted_only_where_its_own_step_is_out_of_range() {
    // The model was fitted to steps up to 4. The prediction meets the target of 20 ms at step 3 in the first
    // case, and at step 12 in the second.
    for (seconds, trusted) in [(0.06f32, true), (0.24, false)] {
        let mut hybrid = fitted(0.1);
        let score = |step: f32| if step > 4.0 { 3.0 } else { 0.0 };
        let cost = |step: f32| CostTerms::whole(seconds / step, score(step), Source::Analytic);
        for i in 0..20 {
            let (d, seen) = planned(&mut hybrid, (0.02, 32.0), starts(i == 0), cost);
            assert_eq!(d.reason != Reason::History, trusted || i == 0, "{seconds} s, frame {i}: {d:?}");
            assert_eq!(d.out_of_range, score(d.step));
            hybrid.observe(&Observed { seconds: seconds / d.step, ..seen });
        }
    }
}

#[test]
fn narrow_limits_do_not_allow_a_finest_step_without_a_bound() {
    let mut hybrid = fitted(1.0);
    let cost = |step: f32| CostTerms::whole(0.019 / step, 0.0, Source::Analytic);
    let (plan, _) = planned(&mut hybrid, (0.02, 2.0), starts(true), cost);
    assert_eq!(plan.reason, Reason::Fits);
    // The step with the least expected cost lies between 0.95, at which the expected time equals the target,
    // and the coarsest step.
    assert!((plan.step - 1.543456).abs() < 1e-4, "{plan:?}");
}

#[test]
fn state_survives_saving_and_damaged_state_is_refused() {
    let make = || Hybrid::new(HybridOptions::default());
    let mut hybrid = make();
    let cost = |step: f32| CostTerms::whole(0.1 / step, 0.0, Source::Analytic);
    for i in 0..50 {
        let (d, seen) = planned(&mut hybrid, (0.05, 16.0), starts(i == 0), cost);
        hybrid.observe(&Observed { seconds: 0.3 / d.step, ..seen });
    }
    let mut bytes = Vec::new();
    hybrid.save(&mut bytes);
    let mut back = make();
    back.load(&bytes).unwrap();
    let terms = cost(2.0);
    assert_eq!(back.correct(&terms, Changes::default()), hybrid.correct(&terms, Changes::default()));
    let before = back.correct(&terms, Changes::default());
    for cut in [0, 3, 10, bytes.len() - 1] {
        assert!(back.load(&bytes[..cut]).is_err());
    }
    for at in (4..bytes.len()).step_by(8) {
        let mut damaged = bytes.clone();
        damaged[at..(at + 8).min(bytes.len())].fill(0xff);
        let _ = back.load(&damaged);
        let p = back.correct(&terms, Changes::default());
        assert!(p.seconds.is_finite() && p.seconds > 0.0);
        back.load(&bytes).unwrap();
    }
    assert_eq!(back.correct(&terms, Changes::default()), before);
}

#[test]
fn the_state_stays_bounded_over_long_runs() {
    // 100 000 frames find the same faults as a million, which would take seconds.
    let mut hybrid = Hybrid::new(HybridOptions::default());
    let mut noise = Noise(5);
    for i in 0..100_000u32 {
        let scale = [1e-6f32, 1.0, 1e3][(i / 20_000) as usize % 3];
        let cost = |step: f32| CostTerms::whole(0.02 * scale / step, 0.0, Source::Analytic);
        let changes = Changes { transfer: i % 1000 == 0, ..Changes::default() };
        let (_, seen) = planned(&mut hybrid, (0.01, 16.0), changes, cost);
        let seconds = (seen.seconds * (0.1 * noise.normal()).exp() as f32).max(1e-9);
        hybrid.observe(&Observed { seconds, ..seen });
    }
    for f in hybrid.correction.factors() {
        assert!(f.is_finite() && f > 1e-5 && f < 1e5, "{:?}", hybrid.correction.factors());
    }
    let cost = |step: f32| CostTerms::whole(20.0 / step, 0.0, Source::Analytic);
    let terms = cost(1.0);
    let p = hybrid.correct(&terms, Changes::default());
    assert!((p.seconds / 20.0).ln().abs() < 0.5 && p.upper > p.seconds && p.upper < 4.0 * p.seconds, "{p:?}");
}

pub(super) fn ready_session() -> Session {
    let mut session = Session::default();
    make_ready(&mut session);
    session
}

pub(super) fn make_ready(session: &mut Session) {
    session.set_volume(summary(&sphere(32), [32; 3], 48), None);
    let table = TransferFunction::Gaussian(lobes(0.5, 0.3)).to_table().unwrap();
    session.set_transfer(&table, None).unwrap();
}

/// Draws `frames` frames, each of which takes `seconds`.
pub(super) fn draw(session: &mut Session, frame: &Frame, target: f32, seconds: f32, frames: usize) {
    for _ in 0..frames {
        let plan = session.plan(frame, target).unwrap();
        session.observe(plan.id, seconds, ObserveFlags::default()).unwrap();
    }
}

#[test]
fn broken_timings_are_refused_by_name_and_leave_no_trace() {
    let flags = ObserveFlags::default();
    let mut session = ready_session();
    let f = frame(0.0, 0.0, 2.0);
    draw(&mut session, &f, 0.02, 0.013, 10);
    let plan = session.plan(&f, 0.02).unwrap();
    let before = session.save_state();
    let rejects = |session: &mut Session, id: u64, seconds: f32, text: &str| {
        let e = session.observe(id, seconds, flags).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::RejectedObservation);
        assert!(e.to_string().contains(text), "{e}");
    };
    for (seconds, text) in [
        (f32::NAN, "is not finite"),
        (f32::INFINITY, "is not finite"),
        (0.0, "is not positive"),
        (-1.0, "is not positive"),
        (1e5, "is over 10000 s"),
    ] {
        rejects(&mut session, plan.id, seconds, text);
        assert_eq!(session.save_state(), before);
    }
    rejects(&mut session, plan.id + 1, 0.01, "no plan has this id");
    rejects(&mut session, 0, 0.01, "no plan has this id");
    assert_eq!(session.save_state(), before);
    // An observation may be many frames late; a forgotten plan and a second observation are rejected.
    let ids: Vec<u64> = (0..PENDING_PLANS).map(|_| session.plan(&f, 0.02).unwrap().id).collect();
    rejects(&mut session, plan.id, 0.013, "no plan has this id");
    assert!(session.observe(ids[0], 0.013, flags).is_ok());
    rejects(&mut session, ids[0], 0.013, "was observed before");
    let unusual = session.observe(ids[5], 0.013, ObserveFlags { unusual: true, ..flags });
    assert_eq!(unusual.unwrap(), Verdict::Ignored);
}

/// Returns the session after observations of 20 views.
fn taught(mut session: Session) -> Session {
    for i in 0..40 {
        let plan = session.plan(&frame(0.0, 3.0 * (i % 20) as f32, 2.0), 0.02).unwrap();
        session.observe(plan.id, 0.05 / plan.step, ObserveFlags::default()).unwrap();
    }
    session
}

#[test]
fn no_saved_state_with_a_flipped_bit_a_cut_or_more_bytes_is_loaded() {
    let state = taught(ready_session()).save_state();
    let mut session = ready_session();
    let fresh = session.save_state();
    let mut refused = |bytes: &[u8], what: &str| {
        let error = session.load_state(bytes).expect_err(what);
        assert_eq!(error.kind(), ErrorKind::InvalidArgument, "{what}: {error}");
        assert_eq!(session.save_state(), fresh, "{what} changed the session");
    };
    for bit in 0..8 * state.len() {
        let mut flipped = state.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        refused(&flipped, &std::format!("bit {bit} of {}", 8 * state.len()));
    }
    for cut in 0..state.len() {
        refused(&state[..cut], &std::format!("cut to {cut} bytes"));
    }
    for extra in [1, 4, 8] {
        let mut longer = state.clone();
        longer.resize(state.len() + extra, 0);
        refused(&longer, &std::format!("{extra} bytes more"));
    }
    refused(b"ENS1rubbish", "another version");
    session.load_state(&state).unwrap();
    assert_eq!(session.save_state(), state, "the whole state is taken up");
}

#[test]
fn a_prediction_after_a_load_is_that_of_the_next_plan() {
    let f = frame(20.0, 30.0, 2.0);
    let mut session = ready_session();
    session.set_enabled(false);
    draw(&mut session, &f, 0.02, 0.013, 10);
    session.set_transfer(&TransferFunction::Gaussian(lobes(0.3, 0.9)).to_table().unwrap(), None).unwrap();
    draw(&mut session, &f, 0.02, 0.03, 10);
    let state = session.save_state();
    session.load_state(&state).unwrap();
    let (predicted, planned) = (session.predict(&f).unwrap(), session.plan(&f, 0.02).unwrap());
    assert_eq!((predicted.seconds, predicted.upper), (planned.seconds, planned.upper));
}

#[test]
fn a_saved_state_is_bound_to_its_model_renderer_and_clock() {
    let named = |costs: Option<f64>, renderer: &str, clock: &str| {
        let model = match costs {
            Some(c) => AnalyticModel::from_costs(UnitCosts::new([c; COSTS])).unwrap(),
            None => AnalyticModel::default(),
        };
        let mut session = Session::new(Box::new(model), HybridOptions::default()).unwrap();
        session.set_timing_source(renderer, clock).unwrap();
        session
    };
    let state = named(None, "a renderer", "device").save_state();
    named(None, "a renderer", "device").load_state(&state).unwrap();
    for (costs, renderer, clock, says) in [
        (Some(1e-8), "a renderer", "device", "this session's model"),
        (None, "another", "device", "renderer \"a renderer\""),
        (None, "", "device", "renderer"),
        (None, "a renderer", "wall", "clock \"device\""),
    ] {
        let error = named(costs, renderer, clock).load_state(&state).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Unsupported);
        assert!(error.to_string().contains(says), "{error}");
    }
    let mut session = ready_session();
    assert!(session.set_timing_source(&"x".repeat(257), "").is_err());
}

/// Hexadecimal digits of a session's learned state, saved on a little-endian machine.
const LEARNED: &str = include_str!("learned_state.hex");

#[test]
fn a_saved_state_moves_between_machines_of_any_byte_order() {
    let named = || {
        let mut session = Session::default();
        session.set_timing_source("a renderer", "device").unwrap();
        session
    };
    let digits: Vec<u8> = LEARNED.bytes().filter(u8::is_ascii_hexdigit).collect();
    let pairs = digits.chunks(2).map(|pair| std::str::from_utf8(pair).unwrap());
    let bytes: Vec<u8> = pairs.map(|pair| u8::from_str_radix(pair, 16).unwrap()).collect();
    let mut session = named();
    assert_ne!(session.save_state(), bytes, "nothing was learned yet");
    session.load_state(&bytes).unwrap();
    assert_eq!(session.save_state(), bytes, "byte for byte");
}

#[test]
fn a_linear_cost_model_may_use_a_smaller_probe() {
    use crate::features::{MAX_PROBE_SIDE, PROBE_SIDE};
    let f = frame(20.0, 30.0, 2.0);
    let of_side = |side| {
        let mut session = ready_session().with_probe(side, None)?;
        assert_eq!(session.features.probe_side, side);
        session.predict(&f).map(|p| p.seconds)
    };
    let usual = ready_session().predict(&f).unwrap().seconds;
    assert_eq!(of_side(PROBE_SIDE).unwrap(), usual);
    for side in [4, 7, MAX_PROBE_SIDE] {
        let seconds = of_side(side).unwrap();
        assert!(seconds != usual && (seconds / usual - 1.0).abs() < 0.3, "{side}: {seconds} {usual}");
    }
    for side in [0, MAX_PROBE_SIDE + 1] {
        assert_eq!(of_side(side).unwrap_err().kind(), ErrorKind::InvalidArgument);
    }
}

#[test]
fn a_session_says_what_is_missing_and_refuses_bad_targets() {
    let f = frame(0.0, 0.0, 2.0);
    let mut empty = Session::default();
    assert_eq!(empty.plan(&f, 0.02).unwrap_err().kind(), ErrorKind::NotReady);
    let table = TransferFunction::Gaussian(lobes(0.5, 0.3)).to_table().unwrap();
    assert_eq!(empty.set_transfer(&table, None).unwrap_err().kind(), ErrorKind::NotReady);
    let mut session = ready_session();
    for target in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        assert_eq!(session.plan(&f, target).unwrap_err().kind(), ErrorKind::InvalidArgument);
        assert_eq!(session.choose(&f, &[], target).unwrap_err().kind(), ErrorKind::InvalidArgument);
    }
    assert_eq!(session.choose(&f, &[], 0.02).unwrap_err().kind(), ErrorKind::InvalidArgument);
    let state = session.save_state();
    session.load_state(&state).unwrap();
    session.set_enabled(false);
    let plan = session.plan(&Frame { step: 3.5, ..f }, 1e-9).unwrap();
    assert_eq!((plan.step, plan.reason), (3.5, Reason::Off));
}

/// Plays 150 frames with noise, late and missing observations, a switch of the transfer function, and a phase
/// with steering off. Targets and times are those of `log`; if `log` is empty, targets and times are computed
/// and added to it. Returns the plans.
fn logged(log: &mut Vec<(u32, Option<u32>)>) -> Vec<(u32, u32, u32, Reason)> {
    let replaying = !log.is_empty();
    let mut session = ready_session();
    let mut noise = Noise(21);
    let mut plans = Vec::new();
    let mut late: Option<(u64, f32)> = None;
    for i in 0..150 {
        if i == 60 {
            let table = TransferFunction::Gaussian(lobes(0.8, 0.05)).to_table().unwrap();
            session.set_transfer(&table, None).unwrap();
        }
        session.set_enabled(!(100..110).contains(&i));
        let target = if replaying {
            f32::from_bits(log[i].0)
        } else {
            [0.02, 0.015][i / 40 % 2] * (0.001 * noise.normal()).exp() as f32
        };
        let plan = session.plan(&frame(10.0, i as f32, 2.0), target).unwrap();
        plans.push((plan.step.to_bits(), plan.seconds.to_bits(), plan.upper.to_bits(), plan.reason));
        let seconds = if replaying {
            log[i].1.map(f32::from_bits)
        } else {
            let t = (0.001 + 0.03 / plan.step) * (0.05 * noise.normal()).exp() as f32;
            (i % 17 != 5).then_some(t)
        };
        if !replaying {
            log.push((target.to_bits(), seconds.map(f32::to_bits)));
        }
        if let Some((id, t)) = late.take() {
            session.observe(id, t, ObserveFlags::default()).unwrap();
        }
        match seconds {
            Some(t) if i % 10 == 3 => late = Some((plan.id, t)),
            Some(t) => drop(session.observe(plan.id, t, ObserveFlags::default())),
            None => {}
        }
    }
    plans
}

#[test]
fn a_log_of_targets_and_times_replays_to_the_same_bits() {
    let mut log = Vec::new();
    let first = logged(&mut log);
    assert_eq!(log.len(), 150);
    assert_eq!(logged(&mut log), first);
    // A change of one observed time by 1000 units in the last place must change the plans.
    log[20].1 = log[20].1.map(|t| t + 1000);
    assert_ne!(logged(&mut log), first);
}

#[test]
fn every_plan_gives_a_reason_and_the_off_switch_keeps_learning() {
    let mut log = Vec::new();
    let plans = logged(&mut log);
    let reasons: std::collections::HashSet<Reason> = plans.iter().map(|p| p.3).collect();
    assert!(
        reasons.contains(&Reason::Fits) && reasons.contains(&Reason::Held) && reasons.contains(&Reason::Off)
    );
    assert!(plans.iter().all(|p| (p.3 == Reason::Off) == (p.3 as u32 == 8)));
    assert!(plans[100..110].iter().all(|p| p.3 == Reason::Off && f32::from_bits(p.0) == 1.0));
    // While steering is off, the machine becomes three times slower; the session has learned the new speed
    // when steering is on again.
    let mut session = ready_session();
    let f = frame(10.0, 0.0, 2.0);
    for i in 0..80 {
        session.set_enabled(i < 40);
        let plan = session.plan(&f, 0.02).unwrap();
        let speed = if i < 40 { 1.0 } else { 3.0 };
        session.observe(plan.id, speed * (0.0005 + 0.03 / plan.step), ObserveFlags::default()).unwrap();
    }
    session.set_enabled(true);
    // While steering was off, only step 1 was observed. So the first four frames may be drawn coarser than
    // needed, but must not miss the target; later frames must be close to it.
    for i in 0..8 {
        let plan = session.plan(&f, 0.02).unwrap();
        let seconds = 3.0 * (0.0005 + 0.03 / plan.step);
        let least = if i < 4 { 0.008 } else { 0.016 };
        assert!((least..0.022).contains(&seconds), "frame {i}: {seconds} {plan:?}");
        session.observe(plan.id, seconds, ObserveFlags::default()).unwrap();
    }
}

#[test]
fn a_late_observation_of_an_earlier_scene_does_not_move_this_one() {
    let mut hybrid = fitted(0.2);
    let cost = |step: f32| CostTerms::whole(0.05 / step, 0.0, Source::Analytic);
    let drive = |hybrid: &mut Hybrid, transfer: bool| {
        planned(hybrid, (0.02, 16.0), Changes { transfer, ..Changes::default() }, cost).1
    };
    for _ in 0..20 {
        let o = drive(&mut hybrid, false);
        hybrid.observe(&o);
    }
    let old = drive(&mut hybrid, false);
    for transfer in [true, false, false] {
        let o = drive(&mut hybrid, transfer);
        hybrid.observe(&o);
    }
    let now = |hybrid: &Hybrid| hybrid.correct(&old.terms, Changes::default()).seconds;
    let before = now(&hybrid);
    hybrid.observe(&Observed { seconds: 2.0 * old.seconds, ..old });
    let after = now(&hybrid);
    assert!((after / before).ln().abs() < 0.02, "{before} {after}");
    // Late observations of an old scene must not make recent frames replace the prediction.
    for i in 0..40 {
        // Frames are alternately too slow and too fast, so that no load is detected.
        let wrong = if i % 2 == 0 { 2.0 } else { 0.5 };
        let terms = CostTerms::whole(wrong * old.terms.seconds(), 0.0, Source::Analytic);
        hybrid.observe(&Observed { terms, ..old });
    }
    let (plan, _) = planned(&mut hybrid, (0.02, 16.0), Changes::default(), cost);
    assert_ne!(plan.reason, Reason::History);
}

#[test]
fn an_adaptive_probe_is_refined_no_further_than_the_plan_needs() {
    let volume = summary(&sphere(64), [64; 3], 48);
    let l = lobes(0.4, 0.05);
    let table = TransferFunction::Gaussian(l.clone()).to_table().unwrap();
    let session = |tolerance: Option<f32>, side: usize| {
        let side = if tolerance.is_some() { 24 } else { side };
        let mut session = Session::default().with_probe(side, tolerance).unwrap();
        session.set_volume(volume.clone(), None);
        session.set_transfer(&table, Some(&l)).unwrap();
        session
    };
    let frame = frame(20.0, 30.0, 1.6);
    let expected = session(None, 24).predict(&frame).unwrap().seconds;
    let climbed = |tolerance: f32, target: f32| {
        let mut adaptive = session(Some(tolerance), 11);
        let plan = adaptive.plan(&frame, target).unwrap();
        let side = adaptive.features.probe_side;
        // The plan equals that of a session that always uses this probe.
        let same = session(None, side).plan(&frame, target).unwrap();
        assert_eq!((plan.step, plan.seconds), (same.step, same.seconds), "{tolerance} {target}");
        // Predictions always use the finest probe.
        assert_eq!(adaptive.predict(&frame).unwrap().seconds, expected);
        side
    };
    // All steps meet the target of 1000 s, and no step meets that of 1 ns, so the coarsest probe suffices.
    assert_eq!(climbed(0.0, 1e3), 4);
    assert_eq!(climbed(0.0, 1e-9), 4);
    // For a target between these two, any error of the probe changes the step. So a tolerance of 0 needs the
    // finest probe, and a tolerance of 1 accepts the coarsest.
    let target = 0.8 * expected;
    assert_eq!(climbed(0.0, target), 24);
    assert_eq!(climbed(1.0, target), 4);
    let sides: Vec<usize> = [0.2, 0.1, 0.05, 0.02, 0.01].map(|t| climbed(t, target)).to_vec();
    assert!(sides.is_sorted() && sides.iter().any(|s| (5..24).contains(s)), "{sides:?}");
    // After a refused frame, the rays of a coarse probe do not pass for those of the finest.
    let mut adaptive = session(Some(0.0), 24);
    adaptive.plan(&frame, 1e3).unwrap();
    assert!(adaptive.predict(&Frame { step: 0.0, ..frame }).is_err());
    adaptive.plan(&frame, target).unwrap();
    assert!(adaptive.features.probe.rays > 16);
    assert!(Session::default().with_probe(0, Some(0.1)).is_err());
    assert!(Session::default().with_probe(11, Some(f32::NAN)).is_err());
}

#[test]
fn rays_serve_while_the_view_has_hardly_turned() {
    let voxels = sphere(64);
    let volume = summary(&voxels, [64; 3], 48);
    let l = lobes(0.4, 0.05);
    let table = TransferFunction::Gaussian(l.clone()).to_table().unwrap();
    let mut session = Session::default().with_probe(7, Some(0.3)).unwrap();
    session.set_volume(volume.clone(), None);
    session.set_transfer(&table, Some(&l)).unwrap();
    let seen = |session: &mut Session, frame: &Frame| {
        session.plan(frame, 1e3).unwrap();
        let probe = &session.features.probe;
        (probe.mean_chord, probe.footprint.share)
    };
    let first = seen(&mut session, &frame(20.0, 30.0, 2.6));
    let near = seen(&mut session, &frame(22.0, 32.0, 2.62));
    assert_eq!(near.0, first.0);
    assert_ne!(near.1, first.1);
    // Each view is compared with the view for which rays were cast, not with the previous view.
    assert_eq!(seen(&mut session, &frame(24.0, 33.0, 2.64)).0, first.0);
    assert_ne!(seen(&mut session, &frame(26.0, 36.0, 2.66)).0, first.0);
    // After a change of anything but the view, rays are cast again.
    let wide = Frame { width: 300, ..frame(24.0, 34.0, 2.64) };
    let mut before = seen(&mut session, &wide).0;
    for change in 0..3 {
        match change {
            0 => session.set_transfer(&table, Some(&l)).unwrap(),
            1 => session.mark(Changes { camera: true, ..Changes::default() }),
            _ => {}
        }
        let near = frame(25.0 + 0.4 * change as f32, 34.0, 2.64);
        let far = frame(24.0, 34.0, 2.9);
        let turned = Frame { width: 300, ..if change == 2 { far } else { near } };
        let now = seen(&mut session, &turned).0;
        assert_ne!(now, before, "{change}");
        before = seen(&mut session, &wide).0;
        if change < 2 {
            assert_eq!(before, now);
        }
    }
    // After another time step, rays are cast again.
    let thinner: Vec<u8> = voxels.iter().map(|&v| if v < 120 { 0 } else { v }).collect();
    session.set_time_step(summary(&thinner, [64; 3], 48), None).unwrap();
    let step = Setting::from(&wide);
    let shown = |session: &Session| session.features.work(&step).samples;
    let of_first = shown(&session);
    session.plan(&wide, 1e3).unwrap();
    assert!(shown(&session) < 0.5 * of_first, "{of_first}");
    // Without a tolerance, every plan casts rays.
    let mut plain = Session::default().with_probe(7, None).unwrap();
    plain.set_volume(volume, None);
    plain.set_transfer(&table, Some(&l)).unwrap();
    let first = seen(&mut plain, &frame(20.0, 30.0, 2.6));
    assert_ne!(seen(&mut plain, &frame(21.0, 30.0, 2.6)).0, first.0);
}
