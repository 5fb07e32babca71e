//! Results of a study: errors, latencies and curves, by set, split and predictor.

use crate::latency::Latency;
use entire_io::dataset::{Clock, NoiseFloor, TimedFrame, noise_floor};
use entire_io::metrics::{BoundMetrics, Metrics, intervals_by_group};
use entire_steer::predict::UpperBound;
use entire_train::bound;
use entire_train::split::{GroupBy, TimedFrames};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Number of bootstrap rounds of every interval.
const ROUNDS: usize = 200;

/// Fraction of the bootstrap rounds whose values are inside an interval.
pub(crate) const LEVEL: f64 = 0.9;

/// Bootstrap intervals over volumes at [`LEVEL`]: how much an error depends on the choice of test volumes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(crate) struct Intervals {
    pub(crate) rmse_over_sd: (f64, f64),
    pub(crate) mdape: (f64, f64),
}

impl Intervals {
    /// Intervals of the errors of some predictions; `None` if the frames are of one volume.
    pub(crate) fn of(predicted: &[f64], measured: &TimedFrames<'_>) -> Option<Self> {
        let volumes: Vec<String> = measured.frames.iter().map(|f| GroupBy::Volume.group(&f.scene)).collect();
        let both = |m: &Metrics| [m.rmse_over_sd, m.mdape];
        intervals_by_group(predicted, &measured.seconds, &volumes, (ROUNDS, LEVEL), both)
            .map(|[rmse_over_sd, mdape]| Self { rmse_over_sd, mdape })
    }

    /// RMSE/SD with its interval, `0.047 (0.041–0.055)`.
    pub(crate) fn beside_rmse(of: Option<&Self>, metrics: &Metrics) -> String {
        let interval =
            of.map_or(String::new(), |i| format!(" ({:.3}–{:.3})", i.rmse_over_sd.0, i.rmse_over_sd.1));
        format!("{:.3}{interval}", metrics.rmse_over_sd)
    }

    /// The median error with its interval in per cent, `5.6 (5.1–6.2)`.
    pub(crate) fn beside_mdape(of: Option<&Self>, metrics: &Metrics) -> String {
        let interval =
            of.map_or(String::new(), |i| format!(" ({:.1}–{:.1})", 100.0 * i.mdape.0, 100.0 * i.mdape.1));
        format!("{:.1}{interval}", 100.0 * metrics.mdape)
    }
}

/// Errors of a predictor on its training frames, and in cross-validation on the training tables.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Fit {
    pub(crate) set: String,
    pub(crate) predictor: String,
    /// Errors on the training frames of the training tables.
    pub(crate) seen: Metrics,
    pub(crate) seen_intervals: Option<Intervals>,
    /// Errors in cross-validation: on frames of ensemble members that the predictor was trained without.
    pub(crate) crossed: Option<Metrics>,
    pub(crate) crossed_intervals: Option<Intervals>,
    /// Median error and RMSE/SD of a perfect predictor on the frames of the cross-validation, due to the
    /// noise of the measured times.
    pub(crate) noise: [f64; 2],
    pub(crate) folds: usize,
    /// Number of fitted parameters: weights, biases, and unit costs.
    pub(crate) numbers: usize,
    /// Number of rays along each side of the predictor's probe.
    pub(crate) probe_side: usize,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct SplitResult {
    pub(crate) set: String,
    pub(crate) split: String,
    pub(crate) predictor: String,
    /// Table that lists the predictor ([`super::Named::panel`]); `baseline` for the constant and the proxy.
    pub(crate) panel: String,
    pub(crate) metrics: Metrics,
    /// Intervals of RMSE/SD and of the median error.
    pub(crate) intervals: Option<Intervals>,
    /// Figures of the upper bound, if the predictor has one.
    pub(crate) bound: Option<BoundMetrics>,
}

/// Error of a predictor on other data after calibration to a hundred frames of that data.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct CalibratedResult {
    pub(crate) set: String,
    pub(crate) split: String,
    pub(crate) predictor: String,
    /// Errors on volumes that were not used for calibration.
    pub(crate) metrics: Metrics,
}

#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct Findings {
    pub(crate) results: Vec<SplitResult>,
    /// Errors on the training tables.
    pub(crate) fits: Vec<Fit>,
    pub(crate) latencies: Vec<(String, String, Latency)>,
    /// RMSE with eight-bit weights divided by the RMSE with the weights as stored, on the main split, by set
    /// and predictor.
    pub(crate) eight_bit: Vec<(String, String, f64)>,
    /// Noise floor and number of frames, by set and split.
    pub(crate) noise: Vec<(String, String, NoiseFloor, usize)>,
    /// The predictor that the rule selects, by set.
    pub(crate) selected: BTreeMap<String, String>,
    /// Errors after calibration to other data.
    pub(crate) calibrated: Vec<CalibratedResult>,
    /// Predictors that could not be trained, with the reason.
    pub(crate) left_out: Vec<(String, String, String)>,
    /// Model file by set and predictor.
    #[serde(skip)]
    pub(crate) files: Vec<(String, String, PathBuf)>,
}

impl Findings {
    pub(crate) fn of(&self, set: &str, split: &str, predictor: &str) -> Option<&SplitResult> {
        self.results.iter().find(|r| r.set == set && r.split == split && r.predictor == predictor)
    }

    pub(crate) fn fit(&self, set: &str, predictor: &str) -> Option<&Fit> {
        self.fits.iter().find(|f| f.set == set && f.predictor == predictor)
    }

    /// Errors of a predictor in cross-validation, and the number of folds; `None` if it was not
    /// cross-validated.
    pub(crate) fn crossed(&self, set: &str, predictor: &str) -> Option<(&Metrics, usize)> {
        self.fit(set, predictor).and_then(|f| Some((f.crossed.as_ref()?, f.folds)))
    }

    /// Returns the latency of a predictor that was trained on a data set.
    pub(crate) fn latency(&self, set: &str, predictor: &str) -> Option<Latency> {
        self.latencies.iter().find(|l| l.0 == set && l.1 == predictor).map(|l| l.2)
    }

    /// Median relative error of a perfect predictor due to noise: 0.6745 standard deviations of the noise of
    /// a frame's median time.
    pub(crate) fn noise_mdape(&self, set: &str, split: &str) -> f64 {
        self.noise.iter().find(|n| n.0 == set && n.1 == split).map_or(0.0, |n| n.2.mdape())
    }
}

impl Fit {
    /// The error by which the rule compares predictors: the geometric mean of median error and RMSE/SD in
    /// cross-validation, after the square of the noise is subtracted from the square of each. `None` without
    /// a cross-validation.
    pub(super) fn error(&self) -> Option<f64> {
        let crossed = self.crossed.as_ref()?;
        let [mdape, rmse_over_sd] = [(crossed.mdape, self.noise[0]), (crossed.rmse_over_sd, self.noise[1])]
            .map(|(error, noise)| (error * error - noise * noise).max(0.0).sqrt());
        Some((mdape * rmse_over_sd).sqrt())
    }
}

/// Returns median error and RMSE/SD of a perfect predictor of measured times, due to their noise. Frames that
/// were measured once are left out. `passes` is as in [`noise_floor`].
pub(super) fn noise_of(
    part: &TimedFrames<'_>,
    clock: Clock,
    passes: impl Fn(&TimedFrame) -> usize,
) -> [f64; 2] {
    let mdape = noise_floor(part.frames.iter().copied(), clock, passes).map_or(0.0, |n| n.mdape());
    let squares = part.frames.iter().filter_map(|frame| {
        let times: Vec<f64> = frame.repeats.iter().filter_map(|r| r.seconds(clock)).collect();
        let n = times.len() as f64;
        let mean = times.iter().sum::<f64>() / n;
        let sum: f64 = times.iter().map(|t| (t - mean) * (t - mean)).sum();
        // Variance of the median of the repeats, as in `noise_floor`. The median of two repeats is their
        // mean.
        let median_over_mean = if n > 2.0 { std::f64::consts::FRAC_PI_2 } else { 1.0 };
        (n > 1.0).then(|| median_over_mean * sum / (n - 1.0) / n)
    });
    let squares: Vec<f64> = squares.collect();
    let rmse = (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt();
    let sd = Metrics::new(&part.seconds, &part.seconds).map_or(f64::INFINITY, |m| m.sd);
    [mdape, rmse / sd]
}

/// Number of frames to which predictors are calibrated.
pub(crate) const CALIBRATION_FRAMES: usize = 100;

pub(crate) const CONSTANT: &str = "constant (mean of 15 % of each volume's frames)";
pub(crate) const PROXY: &str = "LVRP (64³ render, linear fit)";

/// Measures the errors of predictions on a split; `None` if the split has no frames.
pub(crate) fn judge(
    set: &str,
    split: &str,
    predictor: &str,
    panel: &str,
    part: &TimedFrames<'_>,
    predicted: &[f64],
    upper: Option<&UpperBound>,
) -> Option<SplitResult> {
    let metrics = Metrics::new(predicted, &part.seconds)?;
    let bound = upper.and_then(|u| bound::judge(u, predicted, &part.seconds));
    Some(SplitResult {
        set: set.to_owned(),
        split: split.to_owned(),
        predictor: predictor.to_owned(),
        panel: panel.to_owned(),
        intervals: Intervals::of(predicted, part),
        metrics,
        bound,
    })
}
