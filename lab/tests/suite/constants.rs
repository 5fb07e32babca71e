//! The constants of the controller: their table in the book, and assumptions about recorded paths.

use entire_lab::trace::{Curve, Trace};
use entire_steer::control::{CorrectionConstants, HybridConstants};
use std::path::Path;

#[test]
fn the_book_lists_every_constant_with_its_value() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/src/constants.md");
    let page = std::fs::read_to_string(page).unwrap();
    let mut hybrid = HybridConstants::default();
    let mut correction = CorrectionConstants::default();
    let mut rows = 0;
    for (name, value) in hybrid.values().into_iter().chain(correction.values()) {
        let row = page.lines().find(|l| l.starts_with(&format!("| `{name}` |")));
        let row = row.unwrap_or_else(|| panic!("docs/src/constants.md lacks a row for {name}"));
        let stated = row.split('|').nth(2).and_then(|v| v.trim().parse::<f64>().ok());
        assert_eq!(stated, Some(*value), "docs/src/constants.md: {row}");
        assert!(row.contains(" ± "), "{row}");
        rows += 1;
    }
    let listed = page.lines().filter(|l| l.contains(" ± ")).count();
    assert_eq!(listed, rows, "docs/src/constants.md lists constants that are not searched");
}

/// The adaptive probe assumes that a motion of the camera changes ln(time) by at most turn / 0.4 + approach /
/// 0.15 (`TURN` and `APPROACH` in `steer/src/control/session/adaptive_probe.rs`). Here, turn is the angle
/// between both positions of the eye, seen from the volume's center, in radians; approach is the change of
/// ln(distance from the center). The test checks this for frames of the recorded training paths that are four
/// frames apart.
#[test]
fn frames_of_the_training_paths_change_no_faster_than_the_adaptive_probe_assumes() {
    const FRAMES: usize = 4;
    let mut stretches = 0;
    for name in ["orbit", "drag", "fly-in"] {
        let file = format!("../data/steer/training/train-{name}.json.gz");
        let trace = Trace::open(&Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).unwrap();
        let path = trace.path.resolve().unwrap();
        let frames: Vec<_> = (0..path.frames.len())
            .map(|i| {
                let eye = trace.frame(&path, i).unwrap().camera.view().inverse().w_axis.truncate();
                (eye, Curve::of(&trace.frames[i]).seconds(1.0).ln())
            })
            .collect();
        for (i, pair) in frames.windows(FRAMES + 1).enumerate() {
            if path.frames[i + 1..=i + FRAMES].iter().any(|f| f.transfer_changed || f.switched()) {
                continue;
            }
            let ((a, before), (b, after)) = (pair[0], pair[FRAMES]);
            let turn = f64::from(a.angle_between(b));
            let approach = f64::from((a.length() / b.length()).ln().abs());
            let most = turn / 0.4 + approach / 0.15;
            assert!((after - before).abs() <= most, "{name} {i}: {} {most}", after - before);
            stretches += 1;
        }
    }
    assert!(stretches > 60, "{stretches}");
}
