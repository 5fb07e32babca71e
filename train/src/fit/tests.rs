//! Compares every kind of predictor with an independent evaluation of its parts.

use super::compose::{carry_past, side_by_side};
use super::*;
use crate::gradient::Network;
use crate::inputs::work_of;
use entire_core::nn::{DenseParts, Dtype, Normalization, PredNet, PredNetParts, Target};
use entire_io::dataset::Timed;
use entire_io::dataset::feature_table::{FeatureTable, quantity_column};
use entire_io::options::thread_pool;
use entire_steer::features::{PROBE_SIDE, SceneFeature, SceneQuantity};
use entire_steer::predict::{COST_QUANTITIES, GroupKind, UnitCosts};

fn network(widths: &[usize], seed: u64) -> PredNetParts {
    let net = Network::<f32>::random(widths, seed).unwrap();
    let layers = (0..net.layers())
        .map(|i| {
            let (weight, bias) = net.layer(i);
            let bias = bias.iter().enumerate().map(|(k, b)| b + 0.1 * (k as f32 + seed as f32)).collect();
            let (inputs, outputs, weight) = (widths[i], widths[i + 1], weight.to_vec());
            DenseParts { inputs, outputs, weight, bias, dtype: Dtype::F32 }
        })
        .collect();
    PredNetParts {
        layers,
        input: Some(Normalization { mean: vec![0.5; widths[0]], std: vec![2.0; widths[0]] }),
        output: Some(Normalization { mean: vec![-3.0], std: vec![0.7] }),
        target: Target::LogSeconds,
    }
}

#[test]
fn networks_side_by_side_give_the_mean_of_their_logarithms() {
    for widths in [&[3, 1][..], &[3, 5, 1], &[3, 5, 4, 1]] {
        let members: Vec<PredNetParts> = (1..=3).map(|seed| network(widths, seed)).collect();
        let one = PredNet::new(&side_by_side(members.clone()).unwrap()).unwrap();
        let each: Vec<PredNet> = members.iter().map(|m| PredNet::new(m).unwrap()).collect();
        for x in [[0.0f32, 0.0, 0.0], [1.0, -2.0, 3.0], [9.0, 9.0, -9.0]] {
            let mean: f64 =
                each.iter().map(|n| f64::from(n.predict(&x, &mut n.scratch(1).unwrap())).ln()).sum::<f64>()
                    / 3.0;
            let found = f64::from(one.predict(&x, &mut one.scratch(1).unwrap())).ln();
            assert!((found - mean).abs() < 1e-5, "{widths:?} {x:?}: {found} {mean}");
        }
    }
    let unlike = vec![network(&[3, 5, 1], 1), network(&[3, 4, 1], 2)];
    assert!(side_by_side(unlike).unwrap_err().to_string().contains("different widths"));
}

fn tables_of_no_volume(count: u64) -> Vec<TimedFrame> {
    use entire_core::scene::{Arcball, Skipping};
    (0..count)
        .map(|number| {
            let mut frame = TimedFrame::of_no_volume("nowhere.nrrd", "");
            frame.number = number;
            frame.scene.skipping = Skipping::None;
            frame.scene.termination = 1.0;
            frame.scene.camera = Arcball {
                rx: (number * 37 % 17) as f32 * 0.2 - 1.5,
                ry: (number * 11 % 23) as f32 * 0.2 - 2.0,
                dz: 1.0 + (number * 5 % 13) as f32 * 0.2,
            };
            frame
        })
        .collect()
}

fn in_context<T>(run: impl FnOnce(&FitContext<'_>) -> T) -> T {
    let pool = thread_pool(Some(1)).unwrap();
    let tables = [Table { path: "t.csv".into(), ..Table::default() }];
    run(&FitContext { tables: &tables, pool: &pool, bar: &ProgressBar::hidden(), stop: &|| false })
}

#[test]
fn an_estimate_carried_past_a_network_is_multiplied_by_what_the_network_gives() {
    use entire_core::scene::{Camera, Frame, TransferFunction};
    use entire_steer::features::{Changes, FrameFeatures, Setting, TransferSummary, VolumeSummary};
    use entire_steer::predict::{Inputs, load};

    let values: Vec<u8> = (0..16 * 12 * 10).map(|i| (i * 7 % 251) as u8).collect();
    let data = entire_io::volume::VolumeData::U8(values);
    let volume = entire_io::volume::Volume::new(data, [16, 12, 10], [1.0; 3], "v").unwrap();
    let summary = VolumeSummary::new(&volume.view()).unwrap();
    let seconds = std::array::from_fn(|i| 1e-6 * (1.0 + i as f64));
    let costs = UnitCosts { seconds, ..UnitCosts::SOFTWARE };
    let inputs = [
        SceneFeature { quantity: SceneQuantity::Pixels, log: true },
        SceneFeature { quantity: SceneQuantity::MeanChord, log: false },
    ];
    for widths in [&[2, 1][..], &[2, 4, 1], &[2, 6, 5, 1], &[2, 4, 4, 3, 1]] {
        let mut ratio = network(widths, 3);
        ratio.output = Some(Normalization { mean: vec![0.2], std: vec![0.3] });
        let carried = carry_past(ratio.clone(), -3.0, 1.5);
        let mut features = inputs.to_vec();
        features.push(SceneFeature { quantity: SceneQuantity::EstimatedSeconds, log: true });
        let mut wide = Layout::new(&[GroupKind::SceneFeatures], features, 0, None)
            .unwrap()
            .with_probe_side(5)
            .with_unit_costs(costs);
        let mut file = ModelFile::default();
        Recipe::default().store(&mut file, carried.clone(), &wide).unwrap();
        let model = file.to_model().unwrap();
        let layout = Layout::of_model(&model).unwrap();
        assert_eq!(layout.probe_side(), 5);
        let mut predictor = load(&model).unwrap();
        let factor = PredNet::new(&ratio).unwrap();
        // The training range has images with 3 to 50 pixels, and chords of 12 to 13. Most images are outside
        // of this range.
        let seen = [4f32.ln(), 12.0, 51f32.ln(), 13.0];
        wide.widen(&seen, 2);
        Recipe::default().store(&mut file, carried, &wide).unwrap();
        let limited = file.to_model().unwrap();
        let (mut limited_predictor, limits) = (load(&limited).unwrap(), Layout::of_model(&limited).unwrap());
        for (lobes, distance, size) in
            [("0.5 0.1 0.3", 2.0, 40), ("0.2 0.01 0.9", 3.5, 300), ("0.9 0.3 1", 1.2, 8)]
        {
            let camera = entire_core::scene::Arcball { rx: 20.0, ry: 70.0, dz: distance };
            let frame = Frame::new(Camera::from_arcball(camera).unwrap(), size, size).unwrap();
            let lobes = entire_io::dataset::parse_lobes(lobes).unwrap();
            let table = TransferFunction::Gaussian(lobes.clone()).to_table().unwrap();
            let mut transfer = TransferSummary::new(&summary, &table).expect("a summary");
            let measured = FrameFeatures::of(&summary, &mut transfer, &frame, 5).expect("a frame");
            let setting = Setting::from(&frame);
            let asked = Inputs {
                features: &measured,
                setting,
                changes: Changes::default(),
                camera,
                volume_features: None,
                lobes: Some(&lobes),
            };
            let quantity = measured.quantities(setting);
            let x = [
                (quantity(SceneQuantity::Pixels) + 1.0).ln() as f32,
                quantity(SceneQuantity::MeanChord) as f32,
            ];
            let counts = COST_QUANTITIES.map(|q| quantity(q) as f32);
            let expected =
                costs.time(&work_of(counts)) * f64::from(factor.predict(&x, &mut factor.scratch(1).unwrap()));
            // The expected time must be far above the lower limit of a network's predictions: at this limit,
            // all predictions would be equal.
            assert!((1e-4..1e4).contains(&expected), "{expected}");
            let predicted = f64::from(predictor.predict(&asked).unwrap().seconds);
            let mut row = vec![0.0; layout.width()];
            layout.write(&asked, &mut row).unwrap();
            let by_row = predict_rows(&model, &layout, &row, None).unwrap()[0];
            for found in [predicted, by_row] {
                assert!((found / expected - 1.0).abs() < 1e-4, "{widths:?}: {found} {expected}");
            }
            // If inputs are clamped to the training range, only the learned factor changes.
            let held = [x[0].clamp(seen[0], seen[2]), x[1].clamp(seen[1], seen[3])];
            assert_ne!(held, x);
            let mut scratch = factor.scratch(1).unwrap();
            let change = f64::from(factor.predict(&held, &mut scratch) / factor.predict(&x, &mut scratch));
            let by_predictor = limited_predictor.predict(&asked).unwrap();
            let by_row = predict_rows(&limited, &limits, &row, None).unwrap()[0];
            for found in [f64::from(by_predictor.seconds), by_row] {
                assert!((found / (expected * change) - 1.0).abs() < 1e-4, "{widths:?}: {found} {expected}");
            }
            let free = predictor.predict(&asked).unwrap();
            assert_eq!(by_predictor.out_of_range.to_bits(), free.out_of_range.to_bits());
        }
    }
}

#[test]
fn what_a_recipe_cannot_take_is_said_before_anything_is_computed() {
    let frames = tables_of_no_volume(3);
    let frames: Vec<&TimedFrame> = frames.iter().collect();
    let part = Timed { frames: &frames, seconds: &[1.0, 2.0, 3.0] };
    // The volume does not exist, so any attempt to compute fails with another error.
    let says =
        |recipe: Recipe| in_context(|context| format!("{:#}", recipe.make(context, part, part).unwrap_err()));
    let residual = Recipe { kind: Kind::Residual, ..Recipe::default() };
    let inputs = vec!["scene_features".into(), "camera".into()];
    assert!(says(Recipe { inputs, ..residual.clone() }).contains("takes scene_features alone"));
    assert!(says(Recipe { loss: "cosine".into(), ..residual.clone() }).contains("huber:DELTA"));
    assert!(says(Recipe { loss: "huber:-1".into(), ..residual.clone() }).contains("delta is -1"));
    assert!(says(Recipe { epochs: 0, ..residual.clone() }).contains("epochs is 0"));
    assert!(says(Recipe { learning_rate: Some(-1.0), ..residual.clone() }).contains("learning rate"));
    assert!(says(Recipe { scene_features: vec!["warp".into()], ..residual.clone() }).contains("warp"));
    assert!(says(residual).contains("nowhere.nrrd"));
}

#[test]
fn a_network_takes_as_many_lobes_as_any_training_frame_has() {
    let one = TimedFrame::of_no_volume("v", "");
    let mut two = one.clone();
    two.scene.lobes = entire_io::dataset::parse_lobes("0.5 0.1 1;0.2 0.1 1").unwrap();
    let recipe = Recipe { inputs: vec!["transfer_function".into()], ..Recipe::default() };
    let training = Timed { frames: &[&one, &two], seconds: &[1.0, 1.0] };
    assert_eq!(recipe.layout(training).unwrap().1.width(), 6);
}

#[test]
fn an_ensemble_says_how_each_of_its_networks_ended() {
    let frames = tables_of_no_volume(6);
    let frames: Vec<&TimedFrame> = frames.iter().collect();
    let part = Timed { frames: &frames, seconds: &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0] };
    let recipe = |ensemble: usize| {
        let (inputs, layers) = (vec!["camera".into()], vec![4]);
        Recipe { inputs, layers, epochs: 2, ensemble, ..Recipe::default() }
    };
    let made = |ensemble| in_context(|context| recipe(ensemble).make(context, part, part).unwrap());
    assert!(made(1).outcome.starts_with("all 2 epochs done, "));
    let two = made(2);
    let each: Vec<&str> = two.outcome.split("; ").collect();
    assert_eq!((each.len(), two.history.len()), (2, 2));
    assert!(each[0].starts_with("network 1: all 2 epochs done, "), "{each:?}");
    assert!(each[1].starts_with("network 2: all 2 epochs done, "), "{each:?}");
    // The networks have consecutive seeds, and after the largest seed comes 0.
    in_context(|context| Recipe { seed: u64::MAX, ..recipe(2) }.make(context, part, part).unwrap());
    // The training is stopped after the first network. The weights of this network are kept, and those of the
    // interrupted network are not used.
    let alone = made(1);
    for seen in 1..8 {
        let asked = std::cell::Cell::new(0);
        let interrupted = in_context(|context| {
            let stop = || {
                asked.set(asked.get() + 1);
                asked.get() > seen
            };
            recipe(3).make(&FitContext { stop: &stop, ..*context }, part, part).unwrap()
        });
        assert!(!interrupted.outcome.contains("network 3: all"), "{}", interrupted.outcome);
        if interrupted.outcome.contains("the mean of 1 networks")
            && interrupted.outcome.contains("network 1: all")
        {
            assert_eq!(interrupted.file.to_bytes().unwrap(), alone.file.to_bytes().unwrap());
            return;
        }
    }
    panic!("no interruption after the first network");
}

#[test]
fn a_stop_before_the_training_is_an_error_and_gives_no_model() {
    let frames = tables_of_no_volume(3);
    let frames: Vec<&TimedFrame> = frames.iter().collect();
    let part = Timed { frames: &frames, seconds: &[1.0, 2.0, 3.0] };
    let made = |recipe: &Recipe, stop: &dyn Fn() -> bool| {
        in_context(|context| recipe.make(&FitContext { stop, ..*context }, part, part))
    };
    let (inputs, layers) = (vec!["camera".into()], vec![4]);
    let new = Recipe { inputs, layers, epochs: 1, ensemble: 2, ..Recipe::default() };
    let path = std::env::temp_dir().join(format!("entire-tuned-{}.safetensors", std::process::id()));
    std::fs::write(&path, made(&new, &|| false).unwrap().file.to_bytes().unwrap()).unwrap();
    let tuned = Recipe { fine_tune: Some(path.clone()), epochs: 1, ..Recipe::default() };
    let goes_on = made(&tuned, &|| false).map(|fitted| fitted.what);
    let said = [&new, &tuned].map(|recipe| made(recipe, &|| true).unwrap_err().to_string());
    std::fs::remove_file(&path).unwrap();
    assert_eq!(goes_on.unwrap(), "PredNet, fine-tuned");
    assert!(said.iter().all(|said| said.contains("nothing was written")), "{said:?}");
}

#[test]
fn an_analytic_fit_that_is_stopped_gives_no_model() {
    let frames = tables_of_no_volume(9);
    let frames: Vec<&TimedFrame> = frames.iter().collect();
    let seconds: Vec<f64> = (1..=9).map(|i| 0.01 * f64::from(i)).collect();
    let part = Timed { frames: &frames, seconds: &seconds };
    let columns: Vec<String> = COST_QUANTITIES.iter().map(|&q| quantity_column(q, PROBE_SIDE)).collect();
    let numbers: Vec<u64> = (0..9).collect();
    let values = (0..9 * columns.len()).map(|i| 1.0 + (i * 7 % 31) as f32).collect();
    let features = Some(FeatureTable::new(columns, &numbers, values, 0).unwrap());
    let (tables, pool) = ([Table { features, ..Table::default() }], thread_pool(Some(1)).unwrap());
    let bar = ProgressBar::hidden();
    let made = |stop: &dyn Fn() -> bool| {
        let context = FitContext { tables: &tables, pool: &pool, bar: &bar, stop };
        Recipe { kind: Kind::Analytic, ..Recipe::default() }.make(&context, part, part)
    };
    assert_eq!(made(&|| false).unwrap().what, "Unit costs of estimated work");
    let said = made(&|| true).unwrap_err().to_string();
    assert!(said.contains("nothing was written"), "{said}");
}

#[test]
fn the_default_recipe_is_that_of_a_command_line_without_options() {
    let recipe = Recipe::default();
    assert_eq!((recipe.kind, &recipe.layers[..]), (Kind::Prednet, &[64, 64][..]));
    assert_eq!((recipe.inputs, recipe.clip), (vec!["scene_features".to_owned()], 1.0));
    assert_eq!((recipe.epochs, recipe.learning_rate), (200, None));
}
