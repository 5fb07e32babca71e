//! Compares pictures at coarser steps and smaller image sizes with pictures at full quality.

use super::{Measuring, WARM_UP_LIMIT};
use crate::calibrate::pool::Candidate;
use crate::pictures::{resized, rmse, scaled_size};
use anyhow::{Context, Result};
use entire_core::scene::Frame;
use entire_io::dataset::Timing;
use entire_steer::calibrate::Picture;
use entire_vk_raycaster::Image;
use std::collections::BTreeSet;
use std::time::Instant;

/// Ray steps at which every scene is drawn, reference steps.
const STEPS: [f32; 5] = [1.0, 1.41, 2.0, 2.83, 4.0];

/// Image sample distances at which every scene is drawn, pixels between rays along each side.
const DISTANCES: [f32; 4] = [1.0, 1.2, 1.44, 2.0736];

/// Time of drawing a scene twice at every pair of step and distance, as a multiple of its time at full
/// quality.
const GRID: f64 = 14.0;

/// Number of scenes that must fit in the remaining time: a scene that would take more than 1 / `SCENES` of
/// this time is left out.
const SCENES: f64 = 6.0;

/// Maximum number of scenes of one volume.
const PER_VOLUME: usize = 2;

/// Shortest side of a compared image, pixels: errors of smaller images vary too much.
const LEAST_SIDE: u32 = 96;

impl Measuring<'_> {
    /// Draws scenes at full quality, at coarser steps and as smaller images until `deadline`, and returns the
    /// compared pictures. An unfinished scene is dropped.
    pub(crate) fn pictures(&mut self, deadline: Instant) -> Result<Vec<Picture>> {
        self.deadline = deadline;
        let longest = self.left() / (SCENES * GRID);
        let mut out = Vec::new();
        for i in self.scenes(longest) {
            // The expected time gets a margin of 20 %, since an unfinished scene is dropped.
            if (self.stop)() || self.left() < 1.2 * GRID * self.full_wall(i) {
                break;
            }
            let c = &self.pool.candidates[i];
            let (volume, factor) = (c.volume, c.factor);
            self.bar.set_message("comparing pictures");
            self.show(volume, factor)?;
            match self.compare(i)? {
                Some(pictures) => out.extend(pictures),
                None => break,
            }
            self.bar.set_position(self.start.elapsed().as_secs());
        }
        Ok(out)
    }

    /// Expected wall seconds of a candidate at full quality.
    fn full_wall(&self, i: usize) -> f64 {
        self.wall(i) * f64::from(self.pool.candidates[i].scene.step).max(1.0)
    }

    /// Returns at most [`PER_VOLUME`] candidates of each volume: those with the largest images among the
    /// candidates that take at most `longest` seconds at full quality. Candidates with an image side below
    /// [`LEAST_SIDE`], or with at most one sample per pixel, are left out. The first candidates of all
    /// volumes come before the second ones.
    fn scenes(&self, longest: f64) -> Vec<usize> {
        let candidates = &self.pool.candidates;
        let pixels = |c: &Candidate| u64::from(c.scene.width) * u64::from(c.scene.height);
        let usable =
            |c: &Candidate| c.scene.width.min(c.scene.height) >= LEAST_SIDE && c.samples_per_pixel() > 1.0;
        let mut largest: Vec<usize> = (0..candidates.len())
            .filter(|&i| usable(&candidates[i]) && self.full_wall(i) <= longest)
            .collect();
        largest.sort_by_key(|&i| std::cmp::Reverse(pixels(&candidates[i])));
        let volumes: BTreeSet<usize> = largest.iter().map(|&i| candidates[i].volume).collect();
        let of = |volume: usize, rank: usize| {
            largest.iter().copied().filter(move |&i| candidates[i].volume == volume).nth(rank)
        };
        (0..PER_VOLUME).flat_map(|rank| volumes.iter().filter_map(move |&v| of(v, rank))).collect()
    }

    /// Draws one scene at every step and image sample distance and returns the pictures; `None` if the time
    /// ran out or `stop` returned true before the end.
    fn compare(&mut self, i: usize) -> Result<Option<Vec<Picture>>> {
        let scene = &self.pool.candidates[i].scene;
        let place = || format!("{}, compared scene {i}", scene.volume);
        let frame = Frame { step: 1.0, ..scene.to_frame().with_context(place)? };
        self.renderer.set_transfer(&scene.to_table().with_context(place)?).with_context(place)?;
        let mut out = Vec::with_capacity(STEPS.len() * DISTANCES.len());
        let mut full: Option<Image> = None;
        for distance in DISTANCES {
            let (width, height) = scaled_size((frame.width, frame.height), 1.0 / distance);
            for step in STEPS {
                let frame = Frame { width, height, step, ..frame }.checked().with_context(place)?;
                let (mut seconds, mut picture) = (f64::INFINITY, None);
                for repeat in 0..2 {
                    if (self.stop)() || self.left() <= 0.0 {
                        return Ok(None);
                    }
                    if repeat > 0 && seconds > WARM_UP_LIMIT {
                        break;
                    }
                    let rendered = self.renderer.render(&frame).with_context(place)?;
                    let timing = Timing::new(rendered.time, rendered.counts);
                    let took = timing.seconds(self.settings.clock).with_context(|| {
                        format!("{}: the renderer has no clock {}", place(), self.settings.clock.name())
                    })?;
                    seconds = seconds.min(took);
                    picture = Some(rendered.image);
                }
                let full_size = full.as_ref().map_or((width, height), |f| (f.width, f.height));
                let shown =
                    picture.and_then(|p| resized(&p, full_size.0, full_size.1)).with_context(place)?;
                let full = full.get_or_insert_with(|| shown.clone());
                let error = rmse(&shown.rgba, &full.rgba).with_context(place)?;
                out.push(Picture { scene: i as u64, step, distance, seconds, error });
            }
        }
        Ok(Some(out))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibrate::Settings;
    use crate::calibrate::pool::Pool;
    use crate::scripted::ScriptedRenderer;
    use entire_io::dataset::TimedFrame;
    use entire_steer::features::SceneQuantity;
    use entire_steer::predict::{COST_QUANTITIES, COSTS, UnitCosts};
    use indicatif::ProgressBar;

    #[test]
    fn scenes_that_show_the_volume_are_compared_even_if_nothing_is_skipped() {
        let candidate = |skips: f64, samples: f64| {
            let mut scene = TimedFrame::of_no_volume("v", "").scene;
            (scene.width, scene.height) = (100, 100);
            let mut work = [1.0; COSTS];
            for (slot, quantity) in work[1..].iter_mut().zip(COST_QUANTITIES) {
                *slot = match quantity {
                    SceneQuantity::Pixels => 1e4,
                    SceneQuantity::Skips => 1e4 * skips,
                    SceneQuantity::Samples => 1e4 * samples,
                    _ => 0.0,
                };
            }
            Candidate { volume: 0, factor: 1, scene, work, random: false }
        };
        let candidates = vec![candidate(0.0, 40.0), candidate(40.0, 0.0)];
        assert_eq!(candidates[0].samples_per_pixel(), 40.0);
        let pool = Pool {
            files: Vec::new(),
            expected: vec![1e-3; candidates.len()],
            candidates,
            prior: UnitCosts::SOFTWARE,
        };
        let (settings, mut renderer) = (Settings::brief(Vec::new()), ScriptedRenderer::default());
        let (now, bar) = (Instant::now(), ProgressBar::hidden());
        let measuring = Measuring::new(&settings, &pool, &mut renderer, now, now, &|| false, &bar);
        assert_eq!(measuring.scenes(1.0), [0]);
    }
}
