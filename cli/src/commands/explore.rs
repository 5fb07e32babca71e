//! `entire explore`: a window on a volume whose frame time stays where it is put.

use crate::files::{open_model, write_json};
use crate::options::{ShadeOption, SkipOption, parse_size};
use crate::path::{CameraPose, Keyframe, Lobe, PATH_FORMAT, PathFile, Point, Transfer, parse_target};
use crate::steering::contenders::{ControllerKind, controller};
use crate::steering::fit::SteeringModel;
use crate::steering::race::shipped_model;
use crate::steering::rivals::StepResponse;
use crate::volume::{Volume, Watcher};
use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use entire_core::Session;
use entire_core::adapt::Prior;
use entire_core::model::Model;
use entire_core::predict::AnalyticModel;
use entire_core::scene::{Arcball, Shading, VolumeView};
use entire_explore::{Host, Progress, RecordedTransfer, Recording, Steering, VolumeSource};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Share of a frame that a coarser step does not save, as rivals take it that go by a response curve which
/// nobody measured here.
const FIXED_SHARE: f32 = 0.1;

/// Explore a volume in a window whose frame time stays where it is put.
///
/// Every frame is planned before it is drawn and told to the predictor afterwards; a graph shows both beside
/// the target. Whenever nothing changes the picture is refined to full quality, in slices that never take
/// longer than the target. Without --model the shipped model steers where the working folder is the
/// project's, else an untrained one; both learn from the frames. Drag to turn, shift-drag to pan, scroll to
/// zoom, F to fly, 1 2 3 to look along an axis, R to reset, Ctrl+Z to take back.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire explore data/nyx_cosmology/m01/t0010.nrrd
  entire explore ct.nii.gz --target 60fps --shade local --skip distance
  entire explore t1.nrrd t2.nrrd t3.nrrd --model out/calibrated.safetensors
  xvfb-run -s '-screen 0 1280x900x24' entire explore skull.nrrd --script events.jsonl --log frames.csv")]
pub struct Options {
    /// The volume file, or those of a time series in order; none for an empty window.
    #[arg(value_name = "VOLUME")]
    pub volumes: Vec<PathBuf>,
    /// Time that frames should not exceed: 33ms, 0.033s or 30fps.
    #[arg(long, default_value = "33ms", value_name = "TIME", allow_hyphen_values = true)]
    pub target: String,
    /// Steer by this model file, which was calibrated to this machine.
    #[arg(long, value_name = "M.safetensors")]
    pub model: Option<PathBuf>,
    /// Who steers at first.
    #[arg(long, value_enum, default_value_t = ControllerKind::Hybrid)]
    pub controller: ControllerKind,
    /// The coarsest ray step that may be chosen, reference steps.
    #[arg(long, default_value_t = 16.0, value_name = "STEP")]
    pub coarsest: f32,
    /// The most pixels between rays along each side that may be chosen.
    #[arg(long, default_value_t = 8.0, value_name = "PIXELS")]
    pub image_sample_distance: f32,
    /// What each sample computes.
    #[arg(long, value_enum, default_value_t)]
    pub shade: ShadeOption,
    /// How empty space is skipped.
    #[arg(long, value_enum, default_value_t)]
    pub skip: SkipOption,
    /// Accumulated opacity at which a ray stops; 1 for never.
    #[arg(long, default_value_t = 0.99, value_name = "OPACITY", allow_hyphen_values = true)]
    pub termination: f32,
    /// Size of the window, pixels.
    #[arg(long, default_value = "1280x800", value_name = "WxH", value_parser = parse_size)]
    pub size: (u32, u32),
    /// Play events from a file (JSON lines, see the book) instead of waiting for a person.
    #[arg(long, value_name = "FILE.jsonl")]
    pub script: Option<PathBuf>,
    /// Write every frame as a row of CSV: seconds, prediction, step, memory.
    #[arg(long, value_name = "FILE.csv")]
    pub log: Option<PathBuf>,
}

/// Runs the command.
///
/// # Errors
/// Without a display or a Vulkan device that shows pictures on it; a model that cannot be read.
pub fn run(options: &Options) -> Result<()> {
    let target = parse_target(&options.target).context("--target")?;
    if !(1.0..=64.0).contains(&options.coarsest) {
        bail!("--coarsest is {}; it must be 1 to 64 reference steps", options.coarsest);
    }
    if !(1.0..=64.0).contains(&options.image_sample_distance) {
        bail!("--image-sample-distance is {}; it must be 1 to 64 pixels", options.image_sample_distance);
    }
    if !(options.termination > 0.0 && options.termination <= 1.0) {
        bail!("--termination is {}; it must lie in (0, 1], 1 for never", options.termination);
    }
    let model = match &options.model {
        Some(file) => Some((file.display().to_string(), open_model(file)?)),
        None => None,
    };
    let window = entire_explore::Options {
        volumes: options.volumes.clone(),
        target,
        coarsest: options.coarsest,
        image_sample_distance: options.image_sample_distance,
        controller: options.controller.name().to_owned(),
        shading: options.shade.into(),
        skipping: options.skip.into(),
        termination: options.termination,
        size: options.size,
        script: options.script.clone(),
        log: options.log.clone(),
    };
    entire_explore::run(window, Arc::new(Surroundings { model }))
}

/// What the window needs, from this program.
struct Surroundings {
    /// The model file that was given, by its name.
    model: Option<(String, Model)>,
}

/// A volume file in memory.
struct Opened(Volume);

impl VolumeSource for Opened {
    fn view(&self) -> VolumeView<'_> {
        self.0.view()
    }
}

/// Follows a file's reading for the window.
struct Follower(Arc<Progress>);

impl Watcher for Follower {
    fn expect(&self, bytes: u64) {
        self.0.expect(bytes);
    }

    fn advance(&self, bytes: u64) -> io::Result<()> {
        self.0.advance(bytes);
        if self.0.is_cancelled() {
            return Err(io::Error::other("cancelled"));
        }
        Ok(())
    }
}

/// A predictor for one volume.
struct Predicts {
    /// None for the untrained analytic model.
    model: Option<SteeringModel>,
    /// Whether the model was calibrated to this machine, as a model that was given is taken to be.
    calibrated: bool,
}

impl Steering for Predicts {
    fn title(&self) -> String {
        match &self.model {
            Some(model) if self.calibrated => format!("predicted by {}", model.title()),
            Some(model) => format!("predicted by {}, corrected by every frame", model.title()),
            None => "predicted by an untrained analytic model, corrected by every frame".to_owned(),
        }
    }

    fn volume_features(&self) -> Option<&[f32]> {
        self.model.as_ref().and_then(SteeringModel::volume_features)
    }

    fn session(&self, name: &str) -> Result<Session> {
        let kind = ControllerKind::from_name(name).with_context(|| format!("no controller {name:?}"))?;
        let predictor = match &self.model {
            Some(model) => model.predictor()?,
            None => Box::new(AnalyticModel::new()),
        };
        // What a model knows of its errors holds on the machine that it was fitted on.
        let prior = match predictor.log_sd() {
            Some(log_sd) if self.calibrated => Prior::Fitted { log_sd },
            _ => Prior::Unknown,
        };
        let steers = controller(kind, 4.0, &StepResponse::inverse_step(FIXED_SHARE), prior);
        Ok(Session::with_controller(predictor, steers))
    }
}

impl Host for Surroundings {
    fn open(&self, file: &Path, progress: &Arc<Progress>) -> Result<Arc<dyn VolumeSource>> {
        let volume = Volume::open_watched(file, Some(Arc::new(Follower(Arc::clone(progress)))))?;
        Ok(Arc::new(Opened(volume)))
    }

    fn steering(&self, volume: &VolumeView<'_>, shading: Shading) -> Result<Arc<dyn Steering>> {
        let calibrated = self.model.is_some();
        let model = match &self.model {
            Some((title, model)) => Some(SteeringModel::new(title.clone(), model.clone(), volume)?),
            None => match shipped_model(shading)? {
                Some((title, file)) => {
                    let title = title.trim_end_matches(", calibrated").to_owned();
                    Some(SteeringModel::new(title, file.to_model()?, volume)?)
                }
                None => None,
            },
        };
        Ok(Arc::new(Predicts { model, calibrated }))
    }

    fn controllers(&self) -> Vec<(&'static str, &'static str)> {
        ControllerKind::value_variants().iter().map(|k| (k.name(), k.title())).collect()
    }

    fn save_recording(&self, file: &Path, recording: &Recording) -> Result<()> {
        let path = path_file(recording);
        // What could not be played is not written.
        path.resolve().context("the recording cannot be played")?;
        write_json(file, &path)
    }

    fn calibration(&self, volume: &Path, shading: Shading) -> String {
        let set = match shading {
            Shading::None => "unshaded",
            other => other.name(),
        };
        let shown = volume.display();
        format!(
            "entire collect {shown} --shade {} --out timings.csv && entire train --data timings.csv --calibrate \
             models/{set}-selected.safetensors --out calibrated.safetensors && entire explore {shown} --model \
             calibrated.safetensors",
            shading.name()
        )
    }
}

/// A recording as a path file. What did not change is held by a keyframe before what did.
fn path_file(recording: &Recording) -> PathFile {
    let frames = &recording.frames;
    let mut keys: Vec<Keyframe> = (0..frames.len() as u32)
        .map(|frame| Keyframe { frame, camera: None, transfer: None, switch: false })
        .collect();
    let pose = |i: usize| {
        let Arcball { rx, ry, dz } = frames[i].camera;
        CameraPose { rx_deg: rx, ry_deg: ry, dz_radii: dz }
    };
    let mut held: Option<Transfer> = None;
    for (i, frame) in frames.iter().enumerate() {
        if i == 0 || pose(i) != pose(i - 1) {
            keys[i].camera = Some(pose(i));
            keys[i].switch |= i > 0 && frame.camera_switched;
            if i > 0 {
                keys[i - 1].camera = Some(pose(i - 1));
            }
        }
        if let Some(found) = frame.transfer.as_ref().map(transfer) {
            let dragged = held.as_ref().filter(|h| !frame.transfer_switched && alike(h, &found)).cloned();
            keys[i].switch |= i > 0 && dragged.is_none();
            if let (Some(before), true) = (dragged, i > 0) {
                keys[i - 1].transfer = Some(before);
            }
            keys[i].transfer = Some(found.clone());
            held = Some(found);
        }
    }
    keys.retain(|k| k.camera.is_some() || k.transfer.is_some());
    PathFile {
        format: PATH_FORMAT.into(),
        name: "recorded".into(),
        frames: frames.len() as u32,
        fov_y_deg: recording.fov_y_degrees,
        keyframes: keys,
    }
}

/// Whether one can be interpolated to the other.
fn alike(a: &Transfer, b: &Transfer) -> bool {
    match (a, b) {
        (Transfer::Lobes(a), Transfer::Lobes(b)) => a.len() == b.len(),
        (Transfer::Points(a), Transfer::Points(b)) => a.len() == b.len(),
        _ => false,
    }
}

fn transfer(recorded: &RecordedTransfer) -> Transfer {
    match recorded {
        RecordedTransfer::Lobes(lobes) => Transfer::Lobes(
            lobes.iter().map(|l| Lobe { center: l.center, width: l.width, height: l.height }).collect(),
        ),
        RecordedTransfer::Points(points) => Transfer::Points(
            points
                .iter()
                .map(|p| Point { position: p.position, color: p.color, opacity: p.opacity })
                .collect(),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::GaussianLobe;
    use entire_explore::RecordedFrame;

    #[test]
    fn a_recording_plays_as_it_was_made() {
        let lobes =
            |height| Some(RecordedTransfer::Lobes(vec![GaussianLobe { center: 0.5, width: 0.01, height }]));
        let at = |ry| Arcball { rx: 10.0, ry, dz: 2.0 };
        let frame = |ry, camera_switched, transfer| RecordedFrame {
            camera: at(ry),
            camera_switched,
            transfer,
            transfer_switched: false,
        };
        let recording = Recording {
            fov_y_degrees: 40.0,
            frames: vec![
                frame(0.0, false, lobes(0.1)),
                frame(0.0, false, None),
                frame(0.0, false, None),
                frame(4.0, false, None),
                frame(90.0, true, None),
                RecordedFrame { transfer_switched: true, ..frame(90.0, false, lobes(0.3)) },
                frame(90.0, false, None),
                frame(90.0, false, lobes(0.4)),
            ],
        };
        let file = path_file(&recording);
        let path = file.resolve().unwrap();
        assert_eq!(path.fov_y_degrees, 40.0);
        let angles: Vec<f32> = path.frames.iter().map(|f| f.camera.ry).collect();
        assert_eq!(angles, [0.0, 0.0, 0.0, 4.0, 90.0, 90.0, 90.0, 90.0], "{file:?}");
        assert_eq!(path.switches(), [4, 5], "the drag is no switch");
        let heights: Vec<f32> = path.frames.iter().map(|f| f.transfer.lobes().unwrap()[0].height).collect();
        assert_eq!(heights, [0.1, 0.1, 0.1, 0.1, 0.1, 0.3, 0.3, 0.4]);
    }

    #[test]
    fn reading_is_followed_and_can_be_stopped() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("v.nrrd");
        let header = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 64 64 64\nencoding: raw\n\n";
        std::fs::write(&file, [header.as_bytes(), &[7; 64 * 64 * 64]].concat()).unwrap();
        let host = Surroundings { model: None };
        let progress = Arc::new(Progress::default());
        let volume = host.open(&file, &progress).unwrap();
        assert_eq!((volume.view().dims(), progress.share()), ([64; 3], 1.0));
        let progress = Arc::new(Progress::default());
        progress.cancel();
        let error = host.open(&file, &progress).err().unwrap();
        assert!(format!("{error:#}").contains("cancelled"), "{error:#}");
    }
}
