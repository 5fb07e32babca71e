//! Bars of the paper's study.

use super::collect::EXPERIMENTS;
use super::description::{BASE_MODE, DataSet, Panel, Paper, YT};
use super::encode::{ALL, SHIPPED};
use super::improved::DISTILLED;
use super::judge::{NETWORK, OURS};
use super::results::{LVRP_AS_PAPER, Reconstruction, Results, Row};
use super::train::FEATURE_VECTOR;
use super::trials::{AS_IT_IS, SETS};
use super::{cases, control, interval};
use crate::bars::Bar;
use anyhow::Result;
use entire_io::files::read_text;

/// A ratio of errors, and its interval over test volumes.
type Ratio = (Option<f64>, Option<(f64, f64)>);

/// Returns the bar with the interval of its value as the note.
fn with_interval(bar: Bar, interval: Option<(f64, f64)>) -> Bar {
    match (bar.value, interval) {
        (None, _) => bar,
        (_, Some((low, high))) => bar.with_note(format!("interval: {low:.4} to {high:.4}")),
        (_, None) => bar.with_note("interval: unknown"),
    }
}

/// A bar on a ratio, with its interval as the note.
fn at_most(name: String, (value, interval): Ratio, limit: f64) -> Bar {
    with_interval(Bar::at_most(format!("paper/{name}"), value, limit), interval)
}

/// A bar on the error without the feature vector divided by the error with it.
fn at_least(name: String, (value, interval): Ratio, limit: f64) -> Bar {
    let bar = with_interval(Bar::at_least(format!("paper/{name}"), value, limit), interval);
    if value.is_none() { bar.with_note("not measured") } else { bar }
}

/// A bar on a ratio of the network that was trained on all data sets together; the note says so.
fn of_one_network(name: String, ratio: Ratio, limit: f64) -> Bar {
    let bar = at_most(name, ratio, limit);
    let note = format!("{}; {ONE_NETWORK}", bar.note);
    bar.with_note(note)
}

/// Returns the bars; a bar without a value counts as missed. If the study is partial, bars with neither value
/// nor note are left out. A bar on a data set is about the paper's split of that data set, and about the
/// paper's base mode unless its name has another mode. Two kinds of bars are about left-out members instead:
/// those of the distilled network, and those with the note [`ONE_NETWORK`]. `missing` is the number of the
/// paper's tables and figures (labels) without a counterpart.
pub(crate) fn bars(
    paper: &Paper,
    all: &[Results],
    missing: usize,
    reconstructions: &[Reconstruction],
    seconds: f64,
) -> Vec<Bar> {
    let limits = &paper.limits;
    let mut out = Vec::new();
    if !paper.partial {
        out.push(Bar::at_most("paper/labels-without-a-table-or-figure", Some(missing as f64), 0.0));
        // A person finds the sentences that the results contradict; the program looks only for listed
        // wordings.
        out.push(Bar::at_most("paper/sentences-contradicted", None, 0.0).with_note("read by a person"));
        let found = Bar::at_most("paper/contradicted-wordings-on-a-page", contradicted(paper).ok(), 0.0);
        out.push(found.with_note(format!("of {} that a person listed", paper.contradicted.wordings.len())));
    }
    // Only results with at least as many frames as the study's description specifies are used.
    let overall = |set: &str, mode: &str| {
        let full = |r: &&Results| frames_of(r).is_some_and(|[expected, frames]| frames >= expected);
        find(all, Panel::Overall, set, mode).filter(full)
    };
    // Returns the network's row and the results that contain this row.
    let network = |set: &str, mode: &str| {
        let r = overall(set, mode)?;
        Some((r, r.row(paper.rule(set).split(), NETWORK)?))
    };
    let over_constant = |set: &str, mode: &str| -> Ratio {
        network(set, mode).map_or((None, None), |(r, row)| (row.over_constant, r.over_constant_interval(row)))
    };
    for (set, limit) in &limits.over_constant {
        let name = || format!("{set}/network-over-constant");
        let bar = at_most(name(), over_constant(set, BASE_MODE), *limit);
        out.push(match (on_fewer_frames(paper, all, set), by_one_network(paper, all, set, AS_IT_IS)) {
            _ if bar.value.is_some() => bar,
            (Some(note), _) => bar.with_note(note),
            (None, Some((constant, _))) => of_one_network(name(), constant, *limit),
            _ => bar,
        });
    }
    for set in limits.over_constant.keys() {
        let name = format!("{set}/{YT}/network-over-constant");
        out.push(at_most(name, over_constant(set, YT), limits.yt_over_constant));
    }
    for set in limits.over_constant.keys() {
        let name = || format!("{set}/network-over-lvrp");
        let found = network(set, BASE_MODE);
        let voxels = found.and_then(|(r, _)| voxels_over_proxy(paper, r));
        let bar = match found.zip(voxels) {
            // This study's low-resolution proxy has a larger share of the voxels than the paper's, so LVRP is a
            // stronger baseline here than there. The ratio cannot be compared, so this goal gets no value.
            Some(((_, row), voxels)) if voxels < limits.lvrp_voxels => {
                let over = row.over_lvrp.map_or("-".into(), |v| format!("{v:.4}"));
                let (here, papers) = (voxels.round(), limits.lvrp_voxels);
                let note =
                    format!("{over}, but LVRP rendered 1/{here} of the voxels, the paper's LVRP 1/{papers}");
                at_most(name(), (None, None), limits.over_lvrp).with_note(note)
            }
            Some(((r, row), _)) => {
                at_most(name(), (row.over_lvrp, r.over_lvrp_interval(row)), limits.over_lvrp)
            }
            None => at_most(name(), (None, None), limits.over_lvrp),
        };
        out.push(match by_one_network(paper, all, set, AS_IT_IS) {
            Some((_, lvrp)) if bar.value.is_none() => of_one_network(name(), lvrp, limits.over_lvrp),
            _ => bar,
        });
    }
    for (set, limit) in &limits.over_constant {
        let found = by_one_network(paper, all, set, DISTILLED);
        let (constant, lvrp) = found.unwrap_or(((None, None), (None, None)));
        out.push(at_most(format!("{set}/distilled-network-over-constant"), constant, *limit));
        out.push(at_most(format!("{set}/distilled-network-over-lvrp"), lvrp, limits.over_lvrp));
    }
    let of_paper = |d: &&DataSet| limits.over_constant.contains_key(&d.name);
    for d in paper.data_sets.iter().filter(of_paper) {
        for mode in &d.modes {
            let pair = network(&d.name, mode).and_then(|(r, p)| Some((r.row(d.rule.split(), OURS)?, p)));
            let ratio = pair.map(|(o, p)| o.rmse / p.rmse);
            let interval = pair.and_then(|(o, p)| interval::of_ratio(&o.by_volume, &p.by_volume));
            let name = format!("{}/{mode}/ours-over-network", d.name);
            out.push(at_most(name, (ratio, interval), limits.ours_over_network));
        }
    }
    // Without variants of different sparsity, volumes hardly differ.
    let (ablation, alone) = limits.feature_vector;
    for d in paper.data_sets.iter().filter(of_paper).filter(|d| d.variants) {
        let name = format!("{}/without-over-with-feature-vector", d.name);
        out.push(at_least(name.clone(), without_over_with(all, d, Panel::Ablation), ablation));
        let varied = without_over_with(all, d, Panel::Varied);
        out.push(at_least(format!("{name}-volume-alone"), varied, alone));
    }
    let main = |r: &&Reconstruction| {
        r.encoder.channels.is_empty() && (r.encoder.size, r.encoder.features) == paper.encoders.main
    };
    let mut own: Vec<f64> = reconstructions.iter().filter(main).filter_map(Reconstruction::psnr).collect();
    out.push(Bar::at_least(
        "paper/reconstruction-psnr-db",
        nth_best(&mut own, limits.data_sets),
        limits.psnr,
    ));
    let joint = [ALL, SHIPPED]
        .iter()
        .find_map(|set| reconstructions.iter().filter(main).find(|r| r.encoder.set == *set));
    let of_set = |set: &String| joint.and_then(|r| r.record.psnr("test", set));
    let mut together: Vec<f64> = limits.over_constant.keys().filter_map(of_set).collect();
    out.push(Bar::at_least(
        "paper/joint-reconstruction-psnr-db",
        nth_best(&mut together, limits.data_sets),
        limits.psnr,
    ));
    let (switches, everywhere) = limits.algorithm1_over_olp;
    for (name, key, limit) in
        [("switches", control::FIRST_FRAMES, switches), ("all", control::ALL_FRAMES, everywhere)]
    {
        for (network, infix) in [("", ""), (control::TUNED, "fine-tuned-")] {
            let found = control::algorithm1_over_olp(all, key, network);
            out.push(Bar::at_most(format!("paper/algorithm1-{infix}over-olp-distance-{name}"), found, limit));
        }
    }
    for (predictor, name) in [(NETWORK, "network"), (DISTILLED, "distilled-network")] {
        let slowest = cases::slowest_node(all, predictor);
        out.push(Bar::at_most(format!("paper/slowest-node-by-{name}"), slowest, limits.slowest_node));
    }
    out.push(Bar::at_most("paper/report-seconds", Some(seconds), limits.report_seconds));
    if paper.partial {
        out.retain(|b| b.value.is_some() || !b.note.is_empty());
    }
    out
}

/// Returns the network's RMSE without VolumeNet's feature vector, divided by its RMSE with it: in the
/// ablation on the paper's split of a data set, or on frames in which only the volume varies.
fn without_over_with(all: &[Results], set: &DataSet, panel: Panel) -> Ratio {
    let split = if panel == Panel::Varied { EXPERIMENTS[0] } else { set.rule.split() };
    let rows = || {
        let found = find(all, panel, &set.name, BASE_MODE)?;
        Some((found.row(split, &format!("without {FEATURE_VECTOR}"))?, found.row(split, NETWORK)?))
    };
    rows().map_or((None, None), |(without, with)| ratio_of(without, with))
}

/// Returns the RMSE of one row divided by that of another on the same frames.
pub(super) fn ratio_of(over: &Row, under: &Row) -> Ratio {
    (Some(over.rmse / under.rmse), interval::of_ratio(&over.by_volume, &under.by_volume))
}

/// Counts the listed wordings that the pages still have.
pub(super) fn contradicted(paper: &Paper) -> Result<f64> {
    let one_line = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let asked = &paper.contradicted;
    anyhow::ensure!(!asked.pages.is_empty(), "no page is named");
    let pages: Vec<String> =
        asked.pages.iter().map(|p| Ok(one_line(&read_text(p, 16 << 20)?))).collect::<Result<_>>()?;
    let said = |wording: &&String| pages.iter().any(|page| page.contains(&one_line(wording)));
    Ok(asked.wordings.iter().filter(said).count() as f64)
}

/// Returns a note for results on fewer frames than the description specifies: the network's RMSE divided by
/// that of the constant prediction, the number of measured frames, and the specified number.
fn on_fewer_frames(paper: &Paper, all: &[Results], set: &str) -> Option<String> {
    let found = find(all, Panel::Overall, set, BASE_MODE)?;
    let row = found.row(paper.rule(set).split(), NETWORK)?;
    let [expected, frames] = frames_of(found)?;
    let brackets = interval::in_brackets(found.over_constant_interval(row));
    Some(format!("{:.4} {brackets} with {frames} of {expected} frames", row.over_constant?))
}

/// Note on ratios of a network of all data sets.
const ONE_NETWORK: &str = "one network for all data sets, left-out member";

/// Returns two ratios of errors on the held-out members of a data set. The error of a network that was
/// trained on all data sets together is divided by the error of the constant prediction, and by the error of
/// LVRP with the paper's share of the voxels.
fn by_one_network(paper: &Paper, all: &[Results], set: &str, network: &str) -> Option<(Ratio, Ratio)> {
    let found = find(all, Panel::Improved, SETS, BASE_MODE)?;
    let title = &paper.data_set(set)?.title;
    let row = found.row(title, network)?;
    let lvrp = found.row(title, LVRP_AS_PAPER).map_or((None, None), |l| ratio_of(row, l));
    Some(((row.over_constant, found.over_constant_interval(row)), lvrp))
}

fn find<'a>(all: &'a [Results], panel: Panel, set: &str, mode: &str) -> Option<&'a Results> {
    all.iter().find(|r| r.panel == panel && r.set == set && r.mode == mode)
}

/// Returns the `n`-th largest of `values`; `None` if there are fewer values.
fn nth_best(values: &mut [f64], n: usize) -> Option<f64> {
    values.sort_by(|a, b| b.total_cmp(a));
    values.get(n.checked_sub(1)?).copied()
}

/// Number of voxels of a rendered volume, divided by the number of voxels of the low-resolution proxy.
fn voxels_over_proxy(paper: &Paper, results: &Results) -> Option<f64> {
    let times = results.fact("times")?;
    let side = |k: &str| times.get(k).copied();
    Some(side("x")? * side("y")? * side("z")? / (paper.proxy as f64).powi(3))
}

/// Number of frames that the study's description specifies, and number of frames in the results.
fn frames_of(results: &Results) -> Option<[f64; 2]> {
    let times = results.fact("times")?;
    Some([*times.get("expected frames")?, *times.get("frames")?])
}

#[cfg(test)]
mod tests {
    use super::super::interval::{ByVolume, Errors};
    use super::super::results::{CONSTANT, Fact, LVRP, Row};
    use super::*;
    use std::path::Path;

    /// Returns a row of results on two test volumes of one frame each; `squared` has their squared errors.
    fn row(name: &str, split: &str, squared: [f64; 2], over: Option<f64>) -> Row {
        let by_volume: ByVolume = ["a", "b"]
            .into_iter()
            .zip(squared)
            .map(|(volume, s)| (volume.to_owned(), Errors { frames: 1, squared: vec![s] }))
            .collect();
        Row {
            name: name.into(),
            split: split.into(),
            frames: 2,
            runs: 1,
            rmse: interval::rmse(&by_volume).unwrap(),
            sd: 1.0,
            over_constant: over,
            over_lvrp: over.map(|v| 2.0 * v),
            mdape: 0.1,
            of_twins: by_volume.clone(),
            by_volume,
            ..Row::default()
        }
    }

    fn overall(set: &str, mode: &str, split: &str, over: Option<f64>) -> Results {
        let mut out = Results::new(Panel::Overall, set, mode, String::new());
        let frames =
            [("expected frames", 100.0), ("frames", 100.0), ("x", 192.0), ("y", 192.0), ("z", 192.0)];
        out.facts.push(Fact { name: "times".into(), values: frames.map(|(n, v)| (n.to_owned(), v)).into() });
        out.rows.push(row(CONSTANT, split, [4.0, 4.0], None));
        out.rows.push(row(LVRP, split, [4.0, 4.0], None));
        out.rows.push(row(NETWORK, split, [0.04, 0.16], over));
        out
    }

    #[test]
    fn a_partial_study_prints_what_it_measured() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/timings/paper-gpu.json");
        let paper = super::super::description::read(&file).unwrap();
        let mut fewer = overall("nyx_cosmology", "local", "members", Some(0.5));
        fewer.facts[0].values.insert("frames".into(), 90.0);
        let mut ablation = Results::new(Panel::Ablation, "castro_blast", BASE_MODE, String::new());
        ablation.rows.push(row(NETWORK, "members", [1.0, 1.0], None));
        ablation.rows.push(row(&format!("without {FEATURE_VECTOR}"), "members", [4.0, 4.0], None));
        let found: Vec<String> =
            bars(&paper, &[fewer, ablation], 0, &[], 1.0).iter().map(ToString::to_string).collect();
        assert!(found[0].contains("nyx_cosmology/network-over-constant - 0.2000 short (0.5000"), "{found:?}");
        assert!(found[0].ends_with("with 90 of 100 frames)"), "{found:?}");
        // A partial study leaves out bars with neither value nor note.
        assert!(found.iter().all(|l| !l.contains(" - ") || l.ends_with(')')), "{found:?}");
        let line = |name: &str| found.iter().find(|l| l.contains(name)).unwrap().as_str();
        assert_eq!(
            line("castro_blast/without-over-with-feature-vector"),
            "bar paper/castro_blast/without-over-with-feature-vector 2.0000 1.5000 ok \
             (interval: 2.0000 to 2.0000)"
        );
        // A bar that the study asks for is printed even if it was not measured.
        assert!(
            line("nyx_cosmology/without-over-with-feature-vector-volume-alone").contains("- 5.0000 short")
        );
    }

    #[test]
    fn a_data_set_counts_in_the_base_mode_and_by_the_papers_rule() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/timings/paper.json");
        let mut paper: Paper = serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
        let of = |paper: &Paper, all: &[Results], name: &str| -> String {
            let found = bars(paper, all, 0, &[], 1.0);
            let bar = found.iter().find(|b| b.name == format!("paper/{name}")).unwrap();
            bar.to_string().split_once(&bar.name).unwrap().1.trim().to_owned()
        };
        let (nyx, maestroex) = ("nyx_cosmology", "maestroex_bubbles");
        let name = "nyx_cosmology/network-over-constant";
        // Results of another mode, or of another split than the paper's, are not used.
        let easier =
            [overall(nyx, "none", "members", Some(0.1)), overall(nyx, "local", "volumes", Some(0.1))];
        assert_eq!(of(&paper, &easier, name), "- 0.2000 short");
        let all = [
            overall(nyx, "local", "members", Some(0.16)),
            overall(maestroex, "local", "volumes", Some(0.3)),
            overall(nyx, YT, "members", Some(0.21)),
        ];
        // A quarter of the bootstrap draws have the first of two volumes only, and a quarter the second only.
        assert_eq!(of(&paper, &all, name), "0.1600 0.2000 ok (interval: 0.1000 to 0.2000)");
        let name = "maestroex_bubbles/network-over-constant";
        assert_eq!(of(&paper, &all, name), "0.3000 0.2600 short (interval: 0.1000 to 0.2000)");
        let name = "nyx_cosmology/yt/network-over-constant";
        assert!(of(&paper, &all, name).starts_with("0.2100 0.2000 short"));
        // LVRP with 64³ of a volume's 192³ voxels is a stronger baseline than the paper's LVRP, so the bar
        // has no value.
        let name = "nyx_cosmology/network-over-lvrp";
        assert_eq!(
            of(&paper, &all, name),
            "- 0.6000 short (0.3200, but LVRP rendered 1/27 of the voxels, the paper's LVRP 1/512)"
        );
        paper.proxy = 24;
        assert_eq!(of(&paper, &all, name), "0.3200 0.6000 ok (interval: 0.1000 to 0.2000)");
        // Stored results that lack the errors of single volumes have no interval.
        let mut kept = all[0].clone();
        kept.rows.iter_mut().for_each(|r| r.by_volume.clear());
        let name = "nyx_cosmology/network-over-constant";
        assert_eq!(of(&paper, &[kept], name), "0.1600 0.2000 ok (interval: unknown)");
    }

    #[test]
    fn one_network_of_all_data_sets_counts_where_there_is_no_other() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/timings/paper.json");
        let paper = super::super::description::read(&file).unwrap();
        let mut improved = Results::new(Panel::Improved, SETS, BASE_MODE, String::new());
        improved.rows.push(row(CONSTANT, "Castro", [4.0, 4.0], None));
        improved.rows.push(row(LVRP_AS_PAPER, "Castro", [1.0, 1.0], None));
        improved.rows.push(row(AS_IT_IS, "Castro", [0.25, 0.25], Some(0.25)));
        improved.rows.push(row(DISTILLED, "Castro", [0.01, 0.01], Some(0.05)));
        let found = bars(&paper, &[improved], 0, &[], 1.0);
        let of = |name: &str| {
            let bar = found.iter().find(|b| b.name == format!("paper/castro_blast/{name}")).unwrap();
            bar.to_string().split_once(&bar.name).unwrap().1.trim().to_owned()
        };
        let note = format!("(interval: 0.2500 to 0.2500; {ONE_NETWORK})");
        assert_eq!(of("network-over-constant"), format!("0.2500 0.2500 ok {note}"));
        assert!(of("network-over-lvrp").starts_with("0.5000 0.6000 ok"));
        assert!(of("distilled-network-over-constant").starts_with("0.0500 0.2500 ok"));
        assert!(of("distilled-network-over-lvrp").starts_with("0.1000 0.6000 ok"));
    }

    /// The pages of the repository make none of the listed claims, and a claim is found even if its lines
    /// break elsewhere.
    #[test]
    fn no_page_says_what_the_results_contradict() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/timings/paper.json");
        let mut paper = super::super::description::read(&file).unwrap();
        assert!(paper.contradicted.wordings.len() >= 10);
        assert_eq!(contradicted(&paper).unwrap(), 0.0);
        let page = tempfile::NamedTempFile::new().unwrap();
        let wording = paper.contradicted.wordings[0].replace(' ', "\n");
        std::fs::write(page.path(), format!("Some text. {wording}")).unwrap();
        paper.contradicted.pages.push(page.path().to_owned());
        assert_eq!(contradicted(&paper).unwrap(), 1.0);
        paper.contradicted.pages.clear();
        assert!(contradicted(&paper).is_err());
    }

    #[test]
    fn what_holds_for_two_of_three_is_the_second_best() {
        assert_eq!(nth_best(&mut [17.3, 19.5, 15.7], 2), Some(17.3));
        assert_eq!(nth_best(&mut [17.3], 2), None);
    }
}
