//! Intervals of ratios of errors by bootstrap over test volumes. Training runs are not resampled: an interval
//! states the dependence of a ratio on the choice of test volumes.

use crate::study::LEVEL;
use entire_io::metrics::percentile;
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Number of bootstrap draws behind an interval.
pub(super) const DRAWS: usize = 10_000;
const SEED: u64 = 1;

/// Squared errors on the frames of one volume.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Errors {
    pub(crate) frames: usize,
    /// Sum of squared errors over the frames, seconds squared, by training run.
    pub(crate) squared: Vec<f64>,
}

pub(super) type ByVolume = BTreeMap<String, Errors>;

/// Squared errors of several runs of a predictor; `volumes` names the volume of each frame.
pub(super) fn by_volume<'a>(
    volumes: impl Iterator<Item = &'a str>,
    measured: &[f64],
    runs: &[Vec<f64>],
) -> ByVolume {
    let mut out = ByVolume::new();
    for (i, volume) in volumes.enumerate() {
        let of = out.entry(volume.to_owned()).or_default();
        of.frames += 1;
        of.squared.resize(runs.len(), 0.0);
        for (sum, predicted) in of.squared.iter_mut().zip(runs) {
            *sum += (predicted[i] - measured[i]).powi(2);
        }
    }
    out
}

/// Returns the RMSE in seconds, averaged over the training runs; `None` without frames.
pub(super) fn rmse(errors: &ByVolume) -> Option<f64> {
    (!errors.is_empty()).then(|| rmse_of(errors.values()))
}

fn rmse_of<'a>(drawn: impl Iterator<Item = &'a Errors> + Clone) -> f64 {
    let frames: usize = drawn.clone().map(|e| e.frames).sum();
    let runs = drawn.clone().map(|e| e.squared.len()).min().unwrap_or(0);
    let total = |run: usize| drawn.clone().map(|e| e.squared[run]).sum::<f64>();
    (0..runs).map(|run| (total(run) / frames as f64).sqrt()).sum::<f64>() / runs as f64
}

/// Interval of the RMSE of one predictor divided by that of another on the same frames: it contains the share
/// [`LEVEL`] of the [`DRAWS`] ratios. `None` if the frames are not the same, or are of fewer than two
/// volumes.
pub(super) fn of_ratio(over: &ByVolume, under: &ByVolume) -> Option<(f64, f64)> {
    let same = over.len() == under.len()
        && over.iter().zip(under).all(|((a, x), (b, y))| a == b && x.frames == y.frames);
    if !same || over.len() < 2 {
        return None;
    }
    let pairs: Vec<(&Errors, &Errors)> = over.values().zip(under.values()).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let mut ratios: Vec<f64> = (0..DRAWS)
        .map(|_| {
            let drawn: Vec<(&Errors, &Errors)> =
                (0..pairs.len()).map(|_| pairs[(rng.next_u64() % pairs.len() as u64) as usize]).collect();
            rmse_of(drawn.iter().map(|p| p.0)) / rmse_of(drawn.iter().map(|p| p.1))
        })
        .collect();
    ratios.sort_by(f64::total_cmp);
    let outside = (1.0 - LEVEL) / 2.0;
    Some((percentile(&ratios, outside), percentile(&ratios, 1.0 - outside)))
}

/// An interval in brackets, as it is printed beside its ratio; for `None`, states that it is unknown.
pub(super) fn in_brackets(interval: Option<(f64, f64)>) -> String {
    interval.map_or_else(|| "(interval unknown)".into(), |(low, high)| format!("({low:.2}–{high:.2})"))
}

/// Explanation of the brackets beside ratios.
pub(super) fn sentence() -> String {
    format!(
        "Brackets beside a ratio of errors contain its {:.0} % bootstrap interval: the test volumes are \
         drawn {DRAWS} times with replacement (seed {SEED}). A ratio has no brackets if the results lack the \
         errors of single volumes.",
        100.0 * LEVEL
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Errors of one run on one frame of each volume.
    fn errors(squared: &[f64]) -> ByVolume {
        let one = |(i, s): (usize, &f64)| (format!("v{i:03}"), Errors { frames: 1, squared: vec![*s] });
        squared.iter().enumerate().map(one).collect()
    }

    /// Ten of twenty volumes have an error. The number of these volumes in a draw is binomial (20, ½), with 6
    /// as 5th percentile and 14 as 95th percentile. The interval must end at the ratios for 6 and 14 volumes.
    #[test]
    fn an_interval_is_that_of_the_binomial_distribution() {
        let half: Vec<f64> = (0..20).map(|i| f64::from(i % 2)).collect();
        let (low, high) = of_ratio(&errors(&half), &errors(&[4.0; 20])).unwrap();
        let ratio = |with: f64| (with / 20.0).sqrt() / 2.0;
        assert!((low - ratio(6.0)).abs() < 1e-12 && (high - ratio(14.0)).abs() < 1e-12, "{low} {high}");
    }

    /// Both predictors are judged on the same drawn volumes. If their ratio is equal on every volume, the
    /// interval must have no width, although the errors differ from volume to volume.
    #[test]
    fn both_predictors_are_judged_on_the_same_draws() {
        let under: Vec<f64> = (1..=9).map(f64::from).collect();
        let over: Vec<f64> = under.iter().map(|e| 0.25 * e).collect();
        let (low, high) = of_ratio(&errors(&over), &errors(&under)).unwrap();
        assert!((low - 0.5).abs() < 1e-12 && (high - 0.5).abs() < 1e-12, "{low} {high}");
        // There is no interval for predictors on different volumes, nor for a single volume.
        assert_eq!(of_ratio(&errors(&over), &errors(&under[..8])), None);
        assert_eq!(of_ratio(&errors(&over[..1]), &errors(&under[..1])), None);
    }

    #[test]
    fn the_error_is_the_mean_of_the_runs() {
        let measured = [1.0, 1.0, 2.0];
        let runs = [vec![2.0, 2.0, 3.0], vec![4.0, 4.0, 5.0]];
        let found = by_volume(["a", "a", "b"].into_iter(), &measured, &runs);
        assert_eq!(found["a"], Errors { frames: 2, squared: vec![2.0, 18.0] });
        assert_eq!(found["b"], Errors { frames: 1, squared: vec![1.0, 9.0] });
        assert_eq!(rmse(&found), Some(2.0));
        assert_eq!(rmse(&ByVolume::new()), None);
    }
}
