//! No prediction of a shipped model is zero, negative or no number: over every committed table, and over a
//! hundred thousand random inputs, ordinary and hostile.

use entire_cli::dataset::{Table, TimedFrame};
use entire_cli::fit::predict_rows;
use entire_cli::inputs::Layout;
use entire_core::model::{Model, ModelFile};
use entire_core::nn::{Executor, PredNet};
use entire_core::predict::check_predictions;
use indicatif::ProgressBar;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::path::{Path, PathBuf};

fn files_in(folder: &str, ending: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(folder);
    let mut out: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| p.to_string_lossy().ends_with(ending))
        .collect();
    out.sort();
    out
}

fn predicting_models() -> Vec<(PathBuf, Model)> {
    files_in("models", ".safetensors")
        .into_iter()
        .map(|p| (p.clone(), Model::from_bytes(&std::fs::read(&p).unwrap()).unwrap()))
        .filter(|(_, m)| m.prednet().is_some())
        .collect()
}

fn invalid(seconds: f64) -> bool {
    !(seconds.is_finite() && seconds > 0.0)
}

#[test]
fn every_prediction_is_a_positive_number_of_seconds() {
    const RANDOM: usize = 100_000;
    let models = predicting_models();
    assert!(models.len() >= 6, "{} shipped models", models.len());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let (mut frames, mut tables, mut not_positive, mut brought) = (0usize, 0usize, 0usize, 0usize);
    for path in
        files_in("data/timings", ".csv.gz").iter().filter(|p| !p.to_string_lossy().contains(".features"))
    {
        let table = [Table::read(path, 0).unwrap()];
        if table[0].features.is_none() {
            continue;
        }
        let refs: Vec<&TimedFrame> = table[0].frames.iter().collect();
        let mut judged = false;
        for (_, model) in &models {
            let layout = Layout::of_model(model).unwrap();
            // Some tables do not keep what some models take.
            let Ok(rows) = layout.rows(&table, &refs, &pool, &ProgressBar::hidden()) else { continue };
            let predicted = predict_rows(model, &rows, layout.width()).unwrap();
            not_positive += predicted.iter().filter(|s| invalid(**s)).count();
            frames += predicted.len();
            judged = true;
        }
        tables += usize::from(judged);
    }
    assert!(tables >= 15 && frames > 50_000, "{tables} tables, {frames} predictions");

    let mut rng = ChaCha8Rng::seed_from_u64(17);
    for (path, model) in &models {
        let parts = model.prednet().unwrap();
        let net = PredNet::new(parts).unwrap();
        let norm = parts.input.as_ref().expect("shipped models know their inputs' spread");
        // Ordinary inputs, inputs far outside, and inputs as no scene has them.
        for (reach, rows) in [(3.0, RANDOM / 2), (30.0, RANDOM / 4), (1e6, RANDOM / 4)] {
            let inputs: Vec<f32> = (0..rows)
                .flat_map(|_| norm.mean.iter().zip(&norm.std))
                .map(|(mean, std)| mean + reach * std * (2.0 * rng.random::<f32>() - 1.0))
                .collect();
            let mut raw = vec![0.0; rows];
            net.predict_batch(
                Executor::Serial,
                &inputs,
                &mut raw,
                std::slice::from_mut(&mut net.scratch(192).unwrap()),
            )
            .unwrap();
            for value in raw {
                let mut seconds = [value];
                match check_predictions(&mut seconds) {
                    Ok(clamped) => {
                        not_positive += usize::from(invalid(f64::from(seconds[0])));
                        brought += clamped;
                    }
                    Err(e) => {
                        assert!(
                            !value.is_finite() && e.to_string().contains("finite"),
                            "{}: {e}",
                            path.display()
                        );
                    }
                }
            }
        }
    }
    println!("predictions not positive: {not_positive}");
    assert_eq!(not_positive, 0);
    // The test must be able to fail: networks on seconds do leave the range that a time has.
    assert!(brought > 0, "no network left the range of times");
}

#[test]
fn hostile_models_predict_positive_seconds_or_are_refused() {
    let (path, _) =
        predicting_models().into_iter().find(|(p, _)| p.ends_with("local-distilled.safetensors")).unwrap();
    let file = ModelFile::from_bytes(&std::fs::read(path).unwrap()).unwrap();
    let model = file.to_model().unwrap();
    let width: usize = model.inputs().iter().map(|g| g.size).sum();
    let mean = model.prednet().unwrap().input.as_ref().unwrap().mean.clone();
    for factor in [-1.0, -1e3, 0.0, 1e4, -1e20] {
        let mut parts = model.prednet().unwrap().clone();
        let last = parts.layers.last_mut().unwrap();
        last.weight.iter_mut().chain(&mut last.bias).for_each(|w| *w *= factor);
        let mut hostile = file.clone();
        // Some of these cannot be stored: the file refuses them, which is as good.
        let Ok(hostile) = hostile.set_prednet(&parts, model.inputs()).and_then(|f| f.to_model()) else {
            continue;
        };
        match predict_rows(&hostile, &mean, width) {
            Ok(seconds) => assert!(seconds.iter().all(|s| !invalid(*s)), "{factor}: {seconds:?}"),
            Err(e) => assert!(format!("{e:#}").contains("finite number"), "{factor}: {e:#}"),
        }
    }
}
