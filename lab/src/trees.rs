//! Gradient-boosted trees of the crate forust-ml. Studies use them as a reference: no model file can hold
//! them, and no renderer can use them.

use anyhow::{Result, anyhow, ensure};
use entire_core::model::Model;
use entire_io::dataset::Timed;
use entire_steer::predict::{Inputs, load};
use entire_train::fit::{FitContext, Kind, Recipe, predict};
use entire_train::inputs::Layout;
use forust_ml::metric::Metric;
use forust_ml::objective::ObjectiveType;
use forust_ml::{GradientBooster, Matrix};
use indicatif::ProgressBar;

/// Maximum number of trees.
const TREES: usize = 1500;

/// Learning rate: the factor on the output of each tree.
const LEARNING_RATE: f32 = 0.05;

/// Number of trees without a better validation error after which growing stops.
const STOPPING_TREES: usize = 60;

/// Trees that predict ln(seconds) or, for residual recipes, the residual of an analytic model.
pub(crate) struct Trees {
    layout: Layout,
    analytic: Option<Model>,
    booster: GradientBooster,
}

impl Trees {
    /// Grows trees on a recipe's inputs; validation frames, if there are any, determine the number of trees.
    pub(crate) fn fit(
        recipe: &Recipe,
        context: &FitContext<'_>,
        training: Timed<'_>,
        validation: Timed<'_>,
    ) -> Result<Self> {
        ensure!(!training.frames.is_empty(), "there are no training frames");
        let costs = Recipe { kind: Kind::Analytic, probe_side: recipe.probe_side, ..Recipe::default() };
        let analytic = match recipe.kind {
            Kind::Residual => Some(costs.make(context, training, validation)?.file.to_model()?),
            _ => None,
        };
        let (_, layout) = recipe.layout(training)?;
        let width = layout.width();
        let prepared = |part: Timed<'_>| -> Result<(Vec<f64>, Vec<f64>, Vec<f64>)> {
            let rows = layout.rows(context.tables, part.frames, context.pool, &ProgressBar::hidden())?;
            let mut logs: Vec<f64> = part.seconds.iter().map(|t| t.ln()).collect();
            if let Some(model) = &analytic {
                let estimates = predict(model, context, part.frames)?;
                logs.iter_mut().zip(estimates).for_each(|(log, t)| *log -= t.ln());
            }
            Ok((by_columns(&rows, width), vec![1.0; logs.len()], logs))
        };
        let (x, ones, y) = prepared(training)?;
        let (vx, v_ones, vy) = prepared(validation)?;
        let judged =
            (!vy.is_empty()).then(|| vec![(Matrix::new(&vx, vy.len(), width), &vy[..], &v_ones[..])]);
        let mut booster = GradientBooster::default()
            .set_objective_type(ObjectiveType::SquaredLoss)
            .set_evaluation_metric(Some(Metric::RootMeanSquaredError))
            .set_iterations(TREES)
            .set_learning_rate(LEARNING_RATE)
            .set_early_stopping_rounds(judged.is_some().then_some(STOPPING_TREES));
        context
            .pool
            .install(|| booster.fit(&Matrix::new(&x, y.len(), width), &y, &ones, judged))
            .map_err(|e| anyhow!("boosted trees: {e}"))?;
        Ok(Self { layout, analytic, booster })
    }

    pub(crate) fn predict(
        &self,
        context: &FitContext<'_>,
        frames: &[&entire_io::dataset::TimedFrame],
    ) -> Result<Vec<f64>> {
        let rows = self.layout.rows(context.tables, frames, context.pool, &ProgressBar::hidden())?;
        let columns = by_columns(&rows, self.layout.width());
        let logs = self.booster.predict(&Matrix::new(&columns, frames.len(), self.layout.width()), false);
        let factors = logs.into_iter().map(f64::exp);
        Ok(match &self.analytic {
            Some(model) => predict(model, context, frames)?.iter().zip(factors).map(|(t, f)| t * f).collect(),
            None => factors.collect(),
        })
    }

    /// Returns a function that predicts the seconds of one frame. It fails if an input is missing.
    pub(crate) fn predictor(&self) -> Result<impl FnMut(&Inputs<'_>) -> Result<f64> + '_> {
        let mut analytic = self.analytic.as_ref().map(load).transpose()?;
        Ok(move |inputs: &Inputs<'_>| {
            let mut row = vec![0.0; self.layout.width()];
            self.layout.write(inputs, &mut row)?;
            let row: Vec<f64> = row.into_iter().map(f64::from).collect();
            let factor = self.booster.predict(&Matrix::new(&row, 1, row.len()), false)[0].exp();
            Ok(match &mut analytic {
                Some(model) => factor * f64::from(model.predict(inputs)?.seconds),
                None => factor,
            })
        })
    }

    /// Number of rays along each side of the probe.
    pub(crate) fn probe_side(&self) -> usize {
        self.layout.probe_side()
    }
}

fn by_columns(rows: &[f32], width: usize) -> Vec<f64> {
    let count = rows.len() / width;
    let mut out = vec![0.0; rows.len()];
    for (i, row) in rows.chunks_exact(width).enumerate() {
        for (k, &v) in row.iter().enumerate() {
            out[k * count + i] = f64::from(v);
        }
    }
    out
}
