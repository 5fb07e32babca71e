//! A persistent renderer: it reads a task per line of its standard input and answers each with a line of its
//! standard output. Other output goes to the task's log.

use super::command::{Guard, kill, leader};
use super::record::Order;
use super::spool::tail;
use anyhow::{Context, Result, bail, ensure};
use serde::Deserialize;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

/// Time limit for each further line of a program that has closed its input.
const LAST_LINES: Duration = Duration::from_secs(1);

/// Answer of a renderer to a task.
#[derive(Clone, Debug, Default, Deserialize)]
pub(super) struct Reply {
    pub(super) task: String,
    /// Seconds of the frame, if the renderer measures them.
    pub(super) seconds: Option<f64>,
    /// Seconds to load the volume, if it was loaded for this task.
    pub(super) load_s: Option<f64>,
    pub(super) error: Option<String>,
    /// Seconds of an earlier attempt at the task, which failed; 0 without such an attempt.
    #[serde(skip)]
    pub(super) lost_s: f64,
}

/// A persistent renderer, started for the first task and again after a failure.
pub(super) struct Session {
    command: Vec<String>,
    limit: Option<Duration>,
    running: Option<Running>,
    /// True if the program was started for the last task.
    fresh: bool,
    /// True if the program ended during the last task.
    ended: bool,
}

struct Running {
    child: Child,
    input: ChildStdin,
    lines: mpsc::Receiver<String>,
    _guard: Option<Guard>,
}

impl Drop for Running {
    fn drop(&mut self) {
        kill(&mut self.child);
    }
}

impl Session {
    /// A renderer that is not started yet. `command`: program and arguments; `limit`: time for a task.
    pub(super) fn new(command: Vec<String>, limit: Option<Duration>) -> Self {
        Self { command, limit, running: None, fresh: false, ended: false }
    }

    fn start(&self) -> Result<Running> {
        let (program, arguments) = self.command.split_first().context("the command is empty")?;
        let mut child = leader(program)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {program:?}; check the renderer's command"))?;
        let guard = Guard::of(&child);
        let (send, lines) = mpsc::channel();
        forward(child.stderr.take().context("no standard error")?, send.clone());
        forward(child.stdout.take().context("no standard output")?, send);
        let input = child.stdin.take().context("no standard input")?;
        Ok(Running { child, input, lines, _guard: guard })
    }

    /// Renders a task to `out`. If the program was started for this task and reports the seconds of the
    /// frame, its start counts as loading. If a program that has answered other tasks ends during this task,
    /// it may have run out of memory: a new process gets the task once more.
    ///
    /// # Errors
    /// When the program cannot be started, ends, answers with an error or with times that the task cannot
    /// have, or does not answer in time.
    pub(super) fn ask(&mut self, order: &Order, out: &Path, log: &Path) -> Result<Reply> {
        let mut clock = Instant::now();
        let mut result = self.try_ask(order, out, log);
        if result.is_err() && self.ended && !self.fresh {
            self.running = None;
            let lost_s = clock.elapsed().as_secs_f64();
            clock = Instant::now();
            result = self.try_ask(order, out, log).map(|reply| Reply { lost_s, ..reply });
        }
        if let (true, Ok(Reply { seconds: Some(seconds), load_s, .. })) = (self.fresh, &mut result) {
            *load_s = Some((clock.elapsed().as_secs_f64() - *seconds).max(load_s.unwrap_or(0.0)));
        }
        if result.is_err() {
            // The program's state is unknown, so the next task gets a new process.
            self.running = None;
        }
        let reply = result?;
        match &reply.error {
            Some(error) => bail!("the renderer reported an error: {error}"),
            None => Ok(reply),
        }
    }

    fn try_ask(&mut self, order: &Order, out: &Path, log: &Path) -> Result<Reply> {
        self.ended = false;
        if self.running.as_mut().is_some_and(|r| !matches!(r.child.try_wait(), Ok(None))) {
            self.running = None;
        }
        self.fresh = self.running.is_none();
        let running = match self.running.take() {
            Some(running) => running,
            None => self.start()?,
        };
        let running = self.running.insert(running);
        let mut log_file = File::create(log).with_context(|| format!("cannot write {}", log.display()))?;
        let mut value = serde_json::to_value(order)?;
        if let Some(fields) = value.as_object_mut() {
            fields.remove("files");
        }
        value["out"] = out.to_str().context("the image's path is not UTF-8; set another `output`")?.into();
        let (clock, limit) = (Instant::now(), self.limit);
        let Running { child, input, lines, .. } = running;
        let (written, waits) = mpsc::channel::<()>();
        let sent = std::thread::scope(|scope| {
            // A program that does not read its input blocks the writing of a long line, so it is killed at
            // the limit.
            if let Some(limit) = limit {
                scope.spawn(move || {
                    if waits.recv_timeout(limit) == Err(RecvTimeoutError::Timeout) {
                        kill(child);
                    }
                });
            }
            let sent = writeln!(input, "{value}").and_then(|()| input.flush());
            drop(written);
            sent
        });
        let is_late = || limit.is_some_and(|l| clock.elapsed() >= l);
        loop {
            // The limit holds also for a program that prints without pause.
            ensure!(
                !is_late(),
                "the renderer gave no answer within {} s (timeout_s)",
                limit.unwrap_or_default().as_secs_f64()
            );
            let left = limit.map_or(Duration::from_secs(3600), |l| l.saturating_sub(clock.elapsed()));
            let left = if sent.is_ok() { left } else { left.min(LAST_LINES) };
            let line = match lines.recv_timeout(left) {
                Ok(line) => line,
                Err(RecvTimeoutError::Timeout) if sent.is_ok() || is_late() => continue,
                Err(_) => {
                    self.ended = true;
                    bail!("the renderer {:?} ended: {}", self.command[0], tail(log))
                }
            };
            match serde_json::from_str::<Reply>(&line) {
                Ok(reply) if reply.task == order.task => {
                    let (took, load_s) = (clock.elapsed().as_secs_f64(), reply.load_s.unwrap_or(0.0));
                    ensure!(
                        (0.0..=took).contains(&load_s) && reply.seconds.is_none_or(|s| s >= 0.0),
                        "the renderer answered after {took:.3} s with load_s = {load_s} and seconds = {}; \
                         load_s must lie between 0 and the time of the answer, and seconds must not be \
                         negative",
                        reply.seconds.map_or_else(|| "none".into(), |s| s.to_string())
                    );
                    return Ok(reply);
                }
                _ => writeln!(log_file, "{line}")?,
            }
        }
    }
}

/// Starts a thread that sends the lines of `reader` until the reader ends.
pub(super) fn forward(reader: impl Read + Send + 'static, to: mpsc::Sender<String>) {
    std::thread::spawn(move || {
        for line in BufReader::new(reader).split(b'\n') {
            let Ok(line) = line else { return };
            if to.send(String::from_utf8_lossy(&line).into_owned()).is_err() {
                return;
            }
        }
    });
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use crate::{command::wait_for_end, record::an_order};

    fn shell(script: &str) -> Session {
        Session::new(["sh", "-c", script].map(str::to_owned).to_vec(), None)
    }

    #[test]
    fn a_program_that_reads_no_more_is_heard_to_its_last_line() {
        let dir = tempfile::tempdir().unwrap();
        // The script closes its input before the task, which is longer than a pipe's buffer, is written.
        let mut session = shell("printf 'one\ntwo\n{\"task\": \"7\"}\n'; exec 0<&-");
        let log = dir.path().join("log");
        let reply = session.ask(&an_order(&"v".repeat(1 << 20)), &dir.path().join("i.png"), &log).unwrap();
        assert_eq!(reply.task, "7");
        assert_eq!(std::fs::read_to_string(&log).unwrap(), "one\ntwo\n");
    }

    #[test]
    fn times_that_a_task_cannot_have_are_an_error() {
        let dir = tempfile::tempdir().unwrap();
        for times in ["\"load_s\": 300", "\"load_s\": -5", "\"seconds\": -1"] {
            let mut session = shell(&format!("read -r _; echo '{{\"task\": \"7\", {times}}}'; read -r _"));
            let said = session.ask(&an_order("v"), &dir.path().join("i.png"), &dir.path().join("log"));
            let said = said.unwrap_err().to_string();
            assert!(said.contains("and seconds must not be negative"), "{times}: {said}");
        }
    }

    #[test]
    fn the_time_limit_holds_for_a_program_that_prints_without_pause_or_reads_nothing() {
        let dir = tempfile::tempdir().unwrap();
        // The second task is longer than a pipe's buffer, so writing it waits until the program reads.
        for (script, name) in [("exec yes", "v".to_owned()), ("exec sleep 1000", "v".repeat(1 << 20))] {
            let mut session = Session { limit: Some(Duration::from_millis(200)), ..shell(script) };
            let said = session.ask(&an_order(&name), &dir.path().join("i.png"), &dir.path().join("log"));
            let said = said.unwrap_err().to_string();
            assert!(said.contains("within 0.2 s (timeout_s)"), "{script}: {said}");
        }
    }

    #[test]
    fn the_children_of_a_program_end_with_its_session() {
        let dir = tempfile::tempdir().unwrap();
        let mut session = shell(r#"sleep 1000 & echo "{\"task\": \"7\", \"error\": \"$!\"}"; wait"#);
        let said = session.ask(&an_order("v"), &dir.path().join("i.png"), &dir.path().join("log"));
        let said = said.unwrap_err().to_string();
        drop(session);
        wait_for_end(said.rsplit(' ').next().unwrap());
    }
}
