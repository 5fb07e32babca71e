//! Ray step and image size as one quantity that a controller can choose.

use super::StepLimits;
use crate::features::Setting;

/// Each image sample distance is this factor times the one before.
const RATIO: f64 = 1.2;

/// How much further the step alone is coarsened where the image is whole.
const WHOLE: f64 = 1.15;

/// The step over the finest one, for each unit of distance, that goes with a coarser image.
const TOGETHER: f64 = 1.1;

/// Range of that quotient within which a distance is kept.
const KEEP: (f64, f64) = (0.75, 1.6);

/// A path from the finest step at full image size to the coarsest step at the largest image sample distance.
///
/// The controller chooses c = step · distance², where neighboring rays stand `distance` pixels apart: the
/// time of a frame goes about as 1/c. Along the path both grow together, which at equal cost shows fewer
/// differences from full quality than coarsening one of them alone; where any smaller image is blurred by
/// much, the step alone is coarsened first. Distances are powers of [`RATIO`], so that buffers seldom change,
/// and one is kept while the step that goes with it is not far off. Where a distance changes, so does the
/// step, and c is met; unless the limits of the step are closer together than two distances are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Coarsening {
    steps: StepLimits,
    /// How many distances over 1 there are.
    levels: i32,
    /// The first of them, in powers of [`RATIO`].
    first: i32,
    /// Up to which c over the finest step the step alone is coarsened.
    alone: f64,
    /// The level of the frame before; 0 at distance 1.
    last: i32,
}

impl Coarsening {
    /// The step alone.
    pub(super) fn of_step(steps: StepLimits) -> Self {
        Self { steps, levels: 0, first: 1, alone: 1.0, last: 0 }
    }

    #[cfg(test)]
    pub(super) fn steps(&self) -> StepLimits {
        self.steps
    }

    pub(super) fn set_steps(&mut self, steps: StepLimits) {
        self.steps = steps;
    }

    /// Sets the largest image sample distance, and how many times the finest step comes before any distance
    /// over 1; numbers of at least 1.
    pub(super) fn set_max_distance(&mut self, distance: f32, step_alone: f32) {
        let powers = |v: f32| libm::floor(libm::log(f64::from(v)) / libm::log(RATIO) + 1.0e-6) as i32;
        self.alone = f64::from(step_alone);
        self.first = (powers(step_alone) / 2).max(1);
        self.levels = (powers(distance) - self.first + 1).max(0);
    }

    fn distance_of(&self, level: i32) -> f64 {
        if level == 0 { 1.0 } else { libm::pow(RATIO, f64::from(level - 1 + self.first)) }
    }

    /// The values of c that may be chosen.
    pub(super) fn limits(&self) -> StepLimits {
        let distance = self.distance_of(self.levels);
        let coarsest = f64::from(self.steps.coarsest) * distance * distance;
        StepLimits { coarsest: coarsest as f32, ..self.steps }
    }

    /// Step, level and image sample distance at c.
    fn at(&self, c: f32) -> (f32, i32, f64) {
        if self.levels == 0 {
            return (c, 0, 1.0);
        }
        let c = f64::from(c);
        let (finest, coarsest) = (f64::from(self.steps.finest), f64::from(self.steps.coarsest));
        let alone = c / finest;
        let together = libm::log((alone / TOGETHER).max(1.0e-30)) / (3.0 * libm::log(RATIO));
        let mut level = libm::round(together) as i32 + 1 - self.first;
        level = if alone <= self.alone { 0 } else { level.clamp(i32::from(self.alone > 1.0), self.levels) };
        let last = self.last.clamp(0, self.levels);
        let distance = self.distance_of(last);
        let quotient = alone / (distance * distance * distance);
        // Where the step alone comes first, the path has bounds of its own there.
        let low = if last == 1 && self.alone > 1.0 {
            self.alone / (distance * distance * distance)
        } else {
            KEEP.0
        };
        let high = if last == 0 { KEEP.1.max(WHOLE * self.alone) } else { KEEP.1 };
        let kept = (last == 0 || quotient >= low) && (last == self.levels || quotient <= high);
        if kept {
            level = last;
        }
        let step = |level: i32| c / (self.distance_of(level) * self.distance_of(level));
        while level < self.levels && step(level) > coarsest * 1.000_001 {
            level += 1;
        }
        while level > 0 && step(level) < finest && step(level - 1) <= coarsest {
            level -= 1;
        }
        (step(level).clamp(finest, coarsest.max(finest)) as f32, level, self.distance_of(level))
    }

    /// What is drawn at c of an image whose full size is that of `full`.
    pub(super) fn setting(&self, full: Setting, c: f32) -> Setting {
        let (step, level, distance) = self.at(c);
        if level == 0 {
            return Setting { step, ..full };
        }
        let shrunk = |side: u32| ((f64::from(side) / distance) as u32).max(1);
        Setting { step, width: shrunk(full.width), height: shrunk(full.height), ..full }
    }

    /// Step and image sample distance of a frame that is drawn at c.
    pub(super) fn take(&mut self, c: f32) -> (f32, f32) {
        let (step, level, distance) = self.at(c);
        self.last = level;
        (step, distance as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Shading, Skipping};
    use proptest::prelude::*;

    fn path(finest: f32, coarsest: f32, distance: f32, step_alone: f32) -> Coarsening {
        let mut path = Coarsening::of_step(StepLimits { finest, coarsest });
        path.set_max_distance(distance, step_alone);
        path
    }

    #[test]
    fn without_smaller_images_it_is_the_step() {
        let mut path = path(1.0, 8.0, 1.19, 1.0);
        assert_eq!(path.limits(), path.steps());
        for c in [1.0f32, 1.7, 8.0, 100.0] {
            assert_eq!(path.take(c), (c, 1.0));
        }
    }

    #[test]
    fn its_ends_are_full_quality_and_the_coarsest_of_both() {
        let mut path = path(0.5, 8.0, 4.0, 1.0);
        assert_eq!(path.take(path.limits().finest), (0.5, 1.0));
        let (step, distance) = path.take(path.limits().coarsest);
        assert!((step - 8.0).abs() < 1e-4 && distance > 3.5 && distance <= 4.0, "{step} {distance}");
    }

    #[test]
    fn an_image_size_is_kept_when_the_step_wavers() {
        let mut path = path(1.0, 8.0, 4.0, 1.0);
        let mut changes = 0;
        let mut before = path.take(4.4).1;
        for i in 0..200 {
            let distance = path.take(if i % 2 == 0 { 4.1 } else { 4.9 }).1;
            changes += usize::from(distance != before);
            before = distance;
        }
        assert!(changes <= 1, "{changes}");
    }

    #[test]
    fn the_step_alone_comes_first_where_it_is_to() {
        let mut path = path(1.0, 8.0, 4.0, 2.1);
        for i in 0..50 {
            let c = 1.0 + 0.2 * i as f32;
            let (step, distance) = path.take(c);
            assert_eq!(distance == 1.0, c < 2.41, "{c}: {step} {distance}");
            assert!(distance == 1.0 || distance > 1.43, "{c}: {step} {distance}");
        }
        path.take(3.0);
        assert!(path.take(2.2).1 > 1.43);
        assert_eq!(path.take(2.0), (2.0, 1.0));
    }

    proptest! {
        #[test]
        fn c_is_met_within_the_limits_and_work_never_rises(
            finest in 0.1f32..2.0, coarsening in 1.0f32..20.0, distance in 1.0f32..8.0, alone in 1.0f32..4.0, from in 0.0f32..1.0) {
            let mut path = path(finest, finest * coarsening, distance, alone);
            let limits = path.limits();
            let c_at = |u: f32| limits.clamp(limits.finest * (limits.coarsest / limits.finest).powf(u));
            path.take(c_at(from));
            let full = Setting { step: 1.0, width: 4096, height: 4096, shading: Shading::None, skipping: Skipping::None };
            let mut before = (f64::INFINITY, f64::INFINITY);
            for i in 0..=60 {
                let c = c_at(i as f32 / 60.0);
                let (step, _, by) = path.at(c);
                prop_assert!(step >= finest && step <= path.steps().coarsest);
                prop_assert!(by <= f64::from(distance) * 1.0001);
                let off = f64::from(step) * by * by / f64::from(c) - 1.0;
                prop_assert!(off.abs() < if coarsening > 2.0 * alone { 1e-5 } else { 7.0 }, "{off}");
                let s = path.setting(full, c);
                let pixels = f64::from(s.width) * f64::from(s.height);
                // Rays alone, and samples alone; an image of whole pixels is a little smaller than it should
                // be.
                let work = (pixels, pixels / f64::from(s.step));
                prop_assert!(work.0 <= before.0 && work.1 <= before.1 * 1.005, "{work:?} {before:?}");
                before = work;
            }
        }
    }
}
