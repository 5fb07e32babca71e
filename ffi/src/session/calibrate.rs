//! Fits a model of the host's own renderer to frames that a session planned and observed.

use super::entire_session;
use super::options::hybrid_options;
use crate::abi::{ByValue, by_value, check_output, check_pointer, write, write_struct};
use crate::guard::{changing, entry, reading};
use crate::handle::{borrow, give};
use crate::model::{entire_model, load, share};
use crate::reserve;
use crate::result::entire_result;
use entire_steer::calibrate::{HeldOut, Picture};

/// Unit by which a calibration held out frames to estimate its error (cross-validation): one of the
/// `ENTIRE_HELD_OUT_*` numbers.
pub type entire_held_out = u32;
/// Nothing, since there were too few frames: the error is that of the training frames.
pub const ENTIRE_HELD_OUT_NOTHING: entire_held_out = 0;
/// Volumes: the error is measured on volumes that no training frame shows.
pub const ENTIRE_HELD_OUT_VOLUMES: entire_held_out = 1;
/// Transfer functions: the error is measured on the training volumes, with transfer functions that no training
/// frame has.
pub const ENTIRE_HELD_OUT_TRANSFER_FUNCTIONS: entire_held_out = 2;
/// Time intervals: the error is that of new views of the training volumes under the training transfer
/// functions.
pub const ENTIRE_HELD_OUT_STRETCHES: entire_held_out = 3;

const _: () = assert!(
    HeldOut::Nothing as u32 == ENTIRE_HELD_OUT_NOTHING
        && HeldOut::Volumes as u32 == ENTIRE_HELD_OUT_VOLUMES
        && HeldOut::TransferFunctions as u32 == ENTIRE_HELD_OUT_TRANSFER_FUNCTIONS
        && HeldOut::Stretches as u32 == ENTIRE_HELD_OUT_STRETCHES
);

/// Report on a model that entire_session_calibrate made. Set struct_size before the call.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_calibration_report {
    /// sizeof(entire_calibration_report).
    pub struct_size: usize,
    /// Frames that the model was fitted to.
    pub frames: usize,
    /// Median of |predicted / measured - 1| over held-out frames.
    pub median_error: f64,
    /// Root mean square error in seconds over held-out frames, divided by the standard deviation of their
    /// times; NaN if all of these times are equal.
    pub rmse_over_sd: f64,
    /// Upper bound divided by prediction: 19 of 20 frames take no longer than this bound.
    pub upper_factor: f64,
    /// Unit by which frames were held out: one of ENTIRE_HELD_OUT_*.
    pub held_out: entire_held_out,
    /// Number of scenes of entire_session_record_picture that the model's quality law was fitted to. 0 if
    /// there were too few; the model then has no quality law.
    pub scenes: u32,
}

by_value!(entire_calibration_report {
    frames: 0,
    median_error: 0.0,
    rmse_over_sd: 0.0,
    upper_factor: 1.0,
    held_out: ENTIRE_HELD_OUT_NOTHING,
    scenes: 0,
});

/// Starts to record frames that are planned and observed, for entire_session_calibrate. The session keeps a
/// uniform random sample of `frame_count` frames (8 to 65536). Earlier recordings are discarded. Planning and
/// observing still do not allocate.
///
/// `prior` is the model to start from: unit costs that were fitted on another machine or renderer, such as
/// models/unshaded-selected.safetensors. NULL starts from the unit costs of a software renderer. Not recorded
/// are unusual and cancelled observations, the first frame of the session and of each volume, the first frame
/// after the session's learned state was loaded or forgotten, and a frame for which entire_session_mark
/// announced ENTIRE_CHANGE_FIRST or ENTIRE_CHANGE_VOLUME.
///
/// To calibrate from a log of frames that were timed earlier: with steering off (entire_session_set_enabled),
/// plan every frame as it was drawn, and observe its time.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a frame count outside 8 to 65536), ENTIRE_UNSUPPORTED (a prior that is
/// not an analytic model), ENTIRE_INVALID_MODEL (a prior whose metadata are damaged), ENTIRE_OUT_OF_MEMORY,
/// ENTIRE_PANIC (a model handle that is unusable), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_record(
    session: *mut entire_session,
    prior: *const entire_model,
    frame_count: usize,
) -> entire_result {
    entry!(changing(session, |state| {
        reserve::check()?;
        let prior = if prior.is_null() { None } else { Some(borrow(prior)?.file()?) };
        Ok(state.session.record(prior.as_ref(), frame_count)?)
    }))
}

/// Fits a model of the renderer and the machine to the frames that were recorded since entire_session_record.
/// The fit takes a second or less for 500 frames, on the calling thread. `report` may be NULL; else set
/// report->struct_size first. The session does not use the model until entire_session_set_model, and
/// continues to record. entire_model_save saves the model for later runs. The names of
/// entire_session_set_timing_source are written to the model's metadata.
///
/// Fails with ENTIRE_NOT_READY (nothing was recorded, or fewer than 8 frames), ENTIRE_INVALID_ARGUMENT (a fit
/// to these frames predicts a time that is not finite), ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT,
/// ENTIRE_STRUCT_SIZE.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_calibrate(
    session: *const entire_session,
    model: *mut *mut entire_model,
    report: *mut entire_calibration_report,
) -> entire_result {
    entry!(reading(session, |state| {
        check_pointer(model, "model (output)")?;
        if !report.is_null() {
            check_output(report)?;
        }
        reserve::check()?;
        let made = state.session.calibrate()?;
        write(model, give(load(&made.file.to_bytes()?, "calibrated model")?), "model (output)")?;
        if !report.is_null() {
            let out = entire_calibration_report {
                frames: made.frames,
                median_error: made.median_error,
                rmse_over_sd: made.rmse_over_sd,
                upper_factor: f64::from(made.upper.factor()),
                held_out: made.held_out as u32,
                scenes: made.quality.map_or(0, |q| u32::try_from(q.scenes).unwrap_or(u32::MAX)),
                ..ByValue::defaults()
            };
            write_struct(report, &out)?;
        }
        Ok(())
    }))
}

/// Records the error of a picture against the same view at full quality, for entire_session_calibrate. The
/// model then contains this renderer's quality law (picture error as a function of ray step and image size),
/// and sessions that steer this renderer with this model coarsen the ray step or the image size, whichever
/// adds less error. Draw at least 3 scenes, all at the same settings. `scene` is a number that identifies the
/// view, `step` is the ray step in multiples of the finest, `image_sample_distance` is the distance of
/// neighboring rays in pixels, and `seconds` is the time that the drawing took. Include full quality (`step`
/// 1, `image_sample_distance` 1, `error` 0), coarser steps alone, smaller images alone, and both. `error` is
/// any measure that is 0 for equal pictures and grows with the difference, such as the root mean squared
/// difference of colors, or 1 - SSIM. Enlarge smaller pictures to full size before the comparison. The first
/// 65536 pictures are kept.
///
/// Fails with ENTIRE_NOT_READY (before entire_session_record), ENTIRE_INVALID_ARGUMENT (a step or distance
/// below 1, seconds that are not positive, a negative error, numbers that are not finite),
/// ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_record_picture(
    session: *mut entire_session,
    scene: u64,
    step: f32,
    image_sample_distance: f32,
    seconds: f64,
    error: f64,
) -> entire_result {
    let picture = Picture { scene, step, distance: image_sample_distance, seconds, error };
    entry!(changing(session, |state| {
        reserve::check()?;
        Ok(state.session.record_picture(picture)?)
    }))
}

/// Number of frames kept since entire_session_record; 0 before it.
///
/// Fails with ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_recorded_count(
    session: *const entire_session,
    frame_count: *mut usize,
) -> entire_result {
    entry!(reading(session, |state| {
        write(frame_count, state.session.recorded().unwrap_or(0), "frame_count (output)")
    }))
}

/// Replaces the session's model, keeping the options that the session was made with. Observations are
/// forgotten; volume, transfer function and limits stay. Recorded frames are discarded only if the number of
/// probe rays changes with the model. If the model takes volume features, set the volume again. The session
/// holds a reference to the model.
///
/// Fails for a model as entire_session_new does, and with ENTIRE_OUT_OF_MEMORY and ENTIRE_NULL_ARGUMENT
/// (`model` may not be NULL here).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_set_model(
    session: *mut entire_session,
    model: *const entire_model,
) -> entire_result {
    entry!(changing(session, |state| {
        reserve::check()?;
        let predictor = borrow(model)?.predictor()?;
        state.session.set_predictor(predictor, hybrid_options(&state.options))?;
        state.model = Some(share(model));
        Ok(())
    }))
}
