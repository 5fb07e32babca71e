//! Services of this program to the window: readers of volumes, predictors, controllers.

use crate::calibrate::place::{machine_model, of_another_kind};
use crate::steering::contenders::{ControllerKind, controller};
use crate::steering::model::{SteeringModel, chosen_model};
use crate::steering::play::choose_pictures;
use crate::steering::rivals::StepResponse;
use anyhow::{Context, Result};
use clap::ValueEnum;
use entire_core::model::{Model, ModelFile};
use entire_core::scene::{Shading, VolumeView};
use entire_explore::{Host, Progress, Steering};
use entire_farm::quoted;
use entire_io::dataset::Clock;
use entire_io::files::write_whole;
use entire_io::volume::{Fill, Range, Reading, Volume};
use entire_report::encode_png;
use entire_steer::Session;
use entire_vk_raycaster::Image;
use std::path::Path;
use std::sync::Arc;

/// Share of a frame's time that does not depend on the ray step. It is assumed for controllers that need a
/// response curve, since the window measures no such curve.
const FIXED_SHARE: f32 = 0.1;

/// This program as the window's [`Host`]: it reads volumes, makes predictors and lists controllers.
pub(super) struct ExplorerHost {
    /// The model of `--model`, with the file's name.
    pub(super) model: Option<(String, Model)>,
    /// Options with which volume files are read.
    pub(super) reading: Reading,
}

/// A predictor for one volume.
struct Predicts {
    model: SteeringModel,
    /// Hash of the model.
    identity: u32,
    /// True if the model was calibrated to this machine; a model given by `--model` is assumed to be.
    calibrated: bool,
    /// The clock that the model states.
    clock: Option<Clock>,
    /// Reason why the machine's model is ignored, if there is one.
    left_out: Option<String>,
}

/// The clock of the window's frames.
const WINDOW: Clock = Clock::Wall;

impl Steering for Predicts {
    fn title(&self) -> String {
        let corrected = if self.calibrated { "" } else { ", corrected by the measured time of every frame" };
        let mut out = format!("predicted by {}{corrected}", self.model.title());
        if let Some(clock) = self.clock.filter(|c| *c != WINDOW) {
            out += &format!(
                "; the model predicts {} seconds, but the window measures {} seconds: the factor between the \
                 two clocks is learned from the first frames",
                clock.name(),
                WINDOW.name()
            );
        }
        if let Some(why) = &self.left_out {
            out += &format!("; {why}");
        }
        out
    }

    fn identity(&self) -> u32 {
        self.identity
    }

    fn volume_features(&self) -> Option<&[f32]> {
        self.model.volume_features()
    }

    fn session(&self, name: &str) -> Result<Session> {
        let kind = ControllerKind::from_name(name).with_context(|| format!("no controller {name:?}"))?;
        let predictor = self.model.predictor()?;
        // The error that a model states was measured on the machine that it was fitted to, so it is used only
        // for a model of this machine.
        let log_sd = predictor.log_sd().filter(|_| self.calibrated);
        let steers = controller(kind, 4.0, &StepResponse::inverse_step(FIXED_SHARE), log_sd);
        let mut session = Session::with_controller(predictor, steers);
        // The window renders with the raycaster, whose quality law applies if the model states none.
        choose_pictures(&mut session)?;
        session.set_timing_source("entire explore", WINDOW.name())?;
        Ok(session)
    }

    fn chooses_image_sample_distance(&self, name: &str) -> bool {
        ControllerKind::from_name(name).is_some_and(ControllerKind::chooses_image_sample_distance)
    }
}

/// Note on a machine's model that is ignored because it was calibrated on another kind of device than the
/// window's, or states another clock than the window's or no clock; `None` for a model that is used.
fn takes_no_part(path: &Path, file: &ModelFile, clock: Option<Clock>, device: &str) -> Option<String> {
    let remedy = "the button \"Calibrate …\" copies the command that makes a model of";
    if let Some(why) = of_another_kind(path, file, "vulkan", device) {
        return Some(format!("{why}: {remedy} this device"));
    }
    (clock != Some(WINDOW)).then(|| {
        let wanted = WINDOW.name();
        let why = clock.map_or("states no clock".into(), |clock| {
            format!("predicts {} time, not {wanted} time", clock.name())
        });
        format!("{} is ignored, since it {why}; {remedy} {wanted} time", path.display())
    })
}

impl Host for ExplorerHost {
    fn open(&self, file: &Path, progress: &Arc<Progress>) -> Result<Volume> {
        Volume::open_as(file, &self.reading, Some(progress.clone()))
    }

    fn steering(&self, volume: &VolumeView<'_>, shading: Shading, device: &str) -> Result<Arc<dyn Steering>> {
        let here = if self.model.is_none() { machine_model(shading)? } else { None };
        let left_out =
            here.as_ref().and_then(|(path, file, clock)| takes_no_part(path, file, *clock, device));
        let machine = here.filter(|_| left_out.is_none());
        let machine = machine.map(|(path, file, _)| (path.display().to_string(), file));
        let (title, model, calibrated) = chosen_model(self.model.clone(), machine, shading)?;
        let clock = entire_io::clock::of(&model);
        let model = SteeringModel::new(title, model, volume)?;
        let identity = model.predictor()?.identity();
        Ok(Arc::new(Predicts { model, identity, calibrated, clock, left_out }))
    }

    fn controllers(&self) -> Vec<(&'static str, &'static str)> {
        ControllerKind::value_variants().iter().map(|k| (k.name(), k.title())).collect()
    }

    fn write_picture(&self, file: &Path, picture: &Image) -> Result<()> {
        write_whole(file, &encode_png(picture)?)
    }

    fn calibration(&self, volume: &Path, shading: Shading) -> String {
        let mut opens = format!("entire explore {} --shade {shading}", quoted(&volume.to_string_lossy()));
        let Reading { array, fill, range } = &self.reading;
        if let Some(array) = array {
            opens += &format!(" --array={}", quoted(array));
        }
        if *fill != Fill::default() {
            opens += &format!(" --fill={fill}");
        }
        if *range != Range::default() {
            opens += &format!(" --range={range}");
        }
        // The window's frames are timed on the host, by wall time.
        format!("entire calibrate --shade {shading} --clock wall && {opens}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    #[cfg(unix)]
    use clap::FromArgMatches;
    use entire_core::model::Key;
    use entire_core::scene::Scalars;
    use entire_steer::predict::AnalyticModel;

    #[test]
    fn a_model_of_another_clock_than_the_windows_is_told() {
        let voxels = [0u8; 512];
        let view = VolumeView::new(Scalars::U8(&voxels), [8; 3]).unwrap();
        let mut file = AnalyticModel::default().to_model_file().unwrap();
        entire_io::clock::set(&mut file, Clock::Cpu);
        let model = file.to_model().unwrap();
        let here = Path::new("here.safetensors");
        let mut predicts = Predicts {
            clock: entire_io::clock::of(&model),
            model: SteeringModel::new("m".into(), model, &view).unwrap(),
            identity: 0,
            calibrated: false,
            left_out: takes_no_part(here, &file, Some(Clock::Device), "a GPU"),
        };
        let title = predicts.title();
        for part in [
            "predicted by m",
            "predicts cpu seconds",
            "here.safetensors is ignored, since it predicts device time",
        ] {
            assert!(title.contains(part), "{part}: {title}");
        }
        (predicts.clock, predicts.left_out) = (Some(WINDOW), None);
        assert_eq!(predicts.title(), "predicted by m, corrected by the measured time of every frame");
        assert!(predicts.session("hybrid").is_ok());
    }

    #[test]
    fn a_model_of_another_kind_of_device_is_told() {
        let mut file = AnalyticModel::default().to_model_file().unwrap();
        file.metadata.insert(Key::Renderer.into(), "vulkan".into());
        file.metadata.insert(Key::Device.into(), "llvmpipe (LLVM 15)".into());
        let note = |device| takes_no_part(Path::new("here.safetensors"), &file, Some(WINDOW), device);
        assert_eq!(note("llvmpipe (LLVM 19)"), None);
        let told = note("NVIDIA H100").unwrap();
        assert!(told.contains("calibrated on llvmpipe") && told.contains("drawn by NVIDIA H100"), "{told}");
    }

    #[cfg(unix)]
    #[test]
    fn the_calibration_command_opens_the_volume_as_the_window_did() {
        let reading = Reading {
            array: Some("the ion's dose".into()),
            fill: Fill::Values(vec![0.0, -1.0]),
            range: Range::Given(-5.0, 5.0),
        };
        let host = ExplorerHost { model: None, reading: reading.clone() };
        let line = host.calibration(Path::new("a volume.nrrd"), Shading::Local);
        let (calibrates, opens) = line.split_once(" && ").unwrap();
        let parsed = |command: &str| {
            let script = format!("printf '%s\\n' {command}");
            let words = std::process::Command::new("sh").args(["-c", &script]).output().unwrap().stdout;
            crate::command().try_get_matches_from(String::from_utf8(words).unwrap().lines()).unwrap()
        };
        let matches = parsed(calibrates);
        let (name, calibration) = matches.subcommand().unwrap();
        let shade = calibration.get_one::<String>("shade").unwrap();
        assert_eq!((name, shade.as_str()), ("calibrate", "local"));
        let matches = parsed(opens);
        let (name, window) = matches.subcommand().unwrap();
        assert_eq!(name, "explore");
        let options = crate::commands::explore::Options::from_arg_matches(window).unwrap();
        assert_eq!(options.volumes, [Path::new("a volume.nrrd")]);
        assert_eq!((options.shade, options.reading), (Shading::Local, reading));
    }

    #[test]
    fn reading_is_followed_and_can_be_stopped() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("v.nrrd");
        let header = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 64 64 64\nencoding: raw\n\n";
        std::fs::write(&file, [header.as_bytes(), &[7; 64 * 64 * 64]].concat()).unwrap();
        let host = ExplorerHost { model: None, reading: Reading::default() };
        let progress = Arc::new(Progress::default());
        let volume = host.open(&file, &progress).unwrap();
        assert_eq!((volume.view().shape().dims, progress.share()), ([64; 3], 1.0));
        let progress = Arc::new(Progress::default());
        progress.cancel();
        let error = host.open(&file, &progress).err().unwrap();
        assert!(format!("{error:#}").contains("cancelled"), "{error:#}");
    }
}
