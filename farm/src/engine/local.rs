//! Workers that are persistent processes of this machine. They keep their volume, and get bundles through a
//! pipe.

use super::{Bundle, Engine, Event, MAX_FRUITLESS_STARTS, Places, Properties};
use crate::command::leader;
use crate::record::Line;
use anyhow::{Context, Result, ensure};
use entire_io::child::wait_at_most;
use entire_io::machine;
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, Stdio};
use std::sync::mpsc::{self, Receiver, Sender};
use std::time::{Duration, Instant};

/// Slot, number of the slot's process, and a line of this process; `None` at the end of its output.
type Said = (usize, u64, Option<String>);

/// The engine.
pub struct Local {
    places: Places,
    run: u64,
    workers: Vec<Worker>,
    send: Sender<Said>,
    lines: Receiver<Said>,
    stopping: bool,
}

struct Worker {
    child: Child,
    input: Option<ChildStdin>,
    /// Number of this slot's process, to tell its lines from those of the previous process.
    generation: u64,
    bundle: Option<u64>,
    at: Option<String>,
    since: Instant,
    /// Number of times that this slot's process has ended since its last line.
    deaths: usize,
}

impl Local {
    /// Initial estimate of a bundle's overhead on its slot, seconds: a line through a pipe and a flush.
    pub const OVERHEAD: f64 = 0.005;

    /// Starts one worker for each of `slots` slots.
    ///
    /// # Errors
    /// When a process cannot be started.
    pub fn start(places: Places, slots: usize, run: u64) -> Result<Self> {
        let (send, lines) = mpsc::channel();
        let mut new = Self { places, run, workers: Vec::new(), send, lines, stopping: false };
        for slot in 0..slots {
            let worker = new.spawn(slot, slots, 0)?;
            new.workers.push(worker);
        }
        Ok(new)
    }

    fn log(&self, slot: usize) -> std::path::PathBuf {
        self.places.state.join("logs").join(format!("worker-{slot}.log"))
    }

    fn spawn(&self, slot: usize, slots: usize, generation: u64) -> Result<Worker> {
        let log = File::create(self.log(slot))
            .with_context(|| format!("cannot write {}", self.log(slot).display()))?;
        let threads = (machine::cores() / slots).max(1).to_string();
        let (program, arguments) = self.places.program.split_first().context("no program")?;
        let mut command = leader(program);
        command
            .args(arguments)
            .arg("farm-worker")
            .arg(&self.places.state)
            .args(["--node", &format!("local-{slot}")])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(log);
        // The renderers of all workers share the processors.
        for name in ["RAYON_NUM_THREADS", "LP_NUM_THREADS", "OMP_NUM_THREADS"] {
            if std::env::var_os(name).is_none() {
                command.env(name, &threads);
            }
        }
        let mut child =
            command.spawn().with_context(|| format!("cannot start the worker {}", program.display()))?;
        let out = child.stdout.take().context("the worker has no standard output")?;
        let input = child.stdin.take();
        let send = self.send.clone();
        std::thread::spawn(move || {
            for line in BufReader::new(out).lines() {
                let Ok(line) = line else { break };
                if send.send((slot, generation, Some(line))).is_err() {
                    return;
                }
            }
            let _ = send.send((slot, generation, None));
        });
        Ok(Worker { child, input, generation, bundle: None, at: None, since: Instant::now(), deaths: 0 })
    }

    fn handle(&mut self, (slot, generation, line): Said, out: &mut Vec<Event>) -> Result<()> {
        let slots = self.workers.len();
        let worker = &mut self.workers[slot];
        if worker.generation != generation {
            return Ok(());
        }
        match line {
            Some(line) => {
                let Ok(line) = serde_json::from_str::<Line>(&line) else { return Ok(()) };
                let bundle = worker.bundle.unwrap_or(u64::MAX);
                match &line {
                    Line::Begin { begins } => worker.at = Some(begins.clone()),
                    Line::Answer(_) => {}
                    Line::End { .. } => {
                        worker.bundle = None;
                        worker.at = None;
                    }
                }
                worker.since = Instant::now();
                worker.deaths = 0;
                out.push(Event::Line(bundle, line));
            }
            None => {
                worker.input = None;
                let status = worker.child.wait().map_or_else(|e| e.to_string(), |s| s.to_string());
                let (bundle, deaths) = (worker.bundle.take(), worker.deaths + 1);
                if self.stopping {
                    out.extend(bundle.map(|bundle| Event::Lost(bundle, String::new())));
                    return Ok(());
                }
                let said = crate::spool::tail(&self.log(slot));
                ensure!(
                    deaths <= MAX_FRUITLESS_STARTS,
                    "worker {slot} ended {deaths} times in a row without beginning a task; the last time \
                     ({status}): {said}; remove the cause and continue with --resume"
                );
                let why = || format!("worker {slot} ended ({status}): {said}");
                out.extend(bundle.map(|bundle| Event::Lost(bundle, why())));
                self.workers[slot] = Worker { deaths, ..self.spawn(slot, slots, generation + 1)? };
                out.push(Event::Fresh(slot));
            }
        }
        Ok(())
    }
}

impl Engine for Local {
    fn properties(&self) -> Properties {
        Properties { name: "local", slots: self.workers.len(), bound: true, ..Properties::default() }
    }

    fn submit(&mut self, bundles: &[Bundle]) -> Result<()> {
        for bundle in bundles {
            let slot = bundle.slot.context("a bundle without a slot")?;
            let mut line = serde_json::to_vec(&bundle.order(self.run))?;
            line.push(b'\n');
            let worker = &mut self.workers[slot];
            worker.bundle = Some(bundle.number);
            worker.since = Instant::now();
            if let Some(input) = &mut worker.input {
                // If the worker has ended, the reading thread reports that, and the bundle counts as lost.
                let _ = input.write_all(&line).and_then(|()| input.flush());
            }
        }
        Ok(())
    }

    fn cancel(&mut self) -> Result<()> {
        self.stopping = true;
        for worker in &mut self.workers {
            worker.input = None;
        }
        Ok(())
    }

    fn poll(&mut self, wait: Duration) -> Result<Vec<Event>> {
        let mut out = Vec::new();
        let mut next = self.lines.recv_timeout(wait).ok();
        while let Some(said) = next {
            self.handle(said, &mut out)?;
            next = self.lines.try_recv().ok();
        }
        Ok(out)
    }

    fn nodes(&self) -> Vec<String> {
        self.workers
            .iter()
            .map(|w| match (&w.bundle, &w.at) {
                (Some(_), Some(task)) => {
                    format!("{} {:.0}s", &task[..6.min(task.len())], w.since.elapsed().as_secs_f64())
                }
                (Some(_), None) => "starts".into(),
                (None, _) => "free".into(),
            })
            .collect()
    }
}

impl Drop for Local {
    fn drop(&mut self) {
        // Workers end when their input is closed. Workers that have not ended after 2 s are killed.
        for worker in &mut self.workers {
            worker.input = None;
        }
        let clock = Instant::now();
        for worker in &mut self.workers {
            let left = Duration::from_secs(2).saturating_sub(clock.elapsed());
            let _ = wait_at_most(&mut worker.child, left);
        }
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn a_worker_without_a_bundle_that_ends_again_and_again_ends_the_run() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("logs")).unwrap();
        let program = ["sh", "-c", "echo no device >&2; exit 3"].map(std::ffi::OsString::from).to_vec();
        let mut engine = Local::start(Places { state: dir.path().to_owned(), program }, 1, 1).unwrap();
        let ended = (0..600).find_map(|_| engine.poll(Duration::from_millis(100)).err());
        let said =
            ended.expect("the engine reports an error after its worker has ended a few times").to_string();
        for part in ["worker 0 ended 4 times in a row", "exit status: 3", "no device", "--resume"] {
            assert!(said.contains(part), "{said}");
        }
    }
}
