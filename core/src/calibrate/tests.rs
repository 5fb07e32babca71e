//! The fit against work whose costs are known, and what a calibration keeps.

use super::*;
use crate::features::{COST_QUANTITIES, Changes, FrameFeatures, PROBE_SIDE, Setting};
use crate::nn::PredNet;
use crate::predict::AnalyticModel;
use crate::scene::{Arcball, Camera, Frame};
use alloc::vec;

fn predict(file: &ModelFile, rows: &[f32]) -> Vec<f64> {
    let model = file.to_model().unwrap();
    let net = PredNet::new(model.prednet().unwrap()).unwrap();
    let mut scratch = net.scratch(1).unwrap();
    rows.chunks_exact(net.inputs()).map(|row| f64::from(net.predict(row, &mut scratch))).collect()
}

#[test]
fn a_posterior_finds_another_machines_unit_costs_and_keeps_the_rest() {
    let prior = blank_prior(PROBE_SIDE).unwrap();
    let model = PriorModel::new(&prior).unwrap();
    // Of each kind of work another amount, as frames hold it; three kinds cost something else here.
    let mut machine = UnitCosts::SOFTWARE.0;
    (machine[1], machine[4], machine[9]) = (4.0 * machine[1], 2.0 * machine[4], 0.5 * machine[9]);
    let work = |i: usize| -> [f64; COSTS] {
        core::array::from_fn(|k| match k {
            0 => 1.0,
            _ => 1e4 * ((i * (7 * k + 3) + k * k) % 29) as f64 + 1e3,
        })
    };
    let width: usize = prior.to_model().unwrap().inputs().iter().map(|g| g.size).sum();
    let row = |i: usize, costs: &[f64; COSTS]| -> Vec<f32> {
        let estimate: f64 = costs.iter().zip(work(i)).map(|(c, w)| c * w).sum();
        let mut row: Vec<f32> = (0..width).map(|k| ((i * (k + 2)) % 7) as f32).collect();
        row[width - 1] = estimate.ln() as f32;
        row
    };
    let seconds = |i: usize| 1.7 * machine.iter().zip(work(i)).map(|(c, w)| c * w).sum::<f64>();
    let frames: Vec<Observed> = (0..80)
        .map(|i| Observed {
            row: row(i, model.costs()),
            work: work(i),
            seconds: seconds(i),
            group: i as u64 % 6,
        })
        .collect();
    let chosen = model.choose(&frames, &UnitCosts::SOFTWARE, |_| true, Executor::Serial).unwrap();
    assert_eq!(chosen.folds, 6);
    // Costs must move for this, and cross-validation says so.
    assert!(chosen.belief.costs > 0.0, "{:?}", chosen.belief);
    let stored: alloc::collections::BTreeMap<String, f64> =
        serde_json::from_str(&chosen.file.metadata[Key::UnitCosts.name()]).unwrap();
    let costs: [f64; COSTS] = core::array::from_fn(|k| stored[UnitCosts::SOFTWARE.named().nth(k).unwrap().0]);
    let rows: Vec<f32> = (100..160).flat_map(|i| row(i, &costs)).collect();
    let there = predict(&chosen.file, &rows);
    let mut errors: Vec<f64> =
        there.iter().zip(100..160).map(|(p, i)| (p / seconds(i) - 1.0).abs()).collect();
    let middle = median(&mut errors).unwrap();
    assert!(middle < 0.03 && errors[errors.len() - 1] < 0.2, "{middle} {errors:?}");
    // On a machine of the prior's make that runs at another speed today, nothing but the speed is learned.
    let slower: Vec<Observed> = (0..80)
        .map(|i| {
            let estimate: f64 = model.costs().iter().zip(work(i)).map(|(c, w)| c * w).sum();
            let noise = 1.0 + 0.02 * ((i * 7 % 5) as f64 - 2.0);
            Observed { seconds: 1.22 * noise * estimate, ..frames[i].clone() }
        })
        .collect();
    let today = model.choose(&slower, &UnitCosts::SOFTWARE, |_| true, Executor::Serial).unwrap();
    assert_eq!((today.belief.costs, today.belief.share, today.belief.weights), (0.0, 1.0, 0.0));
    assert_eq!(today.file.metadata[Key::UnitCosts.name()], prior.metadata[Key::UnitCosts.name()]);
    // Two volumes are too few to choose by: the prior's shape at this machine's speed.
    let few: Vec<Observed> = frames.iter().filter(|f| f.group < 2).cloned().collect();
    assert_eq!(model.choose(&few, &UnitCosts::SOFTWARE, |_| true, Executor::Serial).unwrap().folds, 0);
    assert!(model.choose(&[], &UnitCosts::SOFTWARE, |_| true, Executor::Serial).is_err());
}

#[test]
fn ten_frames_set_the_speed_and_no_model_but_a_residual_one_is_a_prior() {
    let prior = blank_prior(PROBE_SIDE).unwrap();
    let model = PriorModel::new(&prior).unwrap();
    let width: usize = prior.to_model().unwrap().inputs().iter().map(|g| g.size).sum();
    let frames: Vec<Observed> = (0..10u64)
        .map(|i| {
            let mut work = [1e4 * (1 + i % 4) as f64; COSTS];
            work[0] = 1.0;
            let estimate: f64 = model.costs().iter().zip(&work).map(|(c, w)| c * w).sum();
            let mut row = vec![0.0; width];
            row[width - 1] = estimate.ln() as f32;
            Observed { row, work, seconds: 3.0 * estimate, group: i % 3 }
        })
        .collect();
    let chosen = model.choose(&frames, &UnitCosts::SOFTWARE, |_| true, Executor::Serial).unwrap();
    for (p, f) in chosen.crossed.iter().zip(&frames) {
        assert!((p / f.seconds - 1.0).abs() < 0.05, "{p} {}", f.seconds);
    }
    let analytic = AnalyticModel::default().to_model_file().unwrap();
    let error = PriorModel::new(&analytic).err().unwrap().to_string();
    assert!(error.contains("--model-kind residual"), "{error}");
}

/// A renderer that pays for two kinds of work alone.
fn seconds_of(features: &FrameFeatures, setting: &Setting) -> f64 {
    let work = Measurement::new(features, setting, 1.0).work;
    let pixels = 1 + COST_QUANTITIES.iter().position(|q| q.to_string() == "pixels").unwrap();
    5e-4 + 9e-8 * work[pixels]
}

#[test]
fn frames_are_kept_fairly_and_a_model_is_fitted_to_them() {
    let prior = blank_prior(PROBE_SIDE).unwrap();
    assert!(Calibration::new(&prior, 7).is_err() && Calibration::new(&prior, 100_000).is_err());
    let mut calibration = Calibration::new(&prior, 60).unwrap();
    assert!(calibration.is_empty());
    assert_eq!(calibration.fit(["", ""], Executor::Serial).unwrap_err().kind(), crate::ErrorKind::NotReady);
    let features = FrameFeatures::default();
    let camera = Camera::from_arcball(Arcball { rx: 10.0, ry: 20.0, dz: 2.0 }).unwrap();
    let at = |size: u32| Setting::from(&Frame::new(camera, size, size).unwrap());
    let inputs = |size: u32| Inputs {
        features: &features,
        setting: at(size),
        changes: Changes::default(),
        camera: features.pose(),
        volume_features: None,
        lobes: None,
    };
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(calibration.add(&inputs(64), Shown::default(), bad).is_err());
    }
    assert!(calibration.is_empty());
    let rows = calibration.rows.as_ptr();
    for i in 0..600u64 {
        let size = 40 + (i * 37 % 200) as u32;
        let shown = Shown { volume: i / 150, transfer: i / 50 };
        calibration.add(&inputs(size), shown, seconds_of(&features, &at(size))).unwrap();
    }
    assert_eq!((calibration.len(), calibration.offered), (60, 600));
    assert_eq!(rows, calibration.rows.as_ptr(), "moved");
    // Of every quarter about as many stay: 15 expected, a standard deviation of 3.2.
    for quarter in 0..4 {
        let n = calibration.kept.iter().filter(|k| k.order / 150 == quarter).count();
        assert!((5..=25).contains(&n), "{quarter}: {n}");
    }
    let fitted = calibration.fit(["my renderer", "wall"], Executor::Serial).unwrap();
    assert_eq!((fitted.held_out, fitted.frames), (HeldOut::Volumes, 60));
    assert!(fitted.median_error < 0.02, "{}", fitted.median_error);
    assert!(fitted.upper.factor() >= 0.95 && fitted.upper.factor() < 1.1, "{:?}", fitted.upper);
    assert_eq!(fitted.file.metadata["entire.clock"], "wall");
    assert_eq!(fitted.file.metadata[Key::Renderer.name()], "my renderer");
    // The file as any other: it is written, read, and predicts what was measured.
    let model = crate::Model::from_bytes(&fitted.file.to_bytes().unwrap()).unwrap();
    let mut predictor = crate::predict::load(&model).unwrap();
    for size in [45, 90, 200] {
        let p = predictor.predict(&inputs(size)).unwrap();
        let t = seconds_of(&features, &at(size));
        assert!((f64::from(p.seconds) / t - 1.0).abs() < 0.05, "{size}: {} {t}", p.seconds);
        assert!(p.upper >= p.seconds);
    }
    // It is a prior in turn.
    assert!(Calibration::new(&fitted.file, 8).is_ok());
}

#[test]
fn what_is_left_out_follows_from_what_was_shown() {
    let prior = blank_prior(PROBE_SIDE).unwrap();
    let held_out = |frames: u64, shown: fn(u64) -> Shown| {
        let mut calibration = Calibration::new(&prior, 500).unwrap();
        let (width, work) = (calibration.prior().layout().width(), [1.0; COSTS]);
        for i in 0..frames {
            let mut row = vec![0.0; width];
            row[0] = (i % 7) as f32;
            row[width - 1] = -5.0;
            calibration.add_written(&row, &work, shown(i), 0.01 + 1e-4 * (i % 5) as f64);
        }
        let fitted = calibration.fit(["", ""], Executor::Serial).unwrap();
        assert!(!fitted.file.metadata.contains_key("entire.clock"));
        fitted.held_out
    };
    assert_eq!(held_out(30, |i| Shown { volume: i % 3, transfer: 0 }), HeldOut::Volumes);
    assert_eq!(held_out(30, |i| Shown { volume: 5, transfer: i % 4 }), HeldOut::TransferFunctions);
    assert_eq!(held_out(30, |_| Shown::default()), HeldOut::Stretches);
    assert_eq!(held_out(14, |_| Shown::default()), HeldOut::Nothing);
}
