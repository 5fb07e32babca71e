//! `docs/src/options.md` has every option, and help texts have examples that work.

use crate::page::{check_examples, check_page};
use entire_cli::command;

#[test]
fn the_book_names_every_option() {
    let intro = "`make reference` makes this page from the program. `entire COMMAND --help` tells more of \
         each option, and gives examples.";
    check_page("options.md", command(), intro);
}

#[test]
fn every_command_has_examples_that_it_takes() {
    check_examples(command);
}
