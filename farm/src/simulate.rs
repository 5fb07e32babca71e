//! A discrete-event simulator of farms. It runs the planner of real engines on tasks with given true times.
//! Bundles have latency, volumes are loaded, nodes differ in speed and fail.

use super::dispatch::Time;
use super::list::Span;
use super::planner::Planner;
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use std::collections::{BTreeMap, HashSet};

/// The simulated world: durations, speeds and failures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct World {
    /// True seconds of the tasks on a node of speed 1.
    pub seconds: Vec<f64>,
    /// Index of each task's volume.
    pub volume: Vec<usize>,
    /// Seconds to load each volume.
    pub load: Vec<f64>,
    /// Relative speed of each slot.
    pub speeds: Vec<f64>,
    /// Latency of each bundle on its slot, seconds.
    pub latency: f64,
    /// True if each bundle is sent to a given slot, which keeps its volume.
    pub bound: bool,
    /// Mean number of failures of a slot per hour. At a failure, the slot's bundle is lost.
    pub failures_per_hour: f64,
    /// Seconds until a failed slot is back, without its volume.
    pub repair: f64,
    /// Seed of the failures.
    pub seed: u64,
}

/// Result of a simulated run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outcome {
    /// End of the last task, seconds from the beginning.
    pub makespan: f64,
    /// Tasks in the order in which they ended; the nodes are the slots.
    pub ran: Vec<Span>,
    /// Number of bundles that were sent.
    pub bundles: usize,
    /// Number of times that a volume was loaded.
    pub loads: usize,
    /// Number of bundles that were lost.
    pub lost: usize,
    /// Estimate of the end at each share of the argument `ask_at` of [`simulate`]: quantiles 0.05, 0.5, 0.95,
    /// seconds.
    pub said: Vec<[f64; 3]>,
}

enum Event {
    Free(usize),
    Done { bundle: u64, task: u32, slot: usize, start: f64, seconds: f64, load: f64 },
    Over { bundle: u64, slot: usize },
    Lost { bundle: u64, slot: usize },
}

/// Simulates a plan. `ask_at`: ascending shares of the true work after which the planner estimates the end.
pub fn simulate(planner: &mut Planner, world: &World, ask_at: &[f64]) -> Outcome {
    let slots = world.speeds.len();
    let mut rng = ChaCha8Rng::seed_from_u64(world.seed);
    let mut out = Outcome::default();
    let mut events: BTreeMap<(Time, u64), Event> = BTreeMap::new();
    let mut count = 0;
    // The counter keeps events of equal times in order.
    let mut push = |events: &mut BTreeMap<(Time, u64), Event>, at: f64, event: Event| {
        count += 1;
        events.insert((Time(at), count), event);
    };
    for slot in 0..slots {
        push(&mut events, 0.0, Event::Free(slot));
    }
    let total: f64 = world.seconds.iter().sum();
    let mut ask_at: Vec<f64> = ask_at.iter().rev().copied().collect();
    let mut worked = 0.0;
    let mut held: Vec<Option<usize>> = vec![None; slots];
    let mut loaded: HashSet<(usize, usize)> = HashSet::new();
    let mut idle: Vec<usize> = Vec::new();
    while let Some(((Time(now), _), event)) = events.pop_first() {
        let mut asks: Vec<usize> = Vec::new();
        match event {
            Event::Free(slot) => asks.push(slot),
            Event::Done { bundle, task, slot, start, seconds, load } => {
                planner.done(bundle, task, slot, seconds, load);
                if load > 0.0 {
                    let volume = world.volume[task as usize];
                    let warm = !loaded.insert((slot, volume));
                    planner.loads.observe(volume, warm, load);
                }
                worked += world.seconds[task as usize];
                out.ran.push(Span { task: task as usize, node: slot, start, end: now });
                out.makespan = now;
                while ask_at.last().is_some_and(|share| worked >= share * total) {
                    ask_at.pop();
                    out.said.push(planner.eta(now).map(|s| now + s));
                }
            }
            Event::Over { bundle, slot } => {
                planner.ended(bundle, now);
                asks.push(slot);
                asks.append(&mut idle);
            }
            Event::Lost { bundle, slot } => {
                out.lost += 1;
                planner.ended(bundle, now);
                held[slot] = None;
                if world.bound {
                    planner.forget(slot);
                }
                push(&mut events, now + world.repair, Event::Free(slot));
                asks.append(&mut idle);
            }
        }
        for slot in asks {
            let Some(sent) = planner.next(world.bound.then_some(slot), now) else {
                idle.push(slot);
                continue;
            };
            out.bundles += 1;
            let mut at = now + world.latency;
            planner.begun(sent.bundle, at);
            let lost_at = if world.failures_per_hour > 0.0 {
                let unit = ((rng.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
                at - unit.ln() * 3600.0 / world.failures_per_hour
            } else {
                f64::INFINITY
            };
            let mut load = 0.0;
            if !(world.bound && held[slot] == Some(sent.volume)) {
                load = world.load[sent.volume];
                out.loads += 1;
                held[slot] = Some(sent.volume);
            }
            for &task in &sent.tasks {
                let seconds = world.seconds[task as usize] / world.speeds[slot];
                let start = at;
                at += load + seconds;
                if at > lost_at {
                    break;
                }
                let done = Event::Done { bundle: sent.bundle, task, slot, start, seconds, load };
                push(&mut events, at, done);
                load = 0.0;
            }
            let over = if at > lost_at {
                Event::Lost { bundle: sent.bundle, slot }
            } else {
                Event::Over { bundle: sent.bundle, slot }
            };
            push(&mut events, at.min(lost_at), over);
        }
    }
    out
}

#[cfg(test)]
#[path = "simulate_tests.rs"]
mod tests;
