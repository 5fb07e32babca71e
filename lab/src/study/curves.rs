//! Curves of a predictor: error by number of training frames, and by number of frames of other data that it
//! is adapted to.

use super::findings::push_point;
use super::runner::{Bounds, OnSet, Runner};
use super::{CALIBRATION_FRAMES, Findings, Named};
use anyhow::Result;
use entire_cli::calibrate::calibrate_to_frames;
use entire_cli::dataset::Timed;
use entire_cli::fit::{calibrate, predict, transfer};
use entire_cli::split::TimedFrames;
use entire_core::calibrate::{FEWEST_FRAMES, PriorModel};
use entire_core::model::ModelFile;

/// The curve of models that are taken to frames as `entire calibrate` does; others fit their last layer alone.
pub(super) const AS_A_MACHINE: &str = "by entire calibrate";

/// The seed by which training frames are taken for smaller numbers of them.
const SAMPLE_SEED: u64 = 7;
/// The seed by which frames of other data are parted: to adapt to, and to judge by.
const HALVES_SEED: u64 = 11;
/// The seed by which frames to adapt to are taken.
const SHARE_SEED: u64 = 13;

impl Runner<'_> {
    /// Draws a predictor's curves on a set.
    ///
    /// # Errors
    /// When a model cannot be made or predict, or it was stopped.
    pub(super) fn curves(
        &self,
        on: &OnSet<'_>,
        named: &Named,
        file: &ModelFile,
        out: &mut Findings,
    ) -> Result<()> {
        self.sample_curve(on, named, file, out)?;
        let set = on.set;
        let main = set.calibration_split.iter().map(|n| (n, String::new()));
        let more = set.more_calibration_splits.iter().map(|n| (n, format!(" ({n})")));
        for (name, label) in main.chain(more) {
            if let Some(at) = set.splits.iter().position(|s| s.name == *name) {
                self.tuning_curves(on, named, file, (at, &label), out)?;
            }
        }
        Ok(())
    }

    /// Error on the main split by number of training frames.
    fn sample_curve(
        &self,
        on: &OnSet<'_>,
        named: &Named,
        file: &ModelFile,
        out: &mut Findings,
    ) -> Result<()> {
        let OnSet { study, set, data, context } = *on;
        let Some(at) = set.splits.iter().position(|s| s.main) else { return Ok(()) };
        let (split, judged) = (&set.splits[at].name, &data.splits[at]);
        let recipe = named.recipe_for(&set.name);
        let learned = on.learned(recipe)?;
        let none = TimedFrames::default();
        let mut point = |file: &ModelFile, count: usize| -> Result<()> {
            let predicted = predict(&file.to_model()?, context, &judged.frames)?;
            push_point(&mut out.samples, set, split, &named.name, count, &predicted, &judged.seconds);
            Ok(())
        };
        for &size in study.sample_sizes.iter().filter(|n| **n < learned.training.frames.len()) {
            let (part, _) = learned.training.sample(size, SAMPLE_SEED);
            let key = format!("{}-{}-{size}", set.name, named.name);
            let parts = (&part, &learned.validation);
            let (made, _) = self.made(&key, recipe, context, parts, &Bounds::Frames(&none))?;
            point(&made, size)?;
        }
        point(file, learned.training.frames.len())
    }

    /// Error on a split by number of its frames that the model is calibrated to, transferred to, or made of
    /// alone.
    fn tuning_curves(
        &self,
        on: &OnSet<'_>,
        named: &Named,
        file: &ModelFile,
        (at, label): (usize, &str),
        out: &mut Findings,
    ) -> Result<()> {
        let OnSet { study, set, data, context } = *on;
        let (split, all) = (&set.splits[at].name, &data.splits[at]);
        // The last half is judged on, whatever the share learned from.
        let (pool, judged) = all.sample(all.frames.len() / 2, HALVES_SEED);
        let mut point = |file: &ModelFile, how: &str, count: usize| -> Result<()> {
            let predicted = predict(&file.to_model()?, context, &judged.frames)?;
            let curve = format!("{}, {how}{label}", named.name);
            push_point(&mut out.tuning, set, split, &curve, count, &predicted, &judged.seconds);
            Ok(())
        };
        point(file, "calibrated", 0)?;
        let share = |s: &f64| ((s * all.frames.len() as f64).round() as usize).max(2);
        let mut counts: Vec<usize> = study.shares.iter().map(share).collect();
        counts.push(CALIBRATION_FRAMES);
        counts.sort_unstable();
        counts.dedup();
        let none = TimedFrames::default();
        for count in counts.into_iter().filter(|n| *n <= pool.frames.len()) {
            let (part, _) = pool.sample(count, SHARE_SEED);
            let few: Timed<'_> = part.timed();
            point(&calibrate(file, context, few)?, "calibrated", count)?;
            if PriorModel::new(file).is_ok() && count >= FEWEST_FRAMES {
                point(&calibrate_to_frames(file, context, few)?, AS_A_MACHINE, count)?;
            }
            if set.transfer {
                point(&transfer(file, context, few)?, "transferred", count)?;
            }
            if count < FEWEST_ALONE {
                continue;
            }
            let key = format!("{}-{}-{split}-alone-{count}", set.name, named.name);
            let recipe = named.recipe_for(&set.name);
            match self.made(&key, recipe, context, (&part, &none), &Bounds::Frames(&none)) {
                Ok((alone, _)) => point(&alone, "from nothing", count)?,
                Err(e) if (self.stop)() => return Err(e),
                Err(e) => out.left_out.push((set.name.clone(), key, format!("{e:#}"))),
            }
        }
        Ok(())
    }
}

/// Fewest frames that a model is made of alone.
const FEWEST_ALONE: usize = 10;
