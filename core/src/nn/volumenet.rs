//! VolumeNet's encoder: reduces a volume to a short feature vector.

use super::Resampler;
use super::parts::{ConvBlockParts, VolumeNetParts};
use super::resample::Exact;
use crate::Result;
use crate::error::bail;
use crate::kernels::conv::{Block, Encoder, PreparedPlane, Scratch, Shape};
use crate::kernels::mlp::Dense;
use crate::kernels::resample::{Affine, Raw, Scalar};
use crate::kernels::{Executor, Level};
use crate::memory::{collected, resize};
use crate::scene::{Scalars, VolumeView};
use alloc::vec::Vec;

/// Bound on the error of [`VolumeNet::encode`]'s features against a float64 evaluation of the same weights on
/// the same volume, as a fraction of the feature vector's Euclidean norm.
pub const VOLUMENET_TOLERANCE: f64 = 1e-4;

/// Limit on an encoder's memory, in bytes (2 GiB): its packed weights and the working memory of one thread.
/// The resampled cube, at most 512 MiB for a model file, is not included. A model file whose sizes need more
/// is refused before this memory is allocated; the result of this check is the same on every level.
pub(crate) const MAX_ENCODER_MEMORY: u64 = 2 << 30;

/// Working memory of an encoding, made by [`VolumeNet::scratch`]; one per calling thread. Empty until the
/// first encoding.
#[derive(Clone, Debug)]
pub struct EncodeScratch {
    resampler: Resampler,
    cube: Vec<f32>,
    encoder: Scratch,
}

/// The encoder, ready to run: blocks of convolution (batch normalization folded in) and SELU, then one dense
/// layer (paper, section on the volume network). The kernel edge and the stride are at most the edge of the
/// padded input. In a model file, the padding is below the kernel edge.
///
/// The input is the volume mapped to [0, 1] over its range, resampled to a cube of
/// [`input`](VolumeNetParts::input)³ voxels (see [`Resampler`]) and mapped to [-1, 1]; its axes are (D, H, W)
/// = (z, y, x). A block with a kernel of k³ taps maps a tensor `in` of `Cin × n³` values to a tensor
/// `out` of `Cout × m³` values, where m = (n + 2·padding − k) / stride + 1, rounded down:
///
/// ```text
/// out[o, z, y, x] = SELU( bias[o] + Σ_{i, a, b, c} weight[o, i, a, b, c] · in[i, z·stride + a − padding,
///                                                                              y·stride + b − padding,
///                                                                              x·stride + c − padding] )
/// ```
///
/// where i runs over 0 … Cin − 1; a, b and c run over 0 … k − 1; `in` is 0 at positions outside 0 … n − 1.
/// The last block's output, flattened in the order (channel, z, y, x), is the input of the dense layer, which
/// has no activation.
#[derive(Clone, Debug)]
pub struct VolumeNet {
    input: usize,
    features: usize,
    level: Level,
    encoder: Encoder,
}

impl VolumeNet {
    /// Builds the network for this CPU's best level.
    ///
    /// # Errors
    /// [`InvalidTensor`](crate::ErrorKind::InvalidTensor) if blocks do not fit together;
    /// [`InvalidModel`](crate::ErrorKind::InvalidModel) for an encoder that needs more than 2 GiB;
    /// [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if its weights cannot be allocated.
    pub fn new(parts: &VolumeNetParts) -> Result<Self> {
        Self::with(parts, Level::detect())
    }

    /// Builds the network for a given level.
    ///
    /// # Errors
    /// As [`VolumeNet::new`].
    pub fn with(parts: &VolumeNetParts, level: Level) -> Result<Self> {
        check(parts)?;
        let blocks = collected(parts.blocks.iter().map(|b| Block {
            inputs: b.inputs,
            outputs: b.outputs,
            shape: Shape {
                input: b.input_edge,
                output: b.output_edge,
                kernel: b.kernel,
                stride: b.stride,
                padding: b.padding,
            },
            weight: &b.weight,
            bias: &b.bias,
        }))?;
        let fc = &parts.fc;
        let head = Dense { inputs: fc.inputs, outputs: fc.outputs, weight: &fc.weight, bias: &fc.bias };
        let encoder = Encoder::new(&blocks, &head, level)?;
        Ok(Self { input: parts.input, features: parts.fc.outputs, level, encoder })
    }

    /// Number of features.
    pub fn feature_len(&self) -> usize {
        self.features
    }

    /// Creates empty working memory for [`encode`](Self::encode), which allocates it when needed.
    pub fn scratch(&self) -> EncodeScratch {
        EncodeScratch { resampler: Resampler::new(self.level), cube: Vec::new(), encoder: Scratch::default() }
    }

    /// Writes the volume's features to `features`.
    ///
    /// A volume that already has the input's size and contiguous rows is read in place; any other is
    /// resampled to a cube of floats in the scratch. The same volume, range, network and level give the same
    /// bits for every executor. Allocates only in the first call with this scratch, after a call of another
    /// network with it, in the first call that resamples, and in a call with longer rows or more threads than
    /// every earlier call.
    ///
    /// # Errors
    /// [`SizeMismatch`](crate::ErrorKind::SizeMismatch) unless `features` holds
    /// [`feature_len`](Self::feature_len) values; [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the
    /// working memory cannot be allocated; [`InvalidArgument`](crate::ErrorKind::InvalidArgument) for a
    /// volume that [`Resampler::resample`] refuses.
    pub fn encode(
        &self,
        view: &VolumeView<'_>,
        scratch: &mut EncodeScratch,
        executor: Executor<'_>,
        features: &mut [f32],
    ) -> Result<()> {
        let (n, given, room) = (self.input, self.features, features.len());
        if room != given {
            bail!(SizeMismatch, "VolumeNet gives {given} features, the output holds {room} numbers");
        }
        let encoder = &mut scratch.encoder;
        if view.dims() == [n; 3] && view.strides()[0] == 1 {
            let mut run = |prepare: &(dyn Fn(usize, &mut PreparedPlane<'_>) + Sync),
                           encoder: &mut Scratch| {
                self.encoder.run(prepare, encoder, executor, features)
            };
            return match view.scalars() {
                Scalars::U8(s) => run(&|z, plane| in_place(view, s, z, plane), encoder),
                Scalars::U16(s) => run(&|z, plane| in_place(view, s, z, plane), encoder),
                Scalars::I16(s) => run(&|z, plane| in_place(view, s, z, plane), encoder),
                Scalars::F32(s) => run(&|z, plane| in_place(view, s, z, plane), encoder),
            };
        }
        if scratch.cube.len() != n * n * n {
            scratch.cube.clear();
            resize(&mut scratch.cube, n * n * n, 0.0)?;
        }
        scratch.resampler.resample(view, n, &mut scratch.cube, executor)?;
        let cube = scratch.cube.as_slice();
        self.encoder.run(&|z, plane| plane.fill(cube, z * n * n, n, Raw), encoder, executor, features)
    }
}

/// Prepares plane `z` of a volume that is read without resampling.
fn in_place<T: Scalar>(view: &VolumeView<'_>, scalars: &[T], z: usize, plane: &mut PreparedPlane<'_>) {
    let [_, row, slice] = view.strides();
    match Affine::of(view.range()) {
        Some(map) => plane.fill(scalars, z * slice, row, map),
        None => plane.fill(scalars, z * slice, row, Exact(view)),
    }
}

/// Returns an upper bound of the bytes of an encoder's packed weights and of one thread's working memory, for
/// the widest vectors of any level. Sums saturate.
fn memory(parts: &VolumeNetParts) -> u64 {
    /// Floats per vector and per cache line.
    const LANES: u128 = 16;
    const ROW: u128 = 2 * LANES;
    let wide = |n: usize| n as u128;
    let product = |factors: &[u128]| factors.iter().fold(1u128, |p, &f| p.saturating_mul(f));
    let cube = |edge: u128| product(&[edge; 3]);
    let (mut floats, mut last) = (0u128, 0u128);
    for (i, block) in parts.blocks.iter().enumerate() {
        let (input, output) = (wide(block.input_edge), wide(block.output_edge));
        let (kernel, stride) = (wide(block.kernel), wide(block.stride).max(1));
        let border = parts.blocks.get(i + 1).map_or(0, |next| wide(next.padding));
        let channels = wide(block.outputs).next_multiple_of(LANES);
        let weights = product(&[cube(kernel), wide(block.inputs), channels]);
        // Weights, offsets of the taps, and biases.
        floats = floats.saturating_add(weights).saturating_add(4 * cube(kernel)).saturating_add(channels);
        if i == 0 {
            let padded = input + 2 * wide(block.padding);
            let phase = padded.div_ceil(stride).max(output.next_multiple_of(ROW) + (kernel - 1) / stride);
            let prepared = product(&[kernel, padded, stride, phase.next_multiple_of(LANES)]);
            let row = (output + border).next_multiple_of(LANES);
            let plane = product(&[output + 2 * border, channels, row]);
            let planes = parts.blocks.get(1).map_or(output, |second| wide(second.kernel));
            let kept = product(&[planes, plane]).saturating_add(border + 3 * LANES);
            floats = floats.saturating_add(prepared).saturating_add(kept);
            last = product(&[output, plane]);
        } else {
            last = product(&[cube(output + 2 * border), channels]);
            floats = floats.saturating_add(last).saturating_add(LANES);
        }
    }
    let dense = product(&[last.saturating_add(LANES), wide(parts.fc.outputs)]);
    let bytes = floats.saturating_add(dense).saturating_mul(size_of::<f32>() as u128);
    u64::try_from(bytes).unwrap_or(u64::MAX)
}

/// Checks that the blocks and the dense layer fit together and that the encoder needs at most
/// [`MAX_ENCODER_MEMORY`].
pub(crate) fn check(parts: &VolumeNetParts) -> Result<()> {
    let (mut edge, mut channels) = (parts.input, 1usize);
    if edge == 0 {
        bail!(InvalidTensor, "VolumeNet's input edge is 0: it must be at least 1 voxel");
    }
    if parts.blocks.is_empty() {
        bail!(InvalidTensor, "VolumeNet has no block: expected at least volumenet.encoder.0.conv.weight");
    }
    for (i, block) in parts.blocks.iter().enumerate() {
        let name = alloc::format!("volumenet.encoder.{i}.conv");
        let &ConvBlockParts { inputs, outputs, kernel, stride, padding, input_edge, output_edge, .. } = block;
        if inputs != channels || outputs == 0 || input_edge != edge {
            bail!(
                InvalidTensor,
                "{name} takes {inputs} channels of edge {input_edge} and gives {outputs} channels; the layer \
                 before it gives {channels} channels of edge {edge}"
            );
        }
        let padded = padding.checked_mul(2).and_then(|p| p.checked_add(edge));
        let output = match padded {
            Some(padded) if (1..=padded).contains(&stride) && (1..=padded).contains(&kernel) => {
                (padded - kernel) / stride + 1
            }
            _ => 0,
        };
        if output == 0 || output != output_edge {
            bail!(
                InvalidTensor,
                "{name}: kernel {kernel}, stride {stride}, padding {padding} on an edge of {edge} give an edge \
                 of {output}, not {output_edge}"
            );
        }
        let wanted = [outputs, inputs, kernel, kernel, kernel]
            .iter()
            .try_fold(1usize, |product, &n| product.checked_mul(n));
        let (weights, biases) = (block.weight.len(), block.bias.len());
        if wanted != Some(weights) || biases != outputs {
            bail!(
                InvalidTensor,
                "{name}: {weights} weights and {biases} biases do not fit {outputs} x {inputs} x {kernel}³"
            );
        }
        (edge, channels) = (output, outputs);
    }
    let flat = edge.checked_mul(edge).and_then(|e| e.checked_mul(edge)).and_then(|e| e.checked_mul(channels));
    let taken = parts.fc.inputs;
    if flat != Some(taken) {
        bail!(
            InvalidTensor,
            "volumenet.fc.weight takes {taken} numbers, the last block gives {channels} x {edge}³"
        );
    }
    parts.fc.check("volumenet.fc")?;
    let bytes = memory(parts);
    if bytes > MAX_ENCODER_MEMORY {
        bail!(
            InvalidModel,
            "an encoder of input {}, {} blocks and {} features takes {bytes} bytes, at most {MAX_ENCODER_MEMORY} are \
             accepted: use a smaller input, fewer channels or earlier strides",
            parts.input,
            parts.blocks.len(),
            parts.fc.outputs
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ErrorKind;
    use crate::nn::conv3d::reference;
    use crate::nn::{DenseParts, Dtype, random};
    use crate::scene::VolumeOptions;
    use alloc::vec;

    /// Pseudo-random numbers from -1 to 1.
    fn noise(seed: u64) -> impl FnMut() -> f32 {
        let mut next = random(seed);
        move || (next() >> 29) as f32 / (1 << 23) as f32 - 1.0
    }

    /// Channels, kernel edge, stride and padding of a block.
    type Layer = (usize, usize, usize, usize);

    fn network(input: usize, blocks: &[Layer], features: usize, seed: u64) -> VolumeNetParts {
        let mut next = noise(seed);
        let (mut edge, mut channels) = (input, 1);
        let blocks: Vec<ConvBlockParts> = blocks
            .iter()
            .map(|&(outputs, kernel, stride, padding)| {
                let count = channels * kernel * kernel * kernel;
                let scale = 1.5 / libm::sqrtf(count as f32);
                let block = ConvBlockParts {
                    inputs: channels,
                    outputs,
                    kernel,
                    stride,
                    padding,
                    weight: (0..outputs * count).map(|_| scale * next()).collect(),
                    bias: (0..outputs).map(|_| 0.3 * next()).collect(),
                    input_edge: edge,
                    output_edge: (edge + 2 * padding - kernel) / stride + 1,
                    dtype: Dtype::F32,
                };
                (edge, channels) = (block.output_edge, outputs);
                block
            })
            .collect();
        let inputs = channels * edge * edge * edge;
        let scale = 1.0 / libm::sqrtf(inputs as f32);
        let fc = DenseParts {
            inputs,
            outputs: features,
            weight: (0..inputs * features).map(|_| scale * next()).collect(),
            bias: (0..features).map(|_| next()).collect(),
            dtype: Dtype::F32,
        };
        VolumeNetParts { input, blocks, fc }
    }

    /// Reference: the network in float64 on an input cube in [0, 1].
    fn exact(parts: &VolumeNetParts, cube: impl Iterator<Item = f64>) -> Vec<f64> {
        let mut x: Vec<f64> = cube.map(|v| 2.0 * v - 1.0).collect();
        for block in &parts.blocks {
            x = reference(block, &x);
        }
        let rows = parts.fc.weight.chunks_exact(parts.fc.inputs);
        rows.zip(&parts.fc.bias)
            .map(|(row, &bias)| {
                row.iter().zip(&x).map(|(&w, &x)| f64::from(w) * x).sum::<f64>() + f64::from(bias)
            })
            .collect()
    }

    fn assert_close(found: &[f32], expected: &[f64], what: &str) {
        let norm = libm::sqrt(expected.iter().map(|e| e * e).sum());
        let error = libm::sqrt(
            found.iter().zip(expected).map(|(&f, e)| (f64::from(f) - e) * (f64::from(f) - e)).sum(),
        );
        assert!(error <= 0.1 * VOLUMENET_TOLERANCE * norm, "{what}: error {error:e}, norm {norm:e}");
    }

    fn encode(net: &VolumeNet, view: &VolumeView<'_>) -> Vec<f32> {
        let mut features = vec![f32::NAN; net.feature_len()];
        net.encode(view, &mut net.scratch(), Executor::Serial, &mut features).unwrap();
        features
    }

    /// Compares a network's features of `bytes` with the definition at every level.
    fn check_definition(parts: &VolumeNetParts, bytes: &[u8], what: &str) {
        let view = VolumeView::new(Scalars::U8(bytes), [parts.input; 3]).unwrap();
        let expected = exact(parts, bytes.iter().map(|&b| f64::from(b) / 255.0));
        for level in Level::available() {
            let net = VolumeNet::with(parts, level).unwrap();
            assert_eq!((net.input, net.feature_len(), net.level), (parts.input, parts.fc.outputs, level));
            assert_close(&encode(&net, &view), &expected, &alloc::format!("{what} {level}"));
        }
    }

    const NETWORKS: [(usize, &[Layer]); 16] = [
        // This network and the next have buffers of equal sizes, but different borders.
        (10, &[(4, 3, 2, 0)]),
        (8, &[(4, 3, 2, 1)]),
        (9, &[(5, 3, 2, 1), (7, 3, 2, 1)]),
        (16, &[(8, 3, 2, 1), (16, 3, 2, 1), (32, 3, 2, 1), (64, 3, 2, 1)]),
        (32, &[(8, 3, 2, 1), (16, 3, 2, 1), (48, 3, 2, 1), (33, 3, 2, 1)]),
        (70, &[(3, 3, 2, 1), (16, 3, 2, 1), (4, 5, 3, 2)]),
        (12, &[(6, 1, 1, 0), (9, 1, 1, 0)]),
        (12, &[(20, 5, 1, 2), (3, 2, 2, 0), (17, 4, 3, 3)]),
        (11, &[(4, 2, 3, 0), (4, 2, 3, 1)]),
        (13, &[(4, 1, 4, 0), (6, 1, 2, 2)]),
        (10, &[(4, 7, 2, 3), (4, 3, 1, 4)]),
        (5, &[(2, 5, 1, 0), (40, 1, 1, 0)]),
        (1, &[(3, 1, 1, 0)]),
        (3, &[(2, 2, 5, 6), (2, 3, 4, 3)]),
        (34, &[(17, 3, 1, 1)]),
        // Cuts between threads halve rows of the last layer, which have 16 positions.
        (16, &[(4, 1, 1, 0), (2, 1, 1, 0), (16, 3, 1, 1)]),
    ];

    #[test]
    fn every_level_meets_the_definition_for_any_geometry() {
        for (seed, (input, blocks)) in NETWORKS.into_iter().enumerate() {
            let parts = network(input, blocks, 3, seed as u64 + 1);
            let mut next = noise(seed as u64 + 100);
            let bytes: Vec<u8> = (0..input * input * input).map(|_| (next() * 127.5 + 127.5) as u8).collect();
            check_definition(&parts, &bytes, &alloc::format!("{input} {blocks:?}"));
        }
    }

    /// Compares networks that are small enough for Miri with the definition: every path of the portable
    /// kernels, one, two and three layers.
    #[test]
    fn small_networks_meet_the_definition() {
        let small: [(usize, &[Layer]); 5] = [
            (1, &[(3, 1, 1, 0)]),
            (3, &[(2, 2, 5, 6), (2, 3, 4, 3)]),
            (5, &[(2, 3, 2, 1), (17, 3, 1, 1)]),
            (4, &[(3, 3, 2, 1), (5, 2, 1, 0), (2, 1, 1, 0)]),
            (4, &[(2, 2, 3, 1), (3, 1, 2, 0)]),
        ];
        for (seed, (input, blocks)) in small.into_iter().enumerate() {
            let parts = network(input, blocks, 2, seed as u64 + 1);
            let bytes: Vec<u8> = (0..input * input * input).map(|i| (i * 37 % 251) as u8).collect();
            check_definition(&parts, &bytes, &alloc::format!("{input} {blocks:?}"));
        }
    }

    #[test]
    fn every_scalar_type_and_layout_gives_the_features_of_the_same_cube() {
        let n = 16;
        let parts = network(n, &[(8, 3, 2, 1), (16, 3, 2, 1), (8, 3, 2, 1)], 4, 3);
        let mut next = noise(4);
        let words: Vec<i16> = (0..n * n * n).map(|_| (next() * 30000.0) as i16).collect();
        let unsigned: Vec<u16> = words.iter().map(|&w| (i32::from(w) + 32768) as u16).collect();
        let floats: Vec<f32> = words.iter().map(|&w| f32::from(w)).collect();
        let expected = exact(&parts, words.iter().map(|&w| (f64::from(w) + 30000.0) / 60000.0));
        let mut transposed = vec![0.0; n * n * n];
        for (i, &v) in floats.iter().enumerate() {
            transposed[i % n * n * n + i / n % n * n + i / (n * n)] = v;
        }
        let mut padded = vec![f32::NAN; 3 + (n + 5) * n * n];
        for (i, &v) in floats.iter().enumerate() {
            padded[3 + i / n * (n + 5) + i % n] = v;
        }
        let cube = [n; 3];
        let with = |scalars, strides, low: f32| {
            let range = Some((low, low + 60000.0));
            let options = VolumeOptions { strides, range, ..VolumeOptions::default() };
            VolumeView::with(scalars, cube, options).unwrap()
        };
        let views = [
            with(Scalars::I16(&words), None, -30000.0),
            with(Scalars::U16(&unsigned), None, 2768.0),
            with(Scalars::F32(&floats), None, -30000.0),
            with(Scalars::F32(&transposed), Some([n * n, n, 1]), -30000.0),
            with(Scalars::F32(&padded[3..]), Some([1, n + 5, n * (n + 5)]), -30000.0),
        ];
        for level in Level::available() {
            let net = VolumeNet::with(&parts, level).unwrap();
            for view in &views {
                let what = alloc::format!("{:?} {level}", view.scalars().scalar_type());
                assert_close(&encode(&net, view), &expected, &what);
            }
        }
    }

    #[test]
    fn any_volume_is_resampled_first() {
        let parts = network(8, &[(4, 3, 2, 1), (8, 3, 2, 1)], 2, 5);
        let mut next = noise(6);
        let bytes: Vec<u8> = (0..5 * 7 * 31).map(|_| (next() * 127.5 + 127.5) as u8).collect();
        let view = VolumeView::new(Scalars::U8(&bytes), [5, 7, 31]).unwrap();
        let mut cube = vec![0.0; 512];
        Resampler::default().resample(&view, 8, &mut cube, Executor::Serial).unwrap();
        let expected = exact(&parts, cube.iter().map(|&v| f64::from(v)));
        assert_close(&encode(&VolumeNet::new(&parts).unwrap(), &view), &expected, "resampled");
    }

    #[test]
    fn odd_volumes_have_features() {
        let parts = network(8, &[(4, 3, 2, 1), (8, 3, 2, 1)], 2, 8);
        let net = VolumeNet::new(&parts).unwrap();
        let zero = exact(&parts, core::iter::repeat_n(0.0, 512));
        for values in [[4.0f32; 512], [f32::NAN; 512]] {
            for dims in [[8, 8, 8], [1, 1, 1], [512, 1, 1], [2, 256, 1]] {
                let view = VolumeView::new(Scalars::F32(&values), dims).unwrap();
                assert_close(&encode(&net, &view), &zero, "constant");
            }
        }
        let wild: Vec<f32> =
            (0..512).map(|i| [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1.0, 0.0][i % 5]).collect();
        let view = VolumeView::new(Scalars::F32(&wild), [8, 8, 8]).unwrap();
        let clean = exact(&parts, wild.iter().map(|&v| if v > 0.0 { 1.0 } else { 0.0 }));
        assert_close(&encode(&net, &view), &clean, "NaN and infinities");
        let huge: Vec<f32> = (0..512).map(|i| if i % 3 == 0 { f32::MAX } else { f32::MIN }).collect();
        let view = VolumeView::new(Scalars::F32(&huge), [8, 8, 8]).unwrap();
        let ends = exact(&parts, (0..512).map(|i| if i % 3 == 0 { 1.0 } else { 0.0 }));
        assert_close(&encode(&net, &view), &ends, "whole float range");
    }

    #[cfg(feature = "rayon")]
    #[test]
    fn threads_and_earlier_calls_change_no_bit() {
        for threads in [2, 3, 5] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            for (seed, (input, blocks)) in NETWORKS.into_iter().enumerate() {
                let parts = network(input, blocks, 3, seed as u64 + 1);
                let bytes: Vec<u8> = (0..2 * input * input * input).map(|i| (i * 37 % 251) as u8).collect();
                for dims in [[input; 3], [input, 2 * input, input]] {
                    let view = VolumeView::new(Scalars::U8(&bytes), dims).unwrap();
                    for level in Level::available() {
                        let net = VolumeNet::with(&parts, level).unwrap();
                        let alone = encode(&net, &view);
                        let mut scratch = net.scratch();
                        for executor in [Executor::Rayon(&pool), Executor::Serial, Executor::Rayon(&pool)] {
                            let mut features = [0.0; 3];
                            net.encode(&view, &mut scratch, executor, &mut features).unwrap();
                            let bits = |f: &[f32]| f.iter().map(|f| f.to_bits()).collect::<Vec<_>>();
                            assert_eq!(bits(&features), bits(&alone), "{input} {blocks:?} {level} {threads}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn another_networks_scratch_is_made_to_fit() {
        const ALIKE: [(usize, &[Layer]); 4] = [
            // The planes between the first two layers of these two networks have borders of different widths.
            (14, &[(72, 1, 1, 0), (16, 2, 3, 1)]),
            (14, &[(32, 1, 1, 0), (16, 4, 3, 2)]),
            // The planes of these two networks differ in size, but take the same number of floats in total.
            (14, &[(32, 1, 1, 0), (16, 2, 3, 1)]),
            (14, &[(16, 1, 1, 0), (16, 4, 3, 1)]),
        ];
        let mut nets: Vec<VolumeNet> = Vec::new();
        for level in Level::available() {
            for (seed, (input, blocks)) in NETWORKS.into_iter().chain(ALIKE).enumerate() {
                nets.push(VolumeNet::with(&network(input, blocks, 2, seed as u64), level).unwrap());
            }
        }
        let bytes: Vec<u8> = (0..70 * 70 * 70).map(|i| (i * 31 % 255) as u8).collect();
        let mut shared = nets[0].scratch();
        for net in nets.iter().chain(nets.iter().rev()) {
            let view = VolumeView::new(Scalars::U8(&bytes), [net.input; 3]).unwrap();
            let mut features = [0.0; 2];
            net.encode(&view, &mut shared, Executor::Serial, &mut features).unwrap();
            assert_eq!(features.as_slice(), encode(net, &view), "{} {}", net.input, net.level);
        }
    }

    #[test]
    fn the_memory_that_is_refused_by_is_no_less_than_what_is_taken() {
        for (seed, (input, blocks)) in NETWORKS.into_iter().enumerate() {
            for features in [1, 3] {
                let parts = network(input, blocks, features, seed as u64);
                for level in Level::available() {
                    let taken = VolumeNet::with(&parts, level).unwrap().encoder.memory() as u64;
                    let said = memory(&parts);
                    assert!(taken <= said, "{input} {blocks:?} {level}: {taken} {said}");
                    assert!(said <= 16 * taken + 100_000, "{input} {blocks:?} {level}");
                }
            }
        }
    }

    #[test]
    fn parts_that_do_not_fit_are_refused() {
        let good = network(8, &[(4, 3, 2, 1), (8, 3, 2, 1)], 2, 1);
        assert!(VolumeNet::new(&good).is_ok());
        let refused = |change: &dyn Fn(&mut VolumeNetParts), text: &str| {
            let mut parts = good.clone();
            change(&mut parts);
            let error = VolumeNet::new(&parts).unwrap_err();
            assert_eq!(error.kind(), ErrorKind::InvalidTensor);
            assert!(error.to_string().contains(text), "{}", error.to_string());
        };
        refused(&|p| p.input = 0, "input edge");
        refused(&|p| p.blocks.clear(), "no block");
        refused(&|p| p.blocks[1].inputs = 5, "volumenet.encoder.1.conv");
        refused(&|p| p.blocks[0].stride = 0, "stride 0");
        refused(&|p| p.blocks[0].stride = 11, "stride 11");
        refused(&|p| p.blocks[0].stride = usize::MAX, &alloc::format!("stride {}", usize::MAX));
        refused(&|p| p.blocks[0].kernel = 0, "kernel 0");
        refused(&|p| p.blocks[0].kernel = 11, "kernel 11");
        refused(&|p| p.blocks[0].padding = usize::MAX, "padding");
        refused(&|p| p.blocks[1].output_edge = 3, "not 3");
        refused(&|p| p.blocks[0].weight.truncate(9), "9 weights");
        refused(&|p| p.blocks[0].bias.truncate(1), "1 biases");
        refused(&|p| p.fc.inputs = 65, "65");
        refused(&|p| p.fc.bias[1] = f32::NAN, "volumenet.fc.bias[1]");
        let net = VolumeNet::new(&good).unwrap();
        let view = VolumeView::new(Scalars::U8(&[0; 512]), [8; 3]).unwrap();
        let error = net.encode(&view, &mut net.scratch(), Executor::Serial, &mut [0.0; 3]).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::SizeMismatch);
    }
}
