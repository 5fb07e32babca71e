//! Experiments on the causes of the network's error: the paper's recipe on frames of the repository with one
//! change at a time, and on different numbers of a teacher's labels. Trainings run in parallel, one thread
//! each; each is stored as soon as it ends.

use super::Work;
use super::description::{Change, LowTables, Panel, TrialTables, Validation};
use super::frames::{low_as_text, main_encoder};
use super::judge::Judge;
use super::results::{Results, kept, write};
use crate::study::{Bounds, Low, Runner, line_of, twins};
use anyhow::{Context, Result, bail, ensure};
use entire_core::model::GroupKind;
use entire_core::nn::Target;
use entire_io::dataset::{Clock, Table, TimedFrame};
use entire_io::files::{fnv1a_text, make_folder, note, read_text, write_json};
use entire_io::options::thread_pool;
use entire_io::progress::templated_bar;
use entire_train::fit::{FitContext, Recipe, TargetChoice};
use entire_train::gradient::{Network, Progress, Samples, Settings, preset_widths, train};
use entire_train::split::{GroupBy, TimedFrames};
use indicatif::ProgressBar;
use rayon::ThreadPool;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

/// Name of the trial without a change.
pub(super) const AS_IT_IS: &str = "as it is";
/// Name of the split that holds all test frames. The split of a single data set has the data set's title.
pub(super) const ALL_MEMBERS: &str = "left-out members";
/// Name under which results list all data sets together.
pub(super) const SETS: &str = "all";

/// Version of the results: raised whenever the same frames give other results.
const MADE_AS: u32 = 1;

/// Number of inputs per Gaussian lobe: center, width, height.
const PER_LOBE: usize = 3;

pub(super) struct Trial {
    pub(super) change: Change,
    epochs: usize,
    width: usize,
    pub(super) training: Rows,
    validation: Rows,
    /// Inputs of the frames that are predicted.
    test: Vec<f32>,
}

/// Inputs of a network, one row per frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Rows {
    inputs: Vec<f32>,
    pub(super) seconds: Vec<f64>,
}

impl Rows {
    fn samples(&self) -> Samples<'_> {
        Samples { inputs: &self.inputs, seconds: &self.seconds }
    }
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Done {
    /// Predicted seconds of the test frames.
    pub(super) predicted: Vec<f64>,
    best_epoch: usize,
    seconds: f64,
}

/// Measured tables in memory: training, then test.
pub(super) struct Measured {
    pub(super) tables: Vec<Table>,
    pub(super) low: Low,
    /// The frames as rendered by a proxy with the paper's share of the voxels.
    pub(super) lower: Low,
    clock: Clock,
}

impl Measured {
    /// Reads the tables; `None`, with a note, if one is missing.
    pub(super) fn read(work: &Work<'_>, of: &TrialTables) -> Result<Option<Self>> {
        let clock = work.paper.clock.parse()?;
        if let Some(path) = [&of.training, &of.test].into_iter().find(|p| !p.exists()) {
            note(&format!("{} does not exist; its trials are left out", path.display()));
            return Ok(None);
        }
        let tables = vec![Table::read(&of.training, 0)?, Table::read(&of.test, 1)?];
        let rendered = |by: &LowTables| -> Result<Low> {
            let mut low = Low::new();
            for (index, paths) in [&by.training, &by.test].into_iter().enumerate() {
                for path in paths.iter().filter(|p| p.exists()) {
                    twins((index, &tables[index]), path, clock, &mut low)?;
                }
            }
            Ok(low)
        };
        let (low, lower) = (rendered(&of.low)?, rendered(&of.lower)?);
        Ok(Some(Self { tables, low, lower, clock }))
    }

    pub(super) fn frames(&self, table: usize) -> TimedFrames<'_> {
        TimedFrames::of(&self.tables[table].frames, self.clock)
    }

    /// Hash of a text and of all measured frames.
    pub(super) fn mark(&self, mut inputs: String) -> String {
        for table in &self.tables {
            inputs += &format!(" {:016x}", table.hash);
        }
        inputs += &low_as_text(&self.low);
        fnv1a_text(inputs.as_bytes())
    }

    /// The frames of the training table: those of held-out volumes, and all others.
    fn held_out(&self) -> (TimedFrames<'_>, TimedFrames<'_>) {
        self.frames(0).hold_out(GroupBy::Volume, 1)
    }
}

/// Runs the requested trials of the first mode, except those whose results are stored.
pub(crate) fn run(work: &Work<'_>, panels: &[Panel]) -> Result<()> {
    let first = work.paper.trials.tables.first().filter(|t| work.selection.has_mode(&t.mode));
    let Some(tables) = first else { return Ok(()) };
    for panel in [Panel::Procedure, Panel::Frames].into_iter().filter(|p| panels.contains(p)) {
        let Some(measured) = Measured::read(work, tables)? else { continue };
        let trials = if panel == Panel::Frames {
            by_number(work, &measured)?
        } else {
            changed_recipes(work, &measured, &work.paper.trials.changes)?
        };
        make(work, panel, &tables.mode, &measured, &trials)?;
    }
    Ok(())
}

/// Trains the paper's network on the repository's frames of a mode, or finds it in the folder of models.
/// These frames have none of the members that the recorded paths show, and come from the machine of the
/// paths. `None` if the description names no tables of this mode, or if they are missing.
pub(crate) fn steering_network(work: &Work<'_>, mode: &str) -> Result<Option<PathBuf>> {
    let Some(tables) = work.paper.trials.tables.iter().find(|t| t.mode == mode) else { return Ok(None) };
    let Some(measured) = Measured::read(work, tables)? else { return Ok(None) };
    let (validation, training) = measured.held_out();
    let (shipped, _) = main_encoder(work, None)?;
    let recipe = Recipe { volumenet: Some(shipped), ..work.paper.network.clone() };
    let parts = (&training, &validation);
    made(work, &format!("steering-{mode}"), &recipe, &measured.tables, parts).map(Some)
}

/// Fine-tunes a network to the frames at the reference step of a calibration table.
pub(crate) fn tuned_network(work: &Work<'_>, network: &Path, calibration: &Path) -> Result<PathBuf> {
    let tables = [Table::read(calibration, 0)?];
    let at_reference = |f: &&TimedFrame| f.scene.step == 1.0;
    let learned = TimedFrames::of(tables[0].frames.iter().filter(at_reference), work.paper.clock.parse()?);
    let recipe = Recipe {
        fine_tune: Some(network.to_owned()),
        epochs: work.paper.tuning.epochs,
        preset: None,
        volumenet: None,
        ..work.paper.network.clone()
    };
    made(work, "steering-tuned", &recipe, &tables, (&learned, &TimedFrames::default()))
}

/// Trains a network on the training frames and stops by the validation frames, or finds it in the folder of
/// models.
fn made(
    work: &Work<'_>,
    name: &str,
    recipe: &Recipe,
    tables: &[Table],
    parts: (&TimedFrames<'_>, &TimedFrames<'_>),
) -> Result<PathBuf> {
    let (hidden, none) = (ProgressBar::hidden(), TimedFrames::default());
    let stop = || work.stop();
    let runner = Runner { pool: work.pool, models: work.out.join("models"), bar: &hidden, stop: &stop };
    let context = FitContext { tables, pool: work.pool, bar: &hidden, stop: &stop };
    Ok(runner.made(name, recipe, &context, parts, &Bounds::Frames(&none))?.1)
}

/// Returns a trial of the paper's recipe, and one of each change of the recipe.
pub(super) fn changed_recipes(
    work: &Work<'_>,
    measured: &Measured,
    changes: &[Change],
) -> Result<Vec<Trial>> {
    let asked = &work.paper.trials;
    let (held, training) = measured.held_out();
    let unchanged = Change { name: AS_IT_IS.into(), ..Change::default() };
    let changes = std::iter::once(&unchanged).chain(changes);
    changes
        .map(|change| {
            let validation = match change.validation {
                Validation::Few => held.parted(|f| work.paper.frames.is_of_few(f.number)).0,
                Validation::All => held.clone(),
                Validation::Training => TimedFrames::default(),
            };
            let parts = (&training, &validation);
            trial(work, measured, &measured.tables, parts, change.clone(), asked.epochs)
        })
        .collect()
}

/// Trials of the recipe on growing numbers of labels of each volume, all with the same validation volumes.
fn by_number(work: &Work<'_>, measured: &Measured) -> Result<Vec<Trial>> {
    let path = &work.paper.trials.labels;
    if !path.exists() {
        note(&format!(
            "{} does not exist; `make paper-frames DATA=FOLDER` writes it with a teacher model",
            path.display()
        ));
        return Ok(Vec::new());
    }
    let labels = [Table { root: Some(work.data.to_owned()), ..Table::read(path, 0)? }];
    let held: BTreeSet<&str> = measured.held_out().0.frames.iter().map(|f| f.scene.volume.as_str()).collect();
    let all = TimedFrames::of(&labels[0].frames, measured.clock);
    let mut out = Vec::new();
    for &(count, epochs) in &work.paper.trials.frames {
        let chosen = first_of_each(&all, count)?;
        let (validation, training) = chosen.parted(|f| held.contains(f.scene.volume.as_str()));
        let change = Change { name: count.to_string(), validation: Validation::All, ..Change::default() };
        out.push(trial(work, measured, &labels, (&training, &validation), change, epochs)?);
    }
    Ok(out)
}

/// The first `count` frames of each volume.
fn first_of_each<'a>(all: &TimedFrames<'a>, count: usize) -> Result<TimedFrames<'a>> {
    let mut seen: BTreeMap<&str, usize> = BTreeMap::new();
    let mut out = TimedFrames::default();
    for (frame, seconds) in all.frames.iter().zip(&all.seconds) {
        let n = seen.entry(&frame.scene.volume).or_default();
        *n += 1;
        if *n <= count {
            out.frames.push(frame);
            out.seconds.push(*seconds);
        }
    }
    if let Some((volume, n)) = seen.iter().find(|(_, n)| **n < count) {
        bail!("{volume} has {n} labels; {count} are needed");
    }
    Ok(out)
}

/// A trial of a change, with its training and validation frames.
fn trial(
    work: &Work<'_>,
    measured: &Measured,
    tables: &[Table],
    (training, validation): (&TimedFrames<'_>, &TimedFrames<'_>),
    change: Change,
    mut epochs: usize,
) -> Result<Trial> {
    let (shipped, _) = main_encoder(work, None)?;
    let network = &work.paper.network;
    let recipe = Recipe { volumenet: Some(shipped), sorted_lobes: change.sorted_lobes, ..network.clone() };
    let layout = recipe.layout(training.timed())?.1;
    let groups = layout.groups.clone();
    let rows = |tables: &[Table], frames: &TimedFrames<'_>| {
        let plain = layout.rows(tables, &frames.frames, work.pool, &ProgressBar::hidden())?;
        let (inputs, width) = changed(&plain, &groups, &change);
        Ok::<_, anyhow::Error>((Rows { inputs, seconds: frames.seconds.clone() }, width))
    };
    let (mut training, width) = rows(tables, training)?;
    let (validation, _) = rows(tables, validation)?;
    let (test, _) = rows(&measured.tables, &measured.frames(1))?;
    if change.every_order {
        let orders = every_order(&training, width, &groups)?;
        epochs = (epochs * training.seconds.len()).div_ceil(orders.seconds.len());
        training = orders;
    }
    Ok(Trial { change, epochs, width, training, validation, test: test.inputs })
}

fn place(groups: &[(GroupKind, usize)], wanted: GroupKind) -> std::ops::Range<usize> {
    let before: usize = groups.iter().take_while(|g| g.0 != wanted).map(|g| g.1).sum();
    before..before + groups.iter().find(|g| g.0 == wanted).map_or(0, |g| g.1)
}

/// Rows of inputs with a change applied, and the length of a row.
fn changed(rows: &[f32], groups: &[(GroupKind, usize)], change: &Change) -> (Vec<f32>, usize) {
    let width: usize = groups.iter().map(|g| g.1).sum();
    let sides = place(groups, GroupKind::Resolution);
    let lobes = place(groups, GroupKind::TransferFunction);
    let mut out = Vec::with_capacity(rows.len());
    for row in rows.chunks_exact(width) {
        let mut row = row.to_vec();
        if change.log_inputs {
            row[sides.clone()].iter_mut().for_each(|v| *v = v.ln());
            for lobe in row[lobes.clone()].chunks_exact_mut(PER_LOBE) {
                lobe[1..].iter_mut().for_each(|v| *v = v.ln());
            }
        }
        if change.one_resolution {
            let product: f32 = row[sides.clone()].iter().product();
            row.splice(sides.clone(), [product.powf(1.0 / sides.len().max(1) as f32)]);
        }
        out.extend(row);
    }
    (out, if change.one_resolution { width - sides.len() + 1 } else { width })
}

/// Rows in which every frame occurs once for each order of its Gaussian lobes.
fn every_order(rows: &Rows, width: usize, groups: &[(GroupKind, usize)]) -> Result<Rows> {
    let lobes = place(groups, GroupKind::TransferFunction);
    let count = lobes.len() / PER_LOBE;
    ensure!((1..=4).contains(&count), "{count} Gaussian lobes; 1 to 4 can be taken in every order");
    let mut orders: Vec<Vec<usize>> = vec![Vec::new()];
    for _ in 0..count {
        let longer = |o: Vec<usize>| {
            let rest: Vec<usize> = (0..count).filter(|i| !o.contains(i)).collect();
            rest.into_iter().map(move |i| [o.clone(), vec![i]].concat())
        };
        orders = orders.into_iter().flat_map(longer).collect();
    }
    let mut out = Rows::default();
    for (row, seconds) in rows.inputs.chunks_exact(width).zip(&rows.seconds) {
        for order in &orders {
            let mut other = row.to_vec();
            for (to, from) in order.iter().enumerate() {
                let from = lobes.start + PER_LOBE * from;
                let to = lobes.start + PER_LOBE * to;
                other[to..to + PER_LOBE].copy_from_slice(&row[from..from + PER_LOBE]);
            }
            out.inputs.extend(other);
            out.seconds.push(*seconds);
        }
    }
    Ok(out)
}

impl Trial {
    fn settings(&self, recipe: &Recipe, run: usize) -> Settings {
        Settings {
            epochs: self.epochs,
            batch: self.change.batch.unwrap_or(recipe.batch),
            patience: recipe.patience,
            clip_norm: if self.change.no_clipping { f64::INFINITY } else { recipe.clip },
            target: match self.change.target.unwrap_or(recipe.target) {
                TargetChoice::Seconds => Target::Seconds,
                TargetChoice::LogSeconds => Target::LogSeconds,
            },
            seed: recipe.seed + 100 * (run as u64 - 1),
            ..Settings::default()
        }
    }

    fn train(&self, work: &Work<'_>, run: usize, pool: &ThreadPool) -> Result<Done> {
        let (started, recipe) = (Instant::now(), &work.paper.network);
        let settings = self.settings(recipe, run);
        let preset = recipe.preset.as_deref().context("the network of the description has no preset")?;
        let network = Network::<f32>::random(&preset_widths(preset, self.width)?, settings.seed)?;
        let go_on = |_: &Progress| {
            if work.stop() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        let (training, validation) = (self.training.samples(), self.validation.samples());
        let trained = train(pool, network, None, training, validation, &settings, go_on)?;
        work.go_on()?;
        let mut predicted = trained.predict(pool, &self.test)?;
        ensure!(
            predicted.iter().all(|t| t.is_finite()),
            "{}: a predicted time is infinite or NaN",
            self.change.name
        );
        // A network may predict negative seconds, which are set to 0.
        predicted.iter_mut().for_each(|t| *t = t.max(0.0));
        Ok(Done { predicted, best_epoch: trained.best_epoch, seconds: started.elapsed().as_secs_f64() })
    }

    fn identity(&self, work: &Work<'_>, run: usize) -> Result<String> {
        let settings =
            format!("{:?} {:?}", self.settings(&work.paper.network, run), work.paper.network.preset);
        let mut bytes = format!("{MADE_AS} {settings} {}", self.width).into_bytes();
        for rows in [&self.training, &self.validation] {
            bytes.extend(rows.inputs.iter().flat_map(|v| v.to_le_bytes()));
            bytes.extend(rows.seconds.iter().flat_map(|v| v.to_le_bytes()));
        }
        bytes.extend(self.test.iter().flat_map(|v| v.to_le_bytes()));
        Ok(fnv1a_text(&bytes))
    }
}

/// Calls `worker` on several threads; returns the first error once all have ended.
fn side_by_side(threads: usize, worker: &(dyn Fn() -> Result<()> + Sync)) -> Result<()> {
    let ended: Vec<Result<()>> = std::thread::scope(|scope| {
        let handles: Vec<_> = (0..threads).map(|_| scope.spawn(worker)).collect();
        handles.into_iter().map(|h| h.join().unwrap_or_else(|_| bail!("a training panicked"))).collect()
    });
    ended.into_iter().collect()
}

/// Runs the missing trainings. Returns the runs of each trial, and a text that identifies all trainings.
pub(super) fn trained(work: &Work<'_>, trials: &[Trial], runs: usize) -> Result<(Vec<Vec<Done>>, String)> {
    let folder = work.out.join("trials");
    make_folder(&folder)?;
    let file = |identity: &str| folder.join(format!("{identity}.json"));
    // The first runs of all trials come before any second run.
    let all: Vec<(&Trial, usize)> = (1..=runs).flat_map(|run| trials.iter().map(move |t| (t, run))).collect();
    let identities: Vec<String> = all.iter().map(|(t, run)| t.identity(work, *run)).collect::<Result<_>>()?;
    let todo: Vec<usize> = (0..all.len()).filter(|i| !file(&identities[*i]).exists()).collect();
    let bar = templated_bar("trials [{bar:30}] {pos}/{len}  {wide_msg}");
    bar.set_length(todo.len() as u64);
    let next = AtomicUsize::new(0);
    let worker = || -> Result<()> {
        let pool = thread_pool(Some(1))?;
        while let Some(&i) = todo.get(next.fetch_add(1, Ordering::Relaxed)) {
            let (trial, run) = all[i];
            let done = trial.train(work, run, &pool)?;
            write_json(&file(&identities[i]), &done)?;
            bar.set_message(format!("{}, run {run}: {:.0} s", trial.change.name, done.seconds));
            bar.inc(1);
        }
        Ok(())
    };
    let threads = work.pool.current_num_threads().min(todo.len());
    let ended = side_by_side(threads, &worker);
    bar.finish_and_clear();
    work.go_on()?;
    ended?;
    let read = |i: usize| -> Result<Done> {
        let path: PathBuf = file(&identities[i]);
        let text = read_text(&path, 64 << 20)?;
        serde_json::from_str(&text).with_context(|| format!("{} holds no trial", path.display()))
    };
    let of = |k: usize| -> Result<Vec<Done>> { (0..runs).map(|run| read(run * trials.len() + k)).collect() };
    let runs_of_all = (0..trials.len()).map(of).collect::<Result<Vec<Vec<Done>>>>()?;
    Ok((runs_of_all, identities.concat()))
}

/// Runs the missing trainings, and writes the results of all trials.
fn make(work: &Work<'_>, panel: Panel, mode: &str, measured: &Measured, trials: &[Trial]) -> Result<()> {
    let asked = &work.paper.trials;
    let runs = if panel == Panel::Frames { asked.label_runs } else { asked.runs };
    if trials.is_empty() {
        return Ok(());
    }
    let (done, identities) = trained(work, trials, runs)?;
    let mark = measured.mark(identities);
    if kept(work.out, panel, SETS, mode, &mark)? {
        return Ok(());
    }
    let mut results = Results::new(panel, SETS, mode, mark);
    results.encoder = main_encoder(work, None)?.1;
    let (test, learned) = (measured.frames(1), measured.frames(0));
    let mut judge = Judge::new(&measured.low, runs, ALL_MEMBERS, &test, line_of(&measured.low, &learned));
    for (trial, done) in trials.iter().zip(done) {
        let predicted: Vec<Vec<f64>> = done.iter().map(|d| d.predicted.clone()).collect();
        judge.add(&trial.change.name, &predicted);
        if let Some(row) = judge.rows.last_mut() {
            let best = done.iter().map(|d| d.best_epoch as f64).sum::<f64>() / runs as f64;
            row.more.insert("training frames".into(), trial.training.seconds.len() as f64);
            row.more.insert("validation frames".into(), trial.validation.seconds.len() as f64);
            row.more.insert("epochs".into(), trial.epochs as f64);
            row.more.insert("best epoch".into(), best);
        }
    }
    results.rows.append(&mut judge.rows);
    results.measured_as(&measured.tables[0]);
    write(work.out, &results)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::paper::{Paper, Selection};

    const GROUPS: [(GroupKind, usize); 3] =
        [(GroupKind::Camera, 1), (GroupKind::Resolution, 2), (GroupKind::TransferFunction, 6)];
    const ROW: [f32; 9] = [7.0, 16.0, 64.0, 0.5, 0.01, 0.1, 0.25, 0.02, 0.2];

    #[test]
    fn a_change_touches_its_inputs_alone() {
        let of = |change: &Change| changed(&ROW, &GROUPS, change);
        assert_eq!(of(&Change::default()), (ROW.to_vec(), 9));
        let (row, width) = of(&Change { one_resolution: true, ..Change::default() });
        assert_eq!((&row[..3], row.len(), width), (&[7.0, 32.0, 0.5][..], 8, 8));
        let (row, _) = of(&Change { log_inputs: true, ..Change::default() });
        let ln = f32::ln;
        let expected = [7.0, ln(16.0), ln(64.0), 0.5, ln(0.01), ln(0.1), 0.25, ln(0.02), ln(0.2)];
        assert_eq!(row, expected);
    }

    #[test]
    fn lobes_come_in_each_order_once() {
        let rows = Rows { inputs: ROW.to_vec(), seconds: vec![0.5] };
        let out = every_order(&rows, 9, &GROUPS).unwrap();
        assert_eq!(out.seconds, [0.5, 0.5]);
        assert_eq!(out.inputs[..9], ROW);
        assert_eq!(out.inputs[9..12], ROW[..3]);
        assert_eq!(out.inputs[12..], [&ROW[6..], &ROW[3..6]].concat());
        let three = [(GroupKind::TransferFunction, 9)];
        let rows = Rows { inputs: (0..9u8).map(f32::from).collect(), seconds: vec![1.0] };
        let mut orders: Vec<Vec<u32>> = every_order(&rows, 9, &three)
            .unwrap()
            .inputs
            .chunks_exact(9)
            .map(|r| r.iter().map(|v| *v as u32).collect())
            .collect();
        orders.sort();
        orders.dedup();
        assert_eq!(orders.len(), 6);
    }

    #[test]
    fn workers_end_when_asked_and_errors_are_told() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/timings/paper.json");
        let mut paper: Paper = serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
        (paper.network.preset, paper.network.patience) = (Some("1C32".into()), usize::MAX);
        let (pool, none) = (thread_pool(Some(1)).unwrap(), Path::new(""));
        let work = Work {
            paper: &paper,
            selection: &Selection::default(),
            data: none,
            out: none,
            python: none,
            pool: &pool,
            deadline: None,
            interrupted: &|| true,
        };
        let endless = Trial {
            change: Change::default(),
            epochs: usize::MAX,
            width: ROW.len(),
            training: Rows { inputs: [ROW, ROW].concat(), seconds: vec![0.5, 1.0] },
            validation: Rows::default(),
            test: Vec::new(),
        };
        let asked = side_by_side(2, &|| endless.train(&work, 1, &pool).map(drop)).unwrap_err();
        assert!(asked.to_string().starts_with("interrupted"), "{asked}");
        let error = side_by_side(2, &|| bail!("diverged")).unwrap_err();
        assert_eq!(error.to_string(), "diverged");
    }
}
