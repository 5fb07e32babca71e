//! Nested cross-validation: on predictions that are made up, and on models of frames that tell their member.

use super::data::{Folds, Learned};
use super::nested::{Candidate, Method, Part, evaluate};
use super::tests::telling;
use super::*;
use entire_cli::bound;
use entire_cli::dataset::Clock;
use entire_cli::fit::{Kind, Recipe};
use entire_cli::options::thread_pool;
use entire_cli::split::{GroupBy, TimedFrames};

/// Four members of two volumes each. The second one's frames take a hundred times as long.
fn parts() -> Vec<Part> {
    (0..4)
        .map(|k| Part {
            measured: (1..=10).map(|i| f64::from(i) * if k == 1 { 100.0 } else { 1.0 }).collect(),
            groups: vec![format!("m{k}"); 10],
            volumes: (0..10).map(|i| format!("m{k}/v{}", i % 2)).collect(),
        })
        .collect()
}

/// `[outer][inner]` predictions that are off by a factor.
fn off(parts: &[Part], factor: impl Fn(usize, usize) -> f64) -> Vec<Vec<Vec<f64>>> {
    let of = |outer, inner: usize| {
        let factor = factor(outer, inner);
        parts[inner].measured.iter().map(|t| t * factor).collect()
    };
    (0..parts.len()).map(|outer| (0..parts.len()).map(|inner| of(outer, inner)).collect()).collect()
}

#[test]
fn a_candidate_that_suits_one_member_gains_nothing_from_it() {
    let parts = parts();
    let steady = off(&parts, |_, _| 1.1);
    // By chance right on the member that carries the squared error, and off by half on all others.
    let lucky = off(&parts, |_, inner| if inner == 1 { 1.0 } else { 1.5 });
    let both = [
        Candidate { name: "steady", cold: 1.0, predicted: &steady },
        Candidate { name: "lucky", cold: 1.0, predicted: &lucky },
    ];
    let alone = |i: usize| evaluate(("set", "alone"), &parts, &both[i..=i], None).unwrap();
    let found = evaluate(("set", "rule"), &parts, &both, None).unwrap();
    // Plain cross-validation takes the lucky one, and shows its error.
    assert!(alone(1).metrics.rmse < 0.5 * alone(0).metrics.rmse);
    // Where its member is left out, nothing speaks for it: that member is predicted by the other one.
    let chosen: Vec<&str> = found.folds.iter().map(|f| f.chosen.as_str()).collect();
    assert_eq!(chosen, ["lucky", "steady", "lucky", "lucky"]);
    assert!((found.folds[1].metrics.mdape - 0.1).abs() < 1e-12);
    // What is reported is worse than either candidate: wrong everywhere by the choice itself.
    assert!(found.metrics.rmse >= alone(0).metrics.rmse && found.metrics.rmse > alone(1).metrics.rmse);
    assert!((found.metrics.mdape - 0.5).abs() < 1e-12);
    assert_eq!(found.folds[1].without, ["m1"]);
    // Too slow is never chosen, and nothing is said where nothing is left.
    let slow = [Candidate { cold: 3.0, ..both[0].clone() }, both[1].clone()];
    let quick = evaluate(("set", "rule"), &parts, &slow, Some(2.0)).unwrap();
    assert!(quick.folds.iter().all(|f| f.chosen == "lucky"));
    assert!(evaluate(("set", "rule"), &parts, &slow, Some(0.5)).is_none());
}

#[test]
fn neither_choice_nor_bound_sees_predictions_of_models_that_saw_the_outer_part() {
    let parts = parts();
    let steady = off(&parts, |outer, inner| if outer == inner { 1.1 } else { 1.05 });
    // Models that saw the other members do well (they leave out one part), those that did not do badly.
    let leaky = off(&parts, |outer, inner| if outer == inner { 1.0 } else { 0.5 });
    let both = [
        Candidate { name: "leaky", cold: 1.0, predicted: &leaky },
        Candidate { name: "steady", cold: 1.0, predicted: &steady },
    ];
    let found = evaluate(("set", "rule"), &parts, &both, None).unwrap();
    assert!(found.folds.iter().all(|f| f.chosen == "steady"));
    // Measured over predicted is 1 / 1.05 on inner parts and 1 / 1.1 on outer ones: a bound from those holds.
    assert_eq!(found.bound.coverage, 1.0);
    let found = evaluate(("set", "alone"), &parts, &both[..1], None).unwrap();
    // The bound of the leaky one is of its own inner errors, twice the prediction.
    assert!((found.folds[0].inner.mdape - 0.5).abs() < 1e-12 && found.folds[0].metrics.mdape == 0.0);
    assert!(found.bound.pinball > 0.04, "{}", found.bound.pinball);
    let drawn = found.intervals.unwrap();
    assert!(drawn.mdape.0 <= found.metrics.mdape && found.metrics.mdape <= drawn.mdape.1);
}

#[test]
fn what_is_made_without_parts_holds_no_frame_of_theirs() {
    let t = telling();
    let all = TimedFrames::of(&t.frames, Clock::Cpu);
    let folds = Folds::of(&all);
    assert_eq!((folds.by, folds.groups.len()), (GroupBy::Member, 4));
    for a in 0..4 {
        for b in a + 1..4 {
            let (training, validation) = folds.without(&[a, b], &all);
            let of_held = |f: &&entire_cli::dataset::TimedFrame| {
                let group = folds.by.group(&f.scene);
                folds.groups[a].contains(&group) || folds.groups[b].contains(&group)
            };
            let frames = training.frames.iter().chain(&validation.frames);
            assert_eq!(frames.clone().count(), 20);
            assert!(!frames.copied().any(|f| of_held(&f)));
            assert!(!validation.frames.is_empty());
        }
        assert_eq!(folds.part(a, &all).frames.len(), 10);
    }
    assert_eq!(Folds::key("a", &[1, 3]), "a-without-2-4");
}

#[test]
fn pairs_are_fitted_once_and_give_the_same_on_any_number_of_threads() {
    let t = telling();
    let all = TimedFrames::of(&t.frames, Clock::Cpu);
    let folds = Folds::of(&all);
    let parts: Vec<TimedFrames<'_>> = (0..4).map(|k| folds.part(k, &all)).collect();
    let learned = Learned { validation: TimedFrames::default(), training: all.clone(), all };
    let recipe = Recipe {
        inputs: vec!["camera".into()],
        layers: vec![8],
        epochs: 200,
        patience: 200,
        batch: 8,
        learning_rate: Some(1e-2),
        ..Recipe::default()
    };
    // Without a scene feature beside its table the analytic model cannot be made, and says so.
    let broken = Recipe { kind: Kind::Analytic, ..Recipe::default() };
    let methods = [("good", &recipe), ("broken", &broken)].map(|(key, recipe)| Method {
        key: key.into(),
        recipe,
        learned: &learned,
    });
    let tables = [t.clone()];
    let hidden = indicatif::ProgressBar::hidden();
    let folder = tempfile::tempdir().unwrap();
    let run = |threads: usize, models: &str, stop: bool| {
        let pool = thread_pool(Some(threads)).unwrap();
        let stop = || stop;
        let runner = Runner { pool: &pool, models: folder.path().join(models), bar: &hidden, stop: &stop };
        runner.leave_out(&tables, &folds, &parts, &methods)
    };
    let files = |models: &str| std::fs::read_dir(folder.path().join(models)).map_or(0, Iterator::count);
    let first = run(1, "a", false).unwrap();
    assert!(first[1].is_err());
    let predicted = first[0].as_ref().unwrap();
    // Four parts and six pairs.
    assert_eq!(files("a"), 10);
    for (outer, row) in predicted.iter().enumerate() {
        for (inner, seconds) in row.iter().enumerate() {
            let residuals = bound::log_residuals(seconds, &parts[inner].seconds);
            assert_eq!(residuals.len(), 10);
            // A model that had seen the part would know its seconds.
            assert!(residuals.iter().all(|r| r.abs() > 0.3), "{outer} {inner}: {residuals:?}");
        }
    }
    // The pair's model has seen neither, so it predicts otherwise than the one that has seen the outer part.
    assert_ne!(predicted[0][1], predicted[1][1]);
    for (threads, models) in [(2, "b"), (2, "a")] {
        let again = run(threads, models, false).unwrap();
        assert_eq!(again[0].as_ref().unwrap(), predicted, "{threads} threads, {models}");
    }
    // Stopped, it says so and makes nothing more.
    let said = run(2, "c", true).unwrap_err().to_string();
    assert!(said.contains("what was made is kept"), "{said}");
    assert!(files("c") < 10);
}
