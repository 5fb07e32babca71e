//! Ray step and image size as one quantity that a controller can choose.

use super::StepLimits;
use crate::features::Setting;

/// Each smaller image is smaller than the one before by this factor along each side.
const RATIO: f64 = 1.2;

/// How much further the step alone is coarsened where the image is whole already.
const WHOLE: f64 = 1.15;

/// The step over the finest one, for each pixel, that goes with a smaller image.
const TOGETHER: f64 = 1.1;

/// Range of that quotient within which the size of a smaller image is kept.
const KEEP: (f64, f64) = (0.75, 1.6);

/// A path from the finest step at full image size to the coarsest step at the smallest image.
///
/// The controller chooses c = step · pixel², where the image is smaller by `pixel` along each side: the time of a frame goes
/// about as 1/c. Along the path both grow together, which at equal cost shows fewer differences from full quality than
/// coarsening one of them alone; where any smaller image is blurred by much, the step alone is coarsened first. Images come in
/// sizes [`RATIO`] apart, so that buffers seldom change, and a size is kept while the step that goes with it is not far off.
/// Where a size changes, so does the step, and c is met; unless the limits of the step are closer together than two sizes are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Coarsening {
    steps: StepLimits,
    /// How many smaller images there are.
    sizes: i32,
    /// The first of them, in powers of [`RATIO`].
    first: i32,
    /// Up to which c over the finest step the step alone is coarsened.
    alone: f64,
    /// The image size of the frame before.
    last: i32,
}

impl Coarsening {
    /// The step alone.
    pub(super) fn of_step(steps: StepLimits) -> Self {
        Self { steps, sizes: 0, first: 1, alone: 1.0, last: 0 }
    }

    pub(super) fn steps(&self) -> StepLimits {
        self.steps
    }

    pub(super) fn set_steps(&mut self, steps: StepLimits) {
        self.steps = steps;
    }

    /// Sets how much smaller an image may be along each side, and how many times the finest step comes before any smaller image;
    /// numbers of at least 1.
    pub(super) fn set_coarsest_pixel(&mut self, pixel: f32, step_alone: f32) {
        let powers = |v: f32| libm::floor(libm::log(f64::from(v)) / libm::log(RATIO) + 1.0e-6) as i32;
        self.alone = f64::from(step_alone);
        self.first = (powers(step_alone) / 2).max(1);
        self.sizes = (powers(pixel) - self.first + 1).max(0);
    }

    fn pixel_of(&self, size: i32) -> f64 {
        if size == 0 { 1.0 } else { libm::pow(RATIO, f64::from(size - 1 + self.first)) }
    }

    /// The values of c that may be chosen.
    pub(super) fn limits(&self) -> StepLimits {
        let pixel = self.pixel_of(self.sizes);
        let coarsest = f64::from(self.steps.coarsest()) * pixel * pixel;
        StepLimits { coarsest: coarsest as f32, ..self.steps }
    }

    /// Step, image size and pixel at c.
    fn at(&self, c: f32) -> (f32, i32, f64) {
        if self.sizes == 0 {
            return (c, 0, 1.0);
        }
        let c = f64::from(c);
        let (finest, coarsest) = (f64::from(self.steps.finest()), f64::from(self.steps.coarsest()));
        let alone = c / finest;
        let together = libm::log((alone / TOGETHER).max(1.0e-30)) / (3.0 * libm::log(RATIO));
        let mut size = libm::round(together) as i32 + 1 - self.first;
        size = if alone <= self.alone { 0 } else { size.clamp(i32::from(self.alone > 1.0), self.sizes) };
        let last = self.last.clamp(0, self.sizes);
        let pixel = self.pixel_of(last);
        let quotient = alone / (pixel * pixel * pixel);
        // Where the step alone comes first, the path has bounds of its own there.
        let low = if last == 1 && self.alone > 1.0 { self.alone / (pixel * pixel * pixel) } else { KEEP.0 };
        let high = if last == 0 { KEEP.1.max(WHOLE * self.alone) } else { KEEP.1 };
        let kept = (last == 0 || quotient >= low) && (last == self.sizes || quotient <= high);
        if kept {
            size = last;
        }
        let step = |size: i32| c / (self.pixel_of(size) * self.pixel_of(size));
        while size < self.sizes && step(size) > coarsest * 1.000_001 {
            size += 1;
        }
        while size > 0 && step(size) < finest && step(size - 1) <= coarsest {
            size -= 1;
        }
        (step(size).clamp(finest, coarsest.max(finest)) as f32, size, self.pixel_of(size))
    }

    /// What is drawn at c of an image whose full size is that of `full`.
    pub(super) fn setting(&self, full: Setting, c: f32) -> Setting {
        let (step, size, pixel) = self.at(c);
        if size == 0 {
            return full.with_step(step);
        }
        let shrunk = |side: u32| ((f64::from(side) / pixel) as u32).max(1);
        Setting { step, width: shrunk(full.width), height: shrunk(full.height), ..full }
    }

    /// Step and pixel of a frame that is drawn at c.
    pub(super) fn take(&mut self, c: f32) -> (f32, f32) {
        let (step, size, pixel) = self.at(c);
        self.last = size;
        (step, pixel as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Shading, Skipping};
    use proptest::prelude::*;

    fn path(finest: f32, coarsest: f32, pixel: f32, step_alone: f32) -> Coarsening {
        let mut path = Coarsening::of_step(StepLimits::new(finest, coarsest).unwrap());
        path.set_coarsest_pixel(pixel, step_alone);
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
        assert_eq!(path.take(path.limits().finest()), (0.5, 1.0));
        let (step, pixel) = path.take(path.limits().coarsest());
        assert!((step - 8.0).abs() < 1e-4 && pixel > 3.5 && pixel <= 4.0, "{step} {pixel}");
    }

    #[test]
    fn an_image_size_is_kept_when_the_step_wavers() {
        let mut path = path(1.0, 8.0, 4.0, 1.0);
        let mut changes = 0;
        let mut before = path.take(4.4).1;
        for i in 0..200 {
            let pixel = path.take(if i % 2 == 0 { 4.1 } else { 4.9 }).1;
            changes += usize::from(pixel != before);
            before = pixel;
        }
        assert!(changes <= 1, "{changes}");
    }

    #[test]
    fn the_step_alone_comes_first_where_it_is_to() {
        let mut path = path(1.0, 8.0, 4.0, 2.1);
        for i in 0..50 {
            let c = 1.0 + 0.2 * i as f32;
            let (step, pixel) = path.take(c);
            assert_eq!(pixel == 1.0, c < 2.41, "{c}: {step} {pixel}");
            assert!(pixel == 1.0 || pixel > 1.43, "{c}: {step} {pixel}");
        }
        path.take(3.0);
        assert!(path.take(2.2).1 > 1.43);
        assert_eq!(path.take(2.0), (2.0, 1.0));
    }

    proptest! {
        #[test]
        fn c_is_met_within_the_limits_and_work_never_rises(
            finest in 0.1f32..2.0, coarsening in 1.0f32..20.0, pixel in 1.0f32..8.0, alone in 1.0f32..4.0, from in 0.0f32..1.0) {
            let mut path = path(finest, finest * coarsening, pixel, alone);
            let limits = path.limits();
            let c_at = |u: f32| limits.clamp(limits.finest() * (limits.coarsest() / limits.finest()).powf(u));
            path.take(c_at(from));
            let full = Setting { step: 1.0, width: 4096, height: 4096, shading: Shading::None, skipping: Skipping::None };
            let mut before = (f64::INFINITY, f64::INFINITY);
            for i in 0..=60 {
                let c = c_at(i as f32 / 60.0);
                let (step, _, by) = path.at(c);
                prop_assert!(step >= finest && step <= path.steps().coarsest());
                prop_assert!(by <= f64::from(pixel) * 1.0001);
                let off = f64::from(step) * by * by / f64::from(c) - 1.0;
                prop_assert!(off.abs() < if coarsening > 2.0 * alone { 1e-5 } else { 7.0 }, "{off}");
                let s = path.setting(full, c);
                let pixels = f64::from(s.width) * f64::from(s.height);
                // Rays alone, and samples alone; an image of whole pixels is a little smaller than it should be.
                let work = (pixels, pixels / f64::from(s.step));
                prop_assert!(work.0 <= before.0 && work.1 <= before.1 * 1.005, "{work:?} {before:?}");
                before = work;
            }
        }
    }
}
