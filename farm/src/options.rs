//! Options of a run.

/// Options of a run.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// True to continue an earlier run.
    pub resume: bool,
    /// True to retry quarantined tasks.
    pub retry_quarantined: bool,
    /// True to read existing images and compare them with their checksums.
    pub verify: bool,
    /// True to render a coarse subset first.
    pub preview: bool,
    /// Order in which tasks are sent.
    pub order: crate::dispatch::Order,
    /// True to take all tasks as equally long throughout, for comparison.
    pub uniform: bool,
    /// Overhead of a bundle, seconds, instead of the engine's own figure.
    pub overhead: Option<f64>,
}
