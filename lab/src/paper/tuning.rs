//! Fine-tuning: the network is pre-trained on all data sets whose frames were collected. It is then adapted
//! with few frames to other renderers, machines and kinds of volumes, and compared with networks trained from
//! scratch and with unit costs, which are calibrated to the same frames.

use super::Work;
use super::collect::{Kind, table_path};
use super::description::Panel;
use super::frames::{Loaded, identity};
use super::results::{Curve, Fact, MEASURED, Results, SORTED, kept, write};
use super::volumes::{Selection, places, roots};
use crate::study::{Bounds, Low, Runner};
use anyhow::{Context, Result};
use entire_cli::calibrate::calibrate_to_frames;
use entire_core::model::ModelFile;
use entire_io::dataset::feature_table::{code_column, encoder_id};
use entire_io::dataset::{Clock, Table, TimedFrame};
use entire_io::files::{note, open_model};
use entire_io::metrics::{Metrics, median};
use entire_train::fit::{FitContext, Recipe, predict};
use entire_train::split::TimedFrames;
use indicatif::ProgressBar;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Name of the data set in results on other renderers and kinds of volumes.
const ALL_SETS: &str = "all";
/// Name of the data set in results on other machines.
pub(super) const MACHINES: &str = "machines";

/// Frames of a renderer, machine or kind of volumes to which models are adapted: for training and for
/// testing.
struct Target<'a> {
    name: String,
    learned: TimedFrames<'a>,
    judged: TimedFrames<'a>,
    /// Name under which the results are stored: [`ALL_SETS`] or [`MACHINES`].
    set: &'static str,
}

/// Indices of the tables of another renderer or machine: the first is for training, the last for testing.
struct Found {
    name: String,
    first: usize,
    last: usize,
    /// Name under which the results are stored: [`ALL_SETS`] or [`MACHINES`].
    set: &'static str,
}

struct Pretrained<'a> {
    work: &'a Work<'a>,
    runner: &'a Runner<'a>,
    context: &'a FitContext<'a>,
    recipe: &'a Recipe,
    network: PathBuf,
    costs: ModelFile,
}

/// Maximum number of frames in a chart with a point per frame.
const MOST_DRAWN: usize = 100;
/// Smallest time in a chart with a point per frame, seconds.
const LEAST_DRAWN: f64 = 1e-4;

pub(super) fn tune(work: &Work<'_>, clock: Clock, runner: &Runner<'_>) -> Result<()> {
    let paper = work.paper;
    let mode = &paper.tuning.mode;
    // The network is pre-trained on all available data sets, even if only some are selected.
    let everything = Selection::default();
    let all = places(paper, &everything, work.data)?;
    let mut tables: Vec<Table> = Vec::new();
    let mut pieces: Vec<(usize, usize)> = Vec::new();
    for (p, place) in all.iter().enumerate() {
        // The call computes missing features of the table.
        if Loaded::read(work, place, mode, clock)?.is_none() {
            continue;
        }
        let path = table_path(work.out, &place.set.name, mode, Kind::Random, false);
        pieces.push((p, tables.len()));
        tables.push(Table { root: Some(place.root.clone()), ..Table::read(&path, tables.len())? });
    }
    if pieces.iter().all(|(p, _)| all[*p].set.only_tests) {
        note(&format!("no frames in mode {mode}; nothing to pre-train on"));
        return Ok(());
    }
    let mut others: Vec<Found> = Vec::new();
    let shipped = open_model(&paper.encoders.shipped[0])?;
    let code = code_column(&encoder_id(shipped.volumenet.as_ref().context("no VolumeNet")?), 0);
    let here = machine(&tables[0]).map(str::to_owned);
    let renderers = paper.tuning.renderers.iter().map(|t| (ALL_SETS, t));
    for (set, (name, learn, test)) in renderers.chain(paper.tuning.machines.iter().map(|t| (MACHINES, t))) {
        if !learn.exists() {
            continue;
        }
        let first = tables.len();
        let read = |path: &Path, index: usize| -> Result<Table> {
            let table = Table::read(path, index)?;
            let has = |r: &PathBuf| table.frames.first().is_some_and(|f| r.join(&f.scene.volume).exists());
            Ok(Table { root: roots(work.data).into_iter().find(has), ..table })
        };
        let mut found = vec![read(learn, first)?];
        if learn != test {
            found.push(read(test, first + 1)?);
        }
        let elsewhere = machine(&found[0]) != here.as_deref();
        if set == MACHINES && !elsewhere {
            note(&format!("{name} is left out: its frames are of the machine of the pre-training frames"));
            continue;
        }
        // Tables whose stored features lack the feature vectors of the network's encoder need their volumes.
        let bare = found.iter().filter(|t| t.features.as_ref().is_none_or(|f| f.column(&code).is_none()));
        let lost = bare.flat_map(|t| t.frames.iter().map(move |f| (t, f)));
        let lost = lost.map(|(t, f)| (t, &f.scene.volume)).find(|(t, v)| t.resolve_volume(v).is_none());
        if let Some((_, volume)) = lost {
            note(&format!("{name} is left out: {} has no {volume}", work.data.display()));
            continue;
        }
        let name =
            if set == ALL_SETS && elsewhere { format!("{name}, another machine") } else { name.clone() };
        others.push(Found { name, first, last: first + found.len() - 1, set });
        tables.extend(found);
    }
    let mark = identity(work, Panel::Tuning, ALL_SETS, &tables, &Low::new())?;
    let tests = pieces.iter().any(|(p, _)| all[*p].set.only_tests);
    let mut todo: Vec<&'static str> = Vec::new();
    for set in [ALL_SETS, MACHINES] {
        let any = others.iter().any(|o| o.set == set) || (set == ALL_SETS && tests);
        if any && !kept(work.out, Panel::Tuning, set, mode, &mark)? {
            todo.push(set);
        }
    }
    if todo.is_empty() {
        return Ok(());
    }
    let hidden = ProgressBar::hidden();
    let context = FitContext { tables: &tables, pool: work.pool, bar: &hidden, stop: runner.stop };
    let (mut training, mut validation) = (TimedFrames::default(), TimedFrames::default());
    let mut targets = Vec::new();
    let of_table = |t: usize| TimedFrames::of(&tables[t].frames, clock);
    let pretrained_on: Vec<&str> =
        pieces.iter().map(|(p, _)| &all[*p].set).filter(|s| !s.only_tests).map(|s| s.name.as_str()).collect();
    for (p, t) in &pieces {
        let place = &all[*p];
        match place.main_split() {
            Some(parts) => {
                training = training.and(of_table(*t).parted(|f| parts.training.contains(&f.scene.volume)).0);
                let wanted = |f: &TimedFrame| {
                    parts.validation.contains(&f.scene.volume) && paper.frames.is_of_few(f.number)
                };
                validation = validation.and(of_table(*t).parted(wanted).0);
            }
            None => {
                let (learned, judged) = halves(&of_table(*t));
                let name = place.set.title.clone();
                targets.push(Target { name, learned, judged, set: ALL_SETS });
            }
        }
    }
    for Found { name, first, last, set } in &others {
        // Of a table of another machine, only frames of the pre-training data sets are used. Then the machine
        // is the only difference from the pre-training.
        let known = |f: &TimedFrame| {
            Path::new(&f.scene.volume).iter().any(|part| pretrained_on.iter().any(|s| part == *s))
        };
        let of = |t: usize| if *set == MACHINES { of_table(t).parted(known).0 } else { of_table(t) };
        let (learned, judged) = if first == last { halves(&of(*first)) } else { (of(*first), of(*last)) };
        if learned.frames.is_empty() || judged.frames.is_empty() {
            note(&format!("{name} is left out: it has no frames of the pre-training data sets"));
            continue;
        }
        targets.push(Target { name: name.clone(), learned, judged, set });
    }
    let network = Recipe { volumenet: Some(paper.encoders.shipped[0].clone()), ..paper.network.clone() };
    let none = TimedFrames::default();
    let parts = (&training, &validation);
    let bounds = Bounds::Frames(&none);
    let (_, made) = runner.made("all-pretrained-network", &network, &context, parts, &bounds)?;
    let costs = Recipe { kind: entire_train::fit::Kind::Analytic, ..Recipe::default() };
    let (costs, _) = runner.made("all-pretrained-costs", &costs, &context, parts, &bounds)?;
    let pretrained = Pretrained { work, runner, context: &context, recipe: &network, network: made, costs };
    for set in todo {
        let mut results = Results::new(Panel::Tuning, set, mode, mark.clone());
        results.frames.insert("pre-training".into(), [training.frames.len(), validation.frames.len(), 0]);
        for target in targets.iter().filter(|t| t.set == set) {
            pretrained.take(target, &mut results)?;
        }
        let titles: Vec<&str> = pieces
            .iter()
            .map(|(p, _)| &all[*p].set)
            .filter(|s| !s.only_tests)
            .map(|s| s.title.as_str())
            .collect();
        results.encoder = format!(
            "The network, with the shipped encoder, and unit costs were pre-trained on {} together",
            titles.join(" and ")
        );
        results.measured_as(&tables[0]);
        write(work.out, &results)?;
    }
    Ok(())
}

impl Pretrained<'_> {
    /// Adapts the network and the unit costs to increasing numbers of training frames of `target`, and tests
    /// them on its test frames.
    fn take(&self, target: &Target<'_>, results: &mut Results) -> Result<()> {
        let Self { work, runner, context, recipe, network, costs } = self;
        let none = TimedFrames::default();
        let bounds = Bounds::Frames(&none);
        let mut curves: BTreeMap<&str, Vec<(f64, f64)>> = BTreeMap::new();
        let rmse = |file: &ModelFile| -> Result<f64> {
            let predicted = predict(&file.to_model()?, context, &target.judged.frames)?;
            Ok(Metrics::new(&predicted, &target.judged.seconds).map_or(f64::NAN, |m| m.rmse))
        };
        let mut last: Vec<(&str, ModelFile)> = Vec::new();
        for &count in work.paper.tuning.frames.iter().filter(|n| **n <= target.learned.frames.len()) {
            let mut found: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
            for run in 1..=work.paper.runs {
                work.go_on()?;
                let (few, _) = target.learned.sample(count, run as u64);
                let seed = recipe.seed + 100 * (run as u64 - 1);
                let key = |how: &str| format!("all-{}-{how}-{count}-{run}", target.name);
                let tuned = Recipe {
                    fine_tune: Some(network.clone()),
                    epochs: work.paper.tuning.epochs,
                    preset: None,
                    volumenet: None,
                    seed,
                    ..(*recipe).clone()
                };
                let alone = Recipe { epochs: work.paper.tuning.epochs, seed, ..(*recipe).clone() };
                let parts = (&few, &none);
                let moved = calibrate_to_frames(std::slice::from_ref(costs), context, few.timed())?;
                let made = [
                    ("fine-tuned", runner.made(&key("tuned"), &tuned, context, parts, &bounds)?.0),
                    ("from nothing", runner.made(&key("alone"), &alone, context, parts, &bounds)?.0),
                    ("ours, calibrated", moved),
                ];
                for &(how, ref file) in &made {
                    found.entry(how).or_default().push(rmse(file)?);
                }
                if run == 1 {
                    last = made.into();
                }
            }
            for (how, mut errors) in found {
                if let Some(middle) = median(&mut errors) {
                    curves.entry(how).or_default().push((count as f64, middle));
                }
            }
        }
        let (learned, judged) = (&target.learned.seconds, &target.judged.seconds);
        let mean = learned.iter().sum::<f64>() / learned.len().max(1) as f64;
        let constant = Metrics::new(&vec![mean; judged.len()], judged);
        let zero = predict(&open_model(network)?, context, &target.judged.frames)?;
        let mut drawn = vec![("pre-trained, as it was", zero.clone())];
        for (how, file) in &last {
            drawn.push((how, predict(&file.to_model()?, context, &target.judged.frames)?));
        }
        results.curves.extend(frame_by_frame(target, &drawn));
        let zero = Metrics::new(&zero, judged);
        let mut values = BTreeMap::from([
            ("learned from at most".to_owned(), target.learned.frames.len() as f64),
            ("judged on".to_owned(), target.judged.frames.len() as f64),
            ("ours, as it was".to_owned(), rmse(costs)?),
        ]);
        values.extend(zero.map(|m| ("pre-trained, as it was".to_owned(), m.rmse)));
        values.extend(
            constant.into_iter().flat_map(|m| [("mean".to_owned(), m.rmse), ("sd".to_owned(), m.sd)]),
        );
        results.facts.push(Fact { name: target.name.clone(), values });
        for (how, points) in curves {
            results.curves.push(Curve::new(&target.name, how, "frames learned from", points));
        }
        Ok(())
    }
}

fn machine(table: &Table) -> Option<&str> {
    table.manifest.as_ref().map(|m| m.machine.as_str())
}

/// Curves of measured and predicted times of at most [`MOST_DRAWN`] frames, sorted by measured time.
fn frame_by_frame(target: &Target<'_>, predicted: &[(&str, Vec<f64>)]) -> Vec<Curve> {
    let measured = &target.judged.seconds;
    let mut order: Vec<usize> = (0..measured.len()).collect();
    order.sort_by(|a, b| measured[*a].total_cmp(&measured[*b]));
    let every = order.len().div_ceil(MOST_DRAWN).max(1);
    let shown: Vec<usize> = order.into_iter().step_by(every).collect();
    let curve = |name: &str, seconds: &[f64]| {
        // The chart's axis is logarithmic; a prediction may be negative.
        let drawn: Vec<f64> = shown.iter().map(|i| seconds[*i].max(LEAST_DRAWN)).collect();
        Curve::by_index(&target.name, name, SORTED, &drawn)
    };
    let drawn = predicted.iter().map(|(name, seconds)| curve(name, seconds));
    std::iter::once(curve(MEASURED, measured)).chain(drawn).collect()
}

/// Random halves of some frames, for training and for testing.
fn halves<'a>(all: &TimedFrames<'a>) -> (TimedFrames<'a>, TimedFrames<'a>) {
    all.sample(all.frames.len() / 2, 11)
}
