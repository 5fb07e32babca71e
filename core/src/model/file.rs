//! Container of a model: tensors and metadata, read from and written to safetensors bytes.

use super::key::{FORMAT, Key};
use super::read::{InputGroup, Model, Source};
use crate::Result;
use crate::error::bail;
use crate::memory::check_bytes;
use crate::nn::{Dtype, Normalization, PredNetParts};
use alloc::borrow::{Cow, ToOwned};
use alloc::collections::{BTreeMap, BTreeSet};
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;
use core::fmt;
use safetensors::Dtype as Stored;
use serde::de::{IgnoredAny, MapAccess, Visitor};
use serde::ser::{SerializeMap, Serializer};
use serde::{Deserialize, Deserializer, Serialize};

/// Length of the first field of a safetensors file, in bytes. The field states the length of the header.
const PREFIX: usize = 8;
/// Largest accepted header, in bytes.
const MAX_HEADER: usize = 16 << 20;
/// Upper estimate of the parser's memory per byte of header, in bytes. Nested arrays need the most memory.
/// Each nested array has two characters in the header, and the parser allocates 144 bytes for it: a vector
/// with room for four elements of 32 bytes, and 16 bytes of the allocator's own data.
const HEADER_MEMORY: usize = 72;

/// One tensor as stored in the file: little-endian values, last axis fastest.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct TensorData<'a> {
    pub(super) dtype: Stored,
    pub(super) shape: Vec<usize>,
    pub(super) data: Cow<'a, [u8]>,
}

impl<'a> Source<'a> {
    /// Splits the bytes into tensors and metadata. Every size is checked against the length of the bytes
    /// before anything is allocated for it.
    pub(super) fn parse(bytes: &'a [u8]) -> Result<Self> {
        let Some((prefix, rest)) = bytes.split_first_chunk::<PREFIX>() else {
            bail!(InvalidModel, "not a safetensors file: {} bytes, expected at least {PREFIX}", bytes.len());
        };
        let stated = u64::from_le_bytes(*prefix);
        if stated > MAX_HEADER as u64 || stated > rest.len() as u64 {
            bail!(
                InvalidModel,
                "not a safetensors file, or cut short: it states a header of {stated} bytes (at most \
                 {MAX_HEADER} are accepted), but {} bytes follow",
                rest.len()
            );
        }
        let (header, data) = rest.split_at(stated as usize);
        // Parsing makes many small allocations, which together take up to `HEADER_MEMORY` times the header's
        // length.
        check_bytes(header.len().saturating_mul(HEADER_MEMORY))?;
        let unique = serde_json::from_slice(header).and_then(|_: Names| serde_json::from_slice(header));
        let header: safetensors::tensor::Metadata = match unique {
            Ok(header) => header,
            Err(e) => bail!(InvalidModel, "the safetensors header is damaged: {e}"),
        };
        if header.data_len() != data.len() {
            bail!(
                InvalidModel,
                "the header describes {} bytes of tensors, but the file has {}: it was cut short or has bytes added",
                header.data_len(),
                data.len()
            );
        }
        let mut tensors = BTreeMap::new();
        for (name, info) in header.tensors() {
            let (start, end) = info.data_offsets;
            let Some(slice) = data.get(start..end) else {
                bail!(
                    InvalidModel,
                    "{name} is at bytes {start} to {end} of {}: beyond the end of the file",
                    data.len()
                );
            };
            let tensor =
                TensorData { dtype: info.dtype, shape: info.shape.clone(), data: Cow::Borrowed(slice) };
            tensors.insert(name, tensor);
        }
        let metadata = header.metadata().iter().flatten().map(|(k, v)| (k.clone(), v.clone())).collect();
        Ok(Self { tensors, metadata })
    }
}

/// Editable content of a model file: named tensors and metadata. Unknown entries are kept, so that
/// fine-tuning a file loses nothing (decoder tensors of the training, notes, …).
///
/// The bytes depend only on the content, not on the order of insertion.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelFile {
    pub(super) tensors: BTreeMap<String, TensorData<'static>>,
    /// All metadata: the entries of [`Key`] and all other entries.
    pub metadata: BTreeMap<String, String>,
}

impl Default for ModelFile {
    /// A file without tensors; its only metadata entry is the format's version.
    fn default() -> Self {
        Self { tensors: BTreeMap::new(), metadata: BTreeMap::from([(Key::Format.into(), FORMAT.into())]) }
    }
}

impl ModelFile {
    /// Reads any safetensors file, even if it is not a model of entire.
    ///
    /// # Errors
    /// [`InvalidModel`](crate::ErrorKind::InvalidModel) for bytes that are not a safetensors file;
    /// [`OutOfMemory`](crate::ErrorKind::OutOfMemory) if the memory for reading the header cannot be
    /// allocated.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        let source = Source::parse(bytes)?;
        let own = |(name, t): (String, TensorData<'_>)| {
            (name, TensorData { dtype: t.dtype, shape: t.shape, data: Cow::Owned(t.data.into_owned()) })
        };
        Ok(Self { tensors: source.tensors.into_iter().map(own).collect(), metadata: source.metadata })
    }

    /// Inserts a tensor, rounded to `dtype` (to nearest, ties to even).
    ///
    /// # Errors
    /// [`InvalidTensor`](crate::ErrorKind::InvalidTensor) when the shape and the number of values disagree or
    /// a value is not finite in `dtype`.
    pub fn set_tensor(
        &mut self,
        name: &str,
        dtype: Dtype,
        shape: &[usize],
        values: &[f32],
    ) -> Result<&mut Self> {
        if shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d)) != Some(values.len()) {
            bail!(InvalidTensor, "{name}: shape {shape:?} does not hold {} numbers", values.len());
        }
        let mut data = Vec::with_capacity(values.len() * dtype.bytes());
        for (i, &value) in values.iter().enumerate() {
            let finite = match dtype {
                Dtype::F32 => {
                    data.extend_from_slice(&value.to_le_bytes());
                    value.is_finite()
                }
                Dtype::F16 => {
                    let half = half::f16::from_f32_const(value);
                    data.extend_from_slice(&half.to_le_bytes());
                    half.is_finite()
                }
                Dtype::Bf16 => {
                    let half = half::bf16::from_f32_const(value);
                    data.extend_from_slice(&half.to_le_bytes());
                    half.is_finite()
                }
            };
            if !finite {
                bail!(InvalidTensor, "{name}[{i}] (flat index) is {value}: not finite as {}", dtype.name());
            }
        }
        let dtype = match dtype {
            Dtype::F32 => Stored::F32,
            Dtype::F16 => Stored::F16,
            Dtype::Bf16 => Stored::BF16,
        };
        self.tensors
            .insert(name.to_owned(), TensorData { dtype, shape: shape.to_vec(), data: Cow::Owned(data) });
        Ok(self)
    }

    /// Replaces every tensor under `prednet.`, the target and the input groups. Weights are stored in each
    /// layer's [`dtype`](crate::nn::DenseParts::dtype), every other tensor of PredNet as F32.
    ///
    /// # Errors
    /// [`InvalidTensor`](crate::ErrorKind::InvalidTensor) when the parts do not fit together or a
    /// weight overflows its format.
    pub fn set_prednet(&mut self, net: &PredNetParts, inputs: &[InputGroup]) -> Result<&mut Self> {
        net.check()?;
        self.tensors.retain(|name, _| !name.starts_with("prednet."));
        for (i, layer) in net.layers.iter().enumerate() {
            let shape = [layer.outputs, layer.inputs];
            self.set_tensor(&format!("prednet.{i}.weight"), layer.dtype, &shape, &layer.weight)?;
            self.set_tensor(&format!("prednet.{i}.bias"), Dtype::F32, &[layer.outputs], &layer.bias)?;
        }
        for (name, norm) in [("input", &net.input), ("output", &net.output)] {
            if let Some(Normalization { mean, std }) = norm {
                self.set_tensor(&format!("prednet.{name}.mean"), Dtype::F32, &[mean.len()], mean)?;
                self.set_tensor(&format!("prednet.{name}.std"), Dtype::F32, &[std.len()], std)?;
            }
        }
        self.metadata.insert(Key::Target.into(), net.target.name().into());
        self.metadata.insert(Key::Inputs.into(), json(inputs)?);
        Ok(self)
    }

    /// Returns the file's model; checks the content as [`Model::from_bytes`] does.
    ///
    /// # Errors
    /// As [`Model::from_bytes`].
    pub fn to_model(&self) -> Result<Model> {
        let tensors = self.tensors.iter().map(|(name, t)| {
            let data = Cow::Borrowed(&t.data[..]);
            (name.clone(), TensorData { dtype: t.dtype, shape: t.shape.clone(), data })
        });
        Source { tensors: tensors.collect(), metadata: self.metadata.clone() }.model()
    }

    /// Returns the bytes of the file. Refuses content that could not be read back as a model.
    ///
    /// # Errors
    /// As [`Model::from_bytes`].
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        self.to_model()?;
        // Tensors are sorted by the width of their type, widest first. Each tensor is then aligned to its own
        // type, as in files of other writers of the format.
        let mut order: Vec<_> = self.tensors.iter().collect();
        order.sort_by(|(name, t), (other, o)| o.dtype.cmp(&t.dtype).then_with(|| name.cmp(other)));
        let mut header = json(&Header { metadata: &self.metadata, tensors: &order })?.into_bytes();
        header.resize(header.len().next_multiple_of(PREFIX), b' ');
        if header.len() > MAX_HEADER {
            bail!(
                InvalidModel,
                "the header would take {} bytes, but at most {MAX_HEADER} can be read back: shorten the metadata",
                header.len()
            );
        }
        let size: usize = order.iter().map(|(_, t)| t.data.len()).sum();
        let mut bytes = Vec::with_capacity(PREFIX + header.len() + size);
        bytes.extend_from_slice(&(header.len() as u64).to_le_bytes());
        bytes.extend_from_slice(&header);
        for (_, tensor) in order {
            bytes.extend_from_slice(&tensor.data);
        }
        Ok(bytes)
    }
}

/// The names in a safetensors header, for the check that none occurs twice. The format forbids repeated
/// names; the parser of [`safetensors`] would keep the last entry of a repeated name.
#[derive(Deserialize)]
#[serde(expecting = "a JSON object")]
struct Names {
    #[serde(rename = "__metadata__")]
    _metadata: Option<Unique>,
    #[serde(flatten)]
    _tensors: Unique,
}

/// A JSON object without repeated names.
struct Unique;

impl<'de> Deserialize<'de> for Unique {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> core::result::Result<Self, D::Error> {
        deserializer.deserialize_map(Self)
    }
}

impl<'de> Visitor<'de> for Unique {
    type Value = Self;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> core::result::Result<Self, A::Error> {
        let mut names = BTreeSet::new();
        while let Some((name, IgnoredAny)) = map.next_entry::<String, IgnoredAny>()? {
            if let Some(name) = names.replace(name) {
                return Err(serde::de::Error::custom(format!("it names {name:?} twice")));
            }
        }
        Ok(self)
    }
}

/// The safetensors header with entries in a fixed order.
struct Header<'a> {
    metadata: &'a BTreeMap<String, String>,
    tensors: &'a [(&'a String, &'a TensorData<'static>)],
}

impl Serialize for Header<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> core::result::Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.tensors.len() + 1))?;
        map.serialize_entry("__metadata__", self.metadata)?;
        let mut start = 0;
        for (name, tensor) in self.tensors {
            let end = start + tensor.data.len();
            let info = safetensors::tensor::TensorInfo {
                dtype: tensor.dtype,
                shape: tensor.shape.clone(),
                data_offsets: (start, end),
            };
            map.serialize_entry(name, &info)?;
            start = end;
        }
        map.end()
    }
}

fn json<T: Serialize + ?Sized>(value: &T) -> Result<String> {
    match serde_json::to_string(value) {
        Ok(text) => Ok(text),
        Err(e) => bail!(InvalidModel, "the model's metadata cannot be written as JSON: {e}"),
    }
}
