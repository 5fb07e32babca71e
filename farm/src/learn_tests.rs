use super::*;

fn rng() -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(3)
}

/// A model for tasks of 12 volumes, and the true seconds: base · 2.5 · e^(effect of the volume + noise).
fn world(noise: f64) -> (Learner, Vec<f64>) {
    let mut rng = rng();
    let effects: Vec<f64> = (0..12).map(|_| 0.2 * normal(&mut rng)).collect();
    let base: Vec<f64> = (0..1200).map(|i| 0.01 * (1.0 + f64::from(i % 37))).collect();
    let volume: Vec<usize> = (0..1200).map(|i| i / 100).collect();
    let truth =
        (0..1200).map(|i| base[i] * 2.5 * (effects[volume[i]] + noise * normal(&mut rng)).exp()).collect();
    (Learner::new(Shape::of_volumes(&base, &volume)), truth)
}

/// Fits the model to the true times of tasks.
fn observe(learner: &mut Learner, truth: &[f64], tasks: impl IntoIterator<Item = usize>) {
    for t in tasks {
        learner.observe(t, 0, truth[t]);
    }
    learner.refit();
}

#[test]
fn scale_volumes_and_scatter_are_found() {
    let (mut learner, truth) = world(0.1);
    observe(&mut learner, &truth, (0..1200).step_by(7));
    let errors: Vec<f64> =
        (0..1200).filter(|t| t % 7 != 0).map(|t| (truth[t] / learner.seconds(t)).ln()).collect();
    let sd = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    assert!(sd < 0.12, "{sd}");
    assert!((learner.sigma2.sqrt() - 0.1).abs() < 0.02, "{}", learner.sigma2);
    // Sums are unbiased: expected seconds are means, not medians.
    let (sum, expected) = (truth.iter().sum::<f64>(), (0..1200).map(|t| learner.seconds(t)).sum::<f64>());
    assert!((sum / expected - 1.0).abs() < 0.02, "{sum} {expected}");
}

#[test]
fn a_volume_that_was_never_seen_is_uncertain_and_bounds_hold() {
    let (mut learner, truth) = world(0.1);
    observe(&mut learner, &truth, (0..1200).filter(|t| t % 3 == 0 && *t / 100 != 5));
    let spread = |tasks: &[u32]| learner.upper(tasks, 0.95) / learner.upper(tasks, 0.5);
    let (seen, unseen): (Vec<u32>, Vec<u32>) = ((400..500).collect(), (500..600).collect());
    assert!(spread(&unseen) > 1.15 && spread(&seen) < 1.06, "{} {}", spread(&unseen), spread(&seen));
    // The total of each volume's tasks is below 1.1 times the 99 % bound.
    for v in 0..12u32 {
        let tasks: Vec<u32> = (v * 100..v * 100 + 100).collect();
        let sum: f64 = tasks.iter().map(|t| truth[*t as usize]).sum();
        assert!(sum < 1.1 * learner.upper(&tasks, 0.99), "volume {v}");
    }
}

#[test]
fn slow_nodes_are_told_from_long_tasks_and_a_hung_task_spoils_nothing() {
    let (mut learner, truth) = world(0.05);
    for t in 0..600 {
        let node = t % 3;
        let slow = if node == 2 { 2.0 } else { 1.0 };
        let hung = if t == 100 { 1000.0 } else { 1.0 };
        learner.observe(t, node, truth[t] * slow * hung);
    }
    learner.refit();
    let ratio = learner.speed(0) / learner.speed(2);
    assert!((ratio - 2.0).abs() < 0.1, "{ratio}");
    assert!((learner.speed(0) / learner.speed(1) - 1.0).abs() < 0.05);
    let error =
        (700..800).map(|t| truth[t]).sum::<f64>() / (700..800).map(|t| learner.seconds(t)).sum::<f64>();
    // Volume 7 has no observation, so the ratio of its true to its expected seconds may be up to e^0.7.
    assert!(error.ln().abs() < 0.7, "{error}");
    assert!(learner.sigma2.sqrt() < 0.12, "{}", learner.sigma2);
}

#[test]
fn the_posterior_is_that_of_the_whole_system() {
    // Compares with the dense system of all unknowns: eliminating volumes must give the same values.
    let (mut learner, truth) = world(0.1);
    observe(&mut learner, &truth, (0..1200).step_by(11).take(60));
    let d = learner.beta.len();
    let n = d + learner.shape.volumes;
    let (mut a, mut b) = (vec![0.0; n * n], vec![0.0; n]);
    let mut x = vec![0.0; d];
    for s in &learner.seen {
        learner.x(s.task as usize, &mut x);
        let mut row = x.clone();
        row.resize(n, 0.0);
        row[d + learner.shape.volume(s.task as usize)] = 1.0;
        let middle = learner.log_of(&learner.beta, &learner.effects, s.task as usize);
        let clip = HUBER * learner.sigma2.sqrt();
        let y = s.y.clamp(middle - clip, middle + clip);
        for i in 0..n {
            b[i] += row[i] * y / learner.sigma2;
            for j in 0..n {
                a[i * n + j] += row[i] * row[j] / learner.sigma2;
            }
        }
    }
    for k in 0..n {
        a[k * n + k] += if k < d { PRIOR[k].powi(-2) } else { 1.0 / learner.tau2 };
    }
    let solved = solve(&mut a, b).unwrap();
    // The variances were updated after β was computed, so the two solutions differ slightly.
    for k in 0..n {
        let own = if k < d { learner.beta[k] } else { learner.effects[k - d] };
        assert!((own - solved[k]).abs() < 0.01, "{k}: {own} {}", solved[k]);
    }
}

#[test]
fn the_normal_distribution_is_that_of_tables() {
    for (x, share) in [(0.0, 0.5), (1.0, 0.841_344_746), (-2.5, 0.006_209_665), (3.5, 0.999_767_371)] {
        assert!((normal_below(x) - share).abs() < 1e-8, "{x}: {}", normal_below(x));
    }
    assert!((normal_below(-6.0) / 9.865_876e-10 - 1.0).abs() < 1e-5, "{}", normal_below(-6.0));
}

#[test]
fn a_task_that_still_runs_is_drawn_longer_and_says_how_probable_that_is() {
    let (mut learner, truth) = world(0.1);
    observe(&mut learner, &truth, (0..1200).step_by(40));
    let mut rng = rng();
    let draw = learner.draw(&mut rng);
    let middle = learner.seconds(7);
    let (mut last, mut all) = (1.0, Vec::new());
    for share in [0.3, 0.9, 1.0, 1.2, 3.0] {
        let (seconds, probable) = learner.drawn_beyond(&draw, 7, share * middle, &mut rng);
        assert!(seconds > share * middle && probable <= last, "{share}: {seconds} {probable}");
        (last, all) = (probable, [all, vec![probable]].concat());
    }
    assert!(all[0] > 0.999 && all[4] < 0.01, "{all:?}");
}

#[test]
fn a_list_in_a_wrong_unit_gives_no_infinite_times() {
    for base in [1e12, 1e300] {
        let shape = Shape::of_volumes(&[base; 2], &[0; 2]).with_constant(CONSTANT_SD_WITH_MODEL);
        let mut learner = Learner::new(shape);
        learner.observe(0, 0, 0.01);
        assert!(learner.all_seconds()[1].is_finite() && learner.upper(&[1], 0.99).is_finite(), "{base}");
    }
}
