//! `entire steer` and `entire demo` as processes: their files, output and refused input.

use crate::ball;
use crate::support::{entire_in, fails, files_in, json, refuses, stderr, stdout, succeeds, unread, words};
use std::collections::BTreeSet;
use std::path::Path;

fn setting() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    ball::write(&dir.path().join("ball.nrrd"));
    dir
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
    let summary = json(&out.join("summary.json"));
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
    let dir = setting();
    let steer = "steer ball.nrrd --target 1ms --device cpu --size 40x32 --scenes 4";
    let line = format!("{steer} --generate switches --frames 12 --save-path path.json --out out");
    let text = succeeds(dir.path(), &words(&line));
    assert!(text.contains("Algorithm 1") && text.contains("report.html"), "{text}");
    check_report(&dir.path().join("out"), 7, 12);

    // The saved path plays again, under other controllers.
    let line = format!("{steer} --path path.json --controllers vtk-gpu,unreal,hybrid --out again");
    succeeds(dir.path(), &words(&line));
    let again = dir.path().join("again");
    check_report(&again, 3, 12);
    let csv = std::fs::read_to_string(again.join("frames.csv")).unwrap();
    let names: BTreeSet<&str> = csv.lines().skip(1).map(|l| l.split(',').nth(1).unwrap()).collect();
    assert_eq!(names, BTreeSet::from(["hybrid", "unreal", "vtk-gpu"]));
}

#[test]
fn steer_chooses_image_sizes_and_logs_them() {
    let dir = setting();
    let (log, out) = (dir.path().join("log.csv"), dir.path().join("out"));
    // The target is shorter than any frame on any machine, so that the smallest pictures are chosen.
    let line = "steer ball.nrrd --generate orbit --frames 12 --target 1us --limits 1,4 --device cpu --size \
                121x97 --scenes 4 --controllers olp,hybrid --max-image-sample-distance 1.9 --table log.csv \
                --out out";
    succeeds(dir.path(), &words(line));
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
    // The timing table holds the drawn sizes, row by row.
    let table = std::fs::read_to_string(&log).unwrap();
    let columns: Vec<&str> = table.lines().next().unwrap().split(',').collect();
    let width = columns.iter().position(|c| c.starts_with("width")).unwrap();
    let widths: Vec<u32> =
        table.lines().skip(1).map(|l| l.split(',').nth(width).unwrap().parse().unwrap()).collect();
    assert!(widths.contains(&121) && widths.iter().any(|w| *w < 101), "{widths:?}");
    assert_eq!(widths, drawn);
    assert_eq!(widths.len(), 2 * 12);
    // The table's manifest states the options by which the volume was read.
    let manifest = json(&log.with_extension("manifest.json"));
    assert!(manifest["renderer"] == "cpu" && manifest["settings"]["reading"].is_object(), "{manifest}");
    assert!(manifest["files"].as_object().unwrap().contains_key("ball.nrrd"), "{manifest}");
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("Image sample distance"), "the report does not show the distances");
}

#[test]
fn a_demo_that_nobody_reads_writes_its_report() {
    let dir = setting();
    unread(dir.path(), "demo ball.nrrd --out out --frames 16 --scenes 4 --size 40x40 --device cpu");
    check_report(&dir.path().join("out"), 7, 16);
}

/// Checks that the demo calibrates its model with the volumes in data/, but not with the played volume.
#[test]
fn demo_calibrates_on_other_volumes_and_its_model_steers() {
    let dir = setting();
    let out = dir.path().join("out");
    std::fs::create_dir(dir.path().join("data")).unwrap();
    let ball = std::fs::read(dir.path().join("ball.nrrd")).unwrap();
    for (last, name) in ["a.nrrd", "b.nrrd", "c.nrrd"].iter().enumerate() {
        // These volumes differ in one voxel.
        let other = [&ball[..ball.len() - 1], &[last as u8 + 1]].concat();
        std::fs::write(dir.path().join("data").join(name), other).unwrap();
    }
    // A copy of the played volume and a link to it count as the played volume.
    std::fs::write(dir.path().join("data/copy.nrrd"), ball).unwrap();
    std::os::unix::fs::symlink(dir.path().join("ball.nrrd"), dir.path().join("data/same.nrrd")).unwrap();
    let run = |line: &str| {
        let home = [("XDG_DATA_HOME", dir.path().to_str().unwrap())];
        let output = entire_in(dir.path(), &home, &words(line));
        assert!(output.status.success(), "{}", stderr(&output));
        stdout(&output)
    };
    // The machine's model was calibrated on the played volume: steering uses it, the demo does not.
    run("calibrate ball.nrrd --seconds 5 --frames 24 --max-size 64 --device cpu");
    let line = "steer ball.nrrd --generate orbit --frames 8 --target 500fps --device cpu --size 40x40 \
                --scenes 4 --out seen";
    let text = run(line);
    assert!(text.contains("on which the model was calibrated"), "{text}");
    let seen = dir.path().join("seen");
    assert_eq!(json(&seen.join("summary.json"))["predictor"]["calibrated_on_this_volume"], true);
    let page = std::fs::read_to_string(seen.join("report.html")).unwrap();
    assert!(page.contains("on which the model was calibrated") && !page.contains("was not fitted"));

    let line = "demo ball.nrrd --out out --frames 16 --scenes 4 --seconds 12 --size 40x40 --device cpu";
    let text = run(line);
    for word in [
        "enlarged trilinearly x2",
        "target",
        "clock      wall",
        "frames of 3 other volumes",
        "to which the model was not fitted",
        "entire",
        "abrupt switch",
    ] {
        assert!(text.contains(word), "{word}: {text}");
    }
    check_report(&out, 7, 16);
    let steer = "steer ball.nrrd --enlarge 2 --path out/path.json --model out/model.safetensors --target \
                500fps --device cpu --size 40x40 --scenes 4 --out played";
    succeeds(dir.path(), &words(steer));
    let summary = std::fs::read_to_string(dir.path().join("played/summary.json")).unwrap();
    assert!(summary.contains("model.safetensors"), "{summary}");

    // Without other volumes, the demo has the machine's model alone.
    std::fs::remove_dir_all(dir.path().join("data")).unwrap();
    let text = run(&line.replace("--out out", "--out alone"));
    assert!(text.contains("on which the model was calibrated"), "{text}");
}

#[test]
fn bad_input_is_one_line_and_status_1() {
    let dir = setting();
    let bad = r#"{"format": "entire-path-1", "frames": 3, "keyframes": []}"#;
    std::fs::write(dir.path().join("bad.json"), bad).unwrap();
    let line = |more: &str| format!("steer ball.nrrd --device cpu --out out {more}");
    let told = |more: &str, parts: &[&str]| refuses(dir.path(), &words(&line(more)), parts);
    for (more, expected) in [
        ("--target 33", "--target: "),
        ("--target 33", "no known unit"),
        ("--target 0ms", "finite positive"),
        ("--target -1", "no known unit"),
        ("--target -5ms", "finite positive"),
        ("--target 9ms --scales 9:1,3:0.5", "ordered by frame"),
        ("--target 9ms --hold 3", "several volumes"),
        ("--target 9ms --scenes 3", "at least 4 scenes"),
        ("--target 9ms --controllers pid,pid", "twice"),
        ("--target 9ms --controllers pid --max-image-sample-distance 2", "for the controller hybrid"),
        ("--target 9ms --frames 2", "8 to 1000000 frames"),
        ("--target 9ms --clock device", "no device clock"),
        ("--target 9ms --model /no/such/model", "/no/such/model"),
    ] {
        told(&format!("--generate orbit {more}"), &[expected]);
    }
    let volume = std::fs::read(dir.path().join("ball.nrrd")).unwrap();
    told("--target 9ms --generate orbit --save-path ./ball.nrrd", &["is an input of this command"]);
    assert_eq!(std::fs::read(dir.path().join("ball.nrrd")).unwrap(), volume);
    // A table or path in the folder of the results must not have the name of a result.
    for more in ["--table out/frames.csv", "--table ./out/../out/summary.json", "--save-path out/report.html"]
    {
        let option = more.split(' ').next().unwrap();
        let own = "is written by this command itself; choose another name";
        told(&format!("--target 9ms --generate orbit {more}"), &[&format!("{option}: "), own]);
        assert_eq!(std::fs::read_dir(dir.path().join("out")).unwrap().count(), 0, "{more}");
    }
    // The results do not replace a timing table in their folder.
    let table = dir.path().join("out/frames.csv");
    drop(entire_io::dataset::Writer::create(&table).unwrap());
    let kept = std::fs::read(&table).unwrap();
    for line in
        ["steer ball.nrrd --device cpu --target 9ms --generate orbit --out out", "demo ball.nrrd --out out"]
    {
        fails(dir.path(), line, 1, &["frames.csv is a timing table"]);
        assert_eq!(std::fs::read(&table).unwrap(), kept, "{line}");
    }
    std::fs::remove_file(&table).unwrap();
    told("--target 9ms --path bad.json", &["bad.json is no path file: there is no keyframe"]);
    // The path is checked before the volumes are read.
    for (more, expected) in [
        ("--path bad.json", "bad.json is no path file: there is no keyframe"),
        ("--generate orbit --pictures 3,120", "--pictures names frame 120; the path has frames 0 to 119"),
        ("--generate orbit --frames 8 --scales 8:0.5", "--scales names frame 8; the path has frames 0 to 7"),
    ] {
        let line = format!("steer none.nrrd --target 9ms --out out {more}");
        fails(dir.path(), &line, 1, &[expected]);
    }
    for usage in [
        "--target 9ms",
        "--target 9ms --size 9 --generate orbit",
        "--target 9ms --path bad.json --save-path copy.json",
    ] {
        fails(dir.path(), &line(usage), 2, &[]);
    }
    let far = "--target 9ms --max-image-sample-distance 0.5 --generate orbit";
    fails(dir.path(), &line(far), 2, &["from 1 to 20"]);
    fails(dir.path(), &line("--target 9ms --generate orbit --limits 4,2"), 2, &["step limits"]);
    fails(dir.path(), "demo", 1, &["project's root"]);
}

#[test]
fn example_paths_are_paths() {
    let paths = files_in("examples/paths", ".json");
    assert!(paths.len() >= 2);
    for path in paths {
        entire_io::path::FlightPath::open(&path).unwrap();
    }
}
