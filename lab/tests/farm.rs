//! `entire-lab record` and `entire-lab farm` as processes: a farm's tasks recorded, predicted and balanced.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

#[path = "../../cli/tests/support/ball.rs"]
mod ball;

fn lab(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_entire-lab")).args(arguments).output().unwrap()
}

fn setting() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let volume = dir.path().join("ball.nrrd");
    ball::write(&volume);
    (dir, volume)
}

#[test]
fn farms_are_balanced_from_recorded_frames_of_other_volumes() {
    let (dir, volume) = setting();
    let file = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let (volume, before, tasks) = (volume.to_str().unwrap(), file("before.json"), file("tasks.json"));
    let second = file("second.nrrd");
    std::fs::copy(volume, &second).unwrap();
    let record = |volumes: &[&str], frames: &str, out: &str| {
        let common =
            ["--generate", "orbit", "--device", "cpu", "--size", "24x24", "--steps", "1,2", "--repeats", "2"];
        let output = lab(&[&["record"][..], volumes, &common, &["--frames", frames, "--out", out]].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    record(&[volume, &second, "--hold", "20"], "40", &before);
    record(&[volume], "16", &tasks);
    let (list, report) = (file("tasks.csv"), file("report"));
    let run = |more: &[&str]| {
        let output = lab(&[&["farm", "--trace", &tasks, "--report", &report][..], more].concat());
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        (output.status.code(), text + &String::from_utf8_lossy(&output.stderr))
    };
    // What repeats say of each other is told beside every method.
    let (code, text) = run(&["--training", &before, "--probe-side", "16", "--save-tasks", &list]);
    assert_eq!(code, Some(0), "{text}");
    for word in [
        "16 x 16 rays; each volume left out in turn",
        "factor learned from the view",
        "ms per task",
        "static with exchanges, predicted",
        "a second time",
    ] {
        assert!(text.contains(word), "{word}: {text}");
    }
    assert!(Path::new(&report).join("report.html").is_file());
    let rows = std::fs::read_to_string(&list).unwrap();
    assert_eq!(rows.lines().count(), 17);
    for row in rows.lines().skip(1) {
        let cells: Vec<&str> = row.split(',').collect();
        assert!(cells[1].parse::<f64>().unwrap() > 0.0 && cells[2].parse::<f64>().unwrap() > 0.0, "{row}");
    }
    // The list that was saved is one that farms are planned and compared from.
    assert_eq!(entire_cli::farm::read_tasks(Path::new(&list)).unwrap().len(), 16);
    let output = lab(&["farm", &list, "--report", &report, "--bars"]);
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(text.lines().filter(|l| l.starts_with("bar farm-")).count(), 4, "{text}");

    let (code, text) = run(&["--training", &before, "--probe-side", "25"]);
    assert!(code == Some(1) && text.contains("1 to 24"), "{text}");
    let (code, text) = run(&[]);
    assert!(code == Some(1) && text.contains("--training"), "{text}");
}
