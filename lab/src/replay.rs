//! Replaying traces: controllers against recorded cost curves, scored beside an oracle that knows them.

use crate::trace::{Curve, Trace};
use anyhow::{Context, Result, ensure};
use entire_cli::path::FlightPath;
use entire_cli::steering::play::Contender;
use entire_core::adapt::ObserveFlags;
use entire_core::control::{Reason, StepLimits};
use entire_core::features::{Changes, VolumeSummary};
use serde::Serialize;

/// Frames from a change of anything but the camera on that are not calm, and frames at the start of a path.
pub const SETTLING: usize = 3;

/// A trace that is ready to be replayed.
pub struct Replayable {
    /// As it was recorded.
    pub trace: Trace,
    /// Its path, frame by frame.
    pub path: FlightPath,
    /// Per frame.
    pub curves: Vec<Curve>,
    /// Per volume.
    pub summaries: Vec<VolumeSummary>,
    /// Frames at which something changes abruptly: a switch of the path, another volume, another image size.
    pub switches: Vec<bool>,
}

impl Replayable {
    /// Opens the volumes of a trace and works out its curves.
    ///
    /// # Errors
    /// When a volume is not there or the path is wrong.
    pub fn new(trace: Trace) -> Result<Self> {
        let path = trace.path.resolve()?;
        let curves = trace.frames.iter().map(|f| Curve::of(f)).collect();
        let summaries = trace.summaries().with_context(|| format!("trace {}", trace.name))?;
        let switches = (0..path.frames.len())
            .map(|i| {
                i > 0
                    && (path.frames[i].switched()
                        || (trace.hold >= 4 && trace.volume_at(i) != trace.volume_at(i - 1))
                        || trace.scales.iter().any(|(from, _)| *from as usize == i))
            })
            .collect();
        Ok(Self { trace, path, curves, summaries, switches })
    }
}

/// One frame of a replay.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Replayed {
    /// Seconds that it should not have exceeded.
    pub target: f64,
    /// Seconds that it took.
    pub seconds: f64,
    /// Seconds that the controller expected; NaN where it expected nothing.
    pub predicted: f64,
    /// Its upper bound; NaN where there was none.
    pub upper: f64,
    /// The step that was chosen.
    pub step: f64,
    /// The oracle's step.
    pub oracle_step: f64,
    /// Likeness to the reference picture, decibels.
    pub psnr: f64,
    /// The oracle's.
    pub oracle_psnr: f64,
    /// Structural similarity to the reference picture.
    pub ssim: f64,
    /// The oracle's.
    pub oracle_ssim: f64,
    /// Whether the coarsest step meets the target.
    pub feasible: bool,
    /// Whether some allowed step takes exactly the target.
    pub reachable: bool,
    /// Whether something, or the target, changed abruptly here.
    pub switched: bool,
    /// Whether nothing but the camera has changed in this frame and the [`SETTLING`] before, nor the path begun.
    pub calm: bool,
    /// Why the step.
    #[serde(serialize_with = "reason_name")]
    pub reason: Reason,
}

fn reason_name<S: serde::Serializer>(reason: &Reason, s: S) -> std::result::Result<S::Ok, S::Error> {
    s.serialize_str(reason.name())
}

/// A number that depends on two others and on nothing else.
fn mix(a: u64, b: u64) -> u64 {
    let mut h = a.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ b.wrapping_mul(0xd1b5_4a32_d192_ed03);
    h ^= h >> 29;
    h = h.wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h ^ (h >> 32)
}

/// Plays a trace against `targets` (one per frame). The noise of a frame is the same for every controller; `seed` picks
/// which of the measured ones.
///
/// # Errors
/// When a prediction fails; names the frame.
pub fn replay(
    recorded: &Replayable,
    contender: &mut Contender,
    volume_features: Option<&[f32]>,
    targets: &[f64],
    limits: StepLimits,
    seed: u64,
) -> Result<Vec<Replayed>> {
    let n = recorded.path.frames.len();
    ensure!(targets.len() == n, "{} targets for {n} frames", targets.len());
    let draw = recorded.trace.draw_settings()?;
    let session = &mut contender.session;
    session.set_limits(limits);
    let (finest, coarsest) = (f64::from(limits.finest()), f64::from(limits.coarsest()));
    let mut out: Vec<Replayed> = Vec::with_capacity(n);
    let mut shown = usize::MAX;
    let mut since_switch = 0;
    for (index, at) in recorded.path.frames.iter().enumerate() {
        let place = || format!("frame {index} of trace {}", recorded.trace.name);
        let volume = recorded.trace.volume_at(index);
        let swapped = volume != shown;
        if swapped {
            session.set_volume(recorded.summaries[volume].clone(), volume_features);
            shown = volume;
        }
        if at.transfer_changed || swapped {
            let table = at.transfer.function().to_table().with_context(place)?;
            session.set_transfer(&table, at.transfer.lobes().as_deref()).with_context(place)?;
        }
        if at.camera_switched {
            session.mark(Changes { camera: true, ..Changes::NONE });
        }
        let frame = recorded.trace.frame(&recorded.path, &draw, index).with_context(place)?;
        let target = targets[index];
        let plan = session.plan(&frame, target as f32).with_context(place)?;
        let curve = &recorded.curves[index];
        let step = f64::from(plan.step);
        let seconds = curve.seconds(step) * curve.noise(mix(seed, index as u64)).exp();
        session.observe(plan.id, seconds as f32, ObserveFlags::default())?;
        let oracle_step = curve.oracle(target, finest, coarsest);
        let retargeted = index > 0 && (targets[index - 1] / target).ln().abs() > 0.05;
        let switched = recorded.switches[index] || retargeted;
        let announced = at.transfer_changed || swapped;
        since_switch = if switched || announced || index == 0 { 0 } else { since_switch + 1 };
        out.push(Replayed {
            target,
            seconds,
            predicted: f64::from(plan.seconds),
            upper: f64::from(plan.upper),
            step,
            oracle_step,
            psnr: curve.psnr(step),
            oracle_psnr: curve.psnr(oracle_step),
            ssim: curve.ssim(step),
            oracle_ssim: curve.ssim(oracle_step),
            feasible: curve.seconds(coarsest) <= target,
            reachable: curve.reaches(target, finest, coarsest),
            switched,
            calm: since_switch >= SETTLING,
            reason: plan.reason,
        });
    }
    Ok(out)
}

/// Three figures: how often, how far, how well.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Three {
    /// Share of the feasible frames that took over 1.1 targets.
    pub missed: f64,
    /// Mean |t − target| / target over the reachable frames.
    pub deviation: f64,
    /// Mean over all frames of the oracle's step over the step, at most 1.
    pub quality: f64,
}

/// Sums over frames, from which scores come; sums of several replays add up.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tally {
    all: Sums,
    calm: Sums,
    calm_steps: f64,
    jumps: f64,
    switches: f64,
    inside: f64,
    ssim: f64,
    oracle_ssim: f64,
    psnr: f64,
    oracle_psnr: f64,
    reachable_switch: f64,
    switch_error: f64,
    longest: usize,
    worst: f64,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Sums {
    frames: f64,
    feasible: f64,
    missed: f64,
    reachable: f64,
    error: f64,
    quality: f64,
}

impl Sums {
    fn add(&mut self, f: &Replayed) {
        self.frames += 1.0;
        self.quality += (f.oracle_step / f.step).min(1.0);
        if f.feasible {
            self.feasible += 1.0;
            self.missed += f64::from(u8::from(f.seconds > 1.1 * f.target));
        }
        if f.reachable {
            self.reachable += 1.0;
            self.error += (f.seconds / f.target - 1.0).abs();
        }
    }

    fn merge(&mut self, o: &Self) {
        self.frames += o.frames;
        self.feasible += o.feasible;
        self.missed += o.missed;
        self.reachable += o.reachable;
        self.error += o.error;
        self.quality += o.quality;
    }

    fn three(&self) -> Three {
        Three {
            missed: self.missed / self.feasible.max(1.0),
            deviation: self.error / self.reachable.max(1.0),
            quality: self.quality / self.frames.max(1.0),
        }
    }
}

/// A controller's scores. Shares are 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Frames played.
    pub frames: usize,
    /// Over all frames.
    pub all: Three,
    /// Over calm frames.
    pub calm: Three,
    /// Share of calm frames whose step differs from the frame before by over 20 %.
    pub jumps: f64,
    /// Abrupt changes.
    pub switches: usize,
    /// Share of them whose first frame stayed inside its upper bound; NaN from controllers without one.
    pub inside_bound: f64,
    /// Mean |t − target| / target of their first frames, where reachable.
    pub first_frame_deviation: f64,
    /// Mean structural similarity to the reference pictures over the oracle's.
    pub ssim_ratio: f64,
    /// Mean decibels below the oracle's pictures.
    pub psnr_loss: f64,
    /// Longest run of feasible frames over 1.1 targets.
    pub longest: usize,
    /// Largest time over target among feasible frames.
    pub worst: f64,
}

impl Tally {
    /// Of one replay.
    pub fn of(frames: &[Replayed]) -> Self {
        let mut t = Self::default();
        let mut run = 0;
        for (i, f) in frames.iter().enumerate() {
            t.all.add(f);
            if f.calm {
                t.calm.add(f);
                if let Some(before) = i.checked_sub(1).map(|i| &frames[i]) {
                    t.calm_steps += 1.0;
                    let jump = (f.step / before.step).ln().abs() > 1.2f64.ln();
                    t.jumps += f64::from(u8::from(jump));
                }
            }
            if f.switched {
                t.switches += 1.0;
                t.inside += f64::from(u8::from(f.seconds <= f.upper));
                if f.upper.is_nan() {
                    t.inside = f64::NAN;
                }
                if f.reachable {
                    t.reachable_switch += 1.0;
                    t.switch_error += (f.seconds / f.target - 1.0).abs();
                }
            }
            t.ssim += f.ssim;
            t.oracle_ssim += f.oracle_ssim;
            t.psnr += f.psnr;
            t.oracle_psnr += f.oracle_psnr;
            let missed = f.feasible && f.seconds > 1.1 * f.target;
            run = if missed { run + 1 } else { 0 };
            t.longest = t.longest.max(run);
            if f.feasible {
                t.worst = t.worst.max(f.seconds / f.target);
            }
        }
        t
    }

    /// Adds another replay's.
    pub fn merge(&mut self, o: &Self) {
        self.all.merge(&o.all);
        self.calm.merge(&o.calm);
        self.calm_steps += o.calm_steps;
        self.jumps += o.jumps;
        self.switches += o.switches;
        self.inside += o.inside;
        self.ssim += o.ssim;
        self.oracle_ssim += o.oracle_ssim;
        self.psnr += o.psnr;
        self.oracle_psnr += o.oracle_psnr;
        self.reachable_switch += o.reachable_switch;
        self.switch_error += o.switch_error;
        self.longest = self.longest.max(o.longest);
        self.worst = self.worst.max(o.worst);
    }

    /// The scores.
    pub fn score(&self) -> Score {
        Score {
            frames: self.all.frames as usize,
            all: self.all.three(),
            calm: self.calm.three(),
            jumps: self.jumps / self.calm_steps.max(1.0),
            switches: self.switches as usize,
            inside_bound: if self.switches > 0.0 { self.inside / self.switches } else { f64::NAN },
            first_frame_deviation: self.switch_error / self.reachable_switch.max(1.0),
            ssim_ratio: self.ssim / self.oracle_ssim.max(1e-9),
            psnr_loss: (self.oracle_psnr - self.psnr) / self.all.frames.max(1.0),
            longest: self.longest,
            worst: self.worst,
        }
    }
}

/// A target that is worth playing on a trace: some allowed step meets it exactly in at least half of the frames.
pub fn worth_playing(recorded: &Replayable, target: f64, limits: StepLimits) -> bool {
    let (finest, coarsest) = (f64::from(limits.finest()), f64::from(limits.coarsest()));
    let reachable = recorded.curves.iter().filter(|c| c.reaches(target, finest, coarsest)).count();
    2 * reachable >= recorded.curves.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(seconds: f64, step: f64) -> Replayed {
        Replayed {
            target: 0.1,
            seconds,
            predicted: 0.1,
            upper: 0.12,
            step,
            oracle_step: 2.0,
            psnr: 40.0,
            oracle_psnr: 42.0,
            ssim: 0.9,
            oracle_ssim: 1.0,
            feasible: true,
            reachable: true,
            switched: false,
            calm: true,
            reason: Reason::Fits,
        }
    }

    #[test]
    fn scores_of_a_scripted_series() {
        let mut frames = vec![frame(0.1, 2.0); 10];
        frames[0].calm = false;
        frames[4] = Replayed { switched: true, calm: false, ..frame(0.13, 4.0) };
        frames[5].step = 1.0;
        frames[6] = Replayed { feasible: false, reachable: false, ..frame(0.5, 2.0) };
        let s = Tally::of(&frames).score();
        assert!((s.all.missed - 1.0 / 9.0).abs() < 1e-12 && s.calm.missed == 0.0);
        assert!((s.all.deviation - 0.3 / 9.0).abs() < 1e-12);
        assert!((s.all.quality - 0.95).abs() < 1e-12);
        // Calm frames whose step jumped: 5 (from 4 to 1) and 6 (from 1 to 2).
        assert!((s.jumps - 2.0 / 8.0).abs() < 1e-12);
        assert_eq!((s.switches, s.inside_bound, s.longest), (1, 0.0, 1));
        assert!((s.worst - 1.3).abs() < 1e-12 && (s.psnr_loss - 2.0).abs() < 1e-12);
        assert!((s.ssim_ratio - 0.9).abs() < 1e-12);
        let mut twice = Tally::of(&frames);
        twice.merge(&Tally::of(&frames));
        let t = twice.score();
        assert_eq!((t.frames, t.all, t.jumps), (20, s.all, s.jumps));
    }
}
