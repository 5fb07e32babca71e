//! Command lines with placeholders, and their process groups. Arguments are passed to the program directly,
//! without a shell, so names and paths need no quoting.

use anyhow::{Context, Result, bail};
use std::ffi::OsStr;
use std::process::{Child, Command};

/// Names of all placeholders.
const NAMES: &str = "volume volume_name time rx_deg ry_deg dz_radii fov_y_deg transfer transfer_name width \
                     height step out task";

/// Checks the placeholders of an argument.
///
/// # Errors
/// When a placeholder is unknown, or a brace is neither doubled nor part of a placeholder.
pub(crate) fn check(argument: &str) -> Result<()> {
    fill(argument, |name| NAMES.split(' ').any(|known| known == name).then_some("")).map(|_| ())
}

/// True if a checked argument has this placeholder.
pub(crate) fn has(argument: &str, name: &str) -> bool {
    fill(argument, |found| (found != name).then_some("")).is_err()
}

/// Returns an argument with its placeholders replaced by the texts that `value` returns for their names.
/// Inserted text is not expanded again.
///
/// # Errors
/// When a placeholder has no value, or a brace is neither doubled nor part of a placeholder.
pub(crate) fn fill<'v>(argument: &str, value: impl Fn(&str) -> Option<&'v str>) -> Result<String> {
    let mut out = String::new();
    let mut rest = argument;
    while let Some(at) = rest.find(['{', '}']) {
        out += &rest[..at];
        let (brace, after) = (rest.as_bytes()[at] as char, &rest[at + 1..]);
        if after.starts_with(brace) {
            out.push(brace);
            rest = &after[1..];
            continue;
        }
        let end = after.find(['{', '}']).filter(|&e| brace == '{' && after.as_bytes()[e] == b'}');
        let Some(end) = end else {
            bail!("the argument {argument:?} has a single {brace:?}; write {{{{ or }}}} for a brace itself")
        };
        let name = &after[..end];
        out += value(name).with_context(|| {
            let known = NAMES.replace(' ', "}, {");
            format!("the argument {argument:?} holds {{{name}}}; accepted are {{{known}}}")
        })?;
        rest = &after[end + 1..];
    }
    Ok(out + rest)
}

/// Returns a word quoted for a POSIX shell, for the scripts of batch systems and for commands to paste.
pub fn quoted(word: &str) -> String {
    format!("'{}'", word.replace('\'', "'\\''"))
}

/// Returns a command whose process leads its own process group. [`kill`] ends this group; Ctrl-C does not
/// reach it.
pub(crate) fn leader(program: impl AsRef<OsStr>) -> Command {
    let mut command = Command::new(program);
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    command
}

/// Kills the process of a [`leader`]; on Unix, also the processes that it has started.
pub(crate) fn kill(child: &mut Child) {
    #[cfg(unix)]
    let _ = rustix::process::kill_process_group(
        rustix::process::Pid::from_child(child),
        rustix::process::Signal::KILL,
    );
    let _ = child.kill();
    let _ = child.wait();
}

/// A shell in the process group of a [`leader`]. Its standard input ends when this process ends, even if this
/// process is killed; the shell then kills the group. If the guard is dropped, only the shell ends.
pub(crate) struct Guard(Child);

impl Guard {
    /// Guards the group of `leader`; `None` if no shell can be started, or the system has no process groups.
    #[cfg(unix)]
    pub(crate) fn of(leader: &Child) -> Option<Self> {
        use std::process::Stdio;
        let mut shell = Command::new("sh");
        std::os::unix::process::CommandExt::process_group(&mut shell, i32::try_from(leader.id()).ok()?);
        shell.args(["-c", "read -r _; kill -KILL 0"]).stdin(Stdio::piped());
        shell.stdout(Stdio::null()).stderr(Stdio::null()).spawn().ok().map(Self)
    }

    #[cfg(not(unix))]
    pub(crate) fn of(_: &Child) -> Option<Self> {
        None
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        // The shell is killed while its input is still open, so it kills nothing.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Waits until a process has ended; needs Linux's folder `/proc`.
#[cfg(test)]
#[cfg(unix)]
pub(crate) fn wait_for_end(pid: &str) {
    let ended = (0..1000).any(|_| {
        std::thread::sleep(std::time::Duration::from_millis(10));
        // `Z` is the state of a process that has ended, but whose status its parent has not read.
        !std::fs::read_to_string(format!("/proc/{}/stat", pid.trim())).is_ok_and(|text| !text.contains(") Z"))
    });
    assert!(ended, "process {pid} still runs");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn placeholders_are_filled_once_and_mistakes_are_named() {
        let value = |name: &str| Some(if name == "out" { "a {task} b.png" } else { "7" });
        assert_eq!(fill("--out={out}", value).unwrap(), "--out=a {task} b.png");
        assert_eq!(fill("{{{task}}}", value).unwrap(), "{7}");
        assert_eq!(fill("plain", value).unwrap(), "plain");
        assert_eq!(["a{out}", "{{out}}", "{task}"].map(|text| has(text, "out")), [true, false, false]);
        for (text, word) in [("{oot}", "{oot}"), ("{out", "single"), ("a}b", "single"), ("{a{b}", "single")] {
            let said = format!("{:#}", check(text).unwrap_err());
            assert!(said.contains(word), "{text}: {said}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_group_ends_with_the_process_that_guards_it() {
        use std::io::{BufRead, BufReader};
        let mut program = leader("sh");
        program.args(["-c", "sleep 1000 & echo $!; wait"]).stdout(std::process::Stdio::piped());
        let mut child = program.spawn().unwrap();
        let mut pid = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut pid).unwrap();
        drop(Guard::of(&child).unwrap());
        assert!(child.try_wait().unwrap().is_none());
        let mut guard = Guard::of(&child).unwrap();
        // When a process ends, the system closes this pipe.
        drop(guard.0.stdin.take());
        wait_for_end(&pid);
        assert!(!child.wait().unwrap().success());
    }

    #[cfg(unix)]
    #[test]
    fn a_shell_reads_quoted_words_back() {
        for word in ["plain", "a b", "it's", "$(rm -rf x)", "`x`", "a\nb", "\\", "'", "", "*", "!x; y & z"] {
            let script = format!("printf %s {}", quoted(word));
            let out = Command::new("sh").args(["-c", &script]).output().unwrap();
            assert_eq!(String::from_utf8(out.stdout).unwrap(), word);
        }
    }
}
