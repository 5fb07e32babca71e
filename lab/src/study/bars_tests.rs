//! Tests of the bars and of the rule of selection on synthetic findings.

use super::report::fits_table;
use super::rule::by_rule;
use super::*;
use entire_io::dataset::NoiseFloor;
use entire_io::metrics::Metrics;

fn study_of(predictors: &str, limits: &str) -> Study {
    serde_json::from_str(&format!(
        r#"{{ "title": "t", "latency_volume": ["v.nrrd", 1], "predictors": [{predictors}], "sets": [{{
            "name": "a set", "training": [], "calibration_split": "other", "limits": {limits},
            "splits": [{{ "name": "seen", "tables": [] }},
                {{ "name": "member", "tables": [], "main": true }}] }}] }}"#
    ))
    .unwrap()
}

fn result(split: &str, predictor: &str, off: f64) -> SplitResult {
    let measured = [1.0, 2.0, 4.0];
    let predicted = measured.map(|t| t * off);
    SplitResult {
        set: "a set".into(),
        split: split.into(),
        predictor: predictor.into(),
        panel: "main".into(),
        metrics: Metrics::new(&predicted, &measured).unwrap(),
        intervals: None,
        bound: None,
    }
}

/// Returns a cross-validated fit. `off`: predicted / measured seconds in cross-validation.
fn fit(name: &str, off: f64, numbers: usize) -> Fit {
    Fit {
        set: "a set".into(),
        predictor: name.into(),
        seen: result("member", name, 1.0).metrics,
        seen_intervals: None,
        crossed: Some(result("member", name, off).metrics),
        crossed_intervals: None,
        noise: [0.0; 2],
        folds: 5,
        numbers,
        probe_side: 11,
    }
}

const ALL: &str = r#"{ "rmse_over_sd": 0.5, "constant_over_paper": 4, "proxy_over_paper": 3, "modality": true,
    "latency": true }"#;

#[test]
fn a_limit_without_anything_to_hold_against_it_is_short_and_not_silent() {
    let study = study_of("", ALL);
    let bars = bars(&study, &Findings::default());
    let names: Vec<&str> = bars.iter().map(|b| b.name.as_str()).collect();
    for name in [
        "a-set/member/best-rmse-over-sd",
        "a-set/member/best-mdape",
        "a-set/member/q95-coverage-off-by",
        "a-set/member/q95-missed-in-slowest-tenth",
        "a-set/member/paper-rmse-over-constant",
        "a-set/member/paper-rmse-over-lvrp",
        "a-set/member/selected-rmse-over-best",
        "a-set/member/selected-latency-over-paper",
        "a-set/member/rmse-at-a-fortieth-of-paper-latency-over-paper",
        "a-set/other/mdape",
        "a-set/other/one-less-r2-log",
        "a-set/other/mdape-after-100-frames",
        "a-set/other/one-less-r2-log-after-100-frames",
    ] {
        assert!(names.contains(&name), "{name}: {names:?}");
    }
    assert_eq!(bars.len(), 14);
    assert!(bars.iter().all(|b| !b.ok && b.value.is_none()));
    assert_eq!(bars[5].to_string(), "bar a-set/member/paper-rmse-over-constant - 0.2500 short");
    assert!(super::bars(&study_of("", "{}"), &Findings::default()).is_empty());
}

#[test]
fn median_errors_are_held_to_twice_the_noise_and_scans_to_seven_percent_at_least() {
    let study = study_of(r#"{ "name": "any" }"#, r#"{ "rmse_over_sd": 0.5, "modality": true }"#);
    let limit = |log_sd_of_median: f64, what: &str| {
        let noise = NoiseFloor {
            log_sd: log_sd_of_median,
            log_sd_of_median,
            median_relative_deviation: 0.0,
            warm_up: 0.0,
            drift: None,
            frames: 3,
        };
        let of = |split: &str| ("a set".to_owned(), split.to_owned(), noise, 3);
        let found = Findings { noise: vec![of("member"), of("other")], ..Findings::default() };
        bars(&study, &found).iter().find(|b| b.name == format!("a-set/{what}")).unwrap().limit
    };
    for (sd, member, other) in [(0.01, 0.01349, 0.07), (0.1, 0.1349, 0.1349)] {
        assert!((limit(sd, "member/best-mdape") - member).abs() < 1e-12);
        assert!((limit(sd, "other/mdape-after-100-frames") - other).abs() < 1e-12);
    }
}

#[test]
fn the_rule_takes_the_smallest_of_the_good_ones_and_looks_at_no_test_frame() {
    let trained =
        |name: &str, kind: &str| format!(r#"{{ "name": "{name}", "recipe": {{ "kind": "{kind}" }} }}"#);
    let mut all = [("paper", "prednet"), ("large", "residual"), ("good", "residual"), ("small", "analytic")]
        .map(|(n, k)| trained(n, k))
        .join(",");
    all += r#", { "name": "t", "trees": true }"#;
    let rule = |good: f64, noise: f64| {
        let study = study_of(&all, "{}");
        let mut found = Findings::default();
        // Every prediction is wrong by a factor. On the test frames the order of the errors is reversed.
        for (name, off, numbers) in
            [("large", 1.10, 900), ("good", good, 19), ("small", 1.30, 2), ("t", 1.01, 1)]
        {
            found.fits.push(Fit { noise: [noise, 0.0], ..fit(name, off, numbers) });
            found.results.push(result("member", name, 2.5 - off));
        }
        let table = fits_table(&study, &found, "a set", "member").to_text();
        assert_eq!(table.matches("selected").count(), 1, "{table}");
        by_rule(&study, &found, "a set").unwrap().name.clone()
    };
    assert_eq!(rule(1.104, 0.0), "good");
    assert_eq!(rule(1.106, 0.0), "large");
    // After the noise is subtracted, the error of `large` is more than 5 % below that of `good`.
    assert_eq!(rule(1.104, 0.08), "large");
}

#[test]
fn bars_are_about_the_selected_predictor_where_the_rule_selects_one() {
    let found = Findings {
        results: vec![
            result("member", "small", 1.04),
            result("member", "lucky", 1.01),
            result("seen", "lucky", 1.3),
            result("member", "paper", 1.2),
            result("member", CONSTANT, 1.6),
        ],
        fits: vec![fit("small", 1.1, 9), fit("lucky", 1.1, 90)],
        ..Findings::default()
    };
    let limits = r#"{ "rmse_over_sd": 0.5, "constant_over_paper": 4 }"#;
    let study = study_of(r#"{ "name": "small" }, { "name": "lucky" }"#, limits);
    let value = |found: &Findings, what: &str| {
        let bars = bars(&study, found);
        let bar = bars.iter().find(|b| b.name == format!("a-set/member/{what}")).unwrap().clone();
        (bar.value, bar.ok)
    };
    assert!((value(&found, "best-mdape").0.unwrap() - 0.04).abs() < 1e-12);
    let (ratio, ok) = value(&found, "paper-rmse-over-constant");
    assert!((ratio.unwrap() - 0.2 / 0.6).abs() < 1e-12 && !ok);
    // A selected predictor without test results is not replaced by another one.
    let gone = Findings { results: found.results[1..].to_vec(), ..found.clone() };
    assert_eq!(value(&gone, "best-mdape"), (None, false));
    // Without cross-validation, the bars are about the best predictor on the test frames.
    let uncrossed = Findings { fits: Vec::new(), ..found };
    assert!((value(&uncrossed, "best-mdape").0.unwrap() - 0.01).abs() < 1e-12);
    assert!(value(&uncrossed, "best-rmse-over-sd").1);
}
