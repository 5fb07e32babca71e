//! The constants of the hybrid controller that recorded paths decide.

crate::adapt::constants! {
    /// Constants of [`Hybrid`](super::Hybrid). The defaults follow from a search over recorded paths
    /// (`entire-lab tune`); nothing needs to be set.
    HybridConstants {
        /// Relative changes of the step, or distances of the expected time from the target, below which the step
        /// is kept.
        dead_band = 0.01,
        /// A step this near to the finest one, in ln(step), is the finest one where that is expected to meet the
        /// target: it would save little, and the picture would no longer be that of full quality.
        full = 0.14,
        /// As `full`, where the scene has been seen for some frames.
        full_settled = 0.14,
        /// Largest move to a finer step in a calm frame, in ln(step), beside what the prediction calls for.
        finer = 0.16,
        /// Largest move to a coarser step in a calm frame where the expected time stays within the target, in
        /// ln(step).
        coarser = 0.17,
        /// Time over the target of the frame before, below which moves to finer steps are not bounded.
        early = 0.5,
        /// Share of the excess, in ln(time), by which the step grows at least after two late frames.
        take_back = 0.5,
        /// Standard deviation of the predicted step curve's slope, d ln(seconds) / d ln(step).
        slope_sd = 0.1,
        /// Distance of two predictions at one step from which the frame before says nothing.
        far = 0.35,
        /// Distance that frames of one scene may have without being announced as changed.
        near = 0.12,
        /// Novelty from which a frame is the first of a new scene.
        novel = 0.3,
        /// Novelty that an announced change after calm frames has at least.
        announced = 0.5,
        /// Margin of calm frames before any was seen.
        calm_start = 2.0,
        /// How fast the margin of calm frames moves.
        calm_pace = 0.05,
        /// Margin of new scenes before any was seen: errors among scenes have heavy tails.
        changed_start = 2.5,
        /// How fast the margin of new scenes moves.
        changed_pace = 0.3,
        /// Share of a predicted change that is believed before any proved true.
        believed_start = 0.4,
        /// How fast that share follows what proves true.
        believed_pace = 0.04,
        /// How fast the mean square of the predicted changes moves, by which that pace is divided.
        power_pace = 0.1,
        /// Share of a frame's time that does not fall with the step, where recent frames alone decide.
        fixed_share = 0.1,
        /// Slowest pace at which the errors of prediction and of recent frames are followed.
        history_pace = 0.08,
        /// Mean error of the prediction, in ln(time), from which recent frames may lead.
        history_error = 0.15,
        /// How many times the error of recent frames it must be.
        history_lead = 1.5,
    }
}
