//! One render loop: a volume, a transfer function, a predictor and a controller.

mod adaptive_probe;
mod coarsening;
#[cfg(feature = "calibrate")]
mod recording;
mod state;
#[cfg(not(feature = "calibrate"))]
mod unrecorded;

use super::{Controller, Decision, HybridOptions, Observed, PlanRequest, Reason, StepLimits};
use crate::adapt::{ObserveFlags, Verdict, check_seconds};
use crate::features::{Changes, FrameFeatures, Setting, TransferSummary, VolumeSummary};
use crate::predict::{AnalyticModel, CostTerms, Inputs, Prediction, Predictor, Quality, Source, TERMS};
use alloc::boxed::Box;
use alloc::string::String;
use alloc::vec::Vec;
use coarsening::Coarsening;
use entire_core::bail;
use entire_core::memory::{collected, reserve};
use entire_core::scene::{Frame, GaussianLobe, Shading, Skipping, TransferTable};
use entire_core::{Error, ErrorKind, Result};
#[cfg(feature = "calibrate")]
use recording::Recording;
#[cfg(not(feature = "calibrate"))]
use unrecorded::Recording;

/// Largest number of plans that wait for their observation; older plans are forgotten.
pub(crate) const PENDING_PLANS: usize = 64;

/// Plan of a frame: settings to draw with, and expected time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plan {
    /// Identifier for [`Session::observe`]; never 0, and unique within a session, except that a withdrawn
    /// plan's id ([`Session::withdraw`]) is used again.
    pub id: u64,
    /// Ray step in multiples of the reference step.
    pub step: f32,
    /// Distance of neighboring rays along each side, in pixels of the frame: the image is drawn with the
    /// frame's sides divided by this number, rounded down, but at least 1. The number is 1 unless
    /// [`Session::set_max_image_sample_distance`] allows more.
    pub image_sample_distance: f32,
    /// Expected seconds; NaN if the controller predicts no time.
    pub seconds: f32,
    /// Upper bound in seconds; NaN if there is none.
    pub upper: f32,
    /// [`Prediction::out_of_range`] for these settings; NaN if the score is unknown.
    pub out_of_range: f32,
    /// Reason for the step.
    pub reason: Reason,
}

#[derive(Clone, Copy)]
struct Pending {
    id: u64,
    /// The planned frame, with the expected seconds in place of measured ones, or NaN if they are unknown.
    frame: Observed,
    observed: bool,
}

/// State of a session before a plan.
#[derive(Clone, Copy, Debug)]
struct Before {
    /// Coarsening level.
    level: usize,
    /// Changes that the caller had announced.
    changes: Changes,
    /// Setting of the last planned frame, and the opacity at which its rays ended early.
    last: Option<Setting>,
    last_termination: f32,
}

/// Predicts and steers one render loop.
///
/// Set the volume and the transfer function. Then for every frame call [`Session::plan`], draw with the
/// plan's step, and report the time to [`Session::observe`]. Observations may be late as long as their plan
/// is among the last 64 plans. Plan, choose, predict and observe do not allocate.
pub struct Session {
    predictor: Box<dyn Predictor + Send>,
    pub(super) controller: Box<dyn Controller + Send>,
    /// Analytic model. The ratio of its times at two steps scales predictions that do not depend on the step.
    shape: AnalyticModel,
    volume: Option<VolumeSummary>,
    transfer: Option<TransferSummary>,
    volume_features: Option<Vec<f32>>,
    lobes: Option<Vec<GaussianLobe>>,
    pub(super) features: FrameFeatures,
    /// Probe that the caller asked for: rays along each side, and the tolerance of a refinement.
    asked_probe: Option<(usize, Option<f32>)>,
    /// Refinement of the probe; `None` if every plan casts the same number of rays.
    adaptive_probe: Option<adaptive_probe::AdaptiveProbe>,
    /// View for which the probe's rays were last cast; `None` without refinement.
    cast_for: Option<adaptive_probe::Cast>,
    coarsening: Coarsening,
    enabled: bool,
    changes: Changes,
    last: Option<Setting>,
    last_termination: f32,
    pending: Box<[Option<Pending>; PENDING_PLANS]>,
    next_id: u64,
    /// Processor seconds of the frame of the next observation; NaN if they are unknown.
    processor_seconds: f32,
    /// Id of the newest plan, and the state before it, for [`Session::withdraw`]; `None` after a withdrawal.
    newest: Option<(u64, Before)>,
    /// Names of the renderer and the clock of observed times; empty if they are unknown.
    timing: [String; 2],
    /// True if the clock of observed times is known not to be that of predicted times.
    converted: bool,
    recording: Option<Recording>,
    /// Picture quality law set by the caller; `None` if the model's law or the built-in one is used.
    quality: Option<Quality>,
}

impl Default for Session {
    /// A session without a model file: it uses the analytic model with default costs, corrected by
    /// observations.
    fn default() -> Self {
        let controller = HybridOptions::default().controller();
        Self::with_controller(Box::new(AnalyticModel::default()), controller)
    }
}

impl Session {
    /// Returns a session with the default controller and the given predictor. If
    /// [`HybridOptions::log_sd`] is `None`, it is the error that the predictor states.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a miss rate, tolerance or trust limit outside its range,
    /// naming the option, its value and its range.
    pub fn new(predictor: Box<dyn Predictor + Send>, options: HybridOptions) -> Result<Self> {
        let controller = controller_for(&*predictor, options)?;
        Ok(Self::with_controller(predictor, controller))
    }

    /// Returns a session with the given predictor and controller.
    pub fn with_controller(
        predictor: Box<dyn Predictor + Send>,
        controller: Box<dyn Controller + Send>,
    ) -> Self {
        let mut session = Self {
            predictor,
            controller,
            shape: AnalyticModel::default(),
            volume: None,
            transfer: None,
            volume_features: None,
            lobes: None,
            features: FrameFeatures::default(),
            asked_probe: None,
            adaptive_probe: None,
            cast_for: None,
            coarsening: Coarsening::of_step(StepLimits::default()),
            enabled: true,
            changes: Changes { first: true, ..Changes::default() },
            last: None,
            last_termination: f32::NAN,
            pending: Box::new([None; PENDING_PLANS]),
            next_id: 1,
            processor_seconds: f32::NAN,
            newest: None,
            timing: [String::new(), String::new()],
            converted: false,
            recording: None,
            quality: None,
        };
        session.set_probe();
        session.weigh_pictures();
        session
    }

    /// Sets the volume's summary, and VolumeNet's output for the volume if the model needs it. The transfer
    /// function must be set again. Does not allocate.
    pub fn set_volume(&mut self, volume: VolumeSummary, volume_features: Option<Vec<f32>>) {
        if let Some(recording) = &mut self.recording {
            recording.set_volume(&volume);
        }
        self.volume = Some(volume);
        self.volume_features = volume_features;
        self.transfer = None;
        self.changes.volume = true;
    }

    /// Sets the summary of the volume's next time step (made by [`crate::features::SummarySeries`]), and
    /// VolumeNet's output for it; `None` keeps the output for the preceding time step. Transfer function and
    /// learned state stay: no change is announced. If the next frame includes an upload, announce it with
    /// [`Session::mark`]. Does not allocate.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before a volume was set, [`crate::ErrorKind::SizeMismatch`] for a
    /// summary whose sizes, spacing, cells or blocks differ from those of the preceding time step,
    /// [`crate::ErrorKind::InvalidArgument`] if the voxel type differs; on an error nothing has changed.
    pub fn set_time_step(&mut self, volume: VolumeSummary, volume_features: Option<Vec<f32>>) -> Result<()> {
        let Some(before) = &self.volume else {
            bail!(NotReady, "no volume is set; set the first time step of a series by set_volume");
        };
        let grid = |v: &VolumeSummary| (v.shape(), v.cells, v.block);
        if grid(&volume) != grid(before) {
            let text = |v: &VolumeSummary| {
                let (shape, cells, block) = (v.shape(), v.cells, v.block);
                alloc::format!(
                    "{:?} voxels of spacing {} in {cells:?} cells and blocks of {block:?}",
                    shape.dims,
                    shape.spacing
                )
            };
            bail!(
                SizeMismatch,
                "a time step must have the sizes, spacing, cells and blocks of the session's volume: the \
                 time step has {}, but the volume has {}; make the time step's summary like the volume's, \
                 or call set_volume for another volume",
                text(&volume),
                text(before)
            );
        }
        if volume.scalar_type != before.scalar_type {
            bail!(
                InvalidArgument,
                "a time step must have the scalar type of the session's volume: the time step has {}, but \
                 the volume has {}; for another volume, call set_volume",
                volume.scalar_type.name(),
                before.scalar_type.name()
            );
        }
        if let Some(transfer) = &mut self.transfer {
            transfer.apply(&volume, None)?;
        }
        self.volume = Some(volume);
        // The rays of the last probe crossed the preceding time step, so their results are not reused.
        self.cast_for = None;
        if volume_features.is_some() {
            self.volume_features = volume_features;
        }
        Ok(())
    }

    /// Sets the transfer function, and its Gaussian lobes if it has any.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before a volume was set, [`crate::ErrorKind::OutOfMemory`] if there
    /// is no memory for the summary; on an error nothing has changed.
    pub fn set_transfer(&mut self, table: &TransferTable, lobes: Option<&[GaussianLobe]>) -> Result<()> {
        let Some(volume) = &self.volume else {
            bail!(NotReady, "no volume is set; set the volume before its transfer function");
        };
        // All memory is allocated before the session is changed, so that a failed call changes nothing.
        let mut fresh = None;
        match (&mut self.lobes, lobes) {
            (Some(kept), Some(new)) => reserve(kept, new.len())?,
            (None, Some(new)) => fresh = Some(collected(new.iter().copied())?),
            (_, None) => {}
        }
        match &mut self.transfer {
            Some(transfer) => transfer.update(volume, table)?,
            None => self.transfer = Some(TransferSummary::new(volume, table)?),
        }
        match (&mut self.lobes, lobes) {
            (Some(kept), Some(new)) => {
                kept.clear();
                kept.extend_from_slice(new);
            }
            (kept, _) => *kept = fresh,
        }
        if let (Some(recording), Some(transfer)) = (&mut self.recording, &self.transfer) {
            recording.set_transfer(transfer);
        }
        self.changes.transfer = true;
        Ok(())
    }

    /// Sets the range of steps.
    ///
    /// # Errors
    /// As [`StepLimits::check`].
    pub fn set_limits(&mut self, limits: StepLimits) -> Result<()> {
        limits.check()?;
        self.coarsening.steps = limits;
        Ok(())
    }

    /// Switches steering on or off. While steering is off, every plan has the frame's own step, unclamped.
    /// The session learns from observations in both cases.
    pub fn set_enabled(&mut self, enabled: bool) {
        self.enabled = enabled;
    }

    /// Announces changes that the session cannot detect (a camera cut, a new pipeline), so that the next
    /// frame is not taken for a smooth continuation of the previous one. Changes of volume, transfer
    /// function, size and mode are detected.
    pub fn mark(&mut self, changes: Changes) {
        let c = &mut self.changes;
        c.first |= changes.first;
        c.transfer |= changes.transfer;
        c.volume |= changes.volume;
        c.size |= changes.size;
        c.mode |= changes.mode;
        c.camera |= changes.camera;
    }

    /// Probe of the last planned or predicted frame: number of rays along each side, and number of its rays
    /// that met the volume.
    pub fn probe(&self) -> (usize, u32) {
        (self.features.probe_side, self.features.probe.rays)
    }

    /// Predicts a frame's time at its own step, corrected by the observations. Changes only
    /// [`Session::probe`], and no learned state. With a tolerance ([`Session::with_probe`]), a later plan
    /// may reuse the rays of this call.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before volume and transfer function are set,
    /// [`crate::ErrorKind::MissingInput`] if the model needs an input that was not supplied.
    pub fn predict(&mut self, frame: &Frame) -> Result<Prediction> {
        self.measure(frame)?;
        let changes = self.changes_for(frame);
        let terms = self.terms_at(changes, &Setting::from(frame))?;
        Ok(self.controller.correct(&terms, changes))
    }

    /// Chooses the step of the next frame for a target in seconds; with steering off, the plan has the
    /// frame's own step.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a target that is not finite and positive; otherwise as
    /// [`Session::predict`].
    pub fn plan(&mut self, frame: &Frame, target: f32) -> Result<Plan> {
        check_target(target)?;
        self.measure_for(frame, target)?;
        let changes = self.changes_for(frame);
        let (setting, level) = (Setting::from(frame), self.coarsening.last);
        let (terms, decision, (step, distance), drawn) = if self.enabled {
            let limits = self.coarsening.limits();
            let (controller, mut cost) = self.costing(changes, setting)?;
            let mut at = |step| cost.at(step);
            let decision = controller.plan(&mut PlanRequest { target, limits, changes, cost: &mut at });
            let terms = cost.at(decision.step);
            let recorded = self.recording.is_some();
            let drawn = if recorded { self.coarsening.setting(setting, decision.step) } else { setting };
            (terms, decision, self.coarsening.take(decision.step), drawn)
        } else {
            self.begin(changes, setting)?;
            let own = self.terms_at(changes, &setting).inspect_err(|_| self.controller.withdraw())?;
            let p = self.controller.correct(&own, Changes::default());
            (own, Decision::of(frame.step, p, Reason::Off), (frame.step, 1.0), setting)
        };
        let plan = self.note(frame, target, changes, terms, decision, (step, distance, level));
        self.record_plan(plan.id, changes, drawn);
        Ok(plan)
    }

    /// Chooses among settings, best quality first. Returns index and plan of the first setting whose
    /// prediction meets the target by [`Controller::fits`]. If there is none, returns index and plan of the
    /// setting with the shortest expected time. Images may have any size with the frame's aspect ratio.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for an empty list, and for a step or image size that
    /// [`Frame::checked`] refuses; other errors as [`Session::plan`].
    pub fn choose(&mut self, frame: &Frame, settings: &[Setting], target: f32) -> Result<(usize, Plan)> {
        check_target(target)?;
        if settings.is_empty() {
            bail!(InvalidArgument, "no settings to choose from; pass at least one, best quality first");
        }
        for (i, s) in settings.iter().enumerate() {
            let drawn = Frame { step: s.step, width: s.width, height: s.height, ..*frame };
            if let Err(e) = drawn.checked() {
                bail!(InvalidArgument, "setting {i}: {e}");
            }
        }
        // One probe serves all settings. It casts shadow rays if the frame or a setting has single
        // scattering.
        let mut widest = *frame;
        if settings.iter().any(|s| s.shading.scatters()) && !frame.shading.scatters() {
            widest.shading = Shading::Scatter;
        }
        if settings.iter().any(|s| s.skipping == Skipping::Distance) {
            widest.skipping = Skipping::Distance;
        }
        self.measure(&widest)?;
        let changes = self.changes_for(frame);
        self.begin(changes, Setting::from(&widest))?;
        let mut best: Option<(usize, CostTerms, Prediction)> = None;
        let mut reason = Reason::TargetUnreachable;
        for (i, setting) in settings.iter().enumerate() {
            let terms = self.terms_at(changes, setting).inspect_err(|_| self.controller.withdraw())?;
            let p = self.controller.correct(&terms, Changes::default());
            if self.controller.fits(&self.controller.judged(&terms, Changes::default()), target) {
                (best, reason) = (Some((i, terms, p)), Reason::Fits);
                break;
            }
            if best.is_none_or(|(_, _, fastest)| p.seconds < fastest.seconds) {
                best = Some((i, terms, p));
            }
        }
        let Some((index, terms, p)) = best else {
            bail!(InvalidArgument, "no setting could be predicted");
        };
        // The frame is drawn with the chosen step, not its own, so the next plan starts from that step.
        self.controller.withdraw();
        self.begin(changes, Setting { step: settings[index].step, ..Setting::from(&widest) })?;
        let decision = Decision::of(settings[index].step, p, reason);
        let drawn = (decision.step, 1.0, self.coarsening.last);
        let plan = self.note(frame, target, changes, terms, decision, drawn);
        self.record_plan(plan.id, changes, settings[index]);
        Ok((index, plan))
    }

    fn record_plan(&mut self, id: u64, changes: Changes, setting: Setting) {
        if let Some(recording) = &mut self.recording {
            recording.plan(id, &self.features.cost_work(&setting), changes);
        }
    }

    /// States the processor seconds of the renderer's process, over all of its threads, in the frame of the
    /// next call of [`Session::observe`]. If other programs take processors away, this time falls relative to
    /// the wall time, and a load is detected after one frame instead of two. Only for observations by wall
    /// time; a value that is not positive and finite counts as unknown.
    pub fn set_processor_seconds(&mut self, seconds: f32) {
        self.processor_seconds = seconds;
    }

    /// Reports the measured seconds of a planned frame. Returns their effect on the learned correction.
    ///
    /// # Errors
    /// [`crate::ErrorKind::RejectedObservation`] for a plan that is unknown, forgotten or already observed,
    /// and for a time that is not finite, not positive or over [`crate::predict::LONGEST_FRAME`]. A rejected
    /// observation has no effect.
    pub fn observe(&mut self, id: u64, seconds: f32, flags: ObserveFlags) -> Result<Verdict> {
        // Taken from every observation, also a refused one, so that no later frame gets this time.
        let processor_seconds = core::mem::replace(&mut self.processor_seconds, f32::NAN);
        let slot = &mut self.pending[(id % PENDING_PLANS as u64) as usize];
        let Some(pending) = slot.as_mut().filter(|p| p.id == id) else {
            return Err(Error::new(
                ErrorKind::RejectedObservation,
                "no plan has this id, or too many plans came after it; report the time of each frame \
                 with the id of its plan, soon after the frame",
            ));
        };
        if pending.observed {
            return Err(Error::new(
                ErrorKind::RejectedObservation,
                "this plan was observed before; report each plan once",
            ));
        }
        check_seconds(seconds)?;
        pending.observed = true;
        let over = seconds > pending.frame.seconds;
        if let Some(recording) = self.recording.as_mut().filter(|_| !flags.cancelled && !flags.unusual) {
            recording.observe(id, seconds);
        }
        if flags.cancelled && !over {
            // The time of a cancelled frame is a lower bound. It carries no information if a longer time was
            // expected, or if no time was expected.
            return Ok(Verdict::Ignored);
        }
        let observed = Observed { seconds, processor_seconds, unusual: flags.unusual, ..pending.frame };
        Ok(self.controller.observe(&observed))
    }

    /// Withdraws the newest plan if the caller draws no frame with it. The next plan gets its id and
    /// continues the frame before the withdrawn one. The call has no effect on an older or an observed plan,
    /// nor on the plan before a withdrawn one.
    pub fn withdraw(&mut self, id: u64) {
        let Some((_, before)) = self.newest.take_if(|newest| newest.0 == id) else { return };
        let slot = &mut self.pending[(id % PENDING_PLANS as u64) as usize];
        if slot.take_if(|plan| !plan.observed).is_some() {
            self.next_id = id;
            self.coarsening.last = before.level;
            self.controller.withdraw();
            (self.last, self.last_termination) = (before.last, before.last_termination);
            self.mark(before.changes);
        }
    }

    /// Forgets all observations and pending plans; volume and transfer function stay.
    pub fn reset(&mut self) {
        self.controller.reset();
        self.pending.fill(None);
        self.changes = Changes { first: true, ..Changes::default() };
        self.last = None;
    }

    fn cast(&mut self, frame: &Frame) -> Result<()> {
        // If the frame is refused, the features no longer state the probe of the last rays.
        self.cast_for = None;
        let (Some(volume), Some(transfer)) = (&self.volume, &mut self.transfer) else {
            let missing = if self.volume.is_none() { "volume" } else { "transfer function" };
            bail!(NotReady, "no {missing} is set; set volume and transfer function before the first frame");
        };
        self.features.measure(volume, transfer, frame)?;
        self.cast_for = self.adaptive_probe.map(|_| adaptive_probe::Cast::of(frame));
        Ok(())
    }

    /// Tells the controller about a frame whose setting the caller chooses.
    fn begin(&mut self, changes: Changes, setting: Setting) -> Result<()> {
        let (controller, mut cost) = self.costing(changes, setting)?;
        controller.begin(changes, setting.step, &mut |step| cost.at(step));
        Ok(())
    }

    /// Returns the controller and the cost function of the measured frame. Checks that every input is
    /// present, so that the cost function lacks none.
    fn costing(
        &mut self,
        changes: Changes,
        setting: Setting,
    ) -> Result<(&mut (dyn Controller + Send), Cost<'_>)> {
        let inputs = inputs_of(&self.features, setting, changes, &self.volume_features, &self.lobes);
        self.predictor.check(&inputs)?;
        let cost = Cost {
            predictor: &mut *self.predictor,
            shape: &self.shape,
            coarsening: self.coarsening,
            full: setting,
            reference: None,
            last: None,
            inputs,
        };
        Ok((&mut *self.controller, cost))
    }

    fn changes_for(&self, frame: &Frame) -> Changes {
        let mut changes = self.changes;
        if let Some(last) = &self.last {
            changes.size |= last.width != frame.width || last.height != frame.height;
            changes.mode |= last.shading != frame.shading
                || last.skipping != frame.skipping
                || self.last_termination != frame.termination;
        }
        changes
    }

    fn terms_at(&mut self, changes: Changes, setting: &Setting) -> Result<CostTerms> {
        let inputs = inputs_of(&self.features, *setting, changes, &self.volume_features, &self.lobes);
        if self.predictor.knows_step() {
            return self.predictor.terms(&inputs);
        }
        let reference = Inputs { setting: Setting { step: 1.0, ..*setting }, ..inputs };
        let terms = self.predictor.terms(&reference)?;
        Ok(scaled(terms, &self.shape, &self.features, setting))
    }

    fn note(
        &mut self,
        frame: &Frame,
        target: f32,
        changes: Changes,
        terms: CostTerms,
        decision: Decision,
        (step, image_sample_distance, level): (f32, f32, usize),
    ) -> Plan {
        let id = self.next_id;
        self.next_id += 1;
        let (scene, Decision { step: chosen, seconds, .. }) = (self.controller.scene(), decision);
        let planned = Observed {
            seconds,
            processor_seconds: f32::NAN,
            step: chosen,
            target,
            changes,
            terms,
            scene,
            unusual: false,
        };
        self.pending[(id % PENDING_PLANS as u64) as usize] =
            Some(Pending { id, frame: planned, observed: false });
        let before =
            Before { level, changes: self.changes, last: self.last, last_termination: self.last_termination };
        self.newest = Some((id, before));
        self.changes = Changes::default();
        self.last = Some(Setting::from(frame));
        self.last_termination = frame.termination;
        Plan {
            id,
            step,
            image_sample_distance,
            seconds: decision.seconds,
            upper: decision.upper,
            out_of_range: decision.out_of_range,
            reason: decision.reason,
        }
    }
}

/// Returns the inputs of a predictor for the last measured frame. The function takes fields of the session,
/// not the session, so that the session's predictor can be borrowed mutably at the same time.
fn inputs_of<'a>(
    features: &'a FrameFeatures,
    setting: Setting,
    changes: Changes,
    volume_features: &'a Option<Vec<f32>>,
    lobes: &'a Option<Vec<GaussianLobe>>,
) -> Inputs<'a> {
    Inputs {
        features,
        setting,
        changes,
        camera: features.pose(),
        volume_features: volume_features.as_deref(),
        lobes: lobes.as_deref(),
    }
}

fn controller_for(predictor: &dyn Predictor, options: HybridOptions) -> Result<Box<dyn Controller + Send>> {
    let log_sd = options.log_sd.or_else(|| predictor.log_sd());
    Ok(HybridOptions { log_sd, ..options.checked()? }.controller())
}

/// Returns `terms`, predicted at the reference step, scaled to the step of `setting` by the ratio of the
/// times that the analytic model predicts at the two steps.
fn scaled(terms: CostTerms, shape: &AnalyticModel, features: &FrameFeatures, setting: &Setting) -> CostTerms {
    let at = shape.parts(features, setting).seconds();
    let reference = shape.parts(features, &Setting { step: 1.0, ..*setting }).seconds();
    let ratio = if reference > 0.0 { at / reference } else { 1.0 };
    let mut parts = [0.0; TERMS];
    for (slot, part) in parts.iter_mut().zip(&terms.parts) {
        *slot = part * ratio;
    }
    CostTerms { parts, ..terms }
}

struct Cost<'a> {
    predictor: &'a mut (dyn Predictor + Send),
    shape: &'a AnalyticModel,
    /// Maps a step of the controller to ray step and image size.
    coarsening: Coarsening,
    /// The frame's setting at full image size.
    full: Setting,
    /// Width and height of an image, and the prediction for this image at the reference step; used for
    /// predictors that do not depend on the step.
    reference: Option<([u32; 2], CostTerms)>,
    /// The last evaluated step and its cost.
    last: Option<(f32, CostTerms)>,
    inputs: Inputs<'a>,
}

impl Cost<'_> {
    fn at(&mut self, step: f32) -> CostTerms {
        if let Some((_, terms)) = self.last.filter(|&(known, _)| known == step) {
            return terms;
        }
        let terms = self.evaluate(step);
        self.last = Some((step, terms));
        terms
    }

    fn evaluate(&mut self, step: f32) -> CostTerms {
        let unknown =
            CostTerms { parts: [f32::NAN; TERMS], out_of_range: f32::NAN, source: Source::Analytic };
        let setting = self.coarsening.setting(self.full, step);
        if self.predictor.knows_step() {
            self.inputs.setting = setting;
            return self.predictor.terms(&self.inputs).unwrap_or(unknown);
        }
        let size = [setting.width, setting.height];
        let reference = match self.reference {
            Some((known, terms)) if known == size => terms,
            _ => {
                let inputs = Inputs { setting: Setting { step: 1.0, ..setting }, ..self.inputs };
                let terms = self.predictor.terms(&inputs).unwrap_or(unknown);
                self.reference = Some((size, terms));
                terms
            }
        };
        scaled(reference, self.shape, self.inputs.features, &setting)
    }
}

fn check_target(target: f32) -> Result<()> {
    if !(target.is_finite() && target > 0.0) {
        bail!(
            InvalidArgument,
            "target frame time is {target} seconds; it must be finite and positive (0.025 for 40 frames per \
             second)"
        );
    }
    Ok(())
}
