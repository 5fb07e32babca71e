//! Error of a predictor on the calibration split, after calibration to a hundred frames of other volumes of
//! this split.

use super::data::OnSet;
use super::findings::CalibratedResult;
use super::{CALIBRATION_FRAMES, Findings};
use anyhow::Result;
use entire_cli::calibrate::calibrate_to_frames;
use entire_core::model::ModelFile;
use entire_io::metrics::Metrics;
use entire_steer::calibrate::PriorModel;
use entire_steer::predict::UnitCosts;
use entire_train::fit::predict;
use entire_train::split::TimedFrames;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::collections::BTreeSet;

/// The seed of the split of volumes into calibration and test.
const HALVES_SEED: u64 = 11;
const FRAMES_SEED: u64 = 13;

/// Calibrates a predictor to [`CALIBRATION_FRAMES`] of one half of the set's calibration split, tests it on
/// the other half, and vice versa. Does nothing for sets without such a split and for models that cannot be a
/// prior.
pub(super) fn calibrated(
    on: &OnSet<'_>,
    predictor: &str,
    file: &ModelFile,
    out: &mut Findings,
) -> Result<()> {
    let OnSet { set, data, context, .. } = *on;
    let Some(at) = set.splits.iter().position(|s| set.calibration_split.as_ref() == Some(&s.name)) else {
        return Ok(());
    };
    if PriorModel::new(std::slice::from_ref(file), &UnitCosts::SOFTWARE).is_err() {
        return Ok(());
    }
    let Some(halves) = halves(&data.splits[at]) else { return Ok(()) };
    let (mut predicted, mut measured) = (Vec::new(), Vec::new());
    for (half, judged) in halves.iter().zip(halves.iter().rev()) {
        let (few, _) = half.sample(CALIBRATION_FRAMES.min(half.frames.len()), FRAMES_SEED);
        let here = calibrate_to_frames(std::slice::from_ref(file), context, few.timed())?;
        predicted.extend(predict(&here.to_model()?, context, &judged.frames)?);
        measured.extend_from_slice(&judged.seconds);
    }
    out.calibrated.extend(Metrics::new(&predicted, &measured).map(|metrics| CalibratedResult {
        set: set.name.clone(),
        split: set.splits[at].name.clone(),
        predictor: predictor.to_owned(),
        metrics,
    }));
    Ok(())
}

/// Divides frames into two parts without a common ensemble member (without a common volume if there are fewer than two
/// members), so that no model is tested on data that it was adapted to. `None` with fewer than two volumes.
fn halves<'a>(all: &TimedFrames<'a>) -> Option<[TimedFrames<'a>; 2]> {
    let by = all.groups_at_least(2);
    let groups: BTreeSet<String> = all.frames.iter().map(|f| by.group(&f.scene)).collect();
    let mut groups: Vec<String> = groups.into_iter().collect();
    groups.shuffle(&mut ChaCha8Rng::seed_from_u64(HALVES_SEED));
    groups.truncate(groups.len() / 2);
    let (first, second) = all.parted(|f| groups.contains(&by.group(&f.scene)));
    (!first.frames.is_empty()).then_some([first, second])
}

#[cfg(test)]
mod tests {
    use super::super::tests::table;
    use super::*;
    use entire_io::dataset::Clock;

    #[test]
    fn no_volume_is_adapted_to_and_judged_by() {
        let volumes = |part: &TimedFrames<'_>| -> BTreeSet<String> {
            part.frames.iter().map(|f| f.scene.volume.clone()).collect()
        };
        let scans: Vec<(String, String)> =
            (0..70).map(|i| (format!("scans/v{}.nrrd", i % 7), String::new())).collect();
        let t = table(&scans);
        let [first, second] = halves(&TimedFrames::of(&t.frames, Clock::Cpu)).unwrap();
        assert_eq!((first.frames.len(), second.frames.len()), (30, 40));
        assert!(volumes(&first).is_disjoint(&volumes(&second)));

        // All time steps of a member must be in the same half.
        let steps: Vec<(String, String)> =
            (0..40).map(|i| (format!("e/m{}/t{}.nrrd", i % 4, i / 4), format!("m{}", i % 4))).collect();
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
