//! Collecting frames: many random scenes of volumes, rendered several times, written down as a timing table.
//!
//! The protocol is the paper's (section "Data collection"): the renderer takes one volume at a time, renders
//! all its frames, each several times, then takes the next; loading is not timed. Scenes come from
//! [`crate::scenes::SceneDistribution`], each depending on the seed, the volume and its number alone. Every
//! repeat is a row of the table (see [`crate::dataset`]); medians are taken by whoever reads it.

mod passes;
mod protocol;
#[cfg(test)]
mod tests;

pub use passes::{collect_passes, pass_files};
pub use protocol::{Job, Protocol, differences};

use crate::dataset::{Scene, Timing, Writer};
use crate::enlarge::{enlarge, resample};
use crate::volume::Volume;
use anyhow::{Context, Result};
use entire_core::scene::DEFAULT_FOV_Y_DEGREES;
use entire_vk_raycaster::Renderer;
use indicatif::ProgressBar;
use std::path::Path;

/// What came of a collection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// Frames that are written down now; where there are several passes, those of each.
    pub done: u64,
    /// Frames that are to be.
    pub total: u64,
    /// Warm-up frames rendered and discarded in this run.
    pub discarded: u64,
    /// Whether it was stopped before the end.
    pub interrupted: bool,
}

/// Collects frames of each job in turn, skipping those that the table has. Frame `i` of job `j` has number
/// `j · frames + i`. `stop` is asked before every rendering; a frame in flight is then given up.
///
/// # Errors
/// A volume that cannot be read, a renderer that fails, a table that cannot be written; names the volume and
/// frame.
pub fn collect(
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
        let volume = open(&job.path).with_context(|| format!("{shown}"))?;
        let volume = if let Some(edge) = protocol.proxy {
            resample(&volume, edge).with_context(|| format!("{shown}"))?
        } else if protocol.enlarge == 1 {
            volume
        } else {
            enlarge(&volume, protocol.enlarge).with_context(|| format!("{shown}"))?
        };
        renderer.set_volume(&volume.view()).with_context(|| format!("{shown}"))?;
        let seed_name = job.seed_name();
        let mut warm_up = protocol.warm_up;
        for index in missing {
            let drawn = protocol.scenes.draw(protocol.seed, &seed_name, index);
            let scene = Scene {
                volume: job.path.to_string_lossy().into_owned(),
                member: job.member.clone(),
                time_step: job.time_step,
                dims: volume.dims().map(|n| n as u32),
                camera: drawn.camera,
                fov_y_degrees: DEFAULT_FOV_Y_DEGREES,
                width: drawn.width,
                height: drawn.height,
                step: drawn.step,
                shading: protocol.shading,
                skipping: protocol.skipping,
                termination: protocol.termination,
                lobes: drawn.lobes,
            };
            let number = first + index;
            let place = || format!("{shown}, frame {number}");
            let frame = scene.to_frame().with_context(place)?;
            renderer.set_transfer(&scene.to_table().with_context(place)?).with_context(place)?;
            let mut repeats = Vec::with_capacity(protocol.repeats as usize);
            while repeats.len() < protocol.repeats as usize {
                if stop() {
                    outcome.interrupted = true;
                    return Ok(outcome);
                }
                let rendered = renderer.render(&frame).with_context(place)?;
                if warm_up > 0 {
                    warm_up -= 1;
                    outcome.discarded += 1;
                    continue;
                }
                repeats.push(Timing::new(rendered.time, rendered.counts));
            }
            table.append(number, &scene, &repeats)?;
            outcome.done += 1;
            progress.inc(1);
        }
    }
    Ok(outcome)
}
