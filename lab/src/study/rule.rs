//! The rule that chooses a predictor. It sees errors of cross-validation and latencies, and no test frame.

use super::bars::{PAPER, SELECTED};
use super::description::main_panel;
use super::{Findings, Intervals, Named, Study};
use entire_cli::fit::Recipe;
use entire_cli::metrics::Metrics;
use entire_core::features::PROBE_SIDE;
use serde::Serialize;

/// How much worse than the least error of cross-validation the chosen predictor's may be.
pub(super) const TOLERANCE: f64 = 0.05;

/// What the rule knows of a predictor.
#[derive(Clone, Copy, Debug)]
pub(super) struct Contender {
    /// RMSE of cross-validation, in any unit that all share.
    pub(super) error: f64,
    /// Seconds of one prediction with cold caches.
    pub(super) cold: f64,
}

/// The rule: of those that take no longer than `longest` seconds, the quickest whose error is within
/// [`TOLERANCE`] of the least; the first of several that are as quick. `None` where none is quick enough.
pub(super) fn choose(contenders: &[Contender], longest: Option<f64>) -> Option<usize> {
    let quick = |c: &Contender| longest.is_none_or(|l| c.cold <= l) && c.error.is_finite();
    let least = contenders.iter().filter(|c| quick(c)).map(|c| c.error).fold(f64::INFINITY, f64::min);
    let good = |c: &Contender| quick(c) && c.error <= (1.0 + TOLERANCE) * least;
    let (place, _) = contenders
        .iter()
        .enumerate()
        .filter(|(_, c)| good(c))
        .min_by(|a, b| a.1.cold.total_cmp(&b.1.cold))?;
    Some(place)
}

/// The rule in a sentence, for a set's share of the latency of `paper`.
pub(super) fn sentence(cold_over_paper: Option<f64>) -> String {
    format!(
        "The rule takes the quickest predictor whose cross-validated RMSE is within {:.0} % of the least{}; \
         it sees no test frame.",
        100.0 * TOLERANCE,
        cold_over_paper.map_or(String::new(), |s| format!(
            " among those that take at most {:.0} % of the latency of `paper`",
            100.0 * s
        ))
    )
}

/// A recipe with every setting that counts and was left away written out.
fn written_out(recipe: &Recipe) -> Recipe {
    Recipe { probe_side: recipe.probe_side.or(Some(PROBE_SIDE)), ..recipe.clone() }
}

/// Whether two recipes make the same predictor of the same frames.
pub(super) fn same(a: &Recipe, b: &Recipe) -> bool {
    written_out(a) == written_out(b)
}

/// A recipe but for what says how its weights are found: predictors of the same shape are equally quick.
pub(super) fn shape(recipe: &Recipe) -> Recipe {
    let Recipe { loss, epochs, batch, learning_rate, final_learning_rate, clip, patience, seed, .. } =
        Recipe::default();
    Recipe {
        loss,
        epochs,
        batch,
        learning_rate,
        final_learning_rate,
        clip,
        patience,
        seed,
        ..written_out(recipe)
    }
}

/// Whether the rule may choose it in a set: it is cross-validated, a model file holds it, and it was made
/// from the set's training frames alone.
pub(super) fn may_choose(named: &Named, set: &str) -> bool {
    named.cross_validated
        && named.panel == main_panel()
        && !named.trees
        && named.recipe_for(set).file.is_none()
}

/// Longest latency that the rule accepts in a set, seconds; any where the set has no limit or the study no
/// `paper`.
pub(super) fn longest(study: &Study, found: &Findings, set: &str) -> Option<f64> {
    let share = study.sets.iter().find(|s| s.name == set)?.limits.cold_over_paper?;
    Some(share * found.latency(set, PAPER)?.cold)
}

/// The predictors of the study that the rule chooses among in a set. Of recipes that are there twice one
/// counts, `selected` where that is one of them.
pub(super) fn listed<'a>(study: &'a Study, set: &str) -> Vec<&'a Named> {
    let all: Vec<&Named> = study.predictors.iter().filter(|p| may_choose(p, set)).collect();
    let stands_for_its_recipe = |p: &Named| {
        let mut twins = all.iter().filter(|q| same(q.recipe_for(set), p.recipe_for(set)));
        let first = twins.clone().next();
        twins.find(|q| q.name == SELECTED).or(first).is_some_and(|q| q.name == p.name)
    };
    all.iter().copied().filter(|p| stands_for_its_recipe(p)).collect()
}

/// Those of them that were made and timed, with what the rule knows of them.
fn contenders<'a>(study: &'a Study, found: &Findings, set: &str) -> (Vec<&'a Named>, Vec<Contender>) {
    listed(study, set)
        .into_iter()
        .filter_map(|p| {
            let error = found.fit(set, &p.name)?.crossed.as_ref()?.rmse;
            Some((p, Contender { error, cold: found.latency(set, &p.name)?.cold }))
        })
        .unzip()
}

/// The predictor of the study that the rule chooses from all training members.
pub(super) fn by_rule<'a>(study: &'a Study, found: &Findings, set: &str) -> Option<&'a Named> {
    let (named, contenders) = contenders(study, found, set);
    choose(&contenders, longest(study, found, set)).map(|place| named[place])
}

/// What the rule chooses from all training members of a set.
#[derive(Clone, Debug, Serialize)]
pub struct Choice {
    /// The set.
    pub set: String,
    /// Among which: [`LISTED`] or [`GRID`].
    pub among: String,
    /// How many.
    pub candidates: usize,
    /// Longest latency that the rule accepts, seconds; any unless given.
    pub longest: Option<f64>,
    /// The predictor that it chooses.
    pub predictor: String,
    /// Its errors in cross-validation.
    pub crossed: Option<Metrics>,
    /// Intervals of these.
    pub crossed_intervals: Option<Intervals>,
    /// The predictor that ships, of those that the rule may choose.
    pub ships: Option<String>,
    /// Whether the two have the same recipe; `None` where nothing ships.
    pub same: Option<bool>,
}

/// The candidates that the study names.
pub const LISTED: &str = "named";
/// The candidates of the study's grid.
pub const GRID: &str = "grid";

impl Choice {
    /// A choice among so many, beside what ships.
    pub(super) fn new(
        (study, found): (&Study, &Findings),
        set: &str,
        (among, candidates): (&str, usize),
        taken: &Named,
        (crossed, crossed_intervals): (Option<Metrics>, Option<Intervals>),
    ) -> Self {
        let shipped = study
            .ship
            .iter()
            .filter_map(|s| study.predictors.iter().find(|p| p.name == s.predictor))
            .find(|p| may_choose(p, set));
        Self {
            set: set.to_owned(),
            among: among.to_owned(),
            candidates,
            longest: longest(study, found, set),
            predictor: taken.name.clone(),
            crossed,
            crossed_intervals,
            ships: shipped.map(|p| p.name.clone()),
            same: shipped.map(|p| same(p.recipe_for(set), taken.recipe_for(set))),
        }
    }

    /// In a sentence.
    pub fn sentence(&self) -> String {
        let longest = self
            .longest
            .map_or_else(|| "any latency".into(), |l| format!("{:.1} µs at most with cold caches", 1e6 * l));
        let errors = self.crossed.as_ref().map_or(String::new(), |m| {
            let i = self.crossed_intervals.as_ref();
            let (rmse, mdape) = (Intervals::beside_rmse(i, m), Intervals::beside_mdape(i, m));
            format!(" (cross-validated RMSE/SD {rmse}, median error {mdape} %)")
        });
        let ships = match (&self.ships, self.same) {
            (Some(_), Some(true)) => "; this is what ships".into(),
            (Some(name), _) => format!("; what ships is `{name}`"),
            _ => String::new(),
        };
        format!(
            "Of {} {} candidates ({longest}) the rule chooses `{}` from all training members{errors}{ships}.",
            self.candidates, self.among, self.predictor
        )
    }
}

/// The choice among the predictors that the study names.
pub(super) fn choice(study: &Study, found: &Findings, set: &str) -> Option<Choice> {
    let taken = by_rule(study, found, set)?;
    let fit = found.fit(set, &taken.name)?;
    let crossed = (fit.crossed.clone(), fit.crossed_intervals);
    let count = contenders(study, found, set).0.len();
    Some(Choice::new((study, found), set, (LISTED, count), taken, crossed))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quickest_of_the_good_ones_is_chosen_and_a_latency_that_is_too_long_never() {
        let of = |values: &[(f64, f64)]| {
            values.iter().map(|&(error, cold)| Contender { error, cold }).collect::<Vec<_>>()
        };
        let all = of(&[(1.0, 50.0), (1.04, 20.0), (1.3, 2.0), (f64::NAN, 1.0)]);
        assert_eq!(choose(&all, None), Some(1));
        // What is too slow does not set the least error either.
        assert_eq!(choose(&all, Some(20.0)), Some(1));
        assert_eq!(choose(&all, Some(19.9)), Some(2));
        assert_eq!(choose(&all, Some(1.5)), None);
        assert_eq!(choose(&of(&[(1.051, 1.0), (1.0, 2.0)]), None), Some(1));
        assert_eq!(choose(&of(&[(1.0, 2.0), (1.0, 2.0)]), None), Some(0));
        assert_eq!(choose(&[], None), None);
    }

    #[test]
    fn recipes_are_the_same_that_make_the_same_and_of_one_shape_that_are_equally_quick() {
        let recipe = Recipe { ensemble: 4, ..Recipe::default() };
        let said = Recipe { probe_side: Some(PROBE_SIDE), ..recipe.clone() };
        assert!(same(&recipe, &said) && shape(&recipe) == shape(&said));
        let loss = Recipe { loss: "huber:1".into(), ..recipe.clone() };
        assert!(!same(&recipe, &loss) && shape(&recipe) == shape(&loss));
        for other in [
            Recipe { probe_side: Some(4), ..recipe.clone() },
            Recipe { ensemble: 8, ..recipe.clone() },
            Recipe { layers: vec![8], ..recipe.clone() },
        ] {
            assert!(!same(&recipe, &other) && shape(&recipe) != shape(&other));
        }
    }
}
