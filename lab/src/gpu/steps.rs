//! The steps of a device's study: their commands, their time limits, and the way they end.

use super::{Outcome, State};
use crate::child;
use anyhow::{Context, Result, ensure};
use entire_cli::calibrate::place::{TRAINING_MEMBERS, held_out_in, volumes_in};
use entire_io::interrupt;
use nix::sys::signal::Signal;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// Time that a command has to end by itself, from the signal that asks it to end until it is killed.
const END_TIME_LIMIT: Duration = Duration::from_secs(10);

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Extent {
    /// Number of frames of each volume in a table.
    pub(crate) frames: u32,
    /// Longest image side of the tables, pixels.
    pub(crate) max_size: u32,
    /// Enlargement of volumes along each axis.
    pub(crate) enlarge: u32,
    /// Enlargement along each axis in the tables of large volumes; 0 for no such tables.
    pub(crate) enlarge_large: u32,
    /// Duration of each mode's calibration, seconds.
    pub(crate) calibration: f64,
    /// Maximum number of frames of a calibration.
    pub(crate) calibration_frames: u32,
    /// Maximum number of volumes of a calibration; 0 for all.
    pub(crate) calibration_volumes: usize,
    /// Time limit of collecting a table, seconds.
    pub(crate) table: f64,
    /// Sides of the image in the steering step, pixels.
    pub(crate) held_size: u32,
    /// Number of frames in the steering step.
    pub(crate) held_frames: u32,
    /// Maximum number of volumes in a table.
    pub(crate) volumes: usize,
    /// Sides of the pictures that are compared, pixels.
    pub(crate) picture: u32,
}

impl Extent {
    /// Extent of a study on a device that draws a frame in milliseconds.
    pub(crate) const FULL: Self = Self {
        frames: 40,
        max_size: 1024,
        enlarge: 2,
        enlarge_large: 6,
        calibration: 40.0,
        calibration_frames: 500,
        calibration_volumes: 0,
        table: 35.0,
        held_size: 512,
        held_frames: 240,
        volumes: 16,
        picture: 256,
    };
    /// Extent of a study in tests on a software driver. Steps end when all their frames are done: the time
    /// limits suffice for a program without optimization on a busy machine.
    pub(crate) const SHORT: Self = Self {
        frames: 6,
        max_size: 96,
        enlarge: 1,
        enlarge_large: 0,
        calibration: 120.0,
        calibration_frames: 24,
        calibration_volumes: 3,
        table: 120.0,
        held_size: 48,
        held_frames: 40,
        volumes: 3,
        picture: 64,
    };
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Step {
    /// Name of the step and of its log.
    pub(crate) name: String,
    pub(crate) arguments: Vec<String>,
    /// Time limit, wall seconds.
    pub(crate) seconds: f64,
    /// True if the result is used although the time limit ended the command.
    pub(crate) partial: bool,
    /// File in OUT for the command's standard output; `None` if standard output goes to the log.
    pub(crate) output: Option<String>,
    /// Files of an earlier attempt, which are removed before the command runs.
    pub(crate) anew: Vec<PathBuf>,
}

fn step(name: String, seconds: f64, partial: bool, arguments: Vec<String>) -> Step {
    Step { name, arguments, seconds, partial, output: None, anew: Vec::new() }
}

fn words(parts: &[&str]) -> Vec<String> {
    parts.iter().map(|p| (*p).to_owned()).collect()
}

/// Volumes of held-out members, at least one, in the order of their names.
pub(crate) fn held_out(data: &Path) -> Result<Vec<PathBuf>> {
    let help = "give --data a folder with the layout of the project's data/";
    let found =
        held_out_in(data).with_context(|| format!("cannot read the folder {}; {help}", data.display()))?;
    ensure!(
        !found.is_empty(),
        "{} holds no ENSEMBLE/MEMBER/t*.nrrd except of the members {}, on which models are trained; {help}",
        data.display(),
        TRAINING_MEMBERS.join(", ")
    );
    Ok(found)
}

/// Returns at most `count` of the volumes for calibrations, evenly spread in the order of their names. If
/// `count` is 0, returns none, and `entire calibrate` finds volumes itself.
pub(crate) fn calibrated_with(data: &Path, count: usize) -> Result<Vec<PathBuf>> {
    if count == 0 {
        return Ok(Vec::new());
    }
    let all = volumes_in(data).with_context(|| format!("cannot read the folder {}", data.display()))?;
    let every = all.len().div_ceil(count).max(1);
    Ok(all.into_iter().step_by(every).collect())
}

/// Returns the steps of a shading mode: calibrate a model (on the given volumes, or on those that `entire
/// calibrate` finds), collect frames of held-out volumes, and evaluate the model on them.
pub(crate) fn of_mode(
    mode: &str,
    out: &Path,
    (calibrated, volumes): (&[PathBuf], &[PathBuf]),
    (device, clock): (&str, &str),
    extent: Extent,
) -> Vec<Step> {
    let file = |name: String| out.join(name).to_string_lossy().into_owned();
    let model = file(format!("machine-{mode}.safetensors"));
    let mut calibrate = words(&["calibrate", "--shade", mode, "--clock", clock, "--device", device, "--out"]);
    calibrate.extend([model.clone(), "--table".into(), file(format!("calibrate-{mode}.csv"))]);
    calibrate.extend(["--seconds".into(), extent.calibration.to_string()]);
    calibrate.extend(["--frames".into(), extent.calibration_frames.to_string()]);
    calibrate.extend(["--max-size".into(), extent.max_size.to_string()]);
    calibrate.extend(calibrated.iter().map(|v| v.to_string_lossy().into_owned()));
    let anew = ["csv", "manifest.json"].map(|e| out.join(format!("calibrate-{mode}.{e}"))).to_vec();
    let seconds = extent.calibration + 30.0;
    let mut steps = vec![Step { anew, ..step(format!("calibrate-{mode}"), seconds, false, calibrate) }];
    let mut tables = Vec::new();
    for (name, enlarge) in
        [(format!("frames-{mode}"), extent.enlarge), (format!("large-{mode}"), extent.enlarge_large)]
    {
        if enlarge == 0 {
            continue;
        }
        let table = file(format!("{name}.csv"));
        let mut collect = words(&["collect"]);
        // Two large volumes suffice: they take long to load, and differ from the other volumes only in size.
        let most = if enlarge == extent.enlarge { extent.volumes } else { 2 };
        collect.extend(volumes.iter().take(most).map(|v| v.to_string_lossy().into_owned()));
        collect.extend(words(&["--shade", mode, "--device", device, "--repeats", "3", "--min-size", "32"]));
        collect.extend(["--max-size".into(), extent.max_size.to_string()]);
        collect.extend(["--frames".into(), extent.frames.to_string()]);
        collect.extend(["--enlarge".into(), enlarge.to_string(), "--seed".into(), "41".into()]);
        collect.extend(["--resume".into(), "--out".into(), table.clone()]);
        steps.push(step(name, extent.table, true, collect));
        tables.push(table);
    }
    for (name, table) in ["frames", "large"].iter().zip(&tables) {
        let mut evaluate = words(&["evaluate", "--quiet", "--clock", clock, "--observed", "10", "--model"]);
        evaluate.extend([model.clone(), "--data".into(), table.clone()]);
        evaluate.extend(["--out".into(), file(format!("evaluated-{name}-{mode}"))]);
        steps.push(step(format!("evaluate-{name}-{mode}"), 60.0, false, evaluate));
    }
    steps
}

pub(crate) fn probe(device: &str) -> Step {
    let arguments = words(&["probe", "--json", "--device", device]);
    Step { output: Some("probe.json".into()), ..step("probe".into(), 60.0, false, arguments) }
}

/// The steering step: a path with three switches of the transfer function under several controllers.
pub(crate) fn switches(out: &Path, volume: &Path, device: (&str, &str), target: f64, extent: Extent) -> Step {
    let (device, clock) = device;
    let mut steer = words(&["steer", &volume.to_string_lossy(), "--generate", "switches"]);
    steer.extend(words(&["--device", device, "--clock", clock, "--model"]));
    steer.push(out.join("machine-none.safetensors").to_string_lossy().into_owned());
    steer.extend(["--enlarge".into(), extent.enlarge.to_string()]);
    steer.extend(["--size".into(), format!("{0}x{0}", extent.held_size)]);
    steer.extend(["--frames".into(), extent.held_frames.to_string()]);
    steer.extend(["--target".into(), format!("{target}s")]);
    steer.extend(["--out".into(), out.join("switches").to_string_lossy().into_owned()]);
    step("switches".into(), 90.0, false, steer)
}

/// Runs a step's command, at most until its time limit or the deadline; leaves the step out if the deadline
/// is less than a second away. At the limit, the command is asked to end, as by Ctrl-C, and killed if it does
/// not end. Its output goes to `OUT/logs/NAME.txt`.
///
/// # Errors
/// When the command cannot be started, its log or output file cannot be created, or the user asked to stop.
pub(crate) fn run(
    step: &Step,
    entire: &Path,
    out: &Path,
    deadline: Instant,
    stop: &AtomicBool,
) -> Result<Outcome> {
    let begin = Instant::now();
    let outcome = |state, seconds, said| {
        let (step, arguments) = (step.name.clone(), step.arguments.clone());
        Ok(Outcome { step, arguments, state, seconds, said })
    };
    if deadline.saturating_duration_since(begin) < Duration::from_secs(1) {
        let said = "the time ran out; raise --seconds, or run the command again";
        return outcome(State::LeftOut, 0.0, said.into());
    }
    let own = begin + Duration::from_secs_f64(step.seconds);
    let end = deadline.min(own);
    for left in &step.anew {
        // The file may not exist.
        let _ = std::fs::remove_file(left);
    }
    let log = out.join("logs").join(format!("{}.txt", step.name));
    let said = File::create(&log).with_context(|| format!("cannot write {}", log.display()))?;
    let output = match &step.output {
        Some(name) => File::create(out.join(name)).with_context(|| format!("cannot write {name}"))?,
        None => said.try_clone()?,
    };
    let mut child = Command::new(entire)
        .args(&step.arguments)
        .stdin(std::process::Stdio::null())
        .stdout(output)
        .stderr(said)
        .spawn()
        .with_context(|| format!("cannot run {}", entire.display()))?;
    let over = || interrupt::requested(stop) || Instant::now() >= end;
    let (status, cut) = child::wait(&mut child, over, Signal::SIGINT, END_TIME_LIMIT)?;
    ensure!(!interrupt::requested(stop), "stopped; the same command continues from here");
    let text = std::fs::read_to_string(&log).unwrap_or_default();
    let last = text.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or_default().to_owned();
    let state = match (cut, status.success()) {
        (false, true) => State::Done,
        (true, _) if step.partial && deadline < own => State::Unfinished,
        (true, _) if step.partial => State::CutShort,
        _ => State::Failed,
    };
    let said = if cut && state == State::Failed { format!("took too long: {last}") } else { last };
    outcome(state, begin.elapsed().as_secs_f64(), said)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Outcome of a shell script in a run with `left` seconds until its deadline.
    fn shell(left: f64, script: &str, seconds: f64, partial: bool) -> Outcome {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("logs")).unwrap();
        let step = step("s".into(), seconds, partial, words(&["-c", script]));
        let deadline = Instant::now() + Duration::from_secs_f64(left);
        run(&step, Path::new("/bin/sh"), dir.path(), deadline, &AtomicBool::new(false)).unwrap()
    }

    #[test]
    fn a_step_is_done_failed_or_cut_short_and_its_last_line_is_kept() {
        let done = shell(60.0, "echo one; echo two", 30.0, false);
        assert_eq!((done.state, done.said.as_str()), (State::Done, "two"));
        let failed = shell(60.0, "echo no device >&2; exit 1", 30.0, true);
        assert_eq!((failed.state, failed.said.as_str()), (State::Failed, "no device"));
        let endless = "trap 'echo kept; exit 130' INT; while :; do sleep 0.05; done";
        let cut = shell(60.0, endless, 3.0, true);
        assert_eq!((cut.state, cut.said.as_str()), (State::CutShort, "kept"));
        let unfinished = shell(3.0, endless, 30.0, true);
        assert_eq!((unfinished.state, unfinished.said.as_str()), (State::Unfinished, "kept"));
        let useless = shell(60.0, endless, 3.0, false);
        assert_eq!((useless.state, useless.said.as_str()), (State::Failed, "took too long: kept"));
    }

    #[test]
    fn volumes_that_no_calibration_renders_are_found_in_the_projects_data() {
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data");
        let found = held_out(&data).unwrap();
        assert!(found.len() >= 4 && found.iter().all(|p| p.is_file()));
        let some = calibrated_with(&data, 3).unwrap();
        assert!((2..=3).contains(&some.len()) && some.iter().all(|p| !found.contains(p)), "{some:?}");
        assert_eq!(calibrated_with(&data, 0).unwrap(), Vec::<PathBuf>::new());
        assert!(held_out(Path::new("nowhere")).unwrap_err().to_string().contains("--data"));
    }
}
