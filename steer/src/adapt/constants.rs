//! Constants of the correction: those tuned on recorded paths, and those that several files use.

/// Defines a struct of named constants with default values; a search can enumerate the constants.
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
            /// Returns the name of each constant and a mutable reference to it, in the order of their
            /// definition.
            pub fn values(&mut self) -> [(&'static str, &mut f64); [$(stringify!($name)),*].len()] {
                [$((stringify!($name), &mut self.$name),)*]
            }
        }
    };
}
pub(crate) use constants;

constants! {
    /// Constants of the online correction: its priors for an unmeasured machine, its learning rate and its
    /// clipping limit. The defaults come from a search over recorded paths (`entire-lab tune`); callers need
    /// not set any.
    CorrectionConstants {
        /// Prior standard deviation of ln of each unit cost, apart from their common factor, on an unmeasured
        /// machine.
        unit_cost_sd = 1.0,
        /// Initial standard deviation of the prediction errors of calm frames, in ln(time).
        spread_start = 0.07,
        /// Share of a calm frame's error that is added to the scene's own factor.
        gain = 0.4,
        /// Clipping limit of the error of a frame that is faster than expected, in standard deviations.
        clip_below = 1.42,
    }
}

/// Number of frames after which a scene or a load is established: half a second at 60 frames per second, the
/// longest burst of load by other programs in the recordings.
pub(crate) const ESTABLISHED_FRAMES: u64 = 32;
/// Learning rate of statistics of errors: the margins, the variance of calm frames' errors (at least this
/// rate), and the variance, over scenes, of ln of a scene's own factor. At this rate, a statistic is an
/// average over about twenty errors.
pub(crate) const PACE: f64 = 0.05;
/// Limit beyond which an error is an outlier (a stall, a load, or a change of the machine's speed), in
/// standard deviations: only 0.3 % of normal errors are larger.
pub(crate) const CLIP: f64 = 3.0;
