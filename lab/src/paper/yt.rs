//! Frames drawn by yt. The collector in `examples` is called once for every volume and once for its
//! low-resolution proxy, so that a stopped collection can be continued.

use super::Work;
use super::collect::{Kind, table_path};
use super::description::YT;
use super::volumes::Place;
use anyhow::{Context, Result, ensure};
use entire_cli::collection::Job;
use entire_io::dataset::{Manifest, Scene, Table, Writer};
use entire_io::files::{make_folder, make_folder_of};
use entire_io::progress::templated_bar;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::Command;

/// Path of the table of one volume's frames.
fn part(work: &Work<'_>, job: &Job, low: bool) -> PathBuf {
    let name = job.name().replace(['/', '.'], "-");
    work.out.join("tables").join("yt").join(format!("{name}{}.csv", if low { "-low" } else { "" }))
}

/// Collects the missing frames of a data set and merges them. Held-out volumes come first.
pub(crate) fn collect(work: &Work<'_>, place: &Place) -> Result<()> {
    if !place.set.modes.iter().any(|m| m == YT) || !work.selection.has_mode(YT) {
        return Ok(());
    }
    make_folder(&work.out.join("tables").join("yt"))?;
    let mut jobs: Vec<&Job> = place.jobs.iter().collect();
    jobs.sort_by_key(|j| place.frames_of(j, work.paper));
    let bar = templated_bar("yt [{bar:30}] {pos}/{len} volumes, {eta} left  {wide_msg}");
    bar.set_length(2 * jobs.len() as u64);
    bar.reset_eta();
    for job in jobs {
        for low in [false, true] {
            let to = part(work, job, low);
            if !to.exists() {
                work.go_on()?;
                bar.set_message(job.name());
                of_volume(work, place, job, low, &to)?;
            }
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    put_together(work, place)
}

fn of_volume(work: &Work<'_>, place: &Place, job: &Job, low: bool, to: &std::path::Path) -> Result<()> {
    let yt = &work.paper.yt;
    let absolute = |p: &std::path::Path| std::path::absolute(p).unwrap_or_else(|_| p.to_owned());
    let begun = absolute(&to.with_extension("begun.csv"));
    for old in [begun.clone(), Manifest::path_for(&begun)] {
        if old.exists() {
            std::fs::remove_file(&old).with_context(|| format!("cannot remove {}", old.display()))?;
        }
    }
    // The volume's name is part of the seed of its scenes, as for the raycaster.
    let frames = if low { work.paper.frames.held_out } else { place.frames_of(job, work.paper) };
    let mut command = Command::new(work.python);
    command
        .arg(absolute(&yt.script))
        .args(["--seed", &work.paper.seed.to_string(), "--repeats", &yt.repeats.to_string()])
        .args(["--frames", &frames.to_string(), "--warm-up", "1"])
        .args(["--min-size", &yt.min_size.to_string(), "--max-size", &yt.max_size.to_string()])
        .arg("--out")
        .arg(&begun)
        .arg(job.name())
        .current_dir(&place.root);
    if low {
        command.args(["--proxy", &work.paper.proxy.to_string()]);
    }
    let output = command.output().with_context(|| format!("cannot start {}", work.python.display()))?;
    ensure!(
        output.status.success(),
        "{} failed on {}: {}; use --python to name an interpreter that has yt (pip install yt)",
        yt.script.display(),
        job.name(),
        String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or_default()
    );
    let rename = |from: PathBuf, to: PathBuf| {
        std::fs::rename(&from, &to).with_context(|| format!("cannot rename {}", from.display()))
    };
    rename(Manifest::path_for(&begun), Manifest::path_for(to))?;
    rename(begun, to.to_owned())
}

/// Merges the volumes' frames into tables, with the frame numbers of the raycaster's tables.
fn put_together(work: &Work<'_>, place: &Place) -> Result<()> {
    let each = u64::from(work.paper.frames.training);
    let mut scenes: BTreeMap<u64, Scene> = BTreeMap::new();
    for low in [false, true] {
        let path = table_path(work.out, &place.set.name, YT, Kind::Random, low);
        if path.exists() {
            std::fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
        }
        make_folder_of(&path)?;
        let mut writer = Writer::create(&path)?;
        let mut manifest: Option<Manifest> = None;
        for (j, job) in place.jobs.iter().enumerate() {
            let table = Table::read_without_features(&part(work, job, low), 0)?;
            manifest = manifest.or(table.manifest);
            for frame in table.frames {
                let number = j as u64 * each + frame.number;
                let scene = match scenes.get(&number) {
                    // The step is rounded for each grid of voxels, so the step at low resolution may differ.
                    Some(full) => {
                        let here = Scene { dims: full.dims, step: full.step, ..frame.scene.clone() };
                        ensure!(
                            here == *full,
                            "{}: frame {} has another scene than at full resolution",
                            path.display(),
                            frame.number
                        );
                        Scene { dims: frame.scene.dims, ..full.clone() }
                    }
                    None => frame.scene.clone(),
                };
                writer.append(number, &scene, &frame.repeats)?;
                if !low {
                    scenes.insert(number, scene);
                }
            }
        }
        manifest.context("no manifest of yt's frames")?.write(&path)?;
    }
    Ok(())
}
