//! Compares adaptive plans with plans by the finest probe: number of probe rays, and difference of ray steps.
//!
//! ```text
//! cargo run --release -p entire-tests --example probe_ladder -- [--frames N] [--tolerance T] VOLUME…
//! ```
//!
//! Draws random scenes as `entire collect` does (seed 2). Every scene is planned by a session without a
//! model, once adaptively with up to 16² rays and once with 16² rays. The time of each scene at the finest
//! step is predicted with 16² rays; the targets are 0.25 to 64 times the median of these times. Prints for
//! each target how many plans ended with a probe of 4², 7², 11² and 16² rays, the mean number of rays (of all
//! probes of a plan), and the median and the largest of |step / step of the finest probe − 1|.

use entire_core::scene::{Camera, Frame, TransferFunction};
use entire_io::scenes::SceneDistribution;
use entire_io::volume::Volume;
use entire_steer::Session;
use entire_steer::control::StepLimits;
use entire_steer::features::VolumeSummary;

/// Rays along each side of the finest probe.
const FINEST: usize = 16;

fn main() {
    let (mut frames, mut tolerance, mut volumes) = (200, 0.05f32, Vec::new());
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut number = || args.next().and_then(|v| v.parse::<f32>().ok()).expect("a number");
        match arg.as_str() {
            "--frames" => frames = number() as u64,
            "--tolerance" => tolerance = number(),
            _ => volumes.push(arg),
        }
    }
    assert!(!volumes.is_empty(), "give at least one volume file");
    let distribution = SceneDistribution::default();
    let session = |summary: &VolumeSummary| {
        let mut session = Session::untrained().with_probe(FINEST, None).expect("a side");
        session.set_volume(summary.clone(), None);
        session.set_limits(StepLimits { finest: 0.5, coarsest: 8.0 }).expect("limits");
        session
    };
    let mut scenes = Vec::new();
    for path in &volumes {
        let volume = Volume::open(path).unwrap_or_else(|e| panic!("{e:#}"));
        let summary = VolumeSummary::new(&volume.view()).expect("a summary");
        for index in 0..frames {
            let scene = distribution.draw(2, path, index);
            let table = TransferFunction::Gaussian(scene.lobes.clone()).to_table().expect("a table");
            let camera = Camera::from_arcball(scene.camera).expect("a camera");
            let frame = Frame::new(camera, 512, 512).expect("a frame");
            let mut fixed = session(&summary);
            fixed.set_transfer(&table, None).expect("a volume is set");
            let finest = Frame { step: 0.5, ..frame };
            let seconds = fixed.predict(&finest).expect("a prediction").seconds;
            scenes.push((summary.clone(), table, frame, seconds));
        }
    }
    let mut all: Vec<f32> = scenes.iter().map(|s| s.3).collect();
    all.sort_by(f32::total_cmp);
    let median = all[all.len() / 2];
    println!("{} scenes, tolerance {tolerance}, median {median:.4} s at the finest step", scenes.len());
    println!(
        "{:>8}  {:^34}  {:>9}  {:>12}  {:>9}",
        "target", "plans with 4²  7²  11²  16² rays", "mean rays", "median error", "largest"
    );
    for power in -1..=3 {
        let target = median * 4.0f32.powi(power);
        let mut ends = [0usize; 4];
        let (mut rays, mut errors) = (0usize, Vec::new());
        for (summary, table, frame, _) in &scenes {
            let mut fixed = session(summary);
            fixed.set_transfer(table, None).expect("a volume is set");
            let mut ladder = session(summary).with_probe(FINEST, Some(tolerance)).expect("a ladder");
            ladder.set_transfer(table, None).expect("a volume is set");
            let best = fixed.plan(frame, target).expect("a plan").step;
            let step = ladder.plan(frame, target).expect("a plan").step;
            let side = ladder.features().probe_side();
            for (end, s) in ends.iter_mut().zip([4, 7, 11, 16]) {
                rays += if s <= side { s * s } else { 0 };
                *end += usize::from(s == side);
            }
            errors.push((step / best - 1.0).abs());
        }
        errors.sort_by(f32::total_cmp);
        println!(
            "{:>6.2} x  {:>12} {:>6} {:>6} {:>6}  {:>9.1}  {:>11.2} %  {:>7.2} %",
            4.0f32.powi(power),
            ends[0],
            ends[1],
            ends[2],
            ends[3],
            rays as f64 / scenes.len() as f64,
            100.0 * errors[errors.len() / 2],
            100.0 * errors[errors.len() - 1]
        );
    }
}
