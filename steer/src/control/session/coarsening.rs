//! Combines ray step and image size in one quantity for the controller to choose; settings of a session for
//! smaller images and for the picture quality law.

use super::Session;
use crate::control::StepLimits;
use crate::features::Setting;
use crate::predict::{DISTANCE_RATIO, Quality};
use entire_core::Result;
use entire_core::bail;

/// ln of [`DISTANCE_RATIO`].
const LN_RATIO: f64 = 0.182_321_556_793_954_6;

/// Ratio of the step, in finest steps, to the image sample distance, in pixels, if both are coarsened
/// together without a picture quality law. Theory suggests a ratio of 1: samples along a ray are then as far
/// apart as neighboring rays. The added tenth is a choice.
const STEP_PER_DISTANCE: f64 = 1.1;

/// Hysteresis factor: an image sample distance is kept until c = step · distance² lies beyond one of its
/// thresholds by more than this factor. Successive thresholds differ by a factor of 1.2³ = 1.73, so the
/// geometric mean of two successive thresholds is a factor of 1.31 from each. The hysteresis factor is the
/// square root of 1.31. A distance is not increased either while the step after the increase would exceed the
/// finest step by less than this factor: the distance would soon be decreased again, since the step cannot
/// become finer than the finest step.
const DISTANCE_HYSTERESIS: f64 = 1.15;

/// Capacity of the arrays, in levels of the image sample distance. Distance 1 and the powers of
/// [`DISTANCE_RATIO`] up to 64 need 23 levels.
const LEVELS: usize = 24;

/// A path from the finest step at full image size to the coarsest step at the largest image sample distance.
///
/// The controller chooses c = step · distance², where `distance` is the distance of neighboring rays in
/// pixels; a frame's time is about proportional to 1/c. Without a picture quality law, step and distance grow
/// together along the path: at equal time, the picture error is smaller than if one of them grew alone. For a
/// renderer whose smaller images are strongly blurred, only the step grows at first (`step_alone`). With a
/// law ([`Quality`]), the law determines the path. Distances are powers of 1.2, and a distance is kept until
/// c lies clearly beyond its thresholds ([`DISTANCE_HYSTERESIS`]), so that buffers seldom change. A change of
/// the distance changes the step too, so that step · distance² stays equal to c, unless the step would leave
/// its limits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Coarsening {
    pub(super) steps: StepLimits,
    /// Largest image sample distance, in pixels, and the step, in finest steps, up to which the distance
    /// stays 1 without a quality law.
    largest: (f32, f32),
    quality: Option<Quality>,
    /// Number of levels whose image sample distance is greater than 1 pixel.
    levels: usize,
    /// Image sample distance of each level, in pixels, ascending from 1.
    distances: [f64; LEVELS],
    /// Threshold of each level: smallest c, in finest steps, for which the level is used.
    from: [f64; LEVELS],
    /// Level of the previous frame; level 0 is distance 1.
    pub(super) last: usize,
}

impl Coarsening {
    /// Returns a coarsening that changes only the step, never the image sample distance.
    pub(super) fn of_step(steps: StepLimits) -> Self {
        Self {
            steps,
            largest: (1.0, 1.0),
            quality: None,
            levels: 0,
            distances: [1.0; LEVELS],
            from: [0.0; LEVELS],
            last: 0,
        }
    }

    /// Sets the largest image sample distance, in pixels, and `step_alone`: without a quality law, only the
    /// ray step is coarsened, up to this multiple of the finest step. Both values are 1 to 64.
    pub(super) fn set_max_distance(&mut self, distance: f32, step_alone: f32) {
        if self.largest != (distance, step_alone) {
            self.largest = (distance, step_alone);
            self.lay();
        }
    }

    /// Sets the renderer's picture quality law, which the caller has checked.
    pub(super) fn set_quality(&mut self, quality: Option<Quality>) {
        if self.quality != quality {
            self.quality = quality;
            self.lay();
        }
    }

    /// Computes the image sample distance and the threshold of each level.
    fn lay(&mut self) {
        let powers = |v: f32| libm::floor(libm::log(f64::from(v)) / LN_RATIO + 1.0e-6) as usize;
        let (distance, step_alone) = self.largest;
        let first = if self.quality.is_some() { 1 } else { powers(step_alone) / 2 };
        // The distance of the first level must not exceed the largest distance.
        let first = first.min(powers(distance)).max(1);
        self.levels = (powers(distance) + 1).saturating_sub(first).min(LEVELS - 1);
        self.from[0] = 0.0;
        for level in 1..=self.levels {
            let power = (level - 1 + first) as f64;
            self.distances[level] = libm::pow(DISTANCE_RATIO, power);
            self.from[level] = STEP_PER_DISTANCE * libm::pow(DISTANCE_RATIO, 3.0 * (power - 0.5));
        }
        if let Some(quality) = self.quality {
            quality.lay(&self.distances[..=self.levels], &mut self.from[..=self.levels]);
        } else if step_alone > 1.0 {
            let alone = f64::from(step_alone);
            self.from[1] = alone;
            for from in &mut self.from[2..] {
                *from = from.max(alone);
            }
        }
    }

    /// Returns the range of c = step · distance².
    pub(super) fn limits(&self) -> StepLimits {
        let distance = self.distances[self.levels];
        let coarsest = f64::from(self.steps.coarsest) * distance * distance;
        StepLimits { coarsest: coarsest as f32, ..self.steps }
    }

    /// Returns step, level and image sample distance at c.
    fn at(&self, c: f32) -> (f32, usize, f64) {
        if self.levels == 0 {
            return (c, 0, 1.0);
        }
        let c = f64::from(c);
        let (finest, coarsest) = (f64::from(self.steps.finest), f64::from(self.steps.coarsest));
        let alone = c / finest;
        let last = self.last.min(self.levels);
        let kept = alone * DISTANCE_HYSTERESIS >= self.from[last]
            && (last == self.levels || alone <= self.from[last + 1] * DISTANCE_HYSTERESIS);
        let mut level = last;
        if !kept {
            level = self.from[1..=self.levels].iter().take_while(|&&from| alone > from).count();
        }
        let step = |level: usize| c / (self.distances[level] * self.distances[level]);
        while level > last && step(level) < finest * DISTANCE_HYSTERESIS {
            level -= 1;
        }
        while level < self.levels && step(level) > coarsest * 1.000_001 {
            level += 1;
        }
        while level > 0 && step(level) < finest && step(level - 1) <= coarsest {
            level -= 1;
        }
        (step(level).clamp(finest, coarsest.max(finest)) as f32, level, self.distances[level])
    }

    /// Returns the setting at c. The sides of its image are those of `full`, divided by the image sample
    /// distance.
    pub(super) fn setting(&self, full: Setting, c: f32) -> Setting {
        let (step, level, distance) = self.at(c);
        if level == 0 {
            return Setting { step, ..full };
        }
        let shrunk = |side: u32| ((f64::from(side) / distance) as u32).max(1);
        Setting { step, width: shrunk(full.width), height: shrunk(full.height), ..full }
    }

    /// Returns step and image sample distance of a frame drawn at c, and stores its level as the previous
    /// one.
    pub(super) fn take(&mut self, c: f32) -> (f32, f32) {
        let (step, level, distance) = self.at(c);
        self.last = level;
        (step, distance as f32)
    }
}

impl Session {
    /// Allows plans to coarsen the image: neighboring rays are up to `distance` pixels apart along each side
    /// (VTK's ImageSampleDistance). Ray step and image are coarsened together
    /// ([`Plan::image_sample_distance`](super::Plan::image_sample_distance)), from `step_alone` times the
    /// finest step on; a `step_alone` of 1 couples step and image from the start. A `distance` of 1, the
    /// initial value, keeps the full image size. The predictor should depend on the image size.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless 1 ≤ `distance` ≤ 64 and 1 ≤ `step_alone` ≤ 64.
    pub fn set_max_image_sample_distance(&mut self, distance: f32, step_alone: f32) -> Result<()> {
        let alone =
            "step_alone (a multiple of the finest step; the image is coarsened only at larger ray steps)";
        for (what, v) in [("the largest image sample distance", distance), (alone, step_alone)] {
            if !(1.0..=64.0).contains(&v) {
                bail!(InvalidArgument, "{what} is {v}; it must be 1 to 64");
            }
        }
        self.coarsening.set_max_distance(distance, step_alone);
        Ok(())
    }

    /// Sets the picture quality law of this renderer, so that plans coarsen the step or the image, whichever
    /// adds less error. With `None`, the initial value, the law in the model file is used, if the model was
    /// calibrated with the renderer that [`Session::set_timing_source`] named, or if no renderer was named;
    /// otherwise the law that is built in for the renderer of this name ([`Quality::built_in`]). With a law,
    /// `step_alone` of [`Session::set_max_image_sample_distance`] has no effect.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless the weight is 1e-3 to 1e3, the exponents are 0.05 to 8
    /// and the share of rays is 0 to 0.9.
    pub fn set_quality(&mut self, quality: Option<Quality>) -> Result<()> {
        if let Some(quality) = &quality {
            quality.check()?;
        }
        self.quality = quality;
        self.weigh_pictures();
        Ok(())
    }

    /// The picture quality law that plans use: that of [`Session::set_quality`] if one was set, otherwise the
    /// model's, otherwise the built-in one; `None` if there is none of them.
    #[must_use]
    pub fn quality(&self) -> Option<Quality> {
        let renderer = &self.timing[0];
        self.quality.or_else(|| self.predictor.quality(renderer)).or_else(|| Quality::built_in(renderer))
    }

    /// Recomputes, from the present picture quality law, the image sizes that plans choose.
    pub(super) fn weigh_pictures(&mut self) {
        self.coarsening.set_quality(self.quality());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::HybridOptions;
    use crate::predict::{AnalyticModel, load};
    use alloc::boxed::Box;
    use entire_core::scene::{Shading, Skipping};
    use proptest::prelude::*;

    const LAW: Quality =
        Quality { image_weight: 4.0, step_exponent: 1.3, image_exponent: 0.8, ray_share: 0.25 };

    fn path(finest: f32, coarsest: f32, distance: f32, step_alone: f32) -> Coarsening {
        let mut path = Coarsening::of_step(StepLimits { finest, coarsest });
        path.set_max_distance(distance, step_alone);
        path
    }

    #[test]
    fn without_smaller_images_it_is_the_step() {
        let mut path = path(1.0, 8.0, 1.19, 1.0);
        assert_eq!(path.limits(), path.steps);
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
    fn a_distance_below_that_of_the_step_alone_is_used_too() {
        let mut path = path(1.0, 16.0, 2.0, 8.0);
        let (step, distance) = path.take(path.limits().coarsest);
        assert!((step - 16.0).abs() < 1e-3 && distance > 1.5 && distance <= 2.0, "{step} {distance}");
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
    fn after_an_increase_the_step_can_become_finer_before_the_image_grows_again() {
        let mut path = judged(Quality { image_weight: 0.002, ..EVEN });
        let mut before = path.take(1.0).1;
        let mut increases = 0;
        for i in 0..200 {
            let c = 1.0 + 0.05 * i as f32;
            let (step, distance) = path.take(c);
            if distance > before {
                increases += 1;
                assert!(step >= 1.149 || distance == 4.0, "{c}: {step} {distance}");
                let mut back = path;
                assert_eq!(back.take(c / 1.14).1, distance, "{c}");
            }
            before = distance;
            // A new path starts at distance 1, so c may require several levels at once.
            let (step, distance) = judged(Quality { image_weight: 0.002, ..EVEN }).take(c);
            assert!(step >= 1.149 || distance == 1.0, "{c}: {step} {distance}");
        }
        assert!(increases > 4, "{increases}");
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

    fn judged(quality: Quality) -> Coarsening {
        quality.check().unwrap();
        let mut path = path(1.0, 16.0, 4.0, 1.0);
        path.set_quality(Some(quality));
        path
    }

    const EVEN: Quality =
        Quality { image_weight: 1.0, step_exponent: 1.0, image_exponent: 1.0, ray_share: 0.0 };

    #[test]
    fn what_costs_the_picture_less_is_coarsened_first() {
        // A smaller image has almost no error, so the step must stay fine while the image can become smaller.
        let mut images = judged(Quality { image_weight: 0.002, ..EVEN });
        // The next distance is used only if the step is then at least `DISTANCE_HYSTERESIS` times the finest
        // step.
        for (c, distance) in [(1.8f32, 1.2f32), (2.5, 1.44), (4.5, 1.728), (9.0, 2.48832)] {
            let (step, chosen) = images.take(c);
            assert!((chosen - distance).abs() < 1e-5 && step < 1.51, "{c}: {step} {chosen}");
        }
        // Any smaller image has a larger error than any step, so the image must keep its size while the step
        // can become coarser.
        let mut steps = judged(Quality { image_weight: 500.0, image_exponent: 0.1, ..EVEN });
        for c in [1.6f32, 2.2, 4.5, 9.0, 15.0] {
            assert_eq!(steps.take(c), (c, 1.0));
        }
        assert!(steps.take(40.0).1 > 1.0);
    }

    #[test]
    fn time_that_goes_with_rays_speaks_for_smaller_images() {
        let at = |ray_share: f32| {
            let quality = Quality { image_weight: 4.0, step_exponent: 1.3, image_exponent: 1.3, ray_share };
            judged(quality).take(8.0).1
        };
        assert!(at(0.6) > at(0.0), "{} {}", at(0.6), at(0.0));
    }

    #[test]
    fn the_path_taken_shows_less_than_other_distances_at_the_same_time() {
        let quality = Quality { image_weight: 2.0, step_exponent: 1.4, image_exponent: 1.2, ray_share: 0.0 };
        // c begins at 2.2: for smaller c, distance 1 is kept although another distance may have a smaller
        // error.
        for i in 4..40 {
            let c = 1.0 + 0.3 * i as f32;
            let (step, distance) = judged(quality).take(c);
            let own = quality.error(f64::from(step), f64::from(distance));
            for level in 0..8 {
                let d = libm::pow(DISTANCE_RATIO, f64::from(level));
                let s = f64::from(c) / (d * d);
                // Distances are kept somewhat beyond their thresholds, so the chosen setting may have an
                // error that is up to 1.2 times the smallest.
                assert!(s < 1.0 || own <= 1.2 * quality.error(s, d), "{c}: {step} {distance}, {s} {d}");
            }
        }
    }

    #[test]
    fn qualities_out_of_range_are_refused() {
        for bad in [
            Quality { image_weight: 0.0, ..EVEN },
            Quality { step_exponent: f32::NAN, ..EVEN },
            Quality { image_exponent: 9.0, ..EVEN },
            Quality { ray_share: 1.0, ..EVEN },
        ] {
            assert!(bad.check().is_err(), "{bad:?}");
        }
    }

    proptest! {
        #[test]
        fn c_is_met_within_the_limits_and_work_never_rises(
            finest in 0.1f32..2.0, coarsening in 1.0f32..20.0, distance in 1.0f32..8.0, alone in 1.0f32..4.0, from in 0.0f32..1.0,
            known in proptest::option::of((0.01f32..100.0, 0.1f32..3.0, 0.1f32..3.0, 0.0f32..0.9))) {
            let mut path = path(finest, finest * coarsening, distance, alone);
            path.set_quality(known.map(|(image_weight, step_exponent, image_exponent, ray_share)| {
                Quality { image_weight, step_exponent, image_exponent, ray_share }
            }));
            let limits = path.limits();
            let c_at = |u: f32| limits.clamp(limits.finest * (limits.coarsest / limits.finest).powf(u));
            path.take(c_at(from));
            let full = Setting { step: 1.0, width: 4096, height: 4096, shading: Shading::None, skipping: Skipping::None };
            let mut before = (f64::INFINITY, f64::INFINITY);
            for i in 0..=60 {
                let c = c_at(i as f32 / 60.0);
                let (step, _, by) = path.at(c);
                prop_assert!(step >= finest && step <= path.steps.coarsest);
                prop_assert!(by <= f64::from(distance) * 1.0001);
                let off = f64::from(step) * by * by / f64::from(c) - 1.0;
                prop_assert!(off.abs() < if coarsening > 2.0 * alone { 1e-5 } else { 7.0 }, "{off}");
                let s = path.setting(full, c);
                let pixels = f64::from(s.width) * f64::from(s.height);
                // Number of rays, and number of samples. The image's size is rounded down to whole pixels, so
                // the numbers are slightly too small.
                let work = (pixels, pixels / f64::from(s.step));
                prop_assert!(work.0 <= before.0 && work.1 <= before.1 * 1.005, "{work:?} {before:?}");
                before = work;
            }
        }
    }

    #[test]
    fn what_the_model_states_holds_for_its_renderer_until_the_caller_knows_better() {
        let mut file = AnalyticModel::default().to_model_file().unwrap();
        LAW.store(&mut file).unwrap();
        file.metadata.insert(entire_core::model::Key::Renderer.into(), "mine".into());
        let mut session =
            Session::new(load(&file.to_model().unwrap()).unwrap(), HybridOptions::default()).unwrap();
        session.set_max_image_sample_distance(4.0, 1.0).unwrap();
        let path = |session: &Session| session.coarsening;
        let by_model = path(&session);
        assert_eq!(session.quality(), Some(LAW));
        session.set_timing_source("other", "cpu").unwrap();
        assert!(session.quality().is_none() && path(&session) != by_model);
        session.set_timing_source("vtkFixedPointVolumeRayCastMapper", "cpu").unwrap();
        assert_eq!(session.quality().map(|q| q.image_weight), Some(5.9));
        session.set_timing_source("mine", "cpu").unwrap();
        assert_eq!(path(&session), by_model);
        let own = Quality { image_weight: 40.0, ..LAW };
        session.set_quality(Some(own)).unwrap();
        assert!(session.quality() == Some(own) && path(&session) != by_model);
        session.set_quality(None).unwrap();
        assert_eq!((session.quality(), path(&session)), (Some(LAW), by_model));
        session.set_predictor(Box::new(AnalyticModel::default()), HybridOptions::default()).unwrap();
        assert!(session.quality().is_none() && path(&session) != by_model);
    }
}
