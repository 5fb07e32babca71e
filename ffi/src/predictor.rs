//! `entire_predictor`: plan, draw, observe, for one render loop.

use crate::abi::{
    ByValue, check_output, check_pointer, init_struct, read_struct, slice, write, write_struct,
};
use crate::frame::{entire_frame, entire_setting};
use crate::guard::{changing, freeing, guard, last_error_of, reading};
use crate::handle::{Handle, Status, borrow, give, handle, share};
use crate::model::entire_model;
use crate::result::Failure;
use crate::result::entire_result::{self, *};
use crate::transfer::{UnitDistance, entire_transfer_function};
use crate::volume::entire_volume;
use entire_core::adapt::{ObserveFlags, Verdict};
use entire_core::control::{HybridOptions, Plan, Reason, Session, StepLimits};
use entire_core::features::Changes;
use entire_core::predict::{AnalyticModel, Predictor, Source};
use entire_core::scene::TransferFunction;
use glam::Vec3;
use std::ffi::c_char;
use std::mem::{offset_of, size_of};
use std::sync::Arc;

/// Why a plan has the step that it has: one of the `ENTIRE_REASON_*` numbers.
pub type entire_reason = u32;
/// The finest step whose upper bound fits the target.
pub const ENTIRE_REASON_FITS: entire_reason = 1;
/// As before, but moved there slowly because nothing has changed abruptly.
pub const ENTIRE_REASON_DAMPED: entire_reason = 2;
/// The step before still fits and is close to the best: kept.
pub const ENTIRE_REASON_HELD: entire_reason = 3;
/// Nothing finer is allowed, and it fits.
pub const ENTIRE_REASON_FINEST_ALLOWED: entire_reason = 4;
/// Nothing coarser is allowed, and even that is not expected to fit.
pub const ENTIRE_REASON_TARGET_UNREACHABLE: entire_reason = 5;
/// The prediction is not trusted: recent frames decide.
pub const ENTIRE_REASON_HISTORY: entire_reason = 6;
/// Neither a prediction nor a timing is there: the coarsest step allowed.
pub const ENTIRE_REASON_NO_INFORMATION: entire_reason = 7;
/// Steering is off: the step asked for.
pub const ENTIRE_REASON_OFF: entire_reason = 8;
/// A rule that reacts to past frames only.
pub const ENTIRE_REASON_REACTIVE: entire_reason = 9;

/// Where a prediction comes from: one of the `ENTIRE_SOURCE_*` numbers.
pub type entire_source = u32;
/// The linear cost model on estimated work.
pub const ENTIRE_SOURCE_ANALYTIC: entire_source = 1;
/// The model's network.
pub const ENTIRE_SOURCE_NETWORK: entire_source = 2;
/// Recent frames.
pub const ENTIRE_SOURCE_HISTORY: entire_source = 3;

/// What became of an observation that was not refused: one of the `ENTIRE_VERDICT_*` numbers.
pub type entire_verdict = u32;
/// Learned from.
pub const ENTIRE_VERDICT_LEARNED: entire_verdict = 0;
/// Far from what was expected: its pull was clipped.
pub const ENTIRE_VERDICT_CLIPPED: entire_verdict = 1;
/// Taken note of, not learned from: flagged, or the first frame.
pub const ENTIRE_VERDICT_IGNORED: entire_verdict = 2;

/// In `absent`: nothing is known of the seconds; they are NaN.
pub const ENTIRE_ABSENT_SECONDS: u32 = 1;
/// In `absent`: there is no upper bound; it is NaN.
pub const ENTIRE_ABSENT_UPPER: u32 = 2;
/// In `absent`: no training range is known; out_of_range is NaN.
pub const ENTIRE_ABSENT_OUT_OF_RANGE: u32 = 4;

/// Observation flag: the time holds work that is not the frame's (a compile, an upload, a stall).
pub const ENTIRE_OBSERVE_UNUSUAL: u32 = 1;
/// Observation flag: the frame was abandoned; its time says only that it takes at least that long.
pub const ENTIRE_OBSERVE_CANCELLED: u32 = 2;

/// Change flag: a pipeline was built, or the device is another.
pub const ENTIRE_CHANGE_FIRST: u32 = 1;
/// Change flag: another transfer function.
pub const ENTIRE_CHANGE_TRANSFER_FUNCTION: u32 = 2;
/// Change flag: another volume.
pub const ENTIRE_CHANGE_VOLUME: u32 = 4;
/// Change flag: another image size.
pub const ENTIRE_CHANGE_SIZE: u32 = 8;
/// Change flag: another shading, skipping or termination.
pub const ENTIRE_CHANGE_MODE: u32 = 16;
/// Change flag: the camera jumped.
pub const ENTIRE_CHANGE_CAMERA: u32 = 32;

/// How many settings entire_predictor_choose takes at most.
pub const ENTIRE_MAX_SETTINGS: usize = 64;

const _: () = {
    assert!(ENTIRE_REASON_FITS == Reason::Fits as u32);
    assert!(ENTIRE_REASON_DAMPED == Reason::Damped as u32);
    assert!(ENTIRE_REASON_HELD == Reason::Held as u32);
    assert!(ENTIRE_REASON_FINEST_ALLOWED == Reason::FinestAllowed as u32);
    assert!(ENTIRE_REASON_TARGET_UNREACHABLE == Reason::TargetUnreachable as u32);
    assert!(ENTIRE_REASON_HISTORY == Reason::History as u32);
    assert!(ENTIRE_REASON_NO_INFORMATION == Reason::NoInformation as u32);
    assert!(ENTIRE_REASON_OFF == Reason::Off as u32);
    assert!(ENTIRE_REASON_REACTIVE == Reason::Reactive as u32);
    assert!(ENTIRE_SOURCE_ANALYTIC == Source::Analytic as u32);
    assert!(ENTIRE_SOURCE_NETWORK == Source::Network as u32);
    assert!(ENTIRE_SOURCE_HISTORY == Source::History as u32);
    assert!(ENTIRE_VERDICT_LEARNED == Verdict::Learned as u32);
    assert!(ENTIRE_VERDICT_CLIPPED == Verdict::Clipped as u32);
    assert!(ENTIRE_VERDICT_IGNORED == Verdict::Ignored as u32);
};

/// How a predictor steers. Fill with entire_predictor_options_init, then set what differs.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_predictor_options {
    /// sizeof(entire_predictor_options).
    pub struct_size: usize,
    /// Finest ray step that may be chosen, in multiples of the reference step, at least 1/64; default 1.
    pub finest_step: f32,
    /// Coarsest ray step that may be chosen, up to 4096; default 16.
    pub coarsest_step: f32,
    /// Share of frames that may exceed the target by more than `tolerance`, over 0 and under 1; default 0.03.
    pub miss_rate: f32,
    /// How far over the target a frame may be before it counts as missed, as a share of the target, not negative; default
    /// 0.1.
    pub tolerance: f32,
    /// Out-of-range score from which recent frames decide instead of the prediction, positive; default 2.
    pub trust_limit: f32,
    /// Not 0 where moves are damped in calm phases; default 1.
    pub damping: u32,
    /// Rays along each side of the probe that measures frames for a linear cost model (no model, or an analytic one), 1 to
    /// 24. Fewer make plans cheaper and what they are made from rougher, with the square of the side. Default 0: 11. A
    /// network keeps the side that its file names, which it was trained with.
    pub probe_side: u32,
    /// Must be 0.
    pub reserved: u32,
}

// SAFETY: repr(C), struct_size first, integers and floats only.
unsafe impl ByValue for entire_predictor_options {
    const NAME: &'static str = "entire_predictor_options";
    /// Up to `damping`.
    const FIRST_SIZE: usize = offset_of!(Self, probe_side);
    fn defaults() -> Self {
        let (hybrid, limits) = (HybridOptions::default(), StepLimits::default());
        Self {
            struct_size: size_of::<Self>(),
            finest_step: limits.finest(),
            coarsest_step: limits.coarsest(),
            miss_rate: hybrid.miss_rate,
            tolerance: hybrid.tolerance,
            trust_limit: hybrid.trust_limit,
            damping: hybrid.damping.into(),
            probe_side: 0,
            reserved: 0,
        }
    }
}

/// What to draw, and what to expect of it. Set struct_size before the call.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_plan {
    /// sizeof(entire_plan).
    pub struct_size: usize,
    /// Names this plan in entire_predictor_observe; never 0.
    pub id: u64,
    /// Ray step to draw with, in multiples of the reference step.
    pub step: f32,
    /// Expected seconds.
    pub seconds: f32,
    /// Upper bound of the seconds.
    pub upper: f32,
    /// 0 where the inputs lie inside the model's training range, 1 at the edge of trust, growing beyond.
    pub out_of_range: f32,
    /// One of ENTIRE_REASON_*.
    pub reason: entire_reason,
    /// Which of the numbers above are not known: ENTIRE_ABSENT_* flags.
    pub absent: u32,
    /// What to divide the sides of the frame's image by, rounded down; 1 unless entire_predictor_set_coarsest_pixel allows
    /// more.
    pub pixel: f32,
    /// Must be ignored.
    pub reserved: u32,
}

// SAFETY: repr(C), struct_size first, integers and floats only.
unsafe impl ByValue for entire_plan {
    const NAME: &'static str = "entire_plan";
    /// Up to `absent`.
    const FIRST_SIZE: usize = offset_of!(Self, pixel);
    fn defaults() -> Self {
        Self {
            struct_size: size_of::<Self>(),
            id: 0,
            step: f32::NAN,
            seconds: f32::NAN,
            upper: f32::NAN,
            out_of_range: f32::NAN,
            reason: 0,
            absent: 0,
            pixel: 1.0,
            reserved: 0,
        }
    }
}

/// A predicted frame time. Set struct_size before the call.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_prediction {
    /// sizeof(entire_prediction).
    pub struct_size: usize,
    /// Expected seconds.
    pub seconds: f32,
    /// Upper bound of the seconds.
    pub upper: f32,
    /// As in entire_plan.
    pub out_of_range: f32,
    /// One of ENTIRE_SOURCE_*.
    pub source: entire_source,
    /// Which of the numbers above are not known: ENTIRE_ABSENT_* flags.
    pub absent: u32,
    /// Must be ignored.
    pub reserved: u32,
}

// SAFETY: repr(C), struct_size first, integers and floats only.
unsafe impl ByValue for entire_prediction {
    const NAME: &'static str = "entire_prediction";
    const FIRST_SIZE: usize = size_of::<Self>();
    fn defaults() -> Self {
        Self {
            struct_size: size_of::<Self>(),
            seconds: f32::NAN,
            upper: f32::NAN,
            out_of_range: f32::NAN,
            source: 0,
            absent: 0,
            reserved: 0,
        }
    }
}

// The layouts of ABI 1 on 64-bit targets; a field may be added behind, never moved.
#[cfg(target_pointer_width = "64")]
const _: () = {
    assert!(size_of::<entire_predictor_options>() == 40);
    assert!(<entire_predictor_options as ByValue>::FIRST_SIZE == 32);
    assert!(offset_of!(entire_predictor_options, damping) == 28);
    assert!(offset_of!(entire_predictor_options, probe_side) == 32);
    assert!(size_of::<entire_plan>() == 48);
    assert!(<entire_plan as ByValue>::FIRST_SIZE == 40);
    assert!(offset_of!(entire_plan, pixel) == 40);
    assert!(offset_of!(entire_plan, step) == 16);
    assert!(offset_of!(entire_plan, reason) == 32);
    assert!(size_of::<entire_prediction>() == 32);
    assert!(offset_of!(entire_prediction, source) == 20);
};

/// Which of the three numbers are not known.
fn absent(seconds: f32, upper: f32, out_of_range: f32) -> u32 {
    let flag = |value: f32, flag| if value.is_nan() { flag } else { 0 };
    flag(seconds, ENTIRE_ABSENT_SECONDS)
        | flag(upper, ENTIRE_ABSENT_UPPER)
        | flag(out_of_range, ENTIRE_ABSENT_OUT_OF_RANGE)
}

impl From<Plan> for entire_plan {
    fn from(plan: Plan) -> Self {
        Self {
            id: plan.id,
            step: plan.step,
            seconds: plan.seconds,
            upper: plan.upper,
            out_of_range: plan.out_of_range,
            reason: plan.reason as u32,
            pixel: plan.image_sample_distance,
            absent: absent(plan.seconds, plan.upper, plan.out_of_range),
            ..ByValue::defaults()
        }
    }
}

/// Predicts and steers one render loop. For one thread at a time; give every loop its own.
pub struct entire_predictor {
    status: Status,
    value: Loop,
}

pub(crate) struct Loop {
    session: Session,
    model: Option<Arc<entire_model>>,
    /// Spacing and bounding-sphere radius of the volume that is set.
    volume: Option<(Vec3, f32)>,
}

handle!(entire_predictor, Loop, Boxed);

impl Loop {
    fn radius(&self) -> Option<f32> {
        self.volume.map(|(_, radius)| radius)
    }
}

/// Fills predictor options with their defaults; `struct_size` is sizeof(entire_predictor_options).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_options_init(
    options: *mut entire_predictor_options,
    struct_size: usize,
) -> entire_result {
    // SAFETY: the pointer is as the crate's documentation demands.
    guard(|| unsafe { init_struct(options, struct_size) })
}

/// Makes a predictor for one render loop. `model` may be NULL: then a linear cost model, which knows no device until the
/// first frames are observed, predicts. `options` may be NULL for the defaults. The predictor keeps its own share of the
/// model.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (step limits, rates, probe side), ENTIRE_UNSUPPORTED (a model without a prediction
/// network), ENTIRE_MISSING_INPUT (a model with an input group that this version does not know), ENTIRE_PANIC (a model
/// handle that is unusable), ENTIRE_NULL_ARGUMENT, ENTIRE_STRUCT_SIZE.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_new(
    model: *const entire_model,
    options: *const entire_predictor_options,
    predictor: *mut *mut entire_predictor,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    guard(|| unsafe {
        check_pointer(predictor, "predictor (output)")?;
        let options = if options.is_null() { ByValue::defaults() } else { read_struct(options)? };
        let limits = StepLimits::new(options.finest_step, options.coarsest_step)?;
        let hybrid = hybrid_options(&options)?;
        let predicts: Box<dyn Predictor + Send> =
            if model.is_null() { Box::new(AnalyticModel::new()) } else { borrow(model)?.predictor()? };
        let model = if model.is_null() { None } else { Some(share(model)) };
        let mut session = Session::new(predicts, hybrid);
        if options.probe_side != 0 {
            session = session.with_probe_side(options.probe_side as usize)?;
        }
        session.set_limits(limits);
        write(predictor, give(Loop { session, model, volume: None }), "predictor (output)")
    })
}

fn hybrid_options(options: &entire_predictor_options) -> Result<HybridOptions, Failure> {
    let refuse = |what: &str, found: f32, accepted: &str| {
        Err(Failure::new(ENTIRE_INVALID_ARGUMENT, format!("{what} is {found}; it must be {accepted}")))
    };
    let entire_predictor_options { miss_rate, tolerance, trust_limit, .. } = *options;
    if !(miss_rate > 0.0 && miss_rate < 1.0) {
        return refuse("miss_rate", miss_rate, "over 0 and under 1");
    }
    if !(tolerance.is_finite() && tolerance >= 0.0) {
        return refuse("tolerance", tolerance, "finite and not negative");
    }
    if !(trust_limit > 0.0) {
        return refuse("trust_limit", trust_limit, "positive (infinity to trust always)");
    }
    if options.reserved != 0 {
        return Err(Failure::new(
            ENTIRE_INVALID_ARGUMENT,
            format!("reserved is {}; it must be 0", options.reserved),
        ));
    }
    Ok(HybridOptions {
        miss_rate,
        tolerance,
        trust_limit,
        damping: options.damping != 0,
        ..HybridOptions::default()
    })
}

/// Sets the volume. Its first use by any predictor scans its voxels once; where the model takes volume features, they are
/// the volume's ready ones (entire_volume_set_features), else the voxels are encoded by the model's own encoder, which
/// takes milliseconds to seconds. The transfer function must be set again.
///
/// Fails with ENTIRE_SIZE_MISMATCH (ready features of another number than the model takes), ENTIRE_NOT_READY (features
/// are needed, and there are neither ready ones nor voxels), ENTIRE_UNSUPPORTED (features are needed, and the model has
/// no encoder), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_set_volume(
    predictor: *mut entire_predictor,
    volume: *const entire_volume,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            let volume = borrow(volume)?;
            let summary = volume.summary()?;
            let features = match &state.model {
                Some(model) => model.value().features_of(volume)?,
                None => None,
            };
            state.volume = Some((summary.spacing(), summary.bounding_radius()));
            state.session.set_volume(summary.clone(), features.as_deref());
            Ok(())
        })
    }
}

/// Sets the transfer function; the volume comes first.
///
/// Fails with ENTIRE_NOT_READY (no volume), ENTIRE_INVALID_ARGUMENT (a unit distance that is out of range for this
/// volume), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_set_transfer_function(
    predictor: *mut entire_predictor,
    transfer_function: *const entire_transfer_function,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            let transfer = borrow(transfer_function)?;
            let table = transfer.table.clone();
            let table = match (transfer.unit, state.volume) {
                (UnitDistance::ReferenceSteps(distance), _) => table.with_unit_distance(distance)?,
                (UnitDistance::World(distance), Some((spacing, _))) => {
                    table.with_world_unit_distance(distance, spacing)?
                }
                // The session says that the volume comes first.
                (UnitDistance::World(_), None) => table,
            };
            let lobes = match &transfer.function {
                TransferFunction::Gaussian(lobes) => Some(lobes.as_slice()),
                _ => None,
            };
            Ok(state.session.set_transfer(&table, lobes)?)
        })
    }
}

/// Sets the steps that may be chosen, in multiples of the reference step.
///
/// Fails with ENTIRE_INVALID_ARGUMENT unless 1/64 <= finest <= coarsest <= 4096; ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_set_limits(
    predictor: *mut entire_predictor,
    finest_step: f32,
    coarsest_step: f32,
) -> entire_result {
    // SAFETY: the pointer is as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            state.session.set_limits(StepLimits::new(finest_step, coarsest_step)?);
            Ok(())
        })
    }
}

/// Allows plans to shrink the image, so that a side of its pixels is up to `coarsest_pixel` pixels of the frame's long, 1 to
/// 64: ray step and image are then coarsened together, which changes the picture less than one of them alone (`pixel` in
/// entire_plan). Up to `step_alone` times the finest step, 1 to 64, the image stays whole: 1, or some 2 where any smaller image
/// is blurred by much. A `coarsest_pixel` of 1, where predictors start, leaves the image alone. For linear cost models and networks that take the image
/// size. One plan serves all sizes: this is cheaper, and learns better, than planning for one size after the other.
///
/// Fails with ENTIRE_INVALID_ARGUMENT for another number; ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_set_coarsest_pixel(
    predictor: *mut entire_predictor,
    coarsest_pixel: f32,
    step_alone: f32,
) -> entire_result {
    // SAFETY: the pointer is as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            Ok(state.session.set_max_image_sample_distance(coarsest_pixel, step_alone)?)
        })
    }
}

/// Switches steering off (0: every plan answers the frame's own step; for screenshots and still renders) or on again.
/// Observations are learned from either way.
///
/// Fails with ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_set_enabled(
    predictor: *mut entire_predictor,
    enabled: u32,
) -> entire_result {
    // SAFETY: the pointer is as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            state.session.set_enabled(enabled != 0);
            Ok(())
        })
    }
}

/// Tells that the next frame does not follow smoothly on the one before, in ways that the predictor cannot see: flags
/// ENTIRE_CHANGE_*. Changes of volume, transfer function, image size and mode are noticed without it.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (an unknown flag), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_mark(
    predictor: *mut entire_predictor,
    changes: u32,
) -> entire_result {
    const KNOWN: u32 = ENTIRE_CHANGE_FIRST
        | ENTIRE_CHANGE_TRANSFER_FUNCTION
        | ENTIRE_CHANGE_VOLUME
        | ENTIRE_CHANGE_SIZE
        | ENTIRE_CHANGE_MODE
        | ENTIRE_CHANGE_CAMERA;
    // SAFETY: the pointer is as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            check_flags("changes", changes, KNOWN)?;
            let has = |flag| changes & flag != 0;
            state.session.mark(Changes {
                first: has(ENTIRE_CHANGE_FIRST),
                transfer: has(ENTIRE_CHANGE_TRANSFER_FUNCTION),
                volume: has(ENTIRE_CHANGE_VOLUME),
                size: has(ENTIRE_CHANGE_SIZE),
                mode: has(ENTIRE_CHANGE_MODE),
                camera: has(ENTIRE_CHANGE_CAMERA),
            });
            Ok(())
        })
    }
}

fn check_flags(what: &str, found: u32, known: u32) -> Result<(), Failure> {
    if found & !known == 0 {
        return Ok(());
    }
    Err(Failure::new(
        ENTIRE_INVALID_ARGUMENT,
        format!("{what} has the unknown flag(s) {:#x}; known are {known:#x}", found & !known),
    ))
}

/// Predicts a frame's time at the frame's own step, corrected by what was observed; changes nothing that later plans
/// depend on. Set prediction->struct_size first.
///
/// Fails with ENTIRE_NOT_READY (volume or transfer function not set), ENTIRE_MISSING_INPUT (the model needs an input that
/// was not supplied, such as Gaussian lobes), ENTIRE_INVALID_ARGUMENT (the frame), ENTIRE_NULL_ARGUMENT,
/// ENTIRE_STRUCT_SIZE.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_predict(
    predictor: *mut entire_predictor,
    frame: *const entire_frame,
    prediction: *mut entire_prediction,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            check_output(prediction)?;
            let frame = read_struct(frame)?.checked(state.radius())?;
            let p = state.session.predict(&frame)?;
            let out = entire_prediction {
                seconds: p.seconds,
                upper: p.upper,
                out_of_range: p.out_of_range,
                source: p.source as u32,
                absent: absent(p.seconds, p.upper, p.out_of_range),
                ..ByValue::defaults()
            };
            write_struct(prediction, &out)
        })
    }
}

/// Chooses the ray step of the next frame, so that it takes at most `target_seconds`: the finest step whose upper bound
/// fits. Draw with plan->step, then tell entire_predictor_observe how long it took. Set plan->struct_size first. Does not
/// allocate.
///
/// Fails as entire_predictor_predict does, and with ENTIRE_INVALID_ARGUMENT for a target that is not finite and positive.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_plan(
    predictor: *mut entire_predictor,
    frame: *const entire_frame,
    target_seconds: f32,
    plan: *mut entire_plan,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            check_output(plan)?;
            let frame = read_struct(frame)?.checked(state.radius())?;
            let made = state.session.plan(&frame, target_seconds)?;
            write_struct(plan, &made.into())
        })
    }
}

/// Chooses among the caller's settings, best quality first: the first whose upper bound fits the target, else the one
/// expected to be fastest. At most ENTIRE_MAX_SETTINGS. `index` receives which one, `plan` its plan, to be observed like
/// any other. The frame's own step, size and modes do not count. Does not allocate.
///
/// Fails as entire_predictor_plan does, with ENTIRE_INVALID_ARGUMENT for no settings or one that is out of range, and with
/// ENTIRE_SIZE_MISMATCH for too many.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_choose(
    predictor: *mut entire_predictor,
    frame: *const entire_frame,
    settings: *const entire_setting,
    setting_count: usize,
    target_seconds: f32,
    index: *mut usize,
    plan: *mut entire_plan,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            check_output(plan)?;
            check_pointer(index, "index (output)")?;
            let frame = read_struct(frame)?.checked(state.radius())?;
            if setting_count > ENTIRE_MAX_SETTINGS {
                return Err(Failure::new(
                    ENTIRE_SIZE_MISMATCH,
                    format!("{setting_count} settings; choose takes at most {ENTIRE_MAX_SETTINGS}"),
                ));
            }
            let given = slice(settings, setting_count, "settings")?;
            let mut settings = [entire_core::features::Setting::of(&frame); ENTIRE_MAX_SETTINGS];
            for (slot, setting) in settings.iter_mut().zip(given) {
                *slot = setting.checked()?;
            }
            let choice = state.session.choose(&frame, &settings[..setting_count], target_seconds)?;
            write(index, choice.index, "index (output)")?;
            write_struct(plan, &choice.plan.into())
        })
    }
}

/// Tells how long a planned frame took. Late observations are welcome as long as their plan is among the last 64.
/// `flags`: ENTIRE_OBSERVE_* or 0. `verdict` may be NULL. Does not allocate when it succeeds.
///
/// Fails with ENTIRE_REJECTED_OBSERVATION (an unknown or forgotten plan, one observed before, a time that is not finite
/// and positive or over 10000 s; nothing is learned), ENTIRE_INVALID_ARGUMENT (an unknown flag), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_observe(
    predictor: *mut entire_predictor,
    plan_id: u64,
    seconds: f32,
    flags: u32,
    verdict: *mut entire_verdict,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            check_flags("flags", flags, ENTIRE_OBSERVE_UNUSUAL | ENTIRE_OBSERVE_CANCELLED)?;
            if !verdict.is_null() {
                check_pointer(verdict, "verdict (output)")?;
            }
            let told = ObserveFlags {
                unusual: flags & ENTIRE_OBSERVE_UNUSUAL != 0,
                cancelled: flags & ENTIRE_OBSERVE_CANCELLED != 0,
            };
            let found = state.session.observe(plan_id, seconds, told)?;
            if !verdict.is_null() {
                write(verdict, found as u32, "verdict (output)")?;
            }
            Ok(())
        })
    }
}

/// Forgets every observation and every pending plan; volume, transfer function and limits stay.
///
/// Fails with ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_reset(predictor: *mut entire_predictor) -> entire_result {
    // SAFETY: the pointer is as the crate's documentation demands.
    unsafe {
        changing(predictor, |state| {
            state.session.reset();
            Ok(())
        })
    }
}

/// Saves what was learned, for entire_predictor_load_state in a later run: `byte_count` receives how many bytes it is, and
/// `buffer` the bytes where `capacity` suffices. `buffer` may be NULL with capacity 0 to ask for the size.
///
/// Fails with ENTIRE_SIZE_MISMATCH (a capacity that is too small and not 0; the size is in the error text),
/// ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_save_state(
    predictor: *const entire_predictor,
    buffer: *mut u8,
    capacity: usize,
    byte_count: *mut usize,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe {
        reading(predictor, |state| {
            check_pointer(byte_count, "byte_count (output)")?;
            let bytes = state.session.save_state();
            if capacity > 0 {
                check_pointer(buffer, "buffer")?;
                if capacity < bytes.len() {
                    return Err(Failure::new(
                        ENTIRE_SIZE_MISMATCH,
                        format!("buffer holds {capacity} bytes; the state has {}", bytes.len()),
                    ));
                }
                std::ptr::copy_nonoverlapping(bytes.as_ptr(), buffer, bytes.len());
            }
            write(byte_count, bytes.len(), "byte_count (output)")
        })
    }
}

/// Takes up what an earlier predictor saved. Pending plans are forgotten.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (bytes that are cut short, damaged or not a state), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_load_state(
    predictor: *mut entire_predictor,
    bytes: *const u8,
    byte_count: usize,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe { changing(predictor, |state| Ok(state.session.load_state(slice(bytes, byte_count, "bytes")?)?)) }
}

/// Copies the text of the predictor's last call where it failed, as entire_model_last_error does; empty after a call that
/// succeeded.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_last_error(
    predictor: *const entire_predictor,
    buffer: *mut c_char,
    capacity: usize,
    length: *mut usize,
) -> entire_result {
    // SAFETY: the pointers are as the crate's documentation demands.
    unsafe { last_error_of(predictor, buffer, capacity, length) }
}

/// Frees a predictor; NULL is nothing to do.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_predictor_free(predictor: *mut entire_predictor) {
    // SAFETY: the pointer is as the crate's documentation demands.
    unsafe { freeing(predictor) }
}

/// Panics on purpose, for the test of the panic boundary.
#[cfg(feature = "test-panic")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_test_panic(predictor: *mut entire_predictor) -> entire_result {
    // SAFETY: the pointer is as the crate's documentation demands.
    unsafe { changing(predictor, |state| panic!("deliberate, with radius {:?}", state.radius())) }
}
