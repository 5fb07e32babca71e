//! A convolution block in plain float64 loops: the reference in tests of the kernels.

use super::parts::ConvBlockParts;
use crate::kernels::{SELU_ALPHA, SELU_SCALE};
use alloc::vec::Vec;

/// Returns the block's output: SELU(convolution of `x` + bias), see [`VolumeNet`](super::VolumeNet). Tensors
/// have the axes (channel, z, y, x), the last axis fastest.
pub(crate) fn reference(block: &ConvBlockParts, x: &[f64]) -> Vec<f64> {
    let (n, m, k) = (block.input_edge, block.output_edge, block.kernel);
    let inside =
        |at: usize, tap: usize| (at * block.stride + tap).checked_sub(block.padding).filter(|&i| i < n);
    let mut y = Vec::with_capacity(block.outputs * m * m * m);
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
                                    sum += f64::from(w) * x[((i * n + iz) * n + iy) * n + ix];
                                }
                            }
                        }
                    }
                    y.push(SELU_SCALE * if sum > 0.0 { sum } else { SELU_ALPHA * libm::expm1(sum) });
                }
            }
        }
    }
    y
}
