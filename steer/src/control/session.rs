//! One render loop: a volume, a transfer function, a predictor and a controller.

mod ladder;
mod pictures;
mod recording;
mod state;

use super::coarsening::Coarsening;
use super::{
    Controller, Decision, Hybrid, HybridOptions, Observed, PlanRequest, Reason, SceneMark, StepLimits,
};
use crate::adapt::{ObserveFlags, Prior, Verdict, check_seconds};
use crate::features::{Changes, FrameFeatures, Setting, TransferSummary, VolumeSummary};
use crate::predict::{AnalyticModel, CostTerms, Inputs, Prediction, Predictor, Quality, Source, TERMS};
use alloc::boxed::Box;
use alloc::string::String;
use alloc::vec::Vec;
use entire_core::bail;
use entire_core::memory::{copied, reserve};
use entire_core::scene::{Frame, GaussianLobe, Shading, Skipping, TransferTable};
use entire_core::{Error, ErrorKind, Result};

/// Plans that may wait for their observation at a time; older ones are forgotten.
pub const PENDING_PLANS: usize = 64;

/// What to draw, and what to expect of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plan {
    /// Names this plan in [`Session::observe`]; never 0, and no other plan's within a session's life, but for
    /// one that was taken back ([`Session::withdraw`]).
    pub id: u64,
    /// Ray step in multiples of the reference step.
    pub step: f32,
    /// Pixels of the frame between neighboring rays along each side: the image is drawn with the frame's
    /// sides divided by this, rounded down. 1 unless [`Session::set_max_image_sample_distance`] allows more.
    pub image_sample_distance: f32,
    /// Expected seconds; NaN from controllers that expect nothing.
    pub seconds: f32,
    /// Upper bound in seconds; NaN where there is none.
    pub upper: f32,
    /// 0 inside the predictor's range, 1 at the edge of trust, growing beyond; NaN where unknown.
    pub out_of_range: f32,
    /// Why this step.
    pub reason: Reason,
}

#[derive(Clone, Copy)]
struct Pending {
    id: u64,
    step: f32,
    target: f32,
    changes: Changes,
    terms: CostTerms,
    /// What the plan said, seconds; NaN where nothing was known.
    expected: f32,
    scene: SceneMark,
    observed: bool,
}

/// Predicts and steers one render loop.
///
/// Set the volume and the transfer function, then for every frame [`Session::plan`], draw with the plan's
/// step, and [`Session::observe`] the time it took; late observations are welcome as long as their plan is
/// among the last [`PENDING_PLANS`]. Plan, choose, predict and observe never allocate.
pub struct Session {
    predictor: Box<dyn Predictor + Send>,
    pub(super) controller: Box<dyn Controller + Send>,
    /// Step curve for predictors that do not know the step.
    shape: AnalyticModel,
    volume: Option<VolumeSummary>,
    transfer: Option<TransferSummary>,
    volume_features: Option<Vec<f32>>,
    lobes: Option<Vec<GaussianLobe>>,
    pub(super) features: FrameFeatures,
    ladder: Option<ladder::Ladder>,
    cast_for: Option<ladder::Cast>,
    coarsening: Coarsening,
    enabled: bool,
    changes: Changes,
    last: Option<Setting>,
    last_termination: f32,
    pending: Box<[Option<Pending>; PENDING_PLANS]>,
    next_id: u64,
    /// Whose times are observed, and by which clock; empty where nobody said.
    timing: [String; 2],
    /// Whether the clock is another than the predictor's.
    converted: bool,
    recording: Option<recording::Recording>,
    /// What the caller knows of the renderer's pictures; else the model is asked.
    quality: Option<Quality>,
}

impl Session {
    /// With the default controller: [`Hybrid`] around the given predictor. A prior of [`Prior::Unknown`]
    /// gives way to what the predictor knows of its own errors.
    pub fn new(predictor: Box<dyn Predictor + Send>, options: HybridOptions) -> Self {
        let controller = controller_for(&*predictor, options);
        Self::with_controller(predictor, controller)
    }

    /// Without any model: the analytic model with default costs, which observations correct.
    pub fn untrained() -> Self {
        Self::new(Box::new(AnalyticModel::default()), HybridOptions::default())
    }

    /// With any controller.
    pub fn with_controller(
        predictor: Box<dyn Predictor + Send>,
        controller: Box<dyn Controller + Send>,
    ) -> Self {
        // A predictor that needs no probe is scaled by a model that does.
        let features = match predictor.probe_side() {
            0 => FrameFeatures::default(),
            side => FrameFeatures::with_probe_side(side),
        };
        let mut session = Self {
            predictor,
            controller,
            shape: AnalyticModel::default(),
            volume: None,
            transfer: None,
            volume_features: None,
            lobes: None,
            features,
            ladder: None,
            cast_for: None,
            coarsening: Coarsening::of_step(StepLimits::default()),
            enabled: true,
            changes: Changes { first: true, ..Changes::default() },
            last: None,
            last_termination: f32::NAN,
            pending: Box::new([None; PENDING_PLANS]),
            next_id: 1,
            timing: [String::new(), String::new()],
            converted: false,
            recording: None,
            quality: None,
        };
        session.weigh_pictures();
        session
    }

    /// Sets the volume by its summary, and VolumeNet's output for it where the model takes one. The transfer
    /// function must be set again. Nothing is allocated.
    pub fn set_volume(&mut self, volume: VolumeSummary, volume_features: Option<Vec<f32>>) {
        if let Some(recording) = &mut self.recording {
            recording.set_volume(&volume);
        }
        self.volume = Some(volume);
        self.volume_features = volume_features;
        self.transfer = None;
        self.changes.volume = true;
    }

    /// Sets the next time step of the volume ([`crate::features::SummarySeries`] makes its summary), and
    /// VolumeNet's output for it; without, that of the time step before stays. The transfer function stays,
    /// and what was learned of the scene: no change is announced. Where a frame pays for an upload,
    /// [`Session::mark`] says so.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before a volume was set, [`crate::ErrorKind::SizeMismatch`] for one of
    /// other sizes, spacing or cells, [`crate::ErrorKind::InvalidArgument`] for one of another type; nothing
    /// has changed then. Nothing is allocated.
    pub fn set_time_step(&mut self, volume: VolumeSummary, volume_features: Option<Vec<f32>>) -> Result<()> {
        let Some(before) = &self.volume else {
            bail!(NotReady, "no volume is set; set a series' first time step as a volume");
        };
        let grid = |v: &VolumeSummary| (v.shape(), v.cells(), v.block_edge());
        if grid(&volume) != grid(before) {
            let ([x, y, z], [a, b, c]) = (volume.shape().dims, before.shape().dims);
            bail!(
                SizeMismatch,
                "a time step of {x} x {y} x {z} voxels follows on a volume of {a} x {b} x {c} voxels; its \
                 sizes, spacing and summary options must be the same, set another volume as such"
            );
        }
        if volume.scalar_type() != before.scalar_type() {
            bail!(
                InvalidArgument,
                "a time step of {} follows on a volume of {}; set another volume as such",
                volume.scalar_type().name(),
                before.scalar_type().name()
            );
        }
        if let Some(transfer) = &mut self.transfer {
            transfer.follow(&volume)?;
        }
        self.volume = Some(volume);
        // What rays met was the time step before.
        self.cast_for = None;
        if volume_features.is_some() {
            self.volume_features = volume_features;
        }
        Ok(())
    }

    /// Sets the transfer function, and its Gaussian lobes where it has them.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before a volume was set, [`crate::ErrorKind::OutOfMemory`] where there
    /// is no room for what is kept; nothing has changed then.
    pub fn set_transfer(&mut self, table: &TransferTable, lobes: Option<&[GaussianLobe]>) -> Result<()> {
        let Some(volume) = &self.volume else {
            bail!(NotReady, "no volume is set; set the volume before its transfer function");
        };
        // Everything that can fail for want of memory comes first.
        let mut fresh = None;
        match (&mut self.lobes, lobes) {
            (Some(kept), Some(new)) => reserve(kept, new.len())?,
            (None, Some(new)) => fresh = Some(copied(new)?),
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
        if let Some(recording) = &mut self.recording {
            recording.set_transfer(table);
        }
        self.changes.transfer = true;
        Ok(())
    }

    /// Sets the steps that may be chosen.
    ///
    /// # Errors
    /// As [`StepLimits::check`].
    pub fn set_limits(&mut self, limits: StepLimits) -> Result<()> {
        limits.check()?;
        self.coarsening.set_steps(limits);
        Ok(())
    }

    /// Switches steering off (every plan answers the frame's own step, unclamped) or on again. Observations
    /// are learned from either way.
    pub fn set_enabled(&mut self, enabled: bool) {
        self.enabled = enabled;
    }

    /// Tells that the next frame does not follow smoothly on the one before, in ways that the session cannot
    /// see (a camera cut, a new pipeline). Volume, transfer function, size and mode changes are noticed by
    /// themselves.
    pub fn mark(&mut self, changes: Changes) {
        let c = &mut self.changes;
        c.first |= changes.first;
        c.transfer |= changes.transfer;
        c.volume |= changes.volume;
        c.size |= changes.size;
        c.mode |= changes.mode;
        c.camera |= changes.camera;
    }

    /// The features of the frame that was planned or predicted last.
    pub fn features(&self) -> &FrameFeatures {
        &self.features
    }

    /// Predicts a frame at its own step, corrected by what was observed. Leaves no trace in the session's
    /// state.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] before volume and transfer function are set,
    /// [`crate::ErrorKind::MissingInput`] when the model needs an input that was not supplied.
    pub fn predict(&mut self, frame: &Frame) -> Result<Prediction> {
        self.measure(frame)?;
        let changes = self.changes_for(frame);
        let terms = self.terms_at(changes, &Setting::from(frame))?;
        Ok(self.controller.correct(&terms, changes))
    }

    /// Chooses the step of the next frame; the frame's own step is what a session switched off answers.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a target that is not finite and positive; else as
    /// [`Session::predict`].
    pub fn plan(&mut self, frame: &Frame, target: f32) -> Result<Plan> {
        check_target(target)?;
        self.measure_for(frame, target)?;
        let changes = self.changes_for(frame);
        let setting = Setting::from(frame);
        if !self.enabled {
            self.begin(changes, setting)?;
            let own = self.terms_at(changes, &setting)?;
            let p = self.controller.correct(&own, Changes::default());
            let decision = Decision {
                step: frame.step,
                seconds: p.seconds,
                upper: p.upper,
                out_of_range: p.out_of_range,
                reason: Reason::Off,
            };
            let plan = self.note(frame, target, changes, own, decision, (frame.step, 1.0));
            self.record_plan(plan.id, changes, setting);
            return Ok(plan);
        }
        let limits = self.coarsening.limits();
        let (controller, mut cost) = self.costing(changes, setting)?;
        let mut at = |step| cost.at(step);
        let decision = controller.plan(&mut PlanRequest { target, limits, changes, cost: &mut at });
        let terms = cost.at(decision.step);
        let recorded = self.recording.is_some().then(|| self.coarsening.setting(setting, decision.step));
        let drawn = self.coarsening.take(decision.step);
        let plan = self.note(frame, target, changes, terms, decision, drawn);
        if let Some(setting) = recorded {
            self.record_plan(plan.id, changes, setting);
        }
        Ok(plan)
    }

    /// Chooses among settings, best quality first: the index and the plan of the first
    /// that is expected to meet the target ([`Controller::fits`]), else the one expected to be fastest. The
    /// image shape must be the frame's for its features to hold; other sizes of that shape are free.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for no settings, a step or an image size that [`Frame::checked`]
    /// refuses; else as [`Session::plan`].
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
        // One probe serves all settings; shadow rays are part of it only where a setting scatters.
        let scatters = settings.iter().any(|s| s.shading == Shading::Scatter);
        let distance = settings.iter().any(|s| s.skipping == Skipping::Distance);
        let mut widest = *frame;
        if scatters {
            widest = Frame { shading: Shading::Scatter, ..widest };
        }
        if distance {
            widest = Frame { skipping: Skipping::Distance, ..widest };
        }
        self.measure(&widest)?;
        let changes = self.changes_for(frame);
        self.begin(changes, Setting::from(&widest))?;
        let mut fastest: Option<(usize, CostTerms, Prediction)> = None;
        let mut chosen = None;
        for (i, setting) in settings.iter().enumerate() {
            let terms = self.terms_at(changes, setting)?;
            let p = self.controller.correct(&terms, Changes::default());
            if self.controller.fits(&p, target) {
                chosen = Some((i, terms, p));
                break;
            }
            if fastest.is_none_or(|(_, _, f)| p.seconds < f.seconds) {
                fastest = Some((i, terms, p));
            }
        }
        let reason = if chosen.is_some() { Reason::Fits } else { Reason::TargetUnreachable };
        let Some((index, terms, p)) = chosen.or(fastest) else {
            bail!(InvalidArgument, "no setting could be predicted");
        };
        let decision = Decision {
            step: settings[index].step,
            seconds: p.seconds,
            upper: p.upper,
            out_of_range: p.out_of_range,
            reason,
        };
        let drawn = (decision.step, 1.0);
        let plan = self.note(frame, target, changes, terms, decision, drawn);
        self.record_plan(plan.id, changes, settings[index]);
        Ok((index, plan))
    }

    /// Hears how long a planned frame took.
    ///
    /// # Errors
    /// [`crate::ErrorKind::RejectedObservation`] for a plan that is unknown, forgotten or observed before,
    /// and for a time that is not finite, not positive or over [`crate::predict::LONGEST_FRAME`]. It leaves
    /// no trace. Only the error's text allocates.
    pub fn observe(&mut self, id: u64, seconds: f32, flags: ObserveFlags) -> Result<Verdict> {
        let slot = &mut self.pending[(id % PENDING_PLANS as u64) as usize];
        let Some(pending) = slot.as_mut().filter(|p| p.id == id) else {
            return Err(Error::new(
                ErrorKind::RejectedObservation,
                "no plan has this id, or too many plans came after it; report each frame with its plan's \
                 id, sooner",
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
        let over = seconds > pending.expected;
        if let Some(recording) = &mut self.recording
            && !flags.cancelled
            && !flags.unusual
        {
            recording.observe(id, seconds);
        }
        if flags.cancelled && !over {
            // It would have taken longer than this, as was expected or for all that was known.
            return Ok(Verdict::Ignored);
        }
        let observed = Observed {
            seconds,
            step: pending.step,
            target: pending.target,
            changes: pending.changes,
            terms: pending.terms,
            scene: pending.scene,
            unusual: flags.unusual,
        };
        Ok(self.controller.observe(&observed))
    }

    /// Takes the newest plan back, where the caller draws no frame with it: its id goes to the next plan,
    /// which follows on the frame before it. Any other id changes nothing.
    pub fn withdraw(&mut self, id: u64) {
        if id == 0 || id.checked_add(1) != Some(self.next_id) {
            return;
        }
        let slot = &mut self.pending[(id % PENDING_PLANS as u64) as usize];
        if let Some(plan) = slot.take_if(|p| p.id == id && !p.observed) {
            self.next_id = id;
            self.controller.withdraw();
            self.mark(plan.changes);
        }
    }

    /// Forgets every observation and every pending plan; volume and transfer function stay.
    pub fn reset(&mut self) {
        self.controller.reset();
        self.pending.fill(None);
        self.changes = Changes { first: true, ..Changes::default() };
        self.last = None;
    }

    /// Casts the probe's rays.
    fn cast(&mut self, frame: &Frame) -> Result<()> {
        let (Some(volume), Some(transfer)) = (&self.volume, &mut self.transfer) else {
            let missing = if self.volume.is_none() { "volume" } else { "transfer function" };
            bail!(NotReady, "no {missing} is set; set volume and transfer function before the first frame");
        };
        if frame.skipping == Skipping::Distance {
            transfer.prepare_distance();
        }
        self.features.measure(volume, transfer, frame)?;
        self.note_cast(frame);
        Ok(())
    }

    /// Lets the controller know of a frame whose setting it does not choose.
    fn begin(&mut self, changes: Changes, setting: Setting) -> Result<()> {
        let (controller, mut cost) = self.costing(changes, setting)?;
        controller.begin(changes, setting.step, &mut |step| cost.at(step));
        Ok(())
    }

    /// The controller, and what it asks for the costs of the measured frame. That every input is there is
    /// checked here, so that no question fails for want of one.
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
        (step, image_sample_distance): (f32, f32),
    ) -> Plan {
        let id = self.next_id;
        self.next_id += 1;
        self.pending[(id % PENDING_PLANS as u64) as usize] = Some(Pending {
            id,
            step: decision.step,
            target,
            changes,
            terms,
            expected: decision.seconds,
            scene: self.controller.scene(),
            observed: false,
        });
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

/// What predictors may ask for about the frame that was measured last. Of the session's parts, not of the
/// session: what asks is one of them.
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

/// The default controller around a predictor.
fn controller_for(predictor: &dyn Predictor, mut options: HybridOptions) -> Box<dyn Controller + Send> {
    if let (Prior::Unknown, Some(log_sd)) = (options.prior, predictor.log_sd()) {
        options.prior = Prior::Fitted { log_sd };
    }
    Box::new(Hybrid::new(options))
}

/// The prediction at the reference step, brought to a step by the analytic model's ratio.
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
    /// What a step stands for: the step itself, or one with an image size.
    coarsening: Coarsening,
    /// The frame's own setting.
    full: Setting,
    /// An image width and the prediction at the reference step there, for predictors that do not know the
    /// step.
    reference: Option<(u32, CostTerms)>,
    /// The step asked for last, and its cost.
    last: Option<(f32, CostTerms)>,
    inputs: Inputs<'a>,
}

impl Cost<'_> {
    fn at(&mut self, step: f32) -> CostTerms {
        if let Some((known, terms)) = self.last
            && known == step
        {
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
        let reference = match self.reference {
            Some((width, terms)) if width == setting.width => terms,
            _ => {
                let inputs = Inputs { setting: Setting { step: 1.0, ..setting }, ..self.inputs };
                let terms = self.predictor.terms(&inputs).unwrap_or(unknown);
                self.reference = Some((setting.width, terms));
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
