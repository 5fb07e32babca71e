//! Collections that are stopped, continued and repeated, with a renderer whose clock follows a script.

use super::*;
use crate::scripted::ScriptedRenderer;
use anyhow::bail;
use entire_core::scene::{Shading, Skipping};
use entire_io::dataset::{COLUMNS, Clock, MANIFEST_FORMAT, Manifest, Table};
use entire_io::scenes::SceneDistribution;
use entire_io::volume::{Reading, VolumeData};
use serde_json::json;
use std::cell::Cell;

fn protocol() -> Protocol {
    Protocol {
        frames: 4,
        repeats: 3,
        passes: 1,
        warm_up: 2,
        warm_up_repeats: 0,
        seed: 11,
        scenes: SceneDistribution { max_size: 64, ..Default::default() },
        shading: Shading::None,
        skipping: Skipping::Blocks,
        termination: 0.99,
        enlarge: 1,
        proxy: None,
        reading: Reading::default(),
    }
}

fn some_jobs() -> Vec<Job> {
    ["run/m01/t0003.nrrd", "head.nrrd"].map(|p| Job::from_path(Path::new(p))).to_vec()
}

fn tiny(_: &Path) -> Result<Volume> {
    Volume::new(VolumeData::U8(vec![9; 27]), [3, 3, 3], [1.0; 3], "tiny")
}

/// Rows without their clock columns.
fn without_times(path: &Path) -> Vec<String> {
    let at = COLUMNS.iter().position(|c| *c == "seconds_device").unwrap();
    let text = std::fs::read_to_string(path).unwrap();
    text.lines()
        .map(|l| {
            l.split(',')
                .enumerate()
                .filter(|(i, _)| !(at..at + 3).contains(i))
                .map(|(_, f)| f)
                .collect::<Vec<_>>()
                .join(",")
        })
        .collect()
}

/// Returns a function that returns false in its first `calls` calls, then true; with `None`, always false.
fn stop_after(calls: Option<u32>) -> impl Fn() -> bool {
    let asked = Cell::new(0);
    move || {
        asked.set(asked.get() + 1);
        calls.is_some_and(|n| asked.get() > n)
    }
}

fn run_until(path: &Path, renders: Option<u32>, jobs: &[Job]) -> Outcome {
    let mut table = Writer::resume(path, 3).unwrap();
    let mut renderer = ScriptedRenderer::default();
    let (stop, bar) = (stop_after(renders), ProgressBar::hidden());
    collect(jobs, &protocol(), &mut renderer, &mut tiny, &mut table, &stop, &bar).unwrap()
}

#[test]
fn stopping_anywhere_and_resuming_gives_the_same_table() {
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole.csv");
    let outcome = run_until(&whole, None, &some_jobs());
    assert_eq!(outcome, Outcome { done: 8, total: 8, discarded: 4, interrupted: false });
    let expected = without_times(&whole);
    assert_eq!(expected.len(), 1 + 8 * 3);
    for stop_after in 0..30 {
        let path = dir.path().join(format!("{stop_after}.csv"));
        let first = run_until(&path, Some(stop_after), &some_jobs());
        assert!(first.interrupted, "{stop_after}");
        // A partial frame is not in the table. The first frame of a volume is partial until it was rendered
        // five times (two warm-ups, three repeats).
        assert_eq!(Table::read(&path, 0).map(|t| t.frames.len() as u64).unwrap(), first.done);
        let second = run_until(&path, None, &some_jobs());
        assert!(!second.interrupted && second.done == 8);
        assert_eq!(without_times(&path), expected, "{stop_after}");
    }
}

#[test]
fn passes_make_one_table_whose_repeats_are_far_apart_and_can_be_stopped_anywhere() {
    let dir = tempfile::tempdir().unwrap();
    let protocol = Protocol { passes: 2, repeats: 2, ..protocol() };
    let noisy = || {
        let mut renderer = ScriptedRenderer::default();
        renderer.noise = 0.1;
        renderer
    };
    let run = |out: &Path, renders: u32| {
        let mut table = Writer::resume(out, 4).unwrap();
        let stop = stop_after(Some(renders));
        let bar = ProgressBar::hidden();
        let (jobs, mut renderer) = (some_jobs(), noisy());
        collect_passes(&jobs, &protocol, &mut renderer, &mut tiny, &mut table, out, &stop, &bar).unwrap()
    };
    let whole = dir.path().join("whole.csv");
    assert_eq!(run(&whole, 1000), Outcome { done: 16, total: 16, discarded: 8, interrupted: false });
    let expected = without_times(&whole);
    assert_eq!(expected.len(), 1 + 8 * 4);
    assert!(expected[4].starts_with("0,3,") && expected[5].starts_with("1,0,"), "{}", expected[4]);
    // The first two repeats of each frame are those of the first pass: they equal the repeats of a table that
    // the same renderer makes in a single pass.
    let single = dir.path().join("single.csv");
    let once = Protocol { passes: 1, ..protocol.clone() };
    let (mut table, mut renderer) = (Writer::create(&single).unwrap(), noisy());
    let bar = ProgressBar::hidden();
    collect(&some_jobs(), &once, &mut renderer, &mut tiny, &mut table, &|| false, &bar).unwrap();
    let seconds = |path: &Path| -> Vec<Vec<f64>> {
        let frames = Table::read(path, 0).unwrap().frames;
        frames.iter().map(|f| f.repeats.iter().filter_map(|r| r.seconds(Clock::Wall)).collect()).collect()
    };
    for (all, first) in seconds(&whole).iter().zip(seconds(&single)) {
        assert_eq!((all.len(), &all[..2]), (4, first.as_slice()));
        assert!(all[2] != all[0] && all[3] != all[1], "{all:?}");
    }
    std::fs::remove_file(single).unwrap();
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "pass files are left");
    for stop_after in [0, 3, 21, 22, 23, 43] {
        let out = dir.path().join(format!("{stop_after}.csv"));
        let stopped = run(&out, stop_after);
        assert!(stopped.interrupted && stopped.total == 16, "{stop_after}");
        assert_eq!(Table::read(&out, 0).map(|t| t.frames.len()).unwrap(), 0);
        assert!(!run(&out, 1000).interrupted);
        assert_eq!(without_times(&out), expected, "{stop_after}");
    }
}

#[test]
fn a_volume_whose_reading_is_stopped_interrupts_the_collection() {
    let dir = tempfile::tempdir().unwrap();
    let mut table = Writer::create(&dir.path().join("t.csv")).unwrap();
    let stopped = Cell::new(false);
    let mut open = |_: &Path| -> Result<Volume> {
        stopped.set(true);
        bail!("the voxels cannot be read: interrupted")
    };
    let (mut renderer, stop, bar) = (ScriptedRenderer::default(), || stopped.get(), ProgressBar::hidden());
    let outcome = collect(&some_jobs(), &protocol(), &mut renderer, &mut open, &mut table, &stop, &bar);
    assert_eq!(outcome.unwrap(), Outcome { done: 0, total: 8, discarded: 0, interrupted: true });
}

#[test]
fn order_of_volumes_changes_numbers_but_no_scene() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b) = (dir.path().join("a.csv"), dir.path().join("b.csv"));
    run_until(&a, None, &some_jobs());
    run_until(&b, None, &some_jobs().into_iter().rev().collect::<Vec<_>>());
    let sorted = |p: &Path| {
        let mut rows: Vec<String> =
            without_times(p).into_iter().map(|l| l.split_once(',').unwrap().1.to_owned()).collect();
        rows.sort();
        rows
    };
    assert_eq!(sorted(&a), sorted(&b));
}

#[test]
fn members_and_time_steps_come_from_the_path_and_seeds_do_not_depend_on_the_folder() {
    let job = Job::from_path(Path::new("x/castro_blast/m01/t0012.nrrd"));
    assert_eq!((job.member.as_str(), job.time_step), ("m01", Some(12)));
    assert_eq!(job.seed_name(), "castro_blast/m01/t0012.nrrd");
    let elsewhere = Job::from_path(Path::new("/somewhere/else/castro_blast/m01/t0012.nrrd"));
    assert_eq!(job.seed_name(), elsewhere.seed_name());
    let scan = Job::from_path(Path::new("scans/tooth.nii.gz"));
    assert_eq!((scan.member.as_str(), scan.time_step, scan.seed_name().as_str()), ("", None, "tooth.nii.gz"));
    assert_eq!(Job::from_path(Path::new("t.nrrd")).time_step, None);
    // A path with `..` has the same member and the same frames as this path without `..`.
    let plain = Job::from_path(Path::new("x/m01/t0001.nrrd"));
    for path in ["x/m01/y/../t0001.nrrd", "x/m02/../m01/t0001.nrrd", "x/m01/../../x/m01/t0001.nrrd"] {
        let job = Job::from_path(Path::new(path));
        assert_eq!((&job.member, job.seed_name()), (&plain.member, plain.seed_name()), "{path}");
    }
}

#[test]
fn a_table_is_gone_on_with_under_the_same_settings_alone() {
    let manifest = |p: &Protocol, jobs: &[Job], device: &str| Manifest {
        format: MANIFEST_FORMAT.into(),
        device: device.into(),
        seed: p.seed,
        repeats: p.repeats,
        settings: p.settings(jobs),
        ..Manifest::default()
    };
    let base = manifest(&protocol(), &some_jobs(), "d");
    // A manifest that was written to text and read again has equal numbers.
    let back: Manifest = serde_json::from_str(&serde_json::to_string(&base).unwrap()).unwrap();
    assert_eq!(differences(&back, &base), Vec::<String>::new());
    let mut sorted = back.clone();
    let volumes = sorted.settings["volumes"].as_array_mut().unwrap();
    volumes.iter_mut().for_each(|volume| volume.as_object_mut().unwrap().sort_keys());
    assert_eq!(differences(&sorted, &base), Vec::<String>::new());
    // The protocol that is read from a manifest equals the protocol that the manifest was written from.
    let (passes, repeats, warm_up_repeats) = (2, 4, 1);
    let other = Protocol { passes, repeats, warm_up_repeats, proxy: Some(64), ..protocol() };
    let scenes = SceneDistribution { radii: vec![0.2, 0.5], ..Default::default() };
    let twice = Protocol { shading: Shading::Scatter, scenes, ..other };
    for p in [protocol(), twice] {
        let mut written = manifest(&p, &some_jobs(), "d");
        written.repeats = p.repeats * p.passes;
        assert_eq!(Protocol::of_manifest(&written).unwrap(), (p, some_jobs()));
    }
    let mut other = back.clone();
    other.settings["shading"] = json!("path tracing");
    let error = Protocol::of_manifest(&other).unwrap_err().to_string();
    assert_eq!(error, "the manifest's shading is \"path tracing\", which this version does not know");
    let mut moved = back.clone();
    moved.settings["volumes"][0]["seed_name"] = json!("elsewhere/t.nrrd");
    let error = Protocol::of_manifest(&moved).unwrap_err().to_string();
    assert!(error.contains("were drawn from the name \"elsewhere/t.nrrd\", but the file now has"), "{error}");
    let changed = |f: &dyn Fn(&mut Protocol)| {
        let mut p = protocol();
        f(&mut p);
        differences(&back, &manifest(&p, &some_jobs(), "d")).join("; ")
    };
    assert_eq!(changed(&|p| p.seed = 12), "seed was 11 and is 12 now");
    assert_eq!(changed(&|p| p.repeats = 4), "repeats was 3 and is 4 now");
    assert!(changed(&|p| p.frames = 5).starts_with("frames_per_volume was 4"));
    assert!(changed(&|p| p.shading = Shading::Local).contains("shading"));
    assert!(changed(&|p| p.scenes.steps = vec![0.1]).contains("scenes"));
    assert!(changed(&|p| p.enlarge = 2).contains("enlarged"));
    assert!(differences(&back, &manifest(&protocol(), &some_jobs(), "e"))[0].starts_with("device"));
    assert!(differences(&back, &manifest(&protocol(), &some_jobs()[..1], "d"))[0].contains("volumes"));
}

#[test]
fn a_failing_volume_names_itself() {
    let dir = tempfile::tempdir().unwrap();
    let mut table = Writer::create(&dir.path().join("t.csv")).unwrap();
    let (jobs, mut renderer, bar) = (some_jobs(), ScriptedRenderer::default(), ProgressBar::hidden());
    let mut broken = |_: &Path| -> Result<Volume> { bail!("broken header") };
    let told = collect(&jobs, &protocol(), &mut renderer, &mut broken, &mut table, &|| false, &bar);
    let error = format!("{:#}", told.unwrap_err());
    assert!(error.contains("t0003.nrrd: broken header"), "{error}");
}
