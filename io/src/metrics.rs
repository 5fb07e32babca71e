//! Error measures of predicted seconds against measured ones.

pub use entire_steer::numeric::median;
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use serde::Serialize;
use std::collections::BTreeMap;

/// The shortest prediction, seconds; it replaces smaller predictions and NaN.
pub const SHORTEST_PREDICTION: f64 = 1e-6;

/// Returns the prediction; [`SHORTEST_PREDICTION`] if the prediction is smaller or NaN.
pub fn usable(predicted: f64) -> f64 {
    if predicted > SHORTEST_PREDICTION { predicted } else { SHORTEST_PREDICTION }
}

/// Errors of predictions over some frames.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Metrics {
    /// Number of frames.
    pub frames: usize,
    /// Root of the mean squared error, seconds.
    pub rmse: f64,
    /// Standard deviation of the measured seconds.
    pub sd: f64,
    /// RMSE divided by SD: 1 if every prediction is the mean of the measured seconds; infinity or NaN if all
    /// measured seconds are equal.
    pub rmse_over_sd: f64,
    /// Mean absolute error, seconds.
    pub mae: f64,
    /// Median of |predicted − measured| / measured.
    pub mdape: f64,
    /// 95th percentile of |predicted − measured| / measured.
    pub p95: f64,
    /// 99th percentile of |predicted − measured| / measured.
    pub p99: f64,
    /// 1 − Σ(ln predicted − ln measured)² / Σ(ln measured − their mean)²; negative infinity or NaN if all
    /// measured seconds are equal.
    pub r2_log: f64,
    /// Median of predicted / measured − 1 in each tenth of the frames, fastest first.
    pub bias_by_decile: Vec<f64>,
    /// Number of predictions that were zero, negative or NaN.
    pub not_positive: usize,
}

impl Metrics {
    /// Returns the errors of predicted seconds against measured ones. Both slices have one entry per frame;
    /// surplus entries of the longer slice are ignored. Measured seconds must be positive. `None` if there is
    /// no frame.
    pub fn new(predicted: &[f64], measured: &[f64]) -> Option<Self> {
        let frames = measured.len().min(predicted.len());
        if frames == 0 {
            return None;
        }
        let (predicted, measured) = (&predicted[..frames], &measured[..frames]);
        let n = frames as f64;
        let pairs: Vec<(f64, f64)> = predicted.iter().zip(measured).map(|(&p, &t)| (usable(p), t)).collect();
        // The mean of equal numbers is rounded, so the numbers may differ from it.
        let equal = measured.iter().all(|t| *t == measured[0]);
        let about = |mean: f64, values: &[f64]| -> f64 {
            if equal { 0.0 } else { values.iter().map(|v| (v - mean).powi(2)).sum() }
        };
        let mean = measured.iter().sum::<f64>() / n;
        let sd = (about(mean, measured) / n).sqrt();
        let rmse = (pairs.iter().map(|(p, t)| (p - t).powi(2)).sum::<f64>() / n).sqrt();
        let logs: Vec<f64> = measured.iter().map(|t| t.ln()).collect();
        let log_total = about(logs.iter().sum::<f64>() / n, &logs);
        let log_rest: f64 = pairs.iter().map(|(p, t)| (p.ln() - t.ln()).powi(2)).sum();
        let mut relative: Vec<f64> = pairs.iter().map(|(p, t)| (p - t).abs() / t).collect();
        relative.sort_by(f64::total_cmp);
        let mut by_time = pairs.clone();
        by_time.sort_by(|a, b| a.1.total_cmp(&b.1));
        let bias_by_decile = (0..10)
            .filter_map(|d| {
                let tenth = &by_time[d * frames / 10..(d + 1) * frames / 10];
                median(&mut tenth.iter().map(|(p, t)| p / t - 1.0).collect::<Vec<_>>())
            })
            .collect();
        Some(Self {
            frames,
            rmse,
            sd,
            rmse_over_sd: rmse / sd,
            mae: pairs.iter().map(|(p, t)| (p - t).abs()).sum::<f64>() / n,
            mdape: percentile(&relative, 0.5),
            p95: percentile(&relative, 0.95),
            p99: percentile(&relative, 0.99),
            r2_log: 1.0 - log_rest / log_total,
            bias_by_decile,
            not_positive: predicted.iter().filter(|p| !(**p > 0.0)).count(),
        })
    }
}

/// Coverage and quantile loss of an upper bound.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BoundMetrics {
    /// Share of frames that took no longer than the bound.
    pub coverage: f64,
    /// Coverage among the slowest tenth of the frames.
    pub slowest_coverage: f64,
    /// Mean quantile loss in seconds, divided by the mean of the measured seconds: small for a tight bound
    /// that few frames exceed.
    pub pinball: f64,
}

impl BoundMetrics {
    /// Returns the metrics of upper bounds for the quantile `level` (0.95, say) against measured times, both
    /// in seconds. `None` if there is no frame.
    pub fn new(bounds: &[f64], measured: &[f64], level: f64) -> Option<Self> {
        let n = measured.len().min(bounds.len());
        if n == 0 {
            return None;
        }
        let mut pairs: Vec<(f64, f64)> = bounds.iter().copied().zip(measured.iter().copied()).collect();
        pairs.sort_by(|a, b| a.1.total_cmp(&b.1));
        let held = |part: &[(f64, f64)]| {
            part.iter().filter(|(bound, t)| t <= bound).count() as f64 / part.len() as f64
        };
        let loss: f64 = pairs
            .iter()
            .map(|(bound, t)| if t > bound { level * (t - bound) } else { (1.0 - level) * (bound - t) })
            .sum();
        let total: f64 = pairs.iter().map(|p| p.1).sum();
        Some(Self {
            coverage: held(&pairs),
            slowest_coverage: held(&pairs[(9 * n / 10).min(n - 1)..]),
            pinball: loss / total,
        })
    }
}

/// Returns the 95 % confidence interval of a metric by bootstrap over whole groups (volumes, say); `None`
/// with fewer than two groups. `rounds`: number of random draws.
pub fn bootstrap_by_group<G: Ord>(
    predicted: &[f64],
    measured: &[f64],
    groups: &[G],
    rounds: usize,
    metric: impl Fn(&Metrics) -> f64,
) -> Option<(f64, f64)> {
    intervals_by_group(predicted, measured, groups, (rounds, 0.95), |m| [metric(m)]).map(|[i]| i)
}

/// Returns the intervals of several metrics over the same draws. [`bootstrap_by_group`] does so for one
/// metric and 95 %. `rounds`: number of random draws; `level`: confidence level, 0 to 1.
pub fn intervals_by_group<G: Ord, const N: usize>(
    predicted: &[f64],
    measured: &[f64],
    groups: &[G],
    (rounds, level): (usize, f64),
    metrics: impl Fn(&Metrics) -> [f64; N],
) -> Option<[(f64, f64); N]> {
    let mut members: BTreeMap<&G, Vec<usize>> = BTreeMap::new();
    for (i, g) in groups.iter().enumerate() {
        members.entry(g).or_default().push(i);
    }
    let members: Vec<Vec<usize>> = members.into_values().collect();
    if members.len() < 2 {
        return None;
    }
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut drawn: Vec<[f64; N]> = Vec::with_capacity(rounds);
    for _ in 0..rounds {
        let (mut p, mut t) = (Vec::with_capacity(measured.len()), Vec::with_capacity(measured.len()));
        for _ in 0..members.len() {
            let unit = (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
            for &i in &members[(unit * members.len() as f64) as usize] {
                p.push(predicted[i]);
                t.push(measured[i]);
            }
        }
        drawn.extend(Metrics::new(&p, &t).map(|m| metrics(&m)));
    }
    let outside = (1.0 - level) / 2.0;
    Some(std::array::from_fn(|k| {
        let mut values: Vec<f64> = drawn.iter().map(|d| d[k]).collect();
        values.sort_by(f64::total_cmp);
        (percentile(&values, outside), percentile(&values, 1.0 - outside))
    }))
}

/// Returns the quantile `share` (0 to 1) of ascending numbers, interpolated between neighbors; NaN without
/// numbers.
pub fn percentile(ascending: &[f64], share: f64) -> f64 {
    let Some(last) = ascending.len().checked_sub(1) else { return f64::NAN };
    let at = share.clamp(0.0, 1.0) * last as f64;
    let low = at.floor() as usize;
    let t = at - low as f64;
    // Neighbors that are both infinite have no difference.
    if t == 0.0 || ascending[low] == ascending[low + 1] {
        return ascending[low];
    }
    ascending[low] + t * (ascending[low + 1] - ascending[low])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn perfect_predictions_have_no_error_and_the_mean_has_its_deviation() {
        let t: Vec<f64> = (1..=40).map(|i| f64::from(i) * 0.01).collect();
        let perfect = Metrics::new(&t, &t).unwrap();
        assert_eq!((perfect.rmse, perfect.mdape, perfect.p99, perfect.r2_log), (0.0, 0.0, 0.0, 1.0));
        assert_eq!(perfect.bias_by_decile, vec![0.0; 10]);
        let mean = vec![t.iter().sum::<f64>() / 40.0; 40];
        let constant = Metrics::new(&mean, &t).unwrap();
        assert!((constant.rmse_over_sd - 1.0).abs() < 1e-12);
        assert!(constant.bias_by_decile[0] > 5.0 && constant.bias_by_decile[9] < -0.4);
    }

    #[test]
    fn a_factor_is_a_bias_everywhere() {
        let t: Vec<f64> = (1..=30).map(f64::from).collect();
        let p: Vec<f64> = t.iter().map(|t| t * 1.1).collect();
        let m = Metrics::new(&p, &t).unwrap();
        assert!((m.mdape - 0.1).abs() < 1e-12 && (m.p95 - 0.1).abs() < 1e-12);
        assert!(m.bias_by_decile.iter().all(|b| (b - 0.1).abs() < 1e-12));
    }

    #[test]
    fn useless_predictions_count_as_the_shortest_time() {
        let m = Metrics::new(&[-1.0, f64::NAN, 0.0], &[1.0, 1.0, 2.0]).unwrap();
        assert_eq!(m.not_positive, 3);
        assert!(m.rmse.is_finite() && m.r2_log < -10.0);
        assert_eq!(Metrics::new(&[], &[]), None);
        let (short, long) = ([1.0, 2.0, 4.0], [1.0, 2.0, 4.0, -8.0]);
        let equal = Metrics::new(&short, &short);
        assert_eq!((Metrics::new(&short, &long), Metrics::new(&long, &short)), (equal.clone(), equal));
        assert!(Metrics::new(&[1.0; 3], &[1.0; 3]).unwrap().bias_by_decile.len() <= 3);
    }

    #[test]
    fn equal_times_have_no_deviation() {
        // The computed mean of 30 times of 0.01 s is not 0.01 s.
        let times = [0.01; 30];
        let m = Metrics::new(&[0.02; 30], &times).unwrap();
        assert_eq!((m.sd, m.rmse_over_sd, m.r2_log), (0.0, f64::INFINITY, f64::NEG_INFINITY));
        assert!(Metrics::new(&times, &times).unwrap().rmse_over_sd.is_nan());
    }

    #[test]
    fn bounds_are_judged_overall_and_among_the_slowest() {
        let t: Vec<f64> = (1..=100).map(f64::from).collect();
        // A bound that holds for all but the ten slowest frames.
        let bound: Vec<f64> = t.iter().map(|t| if *t > 90.0 { 0.5 * t } else { 2.0 * t }).collect();
        let b = BoundMetrics::new(&bound, &t, 0.95).unwrap();
        assert_eq!((b.coverage, b.slowest_coverage), (0.9, 0.0));
        let tight = BoundMetrics::new(&t, &t, 0.95).unwrap();
        assert_eq!((tight.coverage, tight.slowest_coverage, tight.pinball), (1.0, 1.0, 0.0));
        // Both frames exceed their bound by 0.5 s, and the mean time is 1 s, so the loss is 0.95 · 0.5.
        let low = BoundMetrics::new(&[0.5, 0.5], &[1.0, 1.0], 0.95).unwrap();
        assert!((low.pinball - 0.475).abs() < 1e-12);
        assert_eq!(BoundMetrics::new(&[], &[], 0.95), None);
    }

    #[test]
    fn intervals_are_as_wide_as_groups_differ() {
        let t: Vec<f64> = (0..60).map(|i| 1.0 + f64::from(i % 7)).collect();
        let groups: Vec<String> = (0..60).map(|i| format!("v{}", i / 10)).collect();
        let p: Vec<f64> = t.iter().enumerate().map(|(i, t)| t * (1.0 + 0.1 * (i / 10) as f64)).collect();
        let (low, high) = bootstrap_by_group(&p, &t, &groups, 300, |m| m.mdape).unwrap();
        let all = Metrics::new(&p, &t).unwrap().mdape;
        assert!(low < all && all < high && low >= 0.0 && high <= 0.5 + 1e-9, "{low} {all} {high}");
        assert_eq!(bootstrap_by_group(&p, &t, &["one"; 60], 10, |m| m.mdape), None);
        // Several metrics at once equal those computed one by one, and a lower level gives a narrower
        // interval.
        let [rmse, mdape] = intervals_by_group(&p, &t, &groups, (300, 0.95), |m| [m.rmse, m.mdape]).unwrap();
        assert_eq!(Some(rmse), bootstrap_by_group(&p, &t, &groups, 300, |m| m.rmse));
        assert_eq!(mdape, (low, high));
        let [(a, b)] = intervals_by_group(&p, &t, &groups, (300, 0.5), |m| [m.mdape]).unwrap();
        assert!(low < a && a < b && b < high, "{low} {a} {b} {high}");
    }

    #[test]
    fn percentiles_interpolate() {
        assert_eq!(percentile(&[1.0, 2.0, 4.0], 0.5), 2.0);
        assert_eq!(percentile(&[1.0, 2.0, 4.0], 0.75), 3.0);
        assert_eq!(percentile(&[5.0], 0.95), 5.0);
        assert_eq!(percentile(&[f64::INFINITY; 3], 0.3), f64::INFINITY);
        assert!(percentile(&[], 0.5).is_nan());
    }
}
