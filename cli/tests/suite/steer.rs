//! `entire steer` and `entire demo` as processes: their files, output and refused input.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::ball;

fn entire(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_entire")).args(arguments).output().unwrap()
}

fn setting() -> (tempfile::TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let volume = dir.path().join("ball.nrrd");
    ball::write(&volume);
    let out = dir.path().join("out");
    (dir, volume, out)
}

fn check_report(out: &Path, controllers: usize, frames: usize) {
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    // The bytes of pictures are left out, since they may contain any letters.
    let html: String = page
        .split("base64,")
        .enumerate()
        .map(|(i, part)| if i == 0 { part } else { &part[part.find('"').unwrap()..] })
        .collect::<Vec<_>>()
        .join("base64,");
    for word in ["http:", "https:", "src=\"//", "url(", "@import", "<script", "<link", "NaN"] {
        assert!(!html.contains(word), "the report holds {word}");
    }
    for word in
        ["<svg", "data:image/png;base64,", "switch 1", ">entire<", "Load average", "logical processor"]
    {
        assert!(html.contains(word), "the report lacks {word}");
    }
    let csv = std::fs::read_to_string(out.join("frames.csv")).unwrap();
    assert_eq!(csv.lines().count(), 1 + controllers * frames);
    let summary: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(out.join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["frames"], frames);
    let figures = summary["controllers"].as_object().unwrap();
    assert_eq!(figures.len(), controllers);
    for (name, m) in figures {
        assert_eq!(m["recovery_frames"].as_array().unwrap().len(), 3, "{name}");
        assert!(m["p95_seconds"].as_f64().unwrap() > 0.0 && m["mean_psnr"].as_f64().unwrap() > 0.0);
    }
    assert_eq!(summary["switches"].as_array().unwrap().len(), 3);
}

#[test]
fn steer_plays_a_path_and_writes_a_report_that_stands_alone() {
    let (dir, volume, out) = setting();
    let saved = dir.path().join("path.json");
    let (volume, out_text, saved_text) =
        (volume.to_str().unwrap(), out.to_str().unwrap(), saved.to_str().unwrap());
    let common = ["--target", "1ms", "--device", "cpu", "--size", "40x32", "--scenes", "4"];
    let generated = ["steer", volume, "--generate", "switches", "--frames", "12", "--save-path", saved_text];
    let output = entire(&[&generated[..], &common[..], &["--out", out_text]].concat());
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(text.contains("Algorithm 1") && text.contains("report.html"), "{text}");
    check_report(&out, 5, 12);

    // The saved path plays again, under other controllers.
    let again = dir.path().join("again");
    let other = ["steer", volume, "--path", saved_text, "--controllers", "vtk-gpu,unreal,hybrid"];
    let output = entire(&[&other[..], &common[..], &["--out", again.to_str().unwrap()]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    check_report(&again, 3, 12);
    let csv = std::fs::read_to_string(again.join("frames.csv")).unwrap();
    let names: BTreeSet<&str> = csv.lines().skip(1).map(|l| l.split(',').nth(1).unwrap()).collect();
    assert_eq!(names, BTreeSet::from(["hybrid", "unreal", "vtk-gpu"]));
}

#[test]
fn steer_chooses_image_sizes_and_logs_them() {
    let (dir, volume, out) = setting();
    let log = dir.path().join("log.csv");
    let (volume, out_text, log_text) =
        (volume.to_str().unwrap(), out.to_str().unwrap(), log.to_str().unwrap());
    // The target is shorter than any frame on any machine, so that the smallest pictures are chosen.
    let output = entire(&[
        "steer",
        volume,
        "--generate",
        "orbit",
        "--frames",
        "12",
        "--target",
        "1us",
        "--limits",
        "1,4",
        "--device",
        "cpu",
        "--size",
        "121x97",
        "--scenes",
        "4",
        "--controllers",
        "olp,hybrid",
        "--max-image-sample-distance",
        "1.9",
        "--table",
        log_text,
        "--out",
        out_text,
    ]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let frames = std::fs::read_to_string(out.join("frames.csv")).unwrap();
    let at = |name: &str| frames.lines().next().unwrap().split(',').position(|c| c == name).unwrap();
    let (who, distance) = (at("controller"), at("image_sample_distance"));
    let mut chosen = BTreeSet::new();
    let mut drawn = Vec::new();
    for row in frames.lines().skip(1).map(|l| l.split(',').collect::<Vec<_>>()) {
        assert!(row[who] == "hybrid" || row[distance] == "1", "{row:?}");
        chosen.insert(row[distance].to_owned());
        // The width is rounded down, as for a plan.
        drawn.push((121.0 / row[distance].parse::<f64>().unwrap()) as u32);
    }
    assert!(
        chosen.len() > 1 && chosen.iter().all(|s| (1.0..=1.9).contains(&s.parse::<f32>().unwrap())),
        "{chosen:?}"
    );
    // The log holds the drawn sizes, row by row.
    let table = std::fs::read_to_string(&log).unwrap();
    let columns: Vec<&str> = table.lines().next().unwrap().split(',').collect();
    let width = columns.iter().position(|c| c.starts_with("width")).unwrap();
    let widths: Vec<u32> =
        table.lines().skip(1).map(|l| l.split(',').nth(width).unwrap().parse().unwrap()).collect();
    assert!(widths.contains(&121) && widths.iter().any(|w| *w < 101), "{widths:?}");
    assert_eq!(widths, drawn);
    assert_eq!(widths.len(), 2 * 12);
    // Its manifest says how the volume was read.
    let manifest = std::fs::read(log.with_extension("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    assert!(manifest["renderer"] == "cpu" && manifest["settings"]["reading"].is_object(), "{manifest}");
    assert!(manifest["files"].as_object().unwrap().contains_key(volume), "{manifest}");
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("Image sample distance"), "the report does not show the distances");
}

/// Checks that the machine's model is calibrated with the volumes in data/, but not with the played volume.
#[test]
fn demo_calibrates_on_other_volumes_and_its_model_steers() {
    let (dir, volume, out) = setting();
    std::fs::create_dir(dir.path().join("data")).unwrap();
    for name in ["a.nrrd", "b.nrrd", "c.nrrd"] {
        ball::write(&dir.path().join("data").join(name));
    }
    // A copy of the volume counts as another volume; a link to the volume does not.
    std::os::unix::fs::symlink(&volume, dir.path().join("data/same.nrrd")).unwrap();
    let (volume, out_text) = (volume.to_str().unwrap(), out.to_str().unwrap());
    let small = ["--frames", "16", "--scenes", "4", "--seconds", "12", "--size", "40x40", "--device", "cpu"];
    let output = Command::new(env!("CARGO_BIN_EXE_entire"))
        .args([&["demo", volume, "--out", out_text][..], &small[..]].concat())
        .current_dir(dir.path())
        .env("XDG_DATA_HOME", dir.path())
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    for word in [
        "enlarged trilinearly x2",
        "target",
        "clock      wall",
        "frames of 3 other volumes",
        "which it was not fitted to",
        "entire",
        "abrupt switch",
    ] {
        assert!(text.contains(word), "{word}: {text}");
    }
    check_report(&out, 5, 16);

    let (model, path) = (out.join("model.safetensors"), out.join("path.json"));
    let played = dir.path().join("played");
    let output = entire(&[
        "steer",
        volume,
        "--enlarge",
        "2",
        "--path",
        path.to_str().unwrap(),
        "--model",
        model.to_str().unwrap(),
        "--target",
        "500fps",
        "--device",
        "cpu",
        "--size",
        "40x40",
        "--scenes",
        "4",
        "--out",
        played.to_str().unwrap(),
    ]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let summary = std::fs::read_to_string(played.join("summary.json")).unwrap();
    assert!(summary.contains("model.safetensors"), "{summary}");
}

#[test]
fn bad_input_is_one_line_and_status_1() {
    let (dir, volume, out) = setting();
    let (volume, out) = (volume.to_str().unwrap(), out.to_str().unwrap());
    let bad_path = dir.path().join("bad.json");
    std::fs::write(&bad_path, "{\"format\": \"entire-path-1\", \"frames\": 3, \"keyframes\": []}").unwrap();
    let bad = bad_path.to_str().unwrap();
    let generate = ["--generate", "orbit"];
    let with = |more: &[&str], path: &[&str]| {
        let base = ["steer", volume, "--device", "cpu", "--out", out];
        let output = entire(&[&base[..], path, more].concat());
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!text.contains("panicked"), "{text}");
        (output.status.code(), text)
    };
    for (more, expected) in [
        (&["--target", "33"][..], "--target: "),
        (&["--target", "33"], "no known unit"),
        (&["--target", "0ms"], "finite positive"),
        (&["--target", "-1"], "no known unit"),
        (&["--target", "-5ms"], "finite positive"),
        (&["--target", "9ms", "--retarget", "5"], "FRAME:TIME"),
        (&["--target", "9ms", "--retarget", "5:8"], "--retarget \"5:8\""),
        (&["--target", "9ms", "--retarget", "9:8ms,3:9ms"], "ordered by frame"),
        (&["--target", "9ms", "--scales", "9:1,3:0.5"], "ordered by frame"),
        (&["--target", "9ms", "--hold", "3"], "several volumes"),
        (&["--target", "9ms", "--limits", "4,2"], "step limits"),
        (&["--target", "9ms", "--scenes", "3"], "at least 4 scenes"),
        (&["--target", "9ms", "--controllers", "pid,pid"], "twice"),
        (&["--target", "9ms", "--frames", "2"], "8 to 1000000 frames"),
        (&["--target", "9ms", "--clock", "device"], "no device clock"),
        (&["--target", "9ms", "--model", "/no/such/model"], "/no/such/model"),
    ] {
        let (code, text) = with(more, &generate);
        assert_eq!(code, Some(1), "{more:?}: {text}");
        assert!(text.contains(expected) && text.trim_end().lines().count() == 1, "{more:?}: {text}");
    }
    let (code, text) = with(&["--target", "9ms"], &["--path", bad]);
    assert!(code == Some(1) && text.contains("bad.json is no path: there is no keyframe"), "{text}");
    for usage in [&["--target", "9ms"][..], &["--target", "9ms", "--size", "9", "--generate", "orbit"]] {
        assert_eq!(with(usage, &[]).0, Some(2), "{usage:?}");
    }
    let (code, text) = with(&["--target", "9ms", "--max-image-sample-distance", "0.5"], &generate);
    assert!(code == Some(2) && text.contains("from 1 to 20"), "{text}");
    let output =
        Command::new(env!("CARGO_BIN_EXE_entire")).arg("demo").current_dir(dir.path()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && text.contains("project's root"), "{text}");
}

#[test]
fn example_paths_are_paths() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/paths");
    let mut seen = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "json") {
            entire_io::path::FlightPath::open(&path).unwrap();
            seen += 1;
        }
    }
    assert!(seen >= 2);
}
