//! The paper's network on each data set, tested on measured frames of left-out members: trained by the
//! paper's recipe, with the changes of the recipe that clearly lower the error, and distilled from a teacher
//! model. The results also have the errors of the teacher, and of LVRP with two numbers of voxels.

use super::Work;
use super::description::{Panel, TrialTables};
use super::frames::{low_as_text, main_encoder};
use super::judge::Judge;
use super::results::{LVRP_AS_PAPER, Results, kept, write};
use super::trials::{ALL_MEMBERS, Measured, SETS, changed_recipes, trained};
use crate::study::{by_proxy, line_of};
use anyhow::Result;
use entire_io::files::{fnv1a_text, note, open_model, read_bytes};
use entire_io::metrics::median;
use entire_train::fit::{FitContext, predict};
use entire_train::split::TimedFrames;
use indicatif::ProgressBar;

/// Name of the network that was trained on a teacher's labels.
pub(super) const DISTILLED: &str = "distilled network";
/// Name of the model that labeled the distilled network's frames.
pub(super) const TEACHER: &str = "its teacher, entire's predictor";

/// Runs the missing trainings of all modes, and writes the errors of all networks.
pub(crate) fn run(work: &Work<'_>) -> Result<()> {
    for tables in work.paper.trials.tables.iter().filter(|t| work.selection.has_mode(&t.mode)) {
        if let Some(measured) = Measured::read(work, tables)? {
            make(work, tables, &measured)?;
        }
    }
    Ok(())
}

fn make(work: &Work<'_>, tables: &TrialTables, measured: &Measured) -> Result<()> {
    let asked = &work.paper.trials;
    let shipped = [(DISTILLED, &tables.distilled), (TEACHER, &tables.teacher)];
    if let Some((_, path)) = shipped.iter().find(|(_, path)| !path.exists()) {
        note(&format!("{} does not exist; mode {} is left out", path.display(), tables.mode));
        return Ok(());
    }
    let trials = changed_recipes(work, measured, &asked.changes[asked.changes.len() - 1..])?;
    let (done, mut inputs) = trained(work, &trials, asked.runs)?;
    for (_, path) in shipped {
        inputs += &fnv1a_text(&read_bytes(path)?);
    }
    inputs += &low_as_text(&measured.lower);
    let mark = measured.mark(inputs);
    if kept(work.out, Panel::Improved, SETS, &tables.mode, &mark)? {
        return Ok(());
    }
    let (hidden, stop) = (ProgressBar::hidden(), || work.stop());
    let context = FitContext { tables: &measured.tables, pool: work.pool, bar: &hidden, stop: &stop };
    let (test, learned) = (measured.frames(1), measured.frames(0));
    let mut predictors: Vec<(String, Vec<Vec<f64>>)> = Vec::new();
    for (trial, done) in trials.iter().zip(done) {
        predictors.push((trial.change.name.clone(), done.into_iter().map(|d| d.predicted).collect()));
    }
    for (name, path) in shipped {
        predictors.push((name.into(), vec![predict(&open_model(path)?, &context, &test.frames)?]));
    }
    let mut results = Results::new(Panel::Improved, SETS, &tables.mode, mark);
    results.encoder = main_encoder(work, None)?.1;
    let mut judged = |split: &str, wanted: &dyn Fn(&str, &str) -> bool, set: &str| {
        let chosen: Vec<usize> = (0..test.frames.len())
            .filter(|i| wanted(&test.frames[*i].scene.volume, &test.frames[*i].scene.member))
            .collect();
        if chosen.is_empty() {
            return;
        }
        let part = TimedFrames {
            frames: chosen.iter().map(|i| test.frames[*i]).collect(),
            seconds: chosen.iter().map(|i| test.seconds[*i]).collect(),
        };
        let line_on = learned.parted(|f| set.is_empty() || of_set(&f.scene.volume, set)).0;
        let line = line_of(&measured.low, &line_on);
        let mut judge = Judge::new(&measured.low, asked.runs, split, &part, line);
        let lower = by_proxy(&measured.lower, line_of(&measured.lower, &line_on), &part.frames);
        if let Some(predicted) = lower.into_iter().collect::<Option<Vec<f64>>>() {
            judge.add(LVRP_AS_PAPER, &[predicted]);
            let took =
                |f: &&entire_io::dataset::TimedFrame| measured.lower.get(&(f.table, f.number)).copied();
            let mut times: Vec<f64> = part.frames.iter().filter_map(took).collect();
            if let Some(row) = judge.rows.last_mut() {
                row.latency = median(&mut times);
            }
        }
        for (name, runs) in &predictors {
            let pick = |run: &Vec<f64>| chosen.iter().map(|i| run[*i]).collect();
            judge.add(name, &runs.iter().map(pick).collect::<Vec<Vec<f64>>>());
        }
        results.rows.append(&mut judge.rows);
    };
    judged(ALL_MEMBERS, &|_, _| true, "");
    for set in work.paper.data_sets.iter().filter(|d| !d.only_tests) {
        let Some(members) = &set.members else { continue };
        let of = |volume: &str, member: &str| of_set(volume, &set.name) && members.test.contains(member);
        judged(&set.title, &of, &set.name);
    }
    results.measured_as(&measured.tables[0]);
    write(work.out, &results)
}

fn of_set(volume: &str, set: &str) -> bool {
    volume.split('/').any(|part| part == set)
}
