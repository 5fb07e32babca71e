//! How a job is run.

/// How a job is run.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Whether an earlier run goes on.
    pub resume: bool,
    /// Whether quarantined tasks are tried again.
    pub retry_quarantined: bool,
    /// Whether images that are there are read and compared with their checksums.
    pub verify: bool,
    /// Whether a coarse subset comes first.
    pub preview: bool,
    /// In which order tasks are sent.
    pub order: crate::dispatch::Order,
    /// Whether all tasks are taken for equally long and stay so: to compare with.
    pub uniform: bool,
    /// Seconds that a bundle costs, instead of the engine's own figure.
    pub overhead: Option<f64>,
}
