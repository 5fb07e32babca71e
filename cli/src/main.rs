//! The `entire` command. Exit status: 0 for success, 1 for any error (one line on standard error says why and
//! what to do), 2 for wrong usage.

use std::process::ExitCode;

fn main() -> ExitCode {
    let program = std::env::current_exe().unwrap_or_else(|_| "entire".into());
    entire_cli::main_with_args(std::env::args_os(), vec![program.into_os_string()])
}
