//! Unit costs of estimated work, fitted to measured frames.

use super::FitContext;
use crate::inputs::{Layout, depends_on, work_of};
use anyhow::Result;
use entire_io::dataset::{Table, Timed};
use entire_io::metrics::median;
use entire_io::options::names_software;
use entire_steer::features::SceneFeature;
use entire_steer::predict::{AnalyticModel, COST_QUANTITIES, COSTS, GroupKind, UnitCosts};
use indicatif::ProgressBar;
use std::collections::BTreeSet;

/// Typical unit costs of a software renderer that looks stored values up in tables.
const CONVERSION: UnitCosts = UnitCosts::OF_UNKNOWN[0];

pub(super) fn fit_analytic(
    context: &FitContext<'_>,
    training: Timed<'_>,
    probe_side: usize,
) -> Result<(AnalyticModel, String)> {
    let default = &expected_costs(context, training);
    let measurements: Vec<([f64; COSTS], f64)> = counts(context, training, default, probe_side)?
        .iter()
        .zip(training.seconds)
        .map(|(row, &seconds)| (work_of(*row), seconds))
        .collect();
    let (model, mut errors) = AnalyticModel::fit(default, &measurements, probe_side)?;
    let text = format!(
        "fitted to {} frames, {} refused, median error {:.2} %",
        errors.len(),
        measurements.len() - errors.len(),
        100.0 * median(&mut errors).unwrap_or(f64::NAN)
    );
    Ok((model, text))
}

/// Returns the typical unit costs of a renderer with this backend on this device. The project's raycaster has
/// the costs of a GPU or of a software renderer; any other renderer is assumed to run in software and to
/// convert stored scalar values.
pub fn typical_costs(backend: &str, device: &str) -> UnitCosts {
    match backend {
        "vulkan" | "cpu" if names_software(backend, device) => UnitCosts::SOFTWARE,
        "vulkan" => UnitCosts::GPU,
        _ => CONVERSION,
    }
}

/// Returns the [typical costs](typical_costs) of the renderer that drew the frames of all tables. For
/// renderers of several kinds, returns the costs of a software renderer: with a cost for the conversion of
/// stored values, or without it if the project's raycaster drew all frames.
pub fn typical_costs_of<'a>(tables: impl IntoIterator<Item = &'a Table>) -> UnitCosts {
    let of = |table: &Table| {
        let manifest = table.manifest.as_ref();
        manifest.map_or(CONVERSION, |m| typical_costs(&m.renderer, &m.device))
    };
    let merged = tables.into_iter().map(of).reduce(|a, b| match [a, b] {
        [a, b] if a == b => a,
        both if both.contains(&CONVERSION) => CONVERSION,
        _ => UnitCosts::SOFTWARE,
    });
    merged.unwrap_or(UnitCosts::SOFTWARE)
}

/// Returns the initial unit costs of a fit: the [typical costs](typical_costs_of) of the frames' tables.
pub fn expected_costs(context: &FitContext<'_>, part: Timed<'_>) -> UnitCosts {
    let used: BTreeSet<usize> = part.frames.iter().map(|f| f.table).collect();
    typical_costs_of(used.iter().filter_map(|&table| context.tables.get(table)))
}

/// Returns the counts that are multiplied by unit costs, one row per frame; 0 for counts on which the
/// time does not depend.
pub fn counts(
    context: &FitContext<'_>,
    part: Timed<'_>,
    costs: &UnitCosts,
    probe_side: usize,
) -> Result<Vec<[f32; COSTS - 1]>> {
    let asked: Vec<usize> = (0..COSTS - 1).filter(|&i| depends_on(costs, i)).collect();
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
    Ok(counts(context, part, costs, probe_side)?.iter().map(|row| costs.time(&work_of(*row))).collect())
}
