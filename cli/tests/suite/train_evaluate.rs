//! `entire train` and `entire evaluate` as a user runs them, on tables whose times follow a known formula.

use crate::support::{self, byte_nrrd, entire, json, model_of, stderr, succeeds, unread, words};
use entire_core::model::{Key, Model, ModelFile};
use entire_core::nn::Dtype;
use entire_core::scene::{Arcball, GaussianLobe};
use entire_io::dataset::{MANIFEST_FORMAT, Manifest, Scene, Table, TimedFrame, Timing, Writer};
use entire_steer::predict::{AnalyticModel, Quality, load};
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};
use std::path::Path;
use tempfile::TempDir;

#[track_caller]
fn works(data: &TempDir, line: &str) -> String {
    succeeds(data.path(), &words(line))
}

#[track_caller]
fn fails(data: &TempDir, line: &str, code: i32, expected: &str) {
    support::fails(data.path(), line, code, &[expected]);
}

fn text_of(data: &TempDir, name: &str) -> String {
    std::fs::read_to_string(data.path().join(name)).unwrap()
}

/// Returns a folder with a table, t.csv, of four members with two volumes each and `frames` frames per
/// volume. A frame takes a fixed time plus a time per pixel that is inversely proportional to the camera
/// distance; its two repeats are 1 % below and above that time.
fn data(frames: usize) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = Writer::create(&folder.path().join("t.csv")).unwrap();
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
                    time_step: Some(step),
                    dims: [12; 3],
                    camera: Arcball { rx: 180.0 * unit() - 90.0, ry: 360.0 * unit(), dz },
                    width: side,
                    height: side,
                    lobes: vec![GaussianLobe { center: unit(), width: 0.05, height: unit() }],
                    ..TimedFrame::of_no_volume(&name, member).scene
                };
                let seconds = 1e-3 + 2e-8 * f64::from(side * side) * f64::from(3.5 / dz);
                let repeats = [0.99, 1.01].map(|f| Timing { wall: Some(seconds * f), ..Timing::default() });
                writer.append(number, &scene, &repeats).unwrap();
                number += 1;
            }
        }
    }
    folder
}

fn write_volume(path: &Path, shift: f32) {
    let values = (0..12 * 12 * 12).map(|i| {
        let (x, y, z) = (i % 12, i / 12 % 12, i / 144);
        let r = ((x - 6) as f32).hypot((y - 6) as f32).hypot((z - 6) as f32) + 0.01 * shift;
        (255.0 - 30.0 * r).clamp(0.0, 255.0) as u8
    });
    std::fs::write(path, byte_nrrd([12; 3], values)).unwrap();
}

fn model(data: &TempDir, name: &str) -> Model {
    model_of(&data.path().join(name))
}

fn number_after(text: &str, line: &str, label: &str) -> f64 {
    let line = text.lines().find(|l| l.starts_with(line)).unwrap();
    let rest = &line[line.find(label).unwrap() + label.len()..];
    rest.split_whitespace().next().unwrap().parse().unwrap()
}

#[test]
fn seconds_of_two_clocks_are_not_evaluated_together() {
    let data = data(2);
    // A model that states no clock.
    let file = AnalyticModel::default().to_model_file().unwrap();
    std::fs::write(data.path().join("m.safetensors"), file.to_bytes().unwrap()).unwrap();
    let evaluate = "evaluate --quiet --model m.safetensors --data t.csv";
    works(&data, evaluate);
    // One more frame, which has device timestamps.
    let path = data.path().join("t.csv");
    let scene = Table::read(&path, 0).unwrap().frames[0].scene.clone();
    let both = Timing { device: Some(1e-3), wall: Some(2e-3), ..Timing::default() };
    Writer::resume(&path, 2).unwrap().append(16, &scene, &[both; 2]).unwrap();
    fails(&data, evaluate, 1, "2 of 34 repeats have device timestamps");
    works(&data, &format!("{evaluate} --clock wall"));
}

#[test]
fn a_small_network_learns_the_law_on_members_never_seen() {
    let data = data(60);
    let text = works(
        &data,
        "train --quiet --data t.csv --out m.safetensors --batch 32 --layers 32,32 --inputs camera,resolution \
         --learning-rate 1e-2 --test-groups blobs/m04 --validation-groups blobs/m03 --epochs 150",
    );
    assert!(number_after(&text, "test", "median error") < 3.0, "{text}");
    let m = model(&data, "m.safetensors");
    assert_eq!(m.inputs.iter().map(|g| g.size).collect::<Vec<_>>(), [3, 2]);
    let provenance: serde_json::Value = serde_json::from_str(&m.metadata[Key::Provenance.name()]).unwrap();
    assert_eq!(provenance["split"]["test"], serde_json::json!(["blobs/m04"]));
    assert_eq!(provenance["data"][0]["frames"], 480);
    // The first repeat of every frame is faster than the second by a constant factor: a trend, no noise.
    let floor = |name: &str| provenance["noise_floor"][name].as_f64().unwrap();
    assert!(floor("log_sd") < 1e-6, "{provenance}");
    assert!((floor("warm_up") - (0.99f64 / 1.01).ln()).abs() < 1e-4, "{provenance}");
    let card = text_of(&data, "m.md");
    for heading in ["Use", "Inputs", "Data", "Splits", "Training", "Figures", "Limits"] {
        assert!(card.contains(&format!("## {heading}")), "{heading}\n{card}");
    }
    assert!(card.contains("Noise floor"), "{card}");

    // `entire evaluate` computes the same errors on the held-out frames.
    let shown = works(&data, "evaluate --quiet --model m.safetensors --data t.csv --unseen --out evaluation");
    assert!(shown.contains("blobs/m04") && !shown.contains("blobs/m01"), "{shown}");
    let evaluation = json(&data.path().join("evaluation/evaluation.json"));
    let own = &evaluation["predictors"][0];
    assert_eq!((own["metrics"]["frames"].as_u64(), own["frames_seen"].as_u64()), (Some(120), Some(0)));
    let mdape = own["metrics"]["mdape"].as_f64().unwrap();
    assert!((mdape - provenance["metrics"]["test"]["mdape"].as_f64().unwrap()).abs() < 1e-12);
    let constant = &evaluation["predictors"][1]["metrics"];
    assert!(
        constant["rmse_over_sd"].as_f64().unwrap() > 10.0 * own["metrics"]["rmse_over_sd"].as_f64().unwrap()
    );
    assert!(own["latency"]["seconds"].as_f64().unwrap() > 0.0);
    assert_eq!(text_of(&data, "evaluation/predictions.csv").lines().count(), 121);
    for name in ["report.html", "errors.svg", "bias.svg", "scatter-1.svg", "scatter-2.svg"] {
        assert!(text_of(&data, &format!("evaluation/{name}")).len() > 500, "{name}");
    }

    unread(data.path(), "evaluate --quiet --model m.safetensors --data t.csv --out unread");
    // A timing table is not replaced by the predictions.
    std::fs::create_dir(data.path().join("kept")).unwrap();
    std::fs::copy(data.path().join("t.csv"), data.path().join("kept/predictions.csv")).unwrap();
    let onto_table = "evaluate --model m.safetensors --data kept/predictions.csv --out kept --root .";
    fails(&data, onto_table, 1, "predictions.csv is a timing table");
    assert!(text_of(&data, "unread/report.html").len() > 500);

    // Fine-tuning keeps the standardization of the inputs and changes the weights.
    let tune = "train --quiet --data t.csv --out tuned.safetensors --fine-tune m.safetensors";
    works(&data, &format!("{tune} --epochs 2 --limit 40"));
    let (a, b) = (model(&data, "m.safetensors"), model(&data, "tuned.safetensors"));
    assert_eq!(a.prednet.as_ref().unwrap().input, b.prednet.as_ref().unwrap().input);
    assert_ne!(a.prednet.as_ref().unwrap().layers, b.prednet.as_ref().unwrap().layers);
    fails(&data, &format!("{tune} --preset 0C64"), 2, "--preset");
    let onto_itself = "train --data t.csv --out m.safetensors --fine-tune ./m.safetensors";
    fails(&data, onto_itself, 1, "m.safetensors is an input of this command");

    // After fine-tuning with another split, the file still states the groups that the base was trained on.
    works(&data, &format!("{tune} --epochs 1 --test-groups blobs/m01"));
    let card = text_of(&data, "tuned.md");
    assert!(card.contains("trained or validated on test groups: blobs/m01"), "{card}");
    let evaluate = "evaluate --quiet --model tuned.safetensors --data t.csv";
    assert!(works(&data, evaluate).contains("blobs/m01"));
    let unseen = format!("{evaluate} --unseen");
    fails(&data, &unseen, 1, "a model was trained or validated on");

    // All groups were in training or validation, so --unseen leaves no frame.
    works(
        &data,
        "train --quiet --data t.csv --out tuned.safetensors --epochs 1 --validation-groups blobs/m03",
    );
    fails(&data, &unseen, 1, "a model was trained or validated on");
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
    std::fs::write(data.path().join("encoder.safetensors"), file.to_bytes().unwrap()).unwrap();

    let line = "train --quiet --data t.csv --out paper.safetensors --preset 1C32 --target seconds --inputs \
                volume_features,camera,resolution,transfer_function --volumenet encoder.safetensors --epochs \
                3 --dtype f16";
    works(&data, line);
    let m = model(&data, "paper.safetensors");
    assert_eq!(m.inputs.iter().map(|g| g.size).collect::<Vec<_>>(), [2, 3, 2, 3]);
    assert!(m.volumenet.is_some());
    let widths: Vec<usize> = m.prednet.as_ref().unwrap().layers.iter().map(|l| l.outputs).collect();
    assert_eq!(widths, [32, 32, 16, 1]);
    assert_eq!(m.prednet.as_ref().unwrap().layers[0].dtype, Dtype::F16);
    // The header names every tensor. Tensors that training does not use are kept.
    let kept = std::fs::read(data.path().join("paper.safetensors")).unwrap();
    let header = 8 + u64::from_le_bytes(kept[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&kept[8..header]).unwrap();
    assert!(header.get("volumenet.decoder.note").is_some(), "{header}");
    // The same seed gives the same weights.
    works(&data, line);
    assert_eq!(model(&data, "paper.safetensors").prednet, m.prednet);
    works(&data, "evaluate --quiet --model paper.safetensors --data t.csv");
    let without = "train --data t.csv --out paper.safetensors --inputs volume_features";
    fails(&data, without, 1, "name a model file that holds a VolumeNet");
}

#[test]
fn unit_costs_are_one_layer_and_not_negative() {
    let data = data(20);
    let text = works(&data, "calibrate --quiet --data t.csv --out costs.safetensors");
    assert!(text.contains("160 frames of 8 volumes"), "{text}");
    let m = model(&data, "costs.safetensors");
    let net = m.prednet.as_ref().unwrap();
    assert_eq!((net.layers.len(), net.layers[0].outputs), (1, 1));
    assert!(net.layers[0].weight.iter().chain(&net.layers[0].bias).all(|c| *c >= 0.0));
    // Unit costs are not trained by gradient descent; the error names the command that fits them.
    let tune = "train --quiet --data t.csv --out tuned.safetensors --fine-tune costs.safetensors";
    fails(&data, tune, 1, "--prior costs.safetensors");
    // A learned factor on unit costs is trained further, like any network.
    let factor = "train --quiet --data t.csv --out factor.safetensors --model-kind residual --shade none";
    works(&data, &format!("{factor} --layers 4 --epochs 2"));
    let adapt = "entire train --data FRAMES.csv --fine-tune factor.safetensors";
    assert!(text_of(&data, "factor.md").contains(adapt), "{}", text_of(&data, "factor.md"));
    assert_eq!(m.scene_features.len(), net.layers[0].inputs);
    let shown = works(&data, "evaluate --quiet --model costs.safetensors --data t.csv");
    assert!(shown.lines().any(|line| line.starts_with("member ")), "{shown}");
    assert!(shown.contains("blobs/m02"), "{shown}");
    assert!(shown.contains("noise floor, from repeats of a frame"), "{shown}");
}

/// Without --clock, a model of a GPU's frames predicts device time, since the processor only waits.
#[test]
fn frames_of_a_gpu_teach_the_time_of_the_device() {
    let folder = tempfile::tempdir().unwrap();
    let table = concat!(env!("CARGO_MANIFEST_DIR"), "/../data/timings/none-h100-members.csv.gz");
    let train = ["train", "--data", table, "--out", "here.safetensors", "--layers", "4", "--epochs", "1"];
    succeeds(folder.path(), &train);
    assert_eq!(model(&folder, "here.safetensors").metadata[Key::Clock.name()], "device");
}

#[test]
fn compared_pictures_put_their_law_into_the_model() {
    let data = data(10);
    let pictures = data.path().join("pictures.csv");
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
    let line = "calibrate --data t.csv --out both.safetensors --pictures pictures.csv";
    let said = works(&data, line);
    assert!(said.contains("pictures   3 scenes at 20 ray steps and image sizes"), "{said}");
    let found = load(&model(&data, "both.safetensors")).unwrap().quality("").unwrap();
    for (own, wanted) in [
        (found.image_weight, truth.image_weight),
        (found.step_exponent, truth.step_exponent),
        (found.image_exponent, truth.image_exponent),
        (found.ray_share, truth.ray_share),
    ] {
        assert!((own / wanted - 1.0).abs() < 0.02, "{found:?}");
    }

    // A quality law applies to one renderer; a note says that the model cannot name this renderer.
    let told = stderr(&entire(data.path(), &words(line)));
    assert!(told.contains("the frames have no manifest"), "{told}");

    std::fs::write(&pictures, text.replace("near,1,1,0.02,0", "near,1,1,soon,0")).unwrap();
    fails(&data, line, 1, "line 2, column seconds: \"soon\" is no number");
    std::fs::write(&pictures, text.lines().take(21).collect::<Vec<_>>().join("\n")).unwrap();
    fails(&data, line, 1, "at least 3 scenes");
}

#[test]
fn kept_features_stand_in_for_volumes_that_are_gone() {
    let data = data(6);
    let train = "train --data t.csv --out m.safetensors --layers 4 --epochs 1";
    works(&data, "features --quiet --data t.csv");
    works(&data, &format!("{train} --quiet"));
    let evaluate = "evaluate --model m.safetensors --data t.csv --out evaluation";
    let result = || {
        let output = entire(data.path(), &words(evaluate));
        assert!(output.status.success(), "{}", stderr(&output));
        let evaluation = json(&data.path().join("evaluation/evaluation.json"));
        (evaluation["predictors"][0].clone(), stderr(&output))
    };
    let (with, _) = result();
    assert!(with["latency"]["transfer_seconds"].as_f64().unwrap() > 0.0);
    let moved = data.path().join("moved");
    std::fs::rename(data.path().join("blobs"), &moved).unwrap();
    let (without, err) = result();
    assert!(err.contains("note: m: no latency") && err.contains("blobs/m01/t0000.nrrd"), "{err}");
    assert!(without["latency"].is_null());
    assert_eq!(with["metrics"], without["metrics"]);

    // Volumes are found below a given folder; a quiet run prints no note.
    let elsewhere = tempfile::tempdir().unwrap();
    std::fs::rename(&moved, elsewhere.path().join("blobs")).unwrap();
    let root = format!("--quiet --root {}", elsewhere.path().display());
    std::fs::remove_file(data.path().join("t.features.csv.gz")).unwrap();
    fails(&data, evaluate, 1, "blobs/m01/t0000.nrrd");
    for command in [evaluate, train] {
        let output = entire(data.path(), &words(&format!("{command} {root}")));
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
    }
    works(&data, &format!("features --data t.csv {root}"));

    // With one more row, the features belong to another table.
    let mut text = text_of(&data, "t.csv");
    text.push_str(text.lines().last().unwrap().replace(",1,blobs", ",2,blobs").as_str());
    text.push('\n');
    std::fs::write(data.path().join("t.csv"), text).unwrap();
    fails(&data, evaluate, 1, "`entire features`");
}

#[test]
fn features_of_every_table_are_written_if_nobody_reads_the_output() {
    let data = data(1);
    std::fs::copy(data.path().join("t.csv"), data.path().join("u.csv")).unwrap();
    unread(data.path(), "features --data t.csv u.csv");
    assert!(data.path().join("t.features.csv.gz").exists() && data.path().join("u.features.csv.gz").exists());
}

#[test]
fn what_cannot_be_done_is_said() {
    let data = data(3);
    let train = |more: &str, code: i32, expected: &str| {
        fails(&data, &format!("train --quiet --data t.csv --out m.safetensors {more}"), code, expected);
    };
    for (more, code, expected) in [
        ("--scene-features warp_speed", 1, "warp_speed"),
        ("--inputs weather", 1, "weather"),
        ("--inputs camera,camera", 1, "named twice"),
        ("--test-groups m09", 1, "there are blobs/m01"),
        ("--clock device", 1, "choose another --clock"),
        ("--shade local", 1, "--shade"),
        ("--preset 12C99", 1, "12C256"),
        ("--loss cosine", 2, "huber:DELTA"),
        ("--epochs 0", 1, "epochs is 0"),
        ("--limit 0", 1, "--limit is 0"),
        ("--threads 0", 1, "--threads is 0"),
        ("--learning-rate=-1", 1, "learning rate"),
        ("--fine-tune t.csv", 1, "t.csv"),
        ("--model-kind residual --inputs scene_features,camera", 1, "takes scene_features alone"),
        // Options that would have no effect are refused.
        ("--model-kind residual --preset 4C64", 1, "--preset is for --model-kind prednet"),
        ("--model-kind analytic", 2, "--model-kind"),
        ("--sorted-lobes --fine-tune m.safetensors", 2, "--sorted-lobes"),
        ("--model-kind residual --fine-tune m.safetensors", 2, "--model-kind"),
        ("--sorted-lobes", 1, "--sorted-lobes has no effect without the input group transfer_function"),
        ("--volumenet e.safetensors", 1, "--volumenet has no effect without the input group volume_features"),
        ("--inputs camera --probe-side 7", 1, "--probe-side has no effect without the input group"),
        ("--inputs camera --scene-features pixels", 1, "--scene-features has no effect"),
    ] {
        train(more, code, expected);
    }
    for (line, code, expected) in [
        ("train --data t.csv --out m.bin", 1, ".safetensors"),
        ("train --data nowhere.csv --out m.safetensors", 1, "cannot read nowhere.csv"),
        ("train --data t.csv ./t.csv --out m.safetensors", 1, "./t.csv is given twice, first as t.csv"),
        ("train --out m.safetensors", 2, "--data"),
        ("evaluate --model nowhere.safetensors --data t.csv", 1, "cannot read nowhere.safetensors"),
        ("evaluate --model t.csv --data t.csv", 1, "safetensors"),
    ] {
        fails(&data, line, code, expected);
    }

    // A manifest of another format and a missing volume are refused.
    let manifest = Manifest { format: MANIFEST_FORMAT.replace('1', "9"), repeats: 2, ..Manifest::default() };
    let csv = data.path().join("t.csv");
    manifest.write(&csv).unwrap();
    train("", 1, "entire-timings-1");
    std::fs::remove_file(Manifest::path_for(&csv)).unwrap();
    std::fs::remove_file(data.path().join("blobs/m01/t0000.nrrd")).unwrap();
    train("", 1, "blobs/m01/t0000.nrrd");
    assert!(!data.path().join("m.safetensors").exists());
}
