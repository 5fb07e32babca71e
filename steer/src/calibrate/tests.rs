//! Tests the fit on work with known costs, and the random sampling of frames by a calibration.

use super::*;
use crate::features::tests::frame;
use crate::features::{COST_QUANTITIES, Changes, FrameFeatures, SceneFeature, SceneQuantity, Setting};
use crate::numeric::median;
use crate::predict::{AnalyticModel, GroupKind, InputLayout, Inputs};
use alloc::vec;
use entire_core::nn::{DenseParts, Dtype, Normalization, PredNetParts, Target};

/// Returns a model file with the unit costs of a software renderer and a learned factor that is always 1, for
/// a probe with `side`² rays.
pub(crate) fn unit_factor(side: usize) -> ModelFile {
    let inputs = [
        (SceneQuantity::Pixels, 10.5, 1.6),
        (SceneQuantity::RaySpacing, 0.0, 1.0),
        (SceneQuantity::Voxels, 15.0, 1.3),
        (SceneQuantity::EstimatedSeconds, -3.5, 1.8),
    ];
    let parts = PredNetParts {
        // Returns ln(estimated seconds): the standardized logarithm times its standard deviation, plus its
        // mean.
        layers: vec![DenseParts {
            inputs: 4,
            outputs: 1,
            weight: vec![0.0, 0.0, 0.0, 1.8],
            bias: vec![-3.5],
            dtype: Dtype::F32,
        }],
        input: Some(Normalization {
            mean: inputs.iter().map(|i| i.1).collect(),
            std: inputs.iter().map(|i| i.2).collect(),
        }),
        output: Some(Normalization { mean: vec![0.0], std: vec![1.0] }),
        target: Target::LogSeconds,
    };
    let features = inputs.iter().map(|&(quantity, ..)| SceneFeature { quantity, log: true }).collect();
    let mut layout = InputLayout::new(&[GroupKind::SceneFeatures], features, 0, 0).unwrap();
    layout.unit_costs = Some(UnitCosts::SOFTWARE);
    layout.probe_side = side;
    let mut file = ModelFile::default();
    layout.store(&parts, &mut file).unwrap();
    file
}

/// Work of frame i; the amounts differ between frames and between quantities.
fn work(i: usize) -> [f64; COSTS] {
    core::array::from_fn(|k| match k {
        0 => 1.0,
        _ => 1e4 * ((i * (7 * k + 3) + k * k) % 29) as f64 + 1e3,
    })
}

/// Returns the observation of frame i, which shows volume i mod 6.
fn observed(i: usize, work: [f64; COSTS], seconds: f64) -> Observed {
    Observed { work, seconds, group: i as u64 % 6 }
}

/// Fits a model to frames, with this prior and the typical costs of a software renderer.
fn fitted(prior: &PriorModel, frames: &[Observed]) -> Chosen {
    prior.choose(frames, &[UnitCosts::SOFTWARE]).unwrap()
}

fn costs_of(chosen: &Chosen) -> UnitCosts {
    AnalyticModel::from_model(&chosen.file.to_model().unwrap()).unwrap().unwrap().costs()
}

fn seconds_by(costs: &[f64; COSTS], work: &[f64; COSTS]) -> f64 {
    costs.iter().zip(work).map(|(c, w)| c * w).sum()
}

#[test]
fn a_calibration_finds_another_machines_unit_costs() {
    let prior =
        PriorModel::new(&[AnalyticModel::default().to_model_file().unwrap()], &UnitCosts::SOFTWARE).unwrap();
    for (found, stored) in prior.costs.seconds.iter().zip(&UnitCosts::SOFTWARE.seconds) {
        assert!((found / stored - 1.0).abs() < 1e-6 || *stored == 0.0, "{found} {stored}");
    }
    // On the simulated machine, three unit costs differ from the prior; then all costs are multiplied by 1.7.
    let mut machine = UnitCosts::SOFTWARE.seconds;
    (machine[1], machine[4], machine[13]) = (4.0 * machine[1], 2.0 * machine[4], 0.5 * machine[13]);
    let seconds = |i: usize| 1.7 * seconds_by(&machine, &work(i));
    let frames: Vec<Observed> = (0..80).map(|i| observed(i, work(i), seconds(i))).collect();
    let chosen = fitted(&prior, &frames);
    assert_eq!(chosen.folds, 6);
    let there = costs_of(&chosen).seconds;
    let mut errors: Vec<f64> =
        (100..160).map(|i| (seconds_by(&there, &work(i)) / seconds(i) - 1.0).abs()).collect();
    let middle = median(&mut errors).unwrap();
    assert!(middle < 0.03 && errors[errors.len() - 1] < 0.2, "{middle} {errors:?}");
    // Two volumes are too few for cross-validation, so there are no folds.
    let few: Vec<Observed> = frames.iter().filter(|f| f.group < 2).cloned().collect();
    assert_eq!(fitted(&prior, &few).folds, 0);
    assert!(prior.choose(&[], &[UnitCosts::SOFTWARE]).is_err());
}

#[test]
fn the_longest_ray_is_found_to_cost_time_where_it_does() {
    const LONGEST: usize = crate::features::COMMON_COSTS + 1;
    let prior = PriorModel::default();
    // The longest ray has far less work than all rays together.
    let work = |i: usize| {
        let mut work = work(i);
        work[LONGEST..].iter_mut().for_each(|w| *w *= 1e-3);
        work
    };
    let mut software = UnitCosts::SOFTWARE.seconds;
    (software[3], software[4]) = (3.0 * software[3], 2.0 * software[4]);
    for (machine, on_gpu) in [(software, false), (UnitCosts::GPU.seconds, true)] {
        let frames: Vec<Observed> = (0..120)
            .map(|i| {
                let noise = 1.0 + 0.01 * ((i * 31 % 7) as f64 - 3.0);
                observed(i, work(i), noise * seconds_by(&machine, &work(i)))
            })
            .collect();
        let fitted = |renderers: &[UnitCosts]| {
            let chosen = prior.choose(&frames, renderers).unwrap();
            let (median, rmse_over_sd) = chosen.errors(&frames);
            (costs_of(&chosen).seconds, (median * rmse_over_sd).sqrt())
        };
        let ((plain, plain_error), (found, error)) =
            (fitted(&[UnitCosts::CONVERSION]), fitted(&UnitCosts::OF_UNKNOWN));
        assert!(plain[LONGEST..].iter().all(|c| *c == 0.0));
        assert_eq!(found[LONGEST] > 0.0, on_gpu, "{plain_error} {error}");
        assert!(if on_gpu { error < 0.5 * plain_error } else { found == plain }, "{plain_error} {error}");
    }
}

#[test]
fn equal_times_are_judged_by_the_median_error() {
    // The computed mean of 60 times of 0.01 s is not 0.01 s.
    for seconds in [0.015_625, 0.01] {
        let frames: Vec<Observed> = (0..60).map(|i| observed(i, work(i), seconds)).collect();
        let chosen = PriorModel::default().choose(&frames, &UnitCosts::OF_UNKNOWN).unwrap();
        let (median, rmse_over_sd) = chosen.errors(&frames);
        assert!(median.is_finite() && rmse_over_sd.is_nan(), "{median} {rmse_over_sd}");
    }
}

#[test]
fn the_number_of_cached_voxels_is_found_where_frames_tell_it() {
    let prior = PriorModel::default();
    // Frames touch 0.1 to 60 million voxels. The time of reads that wait for memory varies independently of
    // the number of samples.
    let work = |i: usize| {
        let quantity = |name: &str| 1 + COST_QUANTITIES.iter().position(|q| q.name() == name).unwrap();
        let touched = 1e5 * libm::exp(6.4 * (i * 37 % 101) as f64 / 100.0);
        let samples = 1e6 * (1.0 + (i * 53 % 17) as f64);
        let mut work = [0.0; COSTS];
        (work[0], work[1], work[quantity("samples")]) = (1.0, 2e5, samples);
        let uncached = touched * touched / (touched * touched + UnitCosts::CACHED_VOXELS.powi(2));
        let share = (i * 29 % 13) as f64 / 12.0 * uncached;
        work[quantity("far_samples")] = share * samples;
        work[quantity("touched_voxels")] = touched;
        work
    };
    let mut machine = UnitCosts::SOFTWARE;
    for cached_voxels in [2e6, 8e6, 16e6] {
        machine.cached_voxels = cached_voxels;
        let frames: Vec<Observed> = (0..150).map(|i| observed(i, work(i), machine.time(&work(i)))).collect();
        let chosen = fitted(&prior, &frames);
        let there = costs_of(&chosen);
        assert_eq!(there.cached_voxels, cached_voxels);
        for i in 150..200 {
            let error = there.time(&work(i)) / machine.time(&work(i)) - 1.0;
            assert!(error.abs() < 0.01, "{cached_voxels} {error}");
        }
        let next = PriorModel::new(core::slice::from_ref(&chosen.file), &UnitCosts::SOFTWARE);
        assert_eq!(next.unwrap().costs.cached_voxels, cached_voxels);
        // With too few groups for cross-validation, the prior's number stays.
        let few: Vec<Observed> = frames.iter().filter(|f| f.group < 2).cloned().collect();
        assert!(!fitted(&prior, &few).file.metadata.contains_key(Key::CachedVoxels.name()));
    }
}

#[test]
fn three_frames_set_the_speed_alone() {
    let prior = PriorModel::default();
    let frames: Vec<Observed> =
        (0..3).map(|i| observed(i, work(i), 3.0 * seconds_by(&prior.costs.seconds, &work(i)))).collect();
    let there = costs_of(&fitted(&prior, &frames));
    for (found, known) in there.seconds.iter().zip(&prior.costs.seconds) {
        assert!(*known == 0.0 || (found / known / 3.0 - 1.0).abs() < 1e-3, "{found} {known}");
    }
}

#[test]
fn several_machines_make_one_prior() {
    let model = |scale: f64| {
        let costs = UnitCosts::SOFTWARE.seconds.map(|c| scale * c);
        AnalyticModel::from_costs(UnitCosts::new(costs)).unwrap().to_model_file().unwrap()
    };
    let prior = PriorModel::new(&[model(0.5), model(8.0)], &UnitCosts::SOFTWARE).unwrap();
    for (found, stored) in prior.costs.seconds.iter().zip(&UnitCosts::SOFTWARE.seconds) {
        assert!((found - 2.0 * stored).abs() <= 1e-6 * stored, "{found} {stored}");
    }
    // A cost of 0 in a machine's model means that the machine's frames could not determine the cost. Checks
    // that the prior's cost is positive if only one of two models has a cost of 0.
    let mut blind = UnitCosts::SOFTWARE.seconds;
    blind[2] = 0.0;
    let blind = AnalyticModel::from_costs(UnitCosts::new(blind)).unwrap().to_model_file().unwrap();
    let prior = PriorModel::new(&[model(1.0), blind], &UnitCosts::SOFTWARE).unwrap();
    let ratio = prior.costs.seconds[2] / UnitCosts::SOFTWARE.seconds[2];
    assert!((0.1..1.0).contains(&ratio), "{ratio}");
    let error = PriorModel::new(&[unit_factor(5)], &UnitCosts::SOFTWARE).err().unwrap().to_string();
    assert!(error.contains("`entire calibrate` made"), "{error}");
}

/// Returns the simulated seconds of a renderer with two unit costs: per frame and per pixel.
fn seconds_of(features: &FrameFeatures, setting: &Setting) -> f64 {
    let work = features.cost_work(setting);
    let pixels = 1 + COST_QUANTITIES.iter().position(|q| q.to_string() == "pixels").unwrap();
    5e-4 + 9e-8 * work[pixels]
}

#[test]
fn frames_are_kept_fairly_and_a_model_is_fitted_to_them() {
    assert!(Calibration::new(None, 7).is_err() && Calibration::new(None, 100_000).is_err());
    let mut calibration = Calibration::new(None, 60).unwrap();
    assert_eq!(calibration.frames(), 0);
    assert_eq!(calibration.fit(["", ""]).unwrap_err().kind(), entire_core::ErrorKind::NotReady);
    let features = FrameFeatures::default();
    let at = |size: u32| Setting::from(&frame(10.0, 20.0, 2.0, size));
    let inputs = |size: u32| Inputs {
        features: &features,
        setting: at(size),
        changes: Changes::default(),
        camera: features.pose(),
        volume_features: None,
        lobes: None,
    };
    let place = calibration.kept.as_ptr();
    for i in 0..600u64 {
        let size = 40 + (i * 37 % 200) as u32;
        let shown = Shown { volume: i / 150, transfer: i / 50 };
        calibration.add_work(&features.cost_work(&at(size)), shown, seconds_of(&features, &at(size)));
    }
    assert_eq!((calibration.frames(), calibration.offered), (60, 600));
    assert_eq!(place, calibration.kept.as_ptr(), "moved");
    // Of each quarter of the frames, about the same number is kept: 15 are expected, with a standard
    // deviation of 3.2.
    for quarter in 0..4 {
        let n = calibration.kept.iter().filter(|k| k.order / 150 == quarter).count();
        assert!((5..=25).contains(&n), "{quarter}: {n}");
    }
    let fitted = calibration.fit(["my renderer", "wall"]).unwrap();
    assert_eq!((fitted.held_out, fitted.frames), (HeldOut::Volumes, 60));
    assert!(fitted.median_error < 0.02, "{}", fitted.median_error);
    assert!(fitted.upper.factor() >= 0.95 && fitted.upper.factor() < 1.1, "{:?}", fitted.upper);
    assert_eq!(fitted.file.metadata["entire.clock"], "wall");
    assert_eq!(fitted.file.metadata[Key::Renderer.name()], "my renderer");
    // The file can be written and read, and its model predicts the measured times.
    let model = entire_core::Model::from_bytes(&fitted.file.to_bytes().unwrap()).unwrap();
    let mut predictor = crate::predict::load(&model).unwrap();
    for size in [45, 90, 200] {
        let p = predictor.predict(&inputs(size)).unwrap();
        let t = seconds_of(&features, &at(size));
        assert!((f64::from(p.seconds) / t - 1.0).abs() < 0.05, "{size}: {} {t}", p.seconds);
        assert!(p.upper >= p.seconds);
    }
    // The fitted file can serve as a prior.
    assert!(Calibration::new(Some(&fitted.file), 8).is_ok());
}

#[test]
fn what_is_left_out_follows_from_what_was_shown() {
    let held_out = |frames: u64, shown: fn(u64) -> Shown| {
        let mut calibration = Calibration::new(None, 500).unwrap();
        for i in 0..frames {
            calibration.add_work(&[1.0; COSTS], shown(i), 0.01 + 1e-4 * (i % 5) as f64);
        }
        let fitted = calibration.fit(["", ""]).unwrap();
        assert!(!fitted.file.metadata.contains_key("entire.clock"));
        fitted.held_out
    };
    assert_eq!(held_out(30, |i| Shown { volume: i % 3, transfer: 0 }), HeldOut::Volumes);
    assert_eq!(held_out(30, |i| Shown { volume: 5, transfer: i % 4 }), HeldOut::TransferFunctions);
    assert_eq!(held_out(30, |_| Shown::default()), HeldOut::Stretches);
    assert_eq!(held_out(14, |_| Shown::default()), HeldOut::Nothing);
}
