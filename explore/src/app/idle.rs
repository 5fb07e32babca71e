//! Work between frames: refinement at rest, screenshots, the map of samples, the next volume of a series.

use super::{App, FULL_QUALITY_TEXTURE, STEERED_TEXTURE, Waiting};
use crate::loading::Load;
use crate::refine::Refinement;
use crate::screenshot::Screenshot;
use crate::script::Shot;
use crate::state::{Rest, Shown};
use crate::work_map::WorkMap;
use anyhow::Result;
use entire_core::scene::Frame;
use entire_vk_raycaster::Region;
use std::time::{Duration, Instant};
use winit::event_loop::ControlFlow;

/// Time without changes after which the picture is refined.
const REST: Duration = Duration::from_millis(150);

/// Interval between updates of a progress display.
pub(super) const SHOW_EVERY: Duration = Duration::from_millis(250);

/// Planned time of a slice of work between frames, as a share of the target frame time. The remainder is for
/// slices that take longer than expected.
const SLICE_SHARE: f64 = 0.75;

impl App {
    /// Works for at most one slice; returns the time at which the event loop continues.
    pub(super) fn idle(&mut self) -> Result<ControlFlow> {
        if self.is_scripted() || self.state.changed.any() || !self.state.commands.is_empty() {
            // A minimized window draws nothing until an event shows it again.
            if self.window.as_ref().is_some_and(|w| w.is_minimized() == Some(true)) {
                return Ok(ControlFlow::Wait);
            }
            self.redraw();
            return Ok(ControlFlow::Poll);
        }
        let now = Instant::now();
        // After the loss of the device, a screenshot waits until its volume is loaded again.
        if self.screenshot.is_some() && (self.scene.is_some() || self.loading.is_none()) {
            self.go_on_with_screenshot()?;
            return Ok(ControlFlow::Poll);
        }
        if self.loading.is_some() {
            if self.last_paint.elapsed() > SHOW_EVERY / 2 {
                self.redraw();
            }
            return Ok(ControlFlow::WaitUntil(now + SHOW_EVERY / 2));
        }
        self.play_series()?;
        let ready = self.scene.is_some() && self.pictures.is_some() && self.number > 0;
        if ready && !self.refined {
            let since = self.last_change.elapsed();
            if since < REST && self.waiting != Waiting::Rest {
                return Ok(ControlFlow::WaitUntil(now + (REST - since)));
            }
            self.go_on_refining()?;
            return Ok(ControlFlow::Poll);
        }
        if ready && self.state.show_work && self.state.work.is_none() {
            self.state.work = Some(WorkMap::new(&self.full_frame(self.state.viewport)?)?);
        }
        if ready && self.state.show_work && self.state.work.as_ref().is_some_and(|w| !w.is_done()) {
            let budget = self.slice_seconds();
            if let (Some(work), Some(scene)) = (&mut self.state.work, &mut self.scene)
                && let Err(error) = work.slice(&mut scene.raycaster, budget)
            {
                // The map is switched off. Otherwise, it would begin again at once and fail again.
                (self.state.show_work, self.state.work) = (false, None);
                return Err(error);
            }
            self.show_now_and_then(false);
            return Ok(ControlFlow::Poll);
        }
        let playing = self.state.playing && self.state.series.len() > 1;
        let next =
            [self.repaint_at, playing.then(|| self.swapped + Duration::from_secs_f32(self.state.hold))];
        match next.into_iter().flatten().min() {
            Some(at) if at <= now => {
                self.repaint_at = None;
                self.redraw();
                Ok(ControlFlow::Poll)
            }
            Some(at) => Ok(ControlFlow::WaitUntil(at)),
            None => Ok(ControlFlow::Wait),
        }
    }

    fn slice_seconds(&self) -> f64 {
        SLICE_SHARE * self.state.steer.target
    }

    /// Requests a redraw of the interface if `at_once` is true or [`SHOW_EVERY`] has passed since the last
    /// frame.
    fn show_now_and_then(&self, at_once: bool) {
        if at_once || self.last_paint.elapsed() > SHOW_EVERY {
            self.redraw();
        }
    }

    /// Returns the frame of the view at full quality.
    pub(super) fn full_frame(&self, [width, height]: [u32; 2]) -> Result<Frame> {
        let placement = self.scene.as_ref().map_or(crate::camera::Placement::WHOLE, |s| s.placement);
        Ok(Frame {
            termination: self.state.termination,
            shading: self.state.shading,
            skipping: self.state.skipping,
            ..Frame::new(self.state.view.camera(placement)?, width, height)?
        }
        .checked()?)
    }

    /// Returns the expected seconds of a frame; NaN without a prediction.
    fn expected(&mut self, frame: &Frame) -> f64 {
        self.state.steer.predict(frame).map_or(f64::NAN, |(seconds, _)| seconds)
    }

    fn go_on_refining(&mut self) -> Result<()> {
        let size = self.pictures.as_ref().map_or([1, 1], |p| p.size);
        if self.refinement.is_none() {
            let frame = self.full_frame(size)?;
            let expected = self.expected(&frame);
            self.refinement = Some(Refinement::new(frame, expected));
        }
        let budget = self.slice_seconds();
        let (Some(work), Some(scene), Some(pictures)) =
            (&mut self.refinement, &mut self.scene, &mut self.pictures)
        else {
            return Ok(());
        };
        work.slice(&mut scene.raycaster, &mut pictures.full, budget)?;
        let done = work.cursor.is_done();
        let took = work.begin.elapsed().as_secs_f64();
        self.state.rest = Some(Rest {
            share: work.cursor.share(),
            remaining: work.cursor.remaining(),
            took: done.then_some(took),
        });
        self.state.picture = Some(Shown {
            steered: STEERED_TEXTURE,
            full: Some((FULL_QUALITY_TEXTURE, pictures.size, work.cursor.covered())),
        });
        if done {
            self.refined = true;
            let numbers = [took, work.cast, work.longest];
            if let Some(log) = &mut self.log {
                log.event(self.number, "rest", numbers, self.state.steer.target)?;
            }
            self.refinement = None;
            if self.waiting == Waiting::Rest {
                self.waiting = Waiting::Nothing;
            }
        }
        self.show_now_and_then(done);
        Ok(())
    }

    /// Draws the view at full quality at once and logs its time.
    pub(super) fn full_frame_at_once(&mut self) -> Result<()> {
        let Some(size) = self.pictures.as_ref().map(|p| p.size) else { return Ok(()) };
        let frame = self.full_frame(size)?;
        let (Some(scene), Some(pictures)) = (&mut self.scene, &mut self.pictures) else { return Ok(()) };
        let begin = Instant::now();
        let time = scene.raycaster.render_to(&frame, Region::whole(&frame), &mut pictures.full)?;
        let seconds = begin.elapsed().as_secs_f64();
        if let Some(log) = &mut self.log {
            log.event(self.number, "full", [seconds, time.wall, seconds], self.state.steer.target)?;
        }
        Ok(())
    }

    pub(super) fn start_screenshot(&mut self, Shot { file, size }: Shot) -> Result<()> {
        let frame = self.full_frame(size)?;
        let expected = self.expected(&frame);
        self.screenshot = Some(Screenshot::new(file, frame, expected));
        self.state.screenshot_share = Some(0.0);
        Ok(())
    }

    fn go_on_with_screenshot(&mut self) -> Result<()> {
        let budget = self.slice_seconds();
        let (Some(shot), Some(scene)) = (&mut self.screenshot, &mut self.scene) else {
            self.end_screenshot();
            return Ok(());
        };
        // If the slice fails because the device is lost, the screenshot continues on the reopened device.
        let done = shot.slice(&mut scene.raycaster, budget, &*self.host)?;
        self.state.screenshot_share = Some(shot.share());
        if done {
            let file = shot.file.display().to_string();
            self.state.say(format!("wrote {file}"));
            self.end_screenshot();
        }
        self.show_now_and_then(done);
        Ok(())
    }

    /// Ends a screenshot, complete or not. Its progress display ends too, and a script stops waiting for it.
    pub(super) fn end_screenshot(&mut self) {
        (self.screenshot, self.state.screenshot_share) = (None, None);
        if self.waiting == Waiting::Screenshot {
            self.waiting = Waiting::Nothing;
        }
    }

    /// Requests the next volume of a playing series.
    fn play_series(&mut self) -> Result<()> {
        let due = self.swapped.elapsed() >= Duration::from_secs_f32(self.state.hold);
        if self.state.playing && self.state.series.len() > 1 && due && self.loading.is_none() {
            let next = (self.state.index + 1) % self.state.series.len();
            self.load_step(next)?;
        }
        Ok(())
    }

    /// Loads a volume of the series; the transfer function stays, and so does a range set by "Span the data".
    pub(super) fn load_step(&mut self, index: usize) -> Result<()> {
        let Some(path) = self.state.series.get(index).cloned() else { return Ok(()) };
        let curve = self.scene.is_some().then(|| self.state.edited.curve.clone());
        let range = self.scene.as_ref().and_then(|scene| scene.range);
        self.start(Load { range, crop: self.state.crop, curve, ..self.job(path, index) })
    }
}
