//! Slurm, through its commands: sbatch, squeue, scontrol, scancel, sinfo.

use super::{Bundle, Engine, Event, Places, Properties, utf8};
use crate::command::quoted;
use crate::record::Line;
use crate::spool::{Spool, tail};
use anyhow::{Context, Result, bail, ensure};
use entire_io::files::note;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::io::Write;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Interval between queries of the queue; the spool is read at every poll.
const QUEUE_QUERY_INTERVAL: Duration = Duration::from_secs(2);
/// Longest time without an answer of squeue: the controller may be restarted, and jobs run on meanwhile.
const MAX_SILENCE: Duration = Duration::from_secs(600);
/// Seconds that are added to each time request for start and end of the worker.
const WORKER_START_S: f64 = 15.0;

/// Options of Slurm.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Number of bundles that run at once; default: the number of nodes that sinfo lists.
    pub nodes: Option<usize>,
    /// Additional options of sbatch.
    pub sbatch: Vec<String>,
    /// Longest time request, seconds; default: the time limit of the partition that jobs go to.
    pub limit: Option<f64>,
}

/// The engine.
pub struct Slurm {
    places: Places,
    run: u64,
    options: Options,
    name: String,
    slots: usize,
    limit: Option<f64>,
    spool: Spool,
    /// Job of each bundle that was sent and has not ended.
    open: BTreeMap<u64, Job>,
    /// Bundles for which sbatch made no job since the last query, each with the reason, which is empty if
    /// sbatch was not called.
    refused: Vec<(u64, String)>,
    looked: Option<Instant>,
    /// Time of the first query without an answer since the last answer.
    silent: Option<Instant>,
}

#[derive(Clone, Debug, Default)]
struct Job {
    id: u64,
    state: String,
    nodes: String,
    /// Number of consecutive queries in which the job was neither queued nor running.
    gone: u32,
}

#[derive(Deserialize)]
struct Queue {
    jobs: Vec<Queued>,
}

#[derive(Deserialize)]
struct Queued {
    job_id: u64,
    #[serde(default)]
    job_state: serde_json::Value,
    #[serde(default)]
    nodes: serde_json::Value,
    #[serde(default)]
    name: String,
}

fn ask(program: &str, arguments: &[impl AsRef<OsStr>], input: Option<&str>) -> Result<String> {
    let mut child = Command::new(program)
        .args(arguments)
        .stdin(if input.is_some() { Stdio::piped() } else { Stdio::null() })
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .with_context(|| {
            format!(
                "cannot start {program}; install Slurm's commands (Debian: slurm-client) and set SLURM_CONF"
            )
        })?;
    if let (Some(text), Some(mut pipe)) = (input, child.stdin.take()) {
        // If the program has ended before it read everything, its status and its own message say why.
        let _ = pipe.write_all(text.as_bytes());
    }
    let output = child.wait_with_output()?;
    let error = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{program} ended with {}: {}", output.status, error.trim());
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Returns the seconds of a limit that sinfo prints as `days-hours:minutes:seconds`, perhaps without the
/// first parts; `None` for no limit.
fn parse_limit(text: &str) -> Option<f64> {
    let (days, rest) = text.split_once('-').map_or((0.0, text), |(d, r)| (d.parse().unwrap_or(0.0), r));
    let parts: Vec<f64> = rest.split(':').map(str::parse).collect::<std::result::Result<_, _>>().ok()?;
    let seconds = parts.iter().fold(0.0, |sum, p| 60.0 * sum + p);
    Some(86400.0 * days + seconds)
}

/// Names of the partitions that jobs go to, separated by commas: those in the options of sbatch, else those
/// in its environment variable; `None` for the default partition.
fn partitions(options: &[String], environment: Option<String>) -> Option<String> {
    let mut named = environment.filter(|names| !names.is_empty());
    let mut words = options.iter();
    while let Some(word) = words.next() {
        let names = match word.as_str() {
            "-p" | "--partition" => words.next().map(String::as_str),
            word => word.strip_prefix("--partition=").or(word.strip_prefix("-p")),
        };
        named = names.map(str::to_owned).or(named);
    }
    named
}

/// The longest limit of the partitions that jobs go to, seconds; `None` for no limit. `named`: names of these
/// partitions, separated by commas; `None` for the default one. If none of them is listed, all listed limits
/// count. `listed`: lines of sinfo, `PARTITION LIMIT`; an asterisk marks the default partition.
fn longest_request(listed: &str, named: Option<&str>) -> Option<f64> {
    let takes_jobs = |partition: &str| match named {
        Some(names) => names.split(',').any(|name| name == partition.trim_end_matches('*')),
        None => partition.ends_with('*'),
    };
    let lines = listed.lines().filter_map(|line| line.trim().split_once(' '));
    let (used, others): (Vec<_>, Vec<_>) = lines.partition(|(partition, _)| takes_jobs(partition));
    let partitions = if used.is_empty() { others } else { used };
    let limits: Option<Vec<f64>> = partitions.iter().map(|(_, limit)| parse_limit(limit.trim())).collect();
    limits.map(|l| l.into_iter().fold(0.0, f64::max)).filter(|l| *l > 0.0)
}

/// Returns the longest time of a bundle without [`WORKER_START_S`], seconds. `limit`: longest time request,
/// seconds; rounded down, since requests are whole minutes.
fn longest_bundle(limit: f64) -> f64 {
    60.0 * (limit / 60.0).floor() - WORKER_START_S
}

/// Returns a time request in sbatch's format: `seconds` and [`WORKER_START_S`], rounded up to whole minutes.
fn request(seconds: f64) -> String {
    (((seconds + WORKER_START_S) / 60.0).ceil().max(1.0) as u64).to_string()
}

impl Slurm {
    /// Initial estimate of a bundle's overhead on its node, seconds.
    pub const OVERHEAD: f64 = 0.6;

    /// Checks that Slurm answers, and cancels the waiting and running jobs of an earlier run.
    ///
    /// # Errors
    /// When Slurm does not answer (the message names the packages to install or the daemon to start), lists
    /// no node, or has a time limit below a minute.
    pub fn start(places: Places, options: Options, run: u64) -> Result<Self> {
        let hint = "Slurm does not answer; check that slurmctld is running and that SLURM_CONF is the path of its \
                    configuration file";
        let listed = ask("sinfo", &["-h", "-N", "-o", "%N"], None).context(hint)?;
        let mut names: Vec<&str> = listed.lines().map(str::trim).filter(|n| !n.is_empty()).collect();
        names.sort_unstable();
        names.dedup();
        let slots = options.nodes.unwrap_or(names.len());
        ensure!(slots > 0, "sinfo lists no node; use --slots to give the number of bundles that run at once");
        let listed = ask("sinfo", &["-h", "-o", "%P %l"], None)?;
        let named = partitions(&options.sbatch, std::env::var("SBATCH_PARTITION").ok());
        let limit = options.limit.or(longest_request(&listed, named.as_deref()));
        ensure!(
            limit.is_none_or(|l| longest_bundle(l) > 0.0),
            "the time limit of a bundle is {} s; Slurm counts whole minutes, so give at least 60 s with \
             --time-limit",
            limit.unwrap_or_default()
        );
        let limit = limit.map(longest_bundle);
        let new = Self::new(places, run, options, slots, limit)?;
        new.clear_queue()?;
        Ok(new)
    }

    fn new(places: Places, run: u64, options: Options, slots: usize, limit: Option<f64>) -> Result<Self> {
        let state = utf8(places.state.as_os_str())?;
        let name = format!("entire-{:016x}", entire_io::files::fnv1a(state.as_bytes()));
        let (spool, open, refused) = (Spool::new(&places.state), BTreeMap::new(), Vec::new());
        let (looked, silent) = (None, None);
        Ok(Self { places, run, options, name, slots, limit, spool, open, refused, looked, silent })
    }

    /// True if a bundle that sbatch refuses counts as failed: the controller answers, and no job of this run
    /// is queued or running. Else the controller is silent, or a limit on the number of jobs is the likely
    /// reason.
    fn refusals_count(&self) -> bool {
        self.silent.is_none() && self.open.is_empty()
    }

    /// Cancels jobs of this database and waits until they are gone.
    fn clear_queue(&self) -> Result<()> {
        let clock = Instant::now();
        while self.queue()?.iter().any(|j| alive(&state_of(j))) {
            ask("scancel", &[format!("--name={}", self.name)], None)?;
            if clock.elapsed() > Duration::from_secs(60) {
                bail!("jobs {} of an earlier run stay in Slurm's queue; cancel them with scancel", self.name);
            }
            std::thread::sleep(Duration::from_millis(300));
        }
        Ok(())
    }

    fn queue(&self) -> Result<Vec<Queued>> {
        let text = ask("squeue", &["--json".to_owned(), format!("--name={}", self.name)], None)?;
        let queue: Queue = serde_json::from_str(&text).context("squeue --json")?;
        Ok(queue.jobs.into_iter().filter(|j| j.name == self.name).collect())
    }

    /// Sends a bundle. Returns the number of its job.
    fn sbatch(&self, bundle: &Bundle) -> Result<u64> {
        let log = super::log_of(&self.places.state, bundle.number);
        // Slurm expands % in this name.
        let log = utf8(log.as_os_str())?.replace('%', "%%");
        let worker: Vec<String> = self.places.worker(bundle.number)?.iter().map(|w| quoted(w)).collect();
        let script = format!("#!/bin/sh\nexec {}\n", worker.join(" "));
        let upper = self.limit.map_or(bundle.upper_s, |l| bundle.upper_s.min(l));
        let mut arguments = vec![
            "--parsable".to_owned(),
            format!("--job-name={}", self.name),
            format!("--time={}", request(upper)),
            "--nodes=1".into(),
            "--ntasks=1".into(),
            "--no-requeue".into(),
            format!("--output={log}"),
        ];
        arguments.extend(self.options.sbatch.iter().cloned());
        let said = ask("sbatch", &arguments, Some(&script))?;
        let id = said.trim().split(';').next().and_then(|t| t.parse().ok());
        id.with_context(|| format!("sbatch answered {:?}; the number of a job is expected", said.trim()))
    }

    /// Queries the queue. Returns bundles whose jobs were missing or ended in three queries, with reasons.
    fn look(&mut self) -> Result<Vec<(u64, String)>> {
        let queue: BTreeMap<u64, (String, String)> = self
            .queue()?
            .into_iter()
            .map(|j| (j.job_id, (state_of(&j), j.nodes.as_str().unwrap_or_default().to_owned())))
            .collect();
        let mut lost = Vec::new();
        for (&bundle, job) in &mut self.open {
            match queue.get(&job.id) {
                Some((state, nodes)) if alive(state) => {
                    job.state.clone_from(state);
                    job.nodes.clone_from(nodes);
                    job.gone = 0;
                }
                found => {
                    // The file system may delay the last lines of the job's spool, so the bundle counts as
                    // lost only after three queries.
                    job.gone += 1;
                    if job.gone >= 3 {
                        let state = found.map_or("GONE", |f| f.0.as_str());
                        lost.push((bundle, format!("Slurm's job {} ended ({state})", job.id)));
                    }
                }
            }
        }
        Ok(lost)
    }
}

/// The state of a job: newer versions of Slurm give a list of states, older ones a single state.
fn state_of(job: &Queued) -> String {
    match &job.job_state {
        serde_json::Value::Array(all) => all.first().and_then(|s| s.as_str()).unwrap_or_default().to_owned(),
        other => other.as_str().unwrap_or_default().to_owned(),
    }
}

fn alive(state: &str) -> bool {
    ["PENDING", "RUNNING", "CONFIGURING", "SUSPENDED", "REQUEUED", "STAGE_OUT", "COMPLETING"].contains(&state)
}

impl Engine for Slurm {
    fn properties(&self) -> Properties {
        let (slots, limit) = (self.slots, self.limit);
        Properties { name: "slurm", slots, bound: false, limit, waiting: slots }
    }

    fn submit(&mut self, bundles: &[Bundle]) -> Result<()> {
        for bundle in bundles {
            let number = bundle.number;
            // After a refusal by sbatch, further bundles are not submitted. With the refused bundle, they
            // count as lost at the next query.
            if !self.refused.is_empty() {
                self.refused.push((number, String::new()));
                continue;
            }
            self.places.write_order(bundle, self.run)?;
            match self.sbatch(bundle) {
                Ok(id) => {
                    self.spool.follow(number);
                    self.open.insert(number, Job { id, state: "PENDING".to_owned(), ..Job::default() });
                }
                Err(error) => self.refused.push((number, format!("{error:#}"))),
            }
        }
        Ok(())
    }

    fn reprioritize(&mut self, bundles: &[u64]) -> Result<()> {
        // Users may only lower the priority of their jobs, by a larger nice value.
        for (place, bundle) in bundles.iter().enumerate() {
            if let Some(job) = self.open.get(bundle).filter(|j| j.state == "PENDING") {
                // The command fails if the job has started. The job then needs no priority.
                let (job, nice) = (format!("JobId={}", job.id), format!("Nice={}", 10 * place));
                let _ = ask("scontrol", &["update", &job, &nice], None);
            }
        }
        Ok(())
    }

    fn cancel(&mut self) -> Result<()> {
        self.open.keys().for_each(|b| super::cancel(&self.places.state, *b));
        let waiting = [format!("--name={}", self.name), "--state=PENDING".into()];
        if let Err(error) = ask("scancel", &waiting, None) {
            note(&format!("waiting jobs could not be canceled; each ends when it starts: {error:#}"));
        }
        Ok(())
    }

    fn poll(&mut self, wait: Duration) -> Result<Vec<Event>> {
        std::thread::sleep(wait.min(Duration::from_millis(50)));
        let (mut lost, mut refused) = (Vec::new(), Vec::new());
        let waits = !self.open.is_empty() || !self.refused.is_empty();
        if waits && self.looked.is_none_or(|t| t.elapsed() >= QUEUE_QUERY_INTERVAL) {
            match self.look() {
                Ok(found) => (lost, self.silent) = (found, None),
                Err(e) if self.silent.get_or_insert_with(Instant::now).elapsed() > MAX_SILENCE => {
                    return Err(e);
                }
                Err(_) => {}
            }
            self.looked = Some(Instant::now());
            refused = std::mem::take(&mut self.refused);
            if !self.refusals_count() {
                refused.iter_mut().for_each(|(_, why)| why.clear());
            }
        }
        // The spool is read after the queue, so that it has all answers of the jobs that have ended.
        let mut out = self.spool.poll()?;
        for event in &out {
            if let Event::Line(bundle, Line::End { .. }) = event {
                self.open.remove(bundle);
            }
        }
        for (bundle, why) in lost {
            if self.open.remove(&bundle).is_some() {
                self.spool.forget(bundle);
                let why = format!("{why}: {}", tail(&super::log_of(&self.places.state, bundle)));
                out.push(Event::Lost(bundle, why));
            }
        }
        out.extend(refused.into_iter().map(|(bundle, why)| Event::Lost(bundle, why)));
        Ok(out)
    }

    fn nodes(&self) -> Vec<String> {
        self.open
            .values()
            .filter(|j| j.state == "RUNNING")
            .map(|j| format!("{} job {}", j.nodes, j.id))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_and_requests_are_read_and_written_as_slurm_does() {
        assert_eq!(parse_limit("30:00"), Some(1800.0));
        assert_eq!(parse_limit("1-02:00:00"), Some(93600.0));
        assert_eq!(parse_limit("infinite"), None);
        assert_eq!(request(1.0), "1");
        assert_eq!(request(45.0), "1");
        assert_eq!(request(46.0), "2");
        assert_eq!(request(3600.0), "61");
        // No request exceeds the limit.
        assert_eq!([60.0, 90.0, 3600.0].map(|limit| request(longest_bundle(limit))), ["1", "1", "60"]);
        assert!(longest_bundle(59.0) < 0.0);
    }

    #[test]
    fn the_limit_is_that_of_the_partition_that_jobs_go_to() {
        let listed = "debug* 30:00\nlong 7-00:00:00\nshort 10:00\nopen infinite\n";
        let limit = |options: &[&str], environment: Option<&str>| {
            let options: Vec<String> = options.iter().map(ToString::to_string).collect();
            let named = partitions(&options, environment.map(str::to_owned));
            longest_request(listed, named.as_deref())
        };
        assert_eq!(limit(&[], None), Some(1800.0));
        assert_eq!(limit(&["--qos=x", "--partition=long"], Some("short")), Some(604_800.0));
        assert_eq!(limit(&["-p", "short"], None), Some(600.0));
        assert_eq!(limit(&["-pshort,debug"], None), Some(1800.0));
        assert_eq!(limit(&["--partition", "open"], None), None);
        assert_eq!(limit(&[], Some("short")), Some(600.0));
        assert_eq!(longest_request("a 10:00\nb 20:00\n", None), Some(1200.0));
        assert_eq!(longest_request("", None), None);
    }

    #[test]
    fn a_bundle_that_sbatch_refuses_is_lost_and_the_run_goes_on() {
        let dir = tempfile::tempdir().unwrap();
        for folder in ["orders", "spool"] {
            std::fs::create_dir(dir.path().join(folder)).unwrap();
        }
        let places = Places { state: dir.path().to_owned(), program: vec!["entire".into()] };
        let options = Options { sbatch: vec!["--no-such-option".into()], ..Options::default() };
        let mut engine = Slurm::new(places, 1, options, 2, None).unwrap();
        let bundle = |number| Bundle { number, slot: None, orders: Vec::new(), upper_s: 1.0 };
        engine.submit(&[bundle(1), bundle(2)]).unwrap();
        let spool = crate::spool::path(dir.path(), 1);
        assert!(spool.exists() && crate::spool::lines(&spool).unwrap().is_empty());
        let lost = engine.poll(Duration::ZERO).unwrap();
        assert!(matches!(lost[..], [Event::Lost(1, _), Event::Lost(2, _)]), "{lost:?}");
        // Until the next query, no further bundle is lost, so a short failure does not end the run.
        engine.submit(&[bundle(3)]).unwrap();
        assert!(engine.poll(Duration::ZERO).unwrap().is_empty());
    }

    #[test]
    fn a_failure_of_scancel_is_no_error() {
        // Without Slurm's commands, scancel cannot be started.
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("cancel")).unwrap();
        let places = Places { state: dir.path().to_owned(), program: vec!["entire".into()] };
        let mut engine = Slurm::new(places, 1, Options::default(), 2, None).unwrap();
        engine.open.insert(3, Job { id: 7, state: "RUNNING".to_owned(), ..Job::default() });
        engine.cancel().unwrap();
        assert!(dir.path().join("cancel/3").exists() && engine.open.contains_key(&3));
    }

    #[test]
    fn refusals_count_only_if_the_controller_answers_and_no_job_is_left() {
        let places = Places { state: "state".into(), program: vec!["entire".into()] };
        let mut engine = Slurm::new(places, 1, Options::default(), 2, None).unwrap();
        assert!(engine.refusals_count());
        engine.silent = Some(Instant::now());
        assert!(!engine.refusals_count());
        engine.silent = None;
        engine.open.insert(1, Job { id: 7, state: "RUNNING".to_owned(), ..Job::default() });
        assert!(!engine.refusals_count());
    }
}
