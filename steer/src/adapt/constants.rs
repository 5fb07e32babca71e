//! Constants of the correction, tuned on recorded paths.

/// Defines a struct of constants with defaults, which a search can enumerate.
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
    /// Constants of the online correction: its priors for an unmeasured machine and for scenes, and its
    /// learning rates. The defaults follow from a search over recorded paths (`entire-lab tune`); nothing
    /// needs to be set.
    CorrectionConstants {
        /// Prior standard deviation of ln of each unit cost, apart from their common factor, on an unmeasured
        /// machine.
        unit_cost_sd = 1.0,
        /// Prior standard deviation of scenes' own errors, in ln(time), on an unmeasured machine.
        scene_sd = 0.2,
        /// Initial standard deviation of the errors in calm frames, in ln(time).
        spread_start = 0.07,
        /// Share of a calm frame's error that is added to the scene's own factor.
        gain = 0.4,
        /// Clipping limit of the errors of frames faster than expected, in standard deviations.
        clip_below = 1.42,
    }
}
