//! The constants of the hybrid controller that recorded paths decide.

macro_rules! constants {
    ($($(#[$doc:meta])* $name:ident = $value:expr,)*) => {
        /// Constants of [`Hybrid`](super::Hybrid). The defaults follow from a search over recorded paths
        /// (`entire-lab tune`); nothing needs to be set.
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub struct HybridConstants {
            $($(#[$doc])* pub $name: f64,)*
        }

        impl Default for HybridConstants {
            fn default() -> Self {
                Self { $($name: $value,)* }
            }
        }

        impl HybridConstants {
            /// Names in the order of [`HybridConstants::values`].
            pub const NAMES: &'static [&'static str] = &[$(stringify!($name),)*];

            /// Every constant in turn, to read or to change.
            pub fn values(&mut self) -> [&mut f64; Self::NAMES.len()] {
                [$(&mut self.$name,)*]
            }
        }
    };
}

constants! {
    /// Relative changes of the step, or distances of the expected time from the target, below which the step
    /// is kept.
    dead_band = 0.01,
    /// A step this near to the finest one, in ln(step), is the finest one where that is expected to meet the
    /// target: it would save next to nothing.
    full = 0.05,
    /// Largest move to a finer step in a calm frame, in ln(step), beside what the prediction calls for.
    finer = 0.16,
    /// Largest move to a coarser step in a calm frame where the expected time stays within the target, in
    /// ln(step).
    coarser = 0.17,
    /// Standard deviation of the predicted step curve's slope, d ln(seconds) / d ln(step).
    slope_sd = 0.1,
    /// Distance of two predictions at one step from which the frame before says nothing.
    far = 0.35,
    /// Distance that frames of one scene may have without being announced as changed.
    near = 0.12,
    /// Novelty from which a frame is the first of a new scene.
    novel = 0.3,
    /// How fast the margin of calm frames moves.
    calm_pace = 0.05,
    /// Margin of new scenes before any was seen: errors among scenes have heavy tails.
    changed_start = 2.5,
    /// Standard deviation of ln of every unit cost about their common factor, where the machine was never
    /// measured.
    unit_cost_sd = 1.0,
    /// How fast the margin of new scenes moves.
    changed_pace = 0.3,
}
