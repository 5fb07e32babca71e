//! Picture quality law: the error caused by coarser steps and by smaller images, as stored in a model file.

use alloc::borrow::ToOwned;
use alloc::string::{String, ToString};
use entire_core::Result;
use entire_core::bail;
use entire_core::model::{Key, Model, ModelFile};
use serde::{Deserialize, Serialize};

/// Picture error and time of a renderer as functions of ray step and image size. Among combinations of step
/// and image size that take the same time, a plan uses the one with the smallest error.
///
/// Let s be the step divided by the finest step, and d the distance of neighboring rays along each side, in
/// pixels. By the law, the error is E = (s − 1)^`step_exponent` + `image_weight` · (d − 1)^`image_exponent`.
/// The measured error of a picture against full quality, in any unit, is assumed to be proportional to a
/// power of E, and plans need neither the factor nor the exponent. The picture's time is proportional to
/// (`ray_share` + (1 − `ray_share`) / s) / d². [`crate::calibrate::fit_quality`] fits the law to compared
/// pictures.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Ratio of the error of an image of half the size along each side (d = 2) to the error of a step twice
    /// as coarse (s = 2).
    pub image_weight: f32,
    /// Exponent of the error caused by the step.
    pub step_exponent: f32,
    /// Exponent of the error caused by the image size; near 0 if all smaller images are similarly blurred.
    pub image_exponent: f32,
    /// Share of the time at full quality that depends on the number of rays and not on their samples.
    pub ray_share: f32,
}

/// Ratio of successive image sample distances. A smaller ratio gives more image sizes, each of which needs
/// new buffers. A larger ratio gives larger jumps of the step where the size changes (here by a factor of
/// 1.2² = 1.44). The value is a compromise, not tuned on recorded paths.
pub(crate) const DISTANCE_RATIO: f64 = 1.2;

/// Name, smallest and largest value of each parameter.
const BOUNDS: [(&str, f32, f32); 4] = [
    ("image weight", 1.0e-3, 1.0e3),
    ("step exponent", 0.05, 8.0),
    ("image exponent", 0.05, 8.0),
    ("share of rays", 0.0, 0.9),
];

/// Names of renderers, and the laws of their pictures. `entire calibrate` fitted the raycaster's law to
/// unshaded pictures of the volumes in data/, and lab/scripts/vtk/tradeoff.py those of the mappers of VTK
/// 9.1.
const BUILT_IN: [(&str, [f32; 4]); 4] = [
    ("vulkan", RAYCASTER),
    ("cpu", RAYCASTER),
    ("vtkFixedPointVolumeRayCastMapper", [5.9, 0.97, 1.54, 0.33]),
    ("vtkOpenGLGPUVolumeRayCastMapper", [8.5, 1.22, 0.78, 0.15]),
];

/// Numbers of the raycaster's law.
const RAYCASTER: [f32; 4] = [0.64, 1.45, 0.56, 0.57];

impl Quality {
    /// The law of the renderer of this name, the same on every machine: `vulkan` and `cpu` name the
    /// raycaster, and the other renderers are VTK's mappers, by the names of their classes. `None` for other
    /// names.
    #[must_use]
    pub fn built_in(renderer: &str) -> Option<Self> {
        let (_, numbers) = BUILT_IN.into_iter().find(|(name, _)| *name == renderer)?;
        let [image_weight, step_exponent, image_exponent, ray_share] = numbers;
        Some(Self { image_weight, step_exponent, image_exponent, ray_share })
    }

    fn numbers(&self) -> [f32; 4] {
        [self.image_weight, self.step_exponent, self.image_exponent, self.ray_share]
    }

    /// Returns a law from values in the order of the fields, each clamped to the bounds of
    /// [`Quality::check`].
    #[cfg(feature = "calibrate")]
    pub(crate) fn within(numbers: [f64; 4]) -> Self {
        let [image_weight, step_exponent, image_exponent, ray_share] = core::array::from_fn(|i| {
            let (_, low, high) = BOUNDS[i];
            (numbers[i] as f32).clamp(low, high)
        });
        Self { image_weight, step_exponent, image_exponent, ray_share }
    }

    /// Checks the parameters.
    ///
    /// # Errors
    /// As [`crate::Session::set_quality`].
    pub(crate) fn check(&self) -> Result<()> {
        for ((what, low, high), v) in BOUNDS.into_iter().zip(self.numbers()) {
            if !(low..=high).contains(&v) {
                bail!(
                    InvalidArgument,
                    "the {what} of the picture quality law is {v}; it must be {low} to {high}"
                );
            }
        }
        Ok(())
    }

    /// Returns the error by the law at a step, in finest steps, and an image sample distance, in pixels. The
    /// unit is the error at step 2 and distance 1.
    pub fn error(&self, step: f64, distance: f64) -> f64 {
        let power = |x: f64, exponent: f32| if x > 0.0 { libm::pow(x, f64::from(exponent)) } else { 0.0 };
        power(step - 1.0, self.step_exponent)
            + f64::from(self.image_weight) * power(distance - 1.0, self.image_exponent)
    }

    /// Returns the picture's time, as a share of the time at full quality.
    pub(crate) fn time_share(&self, step: f64, distance: f64) -> f64 {
        let rays = f64::from(self.ray_share);
        (rays + (1.0 - rays) / step) / (distance * distance)
    }

    /// Returns the step at which an image takes the given share of the time at full quality; `None` if this
    /// step would be below 1 or does not exist.
    pub(crate) fn step_for(&self, share: f64, distance: f64) -> Option<f64> {
        let rays = f64::from(self.ray_share);
        let left = share * distance * distance - rays;
        (left > 0.0 && left <= 1.0 - rays).then(|| (1.0 - rays) / left)
    }

    /// Computes the thresholds between image sample distances. `distances` ascends from 1. For each further
    /// distance, `from` receives the smallest value of step · distance² at which this distance has a smaller
    /// error than all smaller distances at equal time; infinity if there is no such value.
    pub(crate) fn lay(&self, distances: &[f64], from: &mut [f64]) {
        /// Ratio of successive frame times that are tried.
        const TIME_RATIO: f64 = 0.97;
        /// Number of frame times that are tried.
        const TIMES: usize = 400;
        from[1..].fill(f64::INFINITY);
        let (mut taken, mut share) = (0, 1.0);
        for _ in 0..TIMES {
            let mut best = (taken, f64::INFINITY, 0.0);
            for (level, &distance) in distances.iter().enumerate().skip(taken) {
                // At the finest step, an image may take less than the available time and nevertheless have
                // the smallest error.
                let finest = (self.time_share(1.0, distance) <= share).then_some(1.0);
                if let Some(step) = self.step_for(share, distance).or(finest) {
                    let error = self.error(step, distance);
                    if error < best.1 {
                        best = (level, error, step * distance * distance);
                    }
                }
            }
            if best.0 > taken {
                // At this time, `taken` and the best distance have different values of step · distance².
                // The threshold is their geometric mean. If the value of the best distance is the smaller
                // one, or no step of `taken` takes this time, the threshold is the value of the best
                // distance. A threshold is never below the previous one.
                let square = distances[taken] * distances[taken];
                let before = self.step_for(share, distances[taken]).map_or(best.2, |s| s * square);
                let at = libm::sqrt(before.min(best.2) * best.2).max(from[taken]);
                from[taken + 1..=best.0].fill(at);
                taken = best.0;
            }
            share *= TIME_RATIO;
        }
    }

    /// Returns the law in a model file, under [`Key::Quality`]; `None` if the file has none.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidModel`] unless the entry is a JSON object with the four parameters within
    /// their bounds.
    pub(crate) fn of(model: &Model) -> Result<Option<Self>> {
        let Some(text) = model.metadata.get(Key::Quality.name()) else { return Ok(None) };
        let quality: Self = match serde_json::from_str(text) {
            Ok(quality) => quality,
            Err(e) => bail!(InvalidModel, "{} is not a quality law of four numbers: {e}", Key::Quality),
        };
        if let Err(e) = quality.check() {
            bail!(InvalidModel, "{}: {e}", Key::Quality);
        }
        Ok(Some(quality))
    }

    /// Stores the law in a model file.
    ///
    /// # Errors
    /// As [`crate::Session::set_quality`].
    pub(crate) fn store(&self, file: &mut ModelFile) -> Result<()> {
        self.check()?;
        file.metadata.insert(Key::Quality.into(), serde_json::json!(self).to_string());
        Ok(())
    }
}

/// A model's [`Quality`] and the renderer with which it was measured.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct KnownQuality {
    quality: Quality,
    renderer: String,
}

impl KnownQuality {
    pub(super) fn of(model: &Model) -> Result<Option<Self>> {
        let renderer = model.metadata.get(Key::Renderer.name()).map_or("", String::as_str).to_owned();
        Ok(Quality::of(model)?.map(|quality| Self { quality, renderer }))
    }

    /// Returns the law if it was measured with the renderer of this name; an empty name matches any renderer.
    pub(super) fn holds_for(known: Option<&Self>, renderer: &str) -> Option<Quality> {
        known.filter(|k| renderer.is_empty() || renderer == k.renderer).map(|k| k.quality)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::predict::AnalyticModel;
    use crate::predict::Predictor;
    use crate::predict::network::ModelPredictor;
    use entire_core::ErrorKind;

    const LAW: Quality =
        Quality { image_weight: 4.0, step_exponent: 1.3, image_exponent: 0.8, ray_share: 0.25 };

    #[test]
    fn the_law_has_its_closed_form() {
        assert_eq!(LAW.error(1.0, 1.0), 0.0);
        assert!((LAW.error(2.0, 1.0) - 1.0).abs() < 1e-12 && (LAW.error(1.0, 2.0) - 4.0).abs() < 1e-12);
        assert!((LAW.time_share(3.0, 1.0) - 0.5).abs() < 1e-12);
        assert!((LAW.time_share(3.0, 2.0) - 0.125).abs() < 1e-12);
        let step = LAW.step_for(0.125, 2.0).unwrap();
        assert!((step - 3.0).abs() < 1e-12);
        assert_eq!(LAW.step_for(0.1, 1.0), None);
    }

    #[test]
    fn files_keep_it_and_it_holds_for_their_renderer() {
        let mut file = AnalyticModel::default().to_model_file().unwrap();
        let holds = |file: &ModelFile, renderer: &str| {
            ModelPredictor::new(&file.to_model().unwrap()).unwrap().quality(renderer)
        };
        assert_eq!(holds(&file, ""), None);
        LAW.store(&mut file).unwrap();
        file.metadata.insert(Key::Renderer.into(), "mine".into());
        assert_eq!(Quality::of(&file.to_model().unwrap()).unwrap(), Some(LAW));
        assert_eq!(
            [holds(&file, ""), holds(&file, "mine"), holds(&file, "other")],
            [Some(LAW), Some(LAW), None]
        );
        assert!(Quality { ray_share: 1.0, ..LAW }.store(&mut file).is_err());
        for bad in [
            "{",
            "{}",
            r#"{"image_weight":0.0,"step_exponent":1.0,"image_exponent":1.0,"ray_share":0.0}"#,
            r#"{"image_weight":1.0,"step_exponent":1.0,"image_exponent":1.0,"ray_share":1e40}"#,
        ] {
            file.metadata.insert(Key::Quality.into(), bad.into());
            let error = ModelPredictor::new(&file.to_model().unwrap()).unwrap_err();
            assert_eq!(error.kind(), ErrorKind::InvalidModel);
            assert!(error.to_string().contains("entire.quality"), "{error}");
        }
    }
}
