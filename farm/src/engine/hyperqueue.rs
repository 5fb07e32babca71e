//! HyperQueue, through its Python package: a small driver script, run with the user's Python.

use super::{Bundle, Engine, Event, Places, Properties};
use crate::command::leader;
use crate::session::forward;
use crate::spool::{Spool, tail};
use anyhow::{Context, Result, bail, ensure};
use entire_io::child::wait_at_most;
use serde::Deserialize;
use serde_json::json;
use std::io::Write;
use std::process::{Child, ChildStdin, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::time::{Duration, Instant};

const SCRIPT: &str = include_str!("hyperqueue.py");
/// Time limit for the start of the server and its workers.
const START: Duration = Duration::from_secs(60);

/// Options of HyperQueue.
#[derive(Clone, Debug)]
pub struct Options {
    /// The Python interpreter in which HyperQueue's package is installed.
    pub python: String,
    /// Number of workers to start, each for one bundle; if a server is given, the assumed number of its
    /// workers.
    pub workers: usize,
    /// The folder of a running server; default: a new one is started.
    pub server_dir: Option<String>,
    /// Number of processors of a bundle, and of a worker that this engine starts.
    pub cpus: u32,
    /// Time limit of a given server's workers, for planning, seconds. Workers that this engine starts have no
    /// limit.
    pub worker_limit: Option<f64>,
}

/// The engine.
pub struct HyperQueue {
    places: Places,
    run: u64,
    options: Options,
    child: Child,
    input: Option<ChildStdin>,
    lines: Receiver<String>,
    /// Answers of the bundles that were sent and have not ended.
    spool: Spool,
    priority: i32,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Said {
    #[allow(dead_code, reason = "the line carries a number")]
    Ready(usize),
    Missing(String),
    Down(String),
    Over(u64),
    #[serde(untagged)]
    Failed {
        failed: u64,
        why: String,
    },
}

/// The longest time request of a bundle, for workers with a time limit (both in seconds). A bundle that
/// requests the whole limit never starts, since some of this time has passed when the bundle is submitted.
fn longest_bundle(limit: f64) -> f64 {
    0.98 * limit - 1.0
}

impl HyperQueue {
    /// Initial estimate of a bundle's overhead, seconds: start of a process, opening of a device.
    pub const OVERHEAD: f64 = 0.05;

    /// Starts the driver script, which starts a server with workers, or connects to the given server.
    ///
    /// # Errors
    /// When HyperQueue is not installed (the message says how to install it), or does not start.
    pub fn start(places: Places, options: Options, run: u64) -> Result<Self> {
        ensure!(
            options.worker_limit.is_none_or(|limit| longest_bundle(limit) > 0.0),
            "the time limit of a worker is {} s, of which 1 s and 2 % are reserved for the time before its first \
             bundle; give a longer limit with --time-limit",
            options.worker_limit.unwrap_or(0.0)
        );
        let config = json!({
            "workers": options.workers, "server_dir": options.server_dir, "cpus": options.cpus,
        });
        let log = places.state.join("logs").join("hyperqueue.log");
        let file = std::fs::File::create(&log).with_context(|| format!("cannot write {}", log.display()))?;
        let mut child = leader(&options.python)
            .args(["-u", "-c", SCRIPT, &config.to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(file)
            .spawn()
            .with_context(|| {
                let python = &options.python;
                format!("cannot start {python:?}; use --python to name a Python that has HyperQueue")
            })?;
        let input = child.stdin.take();
        let (send, lines) = mpsc::channel();
        forward(child.stdout.take().context("HyperQueue's Python program has no standard output")?, send);
        let spool = Spool::new(&places.state);
        let mut new = Self { places, run, options, child, input, lines, spool, priority: 0 };
        new.wait_until_ready(&log)?;
        Ok(new)
    }

    fn wait_until_ready(&mut self, log: &std::path::Path) -> Result<()> {
        let clock = Instant::now();
        while let Ok(line) = self.lines.recv_timeout(START.saturating_sub(clock.elapsed())) {
            match serde_json::from_str(&line) {
                Ok(Said::Ready(_)) => return Ok(()),
                Ok(Said::Missing(error)) => bail!(
                    "{} has no HyperQueue ({error}); install it (pip install hyperqueue), or use \
                     --python to name a Python that has it",
                    self.options.python
                ),
                Ok(Said::Down(error)) => bail!("HyperQueue did not start: {error}"),
                _ => {}
            }
        }
        bail!("HyperQueue did not start: {}; see {}", tail(log), log.display())
    }
}

impl Engine for HyperQueue {
    fn properties(&self) -> Properties {
        let slots = self.options.workers;
        let limit = self.options.worker_limit.map(longest_bundle);
        Properties { name: "hyperqueue", slots, bound: false, limit, waiting: (slots / 4).max(1) }
    }

    fn submit(&mut self, bundles: &[Bundle]) -> Result<()> {
        let mut all = Vec::new();
        for bundle in bundles {
            let number = bundle.number;
            self.places.write_order(bundle, self.run)?;
            self.priority -= 1;
            // A time request has no effect on workers without a time limit.
            let request = self.properties().limit.map(|limit| bundle.upper_s.min(limit).max(0.0));
            all.push(json!({
                "bundle": number,
                "args": self.places.worker(number)?,
                "priority": self.priority,
                "min_time": request,
                "log": super::log_of(&self.places.state, number),
            }));
            self.spool.follow(number);
        }
        let line = json!({ "submit": all }).to_string() + "\n";
        if let Some(input) = &mut self.input {
            // If the script has ended, the next poll reports it.
            let _ = input.write_all(line.as_bytes()).and_then(|()| input.flush());
        }
        Ok(())
    }

    fn cancel(&mut self) -> Result<()> {
        // The Python package cannot cancel bundles. A worker ends before its next task if it finds a marker
        // file.
        self.spool.bundles().for_each(|b| super::cancel(&self.places.state, b));
        Ok(())
    }

    fn poll(&mut self, wait: Duration) -> Result<Vec<Event>> {
        let mut said = Vec::new();
        let clock = Instant::now();
        let wait = wait.min(Duration::from_millis(30));
        while let Ok(line) = self.lines.recv_timeout(wait.saturating_sub(clock.elapsed())) {
            said.push(line);
        }
        // If the script has ended, `recv_timeout` returns at once, and this call waits instead.
        std::thread::sleep(wait.saturating_sub(clock.elapsed()));
        // The spool is read after the script's events, so that it has all answers of ended bundles.
        let mut out = self.spool.poll()?;
        let log = |bundle: u64| tail(&super::log_of(&self.places.state, bundle));
        for line in said {
            match serde_json::from_str(&line) {
                Ok(Said::Over(bundle)) if self.spool.forget(bundle) => {
                    let why = format!("the worker ended before it finished its bundle: {}", log(bundle));
                    out.push(Event::Lost(bundle, why));
                }
                Ok(Said::Failed { failed, why }) if self.spool.forget(failed) => {
                    out.push(Event::Lost(failed, format!("HyperQueue: {why} ({})", log(failed))));
                }
                Ok(Said::Down(error)) => out.push(Event::Down(format!("HyperQueue: {error}"))),
                _ => {}
            }
        }
        if let Ok(Some(status)) = self.child.try_wait() {
            out.push(Event::Down(format!("HyperQueue's script ended ({status})")));
        }
        Ok(out)
    }
}

impl Drop for HyperQueue {
    fn drop(&mut self) {
        self.input = None;
        let _ = wait_at_most(&mut self.child, Duration::from_secs(3));
    }
}
