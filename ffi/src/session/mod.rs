//! `entire_session`: plan, draw, observe, for one render loop.

mod calibrate;
mod observe;
mod options;
mod plan;
mod settings;
mod state;

#[cfg(test)]
pub(crate) use {calibrate::*, observe::*, options::*, plan::*, settings::*, state::*};

use crate::abi::{ByValue, read_struct};
use crate::guard::{entry, freeing, making};
use crate::handle::{Held, borrow, handle};
use crate::model::{entire_model, share};
use crate::result::entire_result::{self, *};
use crate::result::{Failure, refuse};
use entire_steer::control::{Session, StepLimits};
use entire_steer::predict::{AnalyticModel, Predictor};
use glam::Vec3;
use options::{entire_session_options, hybrid_options, probe_of};
use std::sync::Arc;

/// Predicts and steers one render loop. For one thread at a time; make one session for every loop.
pub struct entire_session(Held<Loop>);

pub(crate) struct Loop {
    session: Session,
    model: Option<Arc<entire_model>>,
    /// Spacing and bounding-sphere radius of the current volume.
    volume: Option<(Vec3, f32)>,
    /// Options that the session was made with.
    options: entire_session_options,
}

handle!(entire_session, Loop);

impl Loop {
    fn radius(&self) -> Option<f32> {
        self.volume.map(|(_, radius)| radius)
    }
}

/// Makes a session for one render loop. If `model` is NULL, an analytic model (unit costs times estimated
/// work) predicts and adapts to the device with the first observed frames. `options` may be NULL for the
/// defaults. The session holds a reference to the model.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (step limits, rates or probe settings that are out of range),
/// ENTIRE_UNSUPPORTED (a model without a prediction network, or with a scene feature or order of lobes that
/// this version does not know), ENTIRE_MISSING_INPUT (a model with an input group that this version does not
/// know), ENTIRE_INVALID_MODEL (a model whose metadata are damaged), ENTIRE_PANIC (a model handle that is
/// unusable), ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT, ENTIRE_STRUCT_SIZE.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_new(
    model: *const entire_model,
    options: *const entire_session_options,
    session: *mut *mut entire_session,
) -> entire_result {
    entry!(making(session, "session (output)", || {
        let options = if options.is_null() { ByValue::defaults() } else { read_struct(options)? };
        if options.reserved != 0 {
            refuse!(
                ENTIRE_INVALID_ARGUMENT,
                "entire_session_options.reserved must be 0; call entire_session_options_init"
            );
        }
        let limits = StepLimits { finest: options.finest_step, coarsest: options.coarsest_step };
        limits.check()?;
        let predicts: Box<dyn Predictor + Send> =
            if model.is_null() { Box::new(AnalyticModel::default()) } else { borrow(model)?.predictor()? };
        let model = if model.is_null() { None } else { Some(share(model)) };
        let mut made = Session::new(predicts, hybrid_options(&options))?;
        if let Some((side, tolerance)) = probe_of(&options) {
            made = made.with_probe(side, tolerance)?;
        }
        made.set_limits(limits)?;
        Ok(Loop { session: made, model, volume: None, options })
    }))
}

/// Frees a session; NULL does nothing.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_free(session: *mut entire_session) {
    entry!(freeing(session))
}

/// Panics on purpose, for the test of the panic boundary.
#[cfg(feature = "test-panic")]
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_test_panic(session: *mut entire_session) -> entire_result {
    entry!(crate::guard::changing(session, |state| panic!("deliberate, with radius {:?}", state.radius())))
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
