//! Opens 2000 mutants of model files, predicts with those that open, and encodes a volume. `make bars-robust`
//! runs many more mutants, with a memory limit.

use entire_tests::mutants::{Mutants, exercise};
use entire_tests::small_models;

#[test]
fn mutants_of_model_files_are_refused_or_run() {
    let files = small_models();
    for file in &files {
        assert!(exercise(file).opened, "the seeds themselves are good");
    }
    let mut mutants = Mutants::new(1, &files);
    let (mut opened, mut predicted, mut built, mut encoded) = (0, 0, 0, 0);
    for i in 0..2000 {
        mutants.reseed(i);
        let outcome = exercise(&mutants.next_file());
        opened += usize::from(outcome.opened);
        predicted += usize::from(outcome.predicted);
        built += usize::from(outcome.built);
        encoded += usize::from(outcome.encoded);
    }
    // The generator is effective: it gives both refusals and models that run.
    let counts = format!("{opened} opened, {predicted} predicted, {built} built, {encoded} encoded");
    assert!((100..1900).contains(&opened) && predicted >= 100 && built >= 50 && encoded >= 20, "{counts}");
}
