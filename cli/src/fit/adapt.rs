//! A model taken to another renderer in closed form.

use super::analytic::fit_analytic;
use super::least_squares::{last_layer, standardized, weighted_least_squares};
use super::{FitContext, held};
use crate::dataset::Timed;
use crate::inputs::Layout;
use crate::train::Standardization;
use anyhow::{Context, Result, ensure};
use entire_core::calibrate::hidden_activations;
use entire_core::features::{SceneFeature, SceneQuantity};
use entire_core::model::{Key, ModelFile};
use entire_core::nn::{PredNetParts, Target};
use entire_core::predict::UnitCosts;
use indicatif::ProgressBar;

/// Share of a learned factor's weights that is expected to hold for another renderer, and what that weighs
/// per frame. These and [`SHRINKAGE`] were chosen by cross-validation over the training volumes of four
/// renderers.
const TRANSFERRED: f64 = 0.25;
const TRANSFER_RIDGE: f64 = 0.3;

/// Share of the logarithm of a factor fitted to a few frames that is taken.
const SHRINKAGE: f64 = 0.85;

/// Takes an analytic model times a learned factor to another renderer, from a few frames: unit costs are
/// solved anew, those of [`UnitCosts::CONVERTING`] among them, and the factor's last layer is fitted towards
/// a part of its weights, since what the model had wrong there is in part wrong here too. Frames that are
/// expected to be long weigh more, and of the factor that so few frames give a part is taken.
///
/// # Errors
/// For a model that is no analytic one times a learned factor, or when inputs cannot be computed.
pub fn transfer(file: &ModelFile, context: &FitContext<'_>, frames: Timed<'_>) -> Result<ModelFile> {
    let model = file.to_model()?;
    let layout = Layout::of_model(&model)?;
    let carried = layout.scene_features().last()
        == Some(&SceneFeature { quantity: SceneQuantity::EstimatedSeconds, log: true });
    let parts = model.prednet().context("the model file holds no PredNet")?;
    ensure!(
        carried && parts.target == Target::LogSeconds && model.metadata().contains_key(Key::UnitCosts.name()),
        "only an analytic model times a learned factor (--model-kind residual) can be transferred; fine-tune \
         this one"
    );
    let (analytic, _) = fit_analytic(context, frames, layout.probe_side(), &UnitCosts::CONVERTING)?;
    let mut out = file.clone();
    let layout = layout.with_unit_costs(analytic.costs());
    let rows = layout.rows(context.tables, frames.frames, context.pool, &ProgressBar::hidden())?;
    let rows = held(&model, &rows, layout.width())?;
    let scale = Standardization::of(parts);
    let mut parts = parts.clone();
    let last = parts.layers.last().context("the PredNet has no layer")?.clone();
    // The last unit holds the estimate, which stays as it is; the others hold the factor.
    let width = last.inputs - 1;
    let (estimate, factor) = (f64::from(last.weight[width]), &last.weight[..width]);
    let (mut hidden, mut y) = (Vec::new(), Vec::new());
    let activations = hidden_rows(&parts, &standardized(&rows, &scale), scale.input_mean.len());
    let inputs = scale.input_mean.len();
    let (mut importance, mut neutral) = (Vec::new(), 0.0);
    let standard = |log: f64| (log - f64::from(scale.output_mean)) / f64::from(scale.output_std);
    for ((row, seconds), input) in
        activations.chunks_exact(last.inputs).zip(frames.seconds).zip(rows.chunks_exact(inputs))
    {
        let expected = f64::from(input[inputs - 1]);
        hidden.extend_from_slice(&row[..width]);
        y.push(standard(seconds.ln()) - estimate * row[width]);
        importance.push((0.5 * expected).exp());
        // With this bias and no factor, the estimate is what comes out.
        neutral += (standard(expected) - estimate * row[width]) / frames.seconds.len() as f64;
    }
    let mean = importance.iter().sum::<f64>() / importance.len() as f64;
    importance.iter_mut().for_each(|w| *w /= mean);
    let mut prior: Vec<f64> = factor.iter().map(|&w| TRANSFERRED * f64::from(w)).collect();
    prior.push(neutral);
    let mut solution = weighted_least_squares(&hidden, width, &y, &importance, &prior, TRANSFER_RIDGE);
    solution[..width].iter_mut().for_each(|w| *w *= SHRINKAGE);
    solution[width] = neutral + SHRINKAGE * (solution[width] - neutral);
    if let Some(layer) = parts.layers.last_mut() {
        let fitted = last_layer(&solution);
        layer.weight[..width].copy_from_slice(&fitted.weight);
        layer.bias = fitted.bias;
    }
    layout.store(&parts, &mut out)?;
    Ok(out)
}

/// What enters the last layer, row after row.
fn hidden_rows(parts: &PredNetParts, x: &[f64], width: usize) -> Vec<f64> {
    x.chunks_exact(width).flat_map(|row| hidden_activations(parts, row.to_vec())).collect()
}
