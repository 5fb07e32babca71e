//! `entire-lab gpu-study` as a process, on a Vulkan driver or else on the CPU version of the raycaster:
//! pictures of all shading modes are compared, steps for which no time is left are skipped and named,
//! finished steps are kept, and a second run of the command continues.

use entire_vk_raycaster::{Renderer, VulkanOptions, VulkanRaycaster};
use libtest_mimic::{Arguments, Failed, Trial};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Returns the path of the command `entire` if it was built beside this package's program.
fn entire() -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_BIN_EXE_entire-lab")).with_file_name("entire");
    path.is_file().then_some(path)
}

/// Options for renderer and clock: the Vulkan device with its time stamps (the study's defaults), or with
/// wall time if the device has no time stamps. Without a device: the CPU version with wall time.
fn setting() -> [&'static str; 4] {
    match VulkanOptions::from_env().and_then(VulkanRaycaster::new) {
        Ok(renderer) => {
            println!("on {}", renderer.device());
            let stamps = renderer.limits().is_some_and(|l| l.timestamps.is_some());
            ["--device", "vulkan", "--clock", if stamps { "device" } else { "wall" }]
        }
        Err(error) => {
            println!("no Vulkan device, on the CPU version: {error}");
            ["--device", "cpu", "--clock", "wall"]
        }
    }
}

fn a_short_study_ends_in_time_and_goes_on_where_it_ended() -> Result<(), Failed> {
    let dir = tempfile::tempdir().unwrap();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let out = dir.path().join("out");
    let setting = setting();
    let study = |seconds: &str, more: &[&str]| {
        let run = Command::new(env!("CARGO_BIN_EXE_entire-lab"))
            .current_dir(&root)
            .args(["gpu-study", "--short", "--seconds", seconds, "--out"])
            .arg(&out)
            .args(setting)
            .args(more)
            .output()
            .unwrap();
        (
            run.status.code(),
            String::from_utf8_lossy(&run.stdout).into_owned() + &String::from_utf8_lossy(&run.stderr),
        )
    };
    let json = |name: &str| -> serde_json::Value {
        serde_json::from_str(&std::fs::read_to_string(out.join(name)).unwrap()).unwrap()
    };
    let state = |name: &str| {
        let steps = json("steps.json");
        let found = steps.as_array().unwrap().iter().find(|s| s["step"] == name).map(|s| s["state"].clone());
        found.map(|s| s.as_str().unwrap().to_owned())
    };
    let ended = |name: &str, text: &str| {
        assert!(matches!(state(name).as_deref(), Some("done" | "cut-short")), "{name}: {text}");
    };
    // With far too little time, skipped steps are named, and there is a report.
    let (code, text) = study("1", &[]);
    assert_eq!(code, Some(1), "{text}");
    assert_eq!(state("pictures").as_deref(), Some("done"), "{text}");
    assert_eq!(state("calibrate-scatter").as_deref(), Some("left-out"), "{text}");
    assert!(text.contains("bar gpu-study-steps-missing") && text.contains("short"), "{text}");
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("left out") && page.contains("Pictures"), "{page}");
    // Every mode's pictures agree with the CPU version's.
    let bar = text.lines().find(|l| l.starts_with("bar gpu-study-picture-difference-of-255"));
    assert!(bar.is_some_and(|l| l.ends_with(" ok")), "{text}");
    let pictures = json("pictures.json");
    let modes: BTreeSet<&str> =
        pictures.as_array().unwrap().iter().filter_map(|p| p["shading"].as_str()).collect();
    assert_eq!(modes, BTreeSet::from(["none", "local", "scatter", "local-scatter"]));
    let drawn = || std::fs::metadata(out.join("pictures.json")).unwrap().modified().unwrap();
    let first = drawn();
    // With enough time the selected mode is finished. The steps of other modes stay as they were.
    let (code, text) = study("600", &["--shade", "none"]);
    for step in ["calibrate-none", "frames-none", "evaluate-frames-none", "switches"] {
        ended(step, &text);
    }
    assert_eq!((code, state("calibrate-scatter").as_deref()), (Some(1), Some("left-out")), "{text}");
    // The same command continues with the other modes.
    let (_, text) = study("600", &[]);
    for mode in ["none", "local", "scatter"] {
        for step in ["calibrate", "frames", "evaluate-frames"] {
            ended(&format!("{step}-{mode}"), &text);
        }
    }
    ended("probe", &text);
    assert_eq!(json("probe.json")["backend"], setting[1], "{text}");
    assert_eq!(drawn(), first);
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    for part in ["Frame times by image size", "Frames held", "in a session"] {
        assert!(page.contains(part), "{part}");
    }
    Ok(())
}

// The test is ignored, not passed, if the command does not exist.
fn main() {
    let arguments = Arguments::from_args();
    let missing = entire().is_none();
    if missing {
        eprintln!("ignored: the command entire is not built beside entire-lab (cargo build --workspace)");
    }
    let trial = Trial::test(
        "a_short_study_ends_in_time_and_goes_on_where_it_ended",
        a_short_study_ends_in_time_and_goes_on_where_it_ended,
    );
    libtest_mimic::run(&arguments, vec![trial.with_ignored_flag(missing)]).exit();
}
