//! Compares the book's pages of options with the commands, and reads the examples of help texts.

use clap::Command;
use entire_cli::reference;
use std::path::Path;

/// Checks that a page of the book matches the commands; `UPDATE_REFERENCE=1` (`make reference`) writes it.
pub(crate) fn check_page(name: &str, program: Command, intro: &str) {
    let book = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/src");
    if !book.is_dir() {
        // A published package has no book beside it: the repository's tests check the page.
        return;
    }
    let made = reference::page(program, intro);
    if std::env::var_os("UPDATE_REFERENCE").is_some() {
        std::fs::write(book.join(name), &made).unwrap();
    }
    let kept = std::fs::read_to_string(book.join(name)).unwrap_or_default();
    for (n, (kept, made)) in kept.lines().zip(made.lines()).enumerate() {
        assert_eq!(kept, made, "docs/src/{name} line {}; run `make reference`", n + 1);
    }
    assert_eq!(kept.len(), made.len(), "docs/src/{name} is out of date; run `make reference`");
}

/// Columns of a narrow terminal. A longer line of a help text is wrapped, so that an example cannot be
/// copied.
const TERMINAL_COLUMNS: usize = 80;

/// Checks that every command has examples at the end of its help, and accepts them.
pub(crate) fn check_examples(program: impl Fn() -> Command) {
    check_width(&program());
    for (name, example) in reference::examples(program()) {
        let example = example.unwrap_or_else(|| panic!("{name} --help has no examples"));
        assert!(example == name || example.starts_with(&format!("{name} ")), "{name} --help has {example:?}");
        if let Err(error) = program().try_get_matches_from(words(&example)) {
            panic!("{example}: {error}");
        }
    }
}

/// Checks the lines at the end of the help of a command and of its subcommands.
fn check_width(command: &Command) {
    let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
    for line in help.lines() {
        assert!(line.chars().count() <= TERMINAL_COLUMNS, "{} --help: {line}", command.get_name());
    }
    command.get_subcommands().for_each(check_width);
}

/// Returns the words of a command line without nested quotes.
fn words(line: &str) -> Vec<String> {
    let mut words = Vec::new();
    for (i, part) in line.split('\'').enumerate() {
        match i % 2 {
            0 => words.extend(part.split_whitespace().map(str::to_owned)),
            _ => words.push(part.to_owned()),
        }
    }
    words
}
