//! Waits for child processes of a study. A process whose time is over is asked to end, and killed if it does
//! not end.

use anyhow::{Context, Result};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use std::process::{Child, ExitStatus};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// Interval between checks of a running process.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);

/// Waits until a process ends; returns its exit status, and true if the process was asked to end. Once `over`
/// returns true (a deadline has passed, or the user asked to stop), `signal` asks the process to end; if it
/// still runs after `grace`, it is killed.
pub(crate) fn wait(
    child: &mut Child,
    over: impl Fn() -> bool,
    signal: Signal,
    grace: Duration,
) -> Result<(ExitStatus, bool)> {
    let mut asked: Option<Instant> = None;
    loop {
        if let Some(status) = child.try_wait().context("cannot wait for a command")? {
            return Ok((status, asked.is_some()));
        }
        match asked {
            None if over() => {
                // Until the exit status is read, no other process can get this id. An error is ignored, since
                // a process that does not end is killed below.
                let _ = kill(Pid::from_raw(child.id().cast_signed()), signal);
                asked = Some(Instant::now());
            }
            Some(at) if at.elapsed() >= grace => {
                child.kill().context("cannot kill a command that does not end")?;
                let status = child.wait().context("cannot wait for a command")?;
                return Ok((status, true));
            }
            _ => {}
        }
        sleep(CHECK_INTERVAL);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::process::ExitStatusExt;
    use std::process::Command;

    /// Starts a shell that runs `on_term` at SIGTERM and then continues. [`wait`] asks the shell to end once
    /// the shell's trap is set. Returns the result of [`wait`] and its duration.
    fn told_to_end(on_term: &str, grace: Duration) -> ((ExitStatus, bool), Duration) {
        let dir = tempfile::tempdir().unwrap();
        let ready = dir.path().join("ready");
        let script = format!("trap '{on_term}' TERM; : >'{}'; while :; do sleep 0.05; done", ready.display());
        let mut child = Command::new("/bin/sh").args(["-c", &script]).spawn().unwrap();
        let begin = Instant::now();
        let ended = wait(&mut child, || ready.exists(), Signal::SIGTERM, grace).unwrap();
        (ended, begin.elapsed())
    }

    #[test]
    fn a_process_ends_by_itself_when_it_is_asked_or_when_it_is_killed() {
        let mut child = Command::new("/bin/sh").args(["-c", "exit 3"]).spawn().unwrap();
        let (status, asked) = wait(&mut child, || false, Signal::SIGTERM, Duration::ZERO).unwrap();
        assert_eq!((status.code(), asked), (Some(3), false));
        let ((status, asked), _) = told_to_end("exit 7", Duration::from_secs(60));
        assert_eq!((status.code(), asked), (Some(7), true));
        let grace = Duration::from_millis(300);
        let ((status, asked), took) = told_to_end("", grace);
        assert_eq!((status.signal(), asked), (Some(9), true));
        assert!(took >= grace, "{took:?}");
    }
}
