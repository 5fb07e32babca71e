//! Tests of settings that a caller offers, plans that it withdraws, frames that it cancels, and clocks that
//! it names.

use super::tests::{draw, frame, lobes, make_ready, ready_session};
use super::*;
use crate::adapt::{ObserveFlags, Verdict};
use crate::features::tests::{measured, summary};
use crate::features::{Setting, VolumeSummary};
use crate::predict::{AnalyticModel, Clock, Inputs, Prediction, Predictor, Source, UnitCosts};
use alloc::boxed::Box;
use alloc::vec;
use entire_core::ErrorKind;
use entire_core::scene::{Frame, ScalarType, Scalars, TransferFunction, VolumeOptions, VolumeView};

#[test]
fn a_plan_taken_back_leaves_its_id_to_the_next() {
    let (f, flags) = (frame(20.0, 30.0, 2.0), ObserveFlags::default());
    let mut session = ready_session();
    let first = session.plan(&f, 0.02).unwrap();
    session.withdraw(first.id);
    assert_eq!(
        session.observe(first.id, 0.01, flags).unwrap_err().kind(),
        ErrorKind::RejectedObservation,
        "a plan taken back is observed"
    );
    let again = session.plan(&f, 0.02).unwrap();
    assert_eq!((again.id, again.step, again.reason), (first.id, first.step, first.reason));
    session.observe(again.id, 0.01, flags).unwrap();
    let next = session.plan(&f, 0.02).unwrap();
    // Withdrawing an observed plan, an older one, or one that never existed has no effect.
    for id in [again.id, 0, next.id + 1, u64::MAX] {
        session.withdraw(id);
    }
    session.observe(next.id, 0.01, flags).unwrap();
    session.withdraw(next.id);
    assert_eq!(session.plan(&f, 0.02).unwrap().id, next.id + 1);
    // Only the newest plan can be withdrawn, not the plan before a withdrawn one.
    let [kept, withdrawn] = [0.02, 1e-6].map(|target| session.plan(&f, target).unwrap().id);
    session.withdraw(withdrawn);
    session.withdraw(kept);
    session.observe(kept, 0.01, flags).unwrap();
    assert_eq!(session.plan(&f, 0.02).unwrap().id, withdrawn);
}

#[test]
fn a_withdrawn_plan_leaves_no_trace() {
    let f = frame(20.0, 30.0, 2.0);
    let played = || {
        let mut session = ready_session();
        session.set_max_image_sample_distance(4.0, 1.0).unwrap();
        draw(&mut session, &f, 0.02, 0.03, 5);
        session
    };
    // Plans are compared as text, since their out-of-range scores are NaN.
    let expected = std::format!("{:?}", played().plan(&f, 0.02).unwrap());
    let mut session = played();
    for _ in 0..20 {
        let plan = session.plan(&f, 1e-6).unwrap();
        session.withdraw(plan.id);
    }
    // A withdrawn plan for a smaller image must leave no trace either.
    let small = session.plan(&Frame { width: 256, height: 256, ..f }, 0.02).unwrap();
    session.withdraw(small.id);
    assert_eq!(std::format!("{:?}", session.plan(&f, 0.02).unwrap()), expected);
}

#[test]
fn a_plan_withdrawn_after_an_earlier_frame_was_observed_leaves_no_trace() {
    let f = frame(20.0, 30.0, 2.0);
    let small = Frame { width: 256, height: 256, ..f };
    let play = |withdraws: bool| {
        let mut session = ready_session();
        draw(&mut session, &f, 0.02, 0.03, 5);
        let drawn = session.plan(&f, 0.02).unwrap();
        let withdrawn = withdraws.then(|| session.plan(&small, 0.02).unwrap());
        session.observe(drawn.id, 0.03, ObserveFlags::default()).unwrap();
        withdrawn.iter().for_each(|plan| session.withdraw(plan.id));
        let next = session.plan(&f, 0.02).unwrap();
        (next.step, next.seconds, session.controller.scene())
    };
    let (step, seconds, scene) = play(true);
    let expected = play(false);
    assert_eq!((step, seconds, scene.first), (expected.0, expected.1, expected.2.first));
}

/// Predicts a time that is proportional to the image's height and independent of the step.
struct ByHeight;

impl Predictor for ByHeight {
    fn predict(&mut self, inputs: &Inputs<'_>) -> Result<Prediction> {
        let seconds = 1e-4 * inputs.setting.height as f32;
        Ok(Prediction { seconds, upper: f32::NAN, out_of_range: 0.0, source: Source::Network })
    }

    fn knows_step(&self) -> bool {
        false
    }
}

/// Predicts the same time for all steps below 4, and fails for all other steps.
struct FineOnly;

impl Predictor for FineOnly {
    fn predict(&mut self, inputs: &Inputs<'_>) -> Result<Prediction> {
        if inputs.setting.step >= 4.0 {
            bail!(InvalidModel, "the output is not finite");
        }
        Ok(Prediction { seconds: 0.1, upper: f32::NAN, out_of_range: 0.0, source: Source::Network })
    }
}

#[test]
fn a_choice_that_fails_leaves_no_trace() {
    let f = frame(20.0, 30.0, 2.0);
    let mut session = Session::new(Box::new(FineOnly), HybridOptions::default()).unwrap();
    make_ready(&mut session);
    session.set_limits(StepLimits { finest: 1.0, coarsest: 2.0 }).unwrap();
    draw(&mut session, &f, 1.0, 0.1, 5);
    let trace = |session: &Session| (session.save_state(), std::format!("{:?}", session.controller.scene()));
    let before = trace(&session);
    let steps = [1.0, 8.0].map(|step| Setting { step, ..Setting::from(&f) });
    assert_eq!(session.choose(&f, &steps, 1e-3).unwrap_err().kind(), ErrorKind::InvalidModel);
    assert_eq!(trace(&session), before);
}

#[test]
fn images_of_one_width_and_several_heights_have_their_own_times() {
    // All images smaller than the frame's are one pixel wide.
    let f = Frame { width: 2, height: 400, ..frame(20.0, 30.0, 2.0) };
    let made = || {
        let mut session = Session::new(Box::new(ByHeight), HybridOptions::default()).unwrap();
        make_ready(&mut session);
        session.set_max_image_sample_distance(16.0, 1.0).unwrap();
        session
    };
    let plan = made().plan(&f, 0.01).unwrap();
    assert!((1.1..15.0).contains(&plan.image_sample_distance), "{plan:?}");
    let height = (400.0 / plan.image_sample_distance) as u32;
    let setting = Setting { step: plan.step, width: 1, height, ..Setting::from(&f) };
    let (_, own) = made().choose(&f, &[setting], 0.01).unwrap();
    assert!((plan.seconds / own.seconds - 1.0).abs() < 1e-3, "{plan:?} {own:?}");
}

#[test]
fn another_renderer_starts_without_the_learned_state() {
    let f = frame(20.0, 30.0, 2.0);
    let mut session = ready_session();
    let plan = session.plan(&f, 0.02).unwrap();
    // The learned state is kept when a renderer without a name gets one.
    session.set_timing_source("a renderer", "a watch").unwrap();
    session.observe(plan.id, 0.5, ObserveFlags::default()).unwrap();
    let learned = session.save_state();
    session.set_timing_source("a renderer", "a watch").unwrap();
    assert_eq!(session.save_state(), learned);
    let mut fresh = ready_session();
    fresh.set_timing_source("a renderer", "a watch").unwrap();
    assert_ne!(fresh.save_state(), learned);
    session.set_timing_source("another", "a watch").unwrap();
    session.set_timing_source("a renderer", "a watch").unwrap();
    assert_eq!(session.save_state(), fresh.save_state());
}

#[test]
fn frames_whose_setting_is_chosen_elsewhere_go_on_with_their_scene() {
    let f = frame(0.0, 0.0, 2.0);
    let settings = [1.0f32, 2.0, 4.0].map(|step| Setting { step, ..Setting::from(&f) });
    let other = TransferFunction::Gaussian(lobes(0.3, 0.9)).to_table().unwrap();
    for off in [false, true] {
        let mut session = ready_session();
        session.set_enabled(!off);
        let begins = |session: &mut Session| {
            let id = if off {
                session.plan(&f, 0.02).unwrap().id
            } else {
                session.choose(&f, &settings, 0.02).unwrap().1.id
            };
            session.observe(id, 0.01, ObserveFlags::default()).unwrap();
            session.controller.scene().first
        };
        assert!(begins(&mut session));
        assert!((0..5).all(|_| !begins(&mut session)), "off: {off}");
        session.set_transfer(&other, None).unwrap();
        assert!(begins(&mut session), "off: {off}");
        assert!(!begins(&mut session), "off: {off}");
    }
}

#[test]
fn a_scene_begins_with_the_first_frame_that_is_drawn() {
    let f = frame(20.0, 30.0, 2.0);
    let mut session = ready_session();
    draw(&mut session, &f, 0.02, 0.01, 5);
    assert!(!session.controller.scene().first);
    session.set_transfer(&TransferFunction::Gaussian(lobes(0.3, 0.9)).to_table().unwrap(), None).unwrap();
    for _ in 0..3 {
        let plan = session.plan(&f, 0.02).unwrap();
        assert!(session.controller.scene().first);
        session.withdraw(plan.id);
    }
}

#[test]
fn a_cancelled_frame_says_something_only_when_it_took_longer_than_expected() {
    let f = frame(20.0, 30.0, 2.0);
    let cancelled = ObserveFlags { cancelled: true, ..ObserveFlags::default() };
    let raw = ready_session().predict(&f).unwrap().seconds;
    // The machine is 20 times slower, then 20 times faster than the model predicts.
    for speed in [20.0, 0.05] {
        let mut session = ready_session();
        for _ in 0..30 {
            let plan = session.plan(&f, 1e-9).unwrap();
            session.observe(plan.id, speed * plan.step.recip() * raw, ObserveFlags::default()).unwrap();
        }
        let plan = session.plan(&f, 1e-9).unwrap();
        assert_eq!(session.observe(plan.id, 0.8 * plan.seconds, cancelled).unwrap(), Verdict::Ignored);
        let plan = session.plan(&f, 1e-9).unwrap();
        assert_ne!(session.observe(plan.id, 1.2 * plan.seconds, cancelled).unwrap(), Verdict::Ignored);
    }
}

#[test]
fn no_later_frame_gets_the_processor_time_of_a_cancelled_one() {
    let f = frame(20.0, 30.0, 2.0);
    let mut truth = ready_session();
    let mut predicted = |step: f32| truth.predict(&Frame { step, ..f }).unwrap().seconds;
    let target = 50.0 * predicted(1.0);
    let mut last_step = |stated: f32| {
        let mut session = ready_session();
        for _ in 0..30 {
            let plan = session.plan(&f, target).unwrap();
            let seconds = 40.0 * predicted(plan.step);
            session.set_processor_seconds(1.9 * seconds);
            session.observe(plan.id, seconds, ObserveFlags::default()).unwrap();
        }
        let plan = session.plan(&f, target).unwrap();
        session.set_processor_seconds(stated);
        let cancelled = ObserveFlags { cancelled: true, ..ObserveFlags::default() };
        assert_eq!(session.observe(plan.id, 0.1 * plan.seconds, cancelled).unwrap(), Verdict::Ignored);
        // A slow frame whose processor time is not stated.
        let plan = session.plan(&f, target).unwrap();
        session.observe(plan.id, 80.0 * predicted(plan.step), ObserveFlags::default()).unwrap();
        session.plan(&f, target).unwrap().step
    };
    assert_eq!(last_step(0.1 * target), last_step(f32::NAN));
}

#[test]
fn settings_to_choose_from_are_held_to_the_limits_of_frames() {
    let f = frame(0.0, 0.0, 2.0);
    let mut session = ready_session();
    let good = Setting::from(&f);
    for bad in [
        Setting { step: 1.0e-45, ..good },
        Setting { step: f32::NAN, ..good },
        Setting { width: 0, ..good },
        Setting { height: u32::MAX, ..good },
    ] {
        let error = session.choose(&f, &[good, bad], 0.02).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::InvalidArgument);
        assert!(std::format!("{error}").contains("setting 1: "), "{error}");
    }
}

#[test]
fn choose_takes_the_first_setting_that_fits() {
    let mut session = ready_session();
    let f = frame(0.0, 0.0, 2.0);
    let setting = Setting::from(&f);
    let settings = [0.25f32, 0.5, 1.0, 2.0, 4.0, 8.0].map(|s| Setting { step: s, ..setting });
    // The session learns the machine's speed.
    for _ in 0..30 {
        let (index, plan) = session.choose(&f, &settings, 0.02).unwrap();
        let seconds = 0.001 + 0.04 / settings[index].step;
        session.observe(plan.id, seconds, ObserveFlags::default()).unwrap();
    }
    let (index, plan) = session.choose(&f, &settings, 0.025).unwrap();
    assert_eq!((index, plan.reason), (3, Reason::Fits), "{plan:?}");
    let (index, plan) = session.choose(&f, &settings, 1e-6).unwrap();
    assert_eq!((index, plan.reason), (5, Reason::TargetUnreachable));
    assert_eq!(session.choose(&f, &settings, 10.0).unwrap().0, 0);
}

#[test]
fn the_own_step_of_a_frame_whose_setting_is_chosen_changes_no_plan() {
    let played = |step: f32| {
        let f = Frame { step, ..frame(20.0, 30.0, 2.0) };
        let settings = [1.0f32, 6.0].map(|step| Setting { step, ..Setting::from(&f) });
        let mut session = ready_session();
        for _ in 0..12 {
            let plan = session.choose(&f, &settings, 0.02).unwrap().1;
            session.observe(plan.id, 0.005 + 0.06 / plan.step, ObserveFlags::default()).unwrap();
        }
        std::format!("{:?}", session.plan(&f, 0.02).unwrap())
    };
    let expected = played(6.0);
    for step in [1.0 / 64.0, 1.0, 4096.0] {
        assert_eq!(played(step), expected, "{step}");
    }
}

#[test]
fn options_that_steering_cannot_hold_to_are_refused() {
    let good = HybridOptions::default();
    assert_eq!(good.checked(), Ok(good));
    let ends = HybridOptions { miss_rate: 0.5, tolerance: 0.0, trust_limit: f32::INFINITY, ..good };
    assert_eq!(ends.checked(), Ok(ends));
    for bad in [0.0, -0.1, 0.51, f32::NAN] {
        let error = HybridOptions { miss_rate: bad, ..good }.checked().unwrap_err();
        assert_eq!(error.kind(), ErrorKind::InvalidArgument);
        assert!(std::format!("{error}").contains("miss_rate"), "{error}");
    }
    for bad in [-0.1, f32::NAN, f32::INFINITY] {
        assert!(HybridOptions { tolerance: bad, ..good }.checked().is_err(), "{bad}");
    }
    for bad in [0.0, -1.0, f32::NAN] {
        assert!(HybridOptions { trust_limit: bad, ..good }.checked().is_err(), "{bad}");
    }
}

#[test]
fn a_time_step_keeps_the_transfer_function_and_the_scene() {
    let f = frame(20.0, 30.0, 2.0);
    let summary = |voxels: &[u8], dims| summary(voxels, dims, 48);
    let mut voxels = vec![0u8; 32 * 32 * 32];
    let mut session = Session::default();
    let error = session.set_time_step(summary(&voxels, [32; 3]), None).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::NotReady);
    session = ready_session();
    draw(&mut session, &f, 0.02, 0.01, 5);
    voxels[9000..20_000].fill(130);
    let next = summary(&voxels, [32; 3]);
    session.set_time_step(next.clone(), None).unwrap();
    session.plan(&f, 0.02).unwrap();
    assert!(!session.controller.scene().first);
    // The frame's features are those of the next time step under the same table.
    let table = TransferFunction::Gaussian(lobes(0.5, 0.3)).to_table().unwrap();
    let expected = measured(&next, &table, &f);
    assert_eq!(session.features, expected);
    // A volume whose sizes, spacing or type differ from those of the series is refused.
    let error = session.set_time_step(summary(&voxels[..16 * 32 * 32], [32, 32, 16]), None).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::SizeMismatch);
    let options = VolumeOptions { spacing: [1.0, 1.0, 2.0], ..VolumeOptions::default() };
    let view = VolumeView::with(Scalars::U8(&voxels), [32; 3], options).unwrap();
    let error = session.set_time_step(VolumeSummary::new(&view).unwrap(), None).unwrap_err();
    assert!(error.to_string().contains("[1, 1, 2]"), "{error}");
    let bricks =
        VolumeSummary::from_bricks([32; 3], [1.0; 3], ScalarType::U8, [16; 3], &[[0.0, 1.0]; 8]).unwrap();
    let error = session.set_time_step(bricks, None).unwrap_err();
    assert!(
        error.to_string().contains("[4, 4, 4] cells") && error.to_string().contains("[2, 2, 2] cells"),
        "{error}"
    );
    let words: Vec<u16> = voxels.iter().map(|&v| u16::from(v)).collect();
    let view = VolumeView::new(Scalars::U16(&words), [32; 3]).unwrap();
    let other = VolumeSummary::new(&view).unwrap();
    assert_eq!(session.set_time_step(other, None).unwrap_err().kind(), ErrorKind::InvalidArgument);
    session.plan(&f, 0.02).unwrap();
    assert_eq!(session.features, expected);
}

#[test]
fn a_model_of_another_clock_is_converted_by_the_first_frames() {
    let costs = AnalyticModel::from_costs(UnitCosts::SOFTWARE).unwrap();
    let quarter =
        AnalyticModel::from_costs(UnitCosts::new(UnitCosts::SOFTWARE.seconds.map(|c| c / 4.0))).unwrap();
    let stated = |clock: Option<&str>| {
        let mut file = costs.to_model_file().unwrap();
        if let Some(clock) = clock {
            file.metadata.insert(entire_core::model::Key::Clock.into(), clock.into());
        }
        crate::predict::load(&file.to_model().unwrap()).unwrap()
    };
    // On the simulated machine, a measured time is a quarter of the predicted processor time, as wall time on
    // four processors. Returns the ratio of the second frame's expected time to its measured time. With
    // `loaded`, the session loads a state and forgets it before the first frame.
    let second = |model: Option<&str>, clock: &str, loaded: bool| {
        let mut session = Session::new(stated(model), HybridOptions::default()).unwrap();
        session.set_timing_source("a renderer", clock).unwrap();
        if loaded {
            let state = session.save_state();
            session.load_state(&state).unwrap();
            session.reset();
        }
        let own = Some(clock).filter(|c| *c != "a watch");
        assert_eq!(session.clocks().map(|c| c.map(Clock::name)), [own, model]);
        make_ready(&mut session);
        let frame = frame(10.0, 20.0, 2.0);
        let takes = |session: &mut Session| {
            let plan = session.plan(&frame, 0.05).unwrap();
            let setting = Setting { step: plan.step, ..Setting::from(&frame) };
            (plan, quarter.parts(&session.features, &setting).seconds())
        };
        let (plan, seconds) = takes(&mut session);
        session.observe(plan.id, seconds, ObserveFlags::default()).unwrap();
        let (plan, seconds) = takes(&mut session);
        plan.seconds / seconds
    };
    for (clock, loaded) in [("wall", false), ("device", false), ("wall", true)] {
        let ratio = second(Some("cpu"), clock, loaded);
        assert!((0.8..1.25).contains(&ratio), "{clock}, {loaded}: {ratio}");
    }
    // If a clock is unknown, or if both are the same, the common factor is not learned from the first frame.
    for (model, clock) in [(Some("cpu"), "cpu"), (None, "wall"), (Some("cpu"), "a watch")] {
        let ratio = second(model, clock, false);
        assert!(ratio > 1.5, "{model:?}, {clock}: {ratio}");
    }
}
