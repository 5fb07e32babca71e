//! `entire-lab record` and `entire-lab farm` as processes: a farm's tasks recorded, predicted and balanced.

use crate::{lab, printed};
use std::path::Path;

#[path = "../../../cli/tests/support/ball.rs"]
mod ball;

#[test]
fn farms_are_balanced_from_recorded_frames_of_other_volumes() {
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let (volume, second) = (file("ball.nrrd"), file("second.nrrd"));
    let (before, tasks) = (file("before.json"), file("tasks.json"));
    ball::write(Path::new(&volume));
    std::fs::copy(&volume, &second).unwrap();
    let record = |volumes: &[&str], frames: &str, out: &str| {
        let common =
            ["--generate", "orbit", "--device", "cpu", "--size", "24x24", "--steps", "1,2", "--repeats", "2"];
        let output = lab(&[&["record"][..], volumes, &common, &["--frames", frames, "--out", out]].concat());
        assert!(output.status.success(), "{}", printed(&output.stderr));
    };
    record(&[&volume, &second, "--hold", "20"], "40", &before);
    record(&[&volume], "16", &tasks);
    let (list, report) = (file("tasks.csv"), file("report"));
    let run = |more: &[&str]| {
        let output = lab(&[&["farm", "--trace", &tasks, "--report", &report][..], more].concat());
        (output.status.code(), printed(&output.stdout) + &printed(&output.stderr))
    };
    // The report compares every method.
    let (code, said) = run(&["--training", &before, "--probe-side", "16", "--save-tasks", &list]);
    assert_eq!(code, Some(0), "{said}");
    for word in ["ms per task", "static with exchanges, predicted", "queue, any order (mean of 200)"] {
        assert!(said.contains(word), "{word}: {said}");
    }
    assert!(Path::new(&report).join("report.html").is_file());
    let rows = std::fs::read_to_string(&list).unwrap();
    assert_eq!(rows.lines().count(), 17);
    for row in rows.lines().skip(1) {
        let cells: Vec<&str> = row.split(',').collect();
        assert!(cells[1].parse::<f64>().unwrap() > 0.0 && cells[2].parse::<f64>().unwrap() > 0.0, "{row}");
    }
    // The saved task list can be planned and compared.
    assert_eq!(entire_farm::read_tasks(Path::new(&list)).unwrap().len(), 16);
    let output = lab(&["farm", &list, "--report", &report, "--bars"]);
    let said = printed(&output.stdout);
    assert_eq!(said.lines().filter(|l| l.starts_with("bar farm-")).count(), 4, "{said}");

    let (code, said) = run(&["--training", &before, "--probe-side", "25"]);
    assert!(code == Some(1) && said.contains("1 to 24"), "{said}");
    let (code, said) = run(&[]);
    assert!(code == Some(1) && said.contains("--training"), "{said}");
}

#[test]
fn a_simulated_farm_does_all_tasks_and_pays_for_bundles() {
    let dir = tempfile::tempdir().unwrap();
    let list = dir.path().join("tasks.csv");
    let rows: String =
        (0..64).map(|i| format!("t{i},1,{},v,0\n", if i % 2 == 0 { 1.0 } else { 2.0 })).collect();
    std::fs::write(&list, "task,predicted_s,measured_s,volume,load_s\n".to_owned() + &rows).unwrap();
    let run = |more: &[&str]| -> serde_json::Value {
        let output = lab(&[&["farm-simulate", list.to_str().unwrap(), "--slots", "4"][..], more].concat());
        assert!(output.status.success(), "{}", printed(&output.stderr));
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let plain = run(&["--arrival"]);
    assert_eq!(plain["lower_bound_s"], 24.0);
    // Tasks alternately take 1 s and 2 s; there are four slots, and starting a bundle takes no time. The
    // makespan must exceed the lower bound of all schedules by at most 1 s, the time of a short task.
    let plain = plain["makespan_s"].as_f64().unwrap();
    assert!((24.0..=25.0).contains(&plain), "{plain}");
    let paid = run(&["--arrival", "--latency", "0.5", "--overhead", "0"]);
    // Each of the 64 bundles holds one task and occupies a slot for another half second.
    assert_eq!(paid["bundles"], 64);
    let makespan = paid["makespan_s"].as_f64().unwrap();
    assert!((32.0..=35.0).contains(&makespan), "{makespan}");
    for wrong in ["--latency=nan", "--latency=inf", "--latency=-1", "--overhead=nan"] {
        let output = lab(&["farm-simulate", list.to_str().unwrap(), "--slots", "4", wrong]);
        let said = printed(&output.stderr);
        assert!(output.status.code() == Some(1) && said.contains("finite and not negative"), "{said}");
    }
}
