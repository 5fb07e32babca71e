//! The trainable network: dense layers with SELU between them, parameters in one vector, forward and backward
//! passes.

use super::Real;
use super::matmul::{matrix, multiply, vectorized};
use anyhow::{Result, bail, ensure};
use entire_core::kernels::{SELU_ALPHA, SELU_SCALE};
use entire_core::nn::PredNetParts;
use rand::rngs::ChaCha8Rng;
use rand::{Rng, SeedableRng};

/// Largest number of layers that [`Network`] takes.
const MAX_LAYERS: usize = 1024;
/// Largest layer width that [`Network`] takes.
const MAX_WIDTH: usize = 65_536;

/// Dense layers, SELU after every one but the last (paper, section "PredNet: Rendering Time Prediction").
#[derive(Clone, Debug, PartialEq)]
pub struct Network<T> {
    widths: Vec<usize>,
    pub(super) parameters: Vec<T>,
}

/// Place of a layer's parameters in the vector of all parameters.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Span {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    weight: usize,
}

impl Span {
    fn weight(self) -> std::ops::Range<usize> {
        self.weight..self.weight + self.inputs * self.outputs
    }

    fn bias(self) -> std::ops::Range<usize> {
        let start = self.weight + self.inputs * self.outputs;
        start..start + self.outputs
    }
}

impl<T: Real> Network<T> {
    /// Returns a network with random weights, normal with mean 0 and variance 1/inputs (LeCun), as SELU
    /// needs, and biases 0. `widths` lists the layer widths from input to output.
    ///
    /// # Errors
    /// For fewer than two widths, a width of 0 or over 65 536, or over 1024 layers.
    pub fn random(widths: &[usize], seed: u64) -> Result<Self> {
        check_widths(widths)?;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut parameters = Vec::new();
        for pair in widths.windows(2) {
            let deviation = libm::sqrt(1.0 / pair[0] as f64);
            parameters.extend((0..pair[0] * pair[1]).map(|_| T::of(deviation * normal(&mut rng))));
            parameters.extend((0..pair[1]).map(|_| T::zero()));
        }
        Ok(Self { widths: widths.to_vec(), parameters })
    }

    /// Returns a network with the given layers: weights \[out, in\] by rows, and biases \[out\].
    ///
    /// # Errors
    /// When sizes do not fit together or a number is not finite.
    pub fn from_layers(inputs: usize, layers: &[(&[T], &[T])]) -> Result<Self> {
        let mut widths = vec![inputs];
        let mut parameters = Vec::new();
        for (i, (weight, bias)) in layers.iter().enumerate() {
            let (before, width) = (widths[i], bias.len());
            ensure!(
                before.checked_mul(width) == Some(weight.len()),
                "layer {i} has {} weights and {width} biases for {before} inputs; {width} x {before} \
                     weights are needed",
                weight.len()
            );
            if let Some(at) = weight.iter().chain(*bias).position(|v| !v.is_finite()) {
                bail!("layer {i} holds a NaN or an infinity (element {at})");
            }
            parameters.extend_from_slice(weight);
            parameters.extend_from_slice(bias);
            widths.push(width);
        }
        check_widths(&widths)?;
        Ok(Self { widths, parameters })
    }

    /// Returns the network of a model file, to be fine-tuned.
    ///
    /// # Errors
    /// When the parts do not fit together.
    pub fn from_parts(parts: &PredNetParts) -> Result<Self> {
        let real = |values: &[f32]| values.iter().map(|v| T::of(f64::from(*v))).collect::<Vec<T>>();
        let layers: Vec<_> = parts.layers.iter().map(|l| (real(&l.weight), real(&l.bias))).collect();
        let borrowed: Vec<(&[T], &[T])> = layers.iter().map(|(w, b)| (&w[..], &b[..])).collect();
        Self::from_layers(parts.layers.first().map_or(0, |layer| layer.inputs), &borrowed)
    }

    /// Layer widths from input to output.
    pub(crate) fn widths(&self) -> &[usize] {
        &self.widths
    }

    /// Number of layers.
    pub fn layers(&self) -> usize {
        self.widths.len() - 1
    }

    /// Returns the weights \[out, in\] by rows and the biases \[out\] of a layer.
    ///
    /// # Panics
    /// When there is no such layer.
    pub fn layer(&self, index: usize) -> (&[T], &[T]) {
        let span = self.span(index);
        (&self.parameters[span.weight()], &self.parameters[span.bias()])
    }

    /// All parameters, layer after layer. Each layer has its weights first, then its biases.
    pub fn parameters(&self) -> &[T] {
        &self.parameters
    }

    /// Returns the same network in another precision.
    pub fn cast<U: Real>(&self) -> Network<U> {
        Network {
            widths: self.widths.clone(),
            parameters: self.parameters.iter().map(|p| U::of(p.wide())).collect(),
        }
    }

    pub(crate) fn span(&self, index: usize) -> Span {
        let weight = self.widths.windows(2).take(index).map(|w| w[0] * w[1] + w[1]).sum();
        Span { inputs: self.widths[index], outputs: self.widths[index + 1], weight }
    }
}

fn check_widths(widths: &[usize]) -> Result<()> {
    if widths.len() < 2 || widths.len() > MAX_LAYERS + 1 {
        bail!("{} layers; between 1 and {MAX_LAYERS} are accepted", widths.len().saturating_sub(1));
    }
    if let Some(bad) = widths.iter().find(|&&w| w == 0 || w > MAX_WIDTH) {
        bail!("layer width {bad}; widths between 1 and {MAX_WIDTH} are accepted");
    }
    Ok(())
}

/// Returns a standard normal number (Box–Muller, one of the pair).
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let unit = |bits: u64| ((bits >> 11) as f64 + 0.5) * (1.0 / (1u64 << 53) as f64);
    let (u, v) = (unit(rng.next_u64()), unit(rng.next_u64()));
    libm::sqrt(-2.0 * libm::log(u)) * libm::cos(std::f64::consts::TAU * v)
}

/// Buffers for the rows of one task, and the gradient of the loss over these rows.
#[derive(Clone, Debug)]
pub(crate) struct Pass<T> {
    /// Number of rows that the buffers were made for.
    pub(crate) rows: usize,
    /// Output of every layer, [rows, width] each.
    activations: Vec<Vec<T>>,
    /// Gradient of the loss with respect to the output of a layer.
    delta: Vec<T>,
    /// Gradient of the loss with respect to the output of the layer before that of `delta`.
    next_delta: Vec<T>,
    /// Gradient of the loss with respect to the parameters, in the order of `Network::parameters`.
    pub(crate) gradient: Vec<T>,
}

impl<T: Real> Pass<T> {
    /// Returns buffers for `rows` rows. The buffers of the backward pass are empty unless `backward` is true.
    pub(crate) fn new(network: &Network<T>, rows: usize, backward: bool) -> Self {
        let widest = network.widths.iter().copied().max().unwrap_or(0);
        let delta = if backward { rows * widest } else { 0 };
        Self {
            rows,
            activations: network.widths[1..].iter().map(|w| vec![T::zero(); rows * w]).collect(),
            delta: vec![T::zero(); delta],
            next_delta: vec![T::zero(); delta],
            gradient: vec![T::zero(); if backward { network.parameters.len() } else { 0 }],
        }
    }

    pub(crate) fn output(&self) -> &[T] {
        match self.activations.last() {
            Some(last) => &last[..self.rows * (last.len() / self.rows.max(1))],
            None => &[],
        }
    }

    /// Runs rows through the network. `inputs` holds exactly the rows that the buffers were made for.
    pub(crate) fn forward(&mut self, network: &Network<T>, inputs: &[T]) {
        debug_assert_eq!(inputs.len(), self.rows * network.widths[0]);
        for i in 0..network.layers() {
            let span = network.span(i);
            let (before, here) = self.activations.split_at_mut(i);
            let x = before.last().map_or(inputs, Vec::as_slice);
            let y = &mut here[0];
            let weight = &network.parameters[span.weight()];
            multiply(
                matrix(x, self.rows, span.inputs),
                matrix(weight, span.outputs, span.inputs).reversed_axes(),
                y,
            );
            let bias = &network.parameters[span.bias()];
            vectorized(|| {
                for row in y.chunks_exact_mut(span.outputs) {
                    for (v, b) in row.iter_mut().zip(bias) {
                        *v += *b;
                    }
                }
            });
            if i + 1 < network.layers() {
                T::selu(y);
            }
        }
    }

    /// Computes the gradient of a loss whose derivative with respect to the outputs is `output_delta`, and
    /// writes it to `gradient`. [`Pass::forward`] must have been called with the same inputs.
    pub(crate) fn backward(&mut self, network: &Network<T>, inputs: &[T], output_delta: &[T]) {
        self.delta[..output_delta.len()].copy_from_slice(output_delta);
        for i in (0..network.layers()).rev() {
            let span = network.span(i);
            let x = if i == 0 { inputs } else { &self.activations[i - 1] };
            let delta = &self.delta[..self.rows * span.outputs];
            multiply(
                matrix(delta, self.rows, span.outputs).reversed_axes(),
                matrix(x, self.rows, span.inputs),
                &mut self.gradient[span.weight()],
            );
            let bias = &mut self.gradient[span.bias()];
            bias.fill(T::zero());
            vectorized(|| {
                for row in delta.chunks_exact(span.outputs) {
                    for (b, d) in bias.iter_mut().zip(row) {
                        *b += *d;
                    }
                }
            });
            if i > 0 {
                let next = &mut self.next_delta[..self.rows * span.inputs];
                multiply(
                    matrix(delta, self.rows, span.outputs),
                    matrix(&network.parameters[span.weight()], span.outputs, span.inputs),
                    next,
                );
                // SELU's slope from its output y: `scale` if y > 0, else y + `floor`.
                let (scale, floor) = (T::of(SELU_SCALE), T::of(SELU_SCALE * SELU_ALPHA));
                vectorized(|| {
                    for (d, y) in next.iter_mut().zip(x) {
                        *d *= if *y > T::zero() { scale } else { *y + floor };
                    }
                });
                std::mem::swap(&mut self.delta, &mut self.next_delta);
            }
        }
    }
}
