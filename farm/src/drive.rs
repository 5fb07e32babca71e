//! The driver: sends bundles, records their results, and predicts the end of the job.

use super::database::{Database, Options, planner};
use super::dispatch::Order;
use super::engine::{self, Bundle, Engine, Event, MAX_FRUITLESS_STARTS, Properties};
use super::job::Job;
use super::planner::{Planner, Setting, State};
use super::record::{Answer, Entry, JOURNAL_FORMAT, Line, unix_now};
use super::show::{Show, View};
use super::spool;
use super::worker::says_full;
use anyhow::{Result, bail, ensure};
use entire_io::files::write_whole;
use entire_io::interrupt;
use entire_io::machine;
use std::collections::{HashMap, HashSet};
use std::io::Read;
use std::time::{Duration, Instant};

/// Minimum interval between estimates of the job's end.
const ETA_EVERY: Duration = Duration::from_millis(1000);
/// Interval between writings of the database's table during a run.
const TABLE_EVERY: Duration = Duration::from_secs(30);
/// Time limit of the images in progress after Ctrl-C.
const STOP_TIME_LIMIT: Duration = Duration::from_secs(600);
/// Maximum number of restarts of an engine without a finished task in between.
const RESTARTS: u32 = 3;
/// Quantile of a bundle's seconds that its time request covers.
const UPPER: f64 = 0.99;
/// Interval, in views, between the views that a preview renders first.
const PREVIEW: usize = 8;

/// Result of a run.
#[derive(Clone, Debug, Default)]
pub struct Summary {
    /// Number of images in the database.
    pub done: usize,
    /// Ids and last errors of the tasks that were given up.
    pub quarantined: Vec<(String, String)>,
    /// Number of tasks that were finished in this run.
    pub now: usize,
    /// Seconds of this run.
    pub seconds: f64,
}

/// Queues all tasks that have not ended. If `preview` is true, every eighth view at the smallest size and the
/// coarsest step comes first.
pub fn queue(planner: &mut Planner, job: &Job, preview: bool) {
    let all = (0..job.len() as u32).filter(|t| planner.state(*t) == State::Idle);
    if !preview {
        let all = all.collect();
        return planner.add_stage(all);
    }
    let pixels = |i: usize| u64::from(job.sizes[i][0]) * u64::from(job.sizes[i][1]);
    let small = (0..job.sizes.len()).min_by_key(|i| pixels(*i)).unwrap_or(0);
    let coarse = (0..job.steps.len()).max_by(|a, b| job.steps[*a].total_cmp(&job.steps[*b])).unwrap_or(0);
    let (first, rest): (Vec<u32>, _) = all.partition(|t| {
        let at = job.place(*t as usize);
        at.camera.is_multiple_of(PREVIEW) && at.size == small && at.step == coarse
    });
    planner.add_stage(first);
    planner.add_stage(rest);
}

/// Returns a number of bytes. If the disk has room for so many, a task's failure is not blamed on a full
/// disk. The number is the largest of 256 KiB, the bytes of an uncompressed image of this size, and twice the
/// bytes of the largest image so far (the worker copies a program's image).
fn probe_bytes(largest: u64, [width, height]: [u32; 2]) -> u64 {
    let raw = 4u64.saturating_mul(width.into()).saturating_mul(height.into());
    (1u64 << 18).max(largest.saturating_mul(2)).max(raw)
}

struct Drive<'a, 'b> {
    database: &'b mut Database<'a>,
    planner: Planner,
    engine: Box<dyn Engine>,
    nodes: HashMap<String, usize>,
    /// Pairs of a node and a volume that the node has loaded in this run.
    loaded: HashSet<(usize, usize)>,
    failures: HashMap<u32, u32>,
    losses: HashMap<u32, u32>,
    /// The task that each bundle's worker has begun last.
    at: HashMap<u64, u32>,
    /// Number of bundles that were lost before any of their tasks began, counted since the last line of a
    /// worker.
    stillborn: usize,
    busy: f64,
    over: usize,
    /// Ended bundles whose files are removed after the next flush of the journal.
    to_clear: Vec<u64>,
    first: Option<f64>,
    idle_from: Option<f64>,
    now: usize,
    largest: u64,
    full: Option<String>,
    down: Option<String>,
}

/// Runs a job. `base`: ln of the base seconds of every task; `start` starts an engine for the run with the
/// given number.
///
/// # Errors
/// When the engine cannot be used, the disk is full, or Ctrl-C is pressed; finished tasks stay finished.
pub fn run(
    database: &mut Database<'_>,
    base: Vec<f32>,
    options: &Options,
    start: &mut dyn FnMut(u64) -> Result<Box<dyn Engine>>,
) -> Result<Summary> {
    let job = database.job;
    let engine = start(database.run)?;
    let Properties { name, slots, bound, limit, .. } = engine.properties();
    if !bound {
        // Workers of the previous run may have finished images while `start` cleared their queue.
        database.take_over()?;
    }
    let setting = Setting {
        slots,
        bound,
        overhead: options.overhead,
        limit,
        order: options.order,
        learn: options.order != Order::Uniform,
    };
    let base = if setting.learn { base } else { vec![0.0; base.len()] };
    let mut planner = planner(job, base, setting);
    planner.number_from(database.run << 32);
    let mut nodes = HashMap::new();
    for (&task, answer) in &database.done {
        let next = nodes.len();
        let node = *nodes.entry(answer.node.clone()).or_insert(next);
        planner.done_before(task, if bound { 0 } else { node }, answer.seconds);
    }
    for task in database.quarantined.keys() {
        planner.quarantine(None, *task);
    }
    if bound {
        nodes.clear();
    }
    queue(&mut planner, job, options.preview);
    database.journal.add(&Entry::Run {
        format: JOURNAL_FORMAT.into(),
        job: job.name.clone(),
        date: machine::now(),
        engine: name.into(),
        slots,
        at: unix_now(),
    });
    database.journal.flush()?;
    let largest = database.done.values().map(|answer| answer.bytes).max().unwrap_or(0);
    let mut drive = Drive {
        database,
        planner,
        engine,
        nodes,
        loaded: HashSet::new(),
        failures: HashMap::new(),
        losses: HashMap::new(),
        at: HashMap::new(),
        stillborn: 0,
        busy: 0.0,
        over: 0,
        to_clear: Vec::new(),
        first: None,
        idle_from: None,
        now: 0,
        largest,
        full: None,
        down: None,
    };
    let result = drive.run(start);
    let flushed = drive.flush();
    drop(drive);
    let table = database.write_table();
    let summary = result?;
    flushed?;
    table?;
    Ok(summary)
}

impl Drive<'_, '_> {
    fn run(&mut self, start: &mut dyn FnMut(u64) -> Result<Box<dyn Engine>>) -> Result<Summary> {
        let stop = interrupt::flag()?;
        let mut show = Show::begin();
        let (clock, begin) = (Instant::now(), unix_now());
        let (mut eta_at, mut table_at) = (None::<Instant>, Instant::now());
        let (mut eta, mut printed) = ([f64::NAN; 3], -1.0);
        let (mut restarts, mut done_then) = (0, 0);
        while !(self.planner.is_over() || self.full.is_some() || interrupt::requested(&stop)) {
            while self.send()? {}
            ensure!(
                self.planner.running() > 0 || self.planner.is_over() || self.full.is_some(),
                "{} tasks wait, but no slot takes one; please report this with the job file",
                self.planner.pending()
            );
            self.take()?;
            let reordered = self.planner.refresh();
            // Bundles are sent before the flush, so that slots do not wait for it. Until the flush, the spool
            // has the results.
            while self.send()? {}
            let flushed = self.flush();
            self.unless_full(flushed)?;
            if self.full.is_some() {
                break;
            }
            if reordered {
                self.engine.reprioritize(&self.urgency())?;
            }
            if let Some(why) = self.down.take() {
                if self.now > done_then {
                    restarts = 0;
                }
                restarts += 1;
                done_then = self.now;
                if restarts > RESTARTS {
                    bail!("{why}; {RESTARTS} restarts failed");
                }
                entire_io::files::note(&format!("{why}; the engine is started again"));
                self.restart(start)?;
            }
            if eta_at.is_none_or(|t| t.elapsed() >= ETA_EVERY.max(8 * show.cost)) {
                let before = Instant::now();
                let now = unix_now();
                self.measure_overhead(now);
                eta = self.planner.eta(now).map(|s| now - begin + s);
                let (done, all) = self.planner.progress();
                let share = done as f64 / all.max(1) as f64;
                if share >= printed + 0.01 {
                    printed = share;
                    let ends = eta.map(|e| begin + e);
                    self.database.journal.add(&Entry::Eta { at: now, share, ends });
                }
                show.update(&self.view(eta, now - begin));
                show.cost = before.elapsed();
                eta_at = Some(Instant::now());
            }
            if table_at.elapsed() >= TABLE_EVERY {
                let written = self.database.write_table();
                if let Err(error) = self.unless_full(written) {
                    show.note(&format!("{error:#}; the table is written again later"));
                }
                table_at = Instant::now();
            }
        }
        let interrupted = interrupt::requested(&stop) && !self.planner.is_over();
        if self.full.is_some() {
            // The run ends with the error in `full`, whether `cancel` succeeds or not.
            let _ = self.engine.cancel();
        } else if interrupted {
            show.note(&format!(
                "finishing the images in progress, for at most {} minutes; Ctrl-C again ends at once",
                STOP_TIME_LIMIT.as_secs() / 60
            ));
            self.engine.cancel()?;
            let patience = Instant::now();
            while self.planner.running() > 0 && patience.elapsed() < STOP_TIME_LIMIT {
                self.take()?;
                let flushed = self.flush();
                self.unless_full(flushed)?;
                if self.full.is_some() || self.down.is_some() {
                    break;
                }
            }
        }
        show.update(&self.view(eta, unix_now() - begin));
        show.finish();
        let (done, tasks) = (self.database.done.len(), self.database.job.len());
        if let Some(why) = &self.full {
            bail!("{why}; {done} of {tasks} images are done; free disk space and continue with --resume");
        }
        if interrupted && !self.planner.is_over() {
            bail!("interrupted: {done} of {tasks} images are done; continue with --resume");
        }
        let quarantined = self.database.quarantined.iter();
        Ok(Summary {
            done,
            quarantined: quarantined.map(|(task, error)| (self.id(*task), error.clone())).collect(),
            now: self.now,
            seconds: clock.elapsed().as_secs_f64(),
        })
    }

    /// Flushes the journal to the disk. Then removes the files of ended bundles, since the journal has their
    /// results.
    fn flush(&mut self) -> Result<()> {
        self.database.journal.flush()?;
        let state = self.database.job.state();
        self.to_clear.drain(..).for_each(|bundle| engine::clear(&state, bundle));
        Ok(())
    }

    fn id(&self, task: u32) -> String {
        format!("{:016x}", self.database.job.id(task as usize))
    }

    /// Returns the result. An error that says that the disk is full is recorded instead, and the run then
    /// ends.
    fn unless_full(&mut self, result: Result<()>) -> Result<()> {
        match result {
            Err(error) if says_full(&error) => {
                self.disk_is_full();
                Ok(())
            }
            other => other,
        }
    }

    fn disk_is_full(&mut self) {
        self.full.get_or_insert(format!("the disk of {} is full", self.database.job.output.display()));
    }

    /// Sends bundles to free slots, unless the disk is full. Returns true if every bundle was quarantined
    /// instead of sent, so that slots are still free.
    fn send(&mut self) -> Result<bool> {
        if self.full.is_some() {
            return Ok(false);
        }
        let now = unix_now();
        let Properties { slots, bound, limit, waiting, .. } = self.engine.properties();
        let mut bundles = Vec::new();
        if bound {
            for slot in self.planner.free_slots() {
                bundles.extend(self.planner.next(Some(slot), now));
            }
        } else {
            while self.planner.running() < slots + waiting {
                let Some(sent) = self.planner.next(None, now) else { break };
                bundles.push(sent);
            }
        }
        if bundles.is_empty() {
            return Ok(false);
        }
        let blind = self.planner.is_blind();
        let mut ready = Vec::new();
        for sent in bundles {
            let retries = sent.tasks.iter().filter_map(|t| self.losses.get(t)).max().copied().unwrap_or(0);
            let mut upper_s = f64::INFINITY;
            if !bound {
                let loading = 2.0 * self.planner.loads.seconds(sent.volume, false);
                upper_s = self.planner.learner().upper(&sent.tasks, UPPER) + loading + self.planner.overhead;
                upper_s *= f64::from(1u32 << retries.min(6));
            }
            // A task is not given up if its expected time is only assumed: it is sent, with the limit as its
            // time request.
            if let Some(limit) = limit.filter(|l| sent.expected_s > *l && !blind) {
                // A bundle of several tasks is expected to keep to the limit, so this bundle has one task.
                let why = format!(
                    "the task is expected to take {:.0} s, its volume's loading included; the engine runs \
                     nothing longer than {limit:.0} s (see --time-limit)",
                    sent.expected_s
                );
                for task in sent.tasks.clone() {
                    self.quarantine(sent.bundle, task, &why)?;
                }
                self.planner.ended(sent.bundle, now);
                continue;
            }
            let seconds = sent.tasks.iter().zip(&sent.predicted_s);
            let orders = seconds.map(|(t, s)| self.database.order(*t, f64::from(*s))).collect();
            ready.push(Bundle { number: sent.bundle, slot: sent.slot, orders, upper_s });
        }
        let submitted = self.engine.submit(&ready);
        self.unless_full(submitted)?;
        Ok(ready.is_empty())
    }

    /// Returns the numbers of the bundles that have not begun, the longest first.
    fn urgency(&self) -> Vec<u64> {
        let seconds = |b: &u64| self.planner.open(*b).iter().map(|t| self.planner.expected(*t)).sum::<f64>();
        let mut waits = self.planner.not_begun();
        waits.sort_by(|a, b| seconds(b).total_cmp(&seconds(a)));
        waits
    }

    /// Waits for events of the engine and records them.
    fn take(&mut self) -> Result<()> {
        for event in self.engine.poll(Duration::from_millis(100))? {
            if matches!(event, Event::Line(..)) {
                self.stillborn = 0;
            }
            match event {
                Event::Line(bundle, Line::Begin { begins }) => {
                    let now = unix_now();
                    self.first.get_or_insert(now);
                    self.planner.begun(bundle, now);
                    self.at.extend(self.database.number(&begins).map(|task| (bundle, task)));
                }
                Event::Line(bundle, Line::Answer(answer)) => self.answer(bundle, answer)?,
                Event::Line(bundle, Line::End { .. }) => {
                    self.over += 1;
                    self.ended(bundle);
                }
                Event::Lost(bundle, why) => self.lost(bundle, &why)?,
                Event::Fresh(slot) => self.planner.forget(slot),
                Event::Down(why) => {
                    // The first reason is the cause of the others.
                    self.down.get_or_insert(why);
                }
            }
        }
        Ok(())
    }

    fn answer(&mut self, bundle: u64, answer: Answer) -> Result<()> {
        let Some(task) = self.database.number(&answer.task) else { return Ok(()) };
        if let Some(error) = answer.error.clone() {
            return self.failed(bundle, task, &error, answer.disk_full);
        }
        let node = self.planner.slot_of(bundle).unwrap_or_else(|| {
            let next = self.nodes.len();
            *self.nodes.entry(answer.node.clone()).or_insert(next)
        });
        let volume = self.planner.learner().shape().volume(task as usize);
        if answer.load_s > 0.0 {
            let warm = !self.loaded.insert((node, volume));
            self.planner.loads.observe(volume, warm, answer.load_s);
        }
        self.busy += answer.seconds + answer.load_s;
        self.planner.done(bundle, task, node, answer.seconds, answer.load_s);
        self.largest = self.largest.max(answer.bytes);
        if !self.database.done.contains_key(&task) {
            self.now += 1;
            self.database.finish(task, answer);
        }
        Ok(())
    }

    fn failed(&mut self, bundle: u64, task: u32, error: &str, disk_full: bool) -> Result<()> {
        if disk_full || !self.has_room(task) {
            self.disk_is_full();
            self.planner.again(bundle, task);
            return Ok(());
        }
        let count = self.failures.entry(task).or_insert(0);
        *count += 1;
        if *count >= self.database.job.retry.attempts {
            return self.quarantine(bundle, task, error);
        }
        self.database.journal.add(&Entry::Failed { task: self.id(task), error: error.to_owned() });
        self.planner.again(bundle, task);
        Ok(())
    }

    fn has_room(&self, task: u32) -> bool {
        let job = self.database.job;
        let bytes = probe_bytes(self.largest, job.sizes[job.place(task as usize).size]);
        let probe = job.state().join("parts").join("room");
        let written = std::fs::File::create(&probe).and_then(|mut f| {
            std::io::copy(&mut std::io::repeat(0x5a).take(bytes), &mut f)?;
            f.sync_data()
        });
        let _ = std::fs::remove_file(&probe);
        !matches!(&written, Err(e) if crate::worker::is_full(e))
    }

    fn quarantine(&mut self, bundle: u64, task: u32, error: &str) -> Result<()> {
        let id = self.id(task);
        let state = self.database.job.state();
        let output = spool::end_of(&state.join("logs").join(format!("{id}.log")));
        let name = format!(".farm/quarantine/{id}.log");
        let order = serde_json::to_string_pretty(&self.database.order(task, self.planner.expected(task)))?;
        let text = format!("{error}\n\n{order}\n\n{output}");
        if let Err(error) = write_whole(&self.database.job.output.join(&name), text.as_bytes()) {
            self.planner.again(bundle, task);
            return self.unless_full(Err(error));
        }
        let entry = Entry::Quarantined { task: id, error: error.to_owned(), log: name };
        self.database.journal.add(&entry);
        self.database.quarantined.insert(task, error.to_owned());
        self.planner.quarantine(Some(bundle), task);
        Ok(())
    }

    fn ended(&mut self, bundle: u64) {
        if self.planner.slot_of(bundle).is_none() {
            self.to_clear.push(bundle);
        }
        self.planner.ended(bundle, unix_now());
        self.at.remove(&bundle);
    }

    fn lost(&mut self, bundle: u64, why: &str) -> Result<()> {
        let at = self.at.get(&bundle).copied().filter(|t| self.planner.open(bundle).contains(t));
        if let Some(task) = at.filter(|_| !why.is_empty()) {
            self.database.journal.add(&Entry::Lost { task: self.id(task), why: why.to_owned() });
            let count = self.losses.entry(task).or_insert(0);
            *count += 1;
            if *count >= self.database.job.retry.losses {
                self.quarantine(bundle, task, why)?;
            }
        }
        if !self.at.contains_key(&bundle) && !why.is_empty() {
            self.stillborn += 1;
            ensure!(
                self.stillborn <= MAX_FRUITLESS_STARTS * self.engine.properties().slots,
                "{} bundles in a row ended before a worker began a task; the last one: {why}",
                self.stillborn
            );
        }
        self.ended(bundle);
        Ok(())
    }

    /// Starts an engine in place of one that has ended. The bundles of the ended engine are lost, except for
    /// the answers in the spool. Answers that were processed before are skipped: a failure counts once.
    fn restart(&mut self, start: &mut dyn FnMut(u64) -> Result<Box<dyn Engine>>) -> Result<()> {
        for bundle in self.planner.bundles() {
            for line in spool::lines(&spool::path(&self.database.job.state(), bundle))? {
                let Line::Answer(answer) = line else { continue };
                let open = self.planner.open(bundle);
                if self.database.number(&answer.task).is_some_and(|task| open.contains(&task)) {
                    self.answer(bundle, answer)?;
                }
            }
            engine::cancel(&self.database.job.state(), bundle);
            self.planner.ended(bundle, unix_now());
        }
        self.at.clear();
        self.engine = start(self.database.run)?;
        Ok(())
    }

    /// Measures the overhead of bundles that are not bound to slots: idle seconds of slots / number of ended
    /// bundles. [`Planner::ended`] measures the overhead of bound bundles.
    fn measure_overhead(&mut self, now: f64) {
        let Properties { slots, bound, .. } = self.engine.properties();
        let Some(first) = self.first.filter(|_| !bound) else { return };
        if self.planner.pending() == 0 {
            self.idle_from.get_or_insert(now);
        }
        if self.idle_from.is_some() || self.over < 2 * slots {
            return;
        }
        // Estimated slot seconds that went into the running bundles: for each slot, half of a bundle's mean
        // time.
        let under_way: f64 = 0.5 * slots as f64 * self.busy / self.over as f64;
        let idle = (now - first) * slots as f64 - self.busy - under_way.min(self.busy);
        self.planner.overhead = (idle / self.over as f64).clamp(0.001, 60.0);
    }

    fn view(&self, eta: [f64; 3], elapsed: f64) -> View {
        let (done, all) = self.planner.progress();
        View {
            done,
            all,
            quarantined: self.database.quarantined.len(),
            rate: self.now as f64 / elapsed.max(1e-3),
            elapsed,
            eta,
            nodes: self.engine.nodes(),
        }
    }
}

#[cfg(test)]
#[path = "drive_tests.rs"]
mod tests;
