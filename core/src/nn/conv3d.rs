//! 3-D convolution in plain meaning.
//!
//! A block maps a tensor `x` of `Cin × n³` numbers to `Cout × m³`, m = (n + 2·padding − k) / stride + 1 (rounded down):
//!
//! ```text
//! y[o, z, y, x] = SELU( bias[o] + Σ_{i, a, b, c} weight[o, i, a, b, c] · x[i, z·stride + a − padding,
//!                                                                           y·stride + b − padding,
//!                                                                           x·stride + c − padding] )
//! ```
//!
//! where a, b, c run over 0 … k − 1 and x is 0 outside its edge.

use super::parts::ConvBlockParts;
use super::{SELU_ALPHA, SELU_SCALE};
use alloc::vec::Vec;

/// The definition above in float64, rounded to f32 at the end. Tensors are (C, D, H, W), the last axis fastest.
pub(crate) fn reference(block: &ConvBlockParts, x: &[f32], y: &mut Vec<f32>) {
    let (n, m, k) = (block.input_edge, block.output_edge, block.kernel);
    y.clear();
    let inside =
        |at: usize, tap: usize| (at * block.stride + tap).checked_sub(block.padding).filter(|&i| i < n);
    for o in 0..block.outputs {
        for z in 0..m {
            for row in 0..m {
                for column in 0..m {
                    let mut sum = f64::from(block.bias[o]);
                    for i in 0..block.inputs {
                        for a in 0..k {
                            let Some(iz) = inside(z, a) else { continue };
                            for b in 0..k {
                                let Some(iy) = inside(row, b) else { continue };
                                for c in 0..k {
                                    let Some(ix) = inside(column, c) else { continue };
                                    let w = block.weight[(((o * block.inputs + i) * k + a) * k + b) * k + c];
                                    sum += f64::from(w) * f64::from(x[((i * n + iz) * n + iy) * n + ix]);
                                }
                            }
                        }
                    }
                    let v = if sum > 0.0 { sum } else { SELU_ALPHA * libm::expm1(sum) };
                    y.push((SELU_SCALE * v) as f32);
                }
            }
        }
    }
}
