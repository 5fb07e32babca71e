//! Options of a session, and their checks.

use crate::abi::{by_value, init_struct};
use crate::guard::{entry, guard};
use crate::result::entire_result;
use entire_steer::control::{HybridOptions, StepLimits};
use entire_steer::features::PROBE_SIDE;

/// Options of a session. Fill with entire_session_options_init, then set what differs.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_session_options {
    /// sizeof(entire_session_options).
    pub struct_size: usize,
    /// Finest ray step that may be chosen, in multiples of the reference step, at least 1/64; default 1.
    pub finest_step: f32,
    /// Coarsest ray step that may be chosen, in multiples of the reference step, at most 4096; default 16.
    pub coarsest_step: f32,
    /// Share of calm frames (without a scene change) that may exceed their upper bound, over 0 and at most
    /// 0.5; default 0.05. Of the frames that no other program slows down, a share below `miss_rate` exceeds
    /// (1 + `tolerance`) * target, since many bounds are below that limit.
    pub miss_rate: f32,
    /// Share of the target by which the upper bound for undisturbed frames (frames that no other program
    /// slows down) may exceed the target, not negative; default 0.1.
    pub tolerance: f32,
    /// Out-of-range score above which steps are chosen from recent frames instead of the prediction,
    /// positive; default 2.
    pub trust_limit: f32,
    /// Not 0 if the step changes only slowly while nothing in the scene changes abruptly; default 1.
    pub damping: u32,
    /// Number of rays along each side of the probe that measures frames for an analytic model (also if no
    /// model is given), 1 to 24. The time to make a plan is proportional to the square of the side; fewer
    /// rays estimate the frame less exactly. Default 0: the side in the model's file, or 11 if there is none.
    /// Networks always use the side in their file, which they were trained with.
    pub probe_side: u32,
    /// Accepted error of the probe, as a share of the frame's time, 0 to 1. Over 0, plans start with a probe
    /// of 4 rays along each side and refine it, up to `probe_side` (0: 11), only if the probe's estimated
    /// error is larger than `probe_tolerance` and could change the plan. While the view has hardly turned
    /// since rays were cast, their result is reused. Default 0: every plan casts all of its rays. Networks
    /// always use their own probe. While frames are recorded (entire_session_record), every plan casts all of
    /// its rays.
    pub probe_tolerance: f32,
    /// Not 0 if the picture keeps its quality while other programs slow frames down: steps are chosen as
    /// without this load, so frames exceed the target. entire_plan.seconds includes the load. If the load
    /// lasts longer than 32 frames, the slower speed counts as the machine's normal speed from then on, and
    /// steps are chosen for it. Default 0.
    pub ignore_load: u32,
    /// Must be 0.
    pub reserved: u32,
}

by_value!(entire_session_options {
    finest_step: StepLimits::default().finest,
    coarsest_step: StepLimits::default().coarsest,
    miss_rate: HybridOptions::default().miss_rate,
    tolerance: HybridOptions::default().tolerance,
    trust_limit: HybridOptions::default().trust_limit,
    damping: HybridOptions::default().damping.into(),
    probe_side: 0,
    probe_tolerance: 0.0,
    ignore_load: HybridOptions::default().ignore_load.into(),
    reserved: 0,
});

/// The probe that the options request: number of rays along each side, and its accepted error. `None` keeps
/// the predictor's own probe.
pub(super) fn probe_of(options: &entire_session_options) -> Option<(usize, Option<f32>)> {
    let tolerance = (options.probe_tolerance != 0.0).then_some(options.probe_tolerance);
    match options.probe_side {
        0 if tolerance.is_none() => None,
        0 => Some((PROBE_SIDE, tolerance)),
        side => Some((side as usize, tolerance)),
    }
}

/// Fills session options with their defaults; `struct_size` is sizeof(entire_session_options).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_session_options_init(
    options: *mut entire_session_options,
    struct_size: usize,
) -> entire_result {
    entry!(guard(|| init_struct(options, struct_size)))
}

pub(super) fn hybrid_options(options: &entire_session_options) -> HybridOptions {
    let entire_session_options { miss_rate, tolerance, trust_limit, .. } = *options;
    let (damping, ignore_load) = (options.damping != 0, options.ignore_load != 0);
    let defaults = HybridOptions::default();
    HybridOptions { miss_rate, tolerance, trust_limit, damping, ignore_load, ..defaults }
}
