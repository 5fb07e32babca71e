//! Collection of frames: many random scenes of volumes, rendered several times, in a timing table.
//!
//! The protocol is the paper's (section "Data collection"): the renderer takes one volume at a time, renders
//! all its frames, each several times, and then takes the next volume; loading is not timed. Scenes come from
//! [`entire_io::scenes::SceneDistribution`]; a scene depends only on this distribution, the seed, the
//! volume's name and the scene's number. Every repeat is a row of the table (see [`entire_io::dataset`]);
//! readers take the median of each frame's repeats.

mod passes;
mod protocol;
#[cfg(test)]
mod tests;

pub(crate) use passes::{collect_passes, pass_files, remove};
pub use protocol::{Job, Protocol, differences};
pub(crate) use protocol::{ensure_utf8, manifest_of};

use anyhow::{Context, Result};
use entire_core::scene::Frame;
use entire_io::dataset::{Scene, Timing, Writer};
use entire_io::volume::Volume;
use entire_vk_raycaster::Renderer;
use indicatif::ProgressBar;
use std::path::Path;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Outcome {
    /// Number of frames in the table; with several passes, the sum over the tables of all passes.
    pub(crate) done: u64,
    pub(crate) total: u64,
    /// Warm-up renderings that were discarded in this run.
    pub(crate) discarded: u64,
    pub(crate) interrupted: bool,
}

/// Times of a scene's repeats.
#[derive(Clone, Debug, PartialEq)]
pub struct TimedScene {
    /// Times of each repeat; `None` if the collection stopped before the last repeat.
    pub repeats: Option<Vec<Timing>>,
    /// Number of renderings that were discarded before the repeats.
    pub discarded: u64,
}

/// Renders a scene of the renderer's volume as often as the protocol says. Before the repeats, max(`warm_up`,
/// `protocol.warm_up_repeats`) renderings are discarded; then `warm_up` is 0. `stop` is called before every
/// rendering.
///
/// # Errors
/// A scene that cannot be drawn, a renderer that fails.
pub fn time_scene(
    renderer: &mut dyn Renderer,
    scene: &Scene,
    protocol: &Protocol,
    warm_up: &mut u32,
    stop: &dyn Fn() -> bool,
) -> Result<TimedScene> {
    let frame = scene.to_frame()?;
    renderer.set_transfer(&scene.to_table()?)?;
    *warm_up = (*warm_up).max(protocol.warm_up_repeats);
    let before = *warm_up;
    let repeats = timed_repeats(renderer, &frame, protocol.repeats as usize, warm_up, stop)?;
    Ok(TimedScene { repeats, discarded: u64::from(before - *warm_up) })
}

/// Returns the times of `repeats` renderings of a frame; `None` if `stop`, which is called before every
/// rendering, returned true. Before the repeats, `warm_up` renderings are discarded; each of them reduces
/// `warm_up` by 1.
pub(crate) fn timed_repeats(
    renderer: &mut dyn Renderer,
    frame: &Frame,
    repeats: usize,
    warm_up: &mut u32,
    stop: &dyn Fn() -> bool,
) -> Result<Option<Vec<Timing>>> {
    let mut timings = Vec::with_capacity(repeats);
    while timings.len() < repeats {
        if stop() {
            return Ok(None);
        }
        let rendered = renderer.render(frame)?;
        if *warm_up > 0 {
            *warm_up -= 1;
            continue;
        }
        timings.push(Timing::new(rendered.time, rendered.counts));
    }
    Ok(Some(timings))
}

/// Collects the frames of each job in turn, except those that are in the table already. Frame `i` of job `j`
/// has number `j · frames + i`. `stop` is called after a volume is read and before every rendering; when it
/// returns true, the unfinished frame is dropped.
///
/// # Errors
/// A volume that cannot be read, a renderer that fails, a table that cannot be written; the error names the
/// volume and the frame.
pub(crate) fn collect(
    jobs: &[Job],
    protocol: &Protocol,
    renderer: &mut dyn Renderer,
    open: &mut dyn FnMut(&Path) -> Result<Volume>,
    table: &mut Writer,
    stop: &dyn Fn() -> bool,
    progress: &ProgressBar,
) -> Result<Outcome> {
    let total = jobs.len() as u64 * u64::from(protocol.frames);
    let before = (0..total).filter(|n| table.done().contains(n)).count() as u64;
    let mut outcome = Outcome { done: before, total, discarded: 0, interrupted: false };
    progress.set_length(total);
    progress.set_position(before);
    progress.reset_eta();
    for (j, job) in jobs.iter().enumerate() {
        let first = j as u64 * u64::from(protocol.frames);
        let missing: Vec<u64> =
            (0..u64::from(protocol.frames)).filter(|i| !table.done().contains(&(first + i))).collect();
        if missing.is_empty() {
            continue;
        }
        let shown = job.path.display();
        progress.set_message(format!("{shown}"));
        let opened = open(&job.path);
        // The reading fails if it was stopped.
        if stop() {
            outcome.interrupted = true;
            return Ok(outcome);
        }
        let volume = protocol.sized(opened.with_context(|| format!("{shown}"))?);
        let volume = volume.with_context(|| format!("{shown}"))?;
        renderer.set_volume(&volume.view()).with_context(|| format!("{shown}"))?;
        let mut warm_up = protocol.warm_up;
        for index in missing {
            let scene = protocol.scene(job, volume.dims(), index);
            let number = first + index;
            let timed = time_scene(renderer, &scene, protocol, &mut warm_up, stop)
                .with_context(|| format!("{shown}, frame {number}"))?;
            outcome.discarded += timed.discarded;
            let Some(repeats) = timed.repeats else {
                outcome.interrupted = true;
                return Ok(outcome);
            };
            table.append(number, &scene, &repeats)?;
            outcome.done += 1;
            progress.inc(1);
        }
    }
    Ok(outcome)
}
