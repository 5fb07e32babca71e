//! Sections on experiments without a counterpart in the paper, and on further studies.

use super::bars::ratio_of;
use super::description::{Also, BASE_MODE, Panel, Paper, read};
use super::encode::ALL;
use super::improved::DISTILLED;
use super::interval;
use super::judge::NETWORK;
use super::results::{CONSTANT, LVRP, LVRP_AS_PAPER, Material, Results, Row, read_material};
use super::section::{
    Section, errors_by_data_set, errors_table, mode_in_words, over, seconds, title, with_interval,
};
use super::train::{BETWEEN_VOLUMES, FEATURE_VECTOR};
use super::trials::{ALL_MEMBERS, AS_IT_IS};
use anyhow::Result;
use entire_report::{Axis, Chart, Mark, Series, Table};

/// Experiments without a counterpart in the paper, on the causes of the network's error: title, command,
/// first part of the names of files, and section.
pub(super) fn trials(paper: &Paper, material: &Material) -> Vec<([&'static str; 3], Section)> {
    let of = |panel: Panel| material.all.iter().filter(move |r| r.panel == panel);
    let mut procedure = Section::default();
    for r in of(Panel::Procedure) {
        let changed =
            r.rows.iter().filter(|x| x.split == ALL_MEMBERS && x.name != CONSTANT && x.name != LVRP).count();
        if changed > 1 {
            let what = "The network of the first row was trained by the paper's recipe (inputs, \
                        loss, training settings) on measured frames. Each other row changes one \
                        part of the recipe; the last row changes three. `lobes in every order` \
                        trains on each frame once for each order of its lobes. `weights of the \
                        last epochs` has no validation frames; its weights are those of the epoch \
                        with the lowest training loss.";
            procedure.tables.push(trials_table(r, what, "change"));
        }
    }
    let mut improved = Section::default();
    improved.tables.extend(by_set(paper, &of(Panel::Improved).collect::<Vec<_>>()));
    let mut frames = Section::default();
    for r in of(Panel::Frames) {
        let what = "Another model, the teacher, predicted the frame times for the training. The network was \
                    trained by the paper's recipe with two differences: all frames of the validation \
                    volumes are used, and the more frames, the fewer epochs. It was tested on measured \
                    times.";
        frames.tables.push(trials_table(r, what, "predicted frames of each volume"));
        let x = |row: &Row| row.more.get("training frames").copied();
        let rows = || r.rows.iter().filter(|row| x(row).is_some());
        let line = rows().filter_map(|row| Some((x(row)?, row.over_constant?))).collect();
        let band = rows().filter_map(|row| {
            let (low, high) = r.over_constant_interval(row)?;
            Some((x(row)?, low, high))
        });
        let (x, y) = (Axis::log("frames"), Axis::log("RMSE: network / mean of 15 %"));
        let chart = Chart::new("Error by the number of training frames", x, y)
            .series(Series::new("interval over test volumes", Mark::Band(band.collect())).color(0))
            .series(Series::new("mean over runs", Mark::Line(line)).color(0));
        frames.charts.push((chart, "All networks were trained on the same volumes.".into()));
    }
    let all = [
        (["The recipe, one change at a time", "make paper-procedure", "trial-procedure"], procedure),
        (["Training on predicted frame times", "make paper-frames DATA=FOLDER", "trial-frames"], frames),
        (["Networks with a better recipe or more frames", "make paper-improved", "trial-improved"], improved),
    ];
    all.into_iter().filter(|(_, section)| section.there()).collect()
}

/// Table of the errors of all trials of one part and mode, also relative to the first trial.
fn trials_table(r: &Results, what: &str, name: &str) -> (Table, String) {
    let mut table = Table::headed(&format!(
        "{name} | #training frames | #validation frames | #epochs | #epoch of the chosen weights | #RMSE, s \
         | #SD of the RMSE over runs, s (runs) | #RMSE / SD of the times | #RMSE / RMSE of the mean of 15 % \
         | #RMSE / RMSE of LVRP | #RMSE / RMSE of the first row"
    ));
    let rows = || r.rows.iter().filter(|x| x.split == ALL_MEMBERS && x.more.contains_key("epochs"));
    let first = rows().next();
    for row in rows() {
        let more = |k: &str| row.more.get(k).map(|v| format!("{v:.0}"));
        let over_first = first.map(|f| row.rmse / f.rmse);
        let interval = first.and_then(|f| interval::of_ratio(&row.by_volume, &f.by_volume));
        let spread = row.spread().map_or("-".into(), seconds);
        table.row(vec![
            row.name.as_str().into(),
            more("training frames").into(),
            more("validation frames").into(),
            more("epochs").into(),
            more("best epoch").into(),
            seconds(row.rmse).into(),
            format!("{spread} ({})", row.runs).into(),
            format!("{:.3}", row.rmse / row.sd).into(),
            with_interval(row.over_constant, r.over_constant_interval(row)).into(),
            with_interval(row.over_lvrp, r.over_lvrp_interval(row)).into(),
            over(over_first, interval, first.is_some_and(|f| f.name == row.name)).into(),
        ]);
    }
    let judged = rows().next().map_or(0, |x| x.frames);
    let volumes = rows().next().map_or(0, |x| x.by_volume.len());
    let caption = format!(
        "{what} Shading mode: {}. The {judged} test frames show {volumes} volumes of {ALL_MEMBERS}.",
        mode_in_words(&r.mode)
    );
    (table, caption)
}

/// Table of the errors of all networks by mode and data set, relative to baselines that are computed on the
/// frames of the same data set.
fn by_set(paper: &Paper, of: &[&Results]) -> Option<(Table, String)> {
    let mut table = Table::headed(
        "data set, renderer | #test volumes | #test frames | predictor | #trainings | #RMSE, s | \
         #RMSE / SD of the times | #RMSE / RMSE of the mean of 15 % | #RMSE / RMSE of LVRP | \
         #RMSE / RMSE of LVRP with a 512th of the voxels",
    );
    let mut any = false;
    for r in of {
        let known = |split: &str| split == ALL_MEMBERS || paper.data_sets.iter().any(|d| d.title == split);
        for row in r.rows.iter().filter(|x| x.name != CONSTANT && known(&x.split)) {
            any = true;
            let set = if row.split == ALL_MEMBERS { "all three" } else { row.split.as_str() };
            let lower = r.row(&row.split, LVRP_AS_PAPER);
            let (ratio, interval) = lower.map_or((None, None), |l| ratio_of(row, l));
            table.row(vec![
                format!("{set}, {}", mode_in_words(&r.mode)).into(),
                row.by_volume.len().to_string().into(),
                row.frames.to_string().into(),
                row.name.as_str().into(),
                row.runs.to_string().into(),
                seconds(row.rmse).into(),
                format!("{:.3}", row.rmse / row.sd).into(),
                with_interval(row.over_constant, r.over_constant_interval(row)).into(),
                over(row.over_lvrp, r.over_lvrp_interval(row), row.name == LVRP).into(),
                over(ratio, interval, row.name == LVRP_AS_PAPER).into(),
            ]);
        }
    }
    let caption = format!(
        "Every network was trained on all three data sets. The test frames are of left-out members: m05 of \
         Nyx and Castro, and m03 of MAESTROeX; the rows `all three` also have m04 of Nyx and Castro. \
         `{AS_IT_IS}` is the paper's recipe on measured frames. `{}` predicts the logarithm of seconds, \
         trains on each frame with every order of its lobes, and takes the weights of the epoch with the \
         lowest training loss, without validation frames. `{DISTILLED}` is a shipped network that was made \
         from 440000 frame times of 44 volumes, one of them for validation and one for test. Its teacher \
         predicted these times; the teacher was fitted to measured frames of the same volumes. \
         `{LVRP_AS_PAPER}` renders 24³ of 192³ voxels (Nyx, Castro), and 18³ of 128 × 128 × 192 voxels \
         (MAESTROeX: a 539th). In all rows, a linear fit of its own converts its times. In the unshaded \
         rows, its frames were timed on another machine than all other frames.",
        paper.trials.changes.last().map_or("", |c| c.name.as_str())
    );
    any.then_some((table, caption))
}

/// Sections of the further studies: title, command, and tables.
pub(super) fn also(paper: &Paper) -> Result<Vec<(String, String, Section)>> {
    let of = |a: &Also| {
        let (other, material) = (read(&a.description)?, read_material(&a.kept)?);
        Ok((other.title.clone(), a.command.clone(), study(&other, &material)))
    };
    paper.also.iter().map(of).collect()
}

fn study(paper: &Paper, material: &Material) -> Section {
    let of = |panel: Panel| material.all.iter().filter(move |r| r.panel == panel).collect::<Vec<_>>();
    let mut s = Section::default();
    let mut parts = Vec::new();
    let errors = errors_by_data_set(paper, &of(Panel::Overall), |rule| rule, &mut parts);
    if !parts.is_empty() {
        let clock = if paper.clock == "device" { "device" } else { "processor" };
        let text = format!("The test volumes follow the paper's rule. Frame times are {clock} times.");
        s.tables.push((errors, text));
    }
    let mut vectors = Table::headed(
        "data set, renderer | #training frames | #test frames | \
         #share of the variance of ln(time per pixel) that lies between volumes | #network: RMSE, s | \
         #without feature vector: RMSE, s | #RMSE without / with feature vector",
    );
    let mut any = false;
    for r in of(Panel::Ablation) {
        let split = paper.rule(&r.set).split();
        let rows = (r.row(split, NETWORK), r.row(split, &format!("without {FEATURE_VECTOR}")));
        let (Some(with), Some(without)) = rows else { continue };
        let (ratio, interval) = ratio_of(without, with);
        let share = r.fact(BETWEEN_VOLUMES).and_then(|f| f.get("share"));
        vectors.row(vec![
            title(paper, r).into(),
            r.frames.get(split).map_or(0, |f| f[0]).to_string().into(),
            with.frames.to_string().into(),
            share.map(|s| format!("{:.1} %", 100.0 * s)).into(),
            seconds(with.rmse).into(),
            seconds(without.rmse).into(),
            with_interval(ratio, interval).into(),
        ]);
        any = true;
    }
    if any {
        let text = "The network with and without VolumeNet's feature vector. A cell without a number was \
                    not measured.";
        s.tables.push((vectors, text.into()));
    }
    for r in of(Panel::Varied) {
        let text = "In each of four experiments, one parameter varies; the column `tested on` names it.";
        s.tables.push((errors_table(r), format!("{}. {text}", title(paper, r))));
    }
    let joint: Vec<_> = material.reconstructions.iter().filter(|r| r.encoder.set == ALL).collect();
    if !joint.is_empty() {
        let sets: Vec<_> =
            paper.data_sets.iter().filter(|d| d.modes.iter().any(|m| m == BASE_MODE)).collect();
        let of_set = |title: &str| format!(" | #{title}: training | #{title}: validation | #{title}: test");
        let columns: String = sets.iter().map(|d| of_set(&d.title)).collect();
        let mut table =
            Table::headed(&format!("encoder{columns} | #epochs | reason for the end of the training"));
        for r in joint {
            let mut cells = vec![format!("{}³F{}", r.encoder.size, r.encoder.features).into()];
            for d in &sets {
                let db = |part: &str| r.record.psnr(part, &d.name).map(|v| format!("{v:.2}")).into();
                cells.extend(["train", "validation", "test"].map(db));
            }
            cells.push(r.record.provenance.epochs_run.to_string().into());
            cells.push(r.record.provenance.stopped.as_str().into());
            table.row(cells);
        }
        let text = "Mean PSNR, in dB, of volumes that VolumeNets reconstruct. Each VolumeNet was trained on \
                    all data sets together. No PredNet uses their features: every PredNet of this study \
                    uses a VolumeNet 128³F2 of one data set.";
        s.tables.push((table, text.into()));
    }
    s
}
