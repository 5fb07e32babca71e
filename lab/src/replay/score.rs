//! Scores of controllers against their targets, beside the oracle.

use super::Replayed;
use serde::Serialize;

/// Three scores: misses, distance from the target, quality.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Three {
    /// Share of the feasible frames ([`Replayed::feasible`]) that took longer than 1.1 times the target.
    pub missed: f64,
    /// Mean |t − target| / target over the reachable frames ([`Replayed::reachable`]).
    pub deviation: f64,
    /// Mean over all frames of the oracle's step divided by the chosen step, at most 1. For rules that change
    /// the image resolution: mean of the least reduction that meets the target, divided by the chosen
    /// reduction.
    pub quality: f64,
}

/// Sums over frames, from which scores are computed; sums of several replays can be added.
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
        self.quality += (f.finest_step / f.step).min(1.0);
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
    /// Number of frames played.
    pub frames: usize,
    /// Scores over all frames.
    pub all: Three,
    /// Scores over calm frames.
    pub calm: Three,
    /// Share of calm frames whose step differs from the step of the frame before by over 20 %.
    pub jumps: f64,
    /// Number of abrupt changes.
    pub switches: usize,
    /// Share of abrupt changes whose first frame took no more than its upper bound; NaN without abrupt
    /// changes, and for controllers without upper bounds.
    pub inside_bound: f64,
    /// Mean |t − target| / target over the reachable first frames ([`Replayed::reachable`]) after abrupt
    /// changes.
    pub first_frame_deviation: f64,
    /// Mean structural similarity to the reference pictures, divided by the oracle's.
    pub ssim_ratio: f64,
    /// Mean PSNR of the oracle's pictures minus that of the controller's, decibels.
    pub psnr_loss: f64,
    /// Largest number of consecutive feasible frames that took longer than 1.1 times the target.
    pub longest: usize,
    /// Largest frame time divided by the target, among feasible frames.
    pub worst: f64,
}

impl Tally {
    /// Sums over one replay.
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

    /// Adds the sums of another replay.
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

#[cfg(test)]
mod tests {
    use super::*;
    use entire_steer::control::Reason;

    fn frame(seconds: f64, step: f64) -> Replayed {
        Replayed {
            target: 0.1,
            seconds,
            predicted: 0.1,
            upper: 0.12,
            step,
            finest_step: 2.0,
            oracle_step: 2.0,
            oracle_seconds: 1.0,
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
