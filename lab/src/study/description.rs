//! Description of a study: its JSON file.

use anyhow::{Context, Result, bail, ensure};
use entire_io::dataset::Clock;
use entire_io::files::read_text;
use entire_train::fit::{DtypeChoice, Recipe};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Contents of a description file. Paths are relative to the file's folder.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Study {
    pub(crate) title: String,
    #[serde(default = "cpu")]
    pub(crate) clock: String,
    /// Data sets, each of one shading mode or renderer.
    pub(crate) sets: Vec<Set>,
    /// Predictors, each made for every set.
    pub(crate) predictors: Vec<Named>,
    /// Files that `entire-lab study --ship` writes for every set.
    #[serde(default)]
    pub(crate) ship: Vec<Ship>,
    /// Volume on which latencies are measured, and its enlargement.
    pub(crate) latency_volume: (PathBuf, usize),
}

fn cpu() -> String {
    Clock::Cpu.name().into()
}

/// Value of [`Ship::predictor`] for the predictor that the rule selects.
pub(crate) const SELECTED: &str = "selected";

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Ship {
    /// Name of the predictor, or `selected` for the one that the rule selects.
    pub(crate) predictor: String,
    #[serde(default)]
    pub(crate) dtype: DtypeChoice,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Set {
    pub(crate) name: String,
    /// Training tables; a tenth of their members (of their volumes, if there are fewer than ten members)
    /// decides when training stops.
    pub(crate) training: Vec<PathBuf>,
    /// Tables of frames at other ray steps, for predictors that take the step into account.
    #[serde(default)]
    pub(crate) other_steps: Vec<PathBuf>,
    /// Tables whose frames only determine the upper bounds of predictors that are not cross-validated;
    /// default: the validation frames.
    #[serde(default)]
    pub(crate) bounds: Vec<PathBuf>,
    pub(crate) splits: Vec<SplitTables>,
    /// Tables of the same frames on volumes of 64³ voxels, by name of the original table:
    /// `{"none-train.csv.gz": "none-train-64.csv.gz"}`.
    #[serde(default)]
    pub(crate) low_resolution: BTreeMap<String, PathBuf>,
    /// Name of the split that tests calibration: predictors are calibrated to a hundred of its frames.
    #[serde(default)]
    pub(crate) calibration_split: Option<String>,
    /// Name of the group that this set belongs to. The sets of a group have one shading mode and differ in
    /// the machine; one predictor is selected for the whole group.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) group: Option<String>,
    /// Name of the machine on which the frames were timed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) machine: Option<String>,
    /// Goals that `make bars-accuracy` checks; a missing limit means no goal.
    #[serde(default)]
    pub(crate) limits: Limits,
}

impl Study {
    /// The sets of a set's group, in the order of the description; the set alone if it is in no group.
    pub(crate) fn group(&self, of: &Set) -> impl Iterator<Item = &Set> {
        self.sets.iter().filter(move |s| s.name == of.name || (s.group.is_some() && s.group == of.group))
    }
}

impl Set {
    /// True if the frames of a split determine the upper bounds of predictors that are not cross-validated.
    pub(crate) fn bounds_are_of(&self, split: &SplitTables) -> bool {
        self.bounds.iter().any(|table| split.tables.contains(table))
    }
}

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SplitTables {
    /// Name of the split: `member`, `time step`, `modality`.
    pub(crate) name: String,
    pub(crate) tables: Vec<PathBuf>,
    /// True for the main split, to which all [`Limits`] except `modality` apply.
    #[serde(default)]
    pub(crate) main: bool,
}

/// Goals that `make bars-accuracy` checks.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Limits {
    /// Upper limit of RMSE/SD on the main split: of the selected predictor, or of the best one if none is
    /// selected.
    pub(crate) rmse_over_sd: Option<f64>,
    /// Lower limit of the constant baseline's RMSE divided by the RMSE of the predictor `paper`.
    pub(crate) constant_over_paper: Option<f64>,
    /// Lower limit of the RMSE of LVRP divided by that of the predictor `paper`.
    pub(crate) proxy_over_paper: Option<f64>,
    /// True if the bars of the calibration split apply.
    pub(crate) modality: bool,
    /// True if the bars on latency apply.
    pub(crate) latency: bool,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Named {
    /// Name in every table. Some bars apply to the predictor that is named `paper`.
    pub(crate) name: String,
    #[serde(default)]
    pub(crate) recipe: Recipe,
    /// True for boosted trees on the recipe's inputs: a reference that no model file can hold.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(crate) trees: bool,
    /// Sets for which the predictor is trained; default: all.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) sets: Vec<String>,
    /// Recipes that replace `recipe` for some sets, by name of the set: shading modes need different recipes.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub(crate) in_set: BTreeMap<String, Recipe>,
    /// The table in which the predictor is listed: `main`, `ablation`, `architecture`.
    #[serde(default = "main_panel")]
    pub(crate) panel: String,
    /// True if the predictor is cross-validated: for each fold of ensemble members, it is trained without the
    /// fold and evaluated on the fold. These errors determine the selection and the upper bounds. Used in the
    /// table `main` only.
    #[serde(default = "yes")]
    pub(crate) cross_validated: bool,
}

impl Named {
    pub(crate) fn is_of(&self, set: &str) -> bool {
        self.sets.is_empty() || self.sets.iter().any(|s| s == set)
    }

    pub(crate) fn recipe_for(&self, set: &str) -> &Recipe {
        self.in_set.get(set).unwrap_or(&self.recipe)
    }
}

/// Returns the name of the table in which a predictor is listed by default.
pub(super) fn main_panel() -> String {
    "main".into()
}

fn yes() -> bool {
    true
}

pub(crate) fn read(path: &Path) -> Result<Study> {
    let text = read_text(path, 16 << 20).with_context(|| format!("cannot read {}", path.display()))?;
    let mut study: Study =
        serde_json::from_str(&text).with_context(|| format!("{} is no study file", path.display()))?;
    let folder = path.parent().unwrap_or(Path::new("")).to_owned();
    let place = |p: &mut PathBuf| *p = folder.join(&*p);
    place(&mut study.latency_volume.0);
    for set in &mut study.sets {
        set.training.iter_mut().chain(&mut set.bounds).chain(&mut set.other_steps).for_each(place);
        set.splits.iter_mut().flat_map(|s| &mut s.tables).for_each(place);
        set.low_resolution.values_mut().for_each(place);
    }
    for p in &mut study.predictors {
        for recipe in p.in_set.values_mut().chain(std::iter::once(&mut p.recipe)) {
            recipe.volumenet.iter_mut().chain(&mut recipe.fine_tune).chain(&mut recipe.file).for_each(place);
        }
        if let Some(other) = p.in_set.keys().chain(&p.sets).find(|n| study.sets.iter().all(|s| s.name != **n))
        {
            bail!("{}: {} names the set {other:?}, which does not exist", path.display(), p.name);
        }
    }
    let mut names: Vec<&str> = study.predictors.iter().map(|p| p.name.as_str()).collect();
    names.sort_unstable();
    if let Some(twice) = names.windows(2).find(|w| w[0] == w[1]) {
        bail!("{}: the predictor {:?} appears twice", path.display(), twice[0]);
    }
    for Ship { predictor: name, .. } in &study.ship {
        ensure!(
            name == SELECTED || names.contains(&name.as_str()),
            "{}: ship names {name:?}, which is no predictor; {SELECTED:?} stands for the one that the rule selects",
            path.display()
        );
    }
    Ok(study)
}
