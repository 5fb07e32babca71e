use super::*;

fn ask<'a>(held: Option<usize>, load: &'a dyn Fn(usize) -> f64, slots: usize) -> Ask<'a> {
    Ask { held, keeps: true, load, overhead: 0.0, slots, limit: f64::INFINITY, blind: false, explore: 0 }
}

/// A dispatcher in whose queue all tasks wait; the longest is sent first.
fn queued(seconds: Vec<f32>, volume: Vec<u32>, volumes: usize) -> Dispatcher {
    let tasks = 0..seconds.len() as u32;
    let mut d = Dispatcher::new(seconds, volume, volumes, Order::Longest);
    d.add(tasks);
    d
}

#[test]
fn the_longest_is_first_and_every_task_comes_once() {
    let seconds: Vec<f32> = (0..500).map(|i| 1.0 + (i * 37 % 101) as f32).collect();
    let mut d = queued(seconds.clone(), (0..500).map(|i| i % 7).collect(), 7);
    let mut out = Vec::new();
    while let Some(bundle) = d.next(&ask(None, &|_| 0.0, 3)) {
        assert_eq!(bundle.len(), 1);
        out.extend(bundle);
        if out.len() == 100 {
            // A task that was sent is queued again in its place. A task that waits is not queued twice.
            d.add_again(out[3]);
            d.add_again(*d.lanes[0].last().unwrap());
        }
    }
    assert_eq!(out.len(), 501);
    let falling = out.windows(2).filter(|w| seconds[w[0] as usize] >= seconds[w[1] as usize]).count();
    assert_eq!(falling, 499);
    assert!(d.work() < 1e-3 && d.pending() == 0);
}

#[test]
fn corrected_times_change_the_order() {
    let mut d = queued(vec![1.0, 2.0, 3.0, 4.0], vec![0, 0, 1, 1], 2);
    assert_eq!(d.next(&ask(None, &|_| 0.0, 1)), Some(vec![3]));
    d.reorder(vec![9.0, 2.0, 3.0, 4.0]);
    assert_eq!(d.next(&ask(None, &|_| 0.0, 1)), Some(vec![0]));
    let mut d = Dispatcher::new(vec![1.0, 2.0, 3.0, 4.0], vec![0, 1, 0, 1], 2, Order::Arrival);
    d.add(0..4);
    let order: Vec<u32> = std::iter::from_fn(|| d.next(&ask(None, &|_| 0.0, 1))).flatten().collect();
    assert_eq!(order, [0, 1, 2, 3]);
}

#[test]
fn bundles_are_as_large_as_their_sending_is_worth_and_shrink_at_the_end() {
    let mut d = queued(vec![0.1; 10_000], vec![0; 10_000], 1);
    let mut sizes = Vec::new();
    let load = |_: usize| 0.0;
    while let Some(bundle) = d.next(&Ask { overhead: 0.5, ..ask(None, &load, 4) }) {
        sizes.push(bundle.len());
    }
    // The first bundle takes at most 50 times its overhead, which is 25 s: 250 tasks, or 249 because of
    // rounding. The last bundles are limited by the remaining work.
    assert!((249..=250).contains(&sizes[0]) && sizes.iter().sum::<usize>() == 10_000, "{sizes:?}");
    assert!(*sizes.last().unwrap() <= 15 && sizes[sizes.len() - 2] >= 4, "{sizes:?}");
    assert!(sizes.windows(2).all(|w| w[1] <= w[0]), "{sizes:?}");
}

#[test]
fn bundles_of_unknown_tasks_keep_to_the_limit() {
    let load = |_: usize| 0.0;
    let unknown = |limit: f64| {
        let mut d = queued(vec![1.0; 1000], vec![0; 1000], 1);
        d.next(&Ask { limit, blind: true, ..ask(None, &load, 5) }).unwrap().len()
    };
    assert_eq!([f64::INFINITY, 40.0, 0.5].map(unknown), [50, 20, 1]);
}

#[test]
fn a_bundle_keeps_to_the_limit_with_its_loading() {
    let load = |_: usize| 60.0;
    for blind in [false, true] {
        let mut d = queued(vec![1.0; 200], vec![0; 200], 1);
        let asked = Ask { limit: 100.0, overhead: 1.0, blind, ..ask(None, &load, 1) };
        let first = d.next(&asked).unwrap().len();
        assert!((30..=39).contains(&first), "{first}");
    }
}

#[test]
fn a_node_stays_with_its_volume_where_loading_costs() {
    let mut d = queued(vec![1.0; 60], (0..60).map(|i| i % 3).collect(), 3);
    let load = |_: usize| 4.0;
    let mut held = None;
    let mut changes = 0;
    while let Some(bundle) = d.next(&ask(held, &load, 1)) {
        let v = bundle[0] as usize % 3;
        assert!(bundle.iter().all(|t| *t as usize % 3 == v));
        if held != Some(v) {
            d.hold(held, Some(v));
            held = Some(v);
            changes += 1;
        }
    }
    assert_eq!(changes, 3);
    assert_eq!(d.pending(), 0);
}

#[test]
fn orders_are_those_of_a_plain_search() {
    // A search through all waiting tasks finds the one with the longest expected time; each answer must be
    // this task. Of tasks with equal times, it is the one with the lowest index of its volume, then the
    // lowest number. Many times are equal. Between the answers, times are corrected and tasks are queued
    // again.
    let n = 900u32;
    let seconds =
        |round: u32| (0..n).map(|t| 0.5 + ((t * 7919 + round * 31) % 97) as f32 / 8.0).collect::<Vec<_>>();
    let volume: Vec<u32> = (0..n).map(|t| t * 31 % 11).collect();
    let mut d = Dispatcher::new(seconds(0), volume.clone(), 11, Order::Longest);
    let mut waits = vec![true; n as usize];
    d.add(0..n);
    let mut known = seconds(0);
    for step in 0..n {
        if step % 60 == 59 {
            known = seconds(step);
            // Queues a task again that was sent before.
            let back = (0..n).find(|t| !waits[*t as usize]).unwrap();
            waits[back as usize] = true;
            d.add_again(back);
            d.reorder(known.clone());
        }
        let longest = (0..n)
            .filter(|t| waits[*t as usize])
            .max_by(|a, b| {
                let key = |t: u32| (known[t as usize].to_bits(), Reverse((volume[t as usize], t)));
                key(*a).cmp(&key(*b))
            })
            .unwrap();
        assert_eq!(d.next(&ask(None, &|_| 0.0, 5)), Some(vec![longest]), "{step}");
        waits[longest as usize] = false;
    }
}

#[test]
fn a_copy_draws_the_same_random_numbers() {
    let mut random = Random(ChaCha8Rng::seed_from_u64(3));
    // A number has two words, and the generator makes blocks of 16 words or more at once: the copies begin at
    // all places of a block.
    for _ in 0..70 {
        let mut copy = random.clone();
        let drawn: Vec<u64> = (0..100).map(|_| copy.0.next_u64()).collect();
        let mut again = random.clone();
        assert!(drawn.iter().all(|n| again.0.next_u64() == *n));
        assert_eq!(random.0.next_u64(), drawn[0]);
    }
}
