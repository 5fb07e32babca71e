//! The default controller: chooses the step by a prediction with online correction and an adaptive-conformal
//! margin.

use super::constants::HybridConstants;
use super::history::History;
use super::{Controller, Decision, Observed, PlanRequest, Reason, SceneMark, StepLimits};
use crate::adapt::state::{Reader, Writer};
use crate::adapt::{
    CLIP, Correction, CorrectionConstants, Margin, NOVELTY_LIMIT, PACE, Prior, Standing, Verdict, exceeded,
    normal_quantile,
};
use crate::features::Changes;
use crate::predict::{CostTerms, Prediction, TERMS};
use alloc::boxed::Box;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;

/// Default share of calm frames that may exceed their upper bound.
const DEFAULT_MISS_RATE: f32 = 0.05;

/// Smallest miss rate for the first frames of new scenes. New scenes are rare, so the margin for a lower rate
/// would be learned too slowly.
const NEW_SCENE_MISS_RATE: f32 = 0.07;

/// Default tolerance: share of the target by which an upper bound may exceed the target.
const DEFAULT_TOLERANCE: f32 = 0.1;

/// Settings of the default controller, [`HybridOptions::controller`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HybridOptions {
    /// Miss rate: share of calm frames that may exceed their upper bound, over 0 and at most 0.5; 0.05 by
    /// default. Of the undisturbed frames, a share below the miss rate exceeds (1 + `tolerance`) × target,
    /// since many bounds are below that limit. The miss rate of the first frames of new scenes is at least
    /// 0.07.
    pub miss_rate: f32,
    /// Tolerance: share of the target by which a frame's upper bound may exceed the target; 0.1 by default.
    /// Exceptions: The finest allowed step is chosen, whatever its bound, if its expected time meets the
    /// target and if the finest step whose bound is within the tolerance is at most exp(`full`) times the
    /// finest allowed step ([`HybridConstants`]). If no step has a bound within the tolerance, the step is
    /// chosen by its expected cost among the steps that are expected to meet the target ([`Reason::Fits`]).
    /// If there is none, the coarsest step is chosen ([`Reason::TargetUnreachable`]).
    pub tolerance: f32,
    /// Standard deviation of ln(measured / predicted) of a model that was fitted to times of this machine and
    /// clock. `None` if the machine was never measured, so that even the order of magnitude is unknown.
    pub log_sd: Option<f32>,
    /// True if changes of the step are damped in calm phases.
    pub damping: bool,
    /// True if a detected load does not change the step: while other programs slow frames down, the
    /// picture keeps its quality and frames exceed the target. The expected time of a plan includes the load.
    /// If the load lasts longer than 32 frames, the slower speed counts as the machine's normal speed from
    /// then on, and steps are chosen for it. False by default.
    pub ignore_load: bool,
    /// Out-of-range score beyond which recent frames replace the prediction.
    pub trust_limit: f32,
    /// Constants tuned on recorded paths.
    pub constants: HybridConstants,
    /// Constants of the online correction.
    pub correction: CorrectionConstants,
}

impl Default for HybridOptions {
    fn default() -> Self {
        Self {
            miss_rate: DEFAULT_MISS_RATE,
            tolerance: DEFAULT_TOLERANCE,
            log_sd: None,
            damping: true,
            ignore_load: false,
            trust_limit: 2.0,
            constants: HybridConstants::default(),
            correction: CorrectionConstants::default(),
        }
    }
}

impl HybridOptions {
    /// Returns the controller, without observations. It chooses the finest step whose expected time meets
    /// the target and whose upper bound stays within the tolerance. The expected time is the feed-forward
    /// prediction times the online correction; an adaptive-conformal margin gives the bound.
    ///
    /// * Novelty: the relative change of the predicted cost, in amount and composition, at the last drawn
    ///   step. The larger it is, the less the earlier frames count. A change that the caller announces
    ///   begins a scene, unless the previous frame was announced as changed too (as while a slider is
    ///   dragged); then only the change of the cost counts.
    /// * Calm phases: the correction adapts to the present scene, so the expected error shrinks to the
    ///   noise between frames. The step is kept while it is close to the best step. Otherwise its change
    ///   per frame is limited, unless the limited change would miss the target.
    /// * Other programs on the machine: a detected load multiplies every expected time, until the first
    ///   frame without the load. The step is chosen by the bound for undisturbed frames; the bound of the
    ///   plan covers disturbed frames too.
    /// * A new scene: nothing is damped, the logarithm of the earlier scene's correction is multiplied by
    ///   1 − novelty, and the margin is that of new scenes.
    /// * Wide bounds: if some steps are expected to meet the target but no step has a bound within the
    ///   tolerance, the step with the least expected cost of these steps is chosen. The cost is the
    ///   probability that the frame takes longer than (1 + tolerance) × target, plus 0.375 · ln(step). The
    ///   plan's reason is [`Reason::Fits`] in this case, too.
    /// * Limits: there is no integral term, so no windup; the plan states which limit was reached.
    /// * Fallback: a forecast from the last three frames alone (scaled to the same step by a simple rule)
    ///   replaces the prediction if the prediction is missing, is out of range at the step that it would
    ///   choose, or was recently clearly worse than the forecast. If neither is available, the coarsest
    ///   step is chosen.
    ///
    /// The controller clamps the miss rate, and checks no other option;
    /// [`Session::new`](super::Session::new) checks them.
    pub fn controller(self) -> Box<dyn Controller + Send> {
        Box::new(Hybrid::new(self))
    }

    /// Returns the options if miss rate, tolerance and trust limit are valid; the other options are not
    /// checked.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`], naming the option, its value and its range.
    pub(super) fn checked(self) -> Result<Self> {
        let Self { miss_rate, tolerance, trust_limit, .. } = self;
        if !(miss_rate > 0.0 && miss_rate <= 0.5) {
            bail!(InvalidArgument, "miss_rate is {miss_rate}; it must be over 0 and at most 0.5");
        }
        if !(tolerance.is_finite() && tolerance >= 0.0) {
            bail!(InvalidArgument, "tolerance is {tolerance}; it must be finite and not negative");
        }
        if !(trust_limit > 0.0) {
            bail!(
                InvalidArgument,
                "trust_limit is {trust_limit}; it must be positive (infinity: every prediction is trusted)"
            );
        }
        Ok(self)
    }
}

/// The controller of [`HybridOptions::controller`].
#[derive(Clone, Debug)]
pub(super) struct Hybrid {
    options: HybridOptions,
    prior: Prior,
    pub(super) correction: Correction,
    calm: Margin,
    changed: Margin,
    history: History,
    last: Option<Last>,
    /// Number of a scene, and step of its newest frame from whose time the correction learned.
    learned: Option<(u64, f32)>,
    /// True if the last begun frame was announced as changed.
    announced: bool,
    scene: SceneMark,
    /// Upper limit of the margin of [`Expected::choice_upper`], in standard deviations of undisturbed frames.
    calm_deviations: f64,
    /// State before the last begun frame, for [`Controller::withdraw`]; its correction learns from every
    /// observation, too. `None` if no frame was begun since the last withdrawal or reset.
    before: Option<Before>,
}

/// State that changes when a frame begins.
#[derive(Clone, Debug)]
struct Before {
    correction: Correction,
    last: Option<Last>,
    announced: bool,
    scene: SceneMark,
}

/// The last begun frame.
#[derive(Clone, Copy, Debug)]
struct Last {
    step: f32,
    target: f32,
    terms: CostTerms,
}

/// Largest number of evaluations of the cost in a step search, besides those at the limits; usually four or
/// five suffice.
const EVALUATIONS: usize = 12;
/// Upper limit of the margin of [`Expected::choice_upper`], in standard deviations of undisturbed frames; a
/// low miss rate raises the limit. A bound with this margin covers 98 of 100 undisturbed frames.
/// Slower frames are due to other programs, and a step that is coarse enough for these frames would be too
/// coarse for all others.
const CALM_DEVIATIONS: f64 = 2.0;
/// Cost of a step that is coarser by 1 in ln(step), if a late frame costs 1: the ratio of two goals, 3 % late
/// frames and 8 % of quality. `entire-lab tune` weighs late frames against quality in this ratio, too.
const COARSENESS: f64 = 0.03 / 0.08;
/// Relative change of the step, and relative difference of the expected time from the target, below which the
/// step is kept. Smaller changes are not visible.
const DEAD_BAND: f64 = 0.01;
/// Difference of two targets, in ln, below which they count as equal.
const SAME_TARGET: f64 = 0.02;
/// Trust in a frame with [`Changes::first`], which may include a compilation or an upload. Its noise is taken
/// to have a hundred times the variance of other frames' noise, so this frame sets the order of magnitude
/// only if the prior does not.
const FIRST_TRUST: f64 = 0.01;

/// Expected time of a frame and its bounds, in seconds.
#[derive(Clone, Copy, Debug)]
struct Expected {
    seconds: f64,
    /// Upper bound for all frames, at the miss rate.
    upper: f64,
    /// Time by which the step is chosen: `seconds`, without the load if the load is ignored.
    choice: f64,
    /// Upper bound for frames that no other program disturbs. It is used to choose the step: a step that is
    /// coarse enough for disturbed frames would be too coarse for all others.
    choice_upper: f64,
    /// Standard deviation of ln(time) over frames that no other program disturbs.
    calm_sd: f64,
}

impl Hybrid {
    /// Returns a controller without observations.
    pub(super) fn new(options: HybridOptions) -> Self {
        let (calm, changed) = margins(&options);
        let prior = options.log_sd.map_or(Prior::Unknown, |log_sd| Prior::Fitted { log_sd });
        Self {
            options,
            prior,
            correction: Correction::new(prior, options.correction),
            calm,
            changed,
            history: History::new(),
            last: None,
            learned: None,
            announced: false,
            scene: SceneMark::default(),
            calm_deviations: normal_quantile(f64::from(options.miss_rate)).max(CALM_DEVIATIONS),
            before: None,
        }
    }

    /// Returns the corrected prediction for a frame with these changes since the present frame. As in
    /// [`Hybrid::novelty`], only the first of several successive frames with changes begins a scene.
    fn judge_after(&self, terms: &CostTerms, changes: Changes) -> Expected {
        if changes.first || changes.any() && !self.announced {
            let mut next = self.clone();
            next.correction.advance(1.0);
            next.scene = SceneMark { first: true, ..self.scene };
            next.judge_at(terms, f64::NAN)
        } else {
            self.judge_at(terms, f64::NAN)
        }
    }

    /// Returns the corrected prediction for the present frame at `step`. The predicted step curve has an
    /// error of its own, so the bounds widen within a scene with the distance of `step` from the last drawn
    /// step, or from the last step of which the correction learned (another one after a load), whichever is
    /// nearer. With a `step` of NaN, the bounds do not depend on the step.
    fn judge_at(&self, terms: &CostTerms, step: f64) -> Expected {
        let corrected = self.correction.apply(terms);
        let far = match self.last {
            Some(last) if !self.scene.first && step > 0.0 => {
                let from = |known: f32| libm::fabs(libm::log(step / f64::from(known)));
                match self.learned {
                    // Without a load, both steps are the same.
                    Some((scene, learned)) if scene == self.scene.number && learned != last.step => {
                        from(last.step).min(from(learned))
                    }
                    _ => from(last.step),
                }
            }
            _ => 0.0,
        };
        let slope = self.options.constants.slope_sd * far;
        let wider = |sd: f64| libm::sqrt(sd * sd + slope * slope);
        let z = if self.scene.first { self.changed.multiple } else { self.calm.multiple };
        let calm_sd = wider(corrected.calm_sd);
        let (all, calm) = (z * wider(corrected.sd), self.calm_deviations * calm_sd);
        let choice = corrected.seconds / self.ignored_load();
        Expected {
            seconds: corrected.seconds,
            upper: corrected.seconds * libm::exp(all),
            choice,
            choice_upper: choice * libm::exp(all.min(calm)),
            calm_sd,
        }
    }

    /// Returns the factor of the load if steps ignore the load, else 1.
    fn ignored_load(&self) -> f64 {
        if self.options.ignore_load { self.correction.load_factor() } else { 1.0 }
    }

    /// Novelty of the present frame, 0 to 1.
    fn novelty(&self, changes: Changes, cost: &mut dyn FnMut(f32) -> CostTerms) -> f64 {
        let Some(last) = self.last.filter(|_| !changes.first) else { return 1.0 };
        let d = distance(&last.terms, &cost(last.step));
        if d.is_nan() {
            return if changes.any() { 1.0 } else { 0.0 };
        }
        // The share is squared, so that small differences within a scene count little.
        let share = (d / self.options.constants.far).clamp(0.0, 1.0);
        let announced = changes.any() && !self.announced;
        (share * share).max(if announced { NOVELTY_LIMIT } else { 0.0 })
    }

    /// Begins the present frame: decides whether the frame continues the scene or begins a new one.
    fn enter(&mut self, changes: Changes, cost: &mut dyn FnMut(f32) -> CostTerms) {
        let novelty = self.novelty(changes, cost);
        let first = novelty >= NOVELTY_LIMIT;
        self.before = Some(Before {
            correction: self.correction.clone(),
            last: self.last,
            announced: self.announced,
            scene: self.scene,
        });
        self.correction.advance(novelty);
        self.scene = SceneMark { number: self.scene.number + u64::from(first), first };
        self.announced = changes.any();
    }

    /// Returns the finest step within the limits whose `excess` is not positive, to about half a percent;
    /// `None` if the excess is positive at the coarsest step and at the last drawn step. The excess,
    /// ln(time / target), is nearly linear in ln(step), so a bracketed secant search (Illinois) needs four or
    /// five evaluations. The search assumes that a coarser step has a lower excess. If a network violates
    /// this, the returned step may not be the finest, but its excess is not positive.
    fn finest(limits: StepLimits, last: Option<f32>, mut excess: impl FnMut(f32) -> f64) -> Option<f32> {
        // A step without a prediction counts as too slow.
        let mut excess = |step| {
            let f = excess(step);
            if f.is_nan() { 1.0 } else { f }
        };
        let mut coarsest = limits.coarsest;
        let mut f_high = excess(coarsest);
        if f_high > 0.0 {
            // Bounds widen with the distance from the last step. So if the time hardly depends on the step,
            // the bound may fit at the last step although it does not fit at the coarsest step.
            coarsest = last.filter(|step| limits.clamp(*step) == *step)?;
            f_high = excess(coarsest);
            if f_high > 0.0 {
                return None;
            }
        }
        let mut f_low = excess(limits.finest);
        if f_low <= 0.0 {
            return Some(limits.finest);
        }
        let (mut low, mut high) = (libm::log(f64::from(limits.finest)), libm::log(f64::from(coarsest)));
        let mut best = coarsest;
        let mut side = 0;
        for _ in 0..EVALUATIONS {
            let width = high - low;
            if width < 1.0e-3 {
                break;
            }
            // The secant is shifted slightly towards coarser steps, so that the search ends at a step that
            // fits.
            let secant = (low * f_high - high * (f_low + 1.0e-3)) / (f_high - f_low - 1.0e-3);
            let x = if secant.is_finite() { secant } else { 0.5 * (low + high) };
            let x = x.clamp(low + 0.02 * width, high - 0.02 * width);
            let step = limits.clamp(libm::exp(x) as f32);
            let f = excess(step);
            if f <= 0.0 {
                (high, f_high, best) = (x, f, step);
                if f > -5.0e-3 {
                    break;
                }
                f_low *= if side == 1 { 0.5 } else { 1.0 };
                side = 1;
            } else {
                (low, f_low) = (x, f);
                f_high *= if side == -1 { 0.5 } else { 1.0 };
                side = -1;
            }
        }
        Some(best)
    }

    /// Returns the step within the limits with the least `cost`, to about one percent, by a golden-section
    /// search in ln(step). The search assumes that the cost has one minimum; a probability that decreases
    /// convexly with ln(step), plus a multiple of ln(step), has one.
    fn cheapest(limits: StepLimits, mut cost: impl FnMut(f32) -> f64) -> f32 {
        const GOLDEN: f64 = 0.618_033_988_749_895;
        let [mut low, mut high] = [limits.finest, limits.coarsest].map(|step| libm::log(f64::from(step)));
        let mut best = (limits.finest, cost(limits.finest));
        let mut at = |x: f64| {
            let step = limits.clamp(libm::exp(x) as f32);
            let value = cost(step);
            if value < best.1 {
                best = (step, value);
            }
            value
        };
        let mut middle = [high - GOLDEN * (high - low), low + GOLDEN * (high - low)];
        let mut costs = middle.map(&mut at);
        for _ in 2..EVALUATIONS {
            if costs[0] <= costs[1] {
                high = middle[1];
                middle = [high - GOLDEN * (high - low), middle[0]];
                costs = [at(middle[0]), costs[0]];
            } else {
                low = middle[0];
                middle = [middle[1], low + GOLDEN * (high - low)];
                costs = [costs[1], at(middle[1])];
            }
        }
        best.0
    }

    /// Returns the corrected prediction for the present frame at `step`; `terms` is the predicted cost at
    /// this step. If `by_history` is true, returns the forecast from recent frames instead.
    fn expected(&self, terms: &CostTerms, step: f32, by_history: bool) -> Expected {
        if by_history {
            let (seconds, upper) = self.history.forecast(step, self.calm.multiple);
            let calm_sd = libm::log(upper / seconds) / self.calm.multiple;
            Expected { seconds, upper, choice: seconds, choice_upper: upper, calm_sd }
        } else {
            self.judge_at(terms, f64::from(step))
        }
    }

    /// Returns the step for the present frame and its reason, by the corrected prediction; with `by_history`,
    /// by the forecast from recent frames.
    fn choose(&self, request: &mut PlanRequest<'_>, by_history: bool) -> (f32, Reason) {
        let limits = request.limits;
        let c = self.options.constants;
        let target = f64::from(request.target);
        let ceiling = target * (1.0 + f64::from(self.options.tolerance.max(0.0)));
        let mut judge = |step: f32| self.expected(&(request.cost)(step), step, by_history);
        let excess = |step: f32| {
            let Expected { choice, choice_upper, .. } = judge(step);
            libm::log(f64::max(choice / target, choice_upper / ceiling)).clamp(-50.0, 50.0)
        };
        let mut reason = if by_history { Reason::History } else { Reason::Fits };
        let last = self.last.map(|last| last.step);
        let bounded = Self::finest(limits, last, excess);
        let mut step = match bounded {
            Some(step) => step,
            // No step has a bound that fits. If some steps are expected to fit, the cheapest of these steps
            // is chosen.
            None => match Self::finest(limits, last, |step| libm::log(judge(step).choice / target)) {
                Some(finest) => Self::cheapest(StepLimits { finest, ..limits }, |step| {
                    let Expected { choice, calm_sd, .. } = judge(step);
                    exceeded(libm::log(ceiling / choice) / calm_sd) + COARSENESS * libm::log(f64::from(step))
                }),
                None => {
                    reason = Reason::TargetUnreachable;
                    limits.coarsest
                }
            },
        };
        let nearly = || libm::log(f64::from(step) / f64::from(limits.finest)) <= c.full;
        if reason == Reason::Fits
            && (step <= limits.finest
                || (bounded.is_some() && nearly() && judge(limits.finest).choice <= target))
        {
            step = limits.finest;
            reason = Reason::FinestAllowed;
        }
        let steady = |last: &Last| {
            self.options.damping
                && !self.scene.first
                && !self.correction.jumped
                && limits.clamp(last.step) == last.step
                && libm::fabs(libm::log(target / f64::from(last.target))) < SAME_TARGET
        };
        if let Some(last) = self.last.filter(steady) {
            let delta = libm::log(f64::from(step) / f64::from(last.step));
            let Expected { choice, choice_upper, .. } = judge(last.step);
            let off = libm::log(choice / target);
            let near = libm::fabs(delta) < DEAD_BAND
                || (off > -DEAD_BAND && choice_upper <= ceiling * (1.0 + DEAD_BAND));
            let damped = |sign: f64| limits.clamp(last.step * libm::exp(sign * c.damping) as f32);
            let (finest, settled) = (reason == Reason::FinestAllowed, self.correction.settled());
            let other = if near && off <= DEAD_BAND && !finest {
                Some((last.step, Reason::Held))
            } else if delta > c.damping && settled && judge(damped(1.0)).choice <= target {
                Some((damped(1.0), Reason::Damped))
            } else if delta < -c.damping && !finest && settled {
                Some((damped(-1.0), Reason::Damped))
            } else {
                None
            };
            if let Some((other, why)) = other {
                step = other;
                reason = if reason == Reason::Fits { why } else { reason };
            }
        }
        (step, reason)
    }
}

fn standing(observed: SceneMark, present: SceneMark) -> Standing {
    match observed {
        SceneMark { number, .. } if number != present.number => Standing::Past,
        SceneMark { first: true, .. } => Standing::First,
        _ => Standing::Same,
    }
}

impl Controller for Hybrid {
    fn name(&self) -> &'static str {
        "hybrid"
    }

    fn plan(&mut self, request: &mut PlanRequest<'_>) -> Decision {
        let (limits, changes) = (request.limits, request.changes);
        self.enter(changes, request.cost);
        let coarsest = (request.cost)(limits.coarsest);
        let known = coarsest.seconds().is_finite() && coarsest.seconds() > 0.0;
        // Frames before a change of scene do not predict the frame after it.
        let recent = self.history.len > 0 && !(changes.any() && self.scene.first);
        let mut by_history = recent && (!known || self.history.leads);
        if !known && !by_history {
            self.last = Some(Last { step: limits.coarsest, target: request.target, terms: coarsest });
            return Decision {
                step: limits.coarsest,
                seconds: f32::NAN,
                upper: f32::NAN,
                out_of_range: coarsest.out_of_range,
                reason: Reason::NoInformation,
            };
        }
        let (mut step, mut reason) = self.choose(request, by_history);
        let mut terms = (request.cost)(step);
        if recent && !by_history && terms.out_of_range > self.options.trust_limit {
            by_history = true;
            (step, reason) = self.choose(request, by_history);
            terms = (request.cost)(step);
        }
        let Expected { seconds, upper, .. } = self.expected(&terms, step, by_history);
        self.last = Some(Last { step, target: request.target, terms });
        Decision {
            step,
            seconds: seconds as f32,
            upper: upper as f32,
            out_of_range: terms.out_of_range,
            reason,
        }
    }

    fn observe(&mut self, observed: &Observed) -> Verdict {
        if observed.unusual {
            return Verdict::Ignored;
        }
        let seconds = f64::from(observed.seconds);
        let trust = if observed.changes.first { FIRST_TRUST } else { 1.0 };
        let ratio = libm::log(f64::from(observed.processor_seconds) / seconds);
        if let Some(before) = &mut self.before {
            // The state before the last begun frame learns too: this frame's plan may be withdrawn after an
            // earlier frame was observed.
            let standing = standing(observed.scene, before.scene);
            before.correction.observe(&observed.terms, seconds, standing, trust, ratio);
        }
        let standing = standing(observed.scene, self.scene);
        let corrected = self.correction.apply(&observed.terms).seconds;
        let loaded = self.correction.loaded();
        let error = self.correction.observe(&observed.terms, seconds, standing, trust, ratio);
        let changed = observed.changes.any() && observed.scene.first;
        if !observed.changes.first && standing != Standing::Past {
            let own = libm::fabs(libm::log(seconds / corrected));
            self.history.compare(observed.step, seconds, own, changed);
            match standing {
                Standing::First => self.changed.observe(error),
                _ => self.calm.observe(error),
            }
        }
        if standing != Standing::Past {
            self.history.push(observed.step, seconds, changed, observed.changes.first);
            if !loaded && !self.correction.loaded() {
                self.learned = Some((observed.scene.number, observed.step));
            }
        }
        if error.is_nan() {
            Verdict::Ignored
        } else if libm::fabs(error) > CLIP {
            Verdict::Clipped
        } else {
            Verdict::Learned
        }
    }

    fn reset(&mut self) {
        self.correction.reset();
        (self.calm, self.changed) = margins(&self.options);
        self.history = History::new();
        (self.last, self.learned) = (None, None);
        self.announced = false;
        self.scene = SceneMark { number: self.scene.number + 1, ..SceneMark::default() };
        self.before = None;
    }

    fn convert(&mut self, converted: bool) {
        let prior = match (self.prior, converted) {
            (Prior::Fitted { log_sd }, true) => Prior::Converted { log_sd },
            (Prior::Converted { log_sd }, false) => Prior::Fitted { log_sd },
            _ => return,
        };
        self.prior = prior;
        self.correction = Correction::new(prior, self.options.correction);
    }

    fn begin(&mut self, changes: Changes, step: f32, cost: &mut dyn FnMut(f32) -> CostTerms) {
        self.enter(changes, cost);
        // With a target of NaN, the next frame's step is neither kept at this step nor damped.
        self.last = Some(Last { step, target: f32::NAN, terms: cost(step) });
    }

    fn withdraw(&mut self) {
        if let Some(Before { correction, last, announced, scene }) = self.before.take() {
            (self.correction, self.last, self.announced, self.scene) = (correction, last, announced, scene);
        }
    }

    fn scene(&self) -> SceneMark {
        self.scene
    }

    fn fits(&self, prediction: &Prediction, target: f32) -> bool {
        let ceiling = target * (1.0 + self.options.tolerance.max(0.0));
        prediction.seconds <= target && prediction.upper <= ceiling
    }

    fn correct(&self, terms: &CostTerms, changes: Changes) -> Prediction {
        let Expected { seconds, upper, .. } = self.judge_after(terms, changes);
        prediction_of(terms, seconds, upper)
    }

    fn judged(&self, terms: &CostTerms, changes: Changes) -> Prediction {
        let Expected { choice, choice_upper, .. } = self.judge_after(terms, changes);
        prediction_of(terms, choice, choice_upper)
    }

    fn save(&self, out: &mut Vec<u8>) {
        let mut w = Writer(out);
        w.tag(*b"ENH4");
        self.correction.save(&mut w);
        self.calm.save(&mut w);
        self.changed.save(&mut w);
        self.history.save(&mut w);
    }

    fn load(&mut self, bytes: &[u8]) -> Result<()> {
        let mut r = Reader(bytes);
        let mut next = Self::new(self.options);
        next.convert(matches!(self.prior, Prior::Converted { .. }));
        r.tag(*b"ENH4")?;
        next.correction.load(&mut r)?;
        next.calm.load(&mut r)?;
        next.changed.load(&mut r)?;
        next.history.load(&mut r)?;
        r.end()?;
        *self = next;
        Ok(())
    }
}

fn prediction_of(terms: &CostTerms, seconds: f64, upper: f64) -> Prediction {
    Prediction {
        seconds: (seconds as f32).clamp(1.0e-9, 1.0e9),
        // Not below the clamped seconds; NaN remains NaN.
        upper: (upper as f32).clamp(1.0e-9, f32::INFINITY),
        out_of_range: terms.out_of_range,
        source: terms.source,
    }
}

/// Returns the initial margins of calm frames and of first frames of new scenes.
fn margins(options: &HybridOptions) -> (Margin, Margin) {
    let c = &options.constants;
    let rate = options.miss_rate.max(NEW_SCENE_MISS_RATE);
    (
        Margin::starting_at(c.margin_start, options.miss_rate, PACE),
        Margin::starting_at(c.margin_start, rate, PACE),
    )
}

/// Returns the distance of two predictions at one step: the absolute difference of ln(seconds), plus half the
/// sum of the absolute differences of their terms' shares. NaN if a prediction is unknown.
fn distance(a: &CostTerms, b: &CostTerms) -> f64 {
    let (sum_a, sum_b) = (f64::from(a.seconds()), f64::from(b.seconds()));
    if !(sum_a > 0.0 && sum_b > 0.0 && sum_a.is_finite() && sum_b.is_finite()) {
        return f64::NAN;
    }
    let moved: f64 =
        (0..TERMS).map(|i| libm::fabs(f64::from(a.parts[i]) / sum_a - f64::from(b.parts[i]) / sum_b)).sum();
    libm::fabs(libm::log(sum_b / sum_a)) + 0.5 * moved
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lower_miss_rate_is_kept_by_the_step_too() {
        let of =
            |miss_rate| Hybrid::new(HybridOptions { miss_rate, ..HybridOptions::default() }).calm_deviations;
        assert_eq!(of(0.05), CALM_DEVIATIONS);
        assert!(of(0.001) > 3.0);
    }

    #[test]
    fn no_bound_is_below_its_prediction() {
        let terms = CostTerms::whole(1.0, 0.0, crate::predict::Source::Analytic);
        for seconds in [0.0, 1.0e-20, 1.0e-9, 1.0, 1.0e20] {
            let p = prediction_of(&terms, seconds, 1.3 * seconds);
            assert!(p.upper >= p.seconds, "{p:?}");
        }
        assert!(prediction_of(&terms, f64::NAN, f64::NAN).upper.is_nan());
    }
}
