//! One frame: layout, plan, ray casting, presentation, and the measurement of its time.

use super::{App, FULL_QUALITY_TEXTURE, Pictures, STEERED_TEXTURE, Waiting};
use crate::loading::{Loaded, warm};
use crate::log::{Beside, thread_seconds};
use crate::present::Presented;
use crate::state::{Changed, Shown};
use crate::steering::{FrameRecord, Planned};
use crate::transfer::Edited;
use crate::ui;
use anyhow::Result;
use egui::ClippedPrimitive;
use egui::epaint::Primitive;
use entire_vk_raycaster::{Picture, Region, Renderer};
use std::time::{Duration, Instant};
use winit::event_loop::ActiveEventLoop;

/// Interval in frames between predictions of the full-quality time.
const FULL_EVERY: u64 = 4;

/// A frame whose volume was drawn, with its times.
struct Drawn {
    planned: Planned,
    /// Seconds of ray casting.
    cast: f64,
    /// Seconds from the beginning of the frame to its plan.
    before: f64,
    /// True if camera or transfer function changed abruptly.
    switched: bool,
}

impl App {
    /// Lays out the interface, draws the volume if something changed, and presents both.
    pub(super) fn frame(&mut self, event_loop: &ActiveEventLoop) -> Result<()> {
        let begin = Instant::now();
        let event_at = self.event_at.take();
        self.last_paint = begin;
        self.take_loaded()?;
        let Some(window) = &self.window else { return Ok(()) };
        if window.is_minimized() == Some(true) {
            return Ok(());
        }
        let size = window.inner_size();
        let Some(presenter) = &mut self.presenter else { return Ok(()) };
        if !presenter.prepare([size.width, size.height])? {
            return Ok(());
        }
        if !self.play_script(event_loop)? {
            return Ok(());
        }
        let cpu = thread_seconds();
        let (Some(window), Some(input)) = (&self.window, &mut self.input) else { return Ok(()) };
        let raw = input.take_egui_input(window);
        let state = &mut self.state;
        state.loading = self.loading.as_ref().map(|l| {
            let (stage, share) = l.state();
            let name = l.job.path.file_name().map(|n| n.to_string_lossy().into_owned());
            (name.unwrap_or_default(), stage, share)
        });
        let mut output = self.egui.clone().run_ui(raw, |ui| ui::show(ui, state));
        // egui returns each change of a texture only once. If an error prevents a frame from being shown, its
        // changes are kept for the next frame.
        self.textures.append(std::mem::take(&mut output.textures_delta));
        input.handle_platform_output(window, output.platform_output);
        self.repaint_at = output
            .viewport_output
            .get(&egui::ViewportId::ROOT)
            .and_then(|v| (v.repaint_delay < Duration::from_secs(60)).then(|| begin + v.repaint_delay));
        let mut interface = thread_seconds() - cpu;
        let commands = std::mem::take(&mut self.state.commands);
        for command in commands {
            self.obey(command)?;
        }

        let drawn = self.draw_volume(begin)?;
        let cpu = thread_seconds();
        let mut primitives = self.egui.tessellate(output.shapes, output.pixels_per_point);
        if let Some(pictures) = &self.pictures {
            let whole = self.state.rest.is_some_and(|rest| rest.took.is_some());
            let refined = drawn.is_none() && whole;
            aim(&mut primitives, pictures, drawn.is_some(), refined);
        }
        let Some(presenter) = &mut self.presenter else { return Ok(()) };
        let presented = presenter.show(output.pixels_per_point, &primitives, &mut self.textures)?;
        let waited = if presenter.waits_for_display() { presented.display } else { 0.0 };
        interface += thread_seconds() - cpu - presented.handing;
        if !presented.shown {
            self.redraw();
        }
        self.shown += u64::from(presented.shown);
        if let Some(drawn) = drawn {
            let seconds = begin.elapsed().as_secs_f64() - waited;
            let lag = event_at.map_or(0, |at| self.shown - at);
            self.note(&drawn, seconds, interface, &presented, lag)?;
        }
        Ok(())
    }

    /// Takes over a loaded volume, but not before a screenshot of the present volume is written.
    fn take_loaded(&mut self) -> Result<()> {
        if self.screenshot.is_some() && self.scene.is_some() {
            return Ok(());
        }
        let Some(result) = self.loading.as_ref().and_then(crate::loading::Loading::poll) else {
            return Ok(());
        };
        let is_lost = result.is_err() && self.is_lost();
        let job = self.loading.as_ref().map(|loading| &loading.job);
        let keeps_curve = job.is_some_and(|job| job.curve.is_some());
        let opened = job.is_some_and(|job| job.opened);
        let modes = job.map(|job| (job.shading, job.skipping));
        let asked = self.loading.as_ref().map(|loading| loading.asked);
        if !is_lost {
            self.loading = None;
        }
        let loaded = match result {
            Ok(loaded) => *loaded,
            Err(error) if is_lost || self.script.is_some() => return Err(error),
            Err(error) => {
                // A series stops playing, since its next step would be the same file again.
                self.state.playing = false;
                self.state.complain(&error);
                return Ok(());
            }
        };
        let Loaded { scene, summary, steering, curve, seconds } = loaded;
        // A screenshot continues only if its volume was loaded again after the loss of the device.
        let again = self.scene.is_none()
            && self.state.path.as_ref() == Some(&scene.path)
            && self.state.crop == scene.crop;
        if !again {
            self.end_screenshot();
        }
        let state = &mut self.state;
        let title = scene.path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        if let Some(window) = &self.window {
            window.set_title(&format!("entire explore - {title}"));
        }
        if state.series.get(scene.index) != Some(&scene.path) {
            state.series = vec![scene.path.clone()];
            state.playing = false;
        }
        state.index = scene.index;
        if opened {
            state.recent.add(&scene.path);
        }
        // If the job had a curve, the user may have edited this curve during the load, so the edited one
        // stays.
        if !keeps_curve && curve != state.edited.curve {
            state.edited = Edited::new(curve);
            state.selected = None;
        }
        state.steer.set_volume(summary, steering);
        state.bricks = match scene.raycaster.bricks() {
            1 => "in one texture".to_owned(),
            n => format!("in {n} bricks, since one texture of the device is too small for the volume"),
        };
        state.facts = Some(scene.facts.clone());
        state.histogram = Some(scene.histogram.clone());
        state.crop = scene.crop;
        state.crop_draft = scene.crop.unwrap_or(scene.facts.dims.map(|n| [0, n - 1]));
        state.path = Some(scene.path.clone());
        state.work = None;
        match scene.whole.notes() {
            [] => state.say(format!("opened {title} in {seconds:.2} s")),
            notes => state.say(format!("opened {title} in {seconds:.2} s; {}", notes.join("; "))),
        }
        state.changed.transfer = true;
        state.changed.replaced = true;
        state.picture = Some(Shown { steered: STEERED_TEXTURE, full: None });
        self.warm.clear();
        self.warm.extend(modes);
        self.refinement = None;
        self.scene = Some(scene);
        self.name_predictor();
        self.asked = asked;
        self.swapped = Instant::now();
        if self.waiting == Waiting::Volume {
            self.waiting = Waiting::Nothing;
        }
        Ok(())
    }

    /// Sets the shown name of the predictor and the commands of the button "Calibrate …", both for the
    /// current shading mode.
    fn name_predictor(&mut self) {
        let Some(scene) = &self.scene else { return };
        let state = &mut self.state;
        state.predictor = state.steer.predictor(state.shading);
        state.calibration = self.host.calibration(&scene.path, state.shading);
    }

    /// Makes pictures of the view's size, unless they exist. Returns true if they are new.
    fn prepare_pictures(&mut self) -> Result<bool> {
        let size = self.state.viewport;
        if self.pictures.as_ref().is_some_and(|p| p.size == size) {
            return Ok(false);
        }
        let (Some(device), Some(presenter)) = (&self.device, &mut self.presenter) else { return Ok(false) };
        if let Some(old) = self.pictures.take() {
            presenter.remove_picture(old.steered_id);
            presenter.remove_picture(old.full_id);
        }
        let steered = Picture::new(device, size[0], size[1])?;
        let full = Picture::new(device, size[0], size[1])?;
        let steered_id = presenter.add_picture(&steered)?;
        let full_id = presenter.add_picture(&full)?;
        self.pictures = Some(Pictures { steered, full, steered_id, full_id, size, used: size });
        Ok(true)
    }

    /// Plans and casts a frame, if anything changed.
    fn draw_volume(&mut self, begin: Instant) -> Result<Option<Drawn>> {
        if self.scene.is_none() || self.state.viewport.contains(&0) {
            self.state.changed = Changed::default();
            return Ok(None);
        }
        let resized = self.prepare_pictures()?;
        if self.state.show_work && (resized || self.state.changed.any()) {
            self.state.work = None;
        }
        if !(resized || self.state.changed.any() || self.is_scripted()) {
            return Ok(None);
        }
        let changed = std::mem::take(&mut self.state.changed);
        (self.refined, self.refinement, self.state.rest) = (false, None, None);
        self.last_change = Instant::now();
        let (Some(scene), Some(pictures)) = (&mut self.scene, &mut self.pictures) else { return Ok(None) };
        let state = &mut self.state;
        if changed.transfer {
            let curve = &state.edited.curve;
            let table = curve.table()?;
            scene.raycaster.set_transfer(&table)?;
            state.steer.set_transfer(table, curve.lobes());
            if let Some(shot) = &mut self.screenshot {
                shot.restart();
            }
        }
        if changed.cut {
            state.steer.camera_cut();
        }
        let modes = (state.shading, state.skipping);
        if self.warm.insert(modes) {
            warm(&mut scene.raycaster, modes.0, modes.1)?;
        }
        let size = pictures.size;
        if changed.settings {
            self.name_predictor();
        }
        let frame = self.full_frame(size)?;
        let (Some(scene), Some(pictures)) = (&mut self.scene, &mut self.pictures) else { return Ok(None) };
        let state = &mut self.state;
        if self.number.is_multiple_of(FULL_EVERY) || changed.abrupt() || changed.settings {
            state.steer.predict_full(&frame)?;
        }
        let before = begin.elapsed().as_secs_f64();
        let planned = state.steer.plan(&frame, before)?;
        let whole = Region::whole(&planned.frame);
        let time = scene.raycaster.render_to(&planned.frame, whole, &mut pictures.steered)?;
        let cast = time.wall;
        // On a graphics device, processor time says nothing of other programs.
        let processor = time.cpu.filter(|_| scene.raycaster.is_software());
        state.steer.observe(&planned, frame.shading, cast, processor)?;
        pictures.used = [whole.width, whole.height];
        state.picture = Some(Shown { steered: STEERED_TEXTURE, full: None });
        state.probe = state.steer.probe(state.shading);
        if let Some(recorder) = &mut state.recorder {
            recorder.note(&state.view, &state.edited.curve, changed.replaced)?;
        }
        Ok(Some(Drawn { planned, cast, before, switched: changed.abrupt() }))
    }

    /// Stores and logs a drawn frame.
    fn note(
        &mut self,
        drawn: &Drawn,
        seconds: f64,
        interface: f64,
        presented: &Presented,
        lag: u64,
    ) -> Result<()> {
        let Drawn { planned, cast, before, switched } = *drawn;
        let steer = &mut self.state.steer;
        let record = FrameRecord {
            number: self.number,
            seconds,
            cast,
            interface,
            other: planned.other,
            target: steer.target,
            predicted: f64::from(planned.plan.seconds) + planned.other,
            upper: f64::from(planned.plan.upper) + planned.other,
            step: planned.plan.step,
            image_sample_distance: planned.plan.image_sample_distance,
            reason: planned.plan.reason,
            switched,
            full: steer.full.map_or(f64::NAN, |f| f.0 + planned.other),
        };
        steer.remember(record, (seconds - before - cast).max(0.0));
        let controller = steer.controllers[steer.controller].0;
        if let Some(log) = &mut self.log {
            if let Some(asked) = self.asked.take() {
                let opened = asked.elapsed().as_secs_f64();
                log.event(self.number, "open", [opened, cast, seconds], steer.target)?;
            }
            let (width, height) = (planned.frame.width, planned.frame.height);
            let beside = Beside {
                controller,
                input_frames: lag,
                width,
                height,
                before,
                shown: presented.device,
                handing: presented.handing,
            };
            log.frame(&record, &beside)?;
        }
        self.asked = None;
        self.number += 1;
        Ok(())
    }
}

/// Replaces the placeholders [`STEERED_TEXTURE`] and [`FULL_QUALITY_TEXTURE`] by the texture ids of the
/// pictures, and shows only the used part of the steered picture. Removes pictures that must not be shown. If
/// this frame drew the steered picture (`cast`), the full-quality picture is outdated and is removed. If the
/// full-quality picture is complete (`refined`), the steered picture is removed. A picture that was never
/// drawn is removed, too.
fn aim(primitives: &mut Vec<ClippedPrimitive>, pictures: &Pictures, cast: bool, refined: bool) {
    let share = [0, 1].map(|a| {
        let (used, all) = (pictures.used[a] as f32, pictures.size[a] as f32);
        // The interpolation at the edge must not read pixels beyond the used part.
        if pictures.used == pictures.size { 1.0 } else { (used - 0.5) / all }
    });
    primitives.retain(|primitive| {
        let Primitive::Mesh(mesh) = &primitive.primitive else { return true };
        match mesh.texture_id {
            STEERED_TEXTURE => !refined && !pictures.steered.is_fresh(),
            FULL_QUALITY_TEXTURE => !cast && !pictures.full.is_fresh(),
            _ => true,
        }
    });
    for primitive in primitives {
        let Primitive::Mesh(mesh) = &mut primitive.primitive else { continue };
        if mesh.texture_id == STEERED_TEXTURE {
            mesh.texture_id = pictures.steered_id;
            for vertex in &mut mesh.vertices {
                vertex.uv = egui::pos2(vertex.uv.x * share[0], vertex.uv.y * share[1]);
            }
        } else if mesh.texture_id == FULL_QUALITY_TEXTURE {
            mesh.texture_id = pictures.full_id;
        }
    }
}
