//! Random scenes for timing collections (paper, section "Data collection"): cameras on hemispheres of several
//! radii, random Gaussian transfer functions, random image sizes of which half are square.

use anyhow::{Result, ensure};
use entire_core::scene::{Arcball, GaussianLobe, MAX_IMAGE_SIDE};
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use serde::{Deserialize, Serialize};

/// Distribution of random scenes. All draws are independent.
///
/// * Distance of the eye: one of `radii` (bounding-sphere radii), each equally likely.
/// * Direction of the eye: uniform over the area of the upper hemisphere. The azimuth is uniform in
///   [−180°, 180°), the sine of the elevation in [0, 1).
/// * Image size: sides log-uniform in `[min_size, max_size]`; half of the images are square.
/// * Lobes: a number uniform in `lobes`; center uniform in [0, 1); width w log-uniform in [0.0005, 0.05]
///   (at a distance of √w, 0.022 to 0.22, a lobe has fallen to 1/e); height log-uniform in [0.005, 1].
/// * Ray step: one of `steps` (reference steps), each equally likely.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct SceneDistribution {
    /// Radii of the hemispheres, bounding-sphere radii.
    pub radii: Vec<f32>,
    /// Smallest and largest number of lobes of a transfer function.
    pub lobes: (u32, u32),
    /// Shortest image side, pixels.
    pub min_size: u32,
    /// Longest image side, pixels.
    pub max_size: u32,
    /// Ray steps, reference steps.
    pub steps: Vec<f32>,
}

/// Default radii of the hemispheres.
const DEFAULT_RADII: [f32; 6] = [1.2, 1.5, 2.0, 2.5, 3.0, 4.0];
const WIDTHS: (f64, f64) = (5e-4, 5e-2);
const HEIGHTS: (f64, f64) = (5e-3, 1.0);

impl Default for SceneDistribution {
    fn default() -> Self {
        Self { radii: DEFAULT_RADII.to_vec(), lobes: (3, 3), min_size: 32, max_size: 1024, steps: vec![1.0] }
    }
}

/// A random scene.
#[derive(Clone, Debug, PartialEq)]
pub struct RandomScene {
    /// Position of the eye.
    pub camera: Arcball,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Ray step, reference steps.
    pub step: f32,
    /// The transfer function's lobes.
    pub lobes: Vec<GaussianLobe>,
}

impl SceneDistribution {
    /// Checks the ranges.
    ///
    /// # Errors
    /// When a value is invalid; the error names it and the accepted values.
    pub fn check(&self) -> Result<()> {
        ensure!(
            !self.radii.is_empty() && self.radii.iter().all(|r| r.is_finite() && *r > 0.0),
            "radii are {:?}; give at least one positive number of bounding-sphere radii",
            self.radii
        );
        ensure!(
            self.lobes.0 >= 1 && self.lobes.0 <= self.lobes.1 && self.lobes.1 <= 64,
            "{} to {} lobes were asked for; 1 to 64 are accepted, the lower number first",
            self.lobes.0,
            self.lobes.1
        );
        ensure!(
            self.min_size >= 1 && self.min_size <= self.max_size && self.max_size <= MAX_IMAGE_SIDE,
            "image sides of {} to {} pixels were asked for; 1 to {MAX_IMAGE_SIDE} are accepted, the smaller \
             first",
            self.min_size,
            self.max_size
        );
        ensure!(
            !self.steps.is_empty() && self.steps.iter().all(|s| (1.0 / 64.0..=4096.0).contains(s)),
            "ray steps are {:?}; give at least one, each in [0.015625, 4096] reference steps",
            self.steps
        );
        Ok(())
    }

    /// Returns scene `index` of the volume named `volume` under `seed`, independent of other volumes and
    /// scenes.
    pub fn draw(&self, seed: u64, volume: &str, index: u64) -> RandomScene {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ crate::files::fnv1a(volume.as_bytes()));
        rng.set_stream(index);
        let mut unit = || (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
        let dz = *pick(&self.radii, unit());
        let rx = libm::asin(unit()).to_degrees() as f32;
        let ry = (unit() * 360.0 - 180.0) as f32;
        let square = unit() < 0.5;
        let mut side = || {
            // A log-uniform number in [min, max + 1), rounded down.
            let size = log_uniform((f64::from(self.min_size), f64::from(self.max_size) + 1.0), unit());
            (size as u32).clamp(self.min_size, self.max_size)
        };
        let (width, other) = (side(), side());
        let height = if square { width } else { other };
        let step = *pick(&self.steps, unit());
        let (least, most) = self.lobes;
        let count = least + (unit() * f64::from(most - least + 1)) as u32;
        let lobes = (0..count)
            .map(|_| GaussianLobe {
                center: unit() as f32,
                width: log_uniform(WIDTHS, unit()) as f32,
                height: log_uniform(HEIGHTS, unit()) as f32,
            })
            .collect();
        RandomScene { camera: Arcball { rx, ry, dz }, width, height, step, lobes }
    }
}

fn pick<T>(items: &[T], unit: f64) -> &T {
    &items[((unit * items.len() as f64) as usize).min(items.len() - 1)]
}

fn log_uniform((low, high): (f64, f64), unit: f64) -> f64 {
    low * libm::pow(high / low, unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn many(d: &SceneDistribution) -> Vec<RandomScene> {
        (0..4000).map(|i| d.draw(7, "v.nrrd", i)).collect()
    }

    #[test]
    fn a_scene_depends_on_seed_volume_and_index_alone() {
        let d = SceneDistribution::default();
        assert_eq!(d.draw(7, "a", 3), d.draw(7, "a", 3));
        for other in [d.draw(8, "a", 3), d.draw(7, "b", 3), d.draw(7, "a", 4)] {
            assert_ne!(d.draw(7, "a", 3), other);
        }
        // The expected values are exact: a seed gives the same frames on every machine and in every version.
        let s = d.draw(1, "volume.nrrd", 0);
        assert_eq!(s.camera, Arcball { rx: 1.6128389, ry: 32.929604, dz: 3.0 });
        assert_eq!((s.width, s.height, s.step), (36, 312, 1.0));
        assert_eq!(
            crate::dataset::format_lobes(&s.lobes),
            "0.3575599 0.0110967215 0.017436543;0.91632026 0.0006550259 0.5698056;0.05813787 0.010394635 \
             0.07989768"
        );
    }

    #[test]
    fn draws_follow_the_stated_distributions() {
        let d = SceneDistribution { lobes: (2, 4), steps: vec![0.5, 1.0, 2.0], ..Default::default() };
        let scenes = many(&d);
        let n = scenes.len() as f64;
        let share = |f: &dyn Fn(&RandomScene) -> bool| scenes.iter().filter(|s| f(s)).count() as f64 / n;
        for r in DEFAULT_RADII {
            assert!((share(&|s| s.camera.dz == r) - 1.0 / 6.0).abs() < 0.03);
        }
        assert!(scenes.iter().all(|s| (0.0..=90.0).contains(&s.camera.rx)));
        // Half of a hemisphere's area lies below 30 degrees.
        assert!((share(&|s| s.camera.rx < 30.0) - 0.5).abs() < 0.03);
        assert!((share(&|s| s.camera.ry < -90.0) - 0.25).abs() < 0.03);
        assert!((share(&|s| s.width == s.height) - 0.5).abs() < 0.04);
        // Log-uniform between 32 and 1024: half below 181.
        assert!((share(&|s| s.width < 181) - 0.5).abs() < 0.03);
        assert!(scenes.iter().all(|s| (32..=1024).contains(&s.width) && (32..=1024).contains(&s.height)));
        for count in 2..=4 {
            assert!((share(&|s| s.lobes.len() == count) - 1.0 / 3.0).abs() < 0.04);
        }
        for lobe in scenes.iter().flat_map(|s| &s.lobes) {
            assert!((0.0..=1.0).contains(&lobe.center));
            assert!((5e-4..=0.0501).contains(&lobe.width) && (5e-3..=1.001).contains(&lobe.height));
        }
        assert!((share(&|s| s.step == 2.0) - 1.0 / 3.0).abs() < 0.03);
    }

    #[test]
    fn one_size_and_one_pixel_are_possible() {
        let d = SceneDistribution { min_size: 1, max_size: 1, ..Default::default() };
        d.check().unwrap();
        assert!(many(&d).iter().all(|s| s.width == 1 && s.height == 1));
        let d = SceneDistribution { min_size: 64, max_size: 64, ..Default::default() };
        assert!(many(&d).iter().all(|s| s.width == 64 && s.height == 64));
    }

    #[test]
    fn wrong_ranges_are_named() {
        let with = |f: &dyn Fn(&mut SceneDistribution)| {
            let mut d = SceneDistribution::default();
            f(&mut d);
            d.check().unwrap_err().to_string()
        };
        assert!(with(&|d| d.radii = vec![]).contains("radii"));
        assert!(with(&|d| d.radii = vec![0.0]).contains("radii"));
        assert!(with(&|d| d.radii = vec![f32::NAN]).contains("radii"));
        assert!(with(&|d| d.lobes = (0, 3)).contains("lobes"));
        assert!(with(&|d| d.lobes = (4, 2)).contains("lobes"));
        assert!(with(&|d| d.min_size = 0).contains("image sides"));
        assert!(with(&|d| d.min_size = 2000).contains("image sides"));
        assert!(with(&|d| d.max_size = MAX_IMAGE_SIDE + 1).contains("image sides"));
        assert!(with(&|d| d.steps = vec![]).contains("ray steps"));
        assert!(with(&|d| d.steps = vec![0.0]).contains("ray steps"));
    }
}
