//! Tests of cross-validation, of stored models, of frames at low resolution, and of the repository's studies.

use super::baselines::low_resolution;
use super::findings::noise_of;
use super::runner::{Bounds, Crossed, identity};
use super::*;
use entire_core::scene::{Shading, Skipping};
use entire_io::dataset::feature_table::FeatureTable;
use entire_io::dataset::{Clock, Scene, Table, TimedFrame, Timing, Writer};
use entire_io::metrics::Metrics;
use entire_io::options::thread_pool;
use entire_train::bound;
use entire_train::fit::{FitContext, Recipe};
use entire_train::split::TimedFrames;
use serde_json::json;
use std::path::Path;

/// A table with one frame for each pair of a volume and its member in `volumes`.
pub(super) fn table<S: AsRef<str>>(volumes: &[(S, S)]) -> Table {
    let frame = |number: usize, volume: &str, member: &str| TimedFrame {
        number: number as u64,
        repeats: vec![Timing { wall: Some(0.5), cpu: Some(0.25), ..Timing::default() }],
        ..TimedFrame::of_no_volume(volume, member)
    };
    let frames = volumes.iter().enumerate().map(|(i, (v, m))| frame(i, v.as_ref(), m.as_ref())).collect();
    Table { path: "t.csv".into(), manifest: None, frames, hash: 7, features: None, root: None }
}

/// Frames of members with unrelated seconds: no model can predict a member from the others.
pub(super) fn telling() -> Table {
    let frames: Vec<(String, String)> =
        (0..40).map(|i| (format!("e/m{}/t{}.nrrd", i % 4, i / 4), format!("m{}", i % 4))).collect();
    let mut t = table(&frames);
    for (i, f) in t.frames.iter_mut().enumerate() {
        let seconds = [1.0, 1000.0, 2.0, 500.0][i % 4];
        f.scene.camera.rx = (i % 4) as f32 * 20.0;
        f.repeats = vec![Timing { cpu: Some(seconds), wall: Some(seconds), ..Timing::default() }];
    }
    t
}

#[test]
fn what_is_cross_validated_was_not_learned_from() {
    // Only a predictor that was trained on a member's frames could predict their seconds.
    let t = telling();
    let part = TimedFrames::of(&t.frames, Clock::Cpu);
    let folder = tempfile::tempdir().unwrap();
    let pool = thread_pool(Some(1)).unwrap();
    let hidden = indicatif::ProgressBar::hidden();
    let runner = Runner { pool: &pool, models: folder.path().to_owned(), bar: &hidden, stop: &|| false };
    let tables = [t.clone()];
    let context = FitContext { tables: &tables, pool: &pool, bar: &hidden, stop: &|| false };
    let inputs = vec!["camera".to_owned()];
    for (recipe, trees) in [
        (
            Recipe {
                inputs: inputs.clone(),
                layers: vec![8],
                epochs: 300,
                patience: 300,
                batch: 8,
                learning_rate: Some(1e-2),
                ..Recipe::default()
            },
            false,
        ),
        (Recipe { inputs, ..Recipe::default() }, true),
    ] {
        let Crossed { predicted, measured, folds, groups, .. } =
            runner.crossed("key", (&recipe, trees), &context, &part, &part).unwrap().unwrap();
        assert_eq!((folds, predicted.len(), groups.len()), (4, 40, 40));
        let worst = bound::log_residuals(&predicted, &measured.seconds).into_iter().map(f64::abs);
        assert!(worst.clone().all(|r| r > 0.3), "{:?}", worst.collect::<Vec<_>>());
        let none = TimedFrames::default();
        let seen =
            runner.any("all", (&recipe, trees), &context, (&part, &none), &Bounds::Frames(&none)).unwrap();
        let metrics = Metrics::new(&seen.predict(&context, &part.frames).unwrap(), &part.seconds).unwrap();
        let crossed = Metrics::new(&predicted, &measured.seconds).unwrap();
        assert!(metrics.mdape < 0.5 * crossed.mdape, "{} {}", metrics.mdape, crossed.mdape);
    }
}

#[test]
fn the_noise_of_a_frame_is_that_of_the_median_of_its_repeats() {
    // The repeats of each frame differ from the frame's time by -0.01 s, 0.01 s and (with three repeats) 0 s.
    let rmse = |repeats: usize| {
        let mut t = table(&[("a.nrrd", ""), ("b.nrrd", "")]);
        for (f, seconds) in t.frames.iter_mut().zip([1.0, 3.0]) {
            let times = [seconds - 0.01, seconds + 0.01, seconds];
            f.repeats =
                times[..repeats].iter().map(|s| Timing { cpu: Some(*s), ..Timing::default() }).collect();
        }
        // The times of the two frames have a standard deviation of 1 s, so RMSE/SD equals the RMSE in
        // seconds.
        noise_of(&TimedFrames::of(&t.frames, Clock::Cpu), Clock::Cpu, |_| 1)[1]
    };
    // Estimated variance of one repeat, s²: 2e-4 with two repeats, 1e-4 with three. The median of three has
    // π/2 times the variance of their mean.
    for (repeats, variance) in [(2, 2e-4 / 2.0), (3, std::f64::consts::FRAC_PI_2 * 1e-4 / 3.0)] {
        assert!((rmse(repeats) - f64::sqrt(variance)).abs() < 1e-9, "{}", rmse(repeats));
    }
}

#[test]
fn what_was_made_is_told_apart_by_all_that_it_was_made_of() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("start.safetensors");
    std::fs::write(&file, "one").unwrap();
    let recipe = Recipe { fine_tune: Some(file.clone()), ..Recipe::default() };
    let t = table(&[("a.nrrd", ""), ("b.nrrd", "")]);
    let key = |recipe: &Recipe, t: &Table, clock: Clock| {
        let part = TimedFrames::of(&t.frames, clock);
        identity(recipe, std::slice::from_ref(t), [&part, &part, &part], &[]).unwrap()
    };
    let first = key(&recipe, &t, Clock::Cpu);
    assert_eq!(first, key(&recipe, &t, Clock::Cpu));
    let moved = folder.path().join("moved.safetensors");
    std::fs::copy(&file, &moved).unwrap();
    assert_eq!(first, key(&Recipe { fine_tune: Some(moved), ..recipe.clone() }, &t, Clock::Cpu));

    let part = TimedFrames::of(&t.frames, Clock::Cpu);
    let of = |r: &[f64]| identity(&recipe, std::slice::from_ref(&t), [&part, &part, &part], r).unwrap();
    let mut keys = vec![first, key(&recipe, &t, Clock::Wall), of(&[0.1]), of(&[0.2])];
    keys.push(key(&Recipe { epochs: 7, ..recipe.clone() }, &t, Clock::Cpu));
    keys.push(key(&recipe, &Table { hash: 8, ..t.clone() }, Clock::Cpu));
    for value in [1.0, 2.0] {
        let features = FeatureTable::new(vec!["x".into()], &[0, 1], vec![value, 0.0], 7).unwrap();
        keys.push(key(&recipe, &Table { features: Some(features), ..t.clone() }, Clock::Cpu));
    }
    std::fs::write(&file, "two").unwrap();
    keys.push(key(&recipe, &t, Clock::Cpu));
    let all = keys.len();
    keys.sort();
    keys.dedup();
    assert_eq!(keys.len(), all);
    std::fs::remove_file(&file).unwrap();
    let part = TimedFrames::of(&t.frames, Clock::Cpu);
    let gone = identity(&recipe, std::slice::from_ref(&t), [&part, &part, &part], &[]);
    assert!(gone.unwrap_err().to_string().contains("start.safetensors"));
}

#[test]
fn a_twin_shows_the_same_scene_but_for_its_voxels() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("low.csv");
    let t = table(&[("a.nrrd", "")]);
    let set: Set = serde_json::from_value(json!({
        "name": "s", "training": [], "splits": [], "low_resolution": { "t.csv": path }
    }))
    .unwrap();
    let low = |change: &dyn Fn(&mut Scene)| {
        let mut scene = Scene { dims: [64; 3], ..t.frames[0].scene.clone() };
        change(&mut scene);
        let mut writer = Writer::create(&path).unwrap();
        writer.append(0, &scene, &t.frames[0].repeats).unwrap();
        drop(writer);
        let found = low_resolution(&set, std::slice::from_ref(&t), Clock::Cpu);
        std::fs::remove_file(&path).unwrap();
        found.map_err(|e| e.to_string())
    };
    assert_eq!(low(&|_| ()).unwrap().get(&(0, 0)), Some(&0.25));
    let changes: [&dyn Fn(&mut Scene); 6] = [
        &|s| s.height = 11,
        &|s| s.step = 2.0,
        &|s| s.shading = Shading::Local,
        &|s| s.skipping = Skipping::None,
        &|s| s.volume = "b.nrrd".into(),
        &|s| s.camera.dz = 2.0,
    ];
    for change in changes {
        assert!(low(change).unwrap_err().contains("frame 0 shows a scene that t.csv lacks"));
    }
}

#[test]
fn the_studies_of_the_repository_are_valid() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/timings");
    let paths = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let studies: Vec<_> = paths.filter(|path| path.to_string_lossy().ends_with("study.json")).collect();
    assert!(!studies.is_empty());
    for path in studies {
        let study = read(&path).unwrap_or_else(|e| panic!("{e:#}"));
        assert!(!study.sets.is_empty() && !study.predictors.is_empty(), "{}", path.display());
    }
}
