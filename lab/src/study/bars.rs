//! Bars of a study.

use super::description::SELECTED;
use super::{CONSTANT, Findings, PROXY, SplitResult, Study, shipped};
use crate::bars::Bar;

/// Name of the paper's network, trained as in the paper.
const PAPER: &str = "paper";

/// Name of the paper's network, distilled from another predictor.
const DISTILLED: &str = "distilled";

/// The networks with a bar on their error with eight-bit weights: the paper's, and those that the study ships
/// by name.
pub(super) fn judged_in_eight_bits(study: &Study) -> impl Iterator<Item = &str> {
    let by_name = |name: &&str| ![PAPER, SELECTED].contains(name);
    std::iter::once(PAPER).chain(study.ship.iter().map(|s| s.predictor.as_str()).filter(by_name))
}

pub(super) fn models<'a>(
    found: &'a Findings,
    set: &'a str,
    split: &'a str,
) -> impl Iterator<Item = &'a SplitResult> {
    found.results.iter().filter(move |r| r.set == set && r.split == split && r.panel == "main")
}

fn best<'a>(found: &'a Findings, set: &'a str, split: &'a str) -> Option<&'a SplitResult> {
    models(found, set, split).min_by(|a, b| a.metrics.rmse.total_cmp(&b.metrics.rmse))
}

/// Result of the predictor that the rule selects; if it selects none, of the predictor that is best on the
/// test frames.
fn chosen<'a>(study: &Study, found: &'a Findings, set: &'a str, split: &'a str) -> Option<&'a SplitResult> {
    match shipped(study, found, set, SELECTED) {
        Some(name) => found.of(set, split, name),
        None => best(found, set, split),
    }
}

/// Bars of a study, one for every limit of its sets; a bar without a measured value is missed. Most bars are
/// about the predictor that the rule selects. If the rule selects none, they are about the best predictor on
/// the test frames.
pub(crate) fn bars(study: &Study, found: &Findings) -> Vec<Bar> {
    let mut out = Vec::new();
    let mut at_most = |name: String, value: Option<f64>, limit: f64| {
        out.push(Bar::at_most(name, value, limit));
    };
    let word = |s: &str| s.replace(' ', "-");
    for set in &study.sets {
        let limits = &set.limits;
        let s = set.name.as_str();
        let p = set.splits.iter().find(|s| s.main).map_or("main", |s| s.name.as_str());
        let name = |what: &str| format!("{}/{}/{what}", word(s), word(p));
        let noise = found.noise_mdape(s, p);
        let ours = chosen(study, found, s, p);
        let bound = ours.and_then(|r| r.bound.as_ref());
        if let Some(limit) = limits.rmse_over_sd {
            at_most(name("best-rmse-over-sd"), ours.map(|r| r.metrics.rmse_over_sd), limit);
            at_most(name("best-mdape"), ours.map(|r| r.metrics.mdape), 2.0 * noise);
        }
        if limits.rmse_over_sd.is_some() || bound.is_some() {
            at_most(name("q95-coverage-off-by"), bound.map(|b| (b.coverage - 0.95).abs()), 0.015);
            at_most(name("q95-missed-in-slowest-tenth"), bound.map(|b| 1.0 - b.slowest_coverage), 0.1);
        }
        let rmse = |predictor: &str| found.of(s, p, predictor).map(|r| r.metrics.rmse);
        let over = |a: Option<f64>, b: Option<f64>| Some(a? / b?);
        let paper = rmse(PAPER);
        if limits.constant_over_paper.is_some() {
            for network in judged_in_eight_bits(study) {
                let ratio = found.eight_bit.iter().find(|e| e.0 == *s && e.1 == network).map(|e| e.2);
                at_most(name(&format!("{network}-rmse-eight-bit-over-stored")), ratio, 1.02);
            }
        }
        // The paper's network, and the distilled one if the study has it.
        let distilled = study.predictors.iter().any(|p| p.name == DISTILLED).then_some(DISTILLED);
        for network in std::iter::once(PAPER).chain(distilled) {
            for (baseline, wanted, what) in
                [(CONSTANT, limits.constant_over_paper, "constant"), (PROXY, limits.proxy_over_paper, "lvrp")]
            {
                if let Some(wanted) = wanted {
                    let value = over(rmse(network), rmse(baseline));
                    at_most(name(&format!("{network}-rmse-over-{what}")), value, 1.0 / wanted);
                }
            }
        }
        let has = |name: &str| study.predictors.iter().any(|p| p.name == name);
        let selected = shipped(study, found, s, SELECTED).unwrap_or(SELECTED);
        if limits.latency || (limits.rmse_over_sd.is_some() && has(PAPER)) {
            let of = |predictor: &str| found.latency(s, predictor).map(|l| l.with_changes());
            at_most(name("selected-latency-over-paper"), over(of(selected), of(PAPER)), 0.2);
        }
        if limits.latency {
            let cold = |predictor: &str| found.latency(s, predictor).map(|l| l.cold);
            let lowest = best(found, s, p).map(|r| r.metrics.rmse);
            at_most(name("selected-rmse-over-best"), over(rmse(selected), lowest), 1.1);
            let quick = cold(PAPER).and_then(|theirs| {
                models(found, s, p)
                    .filter(|r| cold(&r.predictor).is_some_and(|c| c <= theirs / 40.0))
                    .map(|r| r.metrics.rmse)
                    .min_by(f64::total_cmp)
            });
            at_most(name("rmse-at-a-fortieth-of-paper-latency-over-paper"), over(quick, paper), 0.5);
        }
        if limits.modality {
            let p = set.calibration_split.as_deref().unwrap_or("calibration");
            let name = |what: &str| format!("{}/{}/{what}", word(s), word(p));
            let ours = chosen(study, found, s, p);
            at_most(name("mdape"), ours.map(|r| r.metrics.mdape), 0.15);
            at_most(name("one-less-r2-log"), ours.map(|r| 1.0 - r.metrics.r2_log), 0.03);
            let tuned = ours.and_then(|r| {
                found.calibrated.iter().find(|t| t.set == s && t.split == p && t.predictor == r.predictor)
            });
            // The limit is 7 %, or twice the noise if that is more.
            let limit = (2.0 * found.noise_mdape(s, p)).max(0.07);
            at_most(name("mdape-after-100-frames"), tuned.map(|t| t.metrics.mdape), limit);
            at_most(name("one-less-r2-log-after-100-frames"), tuned.map(|t| 1.0 - t.metrics.r2_log), 0.015);
        }
    }
    out
}
