//! The constants of the correction that recorded paths decide.

/// A struct of constants, each with its default, that a search can go through by number.
macro_rules! constants {
    ($(#[$whole:meta])* $group:ident { $($(#[$doc:meta])* $name:ident = $value:expr,)* }) => {
        $(#[$whole])*
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub struct $group {
            $($(#[$doc])* pub $name: f64,)*
        }

        impl Default for $group {
            fn default() -> Self {
                Self { $($name: $value,)* }
            }
        }

        impl $group {
            /// Names in the order of `values`.
            pub const NAMES: &'static [&'static str] = &[$(stringify!($name),)*];

            /// Every constant in turn, to read or to change.
            pub fn values(&mut self) -> [&mut f64; Self::NAMES.len()] {
                [$(&mut self.$name,)*]
            }
        }
    };
}
pub(crate) use constants;

constants! {
    /// Constants of the online correction: what it takes a machine and its scenes for before it has seen them, and
    /// how fast it learns. The defaults follow from a search over recorded paths (`entire-lab tune`); nothing needs
    /// to be set.
    CorrectionConstants {
        /// Standard deviation of ln of every unit cost about their common factor, where the machine was never
        /// measured.
        unit_cost_sd = 1.0,
        /// Variance of a fitted model's single unit costs, as a share of the variance of its errors: the rest is
        /// of scenes.
        fitted_share = 0.1,
        /// Standard deviation of scenes' own errors, in ln(time), where the machine was never measured.
        scene_sd = 0.2,
        /// How fast that follows the errors of new scenes.
        scene_pace = 0.15,
        /// Standard deviation of the errors in calm frames before any was seen, in ln(time).
        spread_start = 0.05,
        /// Slowest pace at which it follows them.
        spread_pace = 0.04,
        /// Share of a calm frame's error that the scene's own factor takes up at first.
        gain_start = 0.5,
        /// How fast that share follows the sign of successive errors.
        gain_pace = 0.02,
        /// Variance that the unit costs' common factor gains per frame, in ln.
        common_drift = 1.0e-5,
        /// Variance that each unit cost gains per frame beside it.
        single_drift = 2.0e-6,
        /// Standard deviations beyond which an error that is too fast is clipped.
        clip_below = 2.0,
    }
}
