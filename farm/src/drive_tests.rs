use super::*;
use crate::engine::{Places, Properties};
use crate::predict;
use std::path::PathBuf;

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Draws,
    /// Every task fails, and the engine then ends.
    Ends,
    /// Every task fails because the disk is full, and then no bundle can be sent.
    Full,
    /// No bundle can be written, because the disk is full.
    Refuses,
}

/// An engine of one slot that answers each bundle at once.
struct Fake {
    state: PathBuf,
    kind: Kind,
    events: Vec<Event>,
    /// Bundle and task of the answers so far.
    answered: Vec<(u64, String)>,
}

impl Fake {
    fn new(state: PathBuf, kind: Kind) -> Self {
        Self { state, kind, events: Vec::new(), answered: Vec::new() }
    }

    /// Checks that all answers so far survive the end of the driver, in the spool or in the journal.
    fn check_answers(&self) {
        let journal = std::fs::read_to_string(self.state.join("journal.jsonl")).unwrap();
        for (bundle, task) in &self.answered {
            assert!(spool::path(&self.state, *bundle).exists() || journal.contains(task), "{task}");
        }
    }
}

impl Engine for Fake {
    fn properties(&self) -> Properties {
        Properties { name: "fake", slots: 1, ..Properties::default() }
    }

    fn submit(&mut self, bundles: &[Bundle]) -> Result<()> {
        self.check_answers();
        anyhow::ensure!(self.kind != Kind::Full || self.answered.is_empty(), "a bundle for a full disk");
        if self.kind == Kind::Refuses {
            return Err(std::io::Error::from(std::io::ErrorKind::StorageFull).into());
        }
        for bundle in bundles {
            let (number, mut lines) = (bundle.number, String::new());
            for order in &bundle.orders {
                let error = (self.kind != Kind::Draws).then(|| "no picture".to_owned());
                let disk_full = self.kind == Kind::Full;
                let task = order.task.clone();
                self.answered.push((number, task.clone()));
                let line = Line::Answer(Answer { task, seconds: 1.0, error, disk_full, ..Answer::default() });
                lines += &(serde_json::to_string(&line)? + "\n");
                self.events.push(Event::Line(number, line));
            }
            std::fs::write(spool::path(&self.state, number), lines)?;
            if self.kind == Kind::Ends {
                self.events.push(Event::Down("the queue is gone".into()));
                self.events.push(Event::Down("the script ended".into()));
            } else {
                self.events.push(Event::Line(number, Line::End { end: number }));
            }
        }
        Ok(())
    }

    fn cancel(&mut self) -> Result<()> {
        Ok(())
    }

    fn poll(&mut self, _: Duration) -> Result<Vec<Event>> {
        Ok(std::mem::take(&mut self.events))
    }
}

/// A folder with a job of two tasks. A task is given up after `attempts` failures.
fn setting(attempts: u32) -> (tempfile::TempDir, Job) {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("v.raw"), [0u8; 8]).unwrap();
    let text = format!(
        "name = \"t\"\nsizes = [\"16x16\"]\n[[volumes]]\nfiles = [\"v.raw\"]\n\
         [[cameras]]\nkind = \"orbit\"\nviews = 2\ndistances_radii = [2.0]\n\
         [[transfer]]\nname = \"a\"\nlobes = [[0.5, 0.1, 0.2]]\n\
         [renderer]\nkind = \"command\"\ncommand = [\"draw\", \"{{out}}\"]\n[retry]\nattempts = {attempts}\n"
    );
    std::fs::write(dir.path().join("job.toml"), text).unwrap();
    let job = Job::open(&dir.path().join("job.toml")).unwrap();
    (dir, job)
}

/// Runs a job on engines of which the first `ending` ones end.
fn run_on(database: &mut Database<'_>, ending: usize) -> Result<Summary> {
    run_as(database, |started| if started <= ending { Kind::Ends } else { Kind::Draws })
}

/// Runs a job on engines; `kind` returns the behavior of the first, second, … one.
fn run_as(database: &mut Database<'_>, kind: impl Fn(usize) -> Kind) -> Result<Summary> {
    let (job, mut started) = (database.job, 0);
    run(database, predict::base(job)?, &Options { overhead: 0.01, ..Options::default() }, &mut |_| {
        started += 1;
        Ok(Box::new(Fake::new(job.state(), kind(started))))
    })
}

#[test]
fn answers_stay_in_the_spool_until_the_journal_has_them() {
    let (_dir, job) = setting(1);
    // `Fake` checks the first bundle's answers when it gets the second bundle.
    let summary = run_on(&mut Database::open(&job, &Options::default()).unwrap(), 0).unwrap();
    assert_eq!((summary.done, std::fs::read_dir(job.state().join("spool")).unwrap().count()), (2, 0));
}

#[test]
fn a_failure_before_the_end_of_an_engine_counts_once() {
    let (_dir, job) = setting(2);
    let summary = run_on(&mut Database::open(&job, &Options::default()).unwrap(), 1).unwrap();
    assert_eq!((summary.done, summary.quarantined.len()), (2, 0));
}

#[test]
fn an_engine_that_ends_again_and_again_ends_the_run_with_its_first_reason() {
    let (_dir, job) = setting(9);
    let said = run_on(&mut Database::open(&job, &Options::default()).unwrap(), usize::MAX).unwrap_err();
    assert!(said.to_string().contains("the queue is gone; 3 restarts failed"), "{said}");
}

#[test]
fn a_template_has_the_characters_of_a_long_name_that_openjd_accepts() {
    let (dir, mut job) = setting(1);
    job.name = "n".repeat(200);
    Database::open(&job, &Options::default()).unwrap();
    let places = Places { state: job.state(), program: vec!["entire".into()] };
    let file = dir.path().join("t.json");
    let bundle = Bundle { number: 1, slot: None, orders: Vec::new(), upper_s: 1.0 };
    crate::openjd::export(&job, &places, &[bundle], 1, &file).unwrap();
    let template: serde_json::Value = serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
    assert_eq!(template["name"], "n".repeat(128));
}

#[test]
fn a_plan_for_another_farm_has_no_task_that_was_given_up() {
    let (_dir, job) = setting(1);
    let mut database = Database::open(&job, &Options::default()).unwrap();
    let summary = run_on(&mut database, 1).unwrap();
    assert_eq!((summary.done, summary.quarantined.len()), (1, 1));
    let order = Order::Longest;
    let setting = Setting { slots: 1, bound: true, overhead: 0.01, limit: None, order, learn: true };
    let plan = database.plan(predict::base(&job).unwrap(), setting);
    assert!((0..2).all(|task| plan.state(task) != State::Idle));
    // A dry run reads the journal. The fake engine writes no picture, so the task that it finished counts as
    // not done.
    let ended = crate::database::ended(&job).unwrap();
    assert_eq!(ended.keys().collect::<Vec<_>>(), database.quarantined.keys().collect::<Vec<_>>());
    let plan = |_: usize| {
        let base = predict::base(&job).unwrap();
        let mut plan = crate::database::plan_after(&job, base, setting, ended.clone());
        queue(&mut plan, &job, false);
        plan
    };
    let said = crate::survey::text(&job, &plan, setting, None, None);
    assert!(said.contains("0 of 1 done, 1 given up"), "{said}");
}

#[test]
fn a_report_counts_no_task_as_given_up_that_the_job_has_no_longer() {
    let (dir, job) = setting(1);
    run_on(&mut Database::open(&job, &Options::default()).unwrap(), 1).unwrap();
    let (page, file) = (dir.path().join("r.html"), dir.path().join("job.toml"));
    let said = || {
        crate::report::write(&Job::open(&file).unwrap(), &page).unwrap();
        std::fs::read_to_string(&page).unwrap()
    };
    assert!(said().contains("1 tasks are quarantined"));
    // With another command, the tasks have other ids.
    let text = std::fs::read_to_string(&file).unwrap().replace("draw", "paint");
    std::fs::write(&file, text).unwrap();
    assert!(said().contains("0 tasks are quarantined"));
}

#[test]
fn the_room_for_a_failed_task_is_that_of_its_image() {
    assert_eq!(probe_bytes(0, [16, 16]), 1 << 18);
    assert_eq!(probe_bytes(3 << 20, [16, 16]), 6 << 20);
    assert_eq!(probe_bytes(0, [2000, 1000]), 8_000_000);
    assert_eq!(probe_bytes(u64::MAX, [u32::MAX, u32::MAX]), u64::MAX);
}

#[test]
fn a_full_disk_ends_the_run_with_its_remedy() {
    for kind in [Kind::Full, Kind::Refuses] {
        let (_dir, job) = setting(1);
        let mut database = Database::open(&job, &Options::default()).unwrap();
        let said = run_as(&mut database, |_| kind).unwrap_err().to_string();
        assert!(said.contains("is full; 0 of 2 images are done; free disk space"), "{said}");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_task_is_not_given_up_if_its_log_does_not_fit_on_the_disk() {
    let (_dir, job) = setting(1);
    let mut database = Database::open(&job, &Options::default()).unwrap();
    for task in 0..job.len() {
        let log = job.state().join("quarantine").join(format!("{:016x}.log", job.id(task)));
        std::os::unix::fs::symlink("/dev/full", log).unwrap();
    }
    let said = run_on(&mut database, 1).unwrap_err().to_string();
    assert!(said.contains("is full; 0 of 2 images are done; free disk space"), "{said}");
    assert!(database.quarantined.is_empty());
}
