//! `entire-lab gpu-study` as a process, on the driver that is there or else the CPU twin: steps that have no time are left out by name, what is done is
//! kept, and the same command goes on.

use std::path::{Path, PathBuf};
use std::process::Command;

/// The command `entire`, where the workspace's tests built it beside this package's program.
fn entire() -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_BIN_EXE_entire-lab")).with_file_name("entire");
    path.is_file().then_some(path)
}

#[test]
fn a_short_study_ends_in_time_and_goes_on_where_it_ended() {
    if entire().is_none() {
        println!("skipped: the command entire is not built beside entire-lab (cargo build --workspace)");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let out = dir.path().join("out");
    let study = |seconds: &str, more: &[&str]| {
        let run = Command::new(env!("CARGO_BIN_EXE_entire-lab"))
            .current_dir(&root)
            .args([
                "gpu-study",
                "--short",
                "--device",
                "cpu",
                "--clock",
                "wall",
                "--seconds",
                seconds,
                "--out",
            ])
            .arg(&out)
            .args(more)
            .output()
            .unwrap();
        (
            run.status.code(),
            String::from_utf8_lossy(&run.stdout).into_owned() + &String::from_utf8_lossy(&run.stderr),
        )
    };
    let steps = || -> serde_json::Value {
        serde_json::from_str(&std::fs::read_to_string(out.join("steps.json")).unwrap()).unwrap()
    };
    let state = |name: &str| {
        let steps = steps();
        let found = steps.as_array().unwrap().iter().find(|s| s["step"] == name).map(|s| s["state"].clone());
        found.map(|s| s.as_str().unwrap().to_owned())
    };
    // Far too little time: what was not begun is named, and the page is there.
    let (code, text) = study("10", &[]);
    assert_eq!(code, Some(1), "{text}");
    assert_eq!(state("pictures").as_deref(), Some("done"), "{text}");
    assert_eq!(state("calibrate-scatter").as_deref(), Some("left-out"), "{text}");
    assert!(text.contains("bar gpu-study-steps-missing") && text.contains("short"), "{text}");
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("left out") && page.contains("Pictures"), "{page}");
    let pictures = text.lines().find(|l| l.starts_with("bar gpu-study-picture-difference-of-255"));
    assert!(pictures.is_some_and(|l| l.ends_with(" ok")), "{text}");
    let pictures = std::fs::metadata(out.join("pictures.json")).unwrap().modified().unwrap();
    // With time enough all of it is done, and what was done stays. Modes that are not asked for stay as they were.
    let (code, text) = study("600", &["--shade", "none"]);
    for step in ["probe", "calibrate-none", "frames-none", "evaluate-frames-none", "switches"] {
        assert!(matches!(state(step).as_deref(), Some("done" | "cut-short")), "{step}: {text}");
    }
    assert_eq!((code, state("calibrate-scatter").as_deref()), (Some(1), Some("left-out")), "{text}");
    assert_eq!(std::fs::metadata(out.join("pictures.json")).unwrap().modified().unwrap(), pictures);
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    for part in ["Frame times by image size", "Frames held", "in a session"] {
        assert!(page.contains(part), "{part}");
    }
}
