//! Choice of the most informative frames: greedy D-optimal design over the candidates' features.
//!
//! The feature vector of a frame holds the constant 1 and the share of each kind of work in the expected
//! time. Every second chosen frame is a random candidate. Each of the remaining frames has the largest ratio
//! of information gain (increase of ln det of the information matrix) to a power of its expected seconds. No
//! candidate needs to be rendered for this choice.

use super::pool::{Candidate, Pool};
use entire_steer::numeric::dot;

/// Exponent e of a frame's expected seconds: frames are ranked by information gain / seconds^e. With e = 0
/// the seconds are ignored; e = 1 would leave out long frames, which dominate the root mean squared error. If
/// the calibration is limited by the number of frames, not by the time, e is 0.
const COST_EXPONENT: f64 = 0.5;

/// Diagonal of the initial information matrix, before any frame is chosen; it makes the matrix invertible.
const RIDGE: f64 = 0.05;

pub(crate) struct Design {
    vectors: Vec<Vec<f64>>,
    inverse: Vec<f64>,
    width: usize,
    taken: Vec<bool>,
}

impl Design {
    /// Returns a design in which no frame is chosen; `costs` are the unit costs, in seconds.
    pub(crate) fn new(pool: &Pool, costs: &[f64]) -> Self {
        let vector = |c: &Candidate| -> Vec<f64> {
            let total: f64 = dot(costs, &c.work);
            let share = |(cost, w): (&f64, &f64)| if total > 0.0 { cost * w / total } else { 0.0 };
            std::iter::once(1.0).chain(costs.iter().zip(&c.work).map(share)).collect()
        };
        let vectors: Vec<Vec<f64>> = pool.candidates.iter().map(vector).collect();
        let width = vectors.first().map_or(0, Vec::len);
        let mut inverse = vec![0.0; width * width];
        for i in 0..width {
            inverse[i * width + i] = 1.0 / RIDGE;
        }
        let taken = vec![false; vectors.len()];
        Self { vectors, inverse, width, taken }
    }

    /// Returns the increase of ln det of the information matrix if a frame is added.
    fn gain(&self, i: usize) -> f64 {
        let v = &self.vectors[i];
        let quadratic: f64 =
            self.inverse.chunks_exact(self.width).zip(v).map(|(row, x)| x * dot(row, v)).sum();
        quadratic.max(0.0).ln_1p()
    }

    /// Adds a frame to the design (rank-one update of the inverse).
    pub(crate) fn take(&mut self, i: usize) {
        self.taken[i] = true;
        let v = &self.vectors[i];
        let product: Vec<f64> = self.inverse.chunks_exact(self.width).map(|row| dot(row, v)).collect();
        let scale = 1.0 / (1.0 + dot(&product, v));
        for (row, a) in self.inverse.chunks_exact_mut(self.width).zip(&product) {
            for (slot, b) in row.iter_mut().zip(&product) {
                *slot -= scale * a * b;
            }
        }
    }

    /// Chooses frames until their `seconds` add up to `budget` or `most` frames are chosen. Every second
    /// chosen frame is the next random candidate, so that the error estimate is for typical frames.
    pub(crate) fn choose(&mut self, pool: &Pool, seconds: &[f64], budget: f64, most: usize) -> Vec<usize> {
        let mut out = Vec::new();
        let mut spent = 0.0;
        // A single frame takes at most 12 % of the budget.
        let affordable = |i: usize| seconds[i] <= 0.12 * budget;
        let random_order = random_order(pool);
        let candidates: Vec<f64> =
            (0..seconds.len()).filter(|&i| affordable(i)).map(|i| seconds[i]).collect();
        let mean = candidates.iter().sum::<f64>() / candidates.len().max(1) as f64;
        let exponent = if most as f64 * mean <= budget { 0.0 } else { COST_EXPONENT };
        while out.len() < most && spent < budget {
            let free = |i: &usize| !self.taken[*i] && affordable(*i) && spent + seconds[*i] <= 1.05 * budget;
            let next = if out.len() % 2 == 0 { random_order.iter().copied().find(free) } else { None };
            // Random candidates are left for the random draws as long as other candidates remain, so that the
            // frames on which the error is estimated are not chosen by their gain.
            let best = |random: bool| {
                (0..self.vectors.len())
                    .filter(|&i| free(&i) && pool.candidates[i].random == random)
                    .map(|i| (i, self.gain(i) / seconds[i].max(1e-4).powf(exponent)))
                    .max_by(|a, b| a.1.total_cmp(&b.1))
                    .map(|c| c.0)
            };
            let Some(next) = next.or_else(|| best(false)).or_else(|| best(true)) else { break };
            self.take(next);
            spent += seconds[next];
            out.push(next);
        }
        out
    }
}

/// Returns the random candidates in rounds: each round contains one candidate of each volume and enlargement.
fn random_order(pool: &Pool) -> Vec<usize> {
    let mut seen = std::collections::BTreeMap::new();
    let mut out: Vec<(usize, usize)> = pool
        .candidates
        .iter()
        .enumerate()
        .filter(|(_, c)| c.random)
        .map(|(i, c)| {
            let place = seen.entry((c.volume, c.factor)).or_insert(0usize);
            *place += 1;
            (*place, i)
        })
        .collect();
    out.sort_unstable();
    out.into_iter().map(|o| o.1).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_io::dataset::TimedFrame;
    use entire_steer::numeric::solve;
    use entire_steer::predict::{COSTS, UnitCosts};

    /// Returns one candidate for each entry of `amounts`. The entry has the candidate's amounts of the first
    /// two kinds of work; the amounts of all other kinds are 1.
    fn pool(amounts: &[[f64; 2]]) -> Pool {
        let candidate = |amounts: &[f64; 2]| {
            let mut work = [1.0; COSTS];
            work[..2].copy_from_slice(amounts);
            let scene = TimedFrame::of_no_volume("v", "").scene;
            Candidate { volume: 0, factor: 1, scene, work, random: false }
        };
        Pool {
            files: Vec::new(),
            candidates: amounts.iter().map(candidate).collect(),
            prior: UnitCosts::SOFTWARE,
            expected: vec![1.0; amounts.len()],
        }
    }

    /// Returns ln det of the information matrix of frames, from its Cholesky factor, without `Design`.
    fn log_det(vectors: &[&Vec<f64>]) -> f64 {
        let m = vectors[0].len();
        let mut gram = vec![0.0; m * m];
        for i in 0..m {
            gram[i * m + i] = RIDGE;
            for j in 0..m {
                gram[i * m + j] += vectors.iter().map(|v| v[i] * v[j]).sum::<f64>();
            }
        }
        let mut factor = gram;
        let zeros = vec![0.0; m];
        assert!(solve(&mut factor, zeros).is_some());
        (0..m).map(|i| 2.0 * factor[i * m + i].ln()).sum()
    }

    #[test]
    fn greedy_choice_adds_the_most_information() {
        let rows: Vec<[f64; 2]> = (0..40).map(|i| [(i * 7 % 11) as f64, (i * i % 13) as f64]).collect();
        let pool = pool(&rows);
        let costs = [1.0; COSTS];
        let seconds = vec![1.0; rows.len()];
        let mut design = Design::new(&pool, &costs);
        let vectors = design.vectors.clone();
        let chosen = design.choose(&pool, &seconds, 1e3, 6);
        assert_eq!(chosen.len(), 6);
        // Each choice is checked: no other frame would have made the determinant larger.
        for k in 1..chosen.len() {
            let with = |i: usize| {
                let mut all: Vec<&Vec<f64>> = chosen[..k].iter().map(|&c| &vectors[c]).collect();
                all.push(&vectors[i]);
                log_det(&all)
            };
            let best =
                (0..rows.len()).filter(|i| !chosen[..k].contains(i)).map(with).fold(f64::MIN, f64::max);
            assert!(with(chosen[k]) > best - 1e-6, "{k}: {} {best}", with(chosen[k]));
        }
    }

    #[test]
    fn seconds_count_only_where_they_are_the_limit() {
        // The last candidate is the most informative and takes longest.
        let rows: Vec<[f64; 2]> =
            (0..200).map(|i| if i == 199 { [90.0, 0.0] } else { [(i % 3) as f64, (i % 4) as f64] }).collect();
        let pool = pool(&rows);
        let mut seconds = vec![0.2; rows.len()];
        seconds[199] = 2.0;
        let first_by_design =
            |most: usize| Design::new(&pool, &[1.0; COSTS]).choose(&pool, &seconds, 20.0, most)[0];
        assert_eq!(first_by_design(10), 199);
        assert_ne!(first_by_design(400), 199);
    }

    #[test]
    fn frames_that_cost_too_much_and_budgets_are_kept() {
        let rows: Vec<[f64; 2]> = (0..30).map(|i| [(i % 5) as f64, (i % 7) as f64]).collect();
        let pool = pool(&rows);
        let mut seconds = vec![0.05; rows.len()];
        seconds[3] = 0.9;
        let mut design = Design::new(&pool, &[1.0; COSTS]);
        let chosen = design.choose(&pool, &seconds, 1.0, 100);
        assert!(!chosen.contains(&3));
        let spent: f64 = chosen.iter().map(|&i| seconds[i]).sum();
        assert!((0.9..=1.06).contains(&spent), "{spent}");
        // A chosen frame is not chosen again.
        let again = design.choose(&pool, &seconds, 1.0, 100);
        assert!(again.iter().all(|i| !chosen.contains(i)));
    }
}
