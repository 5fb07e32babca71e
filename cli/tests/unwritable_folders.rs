//! Commands in a folder that cannot be written: one line that names the file, status 1, and no file left
//! behind. If no folder can be made read-only for this user, the test in a read-only folder is reported as
//! ignored.

mod support;

use libtest_mimic::{Arguments, Failed, Trial};
use std::path::Path;
use std::process::{Command, Output};
use support::{render, stderr, words};

/// Shell command that mounts the folder `$1` read-only and runs the other arguments as a command. A read-only
/// mount also restricts root; permissions do not.
const MOUNTED: &str = r#"mount --bind "$1" "$1" && mount -o remount,ro,bind "$1" "$1" && shift && exec "$@""#;

/// Ways to make a folder read-only.
#[derive(Clone, Copy)]
enum How {
    Permissions,
    Mount,
}

fn mounted(folder: &Path) -> Command {
    let mut command = Command::new("unshare");
    command.args(["--mount", "sh", "-c", MOUNTED, "sh"]).arg(folder);
    command
}

fn set_writable(folder: &Path, writable: bool) {
    let mut permissions = std::fs::metadata(folder).unwrap().permissions();
    permissions.set_readonly(!writable);
    std::fs::set_permissions(folder, permissions).unwrap();
}

/// The first method that makes a folder read-only for this user; `None` if none works.
fn how() -> Option<How> {
    let folder = tempfile::tempdir().unwrap();
    let probe = folder.path().join("probe");
    set_writable(folder.path(), false);
    let bound = std::fs::write(&probe, "").is_err();
    set_writable(folder.path(), true);
    if bound {
        return Some(How::Permissions);
    }
    let _ = std::fs::remove_file(&probe);
    // The mount must succeed, and writing a file must fail.
    let ran =
        mounted(folder.path()).args(["sh", "-c", r#"! touch "$1" 2>/dev/null"#, "sh"]).arg(&probe).output();
    ran.is_ok_and(|o| o.status.success()).then_some(How::Mount)
}

/// Returns a folder with a volume and a table of its frames.
fn workshop() -> tempfile::TempDir {
    let folder = support::workshop();
    let collect =
        "collect ball.nrrd --out t.csv --frames 12 --device cpu --repeats 1 --min-size 16 --max-size 24";
    support::succeeds(folder.path(), &words(collect));
    folder
}

/// Returns commands that write a file into the folder `into`, each with the path of that file.
fn commands(into: &str) -> Vec<(String, Vec<String>)> {
    let owned = |words: Vec<&str>| words.into_iter().map(str::to_owned).collect::<Vec<_>>();
    let out = |name: &str| format!("{into}/{name}");
    let (table, picture, model) = (out("u.csv"), out("o.png"), out("m.safetensors"));
    let drawn = render("ball.nrrd", "0,0,2", "0.5,0.1,0.5", "8x8", &["--out", picture.as_str()]);
    let collect = format!("collect ball.nrrd --out {table} --frames 4 --device cpu --repeats 1");
    let train = format!("train --quiet --data t.csv --out {model} --inputs camera,resolution --clock wall");
    let (collect, drawn, train) = (owned(words(&collect)), owned(drawn), owned(words(&train)));
    vec![(table, collect), (picture, drawn), (model, train)]
}

/// Checks that the command ended with status 1 and one line that has every one of `parts`.
fn check(output: &Output, parts: &[&str]) -> Result<(), Failed> {
    let told = stderr(output);
    let lines: Vec<&str> = told.lines().filter(|l| l.starts_with("entire: ")).collect();
    let [line] = lines[..] else { return Err(format!("{parts:?}: {told:?} is not one error").into()) };
    let clear = parts.iter().all(|part| line.contains(part));
    if output.status.code() != Some(1) || !clear || told.contains("panicked") {
        return Err(format!("{parts:?}: status {:?}, {told:?}", output.status.code()).into());
    }
    Ok(())
}

/// Writes into a path whose folder is a file; this fails for every user.
fn below_a_file() -> Result<(), Failed> {
    let folder = workshop();
    std::fs::write(folder.path().join("file"), "x")?;
    for (file, arguments) in commands("file") {
        let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let output = support::entire(folder.path(), &words);
        // A folder that cannot be made is named in place of the file in it.
        match stderr(&output).contains("cannot make the folder file:") {
            true => check(&output, &["cannot make the folder file:"])?,
            false => check(&output, &["cannot write", &file])?,
        }
    }
    if std::fs::read(folder.path().join("file"))? != b"x" {
        return Err("the file was changed".into());
    }
    Ok(())
}

fn in_a_read_only_folder(how: How) -> Result<(), Failed> {
    let folder = workshop();
    let closed = folder.path().join("closed");
    std::fs::create_dir(&closed)?;
    let entire = env!("CARGO_BIN_EXE_entire");
    for (file, arguments) in commands("closed") {
        let mut command = match how {
            How::Permissions => Command::new(entire),
            How::Mount => {
                let mut command = mounted(&closed);
                command.arg(entire);
                command
            }
        };
        set_writable(&closed, matches!(how, How::Mount));
        let output = command.args(&arguments).current_dir(folder.path()).output();
        set_writable(&closed, true);
        check(&output?, &["cannot write", &file])?;
    }
    if std::fs::read_dir(&closed)?.next().is_some() {
        return Err("something was left in the folder".into());
    }
    Ok(())
}

fn main() {
    let arguments = Arguments::from_args();
    let how = how();
    if how.is_none() {
        eprintln!("in_a_read_only_folder is ignored: permissions do not bind this user, who cannot mount");
    }
    let closed = move || how.map_or(Ok(()), in_a_read_only_folder);
    let trials = vec![
        Trial::test("below_a_file", below_a_file),
        Trial::test("in_a_read_only_folder", closed).with_ignored_flag(how.is_none()),
    ];
    libtest_mimic::run(&arguments, trials).exit();
}
