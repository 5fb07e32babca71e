//! Options of `entire farm` that concern database and driver.

/// Options of a run.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// True to continue an earlier run.
    pub resume: bool,
    /// True to retry quarantined tasks.
    pub retry_quarantined: bool,
    /// True to compare existing images with their checksums, not only their sizes.
    pub verify: bool,
    /// True to render first every eighth view at the smallest size and the coarsest step.
    pub preview: bool,
    /// Order in which tasks are sent.
    pub order: crate::dispatch::Order,
    /// True to treat all tasks as equally long in the whole run, for comparison.
    pub uniform: bool,
    /// Initial estimate of a bundle's overhead, seconds.
    pub overhead: f64,
}
