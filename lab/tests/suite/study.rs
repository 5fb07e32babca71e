//! `entire-lab study` end to end on a small part of the committed timing tables.

use crate::{files, lab, lab_in, printed, read_json, repository};
use entire_io::dataset::feature_table::FeatureTable;
use entire_io::dataset::{MANIFEST_FORMAT, Manifest, Table, Writer};
use std::path::Path;
use std::process::Output;

/// Writes every n-th frame of a committed table, with its features, into a folder.
fn cut(name: &str, every: usize, folder: &Path) {
    let whole = Table::read(&repository().join("data/timings").join(name), 0).unwrap();
    let path = folder.join(name.strip_suffix(".gz").unwrap());
    let mut writer = Writer::create(&path).unwrap();
    let features = whole.features.as_ref().unwrap();
    let (mut numbers, mut values) = (Vec::new(), Vec::new());
    for f in whole.frames.iter().step_by(every) {
        writer.append(f.number, &f.scene, &f.repeats).unwrap();
        numbers.push(f.number);
        values.extend_from_slice(features.row(f.number).unwrap());
    }
    drop(writer);
    let hash = Table::read_without_features(&path, 0).unwrap().hash;
    FeatureTable::new(features.columns().to_vec(), &numbers, values, hash)
        .unwrap()
        .write(&FeatureTable::path_for(&path))
        .unwrap();
}

fn study(folder: &Path, more: &[&str]) -> (Output, String) {
    let common = ["study", "--quiet", "--threads", "1", "--study", "study.json", "--out", "out"];
    let output = lab_in(folder, &[&common[..], more].concat());
    let said = printed(&output.stdout);
    (output, said)
}

#[test]
fn a_small_study_goes_from_tables_to_bars() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    cut("none-train.csv.gz", 22, at);
    cut("none-members.csv.gz", 7, at);
    cut("none-scans.csv.gz", 3, at);
    let volume = repository().join("data/castro_blast/m01/t0015.nrrd");
    let description = serde_json::json!({
        "title": "Small",
        "latency_volume": [volume, 1],
        "sets": [{
            "name": "small",
            "training": ["none-train.csv"],
            "splits": [
                { "name": "member", "tables": ["none-members.csv"], "main": true },
                { "name": "modality", "tables": ["none-scans.csv"] }
            ],
            "calibration_split": "modality",
            "limits": { "rmse_over_sd": 100, "proxy_over_paper": 3, "modality": true }
        }],
        "predictors": [
            { "name": "analytic", "recipe": { "kind": "analytic" } },
            { "name": "factor", "recipe": {
                "kind": "residual", "layers": [6], "epochs": 8, "batch": 32, "learning_rate": 0.003 } }
        ],
        "ship": [{ "predictor": "selected" }]
    });
    std::fs::write(at.join("study.json"), description.to_string()).unwrap();

    let (output, text) = study(at, &["--bars"]);
    // One bar is about a predictor and tables that the study lacks. This bar is missed (`short`), so the
    // command fails.
    assert_eq!(output.status.code(), Some(1), "{text}");
    let bars: Vec<Vec<&str>> =
        text.lines().filter(|l| l.starts_with("bar ")).map(|l| l.split(' ').collect()).collect();
    assert_eq!(bars.len(), 9, "{text}");
    assert!(bars.iter().all(|b| b.len() == 5));
    let bar = |name: &str| bars.iter().find(|b| b[1] == name).unwrap_or_else(|| panic!("{name}: {text}"));
    assert_eq!(bar("small/member/paper-rmse-over-lvrp")[2..], ["-", "0.3333", "short"]);
    assert_eq!(bar("small/member/best-rmse-over-sd")[4], "ok");
    for b in bars.iter().filter(|b| b[1] != "small/member/paper-rmse-over-lvrp") {
        let (value, limit): (f64, f64) = (b[2].parse().unwrap(), b[3].parse().unwrap());
        assert_eq!(b[4] == "ok", value <= limit, "{b:?}");
    }
    // The selected predictor is far better than a constant, whose RMSE/SD is about 1.
    assert!(bar("small/member/best-rmse-over-sd")[2].parse::<f64>().unwrap() < 0.5, "{text}");

    let found = &read_json(&at.join("out/study.json"))["findings"];
    assert_eq!(found["left_out"].as_array().unwrap().len(), 0, "{}", found["left_out"]);
    let calibrated: Vec<&str> =
        found["calibrated"].as_array().unwrap().iter().map(|c| c["predictor"].as_str().unwrap()).collect();
    // A model with a learned factor is no prior of a calibration.
    assert_eq!(calibrated, ["analytic"]);
    let report = std::fs::read_to_string(at.join("out/report.html")).unwrap();
    assert!(report.contains("small/member/paper-rmse-over-lvrp") && report.contains("<svg"));

    // A second run leaves every byte of the stored models unchanged, and without --bars a miss is no error.
    let before = files(&at.join("out/models"));
    assert!(!before.is_empty());
    let (output, _) = study(at, &[]);
    assert_eq!(output.status.code(), Some(0));
    assert_eq!(files(&at.join("out/models")), before);

    // The models that the rule selects are shipped.
    let (output, text) = study(at, &["--ship", "models"]);
    assert_eq!(output.status.code(), Some(0), "{text}");
    let card = std::fs::read_to_string(at.join("models/small-selected.md")).unwrap();
    let selected = text.lines().find_map(|l| l.strip_prefix("small: the rule selects ")).unwrap();
    assert!(card.contains(&format!("The rule selects `{selected}`")), "{card}");

    // If a table has changed after its features were stored, these features are refused.
    std::fs::copy(at.join("none-members.csv"), at.join("none-train.csv")).unwrap();
    let (output, _) = study(at, &[]);
    let said = printed(&output.stderr);
    assert!(output.status.code() == Some(1) && said.contains("`entire features`"), "{said}");
}

#[test]
fn a_table_without_frames_is_named_and_no_result_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let (empty, out) = (folder.path().join("empty.csv"), folder.path().join("out"));
    drop(Writer::create(&empty).unwrap());
    let (format, machine) = (MANIFEST_FORMAT.into(), "AMD EPYC".into());
    Manifest { format, machine, ..Manifest::default() }.write(&empty).unwrap();
    let (empty, out) = (empty.to_str().unwrap(), out.to_str().unwrap());
    let (judged, prior) = ("data/timings/none-members.csv.gz", "models/unshaded-selected.safetensors");
    let other = "data/timings/none-xeon-train.csv.gz";
    let arguments =
        ["--data", empty, other, "--judged", judged, judged, "--priors", prior, prior, "--out", out];
    let output = lab(&[&["frames"][..], &arguments].concat());
    let said = printed(&output.stderr);
    assert!(output.status.code() == Some(1) && said.contains("empty.csv holds no frame"), "{said}");
    assert!(files(Path::new(out)).is_empty());
}
