//! Reactive rules of other renderers, with their published constants.
//!
//! VTK's rule for GPU ray casting acts on the distance of samples along rays: its decision's step is the ray
//! step. The other rules scale the image resolution, by a fraction f of each side or an image sample distance
//! d: their decision's step is s = 1 / f² = d², for an image with 1 / s of the pixels at an unchanged ray
//! step. [`ActsOn`](crate::steering::play::ActsOn) states the quantity and the range of s. `entire steer`
//! draws such images; `entire-lab replay` uses their recorded times and pictures. Only the ray step can be
//! set in the window (`entire explore`), on stress scenes, and on traces without smaller images. There, s is
//! taken as the ray step, which assumes work ∝ 1 / step; the tables say so.

use super::algorithm1::reactive;
use entire_steer::control::{Controller, Decision, Observed, PlanRequest, StepLimits, Verdict};

/// A rule whose steps depend on earlier frames alone.
pub(crate) trait Rule: Sized {
    /// The rule's name.
    const NAME: &'static str;
    /// The rule before the first frame.
    const START: Self;

    /// Returns the step of the next frame, within `limits`. `target` is the frame's target time in seconds.
    fn step(&mut self, target: f32, limits: StepLimits) -> f32;

    /// Updates the rule by a frame's time.
    fn learn(&mut self, observed: &Observed) -> Verdict;

    /// Forgets all frames.
    fn reset(&mut self) {
        *self = Self::START;
    }
}

/// A rule as a controller.
pub(crate) struct Reactive<R>(pub(crate) R);

impl<R: Rule> Controller for Reactive<R> {
    fn name(&self) -> &'static str {
        R::NAME
    }

    fn plan(&mut self, request: &mut PlanRequest<'_>) -> Decision {
        reactive(self.0.step(request.target, request.limits))
    }

    fn observe(&mut self, observed: &Observed) -> Verdict {
        self.0.learn(observed)
    }

    fn reset(&mut self) {
        self.0.reset();
    }
}

/// The reduction rule of VTK's GPU volume mapper: the mean of the old factor and the ratio of allocated to
/// full-quality time, rounded down to 1, 0.5, 0.2 or 0.1. The ray step is the inverse of the factor, as in
/// VTK. The first frame is drawn at full quality.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct VtkGpu {
    factor: f32,
    /// Seconds of the last frame; 0 before the first frame.
    last: f32,
}

impl Rule for VtkGpu {
    const NAME: &'static str = "vtk-gpu";
    const START: Self = Self { factor: 1.0, last: 0.0 };

    fn step(&mut self, target: f32, limits: StepLimits) -> f32 {
        if self.last > 0.0 {
            let full = self.last / self.factor;
            let wanted = 0.5 * (target / full + self.factor);
            self.factor = [1.0, 0.5, 0.2].into_iter().find(|factor| wanted >= *factor).unwrap_or(0.1);
        }
        let step = limits.clamp(1.0 / self.factor);
        self.factor = 1.0 / step;
        step
    }

    fn learn(&mut self, observed: &Observed) -> Verdict {
        self.last = observed.seconds;
        Verdict::Learned
    }
}

/// The rule of VTK's fixed-point CPU mapper: image sample distance √(full time / allocated time), limited to
/// 1…10. The full time is the last frame's time multiplied by its squared image sample distance; the
/// allocated time is the target. The first frame is drawn at half the largest distance. s is the squared
/// distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct VtkFixedPoint {
    /// Image sample distance; half of the largest one before the first frame.
    distance: f32,
    last: f32,
}

impl Rule for VtkFixedPoint {
    const NAME: &'static str = "vtk-fixed-point";
    const START: Self = Self { distance: 5.0, last: 0.0 };

    fn step(&mut self, target: f32, limits: StepLimits) -> f32 {
        if self.last > 0.0 {
            let full = self.last * self.distance * self.distance;
            self.distance = libm::sqrtf(full / target).clamp(1.0, 10.0);
        }
        let step = limits.clamp(self.distance * self.distance);
        self.distance = libm::sqrtf(step).max(1.0);
        step
    }

    fn learn(&mut self, observed: &Observed) -> Verdict {
        self.last = observed.seconds;
        Verdict::Learned
    }
}

/// The rule of vtk.js: after each window of at least one second, the scale is multiplied by the ratio of
/// desired to measured frame rate if this ratio is below 0.85 or above 1.15, and limited to 1.5…400. If the
/// scale exceeds 1.5, s is the scale: the image's sides are divided by its square root. Else s is 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct VtkJs {
    scale: f32,
    elapsed: f32,
    frames: f32,
}

impl Rule for VtkJs {
    const NAME: &'static str = "vtk-js";
    const START: Self = Self { scale: 1.0, elapsed: 0.0, frames: 0.0 };

    fn step(&mut self, target: f32, limits: StepLimits) -> f32 {
        if self.elapsed >= 1.0 {
            let ratio = self.elapsed / self.frames / target;
            if !(0.85..=1.15).contains(&ratio) {
                self.scale *= ratio;
            }
            self.scale = self.scale.clamp(1.5, 400.0);
            self.elapsed = 0.0;
            self.frames = 0.0;
        }
        self.scale = limits.clamp(self.scale).max(1.0);
        limits.clamp(if self.scale > 1.5 { self.scale } else { 1.0 })
    }

    fn learn(&mut self, observed: &Observed) -> Verdict {
        // Browsers show a frame at the next refresh of the display, at most 60 times per second.
        self.elapsed += observed.seconds.clamp(1.0 / 60.0, 1.0e4);
        self.frames += 1.0;
        Verdict::Learned
    }
}

/// Maximum number of past frame times that [`Unreal`] uses.
const WINDOW: usize = 16;

/// The dynamic-resolution heuristic of Unreal Engine. Let f be the present fraction of each image side; s is
/// 1 / f². Each past frame suggests its own fraction times √(0.9 target / its time). The new fraction is the
/// mean of these suggestions, with weight 0.9ⁿ for a frame that is n frames old, and at most 1. Only 0.9 of
/// an increase is applied. The fraction changes by at least 2 % and at most once in 8 frames. (In version 4
/// of the engine, the threshold of 2 % is for increases only.) If the last two frames, or the only frame of
/// the history, took longer than the target, the rule takes the mean of these frames' suggestions at once,
/// without a threshold, and drops the history. The caller's limits keep f in 0.5…1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Unreal {
    side: f32,
    /// Seconds of past frames, converted to full resolution, newest last.
    times: [f32; WINDOW],
    len: usize,
    since_change: u32,
    over: usize,
    frames: u32,
}

impl Unreal {
    /// Returns the weighted mean of the fractions that the newest `count` frames suggest.
    fn suggested(&self, target: f32, count: usize) -> f32 {
        let (mut sum, mut weights, mut weight) = (0.0f32, 0.0f32, 1.0f32);
        for &time in self.times[..self.len].iter().rev().take(count) {
            sum += weight * libm::sqrtf(0.9 * target / time);
            weights += weight;
            weight *= 0.9;
        }
        sum / weights
    }
}

impl Rule for Unreal {
    const NAME: &'static str = "unreal";
    const START: Self = Self { side: 1.0, times: [0.0; WINDOW], len: 0, since_change: 0, over: 0, frames: 0 };

    fn step(&mut self, target: f32, limits: StepLimits) -> f32 {
        let newest = self.len.min(2);
        let panic = newest > 0 && self.over >= newest;
        if panic || (newest > 0 && self.since_change >= 8) {
            let mut wanted = self.suggested(target, if panic { newest } else { self.len });
            if !panic {
                if libm::fabsf(wanted - self.side) < 0.02 * self.side {
                    wanted = self.side;
                } else if wanted > self.side {
                    wanted = self.side + 0.9 * (wanted - self.side);
                }
            }
            let wanted = wanted.max(1.0 / libm::sqrtf(limits.coarsest)).min(1.0);
            if panic || wanted != self.side {
                self.since_change = 0;
            }
            self.side = wanted;
            if panic {
                self.len = 0;
                self.over = 0;
            }
        }
        let wanted = 1.0 / (self.side * self.side);
        let step = limits.clamp(wanted);
        if step != wanted {
            self.side = (1.0 / libm::sqrtf(step)).min(1.0);
        }
        step
    }

    fn learn(&mut self, observed: &Observed) -> Verdict {
        self.frames = self.frames.saturating_add(1);
        if self.frames == 1 {
            return Verdict::Ignored;
        }
        if self.len == WINDOW {
            self.times.copy_within(1.., 0);
            self.len -= 1;
        }
        self.times[self.len] = observed.seconds * observed.step.max(1.0);
        self.len += 1;
        self.since_change = self.since_change.saturating_add(1);
        self.over = if observed.seconds > observed.target { self.over.saturating_add(1) } else { 0 };
        Verdict::Learned
    }
}

/// The frame-rate controller of Filament: the median of up to 15 frame times is the input of a PI controller
/// in velocity form on the ratio of measured to target time (Kp = 1 − e^(−1/8), Ki = 0.002). Output changes
/// of −1 %…+5 % are ignored. The sum of errors is limited to ±100, and does not change while the output is
/// clamped. The controlled quantity is the share of work, and s is its inverse; the caller's limits keep the
/// scale of each side in 0.5…1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Filament {
    work: f32,
    times: [f32; 15],
    len: usize,
    /// Ki times the sum of errors.
    integral: f32,
    clamped: bool,
}

impl Rule for Filament {
    const NAME: &'static str = "filament";
    const START: Self = Self { work: 1.0, times: [0.0; 15], len: 0, integral: 0.0, clamped: false };

    fn step(&mut self, target: f32, limits: StepLimits) -> f32 {
        if self.len >= 3 {
            let mut sorted = self.times;
            let sorted = &mut sorted[..self.len];
            sorted.sort_unstable_by(f32::total_cmp);
            let time = sorted[self.len / 2];
            let error = (1.0 - time / target).clamp(-10.0, 1.0);
            if !self.clamped {
                self.integral = (self.integral + 0.002 * error).clamp(-0.2, 0.2);
            }
            let out = (1.0 - 0.882_496_9) * error + self.integral;
            if !(-0.01..=0.05).contains(&out) {
                let command = if out < 0.0 { 1.0 / (1.0 - out) } else { 1.0 + out };
                self.work = (self.work * command).clamp(1.0e-4, 1.0);
            }
        }
        let wanted = 1.0 / self.work;
        let step = limits.clamp(wanted);
        self.clamped = step != wanted || self.work >= 1.0;
        self.work = (1.0 / step).min(1.0);
        step
    }

    fn learn(&mut self, observed: &Observed) -> Verdict {
        if self.len == self.times.len() {
            self.times.copy_within(1.., 0);
            self.len -= 1;
        }
        self.times[self.len] = observed.seconds;
        self.len += 1;
        Verdict::Learned
    }
}
