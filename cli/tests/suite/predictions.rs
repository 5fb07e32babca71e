//! Predictions of shipped models for every committed table, and for a hundred thousand random inputs,
//! ordinary and extreme. All predicted seconds are finite and positive. The networks' raw outputs are
//! positive for every frame of the tables. For random inputs, the number of raw outputs that are zero in
//! single precision is at most that in `KNOWN_ZEROS`; the predictor replaces such outputs.

use crate::support::{files_in, model_of};
use entire_core::kernels::Executor;
use entire_core::model::Model;
use entire_core::nn::{Normalization, PredNet};
use entire_io::dataset::{Table, TimedFrame};
use entire_steer::predict::{PREDICTED_SECONDS, check_predictions};
use entire_train::fit::predict_rows;
use entire_train::inputs::Layout;
use indicatif::ProgressBar;
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};
use std::path::Path;

fn predicting_models() -> Vec<(String, Model)> {
    let name = |p: &Path| p.file_stem().unwrap().to_string_lossy().into_owned();
    files_in("models", ".safetensors")
        .into_iter()
        .map(|p| (name(&p), model_of(&p)))
        .filter(|(_, m)| m.prednet.is_some())
        .collect()
}

fn invalid(seconds: f64) -> bool {
    !(seconds.is_finite() && seconds > 0.0)
}

/// Shipped networks, and the known numbers of their outputs that are zero in single precision and are raised
/// to the shortest time: for ordinary random inputs, and for all random inputs. Numbers are rounded up to the
/// next thousand, since processors round differently. A larger number is a bug.
const KNOWN_ZEROS: [(&str, usize, usize); 3] = [
    ("local-distilled", 0, 27_000),
    ("scatter-distilled", 1_000, 26_000),
    ("unshaded-distilled", 1_000, 33_000),
];

fn known(model: &str) -> (usize, usize) {
    KNOWN_ZEROS.iter().find(|k| k.0 == model).map_or((0, 0), |k| (k.1, k.2))
}

#[test]
fn no_more_predictions_than_are_known_had_to_be_made_positive() {
    const RANDOM: usize = 100_000;
    /// Largest distance of ordinary inputs from the training mean, in standard deviations of the training
    /// frames' inputs.
    const ORDINARY_DISTANCE: f32 = 3.0;
    let models = predicting_models();
    assert!(models.len() >= 6, "{} shipped models", models.len());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let mut of_tables = vec![0usize; models.len()];
    let (mut frames, mut tables) = (0usize, 0usize);
    for path in
        files_in("data/timings", ".csv.gz").iter().filter(|p| !p.to_string_lossy().contains(".features"))
    {
        let table = [Table::read(path, 0).unwrap()];
        if table[0].features.is_none() {
            continue;
        }
        let refs: Vec<&TimedFrame> = table[0].frames.iter().collect();
        let mut judged = false;
        for ((name, model), count) in models.iter().zip(&mut of_tables) {
            let layout = Layout::of_model(model).unwrap();
            // Some tables lack the features of some models.
            let Ok(rows) = layout.rows(&table, &refs, &pool, &ProgressBar::hidden()) else { continue };
            let predicted = predict_rows(model, &layout, &rows, None).unwrap();
            assert!(!predicted.iter().any(|s| invalid(*s)), "{name} on {}", path.display());
            // The shortest time replaces all outputs below it.
            let shortest = f64::from(*PREDICTED_SECONDS.start());
            *count += predicted.iter().filter(|s| **s <= shortest).count();
            frames += predicted.len();
            judged = true;
        }
        tables += usize::from(judged);
    }
    assert!(tables >= 15 && frames > 50_000, "{tables} tables, {frames} predictions");

    let mut rng = ChaCha8Rng::seed_from_u64(17);
    let mut of_random = vec![0usize; models.len()];
    let mut ordinary = vec![0usize; models.len()];
    for (((name, model), count), ordinary) in models.iter().zip(&mut of_random).zip(&mut ordinary) {
        let parts = model.prednet.as_ref().unwrap();
        let net = PredNet::new(parts).unwrap();
        // The inputs of unit costs are counts: of any size, and never negative.
        let counts = Normalization { mean: vec![1e8; net.inputs()], std: vec![1e8; net.inputs()] };
        let (norm, least) = match &parts.input {
            Some(norm) => (norm, f32::NEG_INFINITY),
            None => (&counts, 0.0),
        };
        // Inputs near the training range, inputs far outside of it, and inputs that no scene has.
        for (reach, rows) in [(ORDINARY_DISTANCE, RANDOM / 2), (30.0, RANDOM / 4), (1e6, RANDOM / 4)] {
            let inputs: Vec<f32> = (0..rows)
                .flat_map(|_| norm.mean.iter().zip(&norm.std))
                .map(|(mean, std)| mean + reach * std * (2.0 * rng.random::<f32>() - 1.0))
                .map(|x| x.max(least))
                .collect();
            let mut raw = vec![0.0; rows];
            let scratch = &mut [net.scratch(192).unwrap()];
            net.predict_batch(Executor::Serial, &inputs, &mut raw, scratch).unwrap();
            for value in raw {
                let mut seconds = [value];
                *count += usize::from(value <= 0.0);
                *ordinary += usize::from(value <= 0.0 && reach == ORDINARY_DISTANCE);
                match check_predictions(&mut seconds) {
                    Ok(_) => {
                        let seconds = f64::from(seconds[0]);
                        assert!(!invalid(seconds), "{name}: {value} became {seconds}");
                    }
                    Err(e) => {
                        assert!(!value.is_finite() && e.to_string().contains("finite"), "{name}: {e}");
                    }
                }
            }
        }
    }
    println!(
        "{} of {frames} predictions of frames, {} of {} of random inputs",
        of_tables.iter().sum::<usize>(),
        of_random.iter().sum::<usize>(),
        RANDOM * models.len()
    );
    let sums = [&of_tables, &of_random].map(|counts| counts.iter().sum::<usize>().to_string());
    println!("predictions not positive: {}", sums.join(" "));
    for ((name, _), of_tables) in models.iter().zip(of_tables) {
        assert_eq!(of_tables, 0, "{name}: of the tables' frames");
    }
    for ((name, _), counts) in models.iter().zip(ordinary.into_iter().zip(of_random)) {
        let known = known(name);
        assert!(counts.0 <= known.0 && counts.1 <= known.1, "{name}: {counts:?}, known are {known:?}");
    }
}
