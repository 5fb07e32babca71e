//! Joint choice of step and image size by the quality law (a model of the picture's error), tested on
//! recorded traces.

use super::Replayable;
use crate::trace::{TRACE_SCALES, TracePoint};
use entire_io::metrics::median;
use entire_steer::calibrate::{Picture, fit_quality};
use std::collections::BTreeSet;
use std::path::Path;

/// Fits the quality law to every second trace, and tests it on the traces of other volumes. Returns a
/// sentence with the mean structural similarity of three choices among the settings that meet the target: by
/// the law, by the step alone, and the best choice. `None` if the law cannot be fitted, or if no frame
/// misses a target at full quality and meets this target at a coarser step.
pub(crate) fn frontier(traces: &[Replayable], targets: &[(f64, &str)]) -> Option<String> {
    let fitted: BTreeSet<&Path> =
        traces.iter().step_by(2).flat_map(|t| &t.trace.volumes).map(|v| v.file.as_path()).collect();
    // Returns the points of every frame that was also drawn with both a coarser step and a smaller image. If
    // `test` is false, the frames are those of traces with an even index. If `test` is true, they are those
    // of traces that show no volume of the traces with an even index.
    let points = |test: bool| {
        let fitted = &fitted;
        traces
            .iter()
            .enumerate()
            .filter(move |(i, t)| {
                if test {
                    t.trace.volumes.iter().all(|v| !fitted.contains(v.file.as_path()))
                } else {
                    i % 2 == 0
                }
            })
            .flat_map(|(_, t)| &t.trace.frames)
            .filter(|f| f.iter().any(|p| p.step > 1.0 && p.scale < 1.0))
            .map(|f| {
                f.iter().filter(|p| p.scale == 1.0 || TRACE_SCALES.contains(&p.scale)).collect::<Vec<_>>()
            })
    };
    let pictures: Vec<Picture> = points(false)
        .enumerate()
        .flat_map(|(scene, frame)| {
            frame.into_iter().map(move |p| Picture {
                scene: scene as u64,
                step: p.step,
                distance: 1.0 / p.scale,
                seconds: median(&mut p.seconds.clone()).unwrap_or(f64::NAN),
                error: 1.0 - p.ssim,
            })
        })
        .collect();
    let law = fit_quality(&pictures, None).ok()?;
    let (mut frames, mut by_model, mut by_step, mut best) = (0usize, 0.0, 0.0, 0.0);
    for frame in points(true) {
        for (target, _) in targets {
            let seconds = |p: &TracePoint| median(&mut p.seconds.clone()).unwrap_or(f64::INFINITY);
            let fitting: Vec<_> = frame.iter().copied().filter(|p| seconds(p) <= *target).collect();
            // Counts only frames in which full quality misses the target and a coarser step meets it.
            let full = fitting.iter().filter(|p| p.scale == 1.0).min_by(|a, b| a.step.total_cmp(&b.step));
            let (Some(full), false) = (full, fitting.iter().any(|p| p.scale == 1.0 && p.step <= 1.0)) else {
                continue;
            };
            let error = |p: &TracePoint| law.quality.error(f64::from(p.step), f64::from(1.0 / p.scale));
            let picked = fitting.iter().min_by(|a, b| error(a).total_cmp(&error(b)));
            frames += 1;
            by_step += full.ssim;
            by_model += picked.map_or(0.0, |p| p.ssim);
            best += fitting.iter().map(|p| p.ssim).fold(0.0, f64::max);
        }
    }
    let n = frames as f64;
    (frames > 0).then(|| {
        format!(
            "Quality law (step and image size) on {frames} pairs of a frame and a target, of volumes that \
             the law was not fitted to: mean SSIM {:.4} if the law chooses both, {:.4} if only the step is \
             coarsened, {:.4} for the best choice.",
            by_model / n,
            by_step / n,
            best / n
        )
    })
}
