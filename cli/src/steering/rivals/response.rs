//! G: relative frame time as a function of relative ray step (paper, Algorithm 1 and supplement to use case
//! 1).

use crate::steering::model::Sample;
use anyhow::{Result, ensure};

/// The curve G(step / reference step) = time / time at the reference step: measured, made monotone,
/// interpolated linearly in logarithms.
#[derive(Clone, Debug, PartialEq)]
pub struct StepResponse {
    /// ln(step ratio), ascending, and ln(time ratio), which never rises.
    points: Vec<(f64, f64)>,
}

impl StepResponse {
    /// Fits the curve to measured (step ratio, time ratio) pairs of any number of scenes, in any order: it
    /// takes the median time ratio at each step ratio, then the nearest curve that never rises (pool adjacent
    /// violators). A point (1, 1) is added unless step ratio 1 was measured.
    ///
    /// # Errors
    /// For values that are not finite and positive, or when there are fewer than two different steps.
    pub fn from_samples(samples: &[(f32, f32)]) -> Result<Self> {
        let mut logs: Vec<(f64, f64)> = Vec::with_capacity(samples.len() + 1);
        for (i, &(step, time)) in samples.iter().enumerate() {
            ensure!(
                step.is_finite() && step > 0.0 && time.is_finite() && time > 0.0,
                "sample {i} of the response curve G is ({step}, {time}); step ratio and time ratio must be \
                 finite and positive"
            );
            logs.push((libm::log(f64::from(step)), libm::log(f64::from(time))));
        }
        if !logs.iter().any(|p| libm::fabs(p.0) < 1.0e-6) {
            logs.push((0.0, 0.0));
        }
        logs.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        // Median per step, with the number of samples as weight.
        let mut blocks: Vec<(f64, f64, f64)> = Vec::new();
        let mut rest = &logs[..];
        while let Some(first) = rest.first() {
            let n = rest.iter().take_while(|p| p.0 - first.0 < 1.0e-6).count();
            let median = 0.5 * (rest[(n - 1) / 2].1 + rest[n / 2].1);
            blocks.push((first.0, median, n as f64));
            rest = &rest[n..];
        }
        ensure!(
            blocks.len() >= 2,
            "the response curve G needs scenes that were timed at the reference step and at another ray \
             step; add such frames"
        );
        // Pool adjacent violators: (sum of weighted values, weight, number of points).
        let mut pools: Vec<(f64, f64, usize)> = Vec::new();
        for &(_, y, w) in &blocks {
            pools.push((y * w, w, 1));
            while let [.., a, b] = pools[..] {
                if a.0 / a.1 >= b.0 / b.1 {
                    break;
                }
                pools.pop();
                pools.pop();
                pools.push((a.0 + b.0, a.1 + b.1, a.2 + b.2));
            }
        }
        let mut points = Vec::with_capacity(blocks.len());
        let mut at = 0;
        for (sum, weight, n) in pools {
            for block in &blocks[at..at + n] {
                points.push((block.0, sum / weight));
            }
            at += n;
        }
        Ok(Self { points })
    }

    /// Returns the curve of a renderer whose time has a fixed share and a share that falls as 1 / step,
    /// sampled at steps from 1/4 to 32 times the reference step. It replaces G where G is not measured. The
    /// fixed share is clamped to 0…0.99.
    pub fn inverse_step(fixed_share: f32) -> Self {
        let fixed = if fixed_share.is_finite() { f64::from(fixed_share).clamp(0.0, 0.99) } else { 0.0 };
        let points = (-4..=10)
            .map(|i| {
                let step = libm::exp2(0.5 * f64::from(i));
                (libm::log(step), libm::log(fixed + (1.0 - fixed) / step))
            })
            .collect();
        Self { points }
    }

    /// Returns G, the time ratio at a step ratio. Beyond the sampled steps, G is constant.
    pub fn time_ratio(&self, step_ratio: f32) -> f32 {
        let x = libm::log(f64::from(step_ratio).max(1.0e-30));
        let upper = self.points.partition_point(|p| p.0 < x);
        if upper == 0 {
            return libm::exp(self.points[0].1) as f32;
        }
        if upper == self.points.len() {
            return libm::exp(self.points[upper - 1].1) as f32;
        }
        let ((x0, y0), (x1, y1)) = (self.points[upper - 1], self.points[upper]);
        libm::exp(y0 + (y1 - y0) * (x - x0) / (x1 - x0)) as f32
    }

    /// Returns G⁻¹, the finest step ratio whose time ratio is at most the given one. Returns the finest
    /// sampled ratio if all sampled ratios meet this condition, the coarsest if none does.
    pub fn step_ratio(&self, time_ratio: f32) -> f32 {
        let y = libm::log(f64::from(time_ratio).max(1.0e-30));
        let upper = self.points.partition_point(|p| p.1 > y);
        if upper == 0 {
            return libm::exp(self.points[0].0) as f32;
        }
        if upper == self.points.len() || time_ratio.is_nan() {
            return libm::exp(self.points[self.points.len() - 1].0) as f32;
        }
        let ((x0, y0), (x1, y1)) = (self.points[upper - 1], self.points[upper]);
        let exact = libm::exp(x0 + (x1 - x0) * (y - y0) / (y1 - y0));
        let rounded = exact as f32;
        // The step is rounded up: if two sampled steps differ by a millionth only, the curve between them is
        // so steep that the time at a step rounded down would clearly be too long.
        if f64::from(rounded) < exact { f32::from_bits(rounded.to_bits() + 1) } else { rounded }
    }

    /// Returns the curve's points as (step ratio, time ratio), ascending in step.
    pub fn points(&self) -> impl Iterator<Item = (f32, f32)> + '_ {
        self.points.iter().map(|p| (libm::exp(p.0) as f32, libm::exp(p.1) as f32))
    }
}

/// Returns G, a curve over the ray step, from random scenes: the time of each scene at every step is divided
/// by its time at the reference step.
///
/// # Errors
/// When no scene was timed at two steps.
pub fn response(samples: &[Sample]) -> Result<StepResponse> {
    StepResponse::from_samples(&response_pairs(samples))
}

/// Returns the (step, time ratio) pairs that [`response`] uses, scene after scene.
pub(crate) fn response_pairs(samples: &[Sample]) -> Vec<(f32, f32)> {
    samples
        .iter()
        .filter_map(|s| {
            let reference = samples.iter().find(|r| r.scene == s.scene && r.setting.step == 1.0)?;
            let ratio = s.seconds / reference.seconds;
            (ratio.is_finite() && ratio > 0.0).then_some((s.setting.step, ratio as f32))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn power_laws_are_exact_between_samples() {
        let g = StepResponse::from_samples(&[(2.0, 0.5), (8.0, 0.125), (4.0, 0.25)]).unwrap();
        for step in [1.0f32, 1.5, 3.0, 7.9] {
            assert!((g.time_ratio(step) * step - 1.0).abs() < 1e-5);
            assert!((g.step_ratio(1.0 / step) / step - 1.0).abs() < 1e-5);
        }
        assert_eq!((g.time_ratio(0.1), g.time_ratio(100.0)), (1.0, 0.125));
        assert!((g.step_ratio(5.0) - 1.0).abs() < 1e-6 && (g.step_ratio(0.01) - 8.0).abs() < 1e-5);
    }

    #[test]
    fn medians_ignore_a_wild_scene_and_violations_are_pooled() {
        let g = StepResponse::from_samples(&[(2.0, 0.5), (2.0, 0.5), (2.0, 9.0), (4.0, 0.6), (4.0, 0.6)])
            .unwrap();
        assert!(g.time_ratio(2.0) <= 0.6 && g.time_ratio(2.0) >= 0.5);
        assert_eq!(g.time_ratio(2.0), g.time_ratio(4.0));
    }

    #[test]
    fn broken_samples_are_refused() {
        for bad in [(0.0, 1.0), (1.0, -1.0), (f32::NAN, 1.0), (2.0, f32::INFINITY)] {
            assert!(StepResponse::from_samples(&[(2.0, 0.5), bad]).is_err());
        }
        assert!(StepResponse::from_samples(&[]).is_err());
        assert!(StepResponse::from_samples(&[(1.0, 1.0)]).is_err());
    }

    /// Checks the inverse on a very steep curve: between steps that differ in their sixth digit, rounding the
    /// step changes the time noticeably.
    #[test]
    fn the_inverse_fits_on_a_cliff() {
        let cliff = [(1.425_012, 3.0), (1.425_014_5, 0.01), (4.0, 0.01)];
        let g = StepResponse::from_samples(&cliff).unwrap();
        for i in 1..300 {
            let t = 0.01 * i as f32;
            assert!(g.time_ratio(g.step_ratio(t)) <= t * 1.0001, "{t}");
        }
    }

    proptest! {
        #[test]
        fn never_rises_and_the_inverse_fits(
            samples in prop::collection::vec((0.1f32..32.0, 0.01f32..3.0), 2..30),
            t in 0.01f32..3.0,
        ) {
            let g = StepResponse::from_samples(&samples).unwrap();
            let mut last = f32::INFINITY;
            for i in 0..200 {
                let y = g.time_ratio(0.05 * libm::powf(1.04, i as f32));
                prop_assert!(y <= last * 1.00001);
                last = y;
            }
            let step = g.step_ratio(t);
            let reached = g.time_ratio(step);
            let coarsest = g.points().last().unwrap();
            prop_assert!(reached <= t * 1.0001 || (step - coarsest.0).abs() <= 1e-4 * coarsest.0);
        }
    }
}
