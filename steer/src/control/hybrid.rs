//! Feed-forward prediction with online correction and an adaptive-conformal margin.

use super::constants::HybridConstants;
use super::history::History;
use super::{Controller, Decision, Observed, PlanRequest, Reason, SceneMark, StepLimits};
use crate::adapt::state::{Reader, Writer};
use crate::adapt::{CLIP, Correction, CorrectionConstants, Margin, NOVEL, Prior, Standing, Verdict};
use crate::features::Changes;
use crate::predict::{CostTerms, Prediction, TERMS};
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;

/// Default share of calm frames that may exceed their upper bound.
const DEFAULT_MISS_RATE: f32 = 0.05;

/// Smallest miss rate of the first frames of new scenes. New scenes are rare, so a margin would learn a lower
/// rate too slowly.
const NEW_SCENE_MISS_RATE: f32 = 0.07;

/// Default share of the target by which an upper bound may exceed it.
const DEFAULT_TOLERANCE: f32 = 0.1;

/// Settings of [`Hybrid`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HybridOptions {
    /// Miss rate: share of calm frames that may exceed their upper bound, over 0 and at most 0.5; 0.05 by
    /// default. The share of undisturbed frames over (1 + `tolerance`) × target is smaller, since many bounds
    /// are below that limit. The miss rate of the first frames of new scenes is at least 0.07.
    pub miss_rate: f32,
    /// Tolerance: share of the target by which a frame's upper bound may exceed the target; 0.1 by default.
    /// The finest step is drawn even if its bound exceeds the tolerance, provided that its expected time
    /// meets the target and the step that would be chosen otherwise is at most `full` ([`HybridConstants`])
    /// away.
    pub tolerance: f32,
    /// Prior knowledge of the prediction's errors.
    pub prior: Prior,
    /// True where changes of the step are damped in calm phases.
    pub damping: bool,
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
            prior: Prior::Unknown,
            damping: true,
            trust_limit: 2.0,
            constants: HybridConstants::default(),
            correction: CorrectionConstants::default(),
        }
    }
}

impl HybridOptions {
    /// Returns the options if every value is valid. [`Hybrid::new`] does not check: it clamps the miss rate.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`], naming the option, its value and its range.
    pub fn checked(self) -> Result<Self> {
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
                "trust_limit is {trust_limit}; it must be positive, infinity to trust always"
            );
        }
        Ok(self)
    }
}

/// Chooses the finest step whose expected time meets the target and whose upper bound stays within the
/// tolerance. The expected time is the feed-forward prediction times the online correction; an
/// adaptive-conformal margin gives the bound.
///
/// * Novelty: the relative change of the predicted cost, in amount and composition, at the last drawn step.
///   The larger it is, the less the earlier frames count. A change that the caller announces after calm
///   frames begins a scene; in a series of announced changes (a drag) only the change of the cost counts.
/// * Calm phases: the correction follows the present scene, so the margin shrinks to the noise between frames
///   and the target is met on average. The step is kept while it is close to the best. A larger change is
///   limited per frame, unless only the whole change meets the target.
/// * Other programs on the machine: a detected load multiplies every expected time, until the first frame
///   without the load. The step is chosen by the bound for undisturbed frames; the bound of the plan covers
///   disturbed frames too.
/// * A new scene: nothing is damped, the scene's own correction is dropped, and the margin is that of new
///   scenes.
/// * Wide bounds: where some step is expected to fit but the bound of none does, the chosen step lies
///   halfway, in ln(step), between the finest step that is expected to fit and the coarsest.
/// * Limits: there is no integral term, so no windup; the plan states which limit was reached.
/// * Fallback: a second predictor from the last three frames alone (scaled to a common step by a simple rule)
///   takes over where the prediction is out of range or has recently been clearly worse. If neither predictor
///   is available, the coarsest step is chosen.
#[derive(Clone, Debug)]
pub struct Hybrid {
    options: HybridOptions,
    correction: Correction,
    calm: Margin,
    changed: Margin,
    history: History,
    last: Option<Last>,
    /// True where the frame before was announced as changed.
    announced: bool,
    scene: SceneMark,
    /// Largest margin of the bound by which the step is chosen, in standard deviations of undisturbed frames.
    worth: f64,
    /// State before the last begun frame, until the next observation.
    before: Option<Before>,
}

/// The part of the state that beginning a frame changes.
#[derive(Clone, Debug)]
struct Before {
    correction: Correction,
    last: Option<Last>,
    announced: bool,
    scene: SceneMark,
}

/// The last planned frame.
#[derive(Clone, Copy, Debug)]
struct Last {
    step: f32,
    target: f32,
    terms: CostTerms,
}

/// Guard: largest number of evaluations of the cost in a step search, besides those at the limits; four or
/// five suffice.
const EVALUATIONS: usize = 12;
/// Largest margin of the bound by which the step is chosen, in standard deviations of undisturbed frames,
/// unless a lower miss rate requires more: it covers 98 of 100 frames. Slower frames are due to other
/// programs, and a step coarse enough for them would degrade every frame.
const WORTH: f64 = 2.0;
/// Learning rate of the margins: averages over about twenty frames. A fixed margin has the same loss on the
/// training paths, but does not keep a miss rate.
const MARGIN_PACE: f32 = 0.05;
/// Relative changes of the step, or distances of the expected time from the target, below which the step is
/// kept: a guard, too small to be visible.
const DEAD_BAND: f64 = 0.01;
/// Difference of two targets, in ln, below which they count as equal.
const SAME_TARGET: f64 = 0.02;
/// Trust in the very first frame, which may include a compilation or an upload: the variance of its time
/// counts as a hundred times that of other frames, so the first frame sets the order of magnitude only where
/// nothing else does.
const FIRST_TRUST: f64 = 0.01;

/// Expected time of a frame and its bounds, in seconds.
#[derive(Clone, Copy, Debug)]
struct Expected {
    seconds: f64,
    /// Bound of all frames, at the miss rate.
    upper: f64,
    /// Bound of undisturbed frames, by which the step is chosen: a step coarse enough for frames that other
    /// programs slow down would be too coarse for all others.
    calm_upper: f64,
}

impl Hybrid {
    /// A controller without observations.
    pub fn new(options: HybridOptions) -> Self {
        let (calm, changed) = margins(&options);
        Self {
            options,
            correction: Correction::new(options.prior, options.correction),
            calm,
            changed,
            history: History::new(),
            last: None,
            announced: false,
            scene: SceneMark::default(),
            worth: normal_quantile(f64::from(options.miss_rate)).max(WORTH),
            before: None,
        }
    }

    /// The correction of the cost's terms.
    #[cfg(test)]
    pub(crate) fn correction(&self) -> &Correction {
        &self.correction
    }

    /// Corrects a prediction for the present frame; the bounds do not depend on the step.
    fn judge(&self, terms: &CostTerms) -> Expected {
        self.judge_at(terms, f64::NAN)
    }

    /// Corrects a prediction for the present frame, at `step`. Within a scene the bounds widen with the
    /// distance of the step from the last drawn one, since the predicted step curve has an error of its own.
    fn judge_at(&self, terms: &CostTerms, step: f64) -> Expected {
        let corrected = self.correction.apply(terms);
        let far = match self.last {
            Some(last) if !self.scene.first && step > 0.0 => libm::log(step / f64::from(last.step)),
            _ => 0.0,
        };
        let slope = self.options.constants.slope_sd * far;
        let wider = |sd: f64| libm::sqrt(sd * sd + slope * slope);
        let z = if self.scene.first { self.changed.multiple() } else { self.calm.multiple() };
        let (all, calm) = (z * wider(corrected.sd), self.worth * wider(corrected.calm_sd));
        Expected {
            seconds: corrected.seconds,
            upper: corrected.seconds * libm::exp(all),
            calm_upper: corrected.seconds * libm::exp(all.min(calm)),
        }
    }

    /// Novelty of the present frame, 0 to 1.
    fn novelty(&self, changes: Changes, cost: &mut dyn FnMut(f32) -> CostTerms) -> f64 {
        let Some(last) = self.last.filter(|_| !changes.first) else { return 1.0 };
        let d = distance(&last.terms, &cost(last.step));
        if d.is_nan() {
            return if changes.any() { 1.0 } else { 0.0 };
        }
        // Squared, so that small differences within a scene count little.
        let share = (d / self.options.constants.far).clamp(0.0, 1.0);
        let announced = changes.any() && !self.announced;
        (share * share).max(if announced { NOVEL } else { 0.0 })
    }

    /// Begins the present frame: decides whether it continues the scene or begins one.
    fn enter(&mut self, changes: Changes, cost: &mut dyn FnMut(f32) -> CostTerms) {
        let novelty = self.novelty(changes, cost);
        let first = novelty >= NOVEL;
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

    /// The finest step within the limits whose `excess` is not positive, to about half a percent; `None`
    /// where there is none. The excess (ln of time over target) is nearly linear in ln(step), so a bracketed
    /// secant search (Illinois) needs four or five evaluations. The search assumes that the excess falls with
    /// the step; where a network violates this, the result still fits.
    fn finest(limits: StepLimits, mut excess: impl FnMut(f32) -> f64) -> Option<f32> {
        let mut f_high = excess(limits.coarsest);
        if f_high > 0.0 {
            return None;
        }
        let mut f_low = excess(limits.finest);
        if f_low <= 0.0 {
            return Some(limits.finest);
        }
        let (mut low, mut high) =
            (libm::log(f64::from(limits.finest)), libm::log(f64::from(limits.coarsest)));
        let mut best = limits.coarsest;
        let mut side = 0;
        for _ in 0..EVALUATIONS {
            let width = high - low;
            if width < 1.0e-3 {
                break;
            }
            // Shifted slightly to the fitting side, so that the search ends there.
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
}

impl Controller for Hybrid {
    fn name(&self) -> &'static str {
        "hybrid"
    }

    fn plan(&mut self, request: &mut PlanRequest<'_>) -> Decision {
        let limits = request.limits;
        let c = self.options.constants;
        self.enter(request.changes, request.cost);
        let target = f64::from(request.target);
        let ceiling = target * (1.0 + f64::from(self.options.tolerance.max(0.0)));
        let changes = request.changes;
        let first = (request.cost)(limits.coarsest);
        let known = first.seconds().is_finite() && first.seconds() > 0.0;
        let out_of_range = first.out_of_range;
        let distrusted = !known || out_of_range > self.options.trust_limit || self.history.leads();
        // Frames before a change of scene do not predict the frame after it.
        let by_history = distrusted && !self.history.is_empty() && !(changes.any() && self.scene.first);
        if !known && !by_history {
            self.last = Some(Last { step: limits.coarsest, target: request.target, terms: first });
            return Decision {
                step: limits.coarsest,
                seconds: f32::NAN,
                upper: f32::NAN,
                out_of_range,
                reason: Reason::NoInformation,
            };
        }
        let history = self.history;
        let margin = self.calm.multiple();
        let this = &*self;
        let mut judge = |step: f32| -> Expected {
            if by_history {
                let (seconds, upper) = history.forecast(step, margin);
                Expected { seconds, upper, calm_upper: upper }
            } else {
                this.judge_at(&(request.cost)(step), f64::from(step))
            }
        };
        let excess = |step: f32| {
            let Expected { seconds, calm_upper, .. } = judge(step);
            let f = libm::log(f64::max(seconds / target, calm_upper / ceiling));
            if f.is_nan() { 1.0 } else { f.clamp(-50.0, 50.0) }
        };
        let mut reason = if by_history { Reason::History } else { Reason::Fits };
        let mut step = match Self::finest(limits, excess) {
            Some(step) => step,
            // No step has a bound that fits. Where some step is expected to fit, the choice is the geometric
            // mean of the finest such step and the coarsest.
            None => match Self::finest(limits, |step| libm::log(judge(step).seconds / target)) {
                Some(expected) => limits.clamp(libm::sqrtf(expected * limits.coarsest)),
                None => {
                    reason = Reason::TargetUnreachable;
                    limits.coarsest
                }
            },
        };
        let nearly = || libm::log(f64::from(step) / f64::from(limits.finest)) <= c.full;
        if reason == Reason::Fits
            && (step <= limits.finest || (nearly() && judge(limits.finest).seconds <= target))
        {
            step = limits.finest;
            reason = Reason::FinestAllowed;
        }
        let steady = |last: &Last| {
            self.options.damping
                && !self.scene.first
                && !self.correction.jumped()
                && limits.clamp(last.step) == last.step
                && libm::fabs(libm::log(target / f64::from(last.target))) < SAME_TARGET
        };
        if let Some(last) = self.last.filter(steady) {
            let delta = libm::log(f64::from(step) / f64::from(last.step));
            let Expected { seconds, calm_upper, .. } = judge(last.step);
            let off = libm::log(seconds / target);
            let near = libm::fabs(delta) < DEAD_BAND
                || (off > -DEAD_BAND && calm_upper <= ceiling * (1.0 + DEAD_BAND));
            if near && off <= DEAD_BAND && reason != Reason::FinestAllowed {
                step = last.step;
                if reason == Reason::Fits {
                    reason = Reason::Held;
                }
            } else if delta > c.damping
                && this.correction.settled()
                && judge(limits.clamp(last.step * libm::exp(c.damping) as f32)).seconds <= target
            {
                step = limits.clamp(last.step * libm::exp(c.damping) as f32);
                if reason == Reason::Fits {
                    reason = Reason::Damped;
                }
            } else if delta < -c.damping && reason != Reason::FinestAllowed && this.correction.settled() {
                step = limits.clamp(last.step * libm::exp(-c.damping) as f32);
                if reason == Reason::Fits {
                    reason = Reason::Damped;
                }
            }
        }
        let Expected { seconds, upper, .. } = judge(step);
        self.last = Some(Last { step, target: request.target, terms: (request.cost)(step) });
        Decision { step, seconds: seconds as f32, upper: upper as f32, out_of_range, reason }
    }

    fn observe(&mut self, observed: &Observed) -> Verdict {
        if observed.unusual {
            return Verdict::Ignored;
        }
        self.before = None;
        let seconds = f64::from(observed.seconds);
        let standing = match observed.scene {
            SceneMark { number, .. } if number != self.scene.number => Standing::Past,
            SceneMark { first: true, .. } => Standing::First,
            _ => Standing::Same,
        };
        let trust = if observed.changes.first { FIRST_TRUST } else { 1.0 };
        let corrected = self.correction.apply(&observed.terms).seconds;
        let error = self.correction.observe(&observed.terms, seconds, standing, trust);
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
            self.history.push(observed.step, seconds, changed);
        }
        if libm::fabs(error) > CLIP { Verdict::Clipped } else { Verdict::Learned }
    }

    fn reset(&mut self) {
        self.correction.reset();
        (self.calm, self.changed) = margins(&self.options);
        self.history = History::new();
        self.last = None;
        self.announced = false;
        self.scene = SceneMark { number: self.scene.number + 1, ..SceneMark::default() };
        self.before = None;
    }

    fn convert(&mut self, converted: bool) {
        let prior = match (self.options.prior, converted) {
            (Prior::Fitted { log_sd }, true) => Prior::Converted { log_sd },
            (Prior::Converted { log_sd }, false) => Prior::Fitted { log_sd },
            _ => return,
        };
        self.options.prior = prior;
        self.correction = Correction::new(prior, self.options.correction);
    }

    fn begin(&mut self, changes: Changes, step: f32, cost: &mut dyn FnMut(f32) -> CostTerms) {
        self.enter(changes, cost);
        // Without a target the next frame is not held or damped against this one.
        self.last = Some(Last { step, target: f32::NAN, terms: cost(step) });
    }

    fn withdraw(&mut self) {
        if let Some(Before { correction, last, announced, scene }) = self.before.take() {
            (self.correction, self.last, self.announced, self.scene) = (correction, last, announced, scene);
            return;
        }
        // An earlier frame was observed since this one began.
        if self.scene.first {
            // The scene begins with the next frame.
            self.last = None;
        }
        self.announced = false;
    }

    fn scene(&self) -> SceneMark {
        self.scene
    }

    fn fits(&self, prediction: &Prediction, target: f32) -> bool {
        let ceiling = target * (1.0 + self.options.tolerance.max(0.0));
        prediction.seconds <= target && prediction.upper <= ceiling
    }

    fn correct(&self, terms: &CostTerms, changes: Changes) -> Prediction {
        let Expected { seconds, upper, .. } = if changes.any() {
            let mut next = self.clone();
            next.correction.advance(1.0);
            next.scene = SceneMark { first: true, ..self.scene };
            next.judge(terms)
        } else {
            self.judge(terms)
        };
        Prediction {
            seconds: (seconds as f32).clamp(1.0e-9, 1.0e9),
            upper: upper as f32,
            out_of_range: terms.out_of_range,
            source: terms.source,
        }
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

/// Initial margins of calm frames and of new scenes.
fn margins(options: &HybridOptions) -> (Margin, Margin) {
    let c = &options.constants;
    let rate = options.miss_rate.max(NEW_SCENE_MISS_RATE);
    (
        Margin::starting_at(c.margin_start, options.miss_rate, MARGIN_PACE),
        Margin::starting_at(c.margin_start, rate, MARGIN_PACE),
    )
}

/// Quantile of the normal distribution with this upper-tail probability, clamped to 0…8.
fn normal_quantile(probability: f64) -> f64 {
    let (mut low, mut high) = (0.0, 8.0);
    for _ in 0..30 {
        let middle = 0.5 * (low + high);
        let exceeded = 0.5 * libm::erfc(middle * core::f64::consts::FRAC_1_SQRT_2);
        if exceeded > probability { low = middle } else { high = middle }
    }
    if probability > 0.0 { low } else { 0.0 }
}

/// Distance of two predictions at one step: the absolute difference of their logarithms, plus half the sum of
/// the absolute differences of their terms' shares. NaN if either prediction is unknown.
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
        for (rate, sd) in [(0.158_655_3, 1.0), (0.022_750_13, 2.0), (0.001_349_898, 3.0)] {
            assert!((normal_quantile(rate) - sd).abs() < 1e-6, "{rate}: {}", normal_quantile(rate));
        }
        assert_eq!([f64::NAN, 0.0, -1.0].map(normal_quantile), [0.0; 3]);
        let worth = |miss_rate| Hybrid::new(HybridOptions { miss_rate, ..HybridOptions::default() }).worth;
        assert_eq!(worth(0.05), WORTH);
        assert!(worth(0.001) > 3.0);
    }
}
