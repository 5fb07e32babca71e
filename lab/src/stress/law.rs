//! Scenes on a scripted clock: without noise, a frame takes speed · (fixed + work · step^−0.9) seconds. The
//! script sets speed, fixed and work of every frame ([`Shot`]).

use super::{Limits, Noise, Seen, Verdict, judge};
use entire_cli::steering::contenders::{ControllerKind, controller};
use entire_cli::steering::rivals::StepResponse;
use entire_steer::control::{Controller, FrameBudget, Observed, PassShare, PlanRequest, Reason, StepLimits};
use entire_steer::features::Changes;
use entire_steer::predict::{CostTerms, LONGEST_FRAME, Source};
use std::cell::RefCell;

const EXPONENT: f64 = 0.9;
const FINEST_STEP: f32 = 1.0;
const COARSEST_STEP: f32 = 32.0;
/// Seconds that do not depend on the step, as assumed by the predictor.
const FIXED_SECONDS: f64 = 2e-3;

/// Time that is reported to the controller for a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Heard {
    /// The controller gets the true time.
    True,
    /// The controller gets this other time, in seconds.
    Other(f64),
    /// The controller gets no time.
    Nothing,
    /// The controller gets the true time, but this number of frames later.
    Late(usize),
    /// The controller gets the true time, rounded up to whole intervals of a 60 Hz display.
    Interval,
}

#[derive(Clone, Copy, Debug)]
struct Shot {
    /// Seconds that do not depend on the step.
    fixed: f64,
    /// Part of the seconds that depends on the step, at step 1.
    work: f64,
    /// Factor on all seconds, from the machine or from effects that no predictor models.
    speed: f64,
    /// Factor by which the predictor's seconds are wrong.
    wrong: f64,
    /// True if the predictor returns only the total time, not its fixed part and the part that depends on the
    /// step.
    whole: bool,
    changes: Changes,
    target: f64,
    heard: Heard,
    unusual: bool,
    excused: bool,
    part: usize,
}

impl Shot {
    const PLAIN: Self = Self {
        fixed: FIXED_SECONDS,
        work: 60e-3,
        speed: 1.0,
        wrong: 1.0,
        whole: false,
        changes: STEADY,
        target: 25e-3,
        heard: Heard::True,
        unusual: false,
        excused: false,
        part: 0,
    };
}

const STEADY: Changes =
    Changes { first: false, transfer: false, volume: false, size: false, mode: false, camera: false };
const TRANSFER: Changes = Changes { transfer: true, ..STEADY };
const MODE: Changes = Changes { mode: true, ..STEADY };

/// A script: a function of frame number and noise.
type Script<'a> = &'a mut dyn FnMut(usize, &mut Noise) -> Shot;

/// Length and noise of a scene: the number of frames, the standard deviation of the noise in ln(seconds), and
/// the probability that a frame takes three times as long (`None`: no number is drawn for it).
type Course = (usize, f64, Option<f64>);

fn response() -> StepResponse {
    let samples: Vec<(f32, f32)> = (0..12)
        .map(|i| 1.4f64.powi(i))
        .map(|s| (s as f32, ((2.0 + 60.0 * s.powf(-EXPONENT)) / 62.0) as f32))
        .collect();
    StepResponse::from_samples(&samples).unwrap_or_else(|_| StepResponse::inverse_step(0.03))
}

fn new(method: ControllerKind) -> Box<dyn Controller + Send> {
    controller(method, 3.0, &response(), Some(0.15))
}

/// Plays a script. `each` gets the number of every frame, the reason for the decision, and the frame.
fn play_script(
    controller: &mut dyn Controller,
    seed: u64,
    (frames, sigma, spikes): Course,
    script: Script<'_>,
    mut each: impl FnMut(usize, Reason, &Seen),
) {
    let mut noise = Noise::new(seed);
    // Observations, each with the number of the frame after which the controller gets it.
    let mut waiting: Vec<(usize, Observed)> = Vec::new();
    let (finest, coarsest) = (f64::from(FINEST_STEP), f64::from(COARSEST_STEP));
    let limits = StepLimits { finest: FINEST_STEP, coarsest: COARSEST_STEP };
    for i in 0..frames {
        let shot = script(i, &mut noise);
        let mut cost = |step: f32| {
            let scaled = f64::from(step).powf(-EXPONENT);
            if shot.whole {
                let seconds = shot.wrong * (shot.fixed + shot.work * scaled);
                return CostTerms::whole(seconds as f32, 0.0, Source::Analytic);
            }
            let mut terms = CostTerms::whole(0.0, 0.0, Source::Analytic);
            terms.parts[0] = (shot.wrong * FIXED_SECONDS) as f32;
            terms.parts[4] = (shot.wrong * shot.work * scaled) as f32;
            terms
        };
        let changes = Changes { first: i == 0, ..shot.changes };
        let decision = controller.plan(&mut PlanRequest {
            target: shot.target as f32,
            limits,
            changes,
            cost: &mut cost,
        });
        let clean = |step: f64| shot.speed * (shot.fixed + shot.work * step.powf(-EXPONENT));
        let step = f64::from(decision.step);
        let spike = if spikes.is_some_and(|share| noise.uniform() < share) { 3.0 } else { 1.0 };
        let seconds = clean(step) * (sigma * noise.normal()).exp() * spike;
        let room = shot.target / shot.speed - shot.fixed;
        let oracle = if room > 0.0 { (shot.work / room).powf(1.0 / EXPONENT) } else { coarsest };
        let seen = Seen {
            target: shot.target,
            seconds,
            clean: clean(step),
            step,
            oracle: oracle.clamp(finest, coarsest),
            feasible: clean(coarsest) <= shot.target,
            upper: f64::from(decision.upper),
            predicted: f64::from(decision.seconds),
            first: shot.changes != Changes::default(),
            excused: shot.excused,
            part: shot.part,
        };
        each(i, decision.reason, &seen);
        let terms = cost(decision.step);
        let scene = controller.scene();
        let heard = match shot.heard {
            Heard::True => Some((i, seconds)),
            Heard::Other(other) => Some((i, other)),
            Heard::Interval => Some((i, (seconds * 60.0).ceil() / 60.0)),
            Heard::Late(frames) => Some((i + frames, seconds)),
            Heard::Nothing => None,
        };
        waiting.extend(heard.map(|(due, seconds)| {
            let observed = Observed {
                seconds: seconds as f32,
                processor_seconds: f32::NAN,
                step: decision.step,
                target: shot.target as f32,
                changes,
                terms,
                scene,
                unusual: shot.unusual,
            };
            (due, observed)
        }));
        waiting.retain(|(due, observed)| {
            // As in a session: impossible times are refused before they reach a controller.
            if *due <= i && observed.seconds > 0.0 && observed.seconds <= LONGEST_FRAME {
                controller.observe(observed);
            }
            *due > i
        });
    }
}

fn seen_of(method: ControllerKind, seed: u64, course: Course, script: Script<'_>) -> Vec<Seen> {
    let mut out = Vec::with_capacity(course.0);
    play_script(&mut *new(method), seed, course, script, |_, _, seen| out.push(*seen));
    out
}

/// Errors of the prediction in ln(seconds): `scene` is constant from one new scene to the next, `drift`
/// changes along the path.
struct Wrong {
    scene: f64,
    drift: f64,
}

impl Wrong {
    fn next(&mut self, new_scene: bool, noise: &mut Noise) -> f64 {
        if new_scene {
            self.scene = 0.12 * noise.normal();
        }
        self.drift = 0.95 * self.drift + 0.0125 * noise.normal();
        (self.scene + self.drift).exp()
    }
}

/// Plays a scene of this file; `None` for other scenes. `soak` is the number of disturbed frames in scene 27.
pub(crate) fn play(scene: usize, method: ControllerKind, soak: u64) -> Option<Verdict> {
    let mut wrong = Wrong { scene: 0.0, drift: 0.0 };
    let go = |limits: Limits, script: Script<'_>| {
        let seen = seen_of(method, scene as u64, (400, 0.03, Some(0.005)), script);
        Some(judge(scene, method, &seen, limits, None))
    };
    let strict = |missed, run, quality| Limits { missed, run, quality, inside: 0.9 };
    match scene {
        1 => go(strict(0.08, 2, 0.0), &mut |i, n| {
            let new = i > 0 && (i % 30 == 0 || i >= 300);
            let dense = if i < 300 { i / 30 % 2 == 1 } else { i % 2 == 1 };
            Shot {
                work: if dense { 160e-3 } else { 20e-3 },
                wrong: wrong.next(i == 0 || new, n),
                changes: if new { TRANSFER } else { Changes::default() },
                ..Shot::PLAIN
            }
        }),
        2 => go(strict(0.05, 3, 0.85), &mut |i, n| {
            let drag = (60..260).contains(&i);
            Shot {
                fixed: if drag { 6e-3 } else { 2e-3 },
                work: if drag { 60e-3 * (1.0 + 0.5 * ((i - 60) as f64 / 30.0).sin()) } else { 60e-3 },
                wrong: wrong.next(i == 0 || i == 60, n),
                changes: if drag { TRANSFER } else { Changes::default() },
                ..Shot::PLAIN
            }
        }),
        16 => go(strict(0.03, 3, 0.85), &mut |i, n| {
            let build = i == 0 || i == 150;
            Shot {
                speed: if build { 40.0 } else { 1.0 },
                wrong: wrong.next(build, n),
                changes: if i == 150 { MODE } else { Changes::default() },
                unusual: i == 150,
                excused: build,
                ..Shot::PLAIN
            }
        }),
        17 => go(strict(0.05, 3, 0.85), &mut |i, n| Shot {
            speed: if i / 80 % 2 == 1 { 1.8 } else { 1.0 },
            wrong: wrong.next(i == 0, n),
            ..Shot::PLAIN
        }),
        18 => go(strict(0.05, 3, 0.85), &mut |i, n| {
            let boost = if i < 60 { 0.8 } else { 0.8 + 0.2 * ((i - 60) as f64 / 40.0).min(1.0) };
            let throttle = 1.0 + 0.9 * ((i as f64 - 150.0) / 200.0).clamp(0.0, 1.0);
            Shot { speed: boost * throttle, wrong: wrong.next(i == 0, n), ..Shot::PLAIN }
        }),
        19 => go(strict(0.05, 3, 0.8), &mut |i, n| {
            let heard = match i % 23 {
                3 => Heard::Other(0.0),
                7 => Heard::Other(-0.01),
                9 => Heard::Other(f64::NAN),
                12 => Heard::Other(1e9),
                15 => Heard::Other(f64::INFINITY),
                // The overflow of a 32-bit counter of nanoseconds: far too long, but possible.
                18 => Heard::Other(4.29),
                20 => Heard::Nothing,
                _ if i % 4 == 0 => Heard::Late(3),
                _ => Heard::True,
            };
            Shot { heard, wrong: wrong.next(i == 0, n), ..Shot::PLAIN }
        }),
        20 => {
            let mut shot = |i: usize, n: &mut Noise| Shot {
                heard: Heard::Interval,
                whole: true,
                wrong: wrong.next(i == 0, n),
                excused: i < 10,
                ..Shot::PLAIN
            };
            let limits = Limits { quality: 0.35, ..Limits::missed(0.05) };
            let seen = seen_of(method, 20, (400, 0.03, None), &mut shot);
            Some(judge(20, method, &seen, limits, None))
        }
        21 => go(strict(0.05, 2, 0.0), &mut |i, n| {
            let new = i > 0 && i % 50 == 0;
            Shot {
                work: if i / 50 % 2 == 1 { 225e-3 } else { 15e-3 },
                wrong: wrong.next(i == 0 || new, n),
                changes: if new { MODE } else { Changes::default() },
                ..Shot::PLAIN
            }
        }),
        22 => Some(clamps(method)),
        23 => go(strict(0.04, 2, 0.9), &mut |i, n| Shot {
            target: [33e-3, 16e-3, 200e-3, 11e-3, 33e-3][(i / 80).min(4)],
            wrong: wrong.next(i == 0, n),
            ..Shot::PLAIN
        }),
        24 => Some(resonance(method)),
        25 => go(strict(0.06, 3, 0.85), &mut |i, n| {
            // Half of the volume is cropped away, then an occluder covers it, then frames take longer; in
            // between, frame times are normal. No change is reported to the controller.
            let factor = match i / 60 {
                1 => 0.5,
                3 => 0.3,
                5 => 1.6,
                _ => 1.0,
            };
            Shot { speed: factor, wrong: wrong.next(i == 0, n), ..Shot::PLAIN }
        }),
        26 => Some(paging(method)),
        27 => Some(long_run(method, soak)),
        28 => Some(two_eyes(method)),
        29 => Some(bursts(method)),
        30 => Some(stalls(method)),
        31 => Some(halved(method)),
        _ => None,
    }
}

/// Scene 22: after 60 frames with a possible target, a target that no step meets, then the possible target
/// again, then a target that every step meets.
fn clamps(method: ControllerKind) -> Verdict {
    let mut seen = Vec::new();
    let mut shot = |i: usize, _: &mut Noise| {
        let (target, part) = match i {
            0..60 => (25e-3, 0),
            60..260 => (1e-3, 1),
            260..320 => (25e-3, 2),
            _ => (10.0, 3),
        };
        Shot { target, part, ..Shot::PLAIN }
    };
    let mut unsaid = 0;
    play_script(&mut *new(method), 22, (400, 0.01, Some(0.0)), &mut shot, |_, reason, s| {
        unsaid += usize::from(s.part == 1 && reason != Reason::TargetUnreachable);
        seen.push(*s);
    });
    let at = |range: std::ops::Range<usize>, wrong: &dyn Fn(&Seen) -> bool| {
        range.filter(|i| wrong(&seen[*i])).count()
    };
    let away = at(80..260, &|s| s.step < 0.99 * f64::from(COARSEST_STEP));
    let over = at(263..320, &|s| s.seconds > 1.1 * s.target);
    let under = at(275..320, &|s| s.seconds < 0.75 * s.target);
    let coarse = at(340..400, &|s| s.step > 1.05);
    let broken = [
        (away > 0).then(|| format!("not at the coarsest step in {away} of 180 frames with a 1 ms target")),
        (over > 0).then(|| format!("{over} frames over 1.1 T after the 1 ms target")),
        (under > 0).then(|| format!("integral windup: {under} frames under 0.75 T after the 1 ms target")),
        (coarse > 0).then(|| format!("not at the finest step in {coarse} of 60 frames with a 10 s target")),
        (method == ControllerKind::Hybrid && unsaid > 0)
            .then(|| format!("did not report an unreachable target in {unsaid} frames")),
    ];
    judge(22, method, &seen, Limits::missed(1.0), broken.into_iter().flatten())
}

/// Scene 24: frame times that oscillate, with several periods.
fn resonance(method: ControllerKind) -> Verdict {
    let mut broken = Vec::new();
    let mut all = Vec::new();
    for period in [2usize, 3, 4, 6, 10] {
        let factor = |i: usize| 1.0 + 0.15 * (std::f64::consts::TAU * i as f64 / period as f64 + 0.4).sin();
        let mut shot = |i: usize, _: &mut Noise| Shot { speed: factor(i), ..Shot::PLAIN };
        let seen = seen_of(method, 24 + period as u64, (300, 0.01, Some(0.0)), &mut shot);
        let spread = |values: Vec<f64>| {
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
        };
        let got = spread(seen[60..].iter().map(|s| (s.seconds / s.target).ln()).collect());
        let open = spread((60..300).map(|i| factor(i).ln()).collect());
        if got > 1.35 * open {
            broken.push(format!("period {period}: {:.2} times the spread at a fixed step", got / open));
        }
        all.extend(seen);
    }
    judge(24, method, &all, Limits::missed(1.0), broken)
}

/// Scene 26: bursts of slow frames, as under memory pressure.
fn paging(method: ControllerKind) -> Verdict {
    let mut shot = |i: usize, n: &mut Noise| {
        let burst = (150..300).contains(&i);
        let slow = burst && n.uniform() < 0.33;
        Shot { speed: if slow { 4.0 } else { 1.0 }, part: usize::from(burst), ..Shot::PLAIN }
    };
    let seen = seen_of(method, 26, (500, 0.03, Some(0.0)), &mut shot);
    let mut broken = Vec::new();
    let share = |part: usize, skip: usize, f: &dyn Fn(&Seen) -> bool| {
        let frames: Vec<&Seen> =
            seen.iter().enumerate().filter(|(i, s)| s.part == part && *i >= skip).map(|(_, s)| s).collect();
        frames.iter().filter(|s| f(s)).count() as f64 / frames.len() as f64
    };
    // A frame that takes over 1.1 times the target counts as missed even if the coarsest step misses the
    // target, too.
    let over = |s: &Seen| s.seconds > 1.1 * s.target;
    let (inside, outside) = (share(1, 0, &over), share(0, 0, &over));
    broken.extend((inside > 0.45).then(|| format!("{:.0} % of a burst's frames over 1.1 T", 100.0 * inside)));
    broken.extend((outside > 0.05).then(|| format!("{:.1} % over 1.1 T outside of bursts", 100.0 * outside)));
    if method == ControllerKind::Hybrid {
        let wide = share(1, 200, &|s| s.upper > 2.0 * s.predicted);
        if wide < 0.5 {
            broken.push(format!(
                "the bound is over twice the expected time in only {:.0} % of a burst's later frames",
                100.0 * wide
            ));
        }
        let narrow = seen[100..150].iter().filter(|s| s.upper < 1.6 * s.predicted).count();
        broken.extend((narrow < 45).then(|| "the bound is too wide before the burst".to_owned()));
    }
    judge(26, method, &seen, Limits::missed(1.0), broken)
}

/// Scene 27: a long run of `frames` frames with all disturbances, then 500 ordinary frames.
fn long_run(method: ControllerKind, frames: u64) -> Verdict {
    let mut c = new(method);
    let mut wrong = Wrong { scene: 0.0, drift: 0.0 };
    let tail = 500usize;
    let total = frames as usize + tail;
    let mut shot = |i: usize, n: &mut Noise| {
        let end = i >= frames as usize;
        let new = !end && i.is_multiple_of(997);
        let scale = [1.0, 1e-3, 30.0][i / 20_000 % 3];
        let heard = match i % 211 {
            50 if !end => Heard::Other(f64::NAN),
            51 if !end => Heard::Other(1e-12),
            52 if !end => Heard::Other(9_999.0),
            53 if !end => Heard::Nothing,
            54..60 if !end => Heard::Late(5),
            _ => Heard::True,
        };
        Shot {
            work: if end { 60e-3 } else { 60e-3 * scale * (1.0 + 0.5 * (i as f64 / 300.0).sin()) },
            speed: if !end && i / 1500 % 2 == 1 { 2.5 } else { 1.0 },
            wrong: wrong.next(new || i == frames as usize, n),
            changes: if new || i == frames as usize { TRANSFER } else { Changes::default() },
            heard,
            ..Shot::PLAIN
        }
    };
    let mut broken = Vec::new();
    let mut seen = Vec::new();
    let mut strange = 0u64;
    play_script(&mut *c, 27, (total, 0.03, Some(0.005)), &mut shot, |i, _, s| {
        let expects = !s.upper.is_nan();
        let sound = (f64::from(FINEST_STEP)..=f64::from(COARSEST_STEP)).contains(&s.step)
            && (!expects || (s.predicted.is_finite() && s.predicted > 0.0 && s.upper.is_finite()));
        strange += u64::from(!sound);
        if i >= frames as usize + 100 {
            seen.push(*s);
        }
    });
    if strange > 0 {
        broken.push(format!(
            "{strange} plans have a step outside of the limits, or an expected time or upper bound that is \
             not a valid number"
        ));
    }
    let mut state = Vec::new();
    c.save(&mut state);
    broken.extend((state.len() > 4096).then(|| format!("the state has {} bytes", state.len())));
    if method == ControllerKind::Hybrid && new(method).load(&state).is_err() {
        broken.push("the saved state cannot be loaded".into());
    }
    judge(27, method, &seen, Limits { missed: 0.05, run: 3, quality: 0.8, inside: 0.0 }, broken)
}

/// Scene 28: frames of two passes, one for each eye, and 6 ms of other work. One controller plans both
/// passes. Methods other than entire's give each pass the whole target, since they know nothing of other
/// passes.
fn two_eyes(method: ControllerKind) -> Verdict {
    const TARGET: f64 = 40e-3;
    const REST: f64 = 6e-3;
    const EYES: usize = 2;
    const SCENE_FRAMES: usize = 40;
    const FRAMES: usize = 300;
    // The eyes see the volume from two sides. A dense scene alternates with a thin one.
    let work = |frame: usize, eye: usize| {
        let scene = if frame / SCENE_FRAMES % 2 == 1 { 120e-3 } else { 40e-3 };
        scene * if eye == 0 { 0.95 } else { 1.05 }
    };
    let window = RefCell::new((FrameBudget::default(), PassShare::default()));
    let mut wrong = Wrong { scene: 0.0, drift: 0.0 };
    let mut shot = |pass: usize, n: &mut Noise| {
        let (frame, eye) = (pass / EYES, pass % EYES);
        let (budget, volume) = &mut *window.borrow_mut();
        if eye == 0 {
            budget.begin(1);
        }
        let new = eye == 0 && frame > 0 && frame.is_multiple_of(SCENE_FRAMES);
        let shared = method == ControllerKind::Hybrid;
        Shot {
            work: work(frame, eye),
            wrong: wrong.next(pass == 0 || new, n),
            changes: if new { TRANSFER } else { Changes::default() },
            target: if shared { f64::from(budget.share(volume, TARGET as f32)) } else { TARGET },
            ..Shot::PLAIN
        }
    };
    let mut seen: Vec<Seen> = Vec::with_capacity(FRAMES);
    play_script(&mut *new(method), 28, (EYES * FRAMES, 0.03, Some(0.0)), &mut shot, |pass, _, s| {
        let (frame, eye) = (pass / EYES, pass % EYES);
        let (budget, volume) = &mut *window.borrow_mut();
        budget.drew(volume, s.seconds as f32, (s.seconds * s.step) as f32);
        if eye == 0 {
            let whole: f64 = (0..EYES).map(|eye| work(frame, eye)).sum();
            let room = TARGET - REST - EYES as f64 * FIXED_SECONDS;
            let oracle = (whole / room).powf(1.0 / EXPONENT);
            let (seconds, clean) = (REST + s.seconds, REST + s.clean);
            // The bounds are those of passes.
            seen.push(Seen { target: TARGET, seconds, clean, oracle, upper: f64::NAN, ..*s });
        } else if let Some(last) = seen.last_mut() {
            last.seconds += s.seconds;
            last.clean += s.clean;
            last.step = f64::midpoint(last.step, s.step);
            budget.end(last.seconds as f32, true);
        }
    });
    judge(28, method, &seen, Limits { run: 2, quality: 0.85, ..Limits::missed(0.05) }, None)
}

/// Least share of bursts in scene 29 after which the step returns to its value before the burst.
pub(crate) const BACK: f64 = 0.9;

/// Largest number of frames in scene 31 until the target is held at half the speed.
pub(crate) const MAX_FRAMES_UNTIL_HELD: usize = 3;

/// Scene 29: bursts of another program's load.
fn bursts(method: ControllerKind) -> Verdict {
    // True for the frames of bursts. Each burst has 2 to 20 frames, and the pause after it four times as
    // many.
    let mut noise = Noise::new(29);
    let mut slow = vec![false; 30];
    while slow.len() < 600 {
        let burst = 2 + (19.0 * noise.uniform()) as usize;
        slow.extend(std::iter::repeat_n(true, burst));
        slow.extend(std::iter::repeat_n(false, 4 * burst));
    }
    let mut shot = |i: usize, _: &mut Noise| Shot { speed: if slow[i] { 2.0 } else { 1.0 }, ..Shot::PLAIN };
    let seen = seen_of(method, 29, (slow.len(), 0.03, Some(0.0)), &mut shot);
    let ends: Vec<usize> = (1..seen.len() - 2).filter(|&i| slow[i - 1] && !slow[i]).collect();
    let begun = |end: usize| (0..end).rev().take_while(|&i| slow[i]).last().unwrap_or(end);
    // The first frame after a burst shows that it has ended, so the step is checked two frames later.
    let back = |&&end: &&usize| seen[end + 2].step <= 1.1 * seen[begun(end).saturating_sub(1)].step;
    let share = ends.iter().filter(back).count() as f64 / ends.len() as f64;
    let broken = (share < BACK)
        .then(|| format!("back at the earlier step two frames after only {:.0} % of bursts", 100.0 * share));
    let verdict = judge(29, method, &seen, Limits { quality: 0.85, ..Limits::missed(0.08) }, broken);
    Verdict { figure: Some(share), ..verdict }
}

/// Scene 30: single slow frames.
fn stalls(method: ControllerKind) -> Verdict {
    let seen = seen_of(method, 30, (600, 0.03, Some(0.01)), &mut |_, _| Shot::PLAIN);
    let coarser = (30..seen.len() - 5)
        .filter(|&i| seen[i].seconds > 2.0 * seen[i].clean)
        .filter(|&i| seen[i + 1..=i + 5].iter().any(|s| s.step > 1.1 * seen[i].step))
        .count();
    let broken = (coarser > 0).then(|| format!("coarser after {coarser} stalls"));
    let verdict = judge(30, method, &seen, Limits { quality: 0.85, ..Limits::missed(1.0) }, broken);
    Verdict { figure: Some(coarser as f64), ..verdict }
}

/// Scene 31: a clock speed that is halved permanently.
fn halved(method: ControllerKind) -> Verdict {
    let mut wrong = Wrong { scene: 0.0, drift: 0.0 };
    let mut shot = |i: usize, n: &mut Noise| {
        let new = i > 200 && i.is_multiple_of(40);
        Shot {
            speed: if i >= 100 { 2.0 } else { 1.0 },
            wrong: wrong.next(i == 0 || new, n),
            changes: if new { TRANSFER } else { Changes::default() },
            ..Shot::PLAIN
        }
    };
    let seen = seen_of(method, 31, (600, 0.02, Some(0.0)), &mut shot);
    let last = seen[100..130].iter().rposition(|s| s.seconds > 1.1 * s.target);
    let until = last.map_or(0, |slow| slow + 1);
    let broken =
        (until > MAX_FRAMES_UNTIL_HELD).then(|| format!("the target is held after {until} slow frames"));
    let verdict = judge(31, method, &seen, Limits { inside: 0.9, ..Limits::missed(0.03) }, broken);
    Verdict { figure: Some(until as f64), ..verdict }
}
