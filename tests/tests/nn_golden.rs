//! Compares PredNet and VolumeNet with float64 evaluations by PyTorch (`tests/golden/make_golden.py`), with
//! one test for every level (instruction set). A level that this CPU lacks is reported as ignored.

use entire_core::kernels::{Executor, Level, Storage};
use entire_core::model::Model;
use entire_core::nn::{Dtype, PredNet, PredScratch, VOLUMENET_TOLERANCE, VolumeNet};
use entire_core::scene::{Scalars, VolumeView};
use entire_tests::levels::on_every_level;
use libtest_mimic::{Arguments, Trial};
use serde_json::Value;
use std::path::PathBuf;

fn golden(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("golden").join(name)
}

fn cases(kind: &str) -> Vec<Value> {
    let text = std::fs::read_to_string(golden("golden.json")).expect("golden.json");
    let json: Value = serde_json::from_str(&text).expect("valid JSON");
    json[kind].as_array().expect("a list of cases").clone()
}

fn model(case: &Value) -> Model {
    let name = case["model"].as_str().expect("a file name");
    Model::from_bytes(&std::fs::read(golden(name)).expect(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("numbers").iter().map(|v| v.as_f64().expect("a number")).collect()
}

fn rows(case: &Value) -> (Vec<Vec<f32>>, Vec<f64>) {
    let inputs = case["inputs"].as_array().expect("rows");
    let inputs = inputs.iter().map(|row| numbers(row).into_iter().map(|v| v as f32).collect()).collect();
    (inputs, numbers(&case["seconds"]))
}

/// Storage format of a file's weights.
fn stored(model: &Model) -> Dtype {
    model.prednet.as_ref().expect("a PredNet").layers[0].dtype
}

fn network(model: &Model, level: Level, storage: Storage) -> PredNet {
    PredNet::with(model.prednet.as_ref().expect("a PredNet"), level, storage).expect("a network")
}

/// Predicts rows on this thread.
fn predict(
    net: &PredNet,
    rows: &[f32],
    out: &mut [f32],
    scratch: &mut PredScratch,
) -> entire_core::Result<()> {
    net.predict_batch(Executor::Serial, rows, out, std::slice::from_mut(scratch))
}

/// Checks the error of predictions, single and in batches. If a format stores the weights exactly, the error
/// is relative to each result. If it rounds them, the error is relative to the largest result, since rounding
/// can change a sum by a large factor if its terms nearly cancel.
fn prednets_agree(level: Level) {
    for case in cases("prednets") {
        let (model, (inputs, expected)) = (model(&case), rows(&case));
        let name = case["model"].as_str().expect("a name");
        let scale = expected.iter().fold(0.0f64, |m, y| m.max(y.abs()));
        for storage in Storage::ALL {
            let net = network(&model, level, storage);
            let tolerance = PredNet::tolerance(storage, stored(&model));
            let exact = tolerance == PredNet::tolerance(Storage::F32, stored(&model));
            let allowed = |y: f64| tolerance * if exact { y.abs() } else { scale };
            let mut scratch = net.scratch(1).expect("memory");
            let single: Vec<f32> = inputs.iter().map(|row| net.predict(row, &mut scratch)).collect();
            for rows in [1, 2, 5, 192] {
                let mut scratch = net.scratch(rows).expect("memory");
                let mut batch = vec![0.0; inputs.len()];
                predict(&net, &inputs.concat(), &mut batch, &mut scratch).expect("a batch");
                for (i, &y) in expected.iter().enumerate() {
                    for (how, found) in [("predict", single[i]), ("predict_batch", batch[i])] {
                        let error = (f64::from(found) - y).abs();
                        assert!(
                            error <= allowed(y),
                            "{name} row {i}, {} on {level}, {how} with {rows} rows at once: {found} instead of {y}, \
                             error {:.2e}",
                            storage,
                            error / y.abs()
                        );
                    }
                }
            }
        }
    }
}

/// Checks the features of encoders with kernels, strides and paddings of several sizes, and with weights in
/// each format of a file.
fn encoders_agree(level: Level) {
    for case in cases("volumenets") {
        let (model, expected) = (model(&case), numbers(&case["features"]));
        let name = case["voxels"].as_str().expect("a file name");
        let voxels = std::fs::read(golden(name)).expect(name);
        let edge = case["edge"].as_u64().expect("an edge") as usize;
        let view = VolumeView::new(Scalars::U8(&voxels), [edge; 3]).expect("a volume");
        let net = VolumeNet::with(model.volumenet.as_ref().expect("a VolumeNet"), level).expect("an encoder");
        let mut features = vec![0.0; expected.len()];
        net.encode(&view, &mut net.scratch(), Executor::Serial, &mut features).expect("an encoding");
        let norm = expected.iter().map(|e| e * e).sum::<f64>().sqrt();
        for (&found, expected) in features.iter().zip(&expected) {
            let error = (f64::from(found) - expected).abs() / norm;
            assert!(error <= VOLUMENET_TOLERANCE, "{name} on {level}: {features:?}, error {error:e}");
        }
    }
}

fn storage_follows_the_file() {
    for case in cases("prednets") {
        let model = model(&case);
        let parts = model.prednet.as_ref().expect("a PredNet");
        let expected = match case["dtype"].as_str().expect("a dtype") {
            "F16" => Storage::F16,
            "BF16" => Storage::Bf16,
            _ => Storage::F32,
        };
        let kept = PredNet::with(parts, Level::detect(), expected).expect("a network");
        let net = PredNet::new(parts).expect("a network");
        assert_eq!(net.memory(), kept.memory());
    }
}

/// Checks that a row's result has the same bits for any split of the batch and any other rows in it.
fn batches_do_not_depend_on_their_cut(level: Level) {
    for case in cases("prednets") {
        let (model, (inputs, _)) = (model(&case), rows(&case));
        for storage in Storage::ALL {
            let net = network(&model, level, storage);
            let many: Vec<f32> = inputs.iter().cycle().take(401).flatten().copied().collect();
            let mut expected = vec![0.0; 401];
            predict(&net, &many, &mut expected, &mut net.scratch(192).expect("memory")).expect("a batch");
            for rows in [1, 7, 100, 1000] {
                let mut found = vec![0.0; 401];
                predict(&net, &many, &mut found, &mut net.scratch(rows).expect("memory")).expect("a batch");
                assert_eq!(found, expected, "{rows} rows at once, {storage}");
            }
            for (i, y) in expected.iter().enumerate() {
                assert_eq!(y.to_bits(), expected[i % inputs.len()].to_bits(), "row {i}");
            }
        }
    }
}

fn bad_inputs_have_an_answer(level: Level) {
    for case in cases("prednets") {
        let (model, (inputs, _)) = (model(&case), rows(&case));
        for storage in Storage::ALL {
            let net = network(&model, level, storage);
            let mut scratch = net.scratch(1).expect("memory");
            let row = &inputs[0];
            let good = net.predict(row, &mut scratch);
            assert!(good.is_finite());
            assert!(net.predict(&row[1..], &mut scratch).is_nan(), "too few inputs");
            assert!(net.predict(&[], &mut scratch).is_nan(), "no inputs");
            assert!(net.predict(row, &mut Default::default()).is_nan(), "an empty scratch");
            for i in 0..row.len() {
                let mut bad = row.clone();
                bad[i] = f32::NAN;
                assert!(net.predict(&bad, &mut scratch).is_nan(), "NaN at input {i}");
                for big in [f32::INFINITY, f32::NEG_INFINITY, f32::MAX] {
                    bad[i] = big;
                    let _ = net.predict(&bad, &mut scratch);
                }
            }
            let again = net.predict(row, &mut scratch);
            assert_eq!(again.to_bits(), good.to_bits(), "the scratch keeps no trace");
            let mut out = [0.0; 2];
            assert!(predict(&net, row, &mut out, &mut scratch).is_err(), "inputs for one, outputs for two");
            let empty = &mut PredScratch::default();
            assert!(predict(&net, row, &mut out[..1], empty).is_err(), "an empty scratch");
            assert!(predict(&net, &[], &mut [], &mut scratch).is_ok(), "nothing to do");
        }
    }
}

fn main() {
    let arguments = Arguments::from_args();
    let mut trials = Vec::new();
    trials.extend(on_every_level("prednets_agree_with_float64", prednets_agree));
    trials.extend(on_every_level("encoders_agree_with_float64", encoders_agree));
    trials.extend(on_every_level("batches_do_not_depend_on_their_cut", batches_do_not_depend_on_their_cut));
    trials.extend(on_every_level("bad_inputs_have_an_answer", bad_inputs_have_an_answer));
    trials.push(Trial::test("storage_follows_the_file", || {
        storage_follows_the_file();
        Ok(())
    }));
    libtest_mimic::run(&arguments, trials).exit();
}
