//! Measured times of planned frames.

use super::{check_flags, entire_session};
use crate::abi::{check_pointer, write};
use crate::guard::{changing, entry};
use crate::result::Failure;
use crate::result::entire_result;
use entire_steer::control::{ObserveFlags, Verdict};

const _: () = {
    assert!(ENTIRE_VERDICT_LEARNED == Verdict::Learned as u32);
    assert!(ENTIRE_VERDICT_CLIPPED == Verdict::Clipped as u32);
    assert!(ENTIRE_VERDICT_IGNORED == Verdict::Ignored as u32);
};

/// Effect of an observation that was not refused: one of the `ENTIRE_VERDICT_*` numbers.
pub type entire_verdict = u32;
/// Used to correct predictions.
pub const ENTIRE_VERDICT_LEARNED: entire_verdict = 0;
/// The time is far from the expected one, so its influence on the correction was limited.
pub const ENTIRE_VERDICT_CLIPPED: entire_verdict = 1;
/// Not used to correct predictions: the frame was unusual, was cancelled no later than its expected end, or
/// had no prediction.
pub const ENTIRE_VERDICT_IGNORED: entire_verdict = 2;

/// Observation flag: the time includes work that most frames do not include (a compilation, an upload, a
/// stall).
pub const ENTIRE_OBSERVE_UNUSUAL: u32 = 1;
/// Observation flag: the frame was abandoned; its time is only a lower bound.
pub const ENTIRE_OBSERVE_CANCELLED: u32 = 2;

/// Reports the measured time of a planned frame. The report may come late, as long as the plan is among the
/// last 64. `flags`: ENTIRE_OBSERVE_* or 0. `verdict` may be NULL. Does not allocate when it succeeds.
///
/// Fails with ENTIRE_REJECTED_OBSERVATION (an unknown or forgotten plan, a plan that was observed before, a
/// time that is not finite, is not positive, or is over 10000 s; nothing is learned), ENTIRE_INVALID_ARGUMENT
/// (an unknown flag), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_observe(
    session: *mut entire_session,
    plan_id: u64,
    seconds: f32,
    flags: u32,
    verdict: *mut entire_verdict,
) -> entire_result {
    entry!(changing(session, |state| {
        check_flags("flags", flags, ENTIRE_OBSERVE_UNUSUAL | ENTIRE_OBSERVE_CANCELLED)?;
        if !verdict.is_null() {
            check_pointer(verdict, "verdict (output)")?;
        }
        let noted = ObserveFlags {
            unusual: flags & ENTIRE_OBSERVE_UNUSUAL != 0,
            cancelled: flags & ENTIRE_OBSERVE_CANCELLED != 0,
        };
        let found = state
            .session
            .observe(plan_id, seconds, noted)
            .map_err(|e| Failure::from(e).within(format_args!("{seconds} s for plan {plan_id}")))?;
        if !verdict.is_null() {
            write(verdict, found as u32, "verdict (output)")?;
        }
        Ok(())
    }))
}

/// Withdraws the newest plan. Call this function if no frame was drawn with the plan, for example because the
/// volume is outside of the view. The next plan then gets the id of the withdrawn plan, and knows all changes
/// since the last drawn frame. Has no effect on an older or an observed plan, nor on the plan before a
/// withdrawn one.
///
/// Fails with ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_withdraw(
    session: *mut entire_session,
    plan_id: u64,
) -> entire_result {
    entry!(changing(session, |state| {
        state.session.withdraw(plan_id);
        Ok(())
    }))
}

/// Forgets every observation and every pending plan; volume, transfer function and limits stay.
///
/// Fails with ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_reset(session: *mut entire_session) -> entire_result {
    entry!(changing(session, |state| {
        state.session.reset();
        Ok(())
    }))
}
