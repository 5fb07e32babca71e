//! The rule that selects a predictor: by cross-validation on the training tables, without test frames.

use super::description::{SELECTED, main_panel};
use super::{Findings, Named, Study};
use entire_core::model::Model;
use entire_core::scene::Shading;
use entire_steer::predict::{AnalyticModel, InputLayout, UnitCosts};

/// A predictor beats another one if its error of cross-validation is below this factor times the other's.
pub(super) const MAX_ERROR_RATIO: f64 = 0.95;

pub(crate) const SENTENCE: &str = "Rule of selection: a predictor is excluded if another predictor's error is more than 5 % lower on \
     the tables of every machine; of the others, the one with the fewest fitted parameters is selected (if several have the \
     same number, the one with the fewest rays). The error is the geometric mean of median error and RMSE/SD in \
     cross-validation by ensemble member, each without the noise of the measured times. Test frames are not used.";

/// A predictor with the data that the rule uses.
#[derive(Clone, Debug)]
struct Contender {
    /// Error of cross-validation on the tables of each machine.
    errors: Vec<f64>,
    /// Number of fitted parameters, then number of rays along each side of the probe.
    size: (usize, usize),
}

/// Index of the smallest contender (of equal ones, the first) that no other one beats on every machine.
fn choose(contenders: &[Contender]) -> Option<usize> {
    let beats =
        |a: &Contender, b: &Contender| a.errors.iter().zip(&b.errors).all(|(a, b)| *a < MAX_ERROR_RATIO * b);
    let good = |c: &&(usize, &Contender)| !contenders.iter().any(|other| beats(other, c.1));
    contenders.iter().enumerate().filter(|c| good(&c)).min_by_key(|c| c.1.size).map(|c| c.0)
}

/// True if the rule may select the predictor: it is cross-validated, can be stored in a model file, and is
/// trained on the set's training frames only.
fn may_choose(named: &Named, set: &str) -> bool {
    named.cross_validated
        && named.is_of(set)
        && named.panel == main_panel()
        && !named.trees
        && named.recipe_for(set).file.is_none()
}

/// The predictor that the rule selects for a set, by the errors of cross-validation in all sets of its group.
pub(crate) fn by_rule<'a>(study: &'a Study, found: &Findings, set: &str) -> Option<&'a Named> {
    let of = study.sets.iter().find(|s| s.name == set)?;
    let group: Vec<&str> = study.group(of).map(|s| s.name.as_str()).collect();
    let (named, contenders): (Vec<&Named>, Vec<Contender>) = study
        .predictors
        .iter()
        .filter(|p| group.iter().all(|set| may_choose(p, set)))
        .filter_map(|p| {
            let mut errors = Vec::new();
            for set in &group {
                let error = found.fit(set, &p.name)?.error()?;
                errors.push(if error.is_finite() { error } else { f64::INFINITY });
            }
            let fit = found.fit(set, &p.name)?;
            Some((p, Contender { errors, size: (fit.numbers, fit.probe_side) }))
        })
        .unzip();
    choose(&contenders).map(|place| named[place])
}

/// Returns the predictor that ships under `name`; for `selected`, the one that the rule selects.
pub(crate) fn shipped<'a>(study: &'a Study, found: &Findings, set: &str, name: &'a str) -> Option<&'a str> {
    if name == SELECTED { by_rule(study, found, set).map(|p| p.name.as_str()) } else { Some(name) }
}

/// Number of fitted parameters in a model for a shading mode: weights and biases of its network that are not
/// zero, and unit costs of work that occurs in frames of this mode.
pub(super) fn numbers(model: &Model, shading: Shading) -> usize {
    let held = |quantity: &str| match quantity {
        "local_samples" | "far_local_samples" => shading.is_lit(),
        name if name == "scatter_samples" || name.contains("shadow_samples") => shading.scatters(),
        _ => true,
    };
    let of_costs = |costs: &UnitCosts| costs.named().filter(|(name, c)| *c > 0.0 && held(name)).count();
    if let Ok(Some(analytic)) = AnalyticModel::from_model(model) {
        return of_costs(&analytic.costs());
    }
    let layers = model.prednet.as_ref().map_or(&[][..], |p| &p.layers);
    let counted = |values: &[f32]| values.iter().filter(|v| **v != 0.0).count();
    let weights: usize = layers.iter().map(|l| counted(&l.weight) + counted(&l.bias)).sum();
    let costs = InputLayout::of_model(model).ok().and_then(|l| l.unit_costs);
    weights + costs.map_or(0, |costs| of_costs(&costs))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smallest_is_chosen_that_none_beats_on_every_machine() {
        let of = |values: &[([f64; 2], usize, usize)]| {
            let contender = |&(errors, numbers, side): &([f64; 2], usize, usize)| Contender {
                errors: errors.to_vec(),
                size: (numbers, side),
            };
            values.iter().map(contender).collect::<Vec<_>>()
        };
        // The error of the larger predictor is 10 % lower on one machine only.
        assert_eq!(choose(&of(&[([1.0, 1.0], 15, 11), ([0.9, 0.98], 400, 11)])), Some(0));
        assert_eq!(choose(&of(&[([1.0, 1.0], 15, 11), ([0.9, 0.94], 400, 11)])), Some(1));
        // Of equally large predictors that no other one beats on every machine, the one with the fewest rays
        // is chosen.
        assert_eq!(choose(&of(&[([1.0, 1.0], 15, 11), ([1.03, 1.2], 15, 7), ([1.3, 1.3], 15, 4)])), Some(1));
        assert_eq!(choose(&of(&[([f64::INFINITY, 1.0], 1, 1), ([1.0, 0.9], 9, 9)])), Some(1));
        assert_eq!(choose(&[]), None);
    }
}
