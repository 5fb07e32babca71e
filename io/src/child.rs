//! Other programs that a command waits for.

use std::io::Result;
use std::process::{Child, ExitStatus};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// Interval between checks of a running process.
const CHECK_INTERVAL: Duration = Duration::from_millis(5);

/// Waits for a process and returns its exit status. After the time `limit`, kills the process and returns
/// `None`.
///
/// # Errors
/// When the system refuses to wait for the process.
pub fn wait_at_most(child: &mut Child, limit: Duration) -> Result<Option<ExitStatus>> {
    let clock = Instant::now();
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        if clock.elapsed() > limit {
            let _ = child.kill();
            let _ = child.wait();
            return Ok(None);
        }
        sleep(CHECK_INTERVAL);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::Command;

    #[test]
    fn a_process_ends_by_itself_or_is_killed() {
        let shell = |script: &str| Command::new("sh").args(["-c", script]).spawn().unwrap();
        let ended = wait_at_most(&mut shell("exit 3"), Duration::from_secs(60)).unwrap();
        assert_eq!(ended.unwrap().code(), Some(3));
        let mut asleep = shell("exec sleep 1000");
        assert!(wait_at_most(&mut asleep, Duration::ZERO).unwrap().is_none());
        assert!(!asleep.wait().unwrap().success());
    }
}
