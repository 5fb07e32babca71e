//! `entire train` and `entire evaluate` as a user runs them, on tables whose times follow a known formula.

use entire_core::model::{Key, Model, ModelFile};
use entire_core::nn::Dtype;
use entire_core::scene::{Arcball, GaussianLobe, Shading, Skipping};
use entire_io::dataset::{MANIFEST_FORMAT, Manifest, Scene, Timing, Writer};
use entire_steer::predict::{Quality, load};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn entire(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_entire")).args(arguments).output().unwrap()
}

#[track_caller]
fn works(arguments: &[&str]) -> String {
    let output = entire(arguments);
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{arguments:?}\n{out}{err}");
    out.into_owned()
}

#[track_caller]
fn fails(arguments: &[&str], code: i32, expected: &str) {
    let output = entire(arguments);
    let err = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{arguments:?}\n{err}");
    assert!(err.contains(expected) && !err.contains("panicked"), "{arguments:?}\n{err}");
}

struct Data {
    folder: tempfile::TempDir,
    csv: PathBuf,
}

impl Data {
    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    fn csv(&self) -> &str {
        self.csv.to_str().unwrap()
    }
}

/// Returns four members with two volumes each and `frames` frames per volume. A frame takes a fixed time plus
/// a time per pixel that is inversely proportional to the camera distance; its two repeats are 1 % below and
/// above that.
fn data(frames: usize) -> Data {
    let folder = tempfile::tempdir().unwrap();
    let csv = folder.path().join("t.csv");
    let mut writer = Writer::create(&csv).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut unit = move || (rng.next_u32() >> 8) as f32 / (1 << 24) as f32;
    let mut number = 0;
    for member in ["m01", "m02", "m03", "m04"] {
        std::fs::create_dir_all(folder.path().join("blobs").join(member)).unwrap();
        for step in 0..2u32 {
            let name = format!("blobs/{member}/t{step:04}.nrrd");
            write_volume(&folder.path().join(&name), number as f32);
            for _ in 0..frames {
                let side = 32 + (unit() * 400.0) as u32;
                let dz = 1.2 + 2.0 * unit();
                let scene = Scene {
                    volume: name.clone(),
                    member: member.into(),
                    time_step: Some(step),
                    dims: [12; 3],
                    camera: Arcball { rx: 180.0 * unit() - 90.0, ry: 360.0 * unit(), dz },
                    fov_y_degrees: 45.0,
                    width: side,
                    height: side,
                    step: 1.0,
                    shading: Shading::None,
                    skipping: Skipping::Blocks,
                    termination: 0.99,
                    lobes: vec![GaussianLobe { center: unit(), width: 0.05, height: unit() }],
                };
                let seconds = 1e-3 + 2e-8 * f64::from(side * side) * f64::from(3.5 / dz);
                let repeats = [0.99, 1.01].map(|f| Timing { wall: Some(seconds * f), ..Timing::default() });
                writer.append(number, &scene, &repeats).unwrap();
                number += 1;
            }
        }
    }
    Data { folder, csv }
}

fn write_volume(path: &Path, shift: f32) {
    let mut bytes = b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 12 12 12\nencoding: raw\n\n".to_vec();
    for i in 0..12 * 12 * 12 {
        let (x, y, z) = (i % 12, i / 12 % 12, i / 144);
        let r = ((x - 6) as f32).hypot((y - 6) as f32).hypot((z - 6) as f32) + 0.01 * shift;
        bytes.push((255.0 - 30.0 * r).clamp(0.0, 255.0) as u8);
    }
    std::fs::write(path, bytes).unwrap();
}

fn model(path: &str) -> Model {
    Model::from_bytes(&std::fs::read(path).unwrap()).unwrap()
}

fn number_after(text: &str, line: &str, label: &str) -> f64 {
    let line = text.lines().find(|l| l.starts_with(line)).unwrap();
    let rest = &line[line.find(label).unwrap() + label.len()..];
    rest.split_whitespace().next().unwrap().parse().unwrap()
}

#[test]
fn a_small_network_learns_the_law_on_members_never_seen() {
    let data = data(60);
    let out = data.path("m.safetensors");
    let text = works(&[
        "train",
        "--quiet",
        "--data",
        data.csv(),
        "--out",
        &out,
        "--batch",
        "32",
        "--layers",
        "32,32",
        "--inputs",
        "camera,resolution",
        "--learning-rate",
        "1e-2",
        "--test-members",
        "blobs/m04",
        "--validation-members",
        "blobs/m03",
        "--epochs",
        "150",
    ]);
    assert!(number_after(&text, "test", "median error") < 3.0, "{text}");
    let m = model(&out);
    assert_eq!(m.inputs().iter().map(|g| g.size).collect::<Vec<_>>(), [3, 2]);
    let provenance: serde_json::Value = serde_json::from_str(&m.metadata()[Key::Provenance.name()]).unwrap();
    assert_eq!(provenance["split"]["test"], serde_json::json!(["blobs/m04"]));
    assert_eq!(provenance["data"][0]["frames"], 480);
    // The first repeat of every frame is faster than the second by a constant factor: a trend, no noise.
    let floor = |name: &str| provenance["noise_floor"][name].as_f64().unwrap();
    assert!(floor("log_sd") < 1e-6, "{provenance}");
    assert!((floor("warm_up") - (0.99f64 / 1.01).ln()).abs() < 1e-4, "{provenance}");
    let card = std::fs::read_to_string(data.path("m.md")).unwrap();
    for heading in [
        "## Use",
        "## Inputs",
        "## Data",
        "## Split",
        "## Training",
        "## Metrics",
        "## Limits",
        "Noise floor",
    ] {
        assert!(card.contains(heading), "{heading}\n{card}");
    }

    // `entire evaluate` computes the same errors on the held-out frames.
    let folder = data.path("evaluation");
    let shown =
        works(&["evaluate", "--quiet", "--model", &out, "--data", data.csv(), "--unseen", "--out", &folder]);
    assert!(shown.contains("blobs/m04") && !shown.contains("blobs/m01"), "{shown}");
    let json: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(format!("{folder}/evaluation.json")).unwrap()).unwrap();
    let own = &json["predictors"][0];
    assert_eq!((own["metrics"]["frames"].as_u64(), own["frames_seen"].as_u64()), (Some(120), Some(0)));
    let mdape = own["metrics"]["mdape"].as_f64().unwrap();
    assert!((mdape - provenance["metrics"]["test"]["mdape"].as_f64().unwrap()).abs() < 1e-12);
    let constant = &json["predictors"][1]["metrics"];
    assert!(
        constant["rmse_over_sd"].as_f64().unwrap() > 10.0 * own["metrics"]["rmse_over_sd"].as_f64().unwrap()
    );
    assert!(own["latency"]["seconds"].as_f64().unwrap() > 0.0);
    let rows = std::fs::read_to_string(format!("{folder}/predictions.csv")).unwrap();
    assert_eq!(rows.lines().count(), 121);
    for name in ["report.html", "errors.svg", "bias.svg", "scatter-1.svg", "scatter-2.svg"] {
        assert!(std::fs::metadata(format!("{folder}/{name}")).unwrap().len() > 500, "{name}");
    }

    // Fine-tuning keeps the standardization of the inputs and changes the weights.
    let tuned = data.path("tuned.safetensors");
    works(&[
        "train",
        "--quiet",
        "--data",
        data.csv(),
        "--out",
        &tuned,
        "--fine-tune",
        &out,
        "--epochs",
        "2",
        "--limit",
        "40",
    ]);
    let (a, b) = (model(&out), model(&tuned));
    assert_eq!(a.prednet().unwrap().input, b.prednet().unwrap().input);
    assert_ne!(a.prednet().unwrap().layers, b.prednet().unwrap().layers);
    fails(
        &["train", "--data", data.csv(), "--out", &tuned, "--fine-tune", &out, "--preset", "0C64"],
        2,
        "--preset",
    );

    // The groups that the base was trained on stay known after fine-tuning with another split.
    let mine =
        ["train", "--quiet", "--data", data.csv(), "--out", &tuned, "--fine-tune", &out, "--epochs", "1"];
    works(&[&mine[..], &["--test-groups", "blobs/m01"]].concat());
    let card = std::fs::read_to_string(data.path("tuned.md")).unwrap();
    assert!(card.contains("trained or validated on test groups: blobs/m01"), "{card}");
    let shown = works(&["evaluate", "--quiet", "--model", &tuned, "--data", data.csv()]);
    assert!(shown.contains("blobs/m01"));
    fails(
        &["evaluate", "--model", &tuned, "--data", data.csv(), "--unseen"],
        1,
        "a model was trained or validated on",
    );

    // All groups were in training or validation, so --unseen leaves no frame.
    works(&[
        "train",
        "--quiet",
        "--data",
        data.csv(),
        "--out",
        &tuned,
        "--epochs",
        "1",
        "--validation-groups",
        "blobs/m03",
    ]);
    fails(
        &["evaluate", "--model", &tuned, "--data", data.csv(), "--unseen"],
        1,
        "a model was trained or validated on",
    );
}

#[test]
fn the_paper_configuration_writes_encoder_and_network_into_one_file() {
    let data = data(12);
    let mut file = ModelFile::default();
    file.metadata.insert(Key::VolumeNet.into(), r#"{"input":8,"blocks":[{"stride":2,"padding":1}]}"#.into());
    let ramp = |n: usize| (0..n).map(|i| ((i * 7 % 11) as f32 - 5.0) * 0.05).collect::<Vec<f32>>();
    for (name, shape) in [
        ("encoder.0.conv.weight", &[2usize, 1, 3, 3, 3][..]),
        ("encoder.0.conv.bias", &[2]),
        ("encoder.0.bn.weight", &[2]),
        ("encoder.0.bn.bias", &[2]),
        ("encoder.0.bn.running_mean", &[2]),
        ("fc.weight", &[2, 128]),
        ("fc.bias", &[2]),
        ("decoder.note", &[3]),
    ] {
        let n = shape.iter().product();
        file.set_tensor(&format!("volumenet.{name}"), Dtype::F32, shape, &ramp(n)).unwrap();
    }
    file.set_tensor("volumenet.encoder.0.bn.running_var", Dtype::F32, &[2], &[1.0, 0.5]).unwrap();
    let encoder = data.path("encoder.safetensors");
    std::fs::write(&encoder, file.to_bytes().unwrap()).unwrap();

    let out = data.path("paper.safetensors");
    let arguments = [
        "train",
        "--quiet",
        "--data",
        data.csv(),
        "--out",
        &out,
        "--preset",
        "1C32",
        "--target",
        "seconds",
        "--inputs",
        "volume_features,camera,resolution,transfer_function",
        "--volumenet",
        &encoder,
        "--epochs",
        "3",
        "--dtype",
        "f16",
    ];
    works(&arguments);
    let m = model(&out);
    assert_eq!(m.inputs().iter().map(|g| g.size).collect::<Vec<_>>(), [2, 3, 2, 3]);
    assert!(m.volumenet().is_some());
    let widths: Vec<usize> = m.prednet().unwrap().layers.iter().map(|l| l.outputs).collect();
    assert_eq!(widths, [32, 32, 16, 1]);
    assert_eq!(m.prednet().unwrap().layers[0].dtype, Dtype::F16);
    // The header names every tensor. Tensors that training does not use are kept.
    let kept = std::fs::read(&out).unwrap();
    let header = 8 + u64::from_le_bytes(kept[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&kept[8..header]).unwrap();
    assert!(header.get("volumenet.decoder.note").is_some(), "{header}");
    // The same seed gives the same weights.
    works(&arguments);
    assert_eq!(model(&out).prednet(), m.prednet());
    works(&["evaluate", "--quiet", "--model", &out, "--data", data.csv()]);
    fails(
        &["train", "--data", data.csv(), "--out", &out, "--inputs", "volume_features"],
        1,
        "name a model file that holds a VolumeNet",
    );
}

#[test]
fn the_analytic_model_is_one_layer_with_costs_that_are_not_negative() {
    let data = data(20);
    let out = data.path("costs.safetensors");
    let text = works(&["train", "--quiet", "--data", data.csv(), "--out", &out, "--model-kind", "analytic"]);
    assert!(text.contains("fitted to"), "{text}");
    let m = model(&out);
    let net = m.prednet().unwrap();
    assert_eq!((net.layers.len(), net.layers[0].outputs), (1, 1));
    assert!(net.layers[0].weight.iter().chain(&net.layers[0].bias).all(|c| *c >= 0.0));
    assert_eq!(m.scene_features().len(), net.layers[0].inputs);
    let shown = works(&["evaluate", "--quiet", "--model", &out, "--data", data.csv(), "--by", "volume"]);
    assert!(shown.contains("blobs/m02/t0001.nrrd"), "{shown}");
    assert!(shown.contains("noise floor, from repeats of a frame"), "{shown}");
}

/// On a GPU, the processor only waits.
#[test]
fn frames_of_a_gpu_teach_the_time_of_the_device() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("here.safetensors").display().to_string();
    let table = concat!(env!("CARGO_MANIFEST_DIR"), "/../data/timings/none-h100-members.csv.gz");
    works(&["train", "--data", table, "--out", &out, "--model-kind", "analytic"]);
    assert_eq!(model(&out).metadata()[Key::Clock.name()], "device");
}

#[test]
fn compared_pictures_put_their_law_into_the_model() {
    let data = data(10);
    let (pictures, out) = (data.path("pictures.csv"), data.path("both.safetensors"));
    let truth = Quality { image_weight: 5.0, step_exponent: 1.2, image_exponent: 0.9, ray_share: 0.2 };
    let mut text = "scene,step,image_sample_distance,seconds,error\n".to_owned();
    for scene in ["near", "far", "inside"] {
        for distance in [1.0, 1.2, 1.44, 2.0] {
            for step in [1.0, 1.5, 2.2, 3.2, 4.5] {
                let share = (0.2 + 0.8 / step) / (distance * distance);
                let (seconds, error) = (0.02 * share, truth.error(step, distance));
                text += &format!("{scene},{step},{distance},{seconds},{error}\n");
            }
        }
    }
    std::fs::write(&pictures, &text).unwrap();
    let mut arguments = vec!["train", "--data", data.csv(), "--out", &out, "--model-kind", "analytic"];
    arguments.extend(["--pictures", &pictures]);
    let said = works(&arguments);
    assert!(said.contains("pictures: 3 scenes at 20 ray steps and image sizes"), "{said}");
    let found = load(&model(&out)).unwrap().quality("").unwrap();
    for (own, wanted) in [
        (found.image_weight, truth.image_weight),
        (found.step_exponent, truth.step_exponent),
        (found.image_exponent, truth.image_exponent),
        (found.ray_share, truth.ray_share),
    ] {
        assert!((own / wanted - 1.0).abs() < 0.02, "{found:?}");
    }

    // A quality law applies to one renderer; a note says that the model cannot name this renderer.
    let told = entire(&arguments);
    assert!(String::from_utf8_lossy(&told.stderr).contains("the frames have no manifest"));

    std::fs::write(&pictures, text.replace("near,1,1,0.02,0", "near,1,1,soon,0")).unwrap();
    fails(&arguments, 1, "line 2, column seconds: \"soon\" is no number");
    std::fs::write(&pictures, text.lines().take(21).collect::<Vec<_>>().join("\n")).unwrap();
    fails(&arguments, 1, "at least 3 scenes");
}

#[test]
fn kept_features_stand_in_for_volumes_that_are_gone() {
    let data = data(6);
    let out = data.path("m.safetensors");
    works(&["features", "--quiet", "--data", data.csv()]);
    works(&["train", "--quiet", "--data", data.csv(), "--out", &out, "--model-kind", "analytic"]);
    let folder = data.path("evaluation");
    let evaluate = ["evaluate", "--model", &out, "--data", data.csv(), "--out", &folder];
    let result = || {
        let output = entire(&evaluate);
        let err = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{err}");
        let text = std::fs::read_to_string(format!("{folder}/evaluation.json")).unwrap();
        (serde_json::from_str::<serde_json::Value>(&text).unwrap()["predictors"][0].clone(), err)
    };
    let (with, _) = result();
    assert!(with["latency"]["transfer_seconds"].as_f64().unwrap() > 0.0);
    let moved = data.path("moved");
    std::fs::rename(data.path("blobs"), &moved).unwrap();
    let (without, err) = result();
    assert!(err.contains("note: m: no latency") && err.contains("blobs/m01/t0000.nrrd"), "{err}");
    assert!(without["latency"].is_null());
    assert_eq!(with["metrics"], without["metrics"]);

    // Volumes are found below a given folder; a quiet run prints no note.
    let elsewhere = tempfile::tempdir().unwrap();
    std::fs::rename(&moved, elsewhere.path().join("blobs")).unwrap();
    let root = elsewhere.path().to_str().unwrap();
    std::fs::remove_file(data.path("t.features.csv.gz")).unwrap();
    fails(&evaluate, 1, "blobs/m01/t0000.nrrd");
    for command in
        [&evaluate[..], &["train", "--data", data.csv(), "--out", &out, "--model-kind", "analytic"]]
    {
        let output = entire(&[command, &["--root", root, "--quiet"]].concat());
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
    }
    works(&["features", "--quiet", "--data", data.csv(), "--root", root]);

    // With one more row, the features belong to another table.
    let mut text = std::fs::read_to_string(&data.csv).unwrap();
    text.push_str(text.lines().last().unwrap().replace(",1,blobs", ",2,blobs").as_str());
    text.push('\n');
    std::fs::write(&data.csv, text).unwrap();
    fails(&evaluate, 1, "`entire features`");
}

#[test]
fn what_cannot_be_done_is_said() {
    let data = data(3);
    let out = data.path("m.safetensors");
    let train = |more: &[&str], code: i32, expected: &str| {
        let mut arguments = vec!["train", "--quiet", "--data", data.csv(), "--out", &out];
        arguments.extend(more);
        fails(&arguments, code, expected);
    };
    train(&["--scene-features", "warp_speed"], 1, "warp_speed");
    train(&["--inputs", "weather"], 1, "weather");
    train(&["--inputs", "camera,camera"], 1, "named twice");
    train(&["--test-members", "m09"], 1, "there are blobs/m01");
    train(&["--clock", "device"], 1, "choose another --clock");
    train(&["--shade", "local"], 1, "--shade");
    train(&["--preset", "12C99"], 1, "12C256");
    train(&["--loss", "cosine"], 2, "pinball:QUANTILE");
    train(&["--loss", "relative"], 1, "needs the target seconds");
    train(&["--epochs", "0"], 1, "epochs is 0");
    train(&["--limit", "0"], 1, "--limit is 0");
    train(&["--threads", "0"], 1, "--threads is 0");
    train(&["--learning-rate=-1"], 1, "learning rate");
    train(&["--fine-tune", data.csv()], 1, "t.csv");
    train(
        &["--model-kind", "residual", "--inputs", "scene_features,camera"],
        1,
        "takes scene_features alone",
    );
    // Options that would have no effect are refused.
    train(&["--model-kind", "residual", "--preset", "4C64"], 1, "--preset is for --model-kind prednet");
    train(
        &["--model-kind", "analytic", "--epochs", "9"],
        1,
        "--epochs is for networks; --model-kind analytic",
    );
    train(&["--sorted-lobes", "--fine-tune", &out], 2, "--sorted-lobes");
    fails(&["train", "--data", data.csv(), "--out", "m.bin"], 1, ".safetensors");
    fails(&["train", "--data", "nowhere.csv", "--out", &out], 1, "cannot read nowhere.csv");
    fails(&["train", "--out", &out], 2, "--data");
    fails(
        &["evaluate", "--model", "nowhere.safetensors", "--data", data.csv()],
        1,
        "cannot read nowhere.safetensors",
    );
    fails(&["evaluate", "--model", data.csv(), "--data", data.csv()], 1, "safetensors");

    // A manifest of another format and a missing volume are refused.
    let manifest = Manifest {
        format: MANIFEST_FORMAT.replace('1', "9"),
        created: String::new(),
        machine: String::new(),
        renderer: String::new(),
        device: String::new(),
        driver: String::new(),
        commit: String::new(),
        seed: 0,
        repeats: 2,
        step_reference: String::new(),
        settings: serde_json::Value::Null,
        files: Default::default(),
        other: Default::default(),
    };
    manifest.write(&data.csv).unwrap();
    train(&[], 1, "entire-timings-1");
    std::fs::remove_file(Manifest::path_for(&data.csv)).unwrap();
    std::fs::remove_file(data.path("blobs/m01/t0000.nrrd")).unwrap();
    train(&[], 1, "blobs/m01/t0000.nrrd");
    write_volume(Path::new(&data.path("blobs/m01/t0000.nrrd")), 0.0);
    assert!(!Path::new(&out).exists());
}
