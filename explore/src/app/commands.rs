//! Commands of the user or a script.

use super::{App, Waiting, controller_of, unknown};
use crate::camera::Axis;
use crate::exchange;
use crate::loading::Load;
use crate::recording::Recorder;
use crate::scene::Crop;
use crate::script::{Action, Script};
use crate::state::Command;
use crate::transfer::{Curve, Opacity, PRESETS};
use anyhow::{Context, Result, bail, ensure};
use ash::vk;
use entire_core::GaussianLobe;
use entire_core::scene::Arcball;
use entire_io::files::write_whole;
use std::path::{Path, PathBuf};
use winit::dpi::PhysicalSize;
use winit::event_loop::ActiveEventLoop;

impl App {
    /// Carries out a command of the interface. Errors in reading or writing transfer functions and recordings
    /// are shown, not returned.
    pub(super) fn obey(&mut self, command: Command) -> Result<()> {
        match command {
            Command::Open(path) => self.load(path)?,
            Command::Step(index) => self.load_step(index)?,
            Command::Cancel => {
                if let Some(loading) = self.loading.take() {
                    loading.cancel();
                    // Otherwise, a playing series would load the same volume again.
                    self.state.playing = false;
                    self.state.say(format!("{} was not opened", loading.job.path.display()));
                }
            }
            Command::Crop(crop) => self.crop(crop)?,
            Command::SpanData => self.span_data()?,
            Command::Forget => {
                self.state.steer.forget();
                self.state.changed.settings = true;
                self.state.say("all controllers are reset");
            }
            Command::Screenshot(shot) => {
                if self.screenshot.is_some() {
                    self.state.say("a screenshot is being drawn; wait for its end");
                } else if self.scene.is_some() {
                    self.start_screenshot(shot)?;
                } else {
                    self.state.say("there is no picture; open a volume first");
                }
            }
            Command::LoadTransfer(file) => {
                let done = self.load_transfer(&file);
                self.told(done, "read", &file);
            }
            Command::SaveTransfer { file, paraview } => {
                let done = self.save_transfer(&file, paraview);
                self.told(done, "wrote", &file);
            }
            Command::SaveRecording(file) => {
                let done = self.save_recording(&file);
                self.told(done, "wrote", &file);
            }
        }
        Ok(())
    }

    fn told(&mut self, done: Result<()>, what: &str, file: &Path) {
        match done {
            Ok(()) => self.state.say(format!("{what} {}", file.display())),
            Err(error) => self.state.complain(&error),
        }
    }

    fn load_transfer(&mut self, file: &Path) -> Result<()> {
        let range = self.state.facts.as_ref().map_or((0.0, 1.0), |f| f.range);
        self.state.replace(exchange::load(file, range)?);
        Ok(())
    }

    fn save_transfer(&self, file: &Path, paraview: bool) -> Result<()> {
        let curve = &self.state.edited.curve;
        let text = if paraview {
            let range = self.state.facts.as_ref().map_or((0.0, 1.0), |f| f.range);
            exchange::to_paraview(curve, range)?
        } else {
            exchange::to_own(curve)?
        };
        write_whole(file, text.as_bytes())
    }

    fn save_recording(&mut self, file: &Path) -> Result<()> {
        Recorder::save(&mut self.state.recorder, |recording| recording.write(file))
    }

    pub(super) fn load(&mut self, path: PathBuf) -> Result<()> {
        self.start(Load { opened: true, ..self.job(path, 0) })
    }

    fn crop(&mut self, crop: Option<Crop>) -> Result<()> {
        let Some(scene) = &self.scene else { return Ok(()) };
        // A part that is the whole volume counts as uncropped.
        let all = scene.facts.dims.map(|n| [0, n - 1]);
        self.start(Load {
            source: Some(scene.whole.clone()),
            range: scene.range,
            crop: crop.filter(|c| *c != all),
            curve: Some(self.state.edited.curve.clone()),
            ..self.job(scene.path.clone(), scene.index)
        })
    }

    /// Maps the voxels' own range to [0, 1]. The transfer function becomes a preset for this range.
    fn span_data(&mut self) -> Result<()> {
        let Some(scene) = &self.scene else { return Ok(()) };
        let range = scene.facts.own_range;
        self.start(Load {
            source: Some(scene.whole.clone()),
            range: Some(range),
            crop: scene.crop,
            ..self.job(scene.path.clone(), scene.index)
        })
    }

    /// Plays the script's events that are due before the next frame. Returns false once the window must
    /// close.
    pub(super) fn play_script(&mut self, event_loop: &ActiveEventLoop) -> Result<bool> {
        if self.scene.is_none()
            && let Some(loss) = self.script.as_mut().and_then(Script::initial_loss)
        {
            self.act(loss)?;
        }
        if !self.is_scripted() || self.scene.is_none() {
            return Ok(true);
        }
        while self.waiting == Waiting::Nothing
            && let Some(action) = self.script.as_mut().and_then(|s| s.next(self.number))
        {
            if matches!(action, Action::Quit(_)) {
                event_loop.exit();
                return Ok(false);
            }
            let said = format!("frame {}: {action:?}", self.number);
            self.act(action).context(said)?;
        }
        let Some(script) = &self.script else { return Ok(true) };
        if script.spin != [0.0; 2] {
            self.state.view.orbit(script.spin[0], script.spin[1]);
            self.state.changed.camera = true;
        }
        if let (Opacity::Lobes(lobes), true) = (&mut self.state.edited.curve.opacity, script.drag != [0.0; 2])
            && let Some(lobe) = lobes.first_mut()
        {
            lobe.center = (lobe.center + script.drag[0]).clamp(0.0, 1.0);
            lobe.height = (lobe.height + script.drag[1]).clamp(0.0, 1.0);
            self.state.changed.transfer = true;
        }
        let goes_on = !script.is_done() || self.waiting != Waiting::Nothing;
        if !goes_on {
            event_loop.exit();
        }
        Ok(goes_on)
    }

    fn act(&mut self, action: Action) -> Result<()> {
        let state = &mut self.state;
        match action {
            Action::Camera([rx, ry, dz]) => {
                state.view.set_arcball(Arcball { rx, ry, dz });
                state.changed.cut = true;
            }
            Action::View(name) => {
                let axis = Axis::ALL.into_iter().find(|a| a.name() == name);
                state
                    .view
                    .look_along(axis.with_context(|| unknown("view", &name, Axis::ALL.map(Axis::name)))?);
                state.changed.cut = true;
            }
            Action::Orthographic(on) => {
                state.changed.cut |= state.view.orthographic != on;
                state.view.orthographic = on;
            }
            Action::Zoom(factor) => {
                state.view.zoom(factor);
                state.changed.camera = true;
            }
            Action::Pan([right, down]) => {
                state.view.pan(right, down);
                state.changed.camera = true;
            }
            Action::Preset(name) => {
                ensure!(PRESETS.contains(&name.as_str()), "{}", unknown("preset", &name, PRESETS));
                ensure!(state.preset(&name), "the preset {name:?} needs a volume; open one first");
            }
            Action::Lobes(lobes) => {
                let lobes = lobes.iter().map(|l| GaussianLobe { center: l[0], width: l[1], height: l[2] });
                let colors = state.edited.curve.colors.clone();
                state.replace(Curve { opacity: Opacity::Lobes(lobes.collect()), colors });
            }
            Action::Controller(name) => {
                state.steer.controller = controller_of(&state.steer.controllers, &name)?;
                state.changed.settings = true;
            }
            Action::Steering(on) => {
                state.steer.enabled = on;
                state.changed.settings = true;
            }
            Action::Target(seconds) => {
                if !(seconds.is_finite() && seconds > 0.0) {
                    bail!("the target is {seconds} seconds; it must be finite and positive");
                }
                state.steer.target = seconds;
                state.changed.settings = true;
            }
            Action::Shading(name) => {
                state.shading = name.parse()?;
                state.changed.settings = true;
            }
            Action::Skipping(name) => {
                state.skipping = name.parse()?;
                state.changed.settings = true;
            }
            Action::Size([width, height]) => {
                if let Some(window) = &self.window {
                    let _ = window.request_inner_size(PhysicalSize::new(width, height));
                }
            }
            Action::Open(path) => {
                self.load(path)?;
                self.waiting = Waiting::Volume;
            }
            Action::Crop(crop) => {
                self.crop(crop)?;
                self.waiting = Waiting::Volume;
            }
            Action::SpanData(_) => {
                self.span_data()?;
                self.waiting = Waiting::Volume;
            }
            Action::Screenshot(shot) => {
                self.start_screenshot(shot)?;
                self.waiting = Waiting::Screenshot;
            }
            Action::Rest(_) => {
                (self.refined, self.refinement) = (false, None);
                self.waiting = Waiting::Rest;
            }
            Action::FullFrame(_) => self.full_frame_at_once()?,
            Action::Map(on) => state.show_work = on,
            Action::SaveTransfer(file) => self.save_transfer(&file, false)?,
            Action::LoadTransfer(file) => self.load_transfer(&file)?,
            Action::Undo(_) => state.changed.transfer |= state.edited.undo(),
            Action::Record(_) => {
                state.recorder = Some(Recorder::new(state.view.fov_y));
            }
            Action::SaveRecording(file) => self.save_recording(&file)?,
            Action::LoseDevice(_) => {
                let device = self.device.as_ref().context("there is no device")?;
                return Err(device.error("the script", vk::Result::ERROR_DEVICE_LOST).into());
            }
            Action::Spin(spin) => self.script.iter_mut().for_each(|script| script.spin = spin),
            Action::Drag(drag) => self.script.iter_mut().for_each(|script| script.drag = drag),
            Action::Quit(_) => {}
        }
        Ok(())
    }
}
