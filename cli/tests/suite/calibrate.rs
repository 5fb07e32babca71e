//! `entire calibrate` with the raycaster's CPU version stores a model of the machine in the folder in which
//! the other commands look for it.

use crate::support::*;
use entire_cli::calibrate::{NamedPrior, calibrate_to_tables};
use entire_core::model::ModelFile;
use entire_core::scene::Shading;
use entire_io::dataset::{COLUMNS, Clock, read_tables};
use entire_steer::predict::{Quality, load};
use std::path::Path;
use std::process::Output;

fn volumes(folder: &Path) {
    for (name, value) in [
        ("a", (|i: usize| (i * 7 % 251) as u8) as fn(usize) -> u8),
        ("b", |i| if i % 12 < 6 { 0 } else { (i % 200) as u8 }),
        ("c", |i| (i / 97 % 256) as u8),
    ] {
        let bytes = byte_nrrd([12; 3], (0..12 * 12 * 12).map(value));
        std::fs::write(folder.join(format!("{name}.nrrd")), bytes).unwrap();
    }
}

fn run(folder: &Path, line: &str) -> Output {
    entire_in(folder, &[("XDG_DATA_HOME", folder.join("home").to_str().unwrap())], &words(line))
}

const QUICK_OPTIONS: &str = "--device cpu --seconds 9 --frames 30 --max-size 64 --quiet --threads 1";

#[test]
fn a_machines_model_is_made_found_and_says_its_clock() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    std::fs::create_dir(at.join("data")).unwrap();
    volumes(&at.join("data"));
    // Without a model of the machine, `predict` names the command that makes one.
    std::fs::write(at.join("rows.csv"), "1\n").unwrap();
    let none = run(at, "predict --inputs rows.csv");
    assert!(!none.status.success() && stderr(&none).contains("entire calibrate --shade none"), "{none:?}");

    let made = run(at, &format!("calibrate --clock cpu --table frames.csv {QUICK_OPTIONS}"));
    assert!(made.status.success(), "{}", stderr(&made));
    let said = stdout(&made);
    for part in
        ["to expect", "median error", "RMSE/SD", "clock cpu", "3 volumes", "frames have only disturbed"]
    {
        assert!(said.contains(part), "{part}: {said}");
    }
    // Image sides of at most 64 pixels are too short for comparing pictures.
    assert!(said.contains("too few were compared"), "{said}");
    let path = at.join("home/entire/machine-none.safetensors");
    let model = model_of(&path);
    assert_eq!(model.metadata["entire.clock"], "cpu");
    assert!(load(&model).is_ok());
    let provenance: serde_json::Value =
        serde_json::from_str(model.metadata["entire.provenance"].as_str()).unwrap();
    assert_eq!((&provenance["clock"], &provenance["shading"]), (&"cpu".into(), &"none".into()));
    let names: Vec<&str> = provenance["calibration"]["files"]
        .as_array()
        .unwrap()
        .iter()
        .map(|f| f["name"].as_str().unwrap())
        .collect();
    assert_eq!(names.len(), 3, "{names:?}");
    let frames = provenance["calibration"]["frames"].as_u64().unwrap();
    assert!((8..=30).contains(&frames), "{frames}");
    for text in [model.metadata["entire.provenance"].as_str(), &said] {
        assert!(!text.contains(&format!("\"{}", at.display())), "a path of this machine: {text}");
    }

    // The measured frames form a timing table. The model is evaluated on it by the model's clock; another
    // clock is refused.
    let evaluate = "evaluate --model home/entire/machine-none.safetensors --data frames.csv --quiet";
    let judged = run(at, evaluate);
    assert!(judged.status.success(), "{}", stderr(&judged));
    // A calibrated model does not state its training groups, so the number of their frames is not known.
    let printed = stdout(&judged);
    let row = printed.lines().find(|l| l.starts_with("machine-none ")).unwrap();
    assert_eq!(row.split_whitespace().nth(2), Some("-"), "{row}");
    let refused = run(at, &format!("{evaluate} --clock wall"));
    assert!(!refused.status.success() && stderr(&refused).contains("predicts cpu seconds"), "{refused:?}");

    // The same frames as a renderer's log: fitted without rendering.
    let fitted = run(at, "calibrate --data frames.csv --out logged.safetensors --threads 1");
    assert!(fitted.status.success() && stdout(&fitted).contains("to expect"), "{}", stderr(&fitted));
    let logged = model_of(&at.join("logged.safetensors"));
    // Wall time, since the CPU version has no timestamps.
    assert!(load(&logged).is_ok() && logged.metadata["entire.clock"] == "wall");

    // Frames of another shading are not used, and do not affect the choice of the clock.
    let table = std::fs::read_to_string(at.join("frames.csv")).unwrap();
    let column = |name: &str| COLUMNS.iter().position(|column| *column == name).unwrap();
    let (shading, device) = (column("shading"), column("seconds_device"));
    let others = table.lines().skip(1).map(|row| {
        let mut cells: Vec<&str> = row.split(',').collect();
        (cells[shading], cells[device]) = ("local", "0.1");
        format!("9{}\n", cells.join(","))
    });
    std::fs::write(at.join("mixed.csv"), table.clone() + &others.collect::<String>()).unwrap();
    let mixed = run(at, "calibrate --data mixed.csv --out mixed.safetensors --threads 1");
    assert!(mixed.status.success(), "{}", stderr(&mixed));
    let judged = run(at, "evaluate --model mixed.safetensors --data mixed.csv --threads 1");
    let note = "frames have another shading; --shade none leaves these out";
    assert!(stderr(&judged).contains(note), "{judged:?}");

    // A note says that the prior and the new model predict seconds of different clocks.
    let prior = "--clock wall --prior home/entire/machine-none.safetensors --out wall.safetensors";
    let wall = run(at, &format!("calibrate --data frames.csv --threads 1 {prior}"));
    assert!(wall.status.success(), "{}", stderr(&wall));
    assert!(stderr(&wall).contains("predicts cpu seconds; the new model predicts wall seconds"), "{wall:?}");

    // `predict` finds the machine's model by itself, and names the clock of its seconds.
    let columns: usize = model.inputs.iter().map(|g| g.size).sum();
    std::fs::write(at.join("rows.csv"), vec!["1.5"; columns].join(",") + "\n").unwrap();
    let predicted = run(at, "predict --inputs rows.csv");
    assert!(predicted.status.success(), "{}", stderr(&predicted));
    assert!(stderr(&predicted).contains("predicts cpu seconds"), "{predicted:?}");
    assert!(stdout(&predicted).trim().parse::<f64>().unwrap() > 0.0);

    // The table has checksums of its volumes: changed files are refused.
    let volume = std::fs::read_dir(at.join("data")).unwrap().next().unwrap().unwrap().path();
    let mut bytes = std::fs::read(&volume).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    std::fs::write(&volume, bytes).unwrap();
    for arguments in [
        "features --data frames.csv --quiet",
        "calibrate --data frames.csv --out stale.safetensors --threads 1",
    ] {
        let stale = run(at, arguments);
        assert!(!stale.status.success() && stderr(&stale).contains("changed after the frames"), "{stale:?}");
    }

    // A damaged model of the machine is a finding of `doctor`, with the remedy.
    std::fs::write(&path, &std::fs::read(&path).unwrap()[..100]).unwrap();
    let doctor = run(at, "doctor");
    assert!(doctor.status.success() && stdout(&doctor).contains("Render farms"), "{}", stderr(&doctor));
    for part in
        ["the machine's model is damaged", "machine-none.safetensors", "entire calibrate --shade none"]
    {
        assert!(stdout(&doctor).contains(part), "{part}: {}", stdout(&doctor));
    }
    // With an invalid value of ENTIRE_TILE, `--device auto` opens no renderer, not even the CPU version.
    let doctor = stdout(&entire_in(at, &[("ENTIRE_TILE", "x")], &["doctor"]));
    assert!(doctor.contains("none: ENTIRE_TILE is \"x\""), "{doctor}");
}

#[test]
fn a_model_states_what_coarser_pictures_cost() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    volumes(at);
    // With few frames, most of the time is left for pictures.
    let line = "calibrate a.nrrd b.nrrd c.nrrd --device cpu --seconds 60 --frames 12 --min-size 96 \
                --max-size 128 --quiet --threads 1 --out m.safetensors";
    let made = run(at, line);
    assert!(made.status.success(), "{}", stderr(&made));
    let model = model_of(&at.join("m.safetensors"));
    let quality = load(&model).unwrap().quality("").unwrap_or_else(|| panic!("{}", stdout(&made)));
    assert_eq!(load(&model).unwrap().quality("cpu"), Some(quality));
    assert_eq!(load(&model).unwrap().quality("vulkan"), None);
    let said = stdout(&made);
    assert!(said.contains("pictures") && said.contains("only the step is changed"), "{said}");
    let provenance: serde_json::Value =
        serde_json::from_str(model.metadata["entire.provenance"].as_str()).unwrap();
    let pictures = &provenance["calibration"]["pictures"];
    assert_eq!((&pictures["error"], &pictures["settings"]), (&"rmse".into(), &20.into()));
    let of = |name: &str| pictures[name].as_f64();
    let (chosen, least) = (of("over_best").unwrap(), of("step_least_time").unwrap());
    // The error of the law's choices is at least 0.95 times the best error: a coarse picture may be better
    // than interpolation between drawn settings predicts.
    assert!(chosen > 0.95 && least > 0.0 && least < 1.0, "{pictures}");
    // The ratio for steps alone is missing if even the coarsest step takes longer than all compared frame
    // times.
    let fitted = of("over_prior").unwrap() < 1.0;
    assert_eq!(said.contains("the built-in law is kept"), !fitted, "{said}");
    match of("step_over_best") {
        Some(alone) if fitted => assert!(chosen <= alone + 1e-9, "{pictures}"),
        Some(_) => assert_eq!(Some(quality), Quality::built_in("cpu"), "{pictures}"),
        None => assert!(least > 0.7, "{pictures}"),
    }
}

#[test]
fn all_makes_of_machine_are_started_from() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let priors: Vec<NamedPrior> = ["unshaded-selected", "unshaded-epyc-selected", "unshaded-xeon-selected"]
        .map(|name| {
            let path = root.join(format!("models/{name}.safetensors"));
            (name.to_owned(), ModelFile::from_bytes(&std::fs::read(path).unwrap()).unwrap())
        })
        .into();
    let threads = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let tables = read_tables(&[root.join("data/timings/none-epyc-steps.csv.gz")]).unwrap();
    // Geometric means over ten disjoint tenths of the frames.
    let errors = [&priors[..], &[]].map(|priors| {
        let of = |tenth: u64| {
            let mut few = tables.clone();
            few[0].frames.retain(|f| f.number % 10 == tenth);
            let (_, report) =
                calibrate_to_tables(&few, (Shading::None, Clock::Cpu), priors, None, &threads).unwrap();
            assert_eq!(report.prior.is_some(), !priors.is_empty());
            report.median_error.ln()
        };
        ((0..10).map(of).sum::<f64>() / 10.0).exp()
    });
    assert!(errors[0] < 0.18 && errors[0] < 1.02 * errors[1], "{errors:?}");
}

#[test]
fn what_cannot_be_calibrated_is_said() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    volumes(at);
    refuses(at, &["calibrate"], &["data/ is not here", "name volume files"]);
    fails(at, "calibrate gone.nrrd --out m.safetensors", 1, &["gone.nrrd"]);
    fails(at, "calibrate a.nrrd --termination -1 --out m.safetensors", 1, &["above 0 and at most 1"]);
    // --root is for tables alone.
    fails(at, "calibrate a.nrrd --root . --out m.safetensors", 2, &["--root"]);
    // The CPU version has no timestamps.
    let line = format!("calibrate a.nrrd --clock device --out m.safetensors {QUICK_OPTIONS}");
    fails(at, &line, 1, &["has no timestamps", "--clock"]);
    let twice = "calibrate a.nrrd ./a.nrrd --out m.safetensors";
    fails(at, twice, 1, &["./a.nrrd is given twice, first as a.nrrd"]);
    let both = "calibrate a.nrrd --device cpu --out m.safetensors --table ./m.safetensors";
    fails(at, both, 1, &["--table and --out: ./m.safetensors is given twice"]);
    assert!(!at.join("m.safetensors").exists());
    // A prior is never overwritten, not even by the model of one of several modes.
    std::fs::write(at.join("m-none.safetensors"), "kept").unwrap();
    for line in [
        "calibrate a.nrrd --prior m-none.safetensors --out ./m-none.safetensors",
        "calibrate a.nrrd --shade all --prior m-none.safetensors --out m.safetensors",
        "calibrate --data gone.csv --prior m-none.safetensors --out m-none.safetensors",
    ] {
        refuses(at, &words(line), &["m-none.safetensors is an input of this command", "another name"]);
        assert_eq!(std::fs::read(at.join("m-none.safetensors")).unwrap(), b"kept", "{line}");
    }
}
