//! Several passes over the volumes, so that repeats of a frame are minutes apart.

use super::{Job, Outcome, Protocol, collect};
use anyhow::{Context, Result, ensure};
use entire_io::dataset::{Scene, Table, Timing, Writer, feature_table::beside};
use entire_io::volume::Volume;
use entire_vk_raycaster::Renderer;
use indicatif::ProgressBar;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Files in which each pass over the volumes keeps its frames until all passes are done; empty for a single
/// pass.
pub(crate) fn pass_files(out: &Path, passes: u32) -> Vec<PathBuf> {
    let count = if passes > 1 { passes } else { 0 };
    (1..=count).map(|pass| beside(out, &format!(".pass{pass}.csv"))).collect()
}

/// Runs [`collect`] once for each pass of the protocol. Each pass has its own table beside `out`, so that it
/// can be continued. At the end these tables are merged into `table` and removed. In `table`, a frame's
/// repeats have the order of the passes.
#[expect(clippy::too_many_arguments, reason = "the parameters of `collect`, and the path of the table")]
pub(crate) fn collect_passes(
    jobs: &[Job],
    protocol: &Protocol,
    renderer: &mut dyn Renderer,
    open: &mut dyn FnMut(&Path) -> Result<Volume>,
    table: &mut Writer,
    out: &Path,
    stop: &dyn Fn() -> bool,
    progress: &ProgressBar,
) -> Result<Outcome> {
    let total = jobs.len() as u64 * u64::from(protocol.frames);
    // True if the passes were merged into `table` before an interruption, which may have left pass files.
    let complete = (0..total).all(|n| table.done().contains(&n));
    if protocol.passes == 1 || complete {
        let outcome = collect(jobs, protocol, renderer, open, table, stop, progress)?;
        remove(&pass_files(out, protocol.passes))?;
        return Ok(outcome);
    }
    let files = pass_files(out, protocol.passes);
    let all = total * u64::from(protocol.passes);
    let mut outcome = Outcome { done: 0, total: all, discarded: 0, interrupted: false };
    for (i, file) in files.iter().enumerate() {
        progress.set_prefix(format!("collect, pass {} of {}", i + 1, files.len()));
        let mut pass = Writer::resume(file, protocol.repeats)?;
        let of_pass = collect(jobs, protocol, renderer, open, &mut pass, stop, progress)?;
        outcome.done += of_pass.done;
        outcome.discarded += of_pass.discarded;
        outcome.interrupted = of_pass.interrupted;
        // Later passes have not begun.
        if outcome.interrupted {
            return Ok(outcome);
        }
    }
    let mut frames: BTreeMap<u64, (Scene, Vec<Timing>)> = BTreeMap::new();
    for file in &files {
        for frame in Table::read(file, 0)?.frames {
            let entry = frames.entry(frame.number).or_insert_with(|| (frame.scene.clone(), Vec::new()));
            ensure!(
                entry.0 == frame.scene,
                "{}: frame {} is not the same scene as in earlier passes; remove the pass files",
                file.display(),
                frame.number
            );
            entry.1.extend(frame.repeats);
        }
    }
    for (number, (scene, repeats)) in &frames {
        if !table.done().contains(number) {
            table.append(*number, scene, repeats)?;
        }
    }
    remove(&files)?;
    Ok(outcome)
}

pub(crate) fn remove(files: &[PathBuf]) -> Result<()> {
    for file in files.iter().filter(|f| f.exists()) {
        std::fs::remove_file(file).with_context(|| format!("cannot remove {}", file.display()))?;
    }
    Ok(())
}
