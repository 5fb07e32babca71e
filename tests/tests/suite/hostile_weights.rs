//! Checks that no prediction is zero, negative, infinite or NaN, for models with hostile weights and for the
//! shipped models.

use entire_core::ErrorKind;
use entire_core::kernels::Executor;
use entire_core::model::{InputGroup, Model, ModelFile};
use entire_core::nn::{DenseParts, Dtype, PredNet, PredNetParts, Target};
use entire_steer::predict::check_predictions;
use entire_tests::mutants::{Random, predict};
use std::path::Path;

fn model(first: f32, last: [f32; 4], target: Target) -> Model {
    let layer = |inputs: usize, outputs: usize, weight: Vec<f32>| DenseParts {
        inputs,
        outputs,
        weight,
        bias: vec![0.0; outputs],
        dtype: Dtype::F32,
    };
    let parts = PredNetParts {
        layers: vec![layer(6, 4, vec![first; 24]), layer(4, 1, last.to_vec())],
        input: None,
        output: None,
        target,
    };
    let groups = [("camera", 3), ("resolution", 2), ("step_size", 1)]
        .map(|(name, size)| InputGroup { name: name.into(), size });
    let mut file = ModelFile::default();
    file.set_prednet(&parts, &groups).expect("finite weights");
    file.to_model().expect("a model")
}

#[test]
fn weights_that_leave_single_precision_are_an_error_and_never_a_time() {
    let huge = 3e38f32;
    for (what, last, target) in [
        ("infinite", [huge; 4], Target::Seconds),
        ("minus infinity", [-huge; 4], Target::Seconds),
        ("NaN", [huge, -huge, huge, -huge], Target::Seconds),
        ("infinite logarithm", [huge; 4], Target::LogSeconds),
        ("NaN logarithm", [huge, -huge, huge, -huge], Target::LogSeconds),
    ] {
        let error = predict(&model(huge, last, target)).expect_err(what);
        assert_eq!(error.kind(), ErrorKind::InvalidModel, "{what}");
        assert!(error.to_string().contains("train the model again"), "{error}");
    }
    // An exponential that overflows although its argument is finite.
    let overflow = predict(&model(1.0, [1.0; 4], Target::LogSeconds)).expect_err("an overflow");
    assert_eq!(overflow.kind(), ErrorKind::InvalidModel);
}

#[test]
fn times_that_are_not_positive_are_the_shortest_one_and_not_trusted() {
    for (what, last, target) in [
        ("negative", [-1.0; 4], Target::Seconds),
        ("zero", [0.0; 4], Target::Seconds),
        ("very negative", [-3e30; 4], Target::Seconds),
        ("vanishing exponential", [-1.0; 4], Target::LogSeconds),
    ] {
        let p = predict(&model(1.0, last, target)).expect(what);
        assert_eq!(p.seconds, 1e-6, "{what}");
        assert!(p.out_of_range >= 1000.0, "{what}: {p:?}");
    }
    let good = predict(&model(1e-3, [1.0; 4], Target::Seconds)).expect("a time");
    assert!(good.seconds > 1.0 && !(good.out_of_range > 0.0), "{good:?}");
}

#[test]
fn only_finite_outputs_are_times_and_the_rest_is_brought_into_range() {
    for (raw, expected) in
        [(0.5, (0.5, 0)), (-1.0, (1e-6, 1)), (0.0, (1e-6, 1)), (1e30, (1e9, 1)), (2.0, (2.0, 0))]
    {
        let mut seconds = [raw];
        let brought = check_predictions(&mut seconds).expect("a finite number");
        assert_eq!((seconds[0], brought), expected);
    }
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let error = check_predictions(&mut [0.5, bad]).expect_err("not a number of seconds");
        assert_eq!(error.kind(), ErrorKind::InvalidModel, "{error}");
        assert!(error.to_string().contains("row 1"), "{error}");
    }
}

#[test]
fn shipped_models_give_times_for_ten_thousand_random_inputs() {
    const ROWS: usize = 10_000;
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    let mut tried = 0;
    for entry in std::fs::read_dir(folder).expect("the shipped models") {
        let path = entry.expect("an entry").path();
        if path.extension().is_none_or(|e| e != "safetensors") {
            continue;
        }
        let model = Model::from_bytes(&std::fs::read(&path).expect("a file")).expect("a shipped model");
        let Some(parts) = model.prednet.as_ref() else { continue };
        let net = PredNet::new(parts).expect("a network");
        let mut random = Random::new(88_172_645_463_325_252);
        let mut uniform = || random.uniform();
        // Up to three standard deviations from the training mean of each input.
        let inputs: Vec<f32> = match &parts.input {
            Some(norm) => (0..ROWS)
                .flat_map(|_| norm.mean.iter().zip(&norm.std))
                .map(|(mean, std)| mean + 3.0 * std * uniform())
                .collect(),
            // The inputs of a unit-cost model are counts.
            None => (0..ROWS * net.inputs()).map(|_| 1e8 * (1.0 + uniform())).collect(),
        };
        let mut seconds = vec![0.0; ROWS];
        let scratch = &mut net.scratch(192).expect("memory");
        net.predict_batch(Executor::Serial, &inputs, &mut seconds, std::slice::from_mut(scratch))
            .expect("a batch");
        check_predictions(&mut seconds).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(seconds.iter().all(|s| s.is_finite() && *s > 0.0), "{}", path.display());
        tried += 1;
    }
    assert!(tried >= 6, "{tried} shipped models");
}
