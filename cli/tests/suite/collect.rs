//! `entire collect` as a process: interruption, resumption and refused input.

use crate::support::{byte_nrrd, fails, json, refuses, stderr, stdout, succeeds, words};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

fn collect(volume: &Path, out: &Path, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_entire"));
    command.arg("collect").arg(volume).arg("--out").arg(out).args(["--device", "cpu", "--repeats", "2"]);
    command.args(more).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

#[track_caller]
fn works(command: &mut Command) -> Output {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    output
}

/// Checks that a command ends with this status, and that its messages have every one of `parts`.
#[track_caller]
fn refused(command: &mut Command, code: i32, parts: &[&str]) {
    let output = command.output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(code), "{parts:?}: {said}");
    parts.iter().for_each(|part| assert!(said.contains(part), "{part}: {said}"));
}

/// Starts a command that writes a table, and waits until the table has `lines` lines.
fn started(command: &mut Command, table: &Path, lines: usize) -> Child {
    let child = command.spawn().unwrap();
    let begin = Instant::now();
    while std::fs::read_to_string(table).map_or(0, |t| t.lines().count()) < lines {
        assert!(begin.elapsed() < Duration::from_secs(120), "no frame was written");
        std::thread::sleep(Duration::from_millis(2));
    }
    child
}

/// The table without its three clock columns.
fn frames(path: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(path).unwrap();
    let first = text.lines().next().unwrap().to_owned();
    let keep: Vec<bool> = first.split(',').map(|c| !c.starts_with("seconds_")).collect();
    text.lines()
        .map(|l| l.split(',').zip(&keep).filter(|(_, k)| **k).map(|(f, _)| f).collect::<Vec<_>>().join(","))
        .collect()
}

fn setting() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let volume = dir.path().join("v.nrrd");
    let value = |i: usize| ((i % 24 * 7 + i / 24 % 24 * 5 + i / 576 * 3) % 256) as u8;
    std::fs::write(&volume, byte_nrrd([24; 3], (0..24 * 24 * 24).map(value))).unwrap();
    (dir, volume)
}

#[cfg(unix)]
#[test]
fn ctrl_c_keeps_finished_frames_and_resuming_completes_them() {
    let (dir, volume) = setting();
    // `collect` makes the folder of a table.
    let (whole, cut) = (dir.path().join("new/whole.csv"), dir.path().join("cut.csv"));
    let settings = ["--frames", "40", "--min-size", "96", "--max-size", "160"];
    let output = works(&mut collect(&volume, &whole, &settings));
    // Two warm-ups of the first frame, and one of each of the 39 remaining frames.
    assert!(stdout(&output).contains("41 warm-up renderings were discarded"));

    // The interruption comes after several frames, so that some are left in the table.
    let child = started(&mut collect(&volume, &cut, &settings), &cut, 7);
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(killed.success());
    let output = child.wait_with_output().unwrap();
    let kept = frames(&cut);
    if output.status.success() {
        // The last frame was finished before the signal came, so there was no interruption.
        assert_eq!(kept, frames(&whole));
        return;
    }
    assert_eq!(output.status.code(), Some(1));
    let message = stderr(&output);
    assert!(message.contains("interrupted after") && message.contains("--resume"), "{message}");
    assert_eq!(kept.len() % 2, 1, "a partial frame was left");
    assert!(kept.len() >= 7 && kept.len() < 81);
    assert_eq!(kept, frames(&whole)[..kept.len()]);

    // Without --resume the table is unchanged; under other settings it is not continued.
    refused(&mut collect(&volume, &cut, &settings), 1, &["resume it"]);
    let mut other = collect(&volume, &cut, &settings);
    refused(other.args(["--seed", "2", "--resume"]), 1, &["seed was 1 and is 2 now"]);
    assert_eq!(frames(&cut), kept);

    works(collect(&volume, &cut, &settings).arg("--resume"));
    assert_eq!(frames(&cut), frames(&whole));
    let manifest = json(&dir.path().join("cut.manifest.json"));
    let runs = manifest["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 2);
    assert_eq!((&runs[0]["interrupted"], &runs[1]["interrupted"]), (&true.into(), &false.into()));
    for key in ["machine", "device", "commit", "seed", "settings", "created"] {
        assert!(!manifest[key].is_null(), "{key}");
    }
}

#[test]
fn bad_input_is_one_line_and_status_1_and_wrong_usage_is_2() {
    let (dir, volume) = setting();
    let out = dir.path().join("t.csv");
    let missing = dir.path().join("missing.nrrd");
    let broken = dir.path().join("broken.nrrd");
    std::fs::write(&broken, "NRRD0004\ntype: uint8\n").unwrap();
    let cases: [(&Path, &[&str], &str); 8] = [
        (&missing, &[], "no such file"),
        (&broken, &[], "broken.nrrd"),
        (&volume, &["--min-size", "0"], "image sides"),
        (&volume, &["--max-size", "8"], "image sides"),
        (&volume, &["--steps", "0"], "ray steps"),
        (&volume, &["--frames", "0"], "at least 1"),
        (&volume, &["--enlarge", "99", "--frames", "1"], "whole factors"),
        (dir.path(), &[], "is a folder"),
    ];
    for (volume, more, expected) in cases {
        let _ = std::fs::remove_file(&out);
        let output = collect(volume, &out, more).output().unwrap();
        let message = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{more:?}: {message}");
        assert!(message.contains(expected) && !message.contains("panicked"), "{more:?}: {message}");
        assert_eq!(message.trim_end().lines().count(), 1, "{more:?}: {message}");
    }
    refused(&mut collect(&volume, &out, &["--shade", "phong"]), 2, &[]);
    let again = dir.path().join("..").join(dir.path().file_name().unwrap()).join("v.nrrd");
    refused(collect(&volume, &out, &[]).arg(again), 1, &["v.nrrd is given twice"]);
}

#[cfg(unix)]
#[test]
fn volumes_whose_paths_tables_cannot_hold_are_refused() {
    use std::os::unix::ffi::OsStrExt;
    let dir = tempfile::tempdir().unwrap();
    let name = std::ffi::OsStr::from_bytes(b"v\xe9.nrrd");
    for line in [
        "collect --out t.csv",
        "calibrate --out m.safetensors",
        "steer --table t.csv --generate orbit --target 9ms --out out",
    ] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_entire"));
        let command = command.args(words(line)).arg(name).current_dir(dir.path());
        refused(command, 1, &["the path is not UTF-8", "rename it"]);
    }
}

#[test]
fn frames_of_a_pass_survive_an_error_with_the_manifest() {
    let (dir, volume) = setting();
    let broken = dir.path().join("broken.nrrd");
    let bytes = std::fs::read(&volume).unwrap();
    std::fs::write(&broken, &bytes[..bytes.len() - 100]).unwrap();
    let settings = ["--frames", "2", "--passes", "2", "--max-size", "48"];
    // The second volume cannot be read after frames of the first volume were collected.
    let out = dir.path().join("t.csv");
    let mut second = collect(&volume, &out, &settings);
    refused(second.arg(&broken), 1, &["to continue ", "repeat the same command with --resume"]);
    for kept in ["t.csv", "t.manifest.json", "t.pass1.csv"] {
        assert!(dir.path().join(kept).exists(), "{kept} is gone");
    }
    // If no frame was collected, no file is left.
    let out = dir.path().join("u.csv");
    refused(collect(&broken, &out, &settings).arg(&volume), 1, &[]);
    for gone in ["u.csv", "u.manifest.json", "u.pass1.csv"] {
        assert!(!dir.path().join(gone).exists(), "{gone} is left");
    }
}

#[test]
fn a_table_is_collected_anew_from_its_manifest() {
    let (dir, volume) = setting();
    let (first, again) = (dir.path().join("first.csv"), dir.path().join("again.csv"));
    let settings = ["--frames", "3", "--passes", "2", "--max-size", "48", "--seed", "9", "--steps", "1,2.5"];
    let output = works(&mut collect(&volume, &first, &settings));
    assert!(stdout(&output).starts_with("3 frames of 1 volume x 4 repeats"));

    let like = |table: &Path, out: &Path, more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_entire"));
        command.args(["collect", "--device", "cpu", "--like"]).arg(table).arg("--out").arg(out).args(more);
        command
    };
    works(&mut like(&first, &again, &[]));
    assert_eq!(frames(&again), frames(&first));
    assert_eq!(frames(&again).len(), 1 + 3 * 4);

    let other = dir.path().join("x.csv");
    refused(&mut like(&dir.path().join("none.csv"), &other, &[]), 1, &["none.csv has no manifest"]);
    refused(&mut like(&first, &other, &["--frames", "5"]), 2, &["--frames"]);
    std::fs::remove_file(&volume).unwrap();
    refused(&mut like(&first, &other, &[]), 1, &["v.nrrd: no such file; run from the folder"]);
}

#[test]
fn frames_of_a_proxy_have_features() {
    let dir = tempfile::tempdir().unwrap();
    let volume = dir.path().join("v.nrrd");
    std::fs::write(&volume, byte_nrrd([12, 10, 8], (0..12 * 10 * 8).map(|i| (i % 251) as u8))).unwrap();
    works(&mut collect(
        &volume,
        &dir.path().join("t.csv"),
        &["--frames", "3", "--max-size", "48", "--proxy", "6"],
    ));
    succeeds(dir.path(), &words("features --quiet --data t.csv"));
    assert!(dir.path().join("t.features.csv.gz").exists());
}

#[test]
fn a_table_of_a_teacher_is_not_gone_on_with_after_its_model_changed() {
    let (dir, _) = setting();
    let teacher = dir.path().join("m.safetensors");
    let take = |name: &str| {
        let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models").join(name);
        std::fs::copy(model, &teacher).unwrap();
    };
    let line = "collect v.nrrd --out t.csv --teacher m.safetensors --frames 2 --repeats 1 --max-size 48";
    take("unshaded-selected.safetensors");
    succeeds(dir.path(), &words(line));
    let table = dir.path().join("t.csv");
    let whole = std::fs::read_to_string(&table).unwrap();
    // The table is cut as if the collection had been interrupted before the last frame.
    let cut: Vec<&str> = whole.lines().take(2).collect();
    std::fs::write(&table, cut.join("\n") + "\n").unwrap();
    let resume = format!("{line} --resume");
    take("unshaded-xeon-selected.safetensors");
    fails(dir.path(), &resume, 1, &["teacher was"]);
    take("unshaded-selected.safetensors");
    succeeds(dir.path(), &words(&resume));
    assert_eq!(std::fs::read_to_string(&table).unwrap(), whole);
}

#[test]
fn a_table_is_not_gone_on_with_after_its_volume_was_written_anew() {
    let (dir, volume) = setting();
    let out = dir.path().join("t.csv");
    let settings = ["--frames", "3", "--max-size", "48"];
    works(&mut collect(&volume, &out, &settings));
    let whole = frames(&out);
    // The table is cut as if the collection had been interrupted before the last frame.
    let text = std::fs::read_to_string(&out).unwrap();
    let cut: Vec<&str> = text.lines().take(1 + 2 * 2).collect();
    std::fs::write(&out, cut.join("\n") + "\n").unwrap();

    let bytes = std::fs::read(&volume).unwrap();
    let mut other = bytes.clone();
    *other.last_mut().unwrap() ^= 0x55;
    std::fs::write(&volume, &other).unwrap();
    let resume = [&settings[..], &["--resume"]].concat();
    refused(&mut collect(&volume, &out, &resume), 1, &["v.nrrd changed", "content", "another --out"]);
    assert_eq!(frames(&out), whole[..5]);

    // Other commands that read the volumes refuse the changed volume too.
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/unshaded-distilled.safetensors");
    let evaluate = ["evaluate", "--quiet", "--model", model, "--data", "t.csv"];
    let features = words("features --quiet --data t.csv");
    let train = words("train --quiet --data t.csv --out m.safetensors");
    for arguments in [&features[..], &evaluate, &train] {
        refuses(dir.path(), arguments, &["v.nrrd changed after the frames of t.csv"]);
    }

    // A file with the original content is accepted, although it was written later.
    std::fs::write(&volume, &bytes).unwrap();
    succeeds(dir.path(), &features);
    std::fs::remove_file(dir.path().join("t.features.csv.gz")).unwrap();
    works(&mut collect(&volume, &out, &resume));
    assert_eq!(frames(&out), whole);

    // A table without checksums of its volumes is continued, with a note.
    let path = dir.path().join("t.manifest.json");
    let mut kept = json(&path);
    assert!(kept.as_object_mut().unwrap().remove("files").is_some());
    // A key of another program is kept.
    kept["laboratory"] = "north".into();
    std::fs::write(&path, kept.to_string()).unwrap();
    let output = works(collect(&volume, &out, &resume).arg("--quiet"));
    assert!(output.stderr.is_empty(), "{}", stderr(&output));
    std::fs::write(&path, kept.to_string()).unwrap();
    let output = works(&mut collect(&volume, &out, &resume));
    assert!(stderr(&output).contains("no checksums"), "{}", stderr(&output));
    assert_eq!(json(&path)["laboratory"], "north");
}
