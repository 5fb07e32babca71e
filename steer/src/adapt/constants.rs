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
        /// Standard deviation of scenes' own errors, in ln(time), where the machine was never measured.
        scene_sd = 0.2,
        /// Standard deviation of the errors in calm frames before any was seen, in ln(time).
        spread_start = 0.07,
        /// Share of a calm frame's error that the scene's own factor takes up.
        gain = 0.4,
        /// Standard deviations beyond which an error that is too fast is clipped.
        clip_below = 1.42,
    }
}
