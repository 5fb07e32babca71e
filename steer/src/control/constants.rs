//! The constants of the hybrid controller that recorded paths decide.

crate::adapt::constants! {
    /// Constants of [`Hybrid`](super::Hybrid). The defaults follow from a search over recorded paths
    /// (`entire-lab tune`); nothing needs to be set.
    HybridConstants {
        /// A step this near to the finest one, in ln(step), is the finest one where that is expected to meet the
        /// target: it would save little, and the picture would no longer be that of full quality.
        full = 0.4,
        /// Largest move of the step in a calm frame, in ln(step): to a finer one, and to a coarser one where the
        /// expected time stays within the target.
        damping = 0.16,
        /// Standard deviation of the predicted step curve's slope, d ln(seconds) / d ln(step).
        slope_sd = 0.1,
        /// Distance of two predictions at one step from which the frame before says nothing.
        far = 0.35,
        /// Margin before any frame was seen, in standard deviations.
        margin_start = 2.0,
    }
}
