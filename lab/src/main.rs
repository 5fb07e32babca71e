//! The `entire-lab` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    entire_lab::command_line::main()
}
