//! Networks composed of networks: the mean of an ensemble, and the sum of an estimate and a network's output.

use anyhow::{Context, Result, ensure};
use entire_core::kernels::SELU_SCALE;
use entire_core::nn::{DenseParts, Normalization, PredNetParts, Target};

/// Returns a network that computes the mean of several networks with equal widths and standardization: their
/// hidden layers side by side, and a last layer over all of them.
pub(super) fn side_by_side(members: Vec<PredNetParts>) -> Result<PredNetParts> {
    let count = members.len();
    let mut members = members.into_iter();
    let mut out = members.next().context("the ensemble has no network")?;
    let rest: Vec<PredNetParts> = members.collect();
    let depth = out.layers.len();
    for (i, layer) in out.layers.iter_mut().enumerate() {
        let (first, last) = (i == 0, i + 1 == depth);
        let parts: Vec<&DenseParts> = rest.iter().map(|m| &m.layers[i]).collect();
        let (width, height) = (layer.inputs, layer.outputs);
        ensure!(
            parts.iter().all(|p| p.inputs == width && p.outputs == height),
            "networks of different widths cannot form an ensemble"
        );
        let blocks: Vec<&DenseParts> = std::iter::once(&*layer).chain(parts).collect();
        let (inputs, outputs) =
            (if first { width } else { width * count }, if last { height } else { height * count });
        let share = if last { 1.0 / count as f32 } else { 1.0 };
        let mut weight = vec![0.0; inputs * outputs];
        let mut bias = vec![0.0; outputs];
        for (b, block) in blocks.iter().enumerate() {
            for (r, row) in block.weight.chunks_exact(width).enumerate() {
                let at = (if last { r } else { b * height + r }) * inputs + if first { 0 } else { b * width };
                // In a network of one layer, all members use the same columns, so their weights are added.
                for (w, v) in weight[at..at + width].iter_mut().zip(row) {
                    *w += share * v;
                }
                bias[if last { r } else { b * height + r }] += share * block.bias[r];
            }
        }
        *layer = DenseParts { inputs, outputs, weight, bias, dtype: layer.dtype };
    }
    Ok(out)
}

/// Range below the mean of the estimate's logarithm, in standard deviations, within which the added units
/// pass the logarithm on exactly.
const CARRY_RANGE: f32 = 12.0;

/// Returns a network whose output is that of `parts`, which predicts log ratios, plus the logarithm of an
/// estimate. The logarithm is the last input, with the given mean and standard deviation. One additional unit
/// in each hidden layer passes the logarithm on, shifted so far above zero that SELU is linear there. The
/// last layer removes the shift and SELU's factor.
pub(super) fn carry_past(parts: PredNetParts, mean: f32, sd: f32) -> PredNetParts {
    let (out_mean, out_std) = match &parts.output {
        Some(n) => (n.mean[0], n.std[0]),
        None => (0.0, 1.0),
    };
    let depth = parts.layers.len();
    let mut layers = Vec::with_capacity(depth);
    for (i, layer) in parts.layers.iter().enumerate() {
        let (first, last) = (i == 0, i + 1 == depth);
        let (inputs, outputs) = (layer.inputs + 1, layer.outputs + usize::from(!last));
        let mut weight = Vec::with_capacity(inputs * outputs);
        let mut bias = layer.bias.clone();
        for row in layer.weight.chunks_exact(layer.inputs) {
            weight.extend_from_slice(row);
            weight.push(0.0);
        }
        // The unit's value is gain · (z + shift), where z is the standardized logarithm of the estimate.
        let gain = SELU_SCALE.powi(i as i32);
        let shift = if first { 0.0 } else { f64::from(CARRY_RANGE) };
        if last {
            let scale = f64::from(sd) / f64::from(out_std);
            if let Some(w) = weight.last_mut() {
                *w = (scale / gain) as f32;
            }
            bias[0] = (f64::from(bias[0]) - shift * scale + f64::from(mean) / f64::from(out_std)) as f32;
        } else {
            weight.extend(std::iter::repeat_n(0.0, layer.inputs));
            weight.push(1.0);
            bias.push(if first { CARRY_RANGE } else { 0.0 });
        }
        layers.push(DenseParts { inputs, outputs, weight, bias, dtype: layer.dtype });
    }
    let width = layers[0].inputs - 1;
    let mut input = parts.input.unwrap_or(Normalization { mean: vec![0.0; width], std: vec![1.0; width] });
    input.mean.push(mean);
    input.std.push(sd);
    PredNetParts {
        layers,
        input: Some(input),
        output: Some(Normalization { mean: vec![out_mean], std: vec![out_std] }),
        target: Target::LogSeconds,
    }
}
