//! The frames of a set: for training, for upper bounds, and for testing.

use super::findings::noise_of;
use super::{Set, Study};
use anyhow::{Result, ensure};
use entire_io::dataset::{Clock, Table, read_tables};
use entire_train::fit::{FitContext, Recipe};
use entire_train::split::TimedFrames;
use std::ops::Range;

/// Minimum number of ensemble members at which a tenth of the members is for validation. With fewer members,
/// a tenth of the volumes is for validation: one whole member would be far more than a tenth of the training
/// frames, and the loss of training data would outweigh the better stopping criterion.
pub(super) const MEMBERS: usize = 10;

/// A set's tables in memory, with their roles.
pub(crate) struct SetTables {
    /// All tables; a frame names its table by the index in this list.
    pub(crate) tables: Vec<Table>,
    training: Range<usize>,
    bounds: Range<usize>,
    other_steps: Range<usize>,
    splits: Vec<Range<usize>>,
}

impl SetTables {
    pub(crate) fn read(set: &Set) -> Result<Self> {
        let mut paths = Vec::new();
        let mut add = |tables: &[std::path::PathBuf]| {
            let start = paths.len();
            paths.extend_from_slice(tables);
            start..paths.len()
        };
        let (training, bounds, other_steps) = (add(&set.training), add(&set.bounds), add(&set.other_steps));
        let splits = set.splits.iter().map(|s| add(&s.tables)).collect();
        Ok(Self { tables: read_tables(&paths)?, training, bounds, other_steps, splits })
    }

    /// The training tables.
    pub(crate) fn training(&self) -> &[Table] {
        &self.tables[self.training.clone()]
    }

    /// The frames of each split, in the order of the description.
    pub(crate) fn splits(&self, clock: Clock) -> Vec<TimedFrames<'_>> {
        self.splits.iter().map(|r| self.frames(r, clock)).collect()
    }

    fn frames(&self, which: &Range<usize>, clock: Clock) -> TimedFrames<'_> {
        TimedFrames::of(self.tables[which.clone()].iter().flat_map(|t| &t.frames), clock)
    }
}

/// Frames for training a predictor: frames that weights are fitted to, and frames that decide when training
/// stops.
pub(super) struct Learned<'a> {
    pub(super) all: TimedFrames<'a>,
    /// Frames that decide when training stops.
    pub(super) validation: TimedFrames<'a>,
    /// Frames that weights are fitted to.
    pub(super) training: TimedFrames<'a>,
}

/// A set's frames with their seconds.
pub(super) struct SetData<'a> {
    /// Frames of the training tables.
    pub(super) one_step: Learned<'a>,
    /// Frames of training tables and of tables at other steps, for predictors whose inputs contain the step.
    pub(super) every_step: Learned<'a>,
    /// Frames that determine upper bounds.
    pub(super) bounds: TimedFrames<'a>,
    pub(super) splits: Vec<TimedFrames<'a>>,
    /// Median error and RMSE/SD of a perfect predictor on the frames of the training tables, due to the noise
    /// of the measured times.
    pub(super) noise: [f64; 2],
}

impl<'a> SetData<'a> {
    /// The frames of a set's tables that have a time by the clock.
    pub(super) fn new(set: &Set, tables: &'a SetTables, clock: Clock) -> Result<Self> {
        let all = tables.frames(&tables.training, clock);
        ensure!(
            !all.frames.is_empty(),
            "set {}: no training frame has a time by the clock {:?}",
            set.name,
            clock.name()
        );
        let by = all.groups_at_least(MEMBERS);
        let noise = noise_of(&all, clock, |f| tables.tables[f.table].passes());
        let learned = |all: TimedFrames<'a>| {
            let (validation, training) = all.hold_out(by, 1);
            Learned { all, validation, training }
        };
        let every = all.and(tables.frames(&tables.other_steps, clock));
        Ok(Self {
            one_step: learned(all),
            every_step: learned(every),
            bounds: tables.frames(&tables.bounds, clock),
            splits: tables.splits(clock),
            noise,
        })
    }
}

/// Context of a set: its frames, and the inputs of fitting.
#[derive(Clone, Copy)]
pub(super) struct OnSet<'a> {
    pub(super) study: &'a Study,
    pub(super) set: &'a Set,
    pub(super) data: &'a SetData<'a>,
    pub(super) context: &'a FitContext<'a>,
}

impl<'a> OnSet<'a> {
    /// Training frames of a recipe: frames at all ray steps if the inputs of the recipe contain the step,
    /// which those of the paper's network do not.
    pub(super) fn learned(&self, recipe: &Recipe) -> Result<&'a Learned<'a>> {
        Ok(if recipe.knows_step()? { &self.data.every_step } else { &self.data.one_step })
    }
}
