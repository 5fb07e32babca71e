//! Runs a command of `entire` or `entire-lab`: prints an error as one line, and returns the exit status.

use anyhow::{Context, Result};
use std::fmt::Display;
use std::io::Write;
use std::panic::UnwindSafe;
use std::process::ExitCode;
use std::sync::{Arc, Mutex};

/// Texts of the error of writing into a closed pipe; the codes are those of Windows.
const CLOSED_PIPE_TEXTS: [&str; 3] = ["Broken pipe", "(os error 109)", "(os error 232)"];

/// Runs a command. Exit status: 0, or 1 for an error or a panic (one line on standard error with cause and
/// remedy). A standard output that its reader has closed is no error.
pub fn run(name: &str, command: impl FnOnce() -> Result<()> + UnwindSafe) -> ExitCode {
    // The hook only stores the place of a panic: the error is printed below, in one line.
    let location = Arc::new(Mutex::new(None));
    let noted = location.clone();
    std::panic::set_hook(Box::new(move |info| {
        if let (Some(at), Ok(mut noted)) = (info.location(), noted.lock()) {
            *noted = Some(format!("{}:{}", at.file(), at.line()));
        }
    }));
    let result = std::panic::catch_unwind(command);
    let line = match result {
        Ok(Ok(())) => return ExitCode::SUCCESS,
        // The program that reads the output has closed the pipe.
        Ok(Err(error)) if error.chain().any(is_broken_pipe) => return ExitCode::SUCCESS,
        Ok(Err(error)) => format!("{error:#}"),
        Err(panic) => {
            let text = panic
                .downcast_ref::<String>()
                .map(String::as_str)
                .or_else(|| panic.downcast_ref::<&str>().copied())
                .unwrap_or("unknown");
            // The panic of `println!` holds no error value, only a text.
            if let Some(why) = text.strip_prefix("failed printing to ") {
                if is_closed_stdout(why) {
                    return ExitCode::SUCCESS;
                }
                let _ = writeln!(std::io::stderr().lock(), "{name}: cannot write to {why}");
                return ExitCode::from(1);
            }
            let at = location.lock().ok().and_then(|at| at.clone()).unwrap_or_default();
            format!("internal error ({text}, {at}); please report it with the command that you ran")
        }
    };
    let line: String = line.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let _ = writeln!(std::io::stderr().lock(), "{name}: {line}");
    ExitCode::from(1)
}

/// Prints a line on standard output, for a command that has more to do. If the reader of the output has
/// closed it, the line is dropped and the command goes on.
pub(crate) fn print_line(line: impl Display) -> Result<()> {
    match writeln!(std::io::stdout().lock(), "{line}") {
        Err(error) if is_broken_pipe(&error) => Ok(()),
        written => written.context("cannot write to stdout"),
    }
}

fn is_broken_pipe(error: &(dyn std::error::Error + 'static)) -> bool {
    error.downcast_ref::<std::io::Error>().is_some_and(|e| e.kind() == std::io::ErrorKind::BrokenPipe)
}

/// True if the reader of standard output has closed it. `why`: text of a panic after "failed printing to ". A
/// closed standard error does not count, since the command has not finished then.
fn is_closed_stdout(why: &str) -> bool {
    why.starts_with("stdout") && CLOSED_PIPE_TEXTS.iter().any(|closed| why.contains(closed))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_closed_standard_output_is_success() {
        assert!(is_closed_stdout("stdout: Broken pipe (os error 32)"));
        assert!(!is_closed_stdout("stderr: Broken pipe (os error 32)"));
        assert!(!is_closed_stdout("stdout: No space left on device (os error 28)"));
    }
}
