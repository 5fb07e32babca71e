//! Prediction of a frame, and choice of its settings.

use super::entire_session;
use crate::abi::{ByValue, by_value, check_output, check_pointer, read_struct, slice, write, write_struct};
use crate::frame::{entire_frame, entire_setting};
use crate::guard::{changing, entry};
use crate::result::entire_result::{self, *};
use crate::result::{Failure, is_frame_time, no_prediction, refuse};
use entire_steer::control::{Plan, Reason, Session};
use entire_steer::predict::Source;

/// Reason for a plan's step: one of the `ENTIRE_REASON_*` numbers.
pub type entire_reason = u32;
/// The finest step that is expected to meet the target and whose upper bound is at most (1 + tolerance) times
/// the target. If no step has such a bound: the step with the least expected cost of late frames and of lost
/// quality, among the steps that are expected to meet the target.
pub const ENTIRE_REASON_FITS: entire_reason = 1;
/// The step moves slowly towards that of ENTIRE_REASON_FITS, because nothing changed abruptly.
pub const ENTIRE_REASON_DAMPED: entire_reason = 2;
/// The step of the last plan is kept. It is still expected to meet the target, and is close to that of
/// ENTIRE_REASON_FITS.
pub const ENTIRE_REASON_HELD: entire_reason = 3;
/// The finest allowed step, which is expected to meet the target; its upper bound may exceed (1 + tolerance)
/// times the target.
pub const ENTIRE_REASON_FINEST_ALLOWED: entire_reason = 4;
/// Even the coarsest allowed step is not expected to meet the target. The plan has this step, or the step of
/// the previous frame if that step is expected to exceed the target by less than 1 %.
pub const ENTIRE_REASON_TARGET_UNREACHABLE: entire_reason = 5;
/// The step was chosen from recent frame times, because the prediction is missing, out of range or recently
/// wrong.
pub const ENTIRE_REASON_HISTORY: entire_reason = 6;
/// The coarsest allowed step, because there is neither a prediction nor a recent frame time.
pub const ENTIRE_REASON_NO_INFORMATION: entire_reason = 7;
/// Steering is off: the frame's own step.
pub const ENTIRE_REASON_OFF: entire_reason = 8;

/// Source of a prediction: one of the `ENTIRE_SOURCE_*` numbers.
pub type entire_source = u32;
/// The analytic model: unit costs times estimated work.
pub const ENTIRE_SOURCE_ANALYTIC: entire_source = 1;
/// The model's network.
pub const ENTIRE_SOURCE_NETWORK: entire_source = 2;

/// In `absent`: the seconds are unknown; they are NaN.
pub const ENTIRE_ABSENT_SECONDS: u32 = 1;
/// In `absent`: there is no upper bound; it is NaN.
pub const ENTIRE_ABSENT_UPPER: u32 = 2;
/// In `absent`: the training range is unknown; out_of_range is NaN.
pub const ENTIRE_ABSENT_OUT_OF_RANGE: u32 = 4;

/// Maximum number of settings of entire_session_choose.
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
    assert!(ENTIRE_SOURCE_ANALYTIC == Source::Analytic as u32);
    assert!(ENTIRE_SOURCE_NETWORK == Source::Network as u32);
};

/// Settings of a frame to draw, and its expected time. Set struct_size before the call.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_plan {
    /// sizeof(entire_plan).
    pub struct_size: usize,
    /// Number of this plan for entire_session_observe; never 0.
    pub id: u64,
    /// Ray step to draw with, in multiples of the reference step.
    pub step: f32,
    /// Distance of neighboring rays in pixels of the frame, along each side of the image. To get the image
    /// size, divide the frame's width and height by this number, and round down to a whole number of at least
    /// 1. The number is 1 unless entire_session_set_max_image_sample_distance allows more.
    pub image_sample_distance: f32,
    /// Expected seconds: finite and positive, or NaN where ENTIRE_ABSENT_SECONDS says so.
    pub seconds: f32,
    /// Upper bound of the seconds.
    pub upper: f32,
    /// Out-of-range score: 0 if the inputs are inside the range of the training data, else their distance
    /// from this range in units of half its width. Above the session's trust_limit, steps are chosen from
    /// recent frames.
    pub out_of_range: f32,
    /// ENTIRE_ABSENT_* flags of the unknown numbers among the three above.
    pub absent: u32,
    /// Reason for this step: one of ENTIRE_REASON_*.
    pub reason: entire_reason,
    /// Must be ignored.
    pub reserved: u32,
}

by_value!(entire_plan {
    id: 0,
    step: f32::NAN,
    image_sample_distance: 1.0,
    seconds: f32::NAN,
    upper: f32::NAN,
    out_of_range: f32::NAN,
    absent: 0,
    reason: 0,
    reserved: 0,
});

/// A predicted frame time. Set struct_size before the call.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_prediction {
    /// sizeof(entire_prediction).
    pub struct_size: usize,
    /// Expected seconds, finite and positive.
    pub seconds: f32,
    /// Upper bound of the seconds.
    pub upper: f32,
    /// Out-of-range score: 0 if the inputs are inside the range of the training data, else their distance
    /// from this range in units of half its width.
    pub out_of_range: f32,
    /// ENTIRE_ABSENT_* flags of the unknown numbers among the three above.
    pub absent: u32,
    /// Source of the prediction: one of ENTIRE_SOURCE_*.
    pub source: entire_source,
    /// Must be ignored.
    pub reserved: u32,
}

by_value!(entire_prediction {
    seconds: f32::NAN,
    upper: f32::NAN,
    out_of_range: f32::NAN,
    absent: 0,
    source: 0,
    reserved: 0,
});

/// ENTIRE_ABSENT_* flags of the NaNs among three numbers.
fn absent(seconds: f32, upper: f32, out_of_range: f32) -> u32 {
    let flag = |value: f32, flag| if value.is_nan() { flag } else { 0 };
    flag(seconds, ENTIRE_ABSENT_SECONDS)
        | flag(upper, ENTIRE_ABSENT_UPPER)
        | flag(out_of_range, ENTIRE_ABSENT_OUT_OF_RANGE)
}

/// The upper bound if it can be the seconds of a frame, else NaN.
fn bound(upper: f32) -> f32 {
    if is_frame_time(upper) { upper } else { f32::NAN }
}

/// Converts a plan for the caller. Its seconds may be NaN only if the plan was made without a prediction.
fn checked(plan: Plan) -> Result<entire_plan, Failure> {
    let without = matches!(plan.reason, Reason::History | Reason::NoInformation | Reason::Off);
    if !(is_frame_time(plan.seconds) || without && plan.seconds.is_nan()) {
        return Err(no_prediction(plan.seconds));
    }
    let upper = bound(plan.upper);
    Ok(entire_plan {
        id: plan.id,
        step: plan.step,
        image_sample_distance: plan.image_sample_distance,
        seconds: plan.seconds,
        upper,
        out_of_range: plan.out_of_range,
        absent: absent(plan.seconds, upper, plan.out_of_range),
        reason: plan.reason as u32,
        ..ByValue::defaults()
    })
}

/// Converts a plan by [`checked`]. The session forgets a refused plan, so that the next plan gets its id.
fn kept(session: &mut Session, plan: Plan) -> Result<entire_plan, Failure> {
    checked(plan).inspect_err(|_| session.withdraw(plan.id))
}

/// Predicts a frame's time at the frame's own step, with the correction learned from observed frames. Does
/// not change what was learned. With a probe_tolerance, a later plan may reuse the rays of this call. Set
/// prediction->struct_size first.
///
/// Fails as entire_session_plan does.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_predict(
    session: *mut entire_session,
    frame: *const entire_frame,
    prediction: *mut entire_prediction,
) -> entire_result {
    entry!(changing(session, |state| {
        check_output(prediction)?;
        let frame = read_struct(frame)?.checked(state.radius())?;
        let p = state.session.predict(&frame)?;
        if !is_frame_time(p.seconds) {
            return Err(no_prediction(p.seconds));
        }
        let upper = bound(p.upper);
        let out = entire_prediction {
            seconds: p.seconds,
            upper,
            out_of_range: p.out_of_range,
            absent: absent(p.seconds, upper, p.out_of_range),
            source: p.source as u32,
            ..ByValue::defaults()
        };
        write_struct(prediction, &out)
    }))
}

/// Chooses the ray step of the next frame: the finest step whose expected time is at most `target_seconds`,
/// and whose upper bound for undisturbed frames (frames that no other program slows down) is at most (1 +
/// tolerance) times `target_seconds`. plan->upper is the upper bound for all frames. Draw with plan->step,
/// then pass the frame's time to entire_session_observe. Set plan->struct_size first. Does not allocate.
///
/// Fails with ENTIRE_NOT_READY (volume or transfer function not set), ENTIRE_MISSING_INPUT (the model needs
/// an input that was not supplied, such as Gaussian lobes), ENTIRE_INVALID_ARGUMENT (a frame that is out of
/// range, or a target that is not finite and positive), ENTIRE_INVALID_MODEL (the model's result is not a
/// frame time), ENTIRE_NULL_ARGUMENT, ENTIRE_STRUCT_SIZE.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_plan(
    session: *mut entire_session,
    frame: *const entire_frame,
    target_seconds: f32,
    plan: *mut entire_plan,
) -> entire_result {
    entry!(changing(session, |state| {
        check_output(plan)?;
        let frame = read_struct(frame)?.checked(state.radius())?;
        let made = state.session.plan(&frame, target_seconds)?;
        write_struct(plan, &kept(&mut state.session, made)?)
    }))
}

/// Chooses one of the caller's settings, which are sorted by quality, best first. Takes the first setting
/// that is expected to meet the target and whose upper bound is at most (1 + tolerance) times the target. If
/// there is none, takes the setting with the shortest expected time. There may be at most ENTIRE_MAX_SETTINGS
/// settings. `index` receives the index of the chosen setting, and `plan` its plan; pass the frame's time to
/// entire_session_observe. The frame's own step must be in range, but is ignored; the frame's width and
/// height give the aspect ratio of all settings, and a change of its size or modes counts as a change of the
/// scene. Does not allocate.
///
/// Fails as entire_session_plan does, with ENTIRE_INVALID_ARGUMENT if there is no setting or one that is out
/// of range, and with ENTIRE_SIZE_MISMATCH for more than ENTIRE_MAX_SETTINGS settings.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_choose(
    session: *mut entire_session,
    frame: *const entire_frame,
    settings: *const entire_setting,
    setting_count: usize,
    target_seconds: f32,
    index: *mut usize,
    plan: *mut entire_plan,
) -> entire_result {
    entry!(changing(session, |state| {
        check_output(plan)?;
        check_pointer(index, "index (output)")?;
        let frame = read_struct(frame)?.checked(state.radius())?;
        if setting_count > ENTIRE_MAX_SETTINGS {
            refuse!(
                ENTIRE_SIZE_MISMATCH,
                "setting_count is {setting_count}; at most {ENTIRE_MAX_SETTINGS} (ENTIRE_MAX_SETTINGS) \
                 is accepted"
            );
        }
        let given = slice(settings, setting_count, "settings")?;
        let mut settings = [entire_steer::features::Setting::from(&frame); ENTIRE_MAX_SETTINGS];
        for (slot, setting) in settings.iter_mut().zip(given) {
            *slot = setting.checked()?;
        }
        let (chosen, made) = state.session.choose(&frame, &settings[..setting_count], target_seconds)?;
        let made = kept(&mut state.session, made)?;
        write(index, chosen, "index (output)")?;
        write_struct(plan, &made)
    }))
}
