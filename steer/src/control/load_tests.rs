//! Tests with frames that other programs slow down, and with machines whose speed changes permanently.

use super::hybrid::Hybrid;
use super::tests::{fitted, planned, starts};
use super::*;
use crate::numeric::Noise;
use crate::predict::Source;
use std::vec::Vec;

/// Plays frames with a target of 20 ms and returns their plans. Frame i has the changes `changes(i)`. An
/// undisturbed frame takes 60 ms at step 1; frame i takes `slowed(i)` times as long.
fn played(frames: usize, changes: impl Fn(usize) -> Changes, slowed: impl Fn(usize) -> f32) -> Vec<Decision> {
    played_with(HybridOptions::default(), frames, changes, slowed)
}

/// Plays frames as [`played`] does, with options.
fn played_with(
    options: HybridOptions,
    frames: usize,
    changes: impl Fn(usize) -> Changes,
    slowed: impl Fn(usize) -> f32,
) -> Vec<Decision> {
    played_on_processors(options, frames, changes, slowed, |_| f32::NAN)
}

/// Plays frames as [`played_with`] does, with their processor times: frame i has `share(i)` times its wall
/// time.
fn played_on_processors(
    options: HybridOptions,
    frames: usize,
    changes: impl Fn(usize) -> Changes,
    slowed: impl Fn(usize) -> f32,
    share: impl Fn(usize) -> f32,
) -> Vec<Decision> {
    let mut hybrid = Hybrid::new(HybridOptions { log_sd: Some(0.15), ..options });
    let (mut noise, mut noise_of_share) = (Noise(17), Noise(19));
    let cost = |step: f32| CostTerms::whole(0.06 / step, 0.0, Source::Analytic);
    let play = |i: usize| {
        let changes = Changes { first: i == 0, ..changes(i) };
        let (plan, seen) = planned(&mut hybrid, (0.02, 32.0), changes, cost);
        let seconds = slowed(i) * seen.seconds * (0.02 * noise.normal()).exp() as f32;
        let processor_seconds = share(i) * seconds * (0.02 * noise_of_share.normal()).exp() as f32;
        hybrid.observe(&Observed { seconds, processor_seconds, ..seen });
        plan
    };
    (0..frames).map(play).collect()
}

/// Returns the steps of a calm scene of 80 frames, whose frames have these times and processor times.
fn calm_steps(slowed: impl Fn(usize) -> f32, share: impl Fn(usize) -> f32) -> Vec<f32> {
    let plans = played_on_processors(HybridOptions::default(), 80, |_| Changes::default(), slowed, share);
    plans.iter().map(|d| d.step).collect()
}

#[test]
fn one_slow_frame_changes_nothing_and_a_burst_is_followed_and_forgotten() {
    let calm = |_| Changes::default();
    let steps =
        |slowed: fn(usize) -> f32| -> Vec<f32> { played(120, calm, slowed).iter().map(|d| d.step).collect() };
    let stall = steps(|i| if i == 60 { 3.0 } else { 1.0 });
    assert!(stall[61..].iter().all(|s| *s < 1.1 * stall[60]), "{:?}", &stall[60..66]);
    let burst = steps(|i| if (60..80).contains(&i) { 2.0 } else { 1.0 });
    // The first two slow frames exceed the target. From the third on, the step must be that for the slowed
    // machine.
    assert!(burst[62..80].iter().all(|s| (1.6..2.6).contains(&(s / burst[59]))), "{:?}", &burst[58..80]);
    // The load must end with the first undisturbed frame.
    assert!(burst[81..].iter().all(|s| *s < 1.1 * burst[59]), "{:?}", &burst[80..90]);
}

#[test]
fn a_slow_frame_with_little_processor_time_begins_a_load_at_once() {
    let slowed = |i: usize| if (60..70).contains(&i) { 2.0 } else { 1.0 };
    let steps = calm_steps(slowed, |i| 1.9 / slowed(i));
    // Only the first slow frame exceeds the target.
    assert!(steps[61..70].iter().all(|s| (1.6..2.6).contains(&(s / steps[59]))), "{:?}", &steps[58..70]);
    assert!(steps[71..].iter().all(|s| *s < 1.1 * steps[59]), "{:?}", &steps[70..]);
}

#[test]
fn a_load_does_not_end_in_a_frame_with_little_processor_time() {
    // Frame 64 is fast by chance.
    let slowed = |i: usize| if (60..70).contains(&i) && i != 64 { 2.0 } else { 1.0 };
    let steps = calm_steps(slowed, |i| if (60..70).contains(&i) { 0.95 } else { 1.9 });
    assert!(steps[61..70].iter().all(|s| (1.6..2.6).contains(&(s / steps[59]))), "{:?}", &steps[58..70]);
    assert!(steps[71..].iter().all(|s| *s < 1.1 * steps[59]), "{:?}", &steps[70..]);
}

#[test]
fn a_slow_frame_with_all_of_its_processor_time_is_a_stall() {
    let steps = calm_steps(|i| if i == 60 { 2.0 } else { 1.0 }, |_| 1.9);
    assert!(steps[61..].iter().all(|s| *s < 1.1 * steps[60]), "{:?}", &steps[60..66]);
}

#[test]
fn little_processor_time_alone_changes_nothing() {
    // A frame's time is as expected, although the process got fewer processors.
    let usual = calm_steps(|_| 1.0, |_| 1.9);
    let fewer = calm_steps(|_| 1.0, |i| if i >= 60 { 0.9 } else { 1.9 });
    assert_eq!(usual, fewer);
}

#[test]
fn the_step_before_a_load_is_as_certain_after_it_as_before() {
    let plans = played(120, |_| Changes::default(), |i| if (60..80).contains(&i) { 3.0 } else { 1.0 });
    let (before, after) = (plans[59].step, plans[81].step);
    assert!(plans[70].step > 2.4 * before, "{:?}", plans[70]);
    assert!((after / before).ln().abs() < 0.04, "{before} {after}");
}

#[test]
fn a_saved_state_holds_no_load() {
    let cost = |step: f32| CostTerms::whole(0.06 / step, 0.0, Source::Analytic);
    let (mut hybrid, mut noise) = (fitted(0.15), Noise(17));
    let mut play = |hybrid: &mut Hybrid, first: bool, slowed: f32| {
        let (plan, seen) = planned(hybrid, (0.02, 32.0), starts(first), cost);
        let seconds = slowed * seen.seconds * (0.02 * noise.normal()).exp() as f32;
        hybrid.observe(&Observed { seconds, ..seen });
        plan.step
    };
    let calm = (0..60).map(|i| play(&mut hybrid, i == 0, 1.0)).last().unwrap();
    (0..4).for_each(|_| {
        play(&mut hybrid, false, 2.0);
    });
    assert!(play(&mut hybrid, false, 2.0) > 1.6 * calm);
    let mut bytes = Vec::new();
    hybrid.save(&mut bytes);
    let mut later = fitted(0.15);
    later.load(&bytes).unwrap();
    assert!(play(&mut later, true, 1.0) < 1.3 * calm);
    assert!(play(&mut later, false, 1.0) < 1.3 * calm);
}

#[test]
fn an_ignored_load_changes_no_step_until_it_is_the_machines_speed() {
    let options = HybridOptions { ignore_load: true, ..HybridOptions::default() };
    let calm = |_| Changes::default();
    let plans = played_with(options, 160, calm, |i| if i >= 60 { 2.0 } else { 1.0 });
    let before = plans[59];
    for d in &plans[60..92] {
        assert!((d.step / before.step - 1.0).abs() < 0.1, "{before:?} {d:?}");
    }
    // The expected time includes the load.
    assert!((1.7..2.3).contains(&(plans[80].seconds / before.seconds)), "{:?}", plans[80]);
    for d in &plans[110..] {
        assert!((1.6..2.6).contains(&(d.step / before.step)), "{before:?} {d:?}");
    }
}

#[test]
fn settings_are_judged_by_the_bound_that_chooses_steps() {
    let mut hybrid = fitted(0.15);
    let cost = |step: f32| CostTerms::whole(0.06 / step, 0.0, Source::Analytic);
    let (mut judged, mut bounded) = (0, 0);
    for i in 0..120 {
        let (plan, seen) = planned(&mut hybrid, (0.02, 32.0), starts(i == 0), cost);
        if plan.reason == Reason::Fits {
            let calm = Changes::default();
            judged += usize::from(!hybrid.fits(&hybrid.judged(&seen.terms, calm), 0.02));
            bounded += usize::from(!hybrid.fits(&hybrid.correct(&seen.terms, calm), 0.02));
        }
        // Every third frame stalls, so the upper bound is wide, but no load is detected.
        let slowed = if i % 3 == 2 { 3.0 } else { 1.0 };
        hybrid.observe(&Observed { seconds: seen.seconds * slowed, ..seen });
    }
    assert_eq!(judged, 0);
    assert!(bounded > 5, "{bounded}");
}

#[test]
fn a_doubtful_first_frame_is_forecast_from_once_only() {
    let mut hybrid = Hybrid::new(HybridOptions::default());
    // The prediction is out of range, so recent frames replace it.
    let cost = |step: f32| CostTerms::whole(0.01 / step, 9.0, Source::Network);
    let mut steps = Vec::new();
    for i in 0..6 {
        let (plan, seen) = planned(&mut hybrid, (0.02, 16.0), starts(i == 0), cost);
        // The first frame includes two seconds of compilation.
        hybrid.observe(&Observed { seconds: if i == 0 { 2.0 } else { seen.seconds }, ..seen });
        steps.push(plan.step);
    }
    // Only the second frame is forecast from the first, doubtful frame.
    assert!(steps[1] > 8.0 && steps[2..].iter().all(|s| *s < 4.0), "{steps:?}");
}

#[test]
fn a_load_belongs_to_the_machine_and_says_nothing_of_the_bound() {
    let switched = |i: usize| Changes { transfer: i == 70, ..Changes::default() };
    let quiet = played(75, switched, |_| 1.0);
    let loaded = played(75, switched, |i| if i >= 60 { 2.0 } else { 1.0 });
    let [calm, busy] = [quiet[70], loaded[70]];
    // The new scene's step must be that for the slowed machine, not the coarsest step.
    assert!((1.5..2.7).contains(&(busy.step / calm.step)), "{calm:?} {busy:?}");
    let wide = |d: &Decision| d.upper / d.seconds;
    assert!(wide(&busy) < 1.15 * wide(&calm), "{calm:?} {busy:?}");
}

#[test]
fn a_machine_that_stays_slower_or_faster_is_learned_for_good() {
    for speed in [0.5, 2.0f32] {
        let calm = |_| Changes::default();
        let plans = played(200, calm, |i| if i >= 60 { speed } else { 1.0 });
        for (i, d) in plans.iter().enumerate().skip(62) {
            let seconds = speed * 0.06 / d.step;
            assert!((0.015..0.0215).contains(&seconds), "{speed} frame {i}: {seconds} {d:?}");
        }
    }
}

#[test]
fn a_prediction_that_knows_nothing_of_the_step_is_not_taken_for_a_load() {
    let mut hybrid = fitted(0.3);
    // Predictions of a network trained on another renderer: they hardly depend on the step.
    let cost = |step: f32| CostTerms::whole(0.02 * step.powf(-0.05), 0.0, Source::Network);
    for i in 0..60 {
        let (decision, seen) = planned(&mut hybrid, (0.03, 16.0), starts(i == 0), cost);
        let seconds = 0.003 + 0.1 / decision.step;
        assert!(i < 30 || (0.02..0.033).contains(&seconds), "frame {i}: {seconds} {decision:?}");
        hybrid.observe(&Observed { seconds, ..seen });
    }
}

#[test]
fn where_the_time_hardly_depends_on_the_step_the_finest_step_that_fits_is_found_and_kept() {
    let mut hybrid = fitted(0.15);
    // A frame takes 20 ms at step 2, 22 ms at step 1, and 18.25 ms at step 16.
    let cost = |step: f32| CostTerms::whole(0.018 + 0.004 / step, 0.0, Source::Analytic);
    let mut steps = Vec::new();
    for i in 0..60 {
        let (decision, seen) = planned(&mut hybrid, (0.02, 16.0), starts(i == 0), cost);
        hybrid.observe(&seen);
        steps.push(decision.step);
    }
    assert!(steps[30..].iter().all(|s| (1.9..2.3).contains(s)), "{steps:?}");
}
