//! Records a session's planned and observed frames, to fit a model to them.

use super::{PENDING_PLANS, Session};
use crate::calibrate::{Calibrated, Calibration, Picture, Shown};
use crate::features::{Changes, TransferSummary, VolumeSummary};
use crate::predict::{COSTS, store_probe_side};
use alloc::boxed::Box;
use entire_core::Result;
use entire_core::bail;
use entire_core::memory::try_vec;
use entire_core::model::ModelFile;

/// Record of a plan until its frame's time is known.
#[derive(Clone, Copy)]
struct Planned {
    /// The plan's id; 0 for an empty slot.
    id: u64,
    work: [f64; COSTS],
    shown: Shown,
}

/// A calibration that a session fills.
pub(super) struct Recording {
    calibration: Calibration,
    planned: Box<[Planned]>,
    /// Volume and transfer function of the present frames.
    shown: Shown,
    /// Number of rays along each side of the probe with which the frames are measured.
    probe_side: usize,
}

impl Recording {
    fn place(id: u64) -> usize {
        (id % PENDING_PLANS as u64) as usize
    }

    /// Drops all recorded frames and pictures.
    pub(super) fn clear(&mut self) {
        self.calibration.clear();
        self.planned.iter_mut().for_each(|p| p.id = 0);
    }

    pub(super) fn set_volume(&mut self, volume: &VolumeSummary) {
        self.shown = Shown { volume: volume.fingerprint(), transfer: 0 };
    }

    pub(super) fn set_transfer(&mut self, transfer: &TransferSummary) {
        self.shown.transfer = transfer.fingerprint();
    }

    /// Sets the number of rays along each side of the probe. If it changes, drops all recorded frames and
    /// pictures.
    pub(super) fn set_probe_side(&mut self, side: usize) {
        if side != self.probe_side {
            self.clear();
            self.probe_side = side;
        }
    }

    /// Stores the work of a planned frame, unless [`Changes::first`] or [`Changes::volume`] is set: such a
    /// frame may include uploads.
    pub(super) fn plan(&mut self, id: u64, work: &[f64; COSTS], changes: Changes) {
        let at = Self::place(id);
        let id = if changes.first || changes.volume { 0 } else { id };
        self.planned[at] = Planned { id, work: *work, shown: self.shown };
    }

    /// Adds a planned frame with its time to the calibration.
    pub(super) fn observe(&mut self, id: u64, seconds: f32) {
        let at = Self::place(id);
        let Planned { id: kept, work, shown } = self.planned[at];
        if kept == id {
            self.calibration.add_work(&work, shown, f64::from(seconds));
            self.planned[at].id = 0;
        }
    }
}

impl Session {
    /// Starts to record planned and observed frames for [`Session::calibrate`], up to `frames` of them (8 to
    /// 65 536; later ones replace earlier ones at random, so that the kept frames are a uniform random
    /// sample). Frames recorded before are dropped.
    ///
    /// `prior` is the model to start from: an analytic model that was fitted on another machine or renderer.
    /// Without a prior, the fit starts from unit costs of a software renderer. A frame is not recorded if its
    /// observation is unusual or cancelled, if it is the first of the session or of a volume, or the first
    /// after the learned state was loaded or forgotten, or if [`Changes::first`] or [`Changes::volume`] was
    /// announced for it ([`Session::mark`]). Planning and observing do not allocate while frames are
    /// recorded.
    ///
    /// Frames that were timed earlier can be recorded too: with steering off ([`Session::set_enabled`]), plan
    /// each frame as it was drawn, and observe its time.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a number of frames outside 8 to 65 536,
    /// [`crate::ErrorKind::OutOfMemory`], and for the prior as [`crate::calibrate::prior_costs`].
    pub fn record(&mut self, prior: Option<&ModelFile>, frames: usize) -> Result<()> {
        let calibration = Calibration::new(prior, frames)?;
        let nothing = Planned { id: 0, work: [0.0; COSTS], shown: Shown::default() };
        self.recording = Some(Recording {
            planned: try_vec(PENDING_PLANS, nothing)?.into_boxed_slice(),
            shown: Shown {
                volume: self.volume.as_ref().map_or(0, VolumeSummary::fingerprint),
                transfer: self.transfer.as_ref().map_or(0, TransferSummary::fingerprint),
            },
            probe_side: self.finest_probe_side(),
            calibration,
        });
        Ok(())
    }

    /// Number of kept frames, at most the number given to [`Session::record`]; `None` before that call.
    pub fn recorded(&self) -> Option<usize> {
        self.recording.as_ref().map(|r| r.calibration.frames())
    }

    /// Records a picture that was compared with the same view at full quality, for [`Session::calibrate`],
    /// which then stores this renderer's picture quality law in the model
    /// ([`crate::calibrate::fit_quality`]). Draw each scene at the same settings, full quality among them.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before [`Session::record`], [`crate::ErrorKind::OutOfMemory`], and as
    /// [`Picture::check`].
    pub fn record_picture(&mut self, picture: Picture) -> Result<()> {
        let Some(recording) = &mut self.recording else {
            bail!(NotReady, "nothing is recorded; call record before recording pictures for the quality law");
        };
        recording.calibration.add_picture(picture)
    }

    /// Fits a model to the recorded frames; 500 of them take a second or less on one thread. The session is
    /// unchanged and keeps recording; [`Session::set_predictor`] installs the model.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before [`Session::record`], and for fewer than
    /// [`crate::calibrate::FEWEST_FRAMES`] frames; [`crate::ErrorKind::OutOfMemory`], and as
    /// [`crate::calibrate::fit_frames`].
    pub fn calibrate(&self) -> Result<Calibrated> {
        let Some(recording) = &self.recording else {
            bail!(
                NotReady,
                "no frames were recorded; call record before the frames to which a model is to be fitted"
            );
        };
        let [renderer, clock] = &self.timing;
        let mut made = recording.calibration.fit([renderer, clock])?;
        store_probe_side(recording.probe_side, &mut made.file);
        Ok(made)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adapt::ObserveFlags;
    use crate::calibrate::HeldOut;
    use crate::calibrate::tests::unit_factor;
    use crate::control::HybridOptions;
    use crate::features::tests::{cube, lobe_at};
    use crate::features::{PROBE_SIDE, Setting};
    use crate::predict::{AnalyticModel, UnitCosts, load};
    use entire_core::ErrorKind;
    use entire_core::model::Key;
    use entire_core::scene::{Arcball, Camera, Frame};

    fn frame(i: u32) -> Frame {
        let pose = Arcball { rx: (i * 13 % 80) as f32, ry: (i * 29 % 360) as f32, dz: 1.5 + (i % 4) as f32 };
        Frame::new(Camera::from_arcball(pose).unwrap(), 64 + i * 37 % 400, 64 + i * 53 % 300).unwrap()
    }

    /// Lets a session record the frames of a cube.
    fn recording(mut session: Session) -> Session {
        session.set_volume(cube(24), None);
        session.set_transfer(&lobe_at(0.3), None).unwrap();
        session.record(None, 100).unwrap();
        session
    }

    /// Simulated seconds of a machine whose unit costs are far from the session's initial ones.
    fn drawn(session: &Session, frame: &Frame, step: f32) -> f32 {
        let mut costs = UnitCosts::SOFTWARE;
        (costs.seconds[1], costs.seconds[4], costs.seconds[5]) =
            (8.0 * costs.seconds[1], 3.0 * costs.seconds[4], 0.3 * costs.seconds[5]);
        let setting = Setting { step, ..Setting::from(frame) };
        let work = session.features.cost_work(&setting);
        2.0 * costs.seconds.iter().zip(work).map(|(c, w)| c * w).sum::<f64>() as f32
    }

    /// Plans and draws frames; returns the relative error of every plan's seconds.
    fn play(session: &mut Session, frames: core::ops::Range<u32>) -> Vec<f32> {
        frames
            .map(|i| {
                let frame = frame(i);
                let plan = session.plan(&frame, 1.0).unwrap();
                let seconds = drawn(session, &frame, plan.step);
                session.observe(plan.id, seconds, ObserveFlags::default()).unwrap();
                (plan.seconds / seconds - 1.0).abs()
            })
            .collect()
    }

    #[test]
    fn a_session_makes_a_model_of_its_renderer_and_steers_by_it() {
        let mut session = Session::default();
        assert_eq!(session.recorded(), None);
        assert_eq!(session.calibrate().unwrap_err().kind(), ErrorKind::NotReady);
        session.record(None, 400).unwrap();
        for edge in [24, 32, 40] {
            session.set_volume(cube(edge), None);
            for center in [0.2, 0.6] {
                session.set_transfer(&lobe_at(center), None).unwrap();
                play(&mut session, 0..30);
            }
        }
        // The first frame of each volume is not recorded.
        assert_eq!(session.recorded(), Some(180 - 3));
        session.set_timing_source("a test", "cpu").unwrap();
        let made = session.calibrate().unwrap();
        assert_eq!((made.held_out, made.frames), (HeldOut::Volumes, 177));
        assert!(made.median_error < 0.05, "{}", made.median_error);
        let model = made.file.to_model().unwrap();
        session.set_predictor(load(&model).unwrap(), HybridOptions::default()).unwrap();
        // Predictions are accurate from the first frame on, for a volume that was not recorded.
        session.set_volume(cube(48), None);
        session.set_transfer(&lobe_at(0.4), None).unwrap();
        let mut errors = play(&mut session, 100..120);
        errors.sort_by(f32::total_cmp);
        assert!(errors[10] < 0.08 && errors[19] < 0.4, "{errors:?}");
    }

    #[test]
    fn what_was_not_an_ordinary_frame_is_not_kept() {
        let mut session = recording(Session::default());
        let flags = |unusual, cancelled| ObserveFlags { unusual, cancelled };
        // Five frames: the first of the session, an ordinary one, an unusual one, a cancelled one, and one
        // that is never observed. Only the second must be recorded.
        for (i, flags) in [flags(false, false), flags(false, false), flags(true, false), flags(false, true)]
            .into_iter()
            .enumerate()
        {
            let plan = session.plan(&frame(i as u32), 1.0).unwrap();
            session.observe(plan.id, 0.01, flags).unwrap();
        }
        session.plan(&frame(9), 1.0).unwrap();
        assert_eq!(session.recorded(), Some(1));
        // A frame that was planned before the recording began is not recorded.
        let plan = session.plan(&frame(10), 1.0).unwrap();
        session.record(None, 100).unwrap();
        session.observe(plan.id, 0.01, ObserveFlags::default()).unwrap();
        assert_eq!(session.recorded(), Some(0));
    }

    #[test]
    fn a_withdrawn_plan_is_not_recorded_as_the_first_frame_of_a_volume() {
        let mut session = recording(Session::default());
        play(&mut session, 0..2);
        assert_eq!(session.recorded(), Some(1));
        let withdrawn = session.plan(&frame(2), 1.0).unwrap();
        session.withdraw(withdrawn.id);
        session.set_volume(cube(32), None);
        session.set_transfer(&lobe_at(0.3), None).unwrap();
        let first = session.plan(&frame(3), 1.0).unwrap();
        assert_eq!(first.id, withdrawn.id);
        session.observe(first.id, 0.01, ObserveFlags::default()).unwrap();
        assert_eq!(session.recorded(), Some(1));
    }

    #[test]
    fn recorded_frames_are_of_one_clock_and_of_the_finest_probe() {
        let mut session = Session::default().with_probe(12, Some(1.0)).unwrap();
        session.set_volume(cube(24), None);
        session.set_transfer(&lobe_at(0.3), None).unwrap();
        play(&mut session, 0..1);
        assert_eq!(session.features.probe_side, 4);
        session.record(None, 100).unwrap();
        session.set_timing_source("mine", "wall").unwrap();
        play(&mut session, 1..5);
        assert_eq!((session.features.probe_side, session.recorded()), (12, Some(4)));
        session.set_timing_source("mine", "device").unwrap();
        assert_eq!(session.recorded(), Some(0));
    }

    #[test]
    fn a_calibrated_model_states_the_probe_of_its_frames() {
        for (session, stated) in
            [(Session::default(), None), (Session::default().with_probe(4, None).unwrap(), Some(4))]
        {
            let mut session = recording(session);
            play(&mut session, 0..40);
            let model = session.calibrate().unwrap().file.to_model().unwrap();
            assert_eq!(model.metadata.get(Key::ProbeSide.name()).map(String::as_str), stated.map(|_| "4"));
            assert_eq!(load(&model).unwrap().probe_side(), stated.unwrap_or(PROBE_SIDE));
        }
    }

    #[test]
    fn frames_of_another_probe_are_dropped() {
        let mut session = recording(Session::default());
        play(&mut session, 0..10);
        let network = load(&unit_factor(5).to_model().unwrap()).unwrap();
        session.set_predictor(network, HybridOptions::default()).unwrap();
        assert_eq!(session.recorded(), Some(0));
        play(&mut session, 0..40);
        let model = session.calibrate().unwrap().file.to_model().unwrap();
        assert_eq!(model.metadata[Key::ProbeSide.name()], "5");
    }

    #[test]
    fn a_transfer_function_that_was_shown_before_the_recording_is_recognized() {
        let mut session = recording(Session::default());
        for center in [0.3, 0.6, 0.3] {
            session.set_transfer(&lobe_at(center), None).unwrap();
            play(&mut session, 0..30);
        }
        // Two transfer functions are too few groups for cross-validation, so time intervals are held out.
        assert_eq!(session.calibrate().unwrap().held_out, HeldOut::Stretches);
    }

    #[test]
    fn the_asked_probe_returns_with_unit_costs() {
        let mut session = Session::default().with_probe(24, Some(0.2)).unwrap();
        let network = load(&unit_factor(5).to_model().unwrap()).unwrap();
        session.set_predictor(network, HybridOptions::default()).unwrap();
        assert_eq!((session.features.probe_side, session.adaptive_probe.is_some()), (5, false));
        session.set_predictor(Box::new(AnalyticModel::default()), HybridOptions::default()).unwrap();
        assert_eq!((session.features.probe_side, session.adaptive_probe.is_some()), (24, true));
    }

    #[test]
    fn a_recording_starts_from_unit_costs_alone() {
        let mut session = Session::default();
        let refused = session.record(Some(&unit_factor(5)), 100).unwrap_err();
        assert_eq!(refused.kind(), ErrorKind::Unsupported);
        assert!(refused.to_string().contains("`entire calibrate` made"), "{refused}");
        assert_eq!(session.recorded(), None);
    }

    #[test]
    fn pictures_are_kept_once_frames_are() {
        let mut session = Session::default();
        let picture = Picture { scene: 1, step: 1.0, distance: 1.0, seconds: 0.1, error: 0.0 };
        assert_eq!(session.record_picture(picture).unwrap_err().kind(), ErrorKind::NotReady);
        session.record(None, 8).unwrap();
        session.record_picture(picture).unwrap();
        let broken = Picture { seconds: f64::NAN, ..picture };
        assert_eq!(session.record_picture(broken).unwrap_err().kind(), ErrorKind::InvalidArgument);
        assert_eq!(session.calibrate().unwrap_err().kind(), ErrorKind::NotReady);
    }
}
