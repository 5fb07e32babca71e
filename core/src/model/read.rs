//! Reads bytes into a checked [`Model`].

use super::file::TensorData;
use super::key::{FORMAT, GroupKind, Key};
use crate::Result;
use crate::error::bail;
use crate::memory::{collected, room};
use crate::nn::{
    ConvBlockParts, DenseParts, Dtype, Normalization, PredNetParts, Target, VolumeNetParts, check_volumenet,
};
use alloc::borrow::ToOwned;
use alloc::collections::{BTreeMap, BTreeSet};
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;
use serde::{Deserialize, Serialize};

/// Largest accepted edge of VolumeNet's input, in voxels (512³ voxels are 512 MiB as f32).
pub(crate) const MAX_VOLUMENET_INPUT: usize = 512;

/// Largest number of input groups in a model.
pub(crate) const MAX_INPUT_GROUPS: usize = 1024;

/// Variance offset of batch normalization.
const BATCH_NORM_EPSILON: f64 = 1e-5;

/// A named group of consecutive inputs; a model's inputs are its groups in order.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct InputGroup {
    /// Name of the group, such as `camera`.
    pub name: String,
    /// Number of values in the group.
    pub size: usize,
}

/// A checked model file: every tensor that its networks need is present, has the right shape and is finite.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Model {
    /// The input groups in order; empty if the file has no PredNet.
    pub inputs: Vec<InputGroup>,
    /// Names of the scene features in order; empty if the model has no such group.
    pub scene_features: Vec<String>,
    /// PredNet's weights; `None` if the file has none.
    pub prednet: Option<PredNetParts>,
    /// VolumeNet's weights, with batch normalization folded into the convolutions; `None` if the file has
    /// none.
    pub volumenet: Option<VolumeNetParts>,
    /// All entries of `__metadata__`, known ([`Key`]) or not.
    pub metadata: BTreeMap<String, String>,
}

impl Model {
    /// Reads a model file. The bytes need no alignment. Unknown tensors are ignored; unknown metadata is kept
    /// in `Model::metadata`.
    ///
    /// # Errors
    /// [`InvalidModel`](crate::ErrorKind::InvalidModel) for bytes that are not a model file or for invalid
    /// metadata; [`InvalidTensor`](crate::ErrorKind::InvalidTensor) for a tensor that is missing, has a wrong
    /// shape or is not finite; [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the memory for reading the
    /// header, or for the weights, cannot be allocated. An invalid file is refused as a whole.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        Source::parse(bytes)?.model()
    }

    /// Size of an input group; `None` if the model has no such group.
    pub fn input_size(&self, group: GroupKind) -> Option<usize> {
        self.inputs.iter().find(|own| own.name == group.name()).map(|group| group.size)
    }
}

/// Tensors and metadata of which a model is made.
pub(super) struct Source<'a> {
    pub(super) tensors: BTreeMap<String, TensorData<'a>>,
    pub(super) metadata: BTreeMap<String, String>,
}

impl Source<'_> {
    pub(super) fn model(self) -> Result<Model> {
        match self.metadata.get(Key::Format.name()).map(String::as_str) {
            Some(FORMAT) => {}
            Some(other) => bail!(
                InvalidModel,
                "{} is {other:?}, but this version reads {:?}: use a newer version of the library",
                Key::Format,
                FORMAT
            ),
            None => bail!(
                InvalidModel,
                "the metadata lacks {:?}, expected {:?}: the file is no model of entire, or was saved without metadata",
                Key::Format.name(),
                FORMAT
            ),
        }
        let volumenet = if self.has_volumenet() { Some(self.volumenet()?) } else { None };
        let (mut inputs, mut scene_features, mut prednet) = (Vec::new(), Vec::new(), None);
        if let Some(layers) = self.prednet_layers()? {
            let net = self.prednet(layers)?;
            inputs = self.input_groups(net.inputs(), volumenet.as_ref())?;
            scene_features = self.scene_features(&inputs)?;
            prednet = Some(net);
        }
        if prednet.is_none() && volumenet.is_none() {
            bail!(
                InvalidModel,
                "the file holds neither a PredNet (prednet.0.weight) nor a VolumeNet (volumenet.encoder.0.conv.weight)"
            );
        }
        Ok(Model { inputs, scene_features, prednet, volumenet, metadata: self.metadata })
    }

    fn required(&self, key: Key, example: &str) -> Result<&str> {
        match self.metadata.get(key.name()) {
            Some(text) => Ok(text),
            None => bail!(InvalidModel, "the metadata lacks {:?}; a valid value is {example}", key.name()),
        }
    }

    /// Number of PredNet's layers; `None` if the file has no tensor of PredNet.
    fn prednet_layers(&self) -> Result<Option<usize>> {
        let last =
            self.tensors.keys().filter_map(|name| numbered(name, "prednet.", &["weight", "bias"])).max();
        if last.is_none() {
            let ends =
                ["prednet.input.mean", "prednet.input.std", "prednet.output.mean", "prednet.output.std"];
            if let Some(name) = ends.into_iter().find(|name| self.tensors.contains_key(*name)) {
                bail!(
                    InvalidTensor,
                    "prednet.0.weight is missing, expected shape [out, in]; the file holds {name}"
                );
            }
        }
        Ok(last.map(|n| n + 1))
    }

    fn prednet(&self, layers: usize) -> Result<PredNetParts> {
        let text = self.required(Key::Target, "\"seconds\"")?;
        let Some(target) = Target::ALL.into_iter().find(|target| target.name() == text) else {
            bail!(InvalidModel, "{} is {text:?}, expected \"seconds\" or \"log_seconds\"", Key::Target);
        };
        // No capacity is reserved: the count comes from a tensor's name and may be false. The loop ends at
        // the first missing tensor.
        let mut parts = Vec::new();
        for i in 0..layers {
            let known = parts.last().map(|layer: &DenseParts| layer.outputs);
            let last = i + 1 == layers;
            parts.push(self.dense(&format!("prednet.{i}"), known, last.then_some(1))?);
        }
        let net = PredNetParts {
            input: self.normalization("prednet.input", parts[0].inputs)?,
            output: self.normalization("prednet.output", 1)?,
            layers: parts,
            target,
        };
        net.check()?;
        Ok(net)
    }

    fn input_groups(&self, width: usize, volumenet: Option<&VolumeNetParts>) -> Result<Vec<InputGroup>> {
        let key = Key::Inputs;
        let text = self.required(key, "[{\"name\":\"camera\",\"size\":3}]")?;
        let groups: Vec<InputGroup> = match serde_json::from_str(text) {
            Ok(groups) => groups,
            Err(e) => bail!(
                InvalidModel,
                "{key} is not a JSON array of {{\"name\": text, \"size\": whole number}}: {e}"
            ),
        };
        if groups.len() > MAX_INPUT_GROUPS {
            bail!(
                InvalidModel,
                "{key} lists {} groups, but at most {MAX_INPUT_GROUPS} are accepted: join some groups",
                groups.len()
            );
        }
        let (mut total, mut seen) = (0usize, BTreeSet::new());
        for group in &groups {
            let name = group.name.as_str();
            if !seen.insert(name) {
                bail!(InvalidModel, "{key} names the group {name:?} twice");
            }
            let (fits, expected) = match GroupKind::find(name) {
                Some(GroupKind::Camera) => (group.size == 3, "3"),
                Some(GroupKind::Resolution) => (group.size == 2, "2"),
                Some(GroupKind::StepSize) => (group.size == 1, "1"),
                Some(GroupKind::TransferFunction) => {
                    (group.size > 0 && group.size % 3 == 0, "a multiple of 3 (c, w, h per lobe)")
                }
                _ => (group.size > 0, "at least 1"),
            };
            if !fits {
                bail!(InvalidModel, "{key}: the group {name:?} has size {}, expected {expected}", group.size);
            }
            let encoder = volumenet.filter(|_| GroupKind::find(name) == Some(GroupKind::VolumeFeatures));
            if let Some(net) = encoder.filter(|net| group.size != net.features()) {
                bail!(
                    InvalidModel,
                    "{key}: the group {name:?} has size {}, but volumenet.fc.weight gives {} features",
                    group.size,
                    net.features()
                );
            }
            total = total.saturating_add(group.size);
        }
        if total != width {
            bail!(
                InvalidModel,
                "{key} adds up to {total} inputs, but prednet.0.weight takes {width}: make them agree"
            );
        }
        Ok(groups)
    }

    fn scene_features(&self, inputs: &[InputGroup]) -> Result<Vec<String>> {
        let Some(group) = inputs.iter().find(|group| group.name == GroupKind::SceneFeatures.name()) else {
            return Ok(Vec::new());
        };
        let key = Key::SceneFeatures;
        let names: Vec<String> = match serde_json::from_str(self.required(key, "[\"footprint\"]")?) {
            Ok(names) => names,
            Err(e) => bail!(InvalidModel, "{key} is not a JSON array of names: {e}"),
        };
        let InputGroup { name, size } = group;
        if names.len() != *size {
            let count = names.len();
            bail!(InvalidModel, "{key} names {count} features, but the group {name:?} has size {size}");
        }
        let mut seen = BTreeSet::new();
        if let Some(name) = names.iter().find(|name| !seen.insert(name.as_str())) {
            bail!(InvalidModel, "{key} names {name:?} twice");
        }
        Ok(names)
    }

    /// True if the file has a tensor of VolumeNet.
    fn has_volumenet(&self) -> bool {
        let block = ["conv.weight", "conv.bias", "bn.weight", "bn.bias", "bn.running_mean", "bn.running_var"];
        self.tensors.keys().any(|name| {
            numbered(name, "volumenet.encoder.", &block).is_some()
                || matches!(name.as_str(), "volumenet.fc.weight" | "volumenet.fc.bias")
        })
    }

    fn volumenet(&self) -> Result<VolumeNetParts> {
        #[derive(Deserialize)]
        struct Layout {
            input: usize,
            blocks: Vec<Block>,
        }
        #[derive(Deserialize)]
        struct Block {
            stride: usize,
            padding: usize,
        }
        let key = Key::VolumeNet;
        let example = "{\"input\":128,\"blocks\":[{\"stride\":2,\"padding\":1}]}";
        let layout: Layout = match serde_json::from_str(self.required(key, example)?) {
            Ok(layout) => layout,
            Err(e) => bail!(InvalidModel, "{key} is not of the form {example}: {e}"),
        };
        if layout.input == 0 || layout.input > MAX_VOLUMENET_INPUT {
            bail!(InvalidModel, "{key}: input is {}, accepted are 1 to {MAX_VOLUMENET_INPUT}", layout.input);
        }
        let found = self
            .tensors
            .keys()
            .filter_map(|name| numbered(name, "volumenet.encoder.", &["conv.weight"]))
            .max()
            .map_or(0, |n| n + 1);
        // If the list has more blocks than the file, the loop below names the first missing tensor.
        if layout.blocks.is_empty() || layout.blocks.len() < found {
            bail!(
                InvalidModel,
                "{key} lists {} blocks, but the file holds volumenet.encoder.*.conv.weight for {found}: expected one \
                 entry per block and at least one",
                layout.blocks.len()
            );
        }
        let (mut edge, mut channels) = (layout.input, 1);
        let mut blocks: Vec<ConvBlockParts> = Vec::new();
        for (i, &Block { stride, padding }) in layout.blocks.iter().enumerate() {
            let block = self.conv_block(i, edge, channels, stride, padding)?;
            (edge, channels) = (block.output_edge, block.outputs);
            blocks.push(block);
        }
        let Some(flat) = edge.checked_pow(3).and_then(|n| n.checked_mul(channels)) else {
            bail!(InvalidTensor, "the last block gives {channels} x {edge}^3 numbers: too many to flatten");
        };
        let fc = self.dense("volumenet.fc", Some(flat), None)?;
        let parts = VolumeNetParts { input: layout.input, blocks, fc };
        check_volumenet(&parts)?;
        Ok(parts)
    }

    fn conv_block(
        &self,
        i: usize,
        input_edge: usize,
        inputs: usize,
        stride: usize,
        padding: usize,
    ) -> Result<ConvBlockParts> {
        let name = format!("volumenet.encoder.{i}");
        let conv = format!("{name}.conv.weight");
        let expected = format!("[channels, {inputs}, k, k, k] with channels and k at least 1");
        let Some(tensor) = self.tensors.get(&conv) else {
            let key = Key::VolumeNet;
            bail!(InvalidTensor, "{conv} is missing, expected shape {expected}; {key} lists this block");
        };
        let &[outputs, cin, kernel, k1, k2] = tensor.shape.as_slice() else {
            bail!(InvalidTensor, "{conv} has shape {:?}, expected {expected}", tensor.shape);
        };
        if outputs == 0 || cin != inputs || kernel == 0 || k1 != kernel || k2 != kernel {
            bail!(InvalidTensor, "{conv} has shape {:?}, expected {expected}", tensor.shape);
        }
        if stride == 0 || padding >= kernel {
            bail!(
                InvalidModel,
                "{}: block {i} has stride {stride} and padding {padding}, expected a stride of at least 1 and a \
                 padding below the kernel's size {kernel}",
                Key::VolumeNet
            );
        }
        // The sum cannot overflow: the edge is at most MAX_VOLUMENET_INPUT plus the paddings of all blocks,
        // and each padding is smaller than a kernel that the file holds.
        let padded = input_edge + 2 * padding;
        if kernel > padded {
            bail!(
                InvalidTensor,
                "{conv} has kernel {kernel}, but block {i}'s padded input is only {padded} wide: use fewer \
                 blocks, a larger input or more padding"
            );
        }
        if stride > padded {
            bail!(
                InvalidModel,
                "{}: block {i} has stride {stride}, but its padded input is only {padded} wide: expected a stride of 1 \
                 to {padded}",
                Key::VolumeNet
            );
        }
        let output_edge = (padded - kernel) / stride + 1;
        let (weight, dtype) = tensor.numbers(&conv)?;
        let bias = format!("{name}.conv.bias");
        let bias = self.tensors.contains_key(&bias).then(|| self.vector(&bias, outputs)).transpose()?;
        let gamma = self.vector(&format!("{name}.bn.weight"), outputs)?;
        let beta = self.vector(&format!("{name}.bn.bias"), outputs)?;
        let mean = self.vector(&format!("{name}.bn.running_mean"), outputs)?;
        let variance = self.vector(&format!("{name}.bn.running_var"), outputs)?;
        if let Some((c, v)) = variance.iter().enumerate().find(|(_, v)| **v < 0.0) {
            bail!(InvalidTensor, "{name}.bn.running_var[{c}] is {v}: a variance cannot be negative");
        }
        let mut folded = room(weight.len())?;
        let mut folded_bias = room(outputs)?;
        for (c, filter) in weight.chunks_exact(weight.len() / outputs).enumerate() {
            let scale = f64::from(gamma[c]) / libm::sqrt(f64::from(variance[c]) + BATCH_NORM_EPSILON);
            folded.extend(filter.iter().map(|&w| (f64::from(w) * scale) as f32));
            let shift = bias.as_ref().map_or(0.0, |b| f64::from(b[c])) - f64::from(mean[c]);
            folded_bias.push((shift * scale + f64::from(beta[c])) as f32);
        }
        if let Some(at) = folded.iter().position(|w| !w.is_finite()) {
            bail!(InvalidTensor, "{conv}[{at}] (flat index) overflows once {name}.bn is folded into it");
        }
        if let Some(c) = folded_bias.iter().position(|b| !b.is_finite()) {
            bail!(InvalidTensor, "{name}.conv.bias[{c}] overflows once {name}.bn is folded into it");
        }
        Ok(ConvBlockParts {
            inputs,
            outputs,
            kernel,
            stride,
            padding,
            weight: folded,
            bias: folded_bias,
            input_edge,
            output_edge,
            dtype,
        })
    }

    fn vector(&self, name: &str, length: usize) -> Result<Vec<f32>> {
        let Some(tensor) = self.tensors.get(name) else {
            bail!(InvalidTensor, "{name} is missing, expected shape [{length}]");
        };
        if tensor.shape != [length] {
            bail!(InvalidTensor, "{name} has shape {:?}, expected [{length}]", tensor.shape);
        }
        Ok(tensor.numbers(name)?.0)
    }

    /// Reads a dense layer. The number of inputs is checked if `inputs` states it, and likewise the number of
    /// outputs.
    fn dense(&self, name: &str, inputs: Option<usize>, outputs: Option<usize>) -> Result<DenseParts> {
        let weight_name = format!("{name}.weight");
        let size = |known: Option<usize>, unknown: &str| known.map_or(unknown.to_owned(), |n| format!("{n}"));
        let expected = format!("[{}, {}]", size(outputs, "out"), size(inputs, "in"));
        let Some(weight) = self.tensors.get(&weight_name) else {
            bail!(InvalidTensor, "{weight_name} is missing, expected shape {expected}");
        };
        let &[out, width] = weight.shape.as_slice() else {
            bail!(InvalidTensor, "{weight_name} has shape {:?}, expected {expected}", weight.shape);
        };
        if out == 0 || width == 0 || inputs.is_some_and(|n| n != width) || outputs.is_some_and(|n| n != out) {
            bail!(InvalidTensor, "{weight_name} has shape {:?}, expected {expected}", weight.shape);
        }
        let bias = self.vector(&format!("{name}.bias"), out)?;
        let (weight, dtype) = weight.numbers(&weight_name)?;
        Ok(DenseParts { inputs: width, outputs: out, weight, bias, dtype })
    }

    fn normalization(&self, name: &str, length: usize) -> Result<Option<Normalization>> {
        let (mean, std) = (format!("{name}.mean"), format!("{name}.std"));
        if !self.tensors.contains_key(&mean) && !self.tensors.contains_key(&std) {
            return Ok(None);
        }
        let norm = Normalization { mean: self.vector(&mean, length)?, std: self.vector(&std, length)? };
        norm.check(name, length)?;
        Ok(Some(norm))
    }
}

impl TensorData<'_> {
    /// Returns the values, widened exactly to f32, and their stored format. Refuses NaN, infinity, and
    /// formats other than F32, F16 and BF16.
    fn numbers(&self, name: &str) -> Result<(Vec<f32>, Dtype)> {
        use safetensors::Dtype as Stored;
        let (values, dtype): (Vec<f32>, Dtype) = match self.dtype {
            Stored::F32 => {
                let read = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
                (collected(self.data.chunks_exact(4).map(read))?, Dtype::F32)
            }
            Stored::F16 => {
                let read = |b: &[u8]| half::f16::from_le_bytes([b[0], b[1]]).to_f32_const();
                (collected(self.data.chunks_exact(2).map(read))?, Dtype::F16)
            }
            Stored::BF16 => {
                let read = |b: &[u8]| half::bf16::from_le_bytes([b[0], b[1]]).to_f32_const();
                (collected(self.data.chunks_exact(2).map(read))?, Dtype::Bf16)
            }
            other => bail!(
                InvalidTensor,
                "{name} is stored as {other}, expected F32, F16 or BF16: convert it before saving"
            ),
        };
        if let Some(i) = values.iter().position(|v| !v.is_finite()) {
            let (index, value) = (index_of(i, &self.shape), values[i]);
            bail!(InvalidTensor, "{name}{index} is {value}: every number in a model must be finite");
        }
        Ok((values, dtype))
    }
}

/// Converts a flat index to the tensor's own indices, such as `[3, 17]`.
fn index_of(flat: usize, shape: &[usize]) -> String {
    let mut rest = flat;
    let mut indices = shape.to_vec();
    for size in indices.iter_mut().rev() {
        let n = (*size).max(1);
        (*size, rest) = (rest % n, rest / n);
    }
    format!("{indices:?}")
}

/// Returns the number in a name that consists of `prefix`, a number without leading zeros, `.` and one of
/// `suffixes`; `None` for any other name.
fn numbered(name: &str, prefix: &str, suffixes: &[&str]) -> Option<usize> {
    let (number, suffix) = name.strip_prefix(prefix)?.split_once('.')?;
    if !suffixes.contains(&suffix) || (number.len() > 1 && number.starts_with('0')) {
        return None;
    }
    // Numbers of more than six digits are refused: no file has so many layers. Six digits cannot overflow.
    (number.len() <= 6 && number.bytes().all(|b| b.is_ascii_digit())).then(|| number.parse().ok())?
}
