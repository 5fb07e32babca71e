//! Linear least squares on standardized inputs: robust, drawn towards a prior, weighted.

use crate::metrics::median;
use crate::train::Standardization;
use entire_core::calibrate::solve;
use entire_core::nn::{DenseParts, Dtype};

pub(super) fn standardized(rows: &[f32], scale: &Standardization) -> Vec<f64> {
    let width = scale.input_mean.len();
    rows.iter()
        .enumerate()
        .map(|(i, &x)| {
            let k = i % width;
            (f64::from(x) - f64::from(scale.input_mean[k])) / f64::from(scale.input_std[k])
        })
        .collect()
}

pub(super) fn last_layer(solution: &[f64]) -> DenseParts {
    let n = solution.len() - 1;
    DenseParts {
        inputs: n,
        outputs: 1,
        weight: solution[..n].iter().map(|&w| w as f32).collect(),
        bias: vec![solution[n] as f32],
        dtype: Dtype::F32,
    }
}

/// Minimizes Σ huber(y − w·x − b) + n·ridge·‖(w, b) − prior‖², the bias free of the ridge; returns w then b.
/// Errors beyond two robust standard deviations count linearly.
pub(super) fn robust_least_squares(
    x: &[f64],
    width: usize,
    y: &[f64],
    prior: &[f64],
    ridge: f64,
) -> Vec<f64> {
    weighted_least_squares(x, width, y, &vec![1.0; y.len()], prior, ridge)
}

/// As [`robust_least_squares`], each row times its importance; their mean is 1.
pub(super) fn weighted_least_squares(
    x: &[f64],
    width: usize,
    y: &[f64],
    importance: &[f64],
    prior: &[f64],
    ridge: f64,
) -> Vec<f64> {
    let m = width + 1;
    let mut solution = prior.to_vec();
    let mut weights = vec![1.0; y.len()];
    for _ in 0..6 {
        let mut gram = vec![0.0; m * m];
        let mut rhs = vec![0.0; m];
        for (((row, &t), &weight), &times) in x.chunks_exact(width).zip(y).zip(&weights).zip(importance) {
            let weight = weight * times;
            let at = |i: usize| if i < width { row[i] } else { 1.0 };
            for i in 0..m {
                let wi = weight * at(i);
                rhs[i] += wi * t;
                for j in 0..=i {
                    gram[i * m + j] += wi * at(j);
                }
            }
        }
        let pull = ridge * y.len() as f64;
        for i in 0..m {
            let pull = if i < width { pull } else { 1e-9 * pull };
            gram[i * m + i] += pull;
            rhs[i] += pull * prior[i];
        }
        let Some(next) = solve(&mut gram, rhs) else { break };
        solution = next;
        let residuals: Vec<f64> = x
            .chunks_exact(width)
            .zip(y)
            .map(|(row, t)| {
                (t - row.iter().zip(&solution).map(|(a, b)| a * b).sum::<f64>() - solution[width]).abs()
            })
            .collect();
        let limit = 2.0 * 1.4826 * median(&mut residuals.clone()).unwrap_or(0.0);
        for (w, r) in weights.iter_mut().zip(&residuals) {
            *w = if *r <= limit { 1.0 } else { limit / r };
        }
    }
    solution
}
