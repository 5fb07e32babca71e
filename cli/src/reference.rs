//! The book's pages of options, generated from the definitions of the commands.

use clap::{Arg, Command};
use std::fmt::Write as _;

/// Returns the page of a program: one section for each of its commands, with a table of its options.
pub fn page(mut program: Command, intro: &str) -> String {
    program.build();
    let name = program.get_name().to_owned();
    let mut out = format!("# Options of {name}\n\n{intro}\n");
    for (command, definition) in commands(&program, &name) {
        let about = definition.get_long_about().or(definition.get_about());
        let about = about.map(ToString::to_string).unwrap_or_default();
        let _ = write!(out, "\n## {command}\n\n{}.\n\n", about.trim_end_matches('.'));
        out.push_str("| option | value | default | meaning |\n|---|---|---|---|\n");
        let flags = definition.get_arguments();
        let flags = flags.filter(|a| !a.is_positional() && !a.get_action().takes_values());
        let shown = |a: &&Arg| !a.is_hide_set() && !matches!(a.get_id().as_str(), "help" | "version");
        let options = definition.get_positionals().chain(definition.get_opts()).chain(flags);
        options.filter(shown).for_each(|arg| row(arg, &mut out));
    }
    out
}

/// Returns the example lines in a program's help texts, each after the name of its command; `None` for a
/// command without examples.
pub fn examples(mut program: Command) -> Vec<(String, Option<String>)> {
    program.build();
    let name = program.get_name().to_owned();
    let mut found = Vec::new();
    for (command, definition) in commands(&program, &name) {
        let help =
            definition.get_after_help().map(ToString::to_string).unwrap_or_default().replace("\\\n", " ");
        let before = found.len();
        for line in help.lines().filter(|l| l.starts_with("  ")) {
            // The text before the program's name is no argument: environment variables, another program, a
            // pipe.
            if let Some(at) = line.find(&format!("{name} ")) {
                found.push((command.clone(), Some(line[at..].to_owned())));
            }
        }
        if found.len() == before {
            found.push((command, None));
        }
    }
    found
}

/// Returns the commands below `command` that have no subcommands, with their full names, such as `entire
/// collect`.
fn commands<'a>(command: &'a Command, name: &str) -> Vec<(String, &'a Command)> {
    let mut all = Vec::new();
    for below in command.get_subcommands().filter(|c| !c.is_hide_set() && c.get_name() != "help") {
        let name = format!("{name} {}", below.get_name());
        if below.get_subcommands().next().is_none() {
            all.push((name, below));
        } else {
            all.extend(commands(below, &name));
        }
    }
    all
}

fn row(arg: &Arg, out: &mut String) {
    let takes_values = arg.get_action().takes_values();
    let value = arg.get_value_names().map(|names| names.join(" ")).unwrap_or_default();
    let choices: Vec<String> =
        arg.get_possible_values().iter().map(|v| format!("`{}`", v.get_name())).collect();
    let repeats = arg.is_positional() && matches!(arg.get_action(), clap::ArgAction::Append);
    let several = arg.get_num_args().is_some_and(|n| n.max_values() > 1) || repeats;
    let dots = if several { "…" } else { "" };
    let (option, value) = match arg.get_long() {
        Some(long) if !takes_values => (format!("`--{long}`"), String::new()),
        Some(long) if choices.is_empty() => (format!("`--{long}`"), format!("`{value}`{dots}")),
        Some(long) => (format!("`--{long}`"), choices.join(", ")),
        None => (format!("`{value}`{dots}"), String::new()),
    };
    let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
    let defaults: Vec<String> =
        arg.get_default_values().iter().map(|v| v.to_string_lossy().into_owned()).collect();
    let default = match defaults.join(",") {
        _ if !takes_values => String::new(),
        // If the code must know whether an option was given, clap has no default for the option; its help
        // text states the default.
        none if none.is_empty() => match help.rsplit_once("[default: ") {
            Some((_, said)) => format!("`{}`", said.trim_end_matches(['.', ']'])),
            None if arg.is_required_set() => "required".to_owned(),
            None => String::new(),
        },
        some => format!("`{some}`"),
    };
    let help = help.split(" [default: ").next().unwrap_or_default().trim_end_matches('.').to_owned();
    // A bare | would end the cell, even within code.
    let cells = [option, value, default, help].map(|cell| cell.replace('|', "\\|"));
    let _ = writeln!(out, "| {} |", cells.join(" | "));
}
