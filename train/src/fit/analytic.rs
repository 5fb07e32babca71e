//! Unit costs of estimated work, fitted to measured frames.

use super::FitContext;
use crate::inputs::{Layout, seconds_of, work_of};
use anyhow::Result;
use entire_io::dataset::{Timed, TimedFrame};
use entire_steer::features::SceneFeature;
use entire_steer::predict::{AnalyticModel, COST_QUANTITIES, COSTS, GroupKind, Measurement, UnitCosts};
use indicatif::ProgressBar;

pub(super) fn fit_analytic(
    context: &FitContext<'_>,
    training: Timed<'_>,
    probe_side: usize,
) -> Result<(AnalyticModel, String)> {
    let default = &expected_costs(context, training);
    let measurements: Vec<Measurement> = counts(context, training, default, probe_side)?
        .iter()
        .zip(training.seconds)
        .map(|(row, &seconds)| Measurement { work: work_of(*row), seconds })
        .collect();
    let mut model = AnalyticModel::default().with_probe_side(probe_side);
    let report = model.fit(default, &measurements)?;
    let text = format!(
        "fitted to {} frames, {} refused, median error {:.2} %",
        report.used,
        report.refused,
        100.0 * report.median_error
    );
    Ok((model, text))
}

/// Returns the initial unit costs of a fit. They are the costs of a renderer that converts stored scalar
/// values, unless all frames were drawn by the project's raycaster or its CPU version, which do not convert
/// values.
pub fn expected_costs(context: &FitContext<'_>, part: Timed<'_>) -> UnitCosts {
    let own = |f: &&TimedFrame| {
        let manifest = context.tables.get(f.table).and_then(|t| t.manifest.as_ref());
        manifest.is_some_and(|m| ["vulkan", "cpu"].contains(&m.renderer.as_str()))
    };
    if part.frames.iter().all(own) { UnitCosts::SOFTWARE } else { UnitCosts::CONVERTING }
}

/// Returns the counts that are multiplied by unit costs, one row per frame; 0 for counts whose unit cost is
/// 0.
pub fn counts(
    context: &FitContext<'_>,
    part: Timed<'_>,
    costs: &UnitCosts,
    probe_side: usize,
) -> Result<Vec<[f32; COSTS - 1]>> {
    let asked: Vec<usize> = (0..COSTS - 1).filter(|i| costs.0[i + 1] > 0.0).collect();
    if asked.is_empty() {
        return Ok(vec![[0.0; COSTS - 1]; part.frames.len()]);
    }
    let features: Vec<SceneFeature> =
        asked.iter().map(|&i| SceneFeature { quantity: COST_QUANTITIES[i], log: false }).collect();
    let layout = Layout::new(&[GroupKind::SceneFeatures], features, 0, None)?.with_probe_side(probe_side);
    let rows = layout.rows(context.tables, part.frames, context.pool, &ProgressBar::hidden())?;
    Ok(rows
        .chunks_exact(asked.len())
        .map(|row| {
            let mut out = [0.0; COSTS - 1];
            for (&i, &value) in asked.iter().zip(row) {
                out[i] = value;
            }
            out
        })
        .collect())
}

pub(super) fn estimates(
    context: &FitContext<'_>,
    part: Timed<'_>,
    costs: &UnitCosts,
    probe_side: usize,
) -> Result<Vec<f64>> {
    Ok(counts(context, part, costs, probe_side)?.iter().map(|row| seconds_of(costs, row)).collect())
}
