//! Stress scenes in which methods of holding a frame time are known to fail: scripts with rules for passing.
//!
//! In the scenes of [`law`], a formula gives the frame time as a function of the ray step, and a script
//! changes the formula from frame to frame. The scenes of [`world`] have real geometry, and the CPU version
//! of the raycaster counts their work. The clock of both is simulated, so that all runs give the same times.
//! Some scenes of [`world`] can also be played on a real renderer with a real clock.

pub(crate) mod law;
pub(crate) mod world;

use crate::bars::Bar;
use entire_cli::steering::contenders::ControllerKind;
use entire_io::dataset::Clock;
use entire_vk_raycaster::{CpuRaycaster, Renderer};
use serde::Serialize;

/// The stress scenes in the order of their numbers, from 1 on. `docs/src/stress.md` has the rule for passing
/// each of them. The rules are the same for every method, except for parts that need an upper bound or that
/// only entire's controller must meet.
const SCENES: [&str; 31] = [
    "abrupt transfer-function switches, then one in every frame",
    "transfer function dragged: the distance map is rebuilt in every frame",
    "camera flies into the volume and through it",
    "extreme zoom: from one block filling the image to a few pixels",
    "fully transparent transfer function, on and off",
    "fully opaque transfer function, on and off",
    "thin haze everywhere: no ray ends early, nothing is skipped",
    "noise volume: every block occupied, rays diverge",
    "constant volume, two values, a single bright voxel",
    "NaN, infinite, signed and squeezed voxel values",
    "flat, single-slice and needle volumes",
    "images from 32 x 32 to 8192 x 8192, odd shapes",
    "window resized mid path",
    "another volume in every frame (time series)",
    "volumes unlike any training data, twice as expensive as predicted",
    "pipeline compiled in the first frame and in one frame mid path; only the latter is flagged as unusual",
    "background load comes and goes unannounced",
    "clock boost, then throttling ramps",
    "timer glitches: zero, negative, NaN, huge, missing, three frames late",
    "only wall times rounded up to the display's interval",
    "shading toggled: 15 times the cost and back",
    "target that no step meets, then one that some steps meet, then one that every step meets",
    "target from 33 ms to 16, 200, 11 and 33 ms",
    "cost oscillates with periods of 2, 3, 4, 6 and 10 frames",
    "clipping, cropping and occluders that the prediction does not include",
    "memory pressure: bursts in which a third of the frames take 4 times as long",
    "a long run with switches, other speeds and timer glitches",
    "two eyes: each frame has two passes, which share the target, and other work",
    "another program takes half of the machine in bursts of 2 to 20 frames, a fifth of the time",
    "single frames of 3 times the time",
    "the clock speed is halved permanently, and the transfer function is switched later",
];

/// Number and description of every scene.
pub(crate) fn scenes() -> impl Iterator<Item = (usize, &'static str)> {
    (1..).zip(SCENES)
}

/// A frame as played, with the data that rules use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Seen {
    /// Target, seconds.
    pub(crate) target: f64,
    pub(crate) seconds: f64,
    /// True seconds without noise.
    pub(crate) clean: f64,
    pub(crate) step: f64,
    /// The finest step that meets the target without noise, clamped to the limits.
    pub(crate) oracle: f64,
    /// True if the coarsest step meets the target.
    pub(crate) feasible: bool,
    /// Upper bound, seconds; NaN for methods without upper bounds.
    pub(crate) upper: f64,
    /// Expected seconds; NaN for methods that make no prediction.
    pub(crate) predicted: f64,
    /// True if the frame is the first one after a change that was reported to the controller.
    pub(crate) first: bool,
    /// True if the rule ignores the frame, for example because a pipeline is built in it.
    pub(crate) excused: bool,
    /// Section of the script that the frame belongs to, for scenes whose rule for passing treats sections
    /// differently; 0 in other scenes.
    pub(crate) part: usize,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Limits {
    /// Upper limit of the share of feasible frames that take longer than 1.1 times the target.
    pub(crate) missed: f64,
    /// Upper limit of the number of consecutive feasible frames that take longer than 1.1 times the target.
    pub(crate) run: usize,
    /// Lower limit of the mean of the oracle's step divided by the chosen step.
    pub(crate) quality: f64,
    /// Lower limit of the share of first frames after a change that take no more than their upper bound.
    /// First frames without an upper bound do not count.
    pub(crate) inside: f64,
}

impl Limits {
    /// A rule that limits misses only.
    pub(crate) const fn missed(missed: f64) -> Self {
        Self { missed, run: usize::MAX, quality: 0.0, inside: 0.0 }
    }
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Verdict {
    pub(crate) scene: usize,
    pub(crate) method: &'static str,
    /// Failures, in words; empty if the method passed.
    pub(crate) failures: Vec<String>,
    /// Share of feasible frames that took longer than 1.1 times the target.
    pub(crate) missed: f64,
    /// Largest number of consecutive feasible frames that took longer than 1.1 times the target.
    pub(crate) run: usize,
    /// Mean of the oracle's step divided by the chosen step; ratios above 1 count as 1.
    pub(crate) quality: f64,
    /// Largest true frame time divided by the target, among feasible frames.
    pub(crate) worst: f64,
    /// Value of the scene's own bar (see [`bars`]); `None` for scenes without one.
    pub(crate) figure: Option<f64>,
}

impl Verdict {
    /// True if the method is entire's own controller.
    pub(crate) fn is_ours(&self) -> bool {
        self.method == ControllerKind::Hybrid.name()
    }

    pub(crate) fn passed(&self) -> bool {
        self.failures.is_empty()
    }
}

/// Applies the limits of a rule to the frames of a scene. `broken` are failures that are known already.
pub(crate) fn judge(
    scene: usize,
    method: ControllerKind,
    frames: &[Seen],
    limits: Limits,
    broken: impl IntoIterator<Item = String>,
) -> Verdict {
    let mut broken: Vec<String> = broken.into_iter().collect();
    let counted: Vec<&Seen> = frames.iter().filter(|f| !f.excused).collect();
    if let Some(i) = frames.iter().position(|f| !(f.step.is_finite() && f.step > 0.0)) {
        broken.push(format!("step {} at frame {i}", frames[i].step));
    }
    let feasible = counted.iter().filter(|f| f.feasible).count().max(1) as f64;
    let over = |f: &Seen| f.feasible && f.seconds > 1.1 * f.target;
    let missed = counted.iter().filter(|f| over(f)).count() as f64 / feasible;
    let (mut run, mut longest) = (0, 0);
    for f in &counted {
        run = if over(f) { run + 1 } else { 0 };
        longest = longest.max(run);
    }
    let quality =
        counted.iter().map(|f| (f.oracle / f.step).min(1.0)).sum::<f64>() / counted.len().max(1) as f64;
    let firsts: Vec<&&Seen> = counted.iter().filter(|f| f.first && !f.upper.is_nan()).collect();
    let inside = firsts.iter().filter(|f| f.seconds <= f.upper).count() as f64 / firsts.len().max(1) as f64;
    broken.extend((missed > limits.missed).then(|| format!("{:.1} % over 1.1 T", 100.0 * missed)));
    broken.extend((longest > limits.run).then(|| format!("{longest} in a row")));
    broken.extend((quality < limits.quality).then(|| format!("quality {quality:.2}")));
    if !firsts.is_empty() && inside < limits.inside {
        broken.push(format!("{:.0} % of first frames inside the bound", 100.0 * inside));
    }
    let worst = counted.iter().filter(|f| f.feasible).map(|f| f.seconds / f.target).fold(0.0, f64::max);
    let figure = None;
    Verdict { scene, method: method.name(), failures: broken, missed, run: longest, quality, worst, figure }
}

#[derive(Clone, Debug)]
pub(crate) struct Noise(u64);

impl Noise {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    /// A uniformly distributed number in (0, 1).
    pub(crate) fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    /// A number with the standard normal distribution.
    pub(crate) fn normal(&mut self) -> f64 {
        libm::sqrt(-2.0 * libm::log(self.uniform())) * libm::cos(std::f64::consts::TAU * self.uniform())
    }
}

/// Plays scenes under methods: on a scripted clock or, if `real` has a renderer and its clock, those that can
/// be played on a real renderer. `soak` is the number of disturbed frames in scene 27.
pub(crate) fn run(
    scenes: &[usize],
    methods: &[ControllerKind],
    soak: u64,
    mut real: Option<(&mut dyn Renderer, Clock)>,
    progress: &indicatif::ProgressBar,
) -> anyhow::Result<Vec<Verdict>> {
    let playable = |n: &usize| real.is_none() || world::REAL_SCENES.contains(n);
    let scenes: Vec<usize> = scenes.iter().copied().filter(playable).collect();
    let mut out = Vec::with_capacity(scenes.len() * methods.len());
    progress.set_length(scenes.len() as u64);
    for number in scenes {
        for &method in methods {
            out.push(match &mut real {
                Some((renderer, clock)) => {
                    let mut machine = world::Machine { renderer: *renderer, clock: Some(*clock) };
                    world::play(number, method, &mut machine)?
                }
                None => match law::play(number, method, soak) {
                    Some(verdict) => verdict,
                    None => {
                        let mut twin = CpuRaycaster::new();
                        let mut machine = world::Machine { renderer: &mut twin, clock: None };
                        world::play(number, method, &mut machine)?
                    }
                },
            });
        }
        progress.inc(1);
    }
    Ok(out)
}

/// Bar on the number of scenes that entire's controller passed; a scene that was not played counts as not
/// passed.
fn passed(name: &str, verdicts: &[Verdict], all: usize) -> Bar {
    let mut ours: Vec<&Verdict> = verdicts.iter().filter(|v| v.is_ours()).collect();
    ours.sort_by_key(|v| v.scene);
    ours.dedup_by_key(|v| v.scene);
    let passed = ours.iter().filter(|v| v.passed()).count();
    Bar::at_least(name, (!ours.is_empty()).then_some(passed as f64), all as f64)
}

/// Bars on the scenes on a scripted clock: entire's controller passes each of them, and at least one other
/// method fails each (else the scene tests nothing). No method passes or fails a scene that was not played.
/// Scenes 29 to 31 also have a bar each, on the figure of entire's controller.
pub(crate) fn bars(verdicts: &[Verdict]) -> Vec<Bar> {
    let harmless = harmless(verdicts);
    let figure = |scene: usize| verdicts.iter().find(|v| v.scene == scene && v.is_ours())?.figure;
    vec![
        passed("stress-scenes-passed", verdicts, SCENES.len()),
        Bar::at_most("stress-scenes-that-no-rival-fails", Some(harmless.len() as f64), 0.0),
        Bar::at_least("stress-bursts-after-which-the-step-is-back", figure(29), law::BACK),
        Bar::at_most("stress-stalls-after-which-steps-are-coarser", figure(30), 0.0),
        Bar::at_most(
            "stress-frames-until-half-the-speed-is-held",
            figure(31),
            law::MAX_FRAMES_UNTIL_HELD as f64,
        ),
    ]
}

/// Bars on the scenes that can be played on a real renderer.
pub(crate) fn bars_on_device(verdicts: &[Verdict]) -> Vec<Bar> {
    vec![passed("stress-scenes-passed-on-device", verdicts, world::REAL_SCENES.len())]
}

/// Returns the scenes that no method other than entire's fails.
pub(crate) fn harmless(verdicts: &[Verdict]) -> Vec<usize> {
    let fails = |scene: usize| verdicts.iter().any(|v| v.scene == scene && !v.is_ours() && !v.passed());
    scenes().map(|s| s.0).filter(|n| !fails(*n)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ours_passes_every_scene() {
        let all: Vec<usize> = scenes().map(|s| s.0).collect();
        assert_eq!(all, (1..=31).collect::<Vec<_>>());
        let bar = indicatif::ProgressBar::hidden();
        let verdicts = run(&all, &[ControllerKind::Hybrid], 50_000, None, &bar).unwrap();
        let failed: Vec<&Verdict> = verdicts.iter().filter(|v| !v.passed()).collect();
        assert!(failed.is_empty(), "{failed:#?}");
        // The verdicts are the same in every run.
        let again = run(&[1, 17, 24, 7], &[ControllerKind::Hybrid], 10, None, &bar).unwrap();
        for v in again {
            assert_eq!(Some(&v), verdicts.iter().find(|w| w.scene == v.scene));
        }
    }

    #[test]
    fn scenes_play_on_a_real_renderer_too() {
        let mut twin = CpuRaycaster::new();
        let mut play = |scenes: &[usize], clock| {
            let bar = indicatif::ProgressBar::hidden();
            run(scenes, &[ControllerKind::Hybrid], 0, Some((&mut twin, clock)), &bar)
        };
        // Real times of a shared machine may pass or fail; every number must be finite.
        let verdicts = play(&[1, 7], Clock::Wall).unwrap();
        assert_eq!(verdicts.len(), 1);
        let v = &verdicts[0];
        assert!(v.scene == 7 && v.quality > 0.0 && v.worst.is_finite());
        assert!(!v.failures.iter().any(|f| f.contains("expected") || f.contains("step")), "{v:?}");
        let error = play(&[7], Clock::Device).unwrap_err();
        assert!(format!("{error:#}").contains("no device clock"), "{error:#}");
    }

    #[test]
    fn every_scene_fails_for_a_rival() {
        use ControllerKind::{Algorithm1, Filament, Olp, Pid, VtkFixedPoint, VtkGpu, VtkJs};
        let progress = indicatif::ProgressBar::hidden();
        let rivals: [(ControllerKind, &[usize]); 7] = [
            (Olp, &[1, 3, 4, 6, 9, 10, 12, 13, 21, 28, 29, 30]),
            (Pid, &[16, 19]),
            (Filament, &[5, 7, 8, 14, 22]),
            (VtkGpu, &[11, 20]),
            (Algorithm1, &[2, 15, 17, 18, 23, 25, 27, 31]),
            (VtkFixedPoint, &[24]),
            (VtkJs, &[26]),
        ];
        let verdicts: Vec<Verdict> = rivals
            .iter()
            .flat_map(|(rival, scenes)| run(scenes, &[*rival], 1000, None, &progress).unwrap())
            .collect();
        assert_eq!(harmless(&verdicts), [0; 0], "{verdicts:#?}");
        let lines: Vec<String> = bars(&verdicts).iter().map(ToString::to_string).collect();
        // The figures of rivals are no values of the bars.
        assert_eq!(
            lines,
            [
                "bar stress-scenes-passed - 31.0000 short",
                "bar stress-scenes-that-no-rival-fails 0.0000 0.0000 ok",
                "bar stress-bursts-after-which-the-step-is-back - 0.9000 short",
                "bar stress-stalls-after-which-steps-are-coarser - 0.0000 short",
                "bar stress-frames-until-half-the-speed-is-held - 3.0000 short"
            ]
        );
    }

    #[test]
    fn bars_are_about_all_scenes_whatever_was_played() {
        let verdict = |scene: usize, method: ControllerKind, broken: &[&str]| Verdict {
            scene,
            method: method.name(),
            failures: broken.iter().map(ToString::to_string).collect(),
            missed: 0.0,
            run: 0,
            quality: 1.0,
            worst: 1.0,
            figure: [(29, 1.0), (30, 0.0), (31, 3.0)].iter().find(|(n, _)| *n == scene).map(|f| f.1),
        };
        let lines = |found: &[Bar]| -> Vec<String> { found.iter().map(ToString::to_string).collect() };
        let ours = |n: usize| verdict(n, ControllerKind::Hybrid, &[]);
        // One scene, named twice, and a rival that passes it.
        let part = [ours(1), ours(1), verdict(1, ControllerKind::Olp, &[])];
        assert_eq!(
            lines(&bars(&part))[..3],
            [
                "bar stress-scenes-passed 1.0000 31.0000 short",
                "bar stress-scenes-that-no-rival-fails 31.0000 0.0000 short",
                "bar stress-bursts-after-which-the-step-is-back - 0.9000 short"
            ]
        );
        assert_eq!(
            lines(&bars_on_device(&part)),
            ["bar stress-scenes-passed-on-device 1.0000 12.0000 short"]
        );
        let mut whole: Vec<Verdict> =
            (1..=31).flat_map(|n| [ours(n), verdict(n, ControllerKind::Pid, &["late"])]).collect();
        assert!(bars(&whole).iter().all(|b| b.ok));
        whole[0].failures = vec!["late".into()];
        for (scene, figure) in [(29, 0.8), (30, 1.0), (31, 4.0)] {
            let ours = whole.iter_mut().find(|v| v.scene == scene && v.is_ours()).unwrap();
            ours.figure = Some(figure);
        }
        assert_eq!(
            lines(&bars(&whole)),
            [
                "bar stress-scenes-passed 30.0000 31.0000 short",
                "bar stress-scenes-that-no-rival-fails 0.0000 0.0000 ok",
                "bar stress-bursts-after-which-the-step-is-back 0.8000 0.9000 short",
                "bar stress-stalls-after-which-steps-are-coarser 1.0000 0.0000 short",
                "bar stress-frames-until-half-the-speed-is-held 4.0000 3.0000 short"
            ]
        );
        assert!(bars_on_device(&whole[..24]).iter().all(|b| !b.ok));
    }

    #[test]
    fn the_judge_counts_what_it_says() {
        let good = Seen {
            target: 0.1,
            seconds: 0.1,
            clean: 0.1,
            step: 2.0,
            oracle: 2.0,
            feasible: true,
            upper: 0.11,
            predicted: 0.1,
            first: false,
            excused: false,
            part: 0,
        };
        let mut frames = vec![good; 20];
        frames[3].seconds = 0.12;
        frames[4].seconds = 0.12;
        frames[4].first = true;
        frames[9] = Seen { seconds: 9.0, excused: true, ..good };
        frames[12] = Seen { seconds: 9.0, feasible: false, ..good };
        let v = judge(1, ControllerKind::Olp, &frames, Limits::missed(0.2), Vec::new());
        assert!(v.passed() && v.run == 2 && (v.missed - 2.0 / 18.0).abs() < 1e-12 && v.worst < 1.3, "{v:?}");
        let strict = Limits { missed: 0.05, run: 1, quality: 1.1, inside: 0.5 };
        assert_eq!(judge(1, ControllerKind::Olp, &frames, strict, Vec::new()).failures.len(), 4);
        frames[0].step = f64::NAN;
        let v = judge(1, ControllerKind::Olp, &frames, Limits::missed(1.0), Vec::new());
        assert!(v.failures[0].contains("step NaN at frame 0"));
    }
}
