//! Plans on recorded paths: their bits stay the same, so that a change that is not meant to change plans
//! changes none.

use crate::{recorded, repository};
use entire_io::files::{fnv1a, open_model};
use entire_lab::replay::Replayable;
use entire_lab::trace::TracePoint;
use entire_steer::control::{HybridOptions, ObserveFlags, Session};
use entire_steer::features::Changes;
use entire_steer::predict::load;
use std::process::Command;

/// Checksums of the plans of both recorded paths, for each kind of session, at the scalar level (FNV-1a). If
/// a change is meant to change plans, take the new checksums from the message of the failed test, and name
/// the reason in the commit.
const CHECKSUMS: [(&str, &str); 3] = [
    ("without a model", "654c593c40517814"),
    ("with the shipped model", "1cf28859a2c9c32a"),
    ("with the shipped model and smaller images", "f350029ae5bb9cd1"),
];

/// Recorded paths in `lab/tests/data`.
const RECORDED: [&str; 2] = ["nyx-switches.json", "castro-cuts.json"];

/// Target of every frame, in seconds: about half of the time at full quality.
const TARGET: f32 = 0.015;

fn session(kind: &str) -> Session {
    if kind == CHECKSUMS[0].0 {
        return Session::default();
    }
    let model = open_model(&repository().join("models/unshaded-selected.safetensors")).unwrap();
    let mut session = Session::new(load(&model).unwrap(), HybridOptions::default()).unwrap();
    if kind == CHECKSUMS[2].0 {
        session.set_max_image_sample_distance(4.0, 1.0).unwrap();
    }
    session
}

/// First recorded seconds of the point whose step is nearest to `step`. Recorded seconds are not
/// interpolated, so that they do not depend on the mathematical functions of the system.
fn seconds(points: &[TracePoint], step: f32) -> f64 {
    let full = points.iter().filter(|p| p.scale == 1.0);
    let nearest = full.min_by(|a, b| (a.step - step).abs().total_cmp(&(b.step - step).abs()));
    nearest.expect("a recorded step").seconds[0]
}

/// Returns the bits of all plans of a path.
fn plans(recorded: &Replayable, mut session: Session) -> Vec<u8> {
    let mut bits = Vec::new();
    session.set_volume(recorded.summaries[0].clone(), None);
    for (index, at) in recorded.path.frames.iter().enumerate() {
        if index == 0 || at.transfer_changed {
            let table = at.transfer.function().to_table().unwrap();
            session.set_transfer(&table, at.transfer.lobes().as_deref()).unwrap();
        }
        if at.camera_switched && index > 0 {
            session.mark(Changes { camera: true, ..Changes::default() });
        }
        let frame = recorded.trace.frame(&recorded.path, index).unwrap();
        let plan = session.plan(&frame, TARGET).unwrap();
        for number in [plan.step, plan.image_sample_distance, plan.seconds, plan.upper, plan.out_of_range] {
            bits.extend(number.to_bits().to_le_bytes());
        }
        let drawn = seconds(&recorded.trace.frames[index], plan.step) as f32;
        let seconds = drawn / (plan.image_sample_distance * plan.image_sample_distance);
        session.observe(plan.id, seconds, ObserveFlags::default()).unwrap();
    }
    bits
}

/// Runs itself again with `ENTIRE_LEVEL=scalar`, since a process detects its level once.
#[test]
fn plans_on_recorded_paths_keep_their_bits() {
    if std::env::var_os("ENTIRE_LEVEL").is_none_or(|level| level != "scalar") {
        let this = "plans::plans_on_recorded_paths_keep_their_bits";
        let mut again = Command::new(std::env::current_exe().unwrap());
        let output = again.args(["--exact", this]).env("ENTIRE_LEVEL", "scalar").output().unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && said.contains("1 passed"), "{said}");
        return;
    }
    let paths = RECORDED.map(|name| recorded(name, 1.0));
    let found = CHECKSUMS.map(|(kind, _)| {
        let bits: Vec<u8> = paths.iter().flat_map(|path| plans(path, session(kind))).collect();
        (kind, format!("{:016x}", fnv1a(&bits)))
    });
    assert_eq!(found.each_ref().map(|(kind, checksum)| (*kind, checksum.as_str())), CHECKSUMS);
}
