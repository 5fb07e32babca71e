//! Calibration samples of recorded timing tables.

use anyhow::{Context, Result};
use entire_cli::steering::calibrate::{Sample, response};
use entire_cli::steering::rivals::StepResponse;
use entire_io::dataset::{Clock, TimedFrame, read_tables};
use entire_io::options::thread_pool;
use entire_steer::features::PROBE_SIDE;
use entire_train::inputs;
use indicatif::ProgressBar;
use std::collections::HashMap;
use std::path::PathBuf;

/// Returns one calibration sample for each frame of the timing tables, with the name of its volume. Frames with the same
/// volume, camera, image size and transfer function have the same scene number. Scene features come from the default
/// probe.
pub(crate) fn samples_by_volume(tables: &[PathBuf]) -> Result<Vec<(String, Sample)>> {
    let tables = read_tables(tables)?;
    let frames: Vec<&TimedFrame> = tables.iter().flat_map(|t| &t.frames).collect();
    let clock = [Clock::Cpu, Clock::Auto]
        .into_iter()
        .find(|c| frames.iter().all(|f| f.seconds(*c).is_some()))
        .context(
            "the calibration tables share no clock: every frame needs seconds_cpu, or every frame needs the \
             time of one other clock",
        )?;
    let pool = thread_pool(None)?;
    let mut numbers: HashMap<String, usize> = HashMap::new();
    let scenes: HashMap<(usize, u64), usize> = frames
        .iter()
        .map(|f| {
            let s = &f.scene;
            let key = format!("{} {:?} {} {} {:?}", s.volume, s.camera, s.width, s.height, s.lobes);
            let next = numbers.len();
            ((f.table, f.number), *numbers.entry(key).or_insert(next))
        })
        .collect();
    let side = Some(PROBE_SIDE);
    inputs::measure(&tables, &frames, side, None, &pool, &ProgressBar::hidden(), |frame, inputs| {
        let sample = Sample {
            scene: scenes[&(frame.table, frame.number)],
            features: inputs.features.clone(),
            setting: inputs.setting,
            camera: inputs.camera,
            lobes: frame.scene.lobes.clone(),
            seconds: frame.seconds(clock).context("a frame without a time")?,
        };
        Ok((frame.scene.volume.clone(), sample))
    })
}

/// G, the curve of frame time over the step, from samples.
pub(crate) fn response_of(samples: &[Sample]) -> Result<StepResponse> {
    response(samples)
        .context("G, the curve of frame time over step, needs scenes that were timed at several steps")
}
