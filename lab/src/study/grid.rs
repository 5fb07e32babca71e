//! Candidates by a stated grid: recipes of every combination of some settings, instead of a list that someone
//! drew up.

use super::{Named, Study};
use anyhow::{Context, Result, ensure};
use entire_cli::fit::Recipe;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};

/// The panel of candidates of the grid.
pub(super) const PANEL: &str = "grid";

/// Recipes that differ in some settings.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    /// Their names, with every setting that differs in braces: `factor {layers}, probe {probe_side}`.
    pub name: String,
    /// What they share.
    #[serde(default)]
    pub recipe: serde_json::Map<String, Value>,
    /// Values of each setting that differs.
    #[serde(default)]
    pub axes: BTreeMap<String, Vec<Value>>,
}

/// A setting's value within a name: 16-16.
fn short(value: &Value) -> String {
    match value {
        Value::String(s) => s.clone(),
        Value::Array(parts) => parts.iter().map(short).collect::<Vec<_>>().join("-"),
        other => other.to_string(),
    }
}

impl Grid {
    /// Every combination, the last setting varying fastest.
    fn predictors(&self) -> Result<Vec<Named>> {
        let mut all = vec![(self.name.clone(), self.recipe.clone())];
        for (setting, values) in &self.axes {
            let place = format!("{{{setting}}}");
            ensure!(self.name.contains(&place), "the name {:?} lacks {place}", self.name);
            ensure!(!values.is_empty(), "{setting} has no value");
            all = all
                .iter()
                .flat_map(|(name, recipe)| {
                    values.iter().map(|v| {
                        let mut recipe = recipe.clone();
                        recipe.insert(setting.clone(), v.clone());
                        (name.replace(&place, &short(v)), recipe)
                    })
                })
                .collect();
        }
        all.into_iter()
            .map(|(name, recipe)| {
                let recipe: Recipe =
                    serde_json::from_value(Value::Object(recipe)).with_context(|| name.clone())?;
                ensure!(
                    recipe.file.is_none() && recipe.volumenet.is_none() && recipe.fine_tune.is_none(),
                    "{name}: a candidate of a grid starts from no file"
                );
                recipe.features().with_context(|| name.clone())?;
                Ok(Named {
                    name,
                    recipe,
                    trees: false,
                    in_set: BTreeMap::new(),
                    panel: PANEL.into(),
                    cross_validated: true,
                })
            })
            .collect()
    }

    /// In a line: its name and the values of its settings.
    pub(super) fn sentence(&self) -> String {
        let axes: Vec<String> = self
            .axes
            .iter()
            .map(|(setting, values)| {
                format!("{setting} {}", values.iter().map(short).collect::<Vec<_>>().join(" / "))
            })
            .collect();
        if axes.is_empty() { self.name.clone() } else { format!("{}: {}", self.name, axes.join(", ")) }
    }
}

impl Study {
    /// The candidates of its grids.
    ///
    /// # Errors
    /// For a setting that is none, and for a name that stands there twice or is another predictor's.
    pub fn grid_predictors(&self) -> Result<Vec<Named>> {
        let mut all = Vec::new();
        for grid in &self.grid {
            all.extend(grid.predictors().with_context(|| format!("grid {:?}", grid.name))?);
        }
        let mut names = BTreeSet::new();
        for p in &all {
            ensure!(names.insert(&p.name), "the grid holds {:?} twice", p.name);
            let other =
                |q: &Named| q.name == p.name && (q.recipe != p.recipe || !q.in_set.is_empty() || q.trees);
            ensure!(
                !self.predictors.iter().any(other),
                "{:?} is a predictor of its own and, otherwise made, one of the grid",
                p.name
            );
        }
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_cli::fit::Kind;
    use serde_json::json;

    fn study(grid: Value, predictors: Value) -> Study {
        serde_json::from_value(json!({
            "title": "t", "latency_volume": ["v.nrrd", 1], "sets": [], "predictors": predictors, "grid": grid
        }))
        .unwrap()
    }

    #[test]
    fn a_grid_holds_every_combination_once_and_shares_what_does_not_differ() {
        let grid = json!([
            { "name": "factor {layers}, probe {probe_side}", "recipe": { "kind": "residual", "batch": 64 },
              "axes": { "probe_side": [4, 7], "layers": [[8], [16, 16]] } },
            { "name": "analytic", "recipe": { "kind": "analytic" } }
        ]);
        let same = json!([{ "name": "analytic", "recipe": { "kind": "analytic" } }]);
        let all = study(grid.clone(), same).grid_predictors().unwrap();
        let names: Vec<&str> = all.iter().map(|p| p.name.as_str()).collect();
        assert_eq!(
            names,
            [
                "factor 8, probe 4",
                "factor 8, probe 7",
                "factor 16-16, probe 4",
                "factor 16-16, probe 7",
                "analytic"
            ]
        );
        let last = &all[3].recipe;
        assert_eq!(
            (last.kind, last.batch, last.probe_side, &last.layers[..]),
            (Kind::Residual, 64, Some(7), &[16, 16][..])
        );
        let other = json!([{ "name": "analytic", "recipe": { "kind": "linear" } }]);
        let said = study(grid, other).grid_predictors().unwrap_err();
        assert!(format!("{said:#}").contains("otherwise made"), "{said:#}");
    }

    #[test]
    fn what_a_grid_may_not_say_is_refused() {
        let fails = |grid: Value| format!("{:#}", study(grid, json!([])).grid_predictors().unwrap_err());
        let unnamed = json!([{ "name": "a", "axes": { "batch": [1, 2] } }]);
        assert!(fails(unnamed).contains("lacks {batch}"));
        assert!(fails(json!([{ "name": "a {batch}", "axes": { "batch": [] } }])).contains("no value"));
        assert!(fails(json!([{ "name": "a", "recipe": { "what": 1 } }])).contains("unknown field"));
        assert!(fails(json!([{ "name": "a" }, { "name": "a" }])).contains("twice"));
        let file = json!([{ "name": "a", "recipe": { "file": "m.safetensors" } }]);
        assert!(fails(file).contains("starts from no file"));
    }
}
