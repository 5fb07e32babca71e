//! Training, validation and test frames, split by volume or ensemble member and never by frame.

mod frames;

pub use frames::TimedFrames;

use anyhow::{Result, bail, ensure};
use entire_core::model::{Key, Model};
use entire_io::dataset::{Scene, TimedFrame};
use entire_io::files::without_dots;
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Unit that a split keeps together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GroupBy {
    /// All frames of an ensemble member; for a volume that belongs to no ensemble, all frames of the volume.
    #[default]
    Member,
    /// All frames of a volume.
    Volume,
}

entire_core::names! { GroupBy:
    Member "member",
    Volume "volume",
}

impl GroupBy {
    /// Returns the group of a frame. A member's name includes the name of the folder above its own folder,
    /// since ensembles often have the same member numbers: `castro_blast/m01`.
    pub fn group(self, scene: &Scene) -> String {
        let volume = without_dots(Path::new(&scene.volume));
        let folder = volume.parent();
        let name = |p: Option<&Path>| p.and_then(Path::file_name).map(|n| n.to_string_lossy().into_owned());
        match self {
            Self::Member if !scene.member.is_empty() => match name(folder.and_then(Path::parent)) {
                Some(ensemble) if name(folder).as_ref() == Some(&scene.member) => {
                    format!("{ensemble}/{}", scene.member)
                }
                _ => scene.member.clone(),
            },
            _ => scene.volume.clone(),
        }
    }
}

/// Groups for training, validation and testing.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Split {
    /// Kind of the groups.
    pub by: GroupBy,
    /// Groups whose frames the model is fitted to.
    pub training: BTreeSet<String>,
    /// Groups whose loss decides when training stops.
    pub validation: BTreeSet<String>,
    /// Groups that are not used in training.
    pub test: BTreeSet<String>,
}

impl Split {
    /// Splits groups: `validation` and `test` name groups, all others are for training. If both are empty and
    /// there are at least three groups, a random tenth of the groups (at least one group) is taken for each.
    /// Groups go to one part if the path of one is the end of the other's.
    ///
    /// # Errors
    /// When a name is no group or is named twice, or no training group is left.
    pub fn new<'a>(
        frames: impl IntoIterator<Item = &'a TimedFrame>,
        by: GroupBy,
        validation: &[String],
        test: &[String],
        seed: u64,
    ) -> Result<Self> {
        let groups: BTreeSet<String> = frames.into_iter().map(|f| by.group(&f.scene)).collect();
        let list = || groups.iter().map(String::as_str).collect::<Vec<_>>().join(", ");
        for name in validation.iter().chain(test) {
            ensure!(groups.contains(name), "{} {name:?} is not in the data; there are {}", by.name(), list());
        }
        let name = |group: &String| shortest(group, &groups).to_owned();
        let [mut held, mut tested]: [BTreeSet<String>; 2] =
            [validation, test].map(|named| named.iter().map(name).collect());
        if let Some(both) = validation.iter().find(|v| tested.contains(&name(v))) {
            bail!("{} {both:?} is named both for validation and for testing; name it once", by.name());
        }
        let names: BTreeSet<String> = groups.iter().map(name).collect();
        if validation.is_empty() && test.is_empty() && names.len() >= 3 {
            let (shuffled, tenth) = shuffled(&names, seed);
            tested = shuffled[..tenth].iter().map(|g| (*g).clone()).collect();
            held = shuffled[tenth..2 * tenth].iter().map(|g| (*g).clone()).collect();
        }
        let mut split = Self { by, ..Self::default() };
        for group in &groups {
            let name = name(group);
            let part = match (held.contains(&name), tested.contains(&name)) {
                (true, _) => &mut split.validation,
                (_, true) => &mut split.test,
                _ => &mut split.training,
            };
            part.insert(group.clone());
        }
        ensure!(
            !split.training.is_empty(),
            "no {} is left to train on; name fewer for validation and testing",
            by.name()
        );
        Ok(split)
    }

    /// Returns the splits by which a model was trained, as its file states them: its own, then those of the
    /// models that it was fine-tuned or distilled from. Empty if the file states none.
    pub fn all_of(model: &Model) -> Vec<Self> {
        let stated = model.metadata.get(Key::Provenance.name());
        let Some(origin) = stated.and_then(|text| serde_json::from_str::<Value>(text).ok()) else {
            return Vec::new();
        };
        let earlier = origin["earlier_splits"].as_array().cloned().unwrap_or_default();
        let all = core::iter::once(origin["split"].clone()).chain(earlier);
        all.filter_map(|split| serde_json::from_value(split).ok()).collect()
    }

    /// True if the model of this split was trained or validated on frames of the scene's group. Two groups
    /// count as the same if the name of one is the end of the other's: tables state paths relative to
    /// different folders.
    pub fn has_seen(&self, scene: &Scene) -> bool {
        let group = self.by.group(scene);
        let own = bare(&group);
        let same = |other: &String| {
            let other = bare(other);
            other.ends_with(own) || own.ends_with(other)
        };
        !self.test.contains(&group) && self.training.iter().chain(&self.validation).any(same)
    }

    /// Returns the part that a frame belongs to.
    pub fn part(&self, scene: &Scene) -> Part {
        let group = self.by.group(scene);
        if self.test.contains(&group) {
            Part::Test
        } else if self.validation.contains(&group) {
            Part::Validation
        } else if self.training.contains(&group) {
            Part::Training
        } else {
            Part::Unknown
        }
    }

    /// Returns the frames of each part.
    pub fn divide<'a>(&self, frames: &[&'a TimedFrame]) -> BTreeMap<Part, Vec<&'a TimedFrame>> {
        let mut parts: BTreeMap<Part, Vec<&TimedFrame>> = BTreeMap::new();
        for frame in frames {
            parts.entry(self.part(&frame.scene)).or_default().push(frame);
        }
        parts
    }
}

/// Returns the path without a leading `./`.
fn bare(name: &str) -> &Path {
    Path::new(name).strip_prefix(".").unwrap_or(Path::new(name))
}

/// Returns the shortest of `groups`, without a leading `./`, that is the end of this group's path: the same
/// volume or member, since tables state paths relative to different folders.
pub fn shortest<'a>(group: &'a str, groups: &BTreeSet<String>) -> &'a str {
    let mut rest = Path::new(group).components();
    let mut found = group;
    while rest.next().is_some() {
        let known = |end: &&str| groups.contains(*end) || groups.contains(&format!("./{end}"));
        found = rest.as_path().to_str().filter(known).unwrap_or(found);
    }
    found
}

/// Returns the groups in random order, and a tenth of their number, but at least 1.
fn shuffled(groups: &BTreeSet<String>, seed: u64) -> (Vec<&String>, usize) {
    let mut order: Vec<&String> = groups.iter().collect();
    order.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
    (order, ((groups.len() as f64 / 10.0).round() as usize).max(1))
}

/// A part of a split.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// Frames that the model is fitted to.
    Training,
    /// Frames whose loss decides when training stops.
    Validation,
    /// Frames that are not used in training.
    Test,
    /// Frames whose group is not in the split.
    Unknown,
}

entire_core::names! { Part:
    Training "training",
    Validation "validation",
    Test "test",
    Unknown "other",
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_of_two_ensembles_with_one_name_are_two_groups() {
        let scene = TimedFrame::of_no_volume("data/castro/m01/t0001.nrrd", "m01").scene;
        assert_eq!(GroupBy::Member.group(&scene), "castro/m01");
        for path in ["castro/m01/y/../t1.nrrd", "castro/m02/../m01/t1.nrrd"] {
            assert_eq!(GroupBy::Member.group(&TimedFrame::of_no_volume(path, "m01").scene), "castro/m01");
        }
        assert_eq!(GroupBy::Member.group(&TimedFrame::of_no_volume("m01/t1.nrrd", "m01").scene), "m01");
        assert_eq!(GroupBy::Member.group(&TimedFrame::of_no_volume("a/b.nrrd", "x").scene), "x");
        assert_eq!(GroupBy::Member.group(&TimedFrame::of_no_volume("a/b.nrrd", "").scene), "a/b.nrrd");
        assert_eq!(GroupBy::Volume.group(&scene), "data/castro/m01/t0001.nrrd");
    }

    #[test]
    fn a_group_was_seen_whatever_folder_its_table_names() {
        let split = Split { training: ["castro/m01".into()].into(), ..Split::default() };
        for (volume, seen) in [
            ("castro/m01/t1.nrrd", true),
            ("x/castro/m01/t1.nrrd", true),
            ("m01/t1.nrrd", true),
            ("nyx/m01/t1.nrrd", false),
        ] {
            assert_eq!(split.has_seen(&TimedFrame::of_no_volume(volume, "m01").scene), seen, "{volume}");
        }
    }

    #[test]
    fn a_tenth_each_and_no_group_torn_apart() {
        let frames: Vec<TimedFrame> =
            (0..200).map(|i| TimedFrame::of_no_volume(&format!("v{}.nrrd", i % 20), "")).collect();
        let split = Split::new(&frames, GroupBy::Volume, &[], &[], 3).unwrap();
        assert_eq!((split.training.len(), split.validation.len(), split.test.len()), (16, 2, 2));
        let refs: Vec<&TimedFrame> = frames.iter().collect();
        let parts = split.divide(&refs);
        assert_eq!(parts[&Part::Training].len(), 160);
        assert!(parts[&Part::Test].iter().all(|f| split.test.contains(&f.scene.volume)));
        assert_eq!(split, Split::new(&frames, GroupBy::Volume, &[], &[], 3).unwrap());
        assert_ne!(split.test, Split::new(&frames, GroupBy::Volume, &[], &[], 4).unwrap().test);
    }

    #[test]
    fn names_are_obeyed_and_checked() {
        let frames = [
            TimedFrame::of_no_volume("a", ""),
            TimedFrame::of_no_volume("b", ""),
            TimedFrame::of_no_volume("c", ""),
        ];
        let names = |n: &[&str]| n.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>();
        let split = Split::new(&frames, GroupBy::Volume, &names(&["a"]), &names(&["c"]), 1).unwrap();
        assert_eq!(split.part(&frames[0].scene), Part::Validation);
        assert_eq!(split.part(&frames[1].scene), Part::Training);
        assert_eq!(split.part(&frames[2].scene), Part::Test);
        assert_eq!(split.part(&TimedFrame::of_no_volume("d", "").scene), Part::Unknown);
        let fails = |v: &[&str], t: &[&str]| {
            Split::new(&frames, GroupBy::Volume, &names(v), &names(t), 1).unwrap_err().to_string()
        };
        assert!(fails(&["x"], &[]).contains("there are a, b, c"));
        assert!(fails(&["a"], &["a"]).contains("named both"));
        assert!(fails(&["a"], &["b", "c"]).contains("left to train on"));
        let few = Split::new(&frames[..2], GroupBy::Volume, &[], &[], 1).unwrap();
        assert_eq!((few.training.len(), few.test.len()), (2, 0));
    }

    #[test]
    fn a_volume_that_two_tables_name_differently_stays_in_one_part() {
        let names = ["a", "b", "c", "./a", "x/b", "/y/x/c"];
        let frames = names.map(|name| TimedFrame::of_no_volume(name, ""));
        for seed in 0..8 {
            let split = Split::new(&frames, GroupBy::Volume, &[], &[], seed).unwrap();
            assert_eq!((split.training.len(), split.validation.len(), split.test.len()), (2, 2, 2));
            for pair in 0..3 {
                assert_eq!(split.part(&frames[pair].scene), split.part(&frames[pair + 3].scene), "{split:?}");
            }
        }
        let apart = ["./a", "x/a", "b", "c"].map(|name| TimedFrame::of_no_volume(name, ""));
        let split = Split::new(&apart, GroupBy::Volume, &[], &["x/a".into()], 1).unwrap();
        assert_eq!(split.test, BTreeSet::from(["./a", "x/a"].map(String::from)));
        let split = Split { by: GroupBy::Volume, training: ["./a".into()].into(), ..Split::default() };
        assert!(split.has_seen(&apart[1].scene));
        let split = Split::new(&frames, GroupBy::Volume, &[], &["x/b".into()], 1).unwrap();
        assert_eq!(split.test, BTreeSet::from(["b", "x/b"].map(String::from)));
    }
}
