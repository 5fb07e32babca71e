//! Inputs of a session: volume, transfer function, limits, and changes that the caller announces.

use super::{check_flags, entire_session};
use crate::abi::{check_pointer, write};
use crate::guard::{changing, entry, reading};
use crate::handle::{Handle, borrow};
use crate::reserve;
use crate::result::entire_result;
use crate::transfer::{UnitDistance, entire_transfer_function};
use crate::volume::entire_volume;
use entire_core::scene::TransferFunction;
use entire_steer::control::{Quality, StepLimits};
use entire_steer::features::Changes;

/// Change flag: a pipeline was built, or the device changed.
pub const ENTIRE_CHANGE_FIRST: u32 = 1;
/// Change flag: the transfer function changed.
pub const ENTIRE_CHANGE_TRANSFER_FUNCTION: u32 = 2;
/// Change flag: the volume changed.
pub const ENTIRE_CHANGE_VOLUME: u32 = 4;
/// Change flag: the image size changed.
pub const ENTIRE_CHANGE_SIZE: u32 = 8;
/// Change flag: shading, skipping or termination changed.
pub const ENTIRE_CHANGE_MODE: u32 = 16;
/// Change flag: the camera jumped.
pub const ENTIRE_CHANGE_CAMERA: u32 = 32;

/// Sets the volume. The first session that uses a volume scans its voxels once. If the model takes volume
/// features, the precomputed ones are used (entire_volume_set_features), else the model's encoder encodes the
/// voxels, which takes milliseconds to seconds. The transfer function must be set again.
///
/// Fails with ENTIRE_SIZE_MISMATCH (the number of precomputed features is not the model's), ENTIRE_NOT_READY
/// (the model needs features, and there are neither precomputed ones nor voxels), ENTIRE_UNSUPPORTED (the
/// model needs features and has no encoder), ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_set_volume(
    session: *mut entire_session,
    volume: *const entire_volume,
) -> entire_result {
    entry!(changing(session, |state| {
        reserve::check()?;
        let volume = borrow(volume)?;
        let summary = volume.summary()?;
        let features = match &state.model {
            Some(model) => model.held().value.features_of(volume)?,
            None => None,
        };
        let kept = summary.try_clone()?;
        state.volume = Some((kept.shape().spacing, kept.shape().bounding_radius));
        state.session.set_volume(kept, features);
        Ok(())
    }))
}

/// Sets the next time step of the session's volume, after entire_volume_update. The transfer function and the
/// correction learned from observed frames stay. The time step does not count as a change of the scene; if
/// the next frame includes an upload, call entire_session_mark. If the model takes volume features, those of
/// the previous time step stay unless the volume has precomputed ones.
///
/// Fails with ENTIRE_NOT_READY (no volume was set), ENTIRE_SIZE_MISMATCH (sizes, spacing or bricks that are
/// not those of the session's volume, a number of precomputed features that is not the model's),
/// ENTIRE_INVALID_ARGUMENT (a scalar type that is not that of the session's volume), ENTIRE_OUT_OF_MEMORY,
/// ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_set_time_step(
    session: *mut entire_session,
    volume: *const entire_volume,
) -> entire_result {
    entry!(changing(session, |state| {
        reserve::check()?;
        let volume = borrow(volume)?;
        let features = match &state.model {
            Some(model) if volume.features.is_some() => model.held().value.features_of(volume)?,
            _ => None,
        };
        Ok(state.session.set_time_step(volume.summary()?.try_clone()?, features)?)
    }))
}

/// Sets the transfer function. The volume must be set before it.
///
/// Fails with ENTIRE_NOT_READY (no volume), ENTIRE_INVALID_ARGUMENT (a unit distance that is out of range for
/// this volume), ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_set_transfer_function(
    session: *mut entire_session,
    transfer_function: *const entire_transfer_function,
) -> entire_result {
    entry!(changing(session, |state| {
        reserve::check()?;
        let transfer = borrow(transfer_function)?;
        let table = transfer.table.clone();
        let table = match (transfer.unit, state.volume) {
            (UnitDistance::ReferenceSteps(distance), _) => table.with_unit_distance(distance)?,
            (UnitDistance::World(distance), Some((spacing, _))) => {
                table.with_unit_distance(distance / spacing.min_element())?
            }
            // Without a volume, set_transfer below fails.
            (UnitDistance::World(_), None) => table,
        };
        let lobes = match &transfer.function {
            TransferFunction::Gaussian(lobes) => Some(lobes.as_slice()),
            _ => None,
        };
        Ok(state.session.set_transfer(&table, lobes)?)
    }))
}

/// Sets the steps that may be chosen, in multiples of the reference step.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (steps that do not satisfy 1/64 <= finest <= coarsest <= 4096),
/// ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_set_limits(
    session: *mut entire_session,
    finest_step: f32,
    coarsest_step: f32,
) -> entire_result {
    entry!(changing(session, |state| {
        Ok(state.session.set_limits(StepLimits { finest: finest_step, coarsest: coarsest_step })?)
    }))
}

/// Allows plans to coarsen the image: neighboring rays are up to `max_image_sample_distance` pixels apart
/// along each side of the image, 1 to 64 (VTK's ImageSampleDistance). Plans then coarsen ray step and image
/// together (`step` and `image_sample_distance` in entire_plan), which changes the picture less than
/// coarsening one of them alone. Up to a step of `step_alone` (1 to 64) times the finest, only the step is
/// coarsened. Use 1, or about 2 if the renderer blurs smaller images strongly. A `max_image_sample_distance`
/// of 1, the default, keeps the full image size. The model must be an analytic model, or a network that has
/// the image size among its inputs. One plan covers all sizes, which is cheaper and corrects predictions
/// better than one plan per size.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a number outside 1 to 64), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_set_max_image_sample_distance(
    session: *mut entire_session,
    max_image_sample_distance: f32,
    step_alone: f32,
) -> entire_result {
    entry!(changing(session, |state| {
        Ok(state.session.set_max_image_sample_distance(max_image_sample_distance, step_alone)?)
    }))
}

/// Sets the quality law of this renderer (picture error as a function of ray step and image size), so that
/// plans coarsen step or image, whichever adds less error. With a step of s times the finest, and rays d
/// pixels apart along each side, a power of the picture error is proportional to (s - 1)^step_exponent +
/// image_weight * (d - 1)^image_exponent, and the time is proportional to (ray_share + (1 - ray_share) / s) /
/// d^2. Fit the four numbers to pictures of this renderer. The law replaces `step_alone` of
/// entire_session_set_max_image_sample_distance. An `image_weight` of 0 removes the law: the session then
/// uses the law of its model, if the model was calibrated with pictures of this renderer, else the built-in
/// law.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (a weight that is neither 0 nor 1e-3 to 1e3, an exponent outside 0.05
/// to 8, a share outside 0 to 0.9), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_set_quality(
    session: *mut entire_session,
    image_weight: f32,
    step_exponent: f32,
    image_exponent: f32,
    ray_share: f32,
) -> entire_result {
    let known = Quality { image_weight, step_exponent, image_exponent, ray_share };
    entry!(changing(session, |state| Ok(state
        .session
        .set_quality((image_weight != 0.0).then_some(known))?)))
}

/// Reads the quality law that plans use. A law of entire_session_set_quality comes first. Without it, plans
/// use the model's law (from entire_session_record_picture or `entire calibrate`), if the model was
/// calibrated with the renderer that entire_session_set_timing_source names, or if no renderer is named.
/// Otherwise, plans use the built-in law of the named renderer (the class names of VTK's fixed-point and GPU
/// mapper, or `vulkan` or `cpu` for the raycaster). All four numbers are 0 if there is no law.
///
/// Fails with ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_quality(
    session: *const entire_session,
    image_weight: *mut f32,
    step_exponent: *mut f32,
    image_exponent: *mut f32,
    ray_share: *mut f32,
) -> entire_result {
    entry!(reading(session, |state| {
        let known = state
            .session
            .quality()
            .map_or([0.0; 4], |q| [q.image_weight, q.step_exponent, q.image_exponent, q.ray_share]);
        let outputs = [
            (image_weight, "image_weight (output)"),
            (step_exponent, "step_exponent (output)"),
            (image_exponent, "image_exponent (output)"),
            (ray_share, "ray_share (output)"),
        ];
        for (output, name) in outputs {
            check_pointer(output, name)?;
        }
        for ((output, name), value) in outputs.into_iter().zip(known) {
            write(output, value, name)?;
        }
        Ok(())
    }))
}

/// Switches steering off (0: every plan returns the frame's own step; for screenshots and still renders) or
/// on again. Observations correct predictions in both cases.
///
/// Fails with ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_set_enabled(
    session: *mut entire_session,
    enabled: u32,
) -> entire_result {
    entry!(changing(session, |state| {
        state.session.set_enabled(enabled != 0);
        Ok(())
    }))
}

/// States the processor seconds of the renderer's process, over all of its threads, in the frame of the next
/// call of entire_session_observe, for a renderer that runs on the processor and is observed by wall time. If
/// other programs take processors away, this time falls relative to the wall time, and the session follows
/// after one slow frame instead of two. A value that is not finite and positive counts as unknown.
///
/// Fails with ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_set_processor_seconds(
    session: *mut entire_session,
    seconds: f32,
) -> entire_result {
    entry!(changing(session, |state| {
        state.session.set_processor_seconds(seconds);
        Ok(())
    }))
}

/// Announces that the next frame differs abruptly from the previous one in a way that the session cannot
/// detect: flags ENTIRE_CHANGE_*. Changes of volume, transfer function, image size and mode are detected
/// without this call.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (an unknown flag), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_mark(session: *mut entire_session, changes: u32) -> entire_result {
    const KNOWN_FLAGS: u32 = ENTIRE_CHANGE_FIRST
        | ENTIRE_CHANGE_TRANSFER_FUNCTION
        | ENTIRE_CHANGE_VOLUME
        | ENTIRE_CHANGE_SIZE
        | ENTIRE_CHANGE_MODE
        | ENTIRE_CHANGE_CAMERA;
    entry!(changing(session, |state| {
        check_flags("changes", changes, KNOWN_FLAGS)?;
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
    }))
}
