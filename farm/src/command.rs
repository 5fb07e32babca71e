//! Command lines with placeholders, and their process groups. Arguments are passed to the program directly,
//! without a shell, so names and paths need no quoting.

use anyhow::{Result, bail};
use std::ffi::OsStr;
use std::process::{Child, Command};

/// Names of all placeholders.
const NAMES: &str = "volume volume_name time rx_deg ry_deg dz_radii fov_y_deg transfer transfer_name width \
                     height step out task";

/// Part of an argument: text, or the name of a placeholder.
enum Part<'a> {
    Text(&'a str),
    Name(&'a str),
}

fn parts(argument: &str) -> Result<Vec<Part<'_>>> {
    let mut out = Vec::new();
    let mut rest = argument;
    while let Some(at) = rest.find(['{', '}']) {
        out.push(Part::Text(&rest[..at]));
        let (brace, after) = (rest.as_bytes()[at] as char, &rest[at + 1..]);
        if after.starts_with(brace) {
            out.push(Part::Text(&after[..1]));
            rest = &after[1..];
            continue;
        }
        let end = after.find(['{', '}']).filter(|&e| brace == '{' && after.as_bytes()[e] == b'}');
        let Some(end) = end else {
            bail!("the argument {argument:?} has a single {brace:?}; write {{{{ or }}}} for a brace itself")
        };
        out.push(Part::Name(&after[..end]));
        rest = &after[end + 1..];
    }
    out.push(Part::Text(rest));
    Ok(out)
}

/// Checks the placeholders of an argument.
///
/// # Errors
/// When a placeholder is unknown, or a brace is neither doubled nor part of a placeholder.
pub(crate) fn check(argument: &str) -> Result<()> {
    for part in parts(argument)? {
        if let Part::Name(name) = part
            && !NAMES.split(' ').any(|known| known == name)
        {
            let known = NAMES.replace(' ', "}, {");
            bail!("the argument {argument:?} holds {{{name}}}; accepted are {{{known}}}");
        }
    }
    Ok(())
}

/// Returns an argument with its placeholders replaced by `values` (name and text). Inserted text is not expanded again.
///
/// # Errors
/// When a placeholder has no value, or a brace is neither doubled nor part of a placeholder.
pub(crate) fn fill(argument: &str, values: &[(&str, String)]) -> Result<String> {
    let mut out = String::new();
    for part in parts(argument)? {
        match part {
            Part::Text(text) => out.push_str(text),
            Part::Name(name) => match values.iter().find(|(n, _)| *n == name) {
                Some((_, value)) => out.push_str(value),
                None => bail!("the argument {argument:?} holds {{{name}}}, which has no value here"),
            },
        }
    }
    Ok(out)
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
        let values: [(&str, String); 2] = [("out", "a {task} b.png".into()), ("task", "7".into())];
        assert_eq!(fill("--out={out}", &values).unwrap(), "--out=a {task} b.png");
        assert_eq!(fill("{{{task}}}", &values).unwrap(), "{7}");
        assert_eq!(fill("plain", &values).unwrap(), "plain");
        for (text, word) in [("{oot}", "{oot}"), ("{out", "single"), ("a}b", "single"), ("{a{b}", "single")] {
            let said = format!("{:#}", check(text).unwrap_err());
            assert!(said.contains(word), "{text}: {said}");
        }
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
