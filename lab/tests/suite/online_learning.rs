//! Learning from observed frame times, on recorded times of a real renderer (software Vulkan, process-CPU time): a
//! session without a model learns the costs of an unknown renderer, and a network is fine-tuned.

use crate::recorded;
use clap::Parser;
use entire_cli::commands::train;
use entire_cli::steering::play::ActsOn;
use entire_cli::steering::play::Contender;
use entire_io::dataset::{Scene, Timing, Writer};
use entire_io::files::open_model;
use entire_io::volume::Volume;
use entire_lab::calibration::samples_of;
use entire_lab::fitted::fit_network;
use entire_lab::replay::{Replayable, Tally, replay};
use entire_steer::control::{Session, StepLimits};
use entire_steer::features::PROBE_SIDE;
use entire_steer::predict::load;
use std::path::Path;

/// Options of `entire train` on a command line.
#[derive(Parser)]
struct Train {
    #[command(flatten)]
    options: train::Options,
}

fn median(mut values: Vec<f64>) -> f64 {
    entire_io::metrics::median(&mut values).expect("values")
}

#[test]
fn sixty_observed_frames_bring_an_unknown_renderer_within_ten_percent() {
    // Factor on the recorded seconds, so that the renderer differs from the default costs of a session.
    const TIMES: f64 = 3.0;
    for (name, fps) in [("nyx-switches.json", 30.0), ("castro-cuts.json", 45.0)] {
        let recorded = recorded(name, TIMES);
        let n = recorded.path.frames.len();
        let errors = |seed: u64| {
            let mut who = Contender {
                name: "untrained".into(),
                session: Session::untrained(),
                chooses_image_sample_distance: false,
                acts_on: ActsOn::RayStep,
            };
            let played =
                replay(&recorded, &mut who, &[], &vec![TIMES / fps; n], StepLimits::default(), seed, 0..n)
                    .unwrap();
            let error = |range: std::ops::Range<usize>| {
                median(played[range].iter().map(|f| (f.predicted / f.seconds - 1.0).abs()).collect())
            };
            (error(0..2), error(60..n), Tally::of(&played[60..]).score())
        };
        for seed in 1..4 {
            let (before, after, score) = errors(seed);
            assert!(after <= 0.10, "{name}: {after}");
            assert!(before > 2.0 * after, "{name}: there was nothing to learn: {before} {after}");
            // With this error, most frames meet the target.
            assert!(score.all.missed < 0.15 && score.all.quality > 0.8, "{name}: {score:?}");
        }
    }
}

/// Returns one point of a recorded frame as a row of a timing table; `law` converts recorded seconds to those
/// of the imitated machine.
fn row(recorded: &Replayable, index: usize, point: usize, law: impl Fn(f64) -> f64) -> (Scene, Timing) {
    let (trace, at) = (&recorded.trace, &recorded.path.frames[index]);
    let draw = &trace.draw;
    let p = &trace.frames[index][point];
    let volume = &trace.volumes[trace.volume_at(index)];
    let small = Volume::open(&volume.file).unwrap().dims();
    let scene = Scene {
        volume: volume.file.display().to_string(),
        member: format!("m{}", index % 8),
        time_step: None,
        dims: small.map(|n| (n * volume.enlarge) as u32),
        camera: at.camera,
        fov_y_degrees: recorded.path.fov_y_degrees,
        width: draw.width,
        height: draw.height,
        step: p.step,
        shading: draw.shading,
        skipping: draw.skipping,
        termination: draw.termination,
        lobes: at.transfer.lobes().unwrap(),
    };
    (scene, Timing { cpu: Some(law(median(p.seconds.clone()))), ..Timing::default() })
}

#[test]
fn a_log_of_observations_fine_tunes_a_network_for_another_machine() {
    let dir = tempfile::tempdir().unwrap();
    let traces = [recorded("nyx-switches.json", 1.0), recorded("castro-cuts.json", 1.0)];
    let table = |name: &str, keep: &dyn Fn(usize, usize) -> bool, law: &dyn Fn(f64) -> f64| {
        let file = dir.path().join(name);
        let mut out = Writer::create(&file).unwrap();
        let mut number = 0;
        for trace in &traces {
            for index in 0..trace.trace.frames.len() {
                for point in (0..trace.trace.frames[index].len()).filter(|p| keep(index, *p)) {
                    let (scene, measured) = row(trace, index, point, law);
                    out.append(number, &scene, &[measured]).unwrap();
                    number += 1;
                }
            }
        }
        file
    };
    // One of eight frames is for testing. The other frames train the network; with the times of a slower
    // machine, they are also the log of observations, with one step per frame.
    let slower = |t: f64| 0.004 + 2.2 * t;
    let made_on = table("made.csv", &|i, p| i % 8 != 3 && p % 2 == 0, &|t| t);
    let log = table("log.csv", &|i, p| i % 8 != 3 && p == (i * 5) % 9, &slower);
    let judged = table("judged.csv", &|i, p| i % 8 == 3 && (p == 2 || p == 5), &slower);
    let (model, tuned) = (dir.path().join("model.safetensors"), dir.path().join("tuned.safetensors"));
    let file = fit_network(&samples_of(&[made_on], PROBE_SIDE).unwrap()).unwrap();
    std::fs::write(&model, file.to_bytes().unwrap()).unwrap();
    let path = |p: &Path| p.to_str().unwrap().to_owned();
    let options = Train::parse_from([
        "train",
        "--threads=1",
        "--epochs=150",
        "--batch=32",
        "--learning-rate=2e-3",
        "--validation-groups=m7",
        "--test-groups=m6",
        "--clock=cpu",
        &format!("--data={}", path(&log)),
        &format!("--fine-tune={}", path(&model)),
        &format!("--out={}", path(&tuned)),
    ]);
    train::run(&options.options).unwrap();
    let judged = samples_of(&[judged], PROBE_SIDE).unwrap();
    let error = |file: &Path| {
        let mut predictor = load(&open_model(file).unwrap()).unwrap();
        median(
            judged
                .iter()
                .map(|s| {
                    (f64::from(predictor.predict(&s.predictor_inputs(None)).unwrap().seconds) / s.seconds
                        - 1.0)
                        .abs()
                })
                .collect(),
        )
    };
    let (before, after) = (error(&model), error(&tuned));
    assert!(before > 0.4 && after < 0.15, "{before} {after}");
}
