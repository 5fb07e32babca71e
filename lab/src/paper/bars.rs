//! Bars of the paper's study.

use super::description::{Panel, Paper, YT};
use super::encode::{ALL, Encoder, Record};
use super::judge::NETWORK;
use super::report::{Shown, ours_of};
use super::results::{Results, Row};
use super::volumes::BY_VOLUMES;
use crate::bars::Bar;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Errors of an encoder's reconstruction of held-out volumes.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Reconstruction {
    /// The encoder.
    pub encoder: Encoder,
    /// Record of its training.
    pub record: Record,
}

impl Reconstruction {
    /// Peak signal-to-noise ratio of test volumes of the data set, dB.
    pub fn psnr(&self) -> Option<f64> {
        self.record.psnr("test", &self.encoder.set)
    }
}

/// The n-th smallest of some numbers, counted from 1: a bound for at least n of them.
fn nth(mut values: Vec<f64>, n: usize) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(n.checked_sub(1)?).copied()
}

/// The bars; missing values are short.
pub fn bars(
    paper: &Paper,
    all: &[Results],
    shown: &[Shown],
    reconstructions: &[Reconstruction],
    seconds: f64,
) -> Vec<Bar> {
    let limits = &paper.limits;
    let missing = shown.iter().filter(|s| !s.there || s.command.is_empty()).count();
    let mut out = vec![Bar::at_most("paper/labels-without-a-table-or-figure", Some(missing as f64), 0.0)];
    // As in the paper: on its split, with at least its number of frames of every training volume.
    let full = |r: &&Results| r.panel == Panel::Overall && complete(r);
    let overall: Vec<&Results> = all.iter().filter(full).collect();
    let network = |r: &Results| r.row(BY_VOLUMES, NETWORK).cloned();
    let ratios = |of: &dyn Fn(&Row) -> Option<f64>, yt: bool| -> Vec<f64> {
        // One value per data set, the worst of its modes; none if a mode has none.
        let mut worst: BTreeMap<&str, Option<f64>> = BTreeMap::new();
        for r in overall.iter().filter(|r| (r.mode == YT) == yt) {
            let found = network(r).as_ref().and_then(of);
            let slot = worst.entry(&r.set).or_insert(Some(f64::NEG_INFINITY));
            *slot = slot.zip(found).map(|(a, b)| a.max(b));
        }
        worst.into_values().flatten().collect()
    };
    let constant = |r: &Row| r.over_constant;
    let lvrp = |r: &Row| r.over_lvrp;
    let n = limits.data_sets;
    let mut at_most =
        |name: &str, value, limit| out.push(Bar::at_most(format!("paper/{name}"), value, limit));
    at_most("raycaster-rmse-over-constant", nth(ratios(&constant, false), n), limits.over_constant);
    at_most("yt-rmse-over-constant", nth(ratios(&constant, true), 1), limits.over_constant);
    at_most("raycaster-rmse-over-lvrp", nth(ratios(&lvrp, false), n), limits.over_lvrp);
    at_most("yt-rmse-over-lvrp", nth(ratios(&lvrp, true), 1), limits.over_lvrp);
    for r in &overall {
        let ratio = ours_of(r, BY_VOLUMES).zip(network(r)).map(|(o, p)| o.rmse / p.rmse);
        at_most(&format!("{}/{}/ours-over-network", r.set, r.mode), ratio, limits.ours_over_network);
    }
    if overall.is_empty() {
        at_most("ours-over-network", None, limits.ours_over_network);
    }
    let (size, features) = paper.encoders.main;
    let mut psnr: Vec<f64> = reconstructions
        .iter()
        .filter(|r| r.encoder.channels.is_empty() && r.encoder.set != ALL)
        .filter(|r| (r.encoder.size, r.encoder.features) == (size, features))
        .filter_map(Reconstruction::psnr)
        .collect();
    psnr.sort_by(|a, b| b.total_cmp(a));
    out.push(Bar::at_least("paper/reconstruction-psnr-db", psnr.get(n - 1).copied(), limits.psnr));
    out.push(Bar::at_most("paper/report-seconds", Some(seconds), limits.report_seconds));
    out
}

/// True if the training volumes have as many frames as the description requires.
fn complete(results: &Results) -> bool {
    let times = results.facts.iter().find(|f| f.name == "times");
    let expected = times.and_then(|t| t.values.get("expected frames")).copied();
    let frames = times.and_then(|t| t.values.get("frames")).copied();
    expected.zip(frames).is_some_and(|(e, f)| f >= e)
}

#[cfg(test)]
mod tests {
    use super::super::results::Fact;
    use super::*;
    use std::path::Path;

    fn overall(set: &str, mode: &str, over: Option<f64>) -> Results {
        let mut out = Results::new(Panel::Overall, set, mode, String::new());
        let frames = [("expected frames", 100.0), ("frames", 100.0)].map(|(n, v)| (n.to_owned(), v));
        out.facts.push(Fact { name: "times".into(), values: frames.into() });
        out.rows.push(Row {
            name: NETWORK.into(),
            split: BY_VOLUMES.into(),
            frames: 10,
            runs: 1,
            rmse: 1.0,
            rmse_sd: 0.0,
            rmse_median: 1.0,
            sd: 1.0,
            mean: 1.0,
            over_constant: over,
            over_lvrp: over.map(|v| 2.0 * v),
            mdape: 0.1,
            latency: None,
            squared_errors: [0.0; 5],
            more: BTreeMap::new(),
        });
        out
    }

    #[test]
    fn a_data_set_counts_by_its_worst_mode() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/timings/paper.json");
        let paper: Paper = serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
        let of = |all: &[Results], name: &str| -> Option<f64> {
            let found = bars(&paper, all, &[], &[], 1.0);
            found.iter().find(|b| b.name == format!("paper/{name}")).unwrap().value
        };
        let mut all = vec![
            overall("a", "none", Some(0.2)),
            overall("a", "local", Some(0.6)),
            overall("b", "none", Some(0.5)),
            overall("b", "scatter", Some(0.1)),
            overall("c", "none", Some(0.9)),
            overall("a", YT, Some(0.3)),
        ];
        // The second of 0.5, 0.6 and 0.9.
        assert_eq!(of(&all, "raycaster-rmse-over-constant"), Some(0.6));
        assert_eq!(of(&all, "raycaster-rmse-over-lvrp"), Some(1.2));
        assert_eq!(of(&all, "yt-rmse-over-constant"), Some(0.3));
        // A data set with a mode without a value has no value.
        all.push(overall("b", "local", None));
        assert_eq!(of(&all, "raycaster-rmse-over-constant"), Some(0.9));
    }
}
