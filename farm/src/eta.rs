//! Predicted end of a plan from random draws of the model, each simulated as a queue.

use super::{Order, Planner, Running, Time};
use crate::learn::Draw;
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rayon::prelude::*;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Maximum number of tasks whose times are drawn for the expected end. If there are more tasks, every n-th
/// one is drawn.
const MAX_DRAWN_TASKS: usize = 4096;
const DRAWS: usize = 400;
/// Minimum effective number of weighted draws.
const MIN_EFFECTIVE_DRAWS: f64 = 40.0;
/// Maximum number of tasks for which the estimate of the end simulates loading and bundles.
const MAX_PLAYED_TASKS: usize = 20_000;

struct UnderWay<'a> {
    running: &'a Running,
    speed: f64,
    /// Expected seconds of loading before the first task; 0 once a task of the bundle is done.
    load: f64,
    /// Seconds since the bundle's last finished task, or since its beginning if no task is done.
    elapsed: f64,
}

impl Planner {
    /// Seconds until all tasks are done: quantiles 0.05, 0.5 and 0.95 of the draws.
    ///
    /// A running task takes at least the time that it has run: its time is drawn from longer times. A draw of
    /// the model is weighted by the probability that all running tasks still run. Otherwise the estimate
    /// would rely on finished tasks only, and tasks that finish first tend to be short.
    pub fn eta(&self, now: f64) -> [f64; 3] {
        // Tasks that were measured since the last fit tend to be long; without them, the predicted end would
        // be too early.
        if !self.learner.is_fresh() && self.learner.observed() <= MAX_PLAYED_TASKS {
            let mut copy = self.clone();
            copy.learner.refit();
            return copy.eta(now);
        }
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut tasks: Vec<u32> = self.stages.iter().flatten().copied().collect();
        tasks.extend(self.dispatcher.waiting());
        let all = tasks.len();
        if self.setting.order != Order::Longest {
            tasks.sort_unstable();
        } else {
            // Longest first, then by number. The bits of positive floats are ordered like the floats.
            let key = |t: u32| u64::from(!self.dispatcher.seconds(t).to_bits()) << 32 | u64::from(t);
            let mut keys: Vec<u64> = tasks.iter().map(|t| key(*t)).collect();
            keys.par_sort_unstable();
            tasks.clear();
            tasks.extend(keys.iter().map(|k| *k as u32));
        }
        let stride = all.div_ceil(MAX_DRAWN_TASKS).max(1);
        let scale = all as f64 / all.div_ceil(stride).max(1) as f64;
        let drawn: Vec<u32> = tasks.iter().copied().skip(stride / 2).step_by(stride).collect();
        let speeds: Vec<f64> = (0..self.slots.len())
            .map(|s| if self.setting.bound { self.learner.speed(s) } else { 1.0 })
            .collect();
        // Until the next request, the dispatcher's times may be older than those of the learner.
        let expected: Vec<f64> = drawn.iter().map(|t| self.learner.seconds(*t as usize)).collect();
        let sampled = stride > 1;
        // If all tasks are drawn, a queue is simulated. If they are a sample, the end is all work divided by
        // the sum of all speeds, plus the mean time until a slot is free.
        let end = |times: &[f64], busy: &[f64]| {
            if sampled {
                let work = scale * times.iter().sum::<f64>();
                (work / speeds.iter().sum::<f64>()) + busy.iter().sum::<f64>() / busy.len().max(1) as f64
            } else {
                queue_end(times, busy, &speeds)
            }
        };
        let under_way: Vec<UnderWay<'_>> =
            self.running.values().map(|r| self.under_way(r, now, &speeds)).collect();
        let middle_busy = busy(&under_way, speeds.len(), |u| {
            let work: f64 = u.running.open.iter().map(|t| self.learner.seconds(*t as usize)).sum();
            let whole = u.load + work / u.speed;
            (whole - u.elapsed).max(0.05 * whole)
        });
        let plain = end(&expected, &middle_busy);
        let extra = self.extra(all, &middle_busy, &speeds, plain);
        let ends: Vec<(f64, f64)> = (0..DRAWS)
            .map(|_| {
                let draw = self.learner.draw(&mut rng);
                let times: Vec<f64> =
                    drawn.iter().map(|t| self.learner.drawn_seconds(&draw, *t as usize, &mut rng)).collect();
                let mut log_weight = 0.0;
                let busy = busy(&under_way, speeds.len(), |u| {
                    let (rest, probable) = self.drawn_rest(u, &draw, &mut rng);
                    log_weight += probable.ln();
                    rest
                });
                (end(&times, &busy) + extra, log_weight)
            })
            .collect();
        quantiles(ends)
    }

    fn under_way<'a>(&self, r: &'a Running, now: f64, speeds: &[f64]) -> UnderWay<'a> {
        let since = r.begun.unwrap_or(if self.setting.bound { r.at } else { now });
        let whole: f64 = r.sent.predicted_s.iter().map(|s| f64::from(*s)).sum();
        let slot = r.sent.slot;
        let sent_speed = slot.map_or(1.0, |s| self.learner.speed(s));
        // Loading comes before the first task, so it is finished once a task is done.
        let load = if r.busy > 0.0 { 0.0 } else { (r.sent.expected_s - whole / sent_speed).max(0.0) };
        UnderWay {
            running: r,
            speed: slot.and_then(|s| speeds.get(s)).copied().unwrap_or(1.0),
            load,
            elapsed: (now - since - r.busy).max(0.0),
        }
    }

    /// Returns the remaining seconds of a bundle in a draw, and the probability that its current task still
    /// runs.
    fn drawn_rest(&self, u: &UnderWay<'_>, draw: &Draw, rng: &mut ChaCha8Rng) -> (f64, f64) {
        let Some((first, others)) = u.running.open.split_first() else { return (0.0, 1.0) };
        let others: f64 =
            others.iter().map(|t| self.learner.drawn_seconds(draw, *t as usize, rng)).sum::<f64>() / u.speed;
        let run = u.elapsed - u.load;
        if run <= 0.0 {
            let first = self.learner.drawn_seconds(draw, *first as usize, rng) / u.speed;
            return (first + others - run, 1.0);
        }
        let (first, probable) = self.learner.drawn_beyond(draw, *first as usize, run * u.speed, rng);
        ((first / u.speed - run).max(0.0) + others, probable)
    }

    /// Returns the seconds by which loading and dispatch delay the end. `plain`: seconds until the end of a
    /// queue without loading and dispatch. Simulates the plan with expected times; with more than
    /// [`MAX_PLAYED_TASKS`] tasks, only estimates the delay.
    fn extra(&self, all: usize, busy: &[f64], speeds: &[f64], plain: f64) -> f64 {
        if all == 0 {
            return 0.0;
        }
        if all > MAX_PLAYED_TASKS {
            let mean = self.dispatcher.work() / all as f64;
            let per_bundle = (50.0 * self.overhead / mean.max(1e-9)).clamp(1.0, 4096.0);
            return all as f64 / per_bundle * self.overhead / speeds.len().max(1) as f64;
        }
        let mut copy = self.clone();
        copy.setting.learn = false;
        let bound = copy.setting.bound;
        let mut free: BinaryHeap<Reverse<(Time, usize)>> =
            busy.iter().enumerate().map(|(slot, at)| Reverse((Time(*at), slot))).collect();
        let mut last = 0.0f64;
        while let Some(Reverse((Time(at), slot))) = free.pop() {
            let asked = bound.then_some(slot).filter(|s| *s < copy.slots.len());
            match copy.next(asked, at) {
                Some(sent) => {
                    let end = at + copy.overhead + sent.expected_s;
                    last = last.max(end);
                    free.push(Reverse((Time(end), slot)));
                }
                None => last = last.max(at),
            }
        }
        last - plain
    }
}

/// Returns the seconds until each slot is free. `rest` returns the remaining seconds of a bundle.
fn busy(under_way: &[UnderWay<'_>], slots: usize, mut rest: impl FnMut(&UnderWay<'_>) -> f64) -> Vec<f64> {
    let mut busy = vec![0.0; slots];
    for (k, u) in under_way.iter().enumerate() {
        let rest = rest(u);
        if let Some(slot) = busy.get_mut(u.running.sent.slot.unwrap_or(k)) {
            *slot += rest;
        } else if let Some(least) = busy.iter_mut().min_by(|a, b| f64::total_cmp(a, b)) {
            // There are more bundles than slots: this bundle runs on the slot that is free first.
            *least += rest;
        }
    }
    busy
}

/// Returns the quantiles 0.05, 0.5 and 0.95 of ends, which are given with their log weights. If the effective
/// number of draws is below [`MIN_EFFECTIVE_DRAWS`], the log weights are scaled towards 0.
fn quantiles(mut ends: Vec<(f64, f64)>) -> [f64; 3] {
    let most = ends.iter().map(|e| e.1).fold(f64::NEG_INFINITY, f64::max);
    let weights = |power: f64| -> Vec<f64> { ends.iter().map(|e| (power * (e.1 - most)).exp()).collect() };
    let counting = |w: &[f64]| w.iter().sum::<f64>().powi(2) / w.iter().map(|w| w * w).sum::<f64>();
    let mut power = 1.0;
    let mut found = weights(power);
    while counting(&found) < MIN_EFFECTIVE_DRAWS && power > 1e-3 {
        power *= 0.7;
        found = weights(power);
    }
    for (end, weight) in ends.iter_mut().zip(found) {
        end.1 = weight;
    }
    ends.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = ends.iter().map(|e| e.1).sum();
    [0.05, 0.5, 0.95].map(|share| {
        let mut sum = 0.0;
        let at = ends.iter().find(|(_, weight)| {
            sum += weight;
            sum >= share * total
        });
        at.or(ends.last()).map_or(0.0, |e| e.0)
    })
}

/// Returns the seconds until all tasks of a queue are done, each on the first free slot. `times`: seconds of
/// the tasks at speed 1, in order; `busy`: seconds until each slot is free; `speeds`: speed of each slot.
pub(crate) fn queue_end(times: &[f64], busy: &[f64], speeds: &[f64]) -> f64 {
    let mut last = busy.iter().copied().fold(0.0, f64::max);
    let mut free: BinaryHeap<Reverse<(Time, usize)>> =
        busy.iter().enumerate().map(|(slot, at)| Reverse((Time(*at), slot))).collect();
    for time in times {
        let Some(Reverse((Time(at), slot))) = free.pop() else { return f64::INFINITY };
        let end = at + time / speeds[slot];
        last = last.max(end);
        free.push(Reverse((Time(end), slot)));
    }
    last
}
