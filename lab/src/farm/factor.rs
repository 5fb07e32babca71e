//! A factor on predicted times, learned from measured frames of one transfer function: the residual of the
//! analytic model.
//!
//! The analytic model multiplies counts of work by constant unit costs. The real unit costs depend on the
//! direction in which rays cross the voxels in memory, and on the spacing of the rays. By ridge regression,
//! ln(measured / predicted) is fitted to the view direction, the spacing of rays, their divergence and
//! further terms of a frame. The fit needs frames similar to the predicted frames, so it is used for farms,
//! not for steering.

#![allow(clippy::needless_range_loop, reason = "loops over the terms read several arrays at once")]

use entire_cli::steering::calibrate::Sample;
use entire_core::scene::{Arcball, Camera};
use entire_steer::features::{FrameFeatures, SceneQuantity, Setting};
use entire_steer::numeric::solve;

/// Number of terms of a frame, without their squares.
const TERMS: usize = 10;
/// Weight of the ridge penalty, as a number of frames.
const RIDGE: f64 = 10.0;
/// Limit of the absolute value of ln(factor).
const LIMIT: f64 = 0.5;

/// Returns the terms of a frame: absolute components of the view direction along the volume's axes; two
/// products of these components; logarithms of ray spacing, samples per ray, share of the image that the
/// volume covers, and ray step; divergence of neighboring rays. `None` if the camera is invalid or a term is
/// not finite.
fn terms(features: &FrameFeatures, setting: &Setting, camera: Arcball) -> Option<[f64; TERMS]> {
    let of = features.quantities(*setting);
    let log = |v: f64| v.max(1e-3).ln();
    let (_, [forward, ..]) = Camera::from_arcball(camera).ok()?.ray_basis(setting.width, setting.height);
    let [x, y, z] = forward.to_array().map(|v| f64::from(v.abs()));
    let out = [
        x,
        y,
        z,
        x * y,
        y * z,
        log(of(SceneQuantity::RaySpacing)),
        log(of(SceneQuantity::Samples) / of(SceneQuantity::Rays).max(1.0)),
        of(SceneQuantity::Divergence),
        log(of(SceneQuantity::FootprintShare)),
        log(of(SceneQuantity::Step)),
    ];
    out.iter().all(|v| v.is_finite()).then_some(out)
}

/// The fitted factor.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Factor {
    mean: [f64; TERMS],
    sd: [f64; TERMS],
    /// Weights of the standardized terms, then of their squares minus one.
    weights: [f64; 2 * TERMS],
    offset: f64,
}

impl Factor {
    /// Returns the factor that is 1 for every frame.
    pub(crate) fn none() -> Self {
        Self { mean: [0.0; TERMS], sd: [1.0; TERMS], weights: [0.0; 2 * TERMS], offset: 0.0 }
    }

    /// Fits the factor to frames with their predicted seconds. The factor is 1 if there are fewer than three
    /// usable frames per weight.
    pub(crate) fn fit(frames: &[(&Sample, f64)]) -> Self {
        let rows: Vec<([f64; TERMS], f64)> = frames
            .iter()
            .filter_map(|(s, predicted)| {
                let error = (s.seconds / predicted).ln();
                Some((terms(&s.features, &s.setting, s.camera)?, error)).filter(|_| error.is_finite())
            })
            .collect();
        let n = rows.len() as f64;
        if rows.len() < 6 * TERMS {
            return Self::none();
        }
        let mut out = Self::none();
        for k in 0..TERMS {
            out.mean[k] = rows.iter().map(|r| r.0[k]).sum::<f64>() / n;
            let variance = rows.iter().map(|r| (r.0[k] - out.mean[k]).powi(2)).sum::<f64>() / n;
            // A constant term carries no information: its standardized value is 0.
            out.sd[k] = if variance > 1e-12 { variance.sqrt() } else { f64::INFINITY };
        }
        out.offset = rows.iter().map(|r| r.1).sum::<f64>() / n;
        const N: usize = 2 * TERMS;
        let (mut gram, mut right) = (vec![0.0; N * N], vec![0.0; N]);
        for (values, error) in &rows {
            let row = out.row(values);
            for i in 0..N {
                right[i] += row[i] * (error - out.offset);
                for j in 0..N {
                    gram[i * N + j] += row[i] * row[j];
                }
            }
        }
        for i in 0..N {
            gram[i * N + i] += RIDGE;
        }
        match solve(&mut gram, right) {
            Some(weights) => out.weights.copy_from_slice(&weights),
            None => return Self::none(),
        }
        out
    }

    fn row(&self, values: &[f64; TERMS]) -> [f64; 2 * TERMS] {
        let mut row = [0.0; 2 * TERMS];
        for k in 0..TERMS {
            // A term is clamped to 2.5 standard deviations around its mean in the training frames.
            let z = ((values[k] - self.mean[k]) / self.sd[k]).clamp(-2.5, 2.5);
            row[k] = z;
            row[TERMS + k] = z * z - 1.0;
        }
        row
    }

    /// Returns the factor on the predicted time of a frame.
    pub(crate) fn of(&self, features: &FrameFeatures, setting: &Setting, camera: Arcball) -> f64 {
        let Some(values) = terms(features, setting, camera) else { return self.offset.exp() };
        let log: f64 = self.row(&values).iter().zip(&self.weights).map(|(a, b)| a * b).sum();
        (self.offset + log).clamp(-LIMIT, LIMIT).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::scene::{Frame, GaussianLobe, Scalars, TransferFunction, VolumeView};
    use entire_steer::features::{TransferSummary, VolumeSummary};

    fn samples(law: impl Fn(f64, f64) -> f64) -> Vec<Sample> {
        let voxels: Vec<u8> = (0..24 * 24 * 24).map(|i| (i * 7 % 251) as u8).collect();
        let view = VolumeView::new(Scalars::U8(&voxels), [24, 24, 24]).unwrap();
        let summary = VolumeSummary::new(&view).unwrap();
        let lobes = vec![GaussianLobe { center: 0.5, width: 0.05, height: 0.1 }];
        let table = TransferFunction::Gaussian(lobes.clone()).to_table().unwrap();
        let mut transfer = TransferSummary::new(&summary, &table).unwrap();
        (0..160)
            .map(|i| {
                let turn = i as f32 * 137.508 % 360.0;
                let camera = Arcball { rx: (i * 31 % 80) as f32, ry: turn, dz: 1.5 + (i % 7) as f32 * 0.2 };
                let frame = Frame::new(Camera::from_arcball(camera).unwrap(), 64, 64).unwrap();
                let mut features = FrameFeatures::default();
                features.measure(&summary, &mut transfer, &frame).expect("a frame");
                let x = f64::from(Camera::from_arcball(camera).unwrap().ray_basis(64, 64).1[0].x.abs());
                let seconds = law(x, f64::from(camera.dz));
                Sample {
                    scene: i,
                    features,
                    setting: Setting::from(&frame),
                    camera,
                    lobes: lobes.clone(),
                    seconds,
                }
            })
            .collect()
    }

    #[test]
    fn a_cost_that_depends_on_the_direction_is_found_and_holds_for_other_poses() {
        let law = |x: f64, _: f64| 0.02 * (0.3 * x * x + 0.1).exp();
        let all = samples(law);
        let (old, new) = all.split_at(110);
        let pairs: Vec<(&Sample, f64)> = old.iter().map(|s| (s, 0.02)).collect();
        let factor = Factor::fit(&pairs);
        let scatter = |factor: &Factor| {
            let log = |s: &Sample| (s.seconds / (0.02 * factor.of(&s.features, &s.setting, s.camera))).ln();
            (new.iter().map(|s| log(s).powi(2)).sum::<f64>() / new.len() as f64).sqrt()
        };
        let (with, without) = (scatter(&factor), scatter(&Factor::none()));
        assert!(with < 0.15 * without, "{with} {without}");
    }

    #[test]
    fn few_or_broken_frames_change_nothing_and_factors_are_bounded() {
        let all = samples(|_, _| 0.02);
        let few: Vec<(&Sample, f64)> = all[..20].iter().map(|s| (s, 0.01)).collect();
        assert_eq!(Factor::fit(&few), Factor::none());
        let broken: Vec<(&Sample, f64)> = all.iter().map(|s| (s, f64::NAN)).collect();
        assert_eq!(Factor::fit(&broken), Factor::none());
        let far: Vec<(&Sample, f64)> = all.iter().map(|s| (s, 1e-9)).collect();
        let factor = Factor::fit(&far).of(&all[0].features, &all[0].setting, all[0].camera);
        assert!((factor - LIMIT.exp()).abs() < 1e-12, "{factor}");
    }
}
