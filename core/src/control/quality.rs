//! How far a picture lies from the best one, as a function of ray step and image scale.

use crate::Result;
use crate::error::bail;
use crate::features::Setting;
use alloc::vec::Vec;

/// A picture that was compared with the one at the reference step and full size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QualitySample {
    /// Ray step, reference steps.
    pub step: f32,
    /// Image side over the full side.
    pub scale: f32,
    /// How far it is from the reference picture: 0 for equal, growing (1 − SSIM, for example).
    pub error: f32,
}

/// error = a · (step − 1)^p + b · (1/scale − 1)^q for steps of at least 1 and scales of at most 1; 0 beyond.
///
/// What a coarser step costs and what a smaller image costs are measured apart and added. Among settings that
/// take the same time the one with the smallest error is the one to draw: [`QualityModel::sort`] brings
/// settings into the order that [`super::Session::choose`] wants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QualityModel {
    step: Law,
    scale: Law,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Law {
    factor: f64,
    exponent: f64,
}

impl Law {
    fn at(&self, x: f64) -> f64 {
        if x > 0.0 { self.factor * libm::pow(x, self.exponent) } else { 0.0 }
    }

    /// Least squares in logarithms over the median error at each x.
    fn fit(mut points: Vec<(f64, f64)>) -> Option<Self> {
        points.retain(|p| p.0 > 1.0e-6);
        points.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let mut logs: Vec<(f64, f64)> = Vec::new();
        let mut rest = &points[..];
        while let Some(first) = rest.first() {
            let n = rest.iter().take_while(|p| p.0 < first.0 * 1.01).count();
            logs.push((libm::log(first.0), libm::log(rest[n / 2].1.max(1.0e-6))));
            rest = &rest[n..];
        }
        let n = logs.len() as f64;
        let (sx, sy) = logs.iter().fold((0.0, 0.0), |s, p| (s.0 + p.0, s.1 + p.1));
        let (mx, my) = (sx / n, sy / n);
        let (mut xx, mut xy) = (0.0, 0.0);
        for (x, y) in &logs {
            xx += (x - mx) * (x - mx);
            xy += (x - mx) * (y - my);
        }
        let exponent = if xx > 0.0 { (xy / xx).clamp(0.1, 4.0) } else { 1.0 };
        (n >= 1.0).then(|| Self { factor: libm::exp(my - exponent * mx), exponent })
    }
}

impl Default for QualityModel {
    /// Medians of 1 − SSIM over real volumes, unshaded, 256 × 256 pixels.
    fn default() -> Self {
        Self { step: Law { factor: 0.009, exponent: 0.9 }, scale: Law { factor: 0.05, exponent: 0.8 } }
    }
}

impl QualityModel {
    /// From compared pictures: those at scale 1 tell what the step costs, those at step 1 what the scale
    /// costs.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for numbers that are not finite, steps or scales that are not
    /// positive, a negative error, or when one of the two kinds is missing.
    pub fn from_samples(samples: &[QualitySample]) -> Result<Self> {
        for (i, s) in samples.iter().enumerate() {
            let sound = s.step.is_finite() && s.step > 0.0 && s.scale.is_finite() && s.scale > 0.0;
            if !(sound && s.error.is_finite() && s.error >= 0.0) {
                bail!(
                    InvalidArgument,
                    "quality sample {i} has step {}, scale {} and error {}; step and scale must be positive, \
                     the error not negative",
                    s.step,
                    s.scale,
                    s.error
                );
            }
        }
        let close = |v: f32| libm::fabsf(v - 1.0) < 1.0e-3;
        let of = |keep: &dyn Fn(&QualitySample) -> bool, x: &dyn Fn(&QualitySample) -> f64| {
            Law::fit(samples.iter().filter(|s| keep(s)).map(|s| (x(s), f64::from(s.error))).collect())
        };
        let step = of(&|s| close(s.scale) && s.step > 1.001, &|s| f64::from(s.step) - 1.0);
        let scale = of(&|s| close(s.step) && s.scale < 0.999, &|s| 1.0 / f64::from(s.scale) - 1.0);
        let (Some(step), Some(scale)) = (step, scale) else {
            bail!(
                InvalidArgument,
                "the samples must hold coarser steps at full size as well as smaller images at the reference \
                 step"
            );
        };
        Ok(Self { step, scale })
    }

    /// The predicted error; 0 for the reference step at full size.
    pub fn error(&self, step: f32, scale: f32) -> f32 {
        let scale = f64::from(scale).max(1.0e-3);
        (self.step.at(f64::from(step) - 1.0) + self.scale.at(1.0 / scale - 1.0)) as f32
    }

    /// Puts settings in order, best picture first. `width` is the full image width.
    pub fn sort(&self, settings: &mut [Setting], width: u32) {
        let error = |s: &Setting| self.error(s.step, s.width as f32 / width.max(1) as f32);
        settings.sort_unstable_by(|a, b| error(a).total_cmp(&error(b)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(step: f32, scale: f32, error: f32) -> QualitySample {
        QualitySample { step, scale, error }
    }

    #[test]
    fn power_laws_are_found_again_and_errors_grow() {
        let mut samples = Vec::new();
        for k in 1..6 {
            let s = 1.0 + 1.6f32.powi(k);
            for wild in [1.0, 1.0, 9.0] {
                samples.push(sample(s, 1.0, wild * 0.01 * (s - 1.0).powf(0.7)));
            }
            let c = 1.0 / (1.0 + 0.2 * k as f32);
            samples.push(sample(1.0, c, 0.05 * (1.0 / c - 1.0)));
        }
        let q = QualityModel::from_samples(&samples).unwrap();
        assert!((q.error(3.0, 1.0) / (0.01 * 2f32.powf(0.7)) - 1.0).abs() < 0.01);
        assert!((q.error(1.0, 0.5) / 0.05 - 1.0).abs() < 0.02);
        assert_eq!(q.error(1.0, 1.0), 0.0);
        assert_eq!(q.error(0.5, 2.0), 0.0);
        let both = q.error(3.0, 0.5);
        assert!((both - q.error(3.0, 1.0) - q.error(1.0, 0.5)).abs() < 1e-6);
    }

    #[test]
    fn broken_or_missing_samples_are_refused() {
        let good = [sample(2.0, 1.0, 0.1), sample(1.0, 0.5, 0.1)];
        assert!(QualityModel::from_samples(&good).is_ok());
        for bad in [
            sample(0.0, 1.0, 0.1),
            sample(2.0, f32::NAN, 0.1),
            sample(2.0, 1.0, -0.1),
            sample(2.0, -1.0, 0.1),
        ] {
            assert!(QualityModel::from_samples(&[good[0], good[1], bad]).is_err());
        }
        assert!(QualityModel::from_samples(&good[..1]).is_err());
        assert!(QualityModel::from_samples(&good[1..]).is_err());
        assert!(QualityModel::from_samples(&[]).is_err());
    }
}
