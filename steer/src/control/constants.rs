//! Constants of the hybrid controller, tuned on recorded paths.

crate::adapt::constants! {
    /// Constants of the default controller. The defaults come from a search over recorded paths
    /// (`entire-lab tune`); callers need not set any.
    HybridConstants {
        /// Limit of ln(s / f), where s is the finest step whose bound is within the tolerance, and f is the
        /// finest allowed step. Up to this limit, f is drawn instead of s if f is expected to meet the
        /// target, because s would save little time and lose full quality.
        full = 0.4,
        /// Largest change of the step in a calm frame, in ln(step). It limits changes to a finer step, except
        /// to the finest allowed step. It limits a change to a coarser step only if the limited step is
        /// expected to meet the target.
        damping = 0.16,
        /// Standard deviation of the slope of the predicted step curve, d ln(seconds) / d ln(step).
        slope_sd = 0.1,
        /// Distance between the predictions of two successive frames at one step, in ln(time) plus shares of
        /// the time, at or above which the frames count as unrelated.
        far = 0.35,
        /// Initial margin, in standard deviations.
        margin_start = 2.0,
    }
}
