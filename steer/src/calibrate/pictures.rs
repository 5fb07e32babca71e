//! Fits the picture quality law to compared pictures.
//!
//! The law of [`Quality`] is fitted in two parts. `ray_share` is fitted to the drawing times, relative to the
//! time at full quality. The weight and the exponents are fitted to the picture errors: first by least
//! squares on the means of ln(error) over scenes, then by a search for the parameters that choose the
//! settings with the smallest measured errors. Measured errors may be proportional to any power of the law's
//! error.
//!
//! Few scenes mislead: their errors say little about other scenes. A prior law, such as the renderer's
//! built-in one, therefore counts as [`PRIOR_SCENES`] further scenes in the means, and is kept unless the
//! fitted law chooses better settings for scenes that are held out of the fit.

use crate::numeric::{median, solve};
use crate::predict::{DISTANCE_RATIO, Quality};
use alloc::collections::BTreeMap;
use alloc::vec;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use serde::Serialize;

/// Smallest number of scenes for a fit.
const FEWEST_SCENES: usize = 3;

/// Number of scenes that the prior law counts as: the number of scenes that each built-in law of VTK's
/// mappers was fitted to.
const PRIOR_SCENES: f64 = 18.0;

/// Largest number of groups of scenes that are held out in turn; up to this number of scenes, each scene is a
/// group.
const GROUPS: usize = 8;

/// The fit of the error uses only pictures that take at most this share of the time at full quality. Slower
/// pictures differ from full quality by rounding only.
const MAX_TIME_SHARE: f64 = 0.75;

/// Ratio of successive steps, and of successive values of c = step · distance², at which errors are
/// evaluated.
const PATH_RATIO: f64 = 1.03;

/// Difference in ln(error) assumed between full quality and the next coarser step, since the error of 0 at
/// full quality has no logarithm.
const FULL_QUALITY_GAP: f64 = 3.0;

/// Frame times at which the law's choices are evaluated, as shares of the time at full quality: first share,
/// end, increment.
const SHARES: (f64, f64, f64) = (0.2, MAX_TIME_SHARE, 0.025);

/// Lower clamp of a picture's error, since an error of 0 has no logarithm.
const LEAST_ERROR: f64 = 1.0e-7;

/// Weight of the law's root mean squared misfit in ln(error), relative to the excess ln(error) of the
/// settings that the law chooses.
const MISFIT: f64 = 0.1;

/// One picture, compared with the same view at full quality.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Picture {
    /// Identifier of the view, that is of scene and camera.
    pub scene: u64,
    /// Ray step in finest steps; 1 for full quality.
    pub step: f32,
    /// Pixels between neighboring rays along each side: 1 for full quality.
    pub distance: f32,
    /// Seconds that the drawing took.
    pub seconds: f64,
    /// Difference from the picture at full quality, by any measure that is 0 for equal pictures and grows
    /// with the difference, such as the root mean squared difference or 1 − SSIM.
    pub error: f64,
}

impl Picture {
    /// Checks the values.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless step and distance are at least 1, seconds are positive,
    /// the error is not negative, and all are finite.
    pub fn check(&self) -> Result<()> {
        let Self { scene, step, distance, seconds, error } = self;
        let sound = *step >= 1.0 && step.is_finite() && *distance >= 1.0 && distance.is_finite();
        let measured = *seconds > 0.0 && seconds.is_finite() && *error >= 0.0 && error.is_finite();
        if sound && measured {
            return Ok(());
        }
        bail!(
            InvalidArgument,
            "a picture of scene {scene} has step {step}, image sample distance {distance}, {seconds} seconds and error \
             {error}; step and distance must be at least 1, seconds positive, the error not negative"
        )
    }
}

/// A law fitted to pictures.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FittedQuality {
    /// The law.
    pub quality: Quality,
    /// Number of scenes in the fit; each was drawn at every setting.
    pub scenes: usize,
    /// Number of settings per scene.
    pub settings: usize,
    /// Excess error of the law's choices: ratio of the error of the law's setting to the smallest error of
    /// all settings that take at most the same time. Errors are interpolated between drawn settings.
    /// Geometric mean over frame times; 1 is the best value.
    pub over_best: f64,
    /// Excess error of fitted laws on scenes that were held out from their fits, divided by the excess error
    /// of the prior law on the same scenes. 1 or more if the prior law is kept; `None` without a prior.
    pub over_prior: Option<f64>,
    /// `over_best` for settings that coarsen the ray step alone. The mean is over those frame times of
    /// `over_best` that such settings reach; `None` if they reach none.
    pub step_over_best: Option<f64>,
    /// Time at the coarsest step and full image size, as a share of the time at full quality.
    pub step_least_time: f64,
}

/// A step, and two means over scenes: ln of the time relative to full quality, and ln of the error.
type Point = (f64, f64, f64);

/// An image sample distance, and its points in the order of ascending steps.
type Line = (f64, Vec<Point>);

/// Map from the bits of distance and step to the seconds of every picture drawn at this setting, and the
/// error of the last one.
type Settings = BTreeMap<(u32, u32), (Vec<f64>, f64)>;

/// Scenes that were drawn at the same settings.
struct Drawn {
    /// Bits of distance and step, ascending.
    settings: Vec<(u32, u32)>,
    /// For each scene and setting: ln of the time relative to full quality, and ln of the error.
    scenes: Vec<Vec<(f64, f64)>>,
}

/// Table for the fit: the drawn settings, each with the means of a [`Point`].
struct Grid {
    /// Image sample distances, ascending, with their points.
    lines: Vec<Line>,
}

impl Grid {
    /// Returns the settings to whose errors the law is fitted: step, distance and mean ln(error).
    fn coarse(&self) -> impl Iterator<Item = (f64, f64, f64)> {
        let coarse = |(s, d, time, _): &(f64, f64, f64, f64)| {
            (*s > 1.0 || *d > 1.0) && *time <= libm::log(MAX_TIME_SHARE)
        };
        self.points().filter(coarse).map(|(s, d, _, error)| (s, d, error))
    }

    /// Replaces the means over `scenes` scenes by the means over these scenes and [`PRIOR_SCENES`] further
    /// scenes that follow the prior law. The error of a further scene is a factor times a power of the law's
    /// error; factor and exponent are fitted to the measured errors.
    fn add_prior(&mut self, prior: &Quality, scenes: usize) {
        let (model, measured): (Vec<f64>, Vec<f64>) =
            self.coarse().map(|(s, d, error)| (libm::log(prior.error(s, d)), error)).unzip();
        let (slope, [mx, my]) = slope_of(&model, &measured);
        let part = PRIOR_SCENES / (PRIOR_SCENES + scenes as f64);
        for (d, line) in &mut self.lines {
            for (s, time, error) in line.iter_mut().filter(|p| p.0 > 1.0 || *d > 1.0) {
                *time += part * (libm::log(prior.time_share(*s, *d)) - *time);
                *error += part * (my + slope * (libm::log(prior.error(*s, *d)) - mx) - *error);
            }
        }
        self.set_full_quality();
    }

    /// Sets ln(error) of full quality, whose error is 0.
    fn set_full_quality(&mut self) {
        if let [whole, next, ..] = &mut self.lines[0].1[..] {
            whole.2 = next.2 - FULL_QUALITY_GAP;
        }
    }

    /// Steps at which all lines are evaluated, ascending.
    fn steps(&self) -> Vec<f64> {
        powers(PATH_RATIO, self.lines[0].1.last().map_or(1.0, |p| p.0))
    }

    /// Returns, for each of [`shares`], the smallest ln(error) of all settings that take at most this time.
    fn best(&self) -> Vec<f64> {
        let (largest, steps) = (self.lines.last().map_or(1.0, |l| l.0), self.steps());
        let all: Vec<(f64, f64)> = powers(DISTANCE_RATIO, largest)
            .iter()
            .flat_map(|&d| steps.iter().map(move |&s| self.at(s, d)))
            .collect();
        at_shares(&all, &shares(), false)
    }

    /// Returns the mean, over frame times, of ln(error of the law's setting / smallest error). `best` holds
    /// ln(smallest error) for each of [`shares`].
    fn regret(&self, law: &Quality, best: &[f64]) -> f64 {
        over_best(&self.path(law), best).unwrap_or(0.0)
    }

    fn points(&self) -> impl Iterator<Item = (f64, f64, f64, f64)> {
        self.lines.iter().flat_map(|(d, line)| line.iter().map(|&(s, time, error)| (s, *d, time, error)))
    }

    /// Returns ln of the relative time and ln of the error at a setting, interpolated linearly between drawn
    /// settings.
    fn at(&self, step: f64, distance: f64) -> (f64, f64) {
        let along = |line: &[Point]| {
            let mut before = line[0];
            for &next in line {
                if step <= next.0 {
                    return between(
                        libm::log(step),
                        (libm::log(before.0), before),
                        (libm::log(next.0), next),
                    );
                }
                before = next;
            }
            (before.1, before.2)
        };
        let after = self.lines.partition_point(|(d, _)| *d < distance).min(self.lines.len() - 1);
        let (far, near) = (&self.lines[after], &self.lines[after.saturating_sub(1)]);
        let [far_point, near_point] = [far, near].map(|(_, line)| along(line));
        let wrap = |(time, error): (f64, f64)| (0.0, time, error);
        between(
            libm::log(distance),
            (libm::log(near.0), wrap(near_point)),
            (libm::log(far.0), wrap(far_point)),
        )
    }

    /// Returns ln of the relative time and ln of the error of the settings that a law chooses, for ascending
    /// values of c = step · distance² from 1.
    fn path(&self, law: &Quality) -> Vec<(f64, f64)> {
        let largest = self.lines.last().map_or(1.0, |l| l.0);
        let coarsest = self.lines[0].1.last().map_or(1.0, |p| p.0);
        let distances = powers(DISTANCE_RATIO, largest);
        let mut from = vec![0.0; distances.len()];
        law.lay(&distances, &mut from);
        powers(PATH_RATIO, coarsest * largest * largest)
            .into_iter()
            .map(|c| {
                let level = from[1..].iter().take_while(|&&from| c > from).count();
                let distance = distances[level];
                self.at((c / (distance * distance)).clamp(1.0, coarsest), distance)
            })
            .collect()
    }
}

/// Returns the powers of `of` from 1 to `end`.
fn powers(of: f64, end: f64) -> Vec<f64> {
    (0..).map(|i| libm::pow(of, f64::from(i))).take_while(|v| *v <= end * 1.001).collect()
}

/// Interpolates time and error linearly between two points at the positions `a.0` and `b.0`.
fn between(x: f64, a: (f64, Point), b: (f64, Point)) -> (f64, f64) {
    let part = if b.0 > a.0 { ((x - a.0) / (b.0 - a.0)).clamp(0.0, 1.0) } else { 1.0 };
    (a.1.1 + part * (b.1.1 - a.1.1), a.1.2 + part * (b.1.2 - a.1.2))
}

/// Returns, for each share of the time at full quality, the smallest ln(error) of the points that take at
/// most this time. If `path` is true, returns ln(error) of the first of these points instead.
fn at_shares(points: &[(f64, f64)], shares: &[f64], path: bool) -> Vec<f64> {
    let at = |share: &f64| {
        let mut fitting = points.iter().filter(|p| p.0 <= libm::log(*share)).map(|p| p.1);
        if path { fitting.next() } else { fitting.reduce(f64::min) }
    };
    shares.iter().map(|share| at(share).unwrap_or(f64::INFINITY)).collect()
}

/// Returns the frame times at which choices are evaluated, as shares of the time at full quality.
fn shares() -> Vec<f64> {
    (0..).map(|i| SHARES.0 + SHARES.2 * f64::from(i)).take_while(|share| *share < SHARES.1).collect()
}

/// Returns by how much a law's choices exceed the best ones in ln(error): the mean over the [`shares`] that
/// `path` reaches, `None` if it reaches none. `path` holds ln(time) and ln(error) of settings, in the order
/// in which the law tries them; the law chooses the first setting whose time is at most the share. `best`
/// holds, for each share, the smallest ln(error) of all settings whose time is at most this share.
fn over_best(path: &[(f64, f64)], best: &[f64]) -> Option<f64> {
    let own = at_shares(path, &shares(), true);
    let both = own.iter().zip(best).filter(|(own, best)| own.is_finite() && best.is_finite());
    let (sum, n) = both.fold((0.0, 0.0), |(sum, n), (own, best)| (sum + own - best, n + 1.0));
    (n > 0.0).then(|| sum / n)
}

/// Fits a line to `y` over `x` by least squares; returns its slope, at least 0.001, and the means of `x` and
/// `y`.
fn slope_of(x: &[f64], y: &[f64]) -> (f64, [f64; 2]) {
    let n = x.len() as f64;
    let (mx, my) = (x.iter().sum::<f64>() / n, y.iter().sum::<f64>() / n);
    let mut gram = [x.iter().map(|x| square(x - mx)).sum::<f64>() + 1.0e-9];
    let product = x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum();
    (solve(&mut gram, vec![product]).map_or(1.0e-3, |b| b[0].max(1.0e-3)), [mx, my])
}

/// Fits the law to pictures. Every scene must be drawn at the same settings: full quality, coarser steps, and
/// smaller images. Scenes with other settings than most scenes are ignored. `prior` is the law that holds
/// without these pictures ([`Quality::built_in`]): the fewer scenes were drawn, the closer is the fitted law
/// to it, and it is returned unless the fitted law is better for held-out scenes. Without a prior, the
/// pictures alone determine the law.
///
/// # Errors
/// [`crate::ErrorKind::InvalidArgument`] for invalid values, for fewer than three scenes, two steps or two
/// distances, and if fewer than four settings take at most 0.75 of the time at full quality.
pub fn fit_quality(pictures: &[Picture], prior: Option<Quality>) -> Result<FittedQuality> {
    let drawn = Drawn::of(pictures)?;
    let grid = drawn.grid(|_| true);
    let counted = grid.coarse().count();
    if counted < 4 {
        bail!(
            InvalidArgument,
            "{counted} pictures of every scene take at most {MAX_TIME_SHARE} times as long as full quality, but \
             at least 4 are needed; draw coarser steps and smaller images"
        );
    }
    let over_prior = prior.map(|prior| drawn.over_prior(&prior));
    let quality = match prior {
        Some(prior) if !over_prior.is_some_and(|over| over < 1.0) => prior,
        _ => drawn.law(|_| true, prior.as_ref()),
    };
    let best = grid.best();
    let alone: Vec<(f64, f64)> = grid.steps().iter().map(|&step| grid.at(step, 1.0)).collect();
    Ok(FittedQuality {
        quality,
        scenes: drawn.scenes.len(),
        settings: drawn.settings.len(),
        over_best: libm::exp(grid.regret(&quality, &best)),
        over_prior,
        step_over_best: over_best(&alone, &best).map(libm::exp),
        step_least_time: alone.iter().map(|p| libm::exp(p.0)).fold(1.0, f64::min),
    })
}

/// Fits the law to a grid.
fn law_of(grid: &Grid) -> Quality {
    let times: Vec<(f64, f64, f64)> = grid.points().map(|(s, d, time, _)| (s, d, time)).collect();
    let rays = least_on_line(0.0, 0.9, &|rays| {
        let law = Quality::within([1.0, 1.0, 1.0, rays]);
        times.iter().map(|&(s, d, time)| square(libm::log(law.time_share(s, d)) - time)).sum()
    });
    let law = |v: &[f64; 3]| Quality::within([libm::exp(v[0]), v[1], v[2], rays]);
    let counted: Vec<(f64, f64, f64)> = grid.coarse().collect();
    let measured: Vec<f64> = counted.iter().map(|c| c.2).collect();
    // Mean squared difference of ln(measured error) from a fitted slope times ln(error by the law): measured
    // errors may be proportional to any power of the law's error.
    let off = |v: &[f64; 3]| {
        let law = law(v);
        let model: Vec<f64> = counted.iter().map(|&(s, d, _)| libm::log(law.error(s, d))).collect();
        let (slope, [mx, my]) = slope_of(&model, &measured);
        let squares = model.iter().zip(&measured).map(|(m, y)| square(slope * (m - mx) - (y - my)));
        squares.sum::<f64>() / measured.len() as f64
    };
    let best = grid.best();
    let inside =
        |v: &[f64; 3]| v[0].abs() < 6.5 && (0.2..=6.0).contains(&v[1]) && (0.2..=6.0).contains(&v[2]);
    let fitted = descend([1.0, 1.5, 1.5], 400, &|v| if inside(v) { off(v) } else { f64::INFINITY });
    let judged = |v: &[f64; 3]| grid.regret(&law(v), &best) + MISFIT * libm::sqrt(off(v));
    law(&descend(fitted, 25, &|v| if inside(v) { judged(v) } else { f64::INFINITY }))
}

fn square(x: f64) -> f64 {
    x * x
}

impl Drawn {
    /// Returns the scenes that were drawn at the most frequent set of settings.
    fn of(pictures: &[Picture]) -> Result<Self> {
        pictures.iter().try_for_each(Picture::check)?;
        // The bits of positive floats have the same order as the floats.
        let key = |p: &Picture| (p.distance.to_bits(), p.step.to_bits());
        let full = (1f32.to_bits(), 1f32.to_bits());
        let mut scenes: BTreeMap<u64, Settings> = BTreeMap::new();
        for p in pictures {
            let slot = scenes.entry(p.scene).or_default().entry(key(p)).or_default();
            slot.0.push(p.seconds);
            slot.1 = p.error;
        }
        scenes.retain(|_, settings| settings.contains_key(&full));
        let mut scenes_of: BTreeMap<Vec<(u32, u32)>, usize> = BTreeMap::new();
        for settings in scenes.values() {
            *scenes_of.entry(settings.keys().copied().collect()).or_default() += 1;
        }
        let Some((wanted, _)) =
            scenes_of.into_iter().max_by_key(|(settings, scenes)| (*scenes, settings.len()))
        else {
            bail!(
                InvalidArgument,
                "no scene was drawn at full quality; draw each scene also with step 1 and image sample \
                 distance 1"
            );
        };
        scenes.retain(|_, settings| settings.keys().eq(&wanted));
        let distinct = |of: fn(&(u32, u32)) -> u32| {
            let mut all: Vec<u32> = wanted.iter().map(of).collect();
            all.sort_unstable();
            all.dedup();
            all.len()
        };
        if scenes.len() < FEWEST_SCENES || distinct(|k| k.0) < 2 || distinct(|k| k.1) < 2 {
            bail!(
                InvalidArgument,
                "{} scenes were drawn at the same {} settings; at least {FEWEST_SCENES} scenes, two steps \
                 and two image sample distances are needed",
                scenes.len(),
                wanted.len()
            );
        }
        let measured = |mut settings: Settings| -> Vec<(f64, f64)> {
            let mut points: Vec<(f64, f64)> = settings
                .values_mut()
                .map(|(seconds, error)| {
                    (median(seconds).map_or(0.0, libm::log), libm::log(error.max(LEAST_ERROR)))
                })
                .collect();
            // Full quality has the smallest step and distance.
            let whole = points[0].0;
            points.iter_mut().for_each(|p| p.0 -= whole);
            points
        };
        Ok(Self { settings: wanted, scenes: scenes.into_values().map(measured).collect() })
    }

    /// Returns the means over the scenes whose index `takes` accepts.
    fn grid(&self, takes: impl Fn(usize) -> bool) -> Grid {
        let taken: Vec<&Vec<(f64, f64)>> =
            self.scenes.iter().enumerate().filter(|(i, _)| takes(*i)).map(|(_, scene)| scene).collect();
        let mut lines: Vec<Line> = Vec::new();
        for (i, &(distance, step)) in self.settings.iter().enumerate() {
            let mean = |of: fn(&(f64, f64)) -> f64| {
                taken.iter().map(|scene| of(&scene[i])).sum::<f64>() / taken.len() as f64
            };
            let [distance, step] = [distance, step].map(|bits| f64::from(f32::from_bits(bits)));
            if lines.last().is_none_or(|l| l.0 != distance) {
                lines.push((distance, Vec::new()));
            }
            if let Some((_, line)) = lines.last_mut() {
                line.push((step, mean(|p| p.0), mean(|p| p.1)));
            }
        }
        let mut grid = Grid { lines };
        grid.set_full_quality();
        grid
    }

    /// Fits the law to the scenes whose index `takes` accepts, and to the prior.
    fn law(&self, takes: impl Fn(usize) -> bool, prior: Option<&Quality>) -> Quality {
        let mut grid = self.grid(&takes);
        if let Some(prior) = prior {
            grid.add_prior(prior, (0..self.scenes.len()).filter(|i| takes(*i)).count());
        }
        law_of(&grid)
    }

    /// Returns the excess error of fitted laws on held-out scenes, divided by the excess error of the prior
    /// law on the same scenes.
    fn over_prior(&self, prior: &Quality) -> f64 {
        let groups = self.scenes.len().min(GROUPS);
        let ratio = |group: usize| {
            let held = self.grid(|i| i % groups == group);
            let (law, best) = (self.law(|i| i % groups != group, Some(prior)), held.best());
            held.regret(&law, &best) - held.regret(prior, &best)
        };
        libm::exp((0..groups).map(ratio).sum::<f64>() / groups as f64)
    }
}

/// Returns the argument, among 181 evenly spaced values from `low` to `high`, for which `of` is smallest.
fn least_on_line(low: f64, high: f64, of: &dyn Fn(f64) -> f64) -> f64 {
    let at = |i: u32| low + (high - low) * f64::from(i) / 180.0;
    let mut best = (f64::INFINITY, low);
    for i in 0..=180 {
        let value = of(at(i));
        if value < best.0 {
            best = (value, at(i));
        }
    }
    best.1
}

/// Returns the argument of a local minimum of `of`, found by a coordinate search from `at`. Its increments
/// are halved after a round in which none of them reduces the value.
fn descend(mut at: [f64; 3], rounds: usize, of: &dyn Fn(&[f64; 3]) -> f64) -> [f64; 3] {
    let mut reach = [0.5, 0.2, 0.2];
    let mut least = of(&at);
    for _ in 0..rounds {
        let before = least;
        for axis in 0..3 {
            for sign in [1.0, -1.0] {
                let mut other = at;
                other[axis] += sign * reach[axis];
                let value = of(&other);
                if value < least {
                    (at, least) = (other, value);
                }
            }
        }
        if least == before {
            reach.iter_mut().for_each(|r| *r *= 0.5);
        }
    }
    at
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::Noise;

    const STEPS: [f32; 5] = [1.0, 1.5, 2.2, 3.2, 4.5];
    const DISTANCES: [f32; 4] = [1.0, 1.2, 1.44, 2.0];
    const TRUTH: Quality =
        Quality { image_weight: 5.0, step_exponent: 1.2, image_exponent: 0.9, ray_share: 0.2 };

    fn pictures(truth: &Quality, scenes: u64, noise: f64) -> Vec<Picture> {
        let mut random = Noise(3);
        let mut wobble = || libm::exp(noise * (2.0 * random.uniform() - 1.0));
        let mut out = Vec::new();
        for scene in 0..scenes {
            for distance in DISTANCES {
                for step in STEPS {
                    let (s, d) = (f64::from(step), f64::from(distance));
                    out.push(Picture {
                        scene,
                        step,
                        distance,
                        seconds: 0.01 * (1.0 + scene as f64) * truth.time_share(s, d) * wobble(),
                        // The law's error to the power of 1.4, times a factor that differs between scenes.
                        error: (0.02 + 0.01 * scene as f64) * libm::pow(truth.error(s, d), 1.4) * wobble(),
                    });
                }
            }
        }
        out
    }

    #[test]
    fn a_law_is_found_again() {
        let found = fit_quality(&pictures(&TRUTH, 4, 0.0), None).unwrap();
        assert_eq!((found.scenes, found.settings), (4, 20));
        let q = found.quality;
        let near = |own: f32, wanted: f32| (own / wanted - 1.0).abs() < 0.02;
        assert!(near(q.image_weight, 5.0) && near(q.step_exponent, 1.2), "{found:?}");
        assert!(near(q.image_exponent, 0.9) && near(q.ray_share, 0.2), "{found:?}");
        // By the law, only powers of 1.2 are chosen as image sample distances, so the optimum is not reached
        // exactly.
        assert!(found.over_best < 1.05 && found.step_over_best.unwrap() > 1.1, "{found:?}");
    }

    #[test]
    fn renderers_that_differ_are_told_apart_through_noise() {
        let blurred = Quality { image_weight: 60.0, image_exponent: 0.3, ..TRUTH };
        let (sharp, blurred) = (
            fit_quality(&pictures(&TRUTH, 6, 0.1), None).unwrap(),
            fit_quality(&pictures(&blurred, 6, 0.1), None).unwrap(),
        );
        assert!(sharp.over_best < 1.1 && blurred.over_best < 1.1, "{sharp:?} {blurred:?}");
        let alone = [sharp, blurred].map(|found| found.step_over_best.unwrap());
        assert!(alone[1] < 1.05 && alone[0] > 1.1, "{sharp:?} {blurred:?}");
        sharp.quality.check().unwrap();
        blurred.quality.check().unwrap();
    }

    #[test]
    fn scenes_that_lack_a_setting_are_passed_over_and_too_few_are_refused() {
        let mut all = pictures(&TRUTH, 4, 0.0);
        all.pop();
        assert_eq!(fit_quality(&all, None).unwrap().scenes, 3);
        // A scene with an additional setting and a scene without full quality are ignored.
        let mut more = pictures(&TRUTH, 5, 0.0);
        more.push(Picture { step: 6.0, ..more[4] });
        more.retain(|p| p.scene != 1 || p.step > 1.0);
        assert_eq!(fit_quality(&more, None).unwrap().scenes, 3);
        let says = |pictures: &[Picture]| fit_quality(pictures, None).unwrap_err().to_string();
        assert!(says(&[]).contains("no scene was drawn at full quality"));
        assert!(says(&pictures(&TRUTH, 2, 0.0)).contains("at least 3 scenes"));
        let steps: Vec<Picture> = all.iter().copied().filter(|p| p.distance == 1.0).collect();
        assert!(says(&steps).contains("two image sample distances"));
        let fine: Vec<Picture> = all.iter().copied().filter(|p| p.step < 2.0 && p.distance < 1.3).collect();
        assert!(says(&fine).contains("draw coarser steps"));
        for bad in [
            Picture { step: 0.5, ..all[3] },
            Picture { distance: f32::NAN, ..all[3] },
            Picture { seconds: 0.0, ..all[3] },
            Picture { error: -1.0, ..all[3] },
        ] {
            let mut broken = all.clone();
            broken[3] = bad;
            assert!(says(&broken).contains("a picture of scene 0"), "{bad:?}");
        }
    }

    /// Returns scenes whose laws scatter around `truth`, as those of different transfer functions do.
    fn scattered(truth: &Quality, scenes: u64, seed: u64) -> Vec<Picture> {
        let mut random = Noise(seed);
        let mut factor = |most: f64| libm::pow(most, 2.0 * random.uniform() - 1.0) as f32;
        (0..scenes)
            .flat_map(|scene| {
                let own = Quality {
                    image_weight: truth.image_weight * factor(6.0),
                    step_exponent: truth.step_exponent * factor(1.4),
                    image_exponent: truth.image_exponent * factor(1.6),
                    ..*truth
                };
                pictures(&own, 1, 0.0).into_iter().map(move |p| Picture { scene, ..p })
            })
            .collect()
    }

    /// Excess error of a law for pictures by the law `truth`.
    fn excess(law: &Quality, truth: &Quality) -> f64 {
        let grid = Drawn::of(&pictures(truth, 3, 0.0)).unwrap().grid(|_| true);
        libm::exp(grid.regret(law, &grid.best()))
    }

    #[test]
    fn few_scenes_that_mislead_keep_the_prior_law_and_many_replace_it() {
        // The prior is the true law. Four scenes mislead a fit without a prior, and hardly a fit with it.
        let draws: Vec<[f64; 2]> = (0..20)
            .map(|seed| {
                let few = scattered(&TRUTH, 4, seed);
                let [alone, found] = [None, Some(TRUTH)].map(|prior| fit_quality(&few, prior).unwrap());
                assert_eq!(found.quality == TRUTH, found.over_prior.unwrap() >= 1.0, "{seed}: {found:?}");
                [alone, found].map(|found| excess(&found.quality, &TRUTH))
            })
            .collect();
        let most = |of: usize| draws.iter().map(|d| d[of]).fold(1.0, f64::max);
        assert!(most(0) > 1.05 * excess(&TRUTH, &TRUTH), "{draws:?}");
        assert!(most(1) < 1.02 * excess(&TRUTH, &TRUTH), "{draws:?}");

        // The prior is the law of another renderer. A fit to few scenes improves on this prior, and a fit to
        // many scenes finds the true law.
        let other = Quality { image_weight: 0.2, image_exponent: 2.5, ..TRUTH };
        let fitted = |scenes| fit_quality(&scattered(&TRUTH, scenes, 5), Some(other)).unwrap();
        let [few, many] = [fitted(8), fitted(300)];
        let [before, after, end] = [other, few.quality, many.quality].map(|law| excess(&law, &TRUTH));
        assert!(before > 1.2 && after < before, "{before} {after} {few:?}");
        assert!(end < 1.02 * excess(&TRUTH, &TRUTH) && many.over_prior.unwrap() < 0.9, "{end} {many:?}");
    }

    #[test]
    fn equal_pictures_have_a_law_too() {
        let blank: Vec<Picture> =
            pictures(&TRUTH, 3, 0.0).into_iter().map(|p| Picture { error: 0.0, ..p }).collect();
        fit_quality(&blank, None).unwrap().quality.check().unwrap();
    }
}
