//! Curves of a predictor: error by number of training frames, and by number of frames of other data that it
//! is adapted to, on other volumes of that data.

use super::findings::push_point;
use super::runner::{Bounds, OnSet, Runner};
use super::{CALIBRATION_FRAMES, Findings, Named};
use anyhow::Result;
use entire_cli::calibrate::calibrate_to_frames;
use entire_cli::dataset::Timed;
use entire_cli::fit::{predict, transfer};
use entire_cli::split::TimedFrames;
use entire_core::calibrate::{FEWEST_FRAMES, PriorModel};
use entire_core::model::ModelFile;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::collections::BTreeSet;

/// The curve of models that are taken to frames as `entire calibrate` does: analytic ones times a learned factor.
pub(super) const CALIBRATED: &str = "by entire calibrate";

/// The seed by which training frames are taken for smaller numbers of them.
const SAMPLE_SEED: u64 = 7;
/// The seed by which volumes of other data are parted: to adapt to, and to judge by.
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
        let Some(halves) = halves(all) else {
            let what = format!("{}, curves on {split}", named.name);
            out.left_out.push((set.name.clone(), what, "frames of fewer than two volumes".into()));
            return Ok(());
        };
        // Each half is judged by what was adapted to the other one, whatever the share learned from.
        let turns = || halves.iter().zip(halves.iter().rev());
        let judged: Vec<f64> = turns().flat_map(|(_, judged)| judged.seconds.clone()).collect();
        let mut point = |adapted: &[ModelFile], how: &str, count: usize| -> Result<()> {
            let mut predicted = Vec::with_capacity(judged.len());
            for (file, (_, judged)) in adapted.iter().zip(turns()) {
                predicted.extend(predict(&file.to_model()?, context, &judged.frames)?);
            }
            let curve = format!("{}, {how}{label}", named.name);
            push_point(&mut out.tuning, set, split, &curve, count, &predicted, &judged);
            Ok(())
        };
        let calibrates = PriorModel::new(file).is_ok();
        if calibrates {
            point(&[file.clone(), file.clone()], CALIBRATED, 0)?;
        }
        let share = |s: &f64| ((s * all.frames.len() as f64).round() as usize).max(2);
        let mut counts: Vec<usize> = study.shares.iter().map(share).collect();
        counts.push(CALIBRATION_FRAMES);
        counts.sort_unstable();
        counts.dedup();
        let none = TimedFrames::default();
        let most = halves.iter().map(|h| h.frames.len()).min().unwrap_or(0);
        for count in counts.into_iter().filter(|n| *n <= most) {
            let parts: Vec<TimedFrames<'_>> =
                halves.iter().map(|half| half.sample(count, SHARE_SEED).0).collect();
            let adapted = |how: &dyn Fn(Timed<'_>) -> Result<ModelFile>| -> Result<Vec<ModelFile>> {
                parts.iter().map(|part| how(part.timed())).collect()
            };
            if calibrates && count >= FEWEST_FRAMES {
                point(&adapted(&|few| calibrate_to_frames(file, context, few))?, CALIBRATED, count)?;
            }
            if set.transfer {
                point(&adapted(&|few| transfer(file, context, few))?, "transferred", count)?;
            }
            if count < FEWEST_ALONE {
                continue;
            }
            let key = format!("{}-{}-{split}-alone-{count}", set.name, named.name);
            let recipe = named.recipe_for(&set.name);
            let alone = |part: &TimedFrames<'_>| {
                self.made(&key, recipe, context, (part, &none), &Bounds::Frames(&none)).map(|made| made.0)
            };
            match parts.iter().map(alone).collect::<Result<Vec<_>>>() {
                Ok(alone) => point(&alone, "from nothing", count)?,
                Err(e) if (self.stop)() => return Err(e),
                Err(e) => out.left_out.push((set.name.clone(), key, format!("{e:#}"))),
            }
        }
        Ok(())
    }
}

/// Frames of other data in two parts that share no ensemble member, or no volume where there are no two
/// members: what is adapted to one is judged on the other, so that nothing is judged on data that it was
/// adapted to. `None` where there are fewer than two volumes.
fn halves<'a>(all: &TimedFrames<'a>) -> Option<[TimedFrames<'a>; 2]> {
    let by = all.groups_at_least(2);
    let groups: BTreeSet<String> = all.frames.iter().map(|f| by.group(&f.scene)).collect();
    let mut groups: Vec<String> = groups.into_iter().collect();
    groups.shuffle(&mut ChaCha8Rng::seed_from_u64(HALVES_SEED));
    groups.truncate(groups.len() / 2);
    let (first, second) = all.parted(|f| groups.contains(&by.group(&f.scene)));
    (!first.frames.is_empty()).then_some([first, second])
}

/// Fewest frames that a model is made of alone.
const FEWEST_ALONE: usize = 10;

#[cfg(test)]
mod tests {
    use super::super::tests::table;
    use super::*;
    use entire_cli::dataset::Clock;

    #[test]
    fn no_volume_is_adapted_to_and_judged_by() {
        let volumes = |part: &TimedFrames<'_>| -> BTreeSet<String> {
            part.frames.iter().map(|f| f.scene.volume.clone()).collect()
        };
        let scans: Vec<String> = (0..70).map(|i| format!("scans/v{}.nrrd", i % 7)).collect();
        let scans: Vec<(&str, &str)> = scans.iter().map(|v| (v.as_str(), "")).collect();
        let t = table(&scans);
        let [first, second] = halves(&TimedFrames::of(&t.frames, Clock::Cpu)).unwrap();
        assert_eq!((first.frames.len(), second.frames.len()), (30, 40));
        assert!(volumes(&first).is_disjoint(&volumes(&second)));

        // Time steps of one member are on one side.
        let steps: Vec<(String, String)> =
            (0..40).map(|i| (format!("e/m{}/t{}.nrrd", i % 4, i / 4), format!("m{}", i % 4))).collect();
        let steps: Vec<(&str, &str)> = steps.iter().map(|(v, m)| (v.as_str(), m.as_str())).collect();
        let t = table(&steps);
        let [first, second] = halves(&TimedFrames::of(&t.frames, Clock::Cpu)).unwrap();
        let members = |part: &TimedFrames<'_>| -> BTreeSet<String> {
            part.frames.iter().map(|f| f.scene.member.clone()).collect()
        };
        assert_eq!((first.frames.len(), second.frames.len()), (20, 20));
        assert!(members(&first).is_disjoint(&members(&second)));

        let one = table(&[("a.nrrd", ""), ("a.nrrd", "")]);
        assert!(halves(&TimedFrames::of(&one.frames, Clock::Cpu)).is_none());
    }
}
