//! The volumes of a data set, and the part of each split that they belong to.

use super::description::{BY_MEMBERS, BY_VOLUMES, DataSet, Paper};
use anyhow::{Context, Result, ensure};
use entire_cli::collection::Job;
use entire_io::files::{fnv1a, note};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Selected data sets and modes; an empty list selects all.
#[derive(Clone, Debug, Default)]
pub(crate) struct Selection {
    pub(crate) data_sets: Vec<String>,
    pub(crate) modes: Vec<String>,
}

impl Selection {
    pub(crate) fn has_mode(&self, mode: &str) -> bool {
        self.modes.is_empty() || self.modes.iter().any(|n| n == mode)
    }
}

/// Training, validation and test volumes, by name; no volume is in two parts.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Parts {
    /// Name of the split: `volumes` or `members`.
    pub(crate) name: &'static str,
    pub(crate) training: BTreeSet<String>,
    /// Volumes that decide when training stops.
    pub(crate) validation: BTreeSet<String>,
    pub(crate) test: BTreeSet<String>,
}

/// Returns the name of a split in words. For a test on volumes of another kind (`modality: NAME`),
/// returns NAME.
pub(super) fn in_words(split: &str) -> &str {
    match split {
        BY_VOLUMES => "random volumes",
        BY_MEMBERS => "left-out member",
        other => other.rsplit(": ").next().unwrap_or(other),
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Place {
    pub(crate) set: DataSet,
    /// Folder to which the names of the data set's volumes are relative.
    pub(crate) root: PathBuf,
    /// Volumes, sorted by path (relative to `root`); frame numbers depend on the volume's index.
    pub(crate) jobs: Vec<Job>,
    /// Splits of the volumes; empty where the set is only for tests.
    pub(crate) splits: Vec<Parts>,
}

impl Place {
    /// Finds a data set; `None` if its folder does not exist.
    pub(crate) fn find(set: &DataSet, data: &Path) -> Result<Option<Self>> {
        let Some(root) = roots(data).into_iter().find(|r| r.join(&set.name).is_dir()) else {
            return Ok(None);
        };
        let mut files = Vec::new();
        files_below(&root, Path::new(&set.name), &mut files)?;
        files.sort();
        ensure!(!files.is_empty(), "{} holds no .nrrd file", root.join(&set.name).display());
        let jobs: Vec<Job> = files.iter().map(|f| Job::from_path(f)).collect();
        let splits = if set.only_tests { Vec::new() } else { splits(set, &jobs)? };
        Ok(Some(Self { set: set.clone(), root, jobs, splits }))
    }

    /// Number of frames of a volume: the number for training volumes if a split trains on it, else the number
    /// for held-out volumes.
    pub(crate) fn frames_of(&self, job: &Job, paper: &Paper) -> u32 {
        let name = job.name();
        let learned = self.splits.iter().any(|s| s.training.contains(&name));
        if learned { paper.frames.training } else { paper.frames.held_out }
    }

    /// The split by which the paper tests on the data set; the split by random volumes if the members of the
    /// paper's split are missing; `None` where the set is only for tests.
    pub(crate) fn main_split(&self) -> Option<&Parts> {
        self.split(self.set.rule.split()).or_else(|| self.splits.first())
    }

    pub(crate) fn split(&self, name: &str) -> Option<&Parts> {
        self.splits.iter().find(|s| s.name == name)
    }
}

/// Returns the folders to which names of volumes may be relative.
pub(super) fn roots(data: &Path) -> [PathBuf; 2] {
    [data.join("ensembles"), data.to_owned()]
}

fn files_below(root: &Path, below: &Path, found: &mut Vec<PathBuf>) -> Result<()> {
    let folder = root.join(below);
    let fail = || format!("cannot read {}", folder.display());
    for entry in std::fs::read_dir(&folder).with_context(fail)? {
        let entry = entry.with_context(fail)?;
        let path = below.join(entry.file_name());
        if entry.path().is_dir() {
            files_below(root, &path, found)?;
        } else if path.extension().is_some_and(|e| e == "nrrd") {
            found.push(path);
        }
    }
    Ok(())
}

/// Name of the volume of which a volume is a variant: `t0010.nrrd` for `t0010.s50.nrrd`, with the same
/// folders.
fn original(name: &str) -> String {
    let (folder, file) = name.split_at(name.rfind('/').map_or(0, |slash| slash + 1));
    match (file.split_once('.'), file.rsplit_once('.')) {
        (Some((stem, _)), Some((_, extension))) => format!("{folder}{stem}.{extension}"),
        _ => name.to_owned(),
    }
}

/// Returns two disjoint tenths of some volumes, each of at least one volume with its variants. Volumes are
/// taken in the order of a hash of their names, so that the choice is pseudo-random but depends on the names
/// alone.
fn tenths<'a>(names: impl Iterator<Item = &'a String>) -> (BTreeSet<String>, BTreeSet<String>) {
    let mut originals: BTreeMap<String, Vec<&String>> = BTreeMap::new();
    for name in names {
        originals.entry(original(name)).or_default().push(name);
    }
    let tenth = ((originals.len() as f64 / 10.0).round() as usize).max(1);
    let mut originals: Vec<(String, Vec<&String>)> = originals.into_iter().collect();
    originals.sort_by_key(|(n, _)| (fnv1a(n.as_bytes()), n.clone()));
    let part = |from: usize| {
        originals.iter().skip(from).take(tenth).flat_map(|(_, all)| all.iter().copied().cloned()).collect()
    };
    (part(0), part(tenth))
}

fn splits(set: &DataSet, jobs: &[Job]) -> Result<Vec<Parts>> {
    let all: BTreeSet<String> = jobs.iter().map(Job::name).collect();
    ensure!(all.len() >= 3, "{} has {} volumes; at least 3 are needed", set.name, all.len());
    let (test, validation) = tenths(all.iter());
    let training = &(&all - &test) - &validation;
    let mut out = vec![Parts { name: BY_VOLUMES, training, validation, test }];
    if let Some(members) = &set.members {
        let of = |wanted: &BTreeSet<String>| -> BTreeSet<String> {
            jobs.iter().filter(|j| wanted.contains(&j.member)).map(Job::name).collect()
        };
        let test = of(&members.test);
        let mut validation = of(&members.validation);
        if validation.is_empty() {
            validation = tenths((&all - &test).iter()).0;
        }
        let training = &(&all - &test) - &validation;
        // There is no split by members if the available data have no volume of one of its parts.
        if !test.is_empty() && !training.is_empty() && !validation.is_empty() {
            out.push(Parts { name: BY_MEMBERS, training, validation, test });
        }
    }
    if set.only_rule && out.iter().any(|s| s.name == set.rule.split()) {
        out.retain(|s| s.name == set.rule.split());
    }
    Ok(out)
}

/// Finds the selected data sets, at least one. A note names those that do not exist.
pub(crate) fn places(paper: &Paper, selection: &Selection, data: &Path) -> Result<Vec<Place>> {
    for name in &selection.data_sets {
        let known = || paper.data_sets.iter().map(|d| d.name.as_str()).collect::<Vec<_>>().join(", ");
        ensure!(paper.data_set(name).is_some(), "--data-sets names {name:?}; there are {}", known());
    }
    let mut found = Vec::new();
    let asked = |d: &&DataSet| selection.data_sets.is_empty() || selection.data_sets.contains(&d.name);
    for set in paper.data_sets.iter().filter(asked) {
        match Place::find(set, data)? {
            Some(place) => found.push(place),
            None => note(&format!("{} is not in {}; it is skipped", set.name, data.display())),
        }
    }
    ensure!(
        !found.is_empty(),
        "{} holds none of the data sets; --data must name the folder that holds them, or one that holds \
         ensembles/",
        data.display()
    );
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::super::description::Rule;
    use super::*;

    fn set(members: Option<serde_json::Value>) -> DataSet {
        let mut value = serde_json::json!({ "name": "e", "title": "E", "modes": ["none"] });
        if let Some(m) = members {
            value["members"] = m;
        }
        serde_json::from_value(value).unwrap()
    }

    fn jobs() -> Vec<Job> {
        (0..40).map(|i| Job::from_path(Path::new(&format!("e/m0{}/t{:04}.nrrd", i % 4, i / 4)))).collect()
    }

    #[test]
    fn variants_of_a_volume_are_in_the_same_part() {
        let variants = |j: Job| {
            let name = j.name();
            let of =
                |share: &str| Job::from_path(Path::new(&name.replace(".nrrd", &format!(".s{share}.nrrd"))));
            [j.clone(), of("50"), of("80")]
        };
        let plain = &splits(&set(None), &jobs()).unwrap()[0];
        let all: Vec<Job> = jobs().into_iter().flat_map(variants).collect();
        let found = &splits(&set(None), &all).unwrap()[0];
        assert_eq!(found.test.len(), 3 * plain.test.len());
        let originals: BTreeSet<String> = found.test.iter().map(|n| original(n)).collect();
        assert_eq!(originals, plain.test, "{:?}", found.test);
    }

    #[test]
    fn the_main_split_is_the_papers_or_else_the_one_that_is_there() {
        let place = |members: &str, only_rule: bool| {
            let members = serde_json::json!({ "validation": ["m02"], "test": [members] });
            let set = DataSet { rule: Rule::Members, only_rule, ..set(Some(members)) };
            let splits = splits(&set, &jobs()).unwrap();
            Place { set, root: PathBuf::new(), jobs: jobs(), splits }
        };
        for (place, main, count) in [
            (place("m03", false), BY_MEMBERS, 2),
            (place("m03", true), BY_MEMBERS, 1),
            (place("m09", true), BY_VOLUMES, 1),
        ] {
            assert_eq!((place.main_split().unwrap().name, place.splits.len()), (main, count));
        }
    }

    #[test]
    fn splits_share_no_volume_and_leave_none_out() {
        let found =
            splits(&set(Some(serde_json::json!({ "validation": ["m02"], "test": ["m03"] }))), &jobs());
        let found = found.unwrap();
        assert_eq!(found.len(), 2);
        for s in &found {
            assert!(s.training.is_disjoint(&s.validation) && s.training.is_disjoint(&s.test));
            assert!(s.validation.is_disjoint(&s.test));
            assert_eq!(s.training.len() + s.validation.len() + s.test.len(), 40);
        }
        assert_eq!((found[0].validation.len(), found[0].test.len()), (4, 4));
        assert!(found[1].test.iter().all(|n| n.contains("/m03/")));
        assert_eq!(found[1].training.len(), 20);
        // If no members are named for validation, some volumes of the members that are not for testing are
        // used.
        let found = splits(&set(Some(serde_json::json!({ "test": ["m03"] }))), &jobs()).unwrap();
        assert_eq!((found[1].training.len(), found[1].validation.len()), (27, 3));
        // If the test members are missing, there is no split by members.
        assert_eq!(splits(&set(Some(serde_json::json!({ "test": ["m09"] }))), &jobs()).unwrap().len(), 1);
        assert!(splits(&set(None), &jobs()[..2]).is_err());
    }
}
