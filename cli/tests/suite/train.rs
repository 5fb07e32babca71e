//! Training against finite differences, against PyTorch, and as a whole.

use entire_core::nn::Target;
use entire_steer::predict::LONGEST_FRAME;
use entire_train::gradient::{
    Loss, Network, Progress, Samples, Settings, Standardization, Stop, Trained, Trainer,
    cosine_learning_rate, preset_widths, train,
};
use proptest::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};
use std::ops::ControlFlow;

/// Largest difference between a gradient and its central difference in float64, relative to the gradient's
/// norm.
const FINITE_DIFFERENCE_TOLERANCE: f64 = 1e-7;
/// Largest difference from PyTorch's float64 run, relative to the largest number compared.
const TORCH_F64_TOLERANCE: f64 = 1e-12;
/// Largest difference from PyTorch's run for training in single precision, relative to the largest number
/// compared.
const TORCH_F32_TOLERANCE: f64 = 2e-5;

fn pool(threads: usize) -> ThreadPool {
    ThreadPoolBuilder::new().num_threads(threads).build().unwrap()
}

/// Numbers in [-1, 1] from a linear congruential generator.
fn noise(n: usize, seed: u64) -> Vec<f64> {
    let mut state = seed.wrapping_mul(2) + 1;
    (0..n)
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        })
        .collect()
}

fn trained(
    threads: usize,
    widths: &[usize],
    training: Samples<'_>,
    validation: Samples<'_>,
    settings: &Settings,
) -> anyhow::Result<Trained> {
    let network = Network::random(widths, settings.seed)?;
    train(&pool(threads), network, None, training, validation, settings, |_| ControlFlow::Continue(()))
}

/// Frames whose log time is a smooth function of two inputs.
fn frames(n: usize, seed: u64) -> (Vec<f32>, Vec<f64>) {
    let raw = noise(2 * n, seed);
    let inputs: Vec<f32> = raw.iter().map(|v| (*v * 3.0 + 5.0) as f32).collect();
    let seconds = raw.chunks(2).map(|x| (0.8 * x[0] + (2.0 * x[1]).sin() - 4.0).exp()).collect();
    (inputs, seconds)
}

const NONE: Samples<'_> = Samples { inputs: &[], seconds: &[] };

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn gradients_are_the_slopes_of_the_loss(
        seed in 0u64..1000,
        hidden in prop::collection::vec(1usize..7, 0..4),
        inputs in 1usize..5,
        rows in prop::sample::select(vec![1usize, 3, 150]),
        loss in prop::sample::select(vec![Loss::SquaredError, Loss::Huber { delta: 0.7 }]),
    ) {
        let mut widths = vec![inputs];
        widths.extend(hidden);
        widths.push(1);
        let network = Network::<f64>::random(&widths, seed).unwrap();
        let x = noise(rows * inputs, seed + 1);
        let y = noise(rows, seed + 2);
        let pool = pool(1);
        let loss_of = |network: &Network<f64>| {
            Trainer::new(network.clone(), loss, f64::INFINITY).unwrap().evaluate(&pool, &x, &y).unwrap().loss
        };
        let mut trainer = Trainer::new(network.clone(), loss, f64::INFINITY).unwrap();
        let step = trainer.evaluate(&pool, &x, &y).unwrap();
        let norm = trainer.gradient().iter().map(|g| g * g).sum::<f64>().sqrt();
        prop_assert!((norm - step.gradient_norm).abs() <= 1e-12 * norm.max(1.0));
        let shifted = |at: usize, by: f64| {
            let mut flat = 0;
            let layers: Vec<(Vec<f64>, Vec<f64>)> = (0..network.layers())
                .map(|i| {
                    let (w, b) = network.layer(i);
                    let mut take = |v: &[f64]| {
                        let out = v.iter().enumerate()
                            .map(|(j, p)| if flat + j == at { p + by } else { *p }).collect::<Vec<_>>();
                        flat += v.len();
                        out
                    };
                    (take(w), take(b))
                })
                .collect();
            let borrowed: Vec<(&[f64], &[f64])> = layers.iter().map(|(w, b)| (&w[..], &b[..])).collect();
            Network::from_layers(inputs, &borrowed).unwrap()
        };
        let scale = norm.max(1e-3);
        let mut beyond = 0;
        for (at, g) in trainer.gradient().iter().enumerate() {
            // SELU and Huber have kinks: a kink within the longer step may be outside the shorter one.
            let differs = |h: f64| {
                let slope = (loss_of(&shifted(at, h)) - loss_of(&shifted(at, -h))) / (2.0 * h);
                (slope - g).abs() > FINITE_DIFFERENCE_TOLERANCE * scale
            };
            beyond += usize::from(differs(1e-6) && differs(1e-7));
        }
        // For a few parameters, a kink may lie within both steps.
        prop_assert!(beyond <= 1 + trainer.gradient().len() / 50, "{beyond} of {}", trainer.gradient().len());
    }
}

#[derive(serde::Deserialize)]
struct Golden {
    widths: Vec<usize>,
    steps: u64,
    clip_norm: f64,
    learning_rate: f64,
    final_learning_rate: f64,
    initial: Vec<f64>,
    batches: Vec<Batch>,
}

#[derive(serde::Deserialize)]
struct Batch {
    inputs: Vec<f64>,
    targets: Vec<f64>,
    learning_rate: f64,
    loss: f64,
    gradient_norm: f64,
    gradient: Vec<f64>,
    parameters: Vec<f64>,
}

fn golden() -> Golden {
    serde_json::from_str(include_str!("../golden/train.json")).unwrap()
}

fn initial(golden: &Golden) -> Network<f64> {
    let mut rest = &golden.initial[..];
    let mut layers = Vec::new();
    for pair in golden.widths.windows(2) {
        let (weight, after) = rest.split_at(pair[0] * pair[1]);
        let (bias, after) = after.split_at(pair[1]);
        layers.push((weight, bias));
        rest = after;
    }
    Network::from_layers(golden.widths[0], &layers).unwrap()
}

#[track_caller]
fn close(found: &[f64], expected: &[f64], tolerance: f64, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f - e).abs() <= tolerance * scale, "{what}[{i}]: {f} against {e}");
    }
}

#[test]
fn steps_are_those_of_pytorch() {
    let golden = golden();
    let pool = pool(2);
    let mut double = Trainer::new(initial(&golden), Loss::SquaredError, golden.clip_norm).unwrap();
    let mut single =
        Trainer::new(initial(&golden).cast::<f32>(), Loss::SquaredError, golden.clip_norm).unwrap();
    for (i, b) in golden.batches.iter().enumerate() {
        let rate =
            cosine_learning_rate(golden.learning_rate, golden.final_learning_rate, i as u64, golden.steps);
        close(&[rate], &[b.learning_rate], 1e-12, "learning rate");
        let step = double.step(&pool, &b.inputs, &b.targets, rate).unwrap();
        close(&[step.loss], &[b.loss], TORCH_F64_TOLERANCE, "loss");
        close(&[step.gradient_norm], &[b.gradient_norm], TORCH_F64_TOLERANCE, "gradient norm");
        close(double.gradient(), &b.gradient, TORCH_F64_TOLERANCE, "gradient");
        close(double.network().parameters(), &b.parameters, TORCH_F64_TOLERANCE, "parameters");

        let narrow = |v: &[f64]| v.iter().map(|x| *x as f32).collect::<Vec<_>>();
        let wide = |v: &[f32]| v.iter().map(|x| f64::from(*x)).collect::<Vec<_>>();
        let step = single.step(&pool, &narrow(&b.inputs), &narrow(&b.targets), rate).unwrap();
        close(&[step.loss], &[b.loss], TORCH_F32_TOLERANCE, "single loss");
        close(&wide(single.gradient()), &b.gradient, TORCH_F32_TOLERANCE, "single gradient");
        close(&wide(single.network().parameters()), &b.parameters, TORCH_F32_TOLERANCE, "single parameters");
    }
    assert!(golden.batches.iter().any(|b| b.gradient_norm > golden.clip_norm));
    assert!(golden.batches.iter().any(|b| b.gradient_norm < golden.clip_norm));
}

#[test]
fn the_result_depends_on_the_seed_and_not_on_the_threads() {
    let (x, t) = frames(600, 1);
    let samples = Samples { inputs: &x, seconds: &t };
    let settings = Settings { epochs: 3, batch: 200, ..Settings::default() };
    let run = |settings: &Settings, threads: usize| {
        let trained = trained(threads, &[2, 16, 8, 1], samples, NONE, settings).unwrap();
        trained.network.parameters().to_vec()
    };
    let one = run(&settings, 1);
    assert_eq!(one, run(&settings, 1));
    assert_eq!(one, run(&settings, 3));
    assert_ne!(one, run(&Settings { seed: 2, ..settings }, 1));
}

#[test]
fn a_smooth_cost_is_learned_with_every_loss_and_target() {
    let (x, t) = frames(2000, 3);
    let (vx, vt) = frames(300, 4);
    let (training, validation) = (Samples { inputs: &x, seconds: &t }, Samples { inputs: &vx, seconds: &vt });
    for (target, loss, limit) in [
        (Target::LogSeconds, Loss::SquaredError, 0.03),
        (Target::LogSeconds, Loss::Huber { delta: 1.0 }, 0.03),
        (Target::Seconds, Loss::SquaredError, 0.2),
    ] {
        let (learning_rate, final_learning_rate) = (1e-2, 1e-4);
        let rest = Settings { learning_rate, final_learning_rate, ..Settings::default() };
        let settings = Settings { epochs: 60, batch: 64, target, loss, ..rest };
        let trained = trained(2, &[2, 32, 16, 1], training, validation, &settings).unwrap();
        let mut errors: Vec<f64> =
            trained.predict(&pool(2), &vx).unwrap().iter().zip(&vt).map(|(p, t)| (p - t).abs() / t).collect();
        errors.sort_by(f64::total_cmp);
        let median = errors[errors.len() / 2];
        assert!(median < limit, "{target:?} {loss:?}: median relative error {median}");
        // The inference network with the trained weights gives the same seconds.
        let parts = trained.to_parts();
        let net = entire_core::nn::PredNet::new(&parts).unwrap();
        let mut scratch = net.scratch(1).unwrap();
        for (row, p) in vx.chunks(2).zip(trained.predict(&pool(1), &vx).unwrap()) {
            let q = f64::from(net.predict(row, &mut scratch));
            assert!(
                (p - q).abs() <= 2e-5 * p.abs().max(f64::from(trained.standardization.output.std[0])),
                "{p} {q}"
            );
        }
    }
}

#[test]
fn early_stopping_keeps_the_best_weights() {
    // Noise cannot be learned: the validation loss rises while the training loss falls.
    let (x, _) = frames(40, 7);
    let t: Vec<f64> = noise(40, 8).iter().map(|u| u.exp()).collect();
    let (vx, _) = frames(40, 9);
    let vt: Vec<f64> = noise(40, 10).iter().map(|u| u.exp()).collect();
    let settings =
        Settings { epochs: 2000, patience: 20, learning_rate: 1e-2, batch: 40, ..Settings::default() };
    let (training, validation) = (Samples { inputs: &x, seconds: &t }, Samples { inputs: &vx, seconds: &vt });
    let trained = trained(1, &[2, 64, 64, 1], training, validation, &settings).unwrap();
    assert_eq!(trained.stop, Stop::Early);
    assert_eq!(trained.history.len(), trained.best_epoch + 20);
    let lowest = trained.history.iter().map(|h| h.validation_loss).fold(f64::INFINITY, f64::min);
    assert_eq!(trained.best_loss, lowest);
    // The stored weights have the lowest validation loss.
    let std = f64::from(trained.standardization.output.std[0]);
    let again = trained.predict(&pool(1), &vx).unwrap();
    let loss = again.iter().zip(&vt).map(|(p, t)| ((p - t) / std).powi(2)).sum::<f64>() / 40.0;
    assert!((loss - lowest).abs() < 1e-4 * lowest, "{loss} {lowest}");
}

#[test]
fn an_interrupted_run_returns_what_it_has() {
    let (x, t) = frames(400, 11);
    let (vx, vt) = frames(100, 12);
    let (training, validation) = (Samples { inputs: &x, seconds: &t }, Samples { inputs: &vx, seconds: &vt });
    let settings = Settings { batch: 50, ..Settings::default() };
    for stop_at in [1, 8, 30] {
        let mut seen: Vec<Progress> = Vec::new();
        let network = Network::<f32>::random(&[2, 8, 1], 1).unwrap();
        let trained = train(&pool(1), network, None, training, validation, &settings, |p| {
            seen.push(*p);
            if p.steps == stop_at { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        })
        .unwrap();
        assert_eq!(trained.stop, Stop::Interrupted);
        assert_eq!(seen.len(), stop_at as usize);
        assert_eq!(trained.history.len(), stop_at as usize / 8);
        assert!(trained.best_loss.is_finite());
        assert_eq!(seen.iter().filter(|p| p.ended.is_some()).count(), trained.history.len());
    }
}

#[test]
fn fine_tuning_starts_from_the_given_model() {
    let (x, t) = frames(500, 13);
    let training = Samples { inputs: &x, seconds: &t };
    let target = Target::LogSeconds;
    let settings = Settings { epochs: 30, learning_rate: 1e-2, target, ..Settings::default() };
    let first = trained(2, &[2, 16, 1], training, NONE, &settings).unwrap();
    let parts = first.to_parts();
    let slower: Vec<f64> = t.iter().map(|t| t * 1.05).collect();
    let settings = Settings { epochs: 1, learning_rate: 1e-6, ..settings };
    let second = train(
        &pool(2),
        Network::<f32>::from_parts(&parts).unwrap(),
        Some(Standardization::of(&parts)),
        Samples { inputs: &x, seconds: &slower },
        NONE,
        &settings,
        |_| ControlFlow::Continue(()),
    )
    .unwrap();
    assert_eq!(second.standardization, first.standardization);
    let (a, b) = (first.predict(&pool(1), &x).unwrap(), second.predict(&pool(1), &x).unwrap());
    assert!(a.iter().zip(&b).all(|(a, b)| (a / b - 1.0).abs() < 0.01));
    assert_ne!(a, b);
}

#[test]
fn a_diverging_run_says_so_and_keeps_finite_weights() {
    // In the second case, the only step of the first epoch gives infinite weights.
    for (count, learning_rate) in [(300, 1e30), (10, 1e39)] {
        let (x, t) = frames(count, 14);
        let (final_learning_rate, clip_norm) = (learning_rate, f64::INFINITY);
        let settings = Settings { learning_rate, final_learning_rate, clip_norm, ..Settings::default() };
        let samples = Samples { inputs: &x, seconds: &t };
        let trained = trained(1, &[2, 8, 8, 1], samples, NONE, &settings).unwrap();
        assert_eq!(trained.stop, Stop::Diverged);
        assert!(trained.network.parameters().iter().all(|p| p.is_finite()));
    }
}

#[test]
fn constant_inputs_and_targets_are_harmless() {
    let x = [3.0f32, 7.0].repeat(20);
    let t = vec![0.25f64; 20];
    let samples = Samples { inputs: &x, seconds: &t };
    let s = Standardization::fit(samples, 2, Target::Seconds);
    assert_eq!((&s.input.std[..], s.output.std[0]), (&[1.0, 1.0][..], 1.0));
    let trained = trained(1, &[2, 4, 1], samples, NONE, &Settings::default()).unwrap();
    assert!((trained.predict(&pool(1), &[3.0, 7.0]).unwrap()[0] - 0.25).abs() < 1e-3);
}

#[test]
fn presets_are_the_papers() {
    assert_eq!(preset_widths("0C256", 16).unwrap(), [16, 256, 128, 64, 32, 16, 1]);
    assert_eq!(preset_widths("4C64", 16).unwrap(), [16, 64, 64, 64, 64, 64, 32, 16, 1]);
    let big = preset_widths("12C256", 16).unwrap();
    assert_eq!(Network::<f32>::random(&big, 1).unwrap().parameters().len(), 837_633);
    for bad in ["", "C", "12", "xC256", "12C255", "12C16", "-1C256", "9999C256"] {
        assert!(preset_widths(bad, 16).unwrap_err().to_string().contains("12C256"), "{bad}");
    }
}

#[test]
fn initial_weights_are_lecun_normal() {
    let network = Network::<f64>::random(&[400, 300, 1], 5).unwrap();
    let (weight, bias) = network.layer(0);
    let mean = weight.iter().sum::<f64>() / weight.len() as f64;
    let variance = weight.iter().map(|w| (w - mean).powi(2)).sum::<f64>() / weight.len() as f64;
    assert!(mean.abs() < 1e-3 && (variance * 400.0 - 1.0).abs() < 0.02, "{mean} {variance}");
    let beyond = weight.iter().filter(|w| w.abs() > 2.0 / 20.0).count() as f64 / weight.len() as f64;
    assert!((beyond - 0.0455).abs() < 0.005, "{beyond}");
    assert!(bias.iter().all(|b| *b == 0.0));
}

#[test]
fn bad_input_is_refused_with_a_reason() {
    let (x, t) = frames(10, 1);
    let good = Samples { inputs: &x, seconds: &t };
    let attempt = |training: Samples<'_>, validation: Samples<'_>, change: fn(&mut Settings)| {
        let mut settings = Settings::default();
        change(&mut settings);
        trained(1, &[2, 4, 1], training, validation, &settings).unwrap_err()
    };
    let nan: Vec<f32> = x.iter().enumerate().map(|(i, v)| if i == 5 { f32::NAN } else { *v }).collect();
    let with = |seconds: f64| -> Vec<f64> { [&t[..3], &[seconds], &t[4..]].concat() };
    let zero = with(0.0);
    type Case<'a> = (Samples<'a>, Samples<'a>, fn(&mut Settings), &'a str);
    let cases: [Case<'_>; 12] = [
        (NONE, good, |_| (), "no training frames"),
        (Samples { inputs: &x[..19], ..good }, NONE, |_| (), "19 inputs for 10 frames"),
        (Samples { inputs: &nan, ..good }, NONE, |_| (), "input 1 of frame 2 is NaN"),
        (Samples { seconds: &zero, ..good }, NONE, |_| (), "frame 3 took 0 seconds"),
        (good, Samples { seconds: &zero, ..good }, |_| (), "validation frames"),
        (good, NONE, |s| s.epochs = 0, "epochs is 0"),
        (good, NONE, |s| s.batch = 0, "batch is 0"),
        (good, NONE, |s| s.patience = 0, "patience is 0"),
        (good, NONE, |s| s.learning_rate = f64::NAN, "learning rate"),
        (good, NONE, |s| s.clip_norm = 0.0, "clipping norm"),
        (good, NONE, |s| s.loss = Loss::Huber { delta: -1.0 }, "Huber delta"),
        (good, NONE, |s| s.loss = Loss::Huber { delta: 1e-50 }, "Huber delta"),
    ];
    for (training, validation, change, expected) in cases {
        let error = attempt(training, validation, change);
        assert!(error.to_string().contains(expected), "{expected}: {error}");
    }
    let longest = f64::from(LONGEST_FRAME);
    let settings = Settings { epochs: 1, ..Settings::default() };
    trained(1, &[2, 4, 1], Samples { seconds: &with(longest), ..good }, NONE, &settings).unwrap();
    for wrong in [longest * 1.001, 1e300, f64::INFINITY, f64::NAN, -1.0] {
        let error = attempt(Samples { seconds: &with(wrong), ..good }, NONE, |_| ());
        assert!(error.to_string().contains("frame 3 took"), "{error}");
    }
    for widths in [&[][..], &[3], &[3, 0, 1], &[70_000, 1]] {
        let error = Network::<f32>::random(widths, 1).unwrap_err().to_string();
        assert!(error.contains("are accepted"), "{error}");
    }
    assert!(Trainer::new(Network::<f32>::random(&[2, 2], 1).unwrap(), Loss::SquaredError, 1.0).is_err());
    assert!(Network::from_layers(2, &[(&[1.0f32; 5][..], &[0.0; 2][..])]).is_err());
    assert!(Network::from_layers(1, &[(&[f32::NAN][..], &[0.0][..])]).is_err());
    let mut trainer =
        Trainer::new(Network::<f32>::random(&[2, 1], 1).unwrap(), Loss::SquaredError, 1.0).unwrap();
    assert!(trainer.step(&pool(1), &[1.0; 3], &[1.0], 0.1).is_err());
    assert!(trainer.step(&pool(1), &[], &[], 0.1).is_err());
}
