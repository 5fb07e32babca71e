//! Dense layers packed for sequential reads, and the networks made of them.
//!
//! A layer's outputs are padded to a multiple of 16 and cut into panels of 64, 32 and 16. A panel is stored
//! in the order in which it is read: its biases (for int8 also the scales and the sums of the weights), then
//! for each input (bfloat16: two inputs, int8: four inputs) the weights of all outputs of the panel. So a
//! matrix-vector product reads memory sequentially and keeps all sums in registers; a product with a tile of
//! several rows reads the same panel. The last layer, which has one output, stays a plain row. Padding is
//! zero and stays zero, since SELU(0) = 0.
//!
//! | module | content |
//! |---|---|
//! | `packing` | storage formats and the panels of a layer |
//! | `weights` | packed weights loaded as vectors |
//! | `row` | one row of inputs |
//! | `batch` | batches of rows, in tiles |
//! | `int8` | integer arithmetic of `row` and `batch` |

/// Calls the macro `$do` with literal indices for every row and vector of a tile, so that each sum has a
/// register of its own: in loops, the compiler keeps arrays of sums in memory. Calls for rows from `ROWS` on
/// and vectors from `VECTORS` on compile to nothing.
#[rustfmt::skip]
macro_rules! unrolled {
    ($do:ident!) => {
        $do!(0, 0); $do!(0, 1); $do!(0, 2); $do!(0, 3);
        $do!(1, 0); $do!(1, 1); $do!(1, 2); $do!(1, 3);
        $do!(2, 0); $do!(2, 1); $do!(2, 2); $do!(2, 3);
        $do!(3, 0); $do!(3, 1); $do!(3, 2); $do!(3, 3);
        $do!(4, 0); $do!(4, 1); $do!(4, 2); $do!(4, 3);
        $do!(5, 0); $do!(5, 1); $do!(5, 2); $do!(5, 3);
    };
}

mod batch;
mod int8;
mod packing;
mod row;
mod weights;

use super::Level;
use crate::Result;
use crate::memory::{resize, room, try_vec};
use alloc::vec::Vec;
use batch::ForwardRows;
pub use packing::Storage;
pub(crate) use packing::{Dense, Line};
use packing::{LINE_BYTES, Layer, pack};
use row::Forward;

/// Largest number of rows per batch: two buffers of this many rows and a layer's weights fit in a
/// second-level cache.
pub(crate) const BLOCK_ROWS: usize = 384;

/// A network of dense layers with SELU after every layer but the last, which has one output.
#[derive(Clone, Debug)]
pub(crate) struct Mlp {
    level: Level,
    /// True if the layers between the first and the last are [`Storage::Int8`].
    int8: bool,
    inputs: usize,
    layers: Vec<Layer>,
    /// The last layer: number of inputs, and the line where its row starts.
    last: (usize, usize),
    last_bias: f32,
    /// Means, then reciprocals of the standard deviations, each padded to whole lines; empty without
    /// normalization.
    norm: Vec<Line>,
    data: Vec<Line>,
    /// Width of the widest activation, in floats.
    width: usize,
    /// Size of the largest panel, in floats, if panels are widened to f32; else 0.
    panel: usize,
}

/// Working memory: activations of one or more rows, their quantized bytes, and one panel widened to f32.
#[derive(Clone, Debug, Default)]
pub(crate) struct MlpScratch {
    rows: usize,
    a: Vec<Line>,
    b: Vec<Line>,
    quantized: Vec<Line>,
    ranges: Vec<[f32; 2]>,
    panel: Vec<Line>,
}

impl Mlp {
    /// Packs the layers, first to last. `norm` holds the mean and the standard deviation of each input.
    ///
    /// Callers have checked that sizes agree, that the last layer has one output, and that nothing is empty.
    ///
    /// # Errors
    /// [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the packed weights cannot be allocated.
    pub(crate) fn new(
        level: Level,
        storage: Storage,
        layers: &[Dense<'_>],
        norm: Option<(&[f32], &[f32])>,
    ) -> Result<Self> {
        let (last, hidden) = layers.split_last().expect("callers have checked that there is a layer");
        let inputs = layers[0].inputs;
        let mut data = Vec::new();
        let mut packed = room(hidden.len())?;
        for (i, layer) in hidden.iter().enumerate() {
            // The first layer stays F32: its inputs have any scale, and it is small.
            let storage = if i == 0 && storage == Storage::Int8 { Storage::F32 } else { storage };
            packed.push(pack(layer, storage, &mut data)?);
        }
        let last_start = data.len();
        resize(&mut data, last_start + last.inputs.div_ceil(16), Line::default())?;
        bytemuck::cast_slice_mut::<_, f32>(&mut data[last_start..])[..last.inputs]
            .copy_from_slice(last.weight);
        let lines = inputs.div_ceil(16);
        let mut normal = Vec::new();
        if let Some((mean, std)) = norm {
            normal = try_vec(2 * lines, Line::default())?;
            let (first, second) = bytemuck::cast_slice_mut::<_, f32>(&mut normal).split_at_mut(lines * 16);
            first[..inputs].copy_from_slice(mean);
            second.iter_mut().zip(std).for_each(|(to, s)| *to = 1.0 / s);
        }
        let widest = packed.iter().map(|l: &Layer| l.inputs.max(l.width)).max().unwrap_or(0);
        let panel = packed.iter().map(|l: &Layer| l.inputs * l.width.min(64)).max().unwrap_or(0);
        Ok(Self {
            level,
            int8: storage == Storage::Int8,
            inputs,
            layers: packed,
            last: (last.inputs, last_start),
            last_bias: last.bias[0],
            norm: normal,
            data,
            width: widest.max(inputs).next_multiple_of(16),
            panel: if matches!(storage, Storage::F16 | Storage::Bf16) { panel } else { 0 },
        })
    }

    pub(crate) fn inputs(&self) -> usize {
        self.inputs
    }

    /// The packed weights, for benchmarks that evict them from the caches.
    pub(crate) fn memory(&self) -> &[u8] {
        bytemuck::cast_slice(&self.data)
    }

    /// Allocates working memory for batches of `rows` rows.
    ///
    /// # Errors
    /// [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the memory cannot be allocated.
    pub(crate) fn scratch(&self, rows: usize) -> Result<MlpScratch> {
        let rows = rows.clamp(1, BLOCK_ROWS);
        let lines = rows.saturating_mul(self.width) / 16;
        // Bytes of all rows; for the int8 layers, each row is padded to a multiple of 32.
        let bytes = rows.saturating_mul(self.width.next_multiple_of(32));
        let int8 = self.int8;
        Ok(MlpScratch {
            rows,
            a: try_vec(lines, Line::default())?,
            b: try_vec(lines, Line::default())?,
            quantized: try_vec(if int8 { bytes.div_ceil(LINE_BYTES) } else { 0 }, Line::default())?,
            ranges: try_vec(if int8 { rows } else { 0 }, [0.0; 2])?,
            panel: try_vec(self.panel.div_ceil(16), Line::default())?,
        })
    }

    /// True if the scratch is large enough for this network.
    fn fits(&self, scratch: &MlpScratch) -> bool {
        let numbers = scratch.rows * self.width;
        let int8 = self.int8;
        scratch.rows > 0
            && scratch.a.len() * 16 >= numbers
            && scratch.b.len() * 16 >= numbers
            && scratch.panel.len() * 16 >= self.panel
            && (!int8
                || (scratch.ranges.len() >= scratch.rows
                    && scratch.quantized.len() * LINE_BYTES
                        >= scratch.rows * self.width.next_multiple_of(32)))
    }

    /// Returns the last layer's output for one row of inputs, or `None` if the number of inputs is wrong, or
    /// if the scratch is too small because another network made it.
    #[inline]
    pub(crate) fn forward(&self, inputs: &[f32], scratch: &mut MlpScratch) -> Option<f32> {
        if inputs.len() != self.inputs || !self.fits(scratch) {
            return None;
        }
        Some(if self.int8 {
            self.level.run_dot4(Forward::<true> { net: self, inputs, scratch })
        } else {
            self.level.run(Forward::<false> { net: self, inputs, scratch })
        })
    }

    /// Writes the last layer's output for each row of `inputs` to `outputs`; returns `None` in the cases of
    /// [`forward`](Self::forward).
    pub(crate) fn forward_rows(
        &self,
        inputs: &[f32],
        outputs: &mut [f32],
        scratch: &mut MlpScratch,
    ) -> Option<()> {
        if self.inputs.checked_mul(outputs.len()) != Some(inputs.len()) || !self.fits(scratch) {
            return None;
        }
        let block = scratch.rows;
        for (inputs, outputs) in inputs.chunks(block * self.inputs).zip(outputs.chunks_mut(block)) {
            if self.int8 {
                self.level.run_dot4(ForwardRows::<true> { net: self, inputs, outputs, scratch });
            } else {
                self.level.run(ForwardRows::<false> { net: self, inputs, outputs, scratch });
            }
        }
        Some(())
    }
}
