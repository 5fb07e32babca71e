//! Reference for schedulers: a local search with many random starts. It knows the measured times and the
//! times to load volumes.

use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use rayon::prelude::*;

/// A scheduling problem: tasks with their volumes, and the times to load volumes.
#[derive(Clone, Debug)]
pub(super) struct Problem<'a> {
    pub(super) seconds: &'a [f64],
    pub(super) volume: &'a [usize],
    /// Seconds to load each volume.
    pub(super) load: &'a [f64],
    /// Number of nodes, all equally fast.
    pub(super) nodes: usize,
}

struct State<'a> {
    problem: &'a Problem<'a>,
    node_of: Vec<usize>,
    count: Vec<u32>,
    ends: Vec<f64>,
}

impl<'a> State<'a> {
    fn new(problem: &'a Problem<'a>) -> Self {
        let cells = problem.nodes * problem.load.len();
        Self {
            problem,
            node_of: vec![usize::MAX; problem.seconds.len()],
            count: vec![0; cells],
            ends: vec![0.0; problem.nodes],
        }
    }

    fn cell(&self, node: usize, task: usize) -> usize {
        node * self.problem.load.len() + self.problem.volume[task]
    }

    fn adds(&self, node: usize, task: usize) -> f64 {
        let load = self.problem.load[self.problem.volume[task]];
        self.problem.seconds[task] + if self.count[self.cell(node, task)] == 0 { load } else { 0.0 }
    }

    /// Seconds that removing a task would save on its node.
    fn frees(&self, task: usize) -> f64 {
        let load = self.problem.load[self.problem.volume[task]];
        let alone = self.count[self.cell(self.node_of[task], task)] == 1;
        self.problem.seconds[task] + if alone { load } else { 0.0 }
    }

    fn put(&mut self, node: usize, task: usize) {
        self.ends[node] += self.adds(node, task);
        let cell = self.cell(node, task);
        self.count[cell] += 1;
        self.node_of[task] = node;
    }

    fn take(&mut self, task: usize) {
        let node = self.node_of[task];
        self.ends[node] -= self.frees(task);
        let cell = self.cell(node, task);
        self.count[cell] -= 1;
    }

    fn last(&self) -> usize {
        (0..self.ends.len()).fold(0, |m, n| if self.ends[n] > self.ends[m] { n } else { m })
    }

    /// Moves and exchanges tasks of the node that ends last until the best estimated change does not shorten
    /// the schedule.
    fn improve(&mut self) {
        loop {
            let last = self.last();
            let longest = self.ends[last];
            let mut best: Option<(f64, usize, usize, Option<usize>)> = None;
            let tasks: Vec<usize> = (0..self.node_of.len()).filter(|t| self.node_of[*t] == last).collect();
            for &task in &tasks {
                let freed = self.frees(task);
                for node in (0..self.ends.len()).filter(|n| *n != last) {
                    let end = (longest - freed).max(self.ends[node] + self.adds(node, task));
                    if end < longest - 1e-9 && best.is_none_or(|b| end < b.0) {
                        best = Some((end, task, node, None));
                    }
                }
                for other in (0..self.node_of.len()).filter(|t| self.node_of[*t] != last) {
                    let node = self.node_of[other];
                    // If both tasks are of one volume, `end` may be too early; the exact end is computed
                    // below.
                    let there = self.ends[node] - self.frees(other) + self.adds(node, task);
                    let here = longest - freed + self.adds(last, other);
                    let end = here.max(there);
                    if end < longest - 1e-9 && best.is_none_or(|b| end < b.0) {
                        best = Some((end, task, node, Some(other)));
                    }
                }
            }
            let Some((_, task, node, other)) = best else { return };
            let before = self.ends.clone();
            self.take(task);
            if let Some(other) = other {
                self.take(other);
                self.put(last, other);
            }
            self.put(node, task);
            if self.ends[last].max(self.ends[node]) >= longest - 1e-9 {
                // Both tasks are of one volume, and the change does not shorten the schedule: it is undone.
                self.take(task);
                if let Some(other) = other {
                    self.take(other);
                    self.put(node, other);
                }
                self.put(last, task);
                self.ends = before;
                return;
            }
        }
    }
}

/// Returns the numbers from 0 to `n` − 1 in random order.
pub(super) fn shuffled(n: usize, rng: &mut ChaCha8Rng) -> Vec<usize> {
    let mut out: Vec<usize> = (0..n).collect();
    for i in (1..n).rev() {
        out.swap(i, (rng.next_u64() % (i as u64 + 1)) as usize);
    }
    out
}

/// Returns the shortest makespan from `starts` random starts. Starts with even numbers fill one node after
/// the other, volume by volume in random order. Starts with odd numbers assign tasks in random order, each to
/// the node that then ends first.
pub(super) fn best_of(problem: &Problem<'_>, starts: u64) -> f64 {
    (0..starts)
        .into_par_iter()
        .map(|seed| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut state = State::new(problem);
            if seed.is_multiple_of(2) {
                let rank = shuffled(problem.load.len(), &mut rng);
                let mut tasks = shuffled(problem.seconds.len(), &mut rng);
                tasks.sort_by_key(|t| rank[problem.volume[*t]]);
                let loads: f64 = problem.load.iter().sum::<f64>()
                    + problem.load.iter().sum::<f64>() / problem.load.len() as f64 * problem.nodes as f64;
                let share = (problem.seconds.iter().sum::<f64>() + loads) / problem.nodes as f64;
                let mut node = 0;
                for task in tasks {
                    if state.ends[node] + 0.5 * problem.seconds[task] > share && node + 1 < problem.nodes {
                        node += 1;
                    }
                    state.put(node, task);
                }
            } else {
                for task in shuffled(problem.seconds.len(), &mut rng) {
                    let done = |n: &usize| state.ends[*n] + state.adds(*n, task);
                    let node = (0..problem.nodes).min_by(|a, b| done(a).total_cmp(&done(b))).unwrap_or(0);
                    state.put(node, task);
                }
            }
            state.improve();
            state.ends.iter().copied().fold(0.0, f64::max)
        })
        .reduce(|| f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_problems_are_solved() {
        // Two volumes on two nodes: in the best schedule, each node loads one volume.
        let (seconds, volume) = (vec![3.0, 1.0, 2.0, 2.0, 1.0, 3.0], vec![0, 0, 0, 1, 1, 1]);
        let p = Problem { seconds: &seconds, volume: &volume, load: &[5.0, 5.0], nodes: 2 };
        assert_eq!(best_of(&p, 20), 11.0);
        // Without loading times, the best schedule balances the seconds of the tasks.
        let p = Problem { load: &[0.0, 0.0], ..p };
        assert_eq!(best_of(&p, 20), 6.0);
    }
}
