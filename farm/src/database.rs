//! A job's database on the disk: finished tasks, from the journal and from answers that the journal lacks.

use super::cinema;
use super::job::Job;
use super::journal::Journal;
use super::learn::{CONSTANT_SD_WITH_MODEL, Shape};
use super::load::Loads;
use super::planner::{Planner, Setting};
use super::record::{Answer, Entry, JOURNAL_FORMAT, Line, Order, parse_id, run_number};
use super::spool;
use anyhow::{Context, Result, ensure};
use entire_io::files::{make_folder, note, write_whole};
use entire_io::identity::{self, Identity};
use std::collections::{BTreeMap, HashMap, HashSet};

/// Options of `entire farm` that concern database and driver.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// True to continue an earlier run.
    pub resume: bool,
    /// True to retry quarantined tasks.
    pub retry_quarantined: bool,
    /// True to compare existing images with their checksums, not only their sizes.
    pub verify: bool,
    /// True to render first every eighth view at the smallest size and the coarsest step.
    pub preview: bool,
    /// Order in which tasks are sent; `Uniform` treats all tasks as equally long in the whole run.
    pub order: crate::dispatch::Order,
    /// Initial estimate of a bundle's overhead, seconds.
    pub overhead: f64,
}

/// A job's database, open for writing: journal and finished tasks.
pub struct Database<'a> {
    pub(super) job: &'a Job,
    pub(super) journal: Journal,
    numbers: HashMap<u64, u32>,
    /// Results of finished tasks. If no expected time of a task is known, its measured time is stored as the
    /// expected time.
    pub(super) done: HashMap<u32, Answer>,
    pub(super) quarantined: HashMap<u32, String>,
    pub(super) run: u64,
}

impl<'a> Database<'a> {
    /// Opens a job's database: makes folders, locks it, reads its journal, and adds answers of workers that
    /// the journal lacks.
    ///
    /// # Errors
    /// When the database has an earlier run and `resume` is not set, another driver is running, or a file
    /// cannot be read or written.
    pub fn open(job: &'a Job, options: &Options) -> Result<Self> {
        let state = job.state();
        for folder in ["spool", "orders", "cancel", "logs", "parts", "quarantine"] {
            make_folder(&state.join(folder))?;
        }
        let numbers = job.numbers();
        ensure!(
            numbers.len() == job.len(),
            "two different tasks have the same id, a hash of 64 bits; split the job into two"
        );
        let (mut done, mut quarantined) = (HashMap::new(), HashMap::new());
        let (mut begun, mut inputs, mut gone) = (false, BTreeMap::new(), HashSet::new());
        let number = |task: &str| parse_id(task).and_then(|id| numbers.get(&id).copied());
        let journal = Journal::open(&state, |entry| {
            match entry {
                Entry::Run { format, .. } => {
                    begun = true;
                    ensure!(
                        format == JOURNAL_FORMAT,
                        "its format is {format:?}, but this version reads {JOURNAL_FORMAT:?}; continue with \
                         the version that began it, or choose another output folder"
                    );
                }
                Entry::Inputs { files } => inputs = files,
                Entry::Done { answer, .. } => {
                    if let Some(task) = number(&answer.task) {
                        quarantined.remove(&task);
                        // A task has several entries if it was rendered again because its picture was
                        // missing: the last one counts.
                        done.insert(task, answer);
                    } else {
                        gone.extend(parse_id(&answer.task));
                    }
                }
                Entry::Quarantined { task, error, .. } => {
                    quarantined.extend(number(&task).map(|task| (task, error)));
                }
                Entry::Failed { .. } | Entry::Lost { .. } | Entry::Eta { .. } => {}
            }
            Ok(())
        })?;
        ensure!(
            options.resume || !begun,
            "{} was begun by an earlier run; continue with --resume, or set another `output` in the job file",
            job.output.display()
        );
        let run = run_number(&state).unwrap_or(0) + 1;
        // Before each task, a worker reads this number. Workers with a bundle of the previous run then end.
        write_whole(&state.join("run"), run.to_string().as_bytes())?;
        let renderer = serde_json::to_vec(&job.renderer)?;
        write_whole(&state.join("renderer.json"), &renderer)?;
        if options.retry_quarantined {
            quarantined.clear();
        }
        let mut new = Self { job, journal, numbers, done, quarantined, run };
        new.compare_inputs(&inputs, gone)?;
        new.take_over()?;
        new.check_images(options.verify)?;
        if begun {
            new.write_table()?;
        }
        Ok(new)
    }

    /// Compares the input files with those of the last run, and removes the pictures of changed files. Prints
    /// a note on changed files and a note on pictures that belong to no task. Stores the identities of the
    /// files in the journal. `then`: identities of the files in the last run, keyed by [`Job::shown`];
    /// `gone`: ids in the journal that belong to no task of the job.
    fn compare_inputs(
        &mut self,
        then: &BTreeMap<String, Vec<Identity>>,
        mut gone: HashSet<u64>,
    ) -> Result<()> {
        let job = self.job;
        gone.retain(|id| job.output.join(job.image(*id)).exists());
        let volumes = 0..job.volumes.len();
        let now: BTreeMap<String, Vec<Identity>> =
            volumes.clone().map(|i| (job.shown(i), job.volumes[i].files.clone())).collect();
        if *then == now && gone.is_empty() {
            return Ok(());
        }
        let ids_then = job.ids_then(then);
        let (mut files, mut count) = (Vec::new(), 0);
        for i in volumes {
            let shown = job.shown(i);
            let changed = then.get(&shown).and_then(|f| identity::difference(f, &job.volumes[i].files));
            let Some(what) = changed else { continue };
            let stale: Vec<u64> = ids_then(i).into_iter().filter(|id| gone.remove(id)).collect();
            for id in &stale {
                let path = job.output.join(job.image(*id));
                std::fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
            }
            count += stale.len();
            if !stale.is_empty() {
                files.push(format!("{shown} ({what})"));
            }
        }
        if let Some(first) = files.first() {
            let more = match files.len() - 1 {
                0 => String::new(),
                n => format!(" and {n} other files"),
            };
            note(&format!(
                "{first}{more} changed; {count} pictures of the old content are removed and rendered again"
            ));
        }
        if !gone.is_empty() {
            note(&format!(
                "{} pictures in {} belong to no task of the job; they are left out of the table",
                gone.len(),
                job.output.join("image").display()
            ));
        }
        self.journal.add(&Entry::Inputs { files: now });
        self.journal.flush()
    }

    /// Number of the task with this id; `None` if the job has no such task.
    pub(super) fn number(&self, task: &str) -> Option<u32> {
        self.numbers.get(&parse_id(task)?).copied()
    }

    /// The number of this run.
    pub fn run(&self) -> u64 {
        self.run
    }

    /// Adds those answers of the spool to the journal that have no error, whose images are complete, and
    /// whose tasks the journal does not list as finished. Then empties the spool folder and the folders of
    /// orders, of cancellations and of images in progress.
    pub(crate) fn take_over(&mut self) -> Result<()> {
        let state = self.job.state();
        let folder = state.join("spool");
        let files = std::fs::read_dir(&folder)
            .and_then(|files| files.map(|file| Ok(file?.path())).collect::<std::io::Result<Vec<_>>>())
            .with_context(|| format!("cannot read {}", folder.display()))?;
        for file in &files {
            for line in spool::lines(file)? {
                let Line::Answer(answer) = line else { continue };
                let Some(task) = self.number(&answer.task) else { continue };
                if answer.error.is_none() && !self.done.contains_key(&task) && self.is_there(&answer, true) {
                    self.finish(task, answer);
                }
            }
        }
        self.journal.flush()?;
        for file in files {
            let _ = std::fs::remove_file(file);
        }
        for name in ["orders", "cancel", "parts"] {
            let _ = std::fs::remove_dir_all(state.join(name));
            make_folder(&state.join(name))?;
        }
        Ok(())
    }

    pub(super) fn finish(&mut self, task: u32, mut answer: Answer) {
        let predicted_s = if answer.predicted_s > 0.0 { answer.predicted_s } else { answer.seconds };
        self.journal.add(&Entry::Done { answer: answer.clone(), predicted_s });
        self.quarantined.remove(&task);
        answer.predicted_s = predicted_s;
        self.done.insert(task, answer);
    }

    fn is_there(&self, answer: &Answer, whole: bool) -> bool {
        let Some(id) = parse_id(&answer.task) else { return false };
        let path = self.job.output.join(self.job.image(id));
        let length = std::fs::metadata(&path).map(|m| m.len());
        if length.ok() != Some(answer.bytes) {
            return false;
        }
        !whole || std::fs::read(&path).is_ok_and(|bytes| crc32fast::hash(&bytes) == answer.crc32)
    }

    /// Removes tasks with missing or damaged images from the finished tasks, so that they are rendered again.
    /// Compares the sizes of the image files with the journal; if `whole` is true, also their checksums.
    fn check_images(&mut self, whole: bool) -> Result<()> {
        let done = std::mem::take(&mut self.done).into_iter();
        let (there, missing): (_, HashMap<_, _>) = done.partition(|(_, a)| self.is_there(a, whole));
        self.done = there;
        if !missing.is_empty() {
            note(&format!(
                "{} images in the journal are missing or damaged; they are rendered again",
                missing.len()
            ));
        }
        Ok(())
    }

    /// As [`plan_after`], with the tasks that have ended so far.
    pub fn plan(&self, base: Vec<f32>, setting: Setting) -> Planner {
        let done = self.done.iter().map(|(task, answer)| (*task, Some(answer.seconds)));
        let given_up = self.quarantined.keys().map(|task| (*task, None));
        plan_after(self.job, base, setting, done.chain(given_up))
    }

    /// Returns the work order of a task: all data that a worker needs to render it.
    pub fn order(&self, task: u32, predicted_s: f64) -> Order {
        let job = self.job;
        let at = job.place(task as usize);
        let (volume, pose) = (&job.volumes[at.volume], job.cameras[at.camera]);
        let id = job.id(task as usize);
        Order {
            task: format!("{id:016x}"),
            volume: volume.path.clone(),
            volume_name: volume.name.clone(),
            time: volume.time,
            reading: volume.reading.clone(),
            camera: [pose.rx, pose.ry, pose.dz],
            fov_y_deg: job.fov_y_deg,
            transfer_name: job.transfers[at.transfer].name.clone(),
            transfer: job.transfers[at.transfer].transfer.clone(),
            size: job.sizes[at.size],
            step: job.steps[at.step],
            image: job.image(id),
            predicted_s,
            files: volume.files.clone(),
        }
    }

    pub(crate) fn write_table(&self) -> Result<()> {
        cinema::write(self.job, &self.done)
    }
}

/// Returns the tasks that have ended: finished tasks in the job's journal whose pictures exist, with their
/// seconds; given-up tasks, with `None`.
///
/// # Errors
/// When the journal cannot be read.
pub fn ended(job: &Job) -> Result<BTreeMap<u32, Option<f64>>> {
    let mut out = BTreeMap::new();
    let numbers = job.numbers();
    for entry in super::journal::entries(&job.state())? {
        let (task, seconds) = match entry {
            Entry::Done { answer, .. } => (answer.task, Some(answer.seconds)),
            Entry::Quarantined { task, .. } => (task, None),
            _ => continue,
        };
        let Some((&id, &task)) = parse_id(&task).and_then(|id| numbers.get_key_value(&id)) else { continue };
        if seconds.is_none() || job.output.join(job.image(id)).exists() {
            out.insert(task, seconds);
        } else {
            out.remove(&task);
        }
    }
    Ok(out)
}

/// Returns a plan of a job in which no task is queued yet. Expected times are corrected by the times of
/// finished tasks. `base`: ln of the base seconds of every task; `ended`: as [`ended`] returns it.
pub fn plan_after(
    job: &Job,
    base: Vec<f32>,
    setting: Setting,
    ended: impl IntoIterator<Item = (u32, Option<f64>)>,
) -> Planner {
    let mut planner = planner(job, base, setting);
    for (task, seconds) in ended {
        match seconds {
            Some(seconds) => planner.done_before(task, 0, seconds),
            None => planner.quarantine(None, task),
        }
    }
    planner.refresh();
    planner
}

/// Returns a planner of a job, with an empty queue. `base`: for every task, ln of the seconds that are
/// expected before any task is measured.
pub fn planner(job: &Job, base: Vec<f32>, setting: Setting) -> Planner {
    let bytes = job.volumes.iter().map(|v| v.bytes as f64).collect();
    let has_model = job.predict.model.is_some() || job.predict.list.is_some();
    let shape = Shape::of_job(job, base);
    let shape = if has_model { shape.with_constant(CONSTANT_SD_WITH_MODEL) } else { shape };
    // A program that is started for each image cannot report loading times separately.
    let tells_loads = !matches!(job.renderer, super::job::Renderer::Command { .. });
    Planner::new(shape, Loads::new(bytes, tells_loads), setting)
}
