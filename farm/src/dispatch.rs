//! Choice of the next bundle when a node requests work (late binding): the longest tasks are sent first. If
//! loading is expensive, a node keeps its loaded volume as long as this choice shortens the run.

use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use rayon::prelude::*;
use std::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;

/// Maximum number of tasks in a bundle.
const MAX_BUNDLE_TASKS: usize = 4096;
/// Maximum and minimum ratio of a bundle's expected seconds to the seconds of its overhead and loading.
const WORK_PER_OVERHEAD: (f64, f64) = (50.0, 3.0);
/// Minimum number of bundles into which the remaining work per slot is cut.
const BUNDLES_PER_SLOT: f64 = 4.0;

pub(crate) struct Ask<'a> {
    pub(crate) held: Option<usize>,
    /// True if the node keeps a volume from one bundle to the next.
    pub(crate) keeps: bool,
    /// Returns the seconds to load a volume.
    pub(crate) load: &'a dyn Fn(usize) -> f64,
    /// Overhead of a bundle, seconds.
    pub(crate) overhead: f64,
    pub(crate) slots: usize,
    /// Time limit of a bundle, seconds. A bundle of several tasks is expected to take at most half of it
    /// without overhead and loading, and at most all of it with them. A bundle of a single task may exceed
    /// it.
    pub(crate) limit: f64,
    /// True if expected times are only assumed: no model file or list gives them, and few tasks were
    /// measured. A bundle then has at most a quarter of a slot's share of the waiting tasks, and only `limit`
    /// restricts its expected seconds.
    pub(crate) blind: bool,
    /// Interval, in requests, at which the answer is a random task of the volume with the fewest sent tasks,
    /// so that the model learns about every volume; 0 for never. No effect if loading is expensive.
    pub(crate) explore: u32,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Time(pub(crate) f64);

impl Eq for Time {}

impl PartialOrd for Time {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Time {
    fn cmp(&self, other: &Self) -> Ordering {
        self.0.total_cmp(&other.0)
    }
}

/// Random numbers. A copy draws the same numbers as the original.
#[derive(Debug)]
struct Random(ChaCha8Rng);

impl Clone for Random {
    fn clone(&self) -> Self {
        Self(ChaCha8Rng::deserialize_state(&self.0.serialize_state()))
    }
}

/// Waiting tasks. Each volume has a list, whose last entry is the task to send first.
#[derive(Clone, Debug)]
pub(crate) struct Dispatcher {
    seconds: Vec<f32>,
    volume: Vec<u32>,
    waits: Vec<bool>,
    lanes: Vec<Vec<u32>>,
    work: Vec<f64>,
    counts: Vec<u32>,
    holders: Vec<u32>,
    /// The key of each volume's next task, and the volume.
    heap: BinaryHeap<(Time, Reverse<usize>)>,
    /// True for each volume that has an entry in the heap. An entry may be outdated: it is checked when it is
    /// taken.
    listed: Vec<bool>,
    pending: usize,
    asked: u32,
    sent: Vec<u32>,
    /// True if loading is expensive enough to affect the choice of a volume.
    loading: bool,
    /// Number of the request at which `loading` was updated last.
    looked: u32,
    arrival: bool,
    rng: Random,
}

/// Order in which tasks are sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Order {
    /// Longest expected time first.
    #[default]
    Longest,
    /// In the order of the job.
    Arrival,
    /// In the order of the job; predictions are ignored, and all tasks are taken as equally long.
    Uniform,
}

impl Dispatcher {
    /// A dispatcher for tasks with these expected seconds and volumes; no task is queued yet.
    pub(crate) fn new(seconds: Vec<f32>, volume: Vec<u32>, volumes: usize, order: Order) -> Self {
        let n = seconds.len();
        Self {
            seconds,
            volume,
            waits: vec![false; n],
            lanes: vec![Vec::new(); volumes],
            work: vec![0.0; volumes],
            counts: vec![0; volumes],
            holders: vec![0; volumes],
            heap: BinaryHeap::new(),
            listed: vec![false; volumes],
            pending: 0,
            asked: 0,
            sent: vec![0; volumes],
            loading: false,
            looked: 0,
            arrival: order != Order::Longest,
            rng: Random(ChaCha8Rng::seed_from_u64(11)),
        }
    }

    pub(crate) fn pending(&self) -> usize {
        self.pending
    }

    /// Expected seconds of all waiting tasks.
    pub(crate) fn work(&self) -> f64 {
        self.work.iter().sum()
    }

    pub(crate) fn seconds(&self, task: u32) -> f32 {
        self.seconds[task as usize]
    }

    /// Numbers of the waiting tasks, ascending.
    pub(crate) fn waiting(&self) -> impl Iterator<Item = u32> + '_ {
        self.waits.iter().enumerate().filter(|(_, w)| **w).map(|(i, _)| i as u32)
    }

    pub(crate) fn add(&mut self, tasks: impl IntoIterator<Item = u32>) {
        for task in tasks {
            if self.wait(task) {
                self.lanes[self.volume[task as usize] as usize].push(task);
            }
        }
        self.sort();
    }

    pub(crate) fn add_again(&mut self, task: u32) {
        if !self.wait(task) {
            return;
        }
        let v = self.volume[task as usize] as usize;
        let mut lane = std::mem::take(&mut self.lanes[v]);
        lane.retain(|t| *t != task);
        let key = self.key(task);
        let place = lane.partition_point(|t| self.key(*t) <= key);
        lane.insert(place, task);
        self.lanes[v] = lane;
        // The task may be longer than the task in its volume's heap entry, so a new entry is made.
        self.listed[v] = false;
        self.push_front(v);
    }

    fn wait(&mut self, task: u32) -> bool {
        let i = task as usize;
        let new = !self.waits[i];
        if new {
            self.waits[i] = true;
            let v = self.volume[i] as usize;
            self.work[v] += f64::from(self.seconds[i]);
            self.counts[v] += 1;
            self.pending += 1;
        }
        new
    }

    /// Replaces the expected seconds of all tasks and sorts the waiting ones.
    pub(crate) fn reorder(&mut self, seconds: Vec<f32>) {
        self.seconds = seconds;
        self.sort();
    }

    fn sort(&mut self) {
        let (seconds, waits) = (&self.seconds, &self.waits);
        let by_number = self.arrival;
        self.lanes.par_iter_mut().zip(&mut self.work).for_each(|(lane, work)| {
            let waiting = lane.iter().filter(|t| waits[**t as usize]);
            // Sort key of a task: the task to send first has the largest key. The bits of positive floats are
            // ordered like the floats.
            let key = |t: u32| {
                let bits = if by_number { 0 } else { seconds[t as usize].to_bits() };
                u64::from(bits) << 32 | u64::from(u32::MAX - t)
            };
            let mut keys: Vec<u64> = waiting.map(|t| key(*t)).collect();
            keys.sort_unstable();
            keys.dedup();
            lane.clear();
            lane.extend(keys.iter().map(|k| u32::MAX - *k as u32));
            *work = lane.iter().map(|t| f64::from(seconds[*t as usize])).sum();
        });
        self.heap.clear();
        self.listed.fill(false);
        for v in 0..self.lanes.len() {
            self.push_front(v);
        }
    }

    fn key(&self, task: u32) -> Time {
        let key = if self.arrival { -(task as f32) } else { self.seconds[task as usize] };
        Time(f64::from(key))
    }

    /// The next waiting task of a volume. Removes sent tasks from the end of the volume's list.
    fn front(&mut self, v: usize) -> Option<u32> {
        while let Some(&task) = self.lanes[v].last() {
            if self.waits[task as usize] {
                return Some(task);
            }
            self.lanes[v].pop();
        }
        None
    }

    fn push_front(&mut self, v: usize) {
        if let (Some(task), false) = (self.front(v), self.listed[v]) {
            self.listed[v] = true;
            self.heap.push((self.key(task), Reverse(v)));
        }
    }

    fn take(&mut self, task: u32) {
        let (i, v) = (task as usize, self.volume[task as usize] as usize);
        self.waits[i] = false;
        self.work[v] = (self.work[v] - f64::from(self.seconds[i])).max(0.0);
        self.counts[v] -= 1;
        self.sent[v] += 1;
        self.pending -= 1;
    }

    fn pop(&mut self, v: usize) -> Option<u32> {
        let task = self.front(v)?;
        self.lanes[v].pop();
        self.take(task);
        Some(task)
    }

    /// Records that a node holds volume `after` instead of `before`; `None` stands for no volume.
    pub(crate) fn hold(&mut self, before: Option<usize>, after: Option<usize>) {
        if let Some(v) = before {
            self.holders[v] = self.holders[v].saturating_sub(1);
        }
        if let Some(v) = after {
            self.holders[v] += 1;
        }
    }

    /// Returns the next bundle for a node; `None` if no task waits, or if the other nodes would finish the
    /// chosen volume before this node has loaded it.
    pub(crate) fn next(&mut self, ask: &Ask<'_>) -> Option<Vec<u32>> {
        if self.pending == 0 {
            return None;
        }
        self.asked += 1;
        let slots = ask.slots.max(1) as f64;
        let total = self.work();
        // With many tasks `loading` changes slowly, so only every 64th request updates it.
        if self.pending < 10_000 || self.looked == 0 || self.asked - self.looked >= 64 {
            self.looked = self.asked;
            let open = (0..self.lanes.len()).filter(|v| self.counts[*v] > 0 && ask.held != Some(*v));
            let loads: f64 = open.map(|v| (ask.load)(v)).sum();
            self.loading = ask.keeps && !self.arrival && loads > 0.002 * total / slots;
        }
        let volume = if self.loading {
            self.choose(ask, total / slots)?
        } else {
            if ask.explore > 0 && self.asked.is_multiple_of(ask.explore) {
                return self.probe().map(|t| vec![t]);
            }
            self.longest()?
        };
        let cost = ask.overhead + if ask.held == Some(volume) { 0.0 } else { (ask.load)(volume) };
        let share = total / slots;
        let worth = (share / BUNDLES_PER_SLOT)
            .min(WORK_PER_OVERHEAD.0 * cost)
            .max((WORK_PER_OVERHEAD.1 * cost).min(share.max(cost)));
        let limit = (0.5 * ask.limit).min(ask.limit - cost);
        let target = if ask.blind { limit } else { worth.min(limit) };
        let fair = (self.pending as f64 / (slots * BUNDLES_PER_SLOT)).ceil() as usize;
        let most = if ask.blind { fair.min(MAX_BUNDLE_TASKS) } else { MAX_BUNDLE_TASKS };
        let (mut bundle, mut sum) = (Vec::new(), 0.0);
        while bundle.len() < most {
            let Some(task) = self.front(volume) else { break };
            let more = f64::from(self.seconds[task as usize]);
            if !bundle.is_empty() && sum + more > target {
                break;
            }
            self.pop(volume);
            bundle.push(task);
            sum += more;
        }
        self.push_front(volume);
        (!bundle.is_empty()).then_some(bundle)
    }

    /// Returns the volume of the next task in the sending order; with the default order, of the longest
    /// waiting task.
    fn longest(&mut self) -> Option<usize> {
        while let Some((key, Reverse(v))) = self.heap.pop() {
            self.listed[v] = false;
            match self.front(v) {
                Some(task) if self.key(task) == key => return Some(v),
                Some(_) => self.push_front(v),
                None => {}
            }
        }
        // The heap is empty. Every volume with a waiting task has an entry in the heap, so no task waits.
        None
    }

    /// A random task of the volume with the fewest sent tasks.
    fn probe(&mut self) -> Option<u32> {
        let v = (0..self.lanes.len()).filter(|v| self.counts[*v] > 0).min_by_key(|v| self.sent[*v])?;
        let lane = &self.lanes[v];
        for _ in 0..64 {
            let task = lane[(self.rng.0.next_u64() % lane.len() as u64) as usize];
            if self.waits[task as usize] {
                self.take(task);
                self.push_front(v);
                return Some(task);
            }
        }
        let task = self.pop(v);
        self.push_front(v);
        task
    }

    /// Returns the volume from which a node gets its next tasks if loading is expensive.
    ///
    /// While tasks of the node's volume wait, the node keeps this volume, with one exception. It changes to a
    /// volume that no node holds if all of these conditions are met: other nodes hold the current volume too;
    /// the work of the new volume exceeds the work of the current volume per other node; the work of the new
    /// volume and its loading together exceed an equal share of all waiting work.
    ///
    /// If no task of the node's volume waits, the node takes a volume that no node holds, else the volume
    /// with the most work per node. It gets no volume if the other nodes would finish this volume before the
    /// node has loaded it.
    fn choose(&self, ask: &Ask<'_>, share: f64) -> Option<usize> {
        let held = ask.held.filter(|v| self.counts[*v] > 0);
        let open = (0..self.lanes.len()).filter(|v| self.counts[*v] > 0 && held != Some(*v));
        // Work of a volume per node, if this node joins the nodes that hold the volume.
        let per_node = |v: usize| self.work[v] / f64::from(self.holders[v] + 1);
        let best = open.max_by(|a, b| {
            let alone = |v: &usize| self.holders[*v] == 0;
            alone(a).cmp(&alone(b)).then(per_node(*a).total_cmp(&per_node(*b))).then(b.cmp(a))
        });
        let Some(held) = held else {
            let v = best?;
            let load = (ask.load)(v);
            // Work that is left once this node has loaded the volume; the nodes that hold the volume work
            // meanwhile.
            let left = self.work[v] - f64::from(self.holders[v]) * load;
            let shortest = *self.lanes[v].iter().find(|task| self.waits[**task as usize])?;
            let shortest = f64::from(self.seconds[shortest as usize]);
            return (self.holders[v] == 0 || left > shortest).then_some(v);
        };
        let leave = best.filter(|&v| {
            let without = self.work[held] / f64::from(self.holders[held].max(2) - 1);
            self.holders[v] == 0
                && self.holders[held] > 1
                && self.work[v] + (ask.load)(v) > share
                && without < self.work[v]
        });
        Some(leave.unwrap_or(held))
    }
}

#[cfg(test)]
#[path = "dispatch_tests.rs"]
mod tests;
