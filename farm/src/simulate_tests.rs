use super::*;
use crate::dispatch::Order;
use crate::learn::Shape;
use crate::list::lower_bound;
use crate::list::simulate_queue;
use crate::load::Loads;
use crate::planner::Setting;

fn times(n: usize) -> Vec<f64> {
    (0..n).map(|i| 0.5 + (i * 7919 % 1000) as f64 / 250.0).collect()
}

fn planner(base: &[f64], volume: &[usize], loads: Vec<f64>, slots: usize, learn: bool) -> Planner {
    planner_of(Shape::of_volumes(base, volume), loads, slots, learn)
}

fn planner_of(shape: Shape, loads: Vec<f64>, slots: usize, learn: bool) -> Planner {
    let tasks = (0..shape.len() as u32).collect();
    let setting = Setting { slots, bound: true, overhead: 0.0, limit: None, order: Order::Longest, learn };
    let mut p = Planner::new(shape, Loads::known(loads), setting);
    p.add_stage(tasks);
    p
}

fn world(seconds: Vec<f64>, slots: usize) -> World {
    let n = seconds.len();
    World {
        seconds,
        volume: vec![0; n],
        load: vec![0.0],
        speeds: vec![1.0; slots],
        bound: true,
        ..World::default()
    }
}

#[test]
fn without_costs_it_is_the_plain_queue() {
    let seconds = times(300);
    let mut p = planner(&seconds, &vec![0; 300], vec![0.0], 7, false);
    let out = simulate(&mut p, &world(seconds.clone(), 7), &[]);
    let order = crate::list::longest_first(&seconds).unwrap();
    let queue = simulate_queue(&order, &seconds, &[], &[1.0; 7]).unwrap();
    assert!((out.makespan - queue.makespan).abs() < 1e-6, "{} {}", out.makespan, queue.makespan);
    assert_eq!(out.ran.len(), 300);
    assert!(p.is_over() && p.progress() == (300, 300));
}

#[test]
fn the_queue_is_sorted_again_only_after_a_fit() {
    let seconds = times(100);
    let mut p = planner(&seconds, &vec![0; 100], vec![0.0], 4, true);
    let mut sorted = 0;
    for _ in 0..100 {
        let sent = p.next(Some(0), 0.0).unwrap();
        let task = sent.tasks[0];
        p.done(sent.bundle, task, 0, seconds[task as usize], 0.0);
        p.ended(sent.bundle, 0.0);
        sorted += usize::from(p.refresh());
    }
    assert!((10..30).contains(&sorted), "{sorted}");
}

#[test]
fn the_time_of_a_failed_task_is_no_overhead() {
    let mut p = planner(&[1.0; 4], &[0; 4], vec![0.0], 1, false);
    let sent = p.next(Some(0), 0.0).unwrap();
    sent.tasks.iter().for_each(|task| p.again(sent.bundle, *task));
    p.ended(sent.bundle, 60.0);
    assert_eq!(p.overhead, 0.0);
    let sent = p.next(Some(0), 60.0).unwrap();
    sent.tasks.iter().for_each(|task| p.done(sent.bundle, *task, 0, 1.0, 0.0));
    p.ended(sent.bundle, 60.5 + sent.tasks.len() as f64);
    assert_eq!(p.overhead, 0.5);
}

#[test]
fn losses_are_made_good() {
    let seconds = times(400);
    let mut p = planner(&seconds, &vec![0; 400], vec![0.0], 8, true);
    let mut w = world(seconds, 8);
    (w.failures_per_hour, w.repair) = (60.0, 5.0);
    let out = simulate(&mut p, &w, &[]);
    assert!(out.lost > 5, "{}", out.lost);
    let mut tasks: Vec<usize> = out.ran.iter().map(|r| r.task).collect();
    tasks.sort_unstable();
    assert_eq!(tasks, (0..400).collect::<Vec<_>>());
    // No slot runs two tasks at once.
    let mut by_slot = out.ran.clone();
    by_slot.sort_by(|a, b| a.node.cmp(&b.node).then(a.start.total_cmp(&b.start)));
    assert!(by_slot.windows(2).all(|w| w[0].node != w[1].node || w[0].end <= w[1].start + 1e-9));
}

#[test]
fn slow_nodes_are_learned_and_get_less() {
    let seconds = times(600);
    let mut p = planner(&seconds, &vec![0; 600], vec![0.0], 4, true);
    let mut w = world(seconds.clone(), 4);
    w.speeds = vec![1.0, 1.0, 1.0, 0.25];
    let out = simulate(&mut p, &w, &[]);
    let bound = lower_bound(&seconds, &w.speeds).unwrap();
    assert!(out.makespan < 1.05 * bound, "{} {bound}", out.makespan);
    let ratio = p.learner().speed(0) / p.learner().speed(3);
    assert!((ratio - 4.0).abs() < 0.3, "{ratio}");
}

#[test]
fn the_end_is_foretold() {
    // Base times have errors of three kinds: common to all tasks, common to a volume's tasks, and of single
    // tasks. After a tenth of the work, the 90 % interval must contain the end in at least 15 of 20 runs.
    let (mut hits, mut errors) = (0, Vec::new());
    for seed in 0..20u64 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let base = times(384);
        let volume: Vec<usize> = (0..384).map(|i| i / 64).collect();
        let off: Vec<f64> = (0..6).map(|_| 0.15 * crate::learn::normal(&mut rng)).collect();
        let truth: Vec<f64> = (0..384)
            .map(|i| base[i] * 3.0 * (off[volume[i]] + 0.1 * crate::learn::normal(&mut rng)).exp())
            .collect();
        let mut p = planner(&base, &volume, vec![0.0; 6], 8, true);
        let mut w = world(truth, 8);
        w.volume = volume;
        w.load = vec![0.0; 6];
        let out = simulate(&mut p, &w, &[0.1]);
        let [low, middle, high] = out.said[0];
        hits += usize::from((low..=high).contains(&out.makespan));
        errors.push((middle / out.makespan - 1.0).abs());
    }
    assert!(hits >= 15, "{hits} of 20");
    let middle = entire_io::metrics::median(&mut errors).unwrap();
    assert!(middle < 0.05, "{middle}");
}

#[test]
fn known_loads_are_waited_for_and_counted() {
    let seconds = times(240);
    let volume: Vec<usize> = (0..240).map(|i| i / 40).collect();
    let mut p = planner(&seconds, &volume, vec![8.0; 6], 8, false);
    let mut w = world(seconds.clone(), 8);
    (w.volume, w.load) = (volume, vec![8.0; 6]);
    let out = simulate(&mut p, &w, &[]);
    let busy: f64 = out.ran.iter().map(|r| r.end - r.start).sum();
    assert!((busy - seconds.iter().sum::<f64>() - 8.0 * out.loads as f64).abs() < 1e-6);
    // Six volumes on eight nodes need at least eight loads; a few more loads balance the work.
    assert!((8..=16).contains(&out.loads), "{}", out.loads);
}

/// Returns the end as predicted after a tenth of the work (quantiles 0.05, 0.5 and 0.95), and the actual end.
/// ln of the base times has errors with standard deviations of 0.05 per volume and 0.15 per task, and a
/// common error.
fn foretold(seed: u64, slots: usize) -> ([f64; 3], f64) {
    use crate::learn::{CONSTANT_SD_WITH_MODEL, normal};
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let base: Vec<f64> = (0..384).map(|_| 0.05 * (0.8 * normal(&mut rng)).exp()).collect();
    let volume: Vec<usize> = (0..384).map(|i| i % 13).collect();
    let off: Vec<f64> = (0..13).map(|_| 0.05 * normal(&mut rng)).collect();
    let constant = 0.1 * normal(&mut rng);
    let truth = (0..384).map(|i| base[i] * (constant + off[volume[i]] + 0.15 * normal(&mut rng)).exp());
    let mut w = world(truth.collect(), slots);
    let shape = Shape::of_volumes(&base, &volume).with_constant(CONSTANT_SD_WITH_MODEL);
    let mut p = planner_of(shape, vec![0.0; 13], slots, true);
    (w.volume, w.load) = (volume, vec![0.0; 13]);
    let out = simulate(&mut p, &w, &[0.1]);
    (out.said[0], out.makespan)
}

#[test]
fn on_many_nodes_the_end_is_not_foretold_by_what_is_done_first() {
    // Tasks that take less time than expected finish first. The predicted end must not be biased by them.
    let (mut hits, mut later, n) = (0, 0.0, 60);
    for seed in 0..n {
        let ([low, middle, high], end) = foretold(seed, 16 + 16 * (seed as usize % 2));
        hits += u32::from((low..=high).contains(&end));
        later += (end / middle).ln() / n as f64;
    }
    assert!((48..=59).contains(&hits), "{hits} of {n}");
    assert!(later.abs() < 0.02, "{later}");
}
