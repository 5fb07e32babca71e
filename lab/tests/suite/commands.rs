//! `entire-lab` as a process: help, wrong usage, checks before any work, and replays under recorded loads.

use crate::{lab, printed, read_json};
use std::process::Output;

#[test]
fn help_shows_examples_and_wrong_usage_exits_with_2() {
    for command in ["study", "record", "replay", "tune", "stress", "farm"] {
        let output = lab(&[command, "--help"]);
        let help = printed(&output.stdout);
        assert_eq!(output.status.code(), Some(0), "{command}");
        assert!(help.contains("Examples:") && help.contains(&format!("entire-lab {command}")), "{help}");
    }
    assert!(printed(&lab(&["--version"]).stdout).starts_with("entire-lab "));
    for arguments in [&[][..], &["nonsense"], &["study"], &["farm"], &["record"]] {
        assert_eq!(lab(arguments).status.code(), Some(2), "{arguments:?}");
    }
}

#[test]
fn a_gpu_study_takes_no_time_limit_that_is_no_number() {
    let output = lab(&["gpu-study", "--seconds", "nan"]);
    let said = printed(&output.stderr);
    assert!(output.status.code() == Some(1) && said.contains("--seconds is no number"), "{said}");
}

#[test]
fn record_says_where_it_cannot_write_before_anything_is_drawn() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("file");
    std::fs::write(&file, "x").unwrap();
    // A file in place of the folder stops every user, root included.
    let out = file.join("trace.json");
    let words = "record data/mr_banana.nrrd --generate orbit --frames 8 --size 24x24 --device cpu --out";
    let output = lab(&words.split(' ').chain([out.to_str().unwrap()]).collect::<Vec<_>>());
    let said = printed(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.starts_with("entire-lab: cannot make the folder") && said.lines().count() == 1, "{said}");
    assert!(said.contains(file.to_str().unwrap()), "{said}");
    assert_eq!(std::fs::read(&file).unwrap(), b"x");
}

#[test]
fn a_stopped_calibration_is_no_table_of_some_of_its_volumes() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("calibration.csv");
    for (volumes, frames) in [(&["mr_banana", "missing"][..], None), (&["mr_banana"][..], Some(48))] {
        let volumes: Vec<String> = volumes.iter().map(|v| format!("data/{v}.nrrd")).collect();
        let rest = "--calibration 8 --clock cpu --repeats 1 --size 16x16 --device cpu --out";
        let volumes = ["record"].into_iter().chain(volumes.iter().map(String::as_str));
        let output = lab(&volumes.chain(rest.split(' ')).chain([out.to_str().unwrap()]).collect::<Vec<_>>());
        assert_eq!(output.status.success(), frames.is_some(), "{}", printed(&output.stderr));
        // The first command fails at its second volume and leaves a table with the header alone. The second
        // command fills this table.
        assert_eq!(std::fs::read_to_string(&out).unwrap().lines().count(), 1 + frames.unwrap_or(0));
    }
}

#[test]
fn tune_says_what_recorded_paths_cost() {
    let tune = |traces: &[&str], targets: &str, more: &[&str]| {
        let traces: Vec<String> = traces.iter().map(|t| format!("data/steer/training/{t}.json.gz")).collect();
        let traces: Vec<&str> = traces.iter().map(String::as_str).collect();
        let rest = ["--calibration", "data/steer/training/calibration.csv.gz", "--targets", targets];
        lab(&[&["tune"][..], &traces, &rest, more].concat())
    };
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("tune.json");
    let written = |output: &Output| -> serde_json::Value {
        assert!(output.status.success(), "{}", printed(&output.stderr));
        serde_json::from_slice(&std::fs::read(&out).unwrap()).unwrap()
    };
    let both = ["train-orbit", "train-series"];
    let output = tune(&both, "45fps,60fps", &["--rounds", "0", "--out", out.to_str().unwrap()]);
    let said = printed(&output.stdout);
    let found = written(&output);
    assert!(said.contains("train-orbit") && said.contains("no other value of any constant"), "{said}");
    assert_eq!(found["paths"], serde_json::json!(["train-orbit", "train-series"]));
    use entire_steer::control::{CorrectionConstants, HybridConstants};
    let (mut hybrid, mut correction) = (HybridConstants::default(), CorrectionConstants::default());
    let names: Vec<_> =
        hybrid.values().into_iter().chain(correction.values()).map(|(name, _)| name).collect();
    assert!(names.iter().all(|n| found["constants"][n].is_f64()), "{found}");
    assert!(said.contains("\nbar searched-constants ") && said.contains(" 12.0000 ok\n"), "{said}");
    for path in 0..2 {
        for (what, most) in [("fitted", 0.15), ("cold", 0.5)] {
            let deviation = found["before"][path][what]["deviation"].as_f64().unwrap();
            assert!(deviation > 0.0 && deviation < most, "{path} {what} {deviation}");
        }
    }
    for (traces, targets, why) in [
        (&both[..1], "45fps", "a standard error needs several paths"),
        (&both[..], "3600s", "train-orbit has no target that some allowed step meets"),
    ] {
        let output = tune(traces, targets, &["--rounds", "0"]);
        let said = printed(&output.stderr);
        assert_eq!(output.status.code(), Some(1));
        assert!(said.contains(why), "{said}");
    }
    // A search from another start, for one constant only.
    let more = ["--set", "damping=0.4", "--only", "damping", "--rounds", "1", "--out", out.to_str().unwrap()];
    let found = written(&tune(&both, "45fps,60fps", &more));
    assert_eq!(found["constants"]["full"], HybridConstants::default().full);
    assert!(found["constants"]["damping"].as_f64().unwrap() <= 0.4, "{found}");
    assert_eq!(found["without"].as_array().unwrap().len(), names.len());
    // Gains of PID are found from another start.
    let more = [
        "--set",
        "pid_integral=5",
        "--only",
        "pid_integral",
        "--rounds",
        "1",
        "--out",
        out.to_str().unwrap(),
    ];
    let found = written(&tune(&both, "45fps,60fps", &more));
    assert!(found["constants"]["pid_integral"].as_f64().unwrap() < 5.0, "{found}");
    assert_eq!(found["pid"]["taken"][0]["name"], "pid_integral");
    // Beside another program that takes a core all the time, the same path costs more.
    let more = "--rounds 0 --disturbances data/steer/disturbances/steady.csv --out".split(' ');
    let found = written(&tune(&both, "45fps", &more.chain([out.to_str().unwrap()]).collect::<Vec<_>>()));
    assert_eq!(found["paths"][2], "train-orbit/steady");
    let missed = |path: usize| found["before"][path]["fitted"]["missed"].as_f64().unwrap();
    assert!(missed(2) > 1.5 * missed(0) && missed(3) > 1.5 * missed(1), "{found}");
    for (option, value, why) in [
        ("--only", "dead-band", "no constant is named dead-band; there are full, damping"),
        ("--set", "far", "far is no NAME=VALUE"),
        ("--set", "far=-1", "far is -1; it must be a finite number and not negative"),
    ] {
        let output = tune(&both, "45fps", &[option, value]);
        let said = printed(&output.stderr);
        assert!(output.status.code() == Some(1) && said.contains(why), "{said}");
    }
}

/// Scores of OLP and entire's controller on two recorded paths with the slowdowns of a file.
fn scores_under(disturbance: &str, more: &[&str]) -> [serde_json::Value; 2] {
    let dir = tempfile::tempdir().unwrap();
    let words = "replay lab/tests/data/nyx-switches.json lab/tests/data/castro-cuts.json \
                 --calibration data/steer/calibration.csv.gz --controllers olp,hybrid";
    let rest = ["--disturbance", disturbance, "--out", dir.path().to_str().unwrap()];
    let arguments: Vec<&str> = words.split_whitespace().chain(rest).chain(more.iter().copied()).collect();
    let output = lab(&arguments);
    assert!(output.status.success(), "{}", printed(&output.stderr));
    let scores = read_json(&dir.path().join("scores.json"));
    ["olp", "hybrid"].map(|name| scores["controllers"][name].clone())
}

#[test]
fn whatever_else_runs_fewer_frames_are_late_than_under_olp() {
    let dir = tempfile::tempdir().unwrap();
    // Half of the speed for 3 of 12 seconds.
    let halved = dir.path().join("halved.csv");
    std::fs::write(&halved, "start_s,slowdown\n0,1\n3,2\n6,1\n9,1\n").unwrap();
    let recorded = |name: &str| format!("data/steer/disturbances/{name}.csv");
    let number = |score: &serde_json::Value, group: &str, name: &str| {
        let of = if group.is_empty() { score } else { &score[group] };
        of[name].as_f64().unwrap()
    };
    // Upper limits: late frames divided by OLP's, and OLP's quality minus entire's.
    for (file, late, lost) in [
        (recorded("none"), 0.85, 0.03),
        (recorded("bursts"), 0.92, 0.05),
        (recorded("steady"), 0.97, 0.04),
        (halved.to_str().unwrap().to_owned(), 0.92, 0.04),
    ] {
        let [olp, ours] = scores_under(&file, &[]);
        let ratio = |group: &str, name: &str| number(&ours, group, name) / number(&olp, group, name);
        let place = format!("{file}: {olp} {ours}");
        assert!(ratio("all", "missed") <= late, "{place}");
        assert!(number(&olp, "all", "quality") - number(&ours, "all", "quality") <= lost, "{place}");
        assert!(ratio("", "first_frame_deviation") <= 0.85, "{place}");
        assert!(ratio("", "worst") <= 0.75, "{place}");
    }
    // A session that ignores the load draws better pictures, and more of its frames are late than OLP's.
    let [olp, ours] = scores_under(&recorded("bursts"), &["--ignore-load"]);
    assert!(number(&ours, "all", "missed") > number(&olp, "all", "missed"), "{olp} {ours}");
    assert!(number(&ours, "all", "quality") > number(&olp, "all", "quality"), "{olp} {ours}");
}

#[test]
fn replay_fails_if_a_path_cannot_be_played() {
    let dir = tempfile::tempdir().unwrap();
    let played = "lab/tests/data/castro-cuts.json";
    let mut trace = read_json(&crate::repository().join("lab/tests/data/nyx-switches.json"));
    trace["name"] = "alternating".into();
    // Frames take 1 s and 100 s in turn, at every step. The trace's own target lies between these times, so no
    // step meets it exactly in any frame.
    for (i, frame) in trace["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
        for point in frame.as_array_mut().unwrap() {
            point["seconds"] = serde_json::json!(vec![if i % 2 == 0 { 1.0 } else { 100.0 }; 2]);
        }
    }
    let alternating = dir.path().join("alternating.json");
    std::fs::write(&alternating, trace.to_string()).unwrap();
    let out = dir.path().join("out");
    let replay = |traces: &[&str]| {
        let rest =
            "--calibration data/steer/training/calibration.csv.gz --controllers fixed --rounds 1 --out";
        let arguments = ["replay"].into_iter().chain(traces.iter().copied()).chain(rest.split(' '));
        lab(&arguments.chain([out.to_str().unwrap()]).collect::<Vec<_>>())
    };
    assert_eq!(replay(&[played]).status.code(), Some(0));
    std::fs::remove_dir_all(&out).unwrap();
    let output = replay(&[played, alternating.to_str().unwrap()]);
    let said = printed(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("entire-lab: not played: alternating"), "{said}");
    assert!(out.join("scores.json").is_file());
}
