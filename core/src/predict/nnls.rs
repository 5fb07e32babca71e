//! Non-negative least squares for a handful of unknowns.

/// Most unknowns that [`nnls`] takes.
const MAX_UNKNOWNS: usize = 24;

/// Minimizes ‖A·x − b‖² over x ≥ 0, given the normal equations `gram` = AᵀA (row-major n × n) and `rhs` =
/// Aᵀb, by the active-set method of Lawson and Hanson. Returns x; unknowns whose column is zero (or not
/// finite) stay 0.
///
/// The columns are scaled to unit length inside and a ridge of 1e-12 of that length keeps collinear columns
/// solvable.
///
/// # Panics
/// When n is over [`MAX_UNKNOWNS`] or `gram` is not n × n.
pub(super) fn nnls(gram: &[f64], rhs: &[f64], x: &mut [f64]) {
    let n = rhs.len();
    assert!(
        n <= MAX_UNKNOWNS && gram.len() == n * n && x.len() == n,
        "nnls takes up to {MAX_UNKNOWNS} unknowns"
    );
    let mut scale = [0.0f64; MAX_UNKNOWNS];
    for i in 0..n {
        let d = gram[i * n + i];
        scale[i] = if d.is_finite() && d > 0.0 { 1.0 / libm::sqrt(d) } else { 0.0 };
    }
    let g = |i: usize, j: usize| gram[i * n + j] * scale[i] * scale[j] + if i == j { 1.0e-12 } else { 0.0 };
    let b = |i: usize| rhs[i] * scale[i];
    let mut passive = [false; MAX_UNKNOWNS];
    let mut y = [0.0f64; MAX_UNKNOWNS];
    let tolerance = 1.0e-11 * (0..n).map(|i| libm::fabs(b(i))).fold(0.0, f64::max);
    // Each pass adds an unknown; passes that remove one lower the residual, so 3n passes are ample.
    for _ in 0..3 * n {
        let gradient = |i: usize, y: &[f64]| b(i) - (0..n).map(|j| g(i, j) * y[j]).sum::<f64>();
        let enter = (0..n)
            .filter(|&i| !passive[i] && scale[i] > 0.0)
            .map(|i| (i, gradient(i, &y)))
            .filter(|&(_, w)| w > tolerance)
            .max_by(|a, b| a.1.total_cmp(&b.1));
        let Some((enter, _)) = enter else { break };
        passive[enter] = true;
        loop {
            let mut z = [0.0f64; MAX_UNKNOWNS];
            if !solve(n, &passive, &g, &b, &mut z) {
                passive[enter] = false;
                break;
            }
            // Walk from y towards z until the first unknown would turn negative, and let that one go.
            let mut nearest = (f64::INFINITY, usize::MAX);
            for i in 0..n {
                if passive[i] && z[i] <= 0.0 {
                    let alpha = if y[i] > 0.0 { y[i] / (y[i] - z[i]) } else { 0.0 };
                    if alpha < nearest.0 {
                        nearest = (alpha, i);
                    }
                }
            }
            let (alpha, leaves) = nearest;
            if leaves == usize::MAX {
                y = z;
                break;
            }
            for i in 0..n {
                if passive[i] {
                    y[i] = (y[i] + alpha * (z[i] - y[i])).max(0.0);
                }
            }
            y[leaves] = 0.0;
            passive[leaves] = false;
        }
    }
    for i in 0..n {
        x[i] = (y[i] * scale[i]).max(0.0);
    }
}

/// Solves the passive rows and columns by Cholesky; false when they are not positive definite.
fn solve(
    n: usize,
    passive: &[bool; MAX_UNKNOWNS],
    g: &impl Fn(usize, usize) -> f64,
    b: &impl Fn(usize) -> f64,
    z: &mut [f64; MAX_UNKNOWNS],
) -> bool {
    let mut index = [0usize; MAX_UNKNOWNS];
    let mut m = 0;
    for (i, &p) in passive.iter().enumerate().take(n) {
        if p {
            index[m] = i;
            m += 1;
        }
    }
    let mut l = [[0.0f64; MAX_UNKNOWNS]; MAX_UNKNOWNS];
    for r in 0..m {
        for c in 0..=r {
            let mut sum = g(index[r], index[c]);
            for k in 0..c {
                sum -= l[r][k] * l[c][k];
            }
            if r == c {
                if !(sum > 1.0e-15) {
                    return false;
                }
                l[r][r] = libm::sqrt(sum);
            } else {
                l[r][c] = sum / l[c][c];
            }
        }
    }
    let mut v = [0.0f64; MAX_UNKNOWNS];
    for r in 0..m {
        let sum: f64 = (0..r).map(|k| l[r][k] * v[k]).sum();
        v[r] = (b(index[r]) - sum) / l[r][r];
    }
    for r in (0..m).rev() {
        let sum: f64 = (r + 1..m).map(|k| l[k][r] * v[k]).sum();
        v[r] = (v[r] - sum) / l[r][r];
        z[index[r]] = v[r];
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec;
    use std::vec::Vec;

    fn normal(a: &[Vec<f64>], b: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let n = a[0].len();
        let mut gram = vec![0.0; n * n];
        let mut rhs = vec![0.0; n];
        for (row, &y) in a.iter().zip(b) {
            for i in 0..n {
                rhs[i] += row[i] * y;
                for j in 0..n {
                    gram[i * n + j] += row[i] * row[j];
                }
            }
        }
        (gram, rhs)
    }

    #[test]
    fn exact_non_negative_solutions_are_found() {
        let truth = [3.0, 0.0, 1e-6];
        let a: Vec<Vec<f64>> =
            (0..20).map(|i| vec![1.0, f64::from(i), f64::from(i * i) * 1e5 + f64::from(i % 3)]).collect();
        let b: Vec<f64> = a.iter().map(|r| r.iter().zip(truth).map(|(x, t)| x * t).sum()).collect();
        let (gram, rhs) = normal(&a, &b);
        let mut x = [0.0; 3];
        nnls(&gram, &rhs, &mut x);
        for (x, t) in x.iter().zip(truth) {
            assert!((x - t).abs() <= 1e-6 * (1.0 + t), "{x} {t}");
        }
    }

    #[test]
    fn a_negative_pull_ends_at_zero() {
        // min (x - (-2))² + (y - 5)²
        let mut x = [9.0; 2];
        nnls(&[1.0, 0.0, 0.0, 1.0], &[-2.0, 5.0], &mut x);
        assert!(x[0] == 0.0 && (x[1] - 5.0).abs() < 1e-9);
    }

    #[test]
    fn zero_and_duplicate_columns_are_harmless() {
        let a: Vec<Vec<f64>> = (1..8).map(|i| vec![f64::from(i), f64::from(i), 0.0]).collect();
        let b: Vec<f64> = (1..8).map(|i| 2.0 * f64::from(i)).collect();
        let (gram, rhs) = normal(&a, &b);
        let mut x = [0.0; 3];
        nnls(&gram, &rhs, &mut x);
        assert!((x[0] + x[1] - 2.0).abs() < 1e-6 && x[2] == 0.0, "{x:?}");
    }

    proptest! {
        /// Karush, Kuhn, Tucker: x ≥ 0; the gradient is 0 where x > 0 and not negative elsewhere.
        #[test]
        fn solutions_meet_the_optimality_conditions(
            rows in prop::collection::vec(prop::collection::vec(-1.0f64..1.0, 5), 6..20),
            b in prop::collection::vec(-1.0f64..1.0, 20),
        ) {
            let b = &b[..rows.len()];
            let (gram, rhs) = normal(&rows, b);
            let mut x = [0.0; 5];
            nnls(&gram, &rhs, &mut x);
            for i in 0..5 {
                let gradient: f64 = (0..5).map(|j| gram[i * 5 + j] * x[j]).sum::<f64>() - rhs[i];
                prop_assert!(x[i] >= 0.0);
                prop_assert!(gradient >= -1e-6);
                if x[i] > 1e-9 {
                    prop_assert!(gradient.abs() < 1e-6, "{} {}", x[i], gradient);
                }
            }
        }
    }
}
