//! `entire-lab paper` end to end on the project's own volumes, with the smallest settings.

use crate::{files, lab, lab_in, printed, read_json, repository};
use serde_json::{Value, json};
use std::path::Path;
use std::process::Output;

/// The committed description, reduced to two data sets, a few small frames and tiny networks.
fn description(to: &Path) {
    let mut d = read_json(&repository().join("data/timings/paper.json"));
    let absolute = |p: &str| json!(repository().join(p));
    d["frames"] = json!({ "training": 8, "held_out": 4, "varied": 3 });
    d["repeats"] = json!(1);
    d["warm_up"] = json!(0);
    d["enlarge"] = json!(1);
    d["proxy"] = json!(12);
    d["scenes"]["min_size"] = json!(16);
    d["scenes"]["max_size"] = json!(32);
    d["data_sets"] = json!([
        { "name": "castro_blast", "title": "Castro", "modes": ["none"], "members": { "test": ["m05"] } },
        { "name": "nyx_cosmology", "title": "Nyx", "modes": ["none"], "only_tests": true }
    ]);
    d["yt"]["script"] = absolute("examples/yt/collect_yt.py");
    d["encoders"]["script"] = absolute("lab/volumenet/train_volumenet.py");
    d["encoders"]["shipped"] = json!([absolute("models/volumenet-128f2.safetensors")]);
    d["runs"] = json!(2);
    d["network"]["preset"] = json!("0C32");
    d["network"]["epochs"] = json!(2);
    let ours = json!({ "kind": "residual", "layers": [4], "epochs": 2, "batch": 8, "probe_side": 5 });
    d["ours"] = json!({ "none": ours });
    d["shares"] = json!([0.5]);
    d["depths"] = json!(["0C32", "1C32"]);
    let table = |part: &str| absolute(&format!("data/timings/paraview-{part}.csv.gz"));
    let renderers = json!([["ParaView", table("train"), table("test")]]);
    // Both entries are the table that this test collects: the first one under another machine's name.
    let (own, other) = ("out/tables/castro_blast-none.csv", "elsewhere.csv");
    let machines = json!([["elsewhere", other, other], ["here", own, own]]);
    d["tuning"] =
        json!({ "mode": "none", "frames": [4], "epochs": 2, "renderers": renderers, "machines": machines });
    d["orbit"] = json!({ "volumes": 2, "poses": 4, "size": 16 });
    let table = |name: &str| absolute(&format!("data/timings/{name}.csv.gz"));
    let (training, test) = (table("none-train"), table("none-members"));
    // The study takes its labels from a table of times that a teacher model predicted. This test uses measured
    // times instead, since the features of these frames are stored.
    d["trials"] = json!({
        "tables": [{
            "mode": "none",
            "training": training,
            "test": test,
            "low": { "training": [table("none-train-64")], "test": [table("none-members-64")] },
            "lower": {
                "training": [table("none-train-24"), table("none-train-18")],
                "test": [table("none-members-24"), table("none-members-18")],
            },
            "distilled": absolute("models/unshaded-distilled.safetensors"),
            "teacher": absolute("models/unshaded-selected.safetensors"),
        }],
        "labels": training,
        "frames": [[2, 2], [4, 1]],
        "label_runs": 1,
        "runs": 2,
        "epochs": 1,
        "changes": [{ "name": "lobes sorted", "sorted_lobes": true }],
    });
    d["also"] = json!([]);
    d.as_object_mut().unwrap().remove("contradicted");
    let own = json!([["castro_blast", "none"]]);
    let names = ["ablation", "varied", "samples", "depth", "encoders", "final", "steering"];
    d["panels"] =
        names.map(|n| (n.to_owned(), own.clone())).into_iter().collect::<serde_json::Map<_, _>>().into();
    for label in d["labels"].as_array_mut().unwrap() {
        if label.get("picture").is_some() {
            label["picture"] = absolute("docs/src/images/explore.png");
        }
    }
    std::fs::write(to, d.to_string()).unwrap();
}

fn paper(folder: &Path, step: &str, more: &[&str]) -> (Output, String) {
    let data = repository().join("data");
    let mut arguments = vec!["paper", step, "--description", "paper.json"];
    if step != "report" {
        arguments.extend(["--threads", "2", "--device", "cpu", "--data", data.to_str().unwrap()]);
    }
    if !more.contains(&"--out") {
        arguments.extend(["--out", "out"]);
    }
    arguments.extend(more);
    let output = lab_in(folder, &arguments);
    let said = printed(&output.stderr);
    (output, said)
}

fn lines(path: &Path) -> usize {
    std::fs::read_to_string(path).unwrap().lines().count()
}

#[test]
fn the_paper_goes_from_volumes_to_rows_and_on_where_it_was_stopped() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    description(&at.join("paper.json"));

    // The command is stopped at once: results are kept, and the message says how to continue.
    let (output, said) = paper(at, "collect", &["--budget", "0.00001"]);
    assert!(!output.status.success() && said.contains("the same command goes on"), "{said}");
    let table = at.join("out/tables/castro_blast-none.csv");
    let begun = lines(&table);
    assert!(begun < 1 + 5 * 8, "{begun}");
    // The last row is cut off, as a killed process would leave it.
    let mut text = std::fs::read_to_string(&table).unwrap();
    text.push_str("3,0,castro");
    std::fs::write(&table, text).unwrap();
    let (output, said) = paper(at, "collect", &[]);
    assert!(output.status.success(), "{said}");
    // Each of the five volumes has eight frames if it is a training volume in some split, else four.
    let rows = lines(&table) - 1;
    assert!((5 * 4..=5 * 8).contains(&rows) && rows.is_multiple_of(4), "{rows}");
    assert_eq!(lines(&at.join("out/tables/castro_blast-none-low.csv")) - 1, 5 * 4);
    // Two held-out volumes, three experiments of three frames, two orbits of two volumes.
    assert_eq!(lines(&at.join("out/tables/castro_blast-none-varied.csv")) - 1, 2 + 3 * 3 + 2 * 2 * 4);
    assert_eq!(lines(&at.join("out/tables/nyx_cosmology-none.csv")) - 1, 4 * 4);
    let before = std::fs::read(&table).unwrap();
    assert!(paper(at, "collect", &[]).0.status.success());
    assert_eq!(std::fs::read(&table).unwrap(), before);

    // A report without results names every label as not measured.
    let (output, _) = paper(at, "report", &["--bars"]);
    assert_eq!(output.status.code(), Some(1));
    let bars = printed(&output.stdout);
    assert!(bars.contains("bar paper/castro_blast/network-over-constant - 0.2500 short"), "{bars}");

    std::fs::copy(&table, at.join("elsewhere.csv")).unwrap();
    let mut manifest = read_json(&at.join("out/tables/castro_blast-none.manifest.json"));
    manifest["machine"] = json!("another");
    std::fs::write(at.join("elsewhere.manifest.json"), manifest.to_string()).unwrap();

    // The volumes of ParaView's table are not in the repository, so the table is left out.
    let (output, said) = paper(at, "train", &[]);
    assert!(output.status.success() && said.contains("note: ParaView is left out: "), "{said}");
    assert!(said.contains("note: here is left out: its frames are of the machine"), "{said}");
    let results = files(&at.join("out/results"));
    for panel in ["overall", "ablation", "varied", "samples", "depth", "balancing", "pictures"] {
        let name = at.join(format!("out/results/{panel}-castro_blast-none.json"));
        assert!(results.contains_key(&name), "{panel}: {:?} {said}", results.keys());
    }
    let of = |name: &str| -> Value {
        serde_json::from_slice(&results[&at.join("out/results").join(name)]).unwrap()
    };
    let overall = of("overall-castro_blast-none.json");
    let rows = overall["rows"].as_array().unwrap();
    for split in ["volumes", "members", "modality: Nyx"] {
        let named: Vec<&str> =
            rows.iter().filter(|r| r["split"] == split).map(|r| r["name"].as_str().unwrap()).collect();
        assert_eq!(named.len(), 4, "{split}: {named:?}");
    }
    for row in rows {
        let (rmse, over) = (row["rmse"].as_f64().unwrap(), row["over_constant"].as_f64().unwrap());
        let constant = rows
            .iter()
            .find(|r| r["split"] == row["split"] && r["name"].as_str().unwrap().starts_with("mean of"))
            .unwrap();
        // The proxy is tested on the frames that were rendered at low resolution, four of each volume.
        if row["frames"] == constant["frames"] {
            assert!((over - rmse / constant["rmse"].as_f64().unwrap()).abs() < 1e-9, "{row}");
        } else {
            assert!(row["name"] == "LVRP" && row["frames"] == 4, "{row}");
        }
    }
    // All measured frames of a test volume are tested. The test volume of the split by member has eight: it
    // is a training volume in the other split.
    let tested = rows.iter().find(|r| r["split"] == "members").unwrap();
    assert_eq!(
        (&tested["frames"], &tested["by_volume"]["castro_blast/m05/t0012.nrrd"]["frames"]),
        (&json!(8), &json!(8))
    );
    for (set, name) in [("all", "Nyx"), ("machines", "elsewhere")] {
        let tuned = of(&format!("tuning-{set}-none.json"));
        let names = tuned["facts"].as_array().unwrap().iter().map(|f| f["name"].as_str().unwrap());
        assert_eq!(names.collect::<Vec<_>>(), [name]);
        let curves = tuned["curves"].as_array().unwrap().iter().filter(|c| c["x"] == "frames learned from");
        assert_eq!(curves.count(), 3, "{set}");
    }
    assert_eq!(of("ablation-castro_blast-none.json")["rows"].as_array().unwrap().len(), 2 + 1 + 4);
    let balanced = of("balancing-castro_blast-none.json");
    let uniform = balanced["facts"].as_array().unwrap().iter().filter(|f| f["name"] == "GT");
    assert!(uniform.clone().count() > 0 && uniform.into_iter().all(|f| f["values"]["slowest"] == 1.0));

    // Nothing is computed twice.
    let models = files(&at.join("out/models"));
    let (output, said) = paper(at, "train", &["--only", "overall,ablation,varied,samples,depth,tuning"]);
    assert!(output.status.success(), "{said}");
    assert_eq!(files(&at.join("out/models")), models);
    assert_eq!(files(&at.join("out/results")), results);

    // Use case 1 needs recorded paths, which are in the repository and name volumes relative to it.
    assert!(!results.contains_key(&at.join("out/results/steering-castro_blast-none.json")));
    std::os::unix::fs::symlink(repository().join("data"), at.join("data")).unwrap();
    let (output, said) = paper(at, "train", &["--only", "steering"]);
    assert!(output.status.success(), "{said}");
    let steering = read_json(&at.join("out/results/steering-castro_blast-none.json"));
    // Two paths show volumes of the data set. Twelve controllers play them with the paper's network, two of
    // these also with the fine-tuned network, and ours plays them also with its own predictor.
    assert_eq!(steering["frames"]["paths"][2], 2);
    let facts = steering["facts"].as_array().unwrap();
    assert_eq!(facts.len(), 15);
    let distance = |name: &str| {
        facts.iter().find(|f| f["name"] == name).unwrap()["values"]["all deviation"].as_f64().unwrap()
    };
    assert_ne!(distance("algorithm1"), distance("algorithm1, fine-tuned"));
    assert!(facts.iter().any(|f| f["name"] == "ours" && f["values"]["all deviation"].is_f64()));
    let curves = steering["curves"].as_array().unwrap();
    for (chart, lines) in [("frame time", 5), ("ray step", 5), ("quality", 5)] {
        let found: Vec<&Value> = curves.iter().filter(|c| c["chart"] == chart).collect();
        assert_eq!(found.len(), lines, "{chart}");
        assert!(found.iter().all(|c| c["points"].as_array().unwrap().len() == 96), "{chart}");
    }
    for picture in steering["pictures"].as_array().unwrap() {
        let png = std::fs::read(at.join("out/pictures").join(picture[0].as_str().unwrap())).unwrap();
        assert!(png.starts_with(b"\x89PNG"));
    }
    assert_eq!(steering["pictures"].as_array().unwrap().len(), 3);

    // The report has an entry with a command for every label of a table or figure of the paper, and marks the
    // entries that are not measured.
    let (output, said) = paper(at, "report", &["--bars", "--keep", "kept.json.gz"]);
    let bars = printed(&output.stdout);
    assert!(bars.contains("bar paper/castro_blast/none/ours-over-network"), "{bars} {said}");
    let rows = read_json(&at.join("out/rows.json"));
    let rows = rows.as_array().unwrap();
    let missing: Vec<&str> =
        rows.iter().filter(|r| r["there"] == false).map(|r| r["label"].as_str().unwrap()).collect();
    // No encoder was trained here.
    let expected =
        ["tab:feature_select_1", "tab:feature_select_2", "fig:volunenet_reconstruction", "tab:final_select"];
    assert_eq!(missing, expected);
    assert!(bars.contains(&format!("labels-without-a-table-or-figure {}.0000", missing.len())), "{bars}");
    assert!(rows.iter().all(|r| !r["command"].as_str().unwrap().is_empty()));
    let html = std::fs::read_to_string(at.join("out/report.html")).unwrap();
    assert!(html.contains("Not measured.") && html.contains("tab:prednet_select_1") && html.contains("<svg"));

    // The kept results give the same rows without the folder.
    let (output, said) = paper(at, "report", &["--out", "elsewhere", "--kept", "kept.json.gz"]);
    assert!(output.status.success(), "{said}");
    let again = read_json(&at.join("elsewhere/rows.json"));
    let ours = |rows: &[Value], label: &str| {
        rows.iter().find(|r| r["label"] == label).map(|r| r["ours"].clone()).unwrap()
    };
    let labels = rows.iter().filter(|r| r["there"] == true).map(|r| r["label"].as_str().unwrap());
    for label in labels {
        assert_eq!(ours(rows, label), ours(again.as_array().unwrap(), label));
    }
}

#[test]
fn trials_are_judged_by_volume_and_made_once() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    description(&at.join("paper.json"));
    let train = || {
        let (output, said) = paper(at, "train", &["--only", "procedure,frames,improved"]);
        assert!(output.status.success(), "{said}");
    };
    train();
    let results = files(&at.join("out/results"));
    let of = |panel: &str| -> Value {
        serde_json::from_slice(&results[&at.join(format!("out/results/{panel}-all-none.json"))]).unwrap()
    };
    let procedure = of("procedure");
    let rows = procedure["rows"].as_array().unwrap();
    let of_all: Vec<&Value> = rows.iter().filter(|r| r["split"] == "left-out members").collect();
    let names: Vec<&str> = of_all.iter().map(|r| r["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["mean of 15 % (Bruder et al.)", "LVRP", "as it is", "lobes sorted"]);
    for row in of_all {
        let volumes = row["by_volume"].as_object().unwrap();
        let frames = volumes.values().map(|v| v["frames"].as_u64().unwrap()).sum::<u64>();
        assert_eq!((volumes.len(), frames), (77, 770));
    }
    // Lobes in another order are other inputs, so the error differs.
    assert_ne!(rows[2]["rmse"], rows[3]["rmse"]);
    let frames = of("frames");
    let learned =
        frames["rows"].as_array().unwrap().iter().filter_map(|r| r["more"]["training frames"].as_f64());
    assert_eq!(learned.collect::<Vec<_>>(), [40.0 * 2.0, 40.0 * 4.0]);

    // Each data set is judged beside its own baselines; networks that were trained before are used again.
    let improved = of("improved");
    let names = |split: &str| -> Vec<&str> {
        let rows = improved["rows"].as_array().unwrap().iter().filter(|r| r["split"] == split);
        rows.map(|r| r["name"].as_str().unwrap()).collect()
    };
    let all = [
        "mean of 15 % (Bruder et al.)",
        "LVRP",
        "LVRP with a 512th of the voxels",
        "as it is",
        "lobes sorted",
        "distilled network",
        "its teacher, entire's predictor",
    ];
    for split in ["left-out members", "Castro"] {
        assert_eq!(names(split), all, "{split}");
    }
    let castro = improved["rows"].as_array().unwrap().iter().find(|r| r["split"] == "Castro").unwrap();
    assert_eq!((&castro["frames"], castro["by_volume"].as_object().unwrap().len()), (&json!(160), 16));

    let (_, said) = paper(at, "report", &[]);
    let html = std::fs::read_to_string(at.join("out/report.html")).unwrap_or_else(|e| panic!("{e} {said}"));
    assert!(html.contains("one change at a time") && html.contains("lobes sorted"));
    // A single run has no SD.
    assert!(html.contains("- (1)"));

    let trials = files(&at.join("out/trials"));
    assert_eq!(trials.len(), 2 * 2 + 2);
    train();
    assert_eq!((files(&at.join("out/trials")), files(&at.join("out/results"))), (trials, results));
}

#[test]
fn the_books_page_is_what_the_kept_results_make() {
    let folder = tempfile::tempdir().unwrap();
    let (pages, made) = (repository().join("docs/src"), folder.path().join("book"));
    // Pictures that the book already has are linked, not written again.
    std::fs::create_dir_all(made.join("images")).unwrap();
    for entry in std::fs::read_dir(pages.join("images")).unwrap().map(Result::unwrap) {
        if entry.path().is_file() {
            std::fs::write(made.join("images").join(entry.file_name()), []).unwrap();
        }
    }
    let kept = "paper report --quiet --kept data/timings/paper-results.json.gz".split(' ');
    let out = folder.path().join("out");
    let folders = ["--out", out.to_str().unwrap(), "--book", made.to_str().unwrap()];
    let output = lab(&kept.chain(folders).collect::<Vec<_>>());
    assert!(output.status.success(), "{}", printed(&output.stderr));
    let page = |folder: &Path| std::fs::read_to_string(folder.join("paper-tables.md")).unwrap();
    assert!(
        page(&made) == page(&pages),
        "docs/src/paper-tables.md is out of date; its first lines say what writes it"
    );
    let names = |folder: &Path| {
        files(&folder.join("images/paper")).into_keys().map(|p| p.file_name().unwrap().to_owned())
    };
    assert_eq!(names(&made).collect::<Vec<_>>(), names(&pages).collect::<Vec<_>>());
}
